"""One way to time: pytest-benchmark's pedantic mode, whose calls are not annotated."""

from __future__ import annotations

from collections.abc import Callable

from pytest_benchmark.fixture import BenchmarkFixture

__all__ = ["best_seconds"]


def best_seconds(
    benchmark: BenchmarkFixture, call: Callable[[], object], *, rounds: int, warmup_rounds: int = 0
) -> float:
    """Run a call some rounds under pytest-benchmark and return the shortest [s]."""
    benchmark.pedantic(call, rounds=rounds, warmup_rounds=warmup_rounds)  # type: ignore[no-untyped-call]
    # None only with --benchmark-disable, when there is nothing to report.
    return float(benchmark.stats.stats.min) if benchmark.stats is not None else float("nan")
