"""How fast this machine simulates, as its own generations measured it.

What was measured stands in ``rates.json`` in the user's cache, by kind of solver and number of particles.
It enters estimates of time and nothing else: a file that is missing, damaged or another machine's counts
for nothing.
"""

from __future__ import annotations

import json
import math
import platform
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import astuple
from pathlib import Path
from typing import TYPE_CHECKING

from lagbench.atomic import write_atomically
from lagbench.data.layout import CACHE_VARIABLE, cache_folder
from lagbench.data.limits import NEEDED, Limit
from lagbench.data.registry import Size
from lagbench.errors import WorkFailedError

if TYPE_CHECKING:
    from lagbench.generators.simulate import Pace

    Row = tuple[float, int, int]  # seconds, particle substeps and frames, as in Pace

__all__ = ["measured_slowness", "note_pace", "orientation"]

NAME = "rates.json"
MOST_BYTES = 1 << 16
MOST_ROWS = 32
"""Numbers of particles per kind of solver that are kept, the latest ones."""

SECONDS = Limit(low=0, high=1e9, open_low=True)
COUNT = Limit(low=1, high=1 << 60, whole=True)
SLOWNESS = Limit(low=1e-3, high=1e4)

SECONDS_PER_PARTICLE_SUBSTEP = 45e-9
SECONDS_PER_FRAME = 2.3e-3
"""Starting the kernels, reading out, checking and writing one frame of a scenario [s]."""


def orientation(particle_substeps: int, frames: int) -> float:
    """Return about what one core of the machine that we measured takes [s]."""
    return particle_substeps * SECONDS_PER_PARTICLE_SUBSTEP + frames * SECONDS_PER_FRAME


def measured_slowness(size: Size) -> float | None:
    """Return what this machine took over the orientation; None where it never timed that solver.

    Of several numbers of particles the nearest counts: the orientation tells small work from large.
    """
    rows = _read().get(_kind(size))
    if not rows:
        return None
    seconds, *work = rows[min(rows, key=lambda particles: abs(math.log(particles / size.particles)))]
    return seconds / orientation(*work)


def note_pace(size: Size, paces: Sequence[Pace]) -> None:
    """Note how fast a generation was; nothing where none was timed or the cache cannot be written."""
    if not paces:
        return
    row = tuple(sum(column) for column in zip(*map(astuple, paces), strict=True))
    held, kind = _read(), _kind(size)
    rows = {n: old for n, old in held.get(kind, {}).items() if n != size.particles} | {size.particles: row}
    held[kind] = dict(list(rows.items())[-MOST_ROWS:])
    text = json.dumps({"machine": platform.node(), **held}, indent=1) + "\n"
    with suppress(WorkFailedError):
        write_atomically(_path(), text.encode(), option=CACHE_VARIABLE)


def _path() -> Path:
    return cache_folder("rates") / NAME


def _kind(size: Size) -> str:
    """Return which of the solvers a size is simulated with."""
    from lagbench.generators.batch import solver_constants
    from lagbench.generators.split import ClosedBoxParameters

    return "closed_box" if isinstance(solver_constants(size), ClosedBoxParameters) else "free_surface"


def _read() -> dict[str, dict[int, Row]]:
    """Return what this machine noted: by kind and number of particles; nothing of what is damaged."""
    try:
        with _path().open("rb") as stream:
            data = stream.read(MOST_BYTES + 1)
        if len(data) > MOST_BYTES:
            return {}
        held = json.loads(data)
        if held["machine"] != platform.node():
            return {}
        return {
            kind: dict(_checked(int(n), *row) for n, row in held.get(kind, {}).items())
            for kind in ("closed_box", "free_surface")
        }
    except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError):
        return {}


def _checked(particles: int, seconds: float, particle_substeps: int, frames: int) -> tuple[int, Row]:
    if not (
        NEEDED["particles"].holds(particles)
        and SECONDS.holds(seconds)
        and COUNT.holds(particle_substeps)
        and COUNT.holds(frames)
        and SLOWNESS.holds(seconds / orientation(particle_substeps, frames))
    ):
        raise ValueError("no machine is so fast or so slow")
    return particles, (seconds, particle_substeps, frames)
