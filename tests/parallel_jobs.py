"""Jobs for worker processes and clusters; they import this module by name."""

from __future__ import annotations

import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path

from lagbench.errors import DataError
from lagbench.scoring.score import ScenarioJob, ScenarioScores, score_scenario
from lagbench.work.executor import Report


@dataclass(frozen=True)
class Deadly:
    """A scoring job whose first try kills its worker.

    Attributes:
        job: the job.
        marker: file that says that it was tried; None for a harmless job.
    """

    job: ScenarioJob
    marker: Path | None


def sit_after_dying_once(deadly: Deadly, report: Report) -> ScenarioScores:
    """Kill the worker on the first call with a marker, else score."""
    if deadly.marker is not None and not deadly.marker.exists():
        deadly.marker.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return score_scenario(deadly.job, report)


def double(number: int, report: Report) -> int:
    """Report one unit and return twice the number; smaller numbers take longer."""
    time.sleep(0.02 * max(0, 4 - number))
    report(1)
    return 2 * number


def take_worker_along(number: int, report: Report) -> int:
    """Kill the worker that runs this, on every call."""
    os.kill(os.getpid(), signal.SIGKILL)
    return number


def refuse(number: int, report: Report) -> int:
    """Raise an error of ours."""
    raise DataError("what is wrong; what to do", where="here")


def time_out(number: int, report: Report) -> int:
    """Fail as a slow file system does."""
    raise TimeoutError("of the job")


def sleep_long(marker: Path, report: Report) -> None:
    """Write the worker's process id, then report for a minute."""
    marker.write_text(str(os.getpid()))
    for _ in range(600):
        time.sleep(0.1)
        report(1)
