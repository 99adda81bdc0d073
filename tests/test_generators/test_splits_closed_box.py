"""Cavity and curl noise: initial and boundary conditions against the thesis."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scenario_draws import (
    all_of,
    changed,
    draw,
    neighbours,
    shifted,
    state_of,
    usual_ids,
)
from scipy.interpolate import CubicHermiteSpline

from lagbench.data import WALLS, registry
from lagbench.generators import draws
from lagbench.generators.split import InitialState


def frequencies_of(states: Sequence[InitialState]) -> list[int]:
    """Return the frequency of the noise of each scenario."""
    frequencies = []
    for state in states:
        frequencies.append(int(state.parameters["frequency"]))
    return frequencies


def test_cavity_scenarios_draw_what_the_design_says() -> None:
    """Ranges of speed, Reynolds number and start hold; a program covers all frames;
    fluid rests first.
    """
    size = registry.load().size("cavity", "full")
    fastest = size.value("speed_max")
    states = all_of("cavity")
    scenarios = usual_ids(size)
    for scenario, state in zip(scenarios, states, strict=True):
        drawn = state.parameters
        assert 20.0 <= float(drawn["reynolds"]) <= 400.0
        # Re = (U / 2) L / nu with L = 0.875 and mu = rho nu with rho = 1e-4.
        reynolds = 0.5 * fastest * 0.875 / state.viscosity
        assert reynolds == pytest.approx(drawn["reynolds"])
        viscosity = drawn["dynamic_viscosity"]
        assert viscosity == pytest.approx(1e-4 * state.viscosity)
        assert state.area == 0.875**2
        assert not state.velocity.any()
        assert 60 <= state.start_frame <= 120
        frame_count = state.start_frame + size.frame_count(scenario)
        assert state.wall_velocity.shape == (frame_count, 4, 2)
        speed = np.abs(state.wall_velocity)
        assert speed.max() <= fastest
    start_frames = {state.start_frame for state in states}
    assert len(start_frames) > 30
    reynolds_numbers = {state.parameters["reynolds"] for state in states}
    assert len(reynolds_numbers) == len(states)
    speeds = [np.abs(state.wall_velocity) for state in states]
    greatest_speeds = [speed.max() for speed in speeds]
    assert max(greatest_speeds) > 0.98 * fastest


def test_cavity_walls_slide_along_themselves_and_never_meet_in_a_corner() -> None:
    """The named walls move, the others rest; those that move together face each
    other.
    """
    for state in all_of("cavity"):
        moving = set()
        for index, wall in enumerate(WALLS):
            if state.wall_velocity[:, index].any():
                moving.add(wall)
        stated = str(state.parameters["wall"]).split("+")
        assert moving == set(stated)
        assert moving <= {"left", "right"} or moving <= {"bottom", "top"}
        # left and right along x, bottom and top along y
        left_and_right = state.wall_velocity[:, [0, 1], 0]
        bottom_and_top = state.wall_velocity[:, [2, 3], 1]
        assert not left_and_right.any()
        assert not bottom_and_top.any()
        if moving == {"bottom", "top"}:  # each has a program of its own
            bottom = state.wall_velocity[:, 2, 0]
            top = state.wall_velocity[:, 3, 0]
            assert not np.array_equal(bottom, top)


@pytest.mark.parametrize("size", ["full", "mini"])
def test_shifted_cavities_lie_outside_train(size: str) -> None:
    """Half has a Reynolds number beyond train's, half two walls that meet in a corner
    and move as one belt around it.
    """
    most = 0.0
    usual = set()
    for state in all_of("cavity", size):
        reynolds = float(state.parameters["reynolds"])
        most = max(most, reynolds)
        usual.add(state.parameters["wall"])
    states = shifted("cavity", size)
    for state in states[::2]:
        assert float(state.parameters["reynolds"]) > 1.2 * most
        assert state.parameters["wall"] in usual
    # each wall's direction anticlockwise, in the order of WALLS
    turn = np.array([-1.0, 1.0, 1.0, -1.0])
    corners = set()
    for state in states[1::2]:
        assert state.parameters["wall"] not in usual
        assert float(state.parameters["reynolds"]) <= most
        corners.add(state.parameters["wall"])
        left_and_right = state.wall_velocity[:, [0, 1], 1]
        bottom_and_top = state.wall_velocity[:, [2, 3], 0]
        tangential = np.hstack([left_and_right, bottom_and_top])
        along = tangential * turn
        moving = np.flatnonzero(along.any(axis=0))
        assert len(moving) == 2
        assert set(moving) != {0, 1}
        assert set(moving) != {2, 3}
        first, second = along[:, moving].T
        np.testing.assert_array_equal(first, second)
    assert len(corners) == 4


@pytest.mark.parametrize("size", ["full", "mini"])
def test_shifted_frequencies_lie_outside_train(size: str) -> None:
    """One below and one above all of train, half of the scenarios each."""
    usual = frequencies_of(all_of("curl-noise", size))
    shifts = frequencies_of(shifted("curl-noise", size))
    lower = shifts[::2]
    higher = shifts[1::2]
    assert max(lower) < min(usual)
    assert min(higher) > max(usual)


def test_cavity_programs_are_hermite_splines_at_rest_in_their_knots() -> None:
    """With knots every 25 frames, SciPy's spline that is flat in each is the program;
    signs alternate.
    """
    mini = registry.load().size("cavity", "mini")
    size = changed(mini, knot_gap_min=25, knot_gap_max=25)
    for scenario in (0, 3, 4):
        state = draw(size, scenario)
        speeds = state.wall_velocity.reshape(-1, 8).T
        for speed in speeds:
            if not speed.any():
                continue
            knots = np.arange(0, len(speed), 25)
            knot_speeds = speed[knots]
            at_rest = np.zeros(len(knots))
            spline = CubicHermiteSpline(knots, knot_speeds, at_rest)
            last = knots[-1]
            expected = spline(np.arange(last))
            np.testing.assert_allclose(speed[:last], expected, atol=2.0**-20)
            signs = np.sign(knot_speeds)
            np.testing.assert_array_equal(signs[1:], -signs[:-1])
            distinct_speeds = np.unique(knot_speeds)
            assert len(distinct_speeds) == len(knots)


@given(
    count=st.integers(4, 3000),
    scenario=st.integers(0, 2**30),
)
def test_lattice_fills_the_box_evenly(count: int, scenario: int) -> None:
    """Any particle count: columns differ by one particle, no gap and no clump."""
    rng = draws.generator("cavity", "test", 1, scenario)
    position = draws.fill(
        rng,
        count,
        low=0.0625,
        high=0.9375,
        jitter=0.25,
    )
    columns = math.isqrt(count)
    share = (position[:, 0] - 0.0625) / 0.875
    column = np.floor(share * columns).astype(int)
    _, counts = np.unique(column, return_counts=True)
    assert len(counts) == columns
    assert counts.max() - counts.min() <= 1
    # Neighbours in a column are at least 3/4 of the closest row spacing apart.
    closest = 0.875 / max(counts.max(), columns)
    gaps, _ = neighbours(position, 2)
    assert gaps[:, 1].min() >= 0.74 * closest


@pytest.mark.parametrize(
    ("size", "count", "least"),
    [
        ("full", 10, 4),
        ("mini", 3, 2),
        ("tiny", 2, 1),
    ],
)
def test_curl_noise_frequencies_follow_the_thesis(
    size: str,
    count: int,
    least: int,
) -> None:
    """Eq. 5.55 with 4 to 13 at full; mini holds those that its grid resolves, tiny
    two.
    """
    frequencies = frequencies_of(all_of("curl-noise", size))
    ids = usual_ids(registry.load().size("curl-noise", size))
    assert frequencies == [i % count + least for i in ids]


def test_curl_noise_affine_predicts_the_neighbours_velocity() -> None:
    """v(x_q) = v_p + C (x_q - x_p) with C midway: 2 % of the change is left; C has no
    trace, to the bit.
    """
    for state in all_of("curl-noise")[:10]:
        trace = np.trace(state.affine, axis1=1, axis2=2)
        gradient = np.abs(state.affine)
        assert not trace.any()
        assert gradient.max() > 0.1
    state = state_of("curl-noise", "full", 0)
    distance, index = neighbours(state.position, 2)
    nearest = index[:, 1]
    middle = 0.5 * (state.affine + state.affine[nearest])
    offset = state.position[nearest] - state.position
    change = state.velocity[nearest] - state.velocity
    predicted = np.einsum("pij,pj->pi", middle, offset)
    residual = change - predicted
    assert distance.max() < 0.02
    residual_rms = np.sqrt(np.mean(residual**2))
    change_rms = np.sqrt(np.mean(change**2))
    assert residual_rms < 0.02 * change_rms


def test_curl_noise_divergence_is_the_grids_share_alone() -> None:
    """Second-order differences: cells a third as wide show a ninth of the
    divergence.
    """
    size = registry.load().size("curl-noise", "full")
    coarse = draw(size, 0).parameters
    # (4 + 1/2) / 120 = (1 + 1/2) / 40: the same walls with cells a third as wide.
    fine_size = changed(size, grid=120, wall=4)
    fine = draw(fine_size, 0).parameters
    coarse_divergence = float(coarse["initial_divergence_rms"])
    fine_divergence = float(fine["initial_divergence_rms"])
    vorticity = float(coarse["initial_vorticity_rms"])
    ratio = coarse_divergence / fine_divergence
    assert ratio == pytest.approx(9.0, rel=0.15)
    assert coarse_divergence < 0.03 * vorticity
