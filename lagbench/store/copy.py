"""Bring scenarios from elsewhere: from a store into its working copy, from other root
folders into one.

The store's manifest says what is there; each object is fetched and gets its name once
its content hash is that of datasets.yaml, or of the manifest where datasets.yaml has
none. What is in the working copy and is what the manifest says is not fetched again.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import sys
import time
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextvars import ContextVar
from pathlib import Path

from pydantic import ValidationError

from lagbench.atomic import atomic_path
from lagbench.data.checksums import file_sha256
from lagbench.data.layout import MANIFEST_NAME, url_of
from lagbench.data.local import remedy as remedy_of
from lagbench.data.lock import dataset_lock
from lagbench.data.manifest import (
    MANIFEST_LIMIT,
    FileEntry,
    Manifest,
    merged,
    note_entries,
    read_manifest,
    read_or_empty,
    write_manifest,
)
from lagbench.data.registry import Size, spell_ids
from lagbench.data.scenario import check_scenario
from lagbench.errors import DataError, UsageError, nearest
from lagbench.work.machine import may_differ
from lagbench.work.progress import watched

from .fetch import Wanted, fetch_scenarios, fetch_text
from .objects import (
    HTTP,
    NotDataError,
    NotInStoreError,
    Objects,
    WrongContentError,
    WrongLengthError,
    check_bucket,
)

FRESH = 30.0  # how long a store's manifest is not asked for again by this process [s]

_asked: dict[str, tuple[float, Manifest | None]] = {}
_written: set[Path] = set()
_quiet: ContextVar[bool] = ContextVar("quiet", default=False)


def address_of(size: Size, url: str, name: str) -> str:
    """Return the address of an object of a data set in a store."""
    return f"{url}/{folder_of(size)}/{name}"


def folder_of(size: Size) -> str:
    """Return the folder of a data set below the root of a store."""
    return size.folder(Path()).as_posix()


def _remedy(size: Size, url: str) -> str:
    if url.startswith(HTTP):
        return "tell whoever serves the address, or name another --root"
    return f"lagbench generate --split {size.split} --size {size.name} --root {url} writes it anew"


def parse_manifest(size: Size, text: bytes, *, where: str, remedy: str) -> Manifest:
    """Return a store's manifest; what is none, or another data set's, is a
    NotDataError.
    """
    try:
        found = Manifest.model_validate_json(text)
    except ValidationError as error:
        what = "the store's manifest is none"
        expected = "a manifest.json as lagbench generate writes it"
        got = ascii(text[:80].decode("utf-8", "replace"))
        raise NotDataError(
            what, where=where, expected=expected, got=got, fix=remedy
        ) from error
    if not found.is_of(size.split, size.name, size.major):
        raise NotDataError(
            "the store's manifest is of another data set",
            where=where,
            expected=f"{size.split} {size.name}, version {size.major}",
            got=ascii(f"{found.split} {found.size}, version {found.version}"[:200]),
            fix=remedy,
        )
    return found


def refuse_strangers(
    found: Manifest, strangers: Collection[int], *, where: str, remedy: str
) -> None:
    """Refuse a store whose manifest has other content hashes than datasets.yaml."""
    if strangers:
        raise WrongContentError(
            "the store holds another data set",
            where=f"{where}, scenarios {spell_ids(strangers)}",
            expected="the content hashes of datasets.yaml",
            got=f"version {found.version}, data set hash {found.dataset_sha256}",
            fix=remedy,
        )


def scenario_files(size: Size, root: Path, subsets: Sequence[str]) -> dict[int, Path]:
    """Return the files of subsets by id, brought from the store that a root is a copy
    of; all are there.
    """
    for subset in subsets:
        if not isinstance(subset, str) or subset not in size.subsets:
            where = f"{size.split} {size.name}"
            raise UsageError(
                f"no subset {subset!r}",
                where=where,
                fix=nearest(str(subset), size.subsets),
            )
    paths = {i: size.path(root, i) for subset in subsets for i in size.subsets[subset]}
    bring(size, root, paths)
    missing = [i for i, path in paths.items() if not path.is_file()]
    if missing:
        lacking = ",".join(
            subset
            for subset in subsets
            if not set(missing).isdisjoint(size.subsets[subset])
        )
        what = f"{len(missing)} of {len(paths)} scenarios are not there"
        got = spell_ids(missing)
        where = str(size.folder(root))
        fix = remedy_of(size, f"--subset {lacking}", root=root)
        raise DataError(what, where=where, got=f"missing: {got} of {lacking}", fix=fix)
    return paths


def bring(
    size: Size, root: Path, scenarios: Iterable[int] = (), *, thoroughly: bool = False
) -> bool:
    """Bring manifest and some scenarios where the root is a store's working copy; say
    whether any came.

    A scenario that the store does not have is left to the caller, who misses its file.
    ``thoroughly`` hashes files that are there, and does not only look at their lengths,
    and looks whether the store has all that its manifest names. Lies of the store are
    DataErrors, its silence is a WorkFailedError.
    """
    url = url_of(root)
    scenarios = tuple(scenarios)
    if url is None or root in _written:
        return False
    found = remote_manifest(size, url)
    if found is None or any(found.entry(i) is None for i in scenarios):
        found = remote_manifest(size, url, fresh=0.0)  # it may have come just now
    if found is None:
        return False
    where = address_of(size, url, MANIFEST_NAME)
    if thoroughly and not url.startswith(HTTP):  # which lists nothing
        there = Objects(url, folder_of(size)).sizes()
        wrong = [
            entry.scenario
            for entry in found.files
            if there.get(entry.path) != entry.bytes
        ]
        if wrong:
            what = "the store's manifest names objects that are not there, or of another length"
            where = f"{where}, scenarios {spell_ids(wrong)}"
            raise DataError(what, where=where, fix=_remedy(size, url))
    named = [e for i in scenarios if (e := found.entry(i))]
    strangers = [e.scenario for e in named if not is_right(e, size, found)]
    refuse_strangers(found, strangers, where=where, remedy=_remedy(size, url))
    old = read_or_empty(size, root)
    lacking = [
        e for e in named if not is_here(e, size, root, None if thoroughly else old)
    ]
    if not lacking and with_local(size, root, found) == old:
        return False
    with dataset_lock(root, size.split, size.name, size.major):
        fetch_entries(
            size, root, url, [e for e in lacking if not is_here(e, size, root)]
        )
        write_manifest(root, with_local(size, root, found))
    return True


def remote_manifest(
    size: Size, url: str, *, fresh: float | None = None
) -> Manifest | None:
    """Return the manifest of a data set in a store; None where there is none.

    An earlier answer of this process counts while it is no older than ``fresh`` [s].
    """
    place = address_of(size, url, MANIFEST_NAME)
    remedy = _remedy(size, url)
    when, known = _asked.get(place, (-1e9, None))
    if time.monotonic() - when < (FRESH if fresh is None else fresh):
        return known
    try:
        text = fetch_text(place, limit=MANIFEST_LIMIT, remedy=remedy)
    except NotInStoreError:
        check_bucket(url)
        found = None
    else:
        found = parse_manifest(size, text, where=place, remedy=remedy)
    _asked[place] = (time.monotonic(), found)
    return found


def unstored(size: Size, root: Path, scenarios: Iterable[int]) -> tuple[int, ...]:
    """Return scenarios that the manifest of a working copy's store lacks; a plain
    folder has no store.
    """
    url = url_of(root)
    if url is None:
        return ()
    found = remote_manifest(size, url)
    return tuple(i for i in scenarios if found is None or found.entry(i) is None)


def is_right(entry: FileEntry, size: Size, manifest: Manifest) -> bool:
    """Return whether an entry of a manifest is what datasets.yaml means.

    A file of a machine that promises no equal bits may differ, as it may in a local
    folder.
    """
    if size.measured is None or entry.scenario not in size.scenarios:
        return entry.scenario in size.scenarios
    return entry.has_hash(size.measured.scenario_sha256.get(entry.scenario)) or (
        manifest.identity == "tolerance"
        and may_differ(entry.device, manifest.environments)
    )


def with_local(size: Size, root: Path, found: Manifest) -> Manifest:
    """Return the store's manifest with what only the working copy holds."""
    folder = size.folder(root)
    local = read_or_empty(size, root)
    ours = [
        e
        for e in local.files
        if found.entry(e.scenario) is None and is_right(e, size, local)
    ]
    return join(
        size, found, local, [entry for entry in ours if (folder / entry.path).is_file()]
    )


def join(
    size: Size, base: Manifest, other: Manifest, files: Collection[FileEntry]
) -> Manifest:
    """Return a manifest with entries of another, and its machines and statistics as far
    as they hold.
    """
    if not files:
        return base
    machines = [
        *base.environments,
        *(e for e in other.environments if e not in base.environments),
    ]
    joined = merged(
        size, base.model_copy(update={"environments": tuple(machines)}), files
    )
    if joined.statistics or joined.subset_sha256.get(
        "train"
    ) != other.subset_sha256.get("train"):
        return joined
    return joined.model_copy(update={"statistics": other.statistics})


def is_here(
    entry: FileEntry, size: Size, root: Path, trusted: Manifest | None = None
) -> bool:
    """Return whether the working copy holds what an entry describes; what is trusted is
    not hashed.
    """
    path = size.folder(root) / entry.path
    if not path.is_file() or path.stat().st_size != entry.bytes:
        return False
    if trusted:
        known = trusted.entry(entry.scenario)
    else:
        known = None
    return (known is not None and known.file_sha256 == entry.file_sha256) or (
        file_sha256(path) == entry.file_sha256
    )


def fetch_entries(
    size: Size, root: Path, url: str, entries: Collection[FileEntry]
) -> None:
    """Fetch objects into the working copy, whose lock is held; each appears whole and
    right.
    """
    if not entries:
        return
    folder = size.folder(root)
    too_long = [e.scenario for e in entries if e.bytes > size.longest_file(e.scenario)]
    if too_long:
        raise WrongLengthError(
            "the store's manifest names longer files than there can be",
            where=f"{address_of(size, url, MANIFEST_NAME)}, scenarios "
            f"{spell_ids(too_long)}",
            expected=f"at most {size.longest_file(too_long[0])} bytes",
            got=next(entry.bytes for entry in entries if entry.scenario == too_long[0]),
            fix=_remedy(size, url),
        )
    wanted = {
        entry.scenario: Wanted(
            url=address_of(size, url, entry.path),
            target=folder / entry.path,
            limit=entry.bytes,
            length=entry.bytes,
            file_sha256=entry.file_sha256,
            content_sha256=entry.content_sha256,
            remedy=_remedy(size, url),
        )
        for entry in entries
    }
    with (
        _Ticker(url, len(entries), sum(entry.bytes for entry in entries)) as told,
        contextlib.closing(fetch_scenarios(wanted, told.count)) as arrivals,
    ):
        for _, absent in arrivals:
            if absent is not None:
                raise absent
            told.finished += 1


def gather(size: Size, root: Path, source: Path, manifest: Manifest) -> Manifest:
    """Take over what another root folder has finished and this one's manifest does not
    hold; return both's.

    Each job of an array generates some scenarios into a root folder of its own. The
    whole is then what one call would have left.
    """
    there = size.folder(source)
    here = size.folder(root)
    found = _gathered(size, root, source)
    taken = []
    new = []
    for entry in found.files:
        old = manifest.entry(entry.scenario)
        if old is None or (
            not old.twin_floor and old.content_sha256 == entry.content_sha256
        ):
            taken.append(entry)
            if (here / entry.path).exists():
                continue
            check_scenario(there / entry.path, entry.content_sha256)
            new.append(entry)
            with atomic_path(here / entry.path) as temporary:
                try:  # files are only ever replaced, so a shared one cannot change
                    os.link((there / entry.path).resolve(), temporary)
                except OSError:
                    shutil.copyfile(there / entry.path, temporary)
    note_entries(here, new)
    for environment in found.environments:
        manifest = merged(size, manifest, environment=environment)
    return merged(size, manifest, taken)


def gatherable(size: Size, root: Path, source: Path) -> tuple[int, ...]:
    """Return the scenarios that :func:`gather` would bring: finished there, and not
    here at all.
    """
    found = _gathered(size, root, source)
    known = read_or_empty(size, root)
    there = size.folder(source)
    here = size.folder(root)
    return tuple(
        entry.scenario
        for entry in found.files
        if known.entry(entry.scenario) is None
        and (there / entry.path).is_file()
        and not (here / entry.path).exists()
    )


def _gathered(size: Size, root: Path, source: Path) -> Manifest:
    found = read_manifest(source, size.split, size.name, size.major)
    if found is None or size.folder(source).resolve() == size.folder(root).resolve():
        raise UsageError(
            "nothing can be gathered from a folder",
            where=str(source),
            expected=f"a root folder with {size.split} {size.name} of another call of "
            f"lagbench generate",
            got="the folder to write to" if found else "no manifest of that data set",
        )
    return found


@contextlib.contextmanager
def writing(root: Path) -> Iterator[None]:
    """Bring nothing into a working copy from which this process writes to the store."""
    _written.add(root)
    try:
        yield
    finally:
        _written.discard(root)
        _asked.clear()


@contextlib.contextmanager
def quietly() -> Iterator[None]:
    """Say nothing on stderr about what is fetched."""
    token = _quiet.set(True)
    try:
        yield
    finally:
        _quiet.reset(token)


class _Ticker:
    """Tells on stderr how much has been fetched, where a person watches."""

    def __init__(self, url: str, objects: int, length: int) -> None:
        self._url = url
        self._objects = objects
        self._length = length
        self.finished = self._arrived = 0
        self._last = 0.0
        self._watched = watched() and not _quiet.get()

    def __enter__(self) -> _Ticker:
        self._tell()
        return self

    def __exit__(self, *_: object) -> None:
        self._tell(end="\n")

    def count(self, arrived: int) -> None:
        """Count bytes."""
        self._arrived += arrived
        if time.monotonic() - self._last > 0.2:
            self._tell()

    def _tell(self, end: str = "") -> None:
        self._last = time.monotonic()
        if self._watched:
            files = f"{self.finished} of {self._objects} files"
            share = f"{self._arrived / 1e6:.1f} of {self._length / 1e6:.1f} MB"
            sys.stderr.write(
                f"\rlagbench: fetching from {self._url}: {files}, {share} {end}"
            )
            sys.stderr.flush()
