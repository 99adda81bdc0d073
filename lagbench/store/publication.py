"""Write a data set to a store: whole objects first, the manifest that names them last.

The data set's lock in the store is held all the while. What the store holds and is right is
neither simulated nor fetched. Objects are put as they are finished; now and then, after
them, and at the end, after the cards, comes the manifest, so that a machine that is lost costs
little and the manifest never names an object that is not there.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

from lagbench.data.checksums import file_sha256
from lagbench.data.layout import MANIFEST_NAME, dataset_folder, url_of
from lagbench.data.manifest import FileEntry, Manifest, merge, write_manifest
from lagbench.data.registry import Size
from lagbench.errors import DataError, LagbenchError

from .bringing import is_right, local_manifest, merged, remote_manifest, writing
from .fetching import fetch_scenarios
from .lease import Lease, lease
from .mirror_errors import NotDataError
from .remote import Remote

__all__ = ["Publication", "look_at", "publication"]

EVERY = 10.0
"""Least time between two manifests while scenarios are being finished [s]."""


class Publication:
    """A data set in a store, and the working copy that it is written from."""

    def __init__(self, size: Size, root: Path, remote: Remote, lock: Lease | None) -> None:
        self._size, self._root, self._remote, self._lock = size, root, remote, lock
        self._folder = dataset_folder(root, size.split, size.name, size.major)
        self._names = remote.sizes()
        found = self._read_manifest()
        # entries of the scenarios that the store holds and that are right, by id
        self.held = {
            e.scenario: e
            for e in found.files
            if is_right(e, size, found) and self._names.get(e.path) == e.bytes
        }
        self._there = {e.path: e.file_sha256 for e in self.held.values()}
        self._named = self._latest = found
        self._when = time.monotonic()

    def prepare(self) -> None:
        """Write the manifest of the working copy: what the store holds, and what only the copy does."""
        found = self._restricted(self._named)
        known = merged(self._size, self._root, found, local_manifest(self._size, self._root))
        if known.files:
            write_manifest(self._root, known)

    def bring(self, scenarios: Iterable[int]) -> None:
        """Fetch what the store holds of some scenarios and the working copy does not."""
        entries = [self.held[i] for i in scenarios if i in self.held]
        lacking = [e for e in entries if not self._is_local(e)]
        fetch_scenarios(self._size, self._root, self._remote.root, lacking)

    def is_settled(self, manifest: Manifest, cards: Mapping[str, bytes]) -> bool:
        """Return whether the store has this manifest, all that it names, and the cards."""
        if manifest != self._named or self._lacking(manifest):
            return False
        return all(self._remote.read(name) == text for name, text in cards.items())

    def follow(self, manifest: Manifest, *, at_once: bool = False) -> None:
        """Put what the manifest names and the store lacks; then, if it is time, the manifest."""
        self._latest = manifest
        for entry in self._lacking(manifest):
            self._put(entry)
        if at_once or time.monotonic() - self._when >= EVERY:
            self._put_manifest(manifest)

    def finish(self, manifest: Manifest, cards: Iterable[Path]) -> None:
        """Put the cards, and the manifest last."""
        self.follow(manifest)
        # The text comes after the pictures that it shows: where it is right, so are they.
        for path in reversed([*cards]):
            self._check()
            self._remote.put(path.relative_to(self._folder).as_posix(), path)
        self._put_manifest(manifest, anew=True)

    def save(self) -> None:
        """Put a manifest of what is there, after an interruption."""
        self._put_manifest(self._restricted(self._latest))

    def _put(self, entry: FileEntry) -> None:
        path = self._folder / entry.path
        if file_sha256(path) != entry.file_sha256:
            raise DataError(
                "a file of the working copy is another than its manifest says",
                where=str(path),
                fix=f"remove it, then lagbench generate with --root {self._remote.root}",
            )
        if self._named.entry(entry.scenario) is not None:
            # An object that is about to change must not be named meanwhile.
            self._there.pop(entry.path, None)
            self._put_manifest(self._restricted(self._named))
        self._check()
        self._remote.put(entry.path, path)
        self._there[entry.path] = entry.file_sha256
        self.held.pop(entry.scenario, None)  # it is here, and the store has ours

    def _put_manifest(self, manifest: Manifest, *, anew: bool = False) -> None:
        if manifest == self._named and not anew:
            return
        self._check()
        self._remote.write(MANIFEST_NAME, (manifest.model_dump_json(indent=1) + "\n").encode())
        self._named, self._when = manifest, time.monotonic()

    def _check(self) -> None:
        if self._lock is not None:
            self._lock.check()

    def _lacking(self, manifest: Manifest) -> list[FileEntry]:
        return [entry for entry in manifest.files if self._there.get(entry.path) != entry.file_sha256]

    def _restricted(self, manifest: Manifest) -> Manifest:
        """Return a manifest without what the store lacks."""
        lacking = self._lacking(manifest)
        if not lacking:
            return manifest
        files = tuple(entry for entry in manifest.files if entry not in lacking)
        return self._merge(manifest.model_copy(update={"files": files}))

    def _merge(self, base: Manifest | None) -> Manifest:
        size = self._size
        return merge(
            base,
            (),
            split=size.split,
            size=size.name,
            version=size.version,
            subsets=size.subsets,
            recorded=size.measured.scenario_sha256 if size.measured else None,
        )

    def _read_manifest(self) -> Manifest:
        try:
            found = remote_manifest(self._size, self._remote.root, fresh=0.0)
        except NotDataError:  # it is written anew from the files
            found = None
        return found or self._merge(None)

    def _is_local(self, entry: FileEntry) -> bool:
        path = self._folder / entry.path
        return (
            path.is_file() and path.stat().st_size == entry.bytes and file_sha256(path) == entry.file_sha256
        )


def look_at(size: Size, root: Path) -> Publication | None:
    """Return what a store holds of a data set, to look only; None for a root that is a plain folder."""
    url = url_of(root)
    return None if url is None else Publication(size, root, _remote(size, url), None)


@contextmanager
def publication(
    size: Size, root: Path, *, on_wait: Callable[[str], None] | None = None
) -> Iterator[Publication | None]:
    """Hold a data set of a store for writing; yield None for a root that is a plain folder."""
    url = url_of(root)
    if url is None:
        yield None
        return
    remote = _remote(size, url)
    with writing(root), lease(remote, on_wait=on_wait) as lock:
        held = Publication(size, root, remote, lock)
        held.prepare()
        try:
            yield held
        except BaseException:
            with suppress(LagbenchError):  # what is wrong is on its way to the user
                held.save()
            raise


def _remote(size: Size, url: str) -> Remote:
    return Remote(url, dataset_folder(Path(), size.split, size.name, size.major).as_posix())
