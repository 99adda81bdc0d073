"""The layout of a predictions.nc: its names, its headers, and the checks on them.

No data set is needed here. What is wrong is collected, not raised; only a file that
HDF5 cannot read at all raises.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import h5py
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    Json,
    StringConstraints,
    ValidationError,
)
from pydantic_core import ErrorDetails

from lagbench.data.hdf5 import (
    MAX_LINKS,
    hdf5_errors,
    list_members,
    open_variable,
)
from lagbench.errors import UnreadableFileError, UsageError, suggest_name

from .budget import Budget
from .headers import (
    MAX_ATTRIBUTE,
    ArrayInfo,
    UnusableAttribute,
    describe_array,
    read_single_value,
)
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

IDENTITY = ("split", "size", "dataset_version", "dataset_sha256", "method")
"""Text attributes that every file has: the predicted data set and the method."""

HASH = re.compile(r"[0-9a-f]{64}")

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

WRITE = (
    "write it with lagbench.submission.write, or fill what `lagbench template` writes"
)
"""How to get a right file."""


def require_name(text: str) -> str:
    """Return a text that can be a required attribute; terminals may show it as it is.

    Raises:
        ValueError: it is empty, too long or not printable.
    """
    if not text.strip() or len(text) > MAX_NAME or not text.isprintable():
        raise ValueError(f"not printable text of 1 to {MAX_NAME} characters")
    return text


Name = Annotated[str, AfterValidator(require_name)]
# HDF5 stores texts up to the first NUL
Text = Annotated[
    str, StringConstraints(max_length=MAX_ATTRIBUTE, pattern=r"^[^\x00]*$")
]
Seconds = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class Labels(BaseModel):
    """Attributes that a writer may set: method, cost, origin and size of the model."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)

    method: Name = "unnamed"  # what made the predictions
    seconds_per_frame: Seconds | None = None  # cost of one predicted frame [s]
    device: Text | None = None  # machine that predicted
    # seed of the training
    seed: Annotated[int, Field(ge=-(2**63), lt=2**64)] | None = None
    # trainable parameters of the model
    parameters: Annotated[int, Field(ge=0, lt=2**64)] | None = None
    training: Text | None = None  # what the model was trained on, in words
    # of our solver on one core of the same machine [s]
    solver_seconds_per_frame: Seconds | None = None
    budget: Json[Budget] | None = None  # what the training took
    provenance: Json[TrainingProvenance] | None = None  # the training behind the model


class Attributes(Labels):
    """The global attributes of a file."""

    lagbench_format: Literal[1]
    split: Name
    size: Name
    dataset_version: Name  # semantic version of the split, as in "1.0.0"
    dataset_sha256: Name  # hash of the data set that the model was given
    method: Name
    subset: Text = "test"  # subset whose scenarios are predicted


class Header(Attributes):
    """What a predictions.nc says about itself."""

    lagbench_format: Literal[1] = 1
    scenarios: tuple[int, ...]  # ids in the order in which they are stored
    frames: tuple[int, ...]  # absolute numbers of the predicted frames
    particles: int  # particles in every frame; the most of any scenario
    # scenario id to the absolute frame from which it is frozen
    diverged_at: Mapping[int, int] = {}
    # scenario id to its number of particles; empty where all have as many
    particle_counts: Mapping[int, int] = {}
    space: int = 2  # components of a position

    def particle_count(self, scenario: int) -> int:
        """Return how many particles a scenario has."""
        return self.particle_counts.get(scenario, self.particles)


@dataclass(frozen=True, kw_only=True)
class FileInfo:
    """What the headers of a file say."""

    # entry of the root group to what it is; the first MAX_LINKS of them
    links: Mapping[str, str]
    link_count: int
    attributes: Mapping[str, object]  # attributes of the format that it has
    arrays: Mapping[str, ArrayInfo]  # variables of the format that a hard link leads to
    packing: Mapping[str, object]  # scale_factor and add_offset of ``position``
    integers: Mapping[str, tuple[int, ...]]  # coordinates whose values could be read
    length: int  # length of the file [bytes]

    @property
    def header(self) -> Header:
        """The header of a file whose layout has been checked."""
        attributes, _ = read_attributes(self.attributes)
        scenarios = self.integers["scenario"]
        frozen_from = dict(
            zip(scenarios, self.integers.get("diverged_at", ()), strict=False)
        )
        counts = self.integers.get("particle_count", ())
        _, _, particles, space = self.arrays["position"].shape or (0, 0, 0, 0)
        return Header.model_construct(
            **dict(attributes),
            scenarios=scenarios,
            frames=self.integers["frame"],
            particles=particles,
            particle_counts=dict(zip(scenarios, counts, strict=False)),
            space=space,
            diverged_at={i: frame for i, frame in frozen_from.items() if frame >= 0},
        )


def read_attributes(
    given: Mapping[str, object],
) -> tuple[Attributes, list[ErrorDetails]]:
    """Return the attributes that can be used, and what is wrong with the others."""
    try:
        return Attributes.model_validate(given), []
    except ValidationError as error:
        faults = error.errors(include_url=False, include_input=False)
    wrong = {fault["loc"][0] for fault in faults}
    usable: dict[str, object] = {**dict.fromkeys(IDENTITY, "?"), "lagbench_format": 1}
    for name in given.keys() - wrong:
        usable[name] = given[name]
    return Attributes.model_validate(usable), faults


def check_labels(labels: Mapping[str, object]) -> None:
    """Refuse values that attributes may not have, before they are written.

    Raises:
        UsageError: there is no such label, or it cannot have that value.
    """
    try:
        Labels.model_validate(dict(labels))
    except ValidationError as error:
        issue = error.errors(include_url=False, include_input=False)[0]
        name = str(issue["loc"][0])
        what = f"{issue['msg']}; docs/predictions.md describes the labels"
        if name not in Labels.model_fields:
            what = f"no such label; {suggest_name(name, Labels.model_fields)}"
        raise UsageError(what, where=f"label {quote(name)}") from None


def inspect_file(file: h5py.File, path: Path) -> FileInfo:
    """Return what a file holds; of values only coordinates are read.

    Raises:
        UnreadableFileError: HDF5 cannot read it, or it is a score file or a scenario
            file: all checks of those would mislead.
    """
    length = path.stat().st_size
    with hdf5_errors(path):
        root = file["/"]
        links, link_count = list_members(root)
        attributes = {}
        for name in Attributes.model_fields:
            value = read_single_value(root, name)
            if value is not None:
                attributes[name] = value
    if not {"position", "scenario"} <= links.keys():
        for name, kind in OTHERS.items():
            if name in links:
                raise UnreadableFileError(
                    f"no predictions, but {kind}; name predictions", where=str(path)
                )

    arrays = {}
    integers = {}
    packing = {}
    for name in ("position", *INTEGERS):
        if links.get(name) != "variable":
            continue
        with hdf5_errors(path, name):
            dataset = open_variable(file, name)
            array = describe_array(dataset)
            if name == "position":
                for attribute in PACKING:
                    value = read_single_value(dataset, attribute)
                    if value is not None:
                        packing[attribute] = value
            elif is_coordinate_readable(array):
                integers[name] = tuple(int(value) for value in dataset[...])
            arrays[name] = array
    return FileInfo(
        links=links,
        link_count=link_count,
        attributes=attributes,
        arrays=arrays,
        packing=packing,
        integers=integers,
        length=length,
    )


def is_coordinate_readable(array: ArrayInfo) -> bool:
    """Return whether an array is a list of integers that is safe to read."""
    return (
        array.shape is not None
        and len(array.shape) == 1
        and array.shape[0] <= MAX_COORDINATE
        and array.chunk_bytes <= MAX_COORDINATE_CHUNK
        and array.kind.lstrip("u").startswith("int")
    )


def check_layout(
    info: FileInfo, issues: IssueCollector, *, dimension: int | None = None
) -> bool:
    """Check links, variables, storage, attributes, dimensions and types.

    The box has ``dimension`` axes; 2 or 3 where it is not known.

    Returns:
        Whether the positions can be read.
    """
    for name, kind in info.links.items():
        if kind == "link":
            issues.error(
                "format",
                f"a {kind} is not followed; store the values themselves",
                where=quote(name),
            )
    if info.link_count > MAX_LINKS:
        issues.error(
            "format",
            f"too many variables, {info.link_count} of at most {MAX_LINKS}; {WRITE}",
            where="/",
        )
    for name in ("position", "scenario", "frame"):
        kind = info.links.get(name, "")
        if kind not in ("variable", "link"):
            known = [quote(stored)[1:-1] for stored in info.links]
            issues.error(
                "format",
                f"no variable {name!r}; {suggest_name(name, known)}",
                where="/",
            )
    for name, array in info.arrays.items():
        where = f"variable {name!r}"
        if array.issue is not None:
            issues.error("format", f"{array.issue}; {WRITE}", where=where)
        elif name != "position" and name not in info.integers:
            issues.error(
                "format",
                f"{array.kind} of shape {array.shape} are no list of at most "
                f"{MAX_COORDINATE} integers; {WRITE}",
                where=where,
            )
    is_stored = not issues.first_failed("format")

    _, faults = read_attributes(info.attributes)
    for fault in faults:
        name = str(fault["loc"][0])
        value = info.attributes.get(name)
        reason = f"{fault['msg']}, got {quote(value)}"
        if isinstance(value, UnusableAttribute):
            reason = "neither one text nor one number"
        issues.error(
            "format",
            f"{reason}; set it: file.{name} = ...",
            where=f"attribute {name!r}",
        )

    position = info.arrays.get("position")
    if position is None:
        issues.skip("there is no variable 'position'", "dims", "dtype")
        return False
    where = "variable 'position'"
    if position.kind != "float32":
        issues.error(
            "dtype",
            f"positions are {position.kind}; store float32: "
            "positions.astype('float32')",
            where=where,
        )
    if info.packing:
        issues.error(
            "dtype",
            f"{', '.join(info.packing)}: packed values are not unpacked here; store "
            "the positions themselves as float32",
            where=where,
        )
    _check_dims(info, position, issues, dimension=dimension)
    marks = info.arrays.get("diverged_at")
    frozen_from = info.integers.get("diverged_at")
    frames = info.integers.get("frame")
    if marks is not None and (frozen_from is None or frames is None):
        issues.skip("'diverged_at' or 'frame' cannot be read", "diverged_at")
    elif marks is not None and frozen_from is not None and frames is not None:
        where = "variable 'diverged_at'"
        scenario_count = len(info.integers.get("scenario", ()))
        if marks.dims != ("scenario",) or len(frozen_from) != scenario_count:
            issues.error(
                "diverged_at",
                "not one value per scenario, on the dimension 'scenario'; store it so, "
                "or leave it out",
                where=where,
            )
        wrong_frames = sorted(set(frozen_from) - {NEVER, *frames})
        if wrong_frames:
            issues.error(
                "diverged_at",
                f"{quote(wrong_frames)}: no predicted frames; name the first frozen "
                f"frame, or {NEVER} for a rollout that did not diverge",
                where=where,
            )
    has_dims = "dims" not in issues.skipped
    return is_stored and has_dims and not issues.first_failed("dims", "dtype")


def _check_dims(
    info: FileInfo,
    position: ArrayInfo,
    issues: IssueCollector,
    *,
    dimension: int | None,
) -> None:
    """Check names, order and lengths of the dimensions of ``position``."""
    shape = position.shape
    if shape is None or not {"scenario", "frame"} <= info.integers.keys():
        issues.skip("positions, scenarios or frames cannot be read", "dims")
        return
    where = "variable 'position'"
    if position.dims != DIMS:
        names = [
            quote(name) if name else "one without a name" for name in position.dims
        ]
        fix = f"the dimensions are {', '.join(DIMS)}, also for a single scenario"
        if sorted(position.dims) == sorted(DIMS):
            fix = "transpose it"
        elif not any(position.dims):
            fix = "attach dimension scales, as netCDF4 and xarray do, not plain h5py"
        what = f"dimensions {', '.join(names) or 'none'}, not {', '.join(DIMS)}; {fix}"
        issues.error("dims", what, where=where)
        return

    if dimension is None:
        dimension = shape[3] if shape[3] in SPACES else SPACES[0]
    scenarios = len(info.integers["scenario"])
    lengths = (scenarios, len(info.integers["frame"]), shape[2], dimension)
    if shape != lengths:
        issues.error("dims", f"shape {shape}, not {lengths}; {WRITE}", where=where)
        return
    counted = info.arrays.get("particle_count")
    if counted is None:
        return
    counts = info.integers.get("particle_count", ())
    is_per_scenario = counted.dims == ("scenario",) and len(counts) == scenarios
    if not is_per_scenario or not all(1 <= count <= shape[2] for count in counts):
        issues.error(
            "dims",
            f"not one number from 1 to {shape[2]} per scenario; leave it out where all "
            "scenarios have as many particles",
            where="variable 'particle_count'",
        )
