"""Scenarios of the registry, drawn once and shared by the tests of the splits."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import importlib
from types import SimpleNamespace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lagbench.data import registry
from lagbench.generators import draws
from lagbench.generators.split import InitialState

SPLITS = ("cavity", "curl-noise", "fluid", "multimaterial")
SIZES = ("full", "mini", "tiny")
EVERY = [(split, size) for split in SPLITS for size in SIZES]


def changed(size: registry.Size, **values: float) -> registry.Size:
    """Return a size with other parameter values."""
    parameters = dict(size.parameters)
    for name, value in values.items():
        parameters[name] = parameters[name].model_copy(update={"value": value})
    return size.model_copy(update={"parameters": parameters})


def draw(size: registry.Size, scenario: int) -> InitialState:
    """Draw a scenario of a size from its own seed."""
    generator = draws.generator(size.split, size.name, size.major, scenario)
    # nothing but ``random`` can be used of the generator
    rng = SimpleNamespace(random=generator.random)
    module = importlib.import_module(size.generator)
    state: InitialState = module.initial_state(size, scenario, rng)
    return state


@functools.cache
def state_of(split: str, size: str, scenario: int) -> InitialState:
    """Draw a scenario of the registry, once."""
    return draw(registry.load().size(split, size), scenario)


def usual_ids(size: registry.Size) -> list[int]:
    """Return the ids of all scenarios that are drawn as those of train are."""
    return [i for i in size.scenarios if i not in size.subsets.get("shift", ())]


def all_of(split: str, size: str = "full") -> list[InitialState]:
    """Return all scenarios of a size but those of shift, in the order of their ids."""
    ids = usual_ids(registry.load().size(split, size))
    return [state_of(split, size, scenario) for scenario in ids]


def shifted(split: str, size: str = "full") -> list[InitialState]:
    """Return the scenarios of shift in the order of their ids."""
    ids = sorted(registry.load().size(split, size).subsets["shift"])
    return [state_of(split, size, scenario) for scenario in ids]


def digest(state: InitialState) -> str:
    """Return a hash over everything in a state."""
    total = hashlib.sha256()
    for field in dataclasses.fields(state):
        value = getattr(state, field.name)
        if isinstance(value, np.ndarray):
            total.update(value.tobytes())
        else:
            total.update(repr(value).encode())
    return total.hexdigest()


def neighbours(
    position: NDArray[np.float64],
    count: int,
    among: NDArray[np.float64] | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return distance and index of the nearest points, by SciPy's k-d tree.

    Both have the shape [point, count].
    """
    if among is None:
        among = position
    ranks = list(range(1, count + 1))
    distance, index = cKDTree(among).query(position, k=ranks)
    return np.asarray(distance), np.asarray(index)
