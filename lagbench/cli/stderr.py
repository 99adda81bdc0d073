"""Lines on stderr, which no command needs to do its work."""

from __future__ import annotations

import sys

from lagbench.errors import escape_unprintable


def print_on_stderr(text: str) -> None:
    """Print a text on stderr."""
    print(escape_unprintable(text), file=sys.stderr, flush=True)
