"""Compare two methods over the test scenarios: ``lagbench compare A B``.

The scenarios are the sample, paired by id; so are seeds, where there are several. Six
scenarios are needed before 5 % can be reached; with fewer only the intervals are
reported. With one seed of each method these weights are compared, not methods.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np

from lagbench.data.checksums import round_digits
from lagbench.data.layout import expand_home, format_ids
from lagbench.data.local import locate_split
from lagbench.data.registry import Registry, load
from lagbench.errors import (
    DataError,
    UnreadableFileError,
    UsageError,
    check_regular,
    format_count,
    suggest_name,
)
from lagbench.figures.tables import Table
from lagbench.metrics.aggregate import FEWEST_FOR_INTERVAL, Score, mean_over_seeds
from lagbench.metrics.metric import Direction, Metric, mean
from lagbench.metrics.significance import FEWEST_SCENARIOS, Comparison
from lagbench.metrics.significance import compare as compare_scores
from lagbench.metrics.table import CHOSEN
from lagbench.references.shipped import shipped
from lagbench.references.table import REFERENCES

from .boards import find_board
from .card import JSON_NAME, number_methods
from .front import digits
from .score import score
from .score_file import NETCDF_NAME, SubmissionStatistics, read_statistics
from .tables import (
    ARROWS,
    LEGEND,
    break_name,
    label_metric,
    show_number,
    with_interval,
)
from .task import SUBMISSION

if TYPE_CHECKING:
    import pandas as pd

CHANCE = "?"
"""Mark of a difference that may be chance, behind better or worse."""

TOO_FEW = "too few"
"""What stands instead of better or worse where scenarios decide nothing."""

SAME = ("split", "size", "dataset_sha256")
"""Fields in which two submissions must be equal."""

SCORES = "scores"
"""The folder of score files in a leaderboard, see :mod:`lagbench.board.folder`."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Contestant:
    """One of the two methods of a comparison: the scores of its seeds."""

    name: str  # as the user gave it
    identity: Mapping[str, str]  # split, size, version and hash of the data, method
    ranking: str  # name of the metric that ranks
    predictions: frozenset[str]  # content hashes of the predicted positions
    # scores of each seed by the metrics that all of them have, with nine digits
    scores: Mapping[str, tuple[Score, ...]]
    # the best reference, if any, and its scores in the ranking metric
    best_reference: str | None
    best_reference_score: Score

    @property
    def seed_count(self) -> int:
        """Number of seeds."""
        return len(self.scores[self.ranking])


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

        table = pd.DataFrame.from_dict(self.as_json()["metrics"], orient="index")
        bounds = pd.DataFrame(table.pop("interval").tolist(), table.index, dtype=float)
        table["low"] = bounds[0]
        table["high"] = bounds[1]
        table = table.drop(columns=["undefined", "scenarios"])
        return table.rename_axis("metric").reset_index()

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

            - a scores.nc, a scores.json beside it, or their folder;
            - a folder whose folders hold the scores of each seed of a method;
            - an entry of the leaderboard, as in ``cavity/full/neuralmpm``;
            - a predictions.nc, which is scored first.
        second: one of the same. Or a bare name: of a reference predictor (of a local
            split the best one, beside predictions any), or of an entry for the same
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

    measured: dict[str, dict[str, tuple[Score, ...]]] = {}  # beside predictions

    def load(name: str | Path) -> Contestant:
        seeds = []
        for path in find_scores(name, board):
            try:
                seed = read_statistics(path.resolve())
            except UnreadableFileError:
                # it may be predictions
                with TemporaryDirectory() as scratch:
                    card = score(
                        path,
                        split=expected_split,
                        root=root,
                        workers=workers,
                        registry=registry,
                        output_dir=scratch,
                    )
                    seed = read_statistics(card.files[1])
                    for row in card.scores.keys() - {SUBMISSION}:
                        scores = card.scores[row].items()
                        measured[row] = {metric: (one,) for metric, one in scores}
            seeds.append(seed)
        contestant = _unite(str(name), seeds)
        found_split = contestant.identity["split"]
        if expected_split not in (None, found_split):
            raise UsageError(
                f"the scores of {name} are of the split {found_split!a}, not of "
                f"{expected_split}"
            )
        return contestant

    is_bare = Path(second).name == str(second) and not Path(second).exists()
    if not is_bare or Path(second).suffix:
        find_scores(second, board)  # before the first is scored
    one = load(first)
    references = {}
    if is_bare:
        references = _references_beside(one, registry) | measured
    is_reference = str(second) in references
    if is_reference:
        two = replace(
            one,
            name=str(second),
            identity={**one.identity, "method": str(second)},
            predictions=frozenset(),
            scores=references[str(second)],
        )
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
        seeds=(one.seed_count, two.seed_count),
        is_against_reference=is_reference,
        metrics=comparisons,
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
                if (folder / NETCDF_NAME).is_file():
                    files.append(folder / NETCDF_NAME)
            if files:
                return files
        raise UnreadableFileError(
            f"{path} holds no {NETCDF_NAME}; name the folder that `lagbench score` "
            "wrote, or an entry as split/size/method"
        )
    place = path.parts
    if path.name == JSON_NAME:
        path = path.with_name(NETCDF_NAME)  # it has the same scores
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


def _unite(name: str, seeds: Sequence[SubmissionStatistics]) -> Contestant:
    """Return a method from its seeds.

    Seeds of different methods, tasks or scenarios, and copies of one are refused.
    """
    first = seeds[0]
    rows = []
    for seed in seeds:
        _check_same(first.identity, seed.identity)
        is_same_method = seed.identity["method"] == first.identity["method"]
        if not is_same_method or seed.tallies.keys() != first.tallies.keys():
            raise UsageError(
                f"{name} holds scores of several methods or subsets; keep the seeds of "
                "each method in a folder of its own"
            )
        row = {}
        for metric, one in seed.scores().items():
            values = [round_digits(value) for value in one.values.tolist()]
            row[metric] = replace(one, values=np.array(values))
        if first.ranking not in row:
            raise UnreadableFileError(
                f"the scores of {name} lack {first.ranking}, which ranks; score the "
                "predictions again"
            )
        rows.append(row)
    predictions = frozenset(seed.predictions_sha256 for seed in seeds)
    if len(predictions) < len(seeds):
        raise UsageError(
            f"{name} holds the same predictions twice; one file stands for one training"
        )
    scores = {}
    for metric in rows[0]:
        if all(metric in row for row in rows):
            scores[metric] = tuple(row[metric] for row in rows)
    return Contestant(
        name=name,
        identity=first.identity,
        ranking=first.ranking,
        predictions=predictions,
        scores=scores,
        best_reference=first.best_reference,
        best_reference_score=replace(
            scores[first.ranking][0], values=first.best_reference_values
        ),
    )


def _references_beside(
    method: Contestant, registry: Registry | None
) -> dict[str, dict[str, tuple[Score, ...]]]:
    """Return the scores of references by name and metric: shipped, or the best one."""
    references: dict[str, dict[str, tuple[Score, ...]]] = {}
    if method.best_reference is not None:
        references[method.best_reference] = {
            method.ranking: (method.best_reference_score,)
        }
    with suppress(UsageError):
        size = (registry or load()).size(
            method.identity["split"], method.identity["size"]
        )
        recorded = size.measured
        if recorded and recorded.dataset_sha256 == method.identity["dataset_sha256"]:
            for name, one in (shipped(size) or {}).items():
                references[name] = {}
                for metric, shipped_score in one.scores.items():
                    references[name][metric] = (shipped_score,)
    return references


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
    judging = [
        name
        for name, scores in one.scores.items()
        if name in two.scores and scores[0].metric.direction is not Direction.NONE
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

    of_one = one.scores[one.ranking][0].scenarios
    of_two = two.scores[one.ranking][0].scenarios
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
        for seeds in (one.scores[name], two.scores[name]):
            means.append(mean(mean_over_seeds([seed.values for seed in seeds])))
            undefined.append(sum(sum(seed.undefined) for seed in seeds))
        comparisons[name] = MetricComparison(
            metric=one.scores[name][0].metric,
            first=means[0],
            second=means[1],
            undefined=(undefined[0], undefined[1]),
            test=compare_scores(one.scores[name], two.scores[name]),
        )
    return comparisons


def comparison_tables(
    result: ComparisonResult, *, every: bool = False
) -> Iterator[Table]:
    """Yield which method is better, then means with their units.

    The second column names the first method: it is better or worse than the second. The
    difference is that of the loss: below 0 where the first method is better, also
    where more of the metric is better. With ``every`` all metrics are shown, not only
    the chosen ones.
    """
    differences = []
    means = []
    for comparison in _shown_metrics(result, every=every):
        test = comparison.test
        metric = comparison.metric
        # no unit, so that four columns fit a terminal
        differences.append(
            (
                f"{metric.name}{ARROWS[metric.direction]}",
                _side(comparison),
                with_interval(test.difference, test.interval),
                "-" if math.isnan(test.p) else f"{test.p:.3g}",
            )
        )
        cells = [label_metric(metric)]
        both = (comparison.first, comparison.second)
        for value, undefined in zip(both, comparison.undefined, strict=True):
            mark = f" †{undefined}" if undefined else ""
            cells.append(f"{show_number(value)}{mark}")
        means.append(tuple(cells))
    first = break_name(result.first)
    title = f"{result.first} against {result.second} on {result.split} {result.size}"
    heads = ("metric", f"{first}\nis", "loss difference [95 %]", "p")
    yield Table(title, heads, tuple(differences))
    yield Table("means", ("metric", first, break_name(result.second)), tuple(means))


def comparison_lines(result: ComparisonResult, *, every: bool = False) -> Iterator[str]:
    """Yield the lines below the tables, which explain the marks that these have."""
    yield LEGEND
    yield (
        f"loss difference: {result.first} minus {result.second}; below 0 "
        f"{result.first} is better"
    )
    shown = _shown_metrics(result, every=every)
    if any(any(comparison.undefined) for comparison in shown):
        yield "†: so many frames without a value"
    sides = [_side(comparison) for comparison in shown]
    if any(side.endswith(CHANCE) for side in sides):
        yield f"{CHANCE}: the test finds no difference at 5 %"
    if TOO_FEW in sides:
        yield f"{TOO_FEW}: under {FEWEST_SCENARIOS} scenarios nothing is decided"


def _shown_metrics(result: ComparisonResult, *, every: bool) -> list[MetricComparison]:
    """Return the metrics of the tables: the chosen ones, or all."""
    chosen = (result.ranking, *CHOSEN)
    return [one for name, one in result.metrics.items() if every or name in chosen]


def _side(comparison: MetricComparison) -> str:
    """Return whether the first method is better, and whether that may be chance."""
    side = comparison.side
    if side not in ("better", "worse"):
        return side
    if len(comparison.test.scenarios) < FEWEST_SCENARIOS:
        return TOO_FEW
    return side if comparison.test.significant else f"{side}{CHANCE}"
