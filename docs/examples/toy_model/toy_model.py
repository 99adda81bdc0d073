"""A model of one parameter: every particle goes on, a little slower (or faster) each
frame.

    python toy_model.py --split cavity --size tiny -o predictions.nc

With per-frame velocities v(f) = x(f) - x(f-1), the parameter c minimises the sum over
`train` of (v(f+1) - c v(f))^2; the rollout is v(f+1) = c v(f), x(f+1) = x(f) + v(f+1).
"""

from __future__ import annotations

import argparse
import platform
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import lagbench
from lagbench import submission
from lagbench.data.registry import load

Floats = NDArray[np.float64]


def positions(
    split: str, size: str, subset: str, root: Path | None
) -> dict[int, Floats]:
    """Return scenario id to positions, shape [frame, particle, space]; padding is left
    out.
    """
    data = lagbench.open_split(split, subset=subset, size=size, root=root)
    held = {
        int(i): np.asarray(data.position.sel(scenario=i), float)
        for i in data.scenario.values
    }
    return {i: x[~np.isnan(x).all(axis=(1, 2))] for i, x in held.items()}


def fit(split: str, size: str, root: Path | None) -> float:
    """Return c by least squares over the training scenarios."""
    steps = [np.diff(x, axis=0) for x in positions(split, size, "train", root).values()]
    return float(
        sum(np.sum(v[1:] * v[:-1]) for v in steps)
        / sum(np.sum(v[:-1] ** 2) for v in steps)
    )


def roll_out(given: Floats, c: float, frames: int) -> Floats:
    """Return the next frames after the given ones, shape [frame, particle, space]."""
    powers = np.cumsum(c ** np.arange(1, frames + 1))
    return np.asarray(given[-1] + powers[:, None, None] * (given[-1] - given[-2]))


def main() -> int:
    """Fit, roll out, write predictions.nc."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--split", default="cavity")
    parser.add_argument("--size", default="tiny")
    parser.add_argument("--root", type=Path)
    parser.add_argument("-o", "--output", type=Path, default=Path("predictions.nc"))
    given = parser.parse_args()
    task = load().size(given.split, given.size).task
    c = fit(given.split, given.size, given.root)
    test = positions(given.split, given.size, "test", given.root)
    start = time.perf_counter()
    rollouts = {
        i: roll_out(x[: task.input_frames], c, task.horizon) for i, x in test.items()
    }
    seconds = (time.perf_counter() - start) / (len(rollouts) * task.horizon)
    submission.write(
        given.output,
        rollouts,
        split=given.split,
        size=given.size,
        root=given.root,
        method="toy-model",
        seconds_per_frame=seconds,
        device=platform.machine(),
        parameters=1,
        training=f"train, least squares: c = {c:.6f}",
    )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
