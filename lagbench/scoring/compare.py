"""Compare two submissions over the test scenarios: ``lagbench compare A B``.

The scenarios are the sample, paired by id. The exact sign-flip test needs six of them before
5 % can be reached; with fewer no significance is claimed and the intervals speak alone.

Names of methods that stand beside each other.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lagbench.data.registry import Registry
from lagbench.errors import DataError, UnreadableFileError, UsageError, nearest
from lagbench.metrics import Comparison, Direction, Score
from lagbench.metrics import compare as compare_scores
from lagbench.metrics.comparison import FEWEST_SCENARIOS
from lagbench.submission.format import MAX_NAME

from .card import JSON_NAME, PublishedScores, digits, parse_scores, read_scores
from .scenario import SUBMISSION
from .score import score

__all__ = [
    "told_apart",
    "ComparisonResult",
    "Contestant",
    "MetricComparison",
    "compare",
]


def told_apart(methods: Sequence[str], taken: Collection[str] = ()) -> list[str]:
    """Return the methods; those that occur twice, or have a taken name, with a number.

    >>> told_apart(["gns", "gat", "gns"])
    ['gns (1)', 'gat', 'gns (2)']
    """
    count, seen = Counter([*methods, *taken]), Counter[str]()
    names = []
    for method in methods:
        seen[method] += 1
        names.append(f"{method} ({seen[method]})" if count[method] > 1 else method)
    return names


SAME = ("split", "size", "dataset_sha256")
"""What two submissions must share."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Contestant:
    """One side of a comparison."""

    name: str  # what the user called it
    identity: Mapping[str, str]  # split, size, version and hash of the data set, and the method
    predictions_sha256: str  # content hash of the predicted positions
    ranking: str  # name of the metric that ranks
    scores: Mapping[str, Score]  # scores by metric


@dataclass(frozen=True, kw_only=True)
class MetricComparison:
    """Two submissions in one metric."""

    unit: str  # unit of the means
    first: float  # mean of the first over scenarios
    second: float  # mean of the second
    test: Comparison  # difference, interval and p-value, in the metric's loss


@dataclass(frozen=True, kw_only=True)
class ComparisonResult:
    """How two submissions compare."""

    split: str  # split of both
    size: str  # size of both
    first: str  # method of the first, told apart from that of the second
    second: str  # method of the second, likewise, or the name of the floor
    same_predictions: bool  # whether both hold the same positions
    ranking: str  # name of the metric that ranks
    scenarios: int  # how many scenarios both have in that metric
    # comparison by metric, the ranking one first; observables are left out
    metrics: Mapping[str, MetricComparison]

    @property
    def verdict(self) -> str:
        """What the ranking metric says, in one sentence that claims no more than it may."""
        said = self.metrics[self.ranking].test
        if self.same_predictions:
            return "both hold the same predictions"
        if self.scenarios < FEWEST_SCENARIOS:
            return (
                f"{self.scenarios} scenarios: no significance is claimed under {FEWEST_SCENARIOS};"
                " read the intervals"
            )
        if not said.significant:
            return f"{self.ranking}: no difference at 5 % (p = {said.p:.3g}, {self.scenarios} scenarios)"
        better = self.first if said.difference < 0.0 else self.second
        return f"{self.ranking}: {better} is better (p = {said.p:.3g}, {self.scenarios} scenarios)"

    def as_json(self) -> dict[str, Any]:
        """Return the comparison as plain values; what is undefined is None."""
        metrics = {
            name: {
                "unit": found.unit,
                "first": digits(found.first),
                "second": digits(found.second),
                "difference": digits(found.test.difference),
                "interval": [digits(bound) for bound in found.test.interval],
                "p": digits(found.test.p),
                "significant": found.test.significant,
                "scenarios": list(found.test.scenarios),
            }
            for name, found in self.metrics.items()
        }
        fields = ("split", "size", "first", "second", "same_predictions", "ranking", "scenarios", "verdict")
        return {**{name: getattr(self, name) for name in fields}, "metrics": metrics}


def compare(
    first: str | Path,
    second: str | Path,
    *,
    metrics: Collection[str] = (),
    root: str | Path | None = None,
    workers: int | None = None,
    registry: Registry | None = None,
) -> ComparisonResult:
    """Compare two submissions to the same split, size and data set.

    Args:
        first: a scores.json, a folder that holds one, or a predictions.nc, which is then scored.
        second: another; or the name of a floor, which stands in the first's scores.
        metrics: metrics to compare; by default all that judge.
        root: folder of all data sets, where predictions are to be scored.
        workers: worker processes for that.
        registry: where splits are described; ours when None.

    Raises:
        UsageError: an unknown metric, or the two belong to different splits or sizes.
        DataError: they belong to data sets of different hashes.
        UnreadableFileError: a file is neither scores nor predictions.
    """
    one, floors = _contestant(first, root, workers, registry)
    floor = str(second) if str(second) in floors else None
    if floor is not None:
        two = _floor(one, floor, floors[floor])
    else:
        two, _ = _contestant(second, root, workers, registry)
    _check_same(one, two)
    judged = _judged(one, two)
    methods = one.identity["method"], two.identity["method"]
    names = told_apart(methods) if floor is None else [*told_apart(methods[:1], taken=(floor,)), floor]
    wanted = [_known(name, judged) for name in metrics] or judged
    order = sorted({one.ranking, *wanted}, key=lambda name: (name != one.ranking, judged.index(name)))
    found = {name: _compared(one.scores[name], two.scores[name]) for name in order}
    return ComparisonResult(
        split=one.identity["split"],
        size=one.identity["size"],
        first=names[0],
        second=names[1],
        same_predictions=one.predictions_sha256 == two.predictions_sha256,
        ranking=one.ranking,
        scenarios=len(found[one.ranking].test.scenarios),
        metrics=found,
    )


def _contestant(
    source: str | Path, root: str | Path | None, workers: int | None, registry: Registry | None
) -> tuple[Contestant, Mapping[str, Mapping[str, Score]]]:
    """Return a submission and the floors scored beside it."""
    path = Path(source)
    if os.path.isdir(path):  # unlike Path.is_dir, it takes any name
        path = path / JSON_NAME
    held = read_scores(path) if path.suffix == ".json" else _scored(path, root, workers, registry)
    if SUBMISSION not in held.scores:
        raise _incomplete(
            str(path), f"a row {SUBMISSION!r}", ", ".join(map(repr, list(held.scores)[:10]))[:MAX_NAME]
        )
    floors = {row: scores for row, scores in held.scores.items() if row != SUBMISSION}
    contestant = Contestant(
        name=str(source),
        identity=held.identity,
        predictions_sha256=held.predictions_sha256,
        ranking=held.ranking,
        scores=held.scores[SUBMISSION],
    )
    return contestant, floors


def _scored(
    path: Path, root: str | Path | None, workers: int | None, registry: Registry | None
) -> PublishedScores:
    # through JSON, so that its digits are those of a scores.json
    card = score(path, root=root, workers=workers, registry=registry, write=False)
    return parse_scores(card.as_json())


def _floor(beside: Contestant, name: str, scores: Mapping[str, Score]) -> Contestant:
    return Contestant(
        name=name,
        identity={**beside.identity, "method": name},
        predictions_sha256="",
        ranking=beside.ranking,
        scores=scores,
    )


def _check_same(one: Contestant, two: Contestant) -> None:
    for key in SAME:
        first, second = one.identity[key], two.identity[key]
        if first != second:
            kind = DataError if key == "dataset_sha256" else UsageError
            raise kind(
                f"the two submissions differ in {key}",
                where=f"{one.name} and {two.name}",
                expected=first,
                got=second,
                fix="compare submissions to the same split, size and data set",
            )


def _judged(one: Contestant, two: Contestant) -> list[str]:
    """Return the names of the metrics to compare by, the ranking one of the first among them."""
    judging = [name for name, held in one.scores.items() if held.metric.direction is not Direction.NONE]
    for side, names in ((one, judging), (two, two.scores)):
        if one.ranking not in names:
            raise _incomplete(side.name, f"values of a ranking metric that judges, {one.ranking!r}", None)
    return [name for name in judging if name in two.scores]


def _incomplete(where: str, expected: str, got: str | None) -> UnreadableFileError:
    return UnreadableFileError(
        "scores without the row or the ranking metric",
        where=where,
        expected=expected,
        got=got,
        fix="score the predictions again: lagbench score predictions.nc",
    )


def _known(name: str, judged: Collection[str]) -> str:
    if name not in judged:
        raise UsageError(f"no metric {name!r} to compare by", where="--metric", fix=nearest(name, judged))
    return name


def _compared(first: Score, second: Score) -> MetricComparison:
    return MetricComparison(
        unit=first.metric.unit,
        first=first.mean,
        second=second.mean,
        test=compare_scores(first, second),
    )
