"""What both formats say beside positions: metadata.json, and kinds of particles.

Programs of other code bases pass over keys of metadata.json that they do not know; ours
stand together under ``lagbench``, so that what we export comes back with its task and
its place in the box.

Both formats mark each particle with a number below 9, which their models embed; only a
few have a meaning to the programs: particles that move as prescribed, and padding. Our
materials go to numbers without such a meaning, one each, so that nothing is lost. On
the way back a number that no material has must be told what it stands for, or left out.
"""

from __future__ import annotations

import enum
import json
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    FiniteFloat,
    TypeAdapter,
    ValidationError,
)

from lagbench.atomic import write_atomically
from lagbench.data import MATERIALS
from lagbench.data.registry import Size
from lagbench.errors import UnreadableFileError, UsageError, suggest_name

NAME = "metadata.json"
OWN_KEY = "lagbench"
MAX_BYTES = 1 << 20
Pair = tuple[FiniteFloat, FiniteFloat]
Length = Annotated[float, Field(gt=0, allow_inf_nan=False)]
# frames and particles of every trajectory, by subset
Shapes = Mapping[str, Sequence[tuple[int, int]]]


class Format(enum.StrEnum):
    """A format that other code bases read."""

    GNS_NPZ = "gns-npz"
    LAGRANGEBENCH_H5 = "lagrangebench-h5"


# of the files of subsets
ENDINGS = {
    Format.GNS_NPZ: ".npz",
    Format.LAGRANGEBENCH_H5: ".h5",
}

NUMBERS: Mapping[Format, Mapping[str, int]] = {  # of each material
    Format.GNS_NPZ: {"liquid": 5, "snow": 6, "jelly": 7, "rope": 8},
    Format.LAGRANGEBENCH_H5: {"liquid": 0, "jelly": 4, "snow": 5, "rope": 6},
}

# of particles of a wall at rest, and of one that moves
WALL_NUMBERS: Mapping[Format, tuple[int, int]] = {
    Format.GNS_NPZ: (3, 3),
    Format.LAGRANGEBENCH_H5: (1, 2),
}

MEANINGS: Mapping[Format, Mapping[int, str]] = {  # of numbers without a material
    Format.GNS_NPZ: {0: "rigid", 3: "kinematic: a boundary that moves as prescribed"},
    Format.LAGRANGEBENCH_H5: {1: "solid wall", 2: "moving wall", 3: "rigid body"},
}

PADDING = -1  # number of particles that are not there (lagrangebench-h5)
DROP = "drop"  # what a number is mapped to whose particles are left out
_DROPPED = -1


def parse_format(name: str) -> Format:
    """Return a format by name; of an unknown one the UsageError names the nearest."""
    known = [form.value for form in Format]
    if name not in known:
        raise UsageError(
            f"no format {name!r}", where="--format", fix=suggest_name(name, known)
        )
    return Format(name)


def numbers_of(form: Format, material: NDArray[np.integer]) -> NDArray[np.int64]:
    """Return the number of each particle's material, shape [particle]."""
    return np.array([NUMBERS[form][name] for name in MATERIALS], dtype=np.int64).take(
        material
    )


def materials_of(
    form: Format,
    numbers: NDArray[Any],
    particles: int,
    *,
    given: Mapping[int, str],
    where: str,
) -> tuple[NDArray[np.int8], NDArray[np.bool_]]:
    """Return the material of each particle kept, and a mask over all; ``given`` is what
    the user said.
    """
    gns = form is Format.GNS_NPZ
    if numbers.dtype.kind not in "iu" or numbers.shape not in [
        (particles,),
        *([(), (1,)] if gns else []),
    ]:
        raise UnreadableFileError(
            "these are no kinds of particles",
            where=where,
            expected=f"an integer, or {particles} of them"
            if gns
            else f"{particles} integers",
            got=f"{numbers.dtype} of shape {numbers.shape}",
        )
    numbers = np.broadcast_to(numbers, (particles,))
    known = (
        {number: name for name, number in NUMBERS[form].items()}
        | {PADDING: DROP}
        | dict(given)
    )
    codes = {
        number: _DROPPED if name == DROP else _code(name)
        for number, name in known.items()
    }
    found = np.unique(numbers).tolist()
    strange = [number for number in found if number not in codes]
    if strange:
        raise UnreadableFileError(
            "particles of a kind that no material is known for",
            where=where,
            expected=", ".join(
                f"{number} ({name})" for number, name in sorted(known.items())
            ),
            got=", ".join(f"{n} ({MEANINGS[form].get(n, 'unknown')})" for n in strange),
            fix=f"say what they stand for: --kinds {strange[0]}=jelly, or leave them "
            f"out: {strange[0]}=drop",
        )
    material = np.empty(numbers.shape, dtype=np.int8)
    for number in found:
        material[numbers == number] = codes[number]
    kept = material != _DROPPED
    if not kept.any():
        raise UnreadableFileError("every particle is padding or left out", where=where)
    return material[kept], kept


def _code(name: str) -> int:
    if name not in MATERIALS:
        fix = suggest_name(name, (*MATERIALS, DROP))
        raise UsageError(f"no material {name!r}", where="--kinds", fix=fix)
    return MATERIALS.index(name)


def parse_kinds(text: str | None) -> dict[int, str]:
    """Return what a user says about numbers of particles.

    >>> parse_kinds("3=jelly,0=drop")
    {3: 'jelly', 0: 'drop'}
    """
    kinds: dict[int, str] = {}
    for part in text.split(",") if text else ():
        number, _, name = part.strip().partition("=")
        if not re.fullmatch(r"-?[0-9]{1,9}", number):
            raise UsageError(
                "bad kinds", where="--kinds", expected="as in 3=jelly,0=drop", got=text
            )
        if name != DROP:
            _code(name)
        kinds[int(number)] = name
    return kinds


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
    # absolute frames at which the scorer reports
    frames_of_interest: tuple[int, ...] | None = None
    cells: Annotated[int, Field(gt=3)] | None = None  # cells across of the score grid
    placement: Literal["cell_centres", "nodes"] | None = None  # where its nodes lie
    # numbers of particles that are walls, no material
    wall_particle_type: tuple[int, ...] = ()


class Source(BaseModel):
    """What a metadata.json says, as far as a local split needs it."""

    model_config = ConfigDict(frozen=True)

    bounds: tuple[Pair, Pair]  # box of the source [its length]
    radius: Length = Field(alias="default_connectivity_radius")  # [its length]
    # time between frames [s]; None where none is stated
    frame_interval: Length | None = Field(alias="dt")
    # distance of neighbouring particles at first [its length]
    spacing: Length | None = Field(alias="dx")
    # along x and y
    periodic: tuple[bool, bool] = Field(alias="periodic_boundary_conditions")
    hints: Hints = Field(alias="lagbench")  # what our own exports add


def floor_of(value: float) -> float:
    """Return the largest multiple of 2^-20 below: taken off a float32 beyond it,
    nothing is lost.
    """
    return math.floor(value * 2**20) / 2**20


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
    from_walls: bool,
    free_slip: bool,
    wall: float | None = None,
) -> dict[str, object]:
    """Return the metadata of an export whose walls, where they are particles, are
    ``wall`` thick [length].
    """
    grid = size.task.score_grid
    task = size.task
    short = {"vel": "velocity", "acc": "acceleration"}
    common = {
        "bounds": [
            [low - o, high - o]
            for (low, high), o in zip(size.bounds, origin, strict=True)
        ],
        "default_connectivity_radius": task.radius,
        "dim": 2,
        **{f"{s}_mean": list(statistics[f"{name}_mean"]) for s, name in short.items()},
        # Models divide by a deviation: 0 becomes 1.
        **{
            f"{s}_std": [v or 1.0 for v in statistics[f"{name}_std"]]
            for s, name in short.items()
        },
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
        "wall_particle_type": [] if wall is None else sorted({*WALL_NUMBERS[form]}),
    }
    if form is Format.GNS_NPZ:
        shortest = min(frames for subset in shapes.values() for frames, _ in subset)
        special: dict[str, object] = {
            "sequence_length": shortest,
            "dt": size.frame_interval,
        }
    else:
        parameters = {
            name: parameter.value for name, parameter in size.parameters.items()
        }
        frames_of = {subset: rows[0][0] for subset, rows in shapes.items()}
        special = {
            "case": size.split.upper(),
            "solver": "MPM" if size.simulated else "unknown",
            "density_evolution": False,
            "dx": spacing,
            "dt": size.dt,  # of the solver
            "write_every": size.substeps_per_frame,
            "t_end": (max(frames_of.values()) - 1) * size.frame_interval,
            "viscosity": parameters.get("liquid_viscosity"),
            "p_bg_factor": 0.0,
            "g_ext_magnitude": parameters.get("gravity", 0.0),
            "artificial_alpha": 0.0,
            "free_slip": free_slip,
            "is_bc_trick": False,
            # One less than frames: the last one is a target only, as in the data sets
            # of that code base.
            **{
                f"sequence_length_{subset}": frames_of[subset] - 1
                for subset in ("train", "test")
            },
            **{
                f"num_trajs_{subset}": len(shapes[subset])
                for subset in ("train", "test")
            },
            "num_particles_max": max(n for rows in shapes.values() for _, n in rows),
            "periodic_boundary_conditions": [False, False],
        }
        # Its cell lists start at 0 and are as long as the bounds are apart: particles
        # beyond the difference would lose their neighbours.
        if wall is not None:
            special["bounds"] = [
                [0.0, h + wall - o]
                for (_, h), o in zip(size.bounds, origin, strict=True)
            ]
        elif not from_walls:
            special["bounds"] = [[0.0, 1.0], [0.0, 1.0]]
    return {**common, **special, OWN_KEY: own}


def write_metadata(folder: Path, metadata: Mapping[str, object]) -> Path:
    """Write metadata.json whole or not at all; return its path."""
    path = folder / NAME
    write_atomically(
        path, (json.dumps(metadata, indent=1) + "\n").encode(), option="--output"
    )
    return path


def read_source(folder: Path, form: Format) -> Source:
    """Return what a metadata.json says; what is missing, no JSON or incomplete is an
    UnreadableFileError.
    """
    path = folder / NAME
    where = str(path)
    try:
        with path.open("rb") as stream:
            text = stream.read(MAX_BYTES + 1)
        if len(text) > MAX_BYTES:
            raise UnreadableFileError(
                "the file is too large", where=where, expected=f"<= {MAX_BYTES} bytes"
            )
        values = json.loads(text)
    except (OSError, ValueError, RecursionError) as error:
        raise UnreadableFileError(
            "cannot read the metadata", where=where, expected="a JSON object", got=error
        ) from error
    if not isinstance(values, dict):
        raise UnreadableFileError(
            "the metadata are no JSON object", where=where, got=type(values).__name__
        )
    # Newer GNS programs keep one block for training and one for rollouts.
    block = values.get("train")
    if isinstance(block, dict):
        values = block
    else:
        values = values
    if values.get("dim", 2) != 2:
        raise UnreadableFileError(
            "the data are not plane",
            where=f"{path}, key dim",
            expected=2,
            got=repr(values["dim"]),
        )
    if form is Format.LAGRANGEBENCH_H5:
        every = values.get("write_every", 1)
    else:
        every = 1
    try:
        step = TypeAdapter(float).validate_python(values.get("dt") or 0.0)
        steps = TypeAdapter(float).validate_python(every)
        return Source.model_validate(
            {
                "bounds": values.get("bounds"),
                "default_connectivity_radius": values.get(
                    "default_connectivity_radius"
                ),
                "dt": step * steps or None,
                "dx": values.get("dx") if form is Format.LAGRANGEBENCH_H5 else None,
                "periodic_boundary_conditions": values.get(
                    "periodic_boundary_conditions"
                )
                or (False, False),
                OWN_KEY: values.get(OWN_KEY) or {},
            }
        )
    except ValidationError as error:
        first = error.errors()[0]
        raise UnreadableFileError(
            "the metadata lack what a split needs, or state it otherwise",
            where=f"{path}, key {'.'.join(map(str, first['loc'] or ('dt',)))}",
            expected=first["msg"],
            got=first["input"],
        ) from None
