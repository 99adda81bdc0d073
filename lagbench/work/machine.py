"""The machine at hand: whether it promises equal bits, what a process may use of it,
children under limits.

The promise of docs/determinism.md holds on x86-64 Linux CPUs. A GPU, an ARM CPU or
another system may keep it too, but nothing shows that before its hashes are those of
datasets.yaml.

A library in C that parses what strangers send may loop, crash or ask for too much:
:func:`in_child` calls any function in a child with limits. Requests and answers are
JSON, so nothing that a child sends is executed. Windows has no limits (no module
``resource``: then ``LIMITS`` is false), macOS refuses one on the address space. Nothing
stands in for a limit that is not to be had.
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
"""Return code of a process that computed longer than it may; None where there is no
such limit.
"""

OUT_OF_MEMORY = 77  # exit code of a child that needed more than it may
MEMORY = 768 << 20  # address space of a child [bytes]
# what a child's libraries read when they start; one thread, since cores are not its to
# choose
ENVIRONMENT = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MALLOC_ARENA_MAX": "2",
    # glibc keeps what is freed: each block of a MiB taken from the system anew is 256
    # page faults
    "MALLOC_MMAP_THRESHOLD_": str(32 << 20),
    "MALLOC_TRIM_THRESHOLD_": str(64 << 20),
}

CHILD = "from lagbench.work.machine import serve; serve()"
"""The child's program; -P keeps the current folder, where strangers' files may lie, off
its path.
"""


def environment_of(device: str) -> dict[str, str]:
    """Return what the manifest says about the machine at hand."""
    libraries = {
        name: version(name) for name in _LIBRARIES if importlib.util.find_spec(name)
    }
    system = {
        "python": platform.python_version(),
        "machine": platform.machine(),
        "system": platform.system(),
    }
    return {**system, **libraries, "device": device}


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
    """Return whether a file of a device may come from a machine that promises no equal
    bits.
    """
    return any(e.get("device") == device and not promises_bits(e) for e in environments)


def available_cores() -> int:
    """Return the number of processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def limit_process(*, memory: int, seconds: int) -> None:
    """Bound address space [bytes] and processor time [s] of this process, as far as the
    system can.
    """
    if not LIMITS:
        return
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 1))
    if sys.platform != "darwin":
        resource.setrlimit(resource.RLIMIT_AS, (memory, memory))


class Answers(NamedTuple):
    """What a child answered, in the order of the requests, and what stopped it, if
    anything did.
    """

    values: list[Any]
    stopped: str | None


def in_child(
    function: str,
    requests: Sequence[object],
    *,
    seconds: float,
    wall: float,
    memory: int = MEMORY,
) -> Answers:
    """Call a function, named by a dotted name, once per request (what JSON can hold) in
    a child with limits.

    Processor time is that of all requests, the start aside, the clock's includes it
    [s]; ``memory`` is the address space [bytes]. An exception in the child, as where it
    cannot import the function, is a WorkFailedError.
    """
    environment = {**os.environ, **ENVIRONMENT}
    try:
        done = subprocess.run(
            [
                sys.executable,
                "-P",
                "-c",
                CHILD,
                function,
                str(memory),
                str(int(seconds)),
            ],
            input=json.dumps(list(requests)).encode(),
            capture_output=True,
            timeout=wall,
            env=environment,
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        return Answers(_lines(error.stdout), f"no end after {wall:.0f} s")
    stopped = None
    code = done.returncode
    if code == OUT_OF_MEMORY:
        stopped = f"more than {memory >> 20} MiB of memory"
    elif code == TOO_LONG:
        stopped = "no end within the computing time allowed"
    elif code < 0:
        stopped = f"it crashed: {signal.strsignal(-code) or -code}"
    elif (
        code and b"Traceback" not in done.stderr
    ):  # ended by a library: exit(), or a crash on Windows
        stopped = f"it ended with exit code {code:#x}"
    elif code:
        raise WorkFailedError(
            "a child process itself failed",
            where=function,
            got=ascii(
                done.stderr.decode("utf-8", "replace").strip().rsplit("\n", 1)[-1][:300]
            ),
            fix="`lagbench doctor` checks the installation; if it finds nothing, "
            "report this with the file",
        )
    return Answers(_lines(done.stdout), stopped)


def _lines(output: bytes | None) -> list[Any]:
    return [
        json.loads(line)
        for line in (output or b"").splitlines(keepends=True)
        if line.endswith(b"\n")
    ]


def serve() -> None:
    """Answer the requests of stdin, one line each, under the limits that the arguments
    name.

    What the imports took is not counted: on a busy machine they may take seconds.
    """
    dotted = sys.argv[1]
    memory = int(sys.argv[2])
    allowed = int(sys.argv[3])
    module, _, name = dotted.rpartition(".")
    function: Callable[[Any], object] = getattr(importlib.import_module(module), name)
    seconds = allowed + math.ceil(time.process_time())
    limit_process(memory=memory, seconds=seconds)
    try:
        for request in json.load(sys.stdin):
            sys.stdout.write(json.dumps(function(request)) + "\n")
            sys.stdout.flush()
    except MemoryError:
        raise SystemExit(OUT_OF_MEMORY) from None
