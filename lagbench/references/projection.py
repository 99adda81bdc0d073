"""Projection solver: incompressible Navier-Stokes on a staggered grid, in full boxes.

A textbook solver (:mod:`.staggered`) that is told what a model is told: the given
frames, the motion of the walls, the body force and the viscosity; in a channel also
the disc, the stream and the fringe. It starts from the velocities of the last two given
frames, which hold half a frame before the last one, and brings them there. From then on
its field carries the particles, two readings a frame (Heun).

It learns nothing. It knows the equations, which are not quite those of the data: their
fluid is weakly compressible. What a surrogate of a full box must be compared with:
accuracy against cost (McGreivy and Hakim, Nature Machine Intelligence 6 (2024) 1256).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from lagbench.data.registry import Size

from .predictor import (
    Floats,
    Given,
    Kind,
    Prediction,
    ReferencePredictor,
)
from .staggered import Forcing, StaggeredGrid

RESOLUTIONS = {"projection": 1, "projection-2x": 2, "projection-3x": 3}
"""Cells of each solver over those of the score grid, along each axis."""


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


def predict(given: Given, resolution: float) -> Prediction:
    """Yield positions that the solver on a grid of some resolution finds.

    Args:
        given: what is given of the scenario.
        resolution: cells over those of the score grid [1].
    """
    interval = given.size.frame_interval
    viscosity = given.viscosity
    walls = given.walls / interval
    grid = StaggeredGrid(
        given.box,
        cells=cell_counts(given, resolution),
        no_slip=given.driven,
        forcing=forcing_of(given.size, given.obstacle),
    )
    first = given.predicted_frames[0]
    forces: Sequence[Floats | None] = [None] * len(walls)
    if given.body_force is not None:
        forces = [*(given.body_force / interval**2)]
    field = grid.from_particles(
        given.middle, given.step / interval, wall_velocity=walls[first - 1]
    )
    field = grid.advance(
        field,
        duration=0.5 * interval,
        viscosity=viscosity,
        wall_velocity=walls[first - 1],
        force=forces[first - 1],
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


def predict_at(resolution: float) -> Callable[[Given], Prediction]:
    """Return the predictor of one resolution."""

    def predict_scenario(given: Given) -> Prediction:
        return predict(given, resolution)

    return predict_scenario


def _describe(name: str, resolution: int) -> ReferencePredictor:
    return ReferencePredictor(
        name=name,
        title=f"Projection solver, {resolution} x the score grid",
        kind=Kind.CLASSICAL,
        definition="Incompressible Navier-Stokes on a staggered grid; the width of its"
        f" cells is that of the cells of the score grid, divided by {resolution}. It"
        " knows the viscosity and the motion of the walls.",
        applies=lambda size: size.is_full_box,
        predict=predict_at(resolution),
    )


PREDICTORS = tuple(_describe(*item) for item in RESOLUTIONS.items())
