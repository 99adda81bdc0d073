"""metadata.json of both formats: written from the registry, read with care.

Programs of other code bases pass over keys that they do not know; ours stand together under
``lagbench``, so that what we export comes back with its task and its place in the box.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, TypeAdapter, ValidationError

from lagbench.atomic import write_atomically
from lagbench.data.registry import Size
from lagbench.data.scenario import MATERIALS
from lagbench.errors import UnreadableFileError

from .kinds import NUMBERS, Format

__all__ = ["NAME", "Hints", "Shapes", "Source", "describe", "floor_of", "read_source", "write_metadata"]

NAME = "metadata.json"
OWN_KEY = "lagbench"
MAX_BYTES = 1 << 20

Pair = tuple[FiniteFloat, FiniteFloat]
Shapes = Mapping[str, Sequence[tuple[int, int]]]
"""Frames and particles of every trajectory, by subset."""

_GRANULES = 2**20


class Hints(BaseModel):
    """What our own exports add: where the box lies and what the task is."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    origin: Pair = (0.0, 0.0)  # what was taken off every position [length]
    bounds: tuple[Pair, Pair] | None = None  # walls before that [length]
    # distance of neighbouring particles at first [length]
    spacing: Annotated[float, Field(gt=0)] | None = None
    density: Annotated[float, Field(gt=0)] | None = None  # rest density [mass/length^2]
    input_frames: Annotated[int, Field(gt=1)] | None = None  # frames given
    horizon: Annotated[int, Field(gt=0)] | None = None  # frames to predict
    frames_of_interest: tuple[int, ...] | None = None  # absolute frames at which the scorer reports
    cells: Annotated[int, Field(gt=3)] | None = None  # cells across of the score grid
    placement: Literal["cell_centres", "nodes"] | None = None  # where its nodes lie


class Source(BaseModel):
    """What a metadata.json says, as far as a local split needs it."""

    model_config = ConfigDict(frozen=True)

    bounds: tuple[Pair, Pair]  # box of the source [its length]
    radius: Annotated[float, Field(gt=0, allow_inf_nan=False)]  # connectivity radius [its length]
    # time between frames [s]; None where none is stated
    frame_interval: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None
    # distance of neighbouring particles at first [its length]
    spacing: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None
    periodic: tuple[bool, bool]  # whether the box is periodic, along x and y
    hints: Hints  # what our own exports add


def floor_of(value: float) -> float:
    """Return the largest multiple of 2^-20 below: taken off a float32 beyond it, nothing is lost."""
    return math.floor(value * _GRANULES) / _GRANULES


def describe(
    size: Size,
    form: Format,
    shapes: Shapes,
    statistics: Mapping[str, tuple[float, ...]],
    *,
    title: str,
    dataset_sha256: str,
    spacing: float,
    origin: tuple[float, float],
    free_slip: bool,
) -> dict[str, object]:
    """Return the metadata of an export."""
    task, grid = size.task, size.task.score_grid
    common = {
        "bounds": [[low - o, high - o] for (low, high), o in zip(size.bounds, origin, strict=True)],
        "default_connectivity_radius": task.radius,
        "dim": 2,
        **_normalisation(statistics),
    }
    own = {
        "split": size.split,
        "size": size.name,
        "version": size.version,
        "title": title,
        "dataset_sha256": dataset_sha256,
        "particle_type": {name: NUMBERS[form][name] for name in MATERIALS},
        "origin": list(origin),
        "bounds": [list(pair) for pair in size.bounds],
        "spacing": spacing,
        "density": size.value("density"),
        "input_frames": task.input_frames,
        "horizon": task.horizon,
        "frames_of_interest": list(task.frames_of_interest),
        "cells": grid.cells,
        "placement": grid.placement,
    }
    if form is Format.GNS_NPZ:
        shortest = min(frames for subset in shapes.values() for frames, _ in subset)
        special: dict[str, object] = {"sequence_length": shortest, "dt": size.frame_interval}
    else:
        special = _of_lagrangebench(size, shapes, spacing=spacing, free_slip=free_slip)
        if not any(origin):
            # Its cell lists start at 0 and are as long as the bounds are apart: with those of
            # the walls, particles beyond the difference would lose their neighbours.
            special["bounds"] = [[0.0, 1.0], [0.0, 1.0]]
    return {**common, **special, OWN_KEY: own}


def _normalisation(statistics: Mapping[str, tuple[float, ...]]) -> dict[str, list[float]]:
    """Return means and deviations; a deviation of 0 would be divided by, so it becomes 1."""
    names = {"vel": "velocity", "acc": "acceleration"}
    means = {f"{short}_mean": list(statistics[f"{name}_mean"]) for short, name in names.items()}
    stds = {f"{short}_std": [v or 1.0 for v in statistics[f"{name}_std"]] for short, name in names.items()}
    return {**means, **stds}


def _of_lagrangebench(size: Size, shapes: Shapes, *, spacing: float, free_slip: bool) -> dict[str, object]:
    """Return the keys that only lagrangebench-h5 has; its ``dt`` is that of the solver."""
    parameters = {name: parameter.value for name, parameter in size.parameters.items()}
    frames = {subset: rows[0][0] for subset, rows in shapes.items()}
    return {
        "case": size.split.upper(),
        "solver": "MPM" if size.simulated else "unknown",
        "density_evolution": False,
        "dx": spacing,
        "dt": size.dt,
        "write_every": size.substeps_per_frame,
        "t_end": (max(frames.values()) - 1) * size.frame_interval,
        "viscosity": parameters.get("liquid_viscosity"),
        "p_bg_factor": 0.0,
        "g_ext_magnitude": parameters.get("gravity", 0.0),
        "artificial_alpha": 0.0,
        "free_slip": free_slip,
        "is_bc_trick": False,
        # One less than frames: the last one is a target only, as in the data sets of that code base.
        "sequence_length_train": frames["train"] - 1,
        "sequence_length_test": frames["test"] - 1,
        "num_trajs_train": len(shapes["train"]),
        "num_trajs_test": len(shapes["test"]),
        "num_particles_max": max(n for rows in shapes.values() for _, n in rows),
        "periodic_boundary_conditions": [False, False],
    }


def write_metadata(folder: Path, metadata: Mapping[str, object]) -> Path:
    """Write metadata.json whole or not at all; return its path."""
    path = folder / NAME
    write_atomically(path, (json.dumps(metadata, indent=1) + "\n").encode(), option="--output")
    return path


def read_source(folder: Path, form: Format) -> Source:
    """Return what a metadata.json says."""
    path = folder / NAME
    values = _values(path)
    # Newer GNS programs keep one block for training and one for rollouts.
    block = values.get("train")
    values = block if isinstance(block, dict) else values
    if values.get("dim", 2) != 2:
        raise UnreadableFileError(
            "the data are not plane", where=f"{path}, key dim", expected=2, got=repr(values["dim"])
        )
    every = values.get("write_every", 1) if form is Format.LAGRANGEBENCH_H5 else 1
    try:
        step = TypeAdapter(float).validate_python(values.get("dt") or 0.0)
        steps = TypeAdapter(float).validate_python(every)
        return Source.model_validate(
            {
                "bounds": values.get("bounds"),
                "radius": values.get("default_connectivity_radius"),
                "frame_interval": step * steps or None,
                "spacing": values.get("dx") if form is Format.LAGRANGEBENCH_H5 else None,
                "periodic": values.get("periodic_boundary_conditions") or (False, False),
                "hints": values.get(OWN_KEY) or {},
            }
        )
    except ValidationError as error:
        raise _mistaken(path, error) from None


def _values(path: Path) -> dict[str, object]:
    try:
        with path.open("rb") as stream:
            text = stream.read(MAX_BYTES + 1)
        if len(text) > MAX_BYTES:
            raise UnreadableFileError(
                "the file is too large", where=str(path), expected=f"<= {MAX_BYTES} bytes"
            )
        values = json.loads(text)
    except (OSError, ValueError, RecursionError) as error:
        raise UnreadableFileError(
            "cannot read the metadata", where=str(path), expected="a JSON object", got=error
        ) from error
    if not isinstance(values, dict):
        raise UnreadableFileError(
            "the metadata are no JSON object", where=str(path), got=type(values).__name__
        )
    return values


_KEYS = {
    "radius": "default_connectivity_radius",
    "frame_interval": "dt",
    "spacing": "dx",
    "periodic": "periodic_boundary_conditions",
    "hints": OWN_KEY,
}
"""Key of what :class:`Source` holds, where it has another name."""


def _mistaken(path: Path, error: ValidationError) -> UnreadableFileError:
    first = error.errors()[0]
    name, *inner = map(str, first["loc"] or ("frame_interval",))
    return UnreadableFileError(
        "the metadata lack what a split needs, or state it otherwise",
        where=f"{path}, key {'.'.join((_KEYS.get(name, name), *inner))}",
        expected=first["msg"],
        got=first["input"],
    )
