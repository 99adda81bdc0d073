"""Columns of the board's tables: for each its name, meaning, value and text."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

from lagbench.metrics.metric import Direction, Metric
from lagbench.metrics.table import METRICS

from .rows import Row, Value
from .verified import Level

METRIC_GROUPS = {
    "position": (
        *("cloud_distance", "position_rmse_20", "position_rmse", "velocity_rmse"),
        *("mse_avg", "mse_end", "sliced_w2", "sinkhorn"),
    ),
    "vorticity": (
        *("vorticity_nrmse", "vorticity_rmse", "vorticity_pearson", "stable_frames"),
        *("spectrum_error", "vorticity_residual_std", "vorticity_kl", "vorticity_w1"),
    ),
    "energy and conservation": (
        *("energy_error", "energy_ratio", "momentum_error", "density_rmse"),
        *("divergence_rms", "shape_error", "connectivity"),
    ),
}
"""Metrics of the tables, by group; those that a data set lacks are left out."""

SHOWN_METRICS = frozenset(name for group in METRIC_GROUPS.values() for name in group)

REPORTED = "*"
"""Behind a time of a frame that only the submitter took."""

NOTHING = "–"


@dataclass(frozen=True, kw_only=True)
class Cell:
    """What a column shows of a row."""

    text: str
    order: float = math.nan  # by which rows are sorted; NaN without a value
    note: str = ""  # in a second, smaller line


@dataclass(frozen=True, kw_only=True)
class Column:
    """One column."""

    key: str
    label: str
    group: str
    meaning: str
    read: Callable[[Row], Cell]
    # direction in which values are better; NONE where nothing is judged
    direction: Direction = Direction.NONE
    perfect: float | None = None

    def loss(self, order: float) -> float:
        """Return a value turned so that smaller is better; NaN without a judgement."""
        if self.direction is Direction.TARGET and self.perfect is not None:
            return abs(order - self.perfect)
        if self.direction is Direction.LOWER:
            return order
        if self.direction is Direction.HIGHER:
            return -order
        return math.nan


def format_number(value: float | None, digits: int = 3) -> str:
    """Return a number with so many significant digits.

    >>> format_number(0.012345), format_number(123456.0), format_number(None)
    ('0.0123', '1.23e+05', '–')
    """
    if value is None or math.isnan(value):
        return NOTHING
    if math.isinf(value):
        return "∞"
    if 1e3 <= abs(value) < 1e5:
        return f"{value:.0f}"
    return f"{value:.{digits}g}"


def value_cell(value: Value | None) -> Cell:
    """Return a value with its 95 % interval."""
    if value is None or math.isnan(value.mean):
        return Cell(text=NOTHING)
    note = ""
    if not math.isnan(value.low + value.high):
        note = f"{format_number(value.low)} … {format_number(value.high)}"
    return Cell(text=format_number(value.mean), order=value.mean, note=note)


def _rank(row: Row) -> Cell:
    if row.rank is None:
        return Cell(text="")
    text = f"{row.rank} ≈" if row.tied else str(row.rank)
    note = ""
    if row.rank_range is not None and row.rank_range[0] < row.rank_range[1]:
        note = f"{row.rank_range[0]}–{row.rank_range[1]}"
    return Cell(text=text, order=row.rank, note=note)


def _method(row: Row) -> Cell:
    notes = [str(row.kind)]
    if row.failed_gates:
        notes.append("under-trained")
    if row.diverged:
        notes.append(f"{row.diverged} diverged")
    notes += row.flags
    return Cell(text=row.name, note=", ".join(notes))


def _speedup(row: Row) -> Cell:
    if row.speedup is None:
        return Cell(text=NOTHING if row.entry is not None else "")
    low, high = row.speedup.interval
    cell = value_cell(Value(mean=row.speedup.value, low=low, high=high))
    return replace(cell, text="> " + cell.text) if row.speedup.at_least else cell


def _breakeven(row: Row) -> Cell:
    if row.breakeven is None:
        return Cell(text=NOTHING if row.entry is not None else "")
    if math.isinf(row.breakeven):
        return Cell(text="never", order=math.inf)
    return Cell(text=format_number(row.breakeven), order=row.breakeven)


def _milliseconds(row: Row) -> Cell:
    if row.seconds is None:
        return Cell(text=NOTHING)
    milliseconds = 1e3 * row.seconds
    is_reported = row.entry is not None and (
        row.verified is None or row.verified.cost is None
    )
    text = format_number(milliseconds)
    return Cell(text=text + (REPORTED if is_reported else ""), order=milliseconds)


def describe_check(row: Row) -> str:
    """Return how far the maintainers followed the scores of an entry."""
    if row.entry is None:
        return ""
    if row.verified is None:
        return str(Level.AS_SUBMITTED)
    models = row.verified.reproduced
    if any(not model.agrees for model in models):
        return "not reproduced"
    text = str(row.verified.level)
    if models and not row.verified.is_complete:
        least = min(models, key=lambda model: model.scenarios)
        text += f", {least.scenarios} of {least.of} scenarios"
    return text


def _parameters(row: Row) -> Cell:
    if row.entry is None or row.entry.parameters is None:
        return Cell(text="")
    count = row.entry.parameters
    text = str(count)
    if count >= 10_000:
        text = f"{count / 1e6:.2g} M" if count >= 1e6 else f"{count / 1e3:.0f} k"
    return Cell(text=text, order=float(count))


def _seeds(row: Row) -> Cell:
    if row.entry is None:
        return Cell(text="")
    return Cell(text=str(len(row.seeds)), order=float(len(row.seeds)))


def _training(row: Row) -> Cell:
    if row.entry is None or row.entry.budget is None:
        return Cell(text="")
    budget = row.entry.budget
    hours = (budget.cpu_hours or 0.0) + (budget.gpu_hours or 0.0)
    if not hours:
        return Cell(text="", note=budget.track or "")
    where = "GPU h" if budget.gpu_hours else "h"
    text = f"{format_number(hours, 2)} {where}"
    return Cell(text=text, order=hours, note=budget.track or "")


MAIN_COLUMNS = (
    Column(
        key="rank",
        label="rank",
        group="main",
        meaning="Entries that differ by less than the truth error share a rank. Below "
        "it: the range in 95 % of the resamples. ≈: cannot be told from the leader.",
        read=_rank,
    ),
    Column(
        key="method",
        label="method",
        group="",
        meaning="Shaded rows are reference predictors, which have no rank.",
        read=_method,
    ),
    Column(
        key="score",
        label="score",
        group="main",
        meaning="The metric that ranks, and its 95 % interval.",
        read=lambda row: value_cell(row.score),
        direction=Direction.LOWER,
    ),
    Column(
        key="skill",
        label="skill",
        group="main",
        meaning="1 - score / score of the best naive baseline.",
        read=lambda row: value_cell(row.skill),
        direction=Direction.HIGHER,
    ),
    Column(
        key="milliseconds",
        label="ms per frame",
        group="main",
        meaning="Processor time of a frame on one core, all rows in one run. *: stated "
        "by the submitter.",
        read=_milliseconds,
    ),
    Column(
        key="speedup",
        label="speedup",
        group="main",
        meaning="Cost of the classical side at the method's error / cost of the method."
        " >: no classical row is as accurate. Learning pays where the interval of a "
        "model is above 1.5.",
        read=_speedup,
    ),
    Column(
        key="breakeven",
        label="break-even",
        group="main",
        meaning="Scenarios to predict before the model was worth its training and the "
        "data for it.",
        read=_breakeven,
    ),
    Column(
        key="shift",
        label="skill on shift",
        group="main",
        meaning="Skill on the subset shift, which lies outside train on purpose.",
        read=lambda row: value_cell(row.shift_skill),
        direction=Direction.HIGHER,
    ),
    Column(
        key="parameters",
        label="parameters",
        group="training",
        meaning="Trainable parameters, as the submitter states.",
        read=_parameters,
    ),
    Column(
        key="seeds",
        label="seeds",
        group="training",
        meaning="Trainings behind the row; with one it speaks of these weights only.",
        read=_seeds,
    ),
    Column(
        key="training",
        label="training",
        group="training",
        meaning="Processor time of one training, as the submitter states.",
        read=_training,
    ),
    Column(
        key="checked",
        label="checked",
        group="training",
        meaning="As submitted, scored again from the predictions, or reproduced from "
        "the model by the maintainers.",
        read=lambda row: Cell(text=describe_check(row)),
    ),
)


def metric_column(metric: Metric, group: str) -> Column:
    """Return the column of a metric."""
    label = metric.name.replace("_", " ")
    if metric.unit != "1":
        label += f" [{metric.unit}]"
    return Column(
        key=metric.name,
        label=label,
        group=group,
        meaning=metric.summary,
        read=lambda row: value_cell(row.metrics.get(metric.name)),
        direction=metric.direction,
        perfect=metric.perfect,
    )


def columns_of(rows: Iterable[Row]) -> list[Column]:
    """Return the columns of a table: those for which any row has something to show."""
    rows = list(rows)
    columns = list(MAIN_COLUMNS)
    for group, names in METRIC_GROUPS.items():
        for name in names:
            if name in METRICS:
                columns.append(metric_column(METRICS[name], group))
    shown = []
    for column in columns:
        cells = [column.read(row) for row in rows]
        if any(cell.text not in ("", NOTHING) for cell in cells):
            shown.append(column)
    return shown


def best_of(column: Column, rows: Iterable[Row]) -> set[str]:
    """Return the ids of the rows with the best value of a column."""
    losses = {row.id: column.loss(column.read(row).order) for row in rows}
    known = [loss for loss in losses.values() if not math.isnan(loss)]
    if not known:
        return set()
    return {name for name, loss in losses.items() if loss == min(known)}
