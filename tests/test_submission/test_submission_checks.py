"""The checks: warnings, truth that is missing or changed, all issues together."""

from __future__ import annotations

import os
import shlex
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

import h5py
import numpy as np
import pytest
from faults import positions, rows, store
from numpy.typing import ArrayLike
from scenario_factory import make_key, write_scenario
from submission_data import (
    FRAMES,
    GIVEN,
    PARTICLES,
    TESTS,
    Bench,
    make_bench,
    small,
    truth,
)

from lagbench.data import local as module
from lagbench.data.registry import Registry
from lagbench.errors import (
    ChecksFailedError,
    DataError,
    LagbenchError,
    UnreadableFileError,
)
from lagbench.submission import Severity, ValidationResult, validate
from lagbench.submission.issues import IssueCollector
from lagbench.submission.truth import Truth
from lagbench.submission.validation import ScenarioScan, check_domain

bench = small


def changed(bench: Bench, new: ArrayLike, place: Any = ...) -> ValidationResult:
    """Validate the valid file with other positions, all of them or those of a place."""
    path = bench.copy("changed.nc")
    with h5py.File(path, "r+") as file:
        values = positions(file)
        values[place] = new
        store(file, values)
    return bench.validate(path)


@pytest.mark.parametrize(("periods", "is_flagged"), [(0.9, False), (-4.0, True)])
def test_particles_periods_away_from_a_periodic_box_are_flagged(
    bench: Bench, periods: float, is_flagged: bool
) -> None:
    """Their images are scored, so that nothing else would show how far they went."""
    original = bench.registry.size("cavity", "tiny")
    size = original.model_copy(update={"periodic": ("x", "y")})
    block = np.stack([size.box.centre + np.zeros((PARTICLES, 2))] * 2)
    block = block.astype(np.float32)
    block[1, 7, 1] = size.box.high[1] + periods * size.box.lengths[1]
    scan = ScenarioScan(3)
    scan.add(GIVEN, block, size)
    issues = IssueCollector()
    check_domain([scan], size, issues)
    warnings = issues.result(bench.valid).warnings
    places = [(issue.check, issue.where) for issue in warnings]
    place = f"scenario 3, frame {GIVEN + 1}, particle 7, y"
    assert places == ([("in_domain", place)] if is_flagged else [])


def test_particles_outside_the_box_are_flagged(bench: Bench) -> None:
    """One position of 1152 at x = 1.5: a warning with its place, exit code 0.

    The wall is at 0.9375 and a solver cell is 0.125 wide: 1.06 passes, 1.07 does not.
    """
    result = changed(bench, 1.5, (1, 4, 9, 0))
    flag = next(f for f in result.findings if f.check == "in_domain")
    assert flag.severity == Severity.WARNING
    assert result.exit_code == 0
    assert flag.where.endswith("scenario 4, frame 7, particle 9")
    assert flag.share == pytest.approx(1 / (3 * 8 * 48), rel=1e-3)
    for place, flagged in ((1.06, False), (1.07, True)):
        assert (
            "in_domain" in {f.check for f in changed(bench, place).warnings}
        ) == flagged


def test_jumps_are_flagged(bench: Bench) -> None:
    """A particle that starts 15 steps away and stays there jumps once, before the first
    predicted frame.

    Particles permuted in the middle of the rollout jump too; a displacement that is
    surely reached ends the search in the truth.
    """
    source = truth_of(bench)
    everything = source.largest_displacement(4, enough=np.inf)
    assert 0 < source.largest_displacement(4, enough=1e-9) <= everything
    result = changed(bench, np.stack([truth(i)[4:, ::-1] for i in TESTS]), np.s_[:, 4:])
    assert {f.check for f in result.findings} == {"max_displacement"}
    assert [f.where.split(",")[1].strip() for f in result.warnings] == [
        "from frame 6 to 7"
    ] * 3
    assert result.exit_code == 0
    result = changed(
        bench, source.given_frames(4)[-1, 9] + [15 * everything, 0.0], np.s_[1, :, 9]
    )
    assert [f.check for f in result.findings] == ["max_displacement"]
    assert (
        result.warnings[0].where
        == f"scenario 4, from frame {GIVEN - 1} to {GIVEN}, particle 9"
    )
    assert result.exit_code == 0


def test_the_limit_of_the_start_is_ten_displacements(bench: Bench) -> None:
    """Scenarios moved by 0.9 and 1.1 times the limit at their first frame: the second
    is flagged.
    """
    source = truth_of(bench)
    limit = 10 * source.largest_displacement(3, enough=np.inf)
    flagged = []
    steps = np.diff(
        np.concatenate([source.given_frames(3), truth(3)]).astype("f8"), axis=0
    )
    assert limit == pytest.approx(10 * np.sqrt((steps**2).sum(-1)).max())
    for factor in (0.9, 1.1):
        result = changed(
            bench,
            source.given_frames(3)[-1] + np.array([factor * limit, 0], np.float32),
            0,
        )
        assert result.exit_code == 0
        flagged.append(result.warnings)
    assert not flagged[0]
    assert flagged[1][0].check == "discontinuous_start"


def test_all_issues_are_reported_together(bench: Bench) -> None:
    """No method, a missing scenario, a NaN and a stale hash in one run, in the order of
    the checks.
    """
    path = rows(bench, "several", [3, 5], list(range(GIVEN, FRAMES)), [0, 2])
    with h5py.File(path, "r+") as file:
        file.attrs["dataset_sha256"] = "ab" * 32
        file["position"][1, 2, 3, 0] = np.nan
        del file.attrs["method"]
    result = bench.validate(path)
    assert [f.check for f in result.errors] == [
        "format",
        "dataset",
        "scenarios",
        "finite",
    ]
    assert result.verdict == "not valid"
    assert result.exit_code == 4


def test_without_the_data_set_what_needs_no_truth_is_checked(
    unmeasured: Registry, bench: Bench, tmp_path: Path
) -> None:
    """Two checks are skipped and give the command; for scoring that is an error of exit
    code 4.

    A registry that nobody measured cannot vouch: the check says so and does not reject.
    """
    elsewhere = replace(bench, root=tmp_path)
    result = elsewhere.validate(bench.valid)
    assert result.exit_code == 0
    assert set(result.skipped) == {
        "start",
        "discontinuous_start",
        "shifted",
        "max_displacement",
    }
    required = elsewhere.validate(bench.valid, require_truth=True)
    assert required.exit_code == 4
    with pytest.raises(DataError) as caught:
        required.check()
    assert "cavity/tiny/v2/test" in str(caught.value)
    result = validate(
        bench.valid,
        root=tmp_path,
        registry=unmeasured,
    )
    flag = next(f for f in result.findings if f.check == "dataset")
    assert flag.severity == Severity.WARNING


@pytest.mark.parametrize(
    ("checks", "deciding_check", "kind"),
    [
        (("format", "dataset"), "dataset", DataError),
        (("format", "dataset", "readable"), "readable", UnreadableFileError),
        (("finite", "format"), "format", ChecksFailedError),
    ],
)
def test_the_raised_error_describes_the_check_that_decides_its_class(
    checks: Sequence[str], deciding_check: str, kind: type[LagbenchError]
) -> None:
    issues = IssueCollector()
    for check in checks:
        issues.error(check, "wrong; mend it", where="/")
    result = issues.result(Path("p.nc"))
    with pytest.raises(kind) as caught:
        result.check()
    assert f"[{deciding_check}]" in str(caught.value)
    assert result.exit_code == caught.value.exit_code


@pytest.fixture
def own(tmp_path: Path) -> Bench:
    """A small data set of which a test may change files, and a valid submission."""
    return make_bench(tmp_path)


def truth_of(own: Bench) -> Truth:
    """The test subset."""
    return Truth(own.registry.size("cavity", "tiny"), own.root)


def change(path: Path, *, keep_times: bool = False) -> None:
    """Change one value of a file and nothing else."""
    before = path.stat()
    with h5py.File(path, "r+") as file:
        file["position"][1, 2, 0] += 0.001
    if keep_times:
        os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))


@pytest.fixture
def hashed() -> Iterator[mock.Mock]:
    """What is called with every file whose values are hashed during a test."""
    with mock.patch.object(
        module, "check_scenario", side_effect=module.check_scenario
    ) as listening:
        yield listening


@pytest.mark.parametrize(
    "damage", ["cut", "another scenario", "one value, all attributes kept"]
)
def test_a_damaged_data_set_is_not_blamed_on_the_submission(
    own: Bench, damage: str
) -> None:
    """Exit code 4, naming the file and the command that mends it."""
    path = truth_of(own).path(4)
    if damage == "cut":
        path.write_bytes(path.read_bytes()[:3000])
    elif damage == "another scenario":
        write_scenario(
            own.root,
            make_key(4),
            frames=FRAMES,
            particles=PARTICLES,
            seed="another",
        )
    else:
        change(path)
    result = own.validate(own.valid)
    assert result.exit_code == 4
    assert {f.check for f in result.errors} == {"dataset"}
    assert not result.valid
    assert result.verdict == "not judged"
    assert str(path) in result.errors[0].where
    command = "lagbench generate --split cavity --size tiny --subset test --root"
    assert f"{command} {shlex.quote(str(own.root))}" in result.errors[0].what
    assert set(result.skipped) == {
        "start",
        "discontinuous_start",
        "shifted",
        "max_displacement",
    }


def test_a_change_after_the_check_is_refused(own: Bench, hashed: mock.Mock) -> None:
    """The note of a check counts for the hashed bytes only, also where the times were
    put back.
    """
    assert own.validate(own.valid).valid
    path = truth_of(own).path(4)
    change(path, keep_times=True)
    hashed.reset_mock()
    with pytest.raises(DataError) as caught:
        truth_of(own).check()
    assert caught.value.exit_code == 4
    assert hashed.mock_calls == [mock.call(path)]
