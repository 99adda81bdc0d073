"""The one table of metrics: name, formula, unit, direction.

Scorer, board, docs and plots read it. Another package adds metrics by an entry point in
the group ``lagbench.metrics`` that names a :class:`Metric` or a sequence of them.
"""

from __future__ import annotations

import copyreg
import warnings
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from importlib.metadata import EntryPoint
from types import MappingProxyType
from typing import Any

from lagbench.data.grid import Placement
from lagbench.data.registry import (
    PluginWarning,
    Size,
    list_entry_points,
    package_of,
)
from lagbench.errors import (
    LagbenchError,
    UsageError,
    describe_exception,
    suggest_name,
)

from . import (
    bodies,
    conservation,
    distributions,
    lagrangebench,
    pointwise,
    transport,
    vorticity,
)
from .frame import FramePair
from .metric import Metric, metric

GROUP = "lagbench.metrics"
"""Entry-point group that adds metrics."""

OwnMetric = Metric | Callable[[FramePair], float]
OwnMetrics = OwnMetric | Collection[OwnMetric]
"""Metrics that a user hands over in Python; see :func:`own_metrics`."""

FAMILIES: Mapping[str, Sequence[Metric]] = MappingProxyType(
    {
        "pointwise": pointwise.METRICS,
        "vorticity": vorticity.METRICS,
        "distributions": distributions.METRICS,
        "conservation": conservation.METRICS,
        "bodies": bodies.METRICS,
        "transport": transport.METRICS,
        "lagrangebench": lagrangebench.METRICS,
    }
)
"""Our metrics by family, in the order in which they are shown."""

METRICS: Mapping[str, Metric] = MappingProxyType(
    {metric.name: metric for family in FAMILIES.values() for metric in family}
)
"""Our metrics by name."""

STATISTICS = tuple(
    sorted({statistic for metric in METRICS.values() for statistic in metric.of})
)
"""Names of the statistics of our metrics; other packages may measure more."""

CHOSEN = (
    "vorticity_nrmse",
    "vorticity_rmse",
    "vorticity_pearson",
    "stable_frames",
    "spectrum_error",
    "vorticity_kl",
    "vorticity_w1",
    "motion_distance",
    "cloud_distance",
    "position_rmse_20",
    "position_rmse",
    "velocity_rmse",
    "mse_avg",
    "mse_end",
    "energy_ratio",
    "momentum_error",
    "angular_momentum_error",
    "density_rmse",
    "divergence_rms",
    "divergence_rms_true",
    "outside_share",
    "active_frames",
    "shape_error",
    "connectivity",
    "sliced_w2",
    "sinkhorn_pot",
)
"""Metrics of the short tables beside the ranking metric; no data set has all."""

RANKING: Mapping[Placement, str] = MappingProxyType(
    {Placement.CELL_CENTRES: "vorticity_nrmse", Placement.NODES: "motion_distance"}
)
"""Metric that ranks: of vorticity in a full box, else of clouds and their motion."""

RANKED_BY_CLOUD = {
    "fluid": 3,
    "multimaterial": 3,
    "fluid-3d": 1,
    "multimaterial-3d": 1,
}
"""MAJOR version by split whose entries were scored without ``motion_distance``."""


def ranking_metric(size: Size) -> str:
    """Return the name of the metric that ranks."""
    if RANKED_BY_CLOUD.get(size.split) == size.major:
        return "cloud_distance"
    return RANKING[Placement(size.task.score_grid.placement)]


def available() -> dict[str, Metric]:
    """Return all metrics by name, those of other installed packages last.

    A package whose metrics cannot be loaded, have the name of another metric, or follow
    from statistics that no metric measures costs these metrics, and a
    :class:`~lagbench.data.registry.PluginWarning` that names it.
    """
    metrics = dict(METRICS)
    point_of: dict[str, EntryPoint] = {}  # of metrics of other packages, by name
    for point in sorted(list_entry_points(GROUP), key=lambda point: point.name):
        if point.value.startswith(f"{__package__}."):
            continue  # METRICS holds ours, whatever version of lagbench is installed
        try:
            value = point.load()
            loaded = value if isinstance(value, Iterable) else (value,)
            for metric in loaded:
                if not isinstance(metric, Metric):
                    raise UsageError(f"{metric!r:.80} is no lagbench.metrics.Metric")
                if metrics.setdefault(metric.name, metric) is not metric:
                    raise UsageError(f"the name {metric.name!r} is taken")
                point_of[metric.name] = point
        except Exception as error:  # importing a stranger's module may raise anything
            is_ours = isinstance(error, LagbenchError)
            _warn_of_package(
                point, str(error) if is_ours else describe_exception(error)
            )

    statistics = _statistics(metrics)
    for name, point in point_of.items():
        missing = sorted(set(metrics[name].of) - statistics)
        if missing:
            reason = (
                f"{name!r} follows from {', '.join(missing)}, which no metric measures"
            )
            _warn_of_package(point, reason)
            del metrics[name]
    return metrics


def _warn_of_package(point: EntryPoint, reason: str) -> None:
    message = (
        f"package {package_of(point)} adds no metric {point.name!r} ({point.value}): "
        f"{reason}"
    )
    warnings.warn(message, PluginWarning, stacklevel=3)


def _statistics(metrics: Mapping[str, Metric]) -> set[str]:
    return {name for name, one in metrics.items() if one.statistic is not None}


def own_metrics(values: object) -> tuple[Metric, ...]:
    """Return metrics that a user hands over in Python, without a package.

    Values are metrics and functions of a frame pair, or one of them.

    A function of a frame pair becomes an observable, which is shown and not judged. It
    has the name of the function, and as summary the first paragraph of its docstring.

    Raises:
        UsageError: a value is neither a metric nor a function; its name is taken, or no
            name for a metric; or it follows from statistics that nothing measures.
    """
    candidates: tuple[object, ...] = (values,)
    if isinstance(values, Iterable) and not isinstance(values, str):
        candidates = tuple(values)
    metrics = []
    table = available()
    for value in candidates:
        own = value
        if callable(value) and hasattr(value, "__name__"):
            own = metric(unit="?", source="none", family="own")(value)
        if not isinstance(own, Metric):
            raise UsageError(
                f"{value!r:.60} is no metric; give a Metric or a named function of a "
                "frame pair; built-in metrics are measured anyway",
                where="metrics",
            )
        if own.name in table:
            raise UsageError(
                f"the name {own.name} is taken; rename it", where="metrics"
            )
        table[own.name] = own
        metrics.append(own)
    statistics = _statistics(table)
    for own in metrics:
        for name in own.of:
            if name not in statistics:
                raise UsageError(
                    f"{own.name} follows from {name!r}, which no metric measures; "
                    f"{suggest_name(name, statistics)}",
                    where="metrics",
                )
    return tuple(metrics)


def select(
    names: Iterable[str | Metric] | None = None,
    *,
    extras: Collection[str] = (),
    known: Mapping[str, Metric] | None = None,
) -> tuple[Metric, ...]:
    """Return metrics with the metrics whose statistics they need, in the table's order.

    Args:
        names: names of metrics, and metrics that are not installed; by default all
            without an extra, or with one of ``extras``.
        extras: extras whose metrics are taken by default.
        known: the table of metrics; all that are installed by default.

    Raises:
        UsageError: no metric has one of the names.
    """
    table = dict(available() if known is None else known)
    if names is None:
        names = [
            one.name
            for one in table.values()
            if one.extra is None or one.extra in extras
        ]

    needed: set[str] = set()
    for choice in names:
        if isinstance(choice, Metric):
            name = choice.name
            table[name] = choice
        else:
            name = choice
        if name not in table:
            raise UsageError(f"no metric {name!r}; {suggest_name(name, table)}")
        needed.update((name, *table[name].of))
    return tuple(one for name, one in table.items() if name in needed)


def _reduce_metric(one: Metric) -> str | tuple[Any, ...]:
    """Return how pickle stores a metric: by its name where it is installed.

    A decorated function cannot be pickled, as its name stands for the metric.
    """
    if METRICS.get(one.name) is one or available().get(one.name) is one:
        return _installed_metric, (one.name,)
    return one.__reduce_ex__(4)


def _installed_metric(name: str) -> Metric:
    """Return a metric that was pickled by its name."""
    known = METRICS if name in METRICS else available()
    if name not in known:
        raise UsageError(f"no metric {name!r}; install the package that adds it")
    return known[name]


copyreg.pickle(Metric, _reduce_metric)
