"""Estimate the floating-point operations of every committed training.

    python -m studies.training_flops --root FOLDER [--size mini] [--board leaderboard]

PyTorch's counter (``torch.utils.flop_counter``) counts the matrix products and
convolutions of one training window, a multiplication and an addition as two
operations. Other operations do not count, so this is an estimate from below. Backward
costs about twice as much as forward: a training costs three times forward per window,
times the windows that it saw. A training with pushforward draws for each window how
many steps come before the loss; the operations are the mean over all these numbers.
Beside it stand the operations of one predicted frame, the mean over the first eight.
The first scenario of ``valid`` is read, and no other.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils.flop_counter import FlopCounterMode

from lagbench.baselines.baseline import Baseline, Batch
from lagbench.baselines.checkpoint import load, restore
from lagbench.baselines.rollout import scenario_batch
from lagbench.board.entry import Entry, Prediction, Status
from lagbench.board.entry_file import read_entry
from lagbench.board.folder import Folder
from lagbench.data.local import resolve_root
from lagbench.data.registry import load as load_registry
from lagbench.errors import LagbenchError, UsageError
from lagbench.figures.tables import markdown

FORWARD_SHARE = 3  # forward and backward cost so many times forward
PREDICTED_FRAMES = 8  # predicted frames whose operations are counted
START = 5  # frame at which the counted window begins


def count_linear(
    x_shape: Sequence[int], weight_shape: Sequence[int], *_: object, **__: object
) -> int:
    """Return the operations of ``x W^T``: two per multiplication and addition."""
    return 2 * math.prod(x_shape) * weight_shape[0]


# PyTorch's counter does not know the product that graph networks use on CPUs
CUSTOM = {torch.ops.mkldnn._linear_pointwise: count_linear}


@dataclass(frozen=True, kw_only=True)
class Operations:
    """Counted operations of a model."""

    window: float  # of the loss of one training window, forward only
    frame: float  # of one predicted frame


class FixedLength(TorchFunctionMode):
    """Answer the draw of a single integer with a number that is given.

    The length of a pushforward is the only single integer that our models draw.
    """

    def __init__(self, length: int) -> None:
        super().__init__()
        self.length = length
        self.draws = 0  # answered so far

    def __torch_function__(
        self,
        function: Callable[..., object],
        types: Sequence[type],
        arguments: Sequence[object] = (),
        options: Mapping[str, object] | None = None,
    ) -> object:
        """Call a function of torch, and replace a single integer that it draws."""
        value = function(*arguments, **(options or {}))
        if function is torch.randint and isinstance(value, Tensor) and not value.dim():
            self.draws += 1
            return torch.full_like(value, self.length)
        return value


def count_window(model: Baseline, window: Batch) -> float:
    """Return the expected operations of the loss of a training window, forward only.

    The number of steps before the loss is uniform from 0 to the option
    ``pushforward``. Each possible number is counted once.

    Raises:
        UsageError: the model draws its number of steps in another way.
    """
    longest = getattr(model.options, "pushforward", 0)
    model.train()
    total = 0
    for length in range(longest + 1):
        generator = torch.Generator().manual_seed(0)
        with (
            torch.no_grad(),
            FixedLength(length) as fixed,
            FlopCounterMode(display=False, custom_mapping=CUSTOM) as counter,
        ):
            model(window, generator)
        if longest and fixed.draws != 1:
            raise UsageError(
                "the number of steps before the loss cannot be set",
                where=f"{type(model).__name__}.forward",
                expected="one draw of a single integer by torch.randint",
                got=f"{fixed.draws} draws",
                fix="adapt FixedLength in studies/training_flops.py",
            )
        total += counter.get_total_flops()
    return total / (longest + 1)


def count(model: Baseline, path: Path, viscosity: float | None) -> Operations:
    """Return the operations of a model on a scenario of its data set."""
    length = model.history + model.future
    window = scenario_batch(path, slice(START, START + length), viscosity=viscosity)
    if model.origin:
        window = scenario_batch(path, slice(length), viscosity=viscosity)
    window_operations = count_window(model, window)

    model.eval()
    with (
        torch.no_grad(),
        FlopCounterMode(display=False, custom_mapping=CUSTOM) as counter,
    ):
        state = model.start(window.part(slice(max(2, model.history))))
        for _ in range(PREDICTED_FRAMES):
            state, _ = model.advance(state)
    frame_operations = counter.get_total_flops() / PREDICTED_FRAMES
    return Operations(window=window_operations, frame=frame_operations)


def count_entry(folder: Folder, entry: Entry, root: Path) -> Operations | None:
    """Return the operations of the first weights of an entry; None without any."""
    for prediction in entry.predictions:
        weights = prediction.weights
        if weights is None or not weights.path.endswith(".safetensors"):
            continue
        if weights.shared_with is not None:
            continue  # the row of the other entry has this training
        path = folder.path / weights.path
        model = restore(load(path), where=str(path))
        size = load_registry().size(entry.split, entry.size)
        scenario = size.path(root, size.subsets["valid"][0])
        return count(model, scenario, size.viscosity())
    return None


def _mean_windows(predictions: Sequence[Prediction]) -> float | None:
    """Return the windows that a training of an entry saw, mean over its seeds.

    Steps of earlier trainings, from whose weights it started, count as many windows.
    """
    windows = []
    for prediction in predictions:
        budget = prediction.budget
        if budget is None or not budget.windows or not budget.steps:
            continue
        all_steps = budget.steps + (budget.start_steps or 0)
        windows.append(budget.windows * all_steps / budget.steps)
    if not windows:
        return None
    return sum(windows) / len(windows)


def row_of(entry: Entry, operations: Operations) -> tuple[str, ...]:
    """Return the row of an entry."""
    windows = _mean_windows(entry.predictions)
    training = "-"
    windows_text = "-"
    if windows is not None:
        total = FORWARD_SHARE * operations.window * windows
        training = f"{total / 1e12:.3g}"
        windows_text = f"{windows:.0f}"
    return (
        f"{entry.split} {entry.size}",
        entry.name,
        windows_text,
        f"{operations.window / 1e9:.3g}",
        training,
        f"{operations.frame / 1e6:.3g}",
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table; return the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m studies.training_flops",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--root", type=Path)
    parser.add_argument("--size", default="mini")
    parser.add_argument("--board", type=Path, default=Path("leaderboard"))
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    folder = Folder(options.board)
    root = resolve_root(options.root)
    rows = []
    for path in folder.entries():
        entry = read_entry(folder.path / path)
        if entry.size != options.size or entry.status is not Status.ACTIVE:
            continue
        try:
            operations = count_entry(folder, entry, root)
        except LagbenchError as error:
            sys.stderr.write(f"{path}: {error}\n")
            continue
        if operations is not None:
            rows.append(row_of(entry, operations))
    heads = (
        "data set",
        "model",
        "windows seen",
        "forward pass of a window [GFLOP]",
        "training [TFLOP]",
        "predicted frame [MFLOP]",
    )
    sys.stdout.write(f"{markdown(heads, rows)}\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
