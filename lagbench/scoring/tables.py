"""Tables of text that show a score card and a comparison."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence

from lagbench.errors import format_count
from lagbench.figures.tables import Table
from lagbench.metrics.metric import Direction, Metric, mean
from lagbench.metrics.significance import FEWEST_SCENARIOS
from lagbench.metrics.table import CHOSEN
from lagbench.references.shipped import DIGITS
from lagbench.submission.issues import quote

from .card import BRIEF_ROWS, ScoreCard
from .compare import ComparisonResult, MetricComparison
from .flags import Flag
from .front import Speedup
from .scenario import SUBMISSION

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
    if every:
        names = list(card.submission)
        frame_names = []
        for name in names:
            if card.submission[name].metric.per_frame:
                frame_names.append(name)
    else:
        frame_names = []
        for name in SHOWN_AT_FRAMES:
            if name in card.submission:
                frame_names.append(name)

    references = _best_reference(card)
    if all_references:
        references = [row for row in card.scores if row != SUBMISSION]

    yield _over_horizon(card, names, references)
    yield _at_frames(card, frame_names)
    yield _per_scenario(card, [SUBMISSION, *references])


def _best_reference(card: ScoreCard) -> list[str]:
    """Return the reference of the skill, else the first one, else none."""
    if card.skill:
        return [card.skill.reference]
    references = [row for row in card.scores if row != SUBMISSION]
    return references[:1]


def brief_table(card: ScoreCard) -> Table:
    """Return skill and the first metrics, beside the best reference."""
    names = card.chosen_metrics[:BRIEF_ROWS]
    return _over_horizon(card, names, _best_reference(card))


def brief_lines(card: ScoreCard) -> Iterator[str]:
    """Yield the lines below the brief table: comparison, raised flags, warnings."""
    yield LEGEND
    yield from _undefined_lines(card, card.chosen_metrics[:BRIEF_ROWS])
    for row in _best_reference(card):
        yield f"against {row}: {_against(card, row)}"
    yield from _cost_lines(card)
    if not isinstance(card.speedup, Speedup):
        yield f"speedup: none, because {card.speedup}"
    for flag in card.flags:
        if flag.raised:
            yield _flag_line(flag)
    yield from _warning_lines(card)


def _over_horizon(
    card: ScoreCard, names: Collection[str], references: Collection[str]
) -> Table:
    """Return the table of scores over the horizon."""
    skill_cell = "-"
    best = None
    if card.skill is not None:
        skill_cell = _with_interval(card.skill.value, card.skill.interval)
        best = card.skill.reference
    zeros = []
    for row in references:
        zeros.append("0" if row == best else "")
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
            means.append(_mean_cell(card, row, name))
        rows.append((_label(score.metric), cell, *means))

    task = f"{card.data_name}, {card.config.horizon} frames"
    title = f"{card.header.method} on {task}, mean over scenarios"
    heads = [_break_name(row) for row in references]
    return Table(title, ("metric", f"{SUBMISSION} [95 %]", *heads), tuple(rows))


def _mean_cell(card: ScoreCard, row: str, name: str) -> str:
    if name not in card.scores[row]:
        return "-"
    return _number(card.scores[row][name].mean)


def _at_frames(card: ScoreCard, names: Collection[str]) -> Table:
    """Return the table of scores at the frames of interest."""
    frames = card.reported_frames
    rows: list[tuple[str, ...]] = []
    for name in names:
        score = card.submission[name]
        cells = []
        for frame in frames:
            cells.append(_number(mean(score.at(frame))))
        rows.append((name, *cells))
    title = f"{card.header.method} at frames, mean over scenarios"
    return Table(title, ("metric", *map(str, frames)), tuple(rows))


def _per_scenario(card: ScoreCard, shown: Sequence[str]) -> Table:
    """Return the table of the ranking metric by scenario."""
    columns = []
    for row in shown:
        columns.append(card.scores[row][card.ranking].values.tolist())
    rows: list[tuple[str, ...]] = []
    for i, *values in zip(card.scenarios, *columns, strict=True):
        rows.append((str(i), *map(_number, values)))
    heads = ("scenario", *map(_break_name, shown))
    return Table(f"{card.ranking} per scenario", heads, tuple(rows))


def _label(metric: Metric) -> str:
    """Return the name of a metric, the mark of its better side, and its unit."""
    label = f"{metric.name}{ARROWS[metric.direction]}"
    if metric.unit == "1":
        return label
    return f"{label} [{metric.unit}]"


def _break_name(name: str) -> str:
    """Return a name as the head of a column, broken into lines at its hyphens."""
    return "-\n".join(name.split("-"))


def flag_lines(card: ScoreCard, *, every: bool = False) -> Iterator[str]:
    """Yield the legend, undefined frames, comparisons, flags and warnings, by line.

    With ``every`` the undefined frames of all metrics are counted, not only those of
    the chosen ones: as the tables show them.
    """
    names: Collection[str] = card.chosen_metrics
    if every:
        names = card.submission
    yield LEGEND
    yield from _undefined_lines(card, names)
    for row in card.scores:
        if row != SUBMISSION:
            yield f"against {row}: {_against(card, row)}"
    yield from _cost_lines(card)
    if not isinstance(card.speedup, Speedup):
        yield f"speedup: none, because {card.speedup}"
    for flag in card.flags:
        yield _flag_line(flag)
    yield from _warning_lines(card)


def _undefined_lines(card: ScoreCard, names: Collection[str]) -> Iterator[str]:
    """Yield the line that counts frames without a value, if there are any."""
    undefined = []
    for name, score in card.submission.items():
        count = sum(score.undefined)
        if name in names and count:
            undefined.append(f"{name} {count}")
    if undefined:
        frames = len(card.scenarios) * card.config.horizon
        yield f"† frames without a value, of {frames}: {', '.join(undefined)}"


def _cost_lines(card: ScoreCard) -> Iterator[str]:
    """Yield the cost that predictions state, if they do."""
    header = card.header
    if header.seconds_per_frame is None:
        return
    machine = "a machine without a name"
    if header.device:
        machine = quote(header.device)  # a stranger's text on a terminal
    yield (
        f"cost: {_number(header.seconds_per_frame)} s per frame on {machine}; the "
        f"predictions state it, and nothing was timed here"
    )


def _flag_line(flag: Flag) -> str:
    line = f"flag {flag.name}: {FLAG_STATES[flag.raised]}"
    if flag.reasons:
        line += f": {'; '.join(flag.reasons)}"
    return line


def _warning_lines(card: ScoreCard) -> Iterator[str]:
    for warning in card.warnings:
        place = ""
        if warning.where not in warning.got:
            place = f" ({warning.where})"
        yield f"warning [{warning.check}] {warning.what}{place}: {warning.got}"
        if warning.fix:
            yield f"  fix: {warning.fix}"


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
    shown = _shown_metrics(result, every=every)
    title = f"{result.first} against {result.second} on {result.split} {result.size}"
    yield Table(
        title,
        ("metric", f"{_break_name(result.first)}\nis", "loss difference [95 %]", "p"),
        tuple(_difference_row(comparison) for comparison in shown),
    )
    yield Table(
        "means",
        ("metric", _break_name(result.first), _break_name(result.second)),
        tuple(_means_row(comparison) for comparison in shown),
    )


def comparison_lines(result: ComparisonResult, *, every: bool = False) -> Iterator[str]:
    """Yield the lines below the tables, which explain the marks that these have."""
    yield LEGEND
    yield (
        f"loss difference: {result.first} minus {result.second}; below 0 "
        f"{result.first} is better"
    )
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
    shown = []
    for name, comparison in result.metrics.items():
        if every or name in chosen:
            shown.append(comparison)
    return shown


def _difference_row(comparison: MetricComparison) -> tuple[str, ...]:
    """Return the row of a metric: name, better or worse, difference, p-value.

    It has no unit, so that four columns fit a terminal.
    """
    test = comparison.test
    p = "-"
    if not math.isnan(test.p):
        p = f"{test.p:.3g}"
    difference = _with_interval(test.difference, test.interval)
    metric = comparison.metric
    label = f"{metric.name}{ARROWS[metric.direction]}"
    return (label, _side(comparison), difference, p)


def _side(comparison: MetricComparison) -> str:
    """Return whether the first method is better, and whether that may be chance."""
    side = comparison.side
    if side not in ("better", "worse"):
        return side
    if len(comparison.test.scenarios) < FEWEST_SCENARIOS:
        return TOO_FEW
    if not comparison.test.significant:
        return f"{side}{CHANCE}"
    return side


def _means_row(comparison: MetricComparison) -> tuple[str, ...]:
    first_undefined, second_undefined = comparison.undefined
    return (
        _label(comparison.metric),
        _with_undefined(comparison.first, first_undefined),
        _with_undefined(comparison.second, second_undefined),
    )


def _with_undefined(value: float, undefined: int) -> str:
    """Return a mean with the number of frames that are left out of it."""
    if undefined:
        return f"{_number(value)} †{undefined}"
    return _number(value)


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
