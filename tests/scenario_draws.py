"""Scenarios of the registry, drawn once and shared by the tests of the splits."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import importlib
import os
import subprocess
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lagbench.data import registry
from lagbench.generators import draws
from lagbench.generators.split import InitialState

SPLITS = ("cavity", "curl-noise", "fluid", "multimaterial")
SIZES = ("full", "mini", "tiny")
Case = TypeVar("Case")
EVERY = [(split, size) for split in SPLITS for size in SIZES]


@functools.cache
def turn() -> int:
    """Return the number of commits so far: it picks what this run does of what is too
    much for one.

    0 where git does not tell. ``LAGBENCH_TURN`` is taken before it: a number, or
    ``all``, which is 0 here.
    """
    wanted = os.environ.get("LAGBENCH_TURN", "")
    if wanted:
        return int(wanted) if wanted != "all" else 0
    asked = ["git", "rev-list", "--count", "HEAD"]
    try:
        told = subprocess.run(
            asked, cwd=Path(__file__).parent, capture_output=True, text=True, check=True
        )
    except (OSError, subprocess.CalledProcessError):
        return 0
    return int(told.stdout)


def of_this_turn(cases: Sequence[Case], *, turns: int, shift: int = 0) -> list[Case]:
    """Return every so many-th case, the next ones after another commit; all with
    ``LAGBENCH_TURN=all``.
    """
    if os.environ.get("LAGBENCH_TURN") == "all":
        return list(cases)
    return [
        case
        for place, case in enumerate(cases)
        if (place + turn() + shift) % turns == 0
    ]


def changed(size: registry.Size, **values: float) -> registry.Size:
    """Return a size with other parameter values."""
    new = {
        k: size.parameters[k].model_copy(update={"value": v}) for k, v in values.items()
    }
    return size.model_copy(update={"parameters": {**size.parameters, **new}})


def draw(size: registry.Size, scenario: int) -> InitialState:
    """Draw a scenario of a size from its own seed."""
    # nothing but ``random`` can be used of the generator
    rng = SimpleNamespace(
        random=draws.generator(size.split, size.name, size.major, scenario).random
    )
    module = importlib.import_module(size.generator)
    state: InitialState = module.initial_state(size, scenario, rng)
    return state


@functools.cache
def state_of(split: str, size: str, scenario: int) -> InitialState:
    """Draw a scenario of the registry, once."""
    return draw(registry.load().size(split, size), scenario)


def all_of(split: str, size: str = "full") -> list[InitialState]:
    """Return all scenarios of a size in the order of their ids."""
    return [
        state_of(split, size, i) for i in registry.load().size(split, size).scenarios
    ]


def digest(state: InitialState) -> str:
    """Return a hash over everything in a state."""
    total = hashlib.sha256()
    for field in dataclasses.fields(state):
        value = getattr(state, field.name)
        total.update(
            value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode()
        )
    return total.hexdigest()


def neighbours(
    position: NDArray[np.float64], count: int, among: NDArray[np.float64] | None = None
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return distance and index of the nearest points, by SciPy's k-d tree, shape
    [point, count].
    """
    found = cKDTree(position if among is None else among).query(
        position, k=list(range(1, count + 1))
    )
    return np.asarray(found[0]), np.asarray(found[1])
