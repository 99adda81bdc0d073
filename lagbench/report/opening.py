"""The top of the page: what was scored, the numbers that matter, flags and warnings."""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterator

from lagbench.flags import Flag
from lagbench.metrics import Direction, Score, bootstrap_interval
from lagbench.metrics.reductions import STABLE_PEARSON, mean
from lagbench.submission import Finding

from .markup import Markup, join, tag
from .numbers import text
from .page import table
from .subject import Entry, Row, Subject
from .wording import unit, words

__all__ = ["flag_list", "head", "identity", "title"]

TILES = ("vorticity_pearson", "position_rmse", "energy_error", "stable_frames")


def title(subject: Subject) -> str:
    """Return the title of the window."""
    names = ", ".join(entry.name for entry in subject.entries)
    return f"{names} on {subject.exam.size.split} {subject.exam.size.name}"


def head(subject: Subject) -> Markup:
    """Return the top of the page."""
    size, header = subject.exam.size, subject.entries[0].card.header
    setting = subject.exam.setting
    names = " · ".join(entry.name for entry in subject.entries)
    lede = (
        f"Given {setting.input_frames} frames of each of {len(subject.scenarios)} test scenarios, predict the"
        f" next {setting.horizon}. {subject.title}, {size.particles} particles, data set version"
        f" {header.dataset_version}."
    )
    return join(
        [
            tag("p", f"lagbench · score report · {size.split} {size.name}", class_="brand"),
            tag("h1", names),
            tag("p", lede, class_="lede"),
            tag("ul", *_tiles(subject), class_="tiles"),
        ]
    )


def _tiles(subject: Subject) -> Iterator[Markup]:
    best = subject.best_entry
    whose = f"{best.name}: " if len(subject.entries) > 1 else ""
    ranking = subject.ranking.name
    yield _tile(f"{whose}{words(ranking)}", best.scores[ranking], _beside(subject, best))
    for name in TILES:
        score = best.scores.get(name)
        if score is None or name == ranking:
            continue
        if name == "stable_frames":
            yield _tile("stable", score, _stable_of(score))
        elif name == "vorticity_pearson":
            yield _at_frame(subject, score)
        else:
            yield _tile(words(name), score, "mean over the horizon")


def _stable_of(score: Score) -> str:
    """Return out of how many frames, and how many of all scenarios' do not count."""
    lost, every = sum(score.undefined), len(score.scenarios) * len(score.frames)
    said = f"of {len(score.frames)}, correlation above {STABLE_PEARSON}"
    return f"{said}; {lost} of {every} frames undefined" if lost else said


def _tile(what: str, score: Score, more: str) -> Markup:
    return _card(f"{what}{unit(score.metric)}", score.mean, score.interval, more)


def _card(what: str, value: float, bounds: tuple[float, float], more: str) -> Markup:
    low, high = bounds
    spread = "" if math.isnan(low) else tag("span", f"{text(low)} … {text(high)}", class_="more")
    number = tag("span", text(value), class_="big")
    return tag("li", tag("span", what, class_="what"), number, spread, tag("span", more, class_="more"))


def _at_frame(subject: Subject, score: Score) -> Markup:
    values = score.at(subject.key_frame)
    more = f"at frame {subject.key_frame}"
    return _card(words(score.metric.name), mean(values), bootstrap_interval(values), more)


def _beside(subject: Subject, row: Row) -> str:
    """Return how the ranking metric stands beside the better floor."""
    metric = subject.ranking
    floors = [r for r in subject.rows if r.entry is None]
    if not floors or metric.direction is not Direction.LOWER:
        return "mean over the horizon; this ranks"
    floor = min(floors, key=lambda r: (math.isnan(r.scores[metric.name].mean), r.scores[metric.name].mean))
    below = floor.scores[metric.name].mean
    ratio = row.scores[metric.name].mean / below if below > 0.0 else math.nan
    return f"{text(ratio, 2)} × {floor.name}"


def flag_list(subject: Subject) -> Markup:
    """Return flags and warnings of every entry."""
    many = len(subject.entries) > 1
    parts = []
    for entry in subject.entries:
        items = [_flag(flag) for flag in entry.card.flags]
        items += [_warning(finding) for finding in entry.card.warnings]
        items += [_diverged(entry)] if entry.card.header.diverged_at else []
        parts.append(join([tag("h4", entry.name) if many else "", tag("ul", *items, class_="flags")]))
    return join(parts)


def _flag(flag: Flag) -> Markup:
    word, kind = {True: ("raised", "bad"), False: ("clear", "ok"), None: ("unknown", "unknown")}[flag.raised]
    numbers = ", ".join(f"{name.replace('_', ' ')} {text(value)}" for name, value in flag.evidence.items())
    reasons = f": {'; '.join(flag.reasons)}" if flag.reasons else ""
    said = tag(
        "span", tag("strong", flag.name.replace("_", " ")), reasons, tag("span", numbers, class_="sub")
    )
    return tag("li", tag("span", word, class_=f"flag {kind}"), said)


def _warning(finding: Finding) -> Markup:
    more = f"{finding.where}: expected {finding.expected}, got {finding.got}. {finding.fix}"
    said = tag("span", tag("strong", finding.check), f": {finding.what}", tag("span", more, class_="sub"))
    return tag("li", tag("span", "warning", class_="flag warn"), said)


def _diverged(entry: Entry) -> Markup:
    where = ", ".join(f"scenario {i} at frame {f}" for i, f in sorted(entry.card.header.diverged_at.items()))
    said = tag("span", tag("strong", "diverged"), f": the rollout is frozen from there on: {where}")
    return tag("li", tag("span", "warning", class_="flag warn"), said)


def identity(subject: Subject) -> Markup:
    """Return what was scored, by hash, and the command that scores it again."""
    first = subject.entries[0].card.header
    data = [
        ["data set", tag("code", f"{first.split}/{first.size} version {first.dataset_version}")],
        ["data set SHA-256", tag("code", first.dataset_sha256)],
    ]
    parts = [table(["what", "value"], data, kind="text", label="Data set")]
    for entry in subject.entries:
        parts += [
            tag("h4", entry.name),
            table(["what", "value"], _about(entry), kind="text", label=entry.name),
        ]
    files = " ".join(shlex.quote(entry.predictions.name) for entry in subject.entries)
    parts += [tag("h4", "The same report again"), tag("pre", f"lagbench score {files} --report report")]
    return join(parts)


def _about(entry: Entry) -> list[list[object]]:
    header = entry.card.header
    rows: list[list[object]] = [
        ["method", header.method],
        ["predictions SHA-256", tag("code", entry.card.predictions_sha256)],
    ]
    known = {
        "parameters": None if header.parameters is None else f"{header.parameters:,}".replace(",", "\u202f"),
        "seconds per frame": None if header.seconds_per_frame is None else text(header.seconds_per_frame),
        "device": header.device,
        "seed": header.seed,
        "training": header.training,
    }
    return rows + [[name, value] for name, value in known.items() if value is not None]
