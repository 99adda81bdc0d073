"""Tables: scores beside the floors, scores at frames, every metric."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lagbench.metrics import FAMILIES, Direction, Metric, Score, compare, shared_ranks
from lagbench.metrics.comparison import FEWEST_SCENARIOS
from lagbench.metrics.reductions import mean

from .markup import Markup, join, tag
from .numbers import html, interval, text
from .page import paragraph, table
from .subject import Row, Subject
from .wording import unit as unit_of
from .wording import words

__all__ = ["every_metric", "frame_table", "score_table", "scenario_table", "verdict_table"]

CHOSEN = (
    "vorticity_rmse",
    "vorticity_pearson",
    "stable_frames",
    "vorticity_kl",
    "vorticity_w1",
    "mse_avg",
    "mse_end",
    "position_rmse",
    "velocity_rmse",
    "energy_error",
    "energy_ratio",
    "density_rmse",
    "momentum_error",
    "shape_error",
    "connectivity",
)
"""Metrics of the first table, after the one that ranks."""

AT_FRAMES = ("vorticity_mae", "vorticity_mse", "vorticity_rmse", "vorticity_pearson", "vorticity_kl")
AT_FRAMES_FREE = ("attribute_mse", "position_rmse", "velocity_rmse", "energy_ratio", "vorticity_pearson")

_WORDS = {
    Direction.LOWER: "lower is better",
    Direction.HIGHER: "higher is better",
    Direction.NONE: "observable",
}


def score_table(subject: Subject) -> Markup:
    """Return the chosen metrics over the horizon, with intervals, beside the floors."""
    wanted = dict.fromkeys((subject.ranking.name, *CHOSEN))
    return _score_rows(subject, [name for name in wanted if _anywhere(subject, name)])


def every_metric(subject: Subject) -> Markup:
    """Return all metrics over the horizon, family by family."""
    listed = {metric.name for family in FAMILIES.values() for metric in family}
    parts = []
    for family, metrics in FAMILIES.items():
        names = [metric.name for metric in metrics if _anywhere(subject, metric.name)]
        if names:
            parts += [tag("h4", family.capitalize()), _score_rows(subject, names)]
    others = [n for n in subject.entries[0].card.submission if n not in listed]
    if others:
        parts += [tag("h4", "Of other packages"), _score_rows(subject, others)]
    return join(parts)


def _anywhere(subject: Subject, name: str) -> bool:
    return all(name in row.scores for row in subject.rows)


def _score_rows(subject: Subject, names: Sequence[str]) -> Markup:
    rows = subject.rows
    cells = []
    for name in names:
        scores = [row.scores[name] for row in rows]
        best = _best(scores[0].metric, [score.mean for score in scores])
        cells.append(
            [
                _named(scores[0].metric, ranks=name == subject.ranking.name),
                *(_cell(score, best=i == best) for i, score in enumerate(scores)),
            ]
        )
    return table(["metric", *(_heading(row) for row in rows)], cells, kind="scores", label="Scores")


def _heading(row: Row) -> Markup:
    return tag("span", row.name) if row.entry else tag("span", row.name, class_="muted")


def _best(metric: Metric, means: Sequence[float]) -> int | None:
    """Return which is best, None where nothing is judged or defined."""
    if metric.direction is Direction.NONE or not np.isfinite(means).any():
        return None
    return int(np.nanargmin([metric.loss(value) for value in means]))


def _named(metric: Metric, *, ranks: bool) -> Markup:
    unit = tag("span", unit_of(metric), class_="unit")
    aim = f"aims at {metric.perfect:g}" if metric.direction is Direction.TARGET else _WORDS[metric.direction]
    flag = join([" ", tag("span", "ranks", class_="flag ok")]) if ranks else ""
    name = tag("span", metric.name.replace("_", "_\u200b"), unit, flag, class_="metric")
    return join([name, tag("span", f"{metric.summary}; {aim}", class_="sub")])


def _cell(score: Score, *, best: bool) -> Markup:
    number = tag("span", text(score.mean), class_="n best" if best else "n")
    undefined = sum(score.undefined)
    lost = tag("span", f"{undefined} undefined", class_="ci") if undefined else ""
    return join([number, interval(score.interval), lost])


def frame_table(subject: Subject) -> Markup:
    """Return the metrics of Tables 5.4 and 5.5 at the key frame, one row per method."""
    chosen = AT_FRAMES if subject.full_box else AT_FRAMES_FREE
    names = [name for name in chosen if _anywhere(subject, name)]
    frame = subject.key_frame
    means = {name: [mean(row.scores[name].at(frame)) for row in subject.rows] for name in names}
    best = {n: _best(subject.rows[0].scores[n].metric, values) for n, values in means.items()}
    cells = []
    for i, row in enumerate(subject.rows):
        numbers = [tag("span", text(means[n][i]), class_="n best" if best[n] == i else "n") for n in names]
        cells.append([_heading(row), *numbers])
    return table(["method", *(words(n) for n in names)], cells, label=f"Scores at frame {frame}")


def scenario_table(subject: Subject) -> Markup:
    """Return the ranking metric of every scenario, one row per method."""
    name = subject.ranking.name
    cells = [
        [_heading(row), *(html(value) for value in row.scores[name].values.tolist())] for row in subject.rows
    ]
    return table(["method", *(str(i) for i in subject.scenarios)], cells, label=f"{name} per scenario")


def verdict_table(subject: Subject) -> Markup:
    """Return how all compare with the leader: exact sign-flip test over scenarios."""
    name, leader = subject.ranking.name, subject.leader
    ranks = shared_ranks({row.name: row.scores[name] for row in subject.rows})
    cells = []
    for row in sorted(subject.rows, key=lambda row: (ranks[row.name], row is not leader)):
        found, same = compare(row.scores[name], leader.scores[name]), row is leader
        cells.append(
            [
                _heading(row),
                str(ranks[row.name]),
                html(row.scores[name].mean),
                tag("span", "leader", class_="muted") if same else html(found.difference),
                "" if same else interval(found.interval),
                "" if same else html(found.p),
            ]
        )
    head = ["method", "rank", words(name), "loss above leader", "95 % interval", "p"]
    count = len(subject.scenarios)
    note = (
        f"Under {FEWEST_SCENARIOS} scenarios no significance is claimed and all share the leader's rank."
        if count < FEWEST_SCENARIOS
        else "Methods that do not differ from the leader at 5 % share its rank."
    )
    test = f"p: exact two-sided sign-flip test over {count} scenarios. {note}"
    return join([table(head, cells, label="Comparison"), paragraph(tag("small", test, class_="muted"))])
