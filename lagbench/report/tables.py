"""Tables: scores beside the floors, scores at frames, every metric.

The top of the page: what was scored, the numbers that matter, flags and warnings.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Sequence

import numpy as np

from lagbench.metrics.aggregate import Score, bootstrap_interval
from lagbench.metrics.frame import Floats
from lagbench.metrics.metric import Direction, Metric, mean
from lagbench.metrics.significance import FEWEST_SCENARIOS, compare, standings
from lagbench.metrics.table import CHOSEN, FAMILIES, METRICS
from lagbench.metrics.vorticity import STABLE_PEARSON

from .html import Markup, html, interval, join, paragraph, table, tag, text, unit, words
from .subject import Row, Subject

AT_FRAMES = (
    "vorticity_mae",
    "vorticity_mse",
    "vorticity_rmse",
    "vorticity_pearson",
    "vorticity_kl",
)
AT_FRAMES_FREE = (
    "sliced_w2",
    "position_rmse",
    "attribute_mse",
    "velocity_rmse",
    "energy_ratio",
)

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
    families = {
        family.capitalize(): [
            metric.name for metric in metrics if _anywhere(subject, metric.name)
        ]
        for family, metrics in FAMILIES.items()
    }
    own = subject.entries[0].card.submission
    families["Of other packages"] = [name for name in own if name not in METRICS]
    return join(
        join([tag("h4", family), _score_rows(subject, names)])
        for family, names in families.items()
        if names
    )


def _anywhere(subject: Subject, name: str) -> bool:
    """Tell whether all entries have a metric; shipped floors lack those of extras."""
    return all(name in entry.card.submission for entry in subject.entries)


def _score_rows(subject: Subject, names: Sequence[str]) -> Markup:
    rows = subject.rows
    cells = []
    for name in names:
        scores = [row.scores.get(name) for row in rows]
        metric = rows[0].scores[name].metric
        best = _best(
            metric, [[] if score is None else score.values for score in scores]
        )
        if name == subject.ranking.name:
            ranks = [" ", tag("span", "ranks", class_="flag ok")]
        else:
            ranks = []
        broken = name.replace("_", "_\u200b")  # where a line may end
        named = tag(
            "span",
            broken,
            tag("span", unit(metric), class_="unit"),
            *ranks,
            class_="metric",
        )
        target = metric.direction is Direction.TARGET
        if target:
            aim = f"aims at {metric.perfect:g}"
        else:
            aim = _WORDS[metric.direction]
        line: list[object] = [
            join([named, tag("span", f"{metric.summary}; {aim}", class_="sub")])
        ]
        for i, score in enumerate(scores):
            if score:
                undefined = sum(score.undefined)
            else:
                undefined = 0
            lost = (
                tag("span", f"{undefined} undefined", class_="ci") if undefined else ""
            )
            number = (
                tag("span", text(score.mean), class_="n best" if i in best else "n")
                if score
                else ""
            )
            line.append(join([number, interval(score.interval), lost]) if score else "")
        cells.append(line)
    return table(["metric", *map(_heading, rows)], cells, kind="scores", label="Scores")


def _heading(row: Row) -> Markup:
    if row.entry:
        return tag("span", row.name)
    return tag("span", row.name, class_="muted whole")


def _best(metric: Metric, values: Sequence[Sequence[float] | Floats]) -> frozenset[int]:
    """Return which are best by the mean of the scenarios' losses; none where nothing is
    judged or defined.

    Those that read the same are included. Beside and beyond what a metric aims at do
    not cancel.
    """
    if metric.direction is Direction.NONE:
        return frozenset()
    losses = [mean(np.array([metric.loss(value) for value in held])) for held in values]
    if not np.isfinite(losses).any():
        return frozenset()
    least = text(float(np.nanmin(losses)))
    return frozenset(i for i, loss in enumerate(losses) if text(loss) == least)


def frame_table(subject: Subject) -> Markup:
    """Return the metrics of Tables 5.4 and 5.5 at the key frame, one row per method."""
    if subject.full_box:
        chosen = AT_FRAMES
    else:
        chosen = AT_FRAMES_FREE
    names = [name for name in chosen if _anywhere(subject, name)]
    frame = subject.key_frame
    cells: list[list[object]] = [[_heading(row)] for row in subject.rows]
    for name in names:
        metric = subject.rows[0].scores[name].metric
        held = [row.scores[name].at(frame) for row in subject.rows]
        # of floors the mean alone is known, which says nothing where a metric aims at a
        # value
        aims = metric.direction is Direction.TARGET
        count = len(subject.scenarios)
        best = _best(
            metric,
            [values[:0] if aims and len(values) < count else values for values in held],
        )
        for i, (line, values) in enumerate(zip(cells, held, strict=True)):
            line.append(
                tag("span", text(mean(values)), class_="n best" if i in best else "n")
            )
    return table(
        ["method", *(words(n) for n in names)], cells, label=f"Scores at frame {frame}"
    )


def scenario_table(subject: Subject) -> Markup:
    """Return the ranking metric of every scenario, one row per method."""
    name = subject.ranking.name
    cells = [
        [_heading(row), *map(html, row.scores[name].values.tolist())]
        for row in subject.rows
    ]
    return table(
        ["method", *(str(i) for i in subject.scenarios)],
        cells,
        label=f"{name} per scenario",
    )


def verdict_table(subject: Subject) -> Markup:
    """Return sign-flip tests of entries against the leader, corrected by Holm; floors
    follow, unranked.
    """
    name = subject.ranking.name
    entries = {row.name: row for row in subject.rows if row.entry}
    placed = standings({method: row.scores[name] for method, row in entries.items()})
    leader = entries[next(iter(placed))]
    cells = []
    for method, place in placed.items():
        row = entries[method]
        same = place.rank == 1
        found = compare(row.scores[name], leader.scores[name])
        cells.append(
            [
                _heading(row),
                str(place.rank),
                html(row.scores[name].mean),
                tag("span", "leader", class_="muted")
                if same
                else html(found.difference),
                "" if same else interval(found.interval),
                "" if same else html(place.p),
                tag("span", "no", class_="muted")
                if place.tied
                else ""
                if same
                else "yes",
            ]
        )
    for row in subject.rows:
        if not row.entry:
            found = compare(row.scores[name], leader.scores[name])
            apart = [html(found.difference), interval(found.interval), "", ""]
            cells.append([_heading(row), "", html(row.scores[name].mean), *apart])
    head = [
        "method",
        "rank",
        words(name),
        "loss above leader",
        "95 % interval",
        "p",
        "told from the leader",
    ]
    count = len(subject.scenarios)
    if count < FEWEST_SCENARIOS:
        few = f" Under {FEWEST_SCENARIOS} scenarios nothing is claimed."
    else:
        few = ""
    test = (
        f"p: exact two-sided sign-flip test over {count} scenarios, corrected by Holm "
        f"for the comparisons"
        f" with the leader. It is about these weights: other seeds may stand "
        f"otherwise.{few}"
    )
    return join(
        [
            table(head, cells, label="Comparison"),
            paragraph(tag("small", test, class_="muted")),
        ]
    )


TILES = (
    "vorticity_pearson",
    "stable_frames",
    "spectrum_error",
    "position_rmse_20",
    "outside_share",
)

STATES = {True: ("raised", "bad"), False: ("clear", "ok"), None: ("unknown", "unknown")}
"""What a flag says, and the classes of that."""

TILE_NOTES = {
    "spectrum_error": "decades of energy, at the frames of interest",
    "position_rmse_20": "particle by particle, first 20 frames",
}


def title(subject: Subject) -> str:
    """Return the title of the window."""
    names = ", ".join(entry.name for entry in subject.entries)
    return f"{names} on {subject.task.size.split} {subject.task.size.name}"


def head(subject: Subject) -> Markup:
    """Return the top of the page."""
    size = subject.task.size
    header = subject.entries[0].card.header
    setting = subject.task.config
    many = len(subject.entries) > 1
    names = " · ".join(entry.name for entry in subject.entries)
    lede = (
        f"Given {setting.input_frames} frames of each of {len(subject.scenarios)} "
        f"test scenarios, predict the"
        f" next {setting.horizon}. {subject.title}, {size.particles} particles, data "
        f"set version"
        f" {header.dataset_version}."
    )
    best = subject.best_entry
    ranking = subject.ranking.name
    tiles = []
    if many:
        whose = f"{best.name}: "
    else:
        whose = ""
    if best.entry is not None:
        found = best.entry.card.skill
    else:
        found = None
    if found is not None:
        said = f"1 - score / score of {found.reference}"
        tiles.append(_card(f"{whose}skill", found.value, found.interval, said))
    tiles.append(
        _tile(f"{whose}{words(ranking)}", best.scores[ranking], _beside(subject, best))
    )
    for name in TILES:
        score = best.scores.get(name)
        if score is None or name == ranking:
            continue
        if name == "stable_frames":
            tiles.append(_tile("stable", score, stable_of(score)))
        elif name == "vorticity_pearson":
            values = score.at(subject.key_frame)
            said = f"at frame {subject.key_frame}"
            tiles.append(
                _card(words(name), mean(values), bootstrap_interval(values), said)
            )
        else:
            tiles.append(
                _tile(words(name), score, TILE_NOTES.get(name, "mean over the horizon"))
            )
    brand = tag(
        "p", f"lagbench · score report · {size.split} {size.name}", class_="brand"
    )
    tail = tag("p", lede, class_="lede"), tag("ul", *tiles, class_="tiles")
    return join([brand, tag("h1", names), *tail])


def stable_of(score: Score) -> str:
    """Return out of how many frames, and how many of all scenarios' do not count."""
    lost = sum(score.undefined)
    every = len(score.scenarios) * len(score.frames)
    said = f"of {len(score.frames)}, correlation above {STABLE_PEARSON}"
    if lost:
        return f"{said}; {lost} of {every} frames undefined"
    return said


def _tile(what: str, score: Score, more: str) -> Markup:
    return _card(f"{what}{unit(score.metric)}", score.mean, score.interval, more)


def _card(what: str, value: float, bounds: tuple[float, float], more: str) -> Markup:
    low, high = bounds
    if math.isnan(low):
        spread = ""
    else:
        spread = tag("span", f"{text(low)} … {text(high)}", class_="more")
    number = tag("span", text(value), class_="big")
    return tag(
        "li",
        tag("span", what, class_="what"),
        number,
        spread,
        tag("span", more, class_="more"),
    )


def _beside(subject: Subject, row: Row) -> str:
    metric = subject.ranking
    floors = [r for r in subject.rows if r.entry is None]
    if not floors or metric.direction is not Direction.LOWER:
        return "mean over the horizon; this ranks"
    floor = min(
        floors,
        key=lambda r: (
            math.isnan(r.scores[metric.name].mean),
            r.scores[metric.name].mean,
        ),
    )
    below = floor.scores[metric.name].mean
    if below > 0.0:
        ratio = row.scores[metric.name].mean / below
    else:
        ratio = math.nan
    return f"{text(ratio, 2)} × {floor.name}"


def flag_list(subject: Subject) -> Markup:
    """Return flags and warnings of every entry."""
    many = len(subject.entries) > 1
    parts = []
    for entry in subject.entries:
        items = []
        for flag in entry.card.flags:
            word, kind = STATES[flag.raised]
            evidence = [
                f"{name.replace('_', ' ')} {text(value)}"
                for name, value in flag.evidence.items()
            ]
            if flag.reasons:
                reasons = f": {'; '.join(flag.reasons)}"
            else:
                reasons = ""
            items.append(
                _item(
                    word,
                    kind,
                    flag.name.replace("_", " "),
                    reasons,
                    ", ".join(evidence),
                )
            )
        for finding in entry.card.warnings:
            more = f"{finding.where}: expected {finding.expected}, got {finding.got}. {finding.fix}"
            items.append(
                _item("warning", "warn", finding.check, f": {finding.what}", more)
            )
        if marks := sorted(entry.card.header.diverged_at.items()):
            said = ", ".join(f"scenario {i} at frame {frame}" for i, frame in marks)
            said = f": the rollout is frozen from there on: {said}"
            items.append(_item("warning", "warn", "diverged", said))
        parts.append(
            join(
                [
                    tag("h4", entry.name) if many else "",
                    tag("ul", *items, class_="flags"),
                ]
            )
        )
    return join(parts)


def _item(
    word: str, kind: str, name: str, said: str, more: str | None = None
) -> Markup:
    if more is None:
        below = ""
    else:
        below = tag("span", more, class_="sub")
    told = tag("span", tag("strong", name), said, below)
    return tag("li", tag("span", word, class_=f"flag {kind}"), told)


def identity(subject: Subject) -> Markup:
    """Return what was scored, by hash, and the command that scores it again."""
    first = subject.entries[0].card.header
    data = [
        [
            "data set",
            tag("code", f"{first.split}/{first.size} version {first.dataset_version}"),
        ],
        ["data set SHA-256", tag("code", first.dataset_sha256)],
    ]
    parts = [table(["what", "value"], data, kind="text", label="Data set")]
    for entry in subject.entries:
        header = entry.card.header
        parameters = header.parameters
        seconds = header.seconds_per_frame
        known = {
            "method": header.method,
            "predictions SHA-256": tag("code", entry.card.predictions_sha256),
            "parameters": None
            if parameters is None
            else f"{parameters:,}".replace(",", "\u202f"),
            "seconds per frame": None if seconds is None else text(seconds),
            "device": header.device,
            "seed": header.seed,
            "training": header.training,
        }
        about = [[name, value] for name, value in known.items() if value is not None]
        parts += [
            tag("h4", entry.name),
            table(["what", "value"], about, kind="text", label=entry.name),
        ]
    files = " ".join(shlex.quote(entry.predictions.name) for entry in subject.entries)
    parts += [
        tag("h4", "The same report again"),
        tag("pre", f"lagbench score {files} --report report"),
    ]
    return join(parts)
