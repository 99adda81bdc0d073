"""Which machines promise equal bits.

The promise of docs/determinism.md holds on x86-64 Linux CPUs. A GPU, an ARM CPU or another
system may keep it too, but nothing shows that before its hashes are those of datasets.yaml.
"""

from __future__ import annotations

import importlib.util
import platform
from collections.abc import Iterable, Mapping
from importlib.metadata import version

__all__ = ["environment_of", "may_differ", "promises_bits"]


_MACHINES = {"x86_64", "amd64"}
_DEVICES = {"cpu", "parallel"}
_LIBRARIES = ("lagbench", "numpy", "netCDF4", "taichi")


def environment_of(device: str) -> dict[str, str]:
    """Return what the manifest says about the machine at hand."""
    libraries = {name: version(name) for name in _LIBRARIES if importlib.util.find_spec(name)}
    system = {"python": platform.python_version(), "machine": platform.machine(), "system": platform.system()}
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
    """Return whether a file of a device may come from a machine that promises no equal bits."""
    return any(e.get("device") == device and not promises_bits(e) for e in environments)
