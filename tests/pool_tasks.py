"""Tasks for the worker pool; workers import this module by name."""

from __future__ import annotations

import atexit
import errno
import os
import signal
import threading
import time
import warnings
from pathlib import Path

from lagbench.data.registry import PluginWarning
from lagbench.errors import DataError
from lagbench.work.pool import Report


def square(number: int, report: Report) -> int:
    """Report one unit and return the square."""
    report(1)
    return number * number


def die_once(marker: Path, report: Report) -> str:
    """Kill the worker on the first call only."""
    report(5)
    if not marker.exists():
        marker.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return "survived"


def die(report: Report) -> None:
    """Kill the worker on every call."""
    os.kill(os.getpid(), signal.SIGKILL)


def refuse(report: Report) -> None:
    """Raise an error of ours."""
    raise DataError("what is wrong", where="here", expected=1, got=2, fix="mend it")


def crash(report: Report) -> None:
    """Raise an error of nobody's."""
    raise ZeroDivisionError


def lack_permission(path: Path, report: Report) -> None:
    """Raise an error of the operating system."""
    raise PermissionError(errno.EACCES, "Permission denied", str(path))


def lock(report: Report) -> object:
    """Return what no process can send to another one."""
    return threading.Lock()


class UnsentError(OSError):
    """An error that cannot be sent to another process: it needs two arguments."""

    def __init__(self, number: int, place: str) -> None:
        super().__init__(errno.EPIPE, f"{number} at {place}")


def break_a_pipe(report: Report) -> None:
    """Raise an error of the operating system that no message explains."""
    raise UnsentError(1, "here")


def sleep_long(marker: Path, report: Report) -> None:
    """Write the worker's process id, then work for a minute, deaf to everything."""
    marker.write_text(str(os.getpid()))
    report(1)
    for _ in range(600):
        time.sleep(0.1)


def leave_a_note(marker: Path, report: Report) -> None:
    """Write a file when the worker's interpreter exits by itself."""
    atexit.register(marker.write_text, "left in peace")


def warn(report: Report) -> None:
    """Give a warning of lagbench and one of Python."""
    warnings.warn("package mine adds no metric", PluginWarning, stacklevel=1)
    warnings.warn("a mean of nothing", RuntimeWarning, stacklevel=1)
