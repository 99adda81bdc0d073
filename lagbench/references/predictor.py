"""Reference predictors: what predicts without training, and what it may know.

They are naive, classical or calibrated (:class:`Kind`). All get what a model gets of a
test scenario: its first frames, its materials, the motion of its walls and its
viscosity.

Some predictors carry the particles of a full box by a velocity field that is known at
scattered points. In two dimensions the field is linear on the Delaunay triangles of the
points. In three it is fitted to the nearest points (:func:`fitted_field`). Beyond a
wall stand mirror images of the points near it, so that the field meets the condition of
the wall half-way: where walls hold the fluid, the image of u is ``2 u_wall - u``; where
they let it slide, its normal component is reversed.
"""

from __future__ import annotations

import enum
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lagbench.data import WALL
from lagbench.data.box import Box, keep_outside, parse_obstacle
from lagbench.data.registry import Size
from lagbench.data.scenario import ScenarioFile

Floats = NDArray[np.float64]

Prediction = Iterator[NDArray[np.float32]]
"""Positions of one predicted frame after the other [length], each [particle, axis]."""

Field = Callable[[Floats], Floats]
"""From points [length], shape [point, axis], to velocities there [length/frame]."""

DEGREE = 4
"""Degree of the polynomials in time through more than two given frames."""

MIRRORED_LAYER = 4.0
"""Depth of the layer that is mirrored at the walls, in spacings of the points."""


NEAREST = 10
"""Points around a place to which a linear function is fitted in three dimensions."""


class Kind(enum.StrEnum):
    """How a prediction comes about."""

    # learns nothing and knows no equation; may look things up in train
    NAIVE = "naive"
    # integrates the equations with stated constants
    CLASSICAL = "classical"
    # a classical solver whose constants, a dozen numbers at most, are fitted on train
    CALIBRATED = "calibrated"
    # a network, no solver
    LEARNED = "learned"
    # a solver with a network inside
    HYBRID = "hybrid"

    @property
    def is_on_classical_side(self) -> bool:
        """Whether a model is measured against it: anyone can fit a number."""
        return self in (Kind.CLASSICAL, Kind.CALIBRATED)

    @property
    def has_network(self) -> bool:
        """Whether a network is at work."""
        return self in (Kind.LEARNED, Kind.HYBRID)


@dataclass(frozen=True, kw_only=True, eq=False)
class Given:
    """What is given of a test scenario: first frames, materials, what drives it."""

    size: Size  # the split and size
    root: Path  # folder of all data sets: train may be looked at
    position: Floats  # the given frames [length], shape [frame, particle, axis]
    material: NDArray[np.int8]  # index into MATERIALS, shape [particle]
    # velocity of each wall from frame f-1 to f, to the end of the horizon
    # [length/frame], shape [frame, wall, axis]
    walls: Floats
    area: float  # area or volume that the particles cover at first [length^d]
    # acceleration of the fluid in layers of equal height along y, lowest first, to the
    # end of the horizon [length/frame^2], shape [frame, layer, axis]; None without one
    body_force: Floats | None = None
    # what the scenario's file states: viscosity, friction and the like
    parameters: Mapping[str, object]

    @cached_property
    def box(self) -> Box:
        """The box that holds the particles."""
        return self.size.box

    @property
    def last(self) -> Floats:
        """Positions of the last given frame [length], shape [particle, axis]."""
        return np.asarray(self.position[-1])

    @property
    def step(self) -> Floats:
        """Last given velocity [length/frame], shape [particle, axis]."""
        return self.box.displacement(self.position[-2], self.position[-1])

    @property
    def middle(self) -> Floats:
        """Positions half a frame before the last given one [length].

        The shape is [particle, axis].

        There the particles have the velocity :attr:`step`.
        """
        if self.box.is_periodic:
            return self.box.wrap(self.last - self.step / 2.0)
        return np.asarray((self.position[-1] + self.position[-2]) / 2.0)

    @property
    def fall(self) -> Floats:
        """Acceleration of a free particle [length/frame^2], shape [axis].

        The second axis points up.
        """
        gravity = np.zeros(self.box.dimension)
        gravity[1] = -float(self.size.value("gravity"))
        return np.asarray(gravity * self.size.frame_interval**2)

    @property
    def viscosity(self) -> float:
        """Kinematic viscosity that the scenario or its data set states [length^2/s].

        Where neither states one the fluid is inviscid: 0.
        """
        stated = self.parameters.get("viscosity")
        if stated is None:
            return self.size.task.effective_viscosity or 0.0
        return float(str(stated))

    @property
    def predicted_frames(self) -> range:
        """Absolute numbers of the frames to predict."""
        task = self.size.task
        return range(task.input_frames, task.input_frames + task.horizon)

    @cached_property
    def driven(self) -> bool:
        """Whether a wall ever moves; such walls hold the fluid, others let it slide."""
        return bool(self.walls.any())

    @cached_property
    def obstacle(self) -> NDArray[np.float32] | None:
        """Centre and radius of the fixed obstacle [length]; None without one.

        The shape is [axis + 1].
        """
        where = f"{self.size.split} {self.size.name}"
        return parse_obstacle(self.parameters, self.box.dimension, where=where)

    def inside(self, position: Floats) -> Floats:
        """Return positions, those beyond a wall or in the obstacle put on it.

        The shape is [particle, axis].
        """
        inside = self.box.inside(position)
        if self.obstacle is None:
            return inside
        return keep_outside(inside, self.obstacle)


@dataclass(frozen=True, kw_only=True)
class ReferencePredictor:
    """One way to predict without training."""

    name: str  # name of its rows
    title: str  # the same for readers
    kind: Kind  # naive, classical or calibrated
    definition: str  # what it predicts, one sentence
    predict: Callable[[Given], Prediction]
    applies: Callable[[Size], bool] = lambda _: True  # whether a split and size has it
    reads_train: bool = False  # whether it looks at the scenarios of train

    @property
    def counts(self) -> bool:
        """Whether skill may be measured against it: against naive ones only."""
        return self.kind is Kind.NAIVE


def falls(size: Size) -> bool:
    """Tell whether the material has a free surface and falls."""
    return not size.is_full_box and "gravity" in size.parameters


def given_in(file: ScenarioFile, size: Size, root: Path) -> Given:
    """Return what a scenario's file gives to a model, without particles of walls."""
    task = size.task
    material = file.read("material")
    position = file.read("position", slice(0, task.input_frames))
    if (material == WALL).any():
        position = position[:, material != WALL]
        material = material[material != WALL]
    mass = float(file.read("particle_mass")) * len(material)
    return Given(
        size=size,
        root=root,
        position=position.astype(np.float64),
        material=material,
        walls=wall_motion(file, size, task.input_frames + task.horizon),
        body_force=_body_force(file, size),
        area=mass / float(size.value("density")),
        parameters=file.header.parameters,
    )


def fitted_velocity(given: Given, frame: int) -> Floats:
    """Return the velocity of each particle in a given frame [length/s].

    Through more than two frames goes a polynomial in time, fitted by least squares.
    Between two the particles fall: they have the mean velocity half-way.
    """
    interval = given.size.frame_interval
    count = len(given.position)
    steps = given.box.displacement(given.position[:-1], given.position[1:])
    if count == 2:
        fall = given.fall if not given.size.is_full_box else 0.0
        return np.asarray((steps[0] + (frame - 0.5) * fall) / interval)
    start = np.zeros((1, *steps.shape[1:]))
    way = np.concatenate([start, np.cumsum(steps, axis=0)])
    time = np.arange(count) - frame
    powers = np.vander(time, min(DEGREE, count - 1) + 1, increasing=True)
    slope = np.linalg.pinv(powers)[1]  # of the polynomial at the frame
    return np.asarray(np.einsum("f,fpa->pa", slope, way) / interval)


def wall_motion(file: ScenarioFile, size: Size, frames: int) -> Floats:
    """Return the velocity of each wall towards the first frames [length/frame].

    Shape [frame, wall, axis], with two walls for each axis.
    """
    if "wall_velocity" not in file.variables:
        return np.zeros((frames, 2 * size.dimension, size.dimension))
    speed = file.read("wall_velocity", slice(0, frames)).astype(np.float64)
    return np.asarray(speed * size.frame_interval)


def _body_force(file: ScenarioFile, size: Size) -> Floats | None:
    """Return the acceleration towards the first frames [length/frame^2], if any."""
    if "body_force" not in file.variables:
        return None
    frames = slice(0, size.task.input_frames + size.task.horizon)
    acceleration = file.read("body_force", frames).astype(np.float64)
    return np.asarray(acceleration * size.frame_interval**2)


def velocity_field(points: Floats, velocities: Floats) -> Field:
    """Return the field that carries particles, from its velocities at points.

    In two dimensions it is :func:`linear_field`, in three :func:`fitted_field`.

    Args:
        points: scattered points [length], shape [point, axis].
        velocities: velocities there [length/frame], shape [point, axis].
    """
    if points.shape[1] == 2:
        return linear_field(points, velocities)
    return fitted_field(points, velocities)


def linear_field(points: Floats, values: Floats) -> Field:
    """Return the field that is linear between points.

    Beyond the points the field has the value at the nearest one.
    """
    from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator

    linear = LinearNDInterpolator(points, values)

    def field(at: Floats) -> Floats:
        velocity = np.asarray(linear(at), np.float64)
        is_beyond = np.isnan(velocity[:, 0])
        if is_beyond.any():
            nearest = NearestNDInterpolator(points, values)
            velocity[is_beyond] = nearest(at[is_beyond])
        return velocity

    return field


def fitted_field(points: Floats, values: Floats) -> Field:
    """Return the field that a linear function of the nearest points has.

    It is fitted to :data:`NEAREST` points (:func:`fit_linear`). There is nothing to
    triangulate, which in three dimensions takes 40 times as long as a reading.
    """
    from scipy.spatial import KDTree

    tree = KDTree(points)

    def field(at: Floats) -> Floats:
        distance, nearest = tree.query(at, k=min(NEAREST, len(points)))
        way = points[nearest] - at[:, None]
        return fit_linear(np.asarray(distance), way, values[nearest])[:, 0]

    return field


def fit_linear(distance: Floats, way: Floats, values: Floats) -> Floats:
    """Return the linear functions that fit values around some places.

    By least squares, with weights of the inverse squared distance.

    Args:
        distance: from each place to its neighbours, the nearest first [length], shape
            [place, neighbour].
        way: to the neighbours [length], shape [place, neighbour, axis].
        values: at the neighbours, shape [place, neighbour, component].

    Returns:
        Value and gradient at each place, shape [place, 1 + axis, component].
    """
    tiny = np.finfo(np.float64).tiny
    weight = 1.0 / (distance**2 + 1e-6 * distance[:, -1:] ** 2 + tiny)
    one = np.ones((*way.shape[:2], 1))
    basis = np.concatenate([one, way], axis=2)
    weighted = weight[..., None] * basis
    matrix = np.einsum("nki,nkj->nij", weighted, basis)
    right = np.einsum("nki,nkj->nij", weighted, values)

    # A little on the diagonal, for points that lie in one plane.
    size = np.trace(matrix, axis1=1, axis2=2)
    matrix += 1e-12 * size[:, None, None] * np.eye(basis.shape[2])
    return np.asarray(np.linalg.solve(matrix, right))


def with_wall_images(
    given: Given, points: Floats, values: Floats, walls: Floats
) -> tuple[Floats, Floats]:
    """Return points and velocities together with their images behind the walls.

    Along a periodic axis the images are those of the neighbouring periods.

    Args:
        given: what is given of the scenario: its box, and whether walls move.
        points: points in the box [length], shape [point, axis].
        values: velocities there [length/frame], shape [point, axis].
        walls: velocities of the walls, left, right, bottom, top and so on
            [length/frame], shape [wall, axis].
    """
    box = given.box
    depth = MIRRORED_LAYER * np.sqrt(box.volume / len(points))
    if box.dimension == 3:
        depth = MIRRORED_LAYER * np.cbrt(box.volume / len(points))
    places = [points]
    speeds = [values]
    for number, motion in enumerate(walls):
        axis, side = divmod(number, 2)
        wall_place = box.bounds[axis][side]
        near = np.abs(points[:, axis] - wall_place) < depth
        image = points[near].copy()
        speed = values[near].copy()
        if box.periodic[axis]:
            # The lower end repeats beyond the upper one, and the other way round.
            period = box.lengths[axis]
            image[:, axis] += -period if side else period
            places.append(image)
            speeds.append(speed)
            continue
        image[:, axis] = 2.0 * wall_place - image[:, axis]
        if given.driven:
            speed = 2.0 * motion - speed
        else:
            speed[:, axis] *= -1.0
        places.append(image)
        speeds.append(speed)
    return np.concatenate(places), np.concatenate(speeds)
