"""Windows of scenarios as NumPy arrays: consecutive frames, in memory that the split's size leaves alone."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from itertools import accumulate
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lagbench.data.local import locate
from lagbench.data.registry import Registry
from lagbench.errors import UsageError

from .frames import CACHE_BYTES, FrameStore, sources_of

__all__ = [
    "Window",
    "WindowReader",
    "Windows",
    "window_of",
    "windows",
]


class Window(NamedTuple):
    """Consecutive frames of one scenario."""

    position: NDArray[np.float32]  # particle positions [length], shape [particle, frame, 2]
    material: NDArray[np.int8]  # 0 liquid, 1 jelly, 2 snow, 3 rope, shape [particle]
    # velocity of the walls [length/s], shape [frame, wall, 2]: what acts on the way to each frame, those to
    # predict included; None in a split without moving walls
    wall_velocity: NDArray[np.float32] | None
    scenario: int  # scenario id
    frame: int  # absolute number of the first frame


class WindowReader:
    """All windows of ``history + future`` consecutive frames of a data set's subsets, by number.

    Files are opened by the process that reads from them, at most 32 at a time; decompressed
    frames are kept up to `cache_bytes` in each process. Stored data are never changed: every
    window is a copy. `windows` says what the arguments are.
    """

    def __init__(
        self,
        split: str,
        *,
        subset: str | Sequence[str] = "train",
        size: str | None = None,
        root: str | Path | None = None,
        history: int | None = None,
        future: int = 1,
        registry: Registry | None = None,
        cache_bytes: int = CACHE_BYTES,
    ) -> None:
        entry, folder, _ = locate(split, size, root=root, registry=registry)
        names = (subset,) if isinstance(subset, str) else tuple(subset)
        sources = sources_of(entry, names, folder)
        self.size = entry  # what the registry publishes: bounds, task, parameters, statistics of train
        self.history = entry.task.input_frames if history is None else history  # frames that a model is given
        self.future = future  # frames after them
        self.length = self.history + future  # frames in a window
        self.scenarios = tuple(sources)
        self.frame_bytes = 8 * entry.particles
        counts = [max(0, source.frames - self.length + 1) for source in sources.values()]
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
        if not len(self):
            longest = max(source.frames for source in sources.values())
            raise UsageError(
                "no scenario is as long as a window",
                where=where,
                expected=f"at most {longest} frames",
                got=f"{self.length}: history {self.history}, future {future}",
                fix="ask for fewer frames",
            )
        self.store = FrameStore(sources, cache_bytes=cache_bytes)

    def __len__(self) -> int:
        """Return the number of windows."""
        return self.starts[-1]

    @property
    def gravity(self) -> float:
        """Downward acceleration [length/s^2]; 0 in a split that states none."""
        stated = self.size.parameters.get("gravity")
        return float(stated.value or 0.0) if stated else 0.0

    @property
    def viscosity(self) -> float | None:
        """Kinematic viscosity of the liquid [length^2/s]; None where scenarios differ: it is not given."""
        stated = self.size.parameters.get("liquid_viscosity")
        return None if stated is None or stated.value is None else float(stated.value)

    def place(self, index: int) -> tuple[int, int]:
        """Return scenario id and first frame of a window.

        Raises:
            IndexError: there is no such window.
        """
        if not -len(self) <= index < len(self):
            message = f"no window {index} among {len(self)}"
            raise IndexError(message)
        index %= len(self)
        row = bisect_right(self.starts, index) - 1
        return self.scenarios[row], index - self.starts[row]

    def read(self, index: int) -> Window:
        """Return a window as NumPy arrays of its own."""
        scenario, frame = self.place(index)
        frames = self.store.frames(scenario, frame, frame + self.length)
        material, walls = self.store.constants(scenario)
        part = None if walls is None else walls[frame : frame + self.length]
        return window_of(frames, material, part, scenario, frame)


class Windows(WindowReader):
    """Windows as NumPy arrays: ``len(data)``, ``data[i]``, ``for window in data``."""

    def __getitem__(self, index: int) -> Window:
        """Return a window."""
        return self.read(index)


def windows(
    split: str,
    *,
    subset: str | Sequence[str] = "train",
    size: str | None = None,
    root: str | Path | None = None,
    history: int | None = None,
    future: int = 1,
    registry: Registry | None = None,
    cache_bytes: int = CACHE_BYTES,
) -> Windows:
    """Open all windows of consecutive frames as NumPy arrays, without PyTorch.

    ``data[i]`` has ``position`` [length], float32, shape [particle, frame, 2]; ``material``, int8,
    shape [particle]; ``wall_velocity`` [length/s], float32, shape [frame, wall, 2], or None; the
    ids ``scenario`` and ``frame``. ``data.size`` holds what is published of the data set.
    `lagbench.torch.WindowDataset` gives the same windows as tensors.

    Args:
        split: name of the split, or path of a local split's folder.
        subset: train, valid, test or, for multimaterial, extra; or several of them.
        size: name of the size; the only one that is there when None.
        root: folder of all data sets; else LAGBENCH_ROOT, else the user data folder.
        history: frames that a model is given; those of the task by default.
        future: frames after them.
        registry: what describes the data set; ours by default.
        cache_bytes: frames kept decompressed [bytes]; with less, reading is slower, never different.

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
