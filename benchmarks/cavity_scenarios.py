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
import sys
from collections import Counter
from pathlib import Path

import numpy as np

from lagbench.data.registry import Size, load
from lagbench.data.scenario import read_scenario
from lagbench.errors import LagbenchError

NAMES = ("wall", "motion", "reynolds_number", "start_frame")

HEAD = """\
| id | walls | motion | Re | start frame | RMS speed [length/s] | reversals | \
mean kinetic energy |
|---:|---|---|---:|---:|---:|---:|---:|"""

ScenarioRow = tuple[object, object, object, object, float, int, float]
"""The values of a scenario in the order of the columns, after its id."""


def main() -> int:
    """Print one Markdown row per scenario and say whether all differ."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--root", type=Path, required=True)
    parser.add_argument("--size", default="full")
    parser.add_argument("--subset", default="train")
    options = parser.parse_args()
    size = load().size("cavity", options.size)
    print(HEAD)
    rows = []
    for scenario in size.subsets[options.subset]:
        row = _read_row(size, options.root, scenario)
        rows.append(row)
        wall, motion, reynolds, start, speed, reversals, energy = row
        print(
            f"| {scenario} | {wall} | {motion} | {reynolds:.1f} | {start} | "
            f"{speed:.4f} | {reversals} | {energy:.3e} |"
        )

    draws: Counter[tuple[object, ...]] = Counter()
    energies: Counter[float] = Counter()
    for *parameters, energy in rows:
        draws[tuple(parameters)] += 1
        energies[energy] += 1
    alike_count = 0
    for *parameters, energy in rows:
        if draws[tuple(parameters)] > 1 or energies[energy] > 1:
            alike_count += 1
    print(f"\n{len(rows)} scenarios, {alike_count} alike")
    return 1 if alike_count else 0


def _read_row(size: Size, root: Path, scenario: int) -> ScenarioRow:
    frame_count = size.frame_count(scenario)
    energies = []
    path = size.path(root, scenario)
    with read_scenario(path) as file:
        parameters = file.header.parameters
        for frame in range(frame_count):
            stored_velocity = file.read("velocity", frame)
            velocity = stored_velocity.astype(np.float64)
            squared_speed = np.sum(velocity**2, axis=-1)
            energy = 0.5 * float(squared_speed.mean())
            energies.append(energy)
        stored_walls = file.read("wall_velocity")
    wall_velocity = stored_walls.astype(np.float64)

    # velocity components of the walls that move, shape [frame, component]
    components = wall_velocity.reshape(frame_count, -1)
    ever_moves = components.any(axis=0)
    moving = components[:, ever_moves]
    mean_square = np.mean(moving**2)
    speed = float(np.sqrt(mean_square))
    reversals = 0
    for component in moving.T:
        # a wall that starts or stops does not change its direction
        signs = np.sign(component[component != 0.0])
        sign_changes = np.diff(signs)
        reversals += int(np.count_nonzero(sign_changes))
    wall, motion, reynolds, start = (parameters[name] for name in NAMES)
    return (
        wall,
        motion,
        reynolds,
        start,
        speed,
        reversals,
        float(np.mean(energies)),
    )


if __name__ == "__main__":
    try:
        raise SystemExit(main())
    except LagbenchError as error:
        print(f"cavity_scenarios: {error}", file=sys.stderr)
        raise SystemExit(error.exit_code) from error
