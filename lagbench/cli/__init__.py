"""The command line: each command is a thin shell over the function of its name.

Commands import what they need inside their bodies, so that ``lagbench --help`` loads typer
and rich only.
"""

from __future__ import annotations

import io
import sys

__all__ = ["main"]


def main() -> None:
    """Run the command line; the entry point ``lagbench``."""
    from .app import app

    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a letter that a stream has not shall not end the work
            stream.reconfigure(errors="backslashreplace")
    app()
