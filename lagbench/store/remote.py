"""A data set's objects in a store that fsspec knows: list, read, put whole, create if absent."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from lagbench.errors import DataError, LagbenchError, UsageError, WorkFailedError, require

__all__ = ["Remote", "check_bucket", "refusals_told", "translated"]

FIX_LINE = "see that the address and AWS_ENDPOINT_URL are right, then repeat the command: it goes on"
FIX_RIGHTS = (
    "see that AWS_PROFILE or AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY may read it, and write to it"
)
FIX_BUCKET = "create the bucket, or correct the address: --root or LAGBENCH_ROOT"

S3 = ("s3://", "s3a://")

_systems: dict[tuple[object, ...], Any] = {}

_CREDENTIALS = {"NoCredentialsError", "PartialCredentialsError", "ProfileNotFound", "TokenRetrievalError"}


class Remote:
    """The folder of one data set version in a store; names are relative to it."""

    def __init__(self, url: str, folder: str) -> None:
        self.root, self.url = url, f"{url}/{folder}"
        with refusals_told(self.url):
            self._system, self._path = file_system(self.url)
        self._local = bool({"file", "local"} & {*_protocols(self._system)})

    def sizes(self) -> dict[str, int]:
        """Return the length of every object by name [bytes]."""
        with refusals_told(self.url):
            try:
                found = self._system.find(self._path, detail=True)
            except FileNotFoundError:
                check_bucket(self.root)
                return {}
        prefix = self._path.rstrip("/") + "/"
        return {p.removeprefix(prefix): int(i["size"]) for p, i in found.items() if p.startswith(prefix)}

    def beside(self) -> list[str]:
        """Return the names of the objects that stand directly in the folder."""
        with refusals_told(self.url):
            try:
                found = self._system.ls(self._path, detail=False)
            except FileNotFoundError:
                return []
        return [str(path).rsplit("/", 1)[-1] for path in found]

    def read(self, name: str) -> bytes | None:
        """Return a small object; None where it is not there."""
        with refusals_told(self.url):
            try:
                return bytes(self._system.cat_file(self._at(name)))
            except FileNotFoundError:
                return None

    def write(self, name: str, data: bytes) -> None:
        """Put a small object, whole or not at all."""
        with refusals_told(self.url):
            if self._local:
                self._settle(name, lambda path: Path(path).write_bytes(data))
            else:
                self._system.pipe_file(self._at(name), data)

    def put(self, name: str, source: Path) -> None:
        """Put a file as an object, whole or not at all."""
        with refusals_told(self.url):
            if self._local:
                self._settle(name, lambda path: self._system.put_file(str(source), path))
            else:
                self._system.put_file(str(source), self._at(name))

    def create(self, name: str, data: bytes) -> bool:
        """Put an object only where none of that name is; return whether it was put."""
        path = self._at(name)
        with refusals_told(self.url):
            try:
                if self._local:
                    Path(path).parent.mkdir(parents=True, exist_ok=True)
                    with self._system.open(path, "xb") as out:
                        out.write(data)
                else:
                    self._system.pipe_file(path, data, mode="create")
            except FileExistsError:
                return False
            except OSError as error:
                # 409: another conditional put of the same name is under way.
                if error.errno == errno.EBUSY:
                    return False
                if error.errno == errno.ENOSYS:
                    raise WorkFailedError(
                        "the store knows no conditional put, so it has no lock",
                        where=self.url,
                        fix="generate to a local folder and copy it there, the manifest last",
                    ) from error
                raise
        return True

    def remove(self, name: str) -> None:
        """Remove an object; one that is not there is no fault."""
        with refusals_told(self.url):
            try:
                self._system.rm_file(self._at(name))
            except FileNotFoundError:
                return

    def _at(self, name: str) -> str:
        return f"{self._path.rstrip('/')}/{name}"

    def _settle(self, name: str, write: Any) -> None:  # noqa: ANN401 (returns anything)
        """Write beside the target and rename: on a file system a put is not atomic by itself."""
        target = Path(self._at(name))
        target.parent.mkdir(parents=True, exist_ok=True)
        beside = target.with_name(f".{target.name}.{os.getpid()}.partial")
        try:
            write(str(beside))
            beside.replace(target)
        finally:
            beside.unlink(missing_ok=True)


def file_system(url: str) -> tuple[Any, str]:
    """Return the file system of fsspec that an address belongs to, and the address within it.

    Nothing is remembered of what it holds: what other machines do must be seen at once.
    """
    if url.startswith(S3):
        require("s3fs", extra="s3")
    import fsspec  # type: ignore[import-untyped]

    scheme = url.split("://", 1)[0]
    # Another endpoint or other credentials are another system, also within one process.
    key = (scheme, *sorted(item for item in os.environ.items() if item[0].startswith("AWS_")))
    if key not in _systems:
        _systems[key], _ = fsspec.core.url_to_fs(url, use_listings_cache=False, skip_instance_cache=True)
    system = _systems[key]
    return system, system._strip_protocol(url)


def check_bucket(url: str) -> None:
    """Tell a missing bucket from one that holds nothing here."""
    if not url.startswith(S3):
        return
    bucket = url.split("//", 1)[1].split("/")[0]
    with refusals_told(url):
        system, _ = file_system(url)
        if not system.exists(bucket):
            raise _no_bucket(url, bucket)


@contextmanager
def refusals_told(url: str) -> Iterator[None]:
    """Turn what a file system of fsspec raises into errors that say what to do."""
    try:
        yield
    except LagbenchError:
        raise
    except Exception as error:  # file systems raise what their libraries raise
        raise translated(error, url) from error


def translated(error: Exception, url: str) -> LagbenchError:
    """Return the error of ours that an exception of a file system means."""
    kind, got = type(error).__name__, f"{type(error).__name__}: {str(error)[:300]}"
    if isinstance(error, ImportError):
        return UsageError("this kind of address needs another package", where=url, got=got, fix=str(error))
    if isinstance(error, ValueError) and "rotocol" in str(error):
        return UsageError(
            "no such kind of address",
            where=url,
            expected="s3://bucket/prefix, or another that fsspec knows; or a folder",
            got=str(error),
        )
    if isinstance(error, FileNotFoundError):
        return _no_bucket(url, url.split("//")[-1].split("/")[0])
    if kind in _CREDENTIALS:
        return WorkFailedError("no credentials for the store", where=url, got=got, fix=FIX_RIGHTS)
    if isinstance(error, PermissionError):
        return WorkFailedError("the store refuses", where=url, got=got, fix=FIX_RIGHTS)
    return WorkFailedError("the store does not answer or fails", where=url, got=got, fix=FIX_LINE)


def _no_bucket(url: str, bucket: str) -> DataError:
    return DataError("there is no such bucket", where=url, got=bucket, fix=FIX_BUCKET)


def _protocols(system: Any) -> tuple[str, ...]:  # noqa: ANN401 (fsspec is untyped)
    named = system.protocol
    return (named,) if isinstance(named, str) else tuple(named)
