"""The order in which training windows are drawn: seeded, resumable, shared out among ranks."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import Sampler

from lagbench.errors import UsageError

from .frame_store import CACHE_BYTES

if TYPE_CHECKING:
    from .windows import WindowDataset

__all__ = ["POOL_BYTES", "RUN", "WindowSampler"]

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

    Args:
        data: what is drawn from.
        seed: seed of all epochs.
        rank: which part to draw; by default that of torch.distributed, else 0.
        ranks: number of parts; by default that of torch.distributed, else 1.

    Attributes:
        epoch: epoch that is drawn from.
        position: windows of its order that the ranks together have drawn.
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
        self.data = data
        self.seed = seed
        self.epoch = 0
        self.position = 0

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

        Args:
            epoch: epoch, from 0.
            position: windows of its order that the ranks together have used.
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
