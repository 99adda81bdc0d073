"""Which part of what is too much for one run is tested at this commit."""

from __future__ import annotations

import functools
import os
import subprocess
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

import pytest

Case = TypeVar("Case")


@functools.cache
def turn() -> int:
    """Return a number that picks the part which this run tests.

    ``LAGBENCH_TURN`` is the number, or ``all``, which is 0 here. Without it the number
    is drawn by the hash of the last commit: the same commit tests the same part again.
    Commits are not counted, because CI may run once for several of them. It is 0 where
    git does not tell.
    """
    chosen = os.environ.get("LAGBENCH_TURN", "")
    if chosen == "all":
        return 0
    if chosen:
        return int(chosen)
    command = ["git", "rev-parse", "HEAD"]
    folder = Path(__file__).parent
    try:
        done = subprocess.run(
            command,
            cwd=folder,
            capture_output=True,
            text=True,
            check=True,
        )
    except (OSError, subprocess.CalledProcessError):
        return 0
    return int(done.stdout, base=16)


def of_this_turn(cases: Sequence[Case], *, turns: int, shift: int = 0) -> list[Case]:
    """Return one case in ``turns``, others after another commit.

    With ``LAGBENCH_TURN=all`` these are all cases.
    """
    if os.environ.get("LAGBENCH_TURN") == "all":
        return list(cases)
    first = -(turn() + shift) % turns
    return list(cases[first::turns])


def leave_out_slow_tests(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out tests marked slow, others after another commit.

    ``LAGBENCH_SLOW_SHARE`` is the share of them that runs, as in ``0.33``. By default
    all run, as with ``LAGBENCH_TURN=all``. Each test is drawn by its name and the turn.
    So it does not wait for ever where its module takes turns too.
    """
    share = float(os.environ.get("LAGBENCH_SLOW_SHARE", "1"))
    if os.environ.get("LAGBENCH_TURN") == "all":
        share = 1.0
    left_out = []
    kept = []
    for item in items:
        draw = zlib.crc32(f"{item.nodeid} {turn()}".encode()) / 2**32
        if item.get_closest_marker("slow") and draw >= share:
            left_out.append(item)
        else:
            kept.append(item)
    config.hook.pytest_deselected(items=left_out)
    items[:] = kept


PROGRAMS = of_this_turn(("README", "notebook", "demo"), turns=3, shift=2)
"""Which of three programs runs whole: each trains a model until it is good."""
