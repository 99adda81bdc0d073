"""Jobs for worker processes and clusters; they import this module by name."""

from __future__ import annotations

import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path

from lagbench.scoring.score import ScenarioJob, ScenarioScores, score_scenario
from lagbench.work.pool import Report


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
    """Kill the Dask worker that runs this, on every call."""
    os.kill(os.getpid(), signal.SIGKILL)
    return number


def time_out(number: int, report: Report) -> int:
    """Fail as a slow file system does."""
    raise TimeoutError("of the job")


def report_for_ever(marker: Path, report: Report) -> None:
    """Report units until that is an error, and write down its kind."""
    try:
        while True:
            time.sleep(0.05)
            report(1)
    except Exception as error:
        marker.write_text(type(error).__name__)
        raise
