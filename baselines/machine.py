"""The device and the threads that a model runs on."""

from __future__ import annotations

import ctypes
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch

from lagbench.errors import UsageError, WorkFailedError
from lagbench.work.machine import available_cores, processor_name, read_processor

MOST_THREADS = 1024
"""Threads that may be asked for where there are fewer cores."""

FULL_MEMORY = (
    "can't allocate memory",  # torch's own memory
    "not enough memory",  # the same on Windows
    "std::bad_alloc",  # memory of the C++ library
    "CUDA error: out of memory",  # a GPU on which others left no room to begin
    "STATUS_ALLOC_FAILED",  # work space of cuBLAS or cuDNN
)
"""Parts of the messages of plain RuntimeErrors of full memory."""


def choose_device(name: str) -> str:
    """Return ``cpu`` or ``cuda``; ``auto`` takes a GPU if there is one.

    Raises:
        UsageError: there is no such device here.
    """
    has_gpu = torch.cuda.is_available()
    if name == "cpu" or (name == "auto" and not has_gpu):
        return "cpu"
    if name in ("cuda", "auto") and has_gpu:
        return "cuda"
    expected = "cpu or auto: torch sees no GPU"
    if has_gpu:
        expected = "cpu, cuda or auto"
    raise UsageError(
        f"no device {name!r} here",
        where="--device",
        expected=expected,
        got=ascii(name),
        fix="leave --device out: auto takes a GPU where there is one",
    )


def is_helper() -> bool:
    """Return whether this process only helps another, the first, to train.

    A helper writes no files and prints nothing.
    """
    local_rank = os.environ.get("LOCAL_RANK", "0")
    rank = os.environ.get("RANK", "0")
    return local_rank != "0" or rank != "0"


@contextmanager
def use_threads(count: int | None, *, processes: int = 1) -> Iterator[None]:
    """Use so many threads for a while.

    By default it is OMP_NUM_THREADS, else a process's share of the cores.

    Raises:
        UsageError: there are so many that OpenMP might end the process.
    """
    source = "--threads"
    if not count:
        environment = os.environ.get("OMP_NUM_THREADS", "")
        if environment.isdecimal():
            source = "OMP_NUM_THREADS"
            count = max(1, int(environment))
        else:
            count = max(1, available_cores() // processes)
    most_threads = max(MOST_THREADS, available_cores())
    if count > most_threads:
        raise UsageError(
            "so many threads cannot be used",
            where=source,
            expected=f"at most {most_threads}",
            got=count,
            fix=f"leave {source} out; this machine has {available_cores()} cores",
        )
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def bound_memory() -> None:
    """Bound the memory of compiled kernels where each step has new array shapes.

    Graphs have new shapes in each step. By default oneDNN keeps the kernels of 1024
    shapes: hundreds of megabytes that no later step uses. It reads this setting when it
    makes its first kernel. A setting of the user stays.
    """
    os.environ.setdefault("ONEDNN_PRIMITIVE_CACHE_CAPACITY", "64")


def return_memory() -> None:
    """Give freed memory back to the system: blocks of ever new sizes leave holes."""
    # Windows has no library of the process itself; macOS has one without this function.
    if os.name != "posix":
        return
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


@contextmanager
def explain_memory_errors(hint: str) -> Iterator[None]:
    """Turn torch's errors of full memory into one that says which option to lower."""
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        is_full = isinstance(error, (MemoryError, torch.OutOfMemoryError))
        message = str(error)
        if not is_full and not any(part in message for part in FULL_MEMORY):
            raise
        # Python's own MemoryError says nothing.
        first_line = message.split("\n")[0] or type(error).__name__
        raise WorkFailedError(
            "out of memory",
            where="memory of the device",
            expected="room for the model and its batch",
            got=first_line[:200],
            fix=hint,
        ) from error


def read_load() -> float | None:
    """Return how many processes wanted to run, the mean over the last minute.

    None where the system does not tell.
    """
    try:
        return round(os.getloadavg()[0], 2)
    except (OSError, AttributeError):  # AttributeError: Windows
        return None


def hardware(device: str = "cpu") -> dict[str, Any]:
    """Return processor, cores, threads and device, without the machine's name."""
    device_name = "cpu"
    if device == "cuda":
        device_name = torch.cuda.get_device_name()
    return {
        "processor": processor_name(),
        "cores": available_cores(),
        "threads": torch.get_num_threads(),
        "device": device_name,
    }


def multiplies_bfloat16(device: str) -> bool:
    """Return whether the device has instructions for products of bfloat16."""
    if device == "cuda":
        return bool(torch.cuda.is_bf16_supported(including_emulation=False))
    flags = read_processor("flags").split()  # of x86
    flags += read_processor("Features").split()  # of Arm
    return not {"avx512_bf16", "amx_bf16", "bf16"}.isdisjoint(flags)


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
