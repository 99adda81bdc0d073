"""Pictures of frames, histograms and residuals of vorticity, curves over frames."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack

import numpy as np
from numpy.typing import NDArray

from lagbench.data.registry import Size
from lagbench.figures.tables import Table
from lagbench.metrics.aggregate import Score
from lagbench.metrics.frame import FramePair
from lagbench.metrics.metric import mean
from lagbench.metrics.table import METRICS

from .cases import key_frame, scenario_of
from .claims import compare_models, comparison_table
from .drawing import (
    SMOOTHED,
    TRUTH_COLOUR,
    OpenRollouts,
    PanelRow,
    charts,
    charts_png,
    loss_over_steps,
    open_rollouts,
    panel_rows,
    plot_losses,
    tidy_axes,
)
from .formatting import number
from .items import Sheet, ThesisItem
from .plan import Plan
from .published import LOSS_SNAPSHOTS, TABLE_4_8
from .roster import colour, label

ROLLOUT_COLUMNS = 6  # columns of a picture that shows a whole rollout

BINS = 40


def panels(plan: Plan, item: ThesisItem) -> Sheet:
    """Return rows of truth and predictions by test case, and their errors.

    There is a picture for each kind of panel.
    """
    results = plan.results(item.split)
    size = results.size
    scenario_by_case = {}
    for case in item.cases:
        scenario = scenario_of(size, case)
        if scenario is not None:
            scenario_by_case[case] = scenario
    frames = _frames(size, item)

    pictures = {}
    with ExitStack() as stack:
        rows = list(_panel_rows(plan, item, scenario_by_case, stack))
        for panel in item.panels:
            ending = panel if len(item.panels) > 1 else ""
            if rows:
                pictures[ending] = panel_rows(rows, frames, panel)

    notes = [item.remark]
    if not scenario_by_case:
        notes.append("No scenario of this kind is in this size's test subset.")
    tables = [_errors(plan, item, frames, scenario_by_case)]
    if len(item.models) == 2:  # a model without and with something
        second, first = item.models
        metrics = (results.ranking, "position_rmse")
        rows_of_pair = compare_models(results, first, (second,), metrics)
        tables.append(comparison_table(rows_of_pair))
    return Sheet(notes=tuple(notes), tables=tuple(tables), pictures=pictures)


def _panel_rows(
    plan: Plan,
    item: ThesisItem,
    scenario_by_case: Mapping[int, int],
    stack: ExitStack,
) -> Iterator[PanelRow]:
    """Yield the truth and every prediction of each case, from files that stay open."""
    split = item.split
    for case, scenario in scenario_by_case.items():
        rollouts: OpenRollouts = stack.enter_context(
            open_rollouts(plan, split, scenario=scenario, names=item.models)
        )
        # the number of a case in a full box, its id on the free surface
        case_name = str(scenario) if split in TABLE_4_8 else f"T{case}"
        for name in (None, *rollouts.predictions):
            heading = label(name)
            if len(scenario_by_case) > 1:
                heading = f"{case_name}, {heading}"
            yield heading, rollouts, name


def _frames(size: Size, item: ThesisItem) -> tuple[int, ...]:
    """Return the predicted ones of an item's frames; the last frame if none is.

    An item without frames shows the key frame.
    """
    first = size.task.input_frames
    last = first + size.task.horizon - 1
    if item.whole:
        spacing = (last - first) / (ROLLOUT_COLUMNS - 1)
        return tuple(first + round(i * spacing) for i in range(ROLLOUT_COLUMNS))
    frames = item.frames or (key_frame(size),)
    predicted = tuple(frame for frame in frames if first <= frame <= last)
    return predicted or (last,)


def _errors(
    plan: Plan,
    item: ThesisItem,
    frames: Sequence[int],
    scenario_by_case: Mapping[int, int],
) -> Table:
    """Return the metrics of an item by case and model.

    The values are those at its frames, or over the whole rollout.
    """
    methods = plan.results(item.split).methods
    names = [name for name in item.models if name in methods]
    units = []
    heads = ["test case", "model"]
    for metric in item.metrics:
        if metric in METRICS:
            units.append(f"{metric} [{METRICS[metric].unit}]")
        if item.whole:
            heads.append(metric)
        else:
            heads += [f"{metric}, frame {frame}" for frame in frames]

    rows = []
    for case, scenario in scenario_by_case.items():
        case_name = f"T{case} ({scenario})"
        if item.split in TABLE_4_8:
            case_name = f"{case} (ours {scenario})"
        for name in names:
            method = methods[name]
            values = []
            for metric in item.metrics:
                if item.whole:
                    values.append(method.over_horizon(metric, scenario))
                else:
                    values += [method.at(metric, frame, scenario) for frame in frames]
            rows.append((case_name, label(name), *map(number, values)))
    return Table(", ".join(units), tuple(heads), tuple(rows))


def histograms(plan: Plan, item: ThesisItem) -> Sheet:
    """Return histograms of the vorticity at an item's frames, and the KL divergences.

    The scenario is T0, the first one of test.
    """
    size = plan.tier(item.split)
    frames = _frames(size, item)
    scenario = min(size.subsets["test"])
    column_count = min(len(frames), 2)
    width = 6.0 if len(frames) == 1 else 4.2
    with (
        open_rollouts(
            plan, item.split, scenario=scenario, names=item.models
        ) as rollouts,
        charts(len(frames), column_count, width=width, height=2.8) as all_axes,
    ):
        for axes, frame in zip(all_axes, frames, strict=True):
            truth = rollouts.snapshot(None, frame).fields
            true_vorticity = truth.vorticity[truth.differentiable]
            low = true_vorticity.min()
            high = true_vorticity.max()
            margin = 0.15 * (high - low) or 1.0
            edges = np.linspace(low - margin, high + margin, BINS + 1)
            counts = np.histogram(true_vorticity, edges)[0]
            axes.stairs(counts, edges, color=TRUTH_COLOUR, lw=1.8, label="truth")
            for name in rollouts.predictions:
                predicted = rollouts.pair(name, frame).predicted_vorticity
                # the outermost bins count what lies beyond the range of the truth
                clipped = np.clip(predicted, edges[0], edges[-1])
                counts = np.histogram(clipped, edges)[0]
                axes.stairs(
                    counts, edges, color=colour(name), lw=1.0, label=label(name)
                )
            tidy_axes(
                axes,
                f"frame {frame}, T0",
                x="vorticity [1/frame]",
                y="nodes",
                legend=frame == frames[0],
            )
        picture = charts_png(all_axes)
    table = _errors(plan, item, frames, {0: scenario})
    return Sheet(notes=(item.remark,), tables=(table,), pictures={"": picture})


def residuals(plan: Plan, item: ThesisItem) -> Sheet:
    """Return the residuals (Eq. 5.22) of six operators at frame 54 of T0.

    They are plotted over the true vorticity, or over the nodes.
    """
    size = plan.tier(item.split)
    (frame,) = _frames(size, item)
    scenario = min(size.subsets["test"])
    is_by_node = "nodes" in item.panels
    x_label = "node" if is_by_node else "true vorticity [1/frame]"
    with (
        open_rollouts(
            plan, item.split, scenario=scenario, names=item.models
        ) as rollouts,
        charts(6, 3, width=2.9, height=2.4) as all_axes,
    ):
        pairs = {name: rollouts.pair(name, frame) for name in rollouts.predictions}
        limit = _residual_limit(pairs)
        for axes, (name, pair) in zip(all_axes, pairs.items(), strict=False):
            if is_by_node:
                place = np.flatnonzero(pair.nodes.ravel()).astype(np.float64)
            else:
                place = pair.true_vorticity
            axes.plot(place, pair.vorticity_residual, ".", ms=2.0, color=colour(name))
            axes.axhline(0.0, color="#c0392b", lw=0.8, ls="--")
            axes.set_ylim(-limit, limit)
            tidy_axes(
                axes, label(name), x=x_label, y="residual [1/frame]", legend=False
            )
        for axes in all_axes[len(pairs) :]:
            axes.set_axis_off()
        picture = charts_png(all_axes)
    table = _errors(plan, item, (frame,), {0: scenario})
    return Sheet(notes=(item.remark,), tables=(table,), pictures={"": picture})


def _residual_limit(pairs: Mapping[str, FramePair]) -> float:
    """Return the range that has all but the extreme residuals of all but the worst."""
    extremes = []
    for pair in pairs.values():
        extremes.append(np.quantile(np.abs(pair.vorticity_residual), 0.995))
    extremes.sort()
    if not extremes:
        return 1.0
    chosen = extremes[-2] if len(extremes) > 2 else extremes[-1]
    return float(1.1 * chosen) or 1.0


# bound of SuperGAT's vorticity MSE [1/frame^2] up to a frame, in the thesis
BOUNDS = {
    40: 0.0002,
    80: 0.0004,
}


def model_curves(plan: Plan, item: ThesisItem) -> Sheet:
    """Return a metric over the frames, one curve per model.

    One chart has T0, the other the mean over scenarios.
    """
    results = plan.results(item.split)
    metric = item.metrics[0]
    scores = {}
    for name in item.models:
        if name in results.methods:
            scores[name] = results.methods[name].scores
    curves: dict[str | None, Score] = {}
    if len(item.metrics) > 1 and scores:  # the truth has a value of its own
        first_scores = next(iter(scores.values()))
        curves[None] = first_scores[item.metrics[1]]
    for name, model_scores in scores.items():
        curves[name] = model_scores[metric]

    with charts(2, 2) as all_axes:
        first_axes, mean_axes = all_axes
        for curve_name, score in curves.items():
            line_colour = TRUTH_COLOUR
            line_width = 1.6
            if curve_name is not None:
                line_colour = colour(curve_name)
                line_width = 1.2
            mean_values = [mean(values) for values in score.per_frame.T]
            for axes, y_values in (
                (first_axes, score.per_frame[0]),
                (mean_axes, mean_values),
            ):
                axes.plot(
                    score.frames,
                    y_values,
                    label=label(curve_name),
                    color=line_colour,
                    lw=line_width,
                )
        if None not in curves:
            first_axes.set_ylim(bottom=0.0)
            mean_axes.set_ylim(bottom=0.0)
        y = f"{metric} [{METRICS[metric].unit}]"
        tidy_axes(first_axes, "T0", x="frame", y=y, legend=False)
        tidy_axes(mean_axes, "mean over test scenarios", x="frame", y=y)
        picture = charts_png(all_axes)

    task = results.size.task
    last_frame = task.input_frames + task.horizon - 1
    frames = sorted({*task.frames_of_interest, last_frame})
    further_metrics = item.metrics[2:]
    rows = []
    for curve_name, score in curves.items():
        row = [label(curve_name)]
        row += [number(mean(score.at(frame))) for frame in frames]
        for further in further_metrics:
            value = None
            if curve_name is not None and further in scores[curve_name]:
                value = scores[curve_name][further].mean
            row.append(number(value))
        rows.append(tuple(row))
    heads = ("model", *(f"frame {frame}" for frame in frames), *further_metrics)
    table = Table("mean over test scenarios", heads, tuple(rows))
    return Sheet(notes=(item.remark,), tables=(table,), pictures={"": picture})


def case_curves(plan: Plan, item: ThesisItem) -> Sheet:
    """Return a metric of one model over the frames, one curve per test scenario."""
    methods = plan.results(item.split).methods
    (name,) = item.models
    (metric,) = item.metrics
    if name not in methods:
        return Sheet(notes=(item.remark, "There is no run of this model."))

    score = methods[name].scores[metric]
    rows = []
    with charts(1, 1, width=5.6, height=3.4) as (axes,):
        for index, scenario in enumerate(score.scenarios):
            case = f"T{index} (scenario {scenario})"
            values = score.per_frame[index]
            axes.plot(score.frames, values, lw=1.1, label=case)
            row = [case]
            for frame in BOUNDS:
                end = frame - score.frames[0] + 1
                row.append(number(float(np.nanmax(values[:end]))))
            rows.append(tuple(row))
        axes.set_ylim(bottom=0.0)
        y = f"{metric} [{score.metric.unit}]"
        tidy_axes(axes, label(name), x="frame", y=y)
        picture = charts_png([axes])

    heads = ["test case"]
    for frame, bound in BOUNDS.items():
        heads.append(f"greatest up to frame {frame} (thesis < {bound})")
    return Sheet(
        notes=(item.remark,),
        tables=(Table("", tuple(heads), tuple(rows)),),
        pictures={"": picture},
    )


def losses(plan: Plan, item: ThesisItem) -> Sheet:
    """Return the losses of trainings over their steps, those of the first seed.

    An item of several splits has one model in each: a curve per split, and a table of
    the losses at the end. An item of one split has a curve per model, and a table of
    the raw terms of the loss at the end. Both tables hold the thesis's values too.
    """
    has_several_splits = len(item.needs) > 1
    curves = {}
    colours = {}
    folders = {}
    for split, names in item.needs.items():
        for name in names:
            folder = plan.folder(split, name, plan.seeds[0])
            curve_name = split
            if not has_several_splits:
                curve_name = label(name)
                colours[curve_name] = colour(name)
            folders[curve_name] = folder
            curves[curve_name] = loss_over_steps(folder)

    with charts(1, 1, width=5.6, height=3.2) as all_axes:
        plot_losses(all_axes[0], curves, colours)
        picture = charts_png(all_axes)

    rows: list[tuple[str, ...]] = []
    heads: tuple[str, ...]
    if has_several_splits:
        heads = (
            "split",
            "loss at the end, ours",
            "train / valid, thesis (Table 4.5, row 3)",
        )
        for curve_name, curve in curves.items():
            rows.append((curve_name, _final_loss(curve.loss), "0.0091 / 0.0152"))
    else:
        terms = tuple(LOSS_SNAPSHOTS["end"])
        heads = ("raw term", *terms)
        for moment, values in LOSS_SNAPSHOTS.items():
            cells = [number(values[term]) for term in terms]
            rows.append((f"thesis, {moment}", *cells))
        for curve_name, folder in folders.items():
            cells = []
            for term in terms:
                cells.append(_final_loss(loss_over_steps(folder, term).loss))
            rows.append((curve_name, *cells))

    title = f"Mean of the last {SMOOTHED} entries of the log"
    return Sheet(
        notes=(item.remark,) if item.remark else (),
        tables=(Table(title, heads, tuple(rows)),),
        pictures={"": picture},
    )


def _final_loss(loss: NDArray[np.float64]) -> str:
    if not loss.size:
        return number(None)
    return number(float(loss[-SMOOTHED:].mean()))
