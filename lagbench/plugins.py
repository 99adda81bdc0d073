"""Splits that other installed packages add, none of which can harm ours."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import TypeVar

from .errors import LagbenchError, UsageError

__all__ = ["GROUP", "PluginWarning", "added_splits"]

GROUP = "lagbench.generators"
"""Entry points of this group name a split and its module; ours register the same way."""

Found = TypeVar("Found")


class PluginWarning(UserWarning):
    """A package that wants to add a split cannot; all other splits are there."""


def added_splits(own: Mapping[str, str], read: Callable[[Path, str], Found]) -> dict[str, Found]:
    """Return what other packages say about their splits, by name.

    A package that cannot be imported or read, or wants a name that is taken, is left out with
    a :class:`PluginWarning`.

    Args:
        own: our splits and the module of each.
        read: returns what a datasets.yaml says about one split.
    """
    added: dict[str, Found] = {}
    for point in dict.fromkeys(entry_points(group=GROUP)):
        if own.get(point.name) == point.value:
            continue
        try:
            if point.name in own or point.name in added:
                raise UsageError("its name is taken")
            added[point.name] = read(_registry_path(point), point.name)
        except Exception as error:  # a stranger's module: importing it may raise anything
            warnings.warn(_complaint(point, error), PluginWarning, stacklevel=2)
    return added


def _registry_path(point: EntryPoint) -> Path:
    """Return the datasets.yaml that a split's module names as REGISTRY."""
    module = point.load()
    if not hasattr(module, "REGISTRY"):
        raise UsageError(
            "its module has no registry", expected="an attribute REGISTRY: the path of its datasets.yaml"
        )
    return Path(module.REGISTRY)


def _complaint(point: EntryPoint, error: Exception) -> str:
    package = point.dist.name if point.dist else point.value.partition(".")[0]
    reason = error if isinstance(error, LagbenchError) else f"{type(error).__name__}: {error}"
    return f"package {package} adds no split {point.name!r} ({point.value}): {reason}"
