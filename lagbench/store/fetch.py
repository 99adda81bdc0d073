"""Fetch objects of a store: resumed by range, bounded in length and time, checked.

An object gets its name once it is checked. Every fault of a store has an error of its
own, see :mod:`.objects`. After a broken connection the next attempt goes on where it
broke; after wrong data nothing of that object stays.
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
from lagbench.data.hdf5 import SIGNATURE, open_hdf5
from lagbench.data.scenario import check_scenario
from lagbench.data.structure import Structure, check_structure
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
LEAST_RATE = 4096.0  # bytes per second below which an object is given up
RATE_SECONDS = 60.0  # seconds of waiting over which the rate is measured
ATTEMPTS = 5  # attempts in a row that bring nothing before we give up
MOST_ATTEMPTS = 100  # attempts at one object at all, however little each brings
PAUSE = 0.5  # pause after the first failed attempt [s]; it doubles
RESUME_HINT = "the same command goes on where it stopped"

Result = TypeVar("Result")


@dataclass(frozen=True, kw_only=True)
class FetchRequest:
    """A scenario's file in a store, and what is known of it."""

    url: str
    target: Path  # path of the file; its temporary name is beside that
    limit: int  # most bytes of a file of this kind
    content_sha256: str  # content hash that it must have, whole or its first digits
    length: int | None = None  # bytes that it has, where the store's manifest says so
    file_sha256: str | None = None  # SHA-256 of its bytes, likewise
    hint: str  # how the user mends a store with wrong data


def partial_name(target: Path) -> Path:
    """Return the temporary name of a file that is being fetched."""
    return target.with_name(f".{target.name}.download{SUFFIX}")


def fetch_text(url: str, *, limit: int, hint: str) -> bytes:
    """Return a small object; after a broken connection it is fetched from its start."""
    rate = TransferRate(url)

    def attempt() -> bytes:
        with closing(open_object(url, 0, hint=hint)) as answer:
            return b"".join(receive(answer, rate, limit=limit, hint=hint))

    return retry(attempt, url)


def fetch_scenarios(
    requests: Mapping[int, FetchRequest],
    report: Callable[[int], None],
    *,
    connections: int = CONNECTIONS,
) -> Generator[tuple[int, NotInStoreError | None], None, None]:
    """Fetch scenarios side by side; yield each once its file is checked and renamed.

    The caller must hold the lock of the data set. Closing the iterator stops the
    transfers. After a broken connection the temporary files stay, and the next attempt
    goes on from them; after wrong data no temporary file stays.

    Args:
        requests: files to fetch, by scenario id.
        report: receives how many more bytes have arrived; negative where bytes that had
            arrived were thrown away.
        connections: objects that are fetched side by side.

    Yields:
        Scenario id, and the error where the store does not have the object.
    """
    stop = threading.Event()
    lock = threading.Lock()

    def count(byte_count: int) -> None:
        if stop.is_set():
            raise _StoppedError
        with lock:
            report(byte_count)

    with ThreadPoolExecutor(max_workers=connections) as pool:
        pending = {}
        arrivals = {}
        for scenario, request in requests.items():
            arrivals[scenario] = _Arrival(count)
            transfer = pool.submit(_fetch, request, arrivals[scenario])
            pending[transfer] = scenario
        try:
            for transfer in as_completed(pending):
                scenario = pending[transfer]
                try:
                    is_resumed = transfer.result()
                    # Here and not in the threads: HDF5 is not safe in several threads.
                    _accept_fetched(
                        requests[scenario], arrivals[scenario], is_resumed=is_resumed
                    )
                except NotInStoreError as error:
                    yield scenario, error
                else:
                    yield scenario, None
        except DataError:
            stop.set()
            pool.shutdown(cancel_futures=True)
            for request in requests.values():
                partial_name(request.target).unlink(missing_ok=True)
            raise
        finally:
            stop.set()
            pool.shutdown(cancel_futures=True)


class _StoppedError(Exception):
    """The transfer of another object has failed."""


class _Arrival:
    """Counts the bytes of an object that arrive and are kept.

    Those of an earlier call do not count.
    """

    def __init__(self, report: Callable[[int], None]) -> None:
        self._report = report
        self._earlier_bytes: int | None = None  # None before the file was looked at
        self._counted_bytes = 0

    def reach(self, length: int) -> None:
        """Report by how many bytes the count changes, now that the file is so long."""
        if self._earlier_bytes is None:
            self._earlier_bytes = length
        self._earlier_bytes = min(self._earlier_bytes, length)
        byte_count = length - self._earlier_bytes
        self._report(byte_count - self._counted_bytes)
        self._counted_bytes = byte_count


def _length_of(path: Path) -> int:
    """Return the length of a file, 0 where there is none [bytes]."""
    try:
        return path.stat().st_size
    except FileNotFoundError:
        return 0


def _fetch(request: FetchRequest, arrival: _Arrival) -> bool:
    """Fetch one object under its temporary name, going on after an earlier attempt.

    Returns:
        Whether a part of the file is from an earlier attempt.
    """
    partial = partial_name(request.target)
    rate = TransferRate(request.url)

    def attempt() -> bool:
        arrival.reach(_length_of(partial))
        with partial.open("ab") as file:
            offset = file.tell()
            if offset and offset == request.length:
                return True
            with closing(open_object(request.url, offset, hint=request.hint)) as answer:
                if answer.start < offset:
                    file.seek(answer.start)
                    file.truncate()
                position = answer.start
                arrival.reach(position)
                blocks = receive(
                    answer,
                    rate,
                    limit=request.limit,
                    length=request.length,
                    begins=SIGNATURE,
                    hint=request.hint,
                )
                for block in blocks:
                    file.write(block)
                    position += len(block)
                    arrival.reach(position)
                return answer.start > 0

    with partial_file_errors(partial):
        return retry(attempt, request.url, partial)


def _accept_fetched(
    request: FetchRequest, arrival: _Arrival, *, is_resumed: bool
) -> None:
    """Accept a fetched file; fetch it anew where its first part may be another's.

    The store may have replaced the object since the earlier attempt, or a crash of the
    machine may have spoiled the part.
    """
    partial = partial_name(request.target)
    try:
        with partial_file_errors(partial):
            accept(request)
    except WrongContentError:
        if not is_resumed:
            raise
        _fetch(request, arrival)
        with partial_file_errors(partial):
            accept(request)


@contextmanager
def partial_file_errors(partial: Path) -> Iterator[None]:
    """Remove a temporary file after wrong data; keep it after any other error.

    An OSError here is one of the disk: those of the connection never arrive as such.
    """
    try:
        partial.parent.mkdir(parents=True, exist_ok=True)
        yield
    except DataError:
        partial.unlink(missing_ok=True)
        raise
    except OSError as error:
        raise WorkFailedError(
            "cannot write there",
            where=str(partial),
            expected="a folder that you may write to, on a disk with space",
            got=error.strerror or error,
            fix="--root names another folder",
        ) from error


def retry(
    attempt: Callable[[], Result],
    url: str,
    partial: Path | None = None,
    place: Callable[[], int] = lambda: 0,
) -> Result:
    """Repeat an attempt until it succeeds, or several in a row bring nothing.

    Args:
        attempt: raises BrokenError where another attempt may succeed.
        url: address of the object, for the message.
        partial: file whose length tells how far the attempts are.
        place: tells how far the attempts are, where there is no such file [bytes].

    Raises:
        ConnectionLostError: too many attempts.
    """

    def arrived_bytes() -> int:
        if partial is not None and partial.exists():
            return partial.stat().st_size
        return place()

    failures = 0
    has_restarted = False
    for _ in range(MOST_ATTEMPTS):
        bytes_before = arrived_bytes()
        try:
            return attempt()
        except BrokenError as broken:
            failures += 1
            if arrived_bytes() > bytes_before:
                failures = 0
            if failures >= ATTEMPTS or (broken.stale and has_restarted):
                raise broken.error from None
            if broken.stale and partial is not None:
                partial.unlink(missing_ok=True)
                has_restarted = True
            time.sleep(PAUSE * 2**failures)
    raise ConnectionLostError(
        "the connection to the store broke too often",
        where=url,
        expected="a whole file",
        got=f"{arrived_bytes()} bytes after {MOST_ATTEMPTS} attempts",
        fix=RESUME_HINT,
    )


class TransferRate:
    """How fast an object arrives, over all attempts at it."""

    def __init__(self, url: str) -> None:
        self.url = url
        self._byte_count = 0
        self._seconds = 0.0

    def count(self, byte_count: int, seconds: float) -> None:
        """Count bytes and the time that was spent on waiting for them.

        The rate is checked after each minute of waiting. Then the count begins anew.

        Raises:
            TooSlowError: too few bytes have arrived in this minute.
        """
        self._byte_count += byte_count
        self._seconds += seconds
        if self._seconds < RATE_SECONDS:
            return
        if self._byte_count < LEAST_RATE * self._seconds:
            raise TooSlowError(
                "the store sends too slowly",
                where=self.url,
                expected=f"at least {LEAST_RATE:g} bytes a second",
                got=f"{self._byte_count} bytes in {self._seconds:.0f} s",
                fix=RESUME_HINT,
            )
        self._byte_count = 0
        self._seconds = 0.0


def receive(
    answer: Answer,
    rate: TransferRate,
    *,
    limit: int,
    length: int | None = None,
    begins: bytes = b"",
    hint: str,
) -> Iterator[bytes]:
    """Yield what a store sends; refuse a page, a wrong length, and more than can be.

    Args:
        answer: the object that the store has begun to send.
        rate: counts bytes and time.
        limit: most bytes that such an object can have.
        length: its length, where it is known [bytes].
        begins: its first bytes.
        hint: how the user mends a store with wrong data.

    Raises:
        NotDataError: another kind of object, such as a page.
        WrongLengthError: the store announces or sends another length.
        TruncatedError: the object ends too early.
        BrokenError: the connection broke.
    """

    def refusal(
        kind: type[DataError], what: str, expected: str, got: str | None = None
    ) -> DataError:
        return kind(what, where=rate.url, expected=expected, got=got, fix=hint)

    position = answer.start
    blocks = _read_blocks(answer, rate)
    block = next(blocks, b"")
    is_other_format = position == 0 and not block.startswith(begins[: len(block)])
    if answer.page or is_other_format:
        words = block[:200].decode("utf-8", "replace").split()
        raise refusal(
            NotDataError,
            "the store sent something else than data",
            "a netCDF4 file or a manifest; a page may ask to log in",
            ascii(" ".join(words)[:80]),
        )
    most_bytes = limit
    expected_length = f"at most {limit} bytes"
    if length is not None:
        most_bytes = length
        expected_length = f"{length} bytes"
    total = answer.total
    if total is not None:
        is_too_long = total > limit
        is_other_length = length is not None and total != length
        if is_too_long or is_other_length:
            raise refusal(
                WrongLengthError,
                "the store announces another length",
                expected_length,
                f"{total} bytes",
            )

    while block:
        position += len(block)
        if position > most_bytes:
            what = "the store sends more than the object holds"
            raise refusal(WrongLengthError, what, f"at most {most_bytes} bytes")
        yield block
        block = next(blocks, b"")

    if total is not None and position < total:
        truncated = refusal(
            TruncatedError,
            "an object ends before the length that the store announces",
            f"{total} bytes",
            f"{position} bytes",
        )
        raise BrokenError(truncated)
    if length is not None and position != length:
        raise refusal(
            TruncatedError,
            "an object ends too early",
            f"{length} bytes",
            f"{position} bytes",
        )


def _read_blocks(answer: Answer, rate: TransferRate) -> Iterator[bytes]:
    """Yield the blocks of an answer; the last one is empty.

    Raises:
        BrokenError: the connection ended before the answer.
    """
    while True:
        started = time.monotonic()
        try:
            block = answer.read(BLOCK)
        except Exception as error:
            rate.count(0, time.monotonic() - started)
            lost = ConnectionLostError(
                "the connection to the store broke",
                where=rate.url,
                expected="a connection that stays",
                got=f"{type(error).__name__}: {error}",
                fix=RESUME_HINT,
            )
            raise BrokenError(lost) from error
        rate.count(len(block), time.monotonic() - started)
        yield block
        if not block:
            return


def accept(request: FetchRequest) -> None:
    """Give a fetched file its name once its content is right.

    Raises:
        WrongContentError: the file is damaged, or its hash is another.
    """
    partial = partial_name(request.target)
    try:
        _check_content(partial, request)
    except (DataError, UnreadableFileError) as error:
        reason = error.what
        if error.got is not None:
            reason = f"{error.what}: {error.got}"
        raise WrongContentError(
            "an object has other content",
            where=request.url,
            expected=f"content hash {request.content_sha256}",
            got=reason,
            fix=request.hint,
        ) from error
    with partial.open("rb") as stream:
        os.fsync(stream.fileno())
    partial.replace(request.target)


def _check_content(partial: Path, request: FetchRequest) -> None:
    # The bytes first: HDF5 should not read what a bad line has garbled.
    if request.file_sha256 is not None and file_sha256(partial) != request.file_sha256:
        raise DataError("its bytes are not those of the store's manifest")
    with open_hdf5(partial) as file:
        check_structure(file, partial, Structure(texts=True))
    check_scenario(partial, request.content_sha256)
