"""Ask an address for a file, from an offset on.

HTTP comes from the standard library, because resuming is what no downloader at hand does (pooch
and fsspec start over); other addresses (``s3://``, ``file://``) are those of fsspec.
"""

from __future__ import annotations

import http.client
import re
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from typing import IO, Protocol

from lagbench.errors import UsageError

from .mirror_errors import (
    BrokenError,
    ConnectionLostError,
    MirrorUnreachableError,
    NotOnMirrorError,
    TruncatedError,
)
from .remote import FIX_RIGHTS, file_system, translated

__all__ = ["BLOCK", "Answer", "ask"]

TIMEOUT = 30.0
"""How long a mirror may be silent [s]."""

BLOCK = 1 << 18
"""Bytes read at a time."""

_GONE = {404, 410}
_BUSY = {408, 425, 429, 500, 502, 503, 504}
_RANGE = re.compile(r"bytes (\d+)-(\d+)/(\d+|\*)")
_PAGE = ("text/html", "application/xhtml+xml")


class Readable(Protocol):
    def read(self, size: int, /) -> bytes:
        """Return at most so many bytes; none at the end."""

    def close(self) -> None:
        """Close it."""


@dataclass(frozen=True)
class Answer:
    """What a mirror answers."""

    stream: Readable  # the bytes from 'start' on
    start: int  # the offset asked for, or 0 where the mirror starts over
    total: int | None  # length of the whole file as announced; None where none is
    page: bool = False  # whether it says itself that it is a page to look at

    def blocks(self, url: str) -> Iterator[bytes]:
        """Yield what arrives."""
        while True:
            try:
                block = self.stream.read(BLOCK)
            except (OSError, http.client.HTTPException) as error:
                raise BrokenError(
                    ConnectionLostError(
                        "the connection to the mirror broke",
                        where=url,
                        got=f"{type(error).__name__}: {error}",
                        fix="the same command goes on where it stopped",
                    )
                ) from error
            if not block:
                return
            yield block


def ask(url: str, offset: int) -> Answer:
    """Ask for a file from an offset on; the answer may start over at 0."""
    if not url.startswith(("http://", "https://")):
        return _ask_fsspec(url, offset)
    headers = {"User-Agent": "lagbench", "Accept-Encoding": "identity"}
    if offset:
        headers["Range"] = f"bytes={offset}-"
    try:
        response = _OPENER.open(urllib.request.Request(url, headers=headers), timeout=TIMEOUT)
    except urllib.error.HTTPError as error:
        with closing(error):
            raise _refusal(error, url, offset) from None
    except (OSError, http.client.HTTPException) as error:
        reason = getattr(error, "reason", error)
        raise BrokenError(
            MirrorUnreachableError(
                "the mirror does not answer",
                where=url,
                got=f"{type(error).__name__}: {reason}",
                fix="try later, or another mirror: --from",
            )
        ) from error
    page = response.headers.get_content_type() in _PAGE
    if response.status != http.client.PARTIAL_CONTENT:
        return Answer(response, 0, _number(response.headers.get("Content-Length")), page)
    match = _RANGE.fullmatch(response.headers.get("Content-Range", ""))
    if match is None or int(match[1]) != offset:
        response.close()
        return ask(url, 0) if offset else Answer(response, 0, None, page)
    return Answer(response, offset, _number(match[3]), page)


def _refusal(error: urllib.error.HTTPError, url: str, offset: int) -> Exception:
    """Return the error that a status means."""
    code = error.code
    if code in _GONE:
        return NotOnMirrorError("the mirror does not have the file", where=url, got=f"HTTP status {code}")
    if code == http.client.REQUESTED_RANGE_NOT_SATISFIABLE and offset:
        truncated = TruncatedError(
            "the mirror's file ends before the length that it announced",
            where=url,
            expected=f"more than {offset} bytes",
            got=f"HTTP status {code}",
            fix="another mirror: --from",
        )
        return BrokenError(truncated, stale=True)
    refused = MirrorUnreachableError(
        "the mirror refuses",
        where=url,
        got=f"HTTP status {code}: {str(error.reason)[:200]!a}",
        fix="another mirror: --from",
    )
    return BrokenError(refused) if code in _BUSY else refused


def _number(text: str | None) -> int | None:
    return int(text) if text is not None and text.isdecimal() else None


def _build_opener() -> urllib.request.OpenerDirector:
    """Return an opener for http and https alone: a redirection leads to no file of this machine."""
    opener = urllib.request.OpenerDirector()
    for handler in (
        urllib.request.ProxyHandler(),
        urllib.request.HTTPHandler(),
        urllib.request.HTTPSHandler(),
        urllib.request.HTTPRedirectHandler(),
        urllib.request.HTTPDefaultErrorHandler(),
        urllib.request.HTTPErrorProcessor(),
        urllib.request.UnknownHandler(),
    ):
        opener.add_handler(handler)
    return opener


_OPENER = _build_opener()


def _ask_fsspec(url: str, offset: int) -> Answer:
    """Ask a file system that fsspec knows."""
    try:
        system, path = file_system(url)
        total = system.info(path)["size"]
        stream: IO[bytes] = system.open(path, "rb")
    except UsageError:
        raise
    except FileNotFoundError:
        raise NotOnMirrorError("the mirror does not have the file", where=url) from None
    except Exception as error:  # file systems raise what their libraries raise
        raise _fsspec_refusal(error, url) from error
    if offset > total:
        offset = 0
    stream.seek(offset)
    return Answer(_Stream(stream), offset, total)


def _fsspec_refusal(error: Exception, url: str) -> Exception:
    """Return the error that an exception of a file system means; a busy line may be tried again."""
    found = translated(error, url)
    if isinstance(found, UsageError):
        return found
    what = "the mirror refuses" if found.fix == FIX_RIGHTS else "the mirror does not answer"
    told = MirrorUnreachableError(what, where=url, got=found.got, fix=found.fix)
    # botocore has tried again by itself.
    final = found.fix == FIX_RIGHTS or not isinstance(error, OSError)
    return told if final else BrokenError(told)


class _Stream:
    """A file of a file system, whose every fault is one of the line."""

    def __init__(self, stream: IO[bytes]) -> None:
        self._stream = stream

    def read(self, size: int, /) -> bytes:
        """Return at most so many bytes; none at the end."""
        try:
            return self._stream.read(size)
        except OSError:
            raise
        except Exception as error:  # see above
            message = f"{type(error).__name__}: {error}"
            raise OSError(message) from error

    def close(self) -> None:
        """Close it."""
        self._stream.close()
