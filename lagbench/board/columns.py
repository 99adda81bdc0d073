"""Columns of the board's tables and the presets that choose among them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from lagbench.metrics import Direction, Metric
from lagbench.report.html import sentence, text, words

from .model import Row, Tab

__all__ = ["COSTS", "Column", "columns_of", "metric_column", "presets_of", "value_of", "written"]

MAIN_METRICS = 7
"""Metrics of the first table; with more it would be wider than a screen."""

MAIN_COSTS = ("speed_up", "parameters")

PRESETS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "position": (
            *("position_rmse", "position_mae", "velocity_rmse", "velocity_mae"),
            *("attribute_mse", "mse_avg", "mse_end", "sliced_w2", "sinkhorn"),
            *(f"position_rmse_{material}" for material in ("liquid", "jelly", "snow", "rope")),
        ),
        "vorticity": (
            *("vorticity_rmse", "vorticity_mae", "vorticity_pearson", "stable_frames"),
            *("vorticity_residual_std", "vorticity_residual_max", "vorticity_residual_slope"),
            *("vorticity_kl", "vorticity_kl_hist", "vorticity_w1"),
        ),
        "energy": (
            *("energy_error", "energy_ratio", "energy_retention", "energy_retention_true"),
            *("energy_predicted", "energy_true"),
        ),
        "conservation": (
            *("momentum_error", "angular_momentum_error", "density_rmse"),
            *("divergence_rms", "divergence_rms_true", "shape_error", "connectivity"),
        ),
    }
)
"""Metrics by preset; those that a data set lacks are left out, the ranking one stands first."""


@dataclass(frozen=True, kw_only=True)
class Column:
    """One column."""

    key: str  # unique name, that of the metric where it shows one
    label: str  # heading
    unit: str = ""  # unit, empty for pure numbers
    direction: Direction = Direction.NONE  # what better means
    perfect: float | None = None  # value of a perfect prediction, None where it depends
    form: str = "number"  # how cells are written: "number", "count", "factor" or "text"
    reported: bool = False  # whether the submitter says it and nothing can compute it again
    meaning: str  # what it says, one or two sentences


REPORTED = "Self-reported: said by the submitter, computed again by nobody."

COSTS = (
    Column(
        key="speed_up",
        label="speed\u2011up",
        direction=Direction.HIGHER,
        form="factor",
        reported=True,
        meaning=f"Time of the solver over time of the model per frame, both on the same machine: below 1×"
        f" the model is slower than the solver. {REPORTED}",
    ),
    Column(
        key="seconds_per_frame",
        label="time per frame",
        unit="s",
        direction=Direction.LOWER,
        reported=True,
        meaning=f"Wall time of one predicted frame of one scenario. {REPORTED}",
    ),
    Column(
        key="solver_seconds_per_frame",
        label="solver time per frame",
        unit="s",
        reported=True,
        meaning=f"Wall time of one frame of the solver on the same machine. {REPORTED}",
    ),
    Column(
        key="parameters",
        label="parameters",
        form="count",
        reported=True,
        meaning=f"Trainable parameters of the model. {REPORTED}",
    ),
    Column(key="seeds", label="seeds", form="count", meaning="Trainings behind the row."),
    Column(
        key="device",
        label="device",
        form="text",
        reported=True,
        meaning=f"Machine of both times. {REPORTED}",
    ),
    Column(key="date", label="date", form="text", meaning="When the entry was submitted."),
)
"""Columns that no metric stands behind."""


def metric_column(metric: Metric) -> Column:
    """Return the column of a metric."""
    return Column(
        key=metric.name,
        label=words(metric.name),
        unit="" if metric.unit == "1" else metric.unit.replace("^2", "²"),
        direction=metric.direction,
        perfect=metric.perfect,
        meaning=sentence(metric),
    )


def columns_of(tab: Tab, metrics: Mapping[str, Metric]) -> tuple[str, ...]:
    """Return the keys of all columns that a tab can show: metrics in the table's order, then costs."""
    found = {name for row in tab.rows for name in row.values}
    return (*(name for name in metrics if name in found), *(column.key for column in COSTS))


def presets_of(tab: Tab, metrics: Mapping[str, Metric]) -> dict[str, tuple[str, ...]]:
    """Return the keys of each preset that has something to show, main first, all last."""
    known = columns_of(tab, metrics)
    costs = tuple(column.key for column in COSTS)
    chosen = {"main": (*tab.columns[:MAIN_METRICS], *MAIN_COSTS), **PRESETS, "cost": costs, "all": known}
    presets = {}
    for name, keys in chosen.items():
        if any(key in known for key in keys):
            wanted = dict.fromkeys((tab.ranking, *keys))
            presets[name] = tuple(key for key in wanted if key in known)
    return presets


def value_of(row: Row, key: str) -> float | str:
    """Return what a row has in a column; NaN where it has nothing."""
    if key in row.values:
        return row.values[key].mean
    if key == "date":
        return row.date
    if key == "device":
        return row.cost.device if row.cost else ""
    if key == "seeds":
        return math.nan if row.floor else float(row.seeds)
    found = row.parameters if key == "parameters" else getattr(row.cost, key, None)
    return math.nan if found is None else float(found)


def written(value: float | str, form: str) -> str:
    """Return the text of a cell.

    >>> written(0.012345, "number"), written(1612345.0, "count"), written(17.25, "factor")
    ('0.0123', '1.61 M', '17.2×')
    """
    if isinstance(value, str):
        return value
    if form == "count":
        return _count(value)
    said = text(value)
    return f"{said}×" if form == "factor" and math.isfinite(value) else said


def _count(value: float) -> str:
    """Return a whole number with at most three digits and what they stand for."""
    for unit, name in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if value >= 0.9995 * unit:
            return f"{text(value / unit)} {name}"
    return text(value)
