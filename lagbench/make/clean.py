"""Remove what killed writers left, or a data set."""

from __future__ import annotations

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
from lagbench.data.registry import Registry
from lagbench.errors import UsageError

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
        names = f"--split {tier.split} --size {tier.name} --root {quote_root(home)}"
        raise UsageError(
            "lagbench cannot make these data again: a local split, made by import; "
            f"lagbench clean {names} --force",
            where=str(folder),
        )

    lock: AbstractContextManager[object]
    if dry_run:
        lock = nullcontext()
    else:
        lock = dataset_lock(home, tier.split, tier.name, tier.major, timeout=0)
    with lock:
        paths = {path for path in folder.rglob(f".*{SUFFIX}") if path.is_file()}
        if not leftovers:
            for subset, ids in tier.subsets.items():
                paths.update(folder / subset / f"{i:04d}.nc" for i in ids)
            if tier.simulated:
                paths.update(folder / name for name in CARDS)
            else:
                # A local split has no cards; its description says nothing without data.
                paths |= {folder / MANIFEST_NAME, folder.parents[1] / DESCRIPTION}
        paths = {path for path in paths if path.is_file()}
        length = sum(path.stat().st_size for path in paths)
        if not dry_run:
            for path in paths:
                path.unlink(missing_ok=True)
            if not leftovers:
                # whoever waits for a lock that is gone takes a new one
                for name in (NOTES_NAME, LOCK_NAME):
                    (folder / name).unlink(missing_ok=True)
    if not dry_run and not leftovers:
        # folders that hold nothing any more, up to the root folder; links stay
        for place in (*folder.iterdir(), folder, *folder.parents):
            if home in place.parents and place.is_dir() and not place.is_symlink():
                with suppress(OSError):
                    place.rmdir()
    return CleanResult(removed=tuple(sorted(paths)), bytes=length, dry_run=dry_run)
