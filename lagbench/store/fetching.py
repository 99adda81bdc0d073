"""Fetch a store's objects into the working copy, side by side, each whole and right or not at all."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Collection, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

from lagbench.atomic import remove_leftovers
from lagbench.data.checksums import file_sha256
from lagbench.data.layout import dataset_folder
from lagbench.data.manifest import FileEntry
from lagbench.data.registry import Size
from lagbench.data.scenario import check_scenario
from lagbench.errors import DataError, WorkFailedError

from .mirror import Fetch, fetch
from .mirror_errors import NotDataError, NotOnMirrorError, WrongContentError

__all__ = ["address_of", "called_store", "fetch_scenarios", "quietly"]

CONNECTIONS = 4
"""Objects that are fetched side by side."""

FIX = "repeat the command: it goes on where it stopped"

_quiet: ContextVar[bool] = ContextVar("quiet", default=False)


def address_of(size: Size, url: str, name: str) -> str:
    """Return the address of an object of a data set in a store."""
    folder = dataset_folder(Path(), size.split, size.name, size.major).as_posix()
    return f"{url}/{folder}/{name}"


@contextmanager
def called_store() -> Iterator[None]:
    """Call the mirror a store in messages: to the user it is one, and there is no other to name."""
    try:
        yield
    except (DataError, WorkFailedError) as error:
        what = error.what.replace("the mirror", "the store")
        raise type(error)(
            what, where=error.where, expected=error.expected, got=error.got, fix=_remedy(error)
        ) from error


@contextmanager
def quietly() -> Iterator[None]:
    """Say nothing on stderr about what is fetched."""
    token = _quiet.set(True)
    try:
        yield
    finally:
        _quiet.reset(token)


def fetch_scenarios(size: Size, root: Path, url: str, entries: Collection[FileEntry]) -> None:
    """Fetch objects into the working copy, whose lock is held; each appears whole and right."""
    if not entries:
        return
    told = _Ticker(url, len(entries), sum(entry.bytes for entry in entries))
    folder = dataset_folder(root, size.split, size.name, size.major)
    wanted = [_wanted(address_of(size, url, entry.path), folder / entry.path, entry) for entry in entries]
    try:
        with told, called_store(), ThreadPoolExecutor(max_workers=CONNECTIONS) as pool:
            try:
                arrivals = pool.map(lambda one: fetch(one, report=told.count), wanted)
                # Checked here and not in the threads: netCDF4 stands one at a time.
                for one, entry, partial in zip(wanted, entries, arrivals, strict=True):
                    _accept(one, entry, partial)
                    told.finish()
            finally:
                told.stop()
                pool.shutdown(cancel_futures=True)
    except DataError:
        remove_leftovers(folder)
        raise


def _wanted(place: str, target: Path, entry: FileEntry) -> Fetch:
    return Fetch(url=place, target=target, limit=entry.bytes, length=entry.bytes, sha256=entry.file_sha256)


def _accept(wanted: Fetch, entry: FileEntry, partial: Path) -> None:
    """Give a file its name once its content is right."""
    try:
        # The bytes first: HDF5 is best not given what a bad line has garbled.
        if file_sha256(partial) != entry.file_sha256:
            raise DataError("its bytes are not those of the store's manifest")
        check_scenario(partial, entry.content_sha256)
    except DataError as error:
        raise WrongContentError(
            "an object of the store has other content",
            where=wanted.url,
            expected=f"content hash {entry.content_sha256}",
            got=error.what if error.got is None else f"{error.what}: {error.got}",
            fix="remove the object; lagbench generate with this --root writes it anew",
        ) from error
    with partial.open("rb") as stream:
        os.fsync(stream.fileno())
    partial.replace(wanted.target)


def _remedy(error: DataError | WorkFailedError) -> str:
    if isinstance(error, NotOnMirrorError | NotDataError):
        return "lagbench generate with this --root writes what is missing or damaged anew"
    return FIX if error.fix is None or "--from" in error.fix else error.fix


class _StoppedError(Exception):
    """Another object has failed."""


class _Ticker:
    """Tells on stderr how much has been fetched, where a person watches."""

    def __init__(self, url: str, objects: int, length: int) -> None:
        self._url, self._objects, self._length = url, objects, length
        self._arrived = self._finished = 0
        self._stopped, self._last = False, 0.0
        self._watched = sys.stderr.isatty() and not _quiet.get()

    def __enter__(self) -> None:
        self._tell()

    def __exit__(self, *_: object) -> None:
        if self._watched:
            self._tell()
            sys.stderr.write("\n")

    def count(self, arrived: int) -> None:
        """Count bytes; end the thread once another has failed."""
        if self._stopped:
            raise _StoppedError
        self._arrived += arrived
        if time.monotonic() - self._last > 0.2:
            self._tell()

    def finish(self) -> None:
        """Count an object."""
        self._finished += 1

    def stop(self) -> None:
        """End the other threads at their next block."""
        self._stopped = True

    def _tell(self) -> None:
        self._last = time.monotonic()
        if self._watched:
            share = f"{self._arrived / 1e6:.1f} of {self._length / 1e6:.1f} MB"
            sys.stderr.write(
                f"\rlagbench: fetching from {self._url}: {self._finished} of {self._objects} files, {share} "
            )
            sys.stderr.flush()
