"""A data set as one archive of a release, named by its hash: write it, and fetch it.

    python -m lagbench.store.archive --split cavity --size mini --output dist

writes ``dist/cavity-mini-<first 16 digits of the data set hash>.tar``: the manifest,
then the scenario files in the order of their names, not compressed (they are already).
The same files give the same bytes. Files from an archive are checked like single ones;
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

from lagbench.addresses import ARCHIVES
from lagbench.atomic import atomic_path
from lagbench.data.layout import MANIFEST_NAME, format_ids
from lagbench.data.local import locate, suggest_repair
from lagbench.data.manifest import (
    MANIFEST_LIMIT,
    FileEntry,
    Manifest,
    read_manifest,
)
from lagbench.data.registry import Size
from lagbench.data.scenario import check_scenario
from lagbench.errors import DataError, LagbenchError
from lagbench.work.run import Meter

from .copy import parse_manifest, refuse_foreign_hashes, update_working_copy
from .fetch import (
    BLOCK,
    FetchRequest,
    TransferRate,
    accept,
    partial_file_errors,
    partial_name,
    receive,
    retry,
)
from .objects import (
    Answer,
    BrokenError,
    NotDataError,
    TruncatedError,
    WrongContentError,
    WrongLengthError,
    open_object,
)

RELEASES_VARIABLE = "LAGBENCH_RELEASES"
"""Environment variable that names another folder of released archives."""

ARCHIVE_ORDER = attrgetter("path")
"""Key of the order of scenario files in an archive."""


def list_releases(size: Size) -> tuple[str, ...]:
    """Return the addresses of releases: one; none for local splits, or if not set."""
    url = os.environ.get(RELEASES_VARIABLE) or ARCHIVES
    if size.simulated and url:
        return (url,)
    return ()


def archive_name(size: Size) -> str:
    """Return the name of the archive of a data set whose hash is recorded."""
    if size.measured is None:
        raise DataError(
            "a data set without a recorded hash has no archive",
            where=f"{size.split} {size.name}",
            expected="a hash in datasets.yaml",
            got="none",
            fix="record it: python -m lagbench.generators.record",
        )
    return f"{size.split}-{size.name}-{size.measured.dataset_sha256[:16]}.tar"


def write_archive(
    split: str | Path,
    size: str | None = None,
    *,
    output: str | Path,
    root: str | Path | None = None,
) -> Path:
    """Write the archive of a complete data set, every file checked; return its path.

    Args:
        split: name of the split, or path of a local split's folder.
        size: name of the size; None takes the only one with data, or mini where several
            have data.
        output: folder for the archive.
        root: folder of all data sets.

    Raises:
        DataError: the data set is incomplete, damaged, or of another hash.
    """
    tier, root_folder, _ = locate(split, size, root=root)
    target = Path(output) / archive_name(tier)
    update_working_copy(tier, root_folder, tier.scenarios)
    manifest = _read_complete_manifest(tier, root_folder)

    folder = tier.folder(root_folder)
    names = [MANIFEST_NAME]
    for entry in sorted(manifest.files, key=ARCHIVE_ORDER):
        check_scenario(folder / entry.path, entry.content_sha256)
        names.append(entry.path)
    with (
        atomic_path(target, option="--output") as temporary,
        tarfile.open(temporary, "w", format=tarfile.USTAR_FORMAT) as archive,
    ):
        for name in names:
            # A bare TarInfo has no owner, no time, and mode 644 for any file.
            member = tarfile.TarInfo(name)
            with (folder / name).open("rb") as stream:
                member.size = os.fstat(stream.fileno()).st_size
                archive.addfile(member, stream)
    return target


def _read_complete_manifest(size: Size, root: Path) -> Manifest:
    """Return the manifest of a data set with all scenarios and the recorded hash."""
    where = str(size.folder(root))
    manifest = read_manifest(root, size.split, size.name, size.major)
    present: list[int] = []
    if manifest is not None:
        present = [entry.scenario for entry in manifest.files]
    if manifest is None or present != list(size.scenarios):
        missing = set(size.scenarios).difference(present)
        got = f"{len(present)} scenarios"
        if missing:
            got += f"; missing: {format_ids(sorted(missing))}"
        raise DataError(
            "the data set is not complete, or has other scenarios",
            where=where,
            expected=f"a manifest with scenarios {format_ids(size.scenarios)}",
            got=got,
            fix=suggest_repair(size, root=root),
        )
    if size.measured is None:
        raise DataError(
            "the hash of the data set is not recorded",
            where=f"{size.record_name}, {size.split} {size.name}",
            expected="a data set hash",
            got="none",
            fix="record the data set first: docs/extending.md",
        )
    recorded_hash = size.measured.dataset_sha256
    if manifest.dataset_sha256 != recorded_hash:
        raise DataError(
            "the data set has another hash",
            where=where,
            expected=f"data set hash {recorded_hash}",
            got=manifest.dataset_sha256,
            fix=suggest_repair(size, root=root),
        )
    return manifest


def fetch_archive(
    size: Size,
    url: str,
    requests: Mapping[int, FetchRequest],
    report: Callable[[int], None],
    *,
    meter: Meter,
    limit: int,
    hint: str,
) -> Generator[FileEntry, None, None]:
    """Fetch scenarios from the archive in a store; yield the entry of each right file.

    The caller holds the lock of the data set. Other members are skipped. Right files
    stay, whatever comes after.

    Args:
        size: the data set.
        url: folder of the archive.
        requests: files to fetch, by scenario id.
        report: receives the number of bytes that arrived. It counts all members,
            also those that are read only to reach a later one.
        meter: begins a stage once the manifest tells the lengths of the requested
            files, and counts their bytes. The caller counts the files.
        limit: most bytes of an archive.
        hint: how the user mends a store with wrong data.

    Raises:
        NotInStoreError: the store has no such archive.
        DataError: the archive is of another data set, lacks a scenario, or has a wrong
            member.
    """
    address = f"{url}/{archive_name(size)}"
    missing = set(requests)
    with closing(_Stream(address, report, limit=limit, hint=hint)) as stream:
        manifest = _fetch_manifest(size, stream, address, hint)
        byte_count = 0
        for entry in manifest.files:
            if entry.scenario in requests:
                byte_count += entry.bytes
        meter.begin("downloading", total=byte_count, scenarios=len(requests))
        for entry in sorted(manifest.files, key=ARCHIVE_ORDER):
            if not missing:
                return
            padding = -entry.bytes % tarfile.BLOCKSIZE
            if entry.scenario not in missing:
                stream.skip(tarfile.BLOCKSIZE + entry.bytes + padding)
                continue
            request = replace(
                requests[entry.scenario], url=address, file_sha256=entry.file_sha256
            )
            _fetch_member(stream, entry, request, meter)
            missing.remove(entry.scenario)
            yield entry
            stream.skip(padding)
        stream.end()


def _fetch_manifest(size: Size, stream: _Stream, address: str, hint: str) -> Manifest:
    """Return the manifest, the first member; refuse one of another data set."""
    length = stream.member(MANIFEST_NAME)
    if length > MANIFEST_LIMIT:
        raise stream.error(
            WrongLengthError, "the manifest is too long", f"{MANIFEST_LIMIT} bytes"
        )
    manifest = parse_manifest(size, stream.read(length), where=address, hint=hint)
    stream.skip(-length % tarfile.BLOCKSIZE)

    recorded_hashes: Mapping[int, str] = {}
    if size.measured is not None:
        recorded_hashes = size.measured.scenario_sha256
    scenarios = []
    foreign_scenarios = []
    for entry in manifest.files:
        scenarios.append(entry.scenario)
        if not entry.has_hash(recorded_hashes.get(entry.scenario)):
            foreign_scenarios.append(entry.scenario)
    if sorted(scenarios) != list(size.scenarios):
        foreign_scenarios = scenarios
    refuse_foreign_hashes(size, manifest, foreign_scenarios, where=address, hint=hint)
    return manifest


def _fetch_member(
    stream: _Stream, entry: FileEntry, request: FetchRequest, meter: Meter
) -> None:
    length = stream.member(entry.path)
    if length != entry.bytes or length > request.limit:
        raise stream.error(
            WrongLengthError,
            f"{entry.path} has another length",
            f"{min(entry.bytes, request.limit)} bytes",
        )
    partial = partial_name(request.target)
    with partial_file_errors(partial):
        with partial.open("wb") as file:

            def write(block: bytes) -> None:
                file.write(block)
                meter.count(len(block))

            stream.copy(length, write)
        accept(request)


class _Stream:
    """The bytes of an archive in order; a broken connection is opened again.

    Skipped bytes are not sent where the store knows ranges.
    """

    def __init__(
        self, url: str, report: Callable[[int], None], *, limit: int, hint: str
    ) -> None:
        self._url = url
        self._report = report
        self._limit = limit
        self._hint = hint
        self._rate = TransferRate(url)
        self._position = 0
        self._knows_ranges = True
        self._answer: Answer | None = None
        self._blocks: Iterator[bytes] = iter(())
        self._unread = b""  # bytes that have arrived, from the present position on

    def error(
        self, kind: type[DataError], what: str, expected: object, got: object = None
    ) -> DataError:
        """Return the error that the archive is wrong."""
        return kind(what, where=self._url, expected=expected, got=got, fix=self._hint)

    def member(self, name: str) -> int:
        """Read the header of the next member; return its length.

        Raises:
            DataError: the next member is not this file.
        """
        header = self.read(tarfile.BLOCKSIZE)
        try:
            member = tarfile.TarInfo.frombuf(header, "ascii", "strict")
        except (tarfile.HeaderError, ValueError) as error:
            raise self.error(
                NotDataError, "a member has no header", name, error
            ) from None
        if member.name != name or not member.isreg() or member.size < 0:
            raise self.error(
                WrongContentError,
                "the archive holds another member",
                name,
                f"{member.name!a}, type {member.type!a}",
            )
        return member.size

    def read(self, count: int) -> bytes:
        """Return the next bytes."""
        parts: list[bytes] = []
        self.copy(count, parts.append)
        return b"".join(parts)

    def copy(self, count: int, write: Callable[[bytes], object]) -> None:
        """Give the next bytes to a function."""
        end = self._position + count

        def attempt() -> None:
            while self._position < end:
                block = self._next_block()
                if not block:
                    raise self.error(
                        TruncatedError,
                        "an archive ends too early",
                        f"over {end - 1}",
                        f"{self._position} bytes",
                    )
                needed_bytes = end - self._position
                part = block[:needed_bytes]
                self._unread = block[needed_bytes:]
                self._position += len(part)
                write(part)

        retry(attempt, self._url, place=lambda: self._position)

    def skip(self, count: int) -> None:
        """Pass over bytes."""
        if self._knows_ranges and count > BLOCK:
            self.close()
            self._position += count
        else:
            self.copy(count, len)

    def end(self) -> None:
        """Read to the end; refuse anything but zeros."""
        block = retry(self._next_block, self._url)
        while block:
            self._unread = b""
            if any(block):
                raise self.error(
                    WrongContentError, "the archive holds another member", "its end"
                )
            self._position += len(block)
            block = retry(self._next_block, self._url)

    def close(self) -> None:
        """Close the connection."""
        if self._answer is not None:
            self._answer.close()
        self._answer = None
        self._unread = b""

    def _next_block(self) -> bytes:
        """Return a block from the present position on; an empty one at the end.

        The connection is opened where it is not open.
        """
        if self._unread:
            return self._unread
        try:
            if self._answer is None:
                self._open()
            return self._unread or self._receive_block()
        except BrokenError as broken:
            self.close()
            if broken.stale:
                raise broken.error from None
            raise

    def _open(self) -> None:
        """Open the connection and pass over bytes before the present position."""
        self._answer = open_object(self._url, self._position, hint=self._hint)
        bytes_before = self._position - self._answer.start
        self._knows_ranges = bytes_before == 0
        self._blocks = receive(
            self._answer,
            self._rate,
            limit=self._limit,
            begins=MANIFEST_NAME.encode() + b"\0",
            hint=self._hint,
        )
        while bytes_before > 0:
            block = next(self._blocks, b"")
            if not block:
                return
            self._unread = block[bytes_before:]
            self._report(len(self._unread))
            bytes_before -= len(block)

    def _receive_block(self) -> bytes:
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
    parser.add_argument(
        "--size",
        help="name of the size; else the only one with data, or mini of several",
    )
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
