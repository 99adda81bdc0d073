"""Tables 5.4 and 5.5 and Figs. 5.13, 5.16: vorticity of six operators at frame 54 of the cavity.

The thesis looks at test scenario T0 alone and forms vorticity by cubic interpolation; ours stands
beside it both ways, for T0 and in the mean over all test scenarios.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

from lagbench.scoring.tables import Table

from .chart import charts, colour, tidy
from .interpolation import Floats, cubic_vorticity, errors
from .plan import Plan
from .roster import label
from .scenes import case_id
from .sheet import Sheet
from .stage import Stage, staged
from .statements import key_frame
from .thesis import OPERATORS, TABLE_5_4
from .wording import number

__all__ = ["BARS", "MEASURES", "bars", "tables"]

SPLIT = "cavity"

MEASURES = {
    "table_5_4": ("mae", "mse", "rmse"),
    "table_5_5": ("mae", "mse", "rmse", "kl"),
}
"""Columns by table."""

BARS = {"fig_5_13": ("pearson", "Pearson correlation"), "fig_5_16": ("kl", "KL divergence [nat]")}
"""Measure by figure."""


def tables(plan: Plan, name: str) -> Sheet:
    """Return Table 5.4 or 5.5: thesis, T0 and mean over scenarios, by both ways to form vorticity."""
    evidence = plan.evidence(SPLIT)
    frame, first = key_frame(evidence), case_id(evidence.size, 0)
    models = {n: evidence.methods[n] for n in (*OPERATORS, "supergat-link") if n in evidence.methods}
    measures = MEASURES[name]

    def scored(model: str, measure: str, scenario: int | None) -> float:
        return models[model].at(f"vorticity_{measure}", frame, scenario)

    cubic = {scenario: dict(_cubic(plan, scenario, frame)) for scenario in plan.exam(SPLIT).scenarios}

    def interpolated(model: str, measure: str, scenario: int | None) -> float:
        chosen = list(cubic) if scenario is None else [scenario]
        found = [cubic[i][model][measure] for i in chosen if model in cubic[i]]
        return sum(found) / len(found) if found else float("nan")

    ways = (
        (f"Score grid ({evidence.size.task.score_grid.cells} cells across, B-spline)", scored),
        ("SciPy griddata, cubic, 40 x 40, as in the thesis", interpolated),
    )
    note = (
        f"Frame {frame}; T0 is our test scenario {first}, another flow than the thesis's. Vorticity is per"
        " frame; the thesis's units are taken to be the same."
    )
    return Sheet(
        notes=(note,),
        tables=tuple(_table(title, list(models), measures, first, way) for title, way in ways),
    )


def _cubic(plan: Plan, scenario: int, frame: int) -> Iterator[tuple[str, Mapping[str, float]]]:
    with staged(plan, SPLIT, scenario, (*OPERATORS, "supergat-link")) as stage:
        truth = _vorticity(stage, None, frame)
        for name in stage.names:
            yield name, errors(truth, _vorticity(stage, name, frame))


def _vorticity(stage: Stage, name: str | None, frame: int) -> Floats:
    held = stage.snapshot(name, frame)
    return cubic_vorticity(held.position, held.velocity, stage.recording.size.bounds)


def _table(
    title: str,
    names: list[str],
    measures: tuple[str, ...],
    first: int | None,
    value: Callable[[str, str, int | None], float],
) -> Table:
    heads = [f"{m.upper()} {who}" for m in measures for who in ("thesis", "ours T0", "ours mean")]
    rows = []
    for name in names:
        row = [label(name)]
        for measure in measures:
            printed = getattr(TABLE_5_4[name], measure) if name in TABLE_5_4 else None
            row += [
                number(printed, 4),
                number(value(name, measure, first)),
                number(value(name, measure, None)),
            ]
        rows.append(tuple(row))
    return Table(title, ("model", *heads), tuple(rows))


def bars(plan: Plan, name: str) -> Sheet:
    """Return Fig. 5.13 or 5.16: one measure of six operators at frame 54, ours beside the thesis's."""
    measure, axis = BARS[name]
    evidence = plan.evidence(SPLIT)
    frame, first = key_frame(evidence), case_id(evidence.size, 0)
    models = {n: evidence.methods[n] for n in OPERATORS if n in evidence.methods}
    series: dict[str, Mapping[str, float]] = {
        "thesis, T0": {n: getattr(row, measure) for n, row in TABLE_5_4.items()},
        "ours, T0": {n: m.at(f"vorticity_{measure}", frame, first) for n, m in models.items()},
        "ours, mean": {n: m.at(f"vorticity_{measure}", frame) for n, m in models.items()},
    }
    with charts(3, width=2.9, height=2.6) as drawn:
        for axes, (title, values) in zip(drawn.axes, series.items(), strict=True):
            order = [n for n in OPERATORS if n in values]
            axes.barh([label(n) for n in order], [values[n] for n in order], color=[colour(n) for n in order])
            axes.invert_yaxis()
            tidy(axes, title, axis, "", legend=False)
        picture = drawn.png()
    rows = tuple((label(n), *(number(values.get(n), 4) for values in series.values())) for n in OPERATORS)
    return Sheet(
        notes=(f"Vorticity at frame {frame} on the score grid.",),
        tables=(Table("", ("model", *series), rows),),
        pictures={"": picture},
    )
