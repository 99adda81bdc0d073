"""The device, the threads and the processes that a model runs on."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch

from lagbench.errors import UsageError
from lagbench.work.machine import available_cores, processor_name


def choose_device(name: str) -> str:
    """Return ``cpu`` or ``cuda``; ``auto`` takes a GPU if there is one.

    Raises:
        UsageError: there is no such device here.
    """
    has_gpu = torch.cuda.is_available()
    if name == "auto":
        return "cuda" if has_gpu else "cpu"
    if name == "cpu" or (name == "cuda" and has_gpu):
        return name
    raise UsageError(f"no device {name!r} here; leave --device out")


def is_helper() -> bool:
    """Return whether this process only helps another, the first, to train.

    A helper writes no files and prints nothing.
    """
    return os.environ.get("RANK", "0") != "0"


@contextmanager
def use_threads(count: int | None) -> Iterator[None]:
    """Use so many threads for a while.

    By default it is OMP_NUM_THREADS, else a process's share of the cores.
    """
    environment = os.environ.get("OMP_NUM_THREADS", "")
    if not count and environment.isdecimal():
        count = int(environment)
    if not count:
        processes = int(os.environ.get("LOCAL_WORLD_SIZE", "1"))
        count = max(1, available_cores() // processes)
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


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
