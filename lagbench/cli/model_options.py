"""The libraries and the next commands of train and predict."""

from __future__ import annotations

import shlex
from pathlib import Path

from lagbench.data.layout import quote_root
from lagbench.data.local import locate_split
from lagbench.data.registry import NO_GENERATOR
from lagbench.errors import check_installed


def require_libraries() -> None:
    """Refuse to go on without the libraries of reference models.

    Raises:
        UsageError: one of them is not installed.
    """
    for name in ("torch", "torch_geometric"):
        check_installed(name, extra="baselines")


def data_option(split: str, root: str | Path | None) -> str:
    """Return the option with which the next command finds the data.

    It is " --root FOLDER" where the user named a root, and " --split FOLDER/" of a
    local split. Else no option is needed.
    """
    location = locate_split(split, root=root)
    entry = location.registry.split(location.name)
    if root is not None:
        return f" --root {quote_root(root)}"
    if entry.generator == NO_GENERATOR:
        folder = location.root / location.name
        return f" --split {shlex.quote(str(folder))}/"
    return ""
