"""This machine: its promise of equal bits, its cores, and children under limits.

The promise of docs/determinism.md holds on x86-64 Linux CPUs. A GPU, an ARM CPU or
another system may keep it too, but nothing shows that before its hashes are those of
datasets.yaml.

A library in C that parses a stranger's file may loop, crash or ask for too much:
:func:`run_in_child` calls any function in a child with limits. Requests and answers are
JSON, so nothing that a child sends is executed. Windows has no limits (no module
``resource``: then ``LIMITS`` is false), macOS refuses one on the address space. Nothing
replaces a limit that a system lacks.
"""

from __future__ import annotations

import importlib
import importlib.util
import json
import math
import os
import platform
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib.metadata import version
from typing import Any, NamedTuple

from lagbench.errors import WorkFailedError

try:
    import resource
except ImportError:
    LIMITS = False
else:
    LIMITS = True

_MACHINES = {"x86_64", "amd64"}
_DEVICES = {"cpu", "parallel"}
_LIBRARIES = ("lagbench", "numpy", "netCDF4", "taichi")

TOO_LONG = -int(getattr(signal, "SIGXCPU", 0)) or None
"""Return code of a process beyond its computing time; None without such a limit."""

OUT_OF_MEMORY = 77  # exit code of a child that needed more than it may
MEMORY = 768 << 20  # address space of a child [bytes]
# Settings of a child's libraries. The parent chooses the cores: one thread.
ENVIRONMENT = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MALLOC_ARENA_MAX": "2",
    # glibc keeps freed memory: each MiB taken from the system anew is 256 page faults.
    "MALLOC_MMAP_THRESHOLD_": str(32 << 20),
    "MALLOC_TRIM_THRESHOLD_": str(64 << 20),
}

CHILD = "from lagbench.work.machine import serve; serve()"
"""The child's program.

-P keeps the current folder, where strangers' files may lie, off its path.
"""


def describe_machine(device: str) -> dict[str, str]:
    """Return machine, system and libraries, for the manifest."""
    environment = {
        "python": platform.python_version(),
        "machine": platform.machine(),
        "system": platform.system(),
    }
    for library in _LIBRARIES:
        if importlib.util.find_spec(library):
            environment[library] = version(library)
    environment["device"] = device
    return environment


def promises_bits(environment: Mapping[str, str]) -> bool:
    """Return whether a machine promises the bits of every other that does.

    >>> promises_bits({"machine": "x86_64", "system": "Linux", "device": "cuda"})
    False
    """
    return (
        environment.get("machine", "").lower() in _MACHINES
        and environment.get("system") == "Linux"
        and environment.get("device") in _DEVICES
    )


def may_differ(device: str, environments: Iterable[Mapping[str, str]]) -> bool:
    """Return whether a device's file may come from a machine without equal bits."""
    for environment in environments:
        if environment.get("device") == device and not promises_bits(environment):
            return True
    return False


def available_cores() -> int:
    """Return the number of processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def limit_process(*, memory: int, seconds: int) -> None:
    """Limit this process, as far as the system can.

    Args:
        memory: address space [bytes].
        seconds: processor time [s].
    """
    if not LIMITS:
        return
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 1))
    if sys.platform != "darwin":
        resource.setrlimit(resource.RLIMIT_AS, (memory, memory))


class Answers(NamedTuple):
    """Answers of a child in the order of the requests, and why it stopped early."""

    values: list[Any]
    stopped: str | None


def run_in_child(
    function: str,
    requests: Sequence[object],
    *,
    seconds: float,
    wall: float,
    memory: int = MEMORY,
) -> Answers:
    """Call a function once per request in a child with limits.

    Args:
        function: dotted name of the function.
        requests: its arguments, which JSON can hold.
        seconds: processor time of all requests, without the start [s].
        wall: time of the clock, with the start [s].
        memory: address space [bytes].

    Raises:
        WorkFailedError: an exception in the child, as where it cannot import the
            function.
    """
    limits = [str(memory), str(int(seconds))]
    try:
        child = subprocess.run(
            [sys.executable, "-P", "-c", CHILD, function, *limits],
            input=json.dumps(list(requests)).encode(),
            capture_output=True,
            timeout=wall,
            env={**os.environ, **ENVIRONMENT},
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        return Answers(_read_answers(error.stdout), f"no end after {wall:.0f} s")
    has_exception = b"Traceback" in child.stderr
    if has_exception and child.returncode > 0 and child.returncode != OUT_OF_MEMORY:
        lines = child.stderr.decode("utf-8", "replace").strip().rsplit("\n", 1)
        raise WorkFailedError(
            "a child process itself failed",
            where=function,
            got=ascii(lines[-1][:300]),
            fix="`lagbench doctor` checks the installation; if it finds nothing, "
            "report this with the file",
        )
    stopped = _describe_exit(child.returncode, memory)
    return Answers(_read_answers(child.stdout), stopped)


def _describe_exit(code: int, memory: int) -> str | None:
    """Return in words why a child has stopped; None where it came to its end."""
    if code == 0:
        return None
    if code == OUT_OF_MEMORY:
        return f"more than {memory >> 20} MiB of memory"
    if code == TOO_LONG:
        return "no end within the computing time allowed"
    if code < 0:
        return f"it crashed: {signal.strsignal(-code) or -code}"
    # A library ended it: exit(), or a crash on Windows.
    return f"it ended with exit code {code:#x}"


def _read_answers(output: bytes | None) -> list[Any]:
    """Return the answers of a child, without a last line that is not complete."""
    answers = []
    for line in (output or b"").splitlines(keepends=True):
        if line.endswith(b"\n"):
            answers.append(json.loads(line))
    return answers


def serve() -> None:
    """Answer the requests of stdin, one line each, under the limits of the arguments.

    The time of the imports is not counted: on a busy machine they may take seconds.
    """
    dotted_name, memory, seconds = sys.argv[1:4]
    module, _, name = dotted_name.rpartition(".")
    function: Callable[[Any], object] = getattr(importlib.import_module(module), name)
    import_seconds = math.ceil(time.process_time())
    limit_process(memory=int(memory), seconds=int(seconds) + import_seconds)
    try:
        for request in json.load(sys.stdin):
            sys.stdout.write(json.dumps(function(request)) + "\n")
            sys.stdout.flush()
    except MemoryError:
        raise SystemExit(OUT_OF_MEMORY) from None
