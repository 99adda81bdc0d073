"""Compose the report and write it: one HTML file of sections and numbered figures.

Nothing in it is fetched from anywhere: styles, drawings and pictures stand in the file,
there is no script, and a content security policy forbids the browser to ask for more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from lagbench.atomic import check_writable, write_atomically
from lagbench.data.registry import Registry
from lagbench.errors import UsageError
from lagbench.figures.html import (
    Markup,
    ReportFigure,
    join,
    load_style_sheet,
    paragraph,
    tag,
    words,
)
from lagbench.scoring.card import ScoreCard

from . import arrows, curves, distributions, maps, particles, summary, tables
from .subject import Gallery, Subject, load_subject, read_gallery

FILE_NAME = "index.html"

POLICY = (
    "default-src 'none'; img-src data:; style-src 'unsafe-inline'; base-uri 'none'; "
    "form-action 'none'"
)

OPEN_SECTIONS = 2
"""Sections that are unfolded when the page is opened: the scores and the rollout."""

FOOT = (
    "Intervals are 95 % bootstrap intervals over scenarios. Velocity and "
    "vorticity are per frame; lengths are in units of the box. This page is one file "
    "and asks nothing of the network."
)


@dataclass(frozen=True)
class Section:
    """A section of the page."""

    name: str  # identifier, unique on the page
    title: str  # its heading
    lead: str  # what stands before the figures: markup, or the text of a paragraph
    figures: Sequence[ReportFigure] = ()


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
        UsageError: no score report, score reports that do not belong together, or a
            page there that is no report.
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
    if not path.is_file():
        return
    policy_tag = _policy_tag().encode()
    with path.open("rb") as stream:
        head = stream.read(4 * len(policy_tag))
    if policy_tag not in head:
        raise UsageError(
            "the folder holds an index.html that is no report",
            where="--report",
            expected="a folder without index.html, or with a report",
            got=str(path),
            fix="name another folder, or remove the page",
        )


def _policy_tag() -> Markup:
    """Return the tag that is in the head of every report, and of no other page."""
    return tag("meta", http_equiv="Content-Security-Policy", content=POLICY)


def render(subject: Subject) -> str:
    """Return the page."""
    gallery = read_gallery(subject)
    vorticity = _vorticity_section(subject, gallery)
    motion = _motion_section(subject, gallery)
    if subject.is_full_box:
        vorticity_and_motion = [vorticity, motion]
    else:
        vorticity_and_motion = [motion, vorticity]
    sections = [
        Section("scores", "Scores", _score_tables(subject)),
        _rollout_section(subject),
        *vorticity_and_motion,
        Section(
            "energy",
            "Energy",
            "Whether the motion is damped, kept or fed.",
            list(curves.energy_curves(subject)),
        ),
        Section("metrics", "Every metric", _metric_tables(subject)),
        Section("identity", "What was scored", summary.draw_identity(subject)),
    ]
    title = summary.format_title(subject)
    return compose_page(title, summary.draw_head(subject), sections)


def _score_tables(subject: Subject) -> Markup:
    ranking = subject.ranking.name
    parts = [
        paragraph(
            "Mean over the horizon and the scenarios, 95 % interval below; bold "
            "is best."
        ),
        tables.score_table(subject),
        tag("h4", f"Ranking by {words(ranking)}"),
        tables.ranking_table(subject),
        tag("h4", f"At frame {subject.key_frame}"),
        tables.frame_table(subject),
        tag("h4", f"{words(ranking, capital=True)} per scenario"),
        tables.scenario_table(subject),
        tag("h4", "Flags and warnings"),
        summary.draw_flags(subject),
    ]
    return join(parts)


def _metric_tables(subject: Subject) -> Markup:
    lead = paragraph(
        "Means over the horizon and the scenarios, with 95 % intervals; bold is best."
    )
    return join([lead, tables.every_metric(subject)])


def _rollout_section(subject: Subject) -> Section:
    return Section(
        "rollout",
        "Error over the rollout",
        "How the error grows from frame to frame.",
        [*curves.method_curves(subject), *curves.error_curves(subject)],
    )


def _vorticity_section(subject: Subject, gallery: Gallery) -> Section:
    bars = list(distributions.bar_figures(subject))
    figures = [
        maps.field_figure(subject, gallery),
        distributions.histogram_figure(subject, gallery),
        *bars[:1],
        distributions.histograms_figure(subject, gallery),
        *bars[1:],
        *distributions.residual_figures(subject, gallery),
    ]
    return Section(
        "vorticity",
        "Vorticity",
        "Where the flow rotates, how strongly, and how the prediction differs.",
        figures,
    )


def _motion_section(subject: Subject, gallery: Gallery) -> Section:
    if subject.is_full_box:
        return Section(
            "flow",
            "The flow over time",
            "Truth and prediction as fields on the score grid.",
            [
                maps.vorticity_figure(subject, gallery),
                *arrows.arrow_figures(subject, gallery),
                maps.scenario_figure(subject, gallery),
            ],
        )
    return Section(
        "particles",
        "Particles",
        "What the particles do: truth above, predictions below.",
        [
            *particles.particle_figures(subject, gallery),
            *curves.body_curves(subject),
        ],
    )


def compose_page(title: str, head: Markup, sections: Sequence[Section]) -> str:
    """Return an HTML page of sections, with a table of contents."""
    links = []
    for section in sections:
        link = tag("a", section.title, href=f"#part-{section.name}")
        links.append(tag("li", link))
    contents = tag("nav", tag("ol", *links), class_="contents", aria_label="Contents")

    parts = []
    first_number = 1
    for number, section in enumerate(sections):
        is_open = number < OPEN_SECTIONS
        parts.append(_compose_section(section, first_number, is_open=is_open))
        first_number += len(section.figures)

    meta = [
        tag("meta", charset="utf-8"),
        _policy_tag(),
        tag("meta", name="viewport", content="width=device-width, initial-scale=1"),
        tag("meta", name="color-scheme", content="light dark"),
        tag("meta", name="referrer", content="no-referrer"),
        tag("title", title),
        tag("link", rel="icon", href="data:,"),
        tag("style", Markup(load_style_sheet())),
    ]
    body = [
        tag("header", head),
        tag("div", contents, tag("main", *parts), class_="columns"),
        tag("footer", paragraph(FOOT)),
    ]
    whole = tag("html", tag("head", *meta), tag("body", *body), lang="en")
    return f"<!DOCTYPE html>\n{whole}\n"


def _compose_section(section: Section, first_number: int, *, is_open: bool) -> Markup:
    """Return a section that its heading folds and unfolds.

    The identifier stands inside: a link to it unfolds the section.
    """
    if isinstance(section.lead, Markup):
        lead = section.lead
    else:
        lead = paragraph(section.lead)
    parts = [lead]
    figures = []
    for number, figure in enumerate(section.figures, first_number):
        figures += [_compose_figure(figure, number), "\n"]
    if figures:
        parts.append(tag("div", *figures, class_="figures"))
    heading = tag("summary", tag("h2", section.title))
    content = tag("div", *parts, id=f"part-{section.name}")
    drawn = tag("details", heading, content, class_="part", open=is_open)
    return join([drawn, "\n"])


def _compose_figure(figure: ReportFigure, number: int) -> Markup:
    label = tag("span", f"Figure {number}", class_="number")
    source = tag("span", f"thesis {figure.thesis}", class_="thesis")
    parts = [
        tag("h3", label, " ", figure.title),
        figure.body,
        tag("figcaption", tag("p", figure.caption, " ", source)),
    ]
    if figure.data is not None:
        title = tag("summary", "Numbers")
        parts.append(tag("details", title, figure.data, class_="numbers"))
    kind = "figure"
    if figure.wide:
        kind = "figure wide"
    return tag("figure", *parts, id=figure.name, class_=kind)
