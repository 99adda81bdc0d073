"""Taichi's runtime: started once per process, with strict arithmetic.

Strict means: no fused multiply-add, no reassociation (``fast_math=False``), float32 and
int32 wherever a kernel does not say otherwise. Everything that makes fields starts
here.
"""

from __future__ import annotations

import contextlib
import io
import os
from collections.abc import Sequence
from typing import Any

from lagbench.errors import UsageError, require
from lagbench.work.machine import available_cores

from .solver import Device

# Taichi greets on stdout as it is imported, which would spoil `--json`, and asks the
# network.
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
"""Variables of Taichi's that a user may set: they choose memory, places and cards,
never arithmetic.
"""

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
        size = max(2, available_cores(), threads or 0)
        greeting = io.StringIO()
        # Others would change device, precision or optimisation behind our back.
        names = [
            name
            for name in os.environ
            if name.startswith("TI_") and name not in HARMLESS
        ]
        hidden = {name: os.environ.pop(name) for name in names}
        try:
            with contextlib.redirect_stdout(greeting):
                ti.init(
                    arch=ti.cuda if on_gpu else ti.cpu,
                    default_fp=ti.f32,
                    default_ip=ti.i32,
                    fast_math=False,
                    cpu_max_num_threads=size,
                    offline_cache=True,
                    enable_fallback=False,
                    log_level=ti.ERROR,
                )
        except RuntimeError as error:
            raise UsageError(
                "Taichi cannot use this device",
                where="cuda" if on_gpu else "cpu",
                got=error,
                fix="use --device cpu: there is no NVIDIA GPU, or no driver of one"
                if on_gpu
                else None,
            ) from error
        finally:
            os.environ.update(hidden)
        _started.append((on_gpu, size))
    running_on_gpu, pool = _started[0]
    if running_on_gpu != on_gpu or (threads or 1) > pool:
        raise UsageError(
            "Taichi runs already with another device or fewer threads",
            where=f"device {device.value}, threads {threads}",
            expected=f"{'CUDA' if running_on_gpu else 'CPU'} with at most "
            f"{pool} threads",
            fix="use another process",
        )
    return threads or min(pool, available_cores())


def place(*groups: tuple[tuple[int, ...], Sequence[Any]]) -> Any:  # noqa: ANN401 (Taichi is untyped)
    """Give fields their memory: each group (shape, fields) is one array of structs."""
    builder = ti.FieldsBuilder()
    for shape, fields in groups:
        axes = (ti.i, ti.ij, ti.ijk, ti.ijkl)[len(shape) - 1]
        builder.dense(axes, shape).place(*fields)
    return builder.finalize()
