"""Tables of text that show a score card and a comparison."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator

from lagbench.errors import format_count
from lagbench.figures.tables import Table
from lagbench.metrics.metric import Direction, Metric, mean
from lagbench.metrics.significance import FEWEST_SCENARIOS
from lagbench.metrics.table import CHOSEN
from lagbench.references.shipped import DIGITS
from lagbench.submission.issues import quote

from .card import BRIEF_ROWS, ScoreCard
from .compare import ComparisonResult, MetricComparison
from .front import Speedup
from .task import SUBMISSION

SHOWN_AT_FRAMES = (
    "vorticity_mse",
    "vorticity_mae",
    "vorticity_rmse",
    "vorticity_pearson",
    "vorticity_kl",
    "vorticity_w1",
    "spectrum_error",
    "position_rmse",
    "attribute_mse",
    "energy_ratio",
    "outside_share",
    "sliced_w2",
)
"""Metrics in the table of frames of interest."""

ARROWS = {
    Direction.LOWER: " ↓",
    Direction.HIGHER: " ↑",
    Direction.TARGET: " ◎",
    Direction.NONE: "",
}
"""Marks of the better side of a metric, behind its name."""

LEGEND = "↑ higher is better; ↓ lower is better; ◎ best at its perfect value"

CHANCE = "?"
"""Mark of a difference that may be chance, behind better or worse."""

TOO_FEW = "too few"
"""What stands instead of better or worse where scenarios decide nothing."""

FLAG_STATES = {True: "raised", False: "not raised", None: "unknown"}


def card_tables(
    card: ScoreCard, *, every: bool = False, all_references: bool = False
) -> Iterator[Table]:
    """Yield tables over the horizon, at frames of interest and per scenario.

    Args:
        card: the score card.
        every: whether every metric is shown, not only the chosen ones.
        all_references: whether all references are shown beside the submission, not
            only the best one.
    """
    names = card.chosen_metrics
    frame_names = [name for name in SHOWN_AT_FRAMES if name in card.submission]
    if every:
        names = list(card.submission)
        frame_names = [name for name in names if card.submission[name].metric.per_frame]
    references = _best_reference(card)
    if all_references:
        references = [row for row in card.scores if row != SUBMISSION]

    yield _over_horizon(card, names, references)
    frames = card.reported_frames
    rows: list[tuple[str, ...]] = []
    for name in frame_names:
        score = card.submission[name]
        rows.append((name, *(_number(mean(score.at(frame))) for frame in frames)))
    title = f"{card.header.method} at frames, mean over scenarios"
    yield Table(title, ("metric", *map(str, frames)), tuple(rows))

    shown = [SUBMISSION, *references]
    columns = [card.scores[row][card.ranking].values.tolist() for row in shown]
    rows = []
    for i, *values in zip(card.scenarios, *columns, strict=True):
        rows.append((str(i), *map(_number, values)))
    heads = ("scenario", *map(_break_name, shown))
    yield Table(f"{card.ranking} per scenario", heads, tuple(rows))


def brief_table(card: ScoreCard) -> Table:
    """Return skill and the first metrics, beside the best reference."""
    return _over_horizon(card, card.chosen_metrics[:BRIEF_ROWS], _best_reference(card))


def _best_reference(card: ScoreCard) -> list[str]:
    """Return the reference of the skill, else the first one, else none."""
    if card.skill:
        return [card.skill.reference]
    return [row for row in card.scores if row != SUBMISSION][:1]


def _over_horizon(
    card: ScoreCard, names: Collection[str], references: Collection[str]
) -> Table:
    """Return the table of scores over the horizon."""
    skill_cell = "-"
    best = None
    if card.skill is not None:
        skill_cell = _with_interval(card.skill.value, card.skill.interval)
        best = card.skill.reference
    zeros = ["0" if row == best else "" for row in references]
    rows = [("skill ↑", skill_cell, *zeros)]
    if isinstance(card.speedup, Speedup):
        rows.append(("speedup ↑", str(card.speedup), *[""] * len(references)))
    for name in names:
        score = card.submission[name]
        cell = _with_interval(score.mean, score.interval)
        if any(score.undefined):
            cell += " †"
        means = []
        for row in references:
            reference = card.scores[row].get(name)
            means.append("-" if reference is None else _number(reference.mean))
        rows.append((_label(score.metric), cell, *means))

    task = f"{card.data_name}, {card.config.horizon} frames"
    title = f"{card.header.method} on {task}, mean over scenarios"
    heads = [_break_name(row) for row in references]
    return Table(title, ("metric", f"{SUBMISSION} [95 %]", *heads), tuple(rows))


def _label(metric: Metric) -> str:
    """Return the name of a metric, the mark of its better side, and its unit."""
    label = f"{metric.name}{ARROWS[metric.direction]}"
    return label if metric.unit == "1" else f"{label} [{metric.unit}]"


def _break_name(name: str) -> str:
    """Return a name as the head of a column, broken into lines at its hyphens."""
    return name.replace("-", "-\n")


def card_lines(
    card: ScoreCard, *, brief: bool = False, every: bool = False
) -> Iterator[str]:
    """Yield the legend, undefined frames, comparisons, cost, flags and warnings.

    Args:
        card: the score card.
        brief: whether only the best reference and raised flags are shown, as below
            the brief table.
        every: whether the undefined frames of all metrics are counted, not only those
            of the chosen ones.
    """
    names: Collection[str] = card.submission if every else card.chosen_metrics
    references = [row for row in card.scores if row != SUBMISSION]
    if brief:
        names = card.chosen_metrics[:BRIEF_ROWS]
        references = _best_reference(card)
    yield LEGEND
    undefined = []
    for name, score in card.submission.items():
        count = sum(score.undefined)
        if name in names and count:
            undefined.append(f"{name} {count}")
    if undefined:
        frames = len(card.scenarios) * card.config.horizon
        yield f"† frames without a value, of {frames}: {', '.join(undefined)}"
    for row in references:
        yield f"against {row}: {_against(card, row)}"
    if card.header.seconds_per_frame is not None:
        machine = "a machine without a name"
        if card.header.device:
            machine = quote(card.header.device)  # a stranger's text on a terminal
        yield (
            f"cost: {_number(card.header.seconds_per_frame)} s per frame on {machine}; "
            f"the predictions state it, and nothing was timed here"
        )
    if not isinstance(card.speedup, Speedup):
        yield f"speedup: none, because {card.speedup}"
    for flag in card.flags:
        if flag.raised or not brief:
            reasons = f": {'; '.join(flag.reasons)}" if flag.reasons else ""
            yield f"flag {flag.name}: {FLAG_STATES[flag.raised]}{reasons}"
    yield from map(str, card.warnings)


def _against(card: ScoreCard, row: str) -> str:
    """Return the result of the comparison with a reference."""
    comparison = card.against(row)
    difference = comparison.difference
    if math.isnan(difference):
        return f"{card.ranking} cannot be compared"
    # to the digits that references are shipped with
    rounding = 5.0 * 10.0**-DIGITS * abs(card.scores[row][card.ranking].mean)
    if abs(difference) <= rounding:
        return f"{card.ranking} is the same"

    # the printed bounds are those of the size of the difference
    low, high = comparison.interval
    word = "worse"
    if difference < 0.0:
        word = "better"
        low, high = (-bound for bound in reversed(comparison.interval))

    interval = ""
    if not math.isnan(low):
        interval = f"{_number(low)} to {_number(high)}, "
    p = f"{format_count(len(comparison.scenarios), 'scenario')}: no p-value"
    if not math.isnan(comparison.p):
        p = f"p = {comparison.p:.3g}"
    return f"{card.ranking} {word} by {_number(abs(difference))} ({interval}{p})"


def comparison_tables(
    result: ComparisonResult, *, every: bool = False
) -> Iterator[Table]:
    """Yield which method is better, then means with their units.

    The second column names the first method: it is better or worse than the second. The
    difference is that of the loss: below 0 where the first method is better, also
    where more of the metric is better. With ``every`` all metrics are shown, not only
    the chosen ones.
    """
    differences = []
    means = []
    for comparison in _shown_metrics(result, every=every):
        test = comparison.test
        metric = comparison.metric
        # no unit, so that four columns fit a terminal
        differences.append(
            (
                f"{metric.name}{ARROWS[metric.direction]}",
                _side(comparison),
                _with_interval(test.difference, test.interval),
                "-" if math.isnan(test.p) else f"{test.p:.3g}",
            )
        )
        cells = [_label(metric)]
        both = (comparison.first, comparison.second)
        for value, undefined in zip(both, comparison.undefined, strict=True):
            mark = f" †{undefined}" if undefined else ""
            cells.append(f"{_number(value)}{mark}")
        means.append(tuple(cells))
    first = _break_name(result.first)
    title = f"{result.first} against {result.second} on {result.split} {result.size}"
    heads = ("metric", f"{first}\nis", "loss difference [95 %]", "p")
    yield Table(title, heads, tuple(differences))
    yield Table("means", ("metric", first, _break_name(result.second)), tuple(means))


def comparison_lines(result: ComparisonResult, *, every: bool = False) -> Iterator[str]:
    """Yield the lines below the tables, which explain the marks that these have."""
    yield LEGEND
    yield (
        f"loss difference: {result.first} minus {result.second}; below 0 "
        f"{result.first} is better"
    )
    names = (result.first, result.second)
    for name, speedups in zip(names, result.speedups, strict=True):
        if any(speedups):
            yield f"speedup of {name}: {'; '.join(filter(None, speedups))}"
    shown = _shown_metrics(result, every=every)
    if any(any(comparison.undefined) for comparison in shown):
        yield "†: so many frames without a value"
    sides = [_side(comparison) for comparison in shown]
    if any(side.endswith(CHANCE) for side in sides):
        yield f"{CHANCE}: the test finds no difference at 5 %"
    if TOO_FEW in sides:
        yield f"{TOO_FEW}: under {FEWEST_SCENARIOS} scenarios nothing is decided"


def _shown_metrics(result: ComparisonResult, *, every: bool) -> list[MetricComparison]:
    """Return the metrics of the tables: the chosen ones, or all."""
    chosen = (result.ranking, *CHOSEN)
    return [one for name, one in result.metrics.items() if every or name in chosen]


def _side(comparison: MetricComparison) -> str:
    """Return whether the first method is better, and whether that may be chance."""
    side = comparison.side
    if side not in ("better", "worse"):
        return side
    if len(comparison.test.scenarios) < FEWEST_SCENARIOS:
        return TOO_FEW
    return side if comparison.test.significant else f"{side}{CHANCE}"


def _with_interval(value: float, interval: tuple[float, float]) -> str:
    """Return a number with its interval.

    >>> _with_interval(0.5, (0.25, 0.75)), _with_interval(0.5, (math.nan, math.nan))
    ('0.5 [0.25, 0.75]', '0.5')
    """
    low, high = interval
    if math.isnan(low):
        return _number(value)
    return f"{value:.3g} [{low:.3g}, {high:.3g}]"


def _number(value: float) -> str:
    """Return a number with four digits, a dash where it is undefined.

    >>> _number(0.000123456), _number(float("nan"))
    ('0.0001235', '-')
    """
    if math.isnan(value):
        return "-"
    return f"{value:.4g}"
