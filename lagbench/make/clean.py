"""Remove what killed writers left, or a generated data set."""

from __future__ import annotations

from contextlib import nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path

from lagbench.atomic import SUFFIX
from lagbench.data.layout import MANIFEST_NAME, NOTES_NAME
from lagbench.data.local import DESCRIPTION, locate
from lagbench.data.lock import LOCK_NAME, dataset_lock
from lagbench.data.registry import Registry
from lagbench.errors import WorkFailedError

from .cards import CARD_NAME, CROISSANT_NAME, PICTURES

CARDS = (
    MANIFEST_NAME,
    CARD_NAME,
    CROISSANT_NAME,
    *PICTURES,
)  # what lagbench writes beside the subsets


@dataclass(frozen=True, kw_only=True)
class CleanResult:
    """What was, or with ``dry_run`` would be, removed."""

    removed: tuple[Path, ...]  # the files
    bytes: int  # their length together [bytes]
    dry_run: bool  # whether they are still there


def clean(
    split: str | Path,
    size: str | None = None,
    *,
    root: str | Path | None = None,
    leftovers: bool = False,
    dry_run: bool = False,
    registry: Registry | None = None,
) -> CleanResult:
    """Remove a generated data set; files that lagbench did not write stay.

    Args:
        split: name of the split.
        size: name of the size; the only one that is there when None.
        root: folder of all data sets; else ``LAGBENCH_ROOT``, else the user data
            folder.
        leftovers: remove only temporary files of killed writers.
        dry_run: only say what would go; writes nothing, a lock neither.
        registry: where splits are described; ours when None.

    Raises:
        UsageError: unknown split or size.
        WorkFailedError: another process writes the data set, or a file cannot be
            removed.
    """
    tier, home, _ = locate(split, size, root=root, registry=registry)
    folder = tier.folder(home)
    if not folder.is_dir():
        return CleanResult(removed=(), bytes=0, dry_run=dry_run)
    with (
        nullcontext()
        if dry_run
        else dataset_lock(home, tier.split, tier.name, tier.major, timeout=0)
    ):
        found = {path for path in folder.rglob(f".*{SUFFIX}") if path.is_file()}
        if not leftovers:
            ours = {
                folder / subset / f"{i:04d}.nc"
                for subset, ids in tier.subsets.items()
                for i in ids
            }
            if tier.simulated:
                ours |= {folder / name for name in CARDS}
            else:  # has no cards; its description says nothing without its data
                ours |= {folder / MANIFEST_NAME, folder.parents[1] / DESCRIPTION}
            found |= {path for path in ours if path.is_file()}
        length = 0
        for path in found:
            with suppress(FileNotFoundError):  # a dry run may stand beside a writer
                length += path.stat().st_size
        for path in () if dry_run else found:
            try:
                path.unlink(missing_ok=True)
            except OSError as error:
                raise WorkFailedError(
                    "cannot remove a file", where=str(path), got=error.strerror
                ) from error
        if not dry_run and not leftovers:
            for name in (
                NOTES_NAME,
                LOCK_NAME,
            ):  # who waits for a lock that is gone takes a new one
                (folder / name).unlink(missing_ok=True)
    if not dry_run and not leftovers:
        # Folders that hold nothing any more go too, up to the root folder; links stay.
        with suppress(OSError):  # somebody else was faster
            for place in (
                *(child for child in folder.iterdir() if child.is_dir()),
                folder,
                *folder.parents,
            ):
                if home in place.parents and not place.is_symlink():
                    with suppress(OSError):  # it holds something
                        place.rmdir()
    return CleanResult(removed=tuple(sorted(found)), bytes=length, dry_run=dry_run)
