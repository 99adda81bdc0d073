"""Columns of the board's tables, what a row has in each, and the presets that choose
among them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lagbench.figures.html import MISSING, sentence, text, words
from lagbench.metrics.metric import Direction, Metric, mean

from .entry import EntryBudget
from .model import ReferenceRow, Row, Tab, Value

MAIN_METRICS = 5
"""Metrics of the first table, the ranking one among them; with more it would be wider
than a screen.
"""

PRESETS: Mapping[str, tuple[str, ...]] = {
    "position": (
        *(
            "cloud_distance",
            "position_rmse_20",
            "position_rmse",
            "position_mae",
            "velocity_rmse",
        ),
        *(
            "velocity_mae",
            "attribute_mse",
            "mse_avg",
            "mse_end",
            "sliced_w2",
            "sinkhorn",
            "sinkhorn_pot",
        ),
        *(
            f"position_rmse_{material}"
            for material in ("liquid", "jelly", "snow", "rope")
        ),
    ),
    "vorticity": (
        *(
            "vorticity_nrmse",
            "vorticity_rmse",
            "vorticity_mae",
            "vorticity_pearson",
            "stable_frames",
        ),
        *("spectrum_error", "vorticity_residual_std", "vorticity_residual_max"),
        *(
            "vorticity_residual_slope",
            "vorticity_kl",
            "vorticity_kl_hist",
            "vorticity_w1",
        ),
    ),
    "energy": (
        *("energy_error", "energy_ratio", "energy_retention", "energy_retention_true"),
        *("energy_predicted", "energy_true"),
    ),
    "conservation": (
        *("momentum_error", "angular_momentum_error", "density_rmse"),
        *("divergence_rms", "divergence_rms_true", "shape_error", "connectivity"),
    ),
    "training": (
        "track",
        "windows",
        "epochs",
        "cpu_hours",
        "gpu_hours",
        "parameters",
        "seeds",
    ),
    "cost": (
        "speed_up",
        "seconds_per_frame",
        "solver_seconds_per_frame",
        "parameters",
        "device",
    ),
}
"""Columns by preset; those that a data set lacks are left out, the ranking one stands
first.
"""


@dataclass(frozen=True, kw_only=True)
class Column:
    """One column."""

    key: str  # unique name, that of the metric where it shows one
    label: str
    unit: str = ""
    direction: Direction = Direction.NONE
    perfect: float | None = None
    form: str = "number"  # how cells are written: number, count, factor or text
    reported: bool = False  # said by the submitter, computed again by nobody
    meaning: str
    # what a row has there, where no metric stands behind
    of: Callable[[Row | ReferenceRow], object] | None = None

    @property
    def quantity(self) -> str:
        """Label and unit, as an axis has them."""
        if self.unit:
            return f"{self.label} [{self.unit}]"
        return self.label

    def loss(self, value: float) -> float:
        """Return the value turned so that smaller is better; NaN for what is not
        judged.
        """
        if self.direction is Direction.TARGET and self.perfect is not None:
            return abs(value - self.perfect)
        return {Direction.LOWER: value, Direction.HIGHER: -value}.get(
            self.direction, math.nan
        )


SKILL = Column(
    key="skill",
    label="skill",
    direction=Direction.HIGHER,
    perfect=1.0,
    meaning="1 - score / score of the best floor, by the ranking metric: 0 is nothing "
    "learned, 1 perfect.",
)


def _of(part: str, key: str) -> Callable[[Row | ReferenceRow], object]:
    def of(row: Row | ReferenceRow) -> object:
        said = row.entry if isinstance(row, Row) else row
        return getattr(getattr(said, part, None) if part else said, key, None)

    return of


def _reported(part: str, key: str, label: str, meaning: str, **how: Any) -> Column:  # noqa: ANN401
    """Return a column of what submitters say."""
    return Column(
        key=key, label=label, meaning=meaning, reported=True, of=_of(part, key), **how
    )


SPEED_UP = "Time of the solver over that of the model per frame."
TIME = "Wall time of a frame of one scenario."
TRACK = "Equal compute for all, or trained until it no longer helped."
OF_ENTRY = (
    _reported(
        "cost",
        "speed_up",
        "speed\u2011up",
        SPEED_UP,
        form="factor",
        direction=Direction.HIGHER,
    ),
    _reported(
        "cost",
        "seconds_per_frame",
        "time per frame",
        TIME,
        unit="s",
        direction=Direction.LOWER,
    ),
    _reported(
        "cost",
        "solver_seconds_per_frame",
        "solver time per frame",
        "On the same machine.",
        unit="s",
    ),
    _reported("cost", "device", "device", "Machine of both times.", form="text"),
    _reported(
        "",
        "parameters",
        "parameters",
        "Trainable parameters of the model.",
        form="count",
    ),
    Column(
        key="budget",
        label="budget",
        form="text",
        reported=True,
        meaning="Computing time of one training.",
        of=lambda row: _budget(row.entry.budget) if isinstance(row, Row) else "",
    ),
    _reported("budget", "track", "track", TRACK, form="text"),
    _reported("budget", "windows", "windows", "Training windows seen.", form="count"),
    _reported("budget", "epochs", "epochs", "Passes over the training subset."),
    _reported("budget", "cpu_hours", "CPU time", "Of one training.", unit="h"),
    _reported("budget", "gpu_hours", "GPU time", "Of one training.", unit="h"),
    Column(
        key="seeds",
        label="seeds",
        form="count",
        meaning="Trainings behind the row; with one it speaks of these weights only.",
        of=lambda row: len(row.entry.predictions) if isinstance(row, Row) else None,
    ),
    Column(
        key="checked",
        label="scores",
        form="text",
        meaning="Verified: the maintainers scored these predictions again. As "
        "submitted: they did not.",
        of=lambda row: (
            ("verified" if row.verified else "as submitted")
            if isinstance(row, Row)
            else ""
        ),
    ),
    Column(
        key="date",
        label="date",
        form="text",
        meaning="Of the submission.",
        of=_of("", "date"),
    ),
)
"""Columns that no metric stands behind."""


def _budget(budget: EntryBudget | None) -> str:
    """Return the computing time of a training in words."""
    if budget is None:
        return ""
    hours = {"CPU": budget.cpu_hours, "GPU": budget.gpu_hours}
    said = [f"{text(value)} {kind} h" for kind, value in hours.items() if value]
    return " + ".join(said) or (
        f"{_count(float(budget.windows))} windows" if budget.windows else ""
    )


def columns_of(tab: Tab, metrics: Mapping[str, Metric]) -> dict[str, Column]:
    """Return all columns of a tab by key: skill, the metrics to show at first, the
    others, then the rest.
    """
    found = {name for row in tab.lines for name in row.values}
    names = [name for name in dict.fromkeys((*tab.columns, *metrics)) if name in found]
    if any(row.skill for row in tab.rows):
        columns = [SKILL]
    else:
        columns = []
    for metric in (metrics[name] for name in names):
        if metric.unit == "1":
            unit = ""
        else:
            unit = metric.unit.replace("^2", "²")
        shown = Column(
            key=metric.name,
            label=words(metric.name),
            unit=unit,
            meaning=sentence(metric),
        )
        columns.append(
            replace(shown, direction=metric.direction, perfect=metric.perfect)
        )
    return {column.key: column for column in (*columns, *OF_ENTRY)}


def presets_of(tab: Tab, columns: Mapping[str, Column]) -> dict[str, tuple[str, ...]]:
    """Return the keys of each preset that has something to show, main first, all
    last.
    """
    main = ("skill", *tab.columns[:MAIN_METRICS], "speed_up", "budget", "checked")
    return {
        name: tuple(key for key in columns if key in ("skill", tab.ranking, *keys))
        for name, keys in {"main": main, **PRESETS, "all": tuple(columns)}.items()
        if any(key in columns for key in keys)
    }


def value_of(row: Row | ReferenceRow, column: Column) -> float | str:
    """Return what a row has in a column; NaN, or an empty text, where it has
    nothing.
    """
    if (value := held(row, column.key)) is not None:
        return value.mean
    if column.of:
        found = column.of(row)
    else:
        found = None
    if column.form == "text":
        return str(found or "")
    if found is None:
        return math.nan
    return float(str(found))


def loss_of(row: Row | ReferenceRow, column: Column) -> float:
    """Return what a row loses in a column, smaller is better; NaN where nothing is
    judged.

    Of a metric that aims at a value the mean of the scenarios' losses: beside and
    beyond do not cancel.
    """
    value = value_of(row, column)
    found = held(row, column.key)
    if column.direction is Direction.TARGET and found is not None:
        return mean(np.array([column.loss(one) for one in found.per_scenario]))
    if isinstance(value, str):
        return math.nan
    return column.loss(value)


def held(row: Row | ReferenceRow, key: str) -> Value | None:
    """Return the value of a metric, or the skill; None where a row has none."""
    if key == "skill" and isinstance(row, Row):
        return row.skill
    return row.values.get(key)


def written(value: float | str, form: str) -> str:
    """Return the text of a cell.

    >>> written(0.012345, "number"), written(1612345.0, "count"), written(17.25, "factor")
    ('0.0123', '1.61 M', '17.2×')
    """
    if isinstance(value, str):
        return value or MISSING
    if form == "count":
        return _count(value)
    said = text(value)
    if form == "factor" and math.isfinite(value):
        return f"{said}×"
    return said


def _count(value: float) -> str:
    """Return a whole number with at most three digits and what they stand for."""
    for unit, name in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if value >= 0.9995 * unit:
            return f"{text(value / unit)} {name}"
    return text(value)
