"""The start of the program `lagbench`: from here on Ctrl-C prints one line."""

from __future__ import annotations

import os
import signal
import threading
from typing import NoReturn

MESSAGE = b"lagbench: interrupted before it began\n"
INTERRUPTED = 130


def app() -> None:
    """Run the program with the words of the command line; ends with its exit code."""
    _fill_standard_descriptors()
    try:
        is_heard = _is_interruptible()
        if is_heard:
            signal.signal(signal.SIGINT, _end_at_once)
        from .cli.program import app as program

        if is_heard:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        program()
    except KeyboardInterrupt:
        _end_at_once()
    finally:
        # All is written; Python's own end shall print no traceback.
        if _is_interruptible():
            signal.signal(signal.SIGINT, signal.SIG_DFL)


def _fill_standard_descriptors() -> None:
    """Open the null device where standard input, output or error is closed.

    Otherwise the next file or socket that is opened would get that number, here or in a
    process that we start.
    """
    for standard in range(3):
        try:
            os.fstat(standard)
        except OSError:
            # the system gives the lowest free number, which is this one
            null = os.open(os.devnull, os.O_RDWR)
            os.set_inheritable(null, True)


def _is_interruptible() -> bool:
    """Tell whether Ctrl-C raises KeyboardInterrupt in this thread.

    A shell's background jobs ignore the signal. Only the main thread gets it, and only
    there a handler can be set.
    """
    if threading.current_thread() is not threading.main_thread():
        return False
    return signal.getsignal(signal.SIGINT) is signal.default_int_handler


def _end_at_once(*_signal: object) -> NoReturn:
    """End this process while modules are imported, when nothing has begun.

    An exception would not do: some modules catch what is raised as they are imported.
    """
    try:
        os.write(2, MESSAGE)
    finally:  # stderr may be closed, or a full disk
        os._exit(INTERRUPTED)


if __name__ == "__main__":
    app()
