"""Pictures of frames: maps, particles, arrows, streamlines; histograms and residuals of the vorticity."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from typing import TYPE_CHECKING

import numpy as np

from lagbench.data.registry import Size
from lagbench.metrics.table import METRICS
from lagbench.scoring.tables import Table

from .claims import compared, comparison_table
from .drawing import TRUTH, Rollouts, charts, opened, panel_rows, png, tidy
from .runs import Plan
from .sheet import Figure, Sheet, number
from .thesis import TABLE_4_8, colour, key_frame, label, predicted, scenario_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["histograms", "panels", "residuals"]

TIMES = 6
"""Columns of a picture that shows a whole rollout."""

BINS = 40


def panels(plan: Plan, figure: Figure) -> Sheet:
    """Return rows of truth and predictions by test case, a picture per kind of panel, and the errors."""
    evidence = plan.evidence(figure.split)
    size = evidence.size
    cases = {case: ours for case in figure.cases if (ours := scenario_of(size, case)) is not None}
    frames = _frames(size, figure)
    with ExitStack() as stack:
        shown = {
            case: stack.enter_context(opened(plan, figure.split, ours, figure.models))
            for case, ours in cases.items()
        }
        rows = [
            (label(name) if len(shown) == 1 else f"{_case(size, case)}, {label(name)}", rollouts, name)
            for case, rollouts in shown.items()
            for name in (None, *rollouts.predictions)
        ]
        pictures = {
            panel if len(figure.panels) > 1 else "": panel_rows(rows, frames, panel)
            for panel in figure.panels
            if rows
        }
    notes = (
        [figure.said] if cases else [figure.said, "No scenario of this kind is in this size's test subset."]
    )
    tables = [_errors(plan, figure, frames, cases)]
    if len(figure.models) == 2:  # a model with and without something
        second, first = figure.models
        tables.append(
            comparison_table(compared(evidence, first, (second,), (evidence.ranking, "position_rmse")))
        )
    return Sheet(notes=tuple(notes), tables=tuple(tables), pictures=pictures)


def _frames(size: Size, figure: Figure) -> tuple[int, ...]:
    """Return the frames of a figure that are predicted: its own, or that at which models are compared."""
    first, last = size.task.input_frames, size.task.input_frames + size.task.horizon - 1
    if figure.whole:
        return tuple(first + round(i * (last - first) / (TIMES - 1)) for i in range(TIMES))
    return predicted(size, figure.frames or (key_frame(size),))


def _case(size: Size, case: int) -> str:
    """Return what rows call a case of the thesis: its number in a full box, its id on the free surface."""
    return str(scenario_of(size, case)) if size.split in TABLE_4_8 else f"T{case}"


def _errors(plan: Plan, figure: Figure, frames: Sequence[int], cases: Mapping[int, int]) -> Table:
    """Return the metrics of a figure by case and model, at its frames or over the whole rollout."""
    methods = plan.evidence(figure.split).methods
    size, metrics = plan.tier(figure.split), figure.metrics
    title = ", ".join(f"{m} [{METRICS[m].unit}]" for m in metrics if m in METRICS)
    heads = list(metrics) if figure.whole else [f"{m}, frame {f}" for m in metrics for f in frames]
    rows = []
    for case, ours in cases.items():
        for method in (methods[n] for n in figure.models if n in methods):
            if figure.whole:
                values = [method.over_horizon(m, ours) for m in metrics]
            else:
                values = [method.at(m, f, ours) for m in metrics for f in frames]
            name = f"{case} (ours {ours})" if size.split in TABLE_4_8 else f"T{case} ({ours})"
            rows.append((name, label(method.name), *map(number, values)))
    return Table(title, ("test case", "model", *heads), tuple(rows))


def histograms(plan: Plan, figure: Figure) -> Sheet:
    """Return histograms of T0's vorticity at the frames of a figure, and their divergences."""
    size = plan.tier(figure.split)
    frames, case = _frames(size, figure), min(size.subsets["test"])
    columns = min(len(frames), 2)
    width = 6.0 if columns == 1 else 4.2
    with (
        opened(plan, figure.split, case, figure.models) as rollouts,
        charts(len(frames), columns, width=width, height=2.8) as drawn,
    ):
        for axes, frame in zip(drawn, frames, strict=True):
            _draw_histograms(axes, rollouts, frame, legend=frame == frames[0])
        picture = png(drawn)
    table = _errors(plan, figure, frames, {0: case})
    return Sheet(notes=(figure.said,), tables=(table,), pictures={"": picture})


def _draw_histograms(axes: Axes, rollouts: Rollouts, frame: int, *, legend: bool) -> None:
    truth = rollouts.snapshot(None, frame).fields
    true = truth.vorticity[truth.differentiable]
    low, high = np.quantile(true, [0.0, 1.0])
    margin = 0.15 * (high - low) or 1.0
    edges = np.linspace(low - margin, high + margin, BINS + 1)
    axes.stairs(np.histogram(true, edges)[0], edges, color=TRUTH, lw=1.8, label="truth")
    for name in rollouts.predictions:
        # what the truth never reaches is counted in the outermost bins
        held = np.clip(rollouts.pair(name, frame).predicted_vorticity, edges[0], edges[-1])
        axes.stairs(np.histogram(held, edges)[0], edges, color=colour(name), lw=1.0, label=label(name))
    tidy(axes, f"frame {frame}, T0", "vorticity [1/frame]", "nodes", legend=legend)


def residuals(plan: Plan, figure: Figure) -> Sheet:
    """Return the residuals (Eq. 5.22) of six operators at frame 54 of T0, over the truth or the nodes."""
    size = plan.tier(figure.split)
    (frame,), case = _frames(size, figure), min(size.subsets["test"])
    by_node = "nodes" in figure.panels
    with (
        opened(plan, figure.split, case, figure.models) as rollouts,
        charts(6, 3, width=2.9, height=2.4) as drawn,
    ):
        pairs = {name: rollouts.pair(name, frame) for name in rollouts.predictions}
        # all but the extreme residuals of all models but the worst are in range
        spread = sorted(np.quantile(np.abs(pair.vorticity_residual), 0.995) for pair in pairs.values())
        limit = float(1.1 * spread[-2 if len(spread) > 2 else -1]) or 1.0 if spread else 1.0
        for axes, (name, pair) in zip(drawn, pairs.items(), strict=False):
            along = np.flatnonzero(pair.nodes.ravel()) if by_node else pair.true_vorticity
            axes.plot(along, pair.vorticity_residual, ".", ms=2.0, color=colour(name))
            axes.axhline(0.0, color="#c0392b", lw=0.8, ls="--")
            axes.set_ylim(-limit, limit)
            x = "node" if by_node else "true vorticity [1/frame]"
            tidy(axes, label(name), x, "residual [1/frame]", legend=False)
        for axes in drawn[len(pairs) :]:
            axes.set_axis_off()
        picture = png(drawn)
    table = _errors(plan, figure, (frame,), {0: case})
    return Sheet(notes=(figure.said,), tables=(table,), pictures={"": picture})
