"""Fetch scenarios from a store: each file gets its name once its content is right."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Generator, Mapping
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path

from lagbench.atomic import SUFFIX
from lagbench.data.checksums import file_sha256
from lagbench.data.scenario import check_scenario
from lagbench.errors import DataError, UnreadableFileError, WorkFailedError

from .objects import NotInStoreError, WrongContentError, download_object

CONNECTIONS = 4  # objects that are fetched side by side


@dataclass(frozen=True, kw_only=True)
class FetchRequest:
    """A scenario's file in a store, and what is known of it."""

    url: str
    target: Path  # path of the file; its temporary name is beside that
    limit: int  # most bytes of a file of this kind
    content_sha256: str  # content hash that it must have, whole or its first digits
    length: int | None = None  # bytes that it has, where the store's manifest says so
    file_sha256: str | None = None  # SHA-256 of its bytes, likewise


def partial_name(target: Path) -> Path:
    """Return the temporary name of a file that is being fetched."""
    return target.with_name(f".{target.name}.download{SUFFIX}")


def fetch_scenarios(
    requests: Mapping[int, FetchRequest],
    report: Callable[[int], None],
    *,
    connections: int = CONNECTIONS,
) -> Generator[tuple[int, NotInStoreError | None], None, None]:
    """Fetch scenarios side by side; yield each once its file is checked and renamed.

    The caller must hold the lock of the data set. Closing the iterator stops the
    transfers.

    Args:
        requests: files to fetch, by scenario id.
        report: receives how many more bytes have arrived; negative where an attempt
            failed.
        connections: objects that are fetched side by side.

    Yields:
        Scenario id, and the error where the store does not have the object.

    Raises:
        DataError: an object is not the one that was asked for.
        WorkFailedError: the store does not answer.
    """
    stop = threading.Event()
    lock = threading.Lock()

    def count(byte_count: int) -> None:
        with lock:
            report(byte_count)
        if stop.is_set() and byte_count > 0:
            raise WorkFailedError("the transfer of another object has failed")

    def fetch(request: FetchRequest) -> None:
        partial = partial_name(request.target)
        partial.parent.mkdir(parents=True, exist_ok=True)
        limit = request.limit if request.length is None else request.length
        download_object(request.url, partial, limit=limit, report=count)

    with ThreadPoolExecutor(max_workers=connections) as pool:
        pending = {}
        for scenario, request in requests.items():
            pending[pool.submit(fetch, request)] = scenario
        try:
            for transfer in as_completed(pending):
                scenario = pending[transfer]
                try:
                    transfer.result()
                except NotInStoreError as error:
                    yield scenario, error
                    continue
                # Here and not in the threads: HDF5 is not safe in several threads.
                accept(requests[scenario])
                yield scenario, None
        finally:
            stop.set()
            pool.shutdown(cancel_futures=True)
            for request in requests.values():
                partial_name(request.target).unlink(missing_ok=True)


def accept(request: FetchRequest) -> None:
    """Give a fetched file its name once its content is right.

    Raises:
        WrongContentError: the file is damaged, or its hash is another.
    """
    partial = partial_name(request.target)
    try:
        # The bytes first: HDF5 should not read what a bad line has garbled.
        expected_hash = request.file_sha256
        if expected_hash is not None and file_sha256(partial) != expected_hash:
            raise DataError("its bytes are not those of the store's manifest")
        check_scenario(partial, request.content_sha256)
    except (DataError, UnreadableFileError) as error:
        raise WrongContentError(
            f"an object is not the file with the content hash {request.content_sha256} "
            f"({error.text}); name another store",
            where=request.url,
        ) from error
    with partial.open("rb") as stream:
        os.fsync(stream.fileno())
    partial.replace(request.target)
