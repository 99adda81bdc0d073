"""A scenario as a picture needs it: frames, walls, names and grid fields.

A recording is a scenario file, or an ``xarray.Dataset`` of one scenario as
``xarray.open_dataset`` and ``lagbench.open_split(...).sel(scenario=3)`` give it.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lagbench.data import grid as gridding
from lagbench.data.local import load_rooted_registry
from lagbench.data.registry import Registry, Size, load
from lagbench.data.scenario import read_scenario
from lagbench.errors import UsageError

if TYPE_CHECKING:
    import xarray as xr


Read = Callable[[str, slice | int], NDArray[Any]]


@dataclass(frozen=True)
class Scene:
    """One frame of a scenario."""

    recording: Recording  # scenario that the frame belongs to
    frame: int  # absolute frame number
    position: NDArray[np.float64]  # [length], shape [particle, 2]
    # velocity of the solver [length/s], shape [particle, 2]
    velocity: NDArray[np.float64]
    # x(f) - x(f-1), at frame 0 velocity times frame interval [length/frame]
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
        """Fields on the size's score grid; vorticity and divergence in 1/frame."""
        score_grid = self.recording.size.task.score_grid
        grid = gridding.Grid(score_grid.cells, gridding.Placement(score_grid.placement))
        full = grid.full_weight(self.recording.particles, self.recording.area)
        return gridding.fields(self.position, self.displacement, grid, full=full)

    @property
    def vorticity(self) -> NDArray[np.float64]:
        """Vorticity at the nodes of the score grid [1/s], shape [x node, y node]."""
        return self.fields.vorticity / self.recording.size.frame_interval


class Recording:
    """A scenario whose frames are read one at a time."""

    def __init__(
        self,
        identity: Mapping[str, Any],
        parameters: Mapping[str, Any],
        frames: int,
        variables: set[str],
        read: Read,
        registry: Registry,
    ) -> None:
        """Read what holds for all frames."""
        self.size: Size = registry.size(str(identity["split"]), str(identity["size"]))
        self.title = registry.split(self.size.split).title  # title of the split
        self.scenario = int(identity["scenario"])  # id
        self.parameters = parameters  # physical parameters by name
        self.frames = frames  # recorded frames
        self._read = read
        self._present = np.isfinite(read("position", 0)).all(axis=-1)
        # [particle]
        self.material = read("material", slice(None))[self._present].astype(np.int8)
        # [length/s], [frame, wall, 2]; zeros without walls
        self.wall_velocity = np.zeros((frames, 4, 2))
        if "wall_velocity" in variables:
            self.wall_velocity[:] = read("wall_velocity", slice(frames))
        self._mass = float(read("particle_mass", slice(None)))

    @property
    def particles(self) -> int:
        """Particles in every frame."""
        return len(self.material)

    @property
    def area(self) -> float:
        """Area that the material covers at first [length^2]."""
        return self._mass * self.particles / float(self.size.value("density"))

    @property
    def spacing(self) -> float:
        """Mean distance of neighbouring particles at first [length]."""
        return float(np.sqrt(self.area / self.particles))

    @property
    def reynolds(self) -> float | None:
        """Reynolds number, None where there is none."""
        value = self.parameters.get("reynolds_number")
        if value is None:
            return None
        return float(value)

    def frame_number(self, frame: int) -> int:
        """Return an absolute frame number; negative ones count from the end."""
        got: object = frame
        try:
            frame = operator.index(frame)
        except TypeError:
            what = "a frame is named by a whole number"
            got = repr(frame)
        else:
            if -self.frames <= frame < self.frames:
                return frame % self.frames
            what = f"no frame {frame}"
            got = frame
        expected = f"0 to {self.frames - 1}"
        raise UsageError(
            what, where=f"scenario {self.scenario}", expected=expected, got=got
        )

    def scene(self, frame: int) -> Scene:
        """Return one frame; negative numbers count from the end."""
        number = self.frame_number(frame)
        position = self._particles("position", number)
        velocity = self._particles("velocity", number)
        if number:
            before = self._particles("position", number - 1)
        else:
            before = None
        if before is None:
            displacement = velocity * self.size.frame_interval
        else:
            displacement = position - before
        return Scene(self, number, position, velocity, displacement)

    def _particles(self, name: str, frame: int) -> NDArray[np.float64]:
        return self._read(name, frame)[self._present].astype(np.float64)


@contextmanager
def open_recording(
    source: str | Path | xr.Dataset, *, registry: Registry | None = None
) -> Iterator[Recording]:
    """Open a scenario file, or a data set of one scenario, for drawing."""
    if not isinstance(source, str | Path):
        yield _of_dataset(source, registry)
        return
    with read_scenario(Path(source)) as file:
        head = file.header
        identity = {
            "split": head.key.split,
            "size": head.key.size,
            "scenario": head.key.scenario,
        }
        splits = _beside(source, registry)
        yield Recording(
            identity, head.parameters, head.frames, {*file.variables}, file.read, splits
        )


def _beside(file: str | Path, registry: Registry | None) -> Registry:
    """Return a registry that also knows the local splits of the root of a scenario
    file.
    """
    parents = Path(file).absolute().parents  # the root is where `scenario_path` has it
    return load_rooted_registry(parents[min(4, len(parents) - 1)], registry)


def _of_dataset(data: xr.Dataset, registry: Registry | None) -> Recording:
    """Return the recording that a data set of one scenario holds."""
    if "scenario" in data.dims:
        got = f"a data set of {data.sizes['scenario']}"
        fix = "choose one: data.sel(scenario=3)"
        raise UsageError("a picture shows one scenario", got=got, fix=fix)
    attributes: dict[str, Any] = {str(k): v for k, v in data.attrs.items()}
    names = ("split", "size", "scenario")
    identity = {
        n: data.coords[n].item() if n in data.coords else attributes[n] for n in names
    }
    if "frame" in data.dims:
        held = data["frame"].values.tolist()
    else:
        held = []
    if "frame_count" in data:
        frames = int(data["frame_count"])
    else:
        frames = len(held)
    if not held or held != list(range(max(frames, len(held)))):
        raise UsageError(
            "a picture needs all frames of a scenario: a frame is called by its number",
            where="coordinate frame",
            expected=f"0, 1, 2, ... to {max(frames, len(held), 1) - 1}",
            got=f"{len(held)}: {', '.join(map(str, held[:3]))}, ..."
            if held
            else "no dimension frame",
            fix="choose a scenario only, data.sel(scenario=3), and say which "
            "frame to draw",
        )

    def read(name: str, frames: slice | int) -> NDArray[Any]:
        variable = data[name]
        return np.asarray(
            variable.isel(frame=frames) if "frame" in variable.dims else variable
        )

    # as xarray and open_split note where the data are from
    file = data.encoding.get("source")
    if isinstance(file, str | Path):
        splits = _beside(file, registry)
    else:
        splits = registry or load()
    return Recording(
        identity,
        attributes,
        frames,
        {str(name) for name in data.variables},
        read,
        splits,
    )
