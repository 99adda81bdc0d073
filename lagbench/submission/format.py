"""The layout of a predictions.nc: its names, its headers, and the checks on them.

No data set is needed here. What is wrong is collected, not raised; only a file that
HDF5 cannot read at all raises.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import h5py

from lagbench.data.box import AXES
from lagbench.data.hdf5 import (
    MAX_LINKS,
    hdf5_errors,
    is_text,
    list_members,
    open_variable,
)
from lagbench.data.structure import (
    MAX_ATTRIBUTE,
    ArrayInfo,
    UnusableAttribute,
    describe_array,
    find_storage_issue,
    read_single_value,
)
from lagbench.errors import UnreadableFileError, UsageError, suggest_name

from .budget import Budget, parse_budget
from .issues import IssueCollector, quote
from .provenance import TrainingProvenance

FORMAT = 1
"""Number of the file layout; stored as attribute ``lagbench_format``."""

DIMS = ("scenario", "frame", "particle", "space")
"""Dimensions of ``position``, in this order."""

SPACES = (2, 3)
"""Numbers of components that a position may have."""

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
    "subset": str,
}
"""Attributes that a file may have: cost, provenance and size of the model, and the
subset, which is ``test`` where none is named.
"""

MAX_NAME = 200
"""Longest required attribute [characters]."""

MAX_COORDINATE = 20_000
"""Most entries of a coordinate that are read; ids and frame numbers have four digits.
"""

MAX_COORDINATE_CHUNK = 1 << 26
"""Largest chunk of a coordinate that is read [bytes]."""

INTEGERS = ("scenario", "frame", "diverged_at", "particle_count")
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
    "particle_count": {
        "long_name": "particles of the scenario; entries behind them are padding",
        "units": "1",
    },
}
"""Attributes of each variable, as we write them."""

USE_TEMPLATE = (
    "start from what `lagbench template` writes, or use lagbench.submission.write"
)
WRITE = (
    "write it with lagbench.submission.write, or fill what `lagbench template` writes"
)
"""How to get a right file."""

WRITE_IN_CHUNKS = (
    "write it with lagbench.submission.write, or with chunks (1, 1, particle, space)"
)

SURROGATES = re.compile("[\ud800-\udfff]")
"""Characters that no UTF-8 has."""

KINDS = {
    str: f"text of at most {MAX_ATTRIBUTE} characters, without NUL and surrogates",
    int: "an integer of 64 bits",
    float: "a positive number",
}
"""Types of optional attributes in words."""


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
    particles: int  # particles in every frame; the most of any scenario
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
    # the training that made the model
    provenance: TrainingProvenance | None = None
    # scenario id to its number of particles; empty where all have as many
    particle_counts: Mapping[int, int] = field(default_factory=dict)
    space: int = 2  # components of a position
    subset: str = "test"  # subset whose scenarios are predicted

    def particle_count(self, scenario: int) -> int:
        """Return how many particles a scenario has."""
        return self.particle_counts.get(scenario, self.particles)


@dataclass(frozen=True, kw_only=True)
class FileInfo:
    """What the headers of a file say."""

    # entry of the root group to what it is; the first MAX_LINKS of them
    links: Mapping[str, str]
    link_count: int
    # attribute of the format to its value, None where it is missing
    attributes: Mapping[str, object]
    arrays: Mapping[str, ArrayInfo]  # variables of the format that a hard link leads to
    # scale_factor and add_offset of ``position``, where it has them
    packing: Mapping[str, object]
    integers: Mapping[str, tuple[int, ...]]  # coordinates whose values could be read
    components: tuple[str, ...]  # names of the components of a position, if any
    length: int  # length of the file [bytes]


def describe_kind(name: str) -> str:
    """Return in words what an attribute must be.

    >>> describe_kind("seed"), describe_kind("parameters")
    ('an integer of 64 bits', 'an integer of 64 bits >= 0')
    """
    if name in REQUIRED:
        return f"printable text of 1 to {MAX_NAME} characters"
    if name == "budget":
        return "JSON of a training's budget"
    if name == "provenance":
        return "JSON of a training's provenance"
    kind = KINDS[OPTIONAL[name]]
    if name == "parameters":
        return f"{kind} >= 0"
    return kind


def is_attribute_valid(name: str, value: object) -> bool:
    """Return whether an attribute may have a value.

    >>> is_attribute_valid("seed", -5), is_attribute_valid("parameters", -5)
    (True, False)
    >>> is_attribute_valid("parameters", 0), is_attribute_valid("method", " ")
    (True, False)
    """
    if name in REQUIRED:
        return isinstance(value, str) and is_name_valid(value)
    if isinstance(value, bool):
        return False
    if isinstance(value, str):
        return OPTIONAL[name] is str and is_text_valid(name, value)
    if isinstance(value, int):
        return is_integer_valid(name, value)
    if isinstance(value, float):
        return OPTIONAL[name] is float and 0 < value < math.inf
    return False


def is_name_valid(text: str) -> bool:
    """Return whether a text can be a required attribute."""
    return bool(text.strip()) and len(text) <= MAX_NAME and text.isprintable()


def require_name(text: str) -> str:
    """Return a text that can be a required attribute; terminals may show it as it is.

    Raises:
        ValueError: it is empty, too long or not printable.
    """
    if not is_name_valid(text):
        raise ValueError(f"not {describe_kind('method')}")
    return text


def is_text_valid(name: str, text: str) -> bool:
    """Return whether a text can be an optional attribute.

    HDF5 stores UTF-8, up to the first NUL.
    """
    if len(text) > MAX_ATTRIBUTE or SURROGATES.search(text) or "\0" in text:
        return False
    if name == "budget":
        return parse_budget(text) is not None
    if name == "provenance":
        return TrainingProvenance.from_json(text) is not None
    return True


def is_integer_valid(name: str, value: int) -> bool:
    """Return whether an integer can be an optional attribute."""
    if not -(2**63) <= value < 2**64:
        return False
    if OPTIONAL[name] is float:
        return value > 0
    if name == "parameters":
        return value >= 0
    return OPTIONAL[name] is int


def require_valid_attribute(name: str, value: object) -> None:
    """Refuse a value that an attribute may not have, before it is written.

    Raises:
        UsageError: it is such a value.
    """
    if not is_attribute_valid(name, value):
        raise UsageError(
            f"the label {name!r} does not fit",
            where=f"label {name!r}",
            expected=describe_kind(name),
            got=quote(value),
            fix="docs/predictions.md describes the labels; leave out a label that you "
            "do not know",
        )


def inspect_file(file: h5py.File, path: Path) -> FileInfo:
    """Return what a file holds; of values only coordinates are read."""
    length = path.stat().st_size
    with hdf5_errors(path):
        root = file["/"]
        links, link_count = list_members(root)
        attributes = {}
        for name in ("lagbench_format", *REQUIRED, *OPTIONAL):
            attributes[name] = read_single_value(root, name)

    arrays = {}
    integers = {}
    packing = {}
    for name in ("position", "particle", *INTEGERS):
        if links.get(name) != "variable":
            continue
        with hdf5_errors(path, name):
            dataset = open_variable(file, name)
            array = describe_array(dataset)
            if name == "particle":  # without values netCDF keeps a float in its place
                if is_coordinate_readable(array, length=length):
                    integers[name] = tuple(int(value) for value in dataset[...])
                continue
            # A scalar has no dimensions to check.
            arrays[name] = array if array.shape else replace(array, shape=None)
            if name == "position":
                packing = read_packing(dataset)
            elif is_coordinate_readable(array, length=length):
                integers[name] = tuple(int(value) for value in dataset[...])
    components: tuple[str, ...] = ()
    if links.get("space") == "variable":
        with hdf5_errors(path, "space"):
            space = open_variable(file, "space")
            if is_text(space) and space.shape in [(count,) for count in SPACES]:
                components = tuple(str(name) for name in space.asstr()[...])
    return FileInfo(
        links=links,
        link_count=link_count,
        attributes=attributes,
        arrays=arrays,
        packing=packing,
        integers=integers,
        components=components,
        length=length,
    )


def read_packing(dataset: h5py.Dataset) -> dict[str, object]:
    """Return the attributes of a variable by which its values would be unpacked."""
    attributes = {name: read_single_value(dataset, name) for name in PACKING}
    return {name: value for name, value in attributes.items() if value is not None}


def is_coordinate_readable(array: ArrayInfo, *, length: int) -> bool:
    """Return whether an array is a list of integers that is safe to read.

    ``length`` is that of the file [bytes].
    """
    return (
        array.shape is not None
        and len(array.shape) == 1
        and array.shape[0] <= MAX_COORDINATE
        and array.chunk_bytes <= MAX_COORDINATE_CHUNK
        and array.kind.lstrip("u").startswith("int")
        and not find_storage_issue(array, length=length)
    )


def header_of(info: FileInfo) -> Header:
    """Return the header of a file whose layout has been checked."""
    labels: dict[str, Any] = {name: str(info.attributes[name]) for name in REQUIRED}
    for name, kind in OPTIONAL.items():
        value = info.attributes[name]
        if kind is float and isinstance(value, int):
            value = float(value)
        labels[name] = value if isinstance(value, kind) else None
    labels["subset"] = labels["subset"] or "test"
    if labels["budget"] is not None:
        labels["budget"] = parse_budget(labels["budget"])
    if labels["provenance"]:
        labels["provenance"] = TrainingProvenance.from_json(labels["provenance"])

    scenarios = info.integers["scenario"]
    frozen_from = info.integers.get("diverged_at", ())
    diverged_at = {}
    for scenario, frame in zip(scenarios, frozen_from, strict=False):
        if frame >= 0:
            diverged_at[scenario] = frame
    counts = info.integers.get("particle_count", ())
    particle_counts = dict(zip(scenarios, counts, strict=False))
    position_shape = info.arrays["position"].shape or ()
    return Header(
        **labels,
        scenarios=scenarios,
        frames=info.integers["frame"],
        particles=position_shape[2],
        particle_counts=particle_counts,
        space=position_shape[3],
        diverged_at=diverged_at,
    )


def refuse_other_kinds(info: FileInfo, path: Path) -> None:
    """Refuse a file of ours that holds no predictions.

    All other checks would mislead.

    Raises:
        UnreadableFileError: it is a score file or a scenario file.
    """
    if {"position", "scenario"} <= info.links.keys():
        return
    for name, kind in OTHERS.items():
        if name in info.links:
            raise UnreadableFileError(
                "a file of another kind",
                where=str(path),
                expected="predictions",
                got=kind,
                fix=USE_TEMPLATE,
            )


def check_format(info: FileInfo, issues: IssueCollector) -> bool:
    """Check links, variables, storage and attributes.

    Returns whether the values can be read.
    """
    issues.complete("format")
    _check_links(info, issues)
    _check_variables(info, issues)
    _check_storage(info, issues)
    is_readable = not issues.first_failed("format")
    _check_attributes(info, issues)
    return is_readable


def _check_links(info: FileInfo, issues: IssueCollector) -> None:
    for name, kind in info.links.items():
        if kind.endswith("link"):
            issues.error(
                "format",
                f"there is a {kind}, which is not followed",
                where=quote(name),
                expected="variables that lie in this file",
                got=kind,
                fix="store the values themselves",
            )
    if info.link_count > MAX_LINKS:
        issues.error(
            "format",
            "too many variables",
            where="/",
            expected=f"at most {MAX_LINKS}",
            got=info.link_count,
            fix=USE_TEMPLATE,
        )


def _check_variables(info: FileInfo, issues: IssueCollector) -> None:
    stored_names = [quote(name) for name in info.links][:10]
    for name in ("position", "scenario", "frame"):
        kind = info.links.get(name, "")
        if kind == "variable" or kind.endswith("link"):
            continue
        if kind or not stored_names:
            fix = USE_TEMPLATE
        else:
            known_names = [quote(stored)[1:-1] for stored in info.links]
            fix = suggest_name(name, known_names)
        issues.error(
            "format",
            f"no variable {name!r}",
            where="/",
            expected=f"a variable {name!r}",
            got=kind or ", ".join(stored_names) or "nothing",
            fix=fix,
        )


def _check_storage(info: FileInfo, issues: IssueCollector) -> None:
    for name, array in info.arrays.items():
        where = f"variable {name!r}"
        problem = find_storage_issue(array, length=info.length)
        if problem is not None:
            issues.error(
                "format",
                problem.what,
                where=where,
                expected=problem.expected,
                got=problem.got,
                fix=WRITE_IN_CHUNKS,
            )
        elif name != "position" and name not in info.integers:
            issues.error(
                "format",
                "a coordinate cannot be read",
                where=where,
                expected=f"one dimension of at most {MAX_COORDINATE} integers",
                got=f"{array.kind}, shape {array.shape}, chunks {array.chunks}",
                fix=USE_TEMPLATE,
            )


def _check_attributes(info: FileInfo, issues: IssueCollector) -> None:
    for name, value in info.attributes.items():
        if name == "lagbench_format":
            expected = str(FORMAT)
            is_right = (
                not isinstance(value, (str, UnusableAttribute)) and value == FORMAT
            )
        elif name in REQUIRED:
            expected = describe_kind(name)
            is_right = is_attribute_valid(name, value)
        else:
            expected = f"{describe_kind(name)}, or no such attribute"
            is_right = value is None or is_attribute_valid(name, value)
        if is_right:
            continue

        what = f"the attribute {name!r} cannot be used"
        got = describe_value(value)
        if value is None:
            what = f"the attribute {name!r} is missing"
            got = "no such attribute"
        issues.error(
            "format",
            what,
            where="global attributes",
            expected=expected,
            got=got,
            fix=f"set it: file.{name} = ...",
        )


def describe_value(value: object) -> str:
    """Return the value of an attribute for a message, or why it has none."""
    if isinstance(value, UnusableAttribute):
        return value.reason
    return quote(value)


def check_dims(
    info: FileInfo, issues: IssueCollector, *, dimension: int | None = None
) -> bool:
    """Check names, order and lengths of the dimensions of ``position``.

    The box has ``dimension`` axes; 2 or 3 where it is not known.
    """
    array = info.arrays.get("position")
    if array is None or array.shape is None:
        issues.skip("'position' cannot be read", "dims")
        return False
    issues.complete("dims")
    where = "variable 'position'"
    if array.dims != DIMS:
        names = []
        for name in array.dims:
            names.append(quote(name) if name else "one without a name")
        issues.error(
            "dims",
            "the dimensions are others",
            where=where,
            expected=", ".join(DIMS),
            got=", ".join(names) or "none",
            fix=_hint_for_dims(array.dims),
        )
        return False

    if dimension is None:
        dimension = array.shape[3] if array.shape[3] in SPACES else SPACES[0]
    lengths = (
        _length_of("scenario", info),
        _length_of("frame", info),
        array.shape[2],
        dimension,
    )
    if array.shape != lengths:
        fix = USE_TEMPLATE
        if array.shape[2] == dimension and array.shape[3] > dimension:
            fix = "particle and space seem to be swapped: transpose them"
        issues.error(
            "dims",
            "the lengths do not fit",
            where=where,
            expected=lengths,
            got=array.shape,
            fix=fix,
        )
        return False
    particles = info.integers.get("particle", ())
    if info.components not in ((), AXES[:dimension]):
        fault = f"components are named {', '.join(map(quote, info.components))}"
    elif list(particles) != list(range(len(particles))):
        fault = "the coordinate particle is not 0, 1, 2 and so on"
    else:
        return _check_particle_counts(info, array.shape, issues)
    issues.error(
        "dims",
        "components or particles stand in another order",
        where=where,
        expected=f"{', '.join(AXES[:dimension])}, and particles 0, 1, 2 and so on",
        got=fault,
        fix="store components x, y, z and particles in the order of the given frames",
    )
    return False


def _check_particle_counts(
    info: FileInfo, shape: tuple[int, ...], issues: IssueCollector
) -> bool:
    """Check that ``particle_count``, if any, fits into ``position``, shape given."""
    array = info.arrays.get("particle_count")
    if array is None:
        return True
    counts = info.integers.get("particle_count", ())
    is_per_scenario = array.dims == ("scenario",) and len(counts) == shape[0]
    if is_per_scenario and all(1 <= count <= shape[2] for count in counts):
        return True
    issues.error(
        "dims",
        "the numbers of particles do not fit",
        where="variable 'particle_count'",
        expected=f"one number from 1 to {shape[2]} per scenario, on the dimension "
        f"'scenario'",
        got=f"{list(counts[:5])} on {', '.join(map(quote, array.dims)) or 'none'}",
        fix="leave it out where all scenarios have as many particles",
    )
    return False


def _hint_for_dims(dims: tuple[str, ...]) -> str:
    if sorted(dims) == sorted(DIMS):
        return "transpose it"
    if not any(dims):
        return "attach dimension scales, as netCDF4 and xarray do; plain h5py does not"
    missing = [name for name in DIMS if name not in dims]
    if len(dims) != len(DIMS) - 1 or len(missing) != 1:
        return USE_TEMPLATE
    if missing == ["scenario"]:
        return "add the leading dimension 'scenario', also for a single scenario"
    return f"add the dimension {missing[0]!r}; the order is {', '.join(DIMS)}"


def _length_of(name: str, info: FileInfo) -> int | str:
    """Return the length of a coordinate, in words where it could not be read."""
    values = info.integers.get(name)
    if values is None:
        return f"as many as {name!r}"
    return len(values)


def check_dtype(info: FileInfo, issues: IssueCollector) -> bool:
    """Check that positions are float32 and not packed as scaled numbers."""
    array = info.arrays.get("position")
    if array is None:
        issues.skip("there is no variable 'position'", "dtype")
        return False
    issues.complete("dtype")
    where = "variable 'position'"
    if array.kind != "float32":
        issues.error(
            "dtype",
            "the type is another",
            where=where,
            expected="float32",
            got=array.kind,
            fix="store positions as float32: positions.astype('float32')",
        )
    if info.packing:
        packing = []
        for name, value in info.packing.items():
            packing.append(f"{name} = {describe_value(value)}")
        issues.error(
            "dtype",
            "the values are packed, and are not unpacked here",
            where=where,
            expected="no scale_factor and no add_offset",
            got=", ".join(packing),
            fix="store the positions themselves as float32",
        )
    return not issues.first_failed("dtype")


def check_diverged_at(info: FileInfo, issues: IssueCollector) -> None:
    """Check that ``diverged_at``, if any, has a predicted frame or -1 per scenario."""
    array = info.arrays.get("diverged_at")
    if array is None:
        issues.complete("diverged_at")
        return
    frozen_from = info.integers.get("diverged_at")
    frames = info.integers.get("frame")
    if frozen_from is None or frames is None:
        issues.skip("'diverged_at' or 'frame' cannot be read", "diverged_at")
        return

    issues.complete("diverged_at")
    where = "variable 'diverged_at'"
    scenario_count = len(info.integers.get("scenario", ()))
    if array.dims != ("scenario",) or len(frozen_from) != scenario_count:
        dimension = "one without a name"
        if any(array.dims):
            dimension = quote(array.dims[0])
        issues.error(
            "diverged_at",
            "it is not told per scenario",
            where=where,
            expected="one value per scenario, on the dimension 'scenario'",
            got=f"{len(frozen_from)} on {dimension}",
            fix="store it beside 'scenario', or leave it out",
        )
    wrong_frames = sorted(set(frozen_from) - {NEVER, *frames})
    if wrong_frames:
        issues.error(
            "diverged_at",
            "a rollout is frozen at no predicted frame",
            where=where,
            expected=f"absolute numbers of predicted frames, {NEVER} for a rollout "
            f"that did not diverge",
            got=", ".join(map(str, wrong_frames[:5])),
            fix=f"name the first frozen frame, or {NEVER}",
        )
