"""Objects by URL: open one from an offset on, list, read and put whole ones.

HTTP comes from the standard library, because no downloader at hand resumes (pooch and
fsspec start over); ``s3://``, ``file://`` and the rest are file systems of fsspec. A
wrong answer of the store is a DataError, a fault of the connection a WorkFailedError.
"""

from __future__ import annotations

import http.client
import ipaddress
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
    hide_credentials,
    require,
)

TIMEOUT = 30.0  # how long a store may be silent [s]

# An S3 store that accepts and never answers is given up after the product, a minute.
S3_TIMEOUT = 10.0  # how long one answer is waited for [s]
S3_ATTEMPTS = 2  # of botocore, also where the store is busy
S3_ROUNDS = 3  # of s3fs, each with so many attempts

HTTP = ("http://", "https://")
S3 = ("s3://", "s3a://")
LOCAL = ("file://", "local://")

LONGEST_SHOWN = 200  # of an address in a message

STORE_HINT = "name a store: --from URL, --root URL, or LAGBENCH_RELEASES=URL"
ADDRESS_HINT = (
    "see that the address and AWS_ENDPOINT_URL are right, then repeat the command: "
    "it goes on"
)

_BUSY_STATUSES = {408, 425, 429, 500, 502, 503, 504}
# No object has more bytes, and Python refuses to read an endless number.
_LENGTH = re.compile(r"\d{1,18}")
_RANGE = re.compile(r"bytes (\d{1,18})-(\d{1,18})/(\d{1,18}|\*)")

# A last label of digits, or of hexadecimal ones, makes a resolver read numbers.
_NUMBER = re.compile(r"[0-9]+|0[xX][0-9a-fA-F]*")

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
    """The store sent no data but an error page or a login form."""


class TruncatedError(DataError):
    """An object ends before the length that the store announces."""


class WrongLengthError(DataError):
    """The store announces or sends another length than the object has."""


class WrongContentError(DataError):
    """An object has another content hash than datasets.yaml."""


class BrokenError(Exception):
    """An attempt that ended early; another may go on from there."""

    def __init__(
        self, error: WorkFailedError | DataError, *, stale: bool = False
    ) -> None:
        super().__init__(str(error))
        self.error = error  # what to raise when no other attempt is made
        self.stale = stale  # whether the bytes that have arrived must be removed first


@dataclass(frozen=True, kw_only=True)
class Answer:
    """An object that a store has begun to send."""

    read: Callable[[int], bytes]  # returns at most so many bytes, none at the end
    close: Callable[[], None]
    start: int  # the offset asked for, or 0 where the store starts over
    total: int | None  # length of the whole object as announced; None where none is
    page: bool = False  # whether the store says itself that it is a page to look at


def open_object(url: str, offset: int, *, hint: str) -> Answer:
    """Ask for an object from an offset on; the answer may start over at 0.

    Args:
        url: address of the object.
        offset: first byte that is asked for.
        hint: how the user mends a store without the object.

    Raises:
        NotInStoreError: there is no such object.
        BrokenError: another attempt may succeed.
        StoreUnreachableError: the store refuses.
        UsageError: the address is none.
    """
    if url.startswith(HTTP):
        return _open_http(url, offset, hint)
    return _open_fsspec(url, offset, hint)


def check_address(url: str) -> None:
    """Refuse what is no address of a store, before any store is asked.

    Raises:
        UsageError: an unknown kind of address, or no host.
    """
    if url.startswith(HTTP):
        _require_http_address(url)
    else:
        _require_scheme(url)


def _require_http_address(url: str) -> str:
    """Return an HTTP address with unusual characters encoded."""
    try:
        return _percent_encode(url)
    except ValueError as error:
        raise _no_address(url, str(error)) from error


def _no_address(url: str, got: str) -> UsageError:
    return UsageError(
        "not the address of a store",
        where=_short_address(url),
        expected="http://host/path",
        got=got,
        fix=STORE_HINT,
    )


def _describe_fault(error: Exception, url: str) -> str:
    """Return what a library says of an address, unless that may hold a password."""
    if "@" in url:
        return "an address with an @ that cannot be read"
    return str(error)


def _open_http(url: str, offset: int, hint: str) -> Answer:
    headers = {"User-Agent": "lagbench", "Accept-Encoding": "identity"}
    if offset:
        headers["Range"] = f"bytes={offset}-"
    address = _require_http_address(url)
    try:
        request = urllib.request.Request(address, headers=headers)
        response = _OPENER.open(request, timeout=TIMEOUT)
    except urllib.error.HTTPError as error:
        with closing(error):
            raise _status_error(error, url, offset, hint) from None
    except (ValueError, http.client.InvalidURL) as error:  # time would not mend it
        raise _no_address(url, _describe_fault(error, url)) from error
    except (OSError, http.client.HTTPException) as error:
        unreachable = StoreUnreachableError(
            "the store does not answer",
            where=url,
            expected="an answer",
            got=f"{type(error).__name__}: {getattr(error, 'reason', error)}",
            fix="repeat the command later: it goes on where it stopped",
        )
        raise BrokenError(unreachable) from error

    start = 0
    total = response.headers.get("Content-Length")
    if response.status == http.client.PARTIAL_CONTENT:
        total = None
        match = _RANGE.fullmatch(response.headers.get("Content-Range", ""))
        if offset and (match is None or int(match[1]) != offset):
            response.close()
            return _open_http(url, 0, hint)
        if match is not None:
            start = offset
            total = match[3]
    content_type = response.headers.get_content_type()
    return Answer(
        # read() would wait for a whole block, and so for ever where a byte comes now
        # and then.
        read=response.read1,
        close=response.close,
        start=start,
        total=_parse_length(total),
        page=content_type in ("text/html", "application/xhtml+xml"),
    )


def _short_address(url: str) -> str:
    """Return an address for a message: its beginning, without user and password."""
    # a blank would end the address
    whole_address = re.sub(r"\s", "%20", url)
    if hide_credentials(whole_address) == whole_address:
        return url[:LONGEST_SHOWN]
    return hide_credentials(whole_address, mark="")[:LONGEST_SHOWN]


def _percent_encode(url: str) -> str:
    """Return an address with unusual characters encoded, but for encoded ones."""
    if hide_credentials(url) != url:
        # the message and the manifest would show it
        msg = "a user or a password before its host; an @ in its path is %40"
        raise ValueError(msg)
    try:
        parts = urllib.parse.urlsplit(url)
        _ = parts.port  # raises for one that is no number
    except ValueError as error:
        raise ValueError(_describe_fault(error, url)) from None
    if "@" in parts.netloc:
        msg = "a user or a password before its host"
        raise ValueError(msg)
    _check_host(parts.hostname)
    path = urllib.parse.quote(parts.path, safe=string.punctuation)
    query = urllib.parse.quote(parts.query, safe=string.punctuation)
    return parts._replace(path=path, query=query).geturl()


def _check_host(host: str | None) -> None:
    """Refuse a host that ends with a number and is no plain IPv4 address.

    ``0x7f.1`` and ``2130706433`` are this machine to a resolver, and no host to a
    reader.

    Raises:
        ValueError: there is no host, or it is such a host.
    """
    if not host:
        raise ValueError("it names no host")
    last_label = host.rstrip(".").rpartition(".")[2]
    if not _NUMBER.fullmatch(last_label):
        return
    try:
        ipaddress.IPv4Address(host)
    except ValueError:
        raise ValueError(
            "its host ends with a number, but is no address as in 192.0.2.1"
        ) from None


def _parse_length(text: str | None) -> int | None:
    if text is not None and _LENGTH.fullmatch(text):
        return int(text)
    return None


def _status_error(
    error: urllib.error.HTTPError, url: str, offset: int, hint: str
) -> Exception:
    """Return the error that an HTTP status means."""
    code = error.code
    if code in (404, 410):
        return NotInStoreError(
            "the store does not have the object",
            where=url,
            expected="the object",
            got=f"HTTP status {code}",
            fix=hint,
        )
    if code == http.client.REQUESTED_RANGE_NOT_SATISFIABLE and offset:
        truncated = TruncatedError(
            "an object ends before the length that the store announced",
            where=url,
            expected=f"more than {offset} bytes",
            got=f"HTTP status {code}",
            fix=hint,
        )
        return BrokenError(truncated, stale=True)
    refused = StoreUnreachableError(
        "the store refuses",
        where=url,
        expected="HTTP status 200",
        got=f"HTTP status {code}: {str(error.reason)[:200]!a}",
        fix=hint,
    )
    if code in _BUSY_STATUSES:
        return BrokenError(refused)
    return refused


class _Redirections(urllib.request.HTTPRedirectHandler):
    """Refuses a redirection to no address of HTTP, as a fault of the store."""

    def redirect_request(
        self,
        req: urllib.request.Request,
        fp: IO[bytes],
        code: int,
        msg: str,
        headers: http.client.HTTPMessage,
        newurl: str,
    ) -> urllib.request.Request | None:
        target = urllib.parse.urlsplit(newurl)
        if target.scheme not in ("http", "https"):
            raise ValueError(f"an address of the kind {target.scheme[:40]!a}")
        _check_host(target.hostname)
        return super().redirect_request(req, fp, code, msg, headers, newurl)

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
            fp.close()
            raise NotDataError(
                "the store leads to no address",
                where=req.full_url,
                expected="the address of a file",
                got=str(error),
                fix="name another store: --from",
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


def _open_fsspec(url: str, offset: int, hint: str) -> Answer:
    try:
        system, path = _file_system(url)
        total = system.info(path)["size"]
        stream = system.open(path, "rb")
        start = 0
        if offset <= total:
            start = offset
        stream.seek(start)
    except LagbenchError:
        raise
    except FileNotFoundError:
        raise NotInStoreError(
            "the store does not have the object",
            where=url,
            expected="the object",
            got="no such file",
            fix=hint,
        ) from None
    except Exception as error:  # file systems raise what their libraries raise
        store_error = _translate_error(error, url)
        # botocore has tried its own errors again by itself, as those of a silent store,
        # and no permission comes with time.
        may_pass = isinstance(error, OSError) and not isinstance(error, PermissionError)
        if may_pass and url.startswith(S3):
            may_pass = not isinstance(error, _botocore_errors().HTTPClientError)
        if may_pass and isinstance(store_error, WorkFailedError):
            raise BrokenError(store_error) from error
        raise store_error from error
    return Answer(read=stream.read, close=stream.close, start=start, total=total)


class Objects:
    """The folder of one data set version in a store of fsspec.

    Names of objects are relative to the folder.

    Raises:
        UsageError: the root is no such store.
    """

    def __init__(self, root: str, folder: str) -> None:
        self.root = root
        self.url = f"{root}/{folder}"  # the store; ``<split>/<size>/v<MAJOR>`` in it
        if root.startswith(HTTP):
            raise UsageError(
                "nothing can be written over HTTP",
                where=root,
                expected="a folder, or s3://bucket/prefix",
                got=root,
                fix="name another --root",
            )
        with _store_errors(self.url):
            self._system, self._path = _file_system(self.url)

    def sizes(self) -> dict[str, int]:
        """Return the length of every object by name [bytes].

        Raises:
            DataError: there is no such bucket.
        """
        with _store_errors(self.url):
            try:
                objects = self._system.find(self._path, detail=True)
            except FileNotFoundError:
                check_bucket(self.root)
                return {}
        prefix = self._path.rstrip("/") + "/"
        lengths = {}
        for path, details in objects.items():
            # An object with the folder's own name does not lie in it.
            if path.startswith(prefix):
                lengths[path.removeprefix(prefix)] = int(details["size"])
        return lengths

    def read(self, name: str) -> bytes | None:
        """Return a small object; None where it is not there."""
        with _store_errors(self.url):
            try:
                return bytes(self._system.cat_file(self._path_of(name)))
            except FileNotFoundError:
                return None

    def write(self, name: str, data: bytes) -> None:
        """Put a small object, whole or not at all."""
        with _store_errors(self.url):
            if self.url.startswith(LOCAL):
                write_atomically(Path(self._path_of(name)), data)
            else:
                self._system.pipe_file(self._path_of(name), data)

    def put(self, name: str, source: Path) -> None:
        """Put a file as an object, whole or not at all.

        After a fault the old object is there, or none.
        """
        with _store_errors(self.url):
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
    with _store_errors(url):
        system, _ = _file_system(url)
        if not system.exists(_bucket_of(url)):
            raise FileNotFoundError


def _bucket_of(url: str) -> str:
    return url.split("//", 1)[1].split("/")[0]


def _load_fsspec() -> Any:  # noqa: ANN401
    """Return the library of file systems; only commands that use a store load it."""
    import fsspec  # type: ignore[import-untyped]

    return fsspec


def _require_scheme(url: str) -> str:
    """Return the scheme of an address that fsspec knows.

    Raises:
        UsageError: fsspec does not know it, or there is none.
    """
    scheme, mark, place = url.partition("://")
    if mark and scheme in _load_fsspec().available_protocols():
        _require_place(url, place)
        return scheme
    fix = STORE_HINT
    if not mark and os.path.isdir(url):
        # Local file systems of fsspec decode no %20.
        fix = f"a folder has an address, too: file://{Path(url).resolve()}"
    raise UsageError(
        "no such kind of address",
        where=_short_address(url),
        expected="http://host/path, s3://bucket/prefix, or another that fsspec knows; "
        "file:///path for a folder",
        got=ascii(hide_credentials(scheme)[:LONGEST_SHOWN]),
        fix=fix,
    )


def _require_place(url: str, place: str) -> None:
    """Refuse an address without host, bucket or path, or with a user.

    Raises:
        UsageError: it is one of these.
    """
    if url.startswith(S3) and place.startswith("/"):
        place = ""
    if not place:
        raise UsageError(
            "the address names no place",
            where=_short_address(url),
            expected="a host, a bucket or a path behind ://",
            got="nothing",
            fix=STORE_HINT,
        )
    if hide_credentials(url) != url:
        raise UsageError(
            "a user or a password stands in the address; let the environment give "
            "them, as by AWS_PROFILE",
            where=_short_address(url),
        )


def _file_system(url: str) -> tuple[Any, str]:
    """Return the file system of an address, and the address within it.

    No listing is cached: changes by other machines must be seen at once.
    """
    if url.startswith(S3):
        require("s3fs", extra="s3")
    fsspec = _load_fsspec()
    scheme = _require_scheme(url)
    # Another endpoint or other credentials are another system, also within one process.
    settings = []
    for item in os.environ.items():
        if item[0].startswith("AWS_"):
            settings.append(item)
    # So is another host or account, where an address of its kind names one.
    system_class = fsspec.get_filesystem_class(scheme)
    place = system_class._get_kwargs_from_urls(url)
    key = (scheme, *sorted(settings), *sorted(place.items()))
    if key not in _systems:
        system, _ = fsspec.core.url_to_fs(
            url,
            use_listings_cache=False,
            skip_instance_cache=True,
            **_client_options(url),
        )
        if url.startswith(S3):
            system.retries = S3_ROUNDS
        _systems[key] = system
    system = _systems[key]
    return system, system._strip_protocol(url)


def _client_options(url: str) -> dict[str, Any]:
    """Return how long a client of S3 waits, and how often; nothing for other stores."""
    if not url.startswith(S3):
        return {}
    return {
        "config_kwargs": {
            "connect_timeout": S3_TIMEOUT,
            "read_timeout": S3_TIMEOUT,
            "retries": {"total_max_attempts": S3_ATTEMPTS},
        }
    }


@contextmanager
def _store_errors(url: str) -> Iterator[None]:
    """Turn what a file system of fsspec raises into errors that say what to do."""
    try:
        yield
    except LagbenchError:
        raise
    except Exception as error:  # file systems raise what their libraries raise
        raise _translate_error(error, url) from error


def _translate_error(error: Exception, url: str) -> LagbenchError:
    """Return the error of ours that an exception of a file system means."""
    message = f"{type(error).__name__}: {str(error)[:300]}"
    if hide_credentials(url) != url:
        # a library may show a part of the password
        message = type(error).__name__
    if isinstance(error, ImportError):
        return UsageError(
            "this kind of address needs another package",
            where=url,
            expected="the package that reads it",
            got=message,
            fix=str(error),
        )
    is_s3 = url.startswith(S3)
    if isinstance(error, FileNotFoundError) and is_s3:
        return DataError(
            "there is no such bucket",
            where=url,
            expected="a bucket that exists",
            got=_bucket_of(url),
            fix="create the bucket, or correct the address: --root or LAGBENCH_ROOT",
        )
    if isinstance(error, FileNotFoundError):
        return DataError(
            "the place is not there",
            where=url,
            expected="a folder that exists",
            got=message,
            fix="make the folder, or correct the address: --root or LAGBENCH_ROOT",
        )
    if _is_permission_error(error, url):
        user = "you"
        if is_s3:
            user = "AWS_PROFILE or AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY"
        return StoreUnreachableError(
            "the store refuses",
            where=url,
            expected="permission to read and write",
            got=message,
            fix=f"see that {user} may read it, and write to it",
        )
    return StoreUnreachableError(
        "the store does not answer or fails",
        where=url,
        expected="an answer",
        got=message,
        fix=ADDRESS_HINT,
    )


def _is_permission_error(error: Exception, url: str) -> bool:
    if isinstance(error, PermissionError):
        return True
    if not url.startswith(S3):
        return False
    exceptions = _botocore_errors()
    credential_errors = (
        exceptions.NoCredentialsError,
        exceptions.PartialCredentialsError,
        exceptions.ProfileNotFound,
        exceptions.TokenRetrievalError,
    )
    return isinstance(error, credential_errors)


def _botocore_errors() -> Any:  # noqa: ANN401
    """Return the module with the errors of S3; an error of it has loaded it before."""
    from botocore import exceptions  # type: ignore[import-untyped]

    return exceptions
