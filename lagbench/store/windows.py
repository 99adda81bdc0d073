"""Windows of consecutive frames as NumPy arrays, in memory of bounded size."""

from __future__ import annotations

import operator
import os
from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import accumulate
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
from numpy.typing import NDArray

from lagbench.data.box import parse_obstacle
from lagbench.data.hdf5 import list_variables
from lagbench.data.layout import major_of
from lagbench.data.local import check_contents, locate, suggest_repair
from lagbench.data.registry import Registry, Size
from lagbench.data.scenario import (
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


class ScenarioHandle(NamedTuple):
    """An open file, with what all its windows share."""

    file: h5py.File
    position: h5py.Dataset
    # 0 liquid, 1 jelly, 2 snow, 3 rope, shape [particle]; 0 in files without it
    material: NDArray[np.int8]
    # velocity of the walls [length/s], shape [frame, wall, axis]; None without
    wall_velocity: Floats | None
    # acceleration of the fluid [length/s^2] in layers of equal height along y, lowest
    # first, shape [frame, layer, axis]; entry f acts from frame f-1 to frame f
    body_force: Floats | None
    viscosity: float | None  # kinematic viscosity that is given [length^2/s]
    obstacle: Floats | None  # centre and radius [length], shape [axis + 1]


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
        self._open_scenarios: OrderedDict[int, ScenarioHandle] = OrderedDict()
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
        opened = self.open(scenario)
        keys = [(scenario, frame) for frame in range(start, stop)]
        missing = [key[1] for key in keys if key not in self._cached_frames]
        if missing:
            with self._damage_errors(scenario):
                self._read(opened, scenario, missing[0], missing[-1] + 1)
        frames = []
        for key in keys:
            if key in self._cached_frames:
                self._cached_frames.move_to_end(key)
                frames.append(self._cached_frames[key])
        while self.cached_bytes > self.cache_bytes:
            _, oldest = self._cached_frames.popitem(last=False)
            self.cached_bytes -= oldest.nbytes
        return frames

    def _read(
        self, opened: ScenarioHandle, scenario: int, start: int, stop: int
    ) -> None:
        """Put consecutive frames into the cache."""
        for frame, positions in enumerate(opened.position[start:stop], start=start):
            if (scenario, frame) not in self._cached_frames:
                # A copy, so that its memory is free when it leaves the cache.
                self._cached_frames[scenario, frame] = positions.copy()
                self.cached_bytes += positions.nbytes

    def open(self, scenario: int) -> ScenarioHandle:
        """Return an open file; of too many the least recently used is closed."""
        if os.getpid() != self._process:
            self._reset()  # HDF5 handles do not survive a fork
        if scenario not in self._open_scenarios:
            with self._damage_errors(scenario):
                self._open_scenarios[scenario] = self._open_checked(scenario)
            if len(self._open_scenarios) > OPEN_FILES:
                _, oldest = self._open_scenarios.popitem(last=False)
                oldest.file.close()
        self._open_scenarios.move_to_end(scenario)
        return self._open_scenarios[scenario]

    def _open_checked(self, scenario: int) -> ScenarioHandle:
        """Open a file; refuse one of another scenario, version or content."""
        path = self._paths[scenario]
        if not path.is_file():
            raise DataError(
                f"a scenario file is missing; {self._repair_hint(scenario)}",
                where=str(path),
            )
        # Frames are cached here: HDF5 need not keep chunks too.
        file = h5py.File(path, "r", rdcc_nbytes=0)
        variables = list_variables(file)
        position = variables["position"]
        try:
            self._check_file(file, position, scenario)
        except DataError:
            file.close()
            raise
        arrays: dict[str, Any] = {}
        for name in ("material", "wall_velocity", "body_force"):
            arrays[name] = variables[name][...] if name in variables else None
        if arrays["material"] is None:
            arrays["material"] = np.zeros(position.shape[1], np.int8)
        parameters = select_parameters(file.attrs, where=str(path))
        stated = parse_viscosity(parameters.get("viscosity"), where=str(path))
        return ScenarioHandle(
            file,
            position,
            **arrays,
            viscosity=self._size.viscosity(stated),
            obstacle=parse_obstacle(parameters, self._size.dimension, where=str(path)),
        )

    def _check_file(
        self, file: h5py.File, position: h5py.Dataset, scenario: int
    ) -> None:
        """Refuse a file of another scenario, version, content or kind."""
        size = self._size
        where = str(self._paths[scenario])
        has_axes = position.ndim == 3 and position.shape[2] == size.dimension
        if position.dtype != np.float32 or not has_axes or not position.size:
            raise DataError(
                f"the file is damaged: position is {position.dtype}, shape "
                f"{position.shape}; {self._repair_hint(scenario)}",
                where=where,
            )
        texts = {}
        for name in ("split", "size", "version", "content_sha256"):
            value = file.attrs[name]
            # netCDF4 stores ASCII text as bytes
            texts[name] = value.decode() if isinstance(value, bytes) else str(value)
        stated = (
            texts["split"],
            texts["size"],
            major_of(texts["version"]),
            *np.ravel(file.attrs["scenario"]).tolist(),
            len(position),
        )
        frames = size.frame_count(scenario)
        expected = (size.split, size.name, size.major, scenario, frames)
        content_hash = texts["content_sha256"]
        recorded_hash = size.registered_hash(scenario)
        if stated != expected or not content_hash.startswith(recorded_hash):
            raise DataError(
                f"a scenario file is not that of the registry: got {stated}, content "
                f"hash {content_hash[:16]}, expected (split, size, version, id, "
                f"frames) = {expected}, content hash {recorded_hash or 'any'}; "
                f"{self._repair_hint(scenario)}",
                where=where,
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


class Window(NamedTuple):
    """Consecutive frames of one scenario."""

    # particle positions [length], shape [particle, frame, axis]
    position: NDArray[np.float32]
    # 0 liquid, 1 jelly, 2 snow, 3 rope, 4 wall, shape [particle]
    material: NDArray[np.int8]
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
        if not len(self):
            raise UsageError(
                f"no scenario is as long as a window of {self.history} + {future} "
                f"frames: the longest has {max(frame_counts, default=0)}; ask for "
                "fewer frames",
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
        return (
            f"<{type(self).__name__}: data set {self.size.split} {self.size.name}, "
            f"subsets {'+'.join(self.subsets)}, scenarios {len(self.scenarios)}, "
            f"windows {len(self)}, frames {self.history} given + {self.future} to "
            f"predict, particles {self.size.particles}>"
        )

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
        opened = self.store.open(scenario)
        walls = opened.wall_velocity
        if walls is not None:
            walls = walls[frame:end]
        force = opened.body_force
        obstacle = opened.obstacle
        origin = None
        if self.origin:
            (first_frame,) = self.store.frames(scenario, 0, 1)
            origin = first_frame.copy()
        window = copy_window(frames, opened.material, walls, scenario, frame)
        return window._replace(
            viscosity=opened.viscosity,
            body_force=None if force is None else force[frame:end].copy(),
            obstacle=None if obstacle is None else obstacle.copy(),
            origin=origin,
        )


class Windows(WindowReader):
    """All windows of consecutive frames as NumPy arrays, without PyTorch.

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

    def __getitem__(self, index: int) -> Window:
        """Return a window."""
        return self.read(index)


windows = Windows


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
