"""Tables of text that show a score card."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator

from lagbench.errors import format_count
from lagbench.figures.tables import Table
from lagbench.metrics.metric import Direction, Metric, mean
from lagbench.references.shipped import DIGITS
from lagbench.submission.issues import quote

from .card import BRIEF_ROWS, ScoreCard
from .front import Speedup
from .task import SUBMISSION

ARROWS = {
    Direction.LOWER: " ↓",
    Direction.HIGHER: " ↑",
    Direction.TARGET: " ◎",
    Direction.NONE: "",
}
"""Marks of the better side of a metric, behind its name."""

LEGEND = "↑ higher is better; ↓ lower is better; ◎ best at its perfect value"

FLAG_STATES = {True: "raised", False: "not raised", None: "unknown"}


def card_tables(card: ScoreCard) -> Iterator[Table]:
    """Yield tables over the horizon, at frames of interest and per scenario."""
    references = [row for row in card.scores if row != SUBMISSION]
    yield _over_horizon(card, list(card.submission), references)
    frames = card.reported_frames
    rows: list[tuple[str, ...]] = []
    for name, score in card.submission.items():
        if score.metric.per_frame:
            rows.append(
                (name, *(show_number(mean(score.at(frame))) for frame in frames))
            )
    title = f"{card.header.method} at frames, mean over scenarios"
    yield Table(title, ("metric", *map(str, frames)), tuple(rows))

    shown = [SUBMISSION, *references]
    columns = [card.scores[row][card.ranking].values.tolist() for row in shown]
    rows = []
    for i, *values in zip(card.scenarios, *columns, strict=True):
        rows.append((str(i), *map(show_number, values)))
    heads = ("scenario", *map(break_name, shown))
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
    """Return the table of scores over the horizon, the first reference first."""
    skill_cell = "-"
    best = None
    if card.skill is not None:
        skill_cell = with_interval(card.skill.value, card.skill.interval)
        best = card.skill.reference
    zeros = ["0" if row == best else "" for row in references]
    rows = [("skill ↑", *zeros[:1], skill_cell, *zeros[1:])]
    if isinstance(card.speedup, Speedup):
        empty = [""] * len(references)
        rows.append(("speedup ↑", *empty[:1], str(card.speedup), *empty[1:]))
    for name in names:
        score = card.submission[name]
        cell = with_interval(score.mean, score.interval)
        if any(score.undefined):
            cell += " †"
        means = []
        for row in references:
            reference = card.scores[row].get(name)
            means.append("-" if reference is None else show_number(reference.mean))
        rows.append((label_metric(score.metric), *means[:1], cell, *means[1:]))

    task = f"{card.data_name}, {card.config.horizon} frames"
    title = f"{card.header.method} on {task}, mean over scenarios"
    heads = [break_name(row) for row in references]
    own = f"{SUBMISSION} [95 %]"
    return Table(title, ("metric", *heads[:1], own, *heads[1:]), tuple(rows))


def label_metric(metric: Metric) -> str:
    """Return the name of a metric, the mark of its better side, and its unit."""
    label = f"{metric.name}{ARROWS[metric.direction]}"
    return label if metric.unit == "1" else f"{label} [{metric.unit}]"


def break_name(name: str) -> str:
    """Return a name as the head of a column, broken into lines at its hyphens."""
    return name.replace("-", "-\n")


def card_lines(card: ScoreCard, *, every: bool = False) -> Iterator[str]:
    """Yield the legend, undefined frames, comparisons, cost, flags and warnings.

    Args:
        card: the score card.
        every: whether all metrics, references and flags are meant; else those of the
            brief table, and raised flags.
    """
    names: Collection[str] = card.chosen_metrics[:BRIEF_ROWS]
    references = _best_reference(card)
    if every:
        names = card.submission
        references = [row for row in card.scores if row != SUBMISSION]
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
            f"cost: {show_number(card.header.seconds_per_frame)} s per frame on "
            f"{machine}; the predictions state it, and nothing was timed here"
        )
    if not isinstance(card.speedup, Speedup):
        yield f"speedup: none, because {card.speedup}"
    for flag in card.flags:
        if flag.raised or every:
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
        interval = f"{show_number(low)} to {show_number(high)}, "
    p = f"{format_count(len(comparison.scenarios), 'scenario')}: no p-value"
    if not math.isnan(comparison.p):
        p = f"p = {comparison.p:.3g}"
    return f"{card.ranking} {word} by {show_number(abs(difference))} ({interval}{p})"


def with_interval(value: float, interval: tuple[float, float]) -> str:
    """Return a number with its interval.

    >>> with_interval(0.5, (0.25, 0.75)), with_interval(0.5, (math.nan, math.nan))
    ('0.5 [0.25, 0.75]', '0.5')
    """
    low, high = interval
    if math.isnan(low):
        return show_number(value)
    return f"{value:.3g} [{low:.3g}, {high:.3g}]"


def show_number(value: float) -> str:
    """Return a number with four digits, a dash where it is undefined.

    >>> show_number(0.000123456), show_number(float("nan"))
    ('0.0001235', '-')
    """
    if math.isnan(value):
        return "-"
    return f"{value:.4g}"
