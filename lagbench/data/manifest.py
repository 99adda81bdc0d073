"""manifest.json: the files of a data set folder, and where they came from.

It stands beside the subsets, is written last, and is itself not hashed. A generation of
some scenarios leaves ``complete: false``; a later one merges its files into it.

``.verified.json`` beside it: the hashes that this machine computed.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

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
from lagbench.errors import (
    DataError,
    UnreadableFileError,
    WorkFailedError,
    check_regular,
)
from lagbench.work.machine import may_differ

from .checksums import (
    HASHED_SUBSETS,
    dataset_hash,
    file_sha256,
    round_digits,
    subset_hash,
)
from .field_errors import describe_expectation, describe_input
from .layout import (
    MANIFEST_NAME,
    NOTES_NAME,
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
            means.append(round_digits(math.fsum(column) / len(column)))
        return tuple(means)


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
        files: new entries.
        split: name of the split.
        size: name of the size.
        version: semantic version of the split.
        subsets: scenario ids of each subset.
        environment: machine and libraries that wrote the new files.
        recorded: first digits of the content hashes of datasets.yaml, by id.
        statistics: statistics over train; the old ones where train is unchanged.
    """
    entries = _collect_entries(old, files, subsets)
    subset_hashes = _hash_complete_subsets(entries, subsets)
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


def _collect_entries(
    old: Manifest | None,
    files: Iterable[FileEntry],
    subsets: Mapping[str, Sequence[int]],
) -> dict[int, FileEntry]:
    """Return entries by id; old ones only if their subset still lists them."""
    entries = {}
    if old is not None:
        for entry in old.files:
            if entry.scenario in subsets.get(entry.subset, ()):
                entries[entry.scenario] = entry
    for entry in files:
        entries[entry.scenario] = entry
    return entries


def _hash_complete_subsets(
    entries: Mapping[int, FileEntry], subsets: Mapping[str, Sequence[int]]
) -> dict[str, str]:
    subset_hashes = {}
    for name, ids in subsets.items():
        if all(scenario in entries for scenario in ids):
            contents = {scenario: entries[scenario].content_sha256 for scenario in ids}
            subset_hashes[name] = subset_hash(contents)
    return subset_hashes


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
    "a local split is made again by lagbench adopt or import"
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
        reason = error.strerror if isinstance(error, OSError) else error.got
        raise DataError(
            "cannot read the manifest",
            where=str(path),
            expected="a readable file",
            got=reason,
            fix="see that you may read it, and that it is a file",
        ) from error
    try:
        manifest = Manifest.model_validate_json(text)
    except ValidationError as error:
        first_error = error.errors()[0]
        key = ".".join(str(part) for part in first_error["loc"])
        raise DataError(
            "the manifest is damaged",
            where=f"{path}, key {key or '(whole file)'}",
            expected="the manifest that lagbench writes, here "
            f"{describe_expectation(first_error)}",
            got=describe_input(first_error),
            fix=_MANIFEST_HINT,
        ) from None
    if not manifest.is_of(split, size, major):
        raise DataError(
            "the manifest is of another data set",
            where=str(path),
            expected=f"{split} {size}, version {major}",
            got=f"{manifest.split} {manifest.size}, version {manifest.version}",
            fix=_MANIFEST_HINT,
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


# --- hashes that this machine has computed --------------------------------------------

# Hashing the values of a large file takes seconds, and a manifest is a claim of whoever
# wrote it. So this machine notes the files whose values it has hashed. A note counts
# for that very file alone: nobody can set the time of its last change of any kind
# (ctime), so notes that came with a copied or downloaded folder count for nothing.


class _HashNote(NamedTuple):
    """A file whose values were hashed."""

    bytes: int
    modified: int  # time of the last change of its bytes [ns]
    changed: int  # time of the last change of any kind [ns]
    file_sha256: str
    content_sha256: str

    @property
    def stamp(self) -> tuple[int, int, int]:
        """Length and times of the file."""
        return self.bytes, self.modified, self.changed

    def says(self, stamp: tuple[int, int, int], content_sha256: str) -> bool:
        """Tell whether this is the note of a file with that stamp and content."""
        return self.stamp == stamp and self.content_sha256 == content_sha256


_read_in_process: dict[Path, _HashNote] = {}
"""Files whose bytes this process has read.

They are not read again while their times stay.
"""


def record_hashes(
    folder: Path,
    contents: Mapping[Path, str],
    *,
    file_hashes: Mapping[Path, str] | None = None,
) -> None:
    """Note content hashes of files that this machine has just hashed or written.

    Where the folder cannot be written to, nothing is noted.

    Args:
        folder: folder of the data set.
        contents: content hashes by path.
        file_hashes: SHA-256 of the files' bytes by path, if they are known from before
            the values were read. The bytes of all other files are read here.
    """
    if not contents:
        return
    known_file_hashes = file_hashes or {}
    old_notes = _read_hash_notes(folder)
    new_notes = {}
    for path, content in contents.items():
        stamp = _file_stamp(path)
        name = _relative_name(path, folder)
        old_note = old_notes.get(name)
        if old_note is not None and old_note.says(stamp, content):
            continue
        # The stamp is from before the bytes are read: if the file changes meanwhile,
        # its new stamp is not that of its note.
        if path in known_file_hashes:
            note = _HashNote(*stamp, known_file_hashes[path], content)
        else:
            note = _HashNote(*stamp, file_sha256(path), content)
            _read_in_process[path] = note
        new_notes[name] = note
    if new_notes:
        text = json.dumps(old_notes | new_notes, indent=1) + "\n"
        with suppress(WorkFailedError):
            write_atomically(folder / NOTES_NAME, text.encode())


def record_entry_hashes(folder: Path, entries: Iterable[FileEntry]) -> None:
    """Note files by their entries, which this machine has just made from them."""
    contents = {}
    file_hashes = {}
    for entry in entries:
        path = folder / entry.path
        contents[path] = entry.content_sha256
        file_hashes[path] = entry.file_sha256
    record_hashes(folder, contents, file_hashes=file_hashes)


def load_recorded_hashes(folder: Path) -> Callable[[Path], tuple[str, str] | None]:
    """Return a function from a file to its noted content hash and SHA-256.

    The function returns None for a file that was not hashed here or has changed since.
    It reads the bytes once in a process; values are not unpacked.
    """
    notes = _read_hash_notes(folder)

    def find_hashes(path: Path) -> tuple[str, str] | None:
        note = notes.get(_relative_name(path, folder))
        if note is None or note.stamp != _file_stamp(path):
            return None
        if _read_in_process.get(path) != note:
            if file_sha256(path) != note.file_sha256:
                return None
            _read_in_process[path] = note
        return note.content_sha256, note.file_sha256

    return find_hashes


def _read_hash_notes(folder: Path) -> dict[str, _HashNote]:
    """Return the notes of ``.verified.json`` by the files' relative names.

    A file that is missing or damaged has no notes: that costs another hashing only.
    """
    path = folder / NOTES_NAME
    notes = {}
    try:
        check_regular(path, longest=MANIFEST_LIMIT)
        for name, row in json.loads(path.read_bytes()).items():
            notes[name] = _HashNote(*row)
    except (
        UnreadableFileError,
        OSError,
        ValueError,
        TypeError,
        AttributeError,
        RecursionError,
    ):
        return {}
    return notes


def _file_stamp(path: Path) -> tuple[int, int, int]:
    status = path.stat()
    return status.st_size, status.st_mtime_ns, status.st_ctime_ns


def _relative_name(path: Path, folder: Path) -> str:
    return path.relative_to(folder).as_posix()
