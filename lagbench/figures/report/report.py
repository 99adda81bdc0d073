"""Compose the report and write it: one HTML file of pictures and tables.

Nothing in it is fetched from anywhere: styles and pictures stand in the file, there is
no script, and a content security policy forbids the browser to ask for more.
"""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined

from lagbench.atomic import check_writable, write_atomically
from lagbench.data.registry import Registry
from lagbench.errors import UsageError
from lagbench.figures.numbers import text, words
from lagbench.scoring.card import ScoreCard

from . import pictures, tables
from .subject import Gallery, Subject, load_subject, read_gallery

FILE_NAME = "index.html"

POLICY = (
    "default-src 'none'; img-src data:; style-src 'unsafe-inline'; base-uri 'none'; "
    "form-action 'none'"
)
"""What a browser may do with the page; no other page has this text."""

TILES = ("vorticity_pearson", "stable_frames", "spectrum_error", "position_rmse_20")
"""Metrics at the top, after skill and the metric that ranks."""

FLAG_STATES = {True: "raised", False: "clear", None: "unknown"}


@dataclass(frozen=True)
class Tile:
    """A number at the top of the page."""

    title: str
    value: str
    note: str


@dataclass(frozen=True)
class Notice:
    """A flag or a warning about an entry."""

    entry: str
    state: str  # raised, clear, unknown or warning
    name: str
    message: str


def write_report(
    folder: str | Path,
    cards: Sequence[ScoreCard],
    predictions: Sequence[str | Path],
    *,
    root: str | Path | None = None,
    registry: Registry | None = None,
) -> Path:
    """Write one self-contained HTML page about scored submissions.

    The same score reports and files give the same bytes: no time, host or folder stands
    in them.

    Args:
        folder: folder for ``index.html``; made where it is missing.
        cards: score reports of one split, size and data set.
        predictions: the files that were scored, in the same order.
        root: folder of all data sets: pictures show the truth too.
        registry: where splits are described; ours when None.

    Raises:
        UsageError: no score report, score reports that do not belong together, a page
            there that is no report, or no matplotlib.
        DataError: the test subset is missing or damaged.
        UnreadableFileError: a predictions.nc is damaged.
        WorkFailedError: the page cannot be written.
    """
    paths = [Path(path) for path in predictions]
    subject = load_subject(cards, paths, root=root, registry=registry)
    check_folder(folder)
    page = Path(folder) / FILE_NAME
    write_atomically(page, render(subject).encode(), option="--report")
    return page


def check_folder(folder: str | Path) -> None:
    """Refuse, before the work, a folder in which no report can be written.

    The folder is not made here. A page of another kind in it is not replaced.

    Raises:
        UsageError: the folder holds an index.html that is no report.
        WorkFailedError: the folder cannot be written.
    """
    check_writable(Path(folder), option="--report")
    path = Path(folder) / FILE_NAME
    if path.is_file() and POLICY not in path.read_text("utf-8", errors="replace"):
        raise UsageError(
            f"{path} is no report; name another folder, or remove the page",
            where="--report",
        )


def render(subject: Subject) -> str:
    """Return the page."""
    gallery = read_gallery(subject)
    environment = Environment(
        loader=PackageLoader("lagbench.figures.report", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    header = subject.entries[0].card.header
    size = subject.task.size
    counts = {size.particle_count(scenario) for scenario in subject.scenarios}
    particles = str(min(counts))
    if len(counts) > 1:
        particles = f"{min(counts)} to {max(counts)}"
    return environment.get_template("page.html").render(
        policy=POLICY,
        subject=subject,
        header=header,
        config=subject.task.config,
        particles=particles,
        tiles=_make_tiles(subject),
        sections=_draw_sections(subject, gallery),
        score_tables=tables.score_tables(subject),
        metric_tables=tables.metric_tables(subject),
        notices=_list_notices(subject),
        files=shlex.join(entry.predictions.name for entry in subject.entries),
    )


def _draw_sections(
    subject: Subject, gallery: Gallery
) -> list[tuple[str, list[pictures.Picture]]]:
    """Return the headings of the page's pictures, and the pictures."""
    rollout = list(pictures.rollout_pictures(subject))
    energy = list(pictures.energy_pictures(subject))
    if subject.is_full_box:
        motion = ("The flow", list(pictures.flow_pictures(subject, gallery)))
    else:
        particles = list(pictures.particle_pictures(subject, gallery))
        motion = ("Particles", particles + list(pictures.body_pictures(subject)))
    return [
        ("Error over the rollout", rollout),
        motion,
        ("Energy", energy),
    ]


def _make_tiles(subject: Subject) -> list[Tile]:
    """Return the numbers of the best entry that matter most."""
    best = subject.best_entry
    tiles = []
    if best.entry is not None and best.entry.card.skill is not None:
        skill = best.entry.card.skill
        interval = tables.format_interval(skill.interval)
        note = f"{interval}; 1 − score / score of {skill.reference}"
        tiles.append(Tile("skill", text(skill.value), note))
    for name in (subject.ranking.name, *TILES):
        score = best.scores.get(name)
        if score is None or any(tile.title == words(name) for tile in tiles):
            continue
        note = tables.format_interval(score.interval)
        tiles.append(Tile(words(name), text(score.mean), note))
    return tiles


def _list_notices(subject: Subject) -> list[Notice]:
    """Return flags and warnings of every entry."""
    notices = []
    for entry in subject.entries:
        for flag in entry.card.flags:
            reasons = "; ".join(flag.reasons)
            state = FLAG_STATES[flag.raised]
            name = flag.name.replace("_", " ")
            notices.append(Notice(entry.name, state, name, reasons))
        for warning in entry.card.warnings:
            notices.append(Notice(entry.name, "warning", warning.check, str(warning)))
        for scenario, frame in sorted((entry.card.header.diverged_at or {}).items()):
            message = f"scenario {scenario} is frozen from frame {frame} on"
            notices.append(Notice(entry.name, "warning", "diverged", message))
    return notices
