"""Validate the closed-box solver: Ghia's cavity, or the decay of curl noise.

    python -m lagbench.generators.acceptance --case cavity --re 400 --substeps 100000
    --json re400.json python -m lagbench.generators.acceptance --case curl-noise
    --frequency 4 --json curl.json

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
from lagbench.generators.solver import Device

from .diagnostics import X, Y, box_of, centre_lines, draw
from .experiment import Case, Result, plan, run, solver_parameters

# significant digits of the numbers in the JSON file: fewer than libraries differ in
DIGITS = 9
JSON = dict[str, Any]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m lagbench.generators.acceptance",
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
    given = parser.parse_args(arguments)
    try:
        sys.stdout.write(summary(perform(given)) + "\n")
    except (LagbenchError, OSError) as error:
        sys.stderr.write(f"error: {error}\n")
        return getattr(error, "exit_code", WorkFailedError.exit_code)
    except KeyboardInterrupt:
        sys.stderr.write("interrupted\n")
        return 130
    return 0


def perform(given: argparse.Namespace) -> JSON:
    """Run what the options ask for, write the files and return the results."""
    substeps = given.substeps
    if substeps is None:
        substeps = 100_000 if given.case is Case.CAVITY else 30_000 * given.grid // 40
    same = (
        "grid",
        "particles",
        "dt",
        "lid_speed",
        "lid_off_after",
        "frequency",
        "seed",
    )
    others = {name: getattr(given, name) for name in same}
    experiment = plan(given.case, substeps=substeps, reynolds=given.re, **others)
    # Make sure that the files can be written, before the long run.
    if given.profiles is not None and given.case is not Case.CAVITY:
        raise UsageError(
            "curl noise has no centre-line profiles",
            where="--profiles",
            fix="leave it out",
        )
    if given.profiles is not None and given.profiles.suffix.lower() not in {
        ".png",
        ".pdf",
        ".svg",
    }:
        raise UsageError(
            "not a picture format",
            where="--profiles",
            expected=".png, .pdf or .svg",
            got=given.profiles,
        )
    files = {"--json": given.json, "--profiles": given.profiles}
    for flag, path in (
        (flag, path) for flag, path in files.items() if path is not None
    ):
        fresh = not path.exists()
        try:
            path.absolute().parent.mkdir(parents=True, exist_ok=True)
            path.open("ab").close()
        except OSError as error:
            raise UsageError(
                "the file cannot be written",
                where=f"{flag} {path}",
                expected="a file in a folder that you may write to",
                got=error.strerror,
            ) from error
        if fresh:
            path.unlink()
    console = Console(stderr=True)
    with Progress(console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task(experiment.case.value, total=experiment.substeps)
        result = run(
            experiment,
            device=given.device,
            report=lambda done: progress.update(task, completed=done),
        )
    found = document(result)
    if given.json is not None:
        given.json.write_text(
            json.dumps(found, indent=1, allow_nan=False) + "\n", encoding="utf-8"
        )
    if given.profiles is not None and result.profiles is not None:
        e = experiment
        title = f"Re {e.reynolds:g}, {e.grid} x {e.grid}, {e.substeps} substeps"
        draw(result.profiles, centre_lines(e.reynolds or 0.0), title, given.profiles)
    return found


def rounded(value: object) -> object:
    """Return a JSON value with its floats cut to significant digits, NaN as null."""
    if isinstance(value, float):
        return round_digits(value, DIGITS) if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: rounded(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [rounded(item) for item in value]
    return value


def document(result: Result) -> JSON:
    """Return everything a run has shown, as the JSON file states it."""
    e = result.experiment
    checks = result.checks
    parameters = solver_parameters(e)
    box = box_of(parameters)
    work = e.particles * e.substeps
    against: JSON | None = None
    lines: JSON | None = None
    if (apart := result.deviations()) is not None:
        u, v = apart
        against = {
            "u_rmse": u.rmse,
            "v_rmse": v.rmse,
            "u_max": u.maximum,
            "v_max": v.maximum,
        }
    if result.profiles is not None:
        ours = result.profiles.at_reference_points()
        ghia = centre_lines(e.reynolds or 0.0)
        lines = {"averaged_substeps": [result.averaged_from, e.substeps]}
        for name, along, abscissae in (("u", "y", Y), ("v", "x", X)):
            known = (
                np.full(len(abscissae), np.nan) if ghia is None else getattr(ghia, name)
            )
            points = zip(abscissae, getattr(ours, name), known, strict=True)
            lines[name] = [
                {along: x, name: float(v), "ghia": float(theirs)}
                for x, v, theirs in points
            ]
    found: JSON = {
        "format": 1,
        "case": e.case.value,
        "settings": asdict(e),
        "parameters": asdict(parameters),
        "box": [box.low, box.high],
        "time": e.substeps * e.dt,
        "centre_lines": lines,
        "ghia": against,
        "jacobian": {
            "min": min(c.jacobian_min for c in checks),
            "max": max(c.jacobian_max for c in checks),
            "min_outside_lid_corners": min(
                c.jacobian_min_outside_lid_corners for c in checks
            ),
            "max_outside_lid_corners": max(
                c.jacobian_max_outside_lid_corners for c in checks
            ),
        },
        "empty_cells": max(c.empty_cells for c in checks),
        "divergence_over_vorticity": checks[-1].divergence_over_vorticity,
        "checks": [asdict(c) for c in checks],
        "kinetic_energy": {
            "substep": result.frame_substeps,
            "value": result.kinetic_energy,
        },
        "energy_retention": result.retention,
        "largest_rise_after_lid_off": result.largest_rise_after_lid_off,
        "timing": {
            "solver_seconds": result.seconds,
            "nanoseconds_per_particle_substep": 1e9 * result.seconds / work,
            "particle_substeps_per_second": work / result.seconds,
        },
    }
    return {key: rounded(value) for key, value in found.items()}


def summary(found: JSON) -> str:
    """Return the results in a few lines."""
    j = found["jacobian"]
    ghia_error = found["ghia"]
    lines = [
        f"J {j['min']:.4f} to {j['max']:.4f}, outside the lid corners "
        f"{j['min_outside_lid_corners']:.4f} "
        f"to {j['max_outside_lid_corners']:.4f}; empty cells {found['empty_cells']}",
        f"{found['timing']['nanoseconds_per_particle_substep']:.1f} ns per particle "
        f"and substep",
    ]
    if ghia_error is not None:
        lines.insert(
            0,
            "against Ghia: " + ", ".join(f"{k} {v:.4f}" for k, v in ghia_error.items()),
        )
    if found["case"] == Case.CURL_NOISE and found["energy_retention"] is not None:
        ratio = f"divergence over vorticity {found['divergence_over_vorticity']:.4f}"
        lines.insert(0, f"energy left {found['energy_retention']:.3f}, {ratio}")
    if found["largest_rise_after_lid_off"] is not None:
        lines.insert(
            0,
            f"largest rise of energy with the lid off "
            f"{found['largest_rise_after_lid_off']:.2e}",
        )
    return "\n".join(lines)


if __name__ == "__main__":
    raise SystemExit(main())
