"""Judge the parameters of an entry: simulate them, and measure what they reach."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from hashlib import sha256
from importlib.resources import files
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError
from rich.console import Console
from rich.progress import track

from lagbench.atomic import write_atomically
from lagbench.errors import UnreadableFileError, UsageError, WorkFailedError
from lagbench.work.run import watched

from .tasks import VERSION, load_task, task_names

MOST_BYTES = 1 << 20
"""Bytes that a file of an entry may have."""


class Entry(BaseModel):
    """What an entry hands in, a JSON file."""

    model_config = ConfigDict(extra="forbid")

    method: str  # how the parameters were found
    version: int = VERSION  # of the tasks
    parameters: dict[str, list[float]]  # by task
    seconds: dict[str, float] = {}  # processor time of each search [s]
    runs: dict[str, int] = {}  # simulator runs of each search


@dataclass(frozen=True)
class Judgement:
    """What the parameters of one task reach."""

    task: str
    error: float  # infinite where the run left the bounds of the solver
    # 0 for the best of 64 random draws, 1 for the best known parameters
    score: float
    sha256: str  # of the positions of the judged run


def read_entry(path: str | Path) -> Entry:
    """Read an entry; parameters out of bounds are refused.

    Raises:
        UnreadableFileError: the file is missing, too long, or no entry.
        UsageError: an unknown task, or parameters out of bounds.
    """
    file = Path(path)
    if not file.is_file() or file.stat().st_size > MOST_BYTES:
        raise UnreadableFileError(
            f"{file} is no file of at most 1 MiB; name the JSON file of an entry"
        )
    try:
        entry = Entry.model_validate_json(file.read_bytes())
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"]))
        raise UnreadableFileError(f"{file}: {place}: {first['msg']}") from None
    if entry.version != VERSION:
        raise UsageError(
            f"{file} is for version {entry.version} of the tasks, which have version "
            f"{VERSION}; search again"
        )
    for name, values in entry.parameters.items():
        load_task(name).check(values)
    return entry


def judge(
    entry: Entry | str | Path,
    *,
    workers: int = 1,
    results: str | Path | None = None,
    quiet: bool = True,
) -> list[Judgement]:
    """Simulate the parameters of an entry and measure what they reach.

    Args:
        entry: the entry, or its file.
        workers: processes.
        results: JSON file of judgements. Those in it are not made again while the
            parameters are the same, so an interrupted call goes on.
        quiet: show no progress.

    Raises:
        UnreadableFileError: the file of the entry or of the results is none.
        UsageError: an unknown task, or parameters out of bounds.
    """
    if not isinstance(entry, Entry):
        entry = read_entry(entry)
    done = _read_results(results, entry)
    jobs = {}
    for name in task_names():
        if name in entry.parameters and name not in done:
            jobs[name] = entry.parameters[name]
    context = get_context("spawn")
    with ProcessPoolExecutor(max(1, workers), mp_context=context) as pool:
        judgements = pool.map(_judge_one, jobs, jobs.values())
        if not quiet and watched():
            judgements = track(
                judgements,
                total=len(jobs),
                description="judge",
                console=Console(stderr=True),
                transient=True,
            )
        for judgement in judgements:
            done[judgement.task] = judgement
            _write_results(results, entry, done)
    return [done[name] for name in task_names() if name in done]


def _judge_one(name: str, values: list[float]) -> Judgement:
    """Return the judgement of one task."""
    task = load_task(name)
    try:
        positions = task.simulate(values)
    except WorkFailedError:
        return Judgement(name, math.inf, 0.0, "")
    error = task.measure(positions.astype(np.float64), task.check(values))
    digest = sha256(np.ascontiguousarray(positions, "<f4").tobytes()).hexdigest()
    return Judgement(name, error, scale_error(name, error), digest)


def scale_error(name: str, error: float) -> float:
    """Return the score of an error: 0 for the best of 64 random draws, 1 for the best
    known.
    """
    known = known_errors()[name]
    return (known["random"] - error) / (known["random"] - known["best"])


def known_errors() -> Mapping[str, Mapping[str, Any]]:
    """Return the best random and the best known error of each task, with parameters.

    ``python -m benchmarks.design known`` makes the file anew.
    """
    text = files(__package__).joinpath("known.json").read_text("utf-8")
    known: Mapping[str, Mapping[str, Any]] = json.loads(text)
    return known


def _read_results(path: str | Path | None, entry: Entry) -> dict[str, Judgement]:
    """Return the judgements of a file that are about the entry's parameters."""
    if path is None or not Path(path).is_file():
        return {}
    try:
        stored = json.loads(Path(path).read_text("utf-8"))
        done = {}
        for line in stored["judgements"]:
            judgement = Judgement(**line)
            values = stored["parameters"].get(judgement.task)
            if values == entry.parameters.get(judgement.task):
                done[judgement.task] = judgement
    except (ValueError, KeyError, TypeError):
        raise UnreadableFileError(
            f"{path} holds no judgements; name another file"
        ) from None
    return done


def _write_results(
    path: str | Path | None, entry: Entry, done: Mapping[str, Judgement]
) -> None:
    """Store judgements beside the parameters that they are about."""
    if path is None:
        return
    parameters = {name: entry.parameters[name] for name in done}
    content = {
        "method": entry.method,
        "version": VERSION,
        "parameters": parameters,
        "judgements": [vars(judgement) for judgement in done.values()],
    }
    write_atomically(Path(path), json.dumps(content, indent=1).encode())
