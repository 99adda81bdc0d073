"""Write a data set to a store: whole objects first, the manifest that names them last.

What the store holds and is right is neither simulated nor fetched. Objects are put as
they are finished; now and then, after them, and at the end, after the cards, comes the
manifest, so that a machine that is lost costs little and the manifest never names an
object that is not there. There is no lock: whoever writes a scenario writes the same
bits, and a manifest that is put keeps what another writer's names.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

from lagbench.data.checksums import file_sha256
from lagbench.data.layout import MANIFEST_NAME, url_of
from lagbench.data.local import root_url
from lagbench.data.manifest import FileEntry, Manifest, merged, write_manifest
from lagbench.data.registry import Size
from lagbench.errors import DataError, LagbenchError

from .copy import (
    fetch_entries,
    folder_of,
    is_here,
    is_right,
    join,
    remote_manifest,
    with_local,
    writing,
)
from .objects import NotDataError, Objects

EVERY = 10.0  # least time between two manifests while scenarios are being finished [s]


class Publication:
    """A data set in a store, and the working copy that it is written from."""

    def __init__(self, size: Size, root: Path, url: str) -> None:
        self._size = size
        self._root = root
        self._folder = size.folder(root)
        self._objects = Objects(url, folder_of(size))
        lengths = self._objects.sizes()
        self._named = self._latest = self._read_manifest()
        # Entries of the scenarios that the store holds and that are right, by id.
        right = [
            e
            for e in self._right(self._named)
            if e.bytes <= size.longest_file(e.scenario)
        ]
        self.held = {e.scenario: e for e in right if lengths.get(e.path) == e.bytes}
        self._there = {e.path: e.file_sha256 for e in self.held.values()}
        self._when = time.monotonic()

    def prepare(self) -> None:
        """Write the manifest of the working copy: what the store holds, and what only
        the copy does.
        """
        known = with_local(self._size, self._root, self._restricted(self._named))
        if known.files:
            write_manifest(self._root, known)

    def bring(self, scenarios: Iterable[int]) -> None:
        """Fetch what the store holds of some scenarios and the working copy does
        not.
        """
        entries = [self.held[i] for i in scenarios if i in self.held]
        lacking = [e for e in entries if not is_here(e, self._size, self._root)]
        fetch_entries(self._size, self._root, self._objects.root, lacking)

    def is_settled(self, manifest: Manifest, cards: Mapping[str, bytes]) -> bool:
        """Return whether the store has this manifest, all that it names, and the
        cards.
        """
        if manifest != self._named or self._lacking(manifest):
            return False
        return all(self._objects.read(name) == text for name, text in cards.items())

    def follow(self, manifest: Manifest, *, at_once: bool = False) -> None:
        """Put what the manifest names and the store lacks; then, if it is time, the
        manifest.

        A file that is another than the manifest says is a DataError.
        """
        self._latest = manifest
        for entry in self._lacking(manifest):
            self._put(entry)
        if at_once or time.monotonic() - self._when >= EVERY:
            self._put_manifest(manifest)

    def finish(self, manifest: Manifest, cards: Iterable[Path]) -> None:
        """Put the cards, and the manifest last."""
        self.follow(manifest)
        # The text comes after the pictures that it shows: where it is right, so are
        # they.
        for path in reversed([*cards]):
            self._objects.put(path.relative_to(self._folder).as_posix(), path)
        self._put_manifest(manifest, anew=True)

    def save(self) -> None:
        """Put a manifest of what is there, after an interruption."""
        self._put_manifest(self._restricted(self._latest))

    def _put(self, entry: FileEntry) -> None:
        path = self._folder / entry.path
        if file_sha256(path) != entry.file_sha256:
            what = "a file of the working copy is another than its manifest says"
            fix = f"remove it, then lagbench generate with --root {self._objects.root}"
            raise DataError(what, where=str(path), fix=fix)
        if self._named.entry(entry.scenario) is not None:
            # An object that is about to change must not be named meanwhile.
            self._there.pop(entry.path, None)
            self._put_manifest(self._restricted(self._named))
        self._objects.put(entry.path, path)
        self._there[entry.path] = entry.file_sha256
        self.held.pop(entry.scenario, None)  # it is here, and the store has ours

    def _put_manifest(self, manifest: Manifest, *, anew: bool = False) -> None:
        """Put a manifest with what another writer has named since we last did."""
        if manifest == self._named and not anew:
            return
        found = self._read_manifest()
        known = {
            e.scenario
            for e in (*self._named.files, *self._latest.files, *manifest.files)
        }
        others = [e for e in self._right(found) if e.scenario not in known]
        manifest = join(self._size, manifest, found, others)
        self._objects.write(
            MANIFEST_NAME, (manifest.model_dump_json(indent=1) + "\n").encode()
        )
        self._named = manifest
        self._when = time.monotonic()

    def _lacking(self, manifest: Manifest) -> list[FileEntry]:
        return [
            entry
            for entry in manifest.files
            if self._there.get(entry.path) != entry.file_sha256
        ]

    def _restricted(self, manifest: Manifest) -> Manifest:
        """Return a manifest without what the store lacks."""
        lacking = self._lacking(manifest)
        files = tuple(entry for entry in manifest.files if entry not in lacking)
        if lacking:
            return merged(self._size, manifest.model_copy(update={"files": files}))
        return manifest

    def _right(self, manifest: Manifest) -> list[FileEntry]:
        return [
            entry for entry in manifest.files if is_right(entry, self._size, manifest)
        ]

    def _read_manifest(self) -> Manifest:
        try:
            found = remote_manifest(self._size, self._objects.root, fresh=0.0)
        except NotDataError:  # it is written anew from the files
            found = None
        return found or merged(self._size, None)


def check_address(root: str | Path | None) -> None:
    """Refuse a root that is an address where nothing can be written, before a copy of
    it is made.
    """
    url = root_url(root)
    if url is not None:
        Objects(url, "")


def look_at(size: Size, root: Path) -> Publication | None:
    """Return what a store holds of a data set, to look only; None for a root that is a
    plain folder.
    """
    url = url_of(root)
    if url is None:
        return None
    return Publication(size, root, url)


@contextmanager
def publication(size: Size, root: Path) -> Iterator[Publication | None]:
    """Write a data set to a store; yield None for a root that is a plain folder.

    Hold the lock of the working copy. Until the end nothing is brought into it. Raises
    a DataError where the bucket does not exist, a WorkFailedError where the store
    refuses or does not answer, a UsageError where what reads this kind of address is
    not installed.
    """
    held = look_at(size, root)
    if held is None:
        yield None
        return
    with writing(root):
        try:
            held.prepare()
            yield held
        except BaseException:
            with suppress(LagbenchError):  # what is wrong is on its way to the user
                held.save()
            raise
