"""Small closed-box scenarios for the solver's tests, and solvers that compile once."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from lagbench.generators.closed_box import ClosedBox
from lagbench.generators.solver import Device, build
from lagbench.generators.split import ClosedBoxParameters, InitialState

ALL_LIDS = (0.3, -0.2, 0.25, -0.35)


def parameters(**changes: float | bool) -> ClosedBoxParameters:
    """Return the cavity's constants on a box of 11 x 11 cells with 700 particles, or changes of them."""
    values: dict[str, float | bool] = {
        "particles": 700,
        "grid": 16,
        "dt": 4e-3,
        "wall": 2,
        "no_slip": True,
        "density": 1e-4,
        "modulus": 5e-4,
        "velocity_relaxation": 0.01,
        "jacobian_relaxation": 0.1,
        "density_coupling": 0.01,
        "shift": 0.01,
    }
    return ClosedBoxParameters(**(values | changes))


def box(constants: ClosedBoxParameters) -> tuple[float, float]:
    """Return the coordinates of the low and the high walls."""
    low = (constants.wall + 0.5) / constants.grid
    return low, 1.0 - low


def lattice(constants: ClosedBoxParameters, seed: int, jitter: float = 0.25) -> NDArray[np.float64]:
    """Return particles that fill the box: columns of nearly equal spacing, each moved at random."""
    rng = np.random.default_rng(seed)
    low, high = box(constants)
    columns = int(np.sqrt(constants.particles))
    ends = constants.particles * np.arange(columns + 1) // columns
    parts = []
    for column, count in enumerate(np.diff(ends)):
        moved = (rng.random((count, 2)) - 0.5) * jitter + 0.5
        x = (column + moved[:, 0]) / columns
        y = (np.arange(count) + moved[:, 1]) / count
        parts.append(np.stack([x, y], axis=1))
    return quantise(low + (high - low) * np.concatenate(parts))


def quantise(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Round to multiples of 2^-20."""
    return np.round(values * 2.0**20) / 2.0**20


def scenario(
    constants: ClosedBoxParameters,
    *,
    seed: int = 0,
    speed: float = 0.0,
    walls: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0),
    viscosity: float = 1e-3,
    jitter: float = 0.25,
    frames: int = 0,
) -> InitialState:
    """Return a full box: random particle velocities up to ``speed``, walls sliding along themselves.

    With ``frames`` they slide up to that fast, as a random program of so many frames says.
    """
    rng = np.random.default_rng([seed, 1])
    low, high = box(constants)
    count = constants.particles
    wall_velocity = np.zeros((4, 2))
    wall_velocity[(0, 1, 2, 3), (1, 1, 0, 0)] = walls
    if frames:
        wall_velocity = quantise(wall_velocity * (2.0 * rng.random((frames, 4, 1)) - 1.0))
    return InitialState(
        position=lattice(constants, seed, jitter),
        velocity=quantise((2.0 * rng.random((count, 2)) - 1.0) * speed),
        affine=quantise((2.0 * rng.random((count, 2, 2)) - 1.0) * speed * constants.grid / 4.0),
        material=np.zeros(count, np.int8),
        area=(high - low) ** 2,
        viscosity=viscosity,
        wall_velocity=wall_velocity,
    )


@functools.cache
def _built(
    constants: ClosedBoxParameters, device: Device, scenarios: int, threads: int | None, copy: int
) -> ClosedBox:
    assert copy >= 0
    return cast("ClosedBox", build(constants, device=device, scenarios=scenarios, threads=threads))


def loaded(
    constants: ClosedBoxParameters,
    states: Sequence[InitialState],
    *,
    device: Device = Device.CPU,
    threads: int | None = None,
    copy: int = 0,
) -> ClosedBox:
    """Return a solver with fresh scenarios; solvers of other ``copy`` are other objects."""
    solver = _built(constants, device, len(states), threads, copy)
    solver.load(states)
    return solver


def snapshot(solver: ClosedBox) -> dict[str, NDArray[Any]]:
    """Return every array that a caller can read, as it is now."""
    return {
        "position": solver.position(),
        "velocity": solver.velocity(),
        "jacobian": solver.jacobian(),
        "grid_velocity": solver.grid_velocity(),
    }


def after(
    constants: ClosedBoxParameters,
    states: Sequence[InitialState],
    substeps: int,
    *,
    device: Device = Device.CPU,
    threads: int | None = None,
) -> dict[str, NDArray[Any]]:
    """Return the arrays of fresh scenarios after some substeps."""
    solver = loaded(constants, states, device=device, threads=threads)
    solver.advance(substeps)
    return snapshot(solver)
