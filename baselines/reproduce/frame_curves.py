"""Figs. 5.10, 5.11, 5.19, 5.28: error of vorticity and kinetic energy over the frames of a rollout."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lagbench.metrics import Score, mean
from lagbench.scoring.tables import Table

from .chart import TRUTH, charts, colour, tidy
from .evidence import Evidence
from .plan import Plan
from .roster import label
from .sheet import Sheet
from .thesis import OPERATORS
from .wording import number

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["FIGURES", "Figure", "draw_figure"]


Floats = NDArray[np.float64]

BOUNDS = ((40, 0.0002), (80, 0.0004))
"""Frames up to which the thesis says that SuperGAT's error stays below so much [1/frame^2]."""


@dataclass(frozen=True, kw_only=True)
class Figure:
    """A figure of curves over frames."""

    split: str  # name of the split
    metric: str  # metric of a model per frame
    axis: str  # what the vertical axis shows
    said: str  # what the thesis says of its figure
    truth: str = ""  # metric that holds the truth's value; empty where 0 is perfect
    models: tuple[str, ...] = OPERATORS  # whose curves
    cases: bool = False  # whether each test scenario is a curve of its own


FIGURES: Mapping[str, Figure] = {
    "fig_5_10": Figure(
        split="cavity",
        metric="vorticity_mse",
        axis="vorticity MSE [1/frame^2]",
        models=("supergat",),
        cases=True,
        said="Thesis: six test cases, below 0.0002 for the first 40 frames and below 0.0004 up to frame 80,"
        " growing almost linearly.",
    ),
    "fig_5_11": Figure(
        split="cavity",
        metric="vorticity_mse",
        axis="vorticity MSE [1/frame^2]",
        said="Thesis: SuperGAT lowest in nearly every frame of T0, GNS second with occasional spikes.",
    ),
    "fig_5_19": Figure(
        split="cavity",
        metric="energy_retention",
        truth="energy_retention_true",
        axis="kinetic energy over the last given [1]",
        said="Thesis: SuperGAT keeps most energy, then GNS; PointNet and the graph transformer least (of"
        " checkpoints of unequal budgets). More energy than the truth is no merit: see the error beside.",
    ),
    "fig_5_28": Figure(
        split="curl-noise",
        metric="energy_predicted",
        truth="energy_true",
        axis="kinetic energy [mass length^2/frame^2]",
        said="Thesis: SuperGAT keeps most energy, then GAT, GATv2, GNS, and the graph transformer least.",
    ),
}
"""Curves by figure."""


def draw_figure(plan: Plan, name: str) -> Sheet:
    """Return a figure of :data:`FIGURES`: T0 and the mean over scenarios, or one curve per scenario."""
    figure, evidence = FIGURES[name], plan.evidence(FIGURES[name].split)
    models = [n for n in figure.models if n in evidence.methods]
    if figure.cases:
        return _cases(figure, evidence, models)
    with charts(2) as drawn:
        for axes, case in zip(drawn.axes, (0, None), strict=True):
            _curves(axes, figure, evidence, models, case)
        picture = drawn.png()
    frames = _shown(evidence)
    rows = [(label(n), *_values(evidence.methods[n].scores[figure.metric], frames)) for n in models]
    if figure.truth and models:
        rows.insert(0, ("truth", *_values(evidence.methods[models[0]].scores[figure.truth], frames)))
    if figure.truth:
        rows = [(*row, _error(evidence, n)) for row, n in zip(rows, [None, *models], strict=True)]
    heads = ("model", *(f"frame {frame}" for frame in frames), *(("energy error",) if figure.truth else ()))
    return Sheet(
        notes=(figure.said,),
        tables=(Table("mean over test scenarios", heads, tuple(rows)),),
        pictures={"": picture},
    )


def _error(evidence: Evidence, name: str | None) -> str:
    return "0" if name is None else number(evidence.methods[name].scores["energy_error"].mean)


def _shown(evidence: Evidence) -> tuple[int, ...]:
    task = evidence.size.task
    last = task.input_frames + task.horizon - 1
    return tuple(sorted({*task.frames_of_interest, last}))


def _values(score: Score, frames: tuple[int, ...]) -> list[str]:
    return [number(mean(score.at(frame))) for frame in frames]


def _curves(axes: Axes, figure: Figure, evidence: Evidence, models: list[str], case: int | None) -> None:
    """Draw one curve per model, of one scenario or of the mean."""

    def curve(score: Score) -> Floats:
        return _mean_curve(score) if case is None else score.per_frame[case]

    scores = {n: evidence.methods[n].scores for n in models}
    if figure.truth and models:
        held = scores[models[0]][figure.truth]
        axes.plot(held.frames, curve(held), color=TRUTH, lw=1.6, label="truth")
    for name in models:
        held = scores[name][figure.metric]
        axes.plot(held.frames, curve(held), color=colour(name), lw=1.2, label=label(name))
    if not figure.truth:
        axes.set_ylim(bottom=0.0)
    title = "mean over test scenarios" if case is None else f"T{case}"
    tidy(axes, title, "frame", figure.axis, legend=case is None)


def _mean_curve(score: Score) -> Floats:
    """Return the mean over the scenarios that have a value, shape [frame]."""
    return np.array([mean(column) for column in score.per_frame.T])


def _cases(figure: Figure, evidence: Evidence, models: list[str]) -> Sheet:
    """Return one curve per test scenario of the first model."""
    if not models:
        return Sheet(notes=(figure.said, "No run of this model is there."))
    score = evidence.methods[models[0]].scores[figure.metric]
    with charts(1, width=5.6, height=3.4) as drawn:
        axes = drawn.axes[0]
        for number_, (scenario, values) in enumerate(zip(score.scenarios, score.per_frame, strict=True)):
            axes.plot(score.frames, values, lw=1.1, label=f"T{number_} (scenario {scenario})")
        axes.set_ylim(bottom=0.0)
        tidy(axes, label(models[0]), "frame", figure.axis)
        picture = drawn.png()
    rows = [
        (f"T{row} ({scenario})", *(number(_greatest(score, row, end)) for end, _ in BOUNDS))
        for row, scenario in enumerate(score.scenarios)
    ]
    heads = ("test case", *(f"greatest up to frame {end} (thesis < {bound})" for end, bound in BOUNDS))
    return Sheet(notes=(figure.said,), tables=(Table("", heads, tuple(rows)),), pictures={"": picture})


def _greatest(score: Score, row: int, end: int) -> float:
    """Return the greatest value of a scenario up to an absolute frame."""
    return float(np.nanmax(score.per_frame[row][: end - score.frames[0] + 1]))
