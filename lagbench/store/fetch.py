"""Fetch objects of a store: resumed by range, bounded in length and time, checked
before they get their name.

Whatever a store does wrong has an error of its own, see :mod:`.objects`. A broken line
is tried again from where it broke; a lie leaves nothing of that object.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Generator, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from lagbench.atomic import SUFFIX
from lagbench.data.checksums import file_sha256
from lagbench.data.hdf5 import SIGNATURE, Structure, check_structure, opened
from lagbench.data.scenario import check_scenario
from lagbench.errors import DataError, UnreadableFileError, WorkFailedError

from .objects import (
    Answer,
    BrokenError,
    ConnectionLostError,
    NotDataError,
    NotInStoreError,
    TooSlowError,
    TruncatedError,
    WrongContentError,
    WrongLengthError,
    open_object,
)

CONNECTIONS = 4  # objects that are fetched side by side
BLOCK = 1 << 18  # bytes read at a time
# bytes per second below which a store is refused, each object by itself
LEAST_RATE = 4096.0
PATIENCE = 60.0  # seconds of waiting over which the rate is measured
ATTEMPTS = 5  # attempts in a row that bring nothing before we give up
MOST_ATTEMPTS = 100  # attempts at one object at all, however little each brings
PAUSE = 0.5  # pause after the first failed attempt [s]; it doubles
FIX_LINE = "the same command goes on where it stopped"

T = TypeVar("T")


@dataclass(frozen=True, kw_only=True)
class Wanted:
    """A scenario's file in a store, and what is known of it."""

    url: str
    target: Path  # where it shall be; its temporary name is beside that
    limit: int  # bytes beyond which no file of this kind goes
    content_sha256: str  # content hash that it must have, whole or its first digits
    length: int | None = None  # bytes that it has, where the store's manifest says so
    file_sha256: str | None = None  # SHA-256 of its bytes, likewise
    remedy: str  # what helps where the store lies


def partial_name(target: Path) -> Path:
    """Return the temporary name of a file that is fetched; a later attempt goes on from
    it.
    """
    return target.with_name(f".{target.name}.download{SUFFIX}")


def fetch_text(url: str, *, limit: int, remedy: str) -> bytes:
    """Return a small object, tried again from its start where the line breaks."""
    pace = Pace(url)

    def attempt() -> bytes:
        with closing(open_object(url, 0, remedy=remedy)) as answer:
            return b"".join(received(answer, pace, limit=limit, remedy=remedy))

    return insist(attempt, url)


def fetch_scenarios(
    wanted: Mapping[int, Wanted],
    report: Callable[[int], None],
    *,
    connections: int = CONNECTIONS,
) -> Generator[tuple[int, NotInStoreError | None], None, None]:
    """Fetch scenarios side by side; yield each as its file has its name, or why the
    store has none.

    Hold the lock of the data set, and close the iterator: that stops what is under way.
    ``report`` is told the bytes that arrive. After a broken line temporary files stay,
    to go on from; after a lie none.
    """
    stop = threading.Event()
    lock = threading.Lock()

    def count(arrived: int) -> None:
        if stop.is_set():
            raise _StoppedError
        with lock:
            report(arrived)

    with ThreadPoolExecutor(max_workers=connections) as pool:
        pending = {pool.submit(_fetch, one, count): i for i, one in wanted.items()}
        try:
            for arrival in as_completed(pending):
                scenario = pending[arrival]
                try:
                    arrival.result()
                except NotInStoreError as error:
                    yield scenario, error
                else:
                    # Here and not in the threads: netCDF4 stands one at a time.
                    accept(wanted[scenario])
                    yield scenario, None
        except DataError:
            stop.set()
            pool.shutdown(cancel_futures=True)
            for one in wanted.values():
                partial_name(one.target).unlink(missing_ok=True)
            raise
        finally:
            stop.set()
            pool.shutdown(cancel_futures=True)


class _StoppedError(Exception):
    """Another object has failed."""


def _fetch(wanted: Wanted, report: Callable[[int], None]) -> None:
    """Fetch one object under its temporary name, going on where an earlier attempt
    stopped.
    """
    partial = partial_name(wanted.target)
    pace = Pace(wanted.url)

    def attempt() -> None:
        report(0)
        with partial.open("ab") as out:
            have = out.tell()
            if have and have == wanted.length:
                return
            with closing(open_object(wanted.url, have, remedy=wanted.remedy)) as answer:
                if answer.start < have:
                    out.seek(answer.start)
                    out.truncate()
                for block in received(
                    answer,
                    pace,
                    limit=wanted.limit,
                    length=wanted.length,
                    begins=SIGNATURE,
                    remedy=wanted.remedy,
                ):
                    out.write(block)
                    report(len(block))

    with saving(partial):
        insist(attempt, wanted.url, partial)


@contextmanager
def saving(partial: Path) -> Iterator[None]:
    """Write a temporary file: after a lie it goes, after a broken line it stays."""
    try:
        partial.parent.mkdir(parents=True, exist_ok=True)
        yield
    except DataError:
        partial.unlink(missing_ok=True)
        raise
    except OSError as error:
        got = error.strerror or error
        fix = "--root names another folder"
        raise WorkFailedError(
            "cannot write there", where=str(partial), got=got, fix=fix
        ) from error


def insist(
    attempt: Callable[[], T],
    url: str,
    partial: Path | None = None,
    place: Callable[[], int] = lambda: 0,
) -> T:
    """Attempt until it succeeds, or attempts bring a partial file, or a place, no
    further.
    """

    def held() -> int:
        if partial and partial.exists():
            return partial.stat().st_size
        return place()

    failures = 0
    restarted = False
    for _ in range(MOST_ATTEMPTS):
        before = held()
        try:
            return attempt()
        except BrokenError as broken:
            if held() > before:
                failures = 0
            else:
                failures = failures + 1
            if failures >= ATTEMPTS or (broken.stale and restarted):
                raise broken.error from None
            if broken.stale and partial:
                partial.unlink(missing_ok=True)
                restarted = True
            time.sleep(PAUSE * 2**failures)
    what = "the connection to the store broke too often"
    got = f"{held()} bytes after {MOST_ATTEMPTS} attempts"
    raise ConnectionLostError(what, where=url, got=got, fix=FIX_LINE)


class Pace:
    """How fast an object arrives, over all attempts at it."""

    def __init__(self, url: str) -> None:
        self.url = url
        self._arrived = 0
        self._waited = 0.0

    def count(self, arrived: int, seconds: float) -> None:
        """Count bytes and the time that they took; refuse a store that sends too
        little.
        """
        self._arrived += arrived
        self._waited += seconds
        if self._waited < PATIENCE:
            return
        if self._arrived < LEAST_RATE * self._waited:
            raise TooSlowError(
                "the store sends too slowly",
                where=self.url,
                expected=f"at least {LEAST_RATE:g} bytes a second",
                got=f"{self._arrived} bytes in {self._waited:.0f} s",
                fix=FIX_LINE,
            )
        self._arrived = 0
        self._waited = 0.0


def received(
    answer: Answer,
    pace: Pace,
    *,
    limit: int,
    length: int | None = None,
    begins: bytes = b"",
    remedy: str,
) -> Iterator[bytes]:
    """Yield what a store sends; refuse a page, another length than is known, and more
    than can be.
    """

    def refused(
        kind: type[DataError], what: str, expected: str, got: str | None = None
    ) -> DataError:
        return kind(what, where=pace.url, expected=expected, got=got, fix=remedy)

    place = answer.start
    blocks = _blocks(answer, pace)
    block = next(blocks, b"")
    if answer.page or (place == 0 and not block.startswith(begins[: len(block)])):
        text = " ".join(block[:200].decode("utf-8", "replace").split())
        expected = "a netCDF4 file or a manifest; a page may ask to log in"
        raise refused(
            NotDataError,
            "the store sent something else than data",
            expected,
            ascii(text[:80]),
        )
    total = answer.total
    if total is not None and (total > limit or total != (length or total)):
        expected = f"{length or f'at most {limit}'} bytes"
        raise refused(
            WrongLengthError,
            "the store announces another length",
            expected,
            f"{total} bytes",
        )
    if length is None:
        most = limit
    else:
        most = length
    while block:
        place += len(block)
        if place > most:
            what = "the store sends more than the object holds"
            raise refused(WrongLengthError, what, f"at most {most} bytes")
        yield block
        block = next(blocks, b"")
    if total is not None and place < total:
        what = "an object ends before the length that the store announces"
        raise BrokenError(
            refused(TruncatedError, what, f"{total} bytes", f"{place} bytes")
        )
    if length is not None and place != length:
        raise refused(
            TruncatedError,
            "an object ends too early",
            f"{length} bytes",
            f"{place} bytes",
        )


def _blocks(answer: Answer, pace: Pace) -> Iterator[bytes]:
    """Yield what arrives until the end; whatever a library raises is a broken line."""
    block = b"more"
    while block:
        started = time.monotonic()
        try:
            block = answer.read(BLOCK)
        except Exception as error:
            pace.count(0, time.monotonic() - started)
            what = "the connection to the store broke"
            got = f"{type(error).__name__}: {error}"
            raise BrokenError(
                ConnectionLostError(what, where=pace.url, got=got, fix=FIX_LINE)
            ) from error
        pace.count(len(block), time.monotonic() - started)
        yield block


def accept(wanted: Wanted) -> None:
    """Give a file its name once its content is right."""
    partial = partial_name(wanted.target)
    try:
        # The bytes first: HDF5 is best not given what a bad line has garbled.
        if (
            wanted.file_sha256 is not None
            and file_sha256(partial) != wanted.file_sha256
        ):
            raise DataError("its bytes are not those of the store's manifest")
        with opened(partial) as file:
            check_structure(file, partial, Structure(texts=True))
        check_scenario(partial, wanted.content_sha256)
    except (DataError, UnreadableFileError) as error:
        raise WrongContentError(
            "an object has other content",
            where=wanted.url,
            expected=f"content hash {wanted.content_sha256}",
            got=error.what if error.got is None else f"{error.what}: {error.got}",
            fix=wanted.remedy,
        ) from error
    with partial.open("rb") as stream:
        os.fsync(stream.fileno())
    partial.replace(wanted.target)
