"""The device and the threads that a model runs on."""

from __future__ import annotations

import ctypes
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from platform import machine as architecture
from typing import Any

import torch

from lagbench.errors import UsageError, WorkFailedError
from lagbench.work.machine import available_cores


def chosen_device(name: str) -> str:
    """Return ``cpu`` or ``cuda``; ``auto`` takes a GPU that is there."""
    there = torch.cuda.is_available()
    if name == "auto":
        if there:
            return "cuda"
        return "cpu"
    if name not in ("cpu", "cuda") or (name == "cuda" and not there):
        if there:
            expected = "cpu, cuda or auto"
        else:
            expected = "cpu or auto: torch sees no GPU"
        raise UsageError(
            f"no device {name!r} here", where="--device", expected=expected
        )
    return name


def is_helper() -> bool:
    """Return whether this process helps another, the first, to train: it writes and
    says nothing.
    """
    return any(os.environ.get(name, "0") != "0" for name in ("LOCAL_RANK", "RANK"))


@contextmanager
def threads_used(count: int | None, *, processes: int = 1) -> Iterator[None]:
    """Use so many threads for a while."""
    before = torch.get_num_threads()
    asked = os.environ.get("OMP_NUM_THREADS", "")
    share = max(1, available_cores() // processes)
    torch.set_num_threads(count or (max(1, int(asked)) if asked.isdecimal() else share))
    try:
        yield
    finally:
        torch.set_num_threads(before)


def bound_memory() -> None:
    """Keep memory flat where every step has shapes of its own, as graphs do.

    oneDNN keeps the kernels of 1024 shapes unless told otherwise before its first:
    hundreds of megabytes of kernels that no later step will use. What the user set
    stays.
    """
    os.environ.setdefault("ONEDNN_PRIMITIVE_CACHE_CAPACITY", "64")


def return_memory() -> None:
    """Give freed memory back to the system: blocks of ever new sizes leave holes
    behind.
    """
    # Windows has no library of the process itself; macOS has one without this function.
    if os.name == "posix":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    else:
        trim = None
    if trim is not None:
        trim(0)


@contextmanager
def memory_errors_told(fix: str) -> Iterator[None]:
    """Turn whatever torch raises when memory is full into an error that says what to
    lower.
    """
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        full = isinstance(error, (MemoryError, torch.OutOfMemoryError))
        if not full and "can't allocate memory" not in str(error):
            raise
        raise WorkFailedError(
            "out of memory", got=str(error).split("\n")[0][:200], fix=fix
        ) from error


def hardware(device: str = "cpu") -> dict[str, Any]:
    """Return what the machine is, without its name."""
    return {
        "processor": _processor() or architecture(),
        "cores": available_cores(),
        "threads": torch.get_num_threads(),
        "device": torch.cuda.get_device_name() if device == "cuda" else "cpu",
    }


def multiplies_bfloat16(device: str) -> bool:
    """Return whether the device has instructions for products of bfloat16."""
    if device == "cuda":
        return bool(torch.cuda.is_bf16_supported(including_emulation=False))
    flags = {
        flag for name in ("flags", "Features") for flag in _processor(name).split()
    }
    return not flags.isdisjoint({"avx512_bf16", "amx_bf16", "bf16"})


def check_compiler(device: str) -> None:
    """Refuse to compile layers for a CPU without a C++ compiler."""
    compiler = os.environ.get("CXX") or "g++"  # the one that torch takes
    if device == "cpu" and shutil.which(compiler) is None:
        raise UsageError(
            "no C++ compiler",
            where="training.compile",
            expected="g++ on the PATH, or another in CXX",
            got=f"no {compiler}",
            fix="install it, or leave the option out",
        )


def _processor(field: str = "model name") -> str:
    """Return what Linux tells of the first processor; nothing where it tells
    nothing.
    """
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return ""
    parts = (line.partition(":") for line in lines)
    return next(
        (value.strip() for name, _, value in parts if name.strip() == field), ""
    )
