"""The command doctor: checks of the machine, which a bug report needs."""

from __future__ import annotations

import os
import platform
from importlib.metadata import PackageNotFoundError, requires, version

from lagbench.atomic import check_writable
from lagbench.data.local import resolve_root
from lagbench.data.registry import load
from lagbench.errors import ChecksFailedError, LagbenchError
from lagbench.make.plan import free_bytes
from lagbench.work.machine import available_cores

from .options import JsonFlag, RootOption
from .output import format_bytes, print_json, print_table


def doctor_command(*, root: RootOption = None, as_json: JsonFlag = False) -> None:
    """Check this machine: libraries, cores, disk, registry."""
    checks = diagnose(root)
    if as_json:
        print_json({"checks": checks})
    else:
        rows = [tuple(check.values()) for check in checks]
        print_table("", ("check", "state", "detail"), rows)
    broken = [check["name"] for check in checks if check["state"] == "broken"]
    if broken:
        raise ChecksFailedError(
            f"this machine cannot run lagbench: {', '.join(broken)} broken; see the "
            "details in the table"
        )


def diagnose(root: str | None = None) -> list[dict[str, str]]:
    """Check what lagbench needs, with data sets under ``root``; nothing is changed.

    Returns:
        Name, state and detail of each check. The state is ok, missing (something
        optional) or broken; the detail says how to mend it.
    """
    machine = platform.machine()
    bits = "bits may differ: see docs/determinism.md"
    if machine in {"x86_64", "AMD64"} and platform.system() == "Linux":
        bits = "bits as in datasets.yaml"
    cores = f"{available_cores()} of {os.cpu_count()} cores"
    checks = [
        _check("lagbench", version("lagbench")),
        _check("python", f"{platform.python_version()} on {platform.platform()}"),
        _check("processor", f"{machine}, {cores}; {bits}"),
        *_check_libraries(),
    ]
    try:
        checks.append(_check("registry", f"{len(load().splits)} splits"))
        folder = resolve_root(root)
        check_writable(folder)
        detail = f"{folder}, {format_bytes(free_bytes(folder))} free"
        checks.append(_check("data folder", detail))
    except (LagbenchError, OSError) as error:
        checks.append(_check("data", str(error), state="broken"))
    return checks


def _check(name: str, detail: str, *, state: str = "ok") -> dict[str, str]:
    return {"name": name, "state": state, "detail": detail}


def _check_libraries() -> list[dict[str, str]]:
    """Check all that lagbench declares; what only an extra needs may be missing."""
    from packaging.requirements import Requirement

    checks: dict[str, dict[str, str]] = {}
    for line in requires("lagbench") or ():
        requirement = Requirement(line)
        name = requirement.name
        _, is_optional, extra = str(requirement.marker or "").partition("extra == ")
        extra = extra.strip('"')
        if extra in ("all", "dev", "docs") or name in checks:
            continue
        try:
            checks[name] = _check(name, version(name))
        except PackageNotFoundError:
            package = f"lagbench[{extra}]" if is_optional else name
            checks[name] = _check(
                name,
                f"pip install '{package}'",
                state="missing" if is_optional else "broken",
            )
    return list(checks.values())
