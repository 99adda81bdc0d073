"""Do bodies in free flight have the mean acceleration of gravity?

    python benchmarks/free_flight.py --root FOLDER [--split NAME ...] [--reach R ...]

Prints which share of the particles belongs to such bodies in the true data, and how far
the mean acceleration of these bodies is from gravity. Each row has another reach of the
forces (``model.free_flight`` of graph networks).
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import torch

from lagbench.baselines.free_flight import find_bodies
from lagbench.baselines.rollout import scenario_batch, scenario_paths
from lagbench.data.registry import Size
from lagbench.data.registry import load as load_registry
from lagbench.errors import LagbenchError
from lagbench.tensors import TensorBox

REACHES = (2.0, 2.8, 3.4, 4.0)  # reaches of forces [radius]
FRAME_STEP = 5  # frames between those that are measured
SCENARIOS = 12  # of train, at most


class FlyingBody(NamedTuple):
    """A body in free flight in one frame."""

    particles: int
    error: float  # largest component of mean acceleration less gravity [g]


def find_flying(size: Size, path: Path, reach: float) -> Iterator[FlyingBody]:
    """Yield the flying bodies of a scenario's frames.

    Args:
        size: split and size of the data.
        path: file of the scenario.
        reach: distance up to which particles act on each other [radius].
    """
    gravity = float(size.value("gravity")) * size.frame_interval**2
    fall = torch.zeros(size.dimension, dtype=torch.float64)
    fall[1] = -gravity
    box = TensorBox(size.box)
    length = reach * size.task.radius

    position = scenario_batch(path).position.double()
    sample = torch.zeros(len(position), dtype=torch.int64)
    for frame in range(2, position.shape[1] - 1, FRAME_STEP):
        before, now, after = position[:, frame - 1 : frame + 2].unbind(1)
        velocity = now - before
        acceleration = after - now - velocity
        body, flies = find_bodies(now, velocity, sample, reach=length, box=box)
        for number in flies.nonzero().flatten():
            members = acceleration[body == number]
            error = (members.mean(dim=0) - fall).abs().max()
            yield FlyingBody(len(members), float(error) / gravity)


def count_particle_frames(paths: Sequence[Path]) -> int:
    """Return the particles of all frames that are measured."""
    count = 0
    for path in paths:
        position = scenario_batch(path).position
        frames = len(range(2, position.shape[1] - 1, FRAME_STEP))
        count += frames * len(position)
    return count


def describe_mean(error_sum: float, particles: int) -> str:
    """Return the mean error of the flying particles; a text where no body flies."""
    if particles == 0:
        return "no body flies"
    return f"{error_sum / particles:.1e}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table; return the exit code."""
    parser = argparse.ArgumentParser(
        prog="python benchmarks/free_flight.py",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--root", type=Path, default=os.environ.get("LAGBENCH_ROOT"))
    parser.add_argument("--split", nargs="+", default=["fluid"])
    parser.add_argument("--size", default="mini")
    parser.add_argument(
        "--reach",
        nargs="+",
        type=float,
        default=REACHES,
        metavar="R",
        help="reaches of the forces [radius]",
    )
    options = parser.parse_args(arguments)
    if options.root is None:
        parser.error("name the folder of all data sets: --root FOLDER")
    if min(options.reach) <= 0.0:
        parser.error(f"a reach must be above 0; got {min(options.reach):g}")

    registry = load_registry()
    print("| data set | reach [radius] | share of particles | mean error [g] |")
    print("| --- | ---: | ---: | ---: |")
    for split in options.split:
        size = registry.size(split, options.size)
        paths_by_id = scenario_paths(
            split, subset="train", size=options.size, root=Path(options.root)
        )
        paths = list(paths_by_id.values())[:SCENARIOS]
        particle_frames = count_particle_frames(paths)
        for reach in options.reach:
            flying = 0
            error_sum = 0.0
            for path in paths:
                for body in find_flying(size, path, reach):
                    flying += body.particles
                    error_sum += body.particles * body.error
            share = flying / particle_frames
            error = describe_mean(error_sum, flying)
            print(f"| {split} {options.size} | {reach:g} | {share:.3f} | {error} |")
    return 0


if __name__ == "__main__":
    try:
        raise SystemExit(main())
    except LagbenchError as error:
        print(f"free_flight: {error}", file=sys.stderr)
        raise SystemExit(error.exit_code) from error
