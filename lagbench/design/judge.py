"""Judge the parameters of an entry: simulate them, and measure what they reach."""

from __future__ import annotations

import functools
import json
from collections.abc import Callable, Mapping
from hashlib import sha256
from importlib.resources import files
from pathlib import Path

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError

from lagbench.atomic import write_atomically
from lagbench.errors import UnreadableFileError, UsageError, WorkFailedError
from lagbench.work.executor import Report, WorkItem, run_items
from lagbench.work.run import Meter, Progress

from .tasks import VERSION, load_task, task_names

MOST_BYTES = 1 << 20
"""Bytes that a file of an entry may have."""


class Verdict(BaseModel):
    """What the parameters of one task reach."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    error: float | None  # None where the run left the bounds of the solver
    sha256: str  # of the positions of the judged run, little-endian float32


class DesignEntry(BaseModel):
    """What an entry hands in, a JSON file; the judge adds the verdicts."""

    model_config = ConfigDict(extra="forbid")

    method: str  # how the parameters were found
    version: int = VERSION  # of the tasks
    budget: int | None = None  # of each search [simulator runs' worth of time]
    seed: int = 0  # of the searches
    parameters: dict[str, list[float]]  # by task
    seconds: dict[str, float] = {}  # processor time of each search [s]
    runs: dict[str, int] = {}  # runs of each search, of any simulator or model
    verdicts: dict[str, Verdict] = {}  # by task


class Known(BaseModel):
    """What is known of a task."""

    random: float  # error of the best of 64 random draws
    best: float  # least error that is known
    parameters: list[float]  # that reach it


def read_entry(path: str | Path) -> DesignEntry:
    """Read an entry; parameters out of bounds are refused.

    Raises:
        UnreadableFileError: the file is missing, too long, or no entry.
        UsageError: an unknown task, or parameters out of bounds.
    """
    file = Path(path)
    if not file.is_file() or file.stat().st_size > MOST_BYTES:
        raise UnreadableFileError(
            "no file of at most 1 MiB; name the JSON file of an entry", where=str(file)
        )
    try:
        entry = DesignEntry.model_validate_json(file.read_bytes())
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"]))
        raise UnreadableFileError(
            f"no entry: {place}: {first['msg']}; docs/design.md shows one",
            where=str(file),
        ) from None
    if entry.version != VERSION:
        raise UsageError(
            f"the entry is for version {entry.version} of the tasks, which have "
            f"version {VERSION}; search again",
            where=str(file),
        )
    for name, values in entry.parameters.items():
        load_task(name).check(values)
    return entry


def judge(
    entry: DesignEntry | str | Path,
    *,
    workers: int = 1,
    results: str | Path | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> dict[str, Verdict]:
    """Simulate the parameters of an entry and measure what they reach.

    Verdicts that the entry brings along are not believed.

    Args:
        entry: the entry, or its file.
        workers: processes.
        results: file to which the entry is written with each new verdict. Where it
            has the same parameters, an interrupted call goes on.
        progress: receives the number of judged tasks.

    Returns:
        The verdict of each task of the entry.

    Raises:
        UnreadableFileError: the file of the entry or of the results is none.
        UsageError: an unknown task, or parameters out of bounds.
    """
    if not isinstance(entry, DesignEntry):
        entry = read_entry(entry)
    done = {}
    if results is not None and Path(results).exists():
        stored = read_entry(results)
        for name, verdict in stored.verdicts.items():
            if stored.parameters.get(name) == entry.parameters.get(name):
                done[name] = verdict
    meter = Meter(progress)
    meter.begin(
        "judging",
        total=len(entry.parameters),
        scenarios=len(entry.parameters),
        done=len(done),
        unit="tasks",
    )
    items = []
    for name, values in entry.parameters.items():
        if name not in done:
            items.append(
                WorkItem(name=name, function=_judge_item, argument=(name, values))
            )
    for finished in run_items(items, workers=workers):
        done[finished.item.name] = finished.value
        meter.count(1, scenarios=1)
        if results is not None:
            write_entry(entry.model_copy(update={"verdicts": done}), results)
    return {name: done[name] for name in task_names() if name in done}


def write_entry(entry: DesignEntry, path: str | Path) -> None:
    """Write an entry to a JSON file."""
    write_atomically(Path(path), entry.model_dump_json(indent=1).encode() + b"\n")


def _judge_item(item: tuple[str, list[float]], _: Report) -> Verdict:
    return judge_task(*item)


def judge_task(name: str, values: list[float]) -> Verdict:
    """Return what parameters of one task reach.

    Raises:
        UsageError: an unknown task, or parameters out of bounds.
    """
    task = load_task(name)
    try:
        positions = task.simulate(values)
    except WorkFailedError:
        return Verdict(error=None, sha256="")
    error = task.measure(positions.astype(np.float64), task.check(values))
    digest = sha256(np.ascontiguousarray(positions, "<f4").tobytes()).hexdigest()
    return Verdict(error=error, sha256=digest)


def scale_error(name: str, error: float | None) -> float | None:
    """Return the score of an error; None where little is known of the task.

    It is 0 for the best of 64 random draws and what is worse, 1 for the best that is
    known, and more for what is better.
    """
    known = known_errors().get(name)
    if known is None or known.best >= known.random:
        return None
    if error is None:
        return 0.0
    return max(0.0, (known.random - error) / (known.random - known.best))


@functools.cache
def known_errors() -> Mapping[str, Known]:
    """Return what is known of each task; ``python -m benchmarks.design known`` finds
    it anew.
    """
    text = files(__package__).joinpath("known.json").read_text("utf-8")
    return {name: Known(**known) for name, known in json.loads(text).items()}
