"""Objects by URL, through fsspec: read, list and put whole ones."""

from __future__ import annotations

import shutil
import tempfile
import time
import urllib.parse
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from lagbench.atomic import atomic_path
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
    # only commands that use a store load it
    from fsspec import available_protocols  # type: ignore[import-untyped]

    try:
        parts = urllib.parse.urlsplit(url)
    except ValueError as error:
        raise UsageError(f"not the address of a store: {error}", where=url) from error
    if "@" in parts.netloc:
        raise UsageError(
            "an address holds no user and no password; let the environment give them, "
            "as by AWS_PROFILE"
        )
    place = parts.path if url.startswith(LOCAL) else parts.netloc
    if parts.scheme not in available_protocols() or not place:
        raise UsageError(
            "no address of a store; name http://host/path, s3://bucket/prefix, or "
            "file:///path for a folder",
            where=url,
        )


def read_object(url: str, *, limit: int) -> bytes:
    """Return a small object.

    Raises:
        NotInStoreError: there is no such object.
        StoreUnreachableError: the store does not answer.
        DataError: it is longer than the limit [bytes].
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "object"
        download_object(url, path, limit=limit, report=lambda _: None)
        return path.read_bytes()


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
    check_address(url)
    from fsspec.callbacks import Callback  # type: ignore[import-untyped]

    class Counter(Callback):  # type: ignore[misc]
        def relative_update(self, inc: int = 1) -> None:
            super().relative_update(inc)
            report(inc)
            if self.value > limit:
                raise _length_error(url, limit)

    for attempt in range(ATTEMPTS):
        counter = Counter()
        try:
            with store_errors(url):
                system, name = _file_system(url)
                system.get_file(name, str(path), callback=counter)
            break
        except BaseException as error:
            report(-counter.value)
            if attempt + 1 == ATTEMPTS or not isinstance(error, StoreUnreachableError):
                raise
            time.sleep(PAUSE * 2**attempt)
    length = path.stat().st_size
    report(length - counter.value)
    if length > limit:
        raise _length_error(url, limit)


def _length_error(url: str, limit: int) -> DataError:
    return DataError(f"an object is longer than {limit} bytes", where=url)


class Objects:
    """The folder of one data set version in a store that can be written.

    Names of objects are relative to the folder.

    Args:
        root: address of the store.
        folder: ``<split>/<size>/v<MAJOR>`` in it.

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
        self.url = f"{root}/{folder}"
        with store_errors(self.url):
            self._system, path = _file_system(self.url)
        self._prefix = path.rstrip("/") + "/"

    def lengths(self) -> dict[str, int]:
        """Return the length of every object by name [bytes].

        Raises:
            DataError: there is no such bucket.
        """
        check_bucket(self.root)
        with store_errors(self.url):
            objects = self._system.find(self._prefix, detail=True)
        return {
            path.removeprefix(self._prefix): int(details["size"])
            for path, details in objects.items()
        }

    def put(self, name: str, source: Path) -> None:
        """Put a file as an object, whole or not at all."""
        with store_errors(self.url):
            if self.url.startswith(LOCAL):
                # On a file system a put is not atomic by itself.
                with atomic_path(Path(self._prefix + name)) as beside:
                    shutil.copyfile(source, beside)
            else:
                self._system.put_file(str(source), self._prefix + name)


def check_bucket(url: str) -> None:
    """Raise a DataError where the bucket is missing, not where it is empty."""
    if not url.startswith(S3):
        return
    with store_errors(url):
        system, path = _file_system(url)
        if not system.exists(path.split("/")[0]):
            raise DataError("there is no such bucket; create it", where=url)


def _file_system(url: str) -> tuple[Any, str]:
    """Return the file system of an address, and the address within it.

    No listing is cached: changes by other machines must be seen at once.
    """
    import fsspec

    options: dict[str, Any] = {}
    if url.startswith(S3):
        require("s3fs", extra="s3")
        options["config_kwargs"] = {
            "connect_timeout": TIMEOUT,
            "read_timeout": TIMEOUT,
            "retries": {"total_max_attempts": 2},
        }
    elif url.startswith(HTTP):
        aiohttp = require("aiohttp", extra="s3")
        timeout = aiohttp.ClientTimeout(sock_connect=TIMEOUT, sock_read=TIMEOUT)
        options["client_kwargs"] = {"timeout": timeout}
    system, path = fsspec.core.url_to_fs(url, use_listings_cache=False, **options)
    return system, path


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
    except FileNotFoundError as error:
        raise NotInStoreError(
            "the store does not have the object", where=url
        ) from error
    except ImportError as error:
        raise UsageError(
            f"this kind of address needs another package: {error}", where=url
        ) from error
    except Exception as error:  # file systems raise what their libraries raise
        raise StoreUnreachableError(
            f"the store does not answer or refuses ({type(error).__name__}: "
            f"{str(error)[:200]}); repeat the command later, or name another store",
            where=url,
        ) from error
