"""A scenario as pictures need it: frames, walls, names and grid fields."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagbench.data import grid as gridding
from lagbench.data.box import parse_obstacle
from lagbench.data.local import load_rooted_registry
from lagbench.data.registry import Registry, Size
from lagbench.data.scenario import ScenarioFile, read_scenario
from lagbench.data.variables import require_known_material
from lagbench.errors import UsageError

# folders between the root of all data sets and a scenario file
DEPTH = 4

KIND_PARAMETERS = ("family", "pair")
"""Parameters that say of which kind a scenario is."""


@dataclass(frozen=True)
class Scene:
    """One frame of a scenario."""

    recording: Recording  # scenario that the frame belongs to
    frame: int  # absolute frame number
    position: NDArray[np.float64]  # [length], shape [particle, axis]
    # velocity of the solver [length/s], shape [particle, axis]
    velocity: NDArray[np.float64]
    # x(f) - x(f-1) [length/frame]; at frame 0 velocity times frame interval, or
    # x(1) - x(0) where no velocity is recorded
    displacement: NDArray[np.float64]

    @property
    def time(self) -> float:
        """Time since frame 0 [s]."""
        return self.frame * self.recording.size.frame_interval

    @property
    def speed(self) -> NDArray[np.float64]:
        """Speed of each particle [length/s], shape [particle]."""
        speed: NDArray[np.float64] = np.sqrt((self.velocity**2).sum(axis=-1))
        return speed

    @cached_property
    def fields(self) -> gridding.Fields:
        """Fields on the size's score grid; vorticity and divergence in 1/frame.

        In three dimensions they are those of the plane across z that is drawn.
        """
        if self._whole_fields.grid.dimension == 2:
            return self._whole_fields
        return self._whole_fields.slice_across_z(self.layer)

    @cached_property
    def layer(self) -> int:
        """Number along z of the nodes of the plane that is drawn, in three dimensions.

        It is the middle one of a full box. Else it is the one with the most nodes that
        have a vorticity, or, where there are none, that count.
        """
        whole = self._whole_fields
        middle = whole.grid.middle_layer
        if self.recording.size.is_full_box:
            return middle
        if self.recording.layer is not None:
            return self.recording.layer
        differentiable, counted = self.nodes_of_layers
        away = np.abs(np.arange(len(counted)) - middle)
        order = np.lexsort((away, -counted, -differentiable))
        return int(order[0])

    @property
    def nodes_of_layers(self) -> NDArray[np.intp]:
        """Nodes with a vorticity, and those that count, shape [2, z node]."""
        whole = self._whole_fields
        counts = []
        for is_node in (whole.differentiable, whole.counted):
            counts.append(np.count_nonzero(is_node, axis=(0, 1)))
        return np.array(counts)

    @cached_property
    def _whole_fields(self) -> gridding.Fields:
        grid = self.recording.size.field_grid
        full = grid.full_weight(self.recording.particles, self.recording.area)
        return gridding.fields(self.position, self.displacement, grid, full=full)

    @property
    def vorticity(self) -> NDArray[np.float64]:
        """Vorticity at the nodes of the score grid [1/s], shape [x node, y node].

        In three dimensions it is the magnitude in the plane that is drawn.
        """
        interval = self.recording.size.frame_interval
        whole = self._whole_fields
        if whole.grid.dimension == 2:
            return whole.vorticity / interval
        across = whole.vorticity[:, :, self.layer]
        magnitude: NDArray[np.float64] = np.sqrt((across**2).sum(axis=-1))
        return magnitude / interval


class Recording:
    """A scenario whose frames are read one at a time."""

    def __init__(self, file: ScenarioFile, registry: Registry, *, where: str) -> None:
        """Read what holds for all frames.

        Args:
            file: the scenario.
            registry: where the split is described.
            where: path of the file, for messages.

        Raises:
            DataError: the obstacle has no place or no size, or a number stands for no
                material.
        """
        header = file.header
        self.size: Size = registry.size(header.key.split, header.key.size)
        self.title = registry.split(self.size.split).title
        self.scenario = header.key.scenario
        self.parameters = header.parameters
        self.frames = header.frames
        # number along z of the slice of all frames; None: the best one of each frame
        self.layer: int | None = None
        self._read = file.read
        material = file.read("material")
        fix = "state a material of lagbench for every particle"
        require_known_material(material, where=where, fix=fix)
        self.material = material.astype(np.int8)
        # [length/s], shape [frame, wall, axis]; zeros without walls
        dimension = self.size.dimension
        self.wall_velocity = np.zeros((self.frames, 2 * dimension, dimension))
        if "wall_velocity" in file.variables:
            self.wall_velocity[:] = file.read("wall_velocity")
        # centre and radius of a fixed obstacle [length]; None without one
        self.obstacle = parse_obstacle(self.parameters, dimension, where=where)
        self._has_velocity = "velocity" in file.variables
        self._particle_mass = float(file.read("particle_mass"))

    @property
    def particles(self) -> int:
        """Number of particles in every frame."""
        return len(self.material)

    @property
    def area(self) -> float:
        """Area or volume that the material covers at first [length^d]."""
        mass = self._particle_mass * self.particles
        return mass / float(self.size.value("density"))

    @property
    def spacing(self) -> float:
        """Mean distance of neighbouring particles at first [length]."""
        if self.is_solid:
            return float(np.cbrt(self.area / self.particles))
        return float(np.sqrt(self.area / self.particles))

    @property
    def is_solid(self) -> bool:
        """Whether the box has three dimensions."""
        return self.size.dimension == 3

    def fix_slice(self, frames: Iterable[int]) -> None:
        """Choose one slice for all frames: the best one of these frames.

        Only free surfaces in three dimensions need it. In full boxes the slice is
        always the middle plane across z.
        """
        if self.size.is_full_box or not self.is_solid:
            return
        counts = np.sum([self.scene(frame).nodes_of_layers for frame in frames], axis=0)
        differentiable, counted = counts
        order = np.lexsort((-counted, -differentiable))
        self.layer = int(order[0])

    @property
    def is_mixed(self) -> bool:
        """Whether the scenario has several materials."""
        return np.unique(self.material).size > 1

    def frame_number(self, frame: int) -> int:
        """Return an absolute frame number; negative ones count from the end.

        Raises:
            UsageError: the scenario has no such frame.
        """
        if not -self.frames <= frame < self.frames:
            raise UsageError(
                f"scenario {self.scenario} has no frame {frame}; name one from 0 to "
                f"{self.frames - 1}, or from -{self.frames} to -1"
            )
        return frame % self.frames

    def scene(self, frame: int) -> Scene:
        """Return one frame; negative numbers count from the end.

        Raises:
            UsageError: the scenario has no such frame, or a single one and no
                velocities.
        """
        number = self.frame_number(frame)
        if self.frames == 1 and not self._has_velocity:
            raise UsageError(
                f"scenario {self.scenario} has one frame without velocities: nothing "
                "says how its particles move; draw one of more frames"
            )
        position = self._read_particles("position", number)
        interval = self.size.frame_interval
        if number > 0:
            before = self._read_particles("position", number - 1)
            displacement = self.size.box.displacement(before, position)
        elif not self._has_velocity:
            after = self._read_particles("position", 1)
            displacement = self.size.box.displacement(position, after)
        else:
            displacement = self._read_particles("velocity", number) * interval
        if self._has_velocity:
            velocity = self._read_particles("velocity", number)
        else:
            velocity = displacement / interval
        return Scene(self, number, position, velocity, displacement)

    def _read_particles(self, name: str, frame: int) -> NDArray[np.float64]:
        return self._read(name, frame).astype(np.float64)


def describe_parameters(parameters: Mapping[str, Any]) -> list[str]:
    """Return Reynolds number, kind and start of a flow, as far as they are stated.

    A flow of vortex rings has no frequency: its files state 0.
    """
    parts = []
    if parameters.get("reynolds_number") is not None:
        parts.append(f"Re {float(str(parameters['reynolds_number'])):.0f}")
    for name in KIND_PARAMETERS:
        if name in parameters:
            parts.append(f"{name} {parameters[name]}")
    if parameters.get("kind") == "rings":
        parts.append("vortex rings")
    elif "frequency" in parameters:
        parts.append(f"frequency {parameters['frequency']}")
    return parts


@contextmanager
def open_recording(
    source: str | Path, *, registry: Registry | None = None
) -> Iterator[Recording]:
    """Open a scenario file for drawing.

    Args:
        source: scenario file.
        registry: where splits are described; ours when None. Local splits around the
            file are known too.

    Raises:
        DataError: the scenario file is missing or damaged.
    """
    parents = Path(source).absolute().parents
    root = parents[min(DEPTH, len(parents) - 1)]
    with read_scenario(Path(source)) as file:
        yield Recording(file, load_rooted_registry(root, registry), where=str(source))
