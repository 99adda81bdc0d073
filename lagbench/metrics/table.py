"""The one table of metrics: name, formula, unit, direction.

Scorer, board, docs and plots read it. Another package adds metrics by an entry point in
the group ``lagbench.metrics`` that names a :class:`Metric` or a sequence of them; ours
are registered the same way.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from importlib.metadata import EntryPoint
from types import MappingProxyType

from lagbench.data.grid import Placement
from lagbench.data.registry import Size, list_entry_points
from lagbench.errors import LagbenchError, UsageError, load_entry_point, suggest_name

from . import bodies, conservation, distributions, pointwise, transport, vorticity
from .metric import Metric

GROUP = "lagbench.metrics"
"""Entry-point group that adds metrics."""

FAMILIES: Mapping[str, Sequence[Metric]] = MappingProxyType(
    {
        "pointwise": pointwise.METRICS,
        "vorticity": vorticity.METRICS,
        "distributions": distributions.METRICS,
        "conservation": conservation.METRICS,
        "bodies": bodies.METRICS,
        "transport": transport.METRICS,
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
"""Names of the statistics that they are formed from; other packages may measure more.
"""

CHOSEN = (
    *(
        "vorticity_nrmse",
        "vorticity_rmse",
        "vorticity_pearson",
        "stable_frames",
        "spectrum_error",
    ),
    *(
        "vorticity_kl",
        "vorticity_w1",
        "cloud_distance",
        "position_rmse_20",
        "position_rmse",
    ),
    *(
        "velocity_rmse",
        "mse_avg",
        "mse_end",
        "energy_ratio",
        "momentum_error",
        "angular_momentum_error",
    ),
    *(
        "density_rmse",
        "divergence_rms",
        "divergence_rms_true",
        "outside_share",
        "active_frames",
    ),
    *("shape_error", "connectivity", "sliced_w2", "sinkhorn_pot"),
)
"""Metrics of the short tables, the one that ranks aside; a data set has some of them.
"""


RANKING: Mapping[Placement, str] = MappingProxyType(
    {Placement.CELL_CENTRES: "vorticity_nrmse", Placement.NODES: "cloud_distance"}
)
"""Metric that ranks: of vorticity where the material fills the box, of clouds where it
has a surface.
"""


def ranking_metric(size: Size) -> str:
    """Return the metric that ranks."""
    return RANKING[Placement(size.task.score_grid.placement)]


def available() -> dict[str, Metric]:
    """Return all metrics by name, those of other installed packages last."""
    known = dict(METRICS)
    for point in sorted(list_entry_points(GROUP), key=lambda point: point.name):
        if point.value.startswith(f"{__package__}."):
            continue  # ours stand in METRICS, whatever version of lagbench is installed
        for metric in _load(point):
            if known.setdefault(metric.name, metric) is not metric:
                raise UsageError(
                    f"two metrics are named {metric.name!r}",
                    where=f"entry point {point.name} = {point.value}",
                    fix="rename one, or uninstall its package",
                )
    for metric in known.values():
        if unknown := sorted(
            name
            for name in metric.of
            if getattr(known.get(name), "statistic", None) is None
        ):
            raise UsageError(
                f"metric {metric.name!r} follows from what no metric measures",
                expected="names of metrics that have a statistic",
                got=", ".join(unknown),
                fix="mend or uninstall the package that adds it",
            )
    return known


def _load(point: EntryPoint) -> Sequence[Metric]:
    try:
        given = load_entry_point(point)
        if isinstance(given, Iterable):
            found = tuple(given)
        else:
            found = (given,)
    except Exception as error:  # a stranger's module: importing it may raise anything
        raise UsageError(
            "a package's metrics cannot be loaded",
            where=f"entry point {point.name} = {point.value}",
            got=error.what
            if isinstance(error, LagbenchError)
            else f"{type(error).__name__}: {error}",
            fix="mend or uninstall that package",
        ) from error
    for metric in found:
        if not isinstance(metric, Metric):
            raise UsageError(
                "an entry point holds something that is no metric",
                where=f"entry point {point.name} = {point.value}",
                expected="a lagbench.metrics.Metric or a sequence of them",
                got=type(metric).__name__,
            )
    return found


def select(
    names: Iterable[str] | None = None,
    *,
    extras: Collection[str] = (),
    known: Mapping[str, Metric] | None = None,
) -> tuple[Metric, ...]:
    """Return metrics and those whose statistics they follow from, in the table's
    order.
    """
    table = available() if known is None else known
    if names is None:
        names = [m.name for m in table.values() if m.extra is None or m.extra in extras]
    wanted: set[str] = set()
    for name in names:
        if name not in table:
            raise UsageError(f"no metric {name!r}", fix=suggest_name(name, table))
        wanted |= {name, *table[name].of}
    return tuple(metric for name, metric in table.items() if name in wanted)
