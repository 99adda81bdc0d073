"""A floor: what predicts without learning, and all that it may know of a test scenario."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lagbench.data.grid import Placement
from lagbench.data.registry import Size
from lagbench.data.scenario import WALLS, ScenarioFile

Floats = NDArray[np.float64]

Prediction = Iterator[NDArray[np.float32]]
"""Positions of one predicted frame after the other [length], each [particle, 2]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Given:
    """What is given of a test scenario: its first frames, its materials and what drives it."""

    size: Size  # the split and size
    root: Path  # folder of all data sets: train may be looked at
    position: Floats  # the given frames [length], shape [frame, particle, 2]
    material: NDArray[np.int8]  # index into MATERIALS, shape [particle]
    # velocity of each wall from frame f-1 to f, to the end of the horizon [length/frame],
    # shape [frame, 4, 2]
    walls: Floats
    area: float  # area that the particles cover at first [length^2]
    parameters: Mapping[str, object]  # what the scenario's file states: viscosity, friction and the like

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
class Floor:
    """One way to predict that costs no learning."""

    name: str  # name of its rows
    title: str  # the same for readers
    definition: str  # what it predicts, one sentence
    applies: Callable[[Size], bool]  # whether a split and size has it
    predict: Callable[[Given], Prediction]
    # whether it may be the best floor, which skill is measured against
    counts: bool = True
    reads_train: bool = False  # whether it looks at the scenarios of train


def fills_box(size: Size) -> bool:
    """Tell whether the material fills the box: no surface, one material."""
    return Placement(size.task.score_grid.placement) is Placement.CELL_CENTRES


def given_in(file: ScenarioFile, size: Size, root: Path) -> Given:
    """Return what a scenario's file gives to a model."""
    task, material = size.task, file.read("material")
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
    """Return the velocity of each wall towards the first frames [length/frame], shape [frame, 4, 2]."""
    if "wall_velocity" not in file.variables:
        return np.zeros((frames, len(WALLS), 2))
    speed = file.read("wall_velocity", slice(0, frames)).astype(np.float64)
    return np.asarray(speed * size.frame_interval)
