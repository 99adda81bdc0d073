"""Columns of the board's tables, the values of rows in them, and presets of columns."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lagbench.figures.numbers import MISSING, sentence, text, words
from lagbench.metrics.metric import Direction, Metric, mean

from .entry import EntryBudget, EntryCost, Level
from .model import BoardRow, ReferenceRow, Tab, Value

TableRow = BoardRow | ReferenceRow

MAIN_METRICS = 4
"""Metrics of the first table, the ranking one among them; with more it would be wider
than a screen.
"""

PRESETS: Mapping[str, tuple[str, ...]] = {
    "position": (
        "motion_distance",
        "cloud_distance",
        "position_rmse_20",
        "position_rmse",
        "position_mae",
        "velocity_rmse",
        "velocity_mae",
        "attribute_mse",
        "mse_avg",
        "mse_end",
        "sliced_w2",
        "sinkhorn",
        "sinkhorn_pot",
        "position_rmse_liquid",
        "position_rmse_jelly",
        "position_rmse_snow",
        "position_rmse_rope",
    ),
    "vorticity": (
        "vorticity_nrmse",
        "vorticity_rmse",
        "vorticity_mae",
        "vorticity_pearson",
        "stable_frames",
        "spectrum_error",
        "vorticity_residual_std",
        "vorticity_residual_max",
        "vorticity_residual_slope",
        "vorticity_kl",
        "vorticity_kl_hist",
        "vorticity_w1",
    ),
    "energy": (
        "energy_error",
        "energy_ratio",
        "energy_retention",
        "energy_retention_true",
        "energy_predicted",
        "energy_true",
    ),
    "conservation": (
        "momentum_error",
        "angular_momentum_error",
        "density_rmse",
        "divergence_rms",
        "divergence_rms_true",
        "shape_error",
        "connectivity",
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
        "cost_source",
        "solver_seconds_per_frame",
        "parameters",
        "device",
    ),
}
"""Columns by preset; those that a data set lacks are left out, the ranking one stands
first.
"""

COUNT_UNITS = ((1e9, "G"), (1e6, "M"), (1e3, "k"))


@dataclass(frozen=True, kw_only=True)
class Column:
    """One column."""

    key: str  # unique name, that of the metric where it shows one
    label: str
    unit: str = ""
    direction: Direction = Direction.NONE
    perfect: float | None = None
    form: str = "number"  # how cells are written: number, count, factor or text
    reported: bool = False  # stated by the submitter, computed again by nobody
    # of the cost of a frame, which is measured or stated: the column "time taken by"
    # says which
    of_cost: bool = False
    meaning: str
    # value of a row, where metric_value has none
    read: Callable[[TableRow], object] | None = None

    @property
    def quantity(self) -> str:
        """Label and unit, as an axis has them."""
        if self.unit:
            return f"{self.label} [{self.unit}]"
        return self.label

    def loss(self, value: float) -> float:
        """Return the value turned so that smaller is better; NaN where nothing is
        judged.
        """
        if self.direction is Direction.TARGET and self.perfect is not None:
            return abs(value - self.perfect)
        if self.direction is Direction.LOWER:
            return value
        if self.direction is Direction.HIGHER:
            return -value
        return math.nan


def cost_of(row: TableRow) -> EntryCost | None:
    """Return the cost of a frame: ours where we measured it, else the stated one."""
    if isinstance(row, ReferenceRow):
        return row.cost
    if row.verified is not None and row.verified.cost is not None:
        measured = row.verified.cost
        return EntryCost.model_construct(
            seconds_per_frame=measured.seconds_per_frame,
            device=measured.machine,
            solver_seconds_per_frame=measured.solver,
        )
    return row.entry.cost


def _read_cost(key: str) -> Callable[[TableRow], object]:
    """Return a function that reads a part of a row's cost."""
    return lambda row: getattr(cost_of(row), key, None)


def _read_entry(key: str) -> Callable[[TableRow], object]:
    """Return a function that reads a key of a row's entry."""

    def read(row: TableRow) -> object:
        if isinstance(row, ReferenceRow):
            return None
        return getattr(row.entry, key)

    return read


def _read_budget(key: str) -> Callable[[TableRow], object]:
    """Return a function that reads a part of a row's budget."""
    read_budget = _read_entry("budget")
    return lambda row: getattr(read_budget(row), key, None)


def _describe_budget(row: TableRow) -> str:
    """Return the computing time of one training in words."""
    if isinstance(row, ReferenceRow) or row.entry.budget is None:
        return ""
    budget: EntryBudget = row.entry.budget
    hours = []
    if budget.cpu_hours:
        hours.append(f"{text(budget.cpu_hours)} CPU h")
    if budget.gpu_hours:
        hours.append(f"{text(budget.gpu_hours)} GPU h")
    if hours:
        return " + ".join(hours)
    if budget.windows:
        return f"{_format_count(float(budget.windows))} windows"
    return ""


def _read_kind(row: TableRow) -> str:
    if isinstance(row, ReferenceRow):
        return str(row.kind)
    return str(row.entry.kind)


def _read_solver(row: TableRow) -> str | None:
    if isinstance(row, ReferenceRow):
        return None
    return row.solver


def _count_seeds(row: TableRow) -> int | None:
    if isinstance(row, ReferenceRow):
        return None
    return len(row.entry.predictions)


SHORT_LEVELS = {Level.REPRODUCED: "repr."}
"""Levels that have other names in narrow tables."""


def level_of(row: BoardRow) -> Level:
    """Return how far the maintainers followed the scores of an entry."""
    if row.verified is None:
        return Level.AS_SUBMITTED
    return row.verified.level


def describe_check(row: BoardRow, *, is_short: bool = False) -> str:
    """Return in words how far the scores of an entry were followed.

    Short texts are those of narrow tables, as in ``repr. 2/16``.
    """
    if row.verified is None:
        return str(Level.AS_SUBMITTED)
    level = row.verified.level
    reproductions = row.verified.reproduced
    reproduced = SHORT_LEVELS[Level.REPRODUCED] if is_short else str(Level.REPRODUCED)
    if any(not reproduction.agrees for reproduction in reproductions):
        return f"not {reproduced}"
    if level.rank < Level.REPRODUCED.rank and reproductions:
        seeds = len(row.entry.predictions)
        if is_short:
            return f"{reproduced} {len(reproductions)}/{seeds} seeds"
        return f"{len(reproductions)} of {seeds} seeds reproduced"
    name = SHORT_LEVELS.get(level, str(level)) if is_short else str(level)
    if reproductions and not row.verified.is_reproduced_wholly:
        least = min(reproductions, key=lambda reproduction: reproduction.scenarios)
        if is_short:
            return f"{name} {least.scenarios}/{least.of}"
        return f"{name}, {least.scenarios} of {least.of} scenarios"
    return name


def _describe_check(row: TableRow) -> str:
    if isinstance(row, ReferenceRow):
        return ""
    return describe_check(row)


SELF_REPORTED = "self-reported"
"""Source of a cost that the submitter states and nobody measured."""


def source_of_cost(row: TableRow) -> str:
    """Return who took the time of a frame; empty where nobody did."""
    if isinstance(row, ReferenceRow):
        return "measured" if row.cost else ""
    if row.verified is not None and row.verified.cost is not None:
        return "measured"
    return SELF_REPORTED if row.entry.cost else ""


def format_ranks(rank: int, ranks: tuple[int, int] | None) -> str:
    """Return a range of ranks, or the rank where nothing is claimed.

    >>> format_ranks(2, (1, 3)), format_ranks(2, (2, 2)), format_ranks(2, None)
    ('1–3', '2', '2')
    """
    if ranks is None or ranks[0] == ranks[1]:
        return str(rank)
    return f"{ranks[0]}–{ranks[1]}"


SKILL = Column(
    key="skill",
    label="skill",
    direction=Direction.HIGHER,
    perfect=1.0,
    meaning="1 - score / score of the best naive baseline, by the ranking metric: 0 is "
    "nothing learned, 1 perfect.",
)

AGAINST_CLASSICAL = Column(
    key="against_classical",
    label="÷ classical",
    direction=Direction.LOWER,
    meaning="Score over that of the best classical solver that costs no more per frame:"
    " below 1 the method is more accurate. Where every classical solver costs more, the"
    " cheapest one takes its place. Empty where the entry states no cost.",
)

HAS_GAPS = "†"
"""Behind a mean: some frames have no value."""

SOLVER_COSTS_MORE = "‡"
"""Behind a ratio to a classical solver that costs more than the model."""

SKILL_ON_SHIFT = Column(
    key="skill_on_shift",
    label="skill on shift",
    direction=Direction.HIGHER,
    perfect=1.0,
    meaning="Skill on the subset shift, which lies outside train on purpose; it does "
    "not rank.",
)

SCORE_ON_SHIFT = Column(
    key="score_on_shift",
    label="score on shift",
    direction=Direction.LOWER,
    meaning="The ranking metric on the subset shift, which lies outside train.",
)

ENTRY_COLUMNS = (
    Column(
        key="kind",
        label="kind",
        form="text",
        meaning="Naive: learns nothing and integrates no equations. Classical:"
        " integrates the equations. Learned: fitted to train. Hybrid: a solver with a"
        " learned part.",
        read=_read_kind,
    ),
    Column(
        key="solver",
        label="classical solver",
        form="text",
        meaning="The best classical solver that costs no more per frame. Where all cost"
        " more, the cheapest one.",
        read=_read_solver,
    ),
    Column(
        key="speed_up",
        label="speed\u2011up",
        form="factor",
        direction=Direction.HIGHER,
        of_cost=True,
        meaning="Time of the solver over that of the model per frame.",
        read=_read_cost("speed_up"),
    ),
    Column(
        key="seconds_per_frame",
        label="time per frame",
        unit="s",
        direction=Direction.LOWER,
        of_cost=True,
        meaning="Wall time of a frame of one scenario.",
        read=_read_cost("seconds_per_frame"),
    ),
    Column(
        key="cost_source",
        label="time taken by",
        form="text",
        meaning="Measured: we timed it on one core, an entry in one run with the "
        "simulator and the classical solvers. Self-reported: the submitter states it.",
        read=source_of_cost,
    ),
    Column(
        key="solver_seconds_per_frame",
        label="solver time per frame",
        unit="s",
        of_cost=True,
        meaning="On the same machine.",
        read=_read_cost("solver_seconds_per_frame"),
    ),
    Column(
        key="device",
        label="device",
        form="text",
        of_cost=True,
        meaning="Machine of both times.",
        read=_read_cost("device"),
    ),
    Column(
        key="parameters",
        label="parameters",
        form="count",
        reported=True,
        meaning="Trainable parameters of the model.",
        read=_read_entry("parameters"),
    ),
    Column(
        key="budget",
        label="budget",
        form="text",
        reported=True,
        meaning="Computing time of one training.",
        read=_describe_budget,
    ),
    Column(
        key="track",
        label="track",
        form="text",
        reported=True,
        meaning="Equal compute for all, or trained until it no longer helped.",
        read=_read_budget("track"),
    ),
    Column(
        key="windows",
        label="windows",
        form="count",
        reported=True,
        meaning="Training windows seen.",
        read=_read_budget("windows"),
    ),
    Column(
        key="epochs",
        label="epochs",
        reported=True,
        meaning="Passes over the training subset.",
        read=_read_budget("epochs"),
    ),
    Column(
        key="cpu_hours",
        label="CPU time",
        unit="h",
        reported=True,
        meaning="Of one training.",
        read=_read_budget("cpu_hours"),
    ),
    Column(
        key="gpu_hours",
        label="GPU time",
        unit="h",
        reported=True,
        meaning="Of one training.",
        read=_read_budget("gpu_hours"),
    ),
    Column(
        key="seeds",
        label="seeds",
        form="count",
        meaning="Trainings behind the row; with one it speaks of these weights only.",
        read=_count_seeds,
    ),
    Column(
        key="checked",
        label="scores",
        form="text",
        meaning="How far the maintainers followed the scores: as submitted (not at "
        "all), scored again from the submitter's predictions, or reproduced from "
        "the model.",
        read=_describe_check,
    ),
    Column(
        key="date",
        label="date",
        form="text",
        meaning="Of the submission.",
        read=_read_entry("date"),
    ),
)
"""Columns that show no metric."""


def comparisons_of(tab: Tab) -> tuple[Column, ...]:
    """Return the columns of a tab that compare with other methods or other data.

    Of the skill, the score divided by the classical one, and the skill on shift, those
    that a row has.
    """
    columns = []
    if any(row.skill is not None for row in tab.rows):
        columns.append(SKILL)
    if any(row.against_classical is not None for row in tab.rows):
        columns.append(AGAINST_CLASSICAL)
    if any(row.on_shift is not None for row in tab.rows):
        columns.append(SKILL_ON_SHIFT)
    return tuple(columns)


def columns_of(tab: Tab, metrics: Mapping[str, Metric]) -> dict[str, Column]:
    """Return all columns of a tab by key.

    The skill comes first, then the metrics to show at first, the other metrics, and the
    columns that show no metric.
    """
    columns = {column.key: column for column in comparisons_of(tab)}
    if SKILL_ON_SHIFT.key in columns:
        columns[SCORE_ON_SHIFT.key] = SCORE_ON_SHIFT
    for name in dict.fromkeys((*tab.columns, *metrics)):
        if any(name in row.values for row in tab.lines):
            columns[name] = _metric_column(metrics[name])
    for column in ENTRY_COLUMNS:
        columns[column.key] = column
    return columns


def _metric_column(metric: Metric) -> Column:
    """Return the column of a metric; the unit 1 is not shown."""
    unit = ""
    if metric.unit != "1":
        unit = metric.unit.replace("^2", "²")
    return Column(
        key=metric.name,
        label=words(metric.name),
        unit=unit,
        direction=metric.direction,
        perfect=metric.perfect,
        meaning=sentence(metric),
    )


def presets_of(tab: Tab, columns: Mapping[str, Column]) -> dict[str, tuple[str, ...]]:
    """Return the keys of each preset that has something to show, main first, all
    last.
    """
    metric_count = MAIN_METRICS
    # main fits into 1280 pixels
    if AGAINST_CLASSICAL.key in columns:
        metric_count -= 1
    if SKILL_ON_SHIFT.key in columns:
        metric_count -= 1
    main = (
        "against_classical",
        "skill_on_shift",
        *tab.columns[:metric_count],
        "kind",
        "seconds_per_frame",
        "cost_source",
        "checked",
    )
    keys_by_name = {"main": main, **PRESETS, "all": tuple(columns)}
    presets = {}
    for name, keys in keys_by_name.items():
        if columns.keys().isdisjoint(keys):
            continue
        shown_keys = {"skill", tab.ranking, *keys}
        shown_columns = []
        for key in columns:
            if key in shown_keys:
                shown_columns.append(key)
        presets[name] = tuple(shown_columns)
    return presets


def value_of(row: TableRow, column: Column) -> float | str:
    """Return the value of a row in a column; NaN or an empty text where it has none."""
    value = metric_value(row, column.key)
    if value is not None:
        return value.mean
    content = None
    if column.read is not None:
        content = column.read(row)
    if column.form == "text":
        return str(content or "")
    if content is None:
        return math.nan
    return float(str(content))


def loss_of(row: TableRow, column: Column) -> float:
    """Return the loss of a row in a column, smaller is better; NaN where nothing is
    judged.

    Where the metric aims at a value, the loss is the mean over scenarios of their
    distances from it: values below and above do not cancel.
    """
    value = value_of(row, column)
    metric = metric_value(row, column.key)
    if column.direction is Direction.TARGET and metric is not None:
        losses = []
        for scenario_mean in metric.per_scenario:
            losses.append(column.loss(scenario_mean))
        return mean(np.array(losses))
    if isinstance(value, str):
        return math.nan
    return column.loss(value)


def is_beside_dearer_solver(row: TableRow) -> bool:
    """Tell whether a row is compared with a solver that costs more than the model."""
    if isinstance(row, ReferenceRow) or row.against_classical is None:
        return False
    return row.solver_costs_more


def metric_value(row: TableRow, key: str) -> Value | None:
    """Return a metric, a skill or a ratio, with interval; None where a row has none."""
    if row.on_shift is not None:
        if key == SKILL_ON_SHIFT.key:
            return row.on_shift.skill
        if key == SCORE_ON_SHIFT.key:
            return row.on_shift.score
    if key == SKILL.key:
        return row.skill
    if isinstance(row, BoardRow) and key == AGAINST_CLASSICAL.key:
        return row.against_classical
    return row.values.get(key)


def format_value(value: float | str, form: str) -> str:
    """Return the text of a cell.

    >>> format_value(0.012345, "number"), format_value(1612345.0, "count")
    ('0.0123', '1.61 M')
    >>> format_value(17.25, "factor")
    '17.2×'
    """
    if isinstance(value, str):
        return value or MISSING
    if form == "count":
        return _format_count(value)
    if form == "factor" and math.isfinite(value):
        return f"{text(value)}×"
    return text(value)


def _format_count(value: float) -> str:
    """Return the text of a count: at most three digits, and a unit of counts."""
    for factor, name in COUNT_UNITS:
        if value >= 0.9995 * factor:
            return f"{text(value / factor)} {name}"
    return text(value)


def leader_of(rows: Sequence[BoardRow]) -> BoardRow | None:
    """Return the first ranked row; None where nothing is ranked."""
    for row in rows:
        if row.rank is not None:
            return row
    return None
