"""Objects by URL: open one from an offset on, list, read and put whole ones.

HTTP comes from the standard library, because resuming is what no downloader at hand
does (pooch and fsspec start over); ``s3://``, ``file://`` and the rest are file systems
of fsspec. What is the store's lie is a DataError, what is the line's fault a
WorkFailedError.
"""

from __future__ import annotations

import http.client
import os
import re
import shutil
import string
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from lagbench.atomic import atomic_path, write_atomically
from lagbench.errors import (
    DataError,
    LagbenchError,
    UsageError,
    WorkFailedError,
    require,
)

TIMEOUT = 30.0  # how long a store may be silent [s]
HTTP = ("http://", "https://")
S3 = ("s3://", "s3a://")
LOCAL = ("file://", "local://")

FIX_LINE = "see that the address and AWS_ENDPOINT_URL are right, then repeat the command: it goes on"

_BUSY = {408, 425, 429, 500, 502, 503, 504}
# no object has more bytes, and Python reads no endless number
_LENGTH = re.compile(r"\d{1,18}")
_RANGE = re.compile(r"bytes (\d{1,18})-(\d{1,18})/(\d{1,18}|\*)")

_systems: dict[tuple[object, ...], Any] = {}


class NotInStoreError(DataError):
    """The store does not have the object."""


class StoreUnreachableError(WorkFailedError):
    """No answer from the store, or none but that it is busy or refuses."""


class TooSlowError(StoreUnreachableError):
    """The store sends less than the least rate."""


class ConnectionLostError(WorkFailedError):
    """The connection broke, and went on breaking."""


class NotDataError(DataError):
    """The store sent something else than data: an error page, a login form."""


class TruncatedError(DataError):
    """An object ends before the length that the store announces."""


class WrongLengthError(DataError):
    """The store announces or sends another length than the object has."""


class WrongContentError(DataError):
    """An object has other content than datasets.yaml means."""


class BrokenError(Exception):
    """An attempt that ended early; another may go on from there."""

    def __init__(
        self, error: WorkFailedError | DataError, *, stale: bool = False
    ) -> None:
        super().__init__(str(error))
        self.error = error  # what to raise when no other attempt is made
        self.stale = stale  # whether what is there already has to go first


@dataclass(frozen=True, kw_only=True)
class Answer:
    """An object that a store has begun to send."""

    read: Callable[[int], bytes]  # returns at most so many bytes, none at the end
    close: Callable[[], None]
    start: int  # the offset asked for, or 0 where the store starts over
    total: int | None  # length of the whole object as announced; None where none is
    page: bool = False  # whether the store says itself that it is a page to look at


def open_object(url: str, offset: int, *, remedy: str) -> Answer:
    """Ask for an object from an offset on; the answer may start over at 0.

    The remedy is what helps where the store has not what it should have.
    """
    return (_open_http if url.startswith(HTTP) else _open_fsspec)(url, offset, remedy)


def _open_http(url: str, offset: int, remedy: str) -> Answer:
    headers = {"User-Agent": "lagbench", "Accept-Encoding": "identity"}
    if offset:
        headers["Range"] = f"bytes={offset}-"
    try:
        parts = urllib.parse.urlsplit(url)
        if not parts.hostname:
            raise ValueError("it names no host")
        # Percent-encoded, but for what is encoded already.
        path, query = (
            urllib.parse.quote(p, safe=string.punctuation)
            for p in (parts.path, parts.query)
        )
        address = parts._replace(path=path, query=query).geturl()
        response = _OPENER.open(
            urllib.request.Request(address, headers=headers), timeout=TIMEOUT
        )
    except urllib.error.HTTPError as error:
        with closing(error):
            raise _refusal_of_status(error, url, offset, remedy) from None
    except (ValueError, http.client.InvalidURL) as error:  # time would not mend it
        what = "not the address of a store"
        expected = "http://host/path"
        raise UsageError(what, where=url, expected=expected, got=str(error)) from error
    except (OSError, http.client.HTTPException) as error:
        got = f"{type(error).__name__}: {getattr(error, 'reason', error)}"
        fix = "repeat the command later: it goes on where it stopped"
        silent = StoreUnreachableError(
            "the store does not answer", where=url, got=got, fix=fix
        )
        raise BrokenError(silent) from error
    start = 0
    total = response.headers.get("Content-Length")
    if response.status == http.client.PARTIAL_CONTENT:
        match = _RANGE.fullmatch(response.headers.get("Content-Range", ""))
        if offset and (match is None or int(match[1]) != offset):
            response.close()
            return _open_http(url, 0, remedy)
        start, total = (offset, match[3]) if match else (0, None)
    return Answer(
        # read() would wait for a whole block, and so for ever where a byte comes now
        # and then.
        read=response.read1,
        close=response.close,
        start=start,
        total=int(total) if total is not None and _LENGTH.fullmatch(total) else None,
        page=response.headers.get_content_type()
        in ("text/html", "application/xhtml+xml"),
    )


def _refusal_of_status(
    error: urllib.error.HTTPError, url: str, offset: int, remedy: str
) -> Exception:
    """Return the error that an HTTP status means."""
    code = error.code
    if code in (404, 410):
        got = f"HTTP status {code}"
        return NotInStoreError(
            "the store does not have the object", where=url, got=got, fix=remedy
        )
    if code == http.client.REQUESTED_RANGE_NOT_SATISFIABLE and offset:
        truncated = TruncatedError(
            "an object ends before the length that the store announced",
            where=url,
            expected=f"more than {offset} bytes",
            got=f"HTTP status {code}",
            fix=remedy,
        )
        return BrokenError(truncated, stale=True)
    got = f"HTTP status {code}: {str(error.reason)[:200]!a}"
    refused = StoreUnreachableError("the store refuses", where=url, got=got, fix=remedy)
    if code in _BUSY:
        return BrokenError(refused)
    return refused


class _Redirections(urllib.request.HTTPRedirectHandler):
    """Tells a store that leads to no address from an address that the user mistyped."""

    def http_error_302(
        self,
        req: urllib.request.Request,
        fp: IO[bytes],
        code: int,
        msg: str,
        headers: http.client.HTTPMessage,
    ) -> Any:  # noqa: ANN401
        try:
            return super().http_error_302(req, fp, code, msg, headers)
        except (ValueError, http.client.InvalidURL) as error:
            raise NotDataError(
                "the store leads to no address", where=req.full_url, got=str(error)
            ) from error

    http_error_301 = http_error_303 = http_error_307 = http_error_308 = http_error_302


# For http and https alone: a redirection leads to no file of this machine.
_OPENER = urllib.request.OpenerDirector()
for _handler in (
    urllib.request.ProxyHandler,
    urllib.request.HTTPHandler,
    urllib.request.HTTPSHandler,
    _Redirections,
    urllib.request.HTTPDefaultErrorHandler,
    urllib.request.HTTPErrorProcessor,
    urllib.request.UnknownHandler,
):
    _OPENER.add_handler(_handler())


def _open_fsspec(url: str, offset: int, remedy: str) -> Answer:
    try:
        system, path = _file_system(url)
        total = system.info(path)["size"]
        stream = system.open(path, "rb")
        if offset <= total:
            start = offset
        else:
            start = 0
        stream.seek(start)
    except LagbenchError:
        raise
    except FileNotFoundError:
        raise NotInStoreError(
            "the store does not have the object", where=url, fix=remedy
        ) from None
    except Exception as error:  # file systems raise what their libraries raise
        refused = _refusal(error, url)
        # botocore has tried its own errors again by itself, and no right comes with
        # time.
        again = isinstance(error, OSError) and not isinstance(error, PermissionError)
        if again and isinstance(refused, WorkFailedError):
            raise BrokenError(refused) from error
        raise refused from error
    return Answer(read=stream.read, close=stream.close, start=start, total=total)


class Objects:
    """The folder of one data set version in a store of fsspec; names are relative to
    it.

    A root that is no such store is a UsageError.
    """

    def __init__(self, root: str, folder: str) -> None:
        self.root = root
        self.url = f"{root}/{folder}"  # the store; ``<split>/<size>/v<MAJOR>`` in it
        if root.startswith(HTTP):
            raise UsageError(
                "nothing can be written over HTTP",
                where=root,
                fix="name another --root",
            )
        with _refusals(self.url):
            self._system, self._path = _file_system(self.url)

    def sizes(self) -> dict[str, int]:
        """Return the length of every object by name [bytes]; a missing bucket is a
        DataError.
        """
        with _refusals(self.url):
            try:
                found = self._system.find(self._path, detail=True)
            except FileNotFoundError:
                check_bucket(self.root)
                return {}
        prefix = self._path.rstrip("/") + "/"
        return {
            p.removeprefix(prefix): int(i["size"])
            for p, i in found.items()
            if p.startswith(prefix)
        }

    def read(self, name: str) -> bytes | None:
        """Return a small object; None where it is not there."""
        with _refusals(self.url):
            try:
                return bytes(self._system.cat_file(self._at(name)))
            except FileNotFoundError:
                return None

    def write(self, name: str, data: bytes) -> None:
        """Put a small object, whole or not at all."""
        with _refusals(self.url):
            if self.url.startswith(LOCAL):
                write_atomically(Path(self._at(name)), data)
            else:
                self._system.pipe_file(self._at(name), data)

    def put(self, name: str, source: Path) -> None:
        """Put a file as an object, whole or not at all: after a fault the old one is
        there, or none.
        """
        with _refusals(self.url):
            if self.url.startswith(LOCAL):
                # On a file system a put is not atomic by itself.
                with atomic_path(Path(self._at(name))) as beside:
                    shutil.copyfile(source, beside)
            else:
                self._system.put_file(str(source), self._at(name))

    def _at(self, name: str) -> str:
        return f"{self._path.rstrip('/')}/{name}"


def check_bucket(url: str) -> None:
    """Tell a missing bucket, which is a DataError, from one that holds nothing here."""
    if not url.startswith(S3):
        return
    with _refusals(url):
        system, _ = _file_system(url)
        if not system.exists(_bucket(url)):
            raise FileNotFoundError


def _bucket(url: str) -> str:
    return url.split("//", 1)[1].split("/")[0]


def _file_system(url: str) -> tuple[Any, str]:
    """Return the file system of fsspec that an address belongs to, and the address
    within it.

    Nothing is remembered of what it holds: what other machines do must be seen at once.
    """
    if url.startswith(S3):
        require("s3fs", extra="s3")
    import fsspec  # type: ignore[import-untyped]

    scheme = url.split("://", 1)[0]
    if scheme not in fsspec.available_protocols():
        expected = "s3://bucket/prefix, or another that fsspec knows; file:///path for a folder"
        raise UsageError(
            "no such kind of address", where=url, expected=expected, got=scheme
        )
    # Another endpoint or other credentials are another system, also within one process.
    key = (
        scheme,
        *sorted(item for item in os.environ.items() if item[0].startswith("AWS_")),
    )
    if key not in _systems:
        _systems[key], _ = fsspec.core.url_to_fs(
            url, use_listings_cache=False, skip_instance_cache=True
        )
    system = _systems[key]
    return system, system._strip_protocol(url)


@contextmanager
def _refusals(url: str) -> Iterator[None]:
    """Turn what a file system of fsspec raises into errors that say what to do."""
    try:
        yield
    except LagbenchError:
        raise
    except Exception as error:  # file systems raise what their libraries raise
        raise _refusal(error, url) from error


def _refusal(error: Exception, url: str) -> LagbenchError:
    """Return the error of ours that an exception of a file system means."""
    got = f"{type(error).__name__}: {str(error)[:300]}"
    if isinstance(error, ImportError):
        return UsageError(
            "this kind of address needs another package",
            where=url,
            got=got,
            fix=str(error),
        )
    if isinstance(error, FileNotFoundError):
        fix = "create the bucket, or correct the address: --root or LAGBENCH_ROOT"
        return DataError(
            "there is no such bucket", where=url, got=_bucket(url), fix=fix
        )
    refused = isinstance(error, PermissionError)
    if url.startswith(S3):
        from botocore import exceptions as boto  # type: ignore[import-untyped]

        refused |= isinstance(
            error, (boto.NoCredentialsError, boto.PartialCredentialsError)
        )
        refused |= isinstance(error, (boto.ProfileNotFound, boto.TokenRetrievalError))
    if refused:
        keys = "AWS_PROFILE or AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY"
        fix = f"see that {keys} may read it, and write to it"
        return StoreUnreachableError("the store refuses", where=url, got=got, fix=fix)
    return StoreUnreachableError(
        "the store does not answer or fails", where=url, got=got, fix=FIX_LINE
    )
