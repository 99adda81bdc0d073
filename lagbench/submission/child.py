"""The child's program: answer one request from stdin on stdout, under limits."""

from __future__ import annotations

import math
import pickle
import resource
import sys
import time

from .sandbox import MEMORY, OUT_OF_MEMORY, Request, encode
from .validation import examine

__all__ = ["main"]


def main() -> int:
    """Validate the file of the request; the one argument is the computing time allowed [s].

    What the imports took is not counted: on a busy machine they may take seconds.
    """
    seconds = int(sys.argv[1]) + math.ceil(time.process_time())
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 1))
    request: Request = pickle.load(sys.stdin.buffer)  # from our own parent
    try:
        answer = encode(examine(request))
    except MemoryError:
        return OUT_OF_MEMORY
    sys.stdout.buffer.write(answer)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
