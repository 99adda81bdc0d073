"""A data set as one archive of a release, named by its hash: write it, and fetch it.

    python -m lagbench.store.archive --split cavity --size mini --output dist

writes ``dist/cavity-mini-<first 16 digits of the data set hash>.tar``: the manifest,
then the scenario files in the order of their names, not compressed (they are already).
The same files give the same bytes. Files from an archive are checked like single ones.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import tarfile
import tempfile
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import replace
from operator import attrgetter
from pathlib import Path
from typing import IO

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

from .copy import parse_manifest, refuse_foreign_hashes, update_working_copy
from .fetch import FetchRequest, accept, partial_name
from .objects import WrongContentError, download_object

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
            "a data set without a recorded hash has no archive; record it: python -m "
            "lagbench.generators.record",
            where=f"{size.split} {size.name}",
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
    manifest = read_manifest(root, size.split, size.name, size.major)
    present = [entry.scenario for entry in manifest.files] if manifest else []
    recorded_hash = size.measured.dataset_sha256 if size.measured else None
    is_whole = manifest is not None and present == list(size.scenarios)
    if manifest is None or not is_whole or manifest.dataset_sha256 != recorded_hash:
        raise DataError(
            f"no complete data set with the recorded hash {recorded_hash}: the "
            f"manifest names scenarios {format_ids(present) or 'none'} of "
            f"{format_ids(size.scenarios)}; {suggest_repair(size, root=root)}",
            where=str(size.folder(root)),
        )
    return manifest


def fetch_archive(
    size: Size,
    url: str,
    requests: Mapping[int, FetchRequest],
    report: Callable[[int], None],
) -> Generator[FileEntry, None, None]:
    """Fetch scenarios from the archive in a store; yield the entry of each right file.

    The caller holds the lock of the data set. Right files stay, whatever comes after.

    Args:
        size: the data set.
        url: folder of the archive.
        requests: files to fetch, by scenario id.
        report: receives the number of bytes that arrived.

    Raises:
        NotInStoreError: the store has no such archive.
        DataError: the archive is of another data set, lacks a scenario, or has a wrong
            member.
    """
    address = f"{url}/{archive_name(size)}"
    longest_files = map(size.longest_file, size.scenarios)
    limit = sum(longest_files) + MANIFEST_LIMIT + (len(size.scenarios) + 20) * 1024
    folders = {request.target.parents[1] for request in requests.values()}
    (folder,) = folders
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder, prefix=".download-") as temporary:
        path = Path(temporary) / "archive.tar"
        download_object(address, path, limit=limit, report=report)
        try:
            with tarfile.open(path, "r:") as archive:
                yield from _take_members(size, archive, address, requests)
        except (tarfile.TarError, KeyError) as error:
            raise WrongContentError(
                f"the archive is damaged or lacks a member ({error})", where=address
            ) from error


def _take_members(
    size: Size,
    archive: tarfile.TarFile,
    address: str,
    requests: Mapping[int, FetchRequest],
) -> Iterator[FileEntry]:
    """Write the requested members under their names once they are right."""
    with _member(archive, MANIFEST_NAME, MANIFEST_LIMIT) as stream:
        manifest = parse_manifest(size, stream.read(), where=address)
    recorded_hashes: Mapping[int, str] = {}
    if size.measured is not None:
        recorded_hashes = size.measured.scenario_sha256
    foreign_scenarios = []
    for entry in manifest.files:
        if not entry.has_hash(recorded_hashes.get(entry.scenario)):
            foreign_scenarios.append(entry.scenario)
    refuse_foreign_hashes(size, manifest, foreign_scenarios, where=address)

    entries = {entry.scenario: entry for entry in manifest.files}
    for scenario, request in requests.items():
        entry = entries[scenario]
        partial = partial_name(request.target)
        partial.parent.mkdir(exist_ok=True)
        try:
            with (
                _member(archive, entry.path, request.limit) as stream,
                partial.open("wb") as file,
            ):
                shutil.copyfileobj(stream, file)
            accept(replace(request, url=address, file_sha256=entry.file_sha256))
        finally:
            partial.unlink(missing_ok=True)
        yield entry


def _member(archive: tarfile.TarFile, name: str, limit: int) -> IO[bytes]:
    """Open a regular member of at most so many bytes."""
    member = archive.getmember(name)
    stream = archive.extractfile(member) if member.isreg() else None
    if stream is None or member.size > limit:
        raise tarfile.TarError(f"{name} is no file of at most {limit} bytes")
    return stream


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
