"""A scenario as pictures need it: frames, walls, names and grid fields.

A recording is a scenario file, or an ``xarray.Dataset`` of one scenario as
``xarray.open_dataset`` and ``lagbench.open_split(...).sel(scenario=3)`` give it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lagbench.data import grid as gridding
from lagbench.data.box import parse_obstacle
from lagbench.data.local import load_rooted_registry
from lagbench.data.registry import Registry, Size, load
from lagbench.data.scenario import read_scenario, require_known_material
from lagbench.errors import UsageError

if TYPE_CHECKING:
    import xarray as xr

# from the name of a variable and one or several frames to its values
Read = Callable[[str, slice | int], NDArray[Any]]

IDENTITY = ("split", "size", "scenario")  # what names a scenario

# variables that every picture needs
DRAWN_VARIABLES = ("position", "material", "particle_mass")

# folders between the root of all data sets and a scenario file
DEPTH = 4


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

    def __init__(
        self,
        identity: Mapping[str, Any],
        *,
        parameters: Mapping[str, Any],
        frames: int,
        variables: set[str],
        read: Read,
        registry: Registry,
        file: str | None = None,
    ) -> None:
        """Read what holds for all frames.

        Args:
            identity: split, size and id of the scenario.
            parameters: physical parameters by name.
            frames: number of recorded frames.
            variables: names of the recorded variables.
            read: returns a variable at one or several frames.
            registry: where the split is described.
            file: path of the scenario file, for messages; None where it is not known.

        Raises:
            DataError: the obstacle has no place or no size, or a number stands for no
                material.
        """
        self.size: Size = registry.size(str(identity["split"]), str(identity["size"]))
        self.title = registry.split(self.size.split).title
        self.scenario = int(identity["scenario"])
        self.parameters = parameters
        self.frames = frames
        # number along z of the slice of all frames; None: the best one of each frame
        self.layer: int | None = None
        self._read = read
        # rows of NaN fill up scenarios that have fewer particles than others
        self._is_present = np.isfinite(read("position", 0)).all(axis=-1)
        where = file or f"{self.size.split} {self.size.name}, scenario {self.scenario}"
        material = read("material", slice(None))[self._is_present]
        fix = "state a material of lagbench for every particle"
        require_known_material(material, where=where, fix=fix)
        self.material = material.astype(np.int8)
        # [length/s], shape [frame, wall, axis]; zeros without walls
        dimension = self.size.dimension
        self.wall_velocity = np.zeros((frames, 2 * dimension, dimension))
        if "wall_velocity" in variables:
            self.wall_velocity[:] = read("wall_velocity", slice(frames))
        # centre and radius of a fixed obstacle [length]; None without one
        self.obstacle = self._obstacle(read, variables, where=where)
        self._has_velocity = "velocity" in variables
        self._particle_mass = float(read("particle_mass", slice(None)))

    def _obstacle(
        self, read: Read, variables: set[str], *, where: str
    ) -> NDArray[np.float32] | None:
        """Return centre and radius of the obstacle that a file or data set states."""
        if "obstacle" in variables:
            stated = read("obstacle", slice(None))
            return np.asarray(stated, np.float32)
        return parse_obstacle(self.parameters, self.size.dimension, where=where)

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
    def reynolds(self) -> float | None:
        """Reynolds number, None where there is none."""
        value = self.parameters.get("reynolds_number")
        if value is None:
            return None
        return float(value)

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
        return self._read(name, frame)[self._is_present].astype(np.float64)


def name_start(parameters: Mapping[str, Any]) -> str:
    """Return how a flow starts, as in "frequency 3"; empty where nothing says so.

    A flow of vortex rings has no frequency: its files state 0.
    """
    if parameters.get("kind") == "rings":
        return "vortex rings"
    if "frequency" in parameters:
        return f"frequency {parameters['frequency']}"
    return ""


@contextmanager
def open_recording(
    source: str | Path | xr.Dataset, *, registry: Registry | None = None
) -> Iterator[Recording]:
    """Open a scenario file, or a data set of one scenario, for drawing.

    Args:
        source: scenario file, or data set of one scenario with all its frames.
        registry: where splits are described; ours when None.

    Raises:
        UsageError: the data set has several scenarios, or lacks frames, variables or
            attributes.
        DataError: the scenario file is missing or damaged.
    """
    if not isinstance(source, str | Path):
        yield _record_dataset(source, registry)
        return
    with read_scenario(Path(source)) as file:
        key = file.header.key
        yield Recording(
            {"split": key.split, "size": key.size, "scenario": key.scenario},
            parameters=file.header.parameters,
            frames=file.header.frames,
            variables={*file.variables},
            read=file.read,
            registry=_registry_around(source, registry),
            file=str(source),
        )


def _registry_around(file: str | Path, registry: Registry | None) -> Registry:
    """Return a registry that also knows the local splits around a scenario file."""
    parents = Path(file).absolute().parents
    root = parents[min(DEPTH, len(parents) - 1)]
    return load_rooted_registry(root, registry)


def _record_dataset(data: xr.Dataset, registry: Registry | None) -> Recording:
    """Return the recording that a data set of one scenario holds."""
    if "scenario" in data.dims:
        raise UsageError(
            f"a picture shows one scenario, not {data.sizes['scenario']}; choose one, "
            "as in data.sel(scenario=3)"
        )
    attributes: dict[str, Any] = {str(name): v for name, v in data.attrs.items()}
    _require_complete(data)
    identity = {}
    for name in IDENTITY:
        if name in data.coords:
            identity[name] = data.coords[name].item()
        else:
            identity[name] = attributes[name]

    def read(name: str, frames: slice | int) -> NDArray[Any]:
        variable = data[name]
        if "frame" in variable.dims:
            variable = variable.isel(frame=frames)
        return np.asarray(variable)

    # as xarray and open_split note where the data are from
    file = data.encoding.get("source")
    if isinstance(file, str | Path):
        registry = _registry_around(file, registry)
    elif registry is None:
        registry = load()
    return Recording(
        identity,
        parameters=attributes,
        frames=_count_frames(data),
        variables={str(name) for name in data.variables},
        read=read,
        registry=registry,
    )


def _require_complete(data: xr.Dataset) -> None:
    """Refuse a data set that lacks what every picture needs."""
    missing = []
    for name in IDENTITY:
        if name not in data.coords and name not in data.attrs:
            missing.append(f"attribute {name}")
    for name in DRAWN_VARIABLES:
        if name not in data:
            missing.append(f"variable {name}")
    if missing:
        raise UsageError(
            f"the data set has no {', no '.join(missing)}; keep all variables and "
            "attributes of a scenario, as xr.set_options(keep_attrs=True) does"
        )


def _count_frames(data: xr.Dataset) -> int:
    """Return how many frames a data set of one scenario has; padding does not count."""
    numbers = data["frame"].values.tolist() if "frame" in data.dims else []
    frame_count = len(numbers)
    if "frame_count" in data:
        frame_count = int(data["frame_count"])
    if numbers != list(range(max(frame_count, len(numbers), 1))):
        raise UsageError(
            "a picture needs all frames of a scenario, from 0 on; choose a scenario "
            "only, as in data.sel(scenario=3), and say which frame to draw"
        )
    return frame_count
