"""Training windows: consecutive frames of every scenario, in memory that the split's size leaves alone.

data = WindowDataset("cavity", size="mini", history=6)
loader = DataLoader(data, 2, sampler=WindowSampler(data, seed=0), collate_fn=collate)
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from itertools import accumulate
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import Dataset

from lagbench.errors import UsageError
from lagbench.locating import locate
from lagbench.registry import Registry
from lagbench.scenario_file import read_scenario

from .batch import Batch
from .frame_store import CACHE_BYTES, FrameStore
from .sources import sources_of
from .window_sampler import WindowSampler

__all__ = ["Window", "WindowDataset", "WindowSampler", "collate", "scenario_batch", "scenario_paths"]


class Window(NamedTuple):
    """Consecutive frames of one scenario.

    Attributes:
        position: particle positions [length], float32, shape [particle, frame, 2].
        material: 0 liquid, 1 jelly, 2 snow, 3 rope, int64, shape [particle].
        wall_velocity: velocity of the walls [length/s], float32, shape [frame, wall, 2]; None in
            a split without moving walls.
        scenario: scenario id.
        frame: absolute number of the first frame.
    """

    position: Tensor
    material: Tensor
    wall_velocity: Tensor | None
    scenario: int
    frame: int


class WindowDataset(Dataset[Window]):
    """All windows of ``history + future`` consecutive frames of a data set's subsets.

    Files are opened by the process that reads from them, at most 32 at a time; decompressed
    frames are kept up to `cache_bytes` in each process. Stored data are never changed: every
    window is a copy.

    Args:
        split: name of the split, or path of a local split's folder.
        subset: train, valid, test or, for multimaterial, extra; or several of them.
        size: name of the size.
        root: folder of all data sets, see :func:`lagbench.layout.resolve_root`.
        history: frames that a model is given.
        future: frames after them.
        registry: what describes the data set; ours by default.
        cache_bytes: frames kept decompressed [bytes]; with less, reading is slower, never different.

    Attributes:
        length: frames in a window.
        starts: number of the first window of each scenario, and the number of all windows.

    Raises:
        UsageError: unknown split, size or subset, or no scenario is long enough.
        DataError: scenarios are missing; the message has the command that makes them.
    """

    def __init__(
        self,
        split: str,
        *,
        subset: str | Sequence[str] = "train",
        size: str = "full",
        root: str | Path | None = None,
        history: int,
        future: int = 1,
        registry: Registry | None = None,
        cache_bytes: int = CACHE_BYTES,
    ) -> None:
        entry, folder, _ = locate(split, size, root=root, registry=registry)
        names = (subset,) if isinstance(subset, str) else tuple(subset)
        sources = sources_of(entry, names, folder)
        self.length = history + future
        self.scenarios = tuple(sources)
        self.frame_bytes = 8 * entry.particles
        counts = [max(0, source.frames - self.length + 1) for source in sources.values()]
        self.starts = (0, *accumulate(counts))
        if history < 1 or future < 0 or not len(self):
            longest = max(source.frames for source in sources.values())
            raise UsageError(
                "no scenario holds a window",
                where=f"{split} {size}, {', '.join(names)}",
                expected=f"1 to {longest} frames, at least one of them given",
                got=f"history {history}, future {future}",
            )
        self._store = FrameStore(sources, cache_bytes=cache_bytes)

    def __len__(self) -> int:
        """Return the number of windows."""
        return self.starts[-1]

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

    def __getitem__(self, index: int) -> Window:
        """Return a window.

        Raises:
            IndexError: there is no such window.
            DataError: the file is damaged or not that of the registry.
        """
        scenario, frame = self.place(index)
        frames = self._store.frames(scenario, frame, frame + self.length)
        material, walls = self._store.constants(scenario)
        return _window(
            frames, material, None if walls is None else walls[frame:][: self.length], scenario, frame
        )


def collate(windows: Sequence[Window]) -> Batch:
    """Put windows side by side.

    Raises:
        UsageError: no window, windows of unequal lengths, or only some with moving walls.
    """
    walls = [window.wall_velocity for window in windows if window.wall_velocity is not None]
    frames = {window.position.shape[1] for window in windows}
    if len(frames) != 1 or len(walls) not in (0, len(windows)):
        raise UsageError(
            "windows do not fit side by side",
            where="collate",
            expected="windows of one split and one length",
            got=f"lengths {sorted(frames)}, {len(walls)} of {len(windows)} with moving walls",
        )
    particles = torch.tensor([len(window.material) for window in windows])
    return Batch(
        position=torch.cat([window.position for window in windows]),
        sample=torch.arange(len(windows)).repeat_interleave(particles),
        material=torch.cat([window.material for window in windows]),
        wall_velocity=torch.stack(walls) if walls else None,
        scenario=torch.tensor([window.scenario for window in windows]),
        frame=torch.tensor([window.frame for window in windows]),
    )


def scenario_batch(paths: Path | Sequence[Path], frames: slice = slice(None)) -> Batch:
    """Return the same frames of one or several whole scenarios, for rollouts and validation.

    Args:
        paths: scenario files, see :func:`scenario_paths`.
        frames: consecutive frames, all by default.

    Raises:
        DataError: a file is missing or damaged.
        UsageError: the scenarios have unequal numbers of these frames.
    """
    return collate([_read(path, frames) for path in ([paths] if isinstance(paths, Path) else paths)])


def scenario_paths(
    split: str,
    *,
    subset: str = "test",
    size: str = "full",
    root: str | Path | None = None,
    registry: Registry | None = None,
) -> dict[int, Path]:
    """Return the files of a subset by scenario id; all of them exist.

    Raises:
        UsageError: unknown split, size or subset.
        DataError: scenarios are missing; the message has the command that makes them.
    """
    entry, folder, _ = locate(split, size, root=root, registry=registry)
    return {i: source.path for i, source in sources_of(entry, (subset,), folder).items()}


def _read(path: Path, frames: slice) -> Window:
    """Read frames of one file without a cache."""
    with read_scenario(path) as file:
        numbers = range(file.header.frames)[frames]
        if not numbers or numbers.step != 1:
            raise UsageError(
                "no consecutive frames",
                where=str(path),
                expected=f"frames of 0:{file.header.frames}",
                got=frames,
            )
        run = slice(numbers.start, numbers.stop)
        held = file.variables
        position = file.read("position", run)
        material = file.read("material") if "material" in held else np.zeros(position.shape[1], np.int8)
        walls = file.read("wall_velocity", run) if "wall_velocity" in held else None
        return _window(list(position), material, walls, file.header.key.scenario, numbers.start)


def _window(
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
        torch.from_numpy(pairs.view(np.float32).reshape(*pairs.shape, 2)),
        torch.from_numpy(material.astype(np.int64)),
        None if walls is None else torch.from_numpy(walls.copy()),
        scenario,
        frame,
    )
