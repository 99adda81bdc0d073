"""Fetch a file from a mirror: resumed by HTTP range, bounded in length, under a temporary name.

A mirror is a plain copy of a root folder behind a base URL. Whatever it does wrong has an error
of its own name, see :mod:`lagbench.store.mirror_errors`.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

from lagbench.atomic import SUFFIX
from lagbench.errors import DataError, WorkFailedError

from .address import Answer, ask
from .mirror_errors import BrokenError, ConnectionLostError, NotDataError, TruncatedError, WrongLengthError

__all__ = ["Fetch", "fetch", "fetch_text", "partial_name"]

ATTEMPTS = 5
"""Attempts in a row that bring nothing before we give up."""

MOST_ATTEMPTS = 100
"""Attempts at one file at all, however little each brings."""

PAUSE = 0.5
"""Pause after the first failed attempt [s]; it doubles."""

SIGNATURE = b"\x89HDF\r\n\x1a\n"
"""How every netCDF4 file begins."""


@dataclass(frozen=True, kw_only=True)
class Fetch:
    """A file to fetch."""

    url: str  # where it is
    target: Path  # where it shall be; its temporary name is beside that
    limit: int  # bytes beyond which no file of this kind goes
    length: int | None = None  # bytes that it has, where that is known
    sha256: str | None = None  # SHA-256 of its bytes as the mirror states it


def partial_name(target: Path) -> Path:
    """Return the temporary name of a file that is fetched; a later attempt goes on from it."""
    return target.with_name(f".{target.name}.download{SUFFIX}")


def fetch(wanted: Fetch, *, report: Callable[[int], None] | None = None) -> Path:
    """Bring a file to its temporary name, going on where an earlier attempt stopped."""
    partial = partial_name(wanted.target)
    try:
        partial.parent.mkdir(parents=True, exist_ok=True)
        _insist(wanted, partial, report or _nobody)
        return partial
    except DataError:
        partial.unlink(missing_ok=True)
        raise
    except OSError as error:
        raise WorkFailedError(
            "cannot write there",
            where=str(partial),
            got=error.strerror or error,
            fix="--root names another folder",
        ) from error


def _nobody(_: int) -> None:
    """Listen to nothing."""


def _insist(wanted: Fetch, partial: Path, report: Callable[[int], None]) -> None:
    """Attempt until the file is whole, or attempts bring nothing any more."""
    failures, restarted = 0, False
    for _ in range(MOST_ATTEMPTS):
        before = _size(partial)
        try:
            report(0)
            _attempt(wanted, partial, before, report)
        except BrokenError as broken:
            failures = 0 if _size(partial) > before else failures + 1
            if failures >= ATTEMPTS or (broken.stale and restarted):
                raise broken.error from None
            if broken.stale:
                partial.unlink(missing_ok=True)
                restarted = True
            time.sleep(PAUSE * 2**failures)
        else:
            return
    raise ConnectionLostError(
        "the connection to the mirror broke too often",
        where=wanted.url,
        got=f"{_size(partial)} bytes after {MOST_ATTEMPTS} attempts",
        fix="the same command goes on where it stopped",
    )


def fetch_text(url: str, *, limit: int) -> bytes:
    """Return a small file."""
    failures = 0
    while True:
        try:
            answer = ask(url, 0)
            with closing(answer.stream):
                if answer.page:
                    raise _no_data(url, next(answer.blocks(url), b""))
                _check_length(answer, url, limit, None)
                text = _exactly(answer, url, limit)
        except BrokenError as broken:
            failures += 1
            if failures >= ATTEMPTS:
                raise broken.error from None
            time.sleep(PAUSE * 2**failures)
        else:
            return text


def _exactly(answer: Answer, url: str, limit: int) -> bytes:
    parts: list[bytes] = []
    for block in answer.blocks(url):
        parts.append(block)
        if sum(map(len, parts)) > limit:
            raise WrongLengthError(
                "the mirror sends more than such a file holds", where=url, expected=f"<= {limit} bytes"
            )
    text = b"".join(parts)
    _check_end(answer, url, len(text))
    return text


def _attempt(wanted: Fetch, partial: Path, have: int, report: Callable[[int], None]) -> None:
    """Receive what is missing."""
    if have and have == wanted.length:
        return
    answer = ask(wanted.url, have)
    with closing(answer.stream):
        blocks = answer.blocks(wanted.url)
        first = next(blocks, b"")
        if answer.page or (answer.start == 0 and not first.startswith(SIGNATURE[: len(first)])):
            raise _no_data(wanted.url, first)
        _check_length(answer, wanted.url, wanted.limit, wanted.length)
        # Opened for writing at the place where the answer starts: 0 where it starts over.
        with partial.open("r+b" if answer.start else "wb") as out:
            out.seek(answer.start)
            for block in chain([first], blocks):
                out.write(block)
                _check_most(wanted, out.tell())
                report(len(block))
            out.flush()
            _check_end(answer, wanted.url, out.tell())
            _check_whole(wanted, out.tell())


def _check_most(wanted: Fetch, have: int) -> None:
    """Stop a mirror that sends more than the file holds."""
    most = wanted.limit if wanted.length is None else wanted.length
    if have > most:
        raise WrongLengthError(
            "the mirror sends more than the file holds",
            where=wanted.url,
            expected=f"{'at most ' if wanted.length is None else ''}{most} bytes",
        )


def _check_whole(wanted: Fetch, have: int) -> None:
    """Tell a file that ended before its known length though none was announced."""
    if wanted.length is not None and have != wanted.length:
        raise TruncatedError(
            "the mirror's file ends too early",
            where=wanted.url,
            expected=f"{wanted.length} bytes",
            got=f"{have} bytes",
        )


def _check_length(answer: Answer, url: str, limit: int, length: int | None) -> None:
    """Refuse an announced length that cannot be."""
    if answer.total is None:
        return
    if length is not None and answer.total != length:
        raise WrongLengthError(
            "the mirror announces another length than its manifest states",
            where=url,
            expected=f"{length} bytes",
            got=f"{answer.total} bytes",
        )
    if answer.total > limit:
        raise WrongLengthError(
            "the mirror announces more than such a file holds",
            where=url,
            expected=f"at most {limit} bytes",
            got=f"{answer.total} bytes",
        )


def _no_data(url: str, start: bytes) -> NotDataError:
    text = " ".join(start[:200].decode("utf-8", "replace").split())
    return NotDataError(
        "the mirror sent something else than data",
        where=url,
        expected="a netCDF4 file or a manifest",
        got=ascii(text[:80]),
        fix="open the address in a browser: it may ask to log in, or be no mirror; --from names another",
    )


def _check_end(answer: Answer, url: str, have: int) -> None:
    """Tell an answer that ended before the announced length."""
    if answer.total is not None and have < answer.total:
        raise BrokenError(
            TruncatedError(
                "the mirror's file ends before the length that it announces",
                where=url,
                expected=f"{answer.total} bytes",
                got=f"{have} bytes, also after {ATTEMPTS} attempts",
                fix="try later, or another mirror: --from",
            )
        )


def _size(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0
