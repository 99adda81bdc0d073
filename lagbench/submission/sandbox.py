"""Look at a file in a child process with limits on memory and time.

HDF5 is C code that parses whatever it is given. What loops, crashes or asks for too much ends
the child; the parent says so and goes on. The child answers in JSON, so nothing that it sends
is executed.
"""

from __future__ import annotations

import dataclasses
import json
import os
import pickle
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from lagbench.data.registry import Registry
from lagbench.errors import WorkFailedError

from .findings import CHECKS, Finding, Findings, Severity, ValidationResult

__all__ = ["CPU_SECONDS", "MEMORY", "OUT_OF_MEMORY", "WALL_SECONDS", "Request", "encode", "run_isolated"]

MEMORY = 768 << 20
"""Address space of the child [bytes]."""

CPU_SECONDS = 3.0
"""Computing time for a small file, the start of the child aside [s]."""

WALL_SECONDS = 600.0
"""Time for the child and a small file [s]; only a child that waits gets that far.

What computes too long is stopped by the kernel, which counts computing time: on a machine that is
busy with other work a sound file may take minutes.
"""

BYTES_PER_SECOND = 20e6
"""Larger files get more time: a slow reader's speed [bytes/s]."""

CHILD = "lagbench.submission.child"
"""The child's program; -P keeps the current folder, where strangers' files may lie, off its path."""

OUT_OF_MEMORY = 77
"""Exit code of a child that needed more than :data:`MEMORY`."""


@dataclass(frozen=True, kw_only=True)
class Request:
    """What to validate."""

    path: Path  # the file
    root: Path  # folder of all data sets
    require_truth: bool  # whether a missing test subset is an error
    registry: Registry  # where splits are described


def run_isolated(request: Request) -> ValidationResult:
    """Examine a file in a child process; whatever stops the child fails the check ``readable``."""
    status = request.path.stat()
    # A sparse file claims any length; what it occupies is what has to be read.
    extra = min(status.st_size, 512 * status.st_blocks) / BYTES_PER_SECOND
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MALLOC_ARENA_MAX": "2"}
    try:
        done = subprocess.run(
            [sys.executable, "-P", "-m", CHILD, str(int(CPU_SECONDS + extra))],
            input=pickle.dumps(request),
            capture_output=True,
            timeout=WALL_SECONDS + extra,
            env=environment,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return _stopped(request.path, f"no end after {WALL_SECONDS + extra:.0f} s")
    if done.returncode == 0:
        return _decode(done.stdout)
    if done.returncode == OUT_OF_MEMORY:
        return _stopped(request.path, f"more than {MEMORY >> 20} MiB of memory")
    if done.returncode < 0:
        return _stopped(request.path, _signal(-done.returncode))
    raise WorkFailedError(
        "the validator itself failed",
        where=str(request.path),
        got=ascii(done.stderr.decode("utf-8", "replace").strip().rsplit("\n", 1)[-1][:300]),
        fix="`lagbench doctor` checks the installation; if it finds nothing, report this with the file",
    )


def _signal(number: int) -> str:
    if number == signal.SIGXCPU:
        return "no end within the computing time allowed"
    return f"HDF5 crashed: {signal.strsignal(number) or number}"


def _stopped(path: Path, got: str) -> ValidationResult:
    out = Findings()
    out.error(
        "readable",
        "reading the file had to be stopped",
        where=str(path),
        expected="a file that HDF5 reads within the limits",
        got=got,
        fix="the file is damaged or made to do harm; write it again with lagbench.submission.write",
    )
    out.skip("the file cannot be read", *CHECKS)
    return out.result(path)


def encode(result: ValidationResult) -> bytes:
    """Return a result as the child sends it."""
    value = dataclasses.asdict(result) | {"path": str(result.path)}
    return json.dumps(value).encode()


def _decode(data: bytes) -> ValidationResult:
    value = json.loads(data)
    findings = tuple(Finding(**{**f, "severity": Severity(f["severity"])}) for f in value["findings"])
    return ValidationResult(
        **{**value, "path": Path(value["path"]), "findings": findings, "passed": tuple(value["passed"])}
    )
