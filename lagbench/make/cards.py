"""Data set cards: README.md with pictures, and croissant.json, beside the manifest.

Both follow from the registry and the manifest alone and hold no date, so the same data
set gets the same bytes. Pictures are painted where matplotlib is installed.
"""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

from lagbench.atomic import ROOT_OPTION, write_atomically
from lagbench.data.box import AXES, WALL_NAMES
from lagbench.data.layout import CARD_NAME, CROISSANT_NAME, PICTURES, format_ids
from lagbench.data.manifest import FileEntry, Manifest, mean
from lagbench.data.registry import Parameter, Registry, Size, Split
from lagbench.errors import format_count
from lagbench.figures.tables import escape, escape_prose, markdown

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

FORCE_PARAMETER = "force_max"
"""Parameter of the splits that a body force drives."""

COMPRESSIBILITY: tuple[tuple[str, str, Callable[[Iterable[float]], float]], ...] = (
    ("speed over speed of sound, 99.9 %", "mach_999", max),
    ("speed over speed of sound, largest", "mach_max", max),
    ("J of liquid, 99.9 % lie above", "liquid_jacobian_999", min),
    ("J of liquid, smallest at any substep", "liquid_jacobian_min", min),
    ("Jp of snow, smallest at any substep", "snow_jp_min", min),
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
    pictures = []
    for name in _picture_names(manifest):
        pictures.append(folder / name)

    if not _is_current(texts, pictures):
        if pictures:
            paint_pictures(root, size, split, manifest)
        for path, text in texts.items():
            write_atomically(path, text)
    return [*texts, *pictures]


def paint_pictures(root: Path, size: Size, split: Split, manifest: Manifest) -> None:
    """Paint a contact sheet of all scenarios and one frame of a test scenario."""
    # the drawing modules are loaded only where there is something to paint
    from lagbench.figures.canvas import save
    from lagbench.figures.plot import draw_contact_sheet, draw_frame

    registry = Registry({size.split: split}, {})
    folder = size.folder(root)
    sheet_name, frame_name = PICTURES
    draw_contact_sheet(
        size, root, folder / sheet_name, registry=registry, option=ROOT_OPTION
    )

    entry = _first_test_entry(manifest)
    frame = min(size.task.frames_of_interest[-1], entry.frames - 1)
    drawn = draw_frame(folder / entry.path, frame, registry=registry)
    save(drawn, folder / frame_name, option=ROOT_OPTION)


def _first_test_entry(manifest: Manifest) -> FileEntry:
    """Return the first file of test; without one, the first of the manifest."""
    for entry in manifest.files:
        if entry.subset == "test":
            return entry
    return manifest.files[0]


def _is_current(texts: Mapping[Path, bytes], pictures: list[Path]) -> bool:
    """Return whether the files of a card are there and belong to the same data.

    The card names every content hash. Where its text is right already, the pictures are
    of the same data.
    """
    for path in (*texts, *pictures):
        if not path.is_file():
            return False
    return all(path.read_bytes() == text for path, text in texts.items())


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


def dataset_card(
    size: Size, split: Split, manifest: Manifest, *, pictures: list[str]
) -> str:
    """Return the card of a data set as Markdown with a YAML head."""
    parts = [
        _yaml_head(size, split, manifest),
        f"# {escape(split.title)} · {size.split} {size.name}",
        escape_prose(split.description),
    ]
    if size.split in NOTES:
        parts.append(escape_prose(NOTES[size.split]))
    for name in pictures:
        parts.append(f"![{PICTURES[name]}]({name})")

    parts += ["## In short", _summary_table(size, manifest)]
    parts += ["## Subsets", _subset_table(size, manifest)]
    parts += ["## Reading", *_reading_section(size)]
    parts += ["## Task", _task_table(size, manifest)]
    if manifest.statistics:
        parts += _statistics_section(size, manifest)
    parts += _soundness_section(manifest)
    parts += ["## Parameters", _parameter_table(size)]
    parts += ["## Regenerate and verify", *_verification_section(size, manifest)]
    parts += ["## Scenarios", _scenario_table(manifest)]

    citation = f"{escape(split.licence)}. {escape(split.citation)}."
    parts += ["## Licence and citation", citation]
    return "\n\n".join(parts) + "\n"


def _yaml_head(size: Size, split: Split, manifest: Manifest) -> str:
    """Return the YAML head of a card, which catalogues read."""
    category = "1K<n<10K"
    if len(manifest.files) < 1000:
        category = "n<1K"
    values = {
        "pretty_name": f"{split.title} ({size.split} {size.name})",
        "license": split.licence.lower(),
        "tags": list(KEYWORDS),
        "size_categories": [category],
        "version": manifest.version,
    }
    lines = ["---"]
    for key, value in values.items():
        lines.append(f"{key}: {_yaml_value(value)}")
    lines.append("---")
    return "\n".join(lines)


def _yaml_value(value: object) -> str:
    """Return a string or a list as YAML on one line.

    JSON is YAML, except for characters that do not print: YAML takes some of them for
    line breaks, and forbids others. So they are escaped.
    """
    characters = []
    for character in json.dumps(value, ensure_ascii=False):
        if not character.isprintable():
            character = f"\\U{ord(character):08x}"
        characters.append(character)
    return "".join(characters)


def describe_truth_error(size: Size) -> str:
    """Return how far the truth is from a run twice as fine, in the metric that ranks.

    The metrics are not loaded for its name.
    """
    if size.truth_error is None:
        return "not measured"
    return f"{size.truth_error:.4g} in the metric that ranks"


def _summary_table(size: Size, manifest: Manifest) -> str:
    data_hash = "none before it is complete"
    if manifest.dataset_sha256:
        data_hash = f"`{manifest.dataset_sha256}`"

    frame_counts = []
    particle_counts = []
    byte_count = 0
    for entry in manifest.files:
        frame_counts.append(entry.frames)
        particle_counts.append(entry.particles)
        byte_count += entry.bytes
    fewest = min(frame_counts, default=0)
    most = max(frame_counts, default=0)
    frame_range = str(fewest)
    if most > fewest:
        frame_range = f"{fewest} to {most}"
    fewest_particles = min(particle_counts, default=size.particles)
    most_particles = max(particle_counts, default=size.particles)
    particle_range: int | str = most_particles
    if most_particles > fewest_particles:
        particle_range = f"{fewest_particles:,} to {most_particles:,}"

    sides = []
    for low, high in size.bounds:
        sides.append(f"[{low:.9g}, {high:.9g}]")
    rows = [
        ("version", manifest.version),
        ("complete", manifest.complete),
        ("data set hash", data_hash),
        ("identity", manifest.identity),
        ("scenarios", len(manifest.files)),
        ("frames per scenario", frame_range),
        ("frames of all scenarios", sum(frame_counts)),
        ("particles", particle_range),
        ("frame interval", f"{size.frame_interval:.6g} s"),
        ("substep", f"{size.dt:.6g} s, {size.substeps_per_frame} per frame"),
        ("refinement of the solver", size.refinement),
        ("truth error", describe_truth_error(size)),
        ("box", " x ".join(sides)),
        ("periodic axes", ", ".join(size.periodic) or "none"),
        ("bytes", byte_count),
    ]
    return markdown(("", ""), rows)


def _subset_table(size: Size, manifest: Manifest) -> str:
    rows = []
    for name, ids in size.subsets.items():
        entry_count = 0
        frame_count = 0
        byte_count = 0
        for entry in manifest.files:
            if entry.subset == name:
                entry_count += 1
                frame_count += entry.frames
                byte_count += entry.bytes
        subset_hash = "incomplete"
        if name in manifest.subset_sha256:
            subset_hash = f"`{manifest.subset_sha256[name]}`"
        present = f"{entry_count} of {len(ids)}"
        row = (name, format_ids(ids), present, frame_count, byte_count, subset_hash)
        rows.append(row)
    head = ("subset", "ids", "scenarios", "frames", "bytes", "hash")
    return markdown(head, rows)


def _reading_section(size: Size) -> list[str]:
    return [
        "One netCDF4 file per scenario, which `xarray.open_dataset` reads without "
        "lagbench. "
        "Lengths are in units of the unit box, time in seconds. Frame 0 is the state "
        "when recording starts.",
        "```python\n"
        "import lagbench\n\n"
        f'data = lagbench.open_split("{size.split}", subset="train", '
        f'size="{size.name}")\n'
        'position = data["position"]  # (scenario, frame, particle, space), read when '
        "computed\n"
        "```",
        markdown(
            ("variable", "dimensions", "type", "unit", "meaning"), _variables(size)
        ),
    ]


def _variables(size: Size) -> list[tuple[str, str, str, str, str]]:
    """Return name, dimensions, type, unit and meaning of the variables of a file."""
    vectors = "frame, particle, space"
    meaning = "particle positions in the unit box"
    if size.periodic:
        meaning += ", wrapped along periodic axes"
    rows = [("`position`", vectors, "float32", "length", meaning)]
    if size.stores_velocity:
        meaning = "particle velocities of the solver"
        rows.append(("`velocity`", vectors, "float32", "length/s", meaning))
    rows.append(
        ("`material`", "particle", "int8", "1", "0 liquid, 1 jelly, 2 snow, 3 rope")
    )
    mass = "density x volume" if size.dimension == 3 else "density x area"
    rows.append(("`particle_mass`", "", "float64", mass, "mass of one particle"))
    if size.box.walls:
        names = ", ".join(WALL_NAMES[: 2 * size.dimension])
        meaning = f"full box: what acts towards each frame; walls {names}"
        motion = ("`wall_velocity`", "frame, wall, space", "float32", "length/s")
        rows.append((*motion, meaning))
    if FORCE_PARAMETER in size.parameters:
        meaning = "acceleration towards each frame, in layers along y, lowest first"
        force = ("`body_force`", "frame, layer, space", "float32", "length/s^2")
        rows.append((*force, meaning))
    rows.append(("`time`", "frame", "float64", "s", "time since frame 0"))
    return rows


def _task_table(size: Size, manifest: Manifest) -> str:
    task = size.task
    grid = task.score_grid
    placement = grid.placement.replace("_", " ")
    rows = [
        ("input frames", str(task.input_frames)),
        ("frames to predict", str(task.horizon)),
        ("frames of interest", ", ".join(map(str, task.frames_of_interest))),
        ("score grid", f"{grid.cells} cells a side, {placement}"),
        ("radius for graph models", f"{task.radius:g}"),
    ]
    limits = []
    for entry in manifest.files:
        if entry.twin_floor:
            limits.append(entry.twin_floor)
    if limits:
        first = mean([limit[0] for limit in limits])
        last = mean([limit[-1] for limit in limits])
        at_first = f"{first:.3g} at the first predicted frame"
        text = f"position RMSE {at_first}, {last:.3g} at the last"
        rows.append(("perturbed run, which starts 2^-20 away", text))
    return markdown(("", ""), rows)


def _statistics_section(size: Size, manifest: Manifest) -> list[str]:
    rows = []
    for name, row in manifest.statistics.items():
        rows.append((name.replace("_", " "), *row))
    return [
        "## Statistics of train",
        "The unit of time is the frame. The velocity is x(f) - x(f-1), and the "
        "acceleration is the difference of two velocities.",
        markdown(("", *AXES[: size.dimension]), rows),
    ]


def _soundness_section(manifest: Manifest) -> list[str]:
    """Return how compressible a free surface is; empty for a full box.

    A number counts where a file states it: files of others may state some only.
    """
    rows: list[tuple[str, str]] = []
    for title, name, choose in COMPRESSIBILITY:
        numbers = _stated_numbers(manifest, name)
        if numbers:
            rows.append((title, f"{choose(numbers):.4g}"))
    clamped = _stated_numbers(manifest, "clamped_particles")
    if clamped:
        clamped_count = str(int(sum(clamped)))
        rows.append(("particles that reached a numerical bound", clamped_count))
    if not rows:
        return []

    return [
        "## Compressibility",
        "The worst scenario of each row; quantiles are over particles and frames of "
        "one scenario. A liquid bears no tension (J is 1 at most), and snow that flies "
        "apart keeps the room of loose snow: both are part of the model and are not "
        "counted as bounds.",
        markdown(("", ""), rows),
    ]


def _stated_numbers(manifest: Manifest, name: str) -> list[float]:
    """Return a number of each file that states it."""
    numbers = []
    for entry in manifest.files:
        if name in entry.facts:
            numbers.append(entry.facts[name])
    return numbers


def _parameter_table(size: Size) -> str:
    rows = []
    for name, parameter in size.parameters.items():
        value = _format_value(parameter)
        rows.append((f"`{name}`", value, parameter.unit, parameter.description))
    return markdown(("parameter", "value", "unit", "meaning"), rows)


def _format_value(parameter: Parameter) -> object:
    if isinstance(parameter.value, float):
        return f"{parameter.value:g}"
    return parameter.value


def _verification_section(size: Size, manifest: Manifest) -> list[str]:
    if manifest.identity == "bitwise":
        promise = (
            "The files hold the same bits on every x86-64 Linux machine, with any "
            "number of workers."
        )
    else:
        promise = (
            "Some files come from a device that does not promise equal bits: they "
            "agree to a tolerance."
        )
    options = f"--split {size.split} --size {size.name}"
    commands = (
        "```sh\n"
        "pip install 'lagbench[generate]'\n"
        f"lagbench generate {options}\n"
        f"lagbench verify {options}                 # re-hash every file\n"
        f"lagbench verify {options} --regenerate 2  # simulate two scenarios again "
        f"and compare\n"
        "```"
    )
    return [promise, commands]


def _scenario_table(manifest: Manifest) -> str:
    stated_names: set[str] = set()
    for entry in manifest.files:
        stated_names.update(entry.facts)
    names = sorted(stated_names)
    rows = [_scenario_row(entry, names) for entry in manifest.files]
    titles = [name.replace("_", " ") for name in names]
    table = markdown(("id", "file", "frames", *titles, "content hash"), rows)
    count = format_count(len(rows), "file")
    return f"<details><summary>{count}</summary>\n\n{table}\n\n</details>"


def _scenario_row(entry: FileEntry, names: list[str]) -> tuple[object, ...]:
    """Return a file's row; a number that it does not state is an empty cell."""
    cells = []
    for name in names:
        cell = ""
        if name in entry.facts:
            cell = f"{entry.facts[name]:.6g}"
        cells.append(cell)
    path = f"`{entry.path}`"
    return (entry.scenario, path, entry.frames, *cells, f"`{entry.content_sha256}`")
