"""Figs. 5.12 and 5.18: histograms of the vorticity of six operators beside the truth's."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from lagbench.scoring.tables import Table

from .chart import TRUTH, Charts, charts, colour, tidy
from .plan import Plan
from .roster import label
from .scenes import case_id, predicted
from .sheet import Sheet
from .stage import Stage, staged
from .statements import key_frame
from .thesis import OPERATORS
from .wording import number

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["FIGURES", "draw_figure"]

SPLIT = "cavity"
BINS = 40

FIGURES = {"fig_5_12": (54,), "fig_5_18": (6, 9, 18, 21, 48, 51)}
"""Frames by figure."""


def draw_figure(plan: Plan, name: str) -> Sheet:
    """Return histograms of T0 at the frames of a figure, and their divergences from the truth's."""
    evidence = plan.evidence(SPLIT)
    frames = FIGURES[name] if len(FIGURES[name]) > 1 else (key_frame(evidence),)
    frames = predicted(evidence.size, frames)
    case = case_id(evidence.size, 0)
    columns = min(len(frames), 2)
    width = 6.0 if columns == 1 else 4.2
    with (
        staged(plan, SPLIT, case or 0, OPERATORS) as stage,
        charts(columns, -(-len(frames) // columns), width=width, height=2.8) as drawn,
    ):
        for axes, frame in zip(drawn.axes, frames, strict=False):
            _histograms(axes, stage, frame, legend=frame == frames[0])
        names = stage.names
        picture = _trimmed(drawn, len(frames))
    rows = [
        (label(n), *(number(evidence.methods[n].at("vorticity_kl_hist", f, case)) for f in frames))
        for n in names
    ]
    return Sheet(
        notes=("Thesis: SuperGAT's histogram follows the truth's best, PointNet's is broadest.",),
        tables=(
            Table(
                "Divergence of the histograms (64 bins) from the truth's, T0 [nat]",
                ("model", *(f"frame {frame}" for frame in frames)),
                tuple(rows),
            ),
        ),
        pictures={"": picture},
    )


def _histograms(axes: Axes, stage: Stage, frame: int, *, legend: bool) -> None:
    pairs = {name: stage.pair(name, frame) for name in stage.names}
    truth = stage.snapshot(None, frame).fields
    true = truth.vorticity[truth.differentiable]
    low, high = np.quantile(true, [0.0, 1.0])
    margin = 0.15 * (high - low) or 1.0
    edges = np.linspace(low - margin, high + margin, BINS + 1)
    axes.stairs(np.histogram(true, edges)[0], edges, color=TRUTH, lw=1.8, label="truth")
    for name, pair in pairs.items():
        held = np.clip(pair.predicted_vorticity, edges[0], edges[-1])
        axes.stairs(np.histogram(held, edges)[0], edges, color=colour(name), lw=1.0, label=label(name))
    tidy(axes, f"frame {frame}, T0", "vorticity [1/frame]", "nodes", legend=legend)


def _trimmed(drawn: Charts, used: int) -> bytes:
    for axes in drawn.axes[used:]:
        axes.set_axis_off()
    return drawn.png()
