"""The command doctor: checks of the machine, which a bug report needs."""

from __future__ import annotations

import os
import platform
import shlex
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from lagbench.addresses import REPOSITORY, describe
from lagbench.atomic import check_writable
from lagbench.data.local import resolve_root
from lagbench.data.registry import load
from lagbench.errors import ChecksFailedError, LagbenchError
from lagbench.make.plan import free_bytes
from lagbench.work.machine import available_cores

from .options import JsonFlag, RootOption
from .output import print_json, print_line, print_table

CONSTRAINTS = "constraints.txt"
"""File of a clone that pins the versions of all libraries."""

REQUIRED_LIBRARIES = (
    "numpy",
    "scipy",
    "xarray",
    "netCDF4",
    "h5py",
    "h5netcdf",
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
OPTIONAL_LIBRARIES = {
    "taichi": "generate",
    "matplotlib": "plots",
    "imageio": "plots",
    "torch": "baselines",
    "torch-geometric": "baselines",
    "pytorch-lightning": "baselines",
    "statsmodels": "baselines",
    "tensorboard": "baselines",
    "safetensors": "baselines",
    "distributed": "cluster",
    "s3fs": "s3",
    "pot": "transport",
    "onnx": "onnx",
    "onnxruntime": "onnx",
}
"""Libraries of our extras, each with the name of its extra."""

PURPOSES = {
    "generate": "simulate data",
    "plots": "draw pictures and films",
    "baselines": "train reference models and predict with them",
    "cluster": "work on a Dask cluster",
    "s3": "keep data in S3",
    "transport": "measure the Sinkhorn divergence",
    "onnx": "export models to ONNX and predict with them",
}
"""What each extra is for."""

REPOSITORY_NAME = "repository"  # of the check of its address


@dataclass(frozen=True, kw_only=True)
class InstallationCheck:
    """The check of one part of the installation."""

    name: str  # the part
    state: str  # "ok", "missing" (something optional) or "broken"
    detail: str  # what the check found, and how to mend it


@dataclass(frozen=True, kw_only=True)
class Diagnosis:
    """All checks of the installation."""

    checks: tuple[InstallationCheck, ...]  # in the order in which they were made

    @property
    def broken_parts(self) -> list[str]:
        """Names of the parts that are broken."""
        return [check.name for check in self.checks if check.state == "broken"]

    @property
    def missing_extras(self) -> list[str]:
        """Names of the extras of which a library is missing, in their order."""
        missing = set()
        for check in self.checks:
            if check.state == "missing" and check.name in OPTIONAL_LIBRARIES:
                missing.add(OPTIONAL_LIBRARIES[check.name])
        return [extra for extra in PURPOSES if extra in missing]


def doctor_command(root: RootOption = None, as_json: JsonFlag = False) -> None:
    """Check this machine: libraries, cores, disk, registry."""
    diagnosis = diagnose(root)
    if as_json:
        print_json(diagnosis)
    else:
        rows = [(check.name, check.state, check.detail) for check in diagnosis.checks]
        print_table("", ("check", "state", "detail"), rows)
        for line in _describe_missing(diagnosis.missing_extras):
            print_line(line)
    broken_parts = diagnosis.broken_parts
    if broken_parts:
        raise ChecksFailedError(
            "this machine cannot run lagbench",
            where="lagbench doctor",
            expected="every part: ok",
            got=f"broken: {', '.join(broken_parts)}",
            fix="follow the detail of each broken part in the table",
        )


def _describe_missing(extras: Sequence[str]) -> Iterator[str]:
    """Yield what cannot be done, and the one command that installs all of it."""
    if not extras:
        yield "all optional libraries are installed"
        return
    for extra in extras:
        yield f"missing to {PURPOSES[extra]}: the extra {extra}"
    yield f"install: {install_command(','.join(extras))}"


def install_command(extras: str) -> str:
    """Return the command that installs extras, in a clone from the clone."""
    clone = Path(__file__).resolve().parents[2]
    if (clone / CONSTRAINTS).is_file():
        folder = shlex.quote(str(clone))
        return f"cd {folder} && pip install -c {CONSTRAINTS} -e '.[{extras}]'"
    return f"pip install 'lagbench[{extras}]'"


def diagnose(root: str | Path | None = None) -> Diagnosis:
    """Check what lagbench needs, with data sets under ``root``.

    Nothing is changed, but for the working copy of a root in a store: it is made where
    it is missing.
    """
    checks = [
        InstallationCheck(name="lagbench", state="ok", detail=version("lagbench")),
        InstallationCheck(
            name="python",
            state="ok",
            detail=f"{platform.python_version()} on {platform.platform()}",
        ),
        InstallationCheck(name="processor", state="ok", detail=_describe_processor()),
    ]
    for library in REQUIRED_LIBRARIES:
        checks.append(_check_library(library))
    for library, extra in OPTIONAL_LIBRARIES.items():
        checks.append(_check_library(library, extra))
    checks.append(
        InstallationCheck(name=REPOSITORY_NAME, state="ok", detail=describe(REPOSITORY))
    )
    checks.append(_check_part("registry", _describe_registry))
    checks.append(_check_part("data folder", lambda: _describe_folder(root)))
    return Diagnosis(checks=tuple(checks))


def _describe_processor() -> str:
    machine = platform.machine()
    if machine in {"x86_64", "AMD64"} and platform.system() == "Linux":
        promise = "bits as in datasets.yaml"
    else:
        promise = "bits may differ: see docs/determinism.md"
    return f"{machine}, {available_cores()} of {os.cpu_count()} cores; {promise}"


def _check_library(name: str, extra: str | None = None) -> InstallationCheck:
    """Check a library; that of an extra may be missing, and nothing is broken."""
    try:
        return InstallationCheck(name=name, state="ok", detail=version(name))
    except PackageNotFoundError:
        if extra is None:
            state = "broken"
            detail = f"not installed: pip install {name}"
        else:
            state = "missing"
            detail = install_command(extra)
        return InstallationCheck(name=name, state=state, detail=detail)


def _check_part(name: str, describe: Callable[[], str]) -> InstallationCheck:
    """Check a part by describing it, which fails where the part is broken."""
    try:
        return InstallationCheck(name=name, state="ok", detail=describe())
    except (LagbenchError, OSError) as error:
        return InstallationCheck(name=name, state="broken", detail=str(error))


def _describe_registry() -> str:
    registry = load()
    hash_count = sum(len(sizes) for sizes in registry.measured.values())
    return f"{len(registry.splits)} splits, hashes of {hash_count} sizes"


def _describe_folder(root: str | Path | None) -> str:
    """Return the folder of all data sets and its free space, if it can be written.

    Raises:
        UsageError: the root cannot be a folder.
        WorkFailedError: nothing can be written there.
    """
    folder = resolve_root(root)
    check_writable(folder)
    return f"{folder}, {free_bytes(folder)} bytes free"
