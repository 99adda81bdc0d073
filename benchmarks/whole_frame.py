"""Our solver on the cavity that ``conventional.py`` runs: one core, strict, fixed-point
sums.

    PYTHONPATH=. python benchmarks/whole_frame.py --grid 40 --substeps 2000

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
        Case.CAVITY,
        reynolds=100.0,
        grid=options.grid,
        substeps=options.substeps,
    )
    parameters = solver_parameters(experiment)
    running = solver.build(parameters, device=Device.CPU, threads=1)
    state = initial_state(experiment)
    running.load([state])
    running.advance(1)
    wall_times = []  # [s]
    processor_times = []  # [s]
    for _ in range(options.repeats):
        wall_start = time.perf_counter()
        processor_start = time.process_time()
        running.advance(options.substeps)
        wall_times.append(time.perf_counter() - wall_start)
        processor_times.append(time.process_time() - processor_start)
    particle_substeps = experiment.particles * options.substeps
    (velocity,) = running.velocity()
    square_speed = np.sum(velocity**2, axis=-1)
    speed = {
        "per_core": particle_substeps / min(wall_times),
        "per_processor_second": particle_substeps / min(processor_times),
        "energy": float(0.5 * np.mean(square_speed)),
    }
    print(json.dumps(speed))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
