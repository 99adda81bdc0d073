"""Compare two methods over the test scenarios: ``lagbench compare A B``.

The scenarios are the sample, paired by id; so are seeds, where there are several. Six
scenarios are needed before 5 % can be reached; with fewer only the intervals are
reported. With one seed of each method these weights are compared, not methods.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lagbench.data.layout import expand_home, format_ids
from lagbench.data.local import locate_split
from lagbench.data.registry import Registry
from lagbench.errors import (
    DataError,
    UnreadableFileError,
    UsageError,
    check_regular,
    format_count,
    suggest_name,
)
from lagbench.metrics.aggregate import FEWEST_FOR_INTERVAL, Score, mean_over_seeds
from lagbench.metrics.metric import Direction, Metric, mean
from lagbench.metrics.significance import FEWEST_SCENARIOS, Comparison
from lagbench.metrics.significance import compare as compare_scores
from lagbench.references.table import REFERENCES

from .boards import find_board
from .card import JSON_NAME, number_methods
from .front import digits
from .published_scores import (
    PublishedScores,
    parse_scores,
    read_published_scores,
    read_scores,
)
from .score import score
from .score_file import NETCDF_NAME
from .task import SUBMISSION

if TYPE_CHECKING:
    import pandas as pd

SAME = ("split", "size", "dataset_sha256")
"""Fields in which two submissions must be equal."""

SCORES = "scores"
"""The folder of score files in a leaderboard, see :mod:`lagbench.board.folder`."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Contestant:
    """One of the two methods of a comparison: the scores of its seeds."""

    name: str  # as the user gave it
    seeds: tuple[PublishedScores, ...]

    @property
    def identity(self) -> Mapping[str, str]:
        """Split, size, version and hash of the data set, and the method."""
        return self.seeds[0].identity

    @property
    def ranking(self) -> str:
        """Name of the metric that ranks."""
        return self.seeds[0].ranking

    @property
    def predictions(self) -> set[str]:
        """Content hashes of the predicted positions."""
        return {seed.predictions_sha256 for seed in self.seeds}

    @property
    def scores(self) -> dict[str, tuple[Score, ...]]:
        """Scores of each seed, by the metrics that all of them have."""
        rows = [seed.scores[SUBMISSION] for seed in self.seeds]
        scores = {}
        for name in rows[0]:
            if all(name in row for row in rows):
                scores[name] = tuple(row[name] for row in rows)
        return scores


@dataclass(frozen=True, kw_only=True)
class MetricComparison:
    """Two methods in one metric."""

    metric: Metric
    first: float  # mean of the first over seeds and scenarios
    second: float  # mean of the second
    # frames of each method without a value, which are left out of its mean
    undefined: tuple[int, int]
    test: Comparison  # difference, interval and p-value, in the metric's loss

    @property
    def side(self) -> str:
        """How the first compares with the second by the means of the loss.

        ``better``, ``worse``, ``same``, or ``unknown`` without a common value.
        """
        difference = self.test.difference
        if math.isnan(difference):
            return "unknown"
        if difference == 0.0:
            return "same"
        if difference < 0.0:
            return "better"
        return "worse"


@dataclass(frozen=True, kw_only=True, repr=False)
class ComparisonResult:
    """Result of the comparison of two methods."""

    split: str  # of both
    size: str  # of both
    first: str  # name of the first method, numbered if both have one name
    second: str  # name of the second method, likewise, or of the reference
    namesakes: bool  # whether both methods have one name
    same_predictions: bool  # whether both have the same positions
    ranking: str  # name of the metric that ranks
    scenarios: int  # number of scenarios that both have in that metric
    seeds: tuple[int, int]  # of each method
    # whether the second is a reference predictor, which has no seeds
    is_against_reference: bool
    # the ranking one first; observables are left out
    metrics: Mapping[str, MetricComparison]
    # of each method, over the classical side, by seed; "" in a scores.nc
    speedups: tuple[tuple[str, ...], tuple[str, ...]] = ((), ())

    def __repr__(self) -> str:
        """Return the two methods and the verdict; the values are too many."""
        methods = f"{self.first!r} and {self.second!r} on {self.split} {self.size}"
        return f"<{type(self).__name__}: {methods}: {self.verdict}>"

    @property
    def verdict(self) -> str:
        """The result in the ranking metric, in one sentence."""
        if self.same_predictions:
            return "both hold the same predictions"
        scenarios = format_count(self.scenarios, "scenario")
        if self.scenarios < FEWEST_SCENARIOS:
            advice = "; read the intervals"
            if self.scenarios < FEWEST_FOR_INTERVAL:
                advice = f", an interval {FEWEST_FOR_INTERVAL}"
            verb = "decides" if self.scenarios == 1 else "decide"
            needs = f"a test needs {FEWEST_SCENARIOS}{advice}"
            return f"{scenarios} {verb} nothing: {needs}"
        test = self.metrics[self.ranking].test
        counts = self.seeds[:1] if self.is_against_reference else self.seeds
        seeds = f"{' and '.join(map(str, counts))} seeds"
        if 1 in counts:
            seeds += ": of one seed its weights, not the method"
        sample = f"p = {test.p:.3g}, {scenarios}, {seeds}"
        if not test.significant:
            return f"{self.ranking}: no difference at 5 % ({sample})"
        better = self.first if test.difference < 0.0 else self.second
        return f"{self.ranking}: {better} is better ({sample})"

    def to_dataframe(self) -> pd.DataFrame:
        """Return the comparison as a table with a line for each metric.

        Columns: ``metric``, ``unit``, ``side`` (``better``, ``worse``, ``same`` or
        ``unknown``: the first method against the second), ``first`` and ``second``
        (means of the methods), ``difference`` (of the losses, below 0 if the first is
        better), ``low`` and ``high`` (its 95 % interval), ``p``, ``significant``.
        Undefined values are NaN. The ranking metric comes first.
        """
        import pandas as pd

        lines = []
        for name, comparison in self.metrics.items():
            low, high = comparison.test.interval
            lines.append(
                {
                    "metric": name,
                    "unit": comparison.metric.unit,
                    "side": comparison.side,
                    "first": comparison.first,
                    "second": comparison.second,
                    "difference": comparison.test.difference,
                    "low": low,
                    "high": high,
                    "p": comparison.test.p,
                    "significant": comparison.test.significant,
                }
            )
        return pd.DataFrame(lines)

    def as_json(self) -> dict[str, Any]:
        """Return the comparison as plain values; undefined ones are None."""
        metrics = {}
        for name, comparison in self.metrics.items():
            test = comparison.test
            metrics[name] = {
                "unit": comparison.metric.unit,
                "side": comparison.side,
                "first": digits(comparison.first),
                "second": digits(comparison.second),
                "undefined": list(comparison.undefined),
                "difference": digits(test.difference),
                "interval": [digits(bound) for bound in test.interval],
                "p": digits(test.p),
                "significant": test.significant,
                "scenarios": list(test.scenarios),
            }
        return {
            "split": self.split,
            "size": self.size,
            "first": self.first,
            "second": self.second,
            "same_predictions": self.same_predictions,
            "ranking": self.ranking,
            "scenarios": self.scenarios,
            "verdict": self.verdict,
            "seeds": list(self.seeds),
            "metrics": metrics,
        }


def compare(
    first: str | Path,
    second: str | Path,
    *,
    metrics: str | Collection[str] = (),
    split: str | Path | None = None,
    board: str | Path | None = None,
    root: str | Path | None = None,
    workers: int | None = None,
    registry: Registry | None = None,
) -> ComparisonResult:
    """Compare two methods on the same split, size and data set.

    Args:
        first: one of these:

            - a scores.json or a scores.nc, or a folder that holds one;
            - a folder whose folders hold the scores of each seed of a method;
            - an entry of the leaderboard, as in ``cavity/full/neuralmpm``;
            - a predictions.nc, which is scored first.
        second: one of the same. Or a bare name: of a reference in the scores of the
            first (a scores.nc holds only the best one), or of an entry for the same
            data set.
        metrics: one or more names of further metrics to compare. The ranking metric is
            always compared. By default all metrics whose direction tells better from
            worse.
        split: the split to which both must belong, or the path of a local split's
            folder; the one that they name when None.
        board: folder of the leaderboard; ``leaderboard`` in the working folder when
            None, else that of the clone.
        root: folder of all data sets, where predictions are to be scored.
        workers: worker processes for that.
        registry: where splits are described; ours when None.

    Raises:
        UsageError: an unknown metric, reference, entry or split, or the two belong to
            different splits or sizes, or share predictions.
        DataError: they belong to data sets of different hashes.
        UnreadableFileError: a file is neither scores nor predictions.
    """
    expected_split = None
    if split is not None:
        expected_split, root, _ = locate_split(split, root=root, registry=registry)

    def load(name: str | Path) -> Contestant:
        seeds = []
        for path in find_scores(name, board):
            seed = _read_seed(path)
            if seed is None:
                card = score(
                    path,
                    split=expected_split,
                    root=root,
                    workers=workers,
                    registry=registry,
                    write=False,
                )
                # through JSON, so that its digits are those of a scores.json
                seed = parse_scores(card.as_json())
            seeds.append(seed)
        contestant = Contestant(name=str(name), seeds=tuple(seeds))
        _check_seeds(contestant, expected_split)
        return contestant

    is_bare = Path(second).name == str(second) and not Path(second).exists()
    if not is_bare or Path(second).suffix:
        find_scores(second, board)  # before the first is scored
    one = load(first)
    is_reference = is_bare and str(second) in one.seeds[0].scores
    if is_reference:
        reference = replace(
            one.seeds[0],
            identity={**one.identity, "method": str(second)},
            predictions_sha256="",
            scores={SUBMISSION: one.seeds[0].scores[str(second)]},
        )
        two = Contestant(name=str(second), seeds=(reference,))
    elif is_bare and not Path(second).suffix:
        two = load(f"{one.identity['split']}/{one.identity['size']}/{second}")
    else:
        two = load(second)

    _check_same(one.identity, two.identity)
    shared = one.predictions & two.predictions
    is_same = one.predictions == two.predictions
    if shared and not is_same:
        raise UsageError(
            f"{one.name} and {two.name} share {len(shared)} predictions; compare "
            "different trainings"
        )
    comparisons = _compare_metrics(one, two, metrics)
    methods = [one.identity["method"], two.identity["method"]]
    if is_reference:
        names = [*number_methods(methods[:1], taken=methods[1:]), methods[1]]
    else:
        names = number_methods(methods)
    return ComparisonResult(
        split=one.identity["split"],
        size=one.identity["size"],
        first=names[0],
        second=names[1],
        namesakes=methods[0] == methods[1] and not is_reference,
        same_predictions=is_same,
        ranking=one.ranking,
        scenarios=len(comparisons[one.ranking].test.scenarios),
        seeds=(len(one.seeds), len(two.seeds)),
        is_against_reference=is_reference,
        metrics=comparisons,
        speedups=(
            tuple(seed.speedup for seed in one.seeds),
            () if is_reference else tuple(seed.speedup for seed in two.seeds),
        ),
    )


def find_scores(source: str | Path, board: str | Path | None = None) -> list[Path]:
    """Return the files of the seeds of a method: scores or predictions.

    Args:
        source: a file; a folder of scores, or of the folders of several seeds; or an
            entry of the leaderboard, split/size/method.
        board: folder of the leaderboard.

    Raises:
        UsageError: there is no such file and no such entry.
        UnreadableFileError: a folder holds no scores.
    """
    path = expand_home(source, "method")
    if path.is_dir():
        for folders in ([path], sorted(path.glob("*/"))):
            files = []
            for folder in folders:
                own = [folder / JSON_NAME, folder / NETCDF_NAME]
                files += [file for file in own if file.is_file()][:1]
            if files:
                return files
        raise UnreadableFileError(
            f"{path} holds no {JSON_NAME} and no {NETCDF_NAME}; name the folder that "
            "`lagbench score` wrote, or an entry as split/size/method"
        )
    place = path.parts
    if path.exists() or len(place) != 3 or path.suffix:
        check_regular(path)
        return [path]

    split, size, method = place
    folder = find_board(board) / SCORES / split / size
    files = []
    names = set()
    for file in sorted(folder.glob("*.nc")):
        name = re.sub(r"_[0-9]+$", "", file.stem)
        names.add(name)
        if method in (name, file.stem):
            files.append(file)
    if not files:
        raise UsageError(
            f"no reference predictor, entry or file {str(source)!a}; "
            f"{suggest_name(method, names | REFERENCES.keys())}"
        )
    return files


def _read_seed(path: Path) -> PublishedScores | None:
    """Return the scores of a scores.json or scores.nc, None of other files."""
    if path.suffix == ".json":
        return read_scores(path)
    try:
        return read_published_scores(path.resolve())
    except UnreadableFileError:
        return None  # it may be predictions


def _check_seeds(contestant: Contestant, expected_split: str | None) -> None:
    """Refuse seeds of different methods, tasks or scenarios, and copies of one seed."""
    first = contestant.seeds[0]
    for seed in contestant.seeds:
        if first.ranking not in seed.scores.get(SUBMISSION, {}):
            raise UnreadableFileError(
                f"the scores of {contestant.name} lack {first.ranking}, which ranks; "
                "score the predictions again"
            )
        is_same_method = seed.identity["method"] == first.identity["method"]
        scenarios = seed.scores[SUBMISSION][first.ranking].scenarios
        if not is_same_method or (
            scenarios != first.scores[SUBMISSION][first.ranking].scenarios
        ):
            raise UsageError(
                f"{contestant.name} holds scores of several methods or subsets; keep "
                "the seeds of each method in a folder of its own"
            )
        _check_same(first.identity, seed.identity)
    if len(contestant.predictions) < len(contestant.seeds):
        raise UsageError(
            f"{contestant.name} holds the same predictions twice; one file stands for "
            "one training"
        )
    split = first.identity["split"]
    if expected_split is not None and split != expected_split:
        raise UsageError(
            f"the scores of {contestant.name} are of the split {split!a}, not of "
            f"{expected_split}"
        )


def _check_same(one: Mapping[str, str], two: Mapping[str, str]) -> None:
    """Refuse scores on two data sets."""
    for key in SAME:
        if one[key] == two[key]:
            continue
        what = f"the scores differ in {key}: {one[key]} and {two[key]}"
        if key == "dataset_sha256":
            raise DataError(f"{what}; compare scores on the same data")
        raise UsageError(f"{what}; compare scores on the same split and size")


def _compare_metrics(
    one: Contestant, two: Contestant, metrics: str | Collection[str]
) -> dict[str, MetricComparison]:
    """Compare the ranking metric, then others that judge and are asked for, by name."""
    if isinstance(metrics, str):
        metrics = (metrics,)
    first_scores = one.scores
    second_scores = two.scores
    judging = [
        name
        for name, scores in first_scores.items()
        if name in second_scores and scores[0].metric.direction is not Direction.NONE
    ]
    if one.ranking not in judging:
        raise UnreadableFileError(
            f"the scores of {two.name} lack {one.ranking}, which ranks; score the "
            "predictions again"
        )
    for name in metrics:
        if name not in judging:
            raise UsageError(
                f"no metric {name!a} that judges and that both methods have; "
                f"{suggest_name(name, judging)}"
            )
    chosen = set(metrics or judging)
    others = [name for name in judging if name in chosen and name != one.ranking]
    names = [one.ranking, *others]

    of_one = first_scores[one.ranking][0].scenarios
    of_two = second_scores[one.ranking][0].scenarios
    if set(of_one).isdisjoint(of_two):
        raise UsageError(
            f"{one.name} and {two.name} have no scenario in common: "
            f"{format_ids(of_one)} and {format_ids(of_two)}; compare predictions of "
            "one subset"
        )
    comparisons = {}
    for name in names:
        means = []
        undefined = []
        for seeds in (first_scores[name], second_scores[name]):
            means.append(mean(mean_over_seeds([seed.values for seed in seeds])))
            undefined.append(sum(sum(seed.undefined) for seed in seeds))
        comparisons[name] = MetricComparison(
            metric=first_scores[name][0].metric,
            first=means[0],
            second=means[1],
            undefined=(undefined[0], undefined[1]),
            test=compare_scores(first_scores[name], second_scores[name]),
        )
    return comparisons
