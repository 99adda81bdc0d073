"""Time a model as an ONNX file beside the same model in PyTorch, on one thread.

usage: python benchmarks/onnx_route.py [--root FOLDER]

The model is that of the README, untrained: its cost does not depend on its weights.
Both predict the first test scenario of cavity mini; the data must be there.
"""

from __future__ import annotations

import argparse
import re
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from lagbench.data.local import resolve_root
from lagbench.data.registry import load
from lagbench.models.export import export_onnx
from lagbench.models.onnx_model import open_onnx
from lagbench.torch import predict

README = Path(__file__).parents[1] / "README.md"
REPEATS = 3


def readme_model() -> dict[str, Any]:
    """Return the names that the README's block defines before it trains."""
    block = re.search(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    if block is None:
        raise SystemExit("README.md has no Python block")
    names: dict[str, Any] = {}
    exec(block[1].partition("optimiser = ")[0], names)
    return names


def main() -> None:
    """Print the processor time of a frame of both, and how far they differ."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--root", type=Path)
    options = parser.parse_args()
    root = resolve_root(options.root)
    size = load().size("cavity", "mini")
    first_scenario = size.subsets["test"][0]
    scenario_file = size.path(root, first_scenario)
    names = readme_model()
    with tempfile.TemporaryDirectory() as folder:
        path = export_onnx(
            names["step"],
            Path(folder) / "model.onnx",
            split="cavity",
            size="mini",
            modules=[names["net"]],
            history=2,
            root=root,
        )
        model = open_onnx(path, size=size, root=root)
        onnx_seconds = []
        torch_seconds = []
        for _ in range(REPEATS):
            rollout = model.roll_out(scenario_file)
            onnx_seconds.append(rollout.seconds)
            started = time.process_time()
            predictions = predict(
                names["step"],
                "cavity",
                size="mini",
                history=2,
                root=root,
            )
            _, expected = next(predictions)
            torch_seconds.append(time.process_time() - started)
    frames = size.task.horizon
    onnx_milliseconds = 1e3 * min(onnx_seconds)
    torch_milliseconds = 1e3 * min(torch_seconds)
    difference = np.abs(rollout.position - expected).max()
    sys.stdout.write(
        f"ONNX {onnx_milliseconds / frames:.2f} ms per frame, "
        f"PyTorch {torch_milliseconds / frames:.2f} ms, "
        f"positions within {difference:.1e} after {frames} frames\n"
    )


if __name__ == "__main__":
    main()
