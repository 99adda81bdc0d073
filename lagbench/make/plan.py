"""What a generation will simulate, and the bytes and time that it takes.

Drawing the initial states tells how many substeps lie ahead. How fast this machine is,
its own generations measured: ``rates.json`` in the user's cache holds it by kind of
solver and number of particles. It enters estimates of time and nothing else: a file
that is missing, damaged or another machine's counts for nothing.
"""

from __future__ import annotations

import json
import math
import operator
import os
import platform
import shutil
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from lagbench.atomic import write_atomically
from lagbench.data.layout import CACHE_VARIABLE, cache_folder
from lagbench.data.limits import NEEDED, Limit
from lagbench.data.registry import Size, format_ids, parse_ids
from lagbench.errors import UsageError, WorkFailedError, suggest_name

if TYPE_CHECKING:
    from lagbench.generators.simulate import Pace

    Row = tuple[float, int, int]  # seconds, particle substeps and frames, as in Pace


MOST_BYTES = 1 << 16  # a longer file of rates is not ours [bytes]
MOST_ROWS = 32  # numbers of particles per kind of solver that are kept, the latest ones
# processor time of the generations behind a rate [s]
SECONDS = Limit(low=0, high=1e9, open_low=True)
COUNT = Limit(low=1, high=1 << 60, whole=True)  # particle substeps, and frames
# time over that of the reference machine, one core of an EPYC server
RATIO = Limit(low=1e-3, high=1e4)

# Of the reference machine [s]: one particle's substep
# (benchmarks/test_solver_throughput.py); starting the kernels, reading out, checking
# and writing one frame of mini; starting a worker, which imports Taichi and compiles
# the solver, about half the next time.
SECONDS_PER_PARTICLE_SUBSTEP = 45e-9
SECONDS_PER_FRAME = 2.3e-3
SECONDS_TO_START = 5.0

Selection = str | Sequence[str] | None
Scenarios = str | Iterable[int] | None


def select(
    size: Size, *, subset: Selection = None, scenarios: Scenarios = None
) -> tuple[int, ...]:
    """Return the scenario ids that a user means, ascending."""
    names = subset.replace(" ", "").split(",") if isinstance(subset, str) else subset
    names = tuple(names or size.subsets)
    for name in names:
        if name not in size.subsets:
            what = f"{size.split} {size.name} has no subset {name!r}"
            raise UsageError(
                what, where="--subset", fix=suggest_name(name, size.subsets)
            )
    held = {i for name in names for i in size.subsets[name]}
    if scenarios is None:
        return tuple(sorted(held))
    try:
        if isinstance(scenarios, str):
            wanted = parse_ids(scenarios)
        else:
            wanted = tuple(map(operator.index, scenarios))
    except TypeError:
        expected = "ids, as in (0, 3) or '0,3-5'"
        raise UsageError(
            "no ids", where="--scenarios", expected=expected, got=repr(scenarios)[:80]
        ) from None
    strangers = [i for i in wanted if i not in held]
    if strangers or not wanted:
        raise UsageError(
            f"no scenario {format_ids(strangers) or 'at all'} in {', '.join(names)}",
            where=f"--scenarios, {size.split} {size.name}",
            expected="; ".join(
                f"{name} {format_ids(size.subsets[name])}" for name in names
            ),
            got=format_ids(wanted),
        )
    return tuple(sorted(set(wanted)))


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """What simulating some scenarios takes."""

    scenarios: tuple[int, ...]  # their ids, ascending
    substeps: tuple[int, ...]  # substeps of each, in the same order
    frames: int  # frames that they record together
    # disk space, before compression [bytes]; files come out a little smaller
    bytes: int
    # time on one core, twins of test scenarios included [s], for orientation
    core_seconds: float
    measured: bool  # whether at a rate that this machine has measured

    def seconds(self, workers: int) -> float:
        """Return the time with some workers [s]: all start, then share evenly, never
        below the longest.
        """
        if not self.substeps:
            return 0.0
        longest = self.core_seconds * max(self.substeps) / sum(self.substeps)
        return SECONDS_TO_START + max(self.core_seconds / workers, longest)


def estimate(
    size: Size,
    scenarios: Sequence[int],
    *,
    drawn: int | None = None,
    on_cores: bool = True,
) -> Estimate:
    """Return what simulating these scenarios takes; draw about so many, the others take
    as much per frame.

    ``on_cores``: whether cores of this machine simulate, whose rate it may have
    measured.
    """
    if not size.simulated:
        raise UsageError(
            "a local split cannot be simulated",
            where=f"{size.split} {size.name}",
            fix="lagbench import or lagbench adopt makes it again from the data that "
            "it came from",
        )
    from lagbench.generators.batch import substeps_of
    from lagbench.generators.constants import solver_constants

    solver_constants(size)
    if drawn is None:
        step = 1
    else:
        step = max(1, len(scenarios) // drawn)
    known = {i: substeps_of(size, i) for i in scenarios[::step]}
    per_frame = sum(known.values()) / max(1, sum(map(size.frame_count, known)))
    substeps = tuple(
        known.get(i) or round(per_frame * size.frame_count(i)) for i in scenarios
    )
    frames = sum(size.frame_count(i) for i in scenarios)
    # twins of test scenarios are simulated too, but for the frames behind the horizon
    behind = {
        i: size.frames_behind(i) for i in scenarios if size.subset_of(i) == "test"
    }
    twins = sum(n for i, n in zip(scenarios, substeps, strict=True) if i in behind)
    twins -= sum(behind.values()) * size.substeps_per_frame
    both = frames + sum(map(size.frame_count, behind)) - sum(behind.values())
    if on_cores:
        ratio = measured_ratio(size)
    else:
        ratio = None
    return Estimate(
        scenarios=tuple(scenarios),
        substeps=substeps,
        frames=frames,
        bytes=sum(map(size.file_bytes, scenarios)),
        core_seconds=(ratio or 1.0)
        * reference_seconds((sum(substeps) + twins) * size.particles, both),
        measured=ratio is not None,
    )


def free_bytes(folder: Path) -> int:
    """Return the free space of the file system that holds, or would hold, a folder to
    write to [bytes].
    """
    existing = next(place for place in (folder, *folder.parents) if place.exists())
    if not existing.is_dir() or not os.access(existing, os.W_OK | os.X_OK):
        raise WorkFailedError(
            "no data set can be written here",
            where=str(folder),
            expected="a folder that you may write to",
            got=f"{existing} is {'write-protected' if existing.is_dir() else 'a file'}",
            fix="name another folder: --root or LAGBENCH_ROOT",
        )
    return shutil.disk_usage(existing).free


def check_disk(root: Path, needed: int) -> None:
    """Refuse to start what cannot fit."""
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


def reference_seconds(particle_substeps: int, frames: int) -> float:
    """Return about what one core of the reference machine takes [s]."""
    return particle_substeps * SECONDS_PER_PARTICLE_SUBSTEP + frames * SECONDS_PER_FRAME


def measured_ratio(size: Size) -> float | None:
    """Return what this machine took over the reference machine; None where it never
    timed that solver.
    """
    rows = _read().get(_kind(size))
    if not rows:
        return None
    # The nearest number of particles counts: the reference tells small work from large.
    seconds, *work = rows[
        min(rows, key=lambda particles: abs(math.log(particles / size.particles)))
    ]
    return seconds / reference_seconds(*work)


def note_pace(size: Size, paces: Sequence[Pace]) -> None:
    """Note how fast a generation was; nothing where none was timed or the cache cannot
    be written.
    """
    if not paces:
        return
    row = tuple(sum(column) for column in zip(*map(astuple, paces), strict=True))
    held = _read()
    kind = _kind(size)
    rows = {n: old for n, old in held.get(kind, {}).items() if n != size.particles} | {
        size.particles: row
    }
    held[kind] = dict(list(rows.items())[-MOST_ROWS:])
    text = json.dumps({"machine": platform.node(), **held}, indent=1) + "\n"
    with suppress(
        WorkFailedError, RuntimeError
    ):  # a home that is not known is a RuntimeError
        write_atomically(_path(), text.encode(), option=CACHE_VARIABLE)


def _path() -> Path:
    return cache_folder("rates") / "rates.json"


def _kind(size: Size) -> str:
    """Return which of the solvers a size is simulated with."""
    from lagbench.generators.constants import solver_constants
    from lagbench.generators.split import ClosedBoxParameters

    if isinstance(solver_constants(size), ClosedBoxParameters):
        return "closed_box"
    return "free_surface"


def _read() -> dict[str, dict[int, Row]]:
    """Return what this machine noted: by kind and number of particles; nothing of what
    is damaged.
    """
    try:
        with _path().open("rb") as stream:
            data = stream.read(MOST_BYTES + 1)
        if len(data) > MOST_BYTES:
            return {}
        held = json.loads(data)
        if held["machine"] != platform.node():
            return {}
        rates: dict[str, dict[int, Row]] = {"closed_box": {}, "free_surface": {}}
        for kind, rows in rates.items():
            for particles, (seconds, substeps, frames) in held.get(kind, {}).items():
                counts = NEEDED["particles"].holds(int(particles)) and COUNT.holds(
                    substeps
                )
                if not (counts and COUNT.holds(frames) and SECONDS.holds(seconds)):
                    return {}
                if not RATIO.holds(seconds / reference_seconds(substeps, frames)):
                    return {}
                rows[int(particles)] = (seconds, substeps, frames)
        return rates
    except (OSError, ValueError, TypeError, KeyError, AttributeError, RuntimeError):
        return {}
