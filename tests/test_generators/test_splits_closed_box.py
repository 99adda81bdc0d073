"""Cavity and curl noise: initial and boundary conditions against the thesis."""

from __future__ import annotations

import math
from collections import Counter

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
from lagbench.errors import UsageError
from lagbench.generators import draws
from lagbench.generators.cavity import is_classic


def test_cavity_scenarios_draw_what_the_design_says() -> None:
    """Ranges of speed, Reynolds number and start hold; a program covers all frames;
    fluid rests first.
    """
    size = registry.load().size("cavity", "full")
    fastest = size.value("speed_max")
    states = all_of("cavity")
    for scenario, state in zip(usual_ids(size), states, strict=True):
        drawn = state.parameters
        assert 20.0 <= float(drawn["reynolds"]) <= 400.0
        # Re = (U / 2) L / nu with L = 0.875 and mu = rho nu with rho = 1e-4.
        reynolds = 0.5 * fastest * 0.875 / state.viscosity
        assert reynolds == pytest.approx(drawn["reynolds"])
        assert drawn["dynamic_viscosity"] == pytest.approx(1e-4 * state.viscosity)
        assert state.area == 0.875**2
        assert not state.velocity.any()
        assert 60 <= state.start_frame <= 120
        frame_count = state.start_frame + size.frame_count(scenario)
        assert state.wall_velocity.shape == (frame_count, 4, 2)
        assert np.abs(state.wall_velocity).max() <= fastest
    assert len({state.start_frame for state in states}) > 30
    assert len({drawn.parameters["reynolds"] for drawn in states}) == len(states)
    speeds = [np.abs(state.wall_velocity).max() for state in states]
    assert max(speeds) > 0.98 * fastest


def test_cavity_walls_slide_along_themselves_and_never_meet_in_a_corner() -> None:
    """The named walls move, the others rest; those that move together face each
    other.
    """
    for state in all_of("cavity"):
        moving = set()
        for index, wall in enumerate(WALLS):
            if state.wall_velocity[:, index].any():
                moving.add(wall)
        assert moving == set(str(state.parameters["wall"]).split("+"))
        assert moving <= {"left", "right"} or moving <= {"bottom", "top"}
        assert not state.wall_velocity[:, (0, 1, 2, 3), (0, 0, 1, 1)].any()
        if moving == {"bottom", "top"}:  # each has a program of its own
            bottom = state.wall_velocity[:, 2, 0]
            top = state.wall_velocity[:, 3, 0]
            assert not np.array_equal(bottom, top)


@pytest.mark.parametrize("size", ["full", "mini"])
def test_shifted_cavities_lie_outside_train(size: str) -> None:
    """Half has a Reynolds number beyond train's, half two walls that meet in a corner
    and move as one belt around it.
    """
    most = max(float(s.parameters["reynolds"]) for s in all_of("cavity", size))
    usual = {state.parameters["wall"] for state in all_of("cavity", size)}
    states = shifted("cavity", size)
    for state in states[::2]:
        assert float(state.parameters["reynolds"]) > 1.2 * most
        assert state.parameters["wall"] in usual
    # each wall's direction anticlockwise, in the order of WALLS
    turn = np.array([-1.0, 1.0, 1.0, -1.0])
    for state in states[1::2]:
        assert state.parameters["wall"] not in usual
        assert float(state.parameters["reynolds"]) <= most
        along = state.wall_velocity[:, (0, 1, 2, 3), (1, 1, 0, 0)] * turn
        moving = np.flatnonzero(along.any(axis=0))
        assert len(moving) == 2
        assert set(moving) not in ({0, 1}, {2, 3})
        np.testing.assert_array_equal(along[:, moving[0]], along[:, moving[1]])
    assert len({state.parameters["wall"] for state in states[1::2]}) == 4


@pytest.mark.parametrize("size", ["full", "mini"])
def test_shifted_frequencies_lie_outside_train(size: str) -> None:
    """One below and one above all of train, half of the scenarios each."""
    usual = [state.parameters["frequency"] for state in all_of("curl-noise", size)]
    shifts = [state.parameters["frequency"] for state in shifted("curl-noise", size)]
    assert all(frequency < min(usual) for frequency in shifts[::2])
    assert all(frequency > max(usual) for frequency in shifts[1::2])


def test_cavity_programs_are_hermite_splines_at_rest_in_their_knots() -> None:
    """With knots every 25 frames, SciPy's spline that is flat in each is the program;
    signs alternate.
    """
    mini = registry.load().size("cavity", "mini")
    size = changed(mini, knot_gap_min=25, knot_gap_max=25)
    for scenario in (0, 3, 4):
        state = draw(size, scenario)
        for speed in state.wall_velocity.reshape(-1, 8).T:
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
            assert (signs[1:] == -signs[:-1]).all()
            assert len(np.unique(knot_speeds)) == len(knots)


@pytest.mark.parametrize(("size", "expected"), [("full", 9), ("mini", 6)])
def test_one_cavity_in_eight_is_the_classic(size: str, expected: int) -> None:
    """There the lid rests, then keeps a speed, at the latest in the last given frame;
    train has all walls.
    """
    tier = registry.load().size("cavity", size)
    states = dict(zip(usual_ids(tier), all_of("cavity", size), strict=True))
    classic = {}
    for i, state in states.items():
        if state.parameters["motion"] == "constant":
            classic[i] = state
    assert len(classic) == expected
    assert {i for i in states if is_classic(i)} == classic.keys()
    for state in classic.values():
        speed = np.abs(state.wall_velocity).max(axis=2)
        starts = np.argmax(speed > 0.0, axis=0)
        for wall in np.flatnonzero(speed.any(axis=0)):
            start = starts[wall]
            assert state.start_frame - 15 <= start <= state.start_frame + 5
            assert (speed[start:, wall] == speed[-1, wall]).all()
            speed_max = tier.value("speed_max")
            assert 0.5 * speed_max <= speed[-1, wall] <= speed_max
    if size == "full":
        walls = [state.parameters["wall"] for i, state in classic.items() if i < 48]
        train = Counter(walls)
        assert sorted(train.values()) == [1] * 6


@given(st.integers(4, 3000), st.integers(0, 2**30))
def test_lattice_fills_the_box_evenly(count: int, scenario: int) -> None:
    """Any particle count: columns differ by one particle, no gap and no clump."""
    rng = draws.generator("cavity", "test", 1, scenario)
    position = draws.fill(rng, count, low=0.0625, high=0.9375, jitter=0.25)
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


def test_curl_noise_frequencies_follow_the_thesis() -> None:
    """Eq. 5.55 with 4 to 13 at full; mini holds those that its grid resolves, tiny
    two.
    """
    for size, count, least in (("full", 10, 4), ("mini", 3, 2), ("tiny", 2, 1)):
        states = all_of("curl-noise", size)
        frequencies = [state.parameters["frequency"] for state in states]
        ids = usual_ids(registry.load().size("curl-noise", size))
        assert frequencies == [i % count + least for i in ids]
    # At mini the scale falls as frequency squared: one vorticity [1/frame]. Full has
    # one scale.
    drawn = [state.parameters for state in all_of("curl-noise", "mini")]
    for frequency in (2, 3, 4):
        vorticities = []
        for parameters in drawn:
            if parameters["frequency"] == frequency:
                vorticities.append(float(parameters["initial_vorticity_rms"]))
        assert 0.08 < 0.1 * np.mean(vorticities) < 0.12
    assert {state.parameters["scale"] for state in all_of("curl-noise")} == {0.0052}


def test_curl_noise_affine_predicts_the_neighbours_velocity() -> None:
    """v(x_q) = v_p + C (x_q - x_p) with C midway: 2 % of the change is left; C has no
    trace, to the bit.
    """
    for state in all_of("curl-noise")[:10]:
        assert (state.affine[:, 0, 0] + state.affine[:, 1, 1] == 0.0).all()
        assert np.abs(state.affine).max() > 0.1
    state = state_of("curl-noise", "full", 0)
    distance, index = neighbours(state.position, 2)
    nearest = index[:, 1]
    middle = 0.5 * (state.affine + state.affine[nearest])
    offset = state.position[nearest] - state.position
    change = state.velocity[nearest] - state.velocity
    residual = change - np.einsum("pij,pj->pi", middle, offset)
    assert distance.max() < 0.02
    assert np.sqrt(np.mean(residual**2)) < 0.02 * np.sqrt(np.mean(change**2))


def test_curl_noise_energy_grows_with_frequency() -> None:
    """One velocity scale for all: energy goes about as frequency squared."""
    states = all_of("curl-noise")
    energy = np.array([float(s.parameters["initial_kinetic_energy"]) for s in states])
    for state, recorded in zip(states[:10], energy, strict=False):
        square = np.sum(state.velocity**2, axis=1)
        assert recorded == pytest.approx(0.5 * np.mean(square), rel=1e-12)
    mean = energy[:70].reshape(7, 10).mean(axis=0)
    assert (np.diff(mean) > 0).all()
    slope = np.polyfit(np.log(np.arange(4, 14)), np.log(mean), 1)[0]
    assert 1.6 < slope < 2.4


def test_curl_noise_divergence_is_the_grids_share_alone() -> None:
    """Second-order differences: cells a third as wide show a ninth of the
    divergence.
    """
    size = registry.load().size("curl-noise", "full")
    coarse = draw(size, 0).parameters
    # (4 + 1/2) / 120 = (1 + 1/2) / 40: the same walls with cells a third as wide.
    fine = draw(changed(size, grid=120, wall=4), 0).parameters
    coarse_divergence = float(coarse["initial_divergence_rms"])
    fine_divergence = float(fine["initial_divergence_rms"])
    vorticity = float(coarse["initial_vorticity_rms"])
    assert coarse_divergence / fine_divergence == pytest.approx(9.0, rel=0.15)
    assert coarse_divergence < 0.03 * vorticity


def test_curl_noise_refuses_a_lattice_of_another_count() -> None:
    """A lattice that does not hold the particles is a mistake in datasets.yaml."""
    size = changed(registry.load().size("curl-noise", "tiny"), lattice_x=20)
    with pytest.raises(UsageError) as caught:
        draw(size, 0)
    assert caught.value.where == "datasets.yaml, curl-noise tiny"
