"""Compose the report and write it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from lagbench.atomic import write_atomically
from lagbench.data.registry import Registry
from lagbench.scoring.card import ScoreCard

from .curves import bar_figures, body_curves, energy_curves, error_curves, method_curves
from .distributions import histogram_figures, residual_figures
from .flow import arrow_figures, stream_figures
from .html import join, tag, words
from .maps import field_figure, particle_figures, scenario_figure, vorticity_figure
from .page import Figure, Section, document, paragraph
from .subject import Gallery, Subject, open_gallery, subject_of
from .tables import (
    every_metric,
    flag_list,
    frame_table,
    head,
    identity,
    scenario_table,
    score_table,
    title,
    verdict_table,
)

__all__ = [
    "FILE_NAME",
    "render",
    "write_report",
]


FILE_NAME = "index.html"


def write_report(
    folder: str | Path,
    cards: Sequence[ScoreCard],
    predictions: Sequence[str | Path],
    *,
    root: str | Path | None = None,
    registry: Registry | None = None,
) -> Path:
    """Write one self-contained HTML page about scored submissions.

    The same cards and files give the same bytes: no time, host or folder stands in them.

    Args:
        folder: folder for ``index.html``; made where it is missing.
        cards: score cards of one split, size and data set.
        predictions: the files that were scored, in the same order.
        root: folder of all data sets: pictures show the truth too.
        registry: where splits are described; ours when None.

    Returns:
        Path of the page.

    Raises:
        UsageError: no card, or cards that do not belong together.
        DataError: the test subset is missing or damaged.
        UnreadableFileError: a predictions.nc is.
        WorkFailedError: the page cannot be written.
    """
    subject = subject_of(cards, [Path(path) for path in predictions], root=root, registry=registry)
    path = Path(folder) / FILE_NAME
    write_atomically(path, render(subject).encode(), option="--report")
    return path


def render(subject: Subject) -> str:
    """Return the page."""
    gallery = open_gallery(subject)
    foot = paragraph(
        "Intervals are 95 % bootstrap intervals over test scenarios. Velocity and vorticity are per frame;"
        " lengths are in units of the box. This page is one file and asks nothing of the network."
    )
    return document(title(subject), head(subject), list(_sections(subject, gallery)), foot)


def _sections(subject: Subject, gallery: Gallery) -> Iterator[Section]:
    yield _scores(subject)
    yield Section(
        name="rollout",
        title="Error over the rollout",
        lead=paragraph("How the error grows from frame to frame."),
        figures=[*method_curves(subject), *error_curves(subject)],
    )
    if subject.full_box:
        yield _vorticity(subject, gallery)
        yield _flow(subject, gallery)
    else:
        yield _particles(subject, gallery)
        yield _vorticity(subject, gallery)
    yield Section(
        name="energy",
        title="Energy",
        lead=paragraph("Whether the motion is damped, kept or fed."),
        figures=list(energy_curves(subject)),
    )
    yield Section(
        name="metrics",
        title="Every metric",
        lead=join(
            [
                paragraph(
                    "Means over the horizon and the test scenarios, with 95 % intervals; bold is best."
                ),
                every_metric(subject),
            ]
        ),
    )
    yield Section(name="identity", title="What was scored", lead=identity(subject))


def _scores(subject: Subject) -> Section:
    frame = subject.key_frame
    parts = [
        paragraph("Mean over the horizon and the test scenarios, 95 % interval below; bold is best."),
        score_table(subject),
        tag("h4", f"Ranking by {words(subject.ranking.name)}"),
        verdict_table(subject),
        tag("h4", f"At frame {frame}"),
        frame_table(subject),
        tag("h4", f"{words(subject.ranking.name, capital=True)} per test scenario"),
        scenario_table(subject),
        tag("h4", "Flags and warnings"),
        flag_list(subject),
    ]
    return Section(name="scores", title="Scores", lead=join(parts))


def _vorticity(subject: Subject, gallery: Gallery) -> Section:
    now, over_time = histogram_figures(subject, gallery)
    bars = list(bar_figures(subject))
    figures: list[Figure] = [
        field_figure(subject, gallery),
        *(now, *bars[:1], over_time, *bars[1:]),
        *residual_figures(subject, gallery),
    ]
    text = "Where the flow rotates, how strongly, and how the prediction differs."
    return Section(name="vorticity", title="Vorticity", lead=paragraph(text), figures=figures)


def _flow(subject: Subject, gallery: Gallery) -> Section:
    figures = [
        vorticity_figure(subject, gallery),
        *arrow_figures(subject, gallery),
        *stream_figures(subject, gallery),
        scenario_figure(subject, gallery),
    ]
    text = "Truth and prediction as fields on the score grid."
    return Section(name="flow", title="The flow over time", lead=paragraph(text), figures=figures)


def _particles(subject: Subject, gallery: Gallery) -> Section:
    figures = [*particle_figures(subject, gallery), *body_curves(subject)]
    text = "What the particles do: truth above, predictions below."
    return Section(name="particles", title="Particles", lead=paragraph(text), figures=figures)
