"""Compose the report and write it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from lagbench.atomic import write_atomically
from lagbench.data.registry import Registry
from lagbench.scoring.card import ScoreCard

from . import curves, flow, maps, tables
from .html import Markup, join, tag, words
from .page import Figure, Section, document, paragraph
from .subject import Subject, open_gallery, subject_of

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
    ranking = subject.ranking.name
    scores = [
        paragraph("Mean over the horizon and the test scenarios, 95 % interval below; bold is best."),
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
    vorticity = _section(
        "vorticity",
        "Vorticity",
        "Where the flow rotates, how strongly, and how the prediction differs.",
        maps.field_figure(subject, gallery),
        *(now, *bars[:1], over_time, *bars[1:]),
        *curves.residual_figures(subject, gallery),
    )
    if subject.full_box:
        motion = _section(
            "flow",
            "The flow over time",
            "Truth and prediction as fields on the score grid.",
            maps.vorticity_figure(subject, gallery),
            *flow.arrow_figures(subject, gallery),
            *flow.stream_figures(subject, gallery),
            maps.scenario_figure(subject, gallery),
        )
    else:
        figures = [*maps.particle_figures(subject, gallery), *curves.body_curves(subject)]
        said = "What the particles do: truth above, predictions below."
        motion = _section("particles", "Particles", said, *figures)
    means = "Means over the horizon and the test scenarios, with 95 % intervals; bold is best."
    errors = [*curves.method_curves(subject), *curves.error_curves(subject)]
    energy = curves.energy_curves(subject)
    sections = [
        _section("scores", "Scores", join(scores)),
        _section("rollout", "Error over the rollout", "How the error grows from frame to frame.", *errors),
        *([vorticity, motion] if subject.full_box else [motion, vorticity]),
        _section("energy", "Energy", "Whether the motion is damped, kept or fed.", *energy),
        _section("metrics", "Every metric", join([paragraph(means), tables.every_metric(subject)])),
        _section("identity", "What was scored", tables.identity(subject)),
    ]
    foot = paragraph(
        "Intervals are 95 % bootstrap intervals over test scenarios. Velocity and vorticity are per frame;"
        " lengths are in units of the box. This page is one file and asks nothing of the network."
    )
    return document(tables.title(subject), tables.head(subject), sections, foot)


def _section(name: str, title: str, lead: str, *figures: Figure) -> Section:
    return Section(name, title, lead if isinstance(lead, Markup) else paragraph(lead), figures)
