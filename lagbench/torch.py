"""Windows of a split as PyTorch tensors: data set, order and batches; rollouts of a
model.

>>> from torch.utils.data import DataLoader
>>> from lagbench.torch import WindowDataset, WindowSampler, collate
>>> data = WindowDataset("cavity", size="mini")  # doctest: +SKIP
>>> loader = DataLoader(data, 2, sampler=WindowSampler(data, seed=0), collate_fn=collate)  # doctest: +SKIP

``shuffle=True`` works too; the sampler's order reads each frame about once, where a
data set is larger than the cache. Needs PyTorch: ``pip install 'lagbench[baselines]'``.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import Dataset, Sampler

from lagbench.data.registry import Registry
from lagbench.errors import UsageError
from lagbench.store.windows import CACHE_BYTES, WindowReader
from lagbench.store.windows import Window as Arrays
from lagbench.tensors import Batch, Window, collate

__all__ = [
    "POOL_BYTES",
    "RUN",
    "Batch",
    "Step",
    "Window",
    "WindowDataset",
    "WindowSampler",
    "collate",
    "predict",
    "roll_out",
    "tensors",
]


def tensors(window: Arrays) -> Window:
    """Return a window's arrays as tensors; float32 arrays are shared, not copied."""
    walls = window.wall_velocity
    return Window(
        torch.from_numpy(window.position),
        torch.from_numpy(window.material).long(),
        None if walls is None else torch.from_numpy(walls),
        window.scenario,
        window.frame,
        None if window.origin is None else torch.from_numpy(window.origin),
    )


class WindowDataset(WindowReader, Dataset[Window]):
    """Map-style data set of all windows of ``history + future`` consecutive frames.

    Give `collate` to the DataLoader: windows may differ in their number of particles.
    Workers open files of their own, so any start method works. Memory does not grow
    with the size of the split: each process keeps at most `cache_bytes` of frames.

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
        origin: whether windows hold the positions in the scenario's first frame too.

    Raises:
        UsageError: unknown split, size or subset, or no scenario is long enough.
        DataError: scenarios are missing; the message has the command that makes them.
    """

    def __getitem__(self, index: int) -> Window:
        """Return a window as tensors of its own."""
        return tensors(self.read(index))


RUN = 32
"""Windows that follow each other in a scenario and are drawn from one pool, to share
their frames.
"""

POOL_BYTES = CACHE_BYTES
"""Frames of the windows that are shuffled together [bytes]."""


class WindowSampler(Sampler[int]):
    """Draw every window once an epoch, in an order that follows from seed and epoch
    alone.

    Windows of one scenario that follow each other are cut into runs of 32. An epoch is
    a random order of all runs, taken in pools whose frames fill 256 MiB; the windows of
    a pool are shuffled. So a frame is decompressed about once, not once for each window
    that holds it; where all frames fit one pool, every order is equally likely.

    With several ranks each takes every ranks-th window of the one order, and the last
    few windows that do not go round are left out.
    """

    def __init__(
        self,
        data: WindowDataset,
        *,
        seed: int,
        rank: int | None = None,
        ranks: int | None = None,
    ) -> None:
        grouped = (
            torch.distributed.is_available() and torch.distributed.is_initialized()
        )
        if rank is not None:
            self.rank = rank
        else:
            self.rank = torch.distributed.get_rank() if grouped else 0
        if ranks is not None:
            self.ranks = ranks
        else:
            self.ranks = torch.distributed.get_world_size() if grouped else 1
        if not 0 <= self.rank < self.ranks <= len(data):
            expected = f"0 <= rank < ranks <= {len(data)}"
            got = f"rank {self.rank} of {self.ranks}"
            raise UsageError(
                "no window for a rank",
                where="WindowSampler",
                expected=expected,
                got=got,
            )
        self.data = data  # what is drawn from
        self.seed = _natural(seed, "seed")  # seed of all epochs
        self.epoch = 0  # epoch that is drawn from
        self.position = 0  # windows of its order that the ranks together have drawn

    def __len__(self) -> int:
        """Return the windows of a whole epoch for one rank."""
        return len(self.data) // self.ranks

    def order(self, epoch: int) -> NDArray[np.int64]:
        """Return the windows of an epoch in the order of all ranks together, shape
        [window].
        """
        rng = np.random.Generator(
            np.random.PCG64(np.random.SeedSequence([self.seed, epoch]))
        )
        runs = [
            np.arange(first, min(first + RUN, stop))
            for start, stop in zip(self.data.starts, self.data.starts[1:], strict=False)
            for first in range(start, stop, RUN)
        ]
        shuffled = [runs[i] for i in _permutation(rng, len(runs))]
        pool = max(
            1, POOL_BYTES // (self.data.frame_bytes * (RUN + self.data.length - 1))
        )
        pools = [
            np.concatenate(shuffled[i : i + pool])
            for i in range(0, len(shuffled), pool)
        ]
        return np.concatenate(
            [windows[_permutation(rng, len(windows))] for windows in pools]
        )

    def __iter__(self) -> Iterator[int]:
        """Yield this rank's windows from the position to the end of the epoch; begin
        the next one.
        """
        order = self.order(self.epoch)
        for turn in range(self.position // self.ranks, len(self)):
            self.position = (turn + 1) * self.ranks
            yield int(order[turn * self.ranks + self.rank])
        self.seek(self.epoch + 1)

    def seek(self, epoch: int, position: int = 0) -> None:
        """Continue at a place of an epoch.

        Loaders with worker processes draw ahead of the training: give the position that
        follows from the steps taken.

        Raises:
            UsageError: there is no such place.
        """
        place = (_natural(epoch, "epoch"), _natural(position, "position"))
        most = len(self.data)
        if place[1] > most:
            raise UsageError(
                "no such place",
                where="WindowSampler",
                expected=f"at most {most}",
                got=position,
            )
        self.epoch, self.position = place

    def state_dict(self) -> dict[str, int]:
        """Return what `load_state_dict` takes to continue here, in mid-epoch too."""
        return {"seed": self.seed, "epoch": self.epoch, "position": self.position}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue where another sampler of the same data stood."""
        seed = _natural(state["seed"], "seed")
        self.seek(state["epoch"], state["position"])
        self.seed = seed


def _natural(value: object, name: str) -> int:
    try:
        number = operator.index(value)  # type: ignore[arg-type]
    except TypeError:
        number = -1
    if number < 0:
        what = f"{name} does not fit"
        expected = "a whole number from 0"
        raise UsageError(
            what, where="WindowSampler", expected=expected, got=repr(value)
        )
    return number


def _permutation(rng: np.random.Generator, length: int) -> NDArray[np.intp]:
    """Return a random order; NumPy promises the same bits for `random` alone."""
    return np.argsort(rng.random(length), kind="stable")


Step = Callable[[Batch], Tensor]
"""A model: from windows of given frames to the positions of the next one [length],
shape [particle, 2].

``batch.wall_velocity[:, batch.frames]`` is what acts on the way there.
"""


def roll_out(step: Step, given: Batch, frames: int) -> Tensor:
    """Feed a model with its own predictions; gradients pass through all frames.

    Args:
        step: the model; it may not write to its batch.
        given: the frames that it starts from, with the forcing of those to predict:
            windows of a loader cut by ``batch.part(slice(history))``.
        frames: frames to predict.

    Returns:
        Positions of the frames after the given ones [length], shape [particle, frame,
        2].

    Raises:
        UsageError: frames below 1 or beyond the known forcing, or the model returns no
            [particle, 2].
    """
    walls = given.wall_velocity
    if walls is None:
        known = max(1, frames)
    else:
        known = walls.shape[1] - given.frames
    if (
        not 1 <= frames <= known
    ):  # beyond the forcing a model would take the last one known
        fix = "give longer windows, cut by batch.part(slice(history))"
        raise UsageError(
            "no such frames",
            where="roll_out",
            expected=f"1 to {known}",
            got=frames,
            fix=fix,
        )
    predicted = []
    expected = given.position[:, -1].shape
    for _ in range(frames):
        position = step(given)
        if not isinstance(position, Tensor) or position.shape != expected:
            what = "a model returned no positions of the next frame"
            shape = f"a tensor of shape {list(expected)}: [particle, 2]"
            got = getattr(position, "shape", None) or type(position).__name__
            raise UsageError(what, where="roll_out, step", expected=shape, got=got)
        given = given.followed_by(position)
        # a copy: the model may use the memory of its answer again
        predicted.append(given.position[:, -1])
    return torch.stack(predicted, dim=1)


def predict(
    step: Step,
    split: str | Path,
    *,
    subset: str = "test",
    size: str | None = None,
    root: str | Path | None = None,
    history: int | None = None,
    registry: Registry | None = None,
    device: torch.device | str = "cpu",
) -> Iterator[tuple[int, NDArray[np.float32]]]:
    """Roll a model out over every scenario of a subset, from the frames that the task
    gives.

    ``dict(predict(...))`` is what `lagbench.submission.write` takes;
    `PredictionsWriter` takes one scenario after the other. A network with dropout or
    batch norm is to be set to ``eval()`` before.

    Args:
        step: the model.
        split: name of the split, or path of a local split's folder.
        subset: train, valid, test or, for multimaterial, extra.
        size: name of the size; the only one that is there when None.
        root: folder of all data sets; else LAGBENCH_ROOT, else the user data folder.
        history: the last of the given frames that the model sees; all of them by
            default.
        registry: what describes the data set; ours by default.
        device: where the model is.

    Yields:
        Scenario id, and positions of the frames to predict [length], float32, shape
        [frame, particle, 2].

    Raises:
        UsageError: unknown split, size or subset, fewer frames are given than the model
            is to see, or a scenario has fewer than the task; raised, like all, when the
            first scenario is asked for.
        DataError: scenarios are missing; the message has the command that makes them.
    """
    data = WindowDataset(
        split, subset=subset, size=size, root=root, future=0, registry=registry
    )
    task = data.size.task
    if history is not None and not 1 <= history <= task.input_frames:
        what = "a model cannot see that many of the given frames"
        expected = f"history from 1 to {task.input_frames}"
        raise UsageError(what, where="predict", expected=expected, got=history)
    seen = slice(task.input_frames - (history or task.input_frames), None)
    needed = task.input_frames + task.horizon
    for scenario, first in zip(data.scenarios, data.starts, strict=False):
        if (held := data.size.frame_count(scenario)) < needed:
            what = "a scenario is too short to be predicted"
            where = f"predict, {data.size.split} {data.size.name}, scenario {scenario}"
            fix = "predict the subset test, whose scenarios are long enough"
            raise UsageError(
                what, where=where, expected=f"{needed} frames", got=held, fix=fix
            )
        _, walls = data.store.constants(scenario)
        # The forcing is given for all frames, unlike the positions.
        if walls is None:
            forcing = None
        else:
            forcing = torch.from_numpy(walls.copy())
        given = (
            collate([data[first]._replace(wall_velocity=forcing)]).part(seen).to(device)
        )
        with torch.no_grad():
            positions = roll_out(step, given, task.horizon)
        yield scenario, positions.transpose(0, 1).float().cpu().numpy()
