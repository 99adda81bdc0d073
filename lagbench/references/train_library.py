"""Scenarios of train as the analogs look at them: mirrored, and cut into states.

A box that is symmetric has no preferred side: a scenario that is mirrored is one more
scenario. On free surfaces, where matter falls, the left and right sides are exchanged;
in full boxes also the lower and upper ones. In three dimensions front and back are
exchanged too.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lagbench.data.box import Box
from lagbench.data.registry import Size
from lagbench.data.scenario import read_scenario
from lagbench.errors import DataError
from lagbench.metrics.frame import directions

from .predictor import Floats

FEATURE_LEVELS = (np.arange(16) + 0.5) / 16
"""Levels of the quantiles that describe a cloud along a direction."""

FEATURE_ANGLES = np.arange(8) * (np.pi / 8)
PLANE_DIRECTIONS = np.stack([np.cos(FEATURE_ANGLES), np.sin(FEATURE_ANGLES)])
SPACE_DIRECTIONS = directions(3)[::4].astype(np.float64).T
FEATURE_DIRECTIONS = {2: PLANE_DIRECTIONS, 3: SPACE_DIRECTIONS}
"""Directions along which clouds are described, shape [axis, direction], by dimension.
"""

VELOCITY_WEIGHT = 20.0
"""Frames over which a difference of velocities counts as one of positions."""

STATE_STRIDE = 2
"""Frames from one state of a scenario to the next."""

UP = 1
"""Axis along which matter falls."""

STATE_SHARE = 2 / 3
"""Share of a scenario's frames within which a state may lie; the rest is its future."""


@dataclass(frozen=True)
class Mirror:
    """A mirror image of a box: the axes that are reversed."""

    box: Box
    axes: tuple[int, ...]

    def positions(self, position: Floats) -> Floats:
        """Return mirrored positions [length], shape [..., axis]."""
        image = np.array(position, np.float64)
        for axis in self.axes:
            image[..., axis] = self.box.low[axis] + self.box.high[axis]
            image[..., axis] -= position[..., axis]
        return image

    def velocities(self, velocity: Floats) -> Floats:
        """Return mirrored velocities, shape [..., axis]."""
        image = np.array(velocity, np.float64)
        for axis in self.axes:
            image[..., axis] *= -1.0
        return image

    def walls(self, wall_velocity: Floats) -> Floats:
        """Return the velocities of the mirrored walls, shape [..., wall, axis]."""
        image = self.velocities(wall_velocity)
        for axis in self.axes:
            pair = [2 * axis, 2 * axis + 1]
            image[..., pair, :] = image[..., pair[::-1], :]
        return image


def mirrors_of(size: Size) -> tuple[Mirror, ...]:
    """Return the mirror images under which a split is the same; the first is itself."""
    box = size.box
    symmetric_axes = list(range(box.dimension))
    if not size.is_full_box:
        symmetric_axes.remove(UP)
    mirrors = []
    for count in range(len(symmetric_axes) + 1):
        for axes in itertools.combinations(symmetric_axes, count):
            mirrors.append(Mirror(box, axes))
    return tuple(mirrors)


def long_enough(size: Size) -> tuple[int, ...]:
    """Return the scenarios of train that last as long as the task.

    Raises:
        DataError: there is none.
    """
    needed = size.task.input_frames + size.task.horizon
    scenarios = []
    for scenario in size.subsets.get("train", ()):
        if size.frame_count(scenario) >= needed:
            scenarios.append(scenario)
    if not scenarios:
        raise DataError(
            f"no scenario of train has the {needed} frames of the task; shorten the "
            "task (--horizon), or take longer trajectories for train",
            where=f"{size.split} {size.name}",
        )
    return tuple(scenarios)


@dataclass(frozen=True, eq=False)
class TrainScenario:
    """The motion of one scenario of train."""

    position: NDArray[np.float32]  # [length], shape [frame, particle, axis]
    material: NDArray[np.int8]  # shape [particle]

    def positions_at(self, frames: Sequence[int] | NDArray[np.intp]) -> Floats:
        """Return positions at frames; after the last one the particles rest."""
        last = len(self.position) - 1
        return np.asarray(self.position[np.minimum(frames, last)], np.float64)


@functools.lru_cache(maxsize=8)
def read_train_scenario(path: Path) -> TrainScenario:
    """Return the motion that a file of train holds."""
    with read_scenario(path) as file:
        return TrainScenario(file.read("position"), file.read("material"))


def describe_state(
    position: Floats, velocity: Floats, material: NDArray[np.integer]
) -> Floats:
    """Return numbers whose distance tells how unlike two states are.

    Quantiles of positions and velocities along a few directions, material by material,
    weighted by the material's share. States of the same materials can be compared.

    Args:
        position: positions [length], shape [particle, axis].
        velocity: velocities [length/frame], shape [particle, axis].
        material: material of each particle, shape [particle].

    Returns:
        Shape [feature]; the Euclidean distance of two has the unit length.
    """
    parts = []
    for kind in np.unique(material):
        members = material == kind
        share = float(np.mean(members))
        for values, weight in ((position, 1.0), (velocity, VELOCITY_WEIGHT)):
            along = FEATURE_DIRECTIONS[values.shape[1]]
            projections = values[members] @ along
            quantiles = np.quantile(projections, FEATURE_LEVELS, axis=0)
            parts.append(weight * np.sqrt(share / quantiles.size) * quantiles.ravel())
    return np.concatenate(parts)


@dataclass(frozen=True, eq=False)
class StateLibrary:
    """States of train under all mirror images, and how they look."""

    scenarios: NDArray[np.intp]  # scenario id of each state, shape [state]
    mirrors: NDArray[np.intp]  # number of its mirror image, shape [state]
    frames: NDArray[np.intp]  # its frame, shape [state]
    features: Floats  # see :func:`describe_state`, shape [state, feature]

    def nearest(self, feature: Floats, *, count: int) -> list[int]:
        """Return the nearest states of different mirrored scenarios, the nearest first.

        Args:
            feature: what :func:`describe_state` says of the state that is compared.
            count: states to return, at most.
        """
        distance = np.sum((self.features - feature) ** 2, axis=1)
        chosen: list[int] = []
        seen = set()
        for state in np.argsort(distance, kind="stable"):
            image = (int(self.scenarios[state]), int(self.mirrors[state]))
            if image in seen:
                continue
            seen.add(image)
            chosen.append(int(state))
            if len(chosen) == count:
                break
        return chosen


_libraries: dict[tuple[Path, tuple[int, ...]], StateLibrary | None] = {}


def state_library(
    size: Size, root: Path, materials: Sequence[int]
) -> StateLibrary | None:
    """Return the states of all scenarios of train that have just these materials.

    None where there is none. Libraries are kept for the next call.

    Raises:
        DataError: no scenario of train is as long as the task.
    """
    kinds = tuple(sorted(int(kind) for kind in materials))
    key = (size.folder(root), kinds)
    if key in _libraries:
        return _libraries[key]
    scenarios = []
    mirror_numbers = []
    frames = []
    features = []
    for scenario in long_enough(size):
        motion = read_train_scenario(size.path(root, scenario))
        if tuple(np.unique(motion.material).tolist()) != kinds:
            continue
        end = int(STATE_SHARE * len(motion.position))
        for number, mirror in enumerate(mirrors_of(size)):
            image = mirror.positions(motion.position.astype(np.float64))
            for frame in range(1, end, STATE_STRIDE):
                velocity = size.box.displacement(image[frame - 1], image[frame])
                state = describe_state(image[frame], velocity, motion.material)
                scenarios.append(scenario)
                mirror_numbers.append(number)
                frames.append(frame)
                features.append(state)
    library: StateLibrary | None = None
    if features:
        library = StateLibrary(
            np.array(scenarios),
            np.array(mirror_numbers),
            np.array(frames),
            np.array(features),
        )
    _libraries[key] = library
    return library
