"""The libraries and the next commands of train and predict."""

from __future__ import annotations

import shlex
from pathlib import Path

from lagbench.data.layout import quote_root
from lagbench.data.local import locate_split
from lagbench.data.registry import NO_GENERATOR
from lagbench.errors import WorkFailedError, check_installed
from lagbench.work.machine import address_space_limit

PREDICTION_LIBRARIES = ("torch", "torch_geometric")
TRAINING_LIBRARIES = (*PREDICTION_LIBRARIES,)

NEEDED_BYTES = 1280 << 20
"""Least address space in which a model is trained [bytes]; tiny ones map 1,040 MiB."""


def require_libraries(names: tuple[str, ...]) -> None:
    """Refuse to go on without the libraries of reference models.

    Raises:
        UsageError: one of them is not installed.
        WorkFailedError: this process may not map as much memory as they need.
    """
    for name in names:
        check_installed(name, extra="baselines")
    # OpenBLAS, which SciPy brings, tries for ever where it finds no memory.
    limit = address_space_limit()
    if limit is not None and limit < NEEDED_BYTES:
        raise WorkFailedError(
            f"there is not enough memory: got {limit >> 20} MiB, expected at least "
            f"{NEEDED_BYTES >> 20} MiB, for PyTorch and SciPy; raise the limit: "
            "`ulimit -v unlimited`, or that of the batch system",
            where="the limit on the address space of this process",
        )


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
