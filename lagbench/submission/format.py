"""What a predictions.nc is: its names, what its headers say, and the checks on its
layout.

No data set is needed here. What is wrong is recorded, not raised; only a file that HDF5
cannot read at all raises.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py

from lagbench.data.hdf5 import MAX_LINKS, hdf5_errors, list_members
from lagbench.data.structure import (
    MAX_ATTRIBUTE,
    ArrayInfo,
    UnusableAttribute,
    describe_array,
    find_storage_issue,
    read_single_value,
)
from lagbench.errors import UnreadableFileError, UsageError, suggest_name

from .budget import Budget, budget_in
from .findings import Findings, quoted
from .provenance import TrainingProvenance

FORMAT = 1
"""Number of the file layout; stored as attribute ``lagbench_format``."""

DIMS = ("scenario", "frame", "particle", "space")
"""Dimensions of ``position``, in this order."""

SPACE = 2
"""Components of a position."""

OTHERS: Mapping[str, str] = {
    "measured": "scores.nc, which `lagbench score` writes of predictions",
    "particle_mass": "a scenario file, which `lagbench generate` writes",
}
"""Files of ours that are taken for predictions, by a variable that only they have."""

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
    "solver_seconds_per_frame": float,
    "budget": str,
    "provenance": str,
}
"""Attributes that a file may have: cost, provenance and size of the model."""

MAX_NAME = 200
"""Longest required attribute [characters]."""

MAX_COORDINATE = 20_000
"""Most entries of a coordinate that are read; ids and frame numbers have four digits.
"""

MAX_COORDINATE_CHUNK = 1 << 26
"""Largest chunk of a coordinate that is read [bytes]."""

INTEGERS = ("scenario", "frame", "diverged_at")
PACKING = ("scale_factor", "add_offset")

ATTRIBUTES: Mapping[str, Mapping[str, str]] = {
    "scenario": {"long_name": "scenario id", "units": "1"},
    "frame": {"long_name": "absolute frame number", "units": "1"},
    "position": {
        "long_name": "predicted particle position in lengths of the unit box",
        "units": "1",
    },
    "velocity": {
        "long_name": "predicted particle velocity in box lengths per second",
        "units": "s-1",
    },
    "diverged_at": {
        "long_name": "first frame of a frozen rollout, -1 where none is",
        "units": "1",
    },
}
"""Attributes of each variable, as we write them."""

_START = "start from what `lagbench template` writes, or use lagbench.submission.write"
WRITE = (
    "write it with lagbench.submission.write, or fill what `lagbench template` writes"
)
"""How to get a right file."""

_WRITE = (
    "write it with lagbench.submission.write, or with chunks (1, 1, particle, space)"
)
_SURROGATES = re.compile("[\ud800-\udfff]")  # what no UTF-8 has
_KINDS = {str: "text", int: "an integer", float: "a positive number"}


@dataclass(frozen=True, kw_only=True)
class Header:
    """What a predictions.nc says about itself."""

    split: str
    size: str
    dataset_version: str  # semantic version of the split, as in "1.0.0"
    dataset_sha256: str  # hash of the data set that the model was given, 64 hex digits
    method: str  # what made the predictions
    scenarios: tuple[int, ...]  # ids in the order in which they are stored
    frames: tuple[int, ...]  # absolute numbers of the predicted frames
    particles: int  # particles in every frame
    seconds_per_frame: float | None  # cost of one predicted frame [s]
    device: str | None  # machine that predicted
    seed: int | None  # seed of the training
    parameters: int | None  # trainable parameters of the model
    training: str | None  # what the model was trained on, in words
    # scenario id to the absolute frame from which it is frozen
    diverged_at: Mapping[int, int]
    # of our solver on one core of the same machine [s]
    solver_seconds_per_frame: float | None = None
    budget: Budget | None = None  # what the training took
    # the training that made the model; of older files read from the words
    provenance: TrainingProvenance | None = None


@dataclass(frozen=True, kw_only=True)
class Anatomy:
    """A file as its headers describe it."""

    # entry of the root group to what it is; the first MAX_LINKS of them
    links: Mapping[str, str]
    link_count: int
    # attribute of the format to its value, None where it is missing
    attributes: Mapping[str, object]
    arrays: Mapping[str, ArrayInfo]  # variables of the format that a hard link leads to
    # scale_factor and add_offset of ``position``, where it has them
    packing: Mapping[str, object]
    integers: Mapping[str, tuple[int, ...]]  # coordinates whose values could be read
    length: int  # length of the file [bytes]


def kind_of(name: str) -> str:
    """Return in words what an attribute must be.

    >>> kind_of("seed"), kind_of("parameters")
    ('an integer', 'an integer >= 0')
    """
    if name in REQUIRED:
        return f"printable text of 1 to {MAX_NAME} characters"
    if name == "budget":
        return "JSON of a training's budget"
    if name == "provenance":
        return "JSON of a training's provenance"
    return f"{_KINDS[OPTIONAL[name]]}{' >= 0' if name == 'parameters' else ''}"


def fits(name: str, value: object) -> bool:
    """Tell whether an attribute may have a value.

    >>> fits("seed", -5), fits("parameters", -5), fits("parameters", 0), fits("method", " ")
    (True, False, True, False)
    """
    if name in REQUIRED:
        if isinstance(value, str):
            text = value
        else:
            text = ""
        return bool(text.strip()) and len(text) <= MAX_NAME and text.isprintable()
    if isinstance(value, bool) or (
        isinstance(value, int) and not -(2**63) <= value < 2**64
    ):
        return False
    if isinstance(value, str) and (
        len(value) > MAX_ATTRIBUTE or _SURROGATES.search(value) or "\0" in value
    ):
        return False  # HDF5 stores UTF-8, up to the first NUL
    if OPTIONAL[name] is float:
        return isinstance(value, (int, float)) and 0 < value < math.inf
    if name == "budget":
        return isinstance(value, str) and budget_in(value) is not None
    if name == "provenance":
        return (
            isinstance(value, str) and TrainingProvenance.from_json(value) is not None
        )
    return isinstance(value, OPTIONAL[name]) and not (
        name == "parameters" and int(value) < 0
    )


def require_fit(name: str, value: object) -> None:
    """Refuse a value that an attribute may not have, before it is written."""
    if not fits(name, value):
        raise UsageError(
            f"the label {name!r} does not fit",
            expected=kind_of(name),
            got=quoted(value),
        )


def dissect(file: h5py.File, path: Path) -> Anatomy:
    """Return what a file holds; of values only coordinates are read."""
    length = path.stat().st_size
    with hdf5_errors(path):
        links, count = list_members(file["/"])
        names = ("lagbench_format", *REQUIRED, *OPTIONAL)
        attributes = {name: read_single_value(file["/"], name) for name in names}
    arrays = {}
    integers = {}
    packing = {}
    for name in ("position", *INTEGERS):
        if links.get(name) == "variable":
            with hdf5_errors(path, name):
                dataset = file[name]
                array = describe_array(dataset)
                if array.shape:
                    arrays[name] = array
                else:
                    arrays[name] = replace(array, shape=None)
                if name == "position":
                    found = {key: read_single_value(dataset, key) for key in PACKING}
                    packing = {
                        key: value for key, value in found.items() if value is not None
                    }
                elif (
                    array.shape is not None
                    and len(array.shape) == 1
                    and array.shape[0] <= MAX_COORDINATE
                    and array.chunk_bytes <= MAX_COORDINATE_CHUNK
                    and array.kind.lstrip("u").startswith("int")
                    and not find_storage_issue(array, length=length)
                ):
                    integers[name] = tuple(int(i) for i in dataset[...])
    return Anatomy(
        links=links,
        link_count=count,
        attributes=attributes,
        arrays=arrays,
        packing=packing,
        integers=integers,
        length=length,
    )


def header_of(anatomy: Anatomy) -> Header:
    """Return the header of a file whose layout has been checked."""
    scenarios = anatomy.integers["scenario"]
    marks = anatomy.integers.get("diverged_at", ())
    labels: dict[str, Any] = {name: str(anatomy.attributes[name]) for name in REQUIRED}
    for name, kind in OPTIONAL.items():
        value = anatomy.attributes[name]
        if kind is float and isinstance(value, int):
            value = float(value)
        else:
            value = value
        if isinstance(value, kind):
            labels[name] = value
        else:
            labels[name] = None
    if labels["budget"]:
        labels["budget"] = budget_in(labels["budget"])
    else:
        labels["budget"] = None
    if labels["provenance"]:
        labels["provenance"] = TrainingProvenance.from_json(labels["provenance"])
    elif labels["training"]:
        labels["provenance"] = TrainingProvenance.from_sentence(labels["training"])
    return Header(
        **labels,
        scenarios=scenarios,
        frames=anatomy.integers["frame"],
        particles=(anatomy.arrays["position"].shape or ())[2],
        diverged_at={
            i: mark for i, mark in zip(scenarios, marks, strict=False) if mark >= 0
        },
    )


def refuse_other_kinds(anatomy: Anatomy, path: Path) -> None:
    """Refuse a file of ours that holds no predictions: all that could be said of it
    would mislead.
    """
    if {"position", "scenario"} <= anatomy.links.keys():
        return
    for name, what in OTHERS.items():
        if name in anatomy.links:
            raise UnreadableFileError(
                "a file of another kind",
                where=str(path),
                expected="predictions",
                got=what,
                fix=_START,
            )


def check_format(anatomy: Anatomy, out: Findings) -> bool:
    """Check links, variables, storage and attributes; tell whether the values can be
    read.
    """
    out.made("format")
    for name, kind in anatomy.links.items():
        if kind.endswith("link"):
            out.error(
                "format",
                f"there is a {kind}, which is not followed",
                where=quoted(name),
                expected="variables that lie in this file",
                got=kind,
                fix="store the values themselves",
            )
    if anatomy.link_count > MAX_LINKS:
        most = f"at most {MAX_LINKS}"
        count = anatomy.link_count
        out.error(
            "format",
            "too many variables",
            where="/",
            expected=most,
            got=count,
            fix=_START,
        )
    known = [quoted(other) for other in anatomy.links][:10]
    for name in ("position", "scenario", "frame"):
        kind = anatomy.links.get(name, "")
        if kind != "variable" and not kind.endswith("link"):
            if kind:
                fix = _START
            else:
                fix = suggest_name(quoted(name), known)
            got = kind or ", ".join(known) or "nothing"
            what = f"no variable {name!r}"
            expected = f"a variable {name!r}"
            out.error("format", what, where="/", expected=expected, got=got, fix=fix)
    for name, array in anatomy.arrays.items():
        problem = find_storage_issue(array, length=anatomy.length)
        if problem is None and (name == "position" or name in anatomy.integers):
            continue
        what, expected, got = problem or (
            "a coordinate cannot be read",
            f"one dimension of at most {MAX_COORDINATE} integers",
            f"{array.kind}, shape {array.shape}, chunks {array.chunks}",
        )
        if problem:
            fix = _WRITE
        else:
            fix = _START
        out.error(
            "format",
            what,
            where=f"variable {name!r}",
            expected=expected,
            got=got,
            fix=fix,
        )
    readable = not out.failed("format")
    _check_attributes(anatomy, out)
    return readable


def _check_attributes(anatomy: Anatomy, out: Findings) -> None:
    for name, value in anatomy.attributes.items():
        if name == "lagbench_format":
            expected = str(FORMAT)
            right = not isinstance(value, (str, UnusableAttribute)) and value == FORMAT
        elif name in REQUIRED:
            expected = kind_of(name)
            right = fits(name, value)
        else:
            expected = f"{kind_of(name)}, or no such attribute"
            right = value is None or fits(name, value)
        if right:
            continue
        if isinstance(value, UnusableAttribute):
            got = value.reason
        else:
            got = quoted(value)
        out.error(
            "format",
            f"the attribute {name!r} "
            f"{'is missing' if value is None else 'cannot be used'}",
            where="global attributes",
            expected=expected,
            got="no such attribute" if value is None else got,
            fix=f"set it: file.{name} = ...",
        )


def check_dims(anatomy: Anatomy, out: Findings) -> bool:
    """Check names, order and lengths of the dimensions of ``position``."""
    array = anatomy.arrays.get("position")
    if array is None or array.shape is None:
        out.skip("'position' cannot be read", "dims")
        return False
    out.made("dims")
    where = "variable 'position'"
    if array.dims != DIMS:
        got = (
            ", ".join(
                quoted(name) if name else "one without a name" for name in array.dims
            )
            or "none"
        )
        expected = ", ".join(DIMS)
        fix = _START
        if sorted(array.dims) == sorted(DIMS):
            fix = "transpose it"
        elif len(array.dims) == len(DIMS) - 1:
            fix = "add the leading dimension 'scenario', also for a single scenario"
        elif not any(array.dims):
            fix = (
                "attach dimension scales, as netCDF4 and xarray do; plain h5py does not"
            )
        out.error(
            "dims",
            "the dimensions are others",
            where=where,
            expected=expected,
            got=got,
            fix=fix,
        )
        return False
    rows = {name: anatomy.integers.get(name) for name in ("scenario", "frame")}
    counted = [
        f"as many as {name!r}" if held is None else len(held)
        for name, held in rows.items()
    ]
    lengths = (*counted, array.shape[2], SPACE)
    if array.shape != lengths:
        swapped = array.shape[2] == SPACE and array.shape[3] > SPACE
        if swapped:
            fix = "particle and space seem to be swapped: transpose them"
        else:
            fix = _START
        out.error(
            "dims",
            "the lengths do not fit",
            where=where,
            expected=lengths,
            got=array.shape,
            fix=fix,
        )
        return False
    return True


def check_dtype(anatomy: Anatomy, out: Findings) -> bool:
    """Check that positions are float32 and not packed as scaled numbers."""
    array = anatomy.arrays.get("position")
    if array is None:
        out.skip("there is no variable 'position'", "dtype")
        return False
    out.made("dtype")
    where = "variable 'position'"
    if array.kind != "float32":
        fix = "store positions as float32: positions.astype('float32')"
        out.error(
            "dtype",
            "the type is another",
            where=where,
            expected="float32",
            got=array.kind,
            fix=fix,
        )
    if anatomy.packing:
        said = {
            n: v.reason if isinstance(v, UnusableAttribute) else quoted(v)
            for n, v in anatomy.packing.items()
        }
        out.error(
            "dtype",
            "the values are packed, and are not unpacked here",
            where=where,
            expected="no scale_factor and no add_offset",
            got=", ".join(f"{name} = {text}" for name, text in said.items()),
            fix="store the positions themselves as float32",
        )
    return not out.failed("dtype")


def check_marks(anatomy: Anatomy, out: Findings) -> None:
    """Check that ``diverged_at``, where it is there, has a predicted frame or -1 per
    scenario.
    """
    array = anatomy.arrays.get("diverged_at")
    marks = anatomy.integers.get("diverged_at")
    frames = anatomy.integers.get("frame")
    if array is not None and (marks is None or frames is None):
        out.skip("'diverged_at' or 'frame' cannot be read", "diverged_at")
        return
    out.made("diverged_at")
    if array is None or marks is None or frames is None:
        return
    where = "variable 'diverged_at'"
    if array.dims != ("scenario",) or len(marks) != len(
        anatomy.integers.get("scenario", ())
    ):
        out.error(
            "diverged_at",
            "it is not told per scenario",
            where=where,
            expected="one value per scenario, on the dimension 'scenario'",
            got=f"{len(marks)} on "
            f"{quoted(array.dims[0]) if any(array.dims) else 'one without a name'}",
            fix="store it beside 'scenario', or leave it out",
        )
    wrong = sorted(set(marks) - {NEVER, *frames})
    if wrong:
        out.error(
            "diverged_at",
            "a rollout is frozen at no predicted frame",
            where=where,
            expected=f"absolute numbers of predicted frames, {NEVER} for a rollout "
            f"that did not diverge",
            got=", ".join(map(str, wrong[:5])),
            fix=f"name the first frozen frame, or {NEVER}",
        )
