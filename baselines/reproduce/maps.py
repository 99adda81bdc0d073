"""Figs. 5.5, 5.17, 5.24, 5.25: maps of vorticity and speed, truth beside predictions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from lagbench.draw.panels import Panel
from lagbench.scoring.tables import Table

from .chart import Line, named, panel_rows
from .evidence import Evidence
from .plan import Plan
from .scenes import after_given, case_id, predicted
from .sheet import Sheet
from .stage import Stage, staged
from .statements import key_frame
from .thesis import OPERATORS
from .wording import number, pair

__all__ = ["FIGURES", "Figure", "draw_figure"]


@dataclass(frozen=True, kw_only=True)
class Figure:
    """A figure of maps of test case T0."""

    split: str  # name of the split
    models: tuple[str, ...]  # models beside the truth
    panels: tuple[Panel, ...]  # kinds of map, one picture each
    said: str  # what the thesis says of its figure
    # frames after the last given one; empty for the frame at which models are compared
    after: tuple[int, ...] = ()


FIGURES: Mapping[str, Figure] = {
    "fig_5_5": Figure(
        split="cavity",
        models=("gns-novorticity", "gns"),
        panels=(Panel.VORTICITY, Panel.STREAMLINES),
        said="Thesis: without the vorticity loss GNS develops fewer or weaker vortices than the truth; with"
        " it they align significantly better. Ours: one model, one budget, weight 0 and 1.",
    ),
    "fig_5_17": Figure(
        split="cavity",
        models=OPERATORS,
        panels=(Panel.VORTICITY, Panel.SPEED),
        said="Thesis: SuperGAT has the lowest error in vorticity and velocity.",
    ),
    "fig_5_24": Figure(
        split="curl-noise",
        models=("supergat",),
        panels=(Panel.SPEED, Panel.STREAMLINES),
        after=(35,),
        said="Thesis: SuperGAT's rollout at frame 35.",
    ),
    "fig_5_25": Figure(
        split="curl-noise",
        models=("supergat",),
        panels=(Panel.VORTICITY,),
        after=(1, 5, 10, 20, 30),
        said="Thesis: close at frames 1 and 5; from 10 to 30 magnitudes and places of vortices differ more"
        " and more.",
    ),
}
"""Maps by figure."""


def draw_figure(plan: Plan, name: str) -> Sheet:
    """Return the maps of a figure and the correlations of what they show."""
    figure, evidence = FIGURES[name], plan.evidence(FIGURES[name].split)
    size, case = evidence.size, case_id(evidence.size, 0)
    frames = after_given(size, figure.after) if figure.after else (key_frame(evidence),)
    frames = predicted(size, frames)
    with staged(plan, figure.split, case or 0, figure.models) as stage:
        pictures = {
            str(panel): panel_rows(list(_lines(stage, panel)), frames, across=len(frames) == 1)
            for panel in figure.panels
        }
        names = stage.names
    rows = [
        (named(n), *(number(evidence.methods[n].at("vorticity_pearson", f, case)) for f in frames))
        for n in names
    ]
    heads = ("model", *(f"frame {frame}" for frame in frames))
    return Sheet(
        notes=(figure.said, *_with_and_without(figure, evidence)),
        tables=(Table("Correlation of the vorticity with the truth's, T0", heads, tuple(rows)),),
        pictures=pictures,
    )


def _lines(stage: Stage, panel: Panel) -> list[Line]:
    return [(named(name), stage, name, panel) for name in (None, *stage.names)]


def _with_and_without(figure: Figure, evidence: Evidence) -> tuple[str, ...]:
    """Return what the scores over all test scenarios say of a pair of models."""
    if len(figure.models) != 2 or not set(figure.models) <= evidence.methods.keys():
        return ()
    without, held = (evidence.methods[name].scores for name in figure.models)
    parts = [
        f"{metric}: {pair(held[metric], without[metric])}" for metric in ("vorticity_rmse", "position_rmse")
    ]
    return (f"Over all test scenarios, with against without: {'; '.join(parts)}.",)
