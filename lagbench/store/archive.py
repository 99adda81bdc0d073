"""A data set as one archive, named by its hash, as releases hold it: write one, and
read it from a store.

    python -m lagbench.store.archive --split cavity --size mini --output dist

writes ``dist/cavity-mini-<first 16 digits of the data set hash>.tar``: the manifest,
then the scenario files in the order of their names, not compressed (they are already).
The same files give the same bytes. What is read is checked as if it came file by file;
a member that should not be there is an error.
"""

from __future__ import annotations

import argparse
import os
import sys
import tarfile
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from operator import attrgetter
from pathlib import Path

from lagbench.atomic import atomic_path
from lagbench.data.layout import MANIFEST_NAME
from lagbench.data.local import locate, remedy
from lagbench.data.manifest import MANIFEST_LIMIT, FileEntry, read_manifest
from lagbench.data.registry import Size
from lagbench.data.scenario import check_scenario
from lagbench.errors import DataError, LagbenchError

from .copy import bring, parse_manifest, refuse_strangers
from .fetch import BLOCK, Pace, Wanted, accept, insist, partial_name, received, saving
from .objects import (
    Answer,
    BrokenError,
    NotDataError,
    TruncatedError,
    WrongContentError,
    WrongLengthError,
    open_object,
)

RELEASES = "https://lagbench.invalid/releases"
"""Folder of the released archives; a placeholder as long as its host is .invalid (RFC
2606).
"""

# environment variable that names another such folder
RELEASES_VARIABLE = "LAGBENCH_RELEASES"
PATH = attrgetter("path")  # the order of scenario files in an archive


def releases(size: Size) -> tuple[str, ...]:
    """Return where a data set is released: one address, or none for local splits and
    placeholders.
    """
    url = os.environ.get(RELEASES_VARIABLE) or RELEASES
    if size.simulated and ".invalid/" not in url:
        return (url,)
    return ()


def archive_name(size: Size) -> str:
    """Return the name of the archive of a data set whose hash is recorded."""
    if size.measured is None:
        where = f"{size.split} {size.name}"
        raise DataError(
            "a data set without a recorded hash has no archive", where=where
        )
    return f"{size.split}-{size.name}-{size.measured.dataset_sha256[:16]}.tar"


def write_archive(
    split: str | Path,
    size: str | None = None,
    *,
    output: str | Path,
    root: str | Path | None = None,
) -> Path:
    """Write the archive of a complete data set into a folder, every file checked;
    return its path.
    """
    tier, home, _ = locate(split, size, root=root)
    target = Path(output) / archive_name(tier)
    bring(tier, home, tier.scenarios)
    folder = tier.folder(home)
    manifest = read_manifest(home, tier.split, tier.name, tier.major)
    if tier.measured:
        recorded = tier.measured.dataset_sha256
    else:
        recorded = None
    whole = manifest is not None and [
        entry.scenario for entry in manifest.files
    ] == list(tier.scenarios)
    if manifest is None or not whole or manifest.dataset_sha256 != recorded:
        raise DataError(
            "the data set is not complete, or of another hash",
            where=str(folder),
            expected=f"data set hash {recorded}",
            got=manifest.dataset_sha256 if manifest else "no manifest",
            fix=remedy(tier),
        )
    files = sorted(manifest.files, key=PATH)
    for entry in files:
        check_scenario(folder / entry.path, entry.content_sha256)
    with (
        atomic_path(target, option="--output") as beside,
        tarfile.open(beside, "w", format=tarfile.USTAR_FORMAT) as tar,
    ):
        for name in (MANIFEST_NAME, *(entry.path for entry in files)):
            # A bare TarInfo has no owner, no time, and mode 644 whatever the file has.
            member = tarfile.TarInfo(name)
            with (folder / name).open("rb") as stream:
                member.size = os.fstat(stream.fileno()).st_size
                tar.addfile(member, stream)
    return target


def fetch_archive(
    size: Size,
    url: str,
    wanted: Mapping[int, Wanted],
    report: Callable[[int], None],
    *,
    limit: int,
    remedy: str,
) -> Generator[FileEntry, None, None]:
    """Fetch scenarios from the archive in a store; yield what its manifest says of each
    as it is right.

    Hold the lock of the data set. ``report`` is told the bytes that arrive. What is not
    wanted is not asked for; no archive is longer than ``limit``. Files that were right
    stay, whatever comes after.
    """
    address = f"{url}/{archive_name(size)}"
    missing = set(wanted)
    with closing(_Stream(address, report, limit=limit, remedy=remedy)) as stream:
        length = stream.member(MANIFEST_NAME)
        if length > MANIFEST_LIMIT:
            raise stream.refused(
                WrongLengthError, "the manifest is too long", f"{MANIFEST_LIMIT} bytes"
            )
        manifest = parse_manifest(
            size, stream.read(length), where=address, remedy=remedy
        )
        stream.skip(-length % tarfile.BLOCKSIZE)
        ids = [entry.scenario for entry in manifest.files]
        if sorted(ids) != list(size.scenarios):
            other = ids
        else:
            other = []
        if size.measured:
            known = size.measured.scenario_sha256
        else:
            known = {}
        other = other or [
            e.scenario for e in manifest.files if not e.has_hash(known.get(e.scenario))
        ]
        refuse_strangers(manifest, other, where=address, remedy=remedy)
        for entry in sorted(manifest.files, key=PATH):
            if not missing:
                return
            padding = -entry.bytes % tarfile.BLOCKSIZE
            if entry.scenario not in missing:
                stream.skip(tarfile.BLOCKSIZE + entry.bytes + padding)
                continue
            one = replace(
                wanted[entry.scenario], url=address, file_sha256=entry.file_sha256
            )
            length = stream.member(entry.path)
            if length != entry.bytes or length > one.limit:
                what = f"{entry.path} has another length"
                raise stream.refused(
                    WrongLengthError, what, f"{min(entry.bytes, one.limit)} bytes"
                )
            partial = partial_name(one.target)
            with saving(partial):
                with partial.open("wb") as out:
                    stream.copy(length, out.write)
                accept(one)
            missing.remove(entry.scenario)
            yield entry
            stream.skip(padding)
        stream.end()


class _Stream:
    """The bytes of an archive in order, taken up where the line breaks.

    What is skipped is not sent where the store knows ranges.
    """

    def __init__(
        self, url: str, report: Callable[[int], None], *, limit: int, remedy: str
    ) -> None:
        self._url = url
        self._report = report
        self._limit = limit
        self._remedy = remedy
        self._pace = Pace(url)
        self._place = 0
        self._ranges = True
        self._answer: Answer | None = None
        self._blocks: Iterator[bytes] = iter(())
        self._rest = b""

    def refused(
        self, kind: type[DataError], what: str, expected: object, got: object = None
    ) -> DataError:
        """Return the error of a lie."""
        return kind(what, where=self._url, expected=expected, got=got, fix=self._remedy)

    def member(self, name: str) -> int:
        """Read the header of the next member, which must be this file; return its
        length.
        """
        header = self.read(tarfile.BLOCKSIZE)
        try:
            found = tarfile.TarInfo.frombuf(header, "ascii", "strict")
        except (tarfile.HeaderError, ValueError) as error:
            raise self.refused(
                NotDataError, "a member has no header", name, error
            ) from None
        if found.name != name or not found.isreg() or found.size < 0:
            got = f"{found.name!a}, type {found.type!a}"
            raise self.refused(
                WrongContentError, "the archive holds another member", name, got
            )
        return found.size

    def read(self, count: int) -> bytes:
        """Return the next bytes, just so many."""
        parts: list[bytes] = []
        self.copy(count, parts.append)
        return b"".join(parts)

    def copy(self, count: int, write: Callable[[bytes], object]) -> None:
        """Give the next bytes, just so many, to a function."""
        end = self._place + count

        def attempt() -> None:
            while self._place < end:
                block = self._next()
                if not block:
                    got = f"{self._place} bytes"
                    raise self.refused(
                        TruncatedError,
                        "an archive ends too early",
                        f"over {end - 1}",
                        got,
                    )
                used = block[: end - self._place]
                self._rest = block[end - self._place :]
                self._place += len(used)
                write(used)

        insist(attempt, self._url, place=lambda: self._place)

    def skip(self, count: int) -> None:
        """Pass over bytes."""
        if self._ranges and count > BLOCK:
            self.close()
            self._place += count
        else:
            self.copy(count, len)

    def end(self) -> None:
        """See that nothing but zeros follows."""
        while block := insist(self._next, self._url):
            self._rest = b""
            if any(block):
                raise self.refused(
                    WrongContentError, "the archive holds another member", "its end"
                )
            self._place += len(block)

    def close(self) -> None:
        """Let go of the line."""
        if self._answer is not None:
            self._answer.close()
        self._answer = None
        self._rest = b""

    def _next(self) -> bytes:
        """Return a block from the present place on, none at the end; the line may have
        to be opened.
        """
        if self._rest:
            return self._rest
        try:
            if self._answer is None:
                self._answer = open_object(self._url, self._place, remedy=self._remedy)
                behind = self._place - self._answer.start
                self._ranges = behind == 0
                self._blocks = received(
                    self._answer,
                    self._pace,
                    limit=self._limit,
                    begins=MANIFEST_NAME.encode() + b"\0",
                    remedy=self._remedy,
                )
                while behind > 0:
                    block = self._arrive()
                    if not block:
                        return b""
                    self._rest = block[behind:]
                    behind = behind - len(block)
            return self._rest or self._arrive()
        except BrokenError as broken:
            self.close()
            if broken.stale:
                raise broken.error from None
            raise

    def _arrive(self) -> bytes:
        block = next(self._blocks, b"")
        self._report(len(block))
        return block


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line of this module; return its exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m lagbench.store.archive",
        description=(__doc__ or "").partition("\n")[0],
    )
    parser.add_argument("--split", required=True, help="name of the split")
    parser.add_argument("--size", help="name of the size; the only one that is there")
    parser.add_argument("--root", help="folder of all data sets")
    parser.add_argument(
        "--output", type=Path, default=Path(), help="folder for the archive"
    )
    options = parser.parse_args(arguments)
    try:
        path = write_archive(
            options.split, options.size, output=options.output, root=options.root
        )
    except LagbenchError as error:
        sys.stderr.write(f"archive: {error}\n")
        return error.exit_code
    sys.stdout.write(f"{path}\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
