"""Every faulty file is named by its check; none raises, none needs much memory or
time.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from bad_submissions import FAULTS, cpu_seconds
from hypothesis import HealthCheck, given, seed, settings
from hypothesis import strategies as st
from submission_data import Bench, small
from turns import of_this_turn, turn

from lagbench.submission import CHECKS, ValidationResult

SECONDS = 10.0
MEBIBYTES = 1000.0


def most() -> float:
    """Memory that no child may exceed [MiB].

    Linux counts what this process held when it started a child as the child's: in a
    large test run the bound is what this process holds, in a run of this file alone it
    is MEBIBYTES.
    """
    return max(MEBIBYTES, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024 + 1)


bench = small


@pytest.fixture
def peaks(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Peak resident memory of every child that ends during a test [MiB], those of other
    tests left out.
    """
    found: list[float] = []

    def waitpid(pid: int, options: int) -> tuple[int, int]:
        ended, status, usage = os.wait4(pid, options)
        if ended:
            found.append(usage.ru_maxrss / 1024)
        return ended, status

    monkeypatch.setattr(os, "waitpid", waitpid)
    return found


def assert_complete(result: ValidationResult) -> None:
    """Every check has found something, passed, or says why it was not made; exit code
    and errors agree.
    """
    found = {finding.check for finding in result.findings}
    assert found | set(result.passed) | set(result.skipped) == set(CHECKS)
    assert result.exit_code in (0, 1, 3, 4)
    assert (result.exit_code == 0) == result.valid
    for finding in result.findings:
        parts = (
            finding.what,
            finding.where,
            finding.expected,
            finding.got,
            finding.fix,
        )
        assert all(part and part.isprintable() for part in parts), finding


def test_there_are_enough_faults_and_a_valid_file_has_none(bench: Bench) -> None:
    """At least 40 distinct ones, and every check that rejects has one.

    Exit code 0, nothing found, nothing skipped.
    """
    assert len(FAULTS) >= 40
    warnings = {"discontinuous_start", "max_displacement"}
    assert {fault.check for fault in FAULTS.values()} == set(CHECKS) - warnings
    result = bench.validate(bench.valid, isolated=True)
    assert result.passed == CHECKS
    assert result.exit_code == 0
    assert result.split == "cavity"
    assert result.method == "truth"


SLOW_FAULTS = ("heap_loops",)
"""Their files are read for seconds before they are given up."""


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow) if name in SLOW_FAULTS else name
        for name in FAULTS
    ],
)
def test_a_faulty_file_fails_its_check(
    bench: Bench, peaks: list[float], name: str
) -> None:
    """The right check, exit code and hint; in this process but for files that would
    stop it.
    """
    fault = FAULTS[name]
    path = fault.make(bench)
    started = cpu_seconds()
    result = bench.validate(path, isolated=fault.hostile)
    assert cpu_seconds() - started < SECONDS
    assert bool(peaks) >= fault.hostile
    assert max(peaks, default=0.0) < most()
    assert fault.check in {finding.check for finding in result.errors}
    assert result.exit_code == fault.exit_code
    assert fault.says in "\n".join(map(str, result.errors))
    assert_complete(result)


@pytest.mark.parametrize(
    "name", ["truncated_half", "stale_hash", "one_nan", "external_link", "fifo"]
)
def test_the_child_process_says_the_same(bench: Bench, name: str) -> None:
    """What the child finds is what this process finds."""
    path = FAULTS[name].make(bench)
    assert bench.validate(path, isolated=True) == bench.validate(path)


MUTATIONS = st.lists(
    st.tuples(
        st.floats(0, 1, exclude_max=True),
        st.sampled_from([0, 1, 8, 127, 128, 255]) | st.integers(0, 255),
    ),
    min_size=1,
    max_size=8,
)


def check_mutation(
    bench: Bench,
    peaks: list[float],
    changes: list[tuple[float, int]],
    keep: float,
) -> None:
    """A valid file with bytes changed and its end cut off passes or fails named checks,
    in bounds.
    """
    data = np.frombuffer(bench.valid.read_bytes(), np.uint8).copy()
    for place, value in changes:
        data[int(place * len(data))] = value
    path = bench.folder / "mutated.nc"
    path.write_bytes(data[: max(1, int(keep * len(data)))].tobytes())
    started = cpu_seconds()
    result = bench.validate(path, isolated=True)
    assert cpu_seconds() - started < SECONDS
    assert max(peaks, default=0.0) < most()
    assert "Traceback" not in str(result)
    assert_complete(result)  # a child that dies is a finding


BYTES = given(changes=MUTATIONS, keep=st.just(1.0) | st.floats(0, 1))
RELAXED = [HealthCheck.too_slow, HealthCheck.function_scoped_fixture]
FEW = settings(
    max_examples=15,
    deadline=None,
    database=None,
    suppress_health_check=RELAXED,
)
MANY = settings(FEW, max_examples=30)
test_changed_bytes_never_escape_the_checks = FEW(BYTES(check_mutation))
# other examples in every turn
test_many_changed_bytes_never_escape_the_checks = pytest.mark.slow(
    seed(turn())(MANY(BYTES(check_mutation)))
)


@pytest.mark.slow
def test_the_script_makes_and_recognises_all_of_them(tmp_path: Path) -> None:
    """A ninth of the faults at each commit, every one in a child process, within time
    and memory: exit code 0.
    """
    script = Path(__file__).parents[1] / "bad_submissions.py"
    names = of_this_turn(list(FAULTS), turns=9)
    done = subprocess.run(
        [sys.executable, script, tmp_path, *names],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert f"{len(names)} faulty files, 0 not recognised" in done.stdout
