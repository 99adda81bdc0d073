"""Compare two methods over the test scenarios: ``lagbench compare A B``.

The scenarios are the sample, paired by id; so are seeds, where a side is a folder of
several. Six scenarios are needed before 5 % can be reached; with fewer no significance
is claimed and the intervals speak alone. With one seed on each side these weights are
compared, not methods.
"""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from lagbench.data.registry import Registry
from lagbench.errors import (
    ChecksFailedError,
    DataError,
    UnreadableFileError,
    UsageError,
    check_regular,
    suggest_name,
)
from lagbench.metrics.aggregate import FEWEST_FOR_INTERVAL, Score, mean_over_seeds
from lagbench.metrics.metric import Direction, Metric, mean
from lagbench.metrics.significance import FEWEST_SCENARIOS, Comparison
from lagbench.metrics.significance import compare as compare_scores
from lagbench.references.table import REFERENCES
from lagbench.submission.format import MAX_NAME

from .card import (
    JSON_NAME,
    SUBMISSION,
    PublishedScores,
    digits,
    parse_scores,
    read_scores,
    told_apart,
)
from .score import score
from .score_file import NETCDF_NAME
from .stored import MAX_SCORE_BYTES, published, unreadable_in_child

SAME = ("split", "size", "dataset_sha256")
"""What two submissions must share."""

AGAIN = "score the predictions again: lagbench score predictions.nc"


@dataclass(frozen=True, kw_only=True, eq=False)
class Contestant:
    """One side of a comparison."""

    name: str  # what the user called it
    # split, size, version and hash of the data set, and the method
    identity: Mapping[str, str]
    predictions: tuple[str, ...]  # content hash of the predicted positions, by seed
    ranking: str  # name of the metric that ranks
    scores: Mapping[str, tuple[Score, ...]]  # of each seed, by metric
    floors: Mapping[str, Mapping[str, Score]]  # rows scored beside it


@dataclass(frozen=True, kw_only=True)
class MetricComparison:
    """Two methods in one metric."""

    metric: Metric
    first: float  # mean of the first over seeds and scenarios
    second: float  # mean of the second
    # frames of either side without a value, which are left out of its mean
    undefined: tuple[int, int]
    test: Comparison  # difference, interval and p-value, in the metric's loss


@dataclass(frozen=True, kw_only=True, repr=False)
class ComparisonResult:
    """How two methods compare."""

    split: str  # of both
    size: str  # of both
    first: str  # method of the first, told apart from that of the second
    second: str  # method of the second, likewise, or the name of the floor
    # whether both methods have one name, so that a number tells them apart
    namesakes: bool
    same_predictions: bool  # whether both hold the same positions
    ranking: str  # name of the metric that ranks
    scenarios: int  # how many both have in that metric
    seeds: tuple[int, int]  # of either side
    floor: bool  # whether the second is a floor, which has no seeds
    # the ranking one first; observables are left out
    metrics: Mapping[str, MetricComparison]

    def __repr__(self) -> str:
        """Return who is compared and the verdict; the values are too many."""
        who = f"{self.first!r} and {self.second!r} on {self.split} {self.size}"
        return f"<{type(self).__name__}: {who}: {self.verdict}>"

    @property
    def verdict(self) -> str:
        """What the ranking metric says, in one sentence that claims no more than it
        may.
        """
        test = self.metrics[self.ranking].test
        if self.same_predictions:
            return "both hold the same predictions"
        if self.scenarios < FEWEST_SCENARIOS:
            said = f"{self.scenarios} scenarios: no significance is claimed under {FEWEST_SCENARIOS}"
            few = self.scenarios < FEWEST_FOR_INTERVAL
            return said + (
                f", no interval under {FEWEST_FOR_INTERVAL}"
                if few
                else "; read the intervals"
            )
        if not test.significant:
            return f"{self.ranking}: no difference at 5 % ({self._sample})"
        if test.difference < 0.0:
            better = self.first
        else:
            better = self.second
        return f"{self.ranking}: {better} is better ({self._sample})"

    @property
    def _sample(self) -> str:
        p, one, two = self.metrics[self.ranking].test.p, *self.seeds
        if self.floor:
            if one > 1:
                what = f"{one} seeds"
            else:
                what = "one seed: these weights, not the method"
        elif one == two == 1:
            what = "one seed each: these weights, not the methods"
        else:
            what = f"{one} and {two} seeds"
            what += (
                ": of one seed its weights, not the method" if 1 in self.seeds else ""
            )
        return f"p = {p:.3g}, {self.scenarios} scenarios, {what}"

    def as_json(self) -> dict[str, Any]:
        """Return the comparison as plain values; what is undefined is None."""
        metrics = {
            name: {
                "unit": found.metric.unit,
                "first": digits(found.first),
                "second": digits(found.second),
                "undefined": list(found.undefined),
                "difference": digits(found.test.difference),
                "interval": [digits(bound) for bound in found.test.interval],
                "p": digits(found.test.p),
                "significant": found.test.significant,
                "scenarios": list(found.test.scenarios),
            }
            for name, found in self.metrics.items()
        }
        fields = (
            "split",
            "size",
            "first",
            "second",
            "same_predictions",
            "ranking",
            "scenarios",
            "verdict",
        )
        held = {name: getattr(self, name) for name in fields}
        return {**held, "seeds": list(self.seeds), "metrics": metrics}


def compare(
    first: str | Path,
    second: str | Path,
    *,
    metrics: Collection[str] = (),
    root: str | Path | None = None,
    workers: int | None = None,
    registry: Registry | None = None,
) -> ComparisonResult:
    """Compare two methods on the same split, size and data set.

    Args:
        first: a scores.json, a folder that holds one, a folder whose folders hold those
            of the seeds of a method; a scores.nc, or a leaderboard's score file, of
            several seeds without their numbers, as in
            ``leaderboard/scores/cavity/full/neuralmpm.nc``; or a predictions.nc, which
            is then scored.
        second: another; or the name of a floor, which stands in the first's scores: in
            a scores.nc the best one, in the ranking metric.
        metrics: metrics to compare; by default all that judge.
        root: folder of all data sets, where predictions are to be scored.
        workers: worker processes for that.
        registry: where splits are described; ours when None.

    Raises:
        UsageError: an unknown metric or floor, or the two belong to different splits or
            sizes.
        DataError: they belong to data sets of different hashes.
        UnreadableFileError: a file is neither scores nor predictions.
    """
    plain = Path(second).name == str(second) and not Path(second).suffix
    bare = plain and not os.path.lexists(second)  # the name of a floor
    if str(first) in REFERENCES and not os.path.lexists(first):
        fix = f"give the floor last: lagbench compare {'PREDICTIONS' if bare else second} {first}"
        raise UsageError(
            "a floor stands in the scores of a submission", got=str(first), fix=fix
        )
    for path in (*_seeds_of(Path(first)), *(() if bare else _seeds_of(Path(second)))):
        check_regular(path)  # before what is there is scored
    one = _contestant(first, root, workers, registry)
    if bare and str(second) in one.floors:
        floor = str(second)
    else:
        floor = None
    if floor is None and bare:
        if str(second) in REFERENCES:
            raise UsageError(
                "these scores do not hold the floor",
                where=str(first),
                expected=str(second),
                got=f"scores of {', '.join(one.floors) or 'no floor'}",
                fix="a scores.nc holds the best floor only: compare predictions.nc or "
                "scores.json",
            )
        if one.floors:
            floors = f"{suggest_name(str(second), one.floors)}; or "
        else:
            floors = ""
        fix = f"{floors}name scores, predictions or a folder of them"
        raise UsageError("neither a floor nor a file", got=ascii(str(second)), fix=fix)
    if floor is None:
        two = _contestant(second, root, workers, registry)
    else:
        two = _floor(one, floor)
    between = f"{one.name} and {two.name}"
    _check_same(between, one.identity, two.identity)
    if floor is None and 0 < len(
        shared := set(one.predictions) & set(two.predictions)
    ) < max(len(one.predictions), len(two.predictions)):
        raise UsageError(
            "both sides have predictions of their own and the same ones",
            where=between,
            expected="other trainings on either side",
            got=f"{len(shared)} in common",
            fix="compare seeds of one method with those of another",
        )
    judged = _judged(one, two)
    methods = one.identity["method"], two.identity["method"]
    if floor is None:
        names = told_apart(methods)
    else:
        names = [*told_apart(methods[:1], taken=(floor,)), floor]
    if isinstance(metrics, str):
        metrics = (metrics,)
    else:
        metrics = metrics
    for name in metrics:
        if name not in judged:
            raise UsageError(
                f"no metric {name!r} to compare by",
                where="--metric",
                fix=suggest_name(name, judged),
            )
    wanted = {one.ranking, *(metrics or judged)}
    order = sorted(wanted, key=lambda name: (name != one.ranking, judged.index(name)))
    found = {name: _compared(one.scores[name], two.scores[name]) for name in order}
    return ComparisonResult(
        split=one.identity["split"],
        size=one.identity["size"],
        first=names[0],
        second=names[1],
        namesakes=floor is None and methods[0] == methods[1],
        same_predictions=set(one.predictions) == set(two.predictions),
        ranking=one.ranking,
        scenarios=len(found[one.ranking].test.scenarios),
        seeds=(len(one.predictions), len(two.predictions)),
        floor=floor is not None,
        metrics=found,
    )


def _contestant(
    source: str | Path,
    root: str | Path | None,
    workers: int | None,
    registry: Registry | None,
) -> Contestant:
    """Return a method with the scores of its seeds, and the floors beside the first of
    them.
    """
    held = []
    for path in _seeds_of(Path(source)):
        if path.suffix == ".json":
            found = read_scores(path)
        else:
            found = _read(path, root, workers, registry)
        if SUBMISSION not in found.scores:
            raise _incomplete(
                str(path),
                f"a row {SUBMISSION!r}",
                ", ".join(map(repr, list(found.scores)[:10]))[:MAX_NAME],
            )
        held.append(found)
    first = held[0]
    own = [one.scores[SUBMISSION] for one in held]
    name, *names = (f"{source} ({one.identity['method']})" for one in held)
    for other, one in zip(names, held[1:], strict=True):
        _check_same(
            f"{name} and {other}", first.identity, one.identity, more=("method",)
        )
    predictions = tuple(one.predictions_sha256 for one in held)
    if len(set(predictions)) < len(held):
        expected = "another seed of the method in each folder"
        fix = "one file stands for one training: leave copies out"
        raise UsageError(
            "the same predictions twice", where=str(source), expected=expected, fix=fix
        )
    common = [name for name in own[0] if all(name in scores for scores in own)]
    return Contestant(
        name=str(source),
        identity=first.identity,
        predictions=predictions,
        ranking=first.ranking,
        scores={name: tuple(scores[name] for scores in own) for name in common},
        floors={
            row: scores for row, scores in first.scores.items() if row != SUBMISSION
        },
    )


def _seeds_of(path: Path) -> list[Path]:
    """Return the score files of a folder: its own, or those of its folders; of a file
    the path itself.

    What is not there may be the name that a leaderboard's files of several seeds share.
    """
    if not os.path.isdir(path):  # unlike Path.is_dir, it takes any name
        place = path
        with suppress(OSError):  # the working folder is gone
            place = Path(os.path.abspath(path))
        on_a_board = path.suffix == ".nc" and place.parts[-4:-3] == ("scores",)
        if on_a_board and not os.path.lexists(path):
            shared = sorted(path.parent.glob("*.nc"))
        else:
            shared = []
        name = re.compile(rf"{re.escape(path.stem)}_[0-9]+")
        return [file for file in shared if name.fullmatch(file.stem)] or [path]
    for folders in (
        [path],
        sorted(inner for inner in path.iterdir() if inner.is_dir()),
    ):
        files = [
            [folder / name for name in (JSON_NAME, NETCDF_NAME)] for folder in folders
        ]
        if found := [
            file for one in files if (file := next(filter(os.path.isfile, one), None))
        ]:
            return found
    raise UnreadableFileError(
        "no scores in the folder",
        where=str(path),
        expected=f"{JSON_NAME} or {NETCDF_NAME}, or folders that hold one each, of a "
        f"method's seeds",
        fix="`lagbench score` writes them; or name a predictions.nc",
    )


def _read(
    path: Path, root: str | Path | None, workers: int | None, registry: Registry | None
) -> PublishedScores:
    real = path.resolve()
    large = (length := real.stat().st_size) > MAX_SCORE_BYTES
    reason = (
        f"{length} bytes, more than scores take"
        if large
        else unreadable_in_child([real]).get(real)
    )
    if reason is None:
        return published(real)
    try:
        # through JSON, so that its digits are those of a scores.json
        return parse_scores(
            score(
                path, root=root, workers=workers, registry=registry, write=False
            ).as_json()
        )
    except (UnreadableFileError, ChecksFailedError) as error:
        with real.open("rb") as stream:
            head = stream.read(MAX_SCORE_BYTES)
        if isinstance(error, ChecksFailedError) and b"lagbench_scores" not in head:
            raise  # predictions that are not valid
        raise UnreadableFileError(
            "neither scores nor predictions",
            where=str(path),
            expected="what `lagbench score` or `lagbench submit` wrote, or a "
            "predictions.nc",
            got=f"as scores: {reason}; as predictions: {error.what}, {error.got}",
            fix=AGAIN,
        ) from error


def _floor(beside: Contestant, name: str) -> Contestant:
    identity = {**beside.identity, "method": name}
    scores = {metric: (score,) for metric, score in beside.floors[name].items()}
    return replace(
        beside, name=name, identity=identity, predictions=("",), scores=scores
    )


def _check_same(
    where: str,
    one: Mapping[str, str],
    two: Mapping[str, str],
    *,
    more: tuple[str, ...] = (),
) -> None:
    for key in (*SAME, *more):
        if (first := one[key]) != (second := two[key]):
            kind = DataError if key == "dataset_sha256" else UsageError
            fix = "compare submissions to the same split, size and data set"
            fix += (
                ", and keep the seeds of each method in a folder of its own"
                if more
                else ""
            )
            what = f"the two submissions differ in {key}"
            raise kind(what, where=where, expected=first, got=second, fix=fix)


def _judged(one: Contestant, two: Contestant) -> list[str]:
    """Return the names of the metrics to compare by, the ranking one of the first among
    them.
    """
    judging = [
        name
        for name, held in one.scores.items()
        if held[0].metric.direction is not Direction.NONE
    ]
    for side, names in ((one, judging), (two, two.scores)):
        if one.ranking not in names:
            raise _incomplete(
                side.name,
                f"values of a ranking metric that judges, {one.ranking!r}",
                None,
            )
    return [name for name in judging if name in two.scores]


def _incomplete(where: str, expected: str, got: str | None) -> UnreadableFileError:
    what = "scores without the row or the ranking metric"
    return UnreadableFileError(what, where=where, expected=expected, got=got, fix=AGAIN)


def _compared(first: tuple[Score, ...], second: tuple[Score, ...]) -> MetricComparison:
    one, two = (
        mean(mean_over_seeds([score.values for score in side]))
        for side in (first, second)
    )
    lost, gone = (
        sum(sum(score.undefined) for score in side) for side in (first, second)
    )
    test = compare_scores(first, second)
    return MetricComparison(
        metric=first[0].metric, first=one, second=two, undefined=(lost, gone), test=test
    )
