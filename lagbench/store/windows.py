"""Windows of scenarios as NumPy arrays: consecutive frames, in memory that the split's
size leaves alone.
"""

from __future__ import annotations

import errno
import operator
import os
from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import accumulate, groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lagbench.data.layout import major_of
from lagbench.data.local import locate, remedy
from lagbench.data.registry import Registry, Size
from lagbench.data.scenario import damaged
from lagbench.errors import DataError, LagbenchError, UsageError, WorkFailedError

from .copy import scenario_files

if TYPE_CHECKING:
    import h5py

Floats = NDArray[np.float32]

CACHE_BYTES = 256 << 20  # frames kept decompressed, by default [bytes]
# files that a store keeps open, about 0.6 MB each; our splits train on up to 63
OPEN_FILES = 128


class _Open(NamedTuple):
    """An open file with what is the same in all its windows."""

    file: h5py.File
    position: h5py.Dataset
    material: NDArray[np.int8]
    wall_velocity: Floats | None


class FrameStore:
    """Read frames of scenario files; those used last stay in memory, up to a fixed
    number of bytes.

    Files are opened by the process that reads them and never written, so a store may be
    sent to worker processes: each has a cache of its own.
    """

    def __init__(
        self, size: Size, paths: Mapping[int, Path], *, cache_bytes: int = CACHE_BYTES
    ) -> None:
        self._size = size
        self._paths = dict(paths)
        self.cache_bytes = cache_bytes
        self._forget()

    def _forget(self) -> None:
        self._process = os.getpid()
        self._open: OrderedDict[int, _Open] = OrderedDict()
        self._frames: OrderedDict[tuple[int, int], Floats] = OrderedDict()
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
        """Return positions of consecutive frames [length], each of shape [particle, 2].

        The arrays are those of the cache: copy them, never write to them.
        """
        self._own()
        found = {
            frame: self._frames.get((scenario, frame)) for frame in range(start, stop)
        }
        lacking = [frame for frame, values in found.items() if values is None]
        # Consecutive frames, which are equally far from their places in the list, are
        # read at once.
        for _, run in groupby(enumerate(lacking), lambda item: item[1] - item[0]):
            numbers = [frame for _, frame in run]
            found.update(self._read(scenario, numbers[0], numbers[-1] + 1))
        held = {frame: values for frame, values in found.items() if values is not None}
        for frame, values in held.items():
            if (scenario, frame) not in self._frames:
                self._frames[scenario, frame] = values
                self.cached_bytes += values.nbytes
            self._frames.move_to_end((scenario, frame))
        while self.cached_bytes > self.cache_bytes:
            self.cached_bytes -= self._frames.popitem(last=False)[1].nbytes
        return list(held.values())

    def constants(self, scenario: int) -> tuple[NDArray[np.int8], Floats | None]:
        """Return material, shape [particle], and wall velocity [length/s], [frame,
        wall, 2].

        Material is 0, liquid, in files without it; wall velocity is None where no wall
        moves.
        """
        self._own()
        return self._opened(scenario)[2:]

    def _own(self) -> None:
        """Reopen files after a fork: HDF5 handles do not survive one."""
        if os.getpid() != self._process:
            self._forget()

    def _read(
        self, scenario: int, first: int, last: int
    ) -> Iterator[tuple[int, Floats]]:
        with self._naming(scenario):
            values = self._opened(scenario).position[first:last]
        # Copies, so that each frame's memory is free when it leaves the cache.
        return ((first + i, frame.copy()) for i, frame in enumerate(values))

    def _opened(self, scenario: int) -> _Open:
        """Return an open file that is what the registry says; of too many the longest
        unused is closed.
        """
        if scenario not in self._open:
            with self._naming(scenario):
                self._open[scenario] = self._checked(scenario)
            if len(self._open) > OPEN_FILES:
                self._open.popitem(last=False)[1].file.close()
        self._open.move_to_end(scenario)
        return self._open[scenario]

    def _checked(self, scenario: int) -> _Open:
        """Open a file; refuse one of another scenario, version or content."""
        import h5py

        from lagbench.data.scenario import variables

        size = self._size
        path = self._paths[scenario]
        if not path.is_file():
            raise DataError(
                "a scenario file is missing",
                where=str(path),
                fix=self._remedy(scenario),
            )
        # Frames are cached here: HDF5 need not keep chunks too.
        file = h5py.File(path, "r", rdcc_nbytes=0)
        values = variables(file)
        held = file.attrs
        position = values["position"]
        # netCDF4 stores ASCII text as bytes.
        split, tier, version, content = (
            text.decode() if isinstance(text := held[name], bytes) else str(text)
            for name in ("split", "size", "version", "content_sha256")
        )
        found = (
            split,
            tier,
            major_of(version),
            int(np.asarray(held["scenario"]).item()),
            len(position),
        )
        expected = (
            size.split,
            size.name,
            size.major,
            scenario,
            size.frame_count(scenario),
        )
        if size.measured:
            digest = size.measured.scenario_sha256.get(scenario, "")
        else:
            digest = ""
        if found != expected or not content.startswith(digest):
            file.close()
            raise DataError(
                "a scenario file is not that of the registry",
                where=str(path),
                expected=f"(split, size, version, id, frames) = {expected}, content "
                f"hash {digest or 'any'}",
                got=f"{found}, content hash {content[:16]}",
                fix=self._remedy(scenario),
            )
        material = values.get("material")
        walls = values.get("wall_velocity")
        if material is None:
            kinds = np.zeros(position.shape[1], np.int8)
        else:
            kinds = material[...]
        return _Open(file, position, kinds, None if walls is None else walls[...])

    @contextmanager
    def _naming(self, scenario: int) -> Iterator[None]:
        """Turn whatever HDF5 raises on damaged bytes into a DataError naming the
        file.
        """
        try:
            yield
        except LagbenchError:
            raise
        except (
            Exception
        ) as error:  # no list of types holds: damage surfaces as nearly any of them
            if isinstance(error, OSError) and error.errno in (
                errno.EMFILE,
                errno.ENFILE,
            ):
                raise WorkFailedError(
                    "the system opens no more files",
                    where=str(self._paths[scenario]),
                    got=f"{len(self._open)} scenario files are open",
                    fix="allow more, as by `ulimit -n 4096`, or open fewer data sets "
                    "at a time",
                ) from error
            got = f"{type(error).__name__}: {error}"
            fix = self._remedy(scenario)
            raise damaged(self._paths[scenario], got, fix=fix) from error

    def _remedy(self, scenario: int) -> str:
        root = self._paths[scenario].parents[4]
        return remedy(
            self._size, f"--subset {self._size.subset_of(scenario)}", root=root
        )


class Window(NamedTuple):
    """Consecutive frames of one scenario."""

    # particle positions [length], shape [particle, frame, 2]
    position: NDArray[np.float32]
    material: NDArray[np.int8]  # 0 liquid, 1 jelly, 2 snow, 3 rope, shape [particle]
    # velocity of the walls [length/s], shape [frame, wall, 2]: what acts on the way to
    # each frame, those to predict included; None in a split without moving walls
    wall_velocity: NDArray[np.float32] | None
    scenario: int  # scenario id
    frame: int  # absolute number of the first frame
    # particle positions in the scenario's first frame [length], shape [particle, 2];
    # None unless asked for
    origin: NDArray[np.float32] | None = None


class WindowReader:
    """All windows of ``history + future`` consecutive frames of a data set's subsets,
    by number.

    Files are opened by the process that reads from them, at most 128 at a time;
    decompressed frames are kept up to `cache_bytes` in each process. Stored data are
    never changed: every window is a copy. `windows` says what the arguments are.
    """

    def __init__(
        self,
        split: str | Path,
        *,
        subset: str | Sequence[str] = "train",
        size: str | None = None,
        root: str | Path | None = None,
        history: int | None = None,
        future: int = 1,
        registry: Registry | None = None,
        cache_bytes: int = CACHE_BYTES,
        origin: bool = False,
    ) -> None:
        entry, folder, _ = locate(split, size, root=root, registry=registry)
        names = (subset,) if isinstance(subset, str) else tuple(subset)
        paths = scenario_files(entry, folder, names)
        # what the registry publishes: bounds, task, parameters, statistics of train
        self.size = entry
        # frames that a model is given
        self.history = entry.task.input_frames if history is None else history
        self.future = future  # frames after them
        self.length = self.history + future  # frames in a window
        self.origin = origin  # whether windows hold the scenario's first frame too
        self.scenarios = tuple(paths)
        self.frame_bytes = 8 * entry.particles
        frames = [entry.frame_count(i) for i in paths]
        counts = [max(0, count - self.length + 1) for count in frames]
        # number of the first window of each scenario, and the number of all windows
        self.starts = (0, *accumulate(counts))
        where = f"{split} {entry.name}, {', '.join(names)}"
        if self.history < 1 or future < 0:
            raise UsageError(
                "a window has at least one given frame",
                where=where,
                expected="history >= 1, future >= 0",
                got=f"history {self.history}, future {future}",
                fix=f"leave history out for the task's {entry.task.input_frames}",
            )
        if not frames or cache_bytes < 0:
            what = "no windows can be read like that"
            expected = "a subset at least, and cache_bytes >= 0"
            got = f"{len(frames)} scenarios, cache_bytes {cache_bytes}"
            raise UsageError(what, where=where, expected=expected, got=got)
        if not len(self):
            raise UsageError(
                "no scenario is as long as a window",
                where=where,
                expected=f"at most {max(frames)} frames",
                got=f"{self.length}: history {self.history}, future {future}",
                fix="ask for fewer frames",
            )
        self.store = FrameStore(entry, paths, cache_bytes=cache_bytes)

    def __len__(self) -> int:
        """Return the number of windows."""
        return self.starts[-1]

    @property
    def gravity(self) -> float:
        """Downward acceleration [length/s^2]; 0 in a split that states none."""
        stated = self.size.parameters.get("gravity")
        if stated:
            return float(stated.value or 0.0)
        return 0.0

    @property
    def viscosity(self) -> float | None:
        """Kinematic viscosity of the liquid [length^2/s]; None where scenarios differ:
        it is not given.
        """
        stated = self.size.parameters.get("liquid_viscosity")
        if stated is None or stated.value is None:
            return None
        return float(stated.value)

    def place(self, index: int) -> tuple[int, int]:
        """Return scenario id and first frame of a window."""
        index = operator.index(index)
        if not -len(self) <= index < len(self):
            raise IndexError(f"no window {index} among {len(self)}")
        index %= len(self)
        row = bisect_right(self.starts, index) - 1
        return self.scenarios[row], index - self.starts[row]

    def read(self, index: int) -> Window:
        """Return a window as NumPy arrays of its own."""
        scenario, frame = self.place(index)
        frames = self.store.frames(scenario, frame, frame + self.length)
        material, walls = self.store.constants(scenario)
        if walls is None:
            part = None
        else:
            part = walls[frame : frame + self.length]
        window = window_of(frames, material, part, scenario, frame)
        if not self.origin:
            return window
        return window._replace(origin=self.store.frames(scenario, 0, 1)[0].copy())


class Windows(WindowReader):
    """Windows as NumPy arrays: ``len(data)``, ``data[i]``, ``for window in data``."""

    def __getitem__(self, index: int) -> Window:
        """Return a window."""
        return self.read(index)


def windows(
    split: str | Path,
    *,
    subset: str | Sequence[str] = "train",
    size: str | None = None,
    root: str | Path | None = None,
    history: int | None = None,
    future: int = 1,
    registry: Registry | None = None,
    cache_bytes: int = CACHE_BYTES,
    origin: bool = False,
) -> Windows:
    """Open all windows of consecutive frames as NumPy arrays, without PyTorch.

    ``data[i]`` has ``position`` [length], float32, shape [particle, frame, 2];
    ``material``, int8, shape [particle]; ``wall_velocity`` [length/s], float32, shape
    [frame, wall, 2], or None; the ids ``scenario`` and ``frame``. ``data.size`` holds
    what is published of the data set. `lagbench.torch.WindowDataset` gives the same
    windows as tensors.

    Args:
        split: name of the split, or path of a local split's folder.
        subset: train, valid, test or, for multimaterial, extra; or several of them.
        size: name of the size; the only one that is there when None.
        root: folder of all data sets; else LAGBENCH_ROOT, else the user data folder.
        history: frames that a model is given; those of the task by default.
        future: frames after them.
        registry: what describes the data set; ours by default.
        cache_bytes: frames kept decompressed [bytes]; with less, reading is slower,
            never different.
        origin: whether windows hold the positions in the scenario's first frame too, as
            ``origin``.

    Raises:
        UsageError: unknown split, size or subset, or no scenario is long enough.
        DataError: scenarios are missing; the message has the command that makes them.
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
    )


def window_of(
    frames: Sequence[NDArray[np.float32]],
    material: NDArray[np.int8],
    walls: NDArray[np.float32] | None,
    scenario: int,
    frame: int,
) -> Window:
    """Copy frames, each of shape [particle, 2], to a window."""
    # x and y of a particle travel as one number of 8 bytes: six times faster.
    pairs = np.stack([xy.view(np.int64)[:, 0] for xy in frames], axis=1)
    return Window(
        pairs.view(np.float32).reshape(*pairs.shape, 2),
        material.copy(),
        None if walls is None else walls.copy(),
        scenario,
        frame,
    )
