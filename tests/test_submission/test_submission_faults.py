"""Every faulty file is named by its check; none raises."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from faults import FAULTS
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from submission_data import Bench, small

from lagbench.submission import CHECKS, ValidationResult
from lagbench.submission.issues import quote

bench = small


def assert_complete(result: ValidationResult) -> None:
    """Every check has found something, passed, or says why it was not made; exit code
    and errors agree.
    """
    found = {finding.check for finding in result.findings}
    assert found | set(result.passed) | set(result.skipped) == set(CHECKS)
    assert result.exit_code in (0, 1, 3, 4)
    assert (result.exit_code == 0) == result.valid


def test_a_valid_file_has_no_fault(bench: Bench) -> None:
    result = bench.validate(bench.valid)
    assert result.passed == CHECKS
    assert result.exit_code == 0
    assert result.split == "cavity"
    assert result.method == "truth"


@pytest.mark.parametrize("name", FAULTS)
def test_a_faulty_file_fails_its_check(bench: Bench, name: str) -> None:
    fault = FAULTS[name]
    result = bench.validate(fault.make(bench))
    assert fault.check in {finding.check for finding in result.errors}
    assert result.exit_code == fault.exit_code
    assert_complete(result)


# bytes of the header are left alone: HDF5 may loop on them
@given(
    places=st.lists(st.floats(0.5, 1, exclude_max=True), min_size=1, max_size=8),
    keep=st.just(1.0) | st.floats(0, 1),
)
@settings(
    max_examples=10,
    deadline=None,
    database=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)
def test_changed_bytes_never_escape_the_checks(
    bench: Bench, places: list[float], keep: float
) -> None:
    data = np.frombuffer(bench.valid.read_bytes(), np.uint8).copy()
    for place in places:
        data[int(place * len(data))] ^= 255
    path = bench.folder / "mutated.nc"
    path.write_bytes(data[: max(1, int(keep * len(data)))].tobytes())
    assert_complete(bench.validate(path))


def test_text_of_strangers_is_shown_escaped_and_short() -> None:
    """Control characters never reach the terminal."""
    assert quote("\x1b[2J\u202e") == r"'\x1b[2J\u202e'"
    assert len(quote("x" * 10**6)) == 80
    assert len(quote([16**5000])) < 80
    assert len(quote(np.arange(40.0).reshape(8, 5)).splitlines()) == 1


def test_the_document_names_every_check() -> None:
    """docs/predictions.md and the code do not drift apart."""
    text = (Path(__file__).parents[2] / "docs" / "predictions.md").read_text()
    rows = [line.split("|") for line in text.splitlines() if line.startswith("| `")]
    severities = {"error", "warning", "error, warning"}
    assert [row[1].strip(" `") for row in rows if row[2].strip() in severities] == list(
        CHECKS
    )
