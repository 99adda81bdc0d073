"""Paint the pictures of a data set card.

Only :func:`.cards.write_cards` imports this module, and only where pictures are to be
painted: it loads the drawing modules.
"""

from __future__ import annotations

from pathlib import Path

from lagbench.data.manifest import FileEntry, Manifest
from lagbench.data.registry import Registry, Size, Split
from lagbench.figures.plot import contact_sheet, plot_frame

from .card_files import PICTURES


def paint_pictures(root: Path, size: Size, split: Split, manifest: Manifest) -> None:
    """Paint a contact sheet of all scenarios and one frame of a test scenario."""
    registry = Registry({size.split: split}, {})
    folder = size.folder(root)
    sheet_name, frame_name = PICTURES
    contact_sheet(
        size.split, size.name, folder / sheet_name, root=root, registry=registry
    )

    entry = _first_test_entry(manifest)
    frame = min(size.task.frames_of_interest[-1], entry.frames - 1)
    plot_frame(folder / entry.path, frame, folder / frame_name, registry=registry)


def _first_test_entry(manifest: Manifest) -> FileEntry:
    """Return the first file of test, of a manifest without one its first file."""
    for entry in manifest.files:
        if entry.subset == "test":
            return entry
    return manifest.files[0]
