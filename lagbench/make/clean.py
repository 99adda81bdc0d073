"""Remove what killed writers left, or a data set."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path

from lagbench.atomic import SUFFIX
from lagbench.data.layout import (
    CARD_NAME,
    CROISSANT_NAME,
    MANIFEST_NAME,
    NOTES_NAME,
    PICTURES,
    quote_root,
)
from lagbench.data.local import DESCRIPTION, locate
from lagbench.data.lock import LOCK_NAME, dataset_lock
from lagbench.data.registry import Registry, Size
from lagbench.errors import UsageError, WorkFailedError

# what lagbench writes beside the subsets
CARDS = (MANIFEST_NAME, CARD_NAME, CROISSANT_NAME, *PICTURES)


@dataclass(frozen=True, kw_only=True)
class CleanResult:
    """What was, or with ``dry_run`` would be, removed."""

    removed: tuple[Path, ...]  # the files, without lagbench's own lock and notes
    bytes: int  # their length together [bytes]
    dry_run: bool  # whether they are still there


def clean(
    split: str | Path,
    size: str | None = None,
    *,
    root: str | Path | None = None,
    leftovers: bool = False,
    force: bool = False,
    dry_run: bool = False,
    registry: Registry | None = None,
) -> CleanResult:
    """Remove a data set; files that lagbench did not write stay.

    Args:
        split: name of the split, or path of a local split's folder.
        size: name of the size; the only one that is there when None. Where several are
            there it must be named.
        root: folder of all data sets; else ``LAGBENCH_ROOT``, else the user data
            folder.
        leftovers: remove only temporary files of killed writers.
        force: also remove a local split, whose data lagbench cannot make again.
        dry_run: only say what would go; writes nothing, a lock neither.
        registry: where splits are described; ours when None.

    Raises:
        UsageError: unknown split or size, no size is named and several are there, or
            the split is a local one, without ``force`` or ``leftovers``.
        DataError: no size is named, and none of several is there.
        WorkFailedError: another process writes the data set, or a file cannot be
            removed.
    """
    tier, home, _ = locate(
        split, size, root=root, registry=registry, is_chosen_of_several=False
    )
    folder = tier.folder(home)
    if not folder.is_dir():
        return CleanResult(removed=(), bytes=0, dry_run=dry_run)
    if not (tier.simulated or leftovers or force):
        raise _local_split_error(tier, home)

    lock: AbstractContextManager[object]
    if dry_run:
        lock = nullcontext()
    else:
        lock = dataset_lock(home, tier.split, tier.name, tier.major, timeout=0)
    with lock:
        paths = {path for path in folder.rglob(f".*{SUFFIX}") if path.is_file()}
        if not leftovers:
            paths |= _data_set_files(tier, folder)
        length = _total_length(paths)
        if not dry_run:
            _remove_files(paths)
            if not leftovers:
                # whoever waits for a lock that is gone takes a new one
                for name in (NOTES_NAME, LOCK_NAME):
                    (folder / name).unlink(missing_ok=True)
    if not dry_run and not leftovers:
        _remove_empty_folders(folder, home)
    return CleanResult(removed=tuple(sorted(paths)), bytes=length, dry_run=dry_run)


def _local_split_error(size: Size, home: Path) -> UsageError:
    names = f"--split {size.split} --size {size.name} --root {quote_root(home)}"
    return UsageError(
        "lagbench cannot make these data again: a local split, made by import; "
        f"lagbench clean {names} --force",
        where=str(size.folder(home)),
    )


def _data_set_files(size: Size, folder: Path) -> set[Path]:
    """Return the files of a data set that lagbench wrote and that are there."""
    paths = set()
    for subset, ids in size.subsets.items():
        for scenario in ids:
            paths.add(folder / subset / f"{scenario:04d}.nc")
    if size.simulated:
        for name in CARDS:
            paths.add(folder / name)
    else:
        # A local split has no cards; its description says nothing without its data.
        paths |= {folder / MANIFEST_NAME, folder.parents[1] / DESCRIPTION}
    return {path for path in paths if path.is_file()}


def _total_length(paths: Iterable[Path]) -> int:
    length = 0
    for path in paths:
        # a dry run may stand beside a writer
        with suppress(FileNotFoundError):
            length += path.stat().st_size
    return length


def _remove_files(paths: Iterable[Path]) -> None:
    for path in paths:
        try:
            path.unlink(missing_ok=True)
        except OSError as error:
            raise WorkFailedError(
                f"cannot remove a file: {error.strerror}; see who owns the file and "
                "its folder: ls -l",
                where=str(path),
            ) from error


def _remove_empty_folders(folder: Path, home: Path) -> None:
    """Remove folders that hold nothing any more, up to the root folder; links stay."""
    # another process may have been faster
    with suppress(OSError):
        children = []
        for child in folder.iterdir():
            if child.is_dir():
                children.append(child)
        for place in (*children, folder, *folder.parents):
            if home in place.parents and not place.is_symlink():
                # a folder that holds something stays
                with suppress(OSError):
                    place.rmdir()
