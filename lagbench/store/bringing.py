"""Bring scenarios of a store into its working copy, so that they can be read as files.

The store's manifest says what is there; each object is fetched as from a mirror, to a temporary
name, going on where an earlier attempt stopped, and gets its name once its content hash is that
of datasets.yaml, or of the manifest where datasets.yaml has none. What is in the working copy
and is what the manifest says is not fetched again.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from pydantic import ValidationError

from lagbench.data.checksums import file_sha256
from lagbench.data.layout import MANIFEST_NAME, dataset_folder, url_of
from lagbench.data.lock import dataset_lock
from lagbench.data.manifest import FileEntry, Manifest, merge, read_manifest, write_manifest
from lagbench.data.registry import Size, spell_ids
from lagbench.errors import DataError
from lagbench.work.machine import may_differ

from .fetching import address_of, called_store, fetch_scenarios
from .mirror import fetch_text
from .mirror_errors import NotDataError, NotOnMirrorError, WrongContentError
from .remote import Remote, check_bucket

__all__ = ["bring", "is_right", "local_manifest", "merged", "remote_manifest", "unstored", "writing"]

FRESH = 30.0
"""How long a store's manifest is not asked for again by this process [s]."""

MANIFEST_LIMIT = 64 << 20
"""Longest manifest that is read [bytes]."""

_asked: dict[tuple[str, str], tuple[float, Manifest | None]] = {}
_written: set[Path] = set()


def bring(size: Size, root: Path, scenarios: Iterable[int] = (), *, thoroughly: bool = False) -> bool:
    """Bring a data set's manifest and some scenarios where the root is a store's working copy.

    A scenario that the store does not have is left to the caller, who misses its file.

    Args:
        size: tier of a split.
        root: folder of all data sets; nothing is done for one that is no working copy.
        scenarios: ids.
        thoroughly: whether to hash files that are there, and not only look at their lengths; and
            to look whether the store has all that its manifest names.

    Returns:
        Whether anything came.

    Raises:
        DataError: the store has no such bucket, or sent what is no data or has other content.
        WorkFailedError: the store refuses or does not answer, or the disk is full.
        UsageError: what reads this kind of address is not installed.
    """
    url, scenarios = url_of(root), tuple(scenarios)
    if url is None or root in _written:
        return False
    found = remote_manifest(size, url)
    if found is None or any(found.entry(i) is None for i in scenarios):
        found = remote_manifest(size, url, fresh=0.0)  # it may have come just now
    if found is None:
        return False
    if thoroughly:
        _check_objects(size, url, found)
    old = local_manifest(size, root)
    wanted = [e for i in scenarios if (e := found.entry(i)) and is_right(e, size, found)]
    _refuse_strangers(size, url, found, scenarios)
    lacking = [entry for entry in wanted if not _is_here(entry, size, root, old, thoroughly=thoroughly)]
    if not lacking and merged(size, root, found, old) == old:
        return False
    with dataset_lock(root, size.split, size.name, size.major):
        lacking = [e for e in lacking if not _is_here(e, size, root, old, thoroughly=True)]
        fetch_scenarios(size, root, url, lacking)
        write_manifest(root, merged(size, root, found, local_manifest(size, root)))
    return True


def remote_manifest(size: Size, url: str, *, fresh: float | None = None) -> Manifest | None:
    """Return the manifest of a data set in a store; None where there is none."""
    place = address_of(size, url, MANIFEST_NAME)
    when, known = _asked.get((url, place), (-1e9, None))
    if time.monotonic() - when < (FRESH if fresh is None else fresh):
        return known
    try:
        with called_store():
            text = fetch_text(place, limit=MANIFEST_LIMIT)
    except NotOnMirrorError:
        check_bucket(url)
        found = None
    else:
        found = _parsed(text, place)
    _asked[url, place] = (time.monotonic(), found)
    return found


def unstored(size: Size, root: Path, scenarios: Iterable[int]) -> tuple[int, ...]:
    """Return scenarios that the manifest of a working copy's store lacks."""
    url = url_of(root)
    if url is None:
        return ()
    found = remote_manifest(size, url)
    return tuple(i for i in scenarios if found is None or found.entry(i) is None)


def is_right(entry: FileEntry, size: Size, manifest: Manifest) -> bool:
    """Return whether an entry of a store's manifest is what datasets.yaml means.

    A file of a machine that promises no equal bits may differ, as it may in a local folder.
    """
    if size.measured is None or entry.scenario not in size.scenarios:
        return entry.scenario in size.scenarios
    return entry.has_hash(size.measured.scenario_sha256.get(entry.scenario)) or (
        manifest.identity == "tolerance" and may_differ(entry.device, manifest.environments)
    )


def merged(size: Size, root: Path, found: Manifest, local: Manifest | None) -> Manifest:
    """Return the store's manifest with what only the working copy holds."""
    folder = dataset_folder(root, size.split, size.name, size.major)
    if local is None:
        return found
    ours = [e for e in local.files if found.entry(e.scenario) is None and is_right(e, size, local)]
    ours = [entry for entry in ours if (folder / entry.path).is_file()]
    if not ours:
        return found
    for environment in (*local.environments, None):
        found = merge(
            found,
            ours if environment is None else (),
            split=size.split,
            size=size.name,
            version=size.version,
            subsets=size.subsets,
            environment=environment,
            recorded=size.measured.scenario_sha256 if size.measured else None,
        )
    if found.statistics or found.subset_sha256.get("train") != local.subset_sha256.get("train"):
        return found
    return found.model_copy(update={"statistics": local.statistics})


def local_manifest(size: Size, root: Path) -> Manifest | None:
    """Return the manifest of the working copy; None where there is none that can be read."""
    try:
        return read_manifest(root, size.split, size.name, size.major)
    except DataError:
        return None


@contextmanager
def writing(root: Path) -> Iterator[None]:
    """Bring nothing into a working copy from which this process writes to the store."""
    _written.add(root)
    try:
        yield
    finally:
        _written.discard(root)
        _asked.clear()


def _parsed(text: bytes, place: str) -> Manifest:
    try:
        return Manifest.model_validate_json(text)
    except ValidationError as error:
        raise NotDataError(
            "the store's manifest is none",
            where=place,
            expected="a manifest.json as lagbench generate writes it",
            got=ascii(text[:80].decode("utf-8", "replace")),
            fix="remove that object; lagbench generate with this --root writes it anew",
        ) from error


def _refuse_strangers(size: Size, url: str, found: Manifest, scenarios: Iterable[int]) -> None:
    other = [i for i in scenarios if (e := found.entry(i)) and not is_right(e, size, found)]
    if other:
        raise WrongContentError(
            "the store holds another data set",
            where=f"{address_of(size, url, MANIFEST_NAME)}, scenarios {spell_ids(other)}",
            expected="the content hashes of datasets.yaml",
            got=f"version {found.version}, data set hash {found.dataset_sha256}",
            fix=f"lagbench generate --split {size.split} --size {size.name} --root {url} puts it right",
        )


def _check_objects(size: Size, url: str, found: Manifest) -> None:
    """Refuse a manifest that names what is not there, or of another length."""
    if url.startswith(("http://", "https://")):  # which list nothing
        return
    there = Remote(url, dataset_folder(Path(), size.split, size.name, size.major).as_posix()).sizes()
    wrong = [entry.scenario for entry in found.files if there.get(entry.path) != entry.bytes]
    if wrong:
        raise DataError(
            "the store's manifest names objects that are not there, or of another length",
            where=f"{address_of(size, url, MANIFEST_NAME)}, scenarios {spell_ids(wrong)}",
            fix=f"lagbench generate --split {size.split} --size {size.name} --root {url}",
        )


def _is_here(entry: FileEntry, size: Size, root: Path, old: Manifest | None, *, thoroughly: bool) -> bool:
    """Return whether the working copy holds what an entry describes."""
    path = dataset_folder(root, size.split, size.name, size.major) / entry.path
    if not path.is_file() or path.stat().st_size != entry.bytes:
        return False
    known = old.entry(entry.scenario) if old else None
    if known is not None and known.file_sha256 == entry.file_sha256 and not thoroughly:
        return True
    return file_sha256(path) == entry.file_sha256
