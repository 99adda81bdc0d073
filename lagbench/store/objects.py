"""Objects by URL: read, list and put whole ones.

HTTP comes from the standard library; ``s3://``, ``file://`` and the rest are file
systems of fsspec.
"""

from __future__ import annotations

import http.client
import os
import shutil
import time
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol, TypeVar

from lagbench.atomic import atomic_path, write_atomically
from lagbench.errors import (
    DataError,
    LagbenchError,
    UsageError,
    WorkFailedError,
    require,
)

TIMEOUT = 30.0  # how long a store may be silent [s]
ATTEMPTS = 3
PAUSE = 1.0  # before the second attempt [s]; it doubles
BLOCK = 1 << 18  # bytes read at a time

Result = TypeVar("Result")

HTTP = ("http://", "https://")
S3 = ("s3://", "s3a://")
LOCAL = ("file://", "local://")


class NotInStoreError(DataError):
    """The store does not have the object."""


class StoreUnreachableError(WorkFailedError):
    """No answer from the store, or none but that it is busy or refuses."""


class WrongContentError(DataError):
    """An object has other content than datasets.yaml or the store's manifest says."""


def check_address(url: str) -> None:
    """Refuse what is no address of a store, before any store is asked.

    Raises:
        UsageError: an unknown kind of address, no host or bucket, or a password.
    """
    try:
        parts = urllib.parse.urlsplit(url)
    except ValueError as error:
        raise UsageError(f"not the address of a store: {error}", where=url) from error
    if "@" in parts.netloc:
        raise UsageError(
            "an address holds no user and no password; let the environment give them, "
            "as by AWS_PROFILE"
        )
    if parts.scheme not in _protocols():
        raise UsageError(
            "no such kind of address; name http://host/path, s3://bucket/prefix, or "
            "file:///path for a folder",
            where=url,
        )
    is_local = url.startswith(LOCAL)
    if not (parts.path if is_local else parts.netloc):
        raise UsageError("the address names no place behind ://", where=url)


def _protocols() -> list[str]:
    """Return the kinds of addresses; only commands that use a store load fsspec."""
    from fsspec import available_protocols  # type: ignore[import-untyped]

    return list(available_protocols())


def read_object(url: str, *, limit: int) -> bytes:
    """Return a small object.

    Raises:
        NotInStoreError: there is no such object.
        StoreUnreachableError: the store does not answer.
        DataError: it is longer than the limit [bytes].
    """

    def attempt() -> bytes:
        with _opened(url) as stream:
            return stream.read(limit + 1)

    content = _repeated(attempt, url)
    if len(content) > limit:
        raise DataError(f"an object is longer than {limit} bytes", where=url)
    return content


def download_object(
    url: str, path: Path, *, limit: int, report: Callable[[int], None]
) -> None:
    """Write an object to a file; after a fault it is fetched from its start.

    Args:
        url: address of the object.
        path: file to write.
        limit: most bytes that the object can have.
        report: receives how many more bytes have arrived; negative where an attempt
            failed.
    """

    def attempt() -> None:
        count = 0
        try:
            with _opened(url) as stream, path.open("wb") as file:
                while block := stream.read(BLOCK):
                    count += len(block)
                    report(len(block))
                    if count > limit:
                        raise DataError(
                            f"an object is longer than {limit} bytes", where=url
                        )
                    file.write(block)
        except BaseException:
            report(-count)
            raise

    _repeated(attempt, url)


def _repeated(attempt: Callable[[], Result], url: str) -> Result:
    """Return what an attempt returns; a store that does not answer is asked again."""
    for number in range(ATTEMPTS):
        try:
            with store_errors(url):
                return attempt()
        except StoreUnreachableError:
            if number + 1 == ATTEMPTS:
                raise
            time.sleep(PAUSE * 2**number)
    raise AssertionError


class _Readable(Protocol):
    def read(self, size: int, /) -> bytes:
        """Return at most so many bytes, none at the end."""


@contextmanager
def _opened(url: str) -> Iterator[_Readable]:
    """Open an object for reading."""
    check_address(url)
    if url.startswith(HTTP):
        address = urllib.parse.quote(url, safe=":/?&=%+,;~@!$'()*[]")
        request = urllib.request.Request(address, headers={"User-Agent": "lagbench"})
        with urllib.request.urlopen(request, timeout=TIMEOUT) as response:
            length = response.headers.get("Content-Length")
            yield _WholeStream(response, length)
        return
    system, path = _file_system(url)
    with system.open(path, "rb") as stream:
        yield stream


class _WholeStream:
    """A response that raises where it ends before the announced length."""

    def __init__(self, response: _Readable, length: str | None) -> None:
        self._response = response
        self._missing = int(length) if length else None

    def read(self, size: int, /) -> bytes:
        """Return at most so many bytes, none at the end."""
        block = self._response.read(size)
        if self._missing is not None:
            self._missing -= len(block)
            if not block and self._missing > 0:
                raise http.client.IncompleteRead(block, self._missing)
        return block


class Objects:
    """The folder of one data set version in a store of fsspec.

    Names of objects are relative to the folder.

    Raises:
        UsageError: the root is no such store.
    """

    def __init__(self, root: str, folder: str) -> None:
        check_address(root)
        if root.startswith(HTTP):
            raise UsageError(
                "nothing can be written over HTTP; name another --root", where=root
            )
        self.root = root
        self.url = f"{root}/{folder}"  # the store; ``<split>/<size>/v<MAJOR>`` in it
        with store_errors(self.url):
            self._system, self._path = _file_system(self.url)

    def sizes(self) -> dict[str, int]:
        """Return the length of every object by name [bytes].

        Raises:
            DataError: there is no such bucket.
        """
        check_bucket(self.root)
        with store_errors(self.url):
            objects = self._system.find(self._path, detail=True)
        prefix = self._path.rstrip("/") + "/"
        lengths = {}
        for path, details in objects.items():
            if path.startswith(prefix):
                lengths[path.removeprefix(prefix)] = int(details["size"])
        return lengths

    def read(self, name: str) -> bytes | None:
        """Return a small object; None where it is not there."""
        with store_errors(self.url):
            try:
                return bytes(self._system.cat_file(self._path_of(name)))
            except FileNotFoundError:
                return None

    def write(self, name: str, data: bytes) -> None:
        """Put a small object, whole or not at all."""
        with store_errors(self.url):
            if self.url.startswith(LOCAL):
                write_atomically(Path(self._path_of(name)), data)
            else:
                self._system.pipe_file(self._path_of(name), data)

    def put(self, name: str, source: Path) -> None:
        """Put a file as an object, whole or not at all."""
        with store_errors(self.url):
            if self.url.startswith(LOCAL):
                # On a file system a put is not atomic by itself.
                with atomic_path(Path(self._path_of(name))) as beside:
                    shutil.copyfile(source, beside)
            else:
                self._system.put_file(str(source), self._path_of(name))

    def _path_of(self, name: str) -> str:
        return f"{self._path.rstrip('/')}/{name}"


def check_bucket(url: str) -> None:
    """Raise a DataError where the bucket is missing, not where it is empty."""
    if not url.startswith(S3):
        return
    with store_errors(url):
        system, _ = _file_system(url)
        bucket = url.split("//", 1)[1].split("/")[0]
        if not system.exists(bucket):
            raise DataError("there is no such bucket; create it", where=url)


_systems: dict[tuple[object, ...], Any] = {}
"""File systems of fsspec, by kind of address and settings."""


def _file_system(url: str) -> tuple[Any, str]:
    """Return the file system of an address, and the address within it.

    No listing is cached: changes by other machines must be seen at once.
    """
    options: dict[str, Any] = {}
    if url.startswith(S3):
        require("s3fs", extra="s3")
        options["config_kwargs"] = {
            "connect_timeout": TIMEOUT,
            "read_timeout": TIMEOUT,
            "retries": {"total_max_attempts": 2},
        }
    import fsspec

    # Another endpoint or other credentials are another system within one process.
    settings = [item for item in os.environ.items() if item[0].startswith("AWS_")]
    key = (url.partition("/")[0], urllib.parse.urlsplit(url).netloc, *sorted(settings))
    if key not in _systems:
        system, _ = fsspec.core.url_to_fs(
            url, use_listings_cache=False, skip_instance_cache=True, **options
        )
        _systems[key] = system
    system = _systems[key]
    return system, system._strip_protocol(url)


@contextmanager
def store_errors(url: str) -> Iterator[None]:
    """Turn what a library raises into errors that say what to do.

    Raises:
        NotInStoreError: the object is not there.
        StoreUnreachableError: the store refuses or does not answer.
    """
    try:
        yield
    except LagbenchError:
        raise
    except Exception as error:  # file systems raise what their libraries raise
        code = getattr(error, "code", None)
        if isinstance(error, FileNotFoundError) or code in (404, 410):
            raise NotInStoreError(
                "the store does not have the object", where=url
            ) from error
        if isinstance(error, ImportError):
            raise UsageError(
                f"this kind of address needs another package: {error}", where=url
            ) from error
        raise StoreUnreachableError(
            f"the store does not answer or refuses ({type(error).__name__}: "
            f"{str(error)[:200]}); repeat the command later, or name another store",
            where=url,
        ) from error
