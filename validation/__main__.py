"""Validate the closed-box solver: Ghia's cavity, or the decay of curl noise.

    python -m validation --case cavity --re 400 --substeps 100000 --json re400.json
    python -m validation --case curl-noise --frequency 4 --json curl.json

Writes u and v at the points of Ghia, Ghia & Shin (1982), their error against the tables
at Reynolds numbers 100, 400, 1000, 3200 and 5000, the range of J, empty cells (every
10,000 substeps and at the end), kinetic energy per frame, divergence against vorticity,
and the time taken. All but the entries under "timing" is the same in every run. Exit
code 0: done; 2: bad options; 5: the solver failed; 130: interrupted.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import Progress

from lagbench.data.checksums import round_digits
from lagbench.errors import LagbenchError, UsageError, WorkFailedError
from lagbench.generators.split import Device

from .diagnostics import CentreLines, X, Y, box_of, centre_lines, draw_profiles
from .experiment import (
    Case,
    Experiment,
    ExperimentResult,
    plan,
    run,
    solver_parameters,
)
from .output import check_writable

# significant digits of the numbers in the JSON file: fewer than libraries differ in
DIGITS = 9
JSON = dict[str, Any]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code."""
    options = _parser().parse_args(arguments)
    try:
        sys.stdout.write(summary(perform(options)) + "\n")
    except (LagbenchError, OSError) as error:
        sys.stderr.write(f"error: {error}\n")
        return getattr(error, "exit_code", WorkFailedError.exit_code)
    except KeyboardInterrupt:
        sys.stderr.write("interrupted\n")
        return 130
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m validation",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("--case", type=Case, choices=list(Case), required=True, help="which closed box")
    add("--json", type=Path, metavar="FILE", help="results")
    add(
        "--re",
        type=float,
        metavar="R",
        help="Reynolds number; curl-noise is inviscid without it",
    )
    add(
        "--grid",
        type=int,
        default=40,
        metavar="N",
        help="cells across the unit box (default 40)",
    )
    add(
        "--particles",
        type=int,
        metavar="P",
        help="particles (default 8192 (N/40)^2, curl-noise 8096)",
    )
    add(
        "--substeps",
        type=int,
        metavar="K",
        help="solver steps (default 100000, curl-noise 600 frames)",
    )
    add("--dt", type=float, help="substep in seconds (default 2e-3 * 40/N)")
    add("--lid-speed", type=float, metavar="U", help="speed of the lid (default 0.15)")
    add(
        "--lid-off-after",
        type=int,
        metavar="K",
        help="substep after which the lid stands still",
    )
    add(
        "--frequency",
        type=int,
        metavar="F",
        help="Perlin frequency of curl noise (default 4)",
    )
    add(
        "--seed",
        type=int,
        default=0,
        help="seed of the particle lattice and the stirring",
    )
    add(
        "--device",
        type=Device,
        choices=list(Device),
        default=Device.CPU,
        help="where to run",
    )
    add("--profiles", type=Path, metavar="PNG", help="draw the centre lines (cavity)")
    return parser


def perform(options: argparse.Namespace) -> JSON:
    """Run what the options ask for, write the files and return the results."""
    experiment = _plan(options)
    # Make sure that the files can be written, before the long run.
    _check_profiles(options.profiles, experiment.case)
    check_writable("--json", options.json)
    check_writable("--profiles", options.profiles)

    console = Console(stderr=True)
    with Progress(console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task(experiment.case.value, total=experiment.substeps)

        def report(done: int) -> None:
            progress.update(task, completed=done)

        result = run(experiment, device=options.device, report=report)

    results = document(result)
    if options.json is not None:
        text = json.dumps(results, indent=1, allow_nan=False) + "\n"
        options.json.write_text(text, encoding="utf-8")
    if options.profiles is not None and result.profiles is not None:
        _draw(result, options.profiles)
    return results


def _plan(options: argparse.Namespace) -> Experiment:
    """Return the experiment that the options describe."""
    substeps = options.substeps
    if substeps is None and options.case is Case.CAVITY:
        substeps = 100_000
    elif substeps is None:
        substeps = 30_000 * options.grid // 40
    return plan(
        options.case,
        substeps=substeps,
        reynolds=options.re,
        grid=options.grid,
        particles=options.particles,
        dt=options.dt,
        lid_speed=options.lid_speed,
        lid_off_after=options.lid_off_after,
        frequency=options.frequency,
        seed=options.seed,
    )


def _check_profiles(path: Path | None, case: Case) -> None:
    """Refuse a picture of what has no profiles, or in another format."""
    if path is None:
        return
    if case is not Case.CAVITY:
        raise UsageError(
            "curl noise has no centre-line profiles; leave it out", where="--profiles"
        )
    if path.suffix.lower() not in {".png", ".pdf", ".svg"}:
        raise UsageError(
            f"not a picture format: {path}, expected .png, .pdf or .svg",
            where="--profiles",
        )


def _draw(result: ExperimentResult, path: Path) -> None:
    """Draw the profiles of a cavity."""
    experiment = result.experiment
    if result.profiles is None:
        return
    grid = f"{experiment.grid} x {experiment.grid}"
    title = f"Re {experiment.reynolds:g}, {grid}, {experiment.substeps} substeps"
    reference = centre_lines(experiment.reynolds or 0.0)
    draw_profiles(result.profiles, reference, title, path)


def round_floats(value: object) -> object:
    """Return a JSON value with its floats rounded to :data:`DIGITS` significant digits.

    Numbers that are not finite become null.
    """
    if isinstance(value, float):
        return round_digits(value, DIGITS) if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: round_floats(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [round_floats(item) for item in value]
    return value


def document(result: ExperimentResult) -> JSON:
    """Return everything a run has shown, as the JSON file states it."""
    experiment = result.experiment
    checks = result.checks
    parameters = solver_parameters(experiment)
    box = box_of(parameters)
    minima = [check.jacobian_min_outside_lid_corners for check in checks]
    maxima = [check.jacobian_max_outside_lid_corners for check in checks]
    results: JSON = {
        "format": 1,
        "case": experiment.case.value,
        "settings": asdict(experiment),
        "parameters": asdict(parameters),
        "box": [box.low, box.high],
        "time": experiment.substeps * experiment.dt,
        "centre_lines": _centre_line_points(result),
        "ghia": _ghia_errors(result),
        "jacobian": {
            "min": min(check.jacobian_min for check in checks),
            "max": max(check.jacobian_max for check in checks),
            "min_outside_lid_corners": min(minima),
            "max_outside_lid_corners": max(maxima),
        },
        "empty_cells": max(check.empty_cells for check in checks),
        "divergence_over_vorticity": checks[-1].divergence_over_vorticity,
        "checks": [asdict(check) for check in checks],
        "kinetic_energy": {
            "substep": result.frame_substeps,
            "value": result.kinetic_energy,
        },
        "energy_retention": result.retention,
        "largest_rise_after_lid_off": result.largest_rise_after_lid_off,
        "timing": _timing(result),
    }
    return {key: round_floats(value) for key, value in results.items()}


def _timing(result: ExperimentResult) -> JSON:
    experiment = result.experiment
    particle_substeps = experiment.particles * experiment.substeps
    return {
        "solver_seconds": result.seconds,
        "nanoseconds_per_particle_substep": 1e9 * result.seconds / particle_substeps,
        "particle_substeps_per_second": particle_substeps / result.seconds,
    }


def _ghia_errors(result: ExperimentResult) -> JSON | None:
    """Return the errors against the tables; None where there are none."""
    deviations = result.deviations()
    if deviations is None:
        return None
    u, v = deviations
    return {
        "u_rmse": u.rmse,
        "v_rmse": v.rmse,
        "u_max": u.maximum,
        "v_max": v.maximum,
    }


def _centre_line_points(result: ExperimentResult) -> JSON | None:
    """Return our velocities at the tabulated points beside Ghia's; None without
    profiles.
    """
    if result.profiles is None:
        return None
    experiment = result.experiment
    measured = result.profiles.at_reference_points()
    reference = centre_lines(experiment.reynolds or 0.0)
    if reference is None:
        unknown = np.full(len(X), np.nan)
        reference = CentreLines(u=unknown, v=unknown)

    u_points = []
    for y, u, ghia in zip(Y, measured.u, reference.u, strict=True):
        u_points.append({"y": y, "u": float(u), "ghia": float(ghia)})
    v_points = []
    for x, v, ghia in zip(X, measured.v, reference.v, strict=True):
        v_points.append({"x": x, "v": float(v), "ghia": float(ghia)})
    return {
        "averaged_substeps": [result.averaged_from, experiment.substeps],
        "u": u_points,
        "v": v_points,
    }


def summary(results: JSON) -> str:
    """Return the results in a few lines."""
    lines = []
    if results["largest_rise_after_lid_off"] is not None:
        rise = results["largest_rise_after_lid_off"]
        lines.append(f"largest rise of energy with the lid off {rise:.2e}")
    if results["case"] == Case.CURL_NOISE and results["energy_retention"] is not None:
        ratio = f"divergence over vorticity {results['divergence_over_vorticity']:.4f}"
        lines.append(f"energy left {results['energy_retention']:.3f}, {ratio}")
    if results["ghia"] is not None:
        errors = [f"{name} {value:.4f}" for name, value in results["ghia"].items()]
        lines.append(f"against Ghia: {', '.join(errors)}")

    j = results["jacobian"]
    everywhere = f"{j['min']:.4f} to {j['max']:.4f}"
    outside = (
        f"{j['min_outside_lid_corners']:.4f} to {j['max_outside_lid_corners']:.4f}"
    )
    empty = results["empty_cells"]
    lines.append(
        f"J {everywhere}, outside the lid corners {outside}; empty cells {empty}"
    )
    speed = results["timing"]["nanoseconds_per_particle_substep"]
    lines.append(f"{speed:.1f} ns per particle and substep")
    return "\n".join(lines)


if __name__ == "__main__":
    raise SystemExit(main())
