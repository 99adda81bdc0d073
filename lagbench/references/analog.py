"""Analog: the scenario of train that starts most like this one, its future the answer.

After Lorenz, J. Atmos. Sci. 26 (1969) 636. Scenarios and their mirror images are
compared at the last given frame by

    d^2 = W2^2(positions) / std(x)^2 + mean |u_a - u_b|^2 / mean |u_a|^2,

the sliced Wasserstein distance of their clouds (material by material where both have
the same), over the variance of a cloud along a direction (wherever in the box it is),
and the difference of their velocity fields on the score grid over the square of those
given here. In a full box the motion of the analog carries the particles: from frame to
frame they move as the analog does where they are. On a free surface the particles of
the analog are assigned to those given so that the sum of squared distances is least,
and their paths are the answer.

Memorising looks like this, and so does a leak from train to test.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lagbench.data.grid import node_velocity, transfer
from lagbench.data.scenario import ScenarioFile, read_scenario
from lagbench.metrics.frame import directions

from .assignment import assign_particles
from .predictor import (
    Floats,
    Given,
    Kind,
    Prediction,
    ReferencePredictor,
    given_in,
    velocity_field,
    wall_motion,
    with_wall_images,
)
from .train_library import Mirror, long_enough, mirrors_of

ANGLES = np.arange(64) * (np.pi / 64)
PLANE_DIRECTIONS = np.stack([np.cos(ANGLES), np.sin(ANGLES)])
SPACE_DIRECTIONS = directions(3).astype(np.float64).T
DIRECTIONS = {2: PLANE_DIRECTIONS, 3: SPACE_DIRECTIONS}
"""Directions on which clouds are projected, shape [axis, direction], by dimension."""

LEVELS = (np.arange(256) + 0.5) / 256
"""Levels at which distributions along a direction are compared; clouds may differ in
number."""


@dataclass(frozen=True, eq=False)
class InitialCloud:
    """How a scenario starts, as scenarios are compared."""

    # quantiles along each direction by material [length], each [level, direction]
    clouds: dict[int, Floats]
    shares: dict[int, float]  # share of each material in the particles [1]
    field: Floats  # velocity at the nodes [length/frame], shape [*node, axis]


def describe_start(given: Given, mirror: Mirror | None = None) -> InitialCloud:
    """Return how a scenario, or a mirror image of it, starts."""
    grid = given.size.field_grid
    position = given.last
    velocity = given.step
    if mirror is not None:
        position = mirror.positions(position)
        velocity = mirror.velocities(velocity)
    directions = DIRECTIONS[position.shape[1]]
    clouds = {}
    shares = {}
    for kind in np.unique(given.material).tolist():
        members = given.material == kind
        projections = position[members] @ directions
        clouds[kind] = np.quantile(projections, LEVELS, axis=0)
        shares[kind] = float(np.mean(members))
    sums = transfer(position, velocity, grid)
    largest_weight = float(sums.weight.max())
    field = node_velocity(sums, largest_weight)
    return InitialCloud(clouds, shares, field)


def distance(start: InitialCloud, other: InitialCloud) -> float:
    """Return how unlike two starts are, in units of the first one's spread [1].

    Infinite for starts of other materials.
    """
    if start.clouds.keys() != other.clouds.keys():
        return float("inf")
    squared_distance = 0.0
    variance = 0.0
    for kind, cloud in start.clouds.items():
        share = start.shares[kind]
        difference = cloud - other.clouds[kind]
        mean_square = float(np.mean(difference**2))
        spread = np.var(cloud, axis=0)
        squared_distance += share * mean_square
        variance += share * float(np.mean(spread))
    field_difference = start.field - other.field
    squared_difference = float(np.mean(field_difference**2))
    squared_speed = float(np.mean(start.field**2)) or 1.0
    of_clouds = squared_distance / variance
    of_fields = squared_difference / squared_speed
    return float(np.sqrt(of_clouds + of_fields))


def find_analog(given: Given) -> tuple[int, Mirror]:
    """Return the scenario of train, and its mirror image, that starts most like this.

    Raises:
        DataError: no scenario of train is as long as the task.
    """
    size = given.size
    start = describe_start(given)
    best = None
    for scenario in long_enough(size):
        with _open(given, scenario) as file:
            candidate = given_in(file, size, given.root)
        for number, mirror in enumerate(mirrors_of(size)):
            unlikeness = distance(start, describe_start(candidate, mirror))
            rank = (unlikeness, scenario, number)
            if best is None or rank < best[0]:
                best = (rank, scenario, mirror)
    if best is None:  # long_enough has refused an empty train
        raise AssertionError
    return best[1:]


def predict(given: Given) -> Prediction:
    """Yield where the analog takes the particles."""
    scenario, mirror = find_analog(given)
    with _open(given, scenario) as file:
        if given.size.is_full_box:
            yield from _carry(given, file, mirror)
        else:
            yield from _follow(given, file, mirror)


def _carry(given: Given, file: ScenarioFile, mirror: Mirror) -> Prediction:
    """Yield where the velocity field of the analog carries the particles."""
    frames = given.predicted_frames
    walls = mirror.walls(wall_motion(file, given.size, frames.stop))
    position = given.last
    before = mirror.positions(_frame(file, frames[0] - 1))
    for frame in frames:
        after = mirror.positions(_frame(file, frame))
        step = given.box.displacement(before, after)  # [length/frame]
        points, velocities = with_wall_images(given, before, step, walls[frame])
        field = velocity_field(points, velocities)
        position = given.inside(position + field(position))
        before = after
        yield position.astype("float32")


def _follow(given: Given, file: ScenarioFile, mirror: Mirror) -> Prediction:
    """Yield the paths of the analog's particles that are assigned to those given."""
    frames = given.predicted_frames
    analog_last = mirror.positions(_frame(file, frames[0] - 1))
    partner = assign_particles(
        given.last, analog_last, given.material, file.read("material"), given.box
    )
    for frame in frames:
        yield mirror.positions(_frame(file, frame))[partner].astype("float32")


def _frame(file: ScenarioFile, frame: int) -> Floats:
    return np.asarray(file.read("position", frame), np.float64)


def _open(given: Given, scenario: int) -> ScenarioFile:
    return read_scenario(given.size.path(given.root, scenario))


PREDICTOR = ReferencePredictor(
    name="analog",
    title="Analog",
    kind=Kind.NAIVE,
    definition="The scenario of train, or a mirror image of one, whose last given frame"
    " is nearest: its motion carries the particles of a full box, its matched particles"
    " are the answer on a free surface.",
    predict=predict,
    reads_train=True,
)
