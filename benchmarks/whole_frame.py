"""Our solver on the cavity that ``conventional.py`` runs: one core, strict, fixed-point
sums.

    python benchmarks/whole_frame.py --grid 40 --substeps 2000

prints one JSON object: particle-substeps per second of wall time and core, and per
second of processor time (best of the repeats), and the mean kinetic energy per particle
at the end.
"""

from __future__ import annotations

import argparse
import json
import time

import numpy as np

from lagbench.generators import solver
from lagbench.generators.split import Device
from validation.experiment import (
    Case,
    initial_state,
    plan,
    solver_parameters,
)


def main() -> int:
    """Run the cavity at Reynolds number 100 and print its speed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--grid", type=int, default=40)
    parser.add_argument("--substeps", type=int, default=2000)
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args()
    experiment = plan(
        Case.CAVITY, reynolds=100.0, grid=options.grid, substeps=options.substeps
    )
    running = solver.build(solver_parameters(experiment), device=Device.CPU, threads=1)
    running.load([initial_state(experiment)])
    running.advance(1)
    wall = []
    processor = []
    for _ in range(options.repeats):
        start = time.perf_counter(), time.process_time()
        running.advance(options.substeps)
        wall.append(time.perf_counter() - start[0])
        processor.append(time.process_time() - start[1])
    work = experiment.particles * options.substeps
    speed = {
        "per_core": work / min(wall),
        "per_processor_second": work / min(processor),
        "energy": float(0.5 * np.mean(np.sum(running.velocity()[0] ** 2, axis=-1))),
    }
    print(json.dumps(speed))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
