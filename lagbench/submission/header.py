"""What a predictions.nc says about itself, and the names of its parts."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

__all__ = ["DIMS", "FORMAT", "NEVER", "OPTIONAL", "REQUIRED", "SPACE", "Header", "fits", "kind_of"]

FORMAT = 1
"""Number of the file layout; stored as attribute ``lagbench_format``."""

DIMS = ("scenario", "frame", "particle", "space")
"""Dimensions of ``position``, in this order."""

SPACE = 2
"""Components of a position."""

NEVER = -1
"""Value of ``diverged_at`` for a rollout that did not diverge."""

REQUIRED = ("split", "size", "dataset_version", "dataset_sha256", "method")
"""Text attributes that every file has, beside ``lagbench_format``."""

OPTIONAL: Mapping[str, type[str] | type[int] | type[float]] = {
    "seconds_per_frame": float,
    "device": str,
    "seed": int,
    "parameters": int,
    "training": str,
}
"""Attributes that a file may have: cost, provenance and size of the model."""

_KINDS = {str: "text", int: "an integer", float: "a positive number"}


def kind_of(name: str) -> str:
    """Return in words what an optional attribute must be.

    >>> kind_of("seed"), kind_of("parameters")
    ('an integer', 'an integer >= 0')
    """
    return f"{_KINDS[OPTIONAL[name]]}{' >= 0' if name == 'parameters' else ''}"


def fits(name: str, value: object) -> bool:
    """Tell whether an optional attribute may have a value.

    >>> fits("seed", -5), fits("parameters", -5), fits("parameters", 0)
    (True, False, True)
    """
    if isinstance(value, bool):
        return False
    if OPTIONAL[name] is float:
        return isinstance(value, (int, float)) and 0 < value < math.inf
    return isinstance(value, OPTIONAL[name]) and not (name == "parameters" and int(value) < 0)


@dataclass(frozen=True, kw_only=True)
class Header:
    """What a predictions.nc says about itself."""

    split: str  # name of the split
    size: str  # name of the size
    dataset_version: str  # semantic version of the split, as in "1.0.0"
    dataset_sha256: str  # hash of the data set that the model was given, 64 hex digits
    method: str  # what made the predictions
    scenarios: tuple[int, ...]  # scenario ids in the order in which they are stored
    frames: tuple[int, ...]  # absolute numbers of the predicted frames
    particles: int  # particles in every frame
    seconds_per_frame: float | None  # cost of one predicted frame [s]
    device: str | None  # machine that predicted
    seed: int | None  # seed of the training
    parameters: int | None  # trainable parameters of the model
    training: str | None  # what the model was trained on, in words
    diverged_at: Mapping[int, int]  # scenario id to the absolute frame from which its rollout is frozen
