"""Figs. 4.4 to 4.6, 4.8, 5.21: loss over the steps of trainings, from what TensorBoard was told."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lagbench.errors import require
from lagbench.scoring.tables import Table

from .chart import charts, colour, tidy
from .evidence import read_json
from .mlp_studies import FILE, study_folder, study_rows
from .plan import Plan
from .roster import ROSTER, label
from .sheet import Sheet
from .thesis import LOSS_SNAPSHOTS, OPERATORS
from .wording import number

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["draw_figure", "loss_over_steps"]

Floats = NDArray[np.float64]

SMOOTHED = 25
"""Entries of the log that a drawn point is the mean of, as many before it as after; fewer at both ends."""


@dataclass(frozen=True, kw_only=True)
class Curve:
    """The loss of one training."""

    name: str  # what the legend calls it
    colour: str | None  # of its line; None for the next in turn
    steps: Floats  # optimiser steps, shape [entry]
    loss: Floats  # weighted sum of the raw terms, shape [entry]


def loss_over_steps(folder: Path, term: str = "total") -> tuple[Floats, Floats]:
    """Return steps and loss of a training; empty where it left no log."""
    logs = folder / "tensorboard"
    if not logs.is_dir():
        return np.empty(0), np.empty(0)
    module = require("tensorboard.backend.event_processing.event_accumulator", extra="baselines")
    held = module.EventAccumulator(str(logs), size_guidance={"scalars": 0}).Reload()
    tag = f"loss/{term}"
    if tag not in held.Tags()["scalars"]:
        return np.empty(0), np.empty(0)
    entries = sorted({entry.step: entry.value for entry in held.Scalars(tag)}.items())
    return np.array([step for step, _ in entries], float), np.array([loss for _, loss in entries])


def smoothed(values: Floats) -> Floats:
    """Return the mean of each value and its neighbours, :data:`SMOOTHED` in all where there are."""
    total = np.concatenate([[0.0], np.cumsum(values)])
    place = np.arange(len(values))
    reach = np.minimum(SMOOTHED // 2, np.minimum(place, place[::-1]))
    mean: Floats = (total[place + reach + 1] - total[place - reach]) / (2 * reach + 1)
    return mean


def draw_figure(plan: Plan, name: str) -> Sheet:
    """Return a figure of learning curves."""
    if name == "fig_5_21":
        return _operators(plan)
    if name == "fig_4_8":
        return _chosen(plan)
    return _studies(plan, name)


def _studies(plan: Plan, name: str) -> Sheet:
    """Return the curves of Table 4.2 or 4.3, with the final errors of train and valid."""
    source = "table_4_3" if name == "fig_4_6" else "table_4_2"
    studies = study_rows(source)
    curves = []
    for study in studies:
        called = study.activation if source == "table_4_2" else f"3 x {study.widths[0]}"
        steps, loss = loss_over_steps(study_folder(plan, source, study))
        curves.append(Curve(name=called, colour=None, steps=steps, loss=loss))
    errors = [read_json(study_folder(plan, source, study) / FILE) for study in studies]
    with charts(2) as drawn:
        _plot(drawn.axes[0], curves, "training loss [standardised^2]")
        place = np.arange(len(studies))
        for shift, subset in ((-0.2, "train"), (0.2, "valid")):
            values = [float(held.get(subset, np.nan)) for held in errors]
            drawn.axes[1].bar(place + shift, values, 0.4, label=subset)
        drawn.axes[1].set_xticks(place, [curve.name for curve in curves])
        tidy(drawn.axes[1], "after training", "", "MSE of one step [standardised^2]")
        picture = drawn.png()
    said = {
        "fig_4_4": "Thesis: ELU falls lowest within 500 epochs, ReLU close behind.",
        "fig_4_5": "Thesis: the gap between training and validation is small for every activation.",
        "fig_4_6": "Thesis: more neurons, lower error; 3 x 1600 becomes unstable after 96 epochs.",
    }
    rows = tuple(
        (
            curve.name,
            number(study.train, 4),
            number(e.get("train")),
            number(study.valid, 4),
            number(e.get("valid")),
        )
        for curve, study, e in zip(curves, studies, errors, strict=True)
    )
    heads = ("network", "train, thesis", "train, ours", "valid, thesis", "valid, ours")
    return Sheet(notes=(said[name],), tables=(Table("", heads, rows),), pictures={"": picture})


def _chosen(plan: Plan) -> Sheet:
    """Return the curve of the chosen MLP, which is the baseline."""
    runs = {split: plan.folder(split, ROSTER["mlp"], plan.seeds[0]) for split in ("fluid", "multimaterial")}
    curves = [Curve(name=split, colour=None, **_loss(folder)) for split, folder in runs.items()]
    with charts(1, width=5.6, height=3.2) as drawn:
        _plot(drawn.axes[0], curves, "training loss [standardised^2]")
        picture = drawn.png()
    rows = tuple((c.name, number(_last(c)), "0.0091 / 0.0152") for c in curves)
    heads = ("split", "loss at the end, ours", "train / valid, thesis (Table 4.5, row 3)")
    return Sheet(tables=(Table("", heads, rows),), pictures={"": picture})


def _operators(plan: Plan) -> Sheet:
    """Return the curves of six operators on curl-noise, and the raw terms at the end."""
    folders = {n: plan.folder("curl-noise", ROSTER[n], plan.seeds[0]) for n in OPERATORS}
    curves = [Curve(name=label(n), colour=colour(n), **_loss(folder)) for n, folder in folders.items()]
    with charts(1, width=5.6, height=3.2) as drawn:
        _plot(drawn.axes[0], curves, "training loss, sum of six terms")
        picture = drawn.png()
    terms = tuple(LOSS_SNAPSHOTS["end"])
    rows = [
        (f"thesis, {when}", *(number(values[term]) for term in terms))
        for when, values in LOSS_SNAPSHOTS.items()
    ]
    for name, folder in folders.items():
        ends = [loss_over_steps(folder, term)[1][-SMOOTHED:] for term in terms]
        rows.append((label(name), *(number(float(end.mean()) if end.size else None) for end in ends)))
    note = (
        "Thesis: the total is 0.302 at step 507 and 0.644 at the end: it rises, so it is no yardstick. Ours:"
        f" raw terms, mean of the last {SMOOTHED} entries of the log."
    )
    table = Table("Raw terms of the loss", ("model", *terms), tuple(rows))
    return Sheet(notes=(note,), tables=(table,), pictures={"": picture})


def _loss(folder: Path) -> Mapping[str, Floats]:
    steps, loss = loss_over_steps(folder)
    return {"steps": steps, "loss": loss}


def _last(curve: Curve) -> float | None:
    return float(curve.loss[-SMOOTHED:].mean()) if curve.loss.size else None


def _plot(axes: Axes, curves: list[Curve], axis: str) -> None:
    for curve in curves:
        if curve.loss.size:
            axes.plot(curve.steps, smoothed(curve.loss), lw=1.1, label=curve.name, color=curve.colour)
    if any(curve.loss.size for curve in curves):
        axes.set_yscale("log")
    tidy(axes, f"mean of {SMOOTHED} entries", "optimiser step", axis)
