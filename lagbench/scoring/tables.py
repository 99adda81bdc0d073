"""What a score card and a comparison print, as tables of text."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator
from dataclasses import dataclass

from lagbench.metrics.aggregate import Score
from lagbench.metrics.metric import Direction, mean
from lagbench.metrics.table import CHOSEN

from .card import ScoreCard
from .compare import ComparisonResult
from .scenario import SUBMISSION

__all__ = [
    "Table",
    "card_tables",
    "comparison_table",
    "flag_lines",
    "skill_line",
]


SHOWN_AT_FRAMES = (
    *("vorticity_mse", "vorticity_mae", "vorticity_rmse", "vorticity_pearson", "vorticity_kl"),
    *("vorticity_w1", "spectrum_error", "position_rmse", "attribute_mse", "energy_ratio"),
    *("outside_share", "sliced_w2"),
)
"""Metrics in the table of frames of interest."""

ARROWS = {Direction.LOWER: "lower", Direction.HIGHER: "higher", Direction.TARGET: "to", Direction.NONE: ""}


@dataclass(frozen=True)
class Table:
    """A table of text."""

    title: str  # what it shows
    columns: tuple[str, ...]  # names of the columns
    rows: tuple[tuple[str, ...], ...]  # cells, row by row


def card_tables(card: ScoreCard, *, every: bool = False) -> Iterator[Table]:
    """Yield the tables of a score card: over the horizon, at frames of interest, per scenario.

    Args:
        card: the score card.
        every: whether to show all metrics instead of the chosen ones.
    """
    names = list(card.submission) if every else _ranked_first(card, CHOSEN)
    at_frames = [n for n in names if card.submission[n].metric.per_frame] if every else SHOWN_AT_FRAMES
    task = f"{card.header.split} {card.header.size}, {card.setting.horizon} frames"
    yield _over_horizon(card, names, f"{card.header.method} on {task}, mean over scenarios")
    yield _at_frames(card, at_frames, f"{card.header.method} at frames, mean over scenarios")
    yield _per_scenario(card)


def _ranked_first(card: ScoreCard, names: Collection[str]) -> list[str]:
    ordered = dict.fromkeys((card.ranking, *names))
    return [name for name in ordered if name in card.submission]


def _over_horizon(card: ScoreCard, names: Collection[str], title: str) -> Table:
    floors = [row for row in card.scores if row != SUBMISSION]
    rows = [_skill_row(card, len(floors))]
    for name in names:
        score = card.submission[name]
        undefined = sum(score.undefined)
        rows.append(
            (
                name,
                _number(score.mean),
                _interval(score),
                *(
                    _number(card.scores[row][name].mean) if name in card.scores[row] else "-"
                    for row in floors
                ),
                _better(score),
                f"{undefined} of {len(score.scenarios) * len(score.frames)}" if undefined else "",
                score.metric.unit,
            )
        )
    heads = (row.replace("-", "-\n") for row in floors)  # narrow enough for 120 characters
    columns = ("metric", SUBMISSION, "95 % interval", *heads, "better", "undefined", "unit")
    return Table(title, columns, tuple(rows))


def _skill_row(card: ScoreCard, floors: int) -> tuple[str, ...]:
    found = card.skill
    if found is None:
        return ("skill", "-", "", *("" for _ in range(floors)), "higher", "", "1")
    low, high = found.interval
    interval = "" if math.isnan(low) else f"{low:.3g} to {high:.3g}"
    return ("skill", _number(found.value), interval, *("" for _ in range(floors)), "higher", "", "1")


def skill_line(card: ScoreCard) -> str:
    """Return the skill in one line."""
    found = card.skill
    if found is None:
        return "skill: undefined, no floor that counts has a score"
    low, high = found.interval
    interval = "" if math.isnan(low) else f" ({low:.3g} to {high:.3g})"
    return f"skill {found.value:.3g}{interval}: 1 - {found.metric} / {found.metric} of {found.floor}"


def _at_frames(card: ScoreCard, names: Collection[str], title: str) -> Table:
    frames = card.reported_frames
    rows = [
        (name, *(_number(mean(card.submission[name].at(frame))) for frame in frames))
        for name in names
        if name in card.submission
    ]
    return Table(title, ("metric", *map(str, frames)), tuple(rows))


def _per_scenario(card: ScoreCard) -> Table:
    rows = [
        (row, *(_number(value) for value in scores[card.ranking].values.tolist()))
        for row, scores in card.scores.items()
    ]
    return Table(f"{card.ranking} per scenario", ("row", *map(str, card.scenarios)), tuple(rows))


def flag_lines(card: ScoreCard) -> Iterator[str]:
    """Yield what flags, warnings and the comparison with the floors say, one line each."""
    for row in card.scores:
        if row != SUBMISSION:
            yield f"against {row}: {_against(card, row)}"
    for flag in card.flags:
        word = {True: "raised", False: "not raised", None: "unknown"}[flag.raised]
        reasons = f": {'; '.join(flag.reasons)}" if flag.reasons else ""
        yield f"flag {flag.name}: {word}{reasons}"
    for warning in card.warnings:
        yield f"warning [{warning.check}] {warning.what}: {warning.got}"


def _against(card: ScoreCard, row: str) -> str:
    found = card.against(row)
    low, high = found.interval
    if math.isnan(found.difference):
        return f"{card.ranking} cannot be compared"
    if found.difference < 0.0:
        word, low, high = "better", -high, -low  # the bounds of what is printed: how much better
    else:
        word = "worse" if found.difference > 0.0 else "equal"
    p = (
        f", p = {found.p:.3g}"
        if not math.isnan(found.p)
        else f", {len(found.scenarios)} scenarios: no p-value"
    )
    return f"{card.ranking} {word} by {_number(abs(found.difference))} ({_number(low)} to {_number(high)}{p})"


def comparison_table(result: ComparisonResult, *, every: bool = False) -> Table:
    """Return the table of a comparison; differences are in the loss: negative favours the first.

    Args:
        result: the comparison.
        every: whether to show all its metrics instead of the chosen ones.
    """
    rows = []
    for name, found in result.metrics.items():
        if not every and name not in (result.ranking, *CHOSEN):
            continue
        low, high = found.test.interval
        rows.append(
            (
                name,
                _number(found.first),
                _number(found.second),
                _number(found.test.difference),
                "" if math.isnan(low) else f"{low:.3g} to {high:.3g}",
                "" if math.isnan(found.test.p) else f"{found.test.p:.3g}",
                found.unit,
            )
        )
    columns = ("metric", result.first, result.second, "loss difference", "95 % interval", "p", "unit")
    return Table(
        f"{result.first} against {result.second} on {result.split} {result.size}", columns, tuple(rows)
    )


def _better(score: Score) -> str:
    metric = score.metric
    goal = f" {metric.perfect:g}" if metric.direction is Direction.TARGET else ""
    return f"{ARROWS[metric.direction]}{goal}"


def _interval(score: Score) -> str:
    low, high = score.interval
    return "" if math.isnan(low) else f"{low:.3g} to {high:.3g}"


def _number(value: float) -> str:
    """Return a number with four digits, a dash where it is undefined.

    >>> _number(0.000123456), _number(float("nan"))
    ('0.0001235', '-')
    """
    return "-" if math.isnan(value) else f"{value:.4g}"
