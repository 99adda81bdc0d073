"""How far the truth of a data set is from a run that is twice as fine.

For the first three test scenarios the solver runs with the refinement of the data set
and with twice that. The truth error is the metric that ranks, between the two, mean
over the scenarios: differences between entries that are smaller mean nothing.

usage: python -m validation.truth_error --split cavity --size tiny
           [--scenarios 3,4] [--registry datasets.yaml]

The number goes to the block ``measured`` of datasets.yaml where the data set is
recorded there.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lagbench.atomic import write_atomically
from lagbench.data.checksums import round_digits
from lagbench.data.registry import Size, default_path, load
from lagbench.generators.batch import draw_initial_state
from lagbench.generators.constants import solver_constants
from lagbench.generators.record import replace_measured
from lagbench.generators.refinement import recorded_particles, refined
from lagbench.generators.solver import build
from lagbench.metrics.table import ranking_metric

from .distance import error_between

SCENARIOS = 3
"""Test scenarios of which the mean is taken."""

Singles = NDArray[np.float32]


def simulate(
    size: Size, scenario: int, refinement: int, like: Singles | None = None
) -> Singles:
    """Run a scenario to the end of its horizon; nothing is written.

    Args:
        size: the split and size.
        scenario: id.
        refinement: that of the run.
        like: positions in the last given frame [length], shape [particle, axis]. Where
            given, the particles that are nearest to them then are recorded, from that
            frame on; else those of the files, from frame 0 on.

    Returns:
        Positions [length], shape [frame, particle, axis].
    """
    fine_size = refined(size, refinement)
    state = draw_initial_state(fine_size, scenario)
    coarse = draw_initial_state(size, scenario)
    solver = build(solver_constants(fine_size), threads=1)
    solver.load([state])
    last_given = size.task.input_frames - 1
    first = 0 if like is None else last_given
    solver.advance((state.start_frame + first) * fine_size.substeps_per_frame)
    if like is not None:
        coarse = replace(coarse, position=like.astype(np.float64))
        state = replace(state, position=solver.position()[0].astype(np.float64))
    particles = np.arange(size.particles)
    if refinement > 1:
        particles = recorded_particles(coarse, state)
    frames = [solver.position()[0, particles]]
    for _ in range(first + 1, size.task.input_frames + size.task.horizon):
        solver.advance(fine_size.substeps_per_frame)
        frames.append(solver.position()[0, particles])
    return np.stack(frames)


def truth_error(size: Size, scenario: int) -> float:
    """Return the ranking metric between the truth and a run twice as fine.

    Both follow the particles that are in the same places in the last given frame.
    """
    truth = simulate(size, scenario, size.refinement)
    first = size.task.input_frames
    last_given = truth[first - 1]
    finer = simulate(size, scenario, 2 * size.refinement, like=last_given)
    state = draw_initial_state(size, scenario)
    return error_between(
        size,
        finer[1:],
        truth[first:],
        given=truth[:first],
        previous=finer[0],
        material=state.material,
        area=state.area,
    )


def write_truth_error(size: Size, value: float, registry: Path) -> None:
    """Write a truth error to the measured block of a datasets.yaml."""
    measured = load(registry).measured
    sizes = dict(measured[size.split])
    update = {"truth_error": round_digits(value, 4)}
    sizes[size.name] = sizes[size.name].model_copy(update=update)
    text = registry.read_text(encoding="utf-8")
    text = replace_measured(text, {**measured, size.split: sizes})
    write_atomically(registry, text.encode())


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line of this module; return its exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--split", required=True)
    parser.add_argument("--size", required=True)
    parser.add_argument("--scenarios")
    parser.add_argument("--registry", type=Path, default=default_path().resolve())
    options = parser.parse_args(arguments)
    size = load(options.registry).size(options.split, options.size)
    scenarios = size.subsets["test"][:SCENARIOS]
    if options.scenarios:
        scenarios = tuple(int(word) for word in options.scenarios.split(","))

    metric = ranking_metric(size)
    errors = []
    for scenario in scenarios:
        errors.append(truth_error(size, scenario))
        line = f"{size.split} {size.name} {scenario}: {metric} {errors[-1]:.4f}\n"
        sys.stdout.write(line)
        sys.stdout.flush()
    mean = float(np.mean(errors))
    sys.stdout.write(f"{size.split} {size.name}: truth error {mean:.4f}\n")
    if size.measured is not None:
        write_truth_error(size, mean, options.registry)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
