"""Lines on stderr, which no command needs to do its work."""

from __future__ import annotations

import os
import sys
from contextlib import suppress

import typer

from lagbench.errors import escape_unprintable


def print_on_stderr(text: str) -> None:
    """Print a text on stderr; where that is full or has no reader, it is lost."""
    try:
        typer.echo(escape_unprintable(text), err=True)
    except OSError:
        # What is buffered would fail again at the end, and change the exit code.
        with suppress(AttributeError, OSError):
            null_device = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null_device, sys.stderr.fileno())
