"""Look at this machine: libraries, cores, disk, registry; what a bug report needs."""

from __future__ import annotations

import os
import platform
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from .errors import LagbenchError
from .layout import resolve_root
from .plan import free_bytes
from .pool import available_cores
from .registry import load

__all__ = ["Check", "Diagnosis", "doctor"]

NEEDED = (
    "numpy",
    "scipy",
    "xarray",
    "netCDF4",
    "h5py",
    "dask",
    "pandas",
    "pydantic",
    "PyYAML",
    "typer",
    "rich",
    "platformdirs",
    "filelock",
    "fsspec",
)
OPTIONAL = {
    "taichi": "generate",
    "matplotlib": "plots",
    "imageio": "plots",
    "torch": "baselines",
    "distributed": "cluster",
    "s3fs": "s3",
}


@dataclass(frozen=True, kw_only=True)
class Check:
    """One thing looked at.

    Attributes:
        name: what it is.
        state: "ok", "missing" (something optional) or "broken".
        detail: what was found, and how to mend it.
    """

    name: str
    state: str
    detail: str


@dataclass(frozen=True, kw_only=True)
class Diagnosis:
    """All that was looked at.

    Attributes:
        checks: in the order of looking.
    """

    checks: tuple[Check, ...]

    @property
    def healthy(self) -> bool:
        """Whether nothing is broken."""
        return all(check.state != "broken" for check in self.checks)


def doctor(root: str | Path | None = None) -> Diagnosis:
    """Look at what lagbench needs on this machine; changes nothing.

    Args:
        root: folder of all data sets; else ``LAGBENCH_ROOT``, else the user data folder.
    """
    folder = resolve_root(root)
    return Diagnosis(
        checks=(
            Check(name="lagbench", state="ok", detail=version("lagbench")),
            Check(name="python", state="ok", detail=f"{platform.python_version()} on {platform.platform()}"),
            _processor(),
            *(_library(name) for name in NEEDED),
            *(_extra(name, extra) for name, extra in OPTIONAL.items()),
            _attempt("registry", _registry),
            _attempt("data folder", lambda: _folder(folder)),
        )
    )


def _processor() -> Check:
    native = platform.machine() in {"x86_64", "AMD64"} and platform.system() == "Linux"
    promise = "bits as in datasets.yaml" if native else "bits may differ: see docs/determinism.md"
    detail = f"{platform.machine()}, {available_cores()} of {os.cpu_count()} cores; {promise}"
    return Check(name="processor", state="ok", detail=detail)


def _library(name: str) -> Check:
    try:
        return Check(name=name, state="ok", detail=version(name))
    except PackageNotFoundError:
        return Check(name=name, state="broken", detail="not installed: pip install lagbench")


def _extra(name: str, extra: str) -> Check:
    try:
        return Check(name=name, state="ok", detail=version(name))
    except PackageNotFoundError:
        return Check(name=name, state="missing", detail=f"pip install 'lagbench[{extra}]'")


def _attempt(name: str, look: Callable[[], str]) -> Check:
    try:
        return Check(name=name, state="ok", detail=look())
    except (LagbenchError, OSError) as error:
        return Check(name=name, state="broken", detail=str(error))


def _registry() -> str:
    registry = load()
    measured = sum(len(sizes) for sizes in registry.measured.values())
    return f"{len(registry.splits)} splits, hashes of {measured} sizes"


def _folder(folder: Path) -> str:
    """Return where data sets live; an OSError when nothing can be written there."""
    existing = next(place for place in (folder, *folder.parents) if place.exists())
    with tempfile.TemporaryFile(dir=existing):
        return f"{folder}, {free_bytes(folder)} bytes free"
