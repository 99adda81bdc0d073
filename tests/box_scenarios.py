"""Small closed-box scenarios for the solver's tests, and solvers that compile once."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagbench.data.box import Box
from lagbench.generators.draws import fill, quantise
from lagbench.generators.full_box import FullBox
from lagbench.generators.full_box_parameters import FullBoxParameters
from lagbench.generators.solver import build
from lagbench.generators.split import Device, InitialState
from lagbench.work.machine import available_cores

ALL_LIDS = (0.3, -0.2, 0.25, -0.35)


def parameters(*, wall: int = 2, **changes: float | bool) -> FullBoxParameters:
    """Return the cavity's constants on a box of 11 x 11 cells of nine particles, or
    changes of them.
    """
    values: dict[str, float | bool] = {
        "particles": 1089,
        "grid": 16,
        "dt": 4e-3,
        "no_slip": True,
    }
    values |= {
        "density": 1e-4,
        "modulus": 5e-4,
        "velocity_relaxation": 0.01,
        "jacobian_relaxation": 0.1,
    }
    values |= {"density_coupling": 0.01, "shift": 0.01, "substeps_per_frame": 7}
    values |= changes
    low = (wall + 0.5) / values["grid"]
    walls = Box.from_bounds([(low, 1.0 - low)] * 2)
    return FullBoxParameters(box=walls, **values)


# Constants are compiled into the kernels, which takes seconds: tests share these few
# where they can.
NO_SLIP = parameters()
FREE_SLIP = parameters(
    no_slip=False,
    wall=1,
    velocity_relaxation=0.002,
    density_coupling=0.002,
    shift=0.002,
)
INERT = parameters(
    particles=20_000, grid=40, modulus=1e-30, shift=0.0, velocity_relaxation=0.2
)


def box(constants: FullBoxParameters) -> tuple[float, float]:
    """Return the coordinates of the low and the high walls."""
    low, high = constants.box.bounds[0]
    return low, high


def scenario(
    constants: FullBoxParameters,
    *,
    seed: int = 0,
    speed: float = 0.0,
    walls: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0),
    viscosity: float = 1e-3,
    jitter: float = 0.25,
    frames: int = 0,
) -> InitialState:
    """Return a full box: random particle velocities up to ``speed``, walls sliding
    along themselves.

    With ``frames`` they slide up to that fast, as a random program of so many frames
    says.
    """
    rng = np.random.default_rng([seed, 1])
    (low, high), count = box(constants), constants.particles
    wall_velocity = np.zeros((4, 2))
    wall_velocity[(0, 1, 2, 3), (1, 1, 0, 0)] = walls
    if frames:
        wall_velocity = quantise(
            wall_velocity * (2.0 * rng.random((frames, 4, 1)) - 1.0)
        )
    return InitialState(
        position=fill(
            np.random.default_rng(seed), count, low=low, high=high, jitter=jitter
        ),
        velocity=quantise((2.0 * rng.random((count, 2)) - 1.0) * speed),
        affine=quantise(
            (2.0 * rng.random((count, 2, 2)) - 1.0) * speed * constants.grid / 4.0
        ),
        material=np.zeros(count, np.int8),
        area=(high - low) ** 2,
        viscosity=viscosity,
        wall_velocity=wall_velocity,
    )


_compiled = functools.cache(build)


def compiled(
    constants: Any, device: Device = Device.CPU, scenarios: int = 1, threads: Any = None
) -> Any:
    """Return the solver of these arguments, built once; to load states sets it back."""
    threads = 1 if device is Device.CPU else threads or available_cores()
    return _compiled(constants, device=device, scenarios=scenarios, threads=threads)


def loaded(
    constants: FullBoxParameters,
    states: Sequence[InitialState],
    **options: Device | int,
) -> FullBox:
    """Return a solver with fresh scenarios; the next call with its arguments takes it
    over.
    """
    solver: FullBox = compiled(constants, scenarios=len(states), **options)
    solver.load(states)
    return solver


def snapshot(solver: FullBox) -> dict[str, NDArray[Any]]:
    """Return every array that a caller can read, as it is now."""
    names = ("position", "velocity", "jacobian", "grid_velocity")
    return {name: getattr(solver, name)() for name in names}


def after(
    constants: FullBoxParameters,
    states: Sequence[InitialState],
    *substeps: int,
    **options: Device | int,
) -> dict[str, NDArray[Any]]:
    """Return the arrays of fresh scenarios after some advances."""
    solver = loaded(constants, states, **options)
    for count in substeps:
        solver.advance(count)
    return snapshot(solver)
