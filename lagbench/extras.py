"""Optional dependencies: import one, or say which extra installs it."""

from __future__ import annotations

import importlib
import importlib.util
from types import ModuleType

from .errors import UsageError

__all__ = ["check_installed", "require"]


def require(module: str, *, extra: str) -> ModuleType:
    """Import an optional module.

    Args:
        module: dotted name of the module.
        extra: extra of lagbench that installs it.

    Raises:
        UsageError: it is not installed; the message holds the command that installs it.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if (error.name or "").split(".")[0] != module.split(".")[0]:
            raise
        raise _missing(module, extra) from None


def check_installed(module: str, *, extra: str) -> None:
    """Refuse before work starts, without importing: workers will import the module.

    Raises:
        UsageError: it is not installed; the message holds the command that installs it.
    """
    if importlib.util.find_spec(module) is None:
        raise _missing(module, extra)


def _missing(module: str, extra: str) -> UsageError:
    return UsageError(
        f"{module.split('.')[0]} is not installed",
        where=f"this needs the extra {extra!r}",
        fix=f"pip install 'lagbench[{extra}]'",
    )
