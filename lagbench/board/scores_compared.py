"""Scores of a model that was run again, beside those that were submitted."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Mapping

import numpy as np

from lagbench.data.checksums import round_digits
from lagbench.errors import ChecksFailedError
from lagbench.metrics.aggregate import Tally, score
from lagbench.metrics.table import METRICS

from .entry import Reproduction, relative_difference

TOLERANCE = 1e-3
"""Relative difference of the ranking metric, its mean over scenarios, up to which a
score counts as reproduced.
"""

DIGITS = 9  # of scores in a record
DIFFERENCE_DIGITS = 2


def sample_scenarios(
    scenarios: Collection[int], model_sha256: str, count: int | None
) -> tuple[int, ...]:
    """Return the scenarios to predict anew, ascending.

    A sample follows from the model, so it is the same in every run.
    """
    if count is None or count >= len(scenarios):
        return tuple(sorted(scenarios))

    def digest(scenario: int) -> bytes:
        return hashlib.sha256(f"{model_sha256} {scenario}".encode()).digest()

    return tuple(sorted(sorted(scenarios, key=digest)[:count]))


def compare(
    metric: str,
    submitted: Mapping[int, Tally],
    reproduced: Mapping[int, Tally],
    *,
    seed: int | None,
    model: str,
    of: int,
) -> Reproduction:
    """Return how a metric of the same scenarios compares.

    Raises:
        ChecksFailedError: one side has no value.
    """
    before = score(METRICS[metric], submitted)
    after = score(METRICS[metric], reproduced)
    if before is None or after is None:
        raise ChecksFailedError(
            "the ranking metric has no value",
            where=metric,
            expected="values before and after",
            got="scenarios without a value",
            fix="score the predictions again: lagbench submit --replace",
        )
    differences = []
    for submitted_value, value in zip(before.values, after.values, strict=True):
        differences.append(relative_difference(submitted_value, value))
    difference = relative_difference(before.mean, after.mean)
    return Reproduction(
        seed=seed,
        model=model,
        metric=metric,
        scenarios=len(reproduced),
        of=of,
        submitted=round_digits(before.mean, DIGITS),
        reproduced=round_digits(after.mean, DIGITS),
        difference=round_digits(difference, DIFFERENCE_DIGITS),
        tolerance=TOLERANCE,
        greatest=round_digits(float(np.max(differences)), DIFFERENCE_DIGITS),
    )
