"""manifest.json: the files of a data set folder, and where they came from.

It stands beside the subsets, is written last, and is itself not hashed. A generation of
some scenarios leaves ``complete: false``; a later one merges its files into it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Literal

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    FiniteFloat,
    ValidationError,
    ValidationInfo,
    field_validator,
)

from lagbench.atomic import write_atomically
from lagbench.errors import DataError, UnreadableFileError, check_regular
from lagbench.work.machine import may_differ

from .checksums import (
    HASHED_SUBSETS,
    dataset_hash,
    file_sha256,
    record_hashes,
    round_digits,
    subset_hash,
)
from .field_errors import describe_faults
from .layout import (
    MANIFEST_NAME,
    ScenarioKey,
    dataset_folder,
    major_of,
    scenario_path,
)
from .registry import Hash, Size
from .scenario import read_scenario

Name = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_-]*$")]
Row = Annotated[tuple[FiniteFloat, ...], Field(strict=False)]


class _ManifestModel(BaseModel):
    """Frozen model that refuses unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


class FileEntry(_ManifestModel):
    """One scenario file."""

    scenario: int  # id of the scenario
    subset: Name  # subset that holds it
    # file relative to the manifest's folder: <subset>/<id:04d>.nc and nothing else
    path: str
    frames: int  # recorded frames
    particles: int  # particles in every frame
    content_sha256: Hash  # content hash
    bytes: int  # length of the file
    file_sha256: Hash  # SHA-256 of its bytes; differs between library versions
    device: str  # device that simulated it
    # further numbers by name, such as the energy of the last frame over the largest;
    # the file states them
    facts: dict[str, FiniteFloat] = Field(default_factory=dict)
    # position RMSE of a perturbed run at each predicted frame [length]; test only
    twin_floor: Row = ()

    @field_validator("path")
    @classmethod
    def _check_path(cls, path: str, info: ValidationInfo) -> str:
        """Refuse a path that leads elsewhere: files are opened and published by it."""
        if {"subset", "scenario"} <= info.data.keys():
            expected = f"{info.data['subset']}/{info.data['scenario']:04d}.nc"
            if path != expected:
                raise ValueError(f"expected {expected!r}")
        return path

    def has_hash(self, recorded: str | None) -> bool:
        """Return whether the content hash begins with the digits of datasets.yaml."""
        return recorded is not None and self.content_sha256.startswith(recorded)


class Manifest(_ManifestModel):
    """The files of a data set folder, their hashes and their machines."""

    format: Literal[1] = 1  # number of this layout
    split: str  # name of the split
    size: str  # name of the size
    # semantic version of the split
    version: Annotated[str, Field(pattern=r"^[1-9]\d{0,5}\.\d{1,6}\.\d{1,6}$")]
    complete: bool = False  # whether every scenario of train, valid and test is there
    # "bitwise" where every file comes from a machine that promises equal bits or has
    # the hash of datasets.yaml, else "tolerance"; see lagbench.work.machine
    identity: Literal["bitwise", "tolerance"] = "bitwise"
    dataset_sha256: Hash | None = None  # data set hash; None until complete
    # hash of every complete subset
    subset_sha256: dict[str, Hash] = Field(default_factory=dict)
    # mean and std per component over train, see lagbench.data.statistics; empty until
    # train is complete
    statistics: dict[str, Row] = Field(default_factory=dict)
    # the distinct machines and library versions that wrote files, oldest first
    environments: Annotated[tuple[dict[str, str], ...], Field(strict=False)] = ()
    # scenario files by ascending id
    files: Annotated[tuple[FileEntry, ...], Field(strict=False)] = ()

    def is_of(self, split: str, size: str, major: int) -> bool:
        """Return whether this is the manifest of a data set.

        Files are read and written where these names lead.
        """
        return (self.split, self.size, major_of(self.version)) == (split, size, major)

    def entry(self, scenario: int) -> FileEntry | None:
        """Return the entry of a scenario; None where it is not generated."""
        return next((entry for entry in self.files if entry.scenario == scenario), None)

    def only(self, scenario: int) -> Manifest:
        """Return a manifest that names one file at the most."""
        files = tuple(entry for entry in self.files if entry.scenario == scenario)
        return self.model_copy(update={"files": files})

    def mean_twin_floor(self) -> tuple[float, ...]:
        """Return the mean predictability limit over test at frames of all [length].

        Nine digits; empty where a test scenario has no perturbed run.
        """
        errors = []
        for entry in self.files:
            if entry.subset == "test":
                errors.append(entry.twin_floor)
        if not all(errors):
            return ()
        means = []
        for column in zip(*errors, strict=False):
            means.append(round_digits(mean(column)))
        return tuple(means)


def mean(values: Sequence[float]) -> float:
    """Return the mean of numbers; infinity where their sum is beyond every float.

    >>> mean([1.0, 2.0]), mean([1e308, 1e308])
    (1.5, inf)
    """
    try:
        return math.fsum(values) / len(values)
    except OverflowError:
        return math.inf


def describe_file(
    root: Path, key: ScenarioKey, *, digest: str | None = None
) -> FileEntry:
    """Return the manifest entry of a scenario file, with the hash that it states."""
    path = scenario_path(root, key)
    with read_scenario(path) as file:
        header = file.header
    return FileEntry(
        scenario=key.scenario,
        subset=key.subset,
        path=f"{key.subset}/{path.name}",
        frames=header.frames,
        particles=header.particles,
        content_sha256=header.content_sha256,
        bytes=path.stat().st_size,
        file_sha256=digest or file_sha256(path),
        device=header.device,
        facts=dict(header.facts),
    )


def build_manifest(
    old: Manifest | None,
    files: Iterable[FileEntry],
    *,
    split: str,
    size: str,
    version: str,
    subsets: Mapping[str, Sequence[int]],
    environment: Mapping[str, str] | None = None,
    recorded: Mapping[int, str] | None = None,
    statistics: Mapping[str, Sequence[float]] | None = None,
) -> Manifest:
    """Return a manifest with new entries; they replace old ones of the same id.

    Args:
        old: manifest before; None for an empty one.
        files: new entries; old ones stay only if their subset still lists them.
        split: name of the split.
        size: name of the size.
        version: semantic version of the split.
        subsets: scenario ids of each subset.
        environment: machine and libraries that wrote the new files.
        recorded: first digits of the content hashes of datasets.yaml, by id.
        statistics: statistics over train; the old ones where train is unchanged.
    """
    entries = {}
    for entry in () if old is None else old.files:
        if entry.scenario in subsets.get(entry.subset, ()):
            entries[entry.scenario] = entry
    for entry in files:
        entries[entry.scenario] = entry
    subset_hashes = {}
    for name, ids in subsets.items():
        if all(scenario in entries for scenario in ids):
            contents = {scenario: entries[scenario].content_sha256 for scenario in ids}
            subset_hashes[name] = subset_hash(contents)
    is_complete = all(name in subset_hashes for name in HASHED_SUBSETS)
    whole_hash = None
    if is_complete:
        whole_hash = dataset_hash(split, size, major_of(version), subset_hashes)

    environments: list[dict[str, str]] = []
    if old is not None:
        environments += old.environments
    if environment is not None and dict(environment) not in environments:
        environments.append(dict(environment))

    if statistics is None and old is not None:
        has_same_train = old.subset_sha256.get("train") == subset_hashes.get("train")
        if has_same_train:
            statistics = old.statistics
    rows: dict[str, tuple[float, ...]] = {}
    if "train" in subset_hashes:
        for name, row in (statistics or {}).items():
            rows[name] = tuple(row)

    identity: Literal["bitwise", "tolerance"] = "bitwise"
    for entry in entries.values():
        is_proven = entry.has_hash((recorded or {}).get(entry.scenario))
        if not is_proven and may_differ(entry.device, environments):
            identity = "tolerance"
    return Manifest(
        split=split,
        size=size,
        version=version,
        complete=is_complete,
        identity=identity,
        dataset_sha256=whole_hash,
        subset_sha256=subset_hashes,
        statistics=rows,
        environments=tuple(environments),
        files=tuple(entries[scenario] for scenario in sorted(entries)),
    )


def merge_entries(
    size: Size,
    base: Manifest | None,
    files: Iterable[FileEntry] = (),
    environment: Mapping[str, str] | None = None,
) -> Manifest:
    """Return a manifest of a size with new entries; an empty one without any."""
    recorded = None
    if size.measured is not None:
        recorded = size.measured.scenario_sha256
    return build_manifest(
        base,
        files,
        split=size.split,
        size=size.name,
        version=size.version,
        subsets=size.subsets,
        environment=environment,
        recorded=recorded,
    )


MANIFEST_LIMIT = 64 << 20
"""Longest manifest that is read [bytes]."""

_MANIFEST_HINT = (
    "remove it; lagbench generate checks the files and writes it anew; "
    "a local split is made again by lagbench import"
)


def read_manifest(root: Path, split: str, size: str, major: int) -> Manifest | None:
    """Return the manifest of a data set folder; None where there is none.

    Raises:
        DataError: the manifest is unreadable, damaged or of another data set.
    """
    path = dataset_folder(root, split, size, major) / MANIFEST_NAME
    try:
        if not path.exists():
            return None
        check_regular(path, longest=MANIFEST_LIMIT)
        text = path.read_bytes()
    except (OSError, UnreadableFileError) as error:
        raise DataError(
            f"cannot read the manifest: {error}", where=str(path)
        ) from error
    try:
        manifest = Manifest.model_validate_json(text)
    except ValidationError as error:
        raise DataError(
            f"the manifest is damaged: {describe_faults(error)}; {_MANIFEST_HINT}",
            where=str(path),
        ) from None
    if not manifest.is_of(split, size, major):
        raise DataError(
            f"the manifest is of another data set: got {manifest.split} "
            f"{manifest.size}, version {manifest.version}, expected {split} {size}, "
            f"version {major}; {_MANIFEST_HINT}",
            where=str(path),
        )
    return manifest


def read_or_empty(size: Size, root: Path) -> Manifest:
    """Return the manifest of a folder, an empty one where none can be read."""
    manifest = None
    with suppress(DataError):  # it is written anew from the files
        manifest = read_manifest(root, size.split, size.name, size.major)
    return manifest or merge_entries(size, None)


def write_manifest(root: Path, manifest: Manifest) -> Path:
    """Write a manifest beside its subsets, whole or not at all; return its path."""
    folder = dataset_folder(
        root, manifest.split, manifest.size, major_of(manifest.version)
    )
    path = folder / MANIFEST_NAME
    write_atomically(path, (manifest.model_dump_json(indent=1) + "\n").encode())
    return path


def record_entry_hashes(folder: Path, entries: Iterable[FileEntry]) -> None:
    """Note files by their entries, which this machine has just made from them."""
    contents = {}
    file_hashes = {}
    for entry in entries:
        path = folder / entry.path
        contents[path] = entry.content_sha256
        file_hashes[path] = entry.file_sha256
    record_hashes(folder, contents, file_hashes=file_hashes)
