"""Options of the commands train and predict, and the libraries that they need."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from lagbench.data.local import locate_split
from lagbench.data.registry import NO_GENERATOR
from lagbench.errors import check_installed

from .options import option

DeviceOption = Annotated[str, option("--device NAME", "cpu, cuda, or auto.")]
ThreadsOption = Annotated[
    int | None,
    option(
        "--threads N",
        "CPU threads; by default OMP_NUM_THREADS, or else a share of the cores.",
        min=1,
    ),
]

PREDICTION_LIBRARIES = ("torch", "torch_geometric")
TRAINING_LIBRARIES = (*PREDICTION_LIBRARIES, "lightning_fabric")


def require_libraries(names: tuple[str, ...]) -> None:
    """Refuse to go on without the libraries of reference models.

    Raises:
        UsageError: one of them is not installed.
    """
    for name in names:
        check_installed(name, extra="baselines")


def root_option(split: str, root: Path | None) -> str:
    """Return the option by which the next command finds the data; often empty."""
    location = locate_split(split, root=root)
    entry = location.registry.split(location.name)
    if root is not None:
        return f" --root {root}"
    if entry.generator == NO_GENERATOR:
        return f" --root {location.root}"
    return ""
