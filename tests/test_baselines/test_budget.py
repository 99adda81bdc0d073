"""Budgets of trainings: which track follows from them, and their way from a training to
the board.
"""

from __future__ import annotations

from typing import Any

import pytest

from lagbench.board.entry import EntryBudget
from lagbench.submission.budget import Budget, track_of


@pytest.mark.parametrize(
    ("size", "minutes", "gpu", "track"),
    [
        ("mini", 15.0, 0.0, "equal compute"),
        ("mini", 15.7, 0.0, "equal compute"),
        ("mini", 15.8, 0.0, None),  # 15 minutes and 5 % are 15.75
        ("mini", 1.0, 0.1, None),
        ("full", 62.9, 0.0, "equal compute"),
        ("full", 63.1, 0.0, None),
        ("tiny", 0.1, 0.0, None),
    ],
)
def test_equal_compute_limits_hours_and_excludes_gpus(
    size: str,
    minutes: float,
    gpu: float,
    track: str | None,
) -> None:
    """At most 15 minutes of processor time at mini, 60 at full, 5 % more allowed, and
    no GPU.
    """
    for beside in (
        None,
        0.2,
    ):  # processor time of validations is told apart and decides nothing
        spent = Budget(cpu_hours=minutes / 60, gpu_hours=gpu, validation_hours=beside)
        assert track_of(size, spent) == track


@pytest.mark.parametrize(
    ("validations", "track"),
    [
        (((500, 1.0), (1000, 0.99)), "converged"),
        (((500, 1.0), (1000, 0.97)), None),
        (
            ((500, 1.0), (1000, 1.2)),
            "converged",
        ),  # what came later is worse: nothing was gained
        (
            ((250, 1.0), (500, 1.1), (1000, 0.97)),
            None,
        ),  # the best of the first half counts
        (((250, 1.0), (1000, 1.0)), None),  # nobody looked at half the steps
        (((1000, 1.0),), None),
        ((), None),
    ],
)
def test_the_track_is_converged_when_the_last_doubling_gains_little(
    validations: tuple[tuple[int, float], ...], track: str | None
) -> None:
    """The best validation falls by less than 2 % over the last doubling of the
    steps.
    """
    best = min((value for _, value in validations), default=None)
    long = Budget(
        steps=1000,
        epochs=1.0,
        cpu_hours=5.0,
        gpu_hours=0.0,
        best=best,
        validations=validations,
    )
    assert track_of("mini", long) == track


def test_an_entry_has_the_mean_budget_of_its_seeds() -> None:
    """An entry has the mean of its seeds' budgets, and their track where it is one."""
    one: dict[str, Any] = {
        "windows": 100,
        "epochs": 0.5,
        "cpu_hours": 0.25,
        "gpu_hours": 0.0,
        "device": "a",
    }
    two = {**one, "windows": 201, "cpu_hours": 0.26, "device": "b"}
    found = EntryBudget.mean_over_seeds("mini", [Budget(**one), Budget(**two)])
    means: dict[str, Any] = {
        "windows": 150,
        "epochs": 0.5,
        "cpu_hours": 0.255,
        "gpu_hours": 0.0,
    }
    assert found == EntryBudget(track="equal compute", **means)
    mixed = EntryBudget.mean_over_seeds(
        "mini", [Budget(**one), Budget(**{**two, "cpu_hours": 2.0})]
    )
    assert mixed.track is None
    assert EntryBudget.mean_over_seeds("mini", [Budget(**one), None]) is None
