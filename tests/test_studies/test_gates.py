"""Gates: their measures on accelerations and clouds that are known."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from studies.gates import Gates, StepErrors, count_densest, read_recorded, to_json

GRAVITY = 2.5 / 3600


def steps() -> StepErrors:
    """Return errors of no window yet."""
    return StepErrors(free_flight=[], settled=[])


def test_no_acceleration_at_all_has_an_error_of_1() -> None:
    truth = np.random.default_rng(0).normal(0.0, 1e-4, (50, 2))
    errors = steps()
    errors.add(-truth, truth, 0.0)
    assert errors.relative == pytest.approx(1.0)


def test_the_bias_is_that_of_windows_in_free_flight_or_at_rest() -> None:
    """Matter that accelerates otherwise counts in neither."""
    error = np.tile([0.0, -0.4 * GRAVITY], (50, 1))
    falling = np.tile([0.0, -GRAVITY], (50, 1))
    errors = steps()
    errors.add(error, falling, -GRAVITY)
    errors.add(0.5 * error, np.zeros((50, 2)), -GRAVITY)
    errors.add(error, 3.0 * falling, -GRAVITY)
    assert errors.free_flight == pytest.approx([-0.4])
    assert errors.settled == pytest.approx([-0.2])


def test_the_fullest_cell_is_counted() -> None:
    cloud = np.full((30, 2), 0.52, np.float32)
    cloud[:10] = 0.98
    assert count_densest(cloud, 8) == 20


GATES = Gates(
    split="fluid",
    size="mini",
    dataset_version="3.0.0",
    method="gns_0",
    weights_sha256="",
    one_step=1.0,
    free_flight=-0.4,
    settled=None,
    densest_cell=2.9,
)


def test_a_gate_fails_at_its_limit_and_one_without_meaning_never() -> None:
    assert GATES.failed == ["one_step", "free_flight"]


def test_a_measure_that_is_no_number_fails() -> None:
    nowhere = replace(GATES, one_step=math.nan, densest_cell=math.nan)
    assert {"one_step", "densest_cell"} <= set(nowhere.failed)


def test_the_densest_cell_may_reach_its_limit() -> None:
    assert "densest_cell" not in replace(GATES, densest_cell=3.0).failed
    assert "densest_cell" in replace(GATES, densest_cell=3.001).failed


def test_what_is_recorded_of_other_weights_stays(tmp_path: Path) -> None:
    """Measured again, weights have one line, the new one."""
    path = tmp_path / "gates.json"
    assert read_recorded(path) == []
    path.write_text(to_json([GATES, replace(GATES, method="gns_1")]))
    better = replace(GATES, one_step=0.5)
    path.write_text(to_json([better], recorded=read_recorded(path)))
    first, second = read_recorded(path)
    assert first["one_step"] == 0.5
    assert second["method"] == "gns_1"
