"""What both formats say beside positions: metadata.json, and kinds of particles.

Programs of other code bases pass over keys of metadata.json that they do not know. Ours
stand together under ``lagbench``, so that an export comes back with its task and its
place in the box.

Both formats mark each particle with a number below 9, which their models embed. Only a
few numbers mean something to the programs: particles that move as prescribed, and
padding. Our materials get numbers without such a meaning, one each, so that nothing is
lost. On the way back the user must say what a number without a material stands for, or
leave its particles out.
"""

from __future__ import annotations

import enum
import itertools
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
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
from lagbench.data.box import AXES
from lagbench.data.field_errors import describe_expectation, describe_input
from lagbench.data.registry import Size
from lagbench.errors import (
    UnreadableFileError,
    UsageError,
    check_regular,
    suggest_name,
)

FORCE = "force.py"
"""Name of the program beside the data that LagrangeBench would run."""

NAME = "metadata.json"
OWN_KEY = "lagbench"
MAX_BYTES = 1 << 20

Pair = tuple[FiniteFloat, FiniteFloat]
Length = Annotated[float, Field(gt=0, allow_inf_nan=False)]

Shapes = Mapping[str, Sequence[tuple[int, int]]]
"""Frames and particles of every trajectory, by subset."""


class Format(enum.StrEnum):
    """A format that other code bases read."""

    GNS_NPZ = "gns-npz"
    LAGRANGEBENCH_H5 = "lagrangebench-h5"


ENDINGS = {
    Format.GNS_NPZ: ".npz",
    Format.LAGRANGEBENCH_H5: ".h5",
}
"""Endings of the files of subsets."""

NUMBERS: Mapping[Format, Mapping[str, int]] = {
    Format.GNS_NPZ: {"liquid": 5, "snow": 6, "jelly": 7, "rope": 8},
    Format.LAGRANGEBENCH_H5: {"liquid": 0, "jelly": 4, "snow": 5, "rope": 6},
}
"""Number of each material."""

WALL_NUMBERS: Mapping[Format, tuple[int, int]] = {
    Format.GNS_NPZ: (3, 3),
    Format.LAGRANGEBENCH_H5: (1, 2),
}
"""Numbers of particles of a wall at rest, and of one that moves."""

MEANINGS: Mapping[Format, Mapping[int, str]] = {
    Format.GNS_NPZ: {0: "rigid", 3: "kinematic: a boundary that moves as prescribed"},
    Format.LAGRANGEBENCH_H5: {1: "solid wall", 2: "moving wall", 3: "rigid body"},
}
"""What numbers without a material mean."""

PADDING = -1
"""Number of particles that are not there, as LagrangeBench writes it."""

DROP = "drop"
"""Stands for the material of particles that are left out."""

DROPPED_CODE = -1

SHORT_NAMES = {"vel": "velocity", "acc": "acceleration"}
"""Prefixes of statistics in metadata.json, and ours."""


def parse_format(name: str) -> Format:
    """Return a format by name; of an unknown one the UsageError names the nearest."""
    names = [form.value for form in Format]
    if name not in names:
        raise UsageError(
            f"no format {name!r}",
            where="--format",
            expected=", ".join(names),
            got=ascii(name),
            fix=suggest_name(name, names),
        )
    return Format(name)


def material_numbers(form: Format, material: NDArray[np.integer]) -> NDArray[np.int64]:
    """Return the number of each particle's material, shape [particle]."""
    numbers = np.array([NUMBERS[form][name] for name in MATERIALS], dtype=np.int64)
    return numbers.take(material)


def find_materials(
    form: Format,
    numbers: NDArray[Any],
    particle_count: int,
    *,
    user_kinds: Mapping[int, str],
    where: str,
) -> tuple[NDArray[np.int8], NDArray[np.bool_]]:
    """Return the material of each particle that is kept, and a mask over all.

    Args:
        form: the format.
        numbers: the number of each particle; gns-npz may have one for all.
        particle_count: particles of the trajectory.
        user_kinds: number to material, or to "drop", as the user says.
        where: the trajectory, for messages.

    Raises:
        UnreadableFileError: no integers, numbers without a material, or no particle is
            left.
        UsageError: a kind of the user names no material.
    """
    _check_kinds(form, numbers, particle_count, where=where)
    numbers = np.broadcast_to(numbers, (particle_count,))
    name_of = {PADDING: DROP}
    for name, number in NUMBERS[form].items():
        name_of[number] = name
    name_of.update(user_kinds)
    code_of = {}
    for number, name in name_of.items():
        code_of[number] = _material_code(name)

    stored_numbers = np.unique(numbers).tolist()
    unknown_numbers = []
    for number in stored_numbers:
        if number not in code_of:
            unknown_numbers.append(number)
    if unknown_numbers:
        meanings = MEANINGS[form]
        meanings_in_file = [
            f"{number} ({name})" for number, name in sorted(name_of.items())
        ]
        unknown = []
        for n in unknown_numbers:
            unknown.append(f"{n} ({meanings.get(n, 'unknown')})")
        first = unknown_numbers[0]
        raise UnreadableFileError(
            "no material is known for a kind of particle",
            where=where,
            expected=", ".join(meanings_in_file),
            got=", ".join(unknown),
            fix=f"state their material: --kinds {first}=jelly, or leave them "
            f"out: {first}=drop",
        )

    material = np.empty(numbers.shape, dtype=np.int8)
    for number in stored_numbers:
        material[numbers == number] = code_of[number]
    is_kept = material != DROPPED_CODE
    if not is_kept.any():
        raise UnreadableFileError(
            "every particle is padding or left out",
            where=where,
            expected="particles of a kind that is kept",
            got=f"kinds {', '.join(map(str, stored_numbers[:10]))}",
            fix="say which are kept: --kinds, as in 3=jelly,0=drop",
        )
    return material[is_kept], is_kept


def _check_kinds(
    form: Format, numbers: NDArray[Any], particle_count: int, *, where: str
) -> None:
    """Refuse kinds that are not one integer per particle.

    Files of gns-npz may have one for all particles.
    """
    shapes: list[tuple[int, ...]] = [(particle_count,)]
    expected = f"{particle_count} integers"
    if form is Format.GNS_NPZ:
        shapes += [(), (1,)]
        expected = f"an integer, or {particle_count} of them"
    if numbers.dtype.kind not in "iu" or numbers.shape not in shapes:
        raise UnreadableFileError(
            "these are no kinds of particles",
            where=where,
            expected=expected,
            got=f"{numbers.dtype} of shape {numbers.shape}",
            fix="save one integer for each particle",
        )


def _material_code(name: str) -> int:
    if name == DROP:
        return DROPPED_CODE
    if name not in MATERIALS:
        raise UsageError(
            f"no material {name!r}",
            where="--kinds",
            expected="the name of a material, or drop",
            got=ascii(name),
            fix=suggest_name(name, (*MATERIALS, DROP)),
        )
    return MATERIALS.index(name)


def parse_kinds(text: str | None) -> dict[int, str]:
    """Return the material, or "drop", of each kind number, as ``--kinds`` has them.

    >>> parse_kinds("3=jelly,0=drop")
    {3: 'jelly', 0: 'drop'}

    Raises:
        UsageError: the text has another form, or a number is given twice.
    """
    kinds: dict[int, str] = {}
    if not text:
        return kinds
    for part in text.split(","):
        number, _, name = part.strip().partition("=")
        if not re.fullmatch(r"-?[0-9]{1,9}", number):
            raise UsageError(
                "bad kinds",
                where="--kinds",
                expected="as in 3=jelly,0=drop",
                got=text,
                fix="write NUMBER=MATERIAL with commas in between",
            )
        _material_code(name)  # refuses unknown names
        kind = int(number)
        if kind in kinds:
            raise UsageError(
                f"kind {kind} is given twice",
                where="--kinds",
                expected="each number once",
                got=f"{kind}={kinds[kind]} and {kind}={name}",
                fix="leave one of the two out",
            )
        kinds[kind] = name
    return kinds


class LagbenchKeys(BaseModel):
    """What our own exports add: where the box lies and what the task is."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    # what was taken off every position [length], for each axis that there is
    origin: tuple[FiniteFloat, ...] = (0.0, 0.0, 0.0)
    # walls before that [length]
    bounds: tuple[Pair, ...] | None = Field(None, min_length=2, max_length=3)
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


class SourceMetadata(BaseModel):
    """What a metadata.json says, as far as a local split needs it."""

    model_config = ConfigDict(frozen=True)

    # box of the source [its length]
    bounds: tuple[Pair, ...] = Field(min_length=2, max_length=3)
    radius: Length = Field(alias="default_connectivity_radius")  # [its length]
    # time between frames [s]; None where none is stated
    frame_interval: Length | None = Field(alias="dt")
    # distance of neighbouring particles at first [its length]
    spacing: Length | None = Field(alias="dx")
    # along each axis; what is said of further axes means nothing
    periodic: tuple[bool, ...] = Field(alias="periodic_boundary_conditions")
    lagbench: LagbenchKeys  # what our own exports add

    @property
    def periodic_axes(self) -> tuple[str, ...]:
        """Names of the periodic axes."""
        axes = AXES[: len(self.bounds)]
        return tuple(itertools.compress(axes, self.periodic))


def round_down(value: float) -> float:
    """Return the largest multiple of 2^-20 that is not above a value.

    If it is not negative, taking it off a float32 above it and below 16 loses no bit.
    """
    return math.floor(value * 2**20) / 2**20


@dataclass(frozen=True, kw_only=True)
class ExportInfo:
    """What metadata.json says of an export beside its registry entry."""

    title: str  # title of the split
    dataset_sha256: str  # hash of the data set
    statistics: Mapping[str, tuple[float, ...]]  # over train
    spacing: float  # distance of neighbouring particles at first [length]
    origin: tuple[float, ...]  # what was taken off every position [length]
    from_walls: bool  # whether the bounds are the walls
    is_free_slip: bool  # whether liquid slides along the walls
    # layers of wall particles are so thick [length]; None without them
    wall_thickness: float | None


def describe_export(
    size: Size, form: Format, shapes: Shapes, info: ExportInfo
) -> dict[str, object]:
    """Return the metadata of an export; the format's keys replace common ones."""
    metadata = _common_metadata(size, info)
    if form is Format.GNS_NPZ:
        metadata |= _gns_metadata(size, shapes)
    else:
        metadata |= _lagrangebench_metadata(size, shapes, info)
    metadata[OWN_KEY] = _lagbench_keys(size, form, info)
    return metadata


def _common_metadata(size: Size, info: ExportInfo) -> dict[str, object]:
    bounds = []
    for (low, high), origin in zip(size.bounds, info.origin, strict=True):
        bounds.append([low - origin, high - origin])
    metadata: dict[str, object] = {
        "bounds": bounds,
        "default_connectivity_radius": size.task.radius,
        "dim": size.dimension,
    }
    for prefix, name in SHORT_NAMES.items():
        metadata[f"{prefix}_mean"] = list(info.statistics[f"{name}_mean"])
    for prefix, name in SHORT_NAMES.items():
        # Models divide by a deviation: 0 becomes 1.
        deviations = info.statistics[f"{name}_std"]
        metadata[f"{prefix}_std"] = [deviation or 1.0 for deviation in deviations]
    return metadata


def _gns_metadata(size: Size, shapes: Shapes) -> dict[str, object]:
    frame_counts = []
    for subset_shapes in shapes.values():
        for frame_count, _ in subset_shapes:
            frame_counts.append(frame_count)
    metadata: dict[str, object] = {
        "sequence_length": min(frame_counts),
        "dt": size.frame_interval,
    }
    if size.box.is_periodic:
        # The format has no such key; other programs ignore it.
        metadata["periodic_boundary_conditions"] = list(size.box.periodic)
    return metadata


def _lagrangebench_metadata(
    size: Size, shapes: Shapes, info: ExportInfo
) -> dict[str, object]:
    viscosity = size.parameters.get("liquid_viscosity")
    gravity = size.parameters.get("gravity")
    frame_counts = {}
    most_particles = 0
    for subset, subset_shapes in shapes.items():
        frame_counts[subset] = subset_shapes[0][0]
        for _, particle_count in subset_shapes:
            most_particles = max(most_particles, particle_count)

    metadata: dict[str, object] = {
        "case": size.split.upper(),
        "solver": "MPM" if size.simulated else "unknown",
        "density_evolution": False,
        "dx": info.spacing,
        "dt": size.dt,  # of the solver
        "write_every": size.substeps_per_frame,
        "t_end": (max(frame_counts.values()) - 1) * size.frame_interval,
        "viscosity": None if viscosity is None else viscosity.value,
        "p_bg_factor": 0.0,
        "g_ext_magnitude": 0.0 if gravity is None else gravity.value,
        "artificial_alpha": 0.0,
        "free_slip": info.is_free_slip,
        "is_bc_trick": False,
    }
    # One less than frames: the last one is a target only, as in the data sets of that
    # code base.
    for subset in ("train", "test"):
        metadata[f"sequence_length_{subset}"] = frame_counts[subset] - 1
    for subset in ("train", "test"):
        metadata[f"num_trajs_{subset}"] = len(shapes[subset])
    metadata["num_particles_max"] = most_particles
    metadata["periodic_boundary_conditions"] = list(size.box.periodic)

    # Its cell lists start at 0 and are as long as the bounds are apart: particles
    # beyond the difference would lose their neighbours.
    if info.wall_thickness is not None:
        bounds = []
        for (_, high), origin in zip(size.bounds, info.origin, strict=True):
            bounds.append([0.0, high + info.wall_thickness - origin])
        metadata["bounds"] = bounds
    elif not info.from_walls:
        bounds = []
        for side, is_periodic in zip(size.bounds, size.box.periodic, strict=True):
            # A period is as long as the box, room between walls may be longer.
            bounds.append(list(side) if is_periodic else [0.0, 1.0])
        metadata["bounds"] = bounds
    return metadata


def _lagbench_keys(size: Size, form: Format, info: ExportInfo) -> dict[str, object]:
    task = size.task
    wall_numbers: list[int] = []
    if info.wall_thickness is not None:
        wall_numbers = sorted(set(WALL_NUMBERS[form]))
    return {
        "split": size.split,
        "size": size.name,
        "version": size.version,
        "title": info.title,
        "dataset_sha256": info.dataset_sha256,
        "particle_type": {name: NUMBERS[form][name] for name in MATERIALS},
        "origin": list(info.origin),
        "bounds": [list(side) for side in size.bounds],
        "spacing": info.spacing,
        "density": size.value("density"),
        "input_frames": task.input_frames,
        "horizon": task.horizon,
        "frames_of_interest": list(task.frames_of_interest),
        "cells": task.score_grid.cells,
        "placement": task.score_grid.placement,
        "wall_particle_type": wall_numbers,
    }


def write_metadata(folder: Path, metadata: Mapping[str, object]) -> Path:
    """Write metadata.json whole or not at all; return its path."""
    path = folder / NAME
    text = json.dumps(metadata, indent=1) + "\n"
    write_atomically(path, text.encode(), option="--output")
    return path


def read_metadata(folder: Path, form: Format) -> SourceMetadata:
    """Return what a metadata.json says.

    Raises:
        UnreadableFileError: it is missing, no JSON, or lacks what a split needs.
    """
    path = folder / NAME
    values = _read_json(path)
    # Newer GNS programs keep one block for training and one for rollouts.
    block = values.get("train")
    if isinstance(block, dict):
        values = block
    bounds = values.get("bounds")
    dimension = values.get("dim", 2)
    if isinstance(bounds, list) and dimension != len(bounds):
        raise UnreadableFileError(
            "the dimension is not that of the bounds",
            where=f"{path}, key dim",
            expected=len(bounds),
            got=repr(dimension),
            fix="correct dim, or give a pair of bounds for each axis",
        )
    spacing = None
    substeps = 1
    if form is Format.LAGRANGEBENCH_H5:
        spacing = values.get("dx")
        substeps = values.get("write_every", 1)
    numbers = TypeAdapter(float)
    try:
        step = numbers.validate_python(values.get("dt") or 0.0)
        frame_interval = step * numbers.validate_python(substeps)
        return SourceMetadata.model_validate(
            {
                "bounds": bounds,
                "default_connectivity_radius": values.get(
                    "default_connectivity_radius"
                ),
                "dt": frame_interval or None,
                "dx": spacing,
                "periodic_boundary_conditions": values.get(
                    "periodic_boundary_conditions"
                )
                or (),
                OWN_KEY: values.get(OWN_KEY) or {},
            }
        )
    except ValidationError as error:
        first = error.errors()[0]
    key = ".".join(map(str, first["loc"] or ("dt",)))
    raise UnreadableFileError(
        "the metadata lack what a split needs, or state it otherwise",
        where=f"{path}, key {key}",
        expected=describe_expectation(first),
        got=describe_input(first),
        fix="correct the key in the metadata",
    )


def _read_json(path: Path) -> dict[str, Any]:
    """Return the JSON object of a file of at most MAX_BYTES."""
    where = str(path)
    check_regular(path, longest=MAX_BYTES, fix="the metadata lie beside train")
    try:
        values = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError) as error:
        raise UnreadableFileError(
            "cannot read the metadata",
            where=where,
            expected="a JSON object",
            got=error,
            fix="fetch the file again, or correct it",
        ) from error
    if not isinstance(values, dict):
        raise UnreadableFileError(
            "the metadata are no JSON object",
            where=where,
            expected="an object, {...}",
            got=type(values).__name__,
            fix="fetch the file again, or correct it",
        )
    return values
