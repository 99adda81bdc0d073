"""Small free-surface scenarios for the solver's tests: bodies of any material, set in
motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from box_scenarios import compiled
from numpy.typing import NDArray

from lagbench.generators.draws import quantise
from lagbench.generators.free_surface import FreeSurface
from lagbench.generators.shapes import Shape, body_at, sample_points
from lagbench.generators.split import (
    Device,
    FreeSurfaceParameters,
    InitialState,
    Material,
)


@dataclass(frozen=True)
class Part:
    """A body: what it is made of, its outline, where it lies and how fast it moves."""

    material: Material
    shape: Shape
    centre: tuple[float, float]
    velocity: tuple[float, float] = (0.0, 0.0)


def parameters(**changes: float) -> FreeSurfaceParameters:
    """Return the constants of multimaterial with 500 particles on a coarse grid, or
    changes of them.
    """
    values: dict[str, float] = {
        "particles": 500,
        "grid": 32,
        "dt": 1 / 600,
        "wall": 2,
        "gravity": 2.5,
    }
    values |= {
        "density": 1.0,
        "liquid_modulus": 60.0,
        "liquid_viscosity": 1e-3,
        "density_coupling": 0.01,
    }
    values |= {"jacobian_relaxation": 0.2, "jacobian_min": 0.5, "jacobian_max": 1.0}
    return FreeSurfaceParameters(**(values | changes))


def scenario(
    constants: FreeSurfaceParameters,
    *parts: Part,
    seed: int = 0,
    friction: float = 0.0,
    spin: float = 0.0,
) -> InitialState:
    """Fill bodies with particles by area; ``spin`` adds a random APIC matrix of that
    size [1/s].
    """
    rng = np.random.default_rng(seed)
    areas = np.array([part.shape.measure for part in parts])
    ends = np.rint(
        np.concatenate([[0.0], areas.cumsum()]) / areas.sum() * constants.particles
    ).astype(int)
    counts = np.diff(ends)
    bodies = [
        sample_points(rng, body_at(part.shape, *part.centre), n)
        for part, n in zip(parts, counts, strict=True)
    ]
    return InitialState(
        position=np.concatenate(bodies),
        velocity=quantise(np.repeat([part.velocity for part in parts], counts, axis=0)),
        affine=quantise(spin * (2.0 * rng.random((constants.particles, 2, 2)) - 1.0)),
        material=np.repeat(
            np.array([part.material for part in parts], np.int8), counts
        ),
        area=float(areas.sum()),
        friction=friction,
    )


def start(
    constants: FreeSurfaceParameters,
    states: Sequence[InitialState],
    **options: Device | int,
) -> FreeSurface:
    """Return a solver that holds some scenarios; the next call with its arguments takes
    it over.
    """
    solver: FreeSurface = compiled(constants, scenarios=len(states), **options)
    solver.load(states)
    return solver


def run(
    constants: FreeSurfaceParameters,
    states: Sequence[InitialState],
    *substeps: int,
    **options: Device | int,
) -> list[NDArray[np.float32]]:
    """Return every array of the state of some scenarios after some advances."""
    solver = start(constants, states, **options)
    for count in substeps:
        solver.advance(count)
    return snapshot(solver)


def snapshot(solver: FreeSurface) -> list[NDArray[np.float32]]:
    """Return every array that the state consists of."""
    names = ("position", "velocity", "affine", "deformation", "volume_ratio")
    return [getattr(solver, name)() for name in names]
