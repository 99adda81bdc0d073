"""Pictures of frames, histograms and residuals of the vorticity; curves over frames,
losses over steps.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack

import numpy as np
from numpy.typing import NDArray

from lagbench.data.registry import Size
from lagbench.figures.tables import Table
from lagbench.metrics.aggregate import Score
from lagbench.metrics.metric import mean
from lagbench.metrics.table import METRICS

from .claims import compared, comparison_table
from .drawing import (
    SMOOTHED,
    TRUTH,
    Figure,
    Sheet,
    charts,
    loss_over_steps,
    opened,
    panel_rows,
    plot_losses,
    png,
    tidy,
)
from .plan import Plan
from .thesis import (
    LOSS_SNAPSHOTS,
    TABLE_4_8,
    colour,
    key_frame,
    label,
    number,
    scenario_of,
)

TIMES = 6  # columns of a picture that shows a whole rollout

BINS = 40


def panels(plan: Plan, figure: Figure) -> Sheet:
    """Return rows of truth and predictions by test case, a picture per kind of panel,
    and the errors.
    """
    evidence = plan.evidence(figure.split)
    size = evidence.size
    cases = {
        case: ours
        for case in figure.cases
        if (ours := scenario_of(size, case)) is not None
    }
    frames = _frames(size, figure)
    # the number of a case in a full box, its id on the free surface
    called = {
        case: str(ours) if size.split in TABLE_4_8 else f"T{case}"
        for case, ours in cases.items()
    }
    with ExitStack() as stack:
        shown = {
            case: stack.enter_context(opened(plan, figure.split, ours, figure.models))
            for case, ours in cases.items()
        }
        rows = [
            (
                label(name) if len(shown) == 1 else f"{called[case]}, {label(name)}",
                rollouts,
                name,
            )
            for case, rollouts in shown.items()
            for name in (None, *rollouts.predictions)
        ]
        pictures = {
            panel if len(figure.panels) > 1 else "": panel_rows(rows, frames, panel)
            for panel in figure.panels
            if rows
        }
    notes = [figure.said] + (
        [] if cases else ["No scenario of this kind is in this size's test subset."]
    )
    tables = [_errors(plan, figure, frames, cases)]
    if len(figure.models) == 2:  # a model with and without something
        second, first = figure.models
        tables.append(
            comparison_table(
                compared(
                    evidence, first, (second,), (evidence.ranking, "position_rmse")
                )
            )
        )
    return Sheet(notes=tuple(notes), tables=tuple(tables), pictures=pictures)


def _frames(size: Size, figure: Figure) -> tuple[int, ...]:
    """Return the frames of a figure that are predicted, the last if none is: its own,
    or the key frame.
    """
    first = size.task.input_frames
    last = size.task.input_frames + size.task.horizon - 1
    if figure.whole:
        return tuple(
            first + round(i * (last - first) / (TIMES - 1)) for i in range(TIMES)
        )
    frames = figure.frames or (key_frame(size),)
    return tuple(frame for frame in frames if first <= frame <= last) or (last,)


def _errors(
    plan: Plan, figure: Figure, frames: Sequence[int], cases: Mapping[int, int]
) -> Table:
    """Return the metrics of a figure by case and model, at its frames or over the whole
    rollout.
    """
    methods = plan.evidence(figure.split).methods
    size = plan.tier(figure.split)
    metrics = figure.metrics
    title = ", ".join(f"{m} [{METRICS[m].unit}]" for m in metrics if m in METRICS)
    if figure.whole:
        heads = list(metrics)
    else:
        heads = [f"{m}, frame {f}" for m in metrics for f in frames]
    rows = []
    for case, ours in cases.items():
        for method in (methods[n] for n in figure.models if n in methods):
            if figure.whole:
                values = [method.over_horizon(m, ours) for m in metrics]
            else:
                values = [method.at(m, f, ours) for m in metrics for f in frames]
            if size.split in TABLE_4_8:
                name = f"{case} (ours {ours})"
            else:
                name = f"T{case} ({ours})"
            rows.append((name, label(method.name), *map(number, values)))
    return Table(title, ("test case", "model", *heads), tuple(rows))


def histograms(plan: Plan, figure: Figure) -> Sheet:
    """Return histograms of T0's vorticity at the frames of a figure, and their
    divergences.
    """
    size = plan.tier(figure.split)
    frames = _frames(size, figure)
    case = min(size.subsets["test"])
    show = charts(
        len(frames),
        min(len(frames), 2),
        width=6.0 if len(frames) == 1 else 4.2,
        height=2.8,
    )
    with opened(plan, figure.split, case, figure.models) as rollouts, show as drawn:
        for axes, frame in zip(drawn, frames, strict=True):
            truth = rollouts.snapshot(None, frame).fields
            true = truth.vorticity[truth.differentiable]
            low, high = np.quantile(true, [0.0, 1.0])
            margin = 0.15 * (high - low) or 1.0
            edges = np.linspace(low - margin, high + margin, BINS + 1)
            axes.stairs(
                np.histogram(true, edges)[0], edges, color=TRUTH, lw=1.8, label="truth"
            )
            for name in rollouts.predictions:
                # what the truth never reaches is counted in the outermost bins
                held = np.clip(
                    rollouts.pair(name, frame).predicted_vorticity, edges[0], edges[-1]
                )
                counts = np.histogram(held, edges)[0]
                axes.stairs(
                    counts, edges, color=colour(name), lw=1.0, label=label(name)
                )
            tidy(
                axes,
                f"frame {frame}, T0",
                "vorticity [1/frame]",
                "nodes",
                legend=frame == frames[0],
            )
        picture = png(drawn)
    table = _errors(plan, figure, frames, {0: case})
    return Sheet(notes=(figure.said,), tables=(table,), pictures={"": picture})


def residuals(plan: Plan, figure: Figure) -> Sheet:
    """Return the residuals (Eq. 5.22) of six operators at frame 54 of T0, over the
    truth or the nodes.
    """
    size = plan.tier(figure.split)
    (frame,), case = _frames(size, figure), min(size.subsets["test"])
    by_node = "nodes" in figure.panels
    show = charts(6, 3, width=2.9, height=2.4)
    with opened(plan, figure.split, case, figure.models) as rollouts, show as drawn:
        pairs = {name: rollouts.pair(name, frame) for name in rollouts.predictions}
        # all but the extreme residuals of all models but the worst are in range
        spread = sorted(
            np.quantile(np.abs(pair.vorticity_residual), 0.995)
            for pair in pairs.values()
        )
        if spread:
            limit = float(1.1 * spread[-2 if len(spread) > 2 else -1]) or 1.0
        else:
            limit = 1.0
        for axes, (name, pair) in zip(drawn, pairs.items(), strict=False):
            along = (
                np.flatnonzero(pair.nodes.ravel()) if by_node else pair.true_vorticity
            )
            axes.plot(along, pair.vorticity_residual, ".", ms=2.0, color=colour(name))
            axes.axhline(0.0, color="#c0392b", lw=0.8, ls="--")
            axes.set_ylim(-limit, limit)
            if by_node:
                x = "node"
            else:
                x = "true vorticity [1/frame]"
            tidy(axes, label(name), x, "residual [1/frame]", legend=False)
        for axes in drawn[len(pairs) :]:
            axes.set_axis_off()
        picture = png(drawn)
    table = _errors(plan, figure, (frame,), {0: case})
    return Sheet(notes=(figure.said,), tables=(table,), pictures={"": picture})


# below which SuperGAT's vorticity MSE stays up to a frame [1/frame^2]
BOUNDS = {
    40: 0.0002,
    80: 0.0004,
}


def model_curves(plan: Plan, figure: Figure) -> Sheet:
    """Return a metric over the frames, one curve per model: for T0 and in the mean over
    scenarios.
    """
    evidence = plan.evidence(figure.split)
    metric = figure.metrics[0]
    scores = {
        n: evidence.methods[n].scores for n in figure.models if n in evidence.methods
    }
    curves: dict[str | None, Score] = {
        name: held[metric] for name, held in scores.items()
    }
    if len(figure.metrics) > 1 and curves:  # the truth has a value of its own
        curves = {None: next(iter(scores.values()))[figure.metrics[1]], **curves}
    with charts(2, 2) as drawn:
        for axes, case in zip(drawn, (0, None), strict=True):
            for name, score in curves.items():
                if case is not None:
                    values = score.per_frame[case]
                else:
                    values = [mean(c) for c in score.per_frame.T]
                line, lw = (TRUTH, 1.6) if name is None else (colour(name), 1.2)
                axes.plot(score.frames, values, label=label(name), color=line, lw=lw)
            if None not in curves:
                axes.set_ylim(bottom=0.0)
            if case is None:
                title = "mean over test scenarios"
            else:
                title = f"T{case}"
            tidy(
                axes,
                title,
                "frame",
                f"{metric} [{METRICS[metric].unit}]",
                legend=case is None,
            )
        picture = png(drawn)
    task = evidence.size.task
    frames = sorted({*task.frames_of_interest, task.input_frames + task.horizon - 1})
    rows = [
        (
            label(name),
            *(number(mean(score.at(frame))) for frame in frames),
            *(
                number(scores[name][m].mean if name and m in scores[name] else None)
                for m in figure.metrics[2:]
            ),
        )
        for name, score in curves.items()
    ]
    heads = ("model", *(f"frame {frame}" for frame in frames), *figure.metrics[2:])
    table = Table("mean over test scenarios", heads, tuple(rows))
    return Sheet(notes=(figure.said,), tables=(table,), pictures={"": picture})


def case_curves(plan: Plan, figure: Figure) -> Sheet:
    """Return a metric of one model over the frames, one curve per test scenario."""
    methods, (name,), (metric,) = (
        plan.evidence(figure.split).methods,
        figure.models,
        figure.metrics,
    )
    if name not in methods:
        return Sheet(notes=(figure.said, "No run of this model is there."))
    score = methods[name].scores[metric]
    cases = [
        f"T{row} (scenario {scenario})" for row, scenario in enumerate(score.scenarios)
    ]
    with charts(1, 1, width=5.6, height=3.4) as (axes,):
        for case, values in zip(cases, score.per_frame, strict=True):
            axes.plot(score.frames, values, lw=1.1, label=case)
        axes.set_ylim(bottom=0.0)
        tidy(axes, label(name), "frame", f"{metric} [{score.metric.unit}]")
        picture = png([axes])
    rows = [
        (
            case,
            *(
                number(float(np.nanmax(values[: end - score.frames[0] + 1])))
                for end in BOUNDS
            ),
        )
        for case, values in zip(cases, score.per_frame, strict=True)
    ]
    heads = (
        "test case",
        *(
            f"greatest up to frame {end} (thesis < {most})"
            for end, most in BOUNDS.items()
        ),
    )
    return Sheet(
        notes=(figure.said,),
        tables=(Table("", heads, tuple(rows)),),
        pictures={"": picture},
    )


def losses(plan: Plan, figure: Figure) -> Sheet:
    """Return the losses of trainings, one curve per split and model, and their raw
    terms at the end.
    """
    folders = {
        (split, name): plan.folder(split, name, plan.seeds[0])
        for split, names in figure.needs.items()
        for name in names
    }
    several = len(figure.needs) > 1
    curves = {
        (split if several else label(name)): (
            None if several else colour(name),
            *loss_over_steps(folder),
        )
        for (split, name), folder in folders.items()
    }
    with charts(1, 1, width=5.6, height=3.2) as drawn:
        plot_losses(drawn[0], curves)
        picture = png(drawn)
    heads: tuple[str, ...] = (
        "split",
        "loss at the end, ours",
        "train / valid, thesis (Table 4.5, row 3)",
    )
    rows: list[tuple[str, ...]] = []
    if several:
        rows += [
            (called, _end(loss), "0.0091 / 0.0152")
            for called, (_, _, loss) in curves.items()
        ]
    else:
        terms = tuple(LOSS_SNAPSHOTS["end"])
        heads = ("raw term", *terms)
        for when, values in LOSS_SNAPSHOTS.items():
            rows.append((f"thesis, {when}", *(number(values[term]) for term in terms)))
        for (_, name), folder in folders.items():
            rows.append(
                (
                    label(name),
                    *(_end(loss_over_steps(folder, term)[1]) for term in terms),
                )
            )
    return Sheet(
        notes=(figure.said,) if figure.said else (),
        tables=(
            Table(
                f"Mean of the last {SMOOTHED} entries of the log", heads, tuple(rows)
            ),
        ),
        pictures={"": picture},
    )


def _end(loss: NDArray[np.float64]) -> str:
    return number(float(loss[-SMOOTHED:].mean()) if loss.size else None)
