"""The one table of metrics: name, formula, unit, direction.

Scorer, board, docs and plots read it. Another package adds metrics by an entry point in
the group ``lagbench.metrics`` that names a :class:`Metric` or a sequence of them.
"""

from __future__ import annotations

import copyreg
import importlib
import sys
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
from .metric import Metric, observable

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
            loaded_metrics = _load(point)
        except Exception as error:  # importing a stranger's module may raise anything
            _warn_of_package(point, _describe(error))
            continue
        for metric in loaded_metrics:
            if metrics.setdefault(metric.name, metric) is metric:
                point_of[metric.name] = point
            else:
                _warn_of_package(point, f"the name {metric.name!r} is taken")

    statistics = set()
    for name, metric in metrics.items():
        if metric.statistic is not None:
            statistics.add(name)
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


def _load(point: EntryPoint) -> Sequence[Metric]:
    """Return the metrics of an entry point of another package."""
    value = point.load()
    metrics: tuple[object, ...] = (value,)
    if isinstance(value, Iterable):
        metrics = tuple(value)

    checked = []
    for metric in metrics:
        if not isinstance(metric, Metric):
            raise UsageError(
                f"it has a {type(metric).__name__}, which is no metric",
                where=point.value,
                expected="a lagbench.metrics.Metric or a sequence of them",
                got=type(metric).__name__,
                fix="decorate its function: see docs/extending.md",
            )
        checked.append(metric)
    return checked


def _describe(error: Exception) -> str:
    if isinstance(error, LagbenchError):
        return error.what
    return describe_exception(error)


def own_metrics(values: object) -> tuple[Metric, ...]:
    """Return metrics that a user hands over in Python, without a package.

    Values are metrics and functions of a frame pair, or one of them.

    A function of a frame pair becomes an observable, which is shown and not judged. It
    has the name of the function, and as summary the first paragraph of its docstring.

    Raises:
        UsageError: a value is neither a metric nor a function; its name is taken, or no
            name for a metric; or it follows from statistics that nothing measures.
    """
    candidates: Iterable[object]
    if isinstance(values, Metric) or callable(values):
        candidates = (values,)
    elif isinstance(values, Iterable) and not isinstance(values, str):
        candidates = values
    else:
        raise _no_own_metric(values)
    metrics = []
    table = available()
    for value in candidates:
        if isinstance(value, Metric):
            own = value
        elif callable(value) and hasattr(value, "__name__"):
            own = observable(value)
        else:
            raise _no_own_metric(value)
        if own.name in table:
            raise UsageError(
                "another metric has the name",
                where="metrics",
                expected="a name of its own for each metric",
                got=own.name,
                fix="rename the function, or give Metric another name=",
            )
        table[own.name] = own
        metrics.append(own)
    for own in metrics:
        _check_statistics(own, table)
    return tuple(metrics)


def _no_own_metric(value: object) -> UsageError:
    """Return the error for a value that is neither a metric nor a named function."""
    fix = "write the function first: see docs/extending.md"
    if isinstance(value, str):
        fix = f"leave the name out: built-in metrics need no metrics=; or {fix}"
    return UsageError(
        "a value is no metric",
        where="metrics",
        expected="lagbench.metrics.Metric, or a named function of a frame pair",
        got=f"{type(value).__name__}: {value!r:.60}",
        fix=fix,
    )


def _check_statistics(own: Metric, table: Mapping[str, Metric]) -> None:
    """Refuse a metric of a user that follows from what no metric measures."""
    for name in own.of:
        if name not in table or table[name].statistic is None:
            statistics = []
            for known_name, metric in table.items():
                if metric.statistic is not None:
                    statistics.append(known_name)
            raise UsageError(
                f"metric {own.name!r} follows from what no metric measures",
                where="of",
                expected="names of metrics with a statistic",
                got=ascii(name),
                fix=suggest_name(name, statistics),
            )


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
        names = []
        for metric in table.values():
            if metric.extra is None or metric.extra in extras:
                names.append(metric.name)

    needed: set[str] = set()
    for choice in names:
        if isinstance(choice, Metric):
            name = choice.name
            table[name] = choice
        else:
            name = choice
        if name not in table:
            raise UsageError(
                f"no metric {name!r}",
                where="names of metrics",
                expected="the name of a metric that is installed",
                got=ascii(name),
                fix=suggest_name(name, table),
            )
        needed.update((name, *table[name].of))
    chosen_metrics = []
    for name, metric in table.items():
        if name in needed:
            chosen_metrics.append(metric)
    return tuple(chosen_metrics)


def _reduce_metric(metric: Metric) -> str | tuple[Any, ...]:
    """Return how pickle stores a metric: by its name, or by its place in a module.

    A decorated function cannot be pickled, as its name stands for the metric. A metric
    that no name leads to is stored by its fields.
    """
    if METRICS.get(metric.name) is metric:
        return _installed_metric, (metric.name,)
    place = _find_in_module(metric)
    if place is not None:
        return _metric_at, place
    if available().get(metric.name) is metric:
        return _installed_metric, (metric.name,)
    return metric.__reduce_ex__(4)


def _find_in_module(metric: Metric) -> tuple[str, str] | None:
    """Return the module of a metric's function, and the metric's name in it."""
    function: object = metric.series
    if metric.statistic is not None:
        function = metric.statistic
    module_name = str(getattr(function, "__module__", None))
    module = sys.modules.get(module_name)
    if module is None:
        return None
    for name, value in list(vars(module).items()):
        if value is metric:
            return module_name, name
    return None


def _metric_at(module_name: str, name: str) -> object:
    """Return a metric that was pickled by its place in a module."""
    return getattr(importlib.import_module(module_name), name)


def _installed_metric(name: str) -> Metric:
    """Return a metric that was pickled by its name.

    Raises:
        UsageError: no metric that is installed here has the name.
    """
    metric = METRICS.get(name)
    if metric is None:
        metric = available().get(name)
    if metric is None:
        raise UsageError(
            f"no metric {name!r}",
            where="an object that is unpickled",
            expected="the name of a metric that is installed",
            got=ascii(name),
            fix="install the package that adds it",
        )
    return metric


copyreg.pickle(Metric, _reduce_metric)
