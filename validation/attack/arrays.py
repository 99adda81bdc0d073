"""Trajectories to adopt and to import: valid ones, and their mutations."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .mutations import Mutation

Arrays = dict[str, NDArray[Any]]

TRAJECTORIES = 4
FRAMES = 16
SIDE = {2: 12, 3: 6}
"""Particles along an axis, by dimension."""


def trajectory(seed: int, dimension: int) -> NDArray[np.float32]:
    """Return positions in a periodic unit box, shape [frame, particle, axis].

    Particles of a lattice drift, and every axis bends the others.
    """
    side = SIDE[dimension]
    centres = (np.arange(side) + 0.5) / side
    lattice = np.stack(np.meshgrid(*[centres] * dimension, indexing="ij"), axis=-1)
    position = lattice.reshape(-1, dimension)
    frames = []
    for frame in range(FRAMES):
        phase = 2 * np.pi * np.roll(position, 1, axis=1) + seed
        position = (position + 0.01 * np.sin(phase + 0.02 * frame) + 0.004) % 1.0
        frames.append(position)
    return np.asarray(frames, np.float32) % np.float32(1.0)


def write_trajectories(folder: Path, dimension: int) -> None:
    """Write trajectories for adopt."""
    folder.mkdir(parents=True)
    for number in range(TRAJECTORIES):
        position = trajectory(number, dimension)
        material = np.zeros(position.shape[1], np.int64)
        np.savez(folder / f"{number}.npz", position=position, material=material)


def write_walled_trajectories(folder: Path, dimension: int) -> None:
    """Write trajectories between moving walls, each with other numbers of particles."""
    folder.mkdir(parents=True)
    for number in range(TRAJECTORIES):
        particles = SIDE[dimension] ** dimension - 7 * number
        frames = FRAMES - number
        # the drift of a periodic box, shrunk: no particle reaches a wall
        start = trajectory(number, dimension)[0, :particles]
        phases = 0.05 * np.arange(frames)[:, None, None]
        position = 0.1 + 0.8 * start + 0.02 * np.sin(phases + 6 * start)
        wall_velocity = np.zeros((frames, 2 * dimension, dimension), np.float32)
        wall_velocity[:, -1, 0] = 0.1
        np.savez(
            folder / f"{number}.npz",
            position=position.astype(np.float32),
            material=np.zeros(particles, np.int64),
            wall_velocity=wall_velocity,
        )


def write_gns(folder: Path, dimension: int) -> None:
    """Write a data set as GNS code bases do: metadata and an npz for each subset."""
    folder.mkdir(parents=True)
    metadata = {
        "bounds": [[0.0, 1.0]] * dimension,
        "periodic_boundary_conditions": [True] * dimension,
        "sequence_length": FRAMES - 1,
        "default_connectivity_radius": 0.1,
        "dim": dimension,
        "dt": 0.1,
    }
    (folder / "metadata.json").write_text(json.dumps(metadata))
    for seed, subset in enumerate(("train", "valid", "test")):
        rows: dict[str, Any] = {}
        for number in range(2):
            position = trajectory(10 * seed + number, dimension)
            kinds = np.full(position.shape[1], 5)
            row = np.empty(2, object)
            row[0] = position
            row[1] = kinds
            rows[f"simulation_trajectory_{number}"] = row
        np.savez(folder / f"{subset}.npz", **rows)


def _edit(path: Path, change: Callable[[Arrays], Arrays | None]) -> None:
    """Write changed arrays in the place of the old ones."""
    with np.load(path) as opened:
        arrays = dict(opened)
    changed = change(arrays)
    np.savez(path, **(arrays if changed is None else changed))


def wrong_numbers(path: Path, rng: np.random.Generator) -> None:
    """Make a position NaN, infinite, huge or negative."""
    values = (np.nan, np.inf, -np.inf, 1e30, -5.0, 1.5)
    value = values[rng.integers(len(values))]

    def change(arrays: Arrays) -> None:
        position = arrays["position"]
        position[tuple(rng.integers(position.shape))] = value

    _edit(path, change)


def jump(path: Path, rng: np.random.Generator) -> None:
    """Exchange the particles of a frame."""

    def change(arrays: Arrays) -> None:
        position = arrays["position"]
        position[FRAMES // 2] = rng.permutation(position[FRAMES // 2])

    _edit(path, change)


def other_shape(path: Path, rng: np.random.Generator) -> None:
    """Leave out components, particles or frames, or add an axis."""
    kind = int(rng.integers(6))

    def change(arrays: Arrays) -> None:
        position = arrays["position"]
        choices = (
            position[..., :1],
            position[:, :0],
            position[:1],
            position[None, None],
            position[..., [0, 0, 0, 0]],
            position.reshape(-1),
        )
        arrays["position"] = choices[kind]

    _edit(path, change)


def other_type(path: Path, rng: np.random.Generator) -> None:
    """Store positions as another type."""
    kinds = ("f2", "f8", ">f4", "i4", "c8", "U8", "?", "V4")

    def change(arrays: Arrays) -> None:
        kind = kinds[rng.integers(len(kinds))]
        position = arrays["position"]
        if kind == "V4":
            arrays["position"] = position.view(kind)
        else:
            arrays["position"] = position.astype(kind)

    _edit(path, change)


def objects(path: Path, rng: np.random.Generator) -> None:
    """Store positions as Python objects, which only a pickle holds."""

    def change(arrays: Arrays) -> None:
        arrays["position"] = arrays["position"].astype(object)

    _edit(path, change)


def wrong_materials(path: Path, rng: np.random.Generator) -> None:
    """Give materials that there are not, too few of them, or other types."""
    kind = int(rng.integers(5))

    def change(arrays: Arrays) -> None:
        material = arrays["material"]
        choices = (
            material + 99,
            material - 1,
            material[:-1],
            material + 0.5,
            np.array("liquid"),
        )
        arrays["material"] = choices[kind]

    _edit(path, change)


def other_names(path: Path, rng: np.random.Generator) -> None:
    """Give the arrays other names, among them paths."""
    names = ("positions", "../../x", "\u202e", "position.npy", "")

    def change(arrays: Arrays) -> Arrays:
        name = names[rng.integers(len(names))]
        arrays[name] = arrays.pop("position")
        return arrays

    _edit(path, change)


def velocities_that_lie(path: Path, rng: np.random.Generator) -> None:
    """Add velocities that are no numbers, or of another motion."""
    factors = (np.nan, np.inf, 0.0, -1.0, 1e30)

    def change(arrays: Arrays) -> None:
        steps = np.diff(arrays["position"], axis=0, prepend=arrays["position"][:1])
        factor = np.float32(factors[rng.integers(len(factors))])
        with np.errstate(invalid="ignore"):
            arrays["velocity"] = steps * factor

    _edit(path, change)


def wrong_walls(path: Path, rng: np.random.Generator) -> None:
    """Spoil the wall velocities of a trajectory: not finite, too fast, other shapes."""
    kind = int(rng.integers(9))

    def change(arrays: Arrays) -> None:
        walls = arrays["wall_velocity"]
        choices: tuple[NDArray[Any], ...] = (
            walls * np.nan,
            walls + np.inf,
            walls + 1e30,
            walls[:-1],
            walls[:, :-1],
            walls[..., :-1],
            walls[0],
            walls.astype("U8"),
            np.ones((), np.float32),
        )
        arrays["wall_velocity"] = choices[kind]

    _edit(path, change)


def other_number(path: Path, rng: np.random.Generator) -> None:
    """Have one particle, none, or as many as no box holds; or one frame or two; or the
    axes in another order.
    """
    kind = int(rng.integers(6))

    def change(arrays: Arrays) -> None:
        position = arrays["position"]
        choices = (
            position[:, :1],
            position[:, :0],
            np.repeat(position, 200, axis=1),
            position[:1],
            position[:2],
            position[:, :, ::-1].copy(order="F"),
        )
        arrays["position"] = choices[kind]
        arrays["material"] = np.zeros(choices[kind].shape[1], np.int64)
        arrays["wall_velocity"] = arrays["wall_velocity"][: choices[kind].shape[0]]

    _edit(path, change)


WALLED_ARRAYS: tuple[Mutation, ...] = (wrong_walls, other_number)

ARRAYS: tuple[Mutation, ...] = (
    wrong_numbers,
    wrong_numbers,
    jump,
    other_shape,
    other_type,
    objects,
    wrong_materials,
    other_names,
    velocities_that_lie,
)
