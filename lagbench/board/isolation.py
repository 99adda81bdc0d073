"""Try score files in a child process first: HDF5 is C code that believes what it reads."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

__all__ = ["unreadable_in_child"]

MEMORY = 768 << 20
"""Address space of the child [bytes]."""

CPU_SECONDS = 10
"""Computing time of the child to start, and for every 50 files [s]."""

FILES_PER_PART = 50

CHILD = "lagbench.board.child"
"""The child's program; -P keeps the current folder, where strangers' files may lie, off its path."""


def unreadable_in_child(paths: Sequence[Path]) -> dict[Path, str]:
    """Return the files that cannot be read, and why; a child that one of them stops is started anew."""
    found: dict[Path, str] = {}
    left = list(paths)
    while left:
        answers, end = _asked(left)
        found |= {path: str(said) for path, said in zip(left, answers, strict=False) if said is not None}
        if len(answers) < len(left):
            found[left[len(answers)]] = f"reading it had to be stopped: {end}"
        left = left[len(answers) + 1 :]
    return found


def _asked(paths: Sequence[Path]) -> tuple[list[str | None], str]:
    """Return the child's answers, and how it ended."""
    seconds = CPU_SECONDS * (1 + len(paths) // FILES_PER_PART)
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MALLOC_ARENA_MAX": "2"}
    try:
        done = subprocess.run(
            [sys.executable, "-P", "-m", CHILD, str(MEMORY), str(seconds)],
            input=json.dumps([str(path) for path in paths]).encode(),
            capture_output=True,
            timeout=10.0 * seconds,
            env=environment,
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        return _lines(error.stdout or b""), "no end in time"
    return _lines(done.stdout), f"exit code {done.returncode}"


def _lines(output: bytes) -> list[str | None]:
    return [json.loads(line) for line in output.splitlines(keepends=True) if line.endswith(b"\n")]
