"""The engine's runtime: started once per process, with strict arithmetic.

Strict means: no fused multiply-add, no reassociation (``fast_math=False``), float32 and
int32 wherever a kernel does not say otherwise. Everything that makes fields starts
here.
"""

from __future__ import annotations

import contextlib
import errno
import io
import os
from collections.abc import Iterator, Sequence
from typing import Any

from lagbench.errors import (
    LIMIT_FIXES,
    LagbenchError,
    UsageError,
    WorkFailedError,
)
from lagbench.work.machine import available_cores

from .language import ENGINE, ti
from .split import Device

PREFIX = {"taichi": "TI_", "quadrants": "QD_"}[ENGINE]
"""What the names of the engine's environment variables begin with."""

MEMORY_VARIABLES = (f"{PREFIX}DEVICE_MEMORY_FRACTION", f"{PREFIX}DEVICE_MEMORY_GB")
"""Variables of the engine that are numbers."""

HARMLESS = frozenset(
    {
        *MEMORY_VARIABLES,
        f"{PREFIX}ENABLE_CUDA",
        f"{PREFIX}LIB_DIR",
        f"{PREFIX}OFFLINE_CACHE_FILE_PATH",
        "TI_SKIP_VERSION_CHECK",
        f"{PREFIX}VISIBLE_DEVICE",
    }
)
"""Variables of the engine that a user may set: they choose memory, places and cards,
never arithmetic.
"""

PROCESS_WORDS = os.strerror(errno.EAGAIN)
"""What the system says that starts no more threads."""

MEMORY_WORDS = "memory allocation"
"""What an engine says that finds no memory as it starts."""

_started: list[tuple[bool, int]] = []


def start(device: Device, *, scenarios: int = 1, threads: int | None = None) -> int:
    """Start the engine for a device unless it runs, and return the threads for parallel
    loops.

    The first call in a process fixes the size of the thread pool; idle threads sleep.
    """
    if device is Device.CPU and scenarios != 1:
        raise UsageError(
            f"the serial device advances one scenario at a time, not {scenarios}; use "
            f"one worker per scenario, or device {Device.PARALLEL.value}",
            where=f"device {device.value}",
        )
    on_gpu = device is Device.CUDA
    if not _started:
        pool_size = max(2, available_cores(), threads or 0)
        _initialise(on_gpu, pool_size)
        _started.append((on_gpu, pool_size))

    running_on_gpu, pool_size = _started[0]
    if running_on_gpu != on_gpu or (threads or 1) > pool_size:
        running_device = "CUDA" if running_on_gpu else "CPU"
        raise UsageError(
            f"{ENGINE} runs already on the {running_device} with at most {pool_size} "
            f"threads; use another process for {threads or 1} of {device.value}",
            where=f"device {device.value}",
        )
    return threads or min(pool_size, available_cores())


def _initialise(on_gpu: bool, pool_size: int) -> None:
    """Start the engine in silence and with strict arithmetic."""
    for name in MEMORY_VARIABLES:
        _check_number(name)
    architecture = ti.cuda if on_gpu else ti.cpu
    greeting = io.StringIO()
    with _hidden_variables(), contextlib.redirect_stdout(greeting):
        try:
            ti.init(
                arch=architecture,
                default_fp=ti.f32,
                default_ip=ti.i32,
                fast_math=False,
                cpu_max_num_threads=pool_size,
                offline_cache=True,
                enable_fallback=False,
                log_level=ti.ERROR,
            )
        except RuntimeError as error:
            raise _device_error(on_gpu, error) from error


def _check_number(name: str) -> None:
    """Refuse an environment variable that is set to something else than a number."""
    value = os.environ.get(name)
    if not value:
        return
    try:
        float(value)
    except ValueError as error:
        raise UsageError(
            f"no number: {value!a}; unset it, or set it to one such as 0.5", where=name
        ) from error


@contextlib.contextmanager
def _hidden_variables() -> Iterator[None]:
    """Hide variables that would change device, precision or optimisation unseen."""
    names = []
    for name in os.environ:
        if name.startswith(PREFIX) and name not in HARMLESS:
            names.append(name)
    hidden = {name: os.environ.pop(name) for name in names}
    try:
        yield
    finally:
        os.environ.update(hidden)


def _device_error(on_gpu: bool, error: RuntimeError) -> LagbenchError:
    text = str(error)
    if MEMORY_WORDS in text:
        return WorkFailedError(
            f"there is no gigabyte of addresses ({text}); raise the limit (`ulimit -v "
            "unlimited`, or that of the batch system)",
            where=ENGINE,
        )
    if PROCESS_WORDS in text:
        return WorkFailedError(
            f"no room for threads ({text}); {LIMIT_FIXES[errno.EAGAIN]}", where=ENGINE
        )
    fix = "`lagbench doctor` shows this machine; `lagbench download` needs no engine"
    if on_gpu:
        fix = "use --device cpu: there is no NVIDIA GPU, or no driver of one"
    device = "cuda" if on_gpu else "cpu"
    return UsageError(f"{ENGINE} cannot use this device ({text}); {fix}", where=device)


def place(*groups: tuple[tuple[int, ...], Sequence[Any]]) -> Any:  # noqa: ANN401 (an engine is untyped)
    """Give fields of the shape of their group memory, each an array of its own."""
    axes_by_dimension = (ti.i, ti.ij, ti.ijk, ti.ijkl)
    builder = ti.FieldsBuilder()
    for shape, fields in groups:
        axes = axes_by_dimension[len(shape) - 1]
        for field in fields:
            builder.dense(axes, shape).place(field)
    return builder.finalize()
