"""Noise that repeats itself, the flows made of it, and the splits that they begin."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from scenario_draws import draw

from lagbench.data import registry
from lagbench.generators import curl_noise_3d, periodic_noise
from lagbench.generators.periodic_noise import Flow, Smooth

Array = NDArray[np.float64]
STEP = 1e-5
PERIODIC = ("decaying-vortices", "poiseuille", "curl-noise-3d")


Field = Callable[[Array], Array]


def slopes(function: Field, points: Array) -> Array:
    """Return central differences along each axis of the periodic unit box, last."""
    result = []
    for axis in range(points.shape[1]):
        step = np.zeros(points.shape[1])
        step[axis] = STEP
        ahead = function((points + step) % 1.0)
        behind = function((points - step) % 1.0)
        rise = ahead - behind
        result.append(rise / (2.0 * STEP))
    return np.stack(result, axis=-1)


@pytest.mark.parametrize("dimension", [2, 3])
def test_noise_repeats_itself_with_exact_derivatives(dimension: int) -> None:
    """Differences across cells and across the ends of the box agree with both
    derivatives.
    """
    rng = np.random.default_rng(5)
    lattice = periodic_noise.draw_lattice(rng, 3, dimension)
    points = rng.random((100, dimension))
    # on faces of the lattice
    cell = np.rint(points[:20] * 3.0)
    points[:20] = cell / 3.0 % 1.0

    def at(position: Array) -> Smooth:
        return periodic_noise.noise(position, lattice)

    exact = at(points)
    gradient = slopes(lambda x: at(x).value, points)
    hessian = slopes(lambda x: at(x).gradient, points)
    assert_allclose(exact.gradient, gradient, rtol=0, atol=1e-5)
    assert_allclose(exact.hessian, hessian, rtol=0, atol=1e-2)


def test_a_vortex_ring_is_a_flow_without_divergence() -> None:
    """It moves along its axis at the centre, rests outside its ball, and its stated
    gradient is its own.
    """
    rng = np.random.default_rng(6)
    centre = np.array([0.9, 0.5, 0.1])
    normal = np.array([0.6, 0.0, 0.8])

    def at(position: Array) -> Flow:
        potential = curl_noise_3d.ring_potential(
            position,
            centre=centre,
            normal=normal,
            radius=0.4,
        )
        return periodic_noise.curl(potential)

    outside = (centre + 0.5) % 1.0
    anywhere = rng.random((60, 3))
    points = np.vstack([centre, outside, anywhere])
    flow = at(points)
    # curl(n x r) = 2 n
    at_centre = flow.velocity[0]
    assert_allclose(at_centre, 2.0 * normal, rtol=0, atol=1e-12)
    assert not flow.velocity[1].any()
    trace = np.trace(flow.affine, axis1=1, axis2=2)
    assert_allclose(trace, 0.0, rtol=0, atol=1e-12)
    numeric = slopes(lambda x: at(x).velocity, points)
    assert_allclose(flow.affine, numeric, rtol=0, atol=1e-4)


@pytest.mark.parametrize("split", PERIODIC)
def test_scenarios_begin_with_the_speed_that_was_drawn(split: str) -> None:
    """Exact numbers inside the box, no divergence, the stated root mean square speed,
    no net momentum, another flow for each scenario.
    """
    size = registry.load().size(split, "mini")
    box = size.box
    flows = []
    for scenario in (0, 3, 40):
        state = draw(size, scenario)
        for values in (state.position, state.velocity, state.affine):
            multiples = values * 2**20
            assert (multiples == np.rint(multiples)).all()
        assert state.position.min() >= 0.0
        assert state.position.max() < 1.0
        trace = np.trace(state.affine, axis1=1, axis2=2)
        assert np.abs(trace).max() <= 2.0**-19
        square_speed = np.sum(state.velocity**2, axis=1)
        speed = np.sqrt(square_speed.mean())
        drawn_speed = state.parameters["speed_rms"]
        assert speed == pytest.approx(drawn_speed, rel=1e-4)
        momentum = state.velocity.mean(axis=0)
        assert np.abs(momentum).max() < 0.02 * speed
        assert state.area == box.volume == 1.0
        flows.append(state.velocity.tobytes())
    assert len(set(flows)) == len(flows)
