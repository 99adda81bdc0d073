"""Fetch scenarios into a working copy from its store, write them to it, or gather them
from other root folders.

The store's manifest names its objects. A fetched object gets its name once its content
hash is that of datasets.yaml, or of the manifest where datasets.yaml has none.
Files of the working copy that match the manifest are not fetched again.

There is no lock on a store: every writer of a scenario writes the same bits, an object
is put before the manifest names it, and each new manifest keeps the entries of others.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import time
from collections.abc import Collection, Iterable, Iterator, Sequence
from pathlib import Path

from pydantic import ValidationError

from lagbench.atomic import atomic_path
from lagbench.data.checksums import file_sha256
from lagbench.data.layout import (
    CARD_NAME,
    MANIFEST_NAME,
    format_ids,
    url_of,
)
from lagbench.data.local import suggest_repair
from lagbench.data.lock import dataset_lock
from lagbench.data.manifest import (
    MANIFEST_LIMIT,
    FileEntry,
    Manifest,
    merge_entries,
    read_manifest,
    read_or_empty,
    record_entry_hashes,
    write_manifest,
)
from lagbench.data.registry import Size
from lagbench.data.scenario import check_scenario
from lagbench.errors import DataError, UsageError, suggest_name
from lagbench.work.machine import may_differ

from .fetch import FetchRequest, fetch_scenarios
from .objects import (
    NotInStoreError,
    Objects,
    WrongContentError,
    check_bucket,
    read_object,
)

FRESH_SECONDS = 30.0
"""How long a store's manifest is not asked for again by this process [s]."""

_manifests: dict[str, tuple[float, Manifest | None]] = {}
"""Time of the last answer and manifest, by address."""

_copies_of_writers: list[Path] = []
"""Working copies from which this process writes to a store, one for each data set."""


def object_address(size: Size, url: str, name: str) -> str:
    """Return the address of an object of a data set in a store."""
    return f"{url}/{store_folder(size)}/{name}"


def store_folder(size: Size) -> str:
    """Return the folder of a data set below the root of a store."""
    return size.folder(Path()).as_posix()


def parse_manifest(size: Size, text: bytes, *, where: str) -> Manifest:
    """Return a store's manifest.

    Raises:
        WrongContentError: the text is no manifest, or that of another data set.
    """
    try:
        manifest = Manifest.model_validate_json(text)
    except ValidationError as error:
        raise WrongContentError(
            f"the store's manifest.json is no manifest of lagbench: {error}",
            where=where,
        ) from error
    if not manifest.is_of(size.split, size.name, size.major):
        raise WrongContentError(
            f"the store's manifest is not of {size.split} {size.name}, version "
            f"{size.major}",
            where=where,
        )
    return manifest


def refuse_foreign_hashes(
    size: Size, manifest: Manifest, foreign_scenarios: Collection[int], *, where: str
) -> None:
    """Refuse a store whose manifest has other content hashes than the record."""
    if foreign_scenarios:
        raise WrongContentError(
            f"scenarios {format_ids(foreign_scenarios)} of the store have other hashes "
            f"than {size.record_name}; name another store",
            where=where,
        )


def scenario_files(size: Size, root: Path, subsets: Sequence[str]) -> dict[int, Path]:
    """Return the files of subsets by id, fetched where the root is a working copy.

    Raises:
        UsageError: unknown subset.
        DataError: scenarios are missing, or a folder may not be read.
    """
    paths = {}
    for subset in subsets:
        if not isinstance(subset, str) or subset not in size.subsets:
            raise UsageError(
                f"no subset {subset!r}; {suggest_name(str(subset), size.subsets)}",
                where=f"{size.split} {size.name}",
            )
        for scenario in size.subsets[subset]:
            paths[scenario] = size.path(root, scenario)
    update_working_copy(size, root, paths)

    missing = []
    for scenario, path in paths.items():
        if not path.is_file():
            missing.append(scenario)
    if missing:
        incomplete_subsets = []
        for subset in subsets:
            if not set(missing).isdisjoint(size.subsets[subset]):
                incomplete_subsets.append(subset)
        names = ",".join(incomplete_subsets)
        options = [f"--subset {names}"]
        if "train" in incomplete_subsets:
            # whoever trains will need the other subsets too
            options = []
        raise DataError(
            f"{len(missing)} of {len(paths)} scenarios are not there "
            f"({format_ids(missing)} of {names}); "
            f"{suggest_repair(size, *options, root=root)}",
            where=str(size.folder(root)),
        )
    return paths


# --- the working copy of a store ------------------------------------------------------


def update_working_copy(
    size: Size, root: Path, scenarios: Iterable[int] = (), *, thoroughly: bool = False
) -> None:
    """Fetch the manifest and some scenarios, where the root is a working copy.

    The caller has to miss the file of a scenario that the store does not have.

    Args:
        size: the data set.
        root: root folder; for a plain folder nothing happens.
        scenarios: scenarios to fetch.
        thoroughly: hash files of the copy, and do not only compare their lengths.

    Raises:
        DataError: the store holds wrong data.
        WorkFailedError: the store does not answer.
    """
    url = url_of(root)
    if url is None or root in _copies_of_writers:
        return
    manifest = remote_manifest(size, url)
    if manifest is None:
        return
    entries = []
    foreign_scenarios = []
    for scenario in scenarios:
        entry = manifest.entry(scenario)
        if entry is not None:
            entries.append(entry)
            if not matches_registry(entry, size, manifest):
                foreign_scenarios.append(scenario)
    where = object_address(size, url, MANIFEST_NAME)
    refuse_foreign_hashes(size, manifest, foreign_scenarios, where=where)

    local_manifest = read_or_empty(size, root)
    trusted = None if thoroughly else local_manifest
    lacking = [e for e in entries if not is_in_copy(e, size, root, trusted)]
    if not lacking and manifest == local_manifest:
        return
    with dataset_lock(root, size.split, size.name, size.major):
        # Another process may have fetched some meanwhile.
        lacking = [e for e in lacking if not is_in_copy(e, size, root)]
        fetch_entries(size, root, url, lacking)
        write_manifest(root, manifest)


def remote_manifest(
    size: Size, url: str, *, fresh: float | None = None
) -> Manifest | None:
    """Return the manifest of a data set in a store; None where there is none.

    Args:
        size: the data set.
        url: root of the store.
        fresh: age up to which an earlier answer counts [s]; FRESH_SECONDS by default.
    """
    if fresh is None:
        fresh = FRESH_SECONDS
    address = object_address(size, url, MANIFEST_NAME)
    if address in _manifests:
        answered, manifest = _manifests[address]
        if time.monotonic() - answered < fresh:
            return manifest
    manifest = None
    try:
        text = read_object(address, limit=MANIFEST_LIMIT)
    except NotInStoreError:
        check_bucket(url)
    else:
        manifest = parse_manifest(size, text, where=address)
    _manifests[address] = (time.monotonic(), manifest)
    return manifest


def matches_registry(entry: FileEntry, size: Size, manifest: Manifest) -> bool:
    """Return whether an entry of a manifest has the hash of datasets.yaml.

    A file of a machine that promises no equal bits may differ, as it may in a local
    folder.
    """
    if entry.scenario not in size.scenarios:
        return False
    if size.measured is None:
        return True
    if entry.has_hash(size.measured.scenario_sha256.get(entry.scenario)):
        return True
    is_tolerant = manifest.identity == "tolerance"
    return is_tolerant and may_differ(entry.device, manifest.environments)


def is_in_copy(
    entry: FileEntry, size: Size, root: Path, trusted: Manifest | None = None
) -> bool:
    """Return whether the working copy holds the file of an entry.

    The bytes are hashed, unless the trusted manifest has the same entry.
    """
    path = size.folder(root) / entry.path
    if not path.is_file() or path.stat().st_size != entry.bytes:
        return False
    if trusted is not None:
        trusted_entry = trusted.entry(entry.scenario)
        if trusted_entry is not None and trusted_entry.file_sha256 == entry.file_sha256:
            return True
    return file_sha256(path) == entry.file_sha256


def fetch_entries(
    size: Size, root: Path, url: str, entries: Collection[FileEntry]
) -> None:
    """Fetch objects into the working copy; each appears whole and right.

    The caller holds the lock of the working copy.

    Raises:
        DataError: the store holds wrong data.
        WorkFailedError: the store does not answer, or the disk is full.
    """
    if not entries:
        return
    requests = {}
    for entry in entries:
        if entry.bytes > size.longest_file(entry.scenario):
            raise WrongContentError(
                f"scenario {entry.scenario} has an impossible length in the manifest",
                where=object_address(size, url, MANIFEST_NAME),
            )
        requests[entry.scenario] = FetchRequest(
            url=object_address(size, url, entry.path),
            target=size.folder(root) / entry.path,
            limit=entry.bytes,
            length=entry.bytes,
            file_sha256=entry.file_sha256,
            content_sha256=entry.content_sha256,
        )
    with contextlib.closing(fetch_scenarios(requests, lambda _: None)) as arrivals:
        for _, error in arrivals:
            if error is not None:
                raise error


class Publication:
    """A data set in a store, and the working copy that it is written from.

    Raises:
        DataError: the bucket does not exist.
        WorkFailedError: the store refuses or does not answer.
        UsageError: nothing can be written there, or a package is not installed.
    """

    def __init__(self, size: Size, root: Path, url: str) -> None:
        self._size = size
        self._root = root
        self._objects = Objects(url, store_folder(size))
        # right entries of the store whose objects are there, by id
        self._manifest = self._read_manifest()
        self.stored_entries = self._read_entries(self._manifest)

    def _read_manifest(self) -> Manifest:
        """Return the store's manifest; an empty one where none can be read."""
        manifest = None
        with contextlib.suppress(WrongContentError):  # it is written anew
            manifest = remote_manifest(self._size, self._objects.root, fresh=0.0)
        return manifest or merge_entries(self._size, None)

    def _read_entries(self, manifest: Manifest) -> dict[int, FileEntry]:
        lengths = self._objects.lengths()
        entries = {}
        for entry in manifest.files:
            is_whole = lengths.get(entry.path) == entry.bytes
            if is_whole and matches_registry(entry, self._size, manifest):
                entries[entry.scenario] = entry
        return entries

    def join(self, local: Manifest) -> Manifest:
        """Return the store's manifest with what only the working copy has."""
        files = tuple(self.stored_entries.values())
        stored = self._manifest.model_copy(update={"files": files})
        own = [e for e in local.files if e.scenario not in self.stored_entries]
        return merge_entries(self._size, stored, own)

    def has_card(self) -> bool:
        """Return whether the store has a card of the data set."""
        return CARD_NAME in self._objects.lengths()

    def fetch(self, scenarios: Iterable[int]) -> None:
        """Fetch the scenarios of the store that the working copy lacks."""
        lacking = []
        for scenario in scenarios:
            entry = self.stored_entries.get(scenario)
            if entry is not None and not is_in_copy(entry, self._size, self._root):
                lacking.append(entry)
        fetch_entries(self._size, self._root, self._objects.root, lacking)

    def put_files(self, manifest: Manifest, cards: Iterable[Path] = ()) -> None:
        """Put the files that the store lacks, the cards, and the manifest last.

        The manifest keeps the entries that other writers have added.

        Raises:
            DataError: a file has another hash than its entry.
        """
        size = self._size
        folder = size.folder(self._root)
        stored_manifest = self._read_manifest()
        stored = self._read_entries(stored_manifest)
        for entry in manifest.files:
            known = stored.pop(entry.scenario, None)
            if known is not None and known.file_sha256 == entry.file_sha256:
                continue
            path = folder / entry.path
            if file_sha256(path) != entry.file_sha256:
                raise DataError(
                    "a file of the working copy is not the one that its manifest "
                    "names; remove it and repeat the command",
                    where=str(path),
                )
            self._objects.put(entry.path, path)
        for path in cards:
            self._objects.put(path.relative_to(folder).as_posix(), path)

        for environment in stored_manifest.environments if stored else ():
            manifest = merge_entries(size, manifest, environment=environment)
        if stored:
            manifest = merge_entries(size, manifest, stored.values())
        if manifest != stored_manifest:
            path = write_manifest(self._root, manifest)
            self._objects.put(MANIFEST_NAME, path)


@contextlib.contextmanager
def publish(size: Size, root: Path, url: str) -> Iterator[Publication]:
    """Yield a publication, through which the caller writes a data set to a store.

    The caller holds the lock of the working copy. Meanwhile nothing is fetched into it
    unasked.
    """
    _copies_of_writers.append(root)
    try:
        yield Publication(size, root, url)
    finally:
        _copies_of_writers.remove(root)
        _manifests.clear()


# --- other root folders ---------------------------------------------------------------


def gather(size: Size, root: Path, source: Path, manifest: Manifest) -> Manifest:
    """Take over finished scenarios of another root folder; return the joint manifest.

    Each job of an array generates some scenarios into a root folder of its own. The
    result is what one call would have left. A file that the root folder has stays. It
    is not named where only the source has an entry, of another file.

    Args:
        size: the data set.
        root: root folder to take them to.
        source: the other root folder.
        manifest: manifest of the data set in the root folder.

    Raises:
        UsageError: the source has no such data set, or is the root folder.
        DataError: a file of the source is damaged.
    """
    source_folder = size.folder(source)
    target_folder = size.folder(root)
    source_manifest = read_manifest(source, size.split, size.name, size.major)
    is_same = source_folder.resolve() == target_folder.resolve()
    if source_manifest is None or is_same:
        raise UsageError(
            f"nothing of {size.split} {size.name} can be gathered there; name the "
            "--root of another call of lagbench generate",
            where=str(source),
        )
    taken_entries = []
    new_entries = []
    for entry in source_manifest.files:
        # A source of another minor version may have more scenarios.
        if entry.scenario not in size.subsets.get(entry.subset, ()):
            continue
        old_entry = manifest.entry(entry.scenario)
        target = target_folder / entry.path
        if old_entry is not None:
            is_same_content = old_entry.content_sha256 == entry.content_sha256
            if is_same_content and not old_entry.twin_floor:
                # The file there may be packed otherwise: its own entry stays.
                limit = {"twin_floor": entry.twin_floor}
                taken_entries.append(old_entry.model_copy(update=limit))
        elif not target.exists():
            new_entries.append(entry)
        elif target.is_file() and file_sha256(target) == entry.file_sha256:
            taken_entries.append(entry)
    for entry in new_entries:
        check_scenario(source_folder / entry.path, entry.content_sha256)
        with atomic_path(target_folder / entry.path) as temporary:
            # Files are only ever replaced, so a shared one cannot change.
            try:
                os.link((source_folder / entry.path).resolve(), temporary)
            except OSError:
                shutil.copyfile(source_folder / entry.path, temporary)
    record_entry_hashes(target_folder, new_entries)
    for environment in source_manifest.environments:
        manifest = merge_entries(size, manifest, environment=environment)
    return merge_entries(size, manifest, [*taken_entries, *new_entries])
