"""What a generation will simulate, and the bytes and time that it takes.

Nothing here writes; drawing the initial states tells how many substeps lie ahead.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from lagbench.data.registry import Size, parse_ids, spell_ids
from lagbench.errors import UsageError, WorkFailedError, nearest

from .rate import measured_slowness, orientation

__all__ = ["Estimate", "check_disk", "estimate", "free_bytes", "scenario_bytes", "select"]


BYTES_PER_PARTICLE = 2 * 2 * 4
"""Position and velocity in one frame, two float32 each, before compression [bytes]."""

BYTES_BESIDE_FRAMES = 64 * 1024
"""Header, constants and chunk index of a file, generously [bytes]."""

Selection = str | Sequence[str] | None
Scenarios = str | Iterable[int] | None


def _names(subset: Selection) -> tuple[str, ...]:
    if subset is None:
        return ()
    return tuple(subset.replace(" ", "").split(",")) if isinstance(subset, str) else tuple(subset)


def select(size: Size, *, subset: Selection = None, scenarios: Scenarios = None) -> tuple[int, ...]:
    """Return the scenario ids that a user means, ascending."""
    names = _names(subset) or tuple(size.subsets)
    for name in names:
        if name not in size.subsets:
            raise UsageError(
                f"{size.split} {size.name} has no subset {name!r}",
                where="--subset",
                fix=nearest(name, size.subsets),
            )
    held = {i for name in names for i in size.subsets[name]}
    if scenarios is None:
        return tuple(sorted(held))
    wanted = parse_ids(scenarios) if isinstance(scenarios, str) else tuple(scenarios)
    strangers = [i for i in wanted if i not in held]
    if strangers or not wanted:
        raise UsageError(
            f"no scenario {spell_ids(strangers) or 'at all'} in {', '.join(names)}",
            where=f"--scenarios, {size.split} {size.name}",
            expected="; ".join(f"{name} {spell_ids(size.subsets[name])}" for name in names),
            got=spell_ids(wanted),
        )
    return tuple(sorted(set(wanted)))


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """What simulating some scenarios takes."""

    scenarios: tuple[int, ...]  # their ids, ascending
    substeps: tuple[int, ...]  # substeps of each, in the same order
    frames: int  # frames that they record together
    bytes: int  # disk space, before compression [bytes]; files come out a little smaller
    core_seconds: float  # time on one core, twins of test scenarios included [s], for orientation
    measured: bool  # whether at a rate that this machine has measured

    def seconds(self, workers: int) -> float:
        """Return the time with some workers [s]: shared evenly, but never below the longest."""
        if not self.substeps:
            return 0.0
        longest = self.core_seconds * max(self.substeps) / sum(self.substeps)
        return max(self.core_seconds / workers, longest)


def scenario_bytes(size: Size, scenario: int) -> int:
    """Return the most bytes that a scenario's file takes, in sum over a data set."""
    return size.frame_count(scenario) * size.particles * BYTES_PER_PARTICLE + BYTES_BESIDE_FRAMES


def estimate(
    size: Size, scenarios: Sequence[int], *, drawn: int | None = None, on_cores: bool = True
) -> Estimate:
    """Return what simulating these scenarios takes.

    Args:
        size: tier of a split.
        scenarios: their ids.
        drawn: draw about so many of them only; the others take what these do per frame. All when None.
        on_cores: whether cores of this machine simulate, whose rate it may have measured.
    """
    if not size.simulated:
        raise UsageError(
            "a local split cannot be simulated",
            where=f"{size.split} {size.name}",
            fix="lagbench import or lagbench adopt makes it again from the data that it came from",
        )
    from lagbench.generators.batch import solver_constants, substeps_of

    solver_constants(size)
    step = 1 if drawn is None else max(1, len(scenarios) // drawn)
    known = {i: substeps_of(size, i) for i in scenarios[::step]}
    per_frame = sum(known.values()) / max(1, sum(map(size.frame_count, known)))
    substeps = tuple(known.get(i) or round(per_frame * size.frame_count(i)) for i in scenarios)
    frames = sum(size.frame_count(i) for i in scenarios)
    task, slowness = size.task, measured_slowness(size) if on_cores else None
    # What a twin does not simulate: the frames behind the horizon.
    behind = {
        i: max(0, size.frame_count(i) - task.input_frames - task.horizon)
        for i in scenarios
        if size.subset_of(i) == "test"
    }
    twins = sum(n for i, n in zip(scenarios, substeps, strict=True) if i in behind)
    twins -= sum(behind.values()) * size.substeps_per_frame
    both = frames + sum(map(size.frame_count, behind)) - sum(behind.values())
    return Estimate(
        scenarios=tuple(scenarios),
        substeps=substeps,
        frames=frames,
        bytes=sum(scenario_bytes(size, i) for i in scenarios),
        core_seconds=(slowness or 1.0) * orientation((sum(substeps) + twins) * size.particles, both),
        measured=slowness is not None,
    )


def free_bytes(folder: Path) -> int:
    """Return the free space of the file system that holds, or would hold, a folder [bytes].

    Raises:
        WorkFailedError: nothing can be written there: the nearest existing parent is a file, or
            is not ours to write.
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
            fix="free disk space, name another folder with --root, or fewer scenarios with --scenarios",
        )
