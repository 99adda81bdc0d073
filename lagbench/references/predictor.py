"""A floor: what predicts without learning, and all that it may know of a test scenario.

Some carry the particles of a full box by a velocity field that is known at scattered
points. Between the points the field is linear on their Delaunay triangles. Beyond a
wall stand mirror images of the points near it, so that the field meets the wall's
condition half-way: where walls hold the fluid, the image of u is ``2 u_wall - u``;
where they let it slide, its normal component is reversed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lagbench.data import WALLS
from lagbench.data.grid import Placement
from lagbench.data.registry import Size
from lagbench.data.scenario import ScenarioFile

Floats = NDArray[np.float64]

Prediction = Iterator[NDArray[np.float32]]
"""Positions of one predicted frame after the other [length], each [particle, 2]."""

Field = Callable[[Floats], Floats]
"""From points [length], shape [point, 2], to velocities there [length/frame]."""

DEPTH = 4.0
"""Depth of the layer that is mirrored at the walls, in spacings of the points."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Given:
    """What is given of a test scenario: its first frames, its materials and what drives
    it.
    """

    size: Size  # the split and size
    root: Path  # folder of all data sets: train may be looked at
    position: Floats  # the given frames [length], shape [frame, particle, 2]
    material: NDArray[np.int8]  # index into MATERIALS, shape [particle]
    # velocity of each wall from frame f-1 to f, to the end of the horizon
    # [length/frame], shape [frame, 4, 2]
    walls: Floats
    area: float  # area that the particles cover at first [length^2]
    # what the scenario's file states: viscosity, friction and the like
    parameters: Mapping[str, object]

    @property
    def last(self) -> Floats:
        """Positions of the last given frame [length], shape [particle, 2]."""
        return np.asarray(self.position[-1])

    @property
    def step(self) -> Floats:
        """Last given velocity [length/frame], shape [particle, 2]."""
        return np.asarray(self.position[-1] - self.position[-2])

    @property
    def predicted_frames(self) -> range:
        """Absolute numbers of the frames to predict."""
        task = self.size.task
        return range(task.input_frames, task.input_frames + task.horizon)

    @cached_property
    def driven(self) -> bool:
        """Whether a wall ever moves; such walls hold the fluid, others let it slide."""
        return bool(self.walls.any())

    def inside(self, position: Floats) -> Floats:
        """Return positions, those beyond a wall put on it, shape [particle, 2]."""
        low, high = np.transpose(self.size.bounds)
        return np.clip(position, low, high)


@dataclass(frozen=True, kw_only=True)
class ReferencePredictor:
    """One way to predict that costs no learning."""

    name: str  # name of its rows
    title: str  # the same for readers
    definition: str  # what it predicts, one sentence
    predict: Callable[[Given], Prediction]
    applies: Callable[[Size], bool] = lambda _: True  # whether a split and size has it
    # whether it may be the best floor, which skill is measured against
    counts: bool = True
    reads_train: bool = False  # whether it looks at the scenarios of train


def fills_box(size: Size) -> bool:
    """Tell whether the material fills the box: no surface, one material."""
    return Placement(size.task.score_grid.placement) is Placement.CELL_CENTRES


def given_in(file: ScenarioFile, size: Size, root: Path) -> Given:
    """Return what a scenario's file gives to a model."""
    task = size.task
    material = file.read("material")
    mass = float(file.read("particle_mass")) * len(material)
    return Given(
        size=size,
        root=root,
        position=file.read("position", slice(0, task.input_frames)).astype(np.float64),
        material=material,
        walls=wall_motion(file, size, task.input_frames + task.horizon),
        area=mass / float(size.value("density")),
        parameters=file.header.parameters,
    )


def wall_motion(file: ScenarioFile, size: Size, frames: int) -> Floats:
    """Return the velocity of each wall towards the first frames [length/frame], shape
    [frame, 4, 2].
    """
    if "wall_velocity" not in file.variables:
        return np.zeros((frames, len(WALLS), 2))
    speed = file.read("wall_velocity", slice(0, frames)).astype(np.float64)
    return np.asarray(speed * size.frame_interval)


def linear_field(points: Floats, values: Floats) -> Field:
    """Return the field that is linear between points, and beyond them that of the
    nearest one.
    """
    from scipy.interpolate import LinearNDInterpolator
    from scipy.spatial import KDTree

    linear = LinearNDInterpolator(points, values)

    def field(at: Floats) -> Floats:
        found = np.asarray(linear(at), np.float64)
        beyond = np.isnan(found[:, 0])
        if beyond.any():
            found[beyond] = values[KDTree(points).query(at[beyond])[1]]
        return found

    return field


def mirrored(
    given: Given, points: Floats, values: Floats, walls: Floats
) -> tuple[Floats, Floats]:
    """Return points and velocities there, each [point, 2], with those that the walls
    reflect.

    ``walls`` are their velocities, left, right, bottom, top [length/frame], shape [4,
    2].
    """
    (left, right), (bottom, top) = given.size.bounds
    depth = DEPTH * np.sqrt((right - left) * (top - bottom) / len(points))
    places = [points]
    speeds = [values]
    for motion, axis, where in zip(
        walls, (0, 0, 1, 1), (left, right, bottom, top), strict=True
    ):
        near = np.abs(points[:, axis] - where) < depth
        image = points[near].copy()
        speed = values[near].copy()
        image[:, axis] = 2.0 * where - image[:, axis]
        if given.driven:
            speed = 2.0 * motion - speed
        else:
            speed[:, axis] *= -1.0
        places.append(image)
        speeds.append(speed)
    return np.concatenate(places), np.concatenate(speeds)
