"""Cavity and curl noise: initial and boundary conditions against design and thesis."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scenario_draws import all_of, changed, draw, neighbours, state_of

from lagbench.data import registry
from lagbench.errors import UsageError
from lagbench.generators import draws, lattice
from lagbench.generators.split import WALLS


def test_cavity_scenarios_draw_what_the_design_says() -> None:
    """Ranges of speed, Reynolds number and start hold; all six sets of walls occur."""
    states = all_of("cavity")
    factor = registry.load().size("cavity", "full").value("speed_factor")
    keys = [tuple(s.parameters[k] for k in ("wall", "direction", "speed", "reynolds")) for s in states]
    assert len(set(keys)) == 60
    assert {wall for wall, *_ in keys} == {"left", "right", "bottom", "top", "left+right", "bottom+top"}
    for state in states:
        drawn = state.parameters
        assert 0.06 * factor - 1e-6 <= float(drawn["speed"]) <= 0.16 * factor + 1e-6
        assert 20.0 <= float(drawn["reynolds"]) <= 400.0
        assert 0 <= state.start_substep <= 60_000
        # Re = U L / nu with L = 0.875 and mu = rho nu with rho = 1e-4.
        assert float(drawn["speed"]) * 0.875 / state.viscosity == pytest.approx(drawn["reynolds"])
        assert drawn["dynamic_viscosity"] == pytest.approx(1e-4 * state.viscosity)
        assert state.area == 0.875**2
        assert not state.velocity.any()


def test_cavity_wall_velocity_is_what_its_words_say() -> None:
    """Named walls slide along themselves at the drawn speed; the others rest."""
    unit = {"right": (1, 0), "left": (-1, 0), "up": (0, 1), "down": (0, -1)}
    for state in all_of("cavity"):
        walls = str(state.parameters["wall"]).split("+")
        words = str(state.parameters["direction"]).split("+")
        expected = np.zeros((4, 2))
        for wall, word in zip(walls, words, strict=True):
            expected[WALLS.index(wall)] = np.multiply(unit[word], state.parameters["speed"])
            assert (word in ("up", "down")) == (wall in ("left", "right"))
        np.testing.assert_array_equal(state.wall_velocity, expected)


def test_cavity_speed_factor_scales_every_speed() -> None:
    """The one factor that tunes the velocity statistics multiplies all wall speeds."""
    size = registry.load().size("cavity", "tiny")
    one, two = (draw(changed(size, speed_factor=f), 2) for f in (1.0, 2.0))
    np.testing.assert_allclose(two.wall_velocity, 2.0 * one.wall_velocity, atol=2.0**-19)
    assert two.start_substep == one.start_substep


@given(st.integers(4, 3000), st.integers(0, 2**30))
def test_lattice_fills_the_box_evenly(count: int, scenario: int) -> None:
    """Any particle count: columns differ by one particle, no gap and no clump."""
    rng = draws.generator("cavity", "test", 1, scenario)
    position = lattice.fill(rng, count, low=0.0625, high=0.9375, jitter=0.25)
    columns = math.isqrt(count)
    held = Counter(np.floor((position[:, 0] - 0.0625) / 0.875 * columns).astype(int).tolist())
    assert len(held) == columns
    assert max(held.values()) - min(held.values()) <= 1
    # Neighbours in a column are at least 3/4 of the closest row spacing apart.
    closest = 0.875 / max(max(held.values()), columns)
    assert neighbours(position, 2)[0][:, 1].min() >= 0.74 * closest


def test_curl_noise_frequencies_follow_the_thesis() -> None:
    """Eq. 5.55 with 4 to 13, subsets as the design lists them; tiny and mini cycle lower."""
    size = registry.load().size("curl-noise", "full")
    found = {i: s.parameters["frequency"] for i, s in zip(size.scenarios, all_of("curl-noise"), strict=True)}
    assert found == {i: i % 10 + 4 for i in range(60)}
    assert [found[i] for i in size.subsets["test"]] == [4, 6, 8, 9, 11, 13]
    assert [found[i] for i in size.subsets["valid"]] == [5, 7, 8, 10, 12, 13]
    assert [s.parameters["frequency"] for s in all_of("curl-noise", "mini")[:6]] == [2, 3, 4, 5, 6, 2]
    assert [s.parameters["frequency"] for s in all_of("curl-noise", "tiny")[:3]] == [1, 2, 1]


def test_curl_noise_velocity_gradient_is_traceless_to_the_bit() -> None:
    """u_x + v_y = 0 in every particle's C after rounding, and C is not zero."""
    for state in all_of("curl-noise")[:10]:
        assert (state.affine[:, 0, 0] + state.affine[:, 1, 1] == 0.0).all()
        assert np.abs(state.affine).max() > 0.1


def test_curl_noise_affine_predicts_the_neighbours_velocity() -> None:
    """v(x_q) = v_p + C (x_q - x_p) with C midway: 2 % of the change is left."""
    state = state_of("curl-noise", "full", 0)
    distance, index = neighbours(state.position, 2)
    offset = state.position[index[:, 1]] - state.position
    middle = 0.5 * (state.affine + state.affine[index[:, 1]])
    predicted = state.velocity + np.einsum("pij,pj->pi", middle, offset)
    error = np.sqrt(np.mean((predicted - state.velocity[index[:, 1]]) ** 2))
    change = np.sqrt(np.mean((state.velocity - state.velocity[index[:, 1]]) ** 2))
    assert distance.max() < 0.02
    assert error < 0.02 * change


def test_curl_noise_energy_grows_with_frequency() -> None:
    """One velocity scale for all: energy goes about as frequency squared."""
    states = all_of("curl-noise")
    energy = np.array([float(s.parameters["initial_kinetic_energy"]) for s in states])
    for state, recorded in zip(states[:10], energy, strict=False):
        assert recorded == pytest.approx(0.5 * np.mean(np.sum(state.velocity**2, axis=1)), rel=1e-12)
    mean = energy.reshape(6, 10).mean(axis=0)
    assert (np.diff(mean) > 0).all()
    slope = np.polyfit(np.log(np.arange(4, 14)), np.log(mean), 1)[0]
    assert 1.6 < slope < 2.4


def test_curl_noise_divergence_is_the_grids_share_alone() -> None:
    """Second-order differences: cells a third as wide show a ninth of the divergence."""
    size = registry.load().size("curl-noise", "full")
    coarse = draw(size, 0).parameters
    # (4 + 1/2) / 120 = (1 + 1/2) / 40: the same walls with cells a third as wide.
    fine = draw(changed(size, grid=120, wall=4), 0).parameters
    ratio = float(coarse["initial_divergence_rms"]) / float(fine["initial_divergence_rms"])
    assert ratio == pytest.approx(9.0, rel=0.15)
    assert float(coarse["initial_divergence_rms"]) < 0.03 * float(coarse["initial_vorticity_rms"])


def test_curl_noise_refuses_a_lattice_of_another_count() -> None:
    """A lattice that does not hold the particles is a mistake in datasets.yaml."""
    size = changed(registry.load().size("curl-noise", "tiny"), lattice_x=20)
    with pytest.raises(UsageError, match=r"(?s)curl-noise tiny.*= 506.*20 \* 22 = 440"):
        draw(size, 0)
