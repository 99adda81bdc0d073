"""Metrics that are not ours and fail.

One of another package costs its own column, not the score. One that a user hands over
ends the scoring.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence

from lagbench.errors import (
    LagbenchError,
    WorkFailedError,
    escape_unprintable,
    find_place_in_extension,
    text_of,
)
from lagbench.metrics.metric import Metric
from lagbench.metrics.table import METRICS
from lagbench.submission.issues import MAX_TEXT, Severity, ValidationIssue, quote

FAILED_METRIC = "metric"
"""Name of the warning for a metric that was left out of a score."""

FIX = "mend it, or leave it out: uninstall the package that adds it"
OWN_FIX = "mend the function, or leave it out of metrics="


class PackageMetricError(WorkFailedError):
    """A metric of another package failed."""

    def __init__(self, metric: str, *, where: str, got: str) -> None:
        self.metric = metric  # its name
        super().__init__(
            f"the metric {metric} failed, which is none of lagbench",
            where=where,
            expected="a number",
            got=got,
            fix=FIX,
        )

    def __reduce__(self) -> tuple[object, ...]:
        """Rebuild with keyword arguments, so that errors cross process borders."""
        rebuild: Callable[..., PackageMetricError] = functools.partial(
            type(self), self.metric, where=str(self.where), got=str(self.got)
        )
        return rebuild, ()


def name_metric(error: Exception) -> Exception:
    """Return the error for a metric of another package that raised an error.

    It names the metric and its line. Another error is returned as it is.
    """
    name = getattr(error, "metric_name", None)
    if name is None or name in METRICS:
        return error
    notes = ", ".join(getattr(error, "__notes__", ()))
    # a metric that a user hands over is in no package
    module = getattr(error, "metric_module", None)
    modules = () if module is None else (module,)
    places = [
        find_place_in_extension(error, *modules),
        getattr(error, "where", None),
        notes or None,
    ]
    where = ", ".join(place for place in places if place)
    return PackageMetricError(name, where=where, got=_describe(error))


def _describe(error: Exception) -> str:
    """Return what a metric raised, or what is wrong with its value, in a short line."""
    if not isinstance(error, LagbenchError):
        return quote(f"{type(error).__name__}: {text_of(error)}")
    description = _shorten(error.what)
    if error.got is not None:
        description += f"; got {_shorten(str(error.got))}"
    return description


def _shorten(text: str) -> str:
    """Return the beginning of a text in one printable line."""
    line = escape_unprintable(" ".join(text.split()))
    if len(line) <= MAX_TEXT:
        return line
    return f"{line[: MAX_TEXT - 3]}..."


def drop_metric(metrics: Sequence[Metric], name: str) -> tuple[Metric, ...]:
    """Return the metrics without one, and without those that follow from it."""
    rest = []
    for metric in metrics:
        if name not in (metric.name, *metric.of):
            rest.append(metric)
    return tuple(rest)


def own_metric_error(error: PackageMetricError) -> WorkFailedError:
    """Return the error for a metric that the user hands over, as it failed."""
    return WorkFailedError(
        f"the metric {error.metric}, which is your own, failed",
        where=error.where,
        expected="a number",
        got=error.got,
        fix=OWN_FIX,
    )


def describe_failure(error: PackageMetricError) -> ValidationIssue:
    """Return the warning for a metric that was left out of a score."""
    return ValidationIssue(
        check=FAILED_METRIC,
        severity=Severity.WARNING,
        what=f"{error.what}; its column is left out",
        where=str(error.where),
        expected=str(error.expected),
        got=f"{error.got} in {error.where}",
        fix=FIX,
    )
