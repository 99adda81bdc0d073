"""Taichi's runtime: started once per process, with strict arithmetic.

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
    require,
)
from lagbench.work.machine import available_cores

from .split import Device

# As it is imported, Taichi greets on stdout, which would spoil `--json`, and asks the
# network for a newer version.
os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")
os.environ.setdefault("TI_SKIP_VERSION_CHECK", "ON")
ti = require("taichi", extra="generate")

HARMLESS = frozenset(
    {
        "TI_DEVICE_MEMORY_FRACTION",
        "TI_DEVICE_MEMORY_GB",
        "TI_ENABLE_CUDA",
        "TI_LIB_DIR",
        "TI_OFFLINE_CACHE_FILE_PATH",
        "TI_SKIP_VERSION_CHECK",
        "TI_VISIBLE_DEVICE",
    }
)
"""Variables of Taichi that a user may set: they choose memory, places and cards,
never arithmetic.
"""

MEMORY_VARIABLES = ("TI_DEVICE_MEMORY_FRACTION", "TI_DEVICE_MEMORY_GB")
"""Variables of Taichi that are numbers."""

PROCESS_WORDS = os.strerror(errno.EAGAIN)
"""What the system says that starts no more threads."""

MEMORY_WORDS = "memory allocation"
"""What Taichi says that finds no memory as it starts."""

_started: list[tuple[bool, int]] = []


def start(device: Device, *, scenarios: int = 1, threads: int | None = None) -> int:
    """Start Taichi for a device unless it runs, and return the threads for parallel
    loops.

    The first call in a process fixes the size of the thread pool; idle threads sleep.
    """
    if device is Device.CPU and scenarios != 1:
        raise UsageError(
            "the serial device advances one scenario at a time",
            where=f"device {device.value}",
            expected="scenarios = 1",
            got=scenarios,
            fix=f"use one worker per scenario, or device {Device.PARALLEL.value}",
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
            "Taichi runs already with another device or fewer threads",
            where="Taichi in this process",
            expected=f"{running_device} with at most {pool_size} threads",
            got=f"{device.value}, threads: {threads or 1}",
            fix="use another process",
        )
    return threads or min(pool_size, available_cores())


def _initialise(on_gpu: bool, pool_size: int) -> None:
    """Start Taichi in silence and with strict arithmetic."""
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
            "an environment variable of Taichi is no number",
            where=name,
            expected="a number, such as 0.5",
            got=ascii(value),
            fix=f"unset {name}, or set it to a number",
        ) from error


@contextlib.contextmanager
def _hidden_variables() -> Iterator[None]:
    """Hide variables that would change device, precision or optimisation unseen."""
    names = []
    for name in os.environ:
        if name.startswith("TI_") and name not in HARMLESS:
            names.append(name)
    hidden = {name: os.environ.pop(name) for name in names}
    try:
        yield
    finally:
        os.environ.update(hidden)


def _device_error(on_gpu: bool, error: RuntimeError) -> LagbenchError:
    if MEMORY_WORDS in str(error):
        return WorkFailedError(
            "there is not enough memory",
            where="Taichi",
            expected="room for a gigabyte of addresses",
            got=error,
            fix="raise the limit (`ulimit -v unlimited`, or that of the batch system)",
        )
    if PROCESS_WORDS in str(error):
        return WorkFailedError(
            "a limit of the operating system is reached",
            where="Taichi",
            expected="room for the threads of Taichi",
            got=error,
            fix=LIMIT_FIXES[errno.EAGAIN],
        )
    if on_gpu:
        return UsageError(
            "Taichi cannot use this device",
            where="cuda",
            expected="an NVIDIA GPU with its driver",
            got=error,
            fix="use --device cpu: there is no NVIDIA GPU, or no driver of one",
        )
    return UsageError(
        "Taichi cannot use this device",
        where="cpu",
        expected="a processor that Taichi can use",
        got=error,
        fix="`lagbench doctor` shows this machine; `lagbench download` needs no Taichi",
    )


def place(*groups: tuple[tuple[int, ...], Sequence[Any]]) -> Any:  # noqa: ANN401 (Taichi is untyped)
    """Give fields of the shape of their group memory, each an array of its own."""
    axes_by_dimension = (ti.i, ti.ij, ti.ijk, ti.ijkl)
    builder = ti.FieldsBuilder()
    for shape, fields in groups:
        axes = axes_by_dimension[len(shape) - 1]
        for field in fields:
            builder.dense(axes, shape).place(field)
    return builder.finalize()
