"""Write a data set to a store: whole objects first, the manifest that names them last.

Right objects of the store are neither simulated nor fetched. A finished file is put at
once. The manifest follows now and then, and at the end after the cards. So a lost
machine costs little, and the manifest never names an object that is not there. There is
no lock: every writer of a scenario writes the same bits, and each new manifest keeps
the entries of other writers.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

from lagbench.data.checksums import file_sha256
from lagbench.data.layout import MANIFEST_NAME
from lagbench.data.manifest import FileEntry, Manifest, merge_entries, write_manifest
from lagbench.data.registry import Size
from lagbench.errors import DataError, LagbenchError

from .copy import (
    add_local_entries,
    fetch_entries,
    is_in_copy,
    join_manifests,
    matches_registry,
    remote_manifest,
    store_folder,
    suspend_fetching,
)
from .objects import Objects, WrongContentError

MANIFEST_SECONDS = 10.0
"""Least time between two manifests while scenarios are being finished [s]."""


class Publication:
    """A data set in a store, and the working copy that it is written from."""

    def __init__(self, size: Size, root: Path, url: str) -> None:
        self._size = size
        self._root = root
        self._folder = size.folder(root)
        self._objects = Objects(url, store_folder(size))
        lengths = self._objects.sizes()
        self._published = self._read_manifest()  # the manifest that is in the store
        self._latest = self._published  # the manifest of the working copy
        # entries of the right scenarios in the store, by id
        self.stored_entries: dict[int, FileEntry] = {}
        # SHA-256 of the objects in the store, by path
        self._object_hashes: dict[str, str] = {}
        # scenarios that another writer has added to the store's manifest meanwhile
        self._foreign_scenarios: set[int] = set()
        for entry in self._list_right_entries(self._published):
            has_possible_length = entry.bytes <= size.longest_file(entry.scenario)
            if has_possible_length and lengths.get(entry.path) == entry.bytes:
                self.stored_entries[entry.scenario] = entry
                self._object_hashes[entry.path] = entry.file_sha256
        self._last_manifest = time.monotonic()

    def prepare(self) -> None:
        """Write the manifest of the working copy, with the entries of the store."""
        stored_manifest = self._without_lacking(self._published)
        manifest = add_local_entries(self._size, self._root, stored_manifest)
        if manifest.files:
            write_manifest(self._root, manifest)

    def fetch(self, scenarios: Iterable[int]) -> None:
        """Fetch the scenarios of the store that the working copy lacks."""
        lacking = []
        for scenario in scenarios:
            entry = self.stored_entries.get(scenario)
            if entry is not None and not is_in_copy(entry, self._size, self._root):
                lacking.append(entry)
        fetch_entries(self._size, self._root, self._objects.root, lacking)

    def is_settled(self, manifest: Manifest, cards: Mapping[str, bytes]) -> bool:
        """Return whether the store has this manifest, its objects, and the cards."""
        if manifest != self._published or self._list_lacking(manifest):
            return False
        return all(self._objects.read(name) == text for name, text in cards.items())

    def put_files(self, manifest: Manifest, *, at_once: bool = False) -> None:
        """Put the files that the store lacks; then, if it is time, the manifest.

        Args:
            manifest: manifest of the working copy.
            at_once: whether to put the manifest now.

        Raises:
            DataError: a file has another hash than its entry.
        """
        self._latest = manifest
        for entry in self._list_lacking(manifest):
            self._put_file(entry)
        waited_seconds = time.monotonic() - self._last_manifest
        if at_once or waited_seconds >= MANIFEST_SECONDS:
            self._put_manifest(manifest)

    def finish(self, manifest: Manifest, cards: Iterable[Path]) -> None:
        """Put the cards, and the manifest last."""
        self.put_files(manifest)
        # The text comes after its pictures: where it is right, so are they.
        for path in reversed([*cards]):
            self._objects.put(path.relative_to(self._folder).as_posix(), path)
        self._put_manifest(manifest, anew=True)

    def save(self) -> None:
        """Put a manifest of the objects in the store, after an interruption."""
        self._put_manifest(self._without_lacking(self._latest))

    def _put_file(self, entry: FileEntry) -> None:
        path = self._folder / entry.path
        if file_sha256(path) != entry.file_sha256:
            raise DataError(
                "a file of the working copy is not the one that its manifest names; "
                "remove it and repeat the command",
                where=str(path),
            )
        if self._published.entry(entry.scenario) is not None:
            # The manifest must not name an object that is about to change.
            self._object_hashes.pop(entry.path, None)
            self._put_manifest(self._without_lacking(self._published))
        self._objects.put(entry.path, path)
        self._object_hashes[entry.path] = entry.file_sha256
        # The working copy has this file: it need not be fetched.
        self.stored_entries.pop(entry.scenario, None)

    def _put_manifest(self, manifest: Manifest, *, anew: bool = False) -> None:
        """Put a manifest with the entries that another writer has added meanwhile."""
        if manifest == self._published and not anew:
            return
        # What this writer has published and then taken out must not come back.
        published_scenarios = {entry.scenario for entry in self._published.files}
        known_scenarios = published_scenarios - self._foreign_scenarios
        for source in (self._latest, manifest):
            known_scenarios |= {entry.scenario for entry in source.files}
        stored_manifest = self._read_manifest()
        added_entries = []
        for entry in self._list_right_entries(stored_manifest):
            if entry.scenario not in known_scenarios:
                added_entries.append(entry)
                self._foreign_scenarios.add(entry.scenario)
        joined = join_manifests(self._size, manifest, stored_manifest, added_entries)
        text = joined.model_dump_json(indent=1) + "\n"
        self._objects.write(MANIFEST_NAME, text.encode())
        self._published = joined
        self._last_manifest = time.monotonic()

    def _list_lacking(self, manifest: Manifest) -> list[FileEntry]:
        """Return the entries whose files the store lacks."""
        lacking = []
        for entry in manifest.files:
            if self._object_hashes.get(entry.path) != entry.file_sha256:
                lacking.append(entry)
        return lacking

    def _without_lacking(self, manifest: Manifest) -> Manifest:
        """Return a manifest without the files that the store lacks."""
        lacking = self._list_lacking(manifest)
        if not lacking:
            return manifest
        files = tuple(entry for entry in manifest.files if entry not in lacking)
        reduced = manifest.model_copy(update={"files": files})
        return merge_entries(self._size, reduced)

    def _list_right_entries(self, manifest: Manifest) -> list[FileEntry]:
        right_entries = []
        for entry in manifest.files:
            if matches_registry(entry, self._size, manifest):
                right_entries.append(entry)
        return right_entries

    def _read_manifest(self) -> Manifest:
        """Return the store's manifest; an empty one where none can be read."""
        manifest = None
        with suppress(WrongContentError):  # it is written anew from the files
            manifest = remote_manifest(self._size, self._objects.root, fresh=0.0)
        return manifest or merge_entries(self._size, None)


def check_address(url: str) -> None:
    """Refuse an address where nothing can be written, before its copy is made."""
    Objects(url, "")


@contextmanager
def publish(size: Size, root: Path, url: str) -> Iterator[Publication]:
    """Yield a publication, through which the caller writes a data set to a store.

    The caller holds the lock of the working copy. While the publication lasts, nothing
    is fetched into the working copy unasked. After an error the store gets a manifest
    of the objects that it has.

    Args:
        size: the data set.
        root: working copy of the store.
        url: address of the store.

    Raises:
        DataError: the bucket does not exist.
        WorkFailedError: the store refuses or does not answer.
        UsageError: the package for this kind of address is not installed.
    """
    state = Publication(size, root, url)
    with suspend_fetching(root):
        try:
            state.prepare()
            yield state
        except BaseException:
            with suppress(LagbenchError):  # the first error is on its way to the user
                state.save()
            raise
