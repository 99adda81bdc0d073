"""Compose the report and write it: one HTML file of pictures and tables.

Nothing in it is fetched from anywhere: styles and pictures stand in the file, there is
no script, and a content security policy forbids the browser to ask for more.
"""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined

from lagbench.atomic import check_writable, write_atomically
from lagbench.data.registry import Registry
from lagbench.errors import UsageError
from lagbench.figures.tables import Table
from lagbench.scoring.card import ScoreCard
from lagbench.scoring.tables import brief_table, card_lines, card_tables

from . import pictures
from .subject import Subject, load_subject, read_gallery

FILE_NAME = "index.html"

POLICY = (
    "default-src 'none'; img-src data:; style-src 'unsafe-inline'; base-uri 'none'; "
    "form-action 'none'"
)
"""What a browser may do with the page; no other page has this text."""


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
    if subject.is_full_box:
        motion = ("The flow", list(pictures.flow_pictures(subject, gallery)))
    else:
        drawn = list(pictures.particle_pictures(subject, gallery))
        motion = ("Particles", drawn + list(pictures.body_pictures(subject)))
    brief_tables = []
    all_tables: list[Table] = []
    lines: list[str] = []
    for entry in subject.entries:
        brief_tables.append(brief_table(entry.card))
        all_tables += card_tables(entry.card)
        prefix = f"{entry.name}: " if len(subject.entries) > 1 else ""
        lines += (f"{prefix}{line}" for line in card_lines(entry.card, every=True))
    return environment.get_template("page.html").render(
        policy=POLICY,
        subject=subject,
        header=header,
        config=subject.task.config,
        particles=particles,
        sections=[
            ("Error over the rollout", list(pictures.rollout_pictures(subject))),
            motion,
            ("Energy", list(pictures.energy_pictures(subject))),
        ],
        brief_tables=brief_tables,
        all_tables=all_tables,
        lines=lines,
        files=shlex.join(entry.predictions.name for entry in subject.entries),
    )
