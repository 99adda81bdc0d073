"""Projection solver: incompressible Navier-Stokes on a staggered grid, in full boxes.

A textbook solver (:mod:`.staggered`) that is told what a model is told: the given
frames, the motion of the walls, the body force and the viscosity; in a channel also
the disc, the stream and the fringe. It starts at the last given frame, from the
velocities of polynomials in time through all given frames. From then on its field
carries the particles, two readings a frame (Heun).

It learns nothing. It knows the equations, which are not quite those of the data: their
fluid is weakly compressible. What a surrogate of a full box must be compared with:
accuracy against cost (McGreivy and Hakim, Nature Machine Intelligence 6 (2024) 1256).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lagbench.data.registry import Size

from .predictor import (
    Floats,
    Given,
    Kind,
    Prediction,
    ReferencePredictor,
    fitted_velocity,
)
from .staggered import Forcing, StaggeredGrid


def cell_counts(given: Given, resolution: float) -> tuple[int, ...]:
    """Return the cells along each axis of the box, shape [axis]."""
    density = resolution * given.size.task.score_grid.cells
    return tuple(max(4, round(density * length)) for length in given.box.lengths)


def forcing_of(size: Size, obstacle: NDArray[np.floating] | None) -> Forcing | None:
    """Return the fixed body and the fringe of a channel; None for other boxes.

    Args:
        size: the split and size; a channel states a fringe and a speed of its stream.
        obstacle: centre and radius of the body [length], shape [axis + 1]; None without
            a body.
    """
    if obstacle is None or not size.has_fringe:
        return None
    stream = np.zeros(size.dimension)
    stream[0] = float(size.value("speed"))
    return Forcing(
        obstacle=obstacle,
        fringe_length=float(size.value("fringe_length")),
        fringe_rate=float(size.value("fringe_rate")),
        stream=stream,
    )


@dataclass(frozen=True, kw_only=True)
class Scheme:
    """How the equations are integrated."""

    resolution: float  # cells over those of the score grid, along each axis [1]
    # factor on the upwind part of third-order advection [1]; None for central
    # differences
    upwinding: float | None = None
    viscosity_factor: float = 1.0  # on the stated viscosity [1]
    radius_factor: float = 1.0  # on the radius within which a body stops the fluid [1]


def predict(given: Given, scheme: Scheme) -> Prediction:
    """Yield positions that the solver finds.

    Args:
        given: what is given of the scenario.
        scheme: how the equations are integrated.
    """
    interval = given.size.frame_interval
    viscosity = scheme.viscosity_factor * given.viscosity
    walls = given.walls / interval
    obstacle = given.obstacle
    if obstacle is not None:
        obstacle = obstacle.astype(np.float64)
        obstacle[-1] *= scheme.radius_factor
    grid = StaggeredGrid(
        given.box,
        cells=cell_counts(given, scheme.resolution),
        no_slip=given.driven,
        forcing=forcing_of(given.size, obstacle),
        upwinding=scheme.upwinding,
    )
    first = given.predicted_frames[0]
    forces: Sequence[Floats | None] = [None] * len(walls)
    if given.body_force is not None:
        forces = [*(given.body_force / interval**2)]
    field = grid.from_particles(
        given.last, fitted_velocity(given, first - 1), wall_velocity=walls[first - 1]
    )
    position = given.last
    for frame in given.predicted_frames:
        later = grid.advance(
            field,
            duration=interval,
            viscosity=viscosity,
            wall_velocity=walls[frame],
            force=forces[frame],
        )
        position = grid.carry(
            position,
            before=field,
            after=later,
            duration=interval,
            wall_velocity=walls[frame],
        )
        if given.obstacle is not None:
            position = given.inside(position)
        field = later
        yield position.astype("float32")


def _describe(name: str, scheme: Scheme) -> ReferencePredictor:
    advection = "central differences"
    if scheme.upwinding is not None:
        advection = "third-order upwind advection"
    return ReferencePredictor(
        name=name,
        title=f"Projection solver, {advection}, {scheme.resolution:g} x the score grid",
        kind=Kind.CLASSICAL,
        definition=f"Incompressible Navier-Stokes on a staggered grid with {advection};"
        " the width of its cells is that of the cells of the score grid, divided by"
        f" {scheme.resolution:g}. It knows the viscosity and what drives the flow.",
        applies=lambda size: size.is_full_box,
        predict=lambda given: predict(given, scheme),
    )


SCHEMES = {
    "projection": Scheme(resolution=1),
    "projection-2x": Scheme(resolution=2),
    "projection-3x": Scheme(resolution=3),
    "upwind": Scheme(resolution=1, upwinding=1.0),
    "upwind-2x": Scheme(resolution=2, upwinding=1.0),
    "upwind-3x": Scheme(resolution=3, upwinding=1.0),
}
"""Scheme of each row."""

PREDICTORS = tuple(_describe(name, scheme) for name, scheme in SCHEMES.items())
