"""Training windows: consecutive frames of every scenario, in memory that the split's size leaves alone.

data = WindowDataset("cavity", size="mini", history=6)
loader = DataLoader(data, 2, sampler=WindowSampler(data, seed=0), collate_fn=collate)

The order in which training windows are drawn: seeded, resumable, shared out among ranks.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator, Mapping, Sequence
from itertools import accumulate
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import Dataset, Sampler

from lagbench.data.local import locate
from lagbench.data.registry import Registry
from lagbench.data.scenario import read_scenario
from lagbench.errors import UsageError

from .baseline import Batch
from .frame_store import CACHE_BYTES, FrameStore, sources_of

__all__ = [
    "POOL_BYTES",
    "RUN",
    "WindowSampler",
    "Window",
    "WindowDataset",
    "collate",
    "scenario_batch",
    "scenario_paths",
]


RUN = 32
"""Windows that follow each other in a scenario and are drawn from one pool, to share their frames."""

POOL_BYTES = CACHE_BYTES
"""Frames of the windows that are shuffled together [bytes]."""


class WindowSampler(Sampler[int]):
    """Draw every window once an epoch, in an order that follows from seed and epoch alone.

    Windows of one scenario that follow each other are cut into runs of 32. An epoch is a random
    order of all runs, taken in pools whose frames fill 256 MiB; the windows of a pool are shuffled.
    So a frame is decompressed about once, not once for each window that holds it; where all frames
    fit one pool, every order is equally likely.

    With several ranks each takes every ranks-th window of the one order, and the last few windows
    that do not go round are left out.
    """

    def __init__(
        self, data: WindowDataset, *, seed: int, rank: int | None = None, ranks: int | None = None
    ) -> None:
        grouped = torch.distributed.is_available() and torch.distributed.is_initialized()
        self.rank = rank if rank is not None else torch.distributed.get_rank() if grouped else 0
        self.ranks = ranks if ranks is not None else torch.distributed.get_world_size() if grouped else 1
        if not 0 <= self.rank < self.ranks <= len(data):
            raise UsageError(
                "no window for a rank",
                where="WindowSampler",
                expected=f"0 <= rank < ranks <= {len(data)}",
                got=f"rank {self.rank} of {self.ranks}",
            )
        self.data = data  # what is drawn from
        self.seed = seed  # seed of all epochs
        self.epoch = 0  # epoch that is drawn from
        self.position = 0  # windows of its order that the ranks together have drawn

    def __len__(self) -> int:
        """Return the windows of a whole epoch for one rank."""
        return len(self.data) // self.ranks

    def order(self, epoch: int) -> NDArray[np.int64]:
        """Return the windows of an epoch in the order of all ranks together, shape [window]."""
        rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence([self.seed, epoch])))
        runs = [
            run for ends in zip(self.data.starts, self.data.starts[1:], strict=False) for run in _cut(*ends)
        ]
        shuffled = [runs[i] for i in _permutation(rng, len(runs))]
        pool = max(1, POOL_BYTES // (self.data.frame_bytes * (RUN + self.data.length - 1)))
        pools = [np.concatenate(shuffled[i : i + pool]) for i in range(0, len(shuffled), pool)]
        return np.concatenate([windows[_permutation(rng, len(windows))] for windows in pools])

    def __iter__(self) -> Iterator[int]:
        """Yield this rank's windows from the position to the end of the epoch; begin the next one."""
        order = self.order(self.epoch)
        for turn in range(self.position // self.ranks, len(self)):
            self.position = (turn + 1) * self.ranks
            yield int(order[turn * self.ranks + self.rank])
        self.seek(self.epoch + 1)

    def seek(self, epoch: int, position: int = 0) -> None:
        """Continue at a place of an epoch.

        Loaders with worker processes draw ahead of the training: give the position that follows
        from the steps taken.
        """
        self.epoch, self.position = epoch, position

    def state_dict(self) -> dict[str, int]:
        """Return what :meth:`load_state_dict` takes to continue here, in mid-epoch too."""
        return {"seed": self.seed, "epoch": self.epoch, "position": self.position}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue where another sampler of the same data stood."""
        self.seed = int(state["seed"])
        self.seek(int(state["epoch"]), int(state["position"]))


def _cut(start: int, stop: int) -> list[NDArray[np.int64]]:
    """Return the windows from start to stop in runs."""
    return [np.arange(first, min(first + RUN, stop)) for first in range(start, stop, RUN)]


def _permutation(rng: np.random.Generator, length: int) -> NDArray[np.intp]:
    """Return a random order; NumPy promises the same bits for `random` alone."""
    return np.argsort(rng.random(length), kind="stable")


class Window(NamedTuple):
    """Consecutive frames of one scenario."""

    position: Tensor  # particle positions [length], float32, shape [particle, frame, 2]
    material: Tensor  # 0 liquid, 1 jelly, 2 snow, 3 rope, int64, shape [particle]
    # velocity of the walls [length/s], float32, shape [frame, wall, 2], of these frames and perhaps of later
    # ones; None in a split without moving walls
    wall_velocity: Tensor | None
    scenario: int  # scenario id
    frame: int  # absolute number of the first frame


class WindowDataset(Dataset[Window]):
    """All windows of ``history + future`` consecutive frames of a data set's subsets.

    Files are opened by the process that reads from them, at most 32 at a time; decompressed
    frames are kept up to `cache_bytes` in each process. Stored data are never changed: every
    window is a copy.

    Args:
        split: name of the split, or path of a local split's folder.
        subset: train, valid, test or, for multimaterial, extra; or several of them.
        size: name of the size.
        root: folder of all data sets, see :func:`lagbench.data.layout.resolve_root`.
        history: frames that a model is given.
        future: frames after them.
        registry: what describes the data set; ours by default.
        cache_bytes: frames kept decompressed [bytes]; with less, reading is slower, never different.

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
        self.length = history + future  # frames in a window
        self.scenarios = tuple(sources)
        self.frame_bytes = 8 * entry.particles
        counts = [max(0, source.frames - self.length + 1) for source in sources.values()]
        # number of the first window of each scenario, and the number of all windows
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
        """Return scenario id and first frame of a window."""
        if not -len(self) <= index < len(self):
            message = f"no window {index} among {len(self)}"
            raise IndexError(message)
        index %= len(self)
        row = bisect_right(self.starts, index) - 1
        return self.scenarios[row], index - self.starts[row]

    def __getitem__(self, index: int) -> Window:
        """Return a window."""
        scenario, frame = self.place(index)
        frames = self._store.frames(scenario, frame, frame + self.length)
        material, walls = self._store.constants(scenario)
        return _window(
            frames, material, None if walls is None else walls[frame:][: self.length], scenario, frame
        )


def collate(windows: Sequence[Window]) -> Batch:
    """Put windows side by side."""
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
        wall_velocity=torch.stack([wall[: min(map(len, walls))] for wall in walls]) if walls else None,
        scenario=torch.tensor([window.scenario for window in windows]),
        frame=torch.tensor([window.frame for window in windows]),
    )


def scenario_batch(paths: Path | Sequence[Path], frames: slice = slice(None)) -> Batch:
    """Return the same frames of one or several whole scenarios, for rollouts and validation."""
    return collate([_read(path, frames) for path in ([paths] if isinstance(paths, Path) else paths)])


def scenario_paths(
    split: str,
    *,
    subset: str = "test",
    size: str = "full",
    root: str | Path | None = None,
    registry: Registry | None = None,
) -> dict[int, Path]:
    """Return the files of a subset by scenario id; all of them exist."""
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
        # The forcing is given for all frames, so that a rollout from these knows what comes.
        walls = file.read("wall_velocity", slice(run.start, None)) if "wall_velocity" in held else None
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
