"""manifest.json: what a data set folder holds, and where it came from.

It stands beside the subsets, is written last, and is itself not hashed. A generation of
some scenarios leaves ``complete: false``; a later one merges its files into what is
there.
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


class _Strict(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


class FileEntry(_Strict):
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
    # position RMSE of the nudged twin at each predicted frame [length]; test only
    twin_floor: Row = ()

    @field_validator("path")
    @classmethod
    def _follows(cls, path: str, info: ValidationInfo) -> str:
        """Refuse a path that leads elsewhere: files are opened and published by it."""
        if {"subset", "scenario"} <= info.data.keys():
            wanted = f"{info.data['subset']}/{info.data['scenario']:04d}.nc"
            if path != wanted:
                raise ValueError(f"expected {wanted!r}")
        return path

    def has_hash(self, recorded: str | None) -> bool:
        """Return whether the content hash begins with the digits that datasets.yaml
        has.
        """
        return recorded is not None and self.content_sha256.startswith(recorded)


class Manifest(_Strict):
    """All that is recorded about a data set folder."""

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
        """Return whether this is of a data set: files are read and written where these
        names lead.
        """
        return (self.split, self.size, major_of(self.version)) == (split, size, major)

    def entry(self, scenario: int) -> FileEntry | None:
        """Return the entry of a scenario; None where it is not generated."""
        return next((entry for entry in self.files if entry.scenario == scenario), None)

    def only(self, scenario: int) -> Manifest:
        """Return a manifest that names one file at the most."""
        return self.model_copy(
            update={"files": tuple(e for e in self.files if e.scenario == scenario)}
        )

    def mean_twin_floor(self) -> tuple[float, ...]:
        """Return the mean twin floor over test at each frame that all have [length].

        Nine digits; empty where a test scenario has no twin.
        """
        twins = [entry.twin_floor for entry in self.files if entry.subset == "test"]
        if not all(twins):
            return ()
        return tuple(
            round_digits(math.fsum(column) / len(column))
            for column in zip(*twins, strict=False)
        )


def describe_file(
    root: Path, key: ScenarioKey, *, digest: str | None = None
) -> FileEntry:
    """Return the manifest entry of a scenario file on disk; its content is not
    re-hashed.
    """
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


def merge(
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
    """Return a manifest with new files put in; new entries replace old ones of the same
    id.
    """
    if old:
        kept = [
            entry
            for entry in old.files
            if entry.scenario in subsets.get(entry.subset, ())
        ]
    else:
        kept = []
    entries = {entry.scenario: entry for entry in (*kept, *files)}
    hashes = {
        name: subset_hash({i: entries[i].content_sha256 for i in ids})
        for name, ids in subsets.items()
        if all(i in entries for i in ids)
    }
    complete = all(name in hashes for name in HASHED_SUBSETS)
    if old:
        environments = list(old.environments)
    else:
        environments = []
    if environment is not None and dict(environment) not in environments:
        environments.append(dict(environment))
    if (
        statistics is None
        and old
        and old.subset_sha256.get("train") == hashes.get("train")
    ):
        statistics = old.statistics
    unproven = [
        e for e in entries.values() if not e.has_hash((recorded or {}).get(e.scenario))
    ]
    differing = any(may_differ(entry.device, environments) for entry in unproven)
    return Manifest(
        split=split,
        size=size,
        version=version,
        complete=complete,
        identity="tolerance" if differing else "bitwise",
        dataset_sha256=dataset_hash(split, size, major_of(version), hashes)
        if complete
        else None,
        subset_sha256=hashes,
        statistics={n: tuple(row) for n, row in (statistics or {}).items()}
        if "train" in hashes
        else {},
        environments=tuple(environments),
        files=tuple(entries[scenario] for scenario in sorted(entries)),
    )


def merged(
    size: Size,
    base: Manifest | None,
    files: Iterable[FileEntry] = (),
    environment: Mapping[str, str] | None = None,
) -> Manifest:
    """Return a manifest of a size with entries put in; an empty one without any."""
    return merge(
        base,
        files,
        split=size.split,
        size=size.name,
        version=size.version,
        subsets=size.subsets,
        environment=environment,
        recorded=size.measured.scenario_sha256 if size.measured else None,
    )


MANIFEST_LIMIT = 64 << 20  # longest manifest that is read [bytes]
_ANEW = (
    "remove it; lagbench generate checks the files and writes it anew; a local split "
    "is made again by"
    " lagbench adopt or import"
)


def read_manifest(root: Path, split: str, size: str, major: int) -> Manifest | None:
    """Return the manifest of a data set folder; None where there is none."""
    path = dataset_folder(root, split, size, major) / MANIFEST_NAME
    try:
        if not path.exists():
            return None
        check_regular(path, longest=MANIFEST_LIMIT)
        text = path.read_bytes()
    except (OSError, UnreadableFileError) as error:
        got = error.strerror if isinstance(error, OSError) else error.got
        raise DataError("cannot read the manifest", where=str(path), got=got) from error
    try:
        found = Manifest.model_validate_json(text)
    except ValidationError as error:
        first = error.errors()[0]
        where = f"{path}, key {'.'.join(map(str, first['loc'])) or '(whole file)'}"
        raise DataError(
            "the manifest is damaged", where=where, got=first["msg"], fix=_ANEW
        ) from None
    if not found.is_of(split, size, major):
        raise DataError(
            "the manifest is of another data set",
            where=str(path),
            expected=f"{split} {size}, version {major}",
            got=f"{found.split} {found.size}, version {found.version}",
            fix=_ANEW,
        )
    return found


def read_or_empty(size: Size, root: Path) -> Manifest:
    """Return the manifest of a folder, an empty one where there is none that can be
    read.
    """
    try:
        found = read_manifest(root, size.split, size.name, size.major)
    except DataError:  # it is written anew from the files
        found = None
    return found or merged(size, None)


def write_manifest(root: Path, manifest: Manifest) -> Path:
    """Write a manifest beside its subsets, whole or not at all; return its path."""
    folder = dataset_folder(
        root, manifest.split, manifest.size, major_of(manifest.version)
    )
    path = folder / MANIFEST_NAME
    write_atomically(path, (manifest.model_dump_json(indent=1) + "\n").encode())
    return path


# --- what this machine has hashed -----------------------------------------------------

# Hashing the values of a file takes seconds where it is large, and a manifest is a
# claim of whoever wrote it. So files whose values were hashed here are noted beside it.
# A note counts for that very file alone: nobody can set the time of its last change of
# any kind (ctime), so notes that came with a copied or downloaded folder count for
# nothing.


class _Note(NamedTuple):
    """A file whose values were hashed."""

    bytes: int
    modified: int  # time of the last change of its bytes [ns]
    changed: int  # time of the last change of any kind [ns]
    file_sha256: str
    content_sha256: str


_seen: dict[Path, _Note] = {}
"""Files that this process has read whole: their bytes are not read again while their
times stay.
"""


def note(
    folder: Path,
    contents: Mapping[Path, str],
    digests: Mapping[Path, str] | None = None,
) -> None:
    """Note the content hashes of files of a data set folder, just hashed or written by
    this machine.

    ``digests`` holds the SHA-256 of their bytes, from before their values were read,
    where it is known; else the bytes are read. Where the folder cannot be written to,
    nothing is noted.
    """
    if not contents:
        return
    old = _notes(folder)
    found = {}
    for path, content in contents.items():
        stamp = _stamp(path)
        known = old.get(_spelled(path, folder))
        if known is None or (*known[:3], known.content_sha256) != (*stamp, content):
            # The times are from before the bytes: a file that changes meanwhile does
            # not fit its note.
            digest = (digests or {}).get(path)
            found[path] = _Note(*stamp, digest or file_sha256(path), content)
            if digest is None:
                _seen[path] = found[path]
    if found:
        notes = old | {_spelled(path, folder): held for path, held in found.items()}
        with suppress(WorkFailedError):
            write_atomically(
                folder / NOTES_NAME, (json.dumps(notes, indent=1) + "\n").encode()
            )


def note_entries(folder: Path, entries: Iterable[FileEntry]) -> None:
    """Note files by their entries, which this machine has just made from them."""
    files = {folder / entry.path: entry for entry in entries}
    digests = {path: entry.file_sha256 for path, entry in files.items()}
    note(folder, {path: entry.content_sha256 for path, entry in files.items()}, digests)


def noted_hashes(folder: Path) -> Callable[[Path], tuple[str, str] | None]:
    """Return what tells content hash and SHA-256 of a file that was hashed here and is
    still the same.

    Its bytes are read to tell, once in a process; values are not unpacked.
    """
    notes = _notes(folder)

    def hashes(path: Path) -> tuple[str, str] | None:
        held = notes.get(_spelled(path, folder))
        if held is None or held[:3] != _stamp(path):
            return None
        if _seen.get(path) != held and file_sha256(path) != held.file_sha256:
            return None
        _seen[path] = held
        return held.content_sha256, held.file_sha256

    return hashes


def _notes(folder: Path) -> dict[str, _Note]:
    path = folder / NOTES_NAME
    try:
        check_regular(path, longest=MANIFEST_LIMIT)
        return {
            name: _Note(*row) for name, row in json.loads(path.read_bytes()).items()
        }
    except (
        UnreadableFileError,
        OSError,
        ValueError,
        TypeError,
        AttributeError,
        RecursionError,
    ):
        return {}


def _stamp(path: Path) -> tuple[int, int, int]:
    status = path.stat()
    return status.st_size, status.st_mtime_ns, status.st_ctime_ns


def _spelled(path: Path, folder: Path) -> str:
    return path.relative_to(folder).as_posix()
