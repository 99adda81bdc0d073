"""The top of the report, its flags and warnings, and the identity of its files."""

from __future__ import annotations

import math
import shlex

from lagbench.figures.html import (
    Markup,
    draw_table,
    format_unit,
    join,
    tag,
    text,
    words,
)
from lagbench.metrics.aggregate import Score
from lagbench.metrics.metric import Direction, mean
from lagbench.metrics.vorticity import STABLE_PEARSON

from .subject import ReportEntry, ReportRow, Subject

TILES = (
    "vorticity_pearson",
    "stable_frames",
    "spectrum_error",
    "position_rmse_20",
    "outside_share",
)
"""Metrics of the tiles at the top, after skill and the metric that ranks."""

TILE_NOTES = {
    "spectrum_error": "decades of energy, at the frames of interest",
    "position_rmse_20": "particle by particle, first 20 frames",
}

FLAG_STATES = {
    True: ("raised", "bad"),
    False: ("clear", "ok"),
    None: ("unknown", "unknown"),
}
"""The word of a flag's state, and its classes."""

NARROW_SPACE = "\u202f"


def format_title(subject: Subject) -> str:
    """Return the title of the window."""
    return f"{', '.join(subject.names)} on {subject.data_name}"


def draw_head(subject: Subject) -> Markup:
    """Return the top of the page: methods, task and tiles."""
    header = subject.entries[0].card.header
    config = subject.task.config
    intro = (
        f"Given {config.input_frames} frames of each of {len(subject.scenarios)} "
        f"{header.subset} scenarios, predict the next {config.horizon}. "
        f"{subject.title}, {_count_particles(subject)} particles, data set version "
        f"{header.dataset_version}."
    )
    brand = f"lagbench · score report · {subject.data_name}"
    parts = [
        tag("p", brand, class_="brand"),
        tag("h1", " · ".join(subject.names)),
        tag("p", intro, class_="lede"),
        tag("ul", *_draw_tiles(subject), class_="tiles"),
    ]
    return join(parts)


def _count_particles(subject: Subject) -> str:
    """Return how many particles the scenarios have: a number or a range."""
    size = subject.task.size
    counts = {size.particle_count(scenario) for scenario in subject.scenarios}
    fewest = min(counts)
    most = max(counts)
    if fewest == most:
        return str(most)
    return f"{fewest} to {most}"


def _draw_tiles(subject: Subject) -> list[Markup]:
    """Return the numbers of the best entry that matter most."""
    best = subject.best_entry
    ranking = subject.ranking.name
    prefix = ""
    if len(subject.entries) > 1:
        prefix = f"{best.name}: "

    tiles = []
    if best.entry is not None and best.entry.card.skill is not None:
        skill = best.entry.card.skill
        note = f"1 - score / score of {skill.reference}"
        tiles.append(_draw_tile(f"{prefix}skill", skill.value, skill.interval, note))
    ranking_note = _compare_with_references(subject, best)
    title = f"{prefix}{words(ranking)}"
    tiles.append(_draw_score_tile(title, best.scores[ranking], ranking_note))

    for name in TILES:
        score = best.scores.get(name)
        if score is None or name == ranking:
            continue
        if name == "stable_frames":
            tiles.append(_draw_score_tile("stable", score, describe_stability(score)))
        elif name == "vorticity_pearson":
            frame = subject.key_frame
            bounds = score.interval_at(frame)
            note = f"at frame {frame}"
            tiles.append(_draw_tile(words(name), mean(score.at(frame)), bounds, note))
        else:
            note = TILE_NOTES.get(name, "mean over the horizon")
            tiles.append(_draw_score_tile(words(name), score, note))
    return tiles


def describe_stability(score: Score) -> str:
    """Return the number of frames, and how many of all scenarios' do not count."""
    note = f"of {len(score.frames)}, correlation above {STABLE_PEARSON}"
    undefined_count = sum(score.undefined)
    if not undefined_count:
        return note
    frame_count = len(score.scenarios) * len(score.frames)
    return f"{note}; {undefined_count} of {frame_count} frames undefined"


def _draw_score_tile(title: str, score: Score, note: str) -> Markup:
    whole_title = f"{title}{format_unit(score.metric)}"
    return _draw_tile(whole_title, score.mean, score.interval, note)


def _draw_tile(
    title: str, value: float, bounds: tuple[float, float], note: str
) -> Markup:
    parts = [
        tag("span", title, class_="what"),
        tag("span", text(value), class_="big"),
    ]
    low, high = bounds
    if not math.isnan(low):
        spread = f"{text(low)} … {text(high)}"
        parts.append(tag("span", spread, class_="more"))
    parts.append(tag("span", note, class_="more"))
    return tag("li", *parts)


def _compare_with_references(subject: Subject, row: ReportRow) -> str:
    """Return how a score compares with that of the best reference predictor."""
    metric = subject.ranking
    means = {}
    for reference in subject.rows:
        if reference.entry is None:
            means[reference.name] = reference.scores[metric.name].mean
    if not means or metric.direction is not Direction.LOWER:
        return "mean over the horizon; this ranks"

    best = min(means, key=lambda name: (math.isnan(means[name]), means[name]))
    ratio = math.nan
    if means[best] > 0.0:
        ratio = row.scores[metric.name].mean / means[best]
    return f"{text(ratio, 2)} × {best}"


def draw_flags(subject: Subject) -> Markup:
    """Return flags and warnings of every entry."""
    parts = []
    for entry in subject.entries:
        if len(subject.entries) > 1:
            parts.append(tag("h4", entry.name))
        parts.append(tag("ul", *_draw_entry_flags(entry), class_="flags"))
    return join(parts)


def _draw_entry_flags(entry: ReportEntry) -> list[Markup]:
    items = []
    for flag in entry.card.flags:
        state, kind = FLAG_STATES[flag.raised]
        reasons = ""
        if flag.reasons:
            reasons = f": {'; '.join(flag.reasons)}"
        evidence = []
        for name, value in flag.evidence.items():
            evidence.append(f"{name.replace('_', ' ')} {text(value)}")
        flag_name = flag.name.replace("_", " ")
        details = ", ".join(evidence)
        items.append(_draw_flag(state, kind, flag_name, reasons, details))

    for warning in entry.card.warnings:
        details = (
            f"{warning.where}: expected {warning.expected}, got {warning.got}. "
            f"{warning.fix}"
        )
        message = f": {warning.what}"
        items.append(_draw_flag("warning", "warn", warning.check, message, details))

    diverged_at = entry.card.header.diverged_at
    if diverged_at:
        places = []
        for scenario, frame in sorted(diverged_at.items()):
            places.append(f"scenario {scenario} at frame {frame}")
        message = f": the rollout is frozen from there on: {', '.join(places)}"
        items.append(_draw_flag("warning", "warn", "diverged", message))
    return items


def _draw_flag(
    state: str, kind: str, name: str, message: str, details: str | None = None
) -> Markup:
    badge = tag("span", state, class_=f"flag {kind}")
    parts: list[object] = [tag("strong", name), message]
    if details is not None:
        below = tag("span", details, class_="sub")
        parts.append(below)
    message_part = tag("span", *parts)
    return tag("li", badge, message_part)


def draw_identity(subject: Subject) -> Markup:
    """Return what was scored, by hash, and the command that scores it again."""
    header = subject.entries[0].card.header
    data_set = f"{header.split}/{header.size} version {header.dataset_version}"
    rows: list[list[object]] = [
        ["data set", tag("code", data_set)],
        ["data set SHA-256", tag("code", header.dataset_sha256)],
    ]
    head = ["what", "value"]
    parts = [draw_table(head, rows, kind="text", label="Data set")]
    for entry in subject.entries:
        parts.append(tag("h4", entry.name))
        rows = _identity_rows(entry)
        parts.append(draw_table(head, rows, kind="text", label=entry.name))

    files = [entry.predictions.name for entry in subject.entries]
    command = f"lagbench score {shlex.join(files)} --report report"
    parts.append(tag("h4", "The same report again"))
    parts.append(tag("pre", command))
    return join(parts)


def _identity_rows(entry: ReportEntry) -> list[list[object]]:
    """Return names and values of what the predictions say about themselves."""
    header = entry.card.header
    parameters = None
    if header.parameters is not None:
        parameters = f"{header.parameters:,}".replace(",", NARROW_SPACE)
    seconds = None
    if header.seconds_per_frame is not None:
        seconds = text(header.seconds_per_frame)
    values = {
        "method": header.method,
        "predictions SHA-256": tag("code", entry.card.predictions_sha256),
        "parameters": parameters,
        "seconds per frame": seconds,
        "device": header.device,
        "seed": header.seed,
        "training": header.training,
    }
    rows: list[list[object]] = []
    for name, value in values.items():
        if value is not None:
            rows.append([name, value])
    return rows
