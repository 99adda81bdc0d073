"""What a score card and a comparison print, as tables of text."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator

from lagbench.figures.tables import Table
from lagbench.metrics.metric import Direction, Metric, mean
from lagbench.metrics.table import CHOSEN
from lagbench.references.shipped import DIGITS

from .card import SUBMISSION, ScoreCard
from .compare import ComparisonResult

SHOWN_AT_FRAMES = (
    *(
        "vorticity_mse",
        "vorticity_mae",
        "vorticity_rmse",
        "vorticity_pearson",
        "vorticity_kl",
    ),
    *(
        "vorticity_w1",
        "spectrum_error",
        "position_rmse",
        "attribute_mse",
        "energy_ratio",
    ),
    *("outside_share", "sliced_w2"),
)
"""Metrics in the table of frames of interest."""

ARROWS = {
    Direction.LOWER: " ↓",
    Direction.HIGHER: " ↑",
    Direction.TARGET: " ◎",
    Direction.NONE: "",
}
"""How the better side of a metric is marked, behind its name."""


def card_tables(
    card: ScoreCard, *, every: bool = False, floors: bool = False
) -> Iterator[Table]:
    """Yield tables over the horizon, at frames of interest and per scenario, of every
    metric or the chosen.

    With ``floors`` they stand beside all floors instead of the best one.
    """
    chosen = card.submission if every else dict.fromkeys((card.ranking, *CHOSEN))
    names = [name for name in chosen if name in card.submission]
    at_frames = (
        [n for n in names if card.submission[n].metric.per_frame]
        if every
        else SHOWN_AT_FRAMES
    )
    method = card.header.method
    frames = card.reported_frames
    task = f"{card.header.split} {card.header.size}, {card.setting.horizon} frames"
    beside = [row for row in card.scores if row != SUBMISSION]
    if not floors:
        if card.skill:
            beside = [card.skill.floor]
        else:
            beside = beside[:1]
    yield _over_horizon(card, names, beside, f"{method} on {task}, mean over scenarios")
    rows: list[tuple[str, ...]] = [
        (name, *(_number(mean(card.submission[name].at(frame))) for frame in frames))
        for name in at_frames
        if name in card.submission
    ]
    yield Table(
        f"{method} at frames, mean over scenarios",
        ("metric", *map(str, frames)),
        tuple(rows),
    )
    shown = [SUBMISSION, *beside]
    columns = [card.scores[row][card.ranking].values.tolist() for row in shown]
    rows = [
        (str(i), *map(_number, values))
        for i, *values in zip(card.scenarios, *columns, strict=True)
    ]
    yield Table(
        f"{card.ranking} per scenario", ("scenario", *map(_head, shown)), tuple(rows)
    )


def _over_horizon(
    card: ScoreCard, names: Collection[str], floors: Collection[str], title: str
) -> Table:
    found = card.skill
    if found is None:
        skill = "-"
    else:
        skill = _with_interval(found.value, found.interval)
    rows = [
        (
            "skill ↑",
            skill,
            *("0" if found and row == found.floor else "" for row in floors),
        )
    ]
    for name in names:
        score = card.submission[name]
        if any(score.undefined):
            mark = " †"
        else:
            mark = ""
        own = f"{_with_interval(score.mean, score.interval)}{mark}"
        others = (card.scores[row].get(name) for row in floors)
        means = ("-" if other is None else _number(other.mean) for other in others)
        rows.append((_named(score.metric), own, *means))
    return Table(
        title, ("metric", f"{SUBMISSION} [95 %]", *map(_head, floors)), tuple(rows)
    )


def _named(metric: Metric) -> str:
    """Return the name of a metric, which side is better, and its unit."""
    if metric.unit == "1":
        unit = ""
    else:
        unit = f" [{metric.unit}]"
    return f"{metric.name}{ARROWS[metric.direction]}{unit}"


def _head(name: str) -> str:
    """Return a name as the head of a column, in lines."""
    return "-\n".join(name.split("-"))


def flag_lines(card: ScoreCard) -> Iterator[str]:
    """Yield what marks mean, what is undefined, and what flags, warnings and floors
    say, one line each.
    """
    yield "↑ more is better, ↓ less is, ◎ nearer to the perfect value is"
    lost = {
        name: sum(score.undefined)
        for name, score in card.submission.items()
        if name in CHOSEN
    }
    if any(lost.values()):
        frames = len(card.scenarios) * card.setting.horizon
        said = ", ".join(f"{name} {count}" for name, count in lost.items() if count)
        yield f"† frames without a value, of {frames}: {said}"
    for row in card.scores:
        if row != SUBMISSION:
            yield f"against {row}: {_against(card, row)}"
    for flag in card.flags:
        word = {True: "raised", False: "not raised", None: "unknown"}[flag.raised]
        if flag.reasons:
            reasons = f": {'; '.join(flag.reasons)}"
        else:
            reasons = ""
        yield f"flag {flag.name}: {word}{reasons}"
    for warning in card.warnings:
        yield f"warning [{warning.check}] {warning.what}: {warning.got}"
        if warning.fix:
            yield f"  fix: {warning.fix}"


def _against(card: ScoreCard, row: str) -> str:
    found = card.against(row)
    low, high = found.interval
    if math.isnan(found.difference):
        return f"{card.ranking} cannot be compared"
    # to the digits that floors are shipped with
    if abs(found.difference) <= 5.0 * 10.0**-DIGITS * abs(
        card.scores[row][card.ranking].mean
    ):
        return f"{card.ranking} is the same"
    if found.difference < 0.0:
        # the bounds of what is printed: how much better
        word, low, high = "better", -high, -low
    else:
        word = "worse"
    if math.isnan(low):
        spread = ""
    else:
        spread = f"{_number(low)} to {_number(high)}, "
    if math.isnan(found.p):
        p = f"{len(found.scenarios)} scenarios: no p-value"
    else:
        p = f"p = {found.p:.3g}"
    return f"{card.ranking} {word} by {_number(abs(found.difference))} ({spread}{p})"


def comparison_tables(
    result: ComparisonResult, *, every: bool = False
) -> Iterator[Table]:
    """Yield differences in the loss, negative favours the first, and means, of every
    metric or the chosen.
    """
    chosen = result.metrics if every else (result.ranking, *CHOSEN)
    shown = [found for name, found in result.metrics.items() if name in chosen]
    title = f"{result.first} against {result.second} on {result.split} {result.size}"
    differences = tuple(
        (
            _named(found.metric),
            _with_interval(found.test.difference, found.test.interval),
            "-" if math.isnan(found.test.p) else f"{found.test.p:.3g}",
        )
        for found in shown
    )
    # a loss is what is less for the better one, also where more of the metric is better
    yield Table(
        f"{title}; below 0 the first is better",
        ("metric", "loss difference [95 %]", "p"),
        differences,
    )
    means = tuple(
        (
            _named(found.metric),
            *(
                _number(value) + (f" ({lost} frames undefined)" if lost else "")
                for value, lost in zip(
                    (found.first, found.second), found.undefined, strict=True
                )
            ),
        )
        for found in shown
    )
    yield Table("means", ("metric", _head(result.first), _head(result.second)), means)


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
