"""Densities of true states, from which the limit of relaxation is chosen.

    python -m studies.densities --root /data

Relaxation (``baselines/relaxation.py``) leaves a particle alone whose density is at
most c times the mean density of the last given frame. True states should hold few
particles beyond that limit, or relaxation disturbs single steps. Each line of the table
has quantiles of the density over that mean, in every ``--every``-th frame of the subset
``train``.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from lagbench.baselines.relaxation import Relaxation
from lagbench.baselines.rollout import scenario_batch, scenario_paths
from lagbench.data.registry import Size
from lagbench.data.registry import load as load_registry
from lagbench.errors import LagbenchError
from lagbench.tensors import TensorBox

SPLITS = (
    "cavity",
    "curl-noise",
    "decaying-vortices",
    "poiseuille",
    "cylinder",
    "cavity-3d",
    "curl-noise-3d",
    "fluid",
    "fluid-3d",
)
"""Splits of one fluid."""

SHARES = (0.5, 0.99, 0.999, 0.9999)


def relative_densities(
    size: Size, paths: Sequence[Path], *, every: int
) -> NDArray[np.float32]:
    """Return all densities over the mean of the last given frame [1], shape [value].

    Args:
        size: size of the scenarios.
        paths: scenario files.
        every: frames between the frames that count.
    """
    relaxation = Relaxation(
        TensorBox(size.box), radius=size.task.radius, iterations=1, densest=1.0
    )
    values = []
    for path in paths:
        scenario = scenario_batch(path, slice(None))
        last_given = scenario.position[:, size.task.input_frames - 1]
        mean = relaxation.density(last_given, scenario.sample).mean()
        for frame in range(0, scenario.frames, every):
            density = relaxation.density(scenario.position[:, frame], scenario.sample)
            relative = density / mean
            values.append(relative.numpy())
    return np.concatenate(values)


def to_line(name: str, densities: NDArray[np.float32]) -> str:
    """Return a line of the table: the quantiles of a data set, and the largest."""
    cells = [name]
    for value in np.quantile(densities, SHARES):
        cells.append(f"{value:.2f}")
    cells.append(f"{densities.max():.2f}")
    return "| " + " | ".join(cells) + " |"


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table; return the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m studies.densities",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--root", type=Path, default=os.environ.get("LAGBENCH_ROOT"))
    parser.add_argument("--split", nargs="+", default=SPLITS)
    parser.add_argument("--size", default="mini")
    parser.add_argument("--scenarios", type=int, default=6)
    parser.add_argument("--every", type=int, default=15)
    options = parser.parse_args(arguments)
    if options.root is None:
        parser.error("name the folder of all data sets: --root FOLDER")
    for option in ("scenarios", "every"):
        if getattr(options, option) < 1:
            parser.error(f"--{option}: at least 1 is needed")

    torch.set_num_threads(1)
    heads = " | ".join(f"{100 * share:g} %" for share in SHARES)
    lines = [f"| data set | {heads} | largest |", "|---" + "|---:" * 5 + "|"]
    try:
        for split in options.split:
            size = load_registry().size(split, options.size)
            of_subset = scenario_paths(
                split, subset="train", size=options.size, root=options.root
            )
            paths = list(of_subset.values())
            densities = relative_densities(
                size, paths[: options.scenarios], every=options.every
            )
            lines.append(to_line(f"{split} {options.size}", densities))
    except LagbenchError as error:
        sys.stderr.write(f"error: {error}\n")
        return error.exit_code
    sys.stdout.write("\n".join(lines) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
