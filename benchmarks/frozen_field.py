"""Print what a test subset asks of a model: how the frozen field fails, or how long it
stays active.

    python benchmarks/frozen_field.py --root FOLDER --data cavity/mini
        [SPLIT/SIZE ...] [--each]

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
    """Print one block per data set; return whether all of them ask enough."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--root", type=Path, required=True)
    parser.add_argument("--data", nargs="+", required=True, metavar="SPLIT/SIZE")
    parser.add_argument("--each", action="store_true", help="one line per scenario")
    options = parser.parse_args()
    failures = 0
    for name in options.data:
        split, size_name = name.split("/")
        size = load().size(split, size_name)
        is_free_surface = size.split in KINDS
        judge = _judge_activity if is_free_surface else _judge_frozen_field
        failures += not judge(size, options.root, options.each)
    return 1 if failures else 0


def _judge_frozen_field(size: Size, root: Path, each: bool) -> bool:
    """Print share below 0.8 and median relative error of the test subset."""
    correlations = []
    errors = []
    for scenario in size.subsets["test"]:
        with read_scenario(size.path(root, scenario)) as file:
            correlation, error = _score_frozen_field(size, file)
            parameters = file.header.parameters
        correlations.append(correlation)
        errors.append(error)
        if each:
            names = ("wall", "motion", "reynolds_number", "frequency")
            kind = [parameters[name] for name in names if name in parameters]
            print(
                f"  {scenario}: correlation {correlation:.3f}, error {error:.3f}; "
                f"{kind}",
                flush=True,
            )

    is_below = ~(np.array(correlations) >= FALLEN)  # undefined ones count
    share_below = float(np.mean(is_below))
    median_error = float(np.median(errors))
    print(
        f"{size.split} {size.name}: {share_below:.0%} of {len(errors)} below "
        f"{FALLEN}, median error {median_error:.2f}",
        flush=True,
    )
    is_hard_enough = size.split != "cavity" or median_error >= ERROR
    return share_below >= SHARE and is_hard_enough


def _score_frozen_field(size: Size, file: ScenarioFile) -> tuple[float, float]:
    """Return correlation at frame 54 and relative error over the horizon."""
    first = size.task.input_frames - 1
    last = first + size.task.horizon
    truth = file.read("position", slice(0, last + 1)).astype(np.float64)
    wall_velocity = file.read("wall_velocity", first).astype(np.float64)
    wall_displacement = wall_velocity * size.frame_interval  # [length/frame]
    path = _carry(size, truth[: first + 1], wall_displacement, last - first)

    grid = Grid(size.task.score_grid.cells, size.task.score_grid.placement)
    (low, high), _ = size.bounds
    full = grid.full_weight(size.particles, (high - low) ** 2)
    correlation = float("nan")
    squared_error = 0.0
    squared_truth = 0.0
    for frame in range(first + 1, last + 1):
        true_step = truth[frame] - truth[frame - 1]
        true_fields = fields(truth[frame], true_step, grid, full=full)
        position = path[frame - first]
        step = position - path[frame - first - 1]
        counted = true_fields.counted
        predicted_fields = fields(position, step, grid, full=full, counted=counted)
        nodes = true_fields.differentiable
        true_vorticity = true_fields.vorticity[nodes]
        vorticity = predicted_fields.vorticity[nodes]
        squared_error += np.mean((true_vorticity - vorticity) ** 2)
        squared_truth += np.mean(true_vorticity**2)
        if frame == min(FRAME, last):
            correlation = pearson(true_vorticity, vorticity)
    return correlation, float(np.sqrt(squared_error / squared_truth))


def _carry(size: Size, given: Array, wall_displacement: Array, steps: int) -> Array:
    """Return the positions to which the field carries the last given ones.

    The shape is [step + 1, particle, 2]; the first are the given ones.
    """
    (low, high), _ = size.bounds
    places, displacements = _with_mirror_images(
        size,
        (given[-1] + given[-2]) / 2,
        given[-1] - given[-2],
        wall_displacement,
    )
    linear = LinearNDInterpolator(places, displacements)
    nearest = NearestNDInterpolator(places, displacements)

    def field(position: Array) -> Array:
        inside = np.clip(position, low, high)
        values = linear(inside)
        is_outside = np.isnan(values[:, 0])  # of the hull of the places
        values[is_outside] = nearest(inside[is_outside])
        return np.asarray(values)

    decay = 1.0 if size.split == "cavity" else _decay(given)
    path = [given[-1]]
    factor = 1.0
    for _ in range(steps):
        factor *= decay
        position = path[-1]
        midpoint = position + factor * field(position) / 2
        path.append(np.clip(position + factor * field(midpoint), low, high))
    return np.array(path)


def _with_mirror_images(
    size: Size, position: Array, displacement: Array, wall_displacement: Array
) -> tuple[Array, Array]:
    """Add the mirror images of the particles near the walls.

    The walls' displacements [length/frame] are in the order left, right, bottom, top.
    """
    places = [position]
    displacements = [displacement]
    for axis, bounds in enumerate(size.bounds):
        for side, wall in enumerate(bounds):
            is_near = np.abs(position[:, axis] - wall) < MIRRORED
            image = position[is_near].copy()
            image[:, axis] = 2 * wall - image[:, axis]
            image_displacement = displacement[is_near].copy()
            if size.split == "cavity":
                wall_index = 2 * axis + side
                moving_wall = wall_displacement[wall_index]
                image_displacement = 2 * moving_wall - image_displacement
            else:
                image_displacement[:, axis] *= -1
            places.append(image)
            displacements.append(image_displacement)
    return np.concatenate(places), np.concatenate(displacements)


def _decay(given: Array) -> float:
    """Return the factor on the speed per frame, at most 1.

    It is fitted to the RMS speeds of the given frames.
    """
    displacement = np.diff(given, axis=0)
    speed = np.sqrt(np.mean(displacement**2, axis=(1, 2)))
    slope, _ = np.polyfit(np.arange(len(speed)), np.log(speed), 1)
    return min(1.0, float(np.exp(slope)))


def _judge_activity(size: Size, root: Path, each: bool) -> bool:
    """Print the median of active frames of each pair or family, over all scenarios."""
    counts_by_kind = defaultdict(list)
    for scenario in size.scenarios:
        with read_scenario(size.path(root, scenario)) as file:
            parameters = file.header.parameters
        kind = parameters[KINDS[size.split]]
        active_frames = parameters["active_frames"]
        counts_by_kind[kind].append(active_frames)
        if each:
            print(f"  {scenario}: {kind} {active_frames}")
    medians = []
    for kind, counts in counts_by_kind.items():
        median = np.median(counts)
        medians.append(median)
        print(
            f"{size.split} {size.name}, {kind}: median {median:g} active frames "
            f"of {size.task.horizon}, {min(counts)} to {max(counts)}"
        )
    return size.name == "tiny" or min(medians) >= ACTIVE


if __name__ == "__main__":
    raise SystemExit(main())
