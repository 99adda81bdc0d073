"""This machine: its promise of equal bits, its cores, and children under limits.

The promise of docs/determinism.md holds on x86-64 Linux CPUs. A GPU, an ARM CPU or
another system may keep it too, but nothing shows that before its hashes are those of
datasets.yaml.

A library in C that parses a stranger's file may loop, crash or ask for too much:
:class:`LimitedChild` calls functions in a child with limits. Requests and answers are
JSON, so nothing that a child sends is executed. Windows has no limits (no module
``resource``: then ``LIMITS`` is false), macOS refuses one on the address space. Nothing
replaces a limit that a system lacks.
"""

from __future__ import annotations

import importlib
import importlib.util
import json
import math
import operator
import os
import platform
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack, suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple, Self

from lagbench.errors import UsageError, WorkFailedError

try:
    import resource
except ImportError:
    LIMITS = False
else:
    LIMITS = True

_MACHINES = {"x86_64", "amd64"}
_DEVICES = {"cpu", "parallel"}
_LIBRARIES = ("lagbench", "numpy", "netCDF4", "taichi")

TOO_LONG: frozenset[int] = frozenset()
"""Return codes of a process beyond its computing time; none without such a limit."""
if LIMITS:
    TOO_LONG = frozenset({-signal.SIGXCPU, -signal.SIGPROF})

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
    # The parent writes and reads the lines of JSON in this encoding.
    "PYTHONIOENCODING": "utf-8",
}

UNLIMITED_START = 60.0
"""Time of the clock for the start of a child without a limit of processor time [s]."""

MEMORY_SIGNS = (b"MemoryError", b"allocate memory", b"failed to map segment")
"""What a child prints that had too little memory to start."""

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


def processor_name() -> str:
    """Return the model of the processor, or its kind where the system tells no more."""
    return read_processor("model name") or platform.machine()


def read_processor(field: str) -> str:
    """Return a field of Linux's first processor; nothing on other systems."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return ""
    for line in lines:
        name, _, value = line.partition(":")
        if name.strip() == field:
            return value.strip()
    return ""


def available_cores() -> int:
    """Return the number of processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def worker_count(workers: int | None, *, default: int | None = None) -> int:
    """Return how many workers to start.

    Args:
        workers: the number that the user gave.
        default: the number where the user gave none; when None one per core.

    Raises:
        UsageError: it is no whole number from 1.
    """
    if workers is None:
        return default or available_cores()
    what = "the number of workers is no whole number"
    with suppress(TypeError):
        count = operator.index(workers)
        if count >= 1 and not isinstance(workers, bool):
            return count
        if count < 1:
            what = "at least one worker is needed"
    raise UsageError(
        f"{what}: {repr(workers)[:80]}; leave it out: a number that suits the work is "
        "taken",
        where="--workers",
    )


def limit_process(*, memory: int, seconds: int) -> None:
    """Limit this process, as far as the system can.

    A hard limit that it has already stays where it is lower.

    Args:
        memory: address space [bytes].
        seconds: processor time [s].
    """
    if not LIMITS:
        return
    _lower_limit(resource.RLIMIT_CORE, 0, 0)
    _lower_limit(resource.RLIMIT_CPU, seconds, seconds + 1)
    if sys.platform != "darwin":
        _lower_limit(resource.RLIMIT_AS, memory, memory)


def _lower_limit(kind: int, soft: int, hard: int) -> None:
    """Set a limit of this process, but raise no hard limit: the system forbids it."""
    _, present_hard = resource.getrlimit(kind)
    if present_hard != resource.RLIM_INFINITY:
        soft = min(soft, present_hard)
        hard = min(hard, present_hard)
    resource.setrlimit(kind, (soft, hard))


def address_space_limit() -> int | None:
    """Return how much memory a process of this one may map [bytes]; None if any.

    It is the limit that ``ulimit -v`` or a batch system has set.
    """
    if not LIMITS:
        return None
    soft, _ = resource.getrlimit(resource.RLIMIT_AS)
    return None if soft == resource.RLIM_INFINITY else soft


def has_time_limit() -> bool:
    """Return whether processes end after some processor time, as by ``ulimit -t``."""
    if not LIMITS:
        return False
    soft, _ = resource.getrlimit(resource.RLIMIT_CPU)
    return soft != resource.RLIM_INFINITY


class ChildStopped(Exception):
    """A child under limits ended, or gave no answer; its text says why."""

    def __init__(self, reason: str, *, is_late: bool = False) -> None:
        """Set why it ended, and whether it was the time of the clock."""
        super().__init__(reason)
        self.is_late = is_late


class LimitedChild:
    """A process with limits that calls functions of one module for this process.

    Use it as a context manager, which ends the process. It starts with the first call.
    """

    def __init__(
        self, module: str, *, seconds: float, wall: float, memory: int = MEMORY
    ) -> None:
        """Set the limits of all calls together.

        Args:
            module: dotted name of the module of the functions.
            seconds: processor time, without the start [s].
            wall: time of the clock that this process waits, with the start [s].
            memory: address space [bytes].
        """
        self._arguments = (module, str(memory), str(int(seconds)))
        self._memory = memory
        self._wall = wall
        self._seconds_left = wall
        self._is_late = False
        self._process: subprocess.Popen[bytes] | None = None
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        """Return the child itself."""
        # a file and not a pipe, which a child that writes much would fill
        self._stderr = self._stack.enter_context(tempfile.TemporaryFile())
        return self

    def __exit__(self, *_: object) -> None:
        """Kill the process: it has nothing to keep."""
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
        self._stack.close()

    def call(self, function: str, argument: object) -> Any:  # noqa: ANN401 - JSON
        """Return what a function of the module returns.

        Args:
            function: name of the function.
            argument: what JSON can hold.

        Raises:
            ChildStopped: the child crashed, went beyond a limit, or wrote something
                else than an answer.
            WorkFailedError: an exception in the child, as where it cannot import the
                module.
        """
        if self._process is None:
            self._process = self._start()
        process = self._process
        start = time.monotonic()
        timer = threading.Timer(self._seconds_left, self._kill_late, [process])
        timer.start()
        try:
            answer = _ask(process, [function, argument])
            if answer is None:
                raise self._failure(process.wait())
        finally:
            timer.cancel()
            self._seconds_left -= time.monotonic() - start
        try:
            return json.loads(answer)
        except (ValueError, RecursionError):
            # Its next line may be anything: no other call can be answered.
            process.kill()
            raise ChildStopped("its answer is no JSON") from None

    def _start(self) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            [sys.executable, "-P", "-c", CHILD, *self._arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._stderr,
            env={**os.environ, **ENVIRONMENT},
        )

    def _kill_late(self, process: subprocess.Popen[bytes]) -> None:
        self._is_late = True
        process.kill()

    def _failure(self, code: int) -> Exception:
        """Return the exception for a child that has ended with an exit code."""
        if self._is_late:
            return ChildStopped(f"no end after {self._wall:.0f} s", is_late=True)
        self._stderr.seek(0)
        text = self._stderr.read()
        limit = address_space_limit()
        is_memory = code == OUT_OF_MEMORY or any(word in text for word in MEMORY_SIGNS)
        if limit is not None and limit < self._memory and is_memory:
            return WorkFailedError(
                f"there is not enough memory: got a limit of {limit >> 20} MiB, "
                f"expected {self._memory >> 20} MiB for a child process; raise the "
                "limit (`ulimit -v unlimited`, or that of the batch system)",
                where=self._arguments[0],
            )
        if b"Traceback" in text and code > 0 and code != OUT_OF_MEMORY:
            lines = text.decode("utf-8", "replace").strip().rsplit("\n", 1)
            return WorkFailedError(
                f"a child process itself failed: {lines[-1][:300]!a}; `lagbench "
                "doctor` checks the installation; if it finds nothing, report this "
                "with the file",
                where=self._arguments[0],
            )
        return ChildStopped(describe_exit(code, self._memory))


def _ask(process: subprocess.Popen[bytes], request: object) -> bytes | None:
    """Return the answer of a child to a request; None where it ends before."""
    if process.stdin is None or process.stdout is None:
        raise WorkFailedError("a child process has no pipes")
    try:
        process.stdin.write(json.dumps(request).encode() + b"\n")
        process.stdin.flush()
    except BrokenPipeError:
        return None
    answer = process.stdout.readline()
    return answer if answer.endswith(b"\n") else None


class Answers(NamedTuple):
    """Answers of a child in the order of the requests, and why it stopped early."""

    values: list[Any]
    stopped: str | None
    is_late: bool = False  # whether the time of the clock ended it

    def require_in_time(self, where: str) -> None:
        """Raise an error if the time of the clock ended the child.

        Where processor time is limited, only a child that waits gets that far.

        Raises:
            WorkFailedError: the machine is too busy.
        """
        if self.is_late and LIMITS:
            raise WorkFailedError(
                f"the machine is too busy: {self.stopped}; call again when the "
                "machine is idle",
                where=where,
            )


def run_in_child(
    function: str,
    requests: Sequence[object],
    *,
    seconds: float,
    wall: float,
    memory: int = MEMORY,
) -> Answers:
    """Call a function once per request in a child with limits.

    Where the system cannot limit the processor time, the time of the clock is at most
    :data:`UNLIMITED_START` longer than the processor time would be.

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
    module, _, name = function.rpartition(".")
    answers = []
    if not LIMITS:
        wall = min(wall, seconds + UNLIMITED_START)
    with LimitedChild(module, seconds=seconds, wall=wall, memory=memory) as child:
        for request in requests:
            try:
                answers.append(child.call(name, request))
            except ChildStopped as stopped:
                return Answers(answers, str(stopped), stopped.is_late)
    return Answers(answers, None)


def describe_exit(code: int, memory: int) -> str:
    """Return in words why a child with an exit code has not answered.

    ``memory`` is its limit [bytes].
    """
    if code == OUT_OF_MEMORY:
        return f"more than {memory >> 20} MiB of memory"
    if code in TOO_LONG:
        return "no end within the computing time allowed"
    if code < 0:
        return f"it crashed: {signal.strsignal(-code) or -code}"
    # A library ended it: exit(), or a crash on Windows.
    return f"it ended with exit code {code:#x}"


def serve() -> None:
    """Answer the requests of stdin, one line each, under the limits of the arguments.

    The time of the imports is not counted: on a busy machine they may take seconds.
    """
    module_name, memory, seconds = sys.argv[1:4]
    module = importlib.import_module(module_name)
    import_seconds = math.ceil(time.process_time())
    limit_process(memory=int(memory), seconds=int(seconds) + import_seconds)
    try:
        for line in sys.stdin:
            name, argument = json.loads(line)
            sys.stdout.write(json.dumps(getattr(module, name)(argument)) + "\n")
            sys.stdout.flush()
    except MemoryError:
        raise SystemExit(OUT_OF_MEMORY) from None
