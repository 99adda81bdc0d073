"""The start of the program `lagbench`: from here on Ctrl-C prints one line."""

from __future__ import annotations

import sys

INTERRUPTED = 130


def app() -> None:
    """Run the program with the words of the command line; ends with its exit code."""
    try:
        from .cli.program import app as program

        exit_code = program()
    except KeyboardInterrupt:
        sys.stderr.write("lagbench: interrupted\n")
        exit_code = INTERRUPTED
    sys.exit(exit_code)


if __name__ == "__main__":
    app()
