"""Compose the report and write it: one HTML file with a table of contents, sections and
numbered figures.

Nothing in it is fetched from anywhere: styles, drawings and pictures stand in the file,
there is no script, and a content security policy forbids the browser to ask for more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from itertools import accumulate
from pathlib import Path

from lagbench.atomic import check_writable, write_atomically
from lagbench.data.registry import Registry
from lagbench.errors import UsageError
from lagbench.figures.html import Figure, Markup, join, paragraph, tag, words
from lagbench.scoring.card import ScoreCard

from . import curves, flow, maps, tables
from .subject import Subject, open_gallery, subject_of

FILE_NAME = "index.html"

POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'"

SIGN = tag("meta", http_equiv="Content-Security-Policy", content=POLICY)
"""What is in the head of every report, and of no other page."""


@dataclass(frozen=True)
class Section:
    """A stretch of the page."""

    name: str  # identifier, unique on the page
    title: str  # its heading
    lead: str  # what stands before the figures: markup, or the text of a paragraph
    figures: Sequence[Figure] = ()


def write_report(
    folder: str | Path,
    cards: Sequence[ScoreCard],
    predictions: Sequence[str | Path],
    *,
    root: str | Path | None = None,
    registry: Registry | None = None,
) -> Path:
    """Write one self-contained HTML page about scored submissions.

    The same cards and files give the same bytes: no time, host or folder stands in
    them.

    Args:
        folder: folder for ``index.html``; made where it is missing.
        cards: score cards of one split, size and data set.
        predictions: the files that were scored, in the same order.
        root: folder of all data sets: pictures show the truth too.
        registry: where splits are described; ours when None.

    Raises:
        UsageError: no card, cards that do not belong together, or a page there that is
            no report.
        DataError: the test subset is missing or damaged.
        UnreadableFileError: a predictions.nc is.
        WorkFailedError: the page cannot be written.
    """
    subject = subject_of(
        cards, [Path(path) for path in predictions], root=root, registry=registry
    )
    check_folder(folder)
    path = Path(folder) / FILE_NAME
    write_atomically(path, render(subject).encode(), option="--report")
    return path


def check_folder(folder: str | Path) -> None:
    """Refuse a folder where no report can be written, or where one would replace a page
    of another kind.
    """
    check_writable(Path(folder), option="--report")
    path = Path(folder) / FILE_NAME
    if not path.is_file():
        return
    with path.open("rb") as stream:
        head = stream.read(4 * len(SIGN))
    if SIGN.encode() not in head:
        fix = "name another folder, or remove the page"
        raise UsageError(
            "a page that is no report lies there",
            where="--report",
            got=str(path),
            fix=fix,
        )


def render(subject: Subject) -> str:
    """Return the page."""
    gallery = open_gallery(subject)
    ranking = subject.ranking.name
    scores = [
        paragraph(
            "Mean over the horizon and the test scenarios, 95 % interval below; bold "
            "is best."
        ),
        tables.score_table(subject),
        tag("h4", f"Ranking by {words(ranking)}"),
        tables.verdict_table(subject),
        tag("h4", f"At frame {subject.key_frame}"),
        tables.frame_table(subject),
        tag("h4", f"{words(ranking, capital=True)} per test scenario"),
        tables.scenario_table(subject),
        tag("h4", "Flags and warnings"),
        tables.flag_list(subject),
    ]
    now, over_time = curves.histogram_figures(subject, gallery)
    bars = list(curves.bar_figures(subject))
    fields = [maps.field_figure(subject, gallery), now, *bars[:1], over_time, *bars[1:]]
    fields += curves.residual_figures(subject, gallery)
    said = "Where the flow rotates, how strongly, and how the prediction differs."
    vorticity = Section("vorticity", "Vorticity", said, fields)
    if subject.full_box:
        over_time = maps.vorticity_figure(subject, gallery)
        every = maps.scenario_figure(subject, gallery)
        figures = [over_time, *flow.flow_figures(subject, gallery), every]
        motion = Section(
            "flow",
            "The flow over time",
            "Truth and prediction as fields on the score grid.",
            figures,
        )
    else:
        figures = [
            *maps.particle_figures(subject, gallery),
            *curves.body_curves(subject),
        ]
        said = "What the particles do: truth above, predictions below."
        motion = Section("particles", "Particles", said, figures)
    means = "Means over the horizon and the test scenarios, with 95 % intervals; bold is best."
    errors = [*curves.method_curves(subject), *curves.error_curves(subject)]
    energy = [*curves.energy_curves(subject)]
    sections = [
        Section("scores", "Scores", join(scores)),
        Section(
            "rollout",
            "Error over the rollout",
            "How the error grows from frame to frame.",
            errors,
        ),
        *([vorticity, motion] if subject.full_box else [motion, vorticity]),
        Section(
            "energy", "Energy", "Whether the motion is damped, kept or fed.", energy
        ),
        Section(
            "metrics",
            "Every metric",
            join([paragraph(means), tables.every_metric(subject)]),
        ),
        Section("identity", "What was scored", tables.identity(subject)),
    ]
    foot = paragraph(
        "Intervals are 95 % bootstrap intervals over test scenarios. Velocity and "
        "vorticity are per frame;"
        " lengths are in units of the box. This page is one file and asks nothing of "
        "the network."
    )
    return document(tables.title(subject), tables.head(subject), sections, foot)


def document(
    title: str, head: Markup, sections: Sequence[Section], foot: Markup
) -> str:
    """Return the page."""
    links = [
        tag("li", tag("a", section.title, href=f"#part-{section.name}"))
        for section in sections
    ]
    contents = tag("nav", tag("ol", *links), class_="contents", aria_label="Contents")
    firsts = accumulate((len(section.figures) for section in sections), initial=1)
    written = [
        _section(section, first)
        for section, first in zip(sections, firsts, strict=False)
    ]
    body = [
        tag("header", head),
        tag("div", contents, tag("main", *written), class_="columns"),
        tag("footer", foot),
    ]
    meta = [
        tag("meta", charset="utf-8"),
        SIGN,
        tag("meta", name="viewport", content="width=device-width, initial-scale=1"),
        tag("meta", name="color-scheme", content="light dark"),
        tag("meta", name="referrer", content="no-referrer"),
        tag("title", title),
        tag("link", rel="icon", href="data:,"),
        tag(
            "style", Markup(files(__package__).joinpath("style.css").read_text("utf-8"))
        ),
    ]
    whole = tag("html", tag("head", *meta), tag("body", *body), lang="en")
    return f"<!DOCTYPE html>\n{whole}\n"


def _section(section: Section, first: int) -> Markup:
    figures = []
    for number, figure in enumerate(section.figures, first):
        heading = tag(
            "h3", tag("span", f"Figure {number}", class_="number"), " ", figure.title
        )
        source = tag("span", f"thesis {figure.thesis}", class_="thesis")
        numbers = tag(
            "details", tag("summary", "Numbers"), figure.data, class_="numbers"
        )
        parts = [
            heading,
            figure.body,
            tag("figcaption", tag("p", figure.caption, " ", source)),
        ]
        if figure.wide:
            kind = "figure wide"
        else:
            kind = "figure"
        drawn = tag(
            "figure",
            *parts,
            numbers if figure.data else "",
            id=figure.name,
            class_=kind,
        )
        figures.append(join([drawn, "\n"]))
    grid = tag("div", *figures, class_="figures") if figures else ""
    heading = tag("h2", section.title)
    if isinstance(section.lead, Markup):
        lead = section.lead
    else:
        lead = paragraph(section.lead)
    return join(
        [
            tag(
                "section", heading, lead, grid, id=f"part-{section.name}", class_="part"
            ),
            "\n",
        ]
    )
