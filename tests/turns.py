"""Which part of what is too much for one run is tested at this commit."""

from __future__ import annotations

import functools
import os
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

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


PROGRAMS = of_this_turn(("README", "notebook", "demo"), turns=3, shift=2)
"""Which of three programs runs whole: each trains a model until it is good."""
