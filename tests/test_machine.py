"""Threads of a model: asked for, told by the environment, or a share of the cores."""

from __future__ import annotations

import os

import pytest
import torch

from lagbench.baselines.machine import threads_used


@pytest.mark.parametrize(
    ("count", "environment", "expected"),
    [(3, "2", 3), (None, "2", 2), (None, "0", 1), (None, "", None), (None, "many", None)],
)
def test_threads_are_those_asked_for(
    monkeypatch: pytest.MonkeyPatch, count: int | None, environment: str, expected: int | None
) -> None:
    """The option wins over OMP_NUM_THREADS, that over one per core; afterwards all is as before."""
    monkeypatch.setenv("OMP_NUM_THREADS", environment)
    before = torch.get_num_threads()
    with threads_used(count):
        assert torch.get_num_threads() == (expected or len(os.sched_getaffinity(0)))
    assert torch.get_num_threads() == before


def test_processes_share_the_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    """As many processes as cores have one thread each."""
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    cores = len(os.sched_getaffinity(0))
    for processes in (cores, cores + 1):
        with threads_used(None, processes=processes):
            assert torch.get_num_threads() == 1
