"""Curves: errors and energy over the frames of a rollout, losses over the steps of a training."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lagbench.errors import require
from lagbench.metrics.aggregate import Score
from lagbench.metrics.metric import mean
from lagbench.metrics.table import METRICS
from lagbench.scoring.tables import Table

from .drawing import TRUTH, charts, png, tidy
from .evidence import read_json
from .mlp_studies import FILE, study_folder, study_rows
from .runs import Plan
from .sheet import Figure, Sheet, number
from .thesis import LOSS_SNAPSHOTS, colour, label

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["case_curves", "loss_over_steps", "losses", "model_curves", "smoothed", "study_losses"]

Floats = NDArray[np.float64]

BOUNDS = {40: 0.0002, 80: 0.0004}
"""What the thesis says that SuperGAT's vorticity MSE stays below up to a frame [1/frame^2]."""

SMOOTHED = 25
"""Entries of the log that a drawn point is the mean of, as many before it as after; fewer at both ends."""


def model_curves(plan: Plan, figure: Figure) -> Sheet:
    """Return a metric over the frames, one curve per model: for T0 and in the mean over scenarios."""
    evidence, metric = plan.evidence(figure.split), figure.metrics[0]
    scores = {n: evidence.methods[n].scores for n in figure.models if n in evidence.methods}
    curves: dict[str | None, Score] = {name: held[metric] for name, held in scores.items()}
    if len(figure.metrics) > 1 and curves:  # the truth has a value of its own
        curves = {None: next(iter(scores.values()))[figure.metrics[1]], **curves}
    with charts(2, 2) as drawn:
        for axes, case in zip(drawn, (0, None), strict=True):
            for name, score in curves.items():
                values = score.per_frame[case] if case is not None else [mean(c) for c in score.per_frame.T]
                line, lw = (TRUTH, 1.6) if name is None else (colour(name), 1.2)
                axes.plot(score.frames, values, label=label(name), color=line, lw=lw)
            if None not in curves:
                axes.set_ylim(bottom=0.0)
            title = "mean over test scenarios" if case is None else f"T{case}"
            tidy(axes, title, "frame", f"{metric} [{METRICS[metric].unit}]", legend=case is None)
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
    methods, (name,), (metric,) = plan.evidence(figure.split).methods, figure.models, figure.metrics
    if name not in methods:
        return Sheet(notes=(figure.said, "No run of this model is there."))
    score = methods[name].scores[metric]
    cases = [f"T{row} (scenario {scenario})" for row, scenario in enumerate(score.scenarios)]
    with charts(1, 1, width=5.6, height=3.4) as drawn:
        (axes,) = drawn
        for case, values in zip(cases, score.per_frame, strict=True):
            axes.plot(score.frames, values, lw=1.1, label=case)
        axes.set_ylim(bottom=0.0)
        tidy(axes, label(name), "frame", f"{metric} [{score.metric.unit}]")
        picture = png(drawn)
    rows = [
        (case, *(number(float(np.nanmax(values[: end - score.frames[0] + 1]))) for end in BOUNDS))
        for case, values in zip(cases, score.per_frame, strict=True)
    ]
    heads = ("test case", *(f"greatest up to frame {end} (thesis < {most})" for end, most in BOUNDS.items()))
    return Sheet(notes=(figure.said,), tables=(Table("", heads, tuple(rows)),), pictures={"": picture})


def losses(plan: Plan, figure: Figure) -> Sheet:
    """Return the losses of trainings, one curve per split and model, and their raw terms at the end."""
    folders = {
        (split, name): plan.folder(split, name, plan.seeds[0])
        for split, names in figure.needs.items()
        for name in names
    }
    several = len(figure.needs) > 1
    curves = {
        (split if several else label(name)): (None if several else colour(name), *loss_over_steps(folder))
        for (split, name), folder in folders.items()
    }
    with charts(1, 1, width=5.6, height=3.2) as drawn:
        _plot_losses(drawn[0], curves)
        picture = png(drawn)
    heads: tuple[str, ...]
    rows: list[tuple[str, ...]] = []
    if several:
        heads = ("split", "loss at the end, ours", "train / valid, thesis (Table 4.5, row 3)")
        rows = [(called, _end(loss), "0.0091 / 0.0152") for called, (_, _, loss) in curves.items()]
    else:
        terms = tuple(LOSS_SNAPSHOTS["end"])
        heads = ("raw term", *terms)
        for when, values in LOSS_SNAPSHOTS.items():
            rows.append((f"thesis, {when}", *(number(values[term]) for term in terms)))
        for (_, name), folder in folders.items():
            rows.append((label(name), *(_end(loss_over_steps(folder, term)[1]) for term in terms)))
    return Sheet(
        notes=(figure.said,) if figure.said else (),
        tables=(Table(f"Mean of the last {SMOOTHED} entries of the log", heads, tuple(rows)),),
        pictures={"": picture},
    )


def study_losses(plan: Plan, figure: Figure) -> Sheet:
    """Return the losses of the rows of Table 4.2 or 4.3, and the final errors over train and valid."""
    studies = study_rows(figure.studies)
    names = [s.activation if s.table == "4.2" else f"3 x {s.widths[0]}" for s in studies]
    folders = [study_folder(plan, figure.studies, study) for study in studies]
    errors = [read_json(folder / FILE) for folder in folders]
    curves = {name: (None, *loss_over_steps(folder)) for name, folder in zip(names, folders, strict=True)}
    with charts(2, 2) as drawn:
        over_steps, after = drawn
        _plot_losses(over_steps, curves)
        place = np.arange(len(studies))
        for shift, subset in ((-0.2, "train"), (0.2, "valid")):
            values = [float(held.get(subset, np.nan)) for held in errors]
            after.bar(place + shift, values, 0.4, label=subset)
        after.set_xticks(place, names)
        tidy(after, "after training", "", "MSE of one step [standardised^2]")
        picture = png(drawn)
    rows = [
        (name, number(s.train, 4), number(e.get("train")), number(s.valid, 4), number(e.get("valid")))
        for name, s, e in zip(names, studies, errors, strict=True)
    ]
    heads = ("network", "train, thesis", "train, ours", "valid, thesis", "valid, ours")
    return Sheet(notes=(figure.said,), tables=(Table("", heads, tuple(rows)),), pictures={"": picture})


def _plot_losses(axes: Axes, curves: Mapping[str, tuple[str | None, Floats, Floats]]) -> None:
    """Plot smoothed losses by name: colour, steps and loss of each."""
    for name, (line, steps, loss) in curves.items():
        if loss.size:
            axes.plot(steps, smoothed(loss), lw=1.1, label=name, color=line)
            axes.set_yscale("log")
    tidy(axes, f"mean of {SMOOTHED} entries", "optimiser step", "training loss")


def _end(loss: Floats) -> str:
    return number(float(loss[-SMOOTHED:].mean()) if loss.size else None)


def loss_over_steps(folder: Path, term: str = "total") -> tuple[Floats, Floats]:
    """Return steps and loss of a training as TensorBoard was told; empty where it left no log."""
    logs, tag = folder / "tensorboard", f"loss/{term}"
    if not logs.is_dir():
        return np.empty(0), np.empty(0)
    module = require("tensorboard.backend.event_processing.event_accumulator", extra="baselines")
    held = module.EventAccumulator(str(logs), size_guidance={"scalars": 0}).Reload()
    if tag not in held.Tags()["scalars"]:
        return np.empty(0), np.empty(0)
    # a training that went on repeats steps; what was told last holds
    entries = sorted({entry.step: entry.value for entry in held.Scalars(tag)}.items())
    return np.array([step for step, _ in entries], float), np.array([loss for _, loss in entries])


def smoothed(values: Floats) -> Floats:
    """Return the mean of each value and its neighbours, :data:`SMOOTHED` in all where there are."""
    total = np.concatenate([[0.0], np.cumsum(values)])
    place = np.arange(len(values))
    reach = np.minimum(SMOOTHED // 2, np.minimum(place, place[::-1]))
    found: Floats = (total[place + reach + 1] - total[place - reach]) / (2 * reach + 1)
    return found
