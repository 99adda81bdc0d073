"""Figs. 5.14 and 5.15: residuals of the predicted vorticity, over the true one and over the nodes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from lagbench.scoring.tables import Table

from .chart import charts, colour, tidy
from .evidence import Evidence
from .plan import Plan
from .roster import label
from .scenes import case_id
from .sheet import Sheet
from .stage import Stage, staged
from .statements import key_frame
from .thesis import OPERATORS
from .wording import number

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["FIGURES", "draw_figure"]

SPLIT = "cavity"

FIGURES = {"fig_5_14": False, "fig_5_15": True}
"""Whether residuals are drawn over the node's number instead of over the truth."""

MEASURES = ("mean", "std", "max", "p05", "p95", "slope")


def draw_figure(plan: Plan, name: str) -> Sheet:
    """Return the residuals (Eq. 5.22) of six operators at frame 54 of T0."""
    evidence = plan.evidence(SPLIT)
    frame, case = key_frame(evidence), case_id(evidence.size, 0)
    with staged(plan, SPLIT, case or 0, OPERATORS) as stage, charts(3, 2, width=2.9, height=2.4) as drawn:
        limit = _limit(stage, frame)
        for axes, model in zip(drawn.axes, stage.names, strict=False):
            _residuals(axes, stage, model, frame, by_node=FIGURES[name])
            axes.set_ylim(-limit, limit)
        for axes in drawn.axes[len(stage.names) :]:
            axes.set_axis_off()
        picture, names = drawn.png(), stage.names
    return Sheet(
        notes=("Thesis: SuperGAT's residuals are the smallest and spread evenly about zero.",),
        tables=(_table(evidence, names, frame, case),),
        pictures={"": picture},
    )


def _limit(stage: Stage, frame: int) -> float:
    """Return a range that holds all but the extreme residuals of all models but the worst."""
    found = [np.quantile(np.abs(stage.pair(n, frame).vorticity_residual), 0.995) for n in stage.names]
    return float(1.1 * np.sort(found)[-2 if len(found) > 2 else -1]) or 1.0 if found else 1.0


def _residuals(axes: Axes, stage: Stage, name: str, frame: int, *, by_node: bool) -> None:
    pair = stage.pair(name, frame)
    along = np.flatnonzero(pair.nodes.ravel()) if by_node else pair.true_vorticity
    axes.plot(along, pair.vorticity_residual, ".", ms=2.0, color=colour(name))
    axes.axhline(0.0, color="#c0392b", lw=0.8, ls="--")
    x = "node" if by_node else "true vorticity [1/frame]"
    tidy(axes, label(name), x, "residual [1/frame]", legend=False)


def _table(evidence: Evidence, names: Sequence[str], frame: int, case: int | None) -> Table:
    metrics = [f"vorticity_residual_{m}" for m in MEASURES]
    known = [m for m in metrics if names and m in evidence.methods[names[0]].scores]
    rows = [(label(n), *(number(evidence.methods[n].at(m, frame, case)) for m in known)) for n in names]
    heads = [m.removeprefix("vorticity_residual_") for m in known]
    return Table(f"Residuals at frame {frame}, T0 [1/frame]", ("model", *heads), tuple(rows))
