"""The child's program: read the score files named on stdin under limits, say how each went.

One line of JSON per file, in their order: null, or why it cannot be read. A file that stops
the child has no line.
"""

from __future__ import annotations

import json
import resource
import sys
from pathlib import Path

from lagbench.errors import UnreadableFileError

from .stored import read_stored

__all__ = ["main"]


def main() -> int:
    """Read the files; the arguments are memory [bytes] and computing time [s] allowed."""
    memory, seconds = int(sys.argv[1]), int(sys.argv[2])
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 1))
    for path in json.load(sys.stdin):
        try:
            read_stored(Path(path))
            answer = None
        except UnreadableFileError as error:
            answer = f"{error.what}: {error.got}"
        sys.stdout.write(json.dumps(answer) + "\n")
        sys.stdout.flush()
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
