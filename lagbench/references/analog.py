"""Analog: the scenario of train that starts most like this one, its future as the
answer.

After Lorenz, J. Atmos. Sci. 26 (1969) 636. Scenarios are compared at the last given
frame by

    d^2 = W2^2(positions) / std(x)^2 + mean |u_a - u_b|^2 / mean |u_a|^2,

the sliced Wasserstein distance of their clouds (material by material where both have
the same), over the variance of a cloud along a direction (wherever in the box it is),
and the difference of their velocity fields on the score grid over the square of those
given here. In a full box the analog's motion carries the particles: from frame to frame
they move as the analog does where they are. On a free surface the analog's particles
are assigned to those given so that the sum of squared distances is least, and their
paths are the answer.

Memorising looks like this, and so does a leak from train to test.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lagbench.data.grid import Grid, Placement, node_velocity, transfer
from lagbench.data.scenario import ScenarioFile, read_scenario
from lagbench.errors import DataError

from .predictor import (
    Floats,
    Given,
    Prediction,
    ReferencePredictor,
    fills_box,
    given_in,
    linear_field,
    mirrored,
    wall_motion,
)

ANGLES = np.arange(64) * (np.pi / 64)
DIRECTIONS = np.stack([np.cos(ANGLES), np.sin(ANGLES)])
"""Directions on which clouds are projected, shape [2, direction]."""

LEVELS = (np.arange(256) + 0.5) / 256
"""Levels at which distributions along a direction are compared; clouds may differ in
number.
"""


@dataclass(frozen=True, eq=False)
class Start:
    """How a scenario starts, as scenarios are compared."""

    # quantiles along each direction by material [length], [level, direction]
    clouds: dict[int, Floats]
    shares: dict[int, float]  # share of each material in the particles [1]
    field: Floats  # velocity at the nodes [length/frame], shape [x node, y node, 2]


def start_of(given: Given) -> Start:
    """Return how a scenario starts."""
    task = given.size.task.score_grid
    grid = Grid(task.cells, Placement(task.placement))
    clouds = {
        int(kind): np.quantile(
            given.last[given.material == kind] @ DIRECTIONS, LEVELS, axis=0
        )
        for kind in np.unique(given.material)
    }
    shares = {kind: float(np.mean(given.material == kind)) for kind in clouds}
    sums = transfer(given.last, given.step, grid)
    return Start(clouds, shares, node_velocity(sums, float(sums.weight.max())))


def distance(one: Start, other: Start) -> float:
    """Return how unlike two starts are, in units of the first one's spread; infinite
    for other materials.
    """
    if one.clouds.keys() != other.clouds.keys():
        return float("inf")
    apart = sum(
        one.shares[k] * np.mean((c - other.clouds[k]) ** 2)
        for k, c in one.clouds.items()
    )
    spread = sum(
        one.shares[k] * np.mean(np.var(c, axis=0)) for k, c in one.clouds.items()
    )
    differ = np.mean((one.field - other.field) ** 2)
    speed = np.mean(one.field**2)
    return float(np.sqrt(apart / spread + differ / (speed or 1.0)))


def nearest(given: Given) -> int:
    """Return the id of the scenario of train that starts most like this one; all must
    be at hand.
    """
    size = given.size
    own = start_of(given)
    needed = size.task.input_frames + size.task.horizon
    found = {}
    for scenario in size.subsets["train"]:
        if size.frame_count(scenario) >= needed:
            with _open(given, scenario) as file:
                found[scenario] = distance(
                    own, start_of(given_in(file, size, given.root))
                )
    if not found:
        what = "no scenario of train is as long as the task"
        where = f"{size.split} {size.name}"
        raise DataError(what, where=where, expected=f"{needed} frames")
    return min(found, key=lambda scenario: (found[scenario], scenario))


def predict(given: Given) -> Prediction:
    """Yield where the analog takes the particles."""
    frames = given.predicted_frames
    now = given.last
    with _open(given, nearest(given)) as file:
        before = _frame(file, frames[0] - 1)
        if not fills_box(given.size):
            partner = assigned(now, before, given.material, file.read("material"))
            for frame in frames:
                yield _frame(file, frame)[partner].astype("float32")
            return
        walls = wall_motion(file, given.size, frames.stop)
        for frame in frames:
            after = _frame(file, frame)
            field = linear_field(*mirrored(given, before, after - before, walls[frame]))
            now = given.inside(now + field(now))
            before = after
            yield now.astype("float32")


def assigned(
    position: Floats,
    theirs: Floats,
    material: NDArray[np.integer],
    of_theirs: NDArray[np.integer],
) -> NDArray[np.intp]:
    """Return a particle of theirs for each of ours: least sum of squared distances,
    material by material.

    Where there are fewer or more of theirs, some are taken more than once, or not at
    all, evenly over their numbers. A material that they lack is matched to all of
    theirs.
    """
    from scipy.optimize import linear_sum_assignment
    from scipy.spatial.distance import cdist

    partner = np.empty(len(position), np.intp)
    for kind in np.unique(material):
        ours = np.flatnonzero(material == kind)
        pool = np.flatnonzero(of_theirs == kind)
        if pool.size:
            pool = pool
        else:
            pool = np.arange(len(theirs))
        chosen = pool[np.arange(len(ours)) * len(pool) // len(ours)]
        cost = cdist(position[ours], theirs[chosen], "sqeuclidean")
        partner[ours] = chosen[linear_sum_assignment(cost)[1]]
    return partner


def _frame(file: ScenarioFile, frame: int) -> Floats:
    return np.asarray(file.read("position", frame), np.float64)


def _open(given: Given, scenario: int) -> ScenarioFile:
    return read_scenario(given.size.path(given.root, scenario))


PREDICTOR = ReferencePredictor(
    name="analog",
    title="Analog",
    definition="The scenario of train whose given frames are nearest to those given "
    "here: its motion carries"
    " the particles of a full box, its matched particles are the answer on a free "
    "surface.",
    predict=predict,
    reads_train=True,
)
