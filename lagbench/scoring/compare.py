"""Compare two methods over the test scenarios: ``lagbench compare A B``.

The scenarios are the sample, paired by id; so are seeds, where a folder of several is
given. Six scenarios are needed before 5 % can be reached; with fewer only the intervals
are reported. With one seed of each method these weights are compared, not methods.
"""

from __future__ import annotations

import difflib
import math
import os
import re
import shlex
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lagbench.data.hdf5 import read_beginning
from lagbench.data.layout import expand_home, format_ids
from lagbench.data.local import locate, locate_split, suggest_split_of
from lagbench.data.registry import Registry, Size, load
from lagbench.errors import (
    ChecksFailedError,
    DataError,
    LagbenchError,
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
from lagbench.references.table import REFERENCES, references_of
from lagbench.submission.format import MAX_NAME
from lagbench.submission.issues import ValidationResult
from lagbench.submission.other_files import refuse_other_files

from .boards import (
    find_board,
    find_boards_here,
    is_board,
    no_board,
    suggest_board,
)
from .card import JSON_NAME, digits, number_methods
from .published_scores import PublishedScores, parse_scores, read_scores
from .scenario import SUBMISSION
from .score import score
from .score_file import NETCDF_NAME
from .score_file_checks import (
    MAX_SCORE_BYTES,
    find_unreadable,
    read_published_scores,
)

if TYPE_CHECKING:
    import pandas as pd

SAME = ("split", "size", "dataset_sha256")
"""Fields in which two submissions must be equal."""

SCORES = "scores"
"""The folder of score files in a leaderboard, see :mod:`lagbench.board.folder`."""

Place = tuple[str, ...]
"""Split, size and method of an entry."""

MOST_LISTED = 10
"""Names that a message lists; of more it states the number."""

AGAIN = "score the predictions again: lagbench score predictions.nc"


@dataclass(frozen=True, kw_only=True, eq=False)
class Contestant:
    """One of the two methods of a comparison."""

    name: str  # as the user gave it
    # split, size, version and hash of the data set, and the method
    identity: Mapping[str, str]
    predictions: tuple[str, ...]  # content hash of the predicted positions, by seed
    ranking: str  # name of the metric that ranks
    scores: Mapping[str, tuple[Score, ...]]  # of each seed, by metric
    references: Mapping[str, Mapping[str, Score]]  # rows scored beside it


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
        if self.scenarios < FEWEST_SCENARIOS:
            return self._verdict_of_few

        test = self.metrics[self.ranking].test
        if not test.significant:
            return f"{self.ranking}: no difference at 5 % ({self._sample})"
        better = self.second
        if test.difference < 0.0:
            better = self.first
        return f"{self.ranking}: {better} is better ({self._sample})"

    @property
    def _verdict_of_few(self) -> str:
        """The verdict of too few scenarios for a p-value."""
        verb = "decides" if self.scenarios == 1 else "decide"
        verdict = (
            f"{format_count(self.scenarios, 'scenario')} {verb} nothing: a test needs "
            f"{FEWEST_SCENARIOS}"
        )
        if self.scenarios < FEWEST_FOR_INTERVAL:
            return f"{verdict}, an interval {FEWEST_FOR_INTERVAL}"
        return f"{verdict}; read the intervals"

    @property
    def _sample(self) -> str:
        """The p-value with the number of scenarios and seeds behind it."""
        p = self.metrics[self.ranking].test.p
        scenarios = format_count(self.scenarios, "scenario")
        return f"p = {p:.3g}, {scenarios}, {self._seeds_in_words}"

    @property
    def _seeds_in_words(self) -> str:
        first, second = self.seeds
        if self.is_against_reference and first == 1:
            return "one seed: these weights, not the method"
        if self.is_against_reference:
            return f"{first} seeds"
        if first == second == 1:
            return "one seed each: these weights, not the methods"
        if 1 in self.seeds:
            return (
                f"{first} and {second} seeds: of one seed its weights, not the method"
            )
        return f"{first} and {second} seeds"

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
            test = comparison.test
            low, high = test.interval
            line = {
                "metric": name,
                "unit": comparison.metric.unit,
                "side": comparison.side,
                "first": comparison.first,
                "second": comparison.second,
                "difference": test.difference,
                "low": low,
                "high": high,
                "p": test.p,
                "significant": test.significant,
            }
            lines.append(line)
        return pd.DataFrame(lines)

    def as_json(self) -> dict[str, Any]:
        """Return the comparison as plain values; undefined ones are None."""
        metrics = {}
        for name, comparison in self.metrics.items():
            metrics[name] = _metric_as_json(comparison)
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


def _metric_as_json(comparison: MetricComparison) -> dict[str, Any]:
    """Return one metric of two methods as plain values; undefined ones are None."""
    test = comparison.test
    return {
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


@dataclass(frozen=True, kw_only=True)
class _ScoringOptions:
    """Options with which predictions are scored."""

    split: str | None  # name of the split to which both must belong
    root: str | Path | None
    workers: int | None
    registry: Registry | None
    # called with split and size of predictions before they are scored
    examine: Callable[[str, str], None] | None = None


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

            - a scores.json, or a folder that holds one;
            - a folder whose folders hold the scores.json of each seed of a method;
            - a scores.nc, or a score file of a leaderboard. The files of several seeds
              go by their common name without ``_<seed>``, as in
              ``leaderboard/scores/cavity/full/neuralmpm.nc``;
            - an entry of the leaderboard, as in ``cavity/full/neuralmpm``;
            - a predictions.nc, which is scored first.
        second: one of the same. Or a bare name: of a reference in the scores of the
            first (a scores.nc holds only the best one), or of an entry for the same
            data set. If both have that name, the reference is meant.
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
        UsageError: an unknown metric, reference, entry or split, no leaderboard where
            one is named, or the two belong to different splits or sizes, or share a
            file.
        DataError: they belong to data sets of different hashes.
        UnreadableFileError: a file is neither scores nor predictions.
    """
    expected_split = None
    if split is not None:
        expected_split, root, _ = locate_split(split, root=root, registry=registry)
    first = _expand_source(first, "A")
    second = _expand_source(second, "B")
    if board is not None:
        board = expand_home(board, "board")
    board_folder, entries = list_entries(board)
    is_bare = _is_bare_name(second)
    _check_order(first, second, is_bare=is_bare)
    splits = (registry or load()).splits
    first = _find_entry(first, board_folder, entries, splits=splits)
    if not is_bare:
        second = _find_entry(second, board_folder, entries, splits=splits)

    # before anything is scored
    _check_files(first)
    if not is_bare:
        _check_files(second)
        _check_different(first, second)

    def require_second(split: str, size: str) -> None:
        if is_bare:
            tier = locate(split, size, root=root, registry=registry).size
            _require_opponent(str(second), tier, entries=entries)

    scoring = _ScoringOptions(
        split=expected_split,
        root=root,
        workers=workers,
        registry=registry,
        examine=require_second,
    )
    one = _load_contestant(first, scoring)

    def require_same(split: str, size: str) -> None:
        other = {**one.identity, "split": split, "size": size}
        _check_same(f"{one.name} and {second}", one.identity, other)

    is_reference = is_bare and str(second) in one.references
    if is_reference:
        two = _reference_beside(one, str(second))
    elif is_bare:
        two = _load_entry(str(second), one, first, entries=entries, scoring=scoring)
    else:
        two = _load_contestant(second, replace(scoring, examine=require_same))

    between = f"{one.name} and {two.name}"
    _check_same(between, one.identity, two.identity)
    if not is_reference:
        _check_overlap(between, one, two)
    comparisons = _compare_metrics(one, two, metrics)
    _check_scenarios(between, one, two)
    return _describe(one, two, comparisons, is_reference=is_reference)


def _compare_metrics(
    one: Contestant, two: Contestant, metrics: str | Collection[str]
) -> dict[str, MetricComparison]:
    """Compare the ranking metric, then others that judge and are asked for, by name."""
    judging = _judging_metrics(one, two)
    if isinstance(metrics, str):
        metrics = (metrics,)
    for name in metrics:
        _require_of_both(name, one, two)
    chosen = _choose_metrics(metrics, judging)
    names = [one.ranking]
    for name in judging:
        if name in chosen and name != one.ranking:
            names.append(name)
    comparisons = {}
    for name in names:
        comparisons[name] = _compare_metric(one.scores[name], two.scores[name])
    return comparisons


def _describe(
    one: Contestant,
    two: Contestant,
    comparisons: Mapping[str, MetricComparison],
    *,
    is_reference: bool,
) -> ComparisonResult:
    """Return the comparison of two methods with what a reader must know of them."""
    first_name, second_name = _names(one, two, is_reference=is_reference)
    has_one_name = one.identity["method"] == two.identity["method"]
    return ComparisonResult(
        split=one.identity["split"],
        size=one.identity["size"],
        first=first_name,
        second=second_name,
        namesakes=has_one_name and not is_reference,
        same_predictions=set(one.predictions) == set(two.predictions),
        ranking=one.ranking,
        scenarios=len(comparisons[one.ranking].test.scenarios),
        seeds=(len(one.predictions), len(two.predictions)),
        is_against_reference=is_reference,
        metrics=comparisons,
    )


def _expand_source(source: str | Path, where: str) -> str | Path:
    """Return a source, a first part ~ of its path replaced by the home folder."""
    path = expand_home(source, where)
    if path == Path(source):
        return source  # as it is written, since it may be a name
    return path


def _is_bare_name(second: str | Path) -> bool:
    """Return whether the second argument is a name, not a path or an existing file."""
    path = Path(second)
    is_plain = path.name == str(second) and not path.suffix
    return is_plain and not os.path.lexists(second)


def list_entries(board: str | Path | None) -> tuple[Path | None, dict[Place, Path]]:
    """Return the folder of a leaderboard, and its entries that have score files.

    A path without the number of a seed stands for all seeds of an entry, as
    :func:`_seed_files` reads it.

    Args:
        board: its folder; ``leaderboard`` in the working folder when None, else that of
            the clone, else none: then the folder is None.

    Raises:
        UsageError: the named folder is no leaderboard.
    """
    try:
        folder = find_board(board, reads=True)
    except UsageError:
        # without a leaderboard, files are compared still
        if board is not None:
            raise
        return None, {}

    entries: dict[Place, Path] = {}
    for path in sorted((folder / SCORES).glob("*/*/*.nc")):
        split, size = path.parts[-3:-1]
        method = re.sub(r"_[0-9]+$", "", path.stem)
        entries[split, size, method] = path.with_name(f"{method}.nc")
    return folder, entries


def _find_entry(
    source: str | Path,
    board: Path | None,
    entries: Mapping[Place, Path],
    *,
    splits: Collection[str],
) -> str | Path:
    """Return the score file of an entry named as split/size/method, else the source.

    The path of a file, which has a suffix, is no name of an entry.

    Raises:
        UsageError: the name of an entry without its data set, or of none; or there is
            no leaderboard.
    """
    if os.path.lexists(source):
        return source
    place = Path(source).parts
    if len(place) == 3 and place in entries:
        return entries[place]
    if len(place) == 3 and place[0] in splits and not Path(source).suffix:
        raise _no_such_entry(place, board, entries)
    data_sets = []
    for split, size, method in entries:
        if (method,) == place:
            data_sets.append(f"{split}/{size}/{method}")
    if data_sets:
        raise UsageError(
            "an entry of the leaderboard is named without its data set",
            where=str(source),
            expected="a file, or split/size/method",
            got=str(source),
            fix=f"name one of {', '.join(data_sets)}",
        )
    return source


def _no_such_entry(
    place: Place, board: Path | None, entries: Mapping[Place, Path]
) -> UsageError:
    """Return the error for the name of an entry that the leaderboard does not have."""
    name = "/".join(place)
    in_other_board = suggest_board(name, searched=board)
    if board is None:
        return no_board(fix=in_other_board, offered=find_boards_here())
    names = ["/".join(known) for known in entries if known[0] == place[0]]
    return UsageError(
        "no such entry",
        where=str(board),
        expected="SPLIT/SIZE/METHOD, as in cavity/mini/gns",
        got=ascii(name),
        fix=in_other_board or suggest_name(name, names),
    )


def _check_files(source: str | Path) -> None:
    """Refuse a method of which some file is no regular one."""
    for path in _seed_files(Path(source)):
        refuse_other_files(path)
        check_regular(path)


def _check_different(first: str | Path, second: str | Path) -> None:
    """Refuse two methods that share a file, by whatever paths it is named."""
    first_files = {os.path.realpath(path) for path in _seed_files(Path(first))}
    second_files = {os.path.realpath(path) for path in _seed_files(Path(second))}
    shared_files = first_files & second_files
    if shared_files:
        what = "a method cannot be compared with itself"
        got = f"{first} and {second}, which are the same"
        if first_files != second_files:
            what = "the two methods share a file"
            got = f"{first} and {second}, which share {min(shared_files)}"
        raise UsageError(
            what,
            where="A and B",
            expected="two methods without a common file",
            got=got,
            fix="name another file, a reference predictor or an entry of the "
            "leaderboard as B",
        )


def _require_opponent(name: str, size: Size, *, entries: Mapping[Place, Path]) -> None:
    """Refuse a name that is neither a reference nor an entry of a data set."""
    references = [predictor.name for predictor in references_of(size)]
    if name in references or (size.split, size.name, name) in entries:
        return
    methods = [place[2] for place in entries if place[:2] == (size.split, size.name)]
    others = [" ".join(place[:2]) for place in entries if place[2] == name]
    fix = suggest_name(name, {*methods, *references})
    in_other_board = suggest_board(f"{size.split}/{size.name}/{name}")
    if in_other_board is not None:
        fix = in_other_board
    elif name in REFERENCES:
        fix = f"{name} is a reference of other data sets; {fix}"
    elif others:
        fix = f"{name} is an entry of {', '.join(others)}; {fix}"
    elif entries and "did you mean" not in fix:
        fix = f"{_name_nearest_entry(name, entries)}{fix}"
    elif not entries:
        fix = f"no leaderboard is found: --board FOLDER names one; {fix}"
    raise UsageError(
        "no reference predictor and no entry of that name",
        where=f"{size.split} {size.name}",
        expected="a reference predictor, an entry of the leaderboard, or a file",
        got=ascii(name),
        fix=fix,
    )


def _name_nearest_entry(name: str, entries: Iterable[Place]) -> str:
    """Return the beginning of a hint: a near name and its data sets; else no text."""
    methods = {method for _, _, method in entries}
    close_methods = difflib.get_close_matches(name, sorted(methods), n=1, cutoff=0.75)
    if not close_methods:
        return ""
    data_sets = []
    for split, size, method in entries:
        if method == close_methods[0]:
            data_sets.append(f"{split} {size}")
    return f"did you mean {close_methods[0]}, an entry of {', '.join(data_sets)}? "


def _check_order(first: str | Path, second: str | Path, *, is_bare: bool) -> None:
    """Refuse a reference as the first of the two."""
    if str(first) not in REFERENCES or os.path.lexists(first):
        return
    scores = second
    if is_bare:
        scores = "PREDICTIONS"
    raise UsageError(
        "a reference predictor cannot be the first argument",
        where="A, the first of the two",
        expected="predictions, scores, or an entry of the leaderboard",
        got=str(first),
        fix=f"give the reference last: lagbench compare {scores} {first}",
    )


def _no_such_name(
    contestant: Contestant,
    first: str | Path,
    second: str,
    entries: Mapping[Place, Path],
) -> UsageError:
    """Return the error for a name that is neither a reference nor an entry."""
    if second in REFERENCES:
        present = ", ".join(contestant.references) or "no reference"
        return UsageError(
            "these scores do not have the reference",
            where=str(first),
            expected=second,
            got=f"scores of {present}",
            fix="name one of these; a scores.nc has the best one only, scores.json and "
            "predictions.nc have all of the data set",
        )
    split = contestant.identity["split"]
    size = contestant.identity["size"]
    names = set(contestant.references)
    for place in entries:
        if place[:2] == (split, size):
            names.add(place[2])
    hint = ""
    if names:
        hint = f"{suggest_name(second, names)}; or "
    in_other_board = suggest_board(f"{split}/{size}/{second}")
    if in_other_board is not None:
        hint = f"{in_other_board}; or "
    return UsageError(
        "neither a reference, nor an entry of the leaderboard, nor a file",
        where=f"{split} {size}",
        expected="the name of one of these",
        got=ascii(second),
        fix=f"{hint}name scores, predictions or a folder of them",
    )


def _check_overlap(where: str, one: Contestant, two: Contestant) -> None:
    """Refuse methods that share some of their predictions, but not all."""
    shared = set(one.predictions) & set(two.predictions)
    most = max(len(one.predictions), len(two.predictions))
    if 0 < len(shared) < most:
        raise UsageError(
            "some predictions belong to both methods",
            where=where,
            expected="different trainings of the two methods",
            got=f"{len(shared)} in common",
            fix="compare seeds of one method with those of another",
        )


def _check_scenarios(where: str, one: Contestant, two: Contestant) -> None:
    """Refuse predictions of two subsets: they have no scenario in common."""
    of_one = one.scores[one.ranking][0].scenarios
    of_two = two.scores[one.ranking][0].scenarios
    if set(of_one).isdisjoint(of_two):
        raise UsageError(
            "the two methods have no scenario in common",
            where=where,
            expected=f"scenarios {format_ids(of_one)}",
            got=f"scenarios {format_ids(of_two)}",
            fix="compare predictions of one subset; entries of the leaderboard are "
            "predictions of test, so predict with --subset test, or with --subset "
            "shift both times",
        )


def _names(one: Contestant, two: Contestant, *, is_reference: bool) -> list[str]:
    """Return the names of the two methods, numbered where they are equal."""
    methods = (one.identity["method"], two.identity["method"])
    if not is_reference:
        return number_methods(methods)
    return [*number_methods(methods[:1], taken=(two.name,)), two.name]


def _require_of_both(name: str, one: Contestant, two: Contestant) -> None:
    """Refuse a metric that only one of the two methods was scored by."""
    for with_metric, without in ((one, two), (two, one)):
        if name in with_metric.scores and name not in without.scores:
            raise UsageError(
                f"only one of the two methods has the metric {name!r}",
                where="--metric",
                expected="a metric of both",
                got=f"{name!r} of {with_metric.name}, none of {without.name}",
                fix="compare two files of predictions: both are scored here by the "
                "metrics of installed packages, entries and references are not",
            )


def _choose_metrics(metrics: Collection[str], judging: Sequence[str]) -> set[str]:
    """Return the names of the metrics that are compared; by default all that judge."""
    for name in metrics:
        if name not in judging:
            raise UsageError(
                f"no metric {name!r} to compare by",
                where="--metric",
                expected="a metric that judges, of both methods",
                got=ascii(name),
                fix=suggest_name(name, judging),
            )
    return set(metrics or judging)


def _load_contestant(source: str | Path, scoring: _ScoringOptions) -> Contestant:
    """Return a method with the scores of its seeds.

    The references are those beside its first seed.
    """
    seeds = []
    for path in _seed_files(Path(source)):
        scores = _load_scores(path, scoring)
        _check_split(path, scores.identity, scoring.split)
        if SUBMISSION not in scores.scores:
            rows = _list_names(map(repr, scores.scores), empty="no row")
            raise _incomplete_error(str(path), f"a row {SUBMISSION!r}", rows[:MAX_NAME])
        seeds.append(scores)

    first = seeds[0]
    _check_seeds(source, seeds)
    rows_of_seeds = [seed.scores[SUBMISSION] for seed in seeds]
    by_metric = {}
    for name in rows_of_seeds[0]:
        if all(name in scores for scores in rows_of_seeds):
            by_metric[name] = tuple(scores[name] for scores in rows_of_seeds)

    references = dict(first.scores)
    del references[SUBMISSION]
    return Contestant(
        name=str(source),
        identity=first.identity,
        predictions=tuple(seed.predictions_sha256 for seed in seeds),
        ranking=first.ranking,
        scores=by_metric,
        references=references,
    )


def _check_split(
    path: Path, identity: Mapping[str, str], expected_split: str | None
) -> None:
    """Refuse scores of another split than the expected one."""
    if expected_split is None or identity["split"] == expected_split:
        return
    raise UsageError(
        "the scores are of another split",
        where=str(path),
        expected=expected_split,
        got=ascii(identity["split"]),
        fix=suggest_split_of(identity["split"]),
    )


def _check_seeds(source: str | Path, seeds: Sequence[PublishedScores]) -> None:
    """Refuse seeds of different methods, tasks or scenarios, and copies of one seed."""
    first = seeds[0].identity
    first_name = f"{source} ({first['method']})"
    for seed in seeds[1:]:
        where = f"{first_name} and {source} ({seed.identity['method']})"
        _check_same(where, first, seed.identity, more=("method",))

    first_scenarios = _scenarios_of(seeds[0])
    for seed in seeds[1:]:
        scenarios = _scenarios_of(seed)
        # a row without a metric is refused later
        if scenarios and first_scenarios and scenarios != first_scenarios:
            raise UsageError(
                "the seeds of a method have other scenarios",
                where=str(source),
                expected=f"scenarios {format_ids(first_scenarios)}",
                got=f"scenarios {format_ids(scenarios)}",
                fix="keep the seeds of one subset, each with all of its scenarios, in "
                "a folder of their own",
            )

    hashes = {seed.predictions_sha256 for seed in seeds}
    if len(hashes) < len(seeds):
        raise UsageError(
            "the same predictions twice",
            where=str(source),
            expected="another seed of the method in each folder",
            got=f"{len(seeds) - len(hashes)} of {len(seeds)} once more",
            fix="one file stands for one training: leave copies out",
        )


def _scenarios_of(seed: PublishedScores) -> tuple[int, ...]:
    """Return the ids of the scenarios of a seed, the same for all of its metrics."""
    for score_of_metric in seed.scores[SUBMISSION].values():
        return score_of_metric.scenarios
    return ()


def _seed_files(path: Path) -> list[Path]:
    """Return the score files of the seeds of a method.

    Of a folder its own file, or those of its folders; of a file the path itself. A
    missing path may be the name that a leaderboard's files of several seeds share.
    """
    if not os.path.isdir(path):  # unlike Path.is_dir, it takes any name
        return _numbered_files(path) or [path]

    inner_folders = sorted(inner for inner in path.iterdir() if inner.is_dir())
    for folders in ([path], inner_folders):
        files = []
        for folder in folders:
            files += _score_files(folder)[:1]
        if files:
            return files
    fix = "`lagbench score` writes them; or name a predictions.nc"
    if is_board(path):
        option = f"--board {shlex.quote(str(path))}"
        fix = (
            f"it is a leaderboard: name an entry as SPLIT/SIZE/METHOD, with {option}; "
            f"to list them: lagbench leaderboard show {option}"
        )
    names = sorted(inner.name for inner in path.iterdir())
    visible_names = [name for name in names if not name.startswith(".")]
    raise UnreadableFileError(
        "no scores in the folder",
        where=str(path),
        expected=f"{JSON_NAME} or {NETCDF_NAME}, or folders that hold one each, of a "
        f"method's seeds",
        got=_list_names(visible_names, empty="nothing"),
        fix=fix,
    )


def _score_files(folder: Path) -> list[Path]:
    """Return scores.json and scores.nc of a folder, those that exist."""
    files = [folder / JSON_NAME, folder / NETCDF_NAME]
    return [file for file in files if os.path.isfile(file)]


def _numbered_files(path: Path) -> list[Path]:
    """Return the score files of all seeds of a method on a leaderboard.

    The path is the name that they share, without the number of a seed. For any other
    path there are none.
    """
    place = path
    with suppress(OSError):  # the working folder is gone
        place = Path(os.path.abspath(path))
    # as in scores/cavity/mini/method.nc
    is_on_board = path.suffix == ".nc" and place.parts[-4:-3] == ("scores",)
    if not is_on_board or os.path.lexists(path):
        return []
    numbered = re.compile(rf"{re.escape(path.stem)}_[0-9]+")
    files = sorted(path.parent.glob("*.nc"))
    numbered_files = []
    for file in files:
        if numbered.fullmatch(file.stem):
            numbered_files.append(file)
    return numbered_files


def _load_scores(path: Path, scoring: _ScoringOptions) -> PublishedScores:
    """Return the scores of a scores.json, a score file or a predictions.nc."""
    if path.suffix == ".json":
        return read_scores(path)

    real = path.resolve()
    length = real.stat().st_size
    if length > MAX_SCORE_BYTES:
        reason = f"{length} bytes, more than scores take"
    else:
        reason = find_unreadable([real]).get(real, "")
    if not reason:
        return read_published_scores(real)

    def examine(result: ValidationResult) -> None:
        if scoring.examine and result.split and result.size:
            scoring.examine(result.split, result.size)

    try:
        card = score(
            path,
            split=scoring.split,
            root=scoring.root,
            workers=scoring.workers,
            registry=scoring.registry,
            write=False,
            examined=examine,
        )
    except (UnreadableFileError, ChecksFailedError) as error:
        head = read_beginning(path, MAX_SCORE_BYTES)
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
    # through JSON, so that its digits are those of a scores.json
    return parse_scores(card.as_json())


def _load_entry(
    name: str,
    one: Contestant,
    first: str | Path,
    *,
    entries: Mapping[Place, Path],
    scoring: _ScoringOptions,
) -> Contestant:
    """Return the entry of a name for the data set of the first method.

    Args:
        name: name of the entry.
        one: the first method.
        first: where it came from, for the message.
        entries: entries of the leaderboard.
        scoring: options with which predictions are scored.

    Raises:
        UsageError: no entry has the name, or it has the file of the first method.
    """
    place = (one.identity["split"], one.identity["size"], name)
    if place not in entries:
        raise _no_such_name(one, first, name, entries)
    _check_different(first, entries[place])
    return _load_contestant(entries[place], scoring)


def _reference_beside(contestant: Contestant, name: str) -> Contestant:
    """Return a reference that was scored beside a method."""
    scores = {}
    for metric, reference_score in contestant.references[name].items():
        scores[metric] = (reference_score,)
    return replace(
        contestant,
        name=name,
        identity={**contestant.identity, "method": name},
        predictions=("",),
        scores=scores,
    )


def _check_same(
    where: str,
    one: Mapping[str, str],
    two: Mapping[str, str],
    *,
    more: tuple[str, ...] = (),
) -> None:
    """Refuse two submissions that differ in the data set or in ``more`` fields."""
    for key in (*SAME, *more):
        if one[key] == two[key]:
            continue
        fix = "compare submissions to the same split, size and data set"
        if more:
            fix += ", and keep the seeds of each method in a folder of its own"
        kind: type[LagbenchError] = UsageError
        if key == "dataset_sha256":
            kind = DataError
        raise kind(
            f"the two submissions differ in {key}",
            where=where,
            expected=one[key],
            got=two[key],
            fix=fix,
        )


def _judging_metrics(one: Contestant, two: Contestant) -> list[str]:
    """Return the names of the metrics that judge and that both methods have.

    Raises:
        UnreadableFileError: the ranking metric of the first is not among them.
    """
    judging = []
    for name, scores in one.scores.items():
        if scores[0].metric.direction is not Direction.NONE:
            judging.append(name)

    expected = f"values of a ranking metric that judges, {one.ranking!r}"
    if one.ranking not in judging:
        raise _incomplete_error(one.name, expected, _list_names(judging))
    if one.ranking not in two.scores:
        raise _incomplete_error(two.name, expected, _list_names(two.scores))
    common = []
    for name in judging:
        if name in two.scores:
            common.append(name)
    return common


def _list_names(names: Iterable[str], *, empty: str = "no such metric") -> str:
    """Return the first names in one line, and how many more there are."""
    every = list(names)
    line = ", ".join(every[:MOST_LISTED]) or empty
    more = len(every) - MOST_LISTED
    if more > 0:
        return f"{line} and {more} more"
    return line


def _incomplete_error(where: str, expected: str, got: str) -> UnreadableFileError:
    return UnreadableFileError(
        "the scores lack a row, or a ranking metric that judges",
        where=where,
        expected=expected,
        got=got,
        fix=AGAIN,
    )


def _compare_metric(
    first: tuple[Score, ...], second: tuple[Score, ...]
) -> MetricComparison:
    """Compare the seeds of two methods in one metric."""
    return MetricComparison(
        metric=first[0].metric,
        first=_mean(first),
        second=_mean(second),
        undefined=(_count_undefined(first), _count_undefined(second)),
        test=compare_scores(first, second),
    )


def _mean(seeds: tuple[Score, ...]) -> float:
    """Return the mean over seeds, then over scenarios."""
    return mean(mean_over_seeds([seed.values for seed in seeds]))


def _count_undefined(seeds: tuple[Score, ...]) -> int:
    return sum(sum(seed.undefined) for seed in seeds)
