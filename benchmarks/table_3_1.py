"""Regenerate Table 3.1 and Fig. 3.1 of the thesis: solver time over the quality factor
q.

    python benchmarks/table_3_1.py --rows 1-4 --device cpu --output docs/figures

writes table_3_1_DEVICE.md and table_3_1_DEVICE.png and prints the table. The rows take
particles, grid and substeps per frame from the thesis; a block of liquid, four
particles per cell, falls and spreads (free-surface solver). Times are the best of the
repeats, in milliseconds: processor time with --device cpu, so that other processes do
not count, and wall-clock time with the other devices. --machine names the machine in
the text above the table.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from lagbench.data.layout import parse_ids
from lagbench.errors import LagbenchError, UsageError
from lagbench.generators import solver
from lagbench.generators.split import (
    Device,
    FreeSurfaceParameters,
    InitialState,
    Material,
)

_LIQUID_MODULUS = 30.0
_COURANT = 0.4
_PER_CELL = 4

FIXED = 20
"""Substeps in a run that measures the time of one substep."""


@dataclass(frozen=True)
class ThesisRow:
    """One row of Table 3.1 as the thesis prints it; times on its GPU [ms]."""

    q: int
    particles: int
    grid: int
    substeps: int
    substep_ms: float
    frame_ms: float


THESIS = (
    ThesisRow(1, 16_384, 128, 20, 0.06, 1.17),
    ThesisRow(2, 65_536, 256, 20, 0.14, 5.33),
    ThesisRow(3, 147_456, 384, 40, 0.51, 41.46),
    ThesisRow(4, 262_144, 512, 40, 0.73, 73.66),
    ThesisRow(5, 589_824, 768, 80, 0.85, 136.09),
    ThesisRow(6, 819_024, 896, 80, 1.14, 180.05),
    ThesisRow(7, 1_024_576, 1024, 120, 1.60, 238.69),
    ThesisRow(8, 1_048_576, 1024, 160, 2.25, 361.89),
    ThesisRow(9, 1_324_104, 1152, 180, 3.08, 562.43),
)


@dataclass(frozen=True, kw_only=True)
class TimedRow:
    """Our times for one row, in milliseconds."""

    row: ThesisRow
    substep_ms: float
    frame_ms: float


@dataclass(frozen=True, kw_only=True)
class Exponents:
    """Slopes of log time over log size."""

    frame_q2: float  # of t/frame against q^2 (Eq. 3.2)
    frame_particles: float  # of t/frame against particles
    substep_particles: float  # of t/substep against particles


def block(row: ThesisRow) -> tuple[FreeSurfaceParameters, InitialState]:
    """Return a square block of liquid above the floor, at rest."""
    parameters = FreeSurfaceParameters(
        particles=row.particles,
        grid=row.grid,
        dt=_COURANT / (row.grid * _LIQUID_MODULUS**0.5),
        wall=3,
        gravity=2.5,
        density=1.0,
        liquid_modulus=_LIQUID_MODULUS,
        liquid_viscosity=1e-3,
        jacobian_relaxation=0.2,
        density_coupling=0.01,
        jacobian_min=0.5,
        jacobian_max=1.0,
    )
    columns = math.ceil(math.sqrt(row.particles))
    index = np.arange(row.particles)
    cell = np.stack([index // columns, index % columns], axis=-1)
    side_cells = (row.particles / _PER_CELL) ** 0.5
    side = side_cells / row.grid
    corner = np.array([0.5 - side / 2.0, 0.2])
    position = corner + side * (cell + 0.5) / columns
    state = InitialState(
        position=np.rint(position * 2.0**20) / 2.0**20,
        velocity=np.zeros((row.particles, 2)),
        affine=np.zeros((row.particles, 2, 2)),
        material=np.full(row.particles, Material.LIQUID, dtype=np.int8),
        area=side**2,
    )
    return parameters, state


def start(row: ThesisRow, device: Device) -> solver.Solver:
    """Build the solver of a row, load the block and compile."""
    parameters, state = block(row)
    threads = None
    if device is Device.CPU:
        threads = 1
    running = solver.build(parameters, device=device, threads=threads)
    running.load([state])
    running.advance(2)
    return running


def best_ms(
    running: solver.Solver,
    substeps: int,
    repeats: int,
    clock: Callable[[], float] = time.process_time,
) -> float:
    """Return the shortest time of advancing by some substeps [ms], positions
    fetched.
    """
    times = []
    for _ in range(repeats):
        begin = clock()
        running.advance(substeps)
        running.position()
        times.append(clock() - begin)
    return 1e3 * min(times)


def measure(row: ThesisRow, *, device: Device, repeats: int) -> TimedRow:
    """Time one row: substeps in runs of a fixed number, and frames of its own
    substeps.
    """
    running = start(row, device)
    if device is Device.CPU:
        clock = time.process_time
    else:
        clock = time.perf_counter
    return TimedRow(
        row=row,
        substep_ms=best_ms(running, FIXED, repeats, clock) / FIXED,
        frame_ms=best_ms(running, row.substeps, repeats, clock),
    )


def _fit_exponents(
    rows: Sequence[ThesisRow], times: Sequence[ThesisRow | TimedRow]
) -> Exponents:
    """Return the slopes of lines through logarithms of sizes and times (Eq. 3.1).

    Args:
        rows: rows that state the sizes.
        times: the same rows with times.
    """
    squares = [row.q**2 for row in rows]
    particles = [row.particles for row in rows]
    substep_ms = [timed.substep_ms for timed in times]
    frame_ms = [timed.frame_ms for timed in times]
    return Exponents(
        frame_q2=_slope(squares, frame_ms),
        frame_particles=_slope(particles, frame_ms),
        substep_particles=_slope(particles, substep_ms),
    )


def _slope(x: Sequence[float], y: Sequence[float]) -> float:
    if len(x) < 2:
        return float("nan")
    slope, _ = np.polyfit(np.log10(x), np.log10(y), 1)
    return float(slope)


def exponents_of_thesis(rows: Sequence[ThesisRow] = THESIS) -> Exponents:
    """Return the exponents of the thesis's times."""
    return _fit_exponents(rows, rows)


def exponents_of_measurements(measurements: Sequence[TimedRow]) -> Exponents:
    """Return the exponents of our times."""
    rows = [measurement.row for measurement in measurements]
    return _fit_exponents(rows, measurements)


def describe(device: str, *, machine: str, repeats: int) -> list[str]:
    """Return the title of the table and the paragraphs that explain it."""
    ours = f"with `--device {device}`"
    if machine:
        ours = f"{ours} on {machine}"
    clock = "as wall-clock time in milliseconds"
    if device == Device.CPU:
        clock = "as processor time in milliseconds"
    consequence = "On a CPU the copy takes little time."
    if device == Device.CUDA:
        consequence = "On a GPU the copy takes long, so t/substep is too large."
    return [
        "## Table 3.1: time of the solver for more and more particles",
        "",
        f"The table compares our solver, run {ours}, with the solver of the thesis. "
        "The solver of the thesis ran on the GPU of its author. (`lagbench cite "
        "cavity` names the thesis.) Row q has the particles, grid and substeps "
        "of row q in Table 3.1 of the thesis.",
        "",
        f"Our times are the shortest of {repeats} runs, {clock}. t/frame is the time "
        "of all substeps of a frame. fps means frames per second. t/substep comes "
        f"from separate runs of {FIXED} substeps. Each of these runs "
        f"also copies all positions once. {consequence}",
        "",
        "The two times of the thesis do not agree. In its rows 2 to 6, t/frame is "
        "larger than the product of substeps and t/substep, by a factor of 1.9 to 2.5. "
        "The last column compares t/frame.",
        "",
    ]


def markdown(
    measurements: Sequence[TimedRow],
    device: str,
    *,
    repeats: int,
    machine: str = "",
) -> str:
    """Return Table 3.1 with our times beside the thesis's, and the exponents."""
    lines = [
        *describe(device, machine=machine, repeats=repeats),
        "| q | q^2 | particles | grid | substeps | t/substep | t/frame | fps "
        "| thesis t/substep | thesis t/frame | thesis t/frame / our t/frame |",
        "|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|",
    ]
    for m in measurements:
        r = m.row
        lines.append(
            f"| {r.q} | {r.q**2} | {r.particles:,} | {r.grid} x {r.grid} | "
            f"{r.substeps} | {m.substep_ms:.3g} "
            f"| {m.frame_ms:.4g} | {1e3 / m.frame_ms:.4g} | {r.substep_ms} | "
            f"{r.frame_ms} "
            f"| {r.frame_ms / m.frame_ms:.3g} |"
        )
    lines += [
        "",
        "The next table shows how the times grow. A row `a against b` has the "
        "exponent p in a ~ b^p, from a least-squares fit. *Same rows* are the rows of "
        "the table above. *All rows* are the nine rows of the thesis.",
        "",
        "| exponent p | ours | thesis, same rows | thesis, all rows |",
        "|---|--:|--:|--:|",
    ]
    rows = [measurement.row for measurement in measurements]
    columns = (
        exponents_of_measurements(measurements),
        exponents_of_thesis(rows),
        exponents_of_thesis(),
    )
    for name, words in (
        ("frame_q2", "t/frame against q^2"),
        ("frame_particles", "t/frame against particles"),
        ("substep_particles", "t/substep against particles"),
    ):
        cells = " | ".join(f"{getattr(column, name):.2f}" for column in columns)
        lines.append(f"| {words} | {cells} |")
    return "\n".join(lines) + "\n"


def read_rows(text: str) -> list[ThesisRow]:
    """Return the rows whose values of q a text names, as in 1-4.

    Raises:
        UsageError: a row does not exist.
    """
    numbers = parse_ids(text, where="--rows", noun="q")
    rows = [row for row in THESIS if row.q in numbers]
    if len(rows) < len(numbers):
        raise UsageError(
            "Table 3.1 has no such rows",
            where="--rows",
            expected=f"values of q from {THESIS[0].q} to {THESIS[-1].q}",
            got=repr(text),
            fix="give them as in --rows 1-4",
        )
    return rows


def draw(measurements: Sequence[TimedRow], device: str, path: Path) -> None:
    """Draw Fig. 3.1: (a) log-log with lines, (b) linear with second-degree fits.

    A line needs two points, and a fit of second degree needs three.
    """
    figure = Figure(figsize=(10.0, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    our_points = []
    for measurement in measurements:
        point = (measurement.row.q**2, measurement.frame_ms)
        our_points.append(point)
    thesis_points = []
    for row in THESIS:
        point = (row.q**2, row.frame_ms)
        thesis_points.append(point)
    series = (
        (f"ours, {device}", "C0", our_points),
        ("thesis, GPU", "C3", thesis_points),
    )
    for name, colour, points in series:
        x, y = np.array(points, dtype=float).T
        line = np.linspace(x.min(), x.max(), 200)
        left.loglog(x, y, "o", color=colour)
        if len(points) >= 2:
            slope, offset = np.polyfit(np.log10(x), np.log10(y), 1)
            power_law = 10**offset * line**slope
            label = f"{name}: slope {slope:.2f}"
            left.loglog(line, power_law, color=colour, label=label)
        right.plot(x, y, "o", color=colour)
        if len(points) >= 3:
            parabola = np.polyfit(x, y, 2)
            fitted = np.polyval(parabola, line)
            right.plot(line, fitted, color=colour, label=name)
    for axes, title in ((left, "(a) log-log"), (right, "(b) second-degree fit")):
        axes.set(xlabel="q^2", ylabel="t/frame [ms]", title=title)
        axes.grid(alpha=0.3)
        axes.legend()
    figure.savefig(path, dpi=150)


def main() -> int:
    """Measure the rows that were asked for, write table and figure."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rows", default="1-4", help="first and last q, such as 1-4")
    parser.add_argument(
        "--device",
        type=Device,
        default=Device.CPU,
        choices=list(Device),
    )
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--machine", default="", help="as in 'an NVIDIA H100'")
    parser.add_argument("--output", type=Path, default=Path("docs/figures"))
    options = parser.parse_args()
    measurements = []
    for row in read_rows(options.rows):
        measurement = measure(row, device=options.device, repeats=options.repeats)
        measurements.append(measurement)

    device = options.device.value
    table = markdown(
        measurements, device, repeats=options.repeats, machine=options.machine
    )
    options.output.mkdir(parents=True, exist_ok=True)
    table_path = options.output / f"table_3_1_{device}.md"
    table_path.write_text(table, encoding="utf-8")
    draw(measurements, device, table_path.with_suffix(".png"))
    print(table)
    return 0


if __name__ == "__main__":
    try:
        raise SystemExit(main())
    except LagbenchError as error:
        print(f"table_3_1: {error}", file=sys.stderr)
        raise SystemExit(error.exit_code) from error
