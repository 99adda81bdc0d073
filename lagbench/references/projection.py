"""Projection solver: incompressible Navier-Stokes on a staggered grid, in full boxes.

A textbook solver (:mod:`.staggered`) that is told what a model is told: the given
frames, the motion of the walls and the viscosity. It starts from the velocities of the
last two given frames, which hold half a frame before the last one, and brings them
there. From then on its field carries the particles, two readings a frame (Heun).

It learns nothing. It knows the equations, which are not quite those of the data: their
fluid is weakly compressible. What a surrogate of a full box must be compared with:
accuracy against cost (McGreivy and Hakim, Nature Machine Intelligence 6 (2024) 1256).
"""

from __future__ import annotations

from collections.abc import Callable

from lagbench.data.box import Box

from .predictor import Given, Prediction, ReferencePredictor, fills_box
from .staggered import StaggeredGrid

RESOLUTIONS = {"projection-half": 0.5, "projection": 1.0, "projection-double": 2.0}
"""Cells of each solver over those of the score grid, along each axis."""

EFFECTIVE_VISCOSITY = "effective_viscosity"
"""Parameter of a size whose data have no viscosity of their own [length^2/s]."""


def viscosity_of(given: Given) -> float:
    """Return the kinematic viscosity that the scenario or its data set states.

    The unit is length^2/s. Where neither states one the fluid is inviscid: 0.
    """
    stated = given.parameters.get("viscosity")
    if stated is None and EFFECTIVE_VISCOSITY in given.size.parameters:
        stated = given.size.value(EFFECTIVE_VISCOSITY)
    return float(str(stated or 0.0))


def cell_counts(given: Given, resolution: float) -> tuple[int, ...]:
    """Return the cells along each axis of the box, shape [axis]."""
    box = Box.from_bounds(given.size.bounds)
    score_cells = given.size.task.score_grid.cells
    return tuple(
        max(4, round(length * score_cells * resolution)) for length in box.lengths
    )


def predict(given: Given, resolution: float) -> Prediction:
    """Yield positions that the solver on a grid of some resolution finds.

    Args:
        given: what is given of the scenario.
        resolution: cells over those of the score grid [1].
    """
    interval = given.size.frame_interval
    viscosity = viscosity_of(given)
    walls = given.walls / interval
    grid = StaggeredGrid(
        Box.from_bounds(given.size.bounds),
        cells=cell_counts(given, resolution),
        no_slip=given.driven,
    )
    first = given.predicted_frames[0]
    middle = (given.position[-1] + given.position[-2]) / 2.0
    field = grid.from_particles(
        middle, given.step / interval, wall_velocity=walls[first - 1]
    )
    field = grid.advance(
        field,
        duration=0.5 * interval,
        viscosity=viscosity,
        wall_velocity=walls[first - 1],
    )
    position = given.last
    for frame in given.predicted_frames:
        later = grid.advance(
            field,
            duration=interval,
            viscosity=viscosity,
            wall_velocity=walls[frame],
        )
        position = grid.carry(
            position,
            before=field,
            after=later,
            duration=interval,
            wall_velocity=walls[frame],
        )
        field = later
        yield position.astype("float32")


def predict_at(resolution: float) -> Callable[[Given], Prediction]:
    """Return the predictor of one resolution."""

    def predict_scenario(given: Given) -> Prediction:
        return predict(given, resolution)

    return predict_scenario


def _describe(name: str, resolution: float) -> ReferencePredictor:
    return ReferencePredictor(
        name=name,
        title=name.replace("-", " ").capitalize(),
        definition="Incompressible Navier-Stokes on a staggered grid with"
        f" {resolution:g} times the cells of the score grid along each axis; it knows"
        " the viscosity and the motion of the walls.",
        applies=fills_box,
        predict=predict_at(resolution),
        counts=False,
    )


PREDICTORS = tuple(_describe(*item) for item in RESOLUTIONS.items())
