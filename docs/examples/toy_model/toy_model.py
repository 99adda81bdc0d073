"""A model with one parameter: every particle continues a little slower or faster.

    python toy_model.py --split cavity --size tiny -o predictions.nc

With the per-frame velocity v(f) = x(f) - x(f-1), a rollout is

    v(f+1) = c v(f),    x(f+1) = x(f) + v(f+1).

The parameter c minimises the sum over `train` of (v(f+1) - c v(f))^2.
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


def read_positions(
    split: str, size: str, subset: str, root: Path | None
) -> dict[int, Floats]:
    """Return the positions of each scenario, shape [frame, particle, space].

    Shorter scenarios are padded with frames of NaN; these frames are left out.
    """
    data = lagbench.open_split(split, subset=subset, size=size, root=root)
    positions = {}
    for scenario in data.scenario.values:
        position = np.asarray(data.position.sel(scenario=scenario), float)
        is_padding = np.isnan(position).all(axis=(1, 2))
        positions[int(scenario)] = position[~is_padding]
    return positions


def fit(split: str, size: str, root: Path | None) -> float:
    """Return c by least squares over the training scenarios."""
    products = 0.0
    squares = 0.0
    for position in read_positions(split, size, "train", root).values():
        velocity = np.diff(position, axis=0)
        products += np.sum(velocity[1:] * velocity[:-1])
        squares += np.sum(velocity[:-1] ** 2)
    return float(products / squares)


def roll_out(given: Floats, c: float, frames: int) -> Floats:
    """Return the next frames after the given ones, shape [frame, particle, space]."""
    velocity = given[-1] - given[-2]
    factors = np.cumsum(c ** np.arange(1, frames + 1))
    return np.asarray(given[-1] + factors[:, None, None] * velocity)


def main() -> int:
    """Fit c, roll out the test scenarios, write the predictions."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--split", default="cavity")
    parser.add_argument("--size", default="tiny")
    parser.add_argument("--root", type=Path)
    parser.add_argument("-o", "--output", type=Path, default=Path("predictions.nc"))
    options = parser.parse_args()

    task = load().size(options.split, options.size).task
    c = fit(options.split, options.size, options.root)
    test = read_positions(options.split, options.size, "test", options.root)

    start = time.process_time()
    rollouts = {}
    for scenario, position in test.items():
        given = position[: task.input_frames]
        rollouts[scenario] = roll_out(given, c, task.horizon)
    seconds = time.process_time() - start
    frame_count = len(rollouts) * task.horizon

    submission.write(
        options.output,
        rollouts,
        split=options.split,
        size=options.size,
        root=options.root,
        method="toy-model",
        seconds_per_frame=seconds / frame_count,
        device=platform.machine(),
        parameters=1,
        training=f"train, least squares: c = {c:.6f}",
    )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
