"""This machine: its promise of equal bits, and its cores.

The promise of docs/determinism.md holds on x86-64 Linux CPUs. A GPU, an ARM CPU or
another system may keep it too, but nothing shows that before its hashes are those of
datasets.yaml.
"""

from __future__ import annotations

import importlib
import importlib.util
import os
import platform
from collections.abc import Iterable, Mapping
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path

from lagbench.errors import NotInstalledError, UsageError

from .engine import find_engine

_MACHINES = {"x86_64", "amd64"}
_DEVICES = {"cpu", "parallel"}
_LIBRARIES = ("lagbench", "numpy", "netCDF4")


def describe_machine(device: str) -> dict[str, str]:
    """Return machine, system and libraries, for the manifest."""
    environment = {
        "python": platform.python_version(),
        "machine": platform.machine(),
        "system": platform.system(),
    }
    libraries = [name for name in _LIBRARIES if importlib.util.find_spec(name)]
    with suppress(NotInstalledError):
        libraries.append(find_engine())
    for library in libraries:
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
    if not isinstance(workers, int) or workers < 1:
        raise UsageError(
            f"{workers!r:.80} is no number of workers; leave it out: a number that "
            "suits the work is taken",
            where="--workers",
        )
    return workers
