"""The checks of a line of verified.yaml.

Its records are compared with the score files of the entry, its costs and dates with
what there can be.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from lagbench.data.layout import format_ids
from lagbench.data.registry import Size
from lagbench.metrics.metric import mean
from lagbench.submission.issues import ValidationIssue

from .entry import RELATIVE_TOLERANCE, Entry, Reproduction, Verification
from .fields import latest_date
from .folder import VERIFIED
from .issues import make_issue
from .scores_compared import DIGITS, sample_scenarios
from .scores_compared import TOLERANCE as REPRODUCED_TOLERANCE
from .selection import is_current

RankingValues = Mapping[Path, Mapping[int, float]]
"""The ranking metric by scenario, by score file."""


def check_line(
    line: Verification,
    entry: Entry,
    size: Size,
    *,
    ranking_values: RankingValues,
) -> Iterator[ValidationIssue]:
    """Yield the parts of a line that cannot be true.

    Args:
        line: the line of the entry, about its score files and models.
        entry: the entry.
        size: its data set, as it is described now.
        ranking_values: the ranking metric in the score files that are sound.
    """
    where = f"{VERIFIED}, {entry.yaml_path}"
    yield from _check_dates(line, where)
    is_of_today = is_current(entry.dataset, size)
    if line.is_reproduced:
        yield from _check_level(line, entry, ranking_values, where)
        if is_of_today:
            yield from _check_counts(line, len(size.scored_scenarios), where)


def _check_dates(line: Verification, where: str) -> Iterator[ValidationIssue]:
    latest = latest_date()
    dates = {"date": line.date}
    if line.cost is not None:
        dates["cost.date"] = line.cost.date
    for key, date in dates.items():
        if date > latest:
            yield make_issue(
                "verified",
                f"{where}, {key}",
                date,
                what="a date lies in the future",
                expected=f"at most {latest}",
                fix="write the line anew: `lagbench leaderboard reproduce --again`; "
                "without a model `leaderboard check --predictions FILE --record`",
            )


def _check_level(
    line: Verification, entry: Entry, ranking_values: RankingValues, where: str
) -> Iterator[ValidationIssue]:
    """Yield the faults of a level that does not follow from its records."""
    faults = list(_faults_of_records(line, entry, ranking_values))
    if faults:
        yield make_issue(
            "verified",
            where,
            "; ".join(faults),
            what=f"the level is {line.level}, and the records do not show it",
            expected="a record of each seed with a model that agrees "
            "with the score of the entry",
        )


def _check_counts(
    line: Verification, test_count: int, where: str
) -> Iterator[ValidationIssue]:
    counts = {reproduction.of for reproduction in line.reproduced}
    most = max(reproduction.scenarios for reproduction in line.reproduced)
    if counts != {test_count} or most > test_count:
        yield make_issue(
            "verified",
            where,
            f"up to {most} of {sorted(counts)} scenarios",
            what="other numbers of scenarios than the test subset has",
            expected=f"at most {test_count} of {test_count}",
        )


def _faults_of_records(
    line: Verification, entry: Entry, ranking_values: RankingValues
) -> Iterator[str]:
    """Yield why the records of a line do not show that the models gave the scores."""
    seeds = sorted(reproduction.seed or 0 for reproduction in line.reproduced)
    seeds_with_models = []
    for prediction in entry.predictions:
        if prediction.weights is not None:
            seeds_with_models.append(prediction.seed or 0)
    if seeds != sorted(seeds_with_models):
        yield f"records of the seeds {format_ids(seeds)}"
    proofs = [_proves_score(reproduction, entry) for reproduction in line.reproduced]
    if not all(proofs):
        yield f"{sum(proofs)} of {len(proofs)} records agree"
    path_of_seed = {}
    for seed, score_path in zip(entry.seeds, entry.score_paths, strict=True):
        path_of_seed[seed or 0] = score_path
    for reproduction in line.reproduced:
        path = path_of_seed.get(reproduction.seed or 0)
        # a seed without a score file that is sound is reported as such
        if path is not None and path in ranking_values:
            yield from _compare_submitted(reproduction, ranking_values[path], path)


def _proves_score(reproduction: Reproduction, entry: Entry) -> bool:
    """Tell whether a record shows that a model gave the score of its entry again."""
    return (
        reproduction.metric == entry.score.ranking_metric
        and reproduction.tolerance <= REPRODUCED_TOLERANCE
        and reproduction.has_stated_difference
        and reproduction.agrees
    )


def _compare_submitted(
    reproduction: Reproduction, values: Mapping[int, float], path: Path
) -> Iterator[str]:
    """Yield the submitted score of a record that is not that of its score file.

    Args:
        reproduction: the record of a model.
        values: the ranking metric by scenario, of the score file of its seed.
        path: the score file.
    """
    submitted = _mean_of_sample(values, reproduction)
    if not math.isclose(reproduction.submitted, submitted, rel_tol=RELATIVE_TOLERANCE):
        yield (
            f"submitted {reproduction.submitted}, where {path} has "
            f"{submitted:.{DIGITS}g}"
        )


def _mean_of_sample(values: Mapping[int, float], reproduction: Reproduction) -> float:
    """Return the mean over the scenarios that a model was run on again.

    They follow from the model and their number.
    """
    scenarios = sample_scenarios(
        values.keys(), reproduction.model, reproduction.scenarios
    )
    return mean(np.array([values[scenario] for scenario in scenarios]))
