"""Print what a test subset asks of a model: how the frozen field fails, or how long it
stays active.

    python benchmarks/frozen_field.py --root FOLDER --data cavity/mini [SPLIT/SIZE ...] [--each]

Full boxes: the velocity of the last given frame, linear between the particles, mirrored
at the walls (no-slip: 2 u_wall - u, free slip: normal component reversed), carries the
particles by midpoint steps; curl noise also by the decay fitted to the given frames.
Printed are the correlation of its vorticity with the true one at frame 54 (tiny: the
last) and its relative error over the horizon, sqrt(sum_f MSE(omega) / sum_f
mean(omega^2)). Free surfaces: active frames by pair or family. Exits with 1 where fewer
than 75 % of a full box's test correlate below 0.8, or a cavity's median error is below
0.8, or (mini, full) a pair's median of active frames is below 80.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator

from lagbench.data.grid import Grid, fields
from lagbench.data.registry import Size, load
from lagbench.data.scenario import ScenarioFile, read_scenario
from lagbench.metrics.vorticity import pearson

Array = NDArray[np.float64]

FRAME = 54
FALLEN = 0.8
SHARE = 0.75
ERROR = 0.8
ACTIVE = 80
KINDS = {"fluid": "family", "multimaterial": "pair"}
MIRRORED = 0.1
"""Depth of the layer that is mirrored at a wall [length]."""


def main() -> int:
    """Print one block per data set; tell whether all of them ask enough."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--root", type=Path, required=True)
    parser.add_argument("--data", nargs="+", required=True, metavar="SPLIT/SIZE")
    parser.add_argument("--each", action="store_true", help="one line per scenario")
    given = parser.parse_args()
    good = True
    for name in given.data:
        size = load().size(*name.split("/"))
        if size.split in KINDS:
            judge = _active
        else:
            judge = _frozen
        good = judge(size, given.root, given.each) and good
    if good:
        return 0
    return 1


def _frozen(size: Size, root: Path, each: bool) -> bool:
    """Print share below 0.8 and median relative error of the test subset."""
    found = []
    for scenario in size.subsets["test"]:
        with read_scenario(size.path(root, scenario)) as file:
            found.append(_scores(size, file))
            if each:
                told = file.header.parameters
                kind = [
                    told[k]
                    for k in ("wall", "motion", "reynolds_number", "frequency")
                    if k in told
                ]
                print(
                    f"  {scenario}: correlation {found[-1][0]:.3f}, error "
                    f"{found[-1][1]:.3f}; {kind}",
                    flush=True,
                )
    correlation, error = np.array(found).T
    below = float(np.mean(~(correlation >= FALLEN)))
    middle = float(np.median(error))
    print(
        f"{size.split} {size.name}: {below:.0%} of {len(found)} below {FALLEN}, "
        f"median error {middle:.2f}",
        flush=True,
    )
    return below >= SHARE and (size.split != "cavity" or middle >= ERROR)


def _scores(size: Size, file: ScenarioFile) -> tuple[float, float]:
    """Return correlation at frame 54 and relative error over the horizon."""
    first = size.task.input_frames - 1
    last = size.task.input_frames + size.task.horizon - 1
    truth = file.read("position", slice(0, last + 1)).astype(np.float64)
    walls = file.read("wall_velocity", first).astype(np.float64) * size.frame_interval
    ours = _carried(size, truth[: first + 1], walls, last - first)
    grid = Grid(size.task.score_grid.cells, size.task.score_grid.placement)
    (low, high), _ = size.bounds
    full = grid.full_weight(size.particles, (high - low) ** 2)
    correlation = float("nan")
    squares = []
    for k in range(first + 1, last + 1):
        true = fields(truth[k], truth[k] - truth[k - 1], grid, full=full)
        step = ours[k - first] - ours[k - first - 1]
        found = fields(ours[k - first], step, grid, full=full, counted=true.counted)
        a, b = (field.vorticity[true.differentiable] for field in (true, found))
        squares.append((np.mean((a - b) ** 2), np.mean(a**2)))
        if k == min(FRAME, last):
            correlation = pearson(a, b)
    wrong, size_of_truth = np.sum(squares, axis=0)
    return correlation, float(np.sqrt(wrong / size_of_truth))


def _carried(size: Size, given: Array, walls: Array, steps: int) -> Array:
    """Return the last given positions and where the field takes them, shape [step + 1,
    particle, 2].
    """
    (low, high), _ = size.bounds
    step = given[-1] - given[-2]
    places, speeds = _with_mirror_images(size, (given[-1] + given[-2]) / 2, step, walls)
    linear = LinearNDInterpolator(places, speeds)
    nearest = NearestNDInterpolator(places, speeds)

    def field(at: Array) -> Array:
        inside = np.clip(at, low, high)
        found = linear(inside)
        outside = np.isnan(found[:, 0])
        found[outside] = nearest(inside[outside])
        return np.asarray(found)

    if size.split == "cavity":
        decay = 1.0
    else:
        decay = _decay(given)
    path = [given[-1]]
    factor = 1.0
    for _ in range(steps):
        factor *= decay
        middle = path[-1] + factor * field(path[-1]) / 2
        path.append(np.clip(path[-1] + factor * field(middle), low, high))
    return np.array(path)


def _with_mirror_images(
    size: Size, at: Array, step: Array, walls: Array
) -> tuple[Array, Array]:
    """Add what the walls reflect; ``walls`` in length per frame, left, right, bottom,
    top.
    """
    places = [at]
    speeds = [step]
    for axis, bounds in enumerate(size.bounds):
        for side, wall in enumerate(bounds):
            near = np.abs(at[:, axis] - wall) < MIRRORED
            image = at[near].copy()
            speed = step[near].copy()
            image[:, axis] = 2 * wall - image[:, axis]
            if size.split == "cavity":
                speed = 2 * walls[2 * axis + side] - speed
            else:
                speed[:, axis] *= -1
            places.append(image)
            speeds.append(speed)
    return np.concatenate(places), np.concatenate(speeds)


def _decay(given: Array) -> float:
    """Return the factor on the speed per frame, fitted to the RMS speed of the given
    frames.
    """
    speed = np.sqrt(np.mean(np.diff(given, axis=0) ** 2, axis=(1, 2)))
    return min(
        1.0, float(np.exp(np.polyfit(np.arange(len(speed)), np.log(speed), 1)[0]))
    )


def _active(size: Size, root: Path, each: bool) -> bool:
    """Print the median of active frames of each pair or family, over all scenarios."""
    found = defaultdict(list)
    for scenario in size.scenarios:
        with read_scenario(size.path(root, scenario)) as file:
            told = file.header.parameters
            found[told[KINDS[size.split]]].append(told["active_frames"])
            if each:
                print(
                    f"  {scenario}: {told[KINDS[size.split]]} {told['active_frames']}"
                )
    for kind, counts in found.items():
        print(
            f"{size.split} {size.name}, {kind}: median {np.median(counts):g} "
            f"active frames"
            f" of {size.task.horizon}, {min(counts)} to {max(counts)}"
        )
    return (
        size.name == "tiny"
        or min(np.median(counts) for counts in found.values()) >= ACTIVE
    )


if __name__ == "__main__":
    raise SystemExit(main())
