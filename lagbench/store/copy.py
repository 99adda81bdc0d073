"""Fetch scenarios into a working copy from its store, or gather them from other roots.

The store's manifest names its objects. A fetched object gets its name once its content
hash is that of datasets.yaml, or of the manifest where datasets.yaml has none.
Files of the working copy that match the manifest are not fetched again.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import time
from collections.abc import Collection, Iterable, Iterator, Sequence
from pathlib import Path

from pydantic import ValidationError

from lagbench.atomic import atomic_path
from lagbench.data.checksums import file_sha256
from lagbench.data.layout import MANIFEST_NAME, format_ids, has_file, url_of
from lagbench.data.local import suggest_repair
from lagbench.data.lock import dataset_lock
from lagbench.data.manifest import (
    MANIFEST_LIMIT,
    FileEntry,
    Manifest,
    merge_entries,
    read_manifest,
    read_or_empty,
    record_entry_hashes,
    write_manifest,
)
from lagbench.data.registry import Size
from lagbench.data.scenario import check_scenario
from lagbench.errors import DataError, UsageError, suggest_name
from lagbench.work.machine import may_differ

from .fetch import FetchRequest, fetch_scenarios
from .objects import (
    HTTP,
    NotInStoreError,
    Objects,
    WrongContentError,
    check_bucket,
    read_object,
)

FRESH_SECONDS = 30.0
"""How long a store's manifest is not asked for again by this process [s]."""

_manifests: dict[str, tuple[float, Manifest | None]] = {}
"""Time of the last answer and manifest, by address."""

_copies_of_writers: list[Path] = []
"""Working copies from which this process writes to a store, one for each data set."""


def object_address(size: Size, url: str, name: str) -> str:
    """Return the address of an object of a data set in a store."""
    return f"{url}/{store_folder(size)}/{name}"


def store_folder(size: Size) -> str:
    """Return the folder of a data set below the root of a store."""
    return size.folder(Path()).as_posix()


def parse_manifest(size: Size, text: bytes, *, where: str) -> Manifest:
    """Return a store's manifest.

    Raises:
        WrongContentError: the text is no manifest, or that of another data set.
    """
    try:
        manifest = Manifest.model_validate_json(text)
    except ValidationError as error:
        raise WrongContentError(
            f"the store's manifest.json is no manifest of lagbench: {error}",
            where=where,
        ) from error
    if not manifest.is_of(size.split, size.name, size.major):
        raise WrongContentError(
            f"the store's manifest is not of {size.split} {size.name}, version "
            f"{size.major}",
            where=where,
        )
    return manifest


def refuse_foreign_hashes(
    size: Size, manifest: Manifest, foreign_scenarios: Collection[int], *, where: str
) -> None:
    """Refuse a store whose manifest has other content hashes than the record."""
    if foreign_scenarios:
        raise WrongContentError(
            f"scenarios {format_ids(foreign_scenarios)} of the store have other hashes "
            f"than {size.record_name}; name another store",
            where=where,
        )


def scenario_files(size: Size, root: Path, subsets: Sequence[str]) -> dict[int, Path]:
    """Return the files of subsets by id, fetched where the root is a working copy.

    Raises:
        UsageError: unknown subset.
        DataError: scenarios are missing, or a folder may not be read.
    """
    paths = {}
    for subset in subsets:
        if not isinstance(subset, str) or subset not in size.subsets:
            raise UsageError(
                f"no subset {subset!r}; {suggest_name(str(subset), size.subsets)}",
                where=f"{size.split} {size.name}",
            )
        for scenario in size.subsets[subset]:
            paths[scenario] = size.path(root, scenario)
    update_working_copy(size, root, paths)

    missing = []
    for scenario, path in paths.items():
        if not has_file(path):
            missing.append(scenario)
    if missing:
        incomplete_subsets = []
        for subset in subsets:
            if not set(missing).isdisjoint(size.subsets[subset]):
                incomplete_subsets.append(subset)
        names = ",".join(incomplete_subsets)
        options = [f"--subset {names}"]
        if "train" in incomplete_subsets:
            # whoever trains will need the other subsets too
            options = []
        raise DataError(
            f"{len(missing)} of {len(paths)} scenarios are not there "
            f"({format_ids(missing)} of {names}); "
            f"{suggest_repair(size, *options, root=root)}",
            where=str(size.folder(root)),
        )
    return paths


# --- the working copy of a store ------------------------------------------------------


def update_working_copy(
    size: Size, root: Path, scenarios: Iterable[int] = (), *, thoroughly: bool = False
) -> bool:
    """Fetch the manifest and some scenarios, where the root is a working copy.

    The caller has to miss the file of a scenario that the store does not have.

    Args:
        size: the data set.
        root: root folder; for a plain folder nothing happens.
        scenarios: scenarios to fetch.
        thoroughly: hash files of the copy, and do not only compare their lengths; check
            that the store has all objects of its manifest.

    Returns:
        Whether the copy has changed.

    Raises:
        DataError: the store holds wrong data.
        WorkFailedError: the store does not answer.
    """
    url = url_of(root)
    scenarios = tuple(scenarios)
    if url is None or root in _copies_of_writers:
        return False
    manifest = _remote_manifest_with(size, url, scenarios)
    if manifest is None:
        return False
    # A store that answers HTTP lists nothing.
    if thoroughly and not url.startswith(HTTP):
        _check_objects(size, url, manifest)

    entries = []
    foreign_scenarios = []
    for scenario in scenarios:
        entry = manifest.entry(scenario)
        if entry is not None:
            entries.append(entry)
            if not matches_registry(entry, size, manifest):
                foreign_scenarios.append(scenario)
    refuse_foreign_hashes(
        size,
        manifest,
        foreign_scenarios,
        where=object_address(size, url, MANIFEST_NAME),
    )

    local_manifest = read_or_empty(size, root)
    trusted = None if thoroughly else local_manifest
    lacking = _list_lacking(entries, size, root, trusted)
    if not lacking and add_local_entries(size, root, manifest) == local_manifest:
        return False
    with dataset_lock(root, size.split, size.name, size.major):
        # Another process may have fetched some meanwhile.
        fetch_entries(size, root, url, _list_lacking(lacking, size, root))
        write_manifest(root, add_local_entries(size, root, manifest))
    return True


def _remote_manifest_with(
    size: Size, url: str, scenarios: Collection[int]
) -> Manifest | None:
    """Return a store's manifest; None where the store has none.

    The store is asked again where the first answer lacks a scenario or is None.
    """
    manifest = remote_manifest(size, url)
    if manifest is not None and not _list_missing(manifest, scenarios):
        return manifest
    # A writer may have put the scenario there since the first answer.
    return remote_manifest(size, url, fresh=0.0)


def _check_objects(size: Size, url: str, manifest: Manifest) -> None:
    """Refuse a store that lacks an object of its manifest."""
    lengths = Objects(url, store_folder(size)).sizes()
    wrong_scenarios = []
    for entry in manifest.files:
        if lengths.get(entry.path) != entry.bytes:
            wrong_scenarios.append(entry.scenario)
    if wrong_scenarios:
        raise DataError(
            f"the store lacks scenarios {format_ids(wrong_scenarios)} of its manifest, "
            f"or they have another length; {_rewriting(size, url)}",
            where=object_address(size, url, MANIFEST_NAME),
        )


def _rewriting(size: Size, url: str) -> str:
    """Return what writes a data set of a store anew."""
    return f"lagbench generate --split {size.split} --size {size.name} --root {url}"


def _list_lacking(
    entries: Iterable[FileEntry],
    size: Size,
    root: Path,
    trusted: Manifest | None = None,
) -> list[FileEntry]:
    return [entry for entry in entries if not is_in_copy(entry, size, root, trusted)]


def remote_manifest(
    size: Size, url: str, *, fresh: float | None = None
) -> Manifest | None:
    """Return the manifest of a data set in a store; None where there is none.

    Args:
        size: the data set.
        url: root of the store.
        fresh: age up to which an earlier answer counts [s]; FRESH_SECONDS by default.
    """
    if fresh is None:
        fresh = FRESH_SECONDS
    address = object_address(size, url, MANIFEST_NAME)
    if address in _manifests:
        answered, manifest = _manifests[address]
        if time.monotonic() - answered < fresh:
            return manifest
    manifest = None
    try:
        text = read_object(address, limit=MANIFEST_LIMIT)
    except NotInStoreError:
        check_bucket(url)
    else:
        manifest = parse_manifest(size, text, where=address)
    _manifests[address] = (time.monotonic(), manifest)
    return manifest


def list_unstored(size: Size, root: Path, scenarios: Iterable[int]) -> tuple[int, ...]:
    """Return the scenarios that a working copy's store lacks; none for a folder."""
    url = url_of(root)
    if url is None:
        return ()
    manifest = remote_manifest(size, url)
    if manifest is None:
        return tuple(scenarios)
    return _list_missing(manifest, scenarios)


def _list_missing(manifest: Manifest, scenarios: Iterable[int]) -> tuple[int, ...]:
    """Return the scenarios without an entry in a manifest."""
    return tuple(scenario for scenario in scenarios if manifest.entry(scenario) is None)


def matches_registry(entry: FileEntry, size: Size, manifest: Manifest) -> bool:
    """Return whether an entry of a manifest has the hash of datasets.yaml.

    A file of a machine that promises no equal bits may differ, as it may in a local
    folder.
    """
    if entry.scenario not in size.scenarios:
        return False
    if size.measured is None:
        return True
    if entry.has_hash(size.measured.scenario_sha256.get(entry.scenario)):
        return True
    is_tolerant = manifest.identity == "tolerance"
    return is_tolerant and may_differ(entry.device, manifest.environments)


def add_local_entries(size: Size, root: Path, manifest: Manifest) -> Manifest:
    """Return the store's manifest with the entries that only the working copy has."""
    folder = size.folder(root)
    local_manifest = read_or_empty(size, root)
    local_entries = []
    for entry in local_manifest.files:
        if manifest.entry(entry.scenario) is not None:
            continue
        is_right = matches_registry(entry, size, local_manifest)
        if is_right and (folder / entry.path).is_file():
            local_entries.append(entry)
    return join_manifests(size, manifest, local_manifest, local_entries)


def join_manifests(
    size: Size, base: Manifest, other: Manifest, files: Collection[FileEntry]
) -> Manifest:
    """Return a manifest with entries, machines and statistics of another.

    Args:
        size: the data set.
        base: the manifest.
        other: the other one; its statistics count where both have the same train.
        files: entries to take from the other one; none leaves the base as it is.
    """
    if not files:
        return base
    environments = list(base.environments)
    for environment in other.environments:
        if environment not in base.environments:
            environments.append(environment)
    widened = base.model_copy(update={"environments": tuple(environments)})
    joined = merge_entries(size, widened, files)
    has_same_train = joined.subset_sha256.get("train") == other.subset_sha256.get(
        "train"
    )
    if joined.statistics or not has_same_train:
        return joined
    return joined.model_copy(update={"statistics": other.statistics})


def is_in_copy(
    entry: FileEntry, size: Size, root: Path, trusted: Manifest | None = None
) -> bool:
    """Return whether the working copy holds the file of an entry.

    The bytes are hashed, unless the trusted manifest has the same entry.
    """
    path = size.folder(root) / entry.path
    if not has_file(path) or path.stat().st_size != entry.bytes:
        return False
    if trusted is not None:
        trusted_entry = trusted.entry(entry.scenario)
        if trusted_entry is not None and trusted_entry.file_sha256 == entry.file_sha256:
            return True
    return file_sha256(path) == entry.file_sha256


def fetch_entries(
    size: Size, root: Path, url: str, entries: Collection[FileEntry]
) -> None:
    """Fetch objects into the working copy; each appears whole and right.

    The caller holds the lock of the working copy.

    Raises:
        DataError: the store holds wrong data.
        WorkFailedError: the store does not answer, or the disk is full.
    """
    if not entries:
        return
    requests = {}
    for entry in entries:
        if entry.bytes > size.longest_file(entry.scenario):
            raise WrongContentError(
                f"scenario {entry.scenario} has an impossible length in the manifest",
                where=object_address(size, url, MANIFEST_NAME),
            )
        requests[entry.scenario] = FetchRequest(
            url=object_address(size, url, entry.path),
            target=size.folder(root) / entry.path,
            limit=entry.bytes,
            length=entry.bytes,
            file_sha256=entry.file_sha256,
            content_sha256=entry.content_sha256,
        )
    with contextlib.closing(fetch_scenarios(requests, lambda _: None)) as arrivals:
        for _, error in arrivals:
            if error is not None:
                raise error


# --- other root folders ---------------------------------------------------------------


def gather(size: Size, root: Path, source: Path, manifest: Manifest) -> Manifest:
    """Take over finished scenarios of another root folder; return the joint manifest.

    Each job of an array generates some scenarios into a root folder of its own. The
    result is what one call would have left. A file that the root folder has stays. It
    is not named where only the source has an entry, of another file.

    Args:
        size: the data set.
        root: root folder to take them to.
        source: the other root folder.
        manifest: manifest of the data set in the root folder.

    Raises:
        UsageError: the source has no such data set, or is the root folder.
        DataError: a file of the source is damaged.
    """
    source_folder = size.folder(source)
    target_folder = size.folder(root)
    source_manifest = _read_source_manifest(size, source)
    _require_other_folder(size, root, source)
    taken_entries = []
    new_entries = []
    for entry in _list_known_entries(size, source_manifest):
        old_entry = manifest.entry(entry.scenario)
        if not _adds_to(old_entry, entry):
            continue
        target = target_folder / entry.path
        if not target.exists():
            check_scenario(source_folder / entry.path, entry.content_sha256)
            new_entries.append(entry)
            _link_or_copy(source_folder / entry.path, target)
            taken_entries.append(entry)
        elif old_entry is not None:
            # The file there may be packed otherwise: its own entry stays.
            limit = {"twin_floor": entry.twin_floor}
            taken_entries.append(old_entry.model_copy(update=limit))
        elif target.is_file() and file_sha256(target) == entry.file_sha256:
            taken_entries.append(entry)
    record_entry_hashes(target_folder, new_entries)
    for environment in source_manifest.environments:
        manifest = merge_entries(size, manifest, environment=environment)
    return merge_entries(size, manifest, taken_entries)


def _list_known_entries(size: Size, manifest: Manifest) -> list[FileEntry]:
    """Return the entries of scenarios that the size has in the same subset.

    A source of another minor version may have more scenarios.
    """
    entries = []
    for entry in manifest.files:
        if entry.scenario in size.subsets.get(entry.subset, ()):
            entries.append(entry)
    return entries


def _adds_to(old_entry: FileEntry | None, entry: FileEntry) -> bool:
    """Tell whether an entry is new, or may add a predictability limit to an old one."""
    if old_entry is None:
        return True
    is_same_content = old_entry.content_sha256 == entry.content_sha256
    return is_same_content and not old_entry.twin_floor


def _link_or_copy(source: Path, target: Path) -> None:
    with atomic_path(target) as temporary:
        # Files are only ever replaced, so a shared one cannot change.
        try:
            os.link(source.resolve(), temporary)
        except OSError:
            shutil.copyfile(source, temporary)


def list_scenarios_to_gather(size: Size, root: Path, source: Path) -> tuple[int, ...]:
    """Return the scenarios whose files :func:`gather` would take from a source.

    :func:`gather` also takes predictability limits for scenarios that the root folder
    has; these are not listed.

    Raises:
        UsageError: the source has no such data set, or is the root folder.
    """
    source_manifest = _read_source_manifest(size, source)
    _require_other_folder(size, root, source)
    target_manifest = read_or_empty(size, root)
    source_folder = size.folder(source)
    target_folder = size.folder(root)
    scenarios = []
    for entry in _list_known_entries(size, source_manifest):
        is_new = target_manifest.entry(entry.scenario) is None
        has_source_file = has_file(source_folder / entry.path)
        has_target_file = (target_folder / entry.path).exists()
        if is_new and has_source_file and not has_target_file:
            scenarios.append(entry.scenario)
    return tuple(scenarios)


def _read_source_manifest(size: Size, source: Path) -> Manifest:
    """Return the manifest of a source; refuse a source that has none."""
    manifest = read_manifest(source, size.split, size.name, size.major)
    if manifest is None:
        raise _refuse_source(size, source, got="no manifest of that data set")
    return manifest


def _require_other_folder(size: Size, root: Path, source: Path) -> None:
    """Refuse a source that is the root folder."""
    if size.folder(source).resolve() == size.folder(root).resolve():
        raise _refuse_source(size, source, got="the folder to write to")


def _refuse_source(size: Size, source: Path, *, got: str) -> UsageError:
    return UsageError(
        f"nothing of {size.split} {size.name} can be gathered there: {got}; name the "
        "--root of another call of lagbench generate",
        where=str(source),
    )


@contextlib.contextmanager
def suspend_fetching(root: Path) -> Iterator[None]:
    """Fetch nothing into a working copy from which this process writes to the store.

    Where several data sets are written, fetching begins again after the last of them.
    """
    _copies_of_writers.append(root)
    try:
        yield
    finally:
        _copies_of_writers.remove(root)
        _manifests.clear()
