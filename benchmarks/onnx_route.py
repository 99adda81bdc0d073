"""Time a model as an ONNX file beside the same model in PyTorch, on one thread.

usage: python benchmarks/onnx_route.py [--root FOLDER]

The model is that of the README, untrained: its cost does not depend on its weights.
Both predict the first test scenario of cavity mini; the data must be there. Both times
are the processor time of the thread that rolls the model out, without the reading of
the data, after one call that is not timed. The best of five rollouts counts.
"""

from __future__ import annotations

import argparse
import os
import re
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from lagbench.data.local import resolve_root
from lagbench.data.registry import Size, load
from lagbench.models.export import export_onnx
from lagbench.models.onnx_model import open_onnx
from lagbench.torch import Batch, Step, WindowDataset, collate, roll_out

README = Path(__file__).parents[1] / "README.md"
HISTORY = 2  # given frames that the README's model sees
REPEATS = 5


def readme_model() -> dict[str, Any]:
    """Return the names that the README's block defines before it trains."""
    block = re.search(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    if block is None:
        raise SystemExit("README.md has no Python block")
    names: dict[str, Any] = {}
    exec(block[1].partition("optimiser = ")[0], names)
    return names


def read_given_frames(size: Size, root: Path) -> Batch:
    """Return the frames of the first test scenario that the model sees.

    The velocities of the walls are those of all frames, as in `predict`.
    """
    task = size.task
    data = WindowDataset(
        size.split,
        subset="test",
        size=size.name,
        root=root,
        future=task.horizon,
    )
    whole = collate([data[0]])
    return whole.part(slice(task.input_frames - HISTORY, task.input_frames))


def time_torch(step: Step, given: Batch, frames: int) -> tuple[float, NDArray[Any]]:
    """Return the processor time of a rollout [s], and its positions.

    Positions have the shape [frame, particle, axis].
    """
    with torch.no_grad():
        step(given)  # the first call allocates
        started = time.thread_time()
        position = roll_out(step, given, frames)
        seconds = time.thread_time() - started
    return seconds, position.transpose(0, 1).numpy()


def main() -> None:
    """Print the processor time of a frame of both, and how far they differ."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--root", type=Path)
    options = parser.parse_args()
    root = resolve_root(options.root)
    os.environ["LAGBENCH_ROOT"] = str(root)  # the README's program opens its data, too
    size = load().size("cavity", "mini")
    frames = size.task.horizon
    first_scenario = size.subsets["test"][0]
    scenario_file = size.path(root, first_scenario)
    readme = readme_model()
    # One thread, as the child process of an ONNX model has.
    torch.set_num_threads(1)
    given = read_given_frames(size, root)
    with tempfile.TemporaryDirectory() as folder:
        path = export_onnx(
            readme["step"],
            Path(folder) / "model.onnx",
            split="cavity",
            size="mini",
            modules=[readme["net"]],
            history=HISTORY,
            root=root,
        )
        model = open_onnx(path, size=size, root=root)
        onnx_times = []
        torch_times = []
        for _ in range(REPEATS):
            rollout = model.roll_out(scenario_file)
            onnx_times.append(rollout.seconds)
            seconds, expected = time_torch(readme["step"], given, frames)
            torch_times.append(seconds)
    onnx_milliseconds = 1e3 * min(onnx_times) / frames
    torch_milliseconds = 1e3 * min(torch_times) / frames
    difference = np.abs(rollout.position - expected).max()
    sys.stdout.write(
        f"ONNX {onnx_milliseconds:.2f} ms per frame, "
        f"PyTorch {torch_milliseconds:.2f} ms, "
        f"ratio {onnx_milliseconds / torch_milliseconds:.2f}, "
        f"positions within {difference:.1e} after {frames} frames\n"
    )


if __name__ == "__main__":
    main()
