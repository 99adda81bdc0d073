"""One way to time, and one to measure in a process of its own."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

from pytest_benchmark.fixture import BenchmarkFixture

ROOT = Path(__file__).parents[1]

__all__ = ["best_processor_seconds", "best_seconds", "measured_apart"]


def best_seconds(
    benchmark: BenchmarkFixture,
    call: Callable[[], object],
    *,
    rounds: int,
    warmup_rounds: int = 0,
) -> float:
    """Run a call some rounds under pytest-benchmark and return the shortest [s]."""
    # Calls of the pedantic mode are not annotated.
    benchmark.pedantic(call, rounds=rounds, warmup_rounds=warmup_rounds)  # type: ignore[no-untyped-call]
    # None only with --benchmark-disable, when there is nothing to report.
    if benchmark.stats is not None:
        return float(benchmark.stats.stats.min)
    return float("nan")


def best_processor_seconds(call: Callable[[], object], *, rounds: int) -> float:
    """Run a call some rounds and return the shortest processor time [s].

    Other processes on the machine hardly change it, as they do the time on the wall.
    """
    best = math.inf
    for _ in range(rounds):
        start = time.process_time()
        call()
        best = min(best, time.process_time() - start)
    return best


def measured_apart(*arguments: str, cores: Collection[int] = ()) -> Any:  # noqa: ANN401 (plain values)
    """Run Python in a process of its own, on some cores where they are named; return
    the JSON at its end.
    """
    done = subprocess.run(
        [sys.executable, *arguments],
        env={**os.environ, "PYTHONPATH": str(ROOT)},  # for validation/
        preexec_fn=(lambda: os.sched_setaffinity(0, cores)) if cores else None,
        capture_output=True,
        text=True,
        check=True,
    )
    return json.loads(done.stdout.splitlines()[-1])
