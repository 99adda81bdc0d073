"""Acceptance of the closed-box solver: Ghia's cavity, lid off, curl
noise.
"""

from __future__ import annotations

import pytest
from turns import of_this_turn

from validation.experiment import (
    CHECK_EVERY,
    Case,
    ExperimentResult,
    plan,
    run,
)

pytestmark = pytest.mark.slow


def _assert_sound(result: ExperimentResult) -> None:
    """No cell is ever empty, and J stays near 1 away from the lid's corners."""
    assert [check.substep for check in result.checks[:-1]] == [
        CHECK_EVERY * (index + 1) for index in range(len(result.checks) - 1)
    ]
    assert result.checks[-1].substep == result.experiment.substeps
    for check in result.checks:
        assert check.empty_cells == 0, check
        assert check.jacobian_min_outside_lid_corners >= 0.98, check
        assert check.jacobian_max_outside_lid_corners <= 1.02, check


@pytest.mark.parametrize(
    ("reynolds", "substeps", "u_bound", "v_bound"),
    of_this_turn(
        [(100.0, 40_000, 0.010, 0.015), (400.0, 100_000, 0.020, 0.020)], turns=2
    ),
)
def test_cavity_agrees_with_ghia(
    reynolds: float,
    substeps: int,
    u_bound: float,
    v_bound: float,
) -> None:
    """RMSE of u and v on the centre lines against Ghia, Ghia & Shin 1982, on 40 x 40
    cells.
    """
    result = run(plan(Case.CAVITY, reynolds=reynolds, substeps=substeps))
    _assert_sound(result)
    deviations = result.deviations()
    assert deviations is not None
    u, v = deviations
    assert u.rmse <= u_bound
    assert v.rmse <= v_bound


def test_energy_falls_when_the_lid_stops() -> None:
    """Walls at rest do no work: kinetic energy falls from every frame to the next."""
    result = run(
        plan(Case.CAVITY, reynolds=100.0, substeps=20_000, lid_off_after=10_000)
    )
    _assert_sound(result)
    assert result.largest_rise_after_lid_off is not None
    assert result.largest_rise_after_lid_off < 0.0


def test_curl_noise_keeps_its_energy() -> None:
    """At frequency 4 at least 65 % of the energy is left after 600 frames, nearly
    divergence-free.
    """
    result = run(plan(Case.CURL_NOISE, frequency=4, substeps=30_000))
    _assert_sound(result)
    assert len(result.displacement_energy) == 600
    assert result.retention is not None
    assert result.retention >= 0.65
    assert all(check.divergence_over_vorticity <= 0.05 for check in result.checks)
