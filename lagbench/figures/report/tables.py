"""Tables of the report: scores over the horizon, at frames, per scenario, ranked."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lagbench.figures.html import (
    Markup,
    draw_table,
    format_unit,
    interval,
    join,
    paragraph,
    tag,
    text,
    words,
    wrap_number,
)
from lagbench.metrics.aggregate import Score
from lagbench.metrics.metric import Direction, Metric, mean
from lagbench.metrics.significance import (
    FEWEST_SCENARIOS,
    Comparison,
    Standing,
    compare,
    standings,
)
from lagbench.metrics.table import CHOSEN, FAMILIES, METRICS

from .subject import ReportRow, Subject

Floats = NDArray[np.float64]

# metrics of the table at the key frame, in full boxes and with a free surface
AT_FRAME_FULL_BOX = (
    "vorticity_mae",
    "vorticity_mse",
    "vorticity_rmse",
    "vorticity_pearson",
    "vorticity_kl",
)
AT_FRAME_FREE_SURFACE = (
    "sliced_w2",
    "position_rmse",
    "attribute_mse",
    "velocity_rmse",
    "energy_ratio",
)

AIMS = {
    Direction.LOWER: "lower is better",
    Direction.HIGHER: "higher is better",
    Direction.NONE: "observable",
}

LINE_BREAK = "\u200b"  # where a line may end


def score_table(subject: Subject) -> Markup:
    """Return the chosen metrics over the horizon, with intervals, by method."""
    names = dict.fromkeys((subject.ranking.name, *CHOSEN))
    return _horizon_table(subject, _measured(subject, names))


def every_metric(subject: Subject) -> Markup:
    """Return all metrics over the horizon, family by family."""
    parts = []
    for family, metrics in FAMILIES.items():
        family_names = [metric.name for metric in metrics]
        names = _measured(subject, family_names)
        if names:
            parts.append(tag("h4", family.capitalize()))
            parts.append(_horizon_table(subject, names))

    submission = subject.entries[0].card.submission
    names = []
    for name in submission:
        if name not in METRICS:
            names.append(name)
    if names:
        parts.append(tag("h4", "Of other packages"))
        parts.append(_horizon_table(subject, names))
    return join(parts)


def _measured(subject: Subject, names: Sequence[str] | dict[str, None]) -> list[str]:
    """Return the metrics that all entries have, of some names."""
    submissions = [entry.card.submission for entry in subject.entries]
    measured = []
    for name in names:
        if all(name in submission for submission in submissions):
            measured.append(name)
    return measured


def _horizon_table(subject: Subject, names: Sequence[str]) -> Markup:
    """Return means over the horizon, a line per metric and a column per method."""
    head = ["metric", *map(_draw_heading, subject.rows)]
    lines = []
    for name in names:
        metric = subject.rows[0].scores[name].metric
        # reference predictors lack metrics of other packages
        scores = []
        for row in subject.rows:
            scores.append(row.scores.get(name))
        values: list[Sequence[float] | Floats] = []
        for score in scores:
            if score is None:
                values.append([])
            else:
                values.append(score.values)
        best = _find_best(metric, values)

        ranks = metric.name == subject.ranking.name
        line: list[object] = [_draw_metric(metric, ranks=ranks)]
        for column, score in enumerate(scores):
            if score is None:
                line.append("")
            else:
                line.append(_draw_score(score, is_best=column in best))
        lines.append(line)
    return draw_table(head, lines, kind="scores", label="Scores")


def _draw_metric(metric: Metric, *, ranks: bool) -> Markup:
    """Return name, unit, summary and aim of a metric."""
    name = metric.name.replace("_", f"_{LINE_BREAK}")
    unit = tag("span", format_unit(metric), class_="unit")
    parts: list[object] = [name, unit]
    if ranks:
        badge = tag("span", "ranks", class_="flag ok")
        parts += [" ", badge]
    if metric.direction is Direction.TARGET:
        aim = f"aims at {metric.perfect:g}"
    else:
        aim = AIMS[metric.direction]
    summary = tag("span", f"{metric.summary}; {aim}", class_="sub")
    return join([tag("span", *parts, class_="metric"), summary])


def _draw_score(score: Score, *, is_best: bool) -> Markup:
    """Return a mean with its interval and the number of undefined values."""
    parts = [_draw_number(score.mean, is_best=is_best), interval(score.interval)]
    undefined_count = sum(score.undefined)
    if undefined_count:
        note = f"{undefined_count} undefined"
        parts.append(tag("span", note, class_="ci"))
    return join(parts)


def _draw_number(value: float, *, is_best: bool) -> Markup:
    kind = "n"
    if is_best:
        kind = "n best"
    return tag("span", text(value), class_=kind)


def _draw_heading(row: ReportRow) -> Markup:
    if row.entry is None:
        return tag("span", row.name, class_="muted whole")
    return tag("span", row.name)


def _find_best(
    metric: Metric, values: Sequence[Sequence[float] | Floats]
) -> frozenset[int]:
    """Return which methods are best by the mean of their scenarios' losses.

    Losses that read the same are equal. An observable, or a metric that nobody has, has
    no best. Values above and below a target do not cancel, as losses are averaged.
    """
    if metric.direction is Direction.NONE:
        return frozenset()
    losses = []
    for method_values in values:
        scenario_losses = [metric.loss(value) for value in method_values]
        losses.append(mean(np.array(scenario_losses)))
    if not np.isfinite(losses).any():
        return frozenset()
    least = text(float(np.nanmin(losses)))
    return frozenset(i for i, loss in enumerate(losses) if text(loss) == least)


def frame_table(subject: Subject) -> Markup:
    """Return the metrics of Tables 5.4 and 5.5 at the key frame, by method."""
    names = _measured(subject, AT_FRAME_FREE_SURFACE)
    if subject.is_full_box:
        names = _measured(subject, AT_FRAME_FULL_BOX)
    frame = subject.key_frame
    lines: list[list[object]] = []
    for row in subject.rows:
        lines.append([_draw_heading(row)])
    for name in names:
        metric = subject.rows[0].scores[name].metric
        values = []
        for row in subject.rows:
            values.append(row.scores[name].at(frame))
        comparable = _comparable(subject, metric, values)
        best = _find_best(metric, comparable)
        for number, line in enumerate(lines):
            value = mean(values[number])
            line.append(_draw_number(value, is_best=number in best))
    head = ["method", *map(words, names)]
    return draw_table(head, lines, label=f"Scores at frame {frame}")


def _comparable(
    subject: Subject, metric: Metric, values: Sequence[Floats]
) -> list[Floats]:
    """Return values by method, none for means that cannot be compared.

    Of reference predictors only the mean is known. It says nothing about a metric with
    a target: scenarios on both sides of the target cancel.
    """
    if metric.direction is not Direction.TARGET:
        return list(values)
    comparable = []
    for method_values in values:
        has_all_scenarios = len(method_values) >= len(subject.scenarios)
        if has_all_scenarios:
            comparable.append(method_values)
        else:
            comparable.append(method_values[:0])
    return comparable


def scenario_table(subject: Subject) -> Markup:
    """Return the ranking metric of every scenario, by method."""
    name = subject.ranking.name
    lines = []
    for row in subject.rows:
        values = row.scores[name].values.tolist()
        lines.append([_draw_heading(row), *map(wrap_number, values)])
    head = ["method", *map(str, subject.scenarios)]
    return draw_table(head, lines, label=f"{name} per scenario")


def ranking_table(subject: Subject) -> Markup:
    """Return the ranking of entries, each tested against the best entry.

    Tests are sign-flip tests, corrected by Holm. Reference predictors follow, unranked.
    A reference predictor may be better than the best entry.
    """
    name = subject.ranking.name
    entries = {}
    scores = {}
    for row in subject.rows:
        if row.entry is not None:
            entries[row.name] = row
            scores[row.name] = row.scores[name]
    ranked = standings(scores)
    best_entry = next(iter(ranked))
    best_score = scores[best_entry]

    lines: list[list[object]] = []
    for method, standing in ranked.items():
        row = entries[method]
        score = row.scores[name]
        comparison = compare(score, best_score)
        cells = _draw_standing(standing, comparison)
        rank = str(standing.rank)
        lines.append([_draw_heading(row), rank, wrap_number(score.mean), *cells])
    for row in subject.rows:
        if row.entry is None:
            score = row.scores[name]
            comparison = compare(score, best_score)
            cells = _draw_difference(comparison)
            mean_cell = wrap_number(score.mean)
            lines.append([_draw_heading(row), "", mean_cell, *cells, "", ""])
    head = [
        "method",
        "rank",
        words(name),
        "loss − loss of the best submission",
        "95 % interval",
        "p",
        "differs from the best submission",
    ]
    lead = paragraph(
        "Only submissions have a rank. Reference predictors stand below them for "
        "comparison. A method with a negative difference of the losses is better than "
        "the best submission."
    )
    note = tag("small", _explain_test(subject), class_="muted")
    table = draw_table(head, lines, label="Comparison")
    return join([lead, table, paragraph(note)])


def _draw_difference(comparison: Comparison) -> list[object]:
    return [wrap_number(comparison.difference), interval(comparison.interval)]


def _draw_standing(standing: Standing, comparison: Comparison) -> list[object]:
    """Return difference from the best entry, interval, p, and whether they differ."""
    if standing.rank == 1:
        return [tag("span", "best submission", class_="muted"), "", "", ""]
    verdict: object = "yes"
    if standing.tied:
        verdict = tag("span", "no", class_="muted")
    return [*_draw_difference(comparison), wrap_number(standing.p), verdict]


def _explain_test(subject: Subject) -> str:
    count = len(subject.scenarios)
    note = (
        f"p: exact two-sided sign-flip test over {count} scenarios, corrected by Holm "
        "for the comparisons with the best submission. It is about these weights: "
        "other seeds may stand otherwise."
    )
    if count < FEWEST_SCENARIOS:
        note += f" Under {FEWEST_SCENARIOS} scenarios nothing is claimed."
    return note
