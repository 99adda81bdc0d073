"""A scenario file of three dimensions that states an obstacle, and its mutations."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from .mutations import Mutation

OBSTACLE = {
    "obstacle_x": 0.5,
    "obstacle_y": 0.5,
    "obstacle_z": 0.4,
    "obstacle_diameter": 0.25,
}
"""Attributes of a ball in the unit box [length]."""

HASHED = "hashed_parameters"
"""The attribute that names the parameters of a scenario."""

STATED: tuple[Any, ...] = (
    0.0,
    -1.0,
    7.0,
    1e-300,
    1e30,
    1e300,
    np.nan,
    np.inf,
    "text",
    "",
    b"\xff",
    True,
    1j,
    [0.5, 0.5],
    [],
    10**18,
)
"""What may stand in the place of a length."""


def write_scenario(source: Path, path: Path) -> None:
    """Copy a scenario file and state an obstacle in it."""
    shutil.copy(source, path)
    with h5py.File(path, "a") as file:
        names = file.attrs[HASHED]
        if isinstance(names, bytes):
            names = names.decode()
        file.attrs[HASHED] = " ".join(sorted([*names.split(), *OBSTACLE]))
        for name, value in OBSTACLE.items():
            file.attrs[name] = value


def other_obstacle(path: Path, rng: np.random.Generator) -> None:
    """State another number of the obstacle, or what is no number."""
    names = list(OBSTACLE)
    name = names[rng.integers(len(names))]
    with h5py.File(path, "a") as file:
        file.attrs[name] = STATED[rng.integers(len(STATED))]


def missing_number(path: Path, rng: np.random.Generator) -> None:
    """Leave a number of the obstacle out, and perhaps its name too."""
    names = list(OBSTACLE)
    name = names[rng.integers(len(names))]
    with h5py.File(path, "a") as file:
        del file.attrs[name]
        if rng.integers(2):
            stated = str(file.attrs[HASHED]).split()
            stated.remove(name)
            file.attrs[HASHED] = " ".join(stated)


OBSTACLES: tuple[Mutation, ...] = (other_obstacle, other_obstacle, missing_number)
