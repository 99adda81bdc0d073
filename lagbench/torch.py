"""Windows of a split as PyTorch tensors: data set, sampler, batches and rollouts.

>>> from torch.utils.data import DataLoader
>>> from lagbench.torch import WindowDataset, WindowSampler, collate
>>> data = WindowDataset("cavity", size="mini")  # doctest: +SKIP
>>> sampler = WindowSampler(data, seed=0)  # doctest: +SKIP
>>> loader = DataLoader(
...     data, batch_size=2, sampler=sampler, collate_fn=collate
... )  # doctest: +SKIP

``shuffle=True`` works too. The sampler's order reads each frame about once where the
data set is larger than the cache. Needs PyTorch: ``pip install 'lagbench[baselines]'``.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagbench.errors import UsageError, require

try:
    import torch
except ModuleNotFoundError:
    require("torch", extra="baselines")  # raises, with the command that installs it
    raise
from torch import Tensor
from torch.utils.data import Dataset, Sampler

from lagbench.data.registry import Registry
from lagbench.store.windows import CACHE_BYTES, WindowReader
from lagbench.store.windows import Window as ArrayWindow
from lagbench.tensors import Batch, TensorBox, TensorWindow, collate

__all__ = [
    "POOL_BYTES",
    "RUN",
    "Batch",
    "Step",
    "TensorBox",
    "Window",
    "WindowDataset",
    "WindowSampler",
    "collate",
    "predict",
    "roll_out",
    "tensors",
]


Window = TensorWindow
"""Public name of a window of tensors."""


def tensors(window: ArrayWindow) -> Window:
    """Return a window's arrays as tensors; float32 arrays are shared, not copied."""
    optional: dict[str, Any] = {}
    for name in ("wall_velocity", "origin", "body_force", "obstacle"):
        array = getattr(window, name)
        optional[name] = None if array is None else torch.from_numpy(array)
    return TensorWindow(
        position=torch.from_numpy(window.position),
        material=torch.from_numpy(window.material).long(),
        scenario=window.scenario,
        frame=window.frame,
        viscosity=window.viscosity,
        **optional,
    )


class WindowDataset(WindowReader, Dataset[TensorWindow]):
    """Map-style data set of all windows of ``history + future`` consecutive frames.

    Give `collate` to the DataLoader: windows may differ in their number of particles.
    Workers open files of their own, so any start method works. Memory does not grow
    with the size of the split: each process keeps at most `cache_bytes` of frames.

    Args:
        split: name of the split, or path of a local split's folder.
        subset: train, valid or test, also shift or extra where the split has it; or
            several of them.
        size: name of the size; None takes the only one with data, or mini where several
            have data.
        root: folder of all data sets; else LAGBENCH_ROOT, else the user data folder.
        history: given frames of the model; those of the task by default.
        future: frames after them.
        registry: description of the data sets; ours by default.
        cache_bytes: frames kept decompressed [bytes]; with less, reading is slower,
            never different.
        origin: whether windows hold the positions in the scenario's first frame too.
        verify: whether the values of all files are hashed first and compared with the
            recorded content hashes, as `lagbench train` does.

    Raises:
        UsageError: unknown split, size or subset, or no scenario is long enough.
        DataError: scenarios are missing; the message has the command that makes them.
            Or a file is damaged, and `verify` is true.
    """

    def __getitem__(self, index: int) -> TensorWindow:
        """Return a window as tensors of its own."""
        return tensors(self.read(index))


RUN = 32
"""Consecutive windows of a scenario that enter a pool together and share frames."""

POOL_BYTES = CACHE_BYTES
"""Frames of the windows that are shuffled together [bytes]."""


class WindowSampler(Sampler[int]):
    """Draw every window once an epoch, in an order that follows from seed and epoch.

    Consecutive windows of one scenario are cut into runs of 32. An epoch is a random
    order of all runs, taken in pools whose frames fill 256 MiB; the windows of a pool
    are shuffled. So a frame is decompressed about once, not once for each window that
    holds it. Where all frames fit one pool, every order is equally likely.

    With n ranks, each rank takes every n-th window of the same order. The last windows
    are left out if there are fewer than n of them.

    Args:
        data: the windows.
        seed: seed of all epochs.
        rank: rank of this process; that of torch.distributed by default.
        ranks: number of ranks; that of torch.distributed by default.

    Raises:
        UsageError: the ranks are more than the windows, or the rank is not one of them.
    """

    def __init__(
        self,
        data: WindowDataset,
        *,
        seed: int,
        rank: int | None = None,
        ranks: int | None = None,
    ) -> None:
        group_rank, group_size = _process_group()
        if rank is None:
            rank = group_rank
        if ranks is None:
            ranks = group_size
        if not 0 <= rank < ranks <= len(data):
            raise UsageError(
                f"no window for rank {rank} of {ranks}: there are {len(data)}; use "
                "fewer processes, or more windows",
                where="WindowSampler",
            )
        self.rank = rank
        self.ranks = ranks
        self.data = data
        self.seed = _check_natural(seed, "seed")  # seed of all epochs
        self.epoch = 0  # the present epoch
        self.position = 0  # windows of its order that the ranks together have drawn

    def __repr__(self) -> str:
        """Return the windows, the seed, and the place in the order."""
        return (
            f"<WindowSampler: windows {len(self.data)}, seed {self.seed}, "
            f"epoch {self.epoch}, position {self.position}, "
            f"rank {self.rank} of {self.ranks}>"
        )

    def __len__(self) -> int:
        """Return the windows of a whole epoch for one rank."""
        return len(self.data) // self.ranks

    def order(self, epoch: int) -> NDArray[np.int64]:
        """Return the windows of an epoch in the order of all ranks, shape [window]."""
        seeds = np.random.SeedSequence([self.seed, epoch])
        rng = np.random.Generator(np.random.PCG64(seeds))

        starts = self.data.starts
        runs = []
        for start, stop in pairwise(starts):
            for first in range(start, stop, RUN):
                end = min(first + RUN, stop)
                runs.append(np.arange(first, end))
        run_order = _draw_permutation(rng, len(runs))
        shuffled_runs = [runs[number] for number in run_order]

        frames_per_run = RUN + self.data.length - 1
        run_bytes = self.data.frame_bytes * frames_per_run
        runs_per_pool = max(1, POOL_BYTES // run_bytes)
        pools = []
        for first in range(0, len(shuffled_runs), runs_per_pool):
            end = first + runs_per_pool
            pool = np.concatenate(shuffled_runs[first:end])
            window_order = _draw_permutation(rng, len(pool))
            pools.append(pool[window_order])
        return np.concatenate(pools)

    def __iter__(self) -> Iterator[int]:
        """Yield this rank's windows to the end of the epoch; begin the next epoch."""
        order = self.order(self.epoch)
        for turn in range(self.position // self.ranks, len(self)):
            self.position = (turn + 1) * self.ranks
            yield int(order[turn * self.ranks + self.rank])
        self.seek(self.epoch + 1)

    def seek(self, epoch: int, position: int = 0) -> None:
        """Continue at a position of an epoch.

        Loaders with worker processes draw ahead of the training: give the position that
        follows from the steps taken.

        Raises:
            UsageError: there is no such position.
        """
        epoch = _check_natural(epoch, "epoch")
        position = _check_natural(position, "position")
        window_count = len(self.data)
        if position > window_count:
            raise UsageError(
                f"no position {position} among {window_count} windows; seek the next "
                "epoch",
                where="WindowSampler",
            )
        self.epoch = epoch
        self.position = position

    def state_dict(self) -> dict[str, int]:
        """Return what `load_state_dict` takes to continue here, in mid-epoch too."""
        return {"seed": self.seed, "epoch": self.epoch, "position": self.position}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue where another sampler of the same data stood.

        Args:
            state: what `state_dict` of that sampler returned.

        Raises:
            UsageError: a key is missing, or there is no such position.
        """
        keys = self.state_dict().keys()
        is_mapping = isinstance(state, Mapping)
        if not is_mapping or not keys <= state.keys():
            got: object = type(state).__name__
            if is_mapping:
                got = ", ".join(map(repr, state)) or "no key"
            raise UsageError(
                f"no state of a sampler: {got}; give what sampler.state_dict() "
                "returned",
                where="WindowSampler.load_state_dict",
            )
        seed = _check_natural(state["seed"], "seed")
        self.seek(state["epoch"], state["position"])
        self.seed = seed


def _process_group() -> tuple[int, int]:
    """Return rank and size of the process group; 0 and 1 where there is none."""
    distributed = torch.distributed
    if distributed.is_available() and distributed.is_initialized():
        return distributed.get_rank(), distributed.get_world_size()
    return 0, 1


def _check_natural(value: object, name: str) -> int:
    """Return a whole number from 0; refuse anything else."""
    try:
        number = operator.index(value)  # type: ignore[arg-type]
    except TypeError:
        number = -1
    if number < 0:
        raise UsageError(
            f"{name} is {value!r}; give a whole number from 0",
            where="WindowSampler",
        )
    return number


def _draw_permutation(rng: np.random.Generator, length: int) -> NDArray[np.intp]:
    """Return a random order; NumPy promises the same bits for `random` alone."""
    return np.argsort(rng.random(length), kind="stable")


Step = Callable[[Batch], Tensor]
"""A model: windows of given frames in, positions of the next frame out.

The positions [length] have shape [particle, axis]. The slice
``batch.wall_velocity[:, batch.frames]`` is the forcing on the way to the next frame; so
is ``batch.body_force[:, batch.frames]`` where a force drives the flow.
"""


def roll_out(step: Step, given: Batch, frames: int) -> Tensor:
    """Feed a model with its own predictions; gradients pass through all frames.

    Args:
        step: the model; it may not write to its batch.
        given: the given frames, with the forcing of the frames to predict: windows of a
            loader cut by ``batch.part(slice(history))``.
        frames: frames to predict.

    Returns:
        Positions of the predicted frames [length], shape [particle, frame, axis].

    Raises:
        UsageError: frames below 1 or beyond the known forcing, or the model returns no
            real [particle, axis] on the device of the given frames.
    """
    # Beyond the known forcing a model would take the last known one.
    longest = max(1, frames)
    for forcing in (given.wall_velocity, given.body_force):
        if forcing is not None:
            longest = min(longest, forcing.shape[1] - given.frames)
    if not 1 <= frames <= longest:
        raise UsageError(
            f"{frames} frames cannot be predicted, 1 to {longest} can; give longer "
            "windows, cut by batch.part(slice(history))",
            where="roll_out",
        )
    batch = given
    predicted_frames = []
    for _ in range(frames):
        position = step(batch)
        _check_step_result(position, batch.position[:, -1])
        batch = batch.followed_by(position)
        # A copy: the model may use the memory of its answer again.
        predicted_frames.append(batch.position[:, -1])
    return torch.stack(predicted_frames, dim=1)


def _check_step_result(position: object, last_position: Tensor) -> None:
    """Refuse a result that is no real tensor of the kind of the last positions."""
    if (
        isinstance(position, Tensor)
        and position.shape == last_position.shape
        and position.device == last_position.device
        and not position.is_complex()
    ):
        return
    got = type(position).__name__
    if isinstance(position, (Tensor, np.ndarray)):
        got = f"{got} of {position.dtype}, shape {list(position.shape)}"
    raise UsageError(
        f"a model returned no positions of the next frame: {got}; return a tensor of "
        f"real numbers, [particle, axis] = {list(last_position.shape)}, on the device "
        f"{last_position.device}",
        where="roll_out, step",
    )


def check_history(history: int | None, given_frames: int, *, where: str) -> int:
    """Return how many of the given frames a model sees: all of them by default.

    Raises:
        UsageError: it is not 1 to all of them.
    """
    if history is None:
        return given_frames
    if not 1 <= history <= given_frames:
        raise UsageError(
            f"a model cannot see {history} of {given_frames} given frames; leave "
            f"history out, or give a number from 1 to {given_frames}",
            where=where,
        )
    return history


def predict(
    step: Step,
    split: str | Path,
    *,
    subset: str = "test",
    size: str | None = None,
    root: str | Path | None = None,
    history: int | None = None,
    registry: Registry | None = None,
    device: torch.device | str | int = "cpu",
) -> Iterator[tuple[int, NDArray[np.float32]]]:
    """Roll a model out over every scenario of a subset, from the task's given frames.

    ``dict(predict(...))`` is what `lagbench.submission.write` takes;
    `PredictionsWriter` takes one scenario after the other. Set a network with dropout
    or batch norm to ``eval()`` first.

    Args:
        step: the model.
        split: name of the split, or path of a local split's folder.
        subset: train, valid or test; also shift or extra where the split has it.
        size: name of the size; None takes the only one with data, or mini where several
            have data.
        root: folder of all data sets; else LAGBENCH_ROOT, else the user data folder.
        history: how many of the last given frames the model sees; all by default.
        registry: description of the data sets; ours by default.
        device: device of the model; a number is that of an accelerator.

    Yields:
        Scenario id, and positions of the frames to predict [length], float32, shape
        [frame, particle, axis].

    Raises:
        UsageError: unknown split, size or subset, history beyond the given frames, or a
            scenario with fewer frames than the task.
        DataError: scenarios are missing; the message has the command that makes them.
    """
    data = WindowDataset(
        split, subset=subset, size=size, root=root, future=0, registry=registry
    )
    task = data.size.task
    history = check_history(history, task.input_frames, where="predict")
    visible_frames = slice(task.input_frames - history, None)
    needed_frames = task.input_frames + task.horizon
    for scenario, first in zip(data.scenarios, data.starts, strict=False):
        frame_count = data.size.frame_count(scenario)
        if frame_count < needed_frames:
            tier = data.size
            raise UsageError(
                f"the scenario has {frame_count} of {needed_frames} frames; predict "
                "the subset test, whose scenarios are long enough",
                where=f"predict, {tier.split} {tier.name}, scenario {scenario}",
            )
        # The forcing is given for all frames, unlike the positions.
        opened = data.store.open(scenario)
        wall_velocity = opened.wall_velocity
        forcing = None
        if wall_velocity is not None:
            forcing = torch.from_numpy(wall_velocity.copy())
        window = data[first]._replace(wall_velocity=forcing)
        body_force = opened.body_force
        if body_force is not None:
            window = window._replace(body_force=torch.from_numpy(body_force.copy()))
        given = collate([window]).part(visible_frames).to(device)
        with torch.no_grad():
            positions = roll_out(step, given, task.horizon)
        # from [particle, frame, axis] to [frame, particle, axis]
        by_frame = positions.transpose(0, 1).float().cpu().numpy()
        yield scenario, by_frame
