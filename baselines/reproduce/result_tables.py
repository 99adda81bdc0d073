"""Tables of docs/results.md: scores over the horizon, numbers of the thesis beside ours, costs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from lagbench.draw.markdown import table
from lagbench.floors import FLOORS
from lagbench.metrics import Direction, Metric
from lagbench.scoring.tables import ARROWS
from lagbench.scoring.task import ranking_metric

from .evidence import Evidence
from .method import Method
from .roster import ROSTER, label
from .scenes import case_id
from .spending import budget, hardware
from .statements import key_frame, ordered
from .table_4_8 import rollout_table
from .thesis import OPERATORS, TABLE_5_4
from .wording import interval, number

__all__ = ["costs", "horizon", "rollout_errors", "totals", "vorticity_at"]

COLUMNS = (
    *("vorticity_rmse", "mse_avg", "vorticity_pearson", "stable_frames", "position_rmse", "mse_end"),
    *("velocity_rmse", "energy_error", "energy_ratio", "density_rmse", "divergence_rms"),
    *("shape_error", "connectivity", "sliced_w2"),
)
"""Metrics over the horizon, the ranking one first."""

VORTICITY_ONLY = ("vorticity_rmse", "vorticity_pearson", "stable_frames", "divergence_rms", "energy_ratio")
"""Metrics that say little where the material does not fill the box."""


def horizon(evidence: Evidence) -> str:
    """Return the scores over the horizon of all models and floors, best first."""
    ranking = ranking_metric(evidence.size)
    free = ranking != "vorticity_rmse"
    names = [ranking, *(n for n in COLUMNS if n != ranking and not (free and n in VORTICITY_ONLY))]
    methods = evidence.methods
    names = [n for n in names if any(n in m.scores for m in methods.values())]
    metrics = {n: next(m.scores[n].metric for m in methods.values() if n in m.scores) for n in names}
    order = ordered({name: method.scores[ranking] for name, method in methods.items()})
    rows = [
        [label(name), _seeds(methods[name]), *(_cell(methods[name], metric) for metric in names)]
        for name in order
    ]
    return table(["model", "seeds", *(_head(metrics[n]) for n in names)], rows)


def _head(metric: Metric) -> str:
    """Return name, unit and direction, as in "position_rmse [length], lower"."""
    words = [f"{metric.name} [{metric.unit}]", ARROWS[metric.direction]]
    if metric.direction is Direction.TARGET:
        words[1] += f" {metric.perfect:g}"
    return ", ".join(filter(None, words))


def _seeds(method: Method) -> str:
    return "floor" if method.name in FLOORS else str(len(method.seeds))


def _cell(method: Method, metric: str) -> str:
    if metric not in method.scores:
        return "-"
    spread = f" ± {number(method.spread(metric), 2)}" if len(method.seeds) > 1 else ""
    undefined = sum(method.scores[metric].undefined)
    return interval(method.scores[metric]) + spread + (f", {undefined} undefined" if undefined else "")


def vorticity_at(evidence: Evidence) -> str:
    """Return Tables 5.4 and 5.5 and the correlations of Fig. 5.13: ours, T0 in brackets, the thesis's."""
    frame, first = key_frame(evidence), case_id(evidence.size, 0)
    models = evidence.models()
    names = [n for n in (*OPERATORS, *models) if n in models]
    rows = []
    thesis = evidence.size.split == "cavity"
    for name in dict.fromkeys(names):
        row = [label(name)]
        for measure in ("mae", "mse", "rmse", "kl", "pearson"):
            metric = f"vorticity_{measure}"
            mean, case = models[name].at(metric, frame), models[name].at(metric, frame, first)
            row += [f"{number(mean)} ({number(case)})"]
            printed = TABLE_5_4.get(name)
            row += [number(getattr(printed, measure, None), 4)] if thesis else []
        rows.append(row)
    heads = [
        f"{m}{who}" for m in ("MAE", "MSE", "RMSE", "KL", "Pearson") for who in ("", ", thesis")[: 1 + thesis]
    ]
    return table(["model", *heads], rows)


def rollout_errors(evidence: Evidence) -> str:
    """Return Table 4.8: average and end error of a rollout, ours and the thesis's."""
    found = rollout_table(evidence)
    return table(found.columns, found.rows)


def costs(evidence: Evidence) -> str:
    """Return what each model took to train and takes to predict."""
    heads = (
        *("model", "recipe", "changed", "parameters", "seeds", "steps x windows", "CPU hours"),
        *("best step", "hardware", "s/frame", "solver s/frame", "speed-up"),
    )
    return table(heads, [_cost_row(name, method) for name, method in evidence.models().items()])


def _cost_row(name: str, method: Method) -> list[object]:
    record, cost = method.seeds[0].record, method.cost
    recipe = record.get("recipe", {})
    known = [hours for held in method.seeds if (hours := held.cpu_hours) is not None]
    best = [held.record.get("best_step") for held in method.seeds]
    return [
        label(name),
        recipe.get("name", "-"),
        _changed(name),
        "-" if method.parameters is None else f"{method.parameters:,}",
        ", ".join("-" if held.seed is None else str(held.seed) for held in method.seeds),
        budget(record),
        "-" if not known else f"{sum(known):.3g}",
        ", ".join("-" if step is None else str(step) for step in best),
        hardware(record),
        number(cost.seconds_per_frame if cost else None),
        number(cost.solver_seconds_per_frame if cost else None),
        number(cost.speed_up if cost else None),
    ]


def _changed(name: str) -> str:
    return "; ".join(ROSTER[name].settings if name in ROSTER else ()) or "-"


def totals(everything: Sequence[Evidence]) -> Iterator[str]:
    """Yield CPU hours of all trainings per size, and in all."""
    for evidence in everything:
        hours = [h for m in evidence.models().values() for s in m.seeds if (h := s.cpu_hours) is not None]
        if hours:
            size = evidence.size
            yield f"{size.split} {size.name}: {len(hours)} trainings, {sum(hours):.3g} CPU hours"
