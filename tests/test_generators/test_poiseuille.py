"""Reverse Poiseuille flow: its scenarios, and the solver against closed forms."""

from __future__ import annotations

import dataclasses
import functools
import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scenario_draws import draw

from lagbench.data import registry
from lagbench.generators import poiseuille
from lagbench.generators.full_box import FullBox
from lagbench.generators.split import InitialState

Array = NDArray[np.float64]

SIZE = registry.load().size("poiseuille", "mini")
HALF = 0.5
"""Height H of a layer [length]."""


@functools.cache
def mini_solver() -> FullBox:
    """Return the solver of size mini; its kernels take seconds to compile."""
    return FullBox(poiseuille.solver_parameters(SIZE))


def without_eddies(
    force: Array,
    *,
    viscosity: float,
    velocity: Array | None = None,
) -> InitialState:
    """Return a drawn scenario whose flow is parallel.

    Args:
        force: acceleration of the lower half towards each frame [length/s^2].
        viscosity: nu [length^2/s].
        velocity: of the particles [length/s]; by default they are at rest.
    """
    state = draw(SIZE, 0)
    body_force = np.zeros((len(force), 2, 2))
    body_force[:, 0, 0] = force
    body_force[:, 1, 0] = -force
    if velocity is None:
        velocity = np.zeros_like(state.velocity)
    return dataclasses.replace(
        state,
        velocity=velocity,
        affine=np.zeros_like(state.affine),
        viscosity=viscosity,
        body_force=body_force,
        start_frame=0,
    )


def parabola(
    height: Array,
    acceleration: float,
    viscosity: float,
) -> Array:
    """Return u(y) = g y (H - y) / (2 nu) in the lower half, its opposite above it."""
    is_lower = height < HALF
    y = np.where(is_lower, height, height - HALF)
    arch = y * (HALF - y)
    u = acceleration * arch / (2.0 * viscosity)
    return np.where(is_lower, u, -u)


def unsteady_profile(
    force: Array,
    viscosity: float,
    height: Array,
) -> Array:
    """Return u(y) [length/s] after a program of forces has acted on a fluid at rest.

    The force is a square wave along y, the sum of (4 f / n pi) sin k y over odd n with
    k = 2 pi n. Each mode decays at the rate nu k^2, and f is constant in each frame.
    """
    u = np.zeros_like(height)
    for n in range(1, 40, 2):
        k = 2.0 * math.pi * n
        rate = viscosity * k * k
        decay = math.exp(-rate * SIZE.frame_interval)
        amplitude = 0.0
        for value in force[1:]:
            mode = 4.0 * value / (n * math.pi)
            gain = mode * (1.0 - decay) / rate
            amplitude = amplitude * decay + gain
        u += amplitude * np.sin(k * height)
    return u


def nodal_profile(solver: FullBox) -> tuple[Array, Array]:
    """Return heights of the nodes and the mean velocity along x there [length/s]."""
    nodal_u = solver.grid_velocity()[0, ..., 0]
    u = nodal_u.astype(np.float64).mean(axis=0)
    height = (np.arange(len(u)) + 0.5) / len(u)
    return height, u


def greatest_momentum(solver: FullBox) -> float:
    """Return the mean velocity along the axis where it is greatest [length/s]."""
    mean = solver.velocity().mean(axis=1)
    return float(np.abs(mean).max())


@pytest.mark.slow
def test_a_steady_force_drives_the_parabola() -> None:
    """Within 2 % of the peak; as much fluid goes one way as the other."""
    viscosity = 0.01
    speed = 0.2
    acceleration = 8.0 * viscosity * speed / HALF**2
    start = draw(SIZE, 0).position[:, 1]
    u = parabola(start, acceleration, viscosity)
    velocity = np.zeros((len(start), 2))
    velocity[:, 0] = 0.7 * u
    state = without_eddies(
        np.full(2, acceleration),
        viscosity=viscosity,
        velocity=velocity,
    )
    solver = mini_solver()
    solver.load([state])
    # The slowest mode forgets its start with exp(-nu (2 pi)^2 t).
    slowest_rate = viscosity * (2.0 * math.pi) ** 2
    duration = 5.0 / slowest_rate
    frames = math.ceil(duration / SIZE.frame_interval)
    solver.advance(frames * SIZE.substeps_per_frame)
    height, u = nodal_profile(solver)
    truth = parabola(height, acceleration, viscosity)
    assert truth.max() == pytest.approx(speed, rel=0.01)
    error = np.abs(u - truth)
    assert error.max() < 0.02 * speed
    assert greatest_momentum(solver) < 0.005 * speed


@pytest.mark.slow
def test_a_program_of_forces_drives_the_flow_that_fourier_modes_have() -> None:
    """A drawn program without eddies: momentum diffuses as in the closed form, the
    total momentum stays zero, and the fluid keeps its density.
    """
    drawn = draw(SIZE, 0).body_force
    assert drawn is not None
    force = drawn[:41, 0, 0]
    viscosity = 1e-3
    solver = mini_solver()
    state = without_eddies(force, viscosity=viscosity)
    solver.load([state])
    solver.advance(40 * SIZE.substeps_per_frame)
    height, u = nodal_profile(solver)
    truth = unsteady_profile(force, viscosity, height)
    speed = np.abs(truth).max()
    assert speed > 0.03
    # the kink of the profile where the halves meet is one cell wide
    error = np.sqrt(np.mean((u - truth) ** 2))
    assert error < 0.02 * speed
    assert greatest_momentum(solver) < 0.005 * speed
    jacobian = solver.jacobian()
    assert jacobian.min() > 0.98
    assert jacobian.max() < 1.02


def test_the_halves_are_driven_against_each_other() -> None:
    """Every scenario has a program of its own for all frames, within the bound, that
    turns around; nothing acts along y.
    """
    programs = set()
    for scenario in (0, 1, 2, 33):
        state = draw(SIZE, scenario)
        force = state.body_force
        assert force is not None
        frame_count = state.start_frame + SIZE.frame_count(scenario)
        assert force.shape == (frame_count, 2, 2)
        lower = force[:, 0]
        upper = force[:, 1]
        along_x = lower[:, 0]
        multiples = force * 2**20
        np.testing.assert_array_equal(upper, -lower)
        assert not force[..., 1].any()
        assert np.abs(force).max() <= SIZE.value("force_max")
        assert along_x.min() < 0.0 < along_x.max()
        assert (multiples == np.rint(multiples)).all()
        programs.add(force.tobytes())
    assert len(programs) == 4
