"""Print what each cavity scenario is: walls and their speeds, Reynolds number, start,
energy.

    python benchmarks/cavity_scenarios.py --root FOLDER [--size full] [--subset train]

The RMS speed is that of the moving walls over all frames, reversals how often they
change direction. The mean kinetic energy per unit mass is that of the solver's particle
velocities over all frames [length^2/s^2]. Exits with 1 if two scenarios have the same
draws or the same energy.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from lagbench.data.registry import Size, load
from lagbench.data.scenario import read_scenario

NAMES = ("wall", "motion", "reynolds_number", "start_frame")


def main() -> int:
    """Print one Markdown row per scenario and say whether all differ."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--root", type=Path, required=True)
    parser.add_argument("--size", default="full")
    parser.add_argument("--subset", default="train")
    given = parser.parse_args()
    size = load().size("cavity", given.size)
    ids = size.subsets[given.subset]
    rows = [_row(size, given.root, scenario) for scenario in ids]
    print(
        "| id | walls | motion | Re | start frame | RMS speed [length/s] | reversals "
        "| mean kinetic energy |"
    )
    print("|---:|---|---|---:|---:|---:|---:|---:|")
    for scenario, (wall, motion, reynolds, start, speed, reversals, energy) in zip(
        ids, rows, strict=True
    ):
        print(
            f"| {scenario} | {wall} | {motion} | {reynolds:.1f} | {start} | "
            f"{speed:.4f} | {reversals} "
            f"| {energy:.3e} |"
        )
    alike = len(rows) - min(
        len({row[:-1] for row in rows}), len({row[-1] for row in rows})
    )
    print(f"\n{len(rows)} scenarios, {alike} alike")
    if alike:
        return 1
    return 0


def _row(size: Size, root: Path, scenario: int) -> tuple:
    with read_scenario(size.path(root, scenario)) as file:
        drawn = tuple(file.header.parameters[name] for name in NAMES)
        energy = [
            0.5
            * float((file.read("velocity", f).astype(np.float64) ** 2).sum(-1).mean())
            for f in range(size.frame_count(scenario))
        ]
        walls = file.read("wall_velocity").astype(np.float64).reshape(len(energy), -1)
    moving = walls[:, walls.any(axis=0)]
    reversals = int(np.count_nonzero(np.diff(np.sign(moving), axis=0)))
    return *drawn, float(np.sqrt(np.mean(moving**2))), reversals, float(np.mean(energy))


if __name__ == "__main__":
    raise SystemExit(main())
