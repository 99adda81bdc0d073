"""The command doctor: checks of the machine, which a bug report needs."""

from __future__ import annotations

import os
import platform
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, requires, version

from lagbench.atomic import check_writable
from lagbench.data.local import resolve_root
from lagbench.data.registry import load
from lagbench.errors import ChecksFailedError, LagbenchError
from lagbench.make.plan import free_bytes
from lagbench.work.machine import available_cores

from .options import JsonFlag, RootOption
from .output import format_bytes, print_json, print_table


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


def doctor_command(*, root: RootOption = None, as_json: JsonFlag = False) -> None:
    """Check this machine: libraries, cores, disk, registry."""
    diagnosis = diagnose(root)
    if as_json:
        print_json(diagnosis)
    else:
        rows = [(check.name, check.state, check.detail) for check in diagnosis.checks]
        print_table("", ("check", "state", "detail"), rows)
    broken = [check.name for check in diagnosis.checks if check.state == "broken"]
    if broken:
        raise ChecksFailedError(
            f"this machine cannot run lagbench: {', '.join(broken)} broken; see the "
            "details in the table"
        )


def diagnose(root: str | None = None) -> Diagnosis:
    """Check what lagbench needs, with data sets under ``root``; nothing is changed."""
    machine = platform.machine()
    bits = "bits may differ: see docs/determinism.md"
    if machine in {"x86_64", "AMD64"} and platform.system() == "Linux":
        bits = "bits as in datasets.yaml"
    cores = f"{available_cores()} of {os.cpu_count()} cores"
    checks = [
        InstallationCheck(name="lagbench", state="ok", detail=version("lagbench")),
        InstallationCheck(
            name="python",
            state="ok",
            detail=f"{platform.python_version()} on {platform.platform()}",
        ),
        InstallationCheck(
            name="processor", state="ok", detail=f"{machine}, {cores}; {bits}"
        ),
        *_check_libraries(),
    ]
    try:
        registry = load()
        detail = f"{len(registry.splits)} splits"
        checks.append(InstallationCheck(name="registry", state="ok", detail=detail))
        folder = resolve_root(root)
        check_writable(folder)
        detail = f"{folder}, {format_bytes(free_bytes(folder))} free"
        checks.append(InstallationCheck(name="data folder", state="ok", detail=detail))
    except (LagbenchError, OSError) as error:
        detail = str(error)
        checks.append(InstallationCheck(name="data", state="broken", detail=detail))
    return Diagnosis(checks=tuple(checks))


def _check_libraries() -> list[InstallationCheck]:
    """Check all that lagbench declares; what only an extra needs may be missing."""
    from packaging.requirements import Requirement

    checks = {}
    for line in requires("lagbench") or ():
        requirement = Requirement(line)
        _, is_optional, extra = str(requirement.marker or "").partition("extra == ")
        extra = extra.strip('"')
        if extra in ("all", "dev", "docs") or requirement.name in checks:
            continue
        try:
            state = "ok"
            detail = version(requirement.name)
        except PackageNotFoundError:
            state = "missing" if is_optional else "broken"
            name = f"lagbench[{extra}]" if is_optional else requirement.name
            detail = f"pip install '{name}'"
        checks[requirement.name] = InstallationCheck(
            name=requirement.name, state=state, detail=detail
        )
    return list(checks.values())
