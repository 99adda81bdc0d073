"""The score card: what the scorer says of one submission, and its form as scores.json.

It holds no time, host or path, and reductions run in id order: the same predictions
give the same bytes. Numbers have nine significant digits; what is undefined is null.

Skill: how much better than the best floor, ``1 - score / score of the best floor``,
over the ranking metric. The best floor has the least mean over its own scenarios, among
those that count (see :mod:`lagbench.references`); the ratio is over the scenarios that both
have. 1 is perfect, 0 says that nothing was learned, below 0 it is worse than not
learning.

Scores as a scores.json tells them, which may come from anybody: checked before they are
used.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagbench.data.checksums import round_digits
from lagbench.errors import UnreadableFileError, check_regular
from lagbench.metrics.aggregate import (
    LARGEST,
    Score,
    Tally,
    bootstrap_interval,
    mean_over_seeds,
)
from lagbench.metrics.frame import Setting
from lagbench.metrics.metric import Direction, Metric, mean
from lagbench.metrics.significance import Comparison, compare
from lagbench.metrics.table import available
from lagbench.submission.format import MAX_NAME, Header
from lagbench.submission.issues import ValidationIssue

from .flags import Flag

FORMAT = 1
"""Number of the layout of scores.json and scores.nc; stored as ``lagbench_scores``."""

JSON_NAME = "scores.json"

IDENTITY = ("split", "size", "dataset_version", "dataset_sha256", "method")
"""What says which data set was predicted, and by what."""

SUBMISSION = "submission"
"""Row of the submission; the floors have rows of their names."""

LABELS = ("seconds_per_frame", "device", "seed", "parameters", "training")


@dataclass(frozen=True, kw_only=True)
class Skill:
    """How much better a submission is than the best floor."""

    metric: str  # name of the ranking metric
    floor: str  # name of the best floor
    value: float  # 1 - score / score of that floor
    # 95 %: scenarios, those of the floor with them, and seeds are resampled; NaN of few
    # scenarios
    interval: tuple[float, float]
    std: float = math.nan  # sample standard deviation over seeds; NaN for one

    def __str__(self) -> str:
        """Return the value, its interval where it has one, and the floor, as in a
        table.
        """
        low, high = self.interval
        if math.isnan(low):
            interval = ""
        else:
            interval = f" [{low:.3f}, {high:.3f}]"
        return f"{self.value:.3f}{interval} over {self.floor}"


def best_floor(floors: Mapping[str, Score]) -> str | None:
    """Return which of the floors that count has the least mean; None where none has one
    above 0.
    """
    known = {name: score.mean for name, score in floors.items() if score.mean > 0.0}
    if known:
        return min(known, key=lambda name: known[name])
    return None


def skill(seeds: Sequence[Score], floors: Mapping[str, Score]) -> Skill | None:
    """Return the skill of a method beside the scores of the floors in the same metric.

    The interval is that of the ratio of means r = A / B, by the linear part of its
    logarithm: with e the two-way bootstrap of (a_si - r b_i) / (r B), where a_si is the
    score of seed s and b_i that of the floor in scenario i, it is 1 - r exp(e). So it
    never passes 1, and is one point where the ratio is the same everywhere. Two seeds
    say little: its lower end may lie far down.

    Args:
        seeds: score of each seed, over the same scenarios.
        floors: scores of the floors that count, by name.

    Returns:
        None without a floor that counts, without a scenario that both have, and for a
        metric of which less is not better.
    """
    name = best_floor(floors)
    metric = seeds[0].metric
    scenarios = seeds[0].scenarios
    if name is None or metric.direction is not Direction.LOWER:
        return None
    theirs = dict(
        zip(floors[name].scenarios, floors[name].values.tolist(), strict=True)
    )
    base = np.array([theirs.get(i, math.nan) for i in scenarios])
    own = np.stack([score.values for score in seeds])
    both = ~np.isnan(base) & ~np.isnan(own).all(axis=0)
    own = own[:, both]
    base = base[both]
    if not base.any():
        return None
    scale = float(np.mean(base))
    ratio = float(np.mean(mean_over_seeds(own))) / scale
    relative = own / ratio - base if ratio > 0.0 else own  # zeros, and certain
    low, high = bootstrap_interval(relative / scale)
    with_all = own[~np.isnan(own).any(axis=1)]
    return Skill(
        metric=metric.name,
        floor=name,
        value=1.0 - ratio,
        interval=(1.0 - ratio * math.exp(high), 1.0 - ratio * math.exp(low)),
        std=float(np.std(np.mean(with_all, axis=1) / scale, ddof=1))
        if len(with_all) > 1
        else math.nan,
    )


FRAMES = 45
"""Frames of the particle film, evenly spaced over the horizon."""

PARTICLES = 200
"""Particles of the film, evenly spaced over the particle numbers."""


@dataclass(frozen=True, eq=False)
class Preview:
    """Pictures of one scenario; index 0 of ``side`` is the truth, 1 the prediction."""

    scenario: int  # id of the scenario
    map_frames: tuple[int, ...]  # frames of interest and the last one
    # at the compared nodes, NaN elsewhere [1/frame], shape [side, map frame, x node, y
    # node]
    vorticity: NDArray[np.float32]
    # shares of 64 bins over the truth's range of omega, NaN where there is none [1],
    # shape [side, map frame, bin]
    histogram: NDArray[np.float32]
    histogram_range: NDArray[np.float32]  # that range [1/frame], shape [map frame, 2]
    film_frames: tuple[int, ...]
    particles: tuple[int, ...]  # numbers of the particles in the film
    material: NDArray[np.int8]  # their materials, shape [film particle]
    # their positions [length], shape [side, film frame, film particle, 2]
    film: NDArray[np.float32]


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class ScoreCard:
    """What the scorer says of one submission."""

    header: Header  # what the predictions say about themselves
    predictions_sha256: str  # content hash of the predicted positions
    setting: Setting  # the task, as metrics see it
    ranking: str  # name of the metric that ranks
    # statistics by row and scenario: of the submission, and of floors that were
    # measured beside it
    tallies: Mapping[str, Mapping[int, Tally]]
    # scores by row (submission, then floors) and metric
    scores: Mapping[str, Mapping[str, Score]]
    # how much better than the best floor, as scored: it does not follow a replaced
    # `scores`; None where no floor that counts has a score
    skill: Skill | None
    flags: tuple[Flag, ...]  # what a reader should know
    # issues of the validation that do not reject
    warnings: tuple[ValidationIssue, ...]
    preview: Preview  # pictures of the first scenario
    files: tuple[Path, ...] = ()  # scores.json and scores.nc, where they were written

    def __repr__(self) -> str:
        """Return whose card it is, the ranking metric and the skill; the values are too
        many.
        """
        header = self.header
        mean = self.submission[self.ranking].mean
        whose = f"{header.method!r} on {header.split} {header.size}"
        return f"<{type(self).__name__}: {whose}, {self.ranking} {mean:.4g}, skill {self.skill}>"

    @property
    def scenarios(self) -> tuple[int, ...]:
        """Ids of the scenarios, ascending."""
        return tuple(sorted(self.tallies[SUBMISSION]))

    @property
    def reported_frames(self) -> tuple[int, ...]:
        """Frames of interest, and the last one."""
        return tuple(
            sorted(self.setting.slow_frames.intersection(self.setting.predicted_frames))
        )

    @property
    def submission(self) -> Mapping[str, Score]:
        """Scores of the submission, by metric."""
        return self.scores[SUBMISSION]

    def against(self, row: str) -> Comparison:
        """Compare the submission with a floor in the ranking metric."""
        return compare(self.submission[self.ranking], self.scores[row][self.ranking])

    def at(self, path: Path, *more: Path) -> ScoreCard:
        """Return this card with the files that it was written to."""
        return replace(self, files=(path, *more))

    def as_json(self) -> dict[str, Any]:
        """Return the card as what scores.json holds."""
        header = self.header
        setting = self.setting
        used = [score.metric for score in self.submission.values()]
        floors = [row for row in self.scores if row != SUBMISSION]
        return {
            "lagbench_scores": FORMAT,
            **{name: getattr(header, name) for name in IDENTITY},
            "predictions_sha256": self.predictions_sha256,
            **{
                name: getattr(header, name)
                for name in LABELS
                if getattr(header, name) is not None
            },
            "diverged_at": {
                str(i): frame for i, frame in sorted(header.diverged_at.items())
            },
            "task": {
                "input_frames": setting.input_frames,
                "horizon": setting.horizon,
                "frames": list(self.reported_frames),
                "scenarios": list(self.scenarios),
            },
            "ranking_metric": self.ranking,
            "skill": _skill(self.skill),
            "metrics": {metric.name: _described(metric) for metric in used},
            "rows": {
                row: {name: self._score(score, row) for name, score in scores.items()}
                for row, scores in self.scores.items()
            },
            "against": {row: _comparison(self.against(row)) for row in floors},
            "flags": {flag.name: _flag(flag) for flag in self.flags},
            "warnings": [
                {"check": f.check, "what": f.what, "got": f.got} for f in self.warnings
            ],
        }

    def _score(self, score: Score, row: str) -> dict[str, Any]:
        said: dict[str, Any] = {
            "mean": digits(score.mean),
            "interval": [digits(bound) for bound in score.interval],
            "values": [digits(value) for value in score.values.tolist()],
            "undefined": list(score.undefined),
        }
        if score.metric.per_frame:
            said["at"] = {
                str(frame): _at(score, frame, row) for frame in self.reported_frames
            }
        return said


def told_apart(methods: Sequence[str], taken: Collection[str] = ()) -> list[str]:
    """Return the methods; those that occur twice, or have a taken name, with a number.

    >>> told_apart(["gns", "gat", "gns"])
    ['gns (1)', 'gat', 'gns (2)']
    """
    count = Counter([*methods, *taken])
    seen = Counter[str]()
    names = []
    for method in methods:
        seen[method] += 1
        names.append(f"{method} ({seen[method]})" if count[method] > 1 else method)
    return names


def digits(value: float) -> float | None:
    """Return a number with nine significant digits, None where it is none.

    >>> digits(2 / 3)
    0.666666667
    """
    if math.isfinite(value):
        return round_digits(value)
    return None


def _at(score: Score, frame: int, row: str) -> dict[str, Any]:
    values = score.at(frame)
    said: dict[str, Any] = {"mean": digits(mean(values))}
    if row == SUBMISSION:
        said["interval"] = [digits(bound) for bound in bootstrap_interval(values)]
    return said


def _described(metric: Metric) -> dict[str, Any]:
    return {
        "family": metric.family,
        "unit": metric.unit,
        "direction": str(metric.direction),
        "perfect": metric.perfect,
        "source": metric.source,
        "summary": metric.summary,
    }


def _skill(found: Skill | None) -> dict[str, Any] | None:
    if found is None:
        return None
    return {
        "floor": found.floor,
        "value": digits(found.value),
        "interval": [digits(bound) for bound in found.interval],
    }


def _comparison(found: Comparison) -> dict[str, Any]:
    return {
        "metric": found.metric,
        "difference": digits(found.difference),
        "interval": [digits(bound) for bound in found.interval],
        "p": digits(found.p),
    }


def _flag(flag: Flag) -> dict[str, Any]:
    numbers = {name: digits(value) for name, value in flag.evidence.items()}
    return {"raised": flag.raised, "reasons": list(flag.reasons), "evidence": numbers}


def spell(card: ScoreCard) -> bytes:
    """Return the bytes of scores.json."""
    text = json.dumps(card.as_json(), indent=1, allow_nan=False, ensure_ascii=False)
    return f"{text}\n".encode()


MAX_BYTES = 64 << 20
"""Longest scores.json that is read [bytes]; those of ours take less than 2 MB."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PublishedScores:
    """What a scores.json says, as far as another submission can be compared with it."""

    # split, size, version and hash of the data set, and the method
    identity: Mapping[str, str]
    predictions_sha256: str  # content hash of the predicted positions
    ranking: str  # name of the metric that ranks
    # scores by row and metric, over the horizon; values per frame are not in the file
    scores: Mapping[str, Mapping[str, Score]]


def read_scores(path: Path) -> PublishedScores:
    """Read a scores.json; metrics that are not installed here are left out."""
    check_regular(path, longest=MAX_BYTES, fix="`lagbench score` writes it")
    try:
        return parse_scores(json.loads(path.read_bytes()))
    except (
        OSError,
        ValueError,
        LookupError,
        TypeError,
        AttributeError,
        ArithmeticError,
    ) as error:
        raise unreadable_scores(path, error) from error
    except RecursionError as error:
        # its own trace is a thousand frames long and says no more
        raise unreadable_scores(path, error) from None


def unreadable_scores(path: Path, error: Exception) -> UnreadableFileError:
    """Return the error for a file that is not the scores.json or scores.nc that its
    name promises.
    """
    return UnreadableFileError(
        f"not a scores{path.suffix} of lagbench",
        where=str(path),
        expected="what `lagbench score` writes beside the predictions",
        got=f"{type(error).__name__}: {str(error)[:MAX_NAME]}",
        fix="score the predictions again: lagbench score predictions.nc",
    )


def parse_scores(held: Mapping[str, Any]) -> PublishedScores:
    """Return what a score card as JSON says: :meth:`ScoreCard.as_json`, or a
    scores.json.
    """
    if held["lagbench_scores"] != FORMAT:
        raise ValueError(
            f"layout {str(held['lagbench_scores'])[:MAX_NAME]!r}, not {FORMAT}"
        )
    ids = tuple(_integer(i, "an id") for i in held["task"]["scenarios"])
    if len(set(ids)) < len(ids):
        raise ValueError("scenario ids that occur twice")
    known = available()
    return PublishedScores(
        identity={name: printable(held, name) for name in IDENTITY},
        predictions_sha256=printable(held, "predictions_sha256"),
        ranking=printable(held, "ranking_metric"),
        scores={
            row: {
                n: _read_score(known[n], ids, said)
                for n, said in scores.items()
                if n in known
            }
            for row, scores in held["rows"].items()
        },
    )


def printable(held: Mapping[str, Any], name: str) -> str:
    """Return text under the rule for attributes of predictions: it goes to terminals as
    it is.
    """
    text = held[name]
    if (
        not isinstance(text, str)
        or not text.strip()
        or len(text) > MAX_NAME
        or not text.isprintable()
    ):
        raise ValueError(f"{name} is not printable text of 1 to {MAX_NAME} characters")
    return text


def _read_score(metric: Metric, ids: tuple[int, ...], said: Mapping[str, Any]) -> Score:
    values = _floats(said["values"])
    undefined = tuple(
        _integer(count, "a number of frames") for count in said["undefined"]
    )
    for numbers in (values, undefined):
        if len(numbers) != len(ids):
            raise ValueError(
                f"{metric.name}: {len(numbers)} values of {len(ids)} scenarios"
            )
    return Score(
        metric=metric,
        scenarios=ids,
        frames=(),
        per_frame=np.empty((len(ids), 0)),
        values=np.array(values),
        undefined=undefined,
    )


def _integer(number: object, what: str) -> int:
    if (
        not isinstance(number, int)
        or isinstance(number, bool)
        or not 0 <= number < 2**31
    ):
        raise ValueError(f"{what} is no integer from 0 to 2^31 - 1")
    return int(number)


def _floats(values: Iterable[float | None]) -> list[float]:
    held = list(values)
    found = [math.nan if value is None else float(value) for value in held]
    if any(isinstance(value, bool) for value in held):
        raise ValueError("a value that is no number")
    if any(
        abs(value) > float(f"{LARGEST:.9g}") for value in found
    ):  # as rounded in the file
        raise ValueError(f"a value beyond {LARGEST:.3g}, which scores do not exceed")
    return found
