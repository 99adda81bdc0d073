"""Figs. 4.11 to 4.13: particles of a rollout, truth above the predictions of frame models, six times."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import TYPE_CHECKING

from lagbench.draw.panels import Panel, draw
from lagbench.scoring.tables import Table

from .chart import Line, named, panel_rows
from .evidence import Evidence
from .plan import Plan
from .scenes import stand_in
from .sheet import Sheet
from .stage import Stage, staged
from .wording import number

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["FIGURES", "Figure", "draw_figure"]

TIMES = 6
"""Columns of a figure."""


@dataclass(frozen=True, kw_only=True)
class Figure:
    """A figure of particles."""

    split: str  # name of the split
    scenarios: tuple[int, ...]  # ids in the thesis
    models: tuple[str, ...]  # rows below the truth, for each scenario
    said: str  # what the thesis says of its figure


FIGURES: Mapping[str, Figure] = {
    "fig_4_11": Figure(
        split="fluid",
        scenarios=(26,),
        models=("lstm-mlp", "mlp", "lstm"),
        said="Thesis: LSTM + MLP keeps trajectory and shape; MLP drifts to a wrong state at the end; LSTM"
        " keeps the trajectory and loses the shape.",
    ),
    "fig_4_12": Figure(
        split="multimaterial",
        scenarios=(54,),
        models=("lstm-mlp",),
        said="Thesis: deformation of liquid and snow is kept; small surface waves end slightly too soon.",
    ),
    "fig_4_13": Figure(
        split="multimaterial",
        scenarios=(57, 56, 58),
        models=("lstm-mlp",),
        said="Thesis: snow and snow accurate; the rope in liquid keeps its coarse shape and comes apart in"
        " places; the jelly ball bounces rightly and disperses while it moves fast.",
    ),
}
"""Particles by figure."""


def draw_figure(plan: Plan, name: str) -> Sheet:
    """Return the particles of a figure and the errors of what it shows."""
    figure, evidence = FIGURES[name], plan.evidence(FIGURES[name].split)
    size = evidence.size
    cases = [(i, ours) for i in figure.scenarios if (ours := stand_in(size, i)) is not None]
    frames = _spaced(size.task.input_frames, size.task.input_frames + size.task.horizon - 1)
    with ExitStack() as stack:
        stages = [stack.enter_context(staged(plan, figure.split, ours, figure.models)) for _, ours in cases]
        lines: list[Line] = [
            (f"{stage.id}, {named(who)}" if len(stages) > 1 else named(who), stage, who, Panel.MATERIAL)
            for stage in stages
            for who in (None, *stage.names)
        ]
        pictures = {"": panel_rows(lines, frames, drawing=_drawing)} if lines else {}
    ids = "; ".join(f"thesis's id {theirs}: our test scenario {ours}" for theirs, ours in cases)
    return Sheet(
        notes=(figure.said, f"{ids}." if ids else "No scenario of this kind is in this size's test subset."),
        tables=(_table(evidence, figure, [ours for _, ours in cases]),),
        pictures=pictures,
    )


def _drawing(axes: Axes, stage: Stage, name: str | None, frame: int, limit: float) -> None:
    draw(axes, Panel.MATERIAL, stage.scene(name, frame), limit=limit)


def _spaced(first: int, last: int) -> tuple[int, ...]:
    """Return evenly spaced frames, first and last included."""
    return tuple(first + round(i * (last - first) / (TIMES - 1)) for i in range(TIMES))


def _table(evidence: Evidence, figure: Figure, scenarios: Sequence[int]) -> Table:
    rows = []
    for scenario in scenarios:
        for name in figure.models:
            if name in evidence.methods:
                rows.append((str(scenario), named(name), *_errors(evidence, name, scenario)))
    heads = ("scenario", "model", *METRICS)
    return Table("Over the whole rollout", heads, tuple(rows))


METRICS = ("mse_avg", "mse_end", "position_rmse", "shape_error", "connectivity")


def _errors(evidence: Evidence, name: str, scenario: int) -> list[str]:
    scores = evidence.methods[name].scores
    known = [scores.get(metric) for metric in METRICS]
    return ["-" if s is None else number(float(s.values[s.scenarios.index(scenario)])) for s in known]
