"""Plan data sets of large scenarios: measure rows of Table 3.1 and extrapolate to a
million particles.

    python benchmarks/scaling_plan.py --rows 2,4 --output docs/figures

writes scaling_plan.md and prints it. Row q has the particles, grid and substeps of the
thesis's Table 3.1; a body of liquid, four particles per cell, falls (split fluid,
scenario 0). Costs are processor times, so that other processes do not count: of parts
(solver, file, hash), and of whole generations with their checks, perturbed run and
cards, at two numbers of frames. Peak memory is that of the largest process; its growth
between the two numbers of frames says what of it depends on the length of a
scenario.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from table_3_1 import THESIS, ThesisRow

from lagbench.data.registry import Registry, load
from lagbench.data.scenario import check_scenario
from lagbench.data.statistics import file_moments
from lagbench.errors import LagbenchError, UsageError, WorkFailedError
from lagbench.generators.batch import (
    ScenarioBatch,
    SimulationJob,
    draw_initial_state,
)
from lagbench.generators.simulate import scenario_writer
from lagbench.make.generate import generate

FRAMES = (4, 10)
"""Frames of the two generations."""

SCENARIOS = 1000
PLANNED = 600
"""Scenarios and frames of the data set that is planned for."""

TESTS = 0.1
HORIZON_END = 300
"""Share of test scenarios, and frames of their perturbed runs."""

_AREA = 0.25
_COURANT = 0.4
_MODULUS = 30.0


@dataclass(frozen=True, kw_only=True)
class Parts:
    """Processor time of each part, for one particle."""

    draw: float  # drawing the initial state [s]
    substep: float  # one substep [s]
    write: float  # hashing, compressing and writing one frame [s]
    check: float  # reading and hashing one frame again [s]
    statistics: float  # moments of one frame [s]
    bytes: float  # one frame in the file [bytes]


@dataclass(frozen=True, kw_only=True)
class Whole:
    """Generations of a scenario, and of a test scenario with its perturbed run."""

    frames: int  # frames of each
    seconds: float  # processor time of all processes [s]
    parent: int  # peak memory of the parent [bytes]
    worker: int  # peak memory of the largest worker [bytes]


MeasuredRow = tuple[ThesisRow, Parts, Sequence[Whole]]


def registry_of(row: ThesisRow, frames: int) -> Registry:
    """Return our splits with a size ``q`` of fluid that has the numbers of a row."""
    registry = load()
    fluid = registry.split("fluid")
    sound_speed = _MODULUS**0.5
    interval = row.substeps * _COURANT / (row.grid * sound_speed)
    full = fluid.sizes["full"]
    size_parameters = {
        **full.parameters,
        "particles": row.particles,
        "grid": row.grid,
        "substeps_per_frame": row.substeps,
    }
    task = full.task.model_copy(
        update={
            "horizon": frames - 2,
            "frames_of_interest": (frames - 1,),
        }
    )
    subsets = {
        "train": (0,),
        "valid": (1,),
        "test": (2,),
    }
    size = full.model_copy(
        update={
            "parameters": size_parameters,
            "subsets": subsets,
            "frames": frames,
            "task": task,
        }
    )
    values = {
        "area_min": _AREA,
        "area_max": _AREA,
        "frame_rate": 1.0 / interval,
    }
    parameters = {}
    for name, parameter in fluid.parameters.items():
        value = values.get(name, parameter.value)
        parameters[name] = parameter.model_copy(update={"value": value})
    split = fluid.model_copy(
        update={
            "parameters": parameters,
            "sizes": {"q": size},
        }
    )
    splits = {**registry.splits, "fluid": split}
    return Registry(splits, {})


def timed(function: Callable[[], object]) -> float:
    """Return the processor time of a call [s]."""
    start = time.process_time()
    function()
    return time.process_time() - start


def best_of_three(function: Callable[[], object]) -> float:
    """Return the shortest processor time of three calls [s]."""
    seconds = [timed(function) for _ in range(3)]
    return min(seconds)


def measure_parts(row: ThesisRow, frames: int, root: Path) -> Parts:
    """Time the parts of a generation in this process."""
    size = registry_of(row, frames).size("fluid", "q")
    job = SimulationJob(size=size, scenarios=(0,), root=root)
    draw_seconds = best_of_three(lambda: draw_initial_state(size, 0))

    batch = ScenarioBatch(job, lambda _: None)
    batch.solver.advance(1)
    solver_seconds = best_of_three(lambda: batch.solver.advance(row.substeps))

    position = batch.solver.position()[0]
    velocity = batch.solver.velocity()[0]
    with scenario_writer(job, 0, batch.states[0]) as writer:

        def write_frames() -> None:
            for _ in range(frames):
                writer.append(position, velocity)

        write_seconds = timed(write_frames)

    path = writer.path
    check_seconds = timed(lambda: check_scenario(path))
    statistics_seconds = timed(lambda: file_moments(path))
    rows_written = frames * row.particles
    particle_substeps = row.particles * row.substeps
    return Parts(
        draw=draw_seconds / row.particles,
        substep=solver_seconds / particle_substeps,
        write=write_seconds / rows_written,
        check=check_seconds / rows_written,
        statistics=statistics_seconds / rows_written,
        bytes=path.stat().st_size / rows_written,
    )


def measure_whole(row: ThesisRow, frames: int, root: Path) -> Whole:
    """Generate a scenario and one with a perturbed run, one after the other."""
    start = time.process_time()
    generate(
        "fluid",
        "q",
        scenarios="0,2",
        root=root,
        workers=1,
        registry=registry_of(row, frames),
    )
    parent_seconds = time.process_time() - start
    parent = resource.getrusage(resource.RUSAGE_SELF)
    workers = resource.getrusage(resource.RUSAGE_CHILDREN)
    worker_seconds = workers.ru_utime + workers.ru_stime
    return Whole(
        frames=frames,
        seconds=parent_seconds + worker_seconds,
        parent=parent.ru_maxrss * 1024,
        worker=workers.ru_maxrss * 1024,
    )


def apart(row: ThesisRow, frames: int, what: str) -> Any:  # noqa: ANN401 (plain values)
    """Measure in a process of its own, whose peak memory is nobody else's."""
    measurement = f"{row.q},{frames},{what}"
    command = [sys.executable, __file__, "--one", measurement]
    # What the process says on stderr stays there.
    process = subprocess.run(command, stdout=subprocess.PIPE, check=False, text=True)
    if process.returncode != 0:
        raise WorkFailedError(
            "a measurement failed",
            where=f"q = {row.q}, {frames} frames, {what}",
            expected="exit code 0",
            got=process.returncode,
            fix="see the error above",
        )
    return json.loads(process.stdout)


def row_of(q: str) -> ThesisRow:
    """Return the row of a quality factor, as the user writes it.

    Raises:
        UsageError: there is no such row.
    """
    names = []
    for row in THESIS:
        name = str(row.q)
        if q == name:
            return row
        names.append(name)
    raise UsageError(
        "Table 3.1 has no such row",
        where="--rows",
        expected=f"values of q, some of {', '.join(names)}",
        got=repr(q),
        fix="give them as in --rows 2,4",
    )


def one(text: str) -> int:
    """Measure one thing and print it as JSON.

    Args:
        text: q, the number of frames, and "parts" or "whole", as in "2,4,parts".
    """
    q, frames, what = text.split(",")
    row = row_of(q)
    with tempfile.TemporaryDirectory() as folder:
        costs: Parts | Whole
        if what == "parts":
            costs = measure_parts(row, int(frames), Path(folder))
        else:
            costs = measure_whole(row, int(frames), Path(folder))
        print(json.dumps(asdict(costs)))
    return 0


def read_rows(text: str) -> list[ThesisRow]:
    """Return the rows that a user names, as in "2,4", the fewest particles first.

    Raises:
        UsageError: there is no such row.
    """
    rows = {row_of(q) for q in text.split(",")}
    return sorted(rows, key=lambda row: row.particles)


def parts_table(measured: Sequence[MeasuredRow]) -> list[str]:
    """Return the costs per particle."""
    lines = [
        "| q | particles | drawing the initial state [ns] | a substep [ns] "
        "| writing a frame [ns] | hashing a written frame [ns] "
        "| statistics of a frame [ns] | bytes in the file, per particle and frame |",
        "|--:|--:|--:|--:|--:|--:|--:|--:|",
    ]
    for row, parts, _ in measured:
        times = " | ".join(
            [
                f"{1e9 * parts.draw:.3g}",
                f"{1e9 * parts.substep:.3g}",
                f"{1e9 * parts.write:.3g}",
                f"{1e9 * parts.check:.3g}",
                f"{1e9 * parts.statistics:.3g}",
            ]
        )
        lines.append(f"| {row.q} | {row.particles:,} | {times} | {parts.bytes:.3g} |")
    return lines


def whole_table(measured: Sequence[MeasuredRow]) -> list[str]:
    """Return the costs of whole generations, beside the sum of the parts."""
    lines = [
        "| q | frames | whole generation [core s] | sum of the parts [core s] "
        "| one frame before compression [MB] | peak memory of the client [MB] "
        "| peak memory of a worker [MB] |",
        "|--:|--:|--:|--:|--:|--:|--:|",
    ]
    for row, parts, runs in measured:
        for run in runs:
            lines.append(
                f"| {row.q} | {run.frames} | {run.seconds:.1f} | "
                f"{expected(row, parts, run.frames):.1f} "
                f"| {16 * row.particles / 1e6:.1f} | {run.parent / 1e6:.0f} | "
                f"{run.worker / 1e6:.0f} |"
            )
    return lines


def expected(row: ThesisRow, p: Parts, frames: int) -> float:
    """Return what two scenarios and a perturbed run should take by the parts [s]."""
    substeps = (frames - 1) * row.substeps
    simulation = p.draw + substeps * p.substep
    writing = frames * p.write
    return row.particles * (3 * simulation + 2 * writing)


def plan_table(row: ThesisRow, p: Parts, memory: int, *, measured_q: int) -> list[str]:
    """Return bytes, core hours and memory of the planned data set."""
    n = row.particles
    frames = PLANNED
    raw_file = frames * n * 16  # [bytes]
    file = frames * n * p.bytes  # [bytes]
    raw_terabytes = SCENARIOS * raw_file / 1e12
    terabytes = SCENARIOS * file / 1e12

    # core hours per second of work on one particle
    hours = SCENARIOS * n / 3600.0
    frame_hours = hours * frames
    frame_seconds = row.substeps * p.substep  # to simulate a frame, per particle
    simulating = hours * (p.draw + (frames - 1) * frame_seconds)
    writing = frame_hours * p.write
    perturbed_hours = TESTS * hours * (p.draw + (HORIZON_END - 1) * frame_seconds)
    statistics = 0.8 * frame_hours * p.statistics
    checking = frame_hours * p.check
    perturbed_runs = (
        f"perturbed runs of the test scenarios ({100 * TESTS:.0f} % of all)"
    )
    train_statistics = "statistics of the train scenarios (80 % of all)"
    rows = {
        "bytes before compression": f"{raw_terabytes:.2f} TB",
        "bytes in files": f"{terabytes:.2f} TB ({file / 1e9:.1f} GB per scenario)",
        "simulating": f"{simulating:,.0f} core hours",
        "compressing, hashing, writing": f"{writing:,.0f} core hours",
        perturbed_runs: f"{perturbed_hours:,.0f} core hours",
        train_statistics: f"{statistics:,.0f} core hours",
        "one `lagbench verify`": f"{checking:,.0f} core hours",
        "memory of a worker": f"{memory / 1e6:.0f} MB",
    }
    return [
        f"The plan is for {SCENARIOS:,} scenarios. It uses the times per particle that "
        f"we measured for q = {measured_q}. A scenario has {n:,} particles, {frames} "
        f"frames of {row.substeps} substeps, and a grid of {row.grid} x {row.grid} "
        f"cells. The perturbed runs have {HORIZON_END} frames, as in fluid full:",
        "",
        "| part | size or time |",
        "|---|--:|",
        *(f"| {name} | {value} |" for name, value in rows.items()),
    ]


def extrapolate_memory(measured: Sequence[MeasuredRow], particles: int) -> int:
    """Return a worker's peak memory at a number of particles [bytes].

    It lies on the line through the first and the last row.
    """
    small, _, small_runs = measured[0]
    large, _, large_runs = measured[-1]
    low = small_runs[-1].worker
    high = large_runs[-1].worker
    if small is large:
        return round(high * particles / large.particles)
    measured_particles = large.particles - small.particles
    slope = (high - low) / measured_particles  # [bytes/particle]
    more_particles = particles - large.particles
    return round(high + slope * more_particles)


def main() -> int:
    """Measure the rows that were asked for and write the plan."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rows", default="2,4", help="values of q, such as 2,4")
    parser.add_argument("--output", type=Path, default=Path("docs/figures"))
    parser.add_argument("--one", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        return one(options.one)

    rows = read_rows(options.rows)
    measured = []
    for row in rows:
        part_costs = apart(row, FRAMES[0], "parts")
        parts = Parts(**part_costs)
        runs = []
        for frames in FRAMES:
            run_costs = apart(row, frames, "whole")
            runs.append(Whole(**run_costs))
        measured.append((row, parts, runs))

    million = row_of("8")
    largest_row, largest_parts, _ = measured[-1]
    memory = extrapolate_memory(measured, million.particles)
    lines = [
        "# Costs of large scenarios",
        "",
        "q names a row of Table 3.1 of the [thesis](../glossary.md). The row states "
        "the particles, the grid and the substeps.",
        "",
        "The first table shows processor times and bytes for one particle. *Writing a "
        "frame* includes hashing and compressing. *Hashing a written frame* is the "
        "work of `lagbench verify`. *Statistics of a frame* is the work for the "
        "means and standard deviations over train.",
        "",
        *parts_table(measured),
        "",
        "A *whole generation* makes one scenario of train, one scenario of test, and "
        "the [perturbed run](../glossary.md) of the test scenario. The *sum of the "
        "parts* comes from the first table. A whole generation takes longer than the "
        "sum of the parts, because the command also imports, compiles, writes the "
        "manifest and draws the pictures. The *client* is the process that you start. "
        "The client starts the workers.",
        "",
        *whole_table(measured),
        "",
        *plan_table(million, largest_parts, memory, measured_q=largest_row.q),
    ]
    text = "\n".join(lines) + "\n"
    options.output.mkdir(parents=True, exist_ok=True)
    path = options.output / "scaling_plan.md"
    path.write_text(text, encoding="utf-8")
    print(text)
    return 0


if __name__ == "__main__":
    try:
        raise SystemExit(main())
    except LagbenchError as error:
        print(f"scaling_plan: {error}", file=sys.stderr)
        raise SystemExit(error.exit_code) from error
