"""Try score files in a child process first: HDF5 is C code that believes what it reads."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

__all__ = ["unreadable_in_child"]

MEMORY = 768 << 20
"""Address space of the child [bytes]."""

CPU_SECONDS = 10
"""Computing time of the child to start, and for every 50 files [s]."""

FILES_PER_PART = 50

MOST_STOPS = 5
"""Files that may stop a child before the rest is left unread: each costs a child's whole time."""

WALL_SECONDS = 600.0
"""Time for all files together, and for every 50 of them [s]; a busy machine may need minutes."""

UNREAD = "not read, because too many others had to be stopped or took all the time allowed"

CHILD = "lagbench.board.child"
"""The child's program; -P keeps the current folder, where strangers' files may lie, off its path."""


def unreadable_in_child(paths: Sequence[Path]) -> dict[Path, str]:
    """Return the files that cannot be read, and why.

    A child that a file stops is started anew for the rest, :data:`MOST_STOPS` times at most and
    within :data:`WALL_SECONDS` for every :data:`FILES_PER_PART` files, whatever the files do.
    """
    found: dict[Path, str] = {}
    left, stops = list(paths), 0
    end = time.monotonic() + WALL_SECONDS * _parts(paths)
    while left:
        if stops == MOST_STOPS or time.monotonic() >= end:
            return found | dict.fromkeys(left, UNREAD)
        answers, how = _asked(left, end - time.monotonic())
        found |= {path: str(said) for path, said in zip(left, answers, strict=False) if said is not None}
        if len(answers) < len(left):
            found[left[len(answers)]] = f"reading it had to be stopped: {how}"
            stops += 1
        left = left[len(answers) + 1 :]
    return found


def _parts(paths: Sequence[Path]) -> int:
    return 1 + len(paths) // FILES_PER_PART


def _asked(paths: Sequence[Path], room: float) -> tuple[list[str | None], str]:
    """Return the child's answers, and how it ended."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MALLOC_ARENA_MAX": "2"}
    try:
        done = subprocess.run(
            [sys.executable, "-P", "-m", CHILD, str(MEMORY), str(CPU_SECONDS * _parts(paths))],
            input=json.dumps([str(path) for path in paths]).encode(),
            capture_output=True,
            timeout=room,
            env=environment,
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        return _lines(error.stdout or b""), "no end in time"
    return _lines(done.stdout), f"exit code {done.returncode}"


def _lines(output: bytes) -> list[str | None]:
    return [json.loads(line) for line in output.splitlines(keepends=True) if line.endswith(b"\n")]
