"""Take finished scenarios over from other root folders, as the jobs of an array leave them.

Each job generates some scenarios into a root folder of its own. What they finished is linked
(copied where the file system cannot) into one folder, and their manifests are merged, so that
the whole equals what one call would have left.
"""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from lagbench.atomic import atomic_path
from lagbench.data.layout import dataset_folder
from lagbench.data.manifest import FileEntry, Manifest, merged, read_manifest
from lagbench.data.registry import Size
from lagbench.data.scenario import check_scenario
from lagbench.errors import UsageError

__all__ = ["gather"]


def gather(size: Size, root: Path, source: Path, manifest: Manifest) -> Manifest:
    """Take over what a source has finished and the folder does not hold."""
    there = dataset_folder(source, size.split, size.name, size.major)
    here = dataset_folder(root, size.split, size.name, size.major)
    found = read_manifest(source, size.split, size.name, size.major)
    if found is None or there.resolve() == here.resolve():
        raise UsageError(
            "nothing can be gathered from a folder",
            where=str(source),
            expected=f"a root folder with {size.split} {size.name} of another call of lagbench generate",
            got="the folder to write to" if found else "no manifest of that data set",
        )
    taken = list(_taken(there, here, found, manifest))
    for environment in found.environments:
        manifest = merged(size, manifest, environment=environment)
    return merged(size, manifest, taken)


def _taken(there: Path, here: Path, found: Manifest, held: Manifest) -> Iterator[FileEntry]:
    """Bring over the files that are not held, and yield their entries."""
    for entry in found.files:
        old = held.entry(entry.scenario)
        if old is None or (not old.twin_floor and old.content_sha256 == entry.content_sha256):
            if not (here / entry.path).exists():
                _bring(there / entry.path, here / entry.path, entry)
            yield entry


def _bring(origin: Path, target: Path, entry: FileEntry) -> None:
    check_scenario(origin, entry.content_sha256)
    with atomic_path(target) as temporary:
        _link(origin, temporary)


def _link(origin: Path, target: Path) -> None:
    """Link a file, or copy it: files are only ever replaced, so a shared one cannot change."""
    with contextlib.suppress(OSError):
        os.link(origin, target)
        return
    shutil.copyfile(origin, target)
