"""Data set cards: README.md with pictures, and croissant.json, beside the manifest.

Both follow from the registry and the manifest alone and hold no date, so the same data
set gets the same bytes. Pictures are painted where matplotlib is installed.
"""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

import jinja2
import yaml

from lagbench.atomic import ROOT_OPTION, write_atomically
from lagbench.data.box import AXES, WALL_NAMES
from lagbench.data.layout import CARD_NAME, CROISSANT_NAME, PICTURES, format_ids
from lagbench.data.manifest import Manifest, mean
from lagbench.data.registry import Registry, Size, Split
from lagbench.figures.tables import escape, escape_prose

from .croissant import KEYWORDS, croissant_json

_PAIRS_WITH_SNOW = (
    "Pairs with snow come to rest first. The attribute `active_frames` of a file "
    "counts the predicted frames up to the last one with at least 1 % of the greatest "
    "kinetic energy."
)

# what a reader of one split's card must know beside its description
NOTES: Mapping[str, str] = {
    "cavity": (
        "The walls drive the flow. A model is given their velocities in all frames, "
        "also in the frames that it predicts. `wall_velocity` at frame f acts from "
        "frame f-1 to frame f."
    ),
    "cavity-3d": (
        "The walls drive the flow. A model is given their velocities in all frames, "
        "also in the frames that it predicts. `wall_velocity` at frame f acts from "
        "frame f-1 to frame f."
    ),
    "multimaterial": _PAIRS_WITH_SNOW,
    "multimaterial-3d": _PAIRS_WITH_SNOW,
    "fluid": (
        "Scenarios of train differ in length: those that move longer have more "
        "frames. The attribute `active_frames` of a file counts the predicted frames "
        "up to the last one with at least 1 % of the greatest kinetic energy."
    ),
    "poiseuille": (
        "A force drives the flow. A model is given the force in all frames, also in "
        "the frames that it predicts. `body_force` at frame f acts from frame f-1 to "
        "frame f. Its first value acts on the lower half, its second one on the upper "
        "half."
    ),
    "cylinder": (
        "The disc stands at (`obstacle_x`, `obstacle_y`) and has the diameter "
        "`obstacle_diameter`. These are attributes of each file. A model is given "
        "them, and also the speed of the stream and the fringe. Files hold the "
        "particles of the fluid only; none of them enters the disc."
    ),
    "curl-noise": (
        "The energy decays, and it decays faster if the frequency is higher. The "
        "equations have no viscosity. The grid acts like one."
    ),
}

COMPRESSIBILITY: tuple[tuple[str, str, Callable[[Iterable[float]], float]], ...] = (
    ("speed over speed of sound, 99.9 %", "mach_999", max),
    ("speed over speed of sound, largest", "mach_max", max),
    ("J of liquid, 99.9 % lie above", "liquid_jacobian_999", min),
    ("J of liquid, smallest at any substep", "liquid_jacobian_min", min),
    ("Jp of snow, smallest at any substep", "snow_jp_min", min),
    ("particles that reached a numerical bound", "clamped_particles", sum),
)
"""Rows of the compressibility: title, number of a file, and which file is the worst."""


def write_cards(root: Path, size: Size, split: Split, manifest: Manifest) -> list[Path]:
    """Write README.md, croissant.json and, with matplotlib, the pictures.

    Nothing is painted or written where the texts are those of the manifest already.

    Returns:
        The paths of the files, README.md first.
    """
    folder = size.folder(root)
    texts: dict[Path, bytes] = {}
    for name, text in card_texts(size, split, manifest).items():
        texts[folder / name] = text
    pictures = [folder / name for name in _picture_names(manifest)]
    # The card names every content hash. Where its text is right already, the pictures
    # are of the same data.
    is_current = all(path.is_file() for path in (*texts, *pictures))
    if not is_current or any(path.read_bytes() != texts[path] for path in texts):
        if pictures:
            paint_pictures(root, size, split, manifest)
        for path, text in texts.items():
            write_atomically(path, text)
    return [*texts, *pictures]


def paint_pictures(root: Path, size: Size, split: Split, manifest: Manifest) -> None:
    """Paint a contact sheet of all scenarios and one frame of a test scenario."""
    # the drawing modules are loaded only where there is something to paint
    from lagbench.figures.canvas import save
    from lagbench.figures.plot import contact_sheet, draw_frame

    registry = Registry({size.split: split}, {})
    folder = size.folder(root)
    sheet_name, frame_name = PICTURES
    contact_sheet(
        size, root, folder / sheet_name, registry=registry, option=ROOT_OPTION
    )

    # the first file of test; without one, the first of all
    entry = min(manifest.files, key=lambda entry: entry.subset != "test")
    frame = min(size.task.frames_of_interest[-1], entry.frames - 1)
    drawn = draw_frame(folder / entry.path, frame, registry=registry)
    save(drawn, folder / frame_name, option=ROOT_OPTION)


def card_texts(size: Size, split: Split, manifest: Manifest) -> dict[str, bytes]:
    """Return the texts of a data set's card by name, README.md first."""
    pictures = _picture_names(manifest)
    card = dataset_card(size, split, manifest, pictures=pictures)
    document = croissant_json(size, split, manifest)
    return {CARD_NAME: card.encode(), CROISSANT_NAME: document.encode()}


def _picture_names(manifest: Manifest) -> list[str]:
    if manifest.files and importlib.util.find_spec("matplotlib"):
        return list(PICTURES)
    return []


def describe_truth_error(size: Size) -> str:
    """Return how far the truth is from a run twice as fine, in the metric that ranks.

    The metrics are not loaded for its name.
    """
    if size.truth_error is None:
        return "not measured"
    return f"{size.truth_error:.4g} in the metric that ranks"


def _format_range(values: Sequence[int]) -> str:
    """Return the least and the greatest number, or the one that all are."""
    least = min(values, default=0)
    greatest = max(values, default=0)
    return f"{least:,}" if least == greatest else f"{least:,} to {greatest:,}"


def dataset_card(
    size: Size, split: Split, manifest: Manifest, *, pictures: list[str]
) -> str:
    """Return the card of a data set as Markdown with a YAML head."""
    # which catalogues read
    head = {
        "pretty_name": f"{split.title} ({size.split} {size.name})",
        "license": split.licence.lower(),
        "tags": list(KEYWORDS),
        "size_categories": ["n<1K" if len(manifest.files) < 1000 else "1K<n<10K"],
        "version": manifest.version,
    }
    facts: dict[str, list[float]] = {}
    for entry in manifest.files:
        for name, value in entry.facts.items():
            facts.setdefault(name, []).append(value)
    # A number counts where a file states it: files of others may state some only.
    soundness = []
    for title, name, choose in COMPRESSIBILITY:
        if name in facts:
            soundness.append((title, choose(facts[name])))

    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters.update(
        text=escape, prose=escape_prose, ids=format_ids, mean=mean, range=_format_range
    )
    return environment.get_template("card.md").render(
        size=size,
        split=split,
        manifest=manifest,
        files=manifest.files,
        head=yaml.safe_dump(head, sort_keys=False, width=math.inf),
        note=NOTES.get(size.split),
        pictures={name: PICTURES[name] for name in pictures},
        truth_error=describe_truth_error(size),
        walls=WALL_NAMES[: 2 * size.dimension],
        axes=AXES[: size.dimension],
        facts=sorted(facts),
        soundness=soundness,
    )
