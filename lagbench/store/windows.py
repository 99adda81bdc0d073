"""Windows of consecutive frames as NumPy arrays, in memory of bounded size."""

from __future__ import annotations

import operator
import os
from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from html import escape
from itertools import accumulate
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
from numpy.typing import NDArray

from lagbench.data.box import parse_obstacle
from lagbench.data.hdf5 import list_variables
from lagbench.data.layout import has_file, major_of
from lagbench.data.local import check_contents, locate, suggest_repair
from lagbench.data.registry import Registry, Size
from lagbench.data.scenario import (
    damage_error,
    parse_viscosity,
    reading_error,
    select_parameters,
)
from lagbench.data.summary import summarise_arrays
from lagbench.errors import DataError, LagbenchError, UsageError

from .copy import scenario_files

Floats = NDArray[np.float32]

CACHE_BYTES = 256 << 20
"""Frames kept decompressed, by default [bytes]."""

OPEN_FILES = 128
"""Files that a store keeps open, about 0.6 MB each; our splits train on up to 63."""


class _OpenScenario(NamedTuple):
    """An open file, with the arrays that all its windows share."""

    file: h5py.File
    position: h5py.Dataset
    material: NDArray[np.int8]
    wall_velocity: Floats | None
    body_force: Floats | None
    viscosity: float | None
    obstacle: Floats | None


class _Identity(NamedTuple):
    """Names and length of a scenario."""

    split: str
    size: str
    major: int
    scenario: int
    frames: int


class FrameStore:
    """Read frames of scenario files; the last used frames stay in memory.

    Files are opened by the process that reads them and never written, so a store may be
    sent to worker processes: each has a cache of its own.

    Args:
        size: the data set.
        paths: files by scenario id.
        cache_bytes: most memory for decompressed frames [bytes].
    """

    def __init__(
        self, size: Size, paths: Mapping[int, Path], *, cache_bytes: float = CACHE_BYTES
    ) -> None:
        self._size = size
        self._paths = dict(paths)
        self.cache_bytes = cache_bytes
        self._reset()

    def _reset(self) -> None:
        self._process = os.getpid()
        # least recently used first
        self._open_scenarios: OrderedDict[int, _OpenScenario] = OrderedDict()
        self._cached_frames: OrderedDict[tuple[int, int], Floats] = OrderedDict()
        self.cached_bytes = 0

    def __getstate__(self) -> dict[str, Any]:
        """Leave open files and cached frames behind when sent to another process."""
        return {
            "size": self._size,
            "paths": self._paths,
            "cache_bytes": self.cache_bytes,
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Start with nothing open and nothing cached."""
        self.__init__(**state)  # type: ignore[misc]

    def frames(self, scenario: int, start: int, stop: int) -> list[Floats]:
        """Return positions of consecutive frames [length], each [particle, axis].

        The arrays are those of the cache: copy them, never write to them.
        """
        self._reset_after_fork()
        values = {}
        missing = []
        for frame in range(start, stop):
            cached = self._cached_frames.get((scenario, frame))
            if cached is None:
                missing.append(frame)
            else:
                values[frame] = cached
        for first, last in _consecutive_runs(missing):
            values.update(self._read(scenario, first, last))

        frames = []
        for frame in range(start, stop):
            if frame in values:
                frames.append(values[frame])
        for frame, positions in sorted(values.items()):
            self._cache(scenario, frame, positions)
        while self.cached_bytes > self.cache_bytes:
            _, oldest = self._cached_frames.popitem(last=False)
            self.cached_bytes -= oldest.nbytes
        return frames

    def _cache(self, scenario: int, frame: int, positions: Floats) -> None:
        """Keep a frame as the last used one."""
        key = (scenario, frame)
        if key not in self._cached_frames:
            self._cached_frames[key] = positions
            self.cached_bytes += positions.nbytes
        self._cached_frames.move_to_end(key)

    def material_and_walls(
        self, scenario: int
    ) -> tuple[NDArray[np.int8], Floats | None]:
        """Return the material of each particle, and the walls' velocity in each frame.

        Material has the shape [particle] and is 0, liquid, in files without it. Wall
        velocity [length/s] has the shape [frame, wall, axis]; it is None where the
        files hold none.
        """
        self._reset_after_fork()
        opened = self._open(scenario)
        return opened.material, opened.wall_velocity

    def body_force(self, scenario: int) -> Floats | None:
        """Return the force that drives the flow [length/s^2], if one does.

        It is the acceleration of the fluid in layers of equal height along y, lowest
        first, shape [frame, layer, axis]. Entry f acts from frame f-1 to frame f.
        """
        self._reset_after_fork()
        return self._open(scenario).body_force

    def viscosity(self, scenario: int) -> float | None:
        """Return the kinematic viscosity that is given [length^2/s], if one is."""
        self._reset_after_fork()
        return self._open(scenario).viscosity

    def obstacle(self, scenario: int) -> Floats | None:
        """Return centre and radius of the fixed obstacle [length], if there is one.

        The shape is [axis + 1].
        """
        self._reset_after_fork()
        return self._open(scenario).obstacle

    def _reset_after_fork(self) -> None:
        """Reopen files after a fork: HDF5 handles do not survive one."""
        if os.getpid() != self._process:
            self._reset()

    def _read(
        self, scenario: int, first: int, last: int
    ) -> Iterator[tuple[int, Floats]]:
        """Yield numbers and positions of the frames from the first to the last."""
        with self._damage_errors(scenario):
            values = self._open(scenario).position[first : last + 1]
        for frame, positions in enumerate(values, start=first):
            # A copy, so that each frame's memory is free when it leaves the cache.
            yield frame, positions.copy()

    def _open(self, scenario: int) -> _OpenScenario:
        """Return an open file; of too many the least recently used is closed."""
        if scenario not in self._open_scenarios:
            with self._damage_errors(scenario):
                self._open_scenarios[scenario] = self._open_checked(scenario)
            if len(self._open_scenarios) > OPEN_FILES:
                _, oldest = self._open_scenarios.popitem(last=False)
                oldest.file.close()
        self._open_scenarios.move_to_end(scenario)
        return self._open_scenarios[scenario]

    def _open_checked(self, scenario: int) -> _OpenScenario:
        """Open a file; refuse one of another scenario, version or content."""
        path = self._paths[scenario]
        if not has_file(path):
            raise DataError(
                f"a scenario file is missing; {self._repair_hint(scenario)}",
                where=str(path),
            )
        # Frames are cached here: HDF5 need not keep chunks too.
        file = h5py.File(path, "r", rdcc_nbytes=0)
        variables = list_variables(file)
        position = variables["position"]
        try:
            self._check_positions(position, scenario)
            self._check_identity(file, scenario, frames=len(position))
        except DataError:
            file.close()
            raise
        material = np.zeros(position.shape[1], np.int8)
        if "material" in variables:
            material = variables["material"][...]
        wall_velocity = None
        if "wall_velocity" in variables:
            wall_velocity = variables["wall_velocity"][...]
        body_force = None
        if "body_force" in variables:
            body_force = variables["body_force"][...]
        parameters = select_parameters(file.attrs, where=str(path))
        stated = parse_viscosity(parameters.get("viscosity"), where=str(path))
        viscosity = self._size.viscosity(stated)
        obstacle = parse_obstacle(parameters, self._size.dimension, where=str(path))
        return _OpenScenario(
            file, position, material, wall_velocity, body_force, viscosity, obstacle
        )

    def _check_positions(self, position: h5py.Dataset, scenario: int) -> None:
        """Refuse positions that are not float32, are empty, or have other axes than
        the box.
        """
        has_axes = position.ndim == 3 and position.shape[2] == self._size.dimension
        if position.dtype == np.float32 and has_axes and position.size:
            return
        raise damage_error(
            self._paths[scenario],
            f"{position.dtype}, shape {position.shape}",
            "position",
            fix=self._repair_hint(scenario),
        )

    def _check_identity(self, file: h5py.File, scenario: int, *, frames: int) -> None:
        """Refuse a file of another scenario, version or content."""
        size = self._size
        stated = _Identity(
            split=_read_text(file, "split"),
            size=_read_text(file, "size"),
            major=major_of(_read_text(file, "version")),
            scenario=self._read_id(file, scenario),
            frames=frames,
        )
        expected = _Identity(
            split=size.split,
            size=size.name,
            major=size.major,
            scenario=scenario,
            frames=size.frame_count(scenario),
        )
        content_hash = _read_text(file, "content_sha256")
        recorded_hash = size.registered_hash(scenario)
        if stated != expected or not content_hash.startswith(recorded_hash):
            raise DataError(
                f"a scenario file is not that of the registry: got {tuple(stated)}, "
                f"content hash {content_hash[:16]}, expected (split, size, version, "
                f"id, frames) = {tuple(expected)}, content hash "
                f"{recorded_hash or 'any'}; {self._repair_hint(scenario)}",
                where=str(self._paths[scenario]),
            )

    def _read_id(self, file: h5py.File, scenario: int) -> int:
        """Return the id that a file states; refuse what is no whole number."""
        value = np.asarray(file.attrs["scenario"])
        if value.size == 1 and value.dtype.kind in "iu":
            return int(value.item())
        raise damage_error(
            self._paths[scenario],
            f"attribute scenario = {ascii(value.tolist())[:80]}",
            fix=self._repair_hint(scenario),
        )

    @contextmanager
    def _damage_errors(self, scenario: int) -> Iterator[None]:
        """Turn whatever HDF5 raises on damaged bytes into a DataError with the path."""
        path = self._paths[scenario]
        try:
            yield
        except LagbenchError:
            raise
        except Exception as error:
            hint = self._repair_hint(scenario)
            raise reading_error(path, error, fix=hint) from error

    def _repair_hint(self, scenario: int) -> str:
        root = self._paths[scenario].parents[4]
        subset = self._size.subset_of(scenario)
        return suggest_repair(self._size, f"--subset {subset}", root=root)


def _consecutive_runs(numbers: Sequence[int]) -> list[tuple[int, int]]:
    """Return first and last number of each run of consecutive ascending numbers."""
    runs: list[tuple[int, int]] = []
    for number in numbers:
        if runs and runs[-1][1] == number - 1:
            runs[-1] = (runs[-1][0], number)
        else:
            runs.append((number, number))
    return runs


def _read_text(file: h5py.File, name: str) -> str:
    """Return an attribute as text; netCDF4 stores ASCII text as bytes."""
    value = file.attrs[name]
    if isinstance(value, bytes):
        return value.decode()
    return str(value)


class Window(NamedTuple):
    """Consecutive frames of one scenario."""

    # particle positions [length], shape [particle, frame, axis]
    position: NDArray[np.float32]
    material: NDArray[np.int8]  # 0 liquid, 1 jelly, 2 snow, 3 rope, shape [particle]
    # velocity of the walls [length/s], shape [frame, wall, axis]: the forcing on the
    # way to each frame, those to predict included; None in a split without moving walls
    wall_velocity: NDArray[np.float32] | None
    scenario: int  # scenario id
    frame: int  # absolute number of the first frame
    # particle positions in the scenario's first frame [length], shape [particle, axis];
    # None unless asked for
    origin: NDArray[np.float32] | None = None
    # kinematic viscosity [length^2/s]: the scenario's, else that of the data set; None
    # where none is known
    viscosity: float | None = None
    # acceleration of the fluid [length/s^2] in layers of equal height along y, lowest
    # first, on the way to each frame, those to predict included, shape [frame, layer,
    # axis]; None where no force drives the flow
    body_force: NDArray[np.float32] | None = None
    # centre and radius of a fixed obstacle [length], shape [axis + 1]; None without one
    obstacle: NDArray[np.float32] | None = None

    def __repr__(self) -> str:
        """Return the names and shapes of what the window holds."""
        return summarise_arrays("Window", self._asdict())


def _check_bytes(value: float, name: str) -> None:
    """Refuse a size of memory below 0; infinity is one.

    Raises:
        UsageError: it is below 0 or no number.
    """
    if value >= 0:
        return
    raise UsageError(
        f"{name} is no number from 0: {repr(value)[:80]}; give bytes, as in "
        f"{name}=1e9, or leave {name} out",
        where=name,
    )


class WindowReader:
    """All windows of ``history + future`` consecutive frames, by number.

    Files are opened by the process that reads from them, at most 128 at a time;
    decompressed frames are kept up to `cache_bytes` in each process. Stored data are
    never changed: every window is a copy. See `windows` for the arguments.

    Where ``verify`` is false, a file counts for what it states: split, version, length
    and content hash are compared, its values are not hashed.
    """

    def __init__(
        self,
        split: str | Path,
        size: str | None = None,
        *,
        subset: str | Sequence[str] = "train",
        root: str | Path | None = None,
        history: int | None = None,
        future: int = 1,
        registry: Registry | None = None,
        cache_bytes: float = CACHE_BYTES,
        origin: bool = False,
        verify: bool = False,
    ) -> None:
        _check_bytes(cache_bytes, "cache_bytes")
        tier, root_folder, _ = locate(split, size, root=root, registry=registry)
        if isinstance(subset, str):
            subset = (subset,)
        subsets = tuple(subset)
        paths = scenario_files(tier, root_folder, subsets)
        # what the registry publishes: bounds, task, parameters, statistics of train
        self.size = tier
        if history is None:
            history = tier.task.input_frames
        self.history = history  # given frames of a model
        self.future = future  # frames after them
        self.length = history + future  # frames in a window
        self.subsets = subsets  # names of the subsets
        self.origin = origin  # whether windows hold the scenario's first frame too
        self.scenarios = tuple(paths)
        # float32 for every component
        self.frame_bytes = 4 * tier.dimension * tier.particles
        frame_counts = [tier.frame_count(scenario) for scenario in paths]
        window_counts = [max(0, count - self.length + 1) for count in frame_counts]
        # number of the first window of each scenario, and the number of all windows
        self.starts = (0, *accumulate(window_counts))

        where = f"{split} {tier.name}, {', '.join(subsets)}"
        if self.history < 1 or future < 0:
            raise UsageError(
                f"a window has at least one given frame: history {self.history}, "
                f"future {future}; leave history out for the task's "
                f"{tier.task.input_frames}",
                where=where,
            )
        if not frame_counts:
            raise UsageError(
                "no windows can be read like that: 0 scenarios; name a subset, as in "
                "subset='train'",
                where=where,
            )
        if not len(self):
            raise UsageError(
                f"no scenario is as long as a window: got {self.length}: history "
                f"{self.history}, future {future}, expected at most "
                f"{max(frame_counts)} frames; ask for fewer frames",
                where=where,
            )
        if verify:
            check_contents(tier, root_folder, paths)
        self.store = FrameStore(tier, paths, cache_bytes=cache_bytes)

    def __len__(self) -> int:
        """Return the number of windows."""
        return self.starts[-1]

    def __repr__(self) -> str:
        """Return data set, subsets, number and length of the windows."""
        facts = ", ".join(f"{name} {value}" for name, value in self._facts.items())
        return f"<{type(self).__name__}: {facts}>"

    def _repr_html_(self) -> str:
        """Return the same as a table, for notebooks; escaped."""
        rows = []
        for name, value in self._facts.items():
            rows.append(f"<tr><th>{escape(name)}</th><td>{escape(value)}</td></tr>")
        caption = escape(type(self).__name__)
        return f"<table><caption>{caption}</caption>{''.join(rows)}</table>"

    @property
    def _facts(self) -> dict[str, str]:
        """What the windows are, by name."""
        return {
            "data set": f"{self.size.split} {self.size.name}",
            "subsets": "+".join(self.subsets),
            "scenarios": str(len(self.scenarios)),
            "windows": str(len(self)),
            "frames": f"{self.history} given + {self.future} to predict",
            "particles": str(self.size.particles),
        }

    @property
    def gravity(self) -> float:
        """Downward acceleration [length/s^2]; 0 in a split that states none."""
        gravity = self.size.parameters.get("gravity")
        if gravity is None:
            return 0.0
        return float(gravity.value or 0.0)

    @property
    def viscosity(self) -> float | None:
        """Kinematic viscosity of all scenarios [length^2/s].

        None where scenarios differ: each window has its own.
        """
        return self.size.viscosity()

    def place(self, index: int) -> tuple[int, int]:
        """Return scenario id and first frame of a window.

        Negative numbers count from the end.

        Raises:
            IndexError: there is no such window.
        """
        index = operator.index(index)
        if not -len(self) <= index < len(self):
            raise IndexError(f"no window {index} among {len(self)}")
        index %= len(self)
        row = bisect_right(self.starts, index) - 1
        return self.scenarios[row], index - self.starts[row]

    def read(self, index: int) -> Window:
        """Return a window as NumPy arrays of its own."""
        scenario, frame = self.place(index)
        end = frame + self.length
        frames = self.store.frames(scenario, frame, end)
        material, walls = self.store.material_and_walls(scenario)
        if walls is not None:
            walls = walls[frame:end]
        window = copy_window(frames, material, walls, scenario, frame)
        viscosity = self.store.viscosity(scenario)
        window = window._replace(viscosity=viscosity)
        force = self.store.body_force(scenario)
        if force is not None:
            shown_force = force[frame:end].copy()
            window = window._replace(body_force=shown_force)
        obstacle = self.store.obstacle(scenario)
        if obstacle is not None:
            window = window._replace(obstacle=obstacle.copy())
        if not self.origin:
            return window
        (first_frame,) = self.store.frames(scenario, 0, 1)
        return window._replace(origin=first_frame.copy())


class Windows(WindowReader):
    """Windows as NumPy arrays: ``len(data)``, ``data[i]``, ``for window in data``."""

    def __getitem__(self, index: int) -> Window:
        """Return a window."""
        return self.read(index)


def windows(
    split: str | Path,
    size: str | None = None,
    *,
    subset: str | Sequence[str] = "train",
    root: str | Path | None = None,
    history: int | None = None,
    future: int = 1,
    registry: Registry | None = None,
    cache_bytes: float = CACHE_BYTES,
    origin: bool = False,
    verify: bool = False,
) -> Windows:
    """Open all windows of consecutive frames as NumPy arrays, without PyTorch.

    ``data[i]`` has ``position`` [length], float32, shape [particle, frame, axis];
    ``material``, int8, shape [particle]; ``wall_velocity`` [length/s], float32, shape
    [frame, wall, axis], or None; the ids ``scenario`` and ``frame``; ``viscosity``
    [length^2/s]; ``body_force`` [length/s^2], float32, shape [frame, layer, axis], or
    None; ``obstacle``, centre and radius [length], float32, shape [axis + 1], or None.
    ``data.size`` is the description of the data set.
    `lagbench.torch.WindowDataset` gives the same windows as tensors.

    Args:
        split: name of the split, or path of a local split's folder.
        size: name of the size; None takes the only one with data, or mini where several
            have data.
        subset: train, valid or test, also shift or extra where the split has it; or
            several of them.
        root: folder of all data sets; else LAGBENCH_ROOT, else the user data folder.
        history: given frames of the model; those of the task by default.
        future: frames after them.
        registry: description of the data sets; ours by default.
        cache_bytes: frames kept decompressed [bytes]; with less, reading is slower,
            never different.
        origin: whether windows hold the positions in the scenario's first frame too, as
            ``origin``.
        verify: whether the values of all files are hashed first and compared with the
            recorded content hashes. Takes seconds per gigabyte; a file that this
            machine has hashed before is only read.

    Raises:
        UsageError: unknown split, size or subset, or no scenario is long enough.
        DataError: scenarios are missing; the message has the command that makes them.
            Or a file is damaged, and `verify` is true.
    """
    return Windows(
        split,
        subset=subset,
        size=size,
        root=root,
        history=history,
        future=future,
        registry=registry,
        cache_bytes=cache_bytes,
        origin=origin,
        verify=verify,
    )


def copy_window(
    frames: Sequence[NDArray[np.float32]],
    material: NDArray[np.int8],
    walls: NDArray[np.float32] | None,
    scenario: int,
    frame: int,
) -> Window:
    """Return a window with copies of frames, each of shape [particle, axis].

    The caller adds viscosity, force and obstacle.
    """
    dimension = frames[0].shape[1]
    if dimension == 2:
        # x and y of a particle travel as one number of 8 bytes: six times faster.
        numbers = [positions.view(np.int64)[:, 0] for positions in frames]
        pairs = np.stack(numbers, axis=1)
        position = pairs.view(np.float32).reshape(*pairs.shape, dimension)
    else:
        position = np.stack(frames, axis=1)
    wall_velocity = None
    if walls is not None:
        wall_velocity = walls.copy()
    return Window(
        position=position,
        material=material.copy(),
        wall_velocity=wall_velocity,
        scenario=scenario,
        frame=frame,
    )
