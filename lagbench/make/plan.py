"""What a generation will simulate, and the bytes and time that it takes.

How fast this machine is, its own generations measured: ``rates.json`` in the user's
cache holds it by kind of solver and number of particles. It enters estimates of time
and nothing else. A file that is missing, damaged or another machine's counts for
nothing.
"""

from __future__ import annotations

import itertools
import json
import math
import operator
import os
import platform
import shutil
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lagbench.atomic import write_atomically
from lagbench.data.field_errors import describe_value
from lagbench.data.layout import (
    CACHE_VARIABLE,
    MAX_ID,
    cache_folder,
    format_ids,
    parse_ids,
)
from lagbench.data.limits import NEEDED, Limit
from lagbench.data.registry import Size
from lagbench.errors import UsageError, WorkFailedError, suggest_name
from lagbench.generators.batch import SimulationPace, substep_count
from lagbench.generators.constants import solver_constants
from lagbench.generators.full_box_parameters import FullBoxParameters
from lagbench.generators.split import ClosedBoxParameters

RateRow = tuple[float, int, int]
"""Seconds, particle substeps and frames, as in SimulationPace."""

MOST_BYTES = 1 << 16  # a longer file of rates is not ours [bytes]
MOST_ROWS = 32  # numbers of particles per kind of solver that are kept, the latest ones
# processor time of the generations behind a rate [s]
SECONDS = Limit(low=0, high=1e9, open_low=True)
COUNT = Limit(low=1, high=1 << 60, whole=True)  # particle substeps, and frames
# time over that of the reference machine, one core of an EPYC server
RATIO = Limit(low=1e-3, high=1e4)

# starting the kernels, reading out, checking and writing one frame of mini on the
# reference machine [s]
SECONDS_PER_FRAME = 2.3e-3


@dataclass(frozen=True, kw_only=True)
class SolverCost:
    """What a kind of solver takes on the reference machine."""

    # a worker that starts: it imports Taichi and compiles the solver, which takes a
    # third of that the next time [s]
    start: float
    particle_substep: float  # one particle's substep [s]


# benchmarks/test_solver_throughput.py and periodic_cube.py measure the substeps
SOLVER_COSTS = {
    "closed_box": SolverCost(start=8.0, particle_substep=45e-9),
    "free_surface": SolverCost(start=5.0, particle_substep=45e-9),
    "free_surface_3d": SolverCost(start=15.0, particle_substep=95e-9),
    # without solids half of the kernel is compiled
    "liquid_3d": SolverCost(start=7.0, particle_substep=95e-9),
    "full_box_2d": SolverCost(start=5.0, particle_substep=45e-9),
    "full_box_3d": SolverCost(start=10.0, particle_substep=95e-9),
}
"""Kinds of solvers, whose pace a machine notes."""

SOLID_PARAMETER = "jelly_modulus"
"""Parameter of the splits with a free surface whose bodies may be solid."""

Selection = str | Sequence[str] | None
Scenarios = str | Iterable[int] | None


def select(
    size: Size, *, subset: Selection = None, scenarios: Scenarios = None
) -> tuple[int, ...]:
    """Return the scenario ids that a user means, ascending.

    Raises:
        UsageError: an unknown subset, an id outside the subsets, or no id at all.
    """
    names = _subset_names(size, subset)
    selectable: set[int] = set()
    for name in names:
        selectable.update(size.subsets[name])
    if scenarios is None:
        return tuple(sorted(selectable))

    ids = _scenario_ids(scenarios)
    unknown = []
    for scenario in ids:
        if scenario not in selectable:
            unknown.append(scenario)
    if unknown or not ids:
        choices = []
        for name in names:
            choices.append(f"{name} {format_ids(size.subsets[name])}")
        # Without any id the message reads "no scenario at all in test".
        missing = format_ids(unknown) or "at all"
        raise UsageError(
            f"no scenario {missing} in {', '.join(names)}",
            where=f"--scenarios, {size.split} {size.name}",
            expected="; ".join(choices),
            got=format_ids(ids) or "none",
            fix="name ids of these, or leave --scenarios out to take all",
        )
    return tuple(sorted(set(ids)))


def _subset_names(size: Size, subset: Selection) -> tuple[str, ...]:
    if isinstance(subset, str):
        subset = subset.replace(" ", "").split(",")
    names = tuple(size.subsets)
    if subset is not None:
        names = tuple(subset)
    if not names:
        raise UsageError(
            "no subset is named",
            where="--subset",
            expected=", ".join(size.subsets),
            got="an empty list",
            fix="name one of these, or leave it out to take all",
        )
    for name in names:
        if name not in size.subsets:
            raise UsageError(
                f"{size.split} {size.name} has no subset {name!r}",
                where="--subset",
                expected=", ".join(size.subsets),
                got=ascii(name),
                fix=suggest_name(name, size.subsets),
            )
    return names


def _scenario_ids(scenarios: str | Iterable[int]) -> tuple[int, ...]:
    try:
        if isinstance(scenarios, str):
            return parse_ids(scenarios)
        # one more than there can be: a range or an iterator may go on for ever
        first_numbers = itertools.islice(scenarios, MAX_ID + 2)
        ids = tuple(map(operator.index, first_numbers))
    except TypeError:
        raise UsageError(
            "no ids",
            where="--scenarios",
            expected="ids, as in (0, 3) or '0,3-5'",
            got=repr(scenarios)[:80],
            fix="give a text, or whole numbers in a list",
        ) from None
    if len(ids) > MAX_ID + 1:
        raise UsageError(
            "more ids than scenarios can have",
            where="--scenarios",
            expected=f"at most {MAX_ID + 1} ids, from 0 to {MAX_ID}",
            got=repr(scenarios)[:80],
            fix="name fewer",
        )
    for scenario in ids:
        if abs(scenario) > MAX_ID:
            raise UsageError(
                "a number is too large for an id",
                where="--scenarios",
                expected=f"ids from 0 to {MAX_ID}",
                got=describe_value(scenario),
                fix="name ids that `lagbench info` lists",
            )
    return ids


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """What simulating some scenarios takes."""

    scenarios: tuple[int, ...]  # their ids, ascending
    substeps: tuple[int, ...]  # substeps of each, in the same order
    frames: int  # frames that they record together
    # disk space, before compression [bytes]; files come out a little smaller
    bytes: int
    # time on one core, perturbed runs of test scenarios included [s], for orientation
    core_seconds: float
    # time in which a worker starts and compiles the solver [s]
    start_seconds: float
    measured: bool  # whether at a rate that this machine has measured

    def seconds(self, workers: int) -> float:
        """Return the time with some workers [s]: all start, then share evenly, never
        below the longest.
        """
        if not self.substeps:
            return 0.0
        longest = self.core_seconds * max(self.substeps) / sum(self.substeps)
        return self.start_seconds + max(self.core_seconds / workers, longest)


def estimate(
    size: Size, scenarios: Sequence[int], *, on_cores: bool = True
) -> Estimate:
    """Return what simulating these scenarios takes; none of them is drawn.

    ``on_cores``: whether cores of this machine simulate, whose rate it may have
    measured.

    Raises:
        UsageError: the split is a local one.
        UnreadableFileError: datasets.yaml has an impossible parameter.
    """
    if not size.simulated:
        raise UsageError(
            "a local split cannot be simulated",
            where=f"{size.split} {size.name}",
            expected="a split that a generator makes",
            got="a split that was adopted or imported",
            fix="lagbench import or lagbench adopt makes it again from the data that "
            "it came from",
        )
    solver_constants(size)  # refuses parameters that the solver cannot use

    substeps = tuple(substep_count(size, scenario) for scenario in scenarios)
    frames = sum(map(size.frame_count, scenarios))

    # Test scenarios are simulated a second time, perturbed, up to the horizon.
    total_substeps = sum(substeps)
    total_frames = frames
    for scenario, count in zip(scenarios, substeps, strict=True):
        if size.subset_of(scenario) == "test":
            omitted_frames = size.frames_after_horizon(scenario)
            total_substeps += count - omitted_frames * size.substeps_per_frame
            total_frames += size.frame_count(scenario) - omitted_frames

    ratio = None
    if on_cores:
        ratio = measured_ratio(size)
    kind = _solver_kind(size)
    seconds = reference_seconds(
        total_substeps * size.particles, total_frames, kind=kind
    )
    return Estimate(
        scenarios=tuple(scenarios),
        substeps=substeps,
        frames=frames,
        bytes=size.data_set_bytes(scenarios),
        core_seconds=(ratio or 1.0) * seconds,
        start_seconds=SOLVER_COSTS[kind].start,
        measured=ratio is not None,
    )


def free_bytes(folder: Path) -> int:
    """Return the free space of the file system that holds, or would hold, a folder to
    write to [bytes].

    Raises:
        WorkFailedError: nothing can be written there.
    """
    places = (folder, *folder.parents)
    existing = next(place for place in places if os.path.lexists(place))
    if existing.is_dir() and os.access(existing, os.W_OK | os.X_OK):
        return shutil.disk_usage(existing).free

    obstacle = "a file"
    if existing.is_dir():
        obstacle = "write-protected"
    elif existing.is_symlink():
        obstacle = "a link that leads to no folder"
    raise WorkFailedError(
        "no data set can be written here",
        where=str(folder),
        expected="a folder that you may write to",
        got=f"{existing} is {obstacle}",
        fix="name another folder: --root or LAGBENCH_ROOT",
    )


def check_disk(root: Path, needed: int) -> None:
    """Refuse to start work whose files do not fit on the disk of the root folder.

    Args:
        root: folder of all data sets.
        needed: bytes that a generation or a download will write.

    Raises:
        WorkFailedError: the disk has fewer free bytes.
    """
    free = free_bytes(root)
    if free < needed:
        raise WorkFailedError(
            "not enough disk space",
            where=str(root),
            expected=f"{needed} bytes free",
            got=f"{free} bytes free",
            fix="free disk space, name another folder with --root, or fewer scenarios "
            "with --scenarios",
        )


def reference_seconds(particle_substeps: int, frames: int, *, kind: str) -> float:
    """Return about what one core of the reference machine takes with a solver [s]."""
    substep = SOLVER_COSTS[kind].particle_substep
    return particle_substeps * substep + frames * SECONDS_PER_FRAME


def measured_ratio(size: Size) -> float | None:
    """Return what this machine took over the reference machine; None where it never
    timed that solver.
    """
    kind = _solver_kind(size)
    rows = _read_rates().get(kind)
    if not rows:
        return None

    # The nearest number of particles counts: the reference tells small work from large.
    def distance(particles: int) -> float:
        return abs(math.log(particles / size.particles))

    seconds, particle_substeps, frames = rows[min(rows, key=distance)]
    return seconds / reference_seconds(particle_substeps, frames, kind=kind)


def note_pace(size: Size, paces: Sequence[SimulationPace]) -> None:
    """Note how fast a generation was; nothing where none was timed or the cache cannot
    be written.
    """
    if not paces:
        return
    seconds = 0.0
    particle_substeps = 0
    frames = 0
    for pace in paces:
        seconds += pace.seconds
        particle_substeps += pace.particle_substeps
        frames += pace.frames

    rates = _read_rates()
    kind = _solver_kind(size)
    rows = dict(rates.get(kind, {}))
    rows.pop(size.particles, None)  # the latest row comes last
    rows[size.particles] = (seconds, particle_substeps, frames)
    rates[kind] = dict(list(rows.items())[-MOST_ROWS:])

    text = json.dumps({"machine": platform.node(), **rates}, indent=1) + "\n"
    # a home that is not known is a RuntimeError
    with suppress(WorkFailedError, RuntimeError):
        write_atomically(_rates_path(), text.encode(), option=CACHE_VARIABLE)


def _rates_path() -> Path:
    return cache_folder("rates") / "rates.json"


def _solver_kind(size: Size) -> str:
    """Return which of the solvers a size is simulated with."""
    constants = solver_constants(size)
    if isinstance(constants, FullBoxParameters):
        return f"full_box_{constants.box.dimension}d"
    if isinstance(constants, ClosedBoxParameters):
        return "closed_box"
    if size.dimension == 3:
        if SOLID_PARAMETER in size.parameters:
            return "free_surface_3d"
        return "liquid_3d"
    return "free_surface"


def _read_rates() -> dict[str, dict[int, RateRow]]:
    """Return what this machine noted, by kind and number of particles.

    The result is empty where the file is damaged or another machine's.
    """
    try:
        with _rates_path().open("rb") as stream:
            data = stream.read(MOST_BYTES + 1)
        if len(data) > MOST_BYTES:
            return {}
        document = json.loads(data)
        if document["machine"] != platform.node():
            return {}
        rates = {}
        for kind in SOLVER_COSTS:
            rates[kind] = _parse_rows(document.get(kind, {}), kind=kind)
        return rates
    except (OSError, ValueError, TypeError, KeyError, AttributeError, RuntimeError):
        return {}


def _parse_rows(rows: Mapping[str, Any], *, kind: str) -> dict[int, RateRow]:
    """Return the rows of one kind of solver; a rate that no machine has is a
    ValueError.
    """
    parsed: dict[int, RateRow] = {}
    for particles, (seconds, particle_substeps, frames) in rows.items():
        is_possible = (
            NEEDED["particles"].holds(int(particles))
            and COUNT.holds(particle_substeps)
            and COUNT.holds(frames)
            and SECONDS.holds(seconds)
        )
        if is_possible:
            expected = reference_seconds(particle_substeps, frames, kind=kind)
            is_possible = RATIO.holds(seconds / expected)
        if not is_possible:
            msg = f"no possible rate: {seconds} s, {particle_substeps}, {frames}"
            raise ValueError(msg)
        parsed[int(particles)] = (seconds, particle_substeps, frames)
    return parsed
