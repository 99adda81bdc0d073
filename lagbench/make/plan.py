"""What a generation will simulate, and the bytes and time that it takes."""

from __future__ import annotations

import itertools
import operator
import os
import shutil
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from lagbench.data.layout import (
    MAX_ID,
    format_ids,
    parse_ids,
)
from lagbench.data.registry import Size
from lagbench.errors import UsageError, WorkFailedError, suggest_name
from lagbench.generators.batch import substep_count
from lagbench.generators.constants import solver_constants

# measured on one core of an EPYC server at size mini, for orientation
PARTICLE_SUBSTEP_SECONDS = {2: 45e-9, 3: 95e-9}
"""Time of one particle's substep by dimension [s]."""

Selection = str | Sequence[str] | None
Scenarios = str | Iterable[int] | None


def select(
    size: Size, *, subset: Selection = None, scenarios: Scenarios = None
) -> tuple[int, ...]:
    """Return the scenario ids that a user means, ascending.

    Raises:
        UsageError: an unknown subset, an id outside the subsets, or no id at all.
    """
    if isinstance(subset, str):
        subset = subset.replace(" ", "").split(",")
    names = tuple(size.subsets) if subset is None else tuple(subset)
    selectable: set[int] = set()
    for name in names:
        if name not in size.subsets:
            raise UsageError(
                f"{size.split} {size.name} has no subset {name!r}; "
                f"{suggest_name(name, size.subsets)}",
                where="--subset",
            )
        selectable.update(size.subsets[name])
    if scenarios is None:
        ids = selectable
    elif isinstance(scenarios, str):
        ids = set(parse_ids(scenarios))
    else:
        try:
            # a range or an iterator may go on for ever
            ids = set(map(operator.index, itertools.islice(scenarios, MAX_ID + 2)))
        except TypeError:
            raise UsageError(
                f"no ids: {scenarios!r:.80}; give a text, or whole numbers in a list",
                where="--scenarios",
            ) from None
    unknown = sorted(ids - selectable)
    if unknown or not ids:
        choices = [f"{name} {format_ids(size.subsets[name])}" for name in names]
        # Without any id the message reads "no scenario at all in test".
        raise UsageError(
            f"no scenario {format_ids(unknown[:100]) or 'at all'} in "
            f"{', '.join(names)}; there are {'; '.join(choices)}",
            where=f"--scenarios, {size.split} {size.name}",
        )
    return tuple(sorted(ids))


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """What simulating some scenarios takes."""

    scenarios: tuple[int, ...]  # their ids, ascending
    substeps: tuple[int, ...]  # substeps of each, in the same order
    # disk space, before compression [bytes]; files come out a little smaller
    bytes: int
    core_seconds: float  # time of the solver on one core [s], for orientation


def estimate(size: Size, scenarios: Sequence[int]) -> Estimate:
    """Return what simulating these scenarios takes; none of them is drawn.

    Raises:
        UsageError: the split is a local one.
        UnreadableFileError: datasets.yaml has an impossible parameter.
    """
    if not size.simulated:
        raise UsageError(
            "a local split cannot be simulated: a split that was adopted or imported; "
            "lagbench import makes it again from the data that it came from",
            where=f"{size.split} {size.name}",
        )
    solver_constants(size)  # refuses parameters that the solver cannot use

    substeps = tuple(substep_count(size, scenario) for scenario in scenarios)
    particles = size.particles * size.refinement**size.dimension
    substep_seconds = PARTICLE_SUBSTEP_SECONDS[size.dimension]
    return Estimate(
        scenarios=tuple(scenarios),
        substeps=substeps,
        bytes=size.data_set_bytes(scenarios),
        core_seconds=sum(substeps) * particles * substep_seconds,
    )


def free_bytes(folder: Path) -> int:
    """Return the free space of the file system that holds, or would hold, a folder to
    write to [bytes].

    Raises:
        WorkFailedError: nothing can be written there.
    """
    places = (folder, *folder.parents)
    existing = next(place for place in places if os.path.lexists(place))
    if not existing.is_dir() or not os.access(existing, os.W_OK | os.X_OK):
        raise WorkFailedError(
            f"no data set can be written here: {existing} is no folder or "
            "write-protected; name another folder: --root or LAGBENCH_ROOT",
            where=str(folder),
        )
    return shutil.disk_usage(existing).free


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
            f"not enough disk space: got {free} bytes free, expected {needed} bytes "
            "free; free disk space, name another folder with --root, or fewer "
            "scenarios with --scenarios",
            where=str(root),
        )
