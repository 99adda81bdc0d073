"""What this process may use: processors, and limits that it sets itself.

Windows has no limits (no module ``resource``: then ``LIMITS`` is false), macOS refuses one on the
address space. Nothing stands in for a limit that is not to be had.
"""

from __future__ import annotations

import os
import signal
import sys

try:
    import resource
except ImportError:
    LIMITS = False
else:
    LIMITS = True

__all__ = ["LIMITS", "TOO_LONG", "available_cores", "limit_process"]


TOO_LONG = -int(getattr(signal, "SIGXCPU", 0)) or None
"""Return code of a process that computed longer than it may; None where there is no such limit."""


def available_cores() -> int:
    """Return the number of processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def limit_process(*, memory: int, seconds: int) -> None:
    """Bound what this process may take from now on, as far as the system can.

    Args:
        memory: address space [bytes].
        seconds: processor time since the process began [s].
    """
    if not LIMITS:
        return
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 1))
    if sys.platform != "darwin":
        resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
