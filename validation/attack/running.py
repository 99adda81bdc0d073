"""Run a command of lagbench in a child process, with its time and memory measured."""

from __future__ import annotations

import hashlib
import os
import signal
import stat
import sys
import time
import traceback
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from lagbench.data import registry
from lagbench.data.layout import NOTES_NAME
from lagbench.work.machine import available_cores

MOST_SECONDS = 60.0
"""Longest time of a case [s], on a machine that is not busy."""

MOST_BYTES = 4 << 30
"""Most memory of a case and of its child processes, each [bytes]."""

DOCUMENTED_CODES = frozenset(range(6))
"""Exit codes of lagbench; 130 and 141 are for interrupts and closed pipes."""

MOST_HASHED_BYTES = 8 << 20
"""Longer files count for the same while length and time of change stay [bytes]."""

FOLDER = str(stat.S_IFDIR)
"""What a snapshot says of a folder; an empty one that a command leaves harms nobody."""

MARKER = "hostile"
"""Begins the names of files that only code from a hostile file writes."""


@dataclass(frozen=True)
class Outcome:
    """How a command ended."""

    code: int | None  # exit code; negative for a signal, None where it was killed
    seconds: float
    is_late: bool  # whether it was killed because it took too long
    peak_bytes: int  # most memory of the process or one of its children
    output: str
    errors: str


def run_command(
    arguments: Sequence[str],
    folder: Path,
    logs: Path,
    *,
    model_seconds: float = 0.0,
    is_installed: bool = False,
) -> Outcome:
    """Run ``lagbench ARGUMENTS`` in a folder, in a fork of this process.

    Args:
        arguments: words after the program's name.
        folder: working folder of the command.
        logs: folder for what the command prints.
        model_seconds: processor time that the command grants a model, beyond
            :data:`MOST_SECONDS` [s].
        is_installed: whether packages in the working folder count as installed.
    """
    most_seconds = (MOST_SECONDS + model_seconds) * _waiting_processes()
    started = time.monotonic()
    process = os.fork()
    if process == 0:
        if is_installed:
            # what this process knows of installed packages is known no more
            sys.path.insert(0, str(folder))
            registry._load.cache_clear()
        _become_command(arguments, folder, logs)
    code: int | None = None
    is_late = False
    while True:
        finished, status, usage = os.wait4(process, os.WNOHANG)
        seconds = time.monotonic() - started
        if finished:
            code = os.waitstatus_to_exitcode(status)
            break
        if seconds > most_seconds:
            is_late = True
            os.killpg(process, signal.SIGKILL)
            _, _, usage = os.wait4(process, 0)
            break
        time.sleep(0.02)
    return Outcome(
        code=code,
        seconds=seconds,
        is_late=is_late,
        peak_bytes=usage.ru_maxrss * 1024,
        output=(logs / "stdout").read_text(errors="replace"),
        errors=(logs / "stderr").read_text(errors="replace"),
    )


def _waiting_processes() -> float:
    """Return how many processes share a core, at least one."""
    return max(1.0, os.getloadavg()[0] / available_cores())


def _become_command(arguments: Sequence[str], folder: Path, logs: Path) -> None:
    """Run a command in this process, a child, and end it."""
    code = 99
    try:
        os.setsid()
        os.chdir(folder)
        for number, name in ((1, "stdout"), (2, "stderr")):
            descriptor = os.open(logs / name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            os.dup2(descriptor, number)
        null_device = os.open(os.devnull, os.O_RDONLY)
        os.dup2(null_device, 0)
        sys.argv = ["lagbench", *arguments]
        from lagbench.cli.program import app

        app(args=list(arguments), prog_name="lagbench")
        code = 0
    except SystemExit as error:
        code = _exit_code(error)
    except BaseException:
        traceback.print_exc()
    finally:
        # The command may have closed its streams, but this child ends here.
        try:
            for stream in (sys.stdout, sys.stderr):
                if not stream.closed:
                    stream.flush()
        finally:
            os._exit(code)


def _exit_code(error: SystemExit) -> int:
    """Return the exit code that Python ends with; print the text of an error."""
    if error.code is None:
        return 0
    if isinstance(error.code, int):
        return error.code & 0xFF
    sys.stderr.write(f"{error.code}\n")
    return 1


def take_snapshot(folder: Path) -> dict[str, str]:
    """Return what lies below a folder: a text for each path.

    Links are not followed; the text of a link has its target.
    """
    snapshot = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        status = path.lstat()
        kind = stat.S_IFMT(status.st_mode)
        text = str(kind)
        if stat.S_ISREG(kind):
            text += f" {status.st_size}"
            # a mutation may have forbidden to read it
            if status.st_size <= MOST_HASHED_BYTES and os.access(path, os.R_OK):
                text += f" {hashlib.sha256(path.read_bytes()).hexdigest()}"
            else:
                text += f" {status.st_mtime_ns}"
        elif stat.S_ISLNK(kind):
            text += f" {os.readlink(path)}"
        snapshot[name] = text
    return snapshot


def find_failures(
    outcome: Outcome, before: dict[str, str], after: dict[str, str]
) -> list[str]:
    """Return what is wrong with how a command ended, as kinds of failure.

    Args:
        outcome: how it ended.
        before: what lay in the working folder before; see :func:`take_snapshot`.
        after: what lay there after it.
    """
    failures = []
    texts = f"{outcome.output}\n{outcome.errors}"
    if "Traceback (most recent" in texts or "fault of lagbench" in texts:
        failures.append("traceback")
    if outcome.is_late:
        failures.append("more than 60 s")
    elif outcome.code not in DOCUMENTED_CODES:
        failures.append("exit code")
    elif outcome.code != 0 and not texts.strip():
        failures.append("no message")
    if outcome.peak_bytes > MOST_BYTES:
        failures.append("more than 4 GB")

    new_names = []
    for name, text in after.items():
        if name not in before and text != FOLDER:
            new_names.append(name)
    changed_names = []
    for name, text in before.items():
        if after.get(name) != text:
            changed_names.append(name)
    if any(Path(name).name.startswith(MARKER) for name in new_names):
        failures.append("code of a file was run")
    if outcome.code == 0:
        leftovers = [name for name in new_names if _is_temporary(name)]
    else:
        leftovers = [name for name in new_names if not _may_stay(name)]
        leftovers += [name for name in changed_names if not _may_stay(name)]
    if leftovers:
        failures.append("half-written")
    return failures


def _may_stay(name: str) -> bool:
    """Tell whether a file is a lock, or the notes of what was hashed."""
    return _is_lock(name) or Path(name).name == NOTES_NAME


def _is_lock(name: str) -> bool:
    return Path(name).name == ".lock" or name.endswith(".lock")


def _is_temporary(name: str) -> bool:
    last = Path(name).name
    if _may_stay(name):
        return False
    return last.startswith(".") or ".tmp" in last
