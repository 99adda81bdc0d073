"""Figs. 5.22, 5.23, 5.26, 5.27: quiver and streamline panels of SuperGAT's curl-noise rollouts."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lagbench.draw.panels import Panel, colour_scale, draw_walls
from lagbench.scoring.tables import Table

from .chart import Drawing, Line, named, panel_rows
from .plan import Plan
from .scenes import after_given, case_id
from .sheet import Sheet
from .stage import Stage, staged
from .wording import number

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["FIGURES", "Figure", "draw_figure"]

SPLIT, MODEL = "curl-noise", "supergat"
AFTER = (1, 5, 10, 20, 30, 40)
"""Frames after the last given one."""


@dataclass(frozen=True, kw_only=True)
class Figure:
    """A figure of truth above prediction for some test cases."""

    cases: tuple[int, ...]  # numbers of the test cases, T0 first
    styles: tuple[str, ...]  # quiver, streamlines: one picture each


FIGURES: Mapping[str, Figure] = {
    "fig_5_22": Figure(cases=(0,), styles=("quiver",)),
    "fig_5_23": Figure(cases=(0, 3), styles=("streamlines",)),
    "fig_5_26": Figure(cases=(1, 2), styles=("quiver", "streamlines")),
    "fig_5_27": Figure(cases=(3, 4), styles=("quiver", "streamlines")),
}
"""Panels by figure."""


def draw_figure(plan: Plan, name: str) -> Sheet:
    """Return the panels of a figure and the velocity errors of what they show."""
    figure, evidence = FIGURES[name], plan.evidence(SPLIT)
    size = evidence.size
    frames = after_given(size, AFTER)
    cases = [(n, i) for n in figure.cases if (i := case_id(size, n)) is not None]
    with ExitStack() as stack:
        stages = {n: stack.enter_context(staged(plan, SPLIT, i, (MODEL,))) for n, i in cases}
        lines: list[Line] = [
            (f"T{n}, {named(who)}", stage, who, Panel.STREAMLINES)
            for n, stage in stages.items()
            for who in (None, *stage.names)
        ]
        pictures = {
            style: panel_rows(lines, frames, drawing=_quiver() if style == "quiver" else None)
            for style in figure.styles
            if lines
        }
    rows: tuple[tuple[str, ...], ...] = ()
    if MODEL in evidence.methods:
        held = evidence.methods[MODEL]
        rows = tuple(
            (f"T{n} ({i})", *(number(held.at("velocity_rmse", frame, i)) for frame in frames))
            for n, i in cases
        )
    heads = ("test case", *(f"frame {frame}" for frame in frames))
    note = (
        "Thesis: predictions follow the truth closely, with deviations late and near the walls. Frames are"
        f" absolute: {', '.join(map(str, AFTER))} after the last given one, where they are predicted."
    )
    title = "Velocity RMSE [length/frame]"
    return Sheet(notes=(note,), tables=(Table(title, heads, rows),), pictures=pictures)


def _quiver() -> Drawing:
    """Return what draws arrows at the nodes, coloured by speed."""

    def drawing(axes: Axes, stage: Stage, name: str | None, frame: int, limit: float) -> None:
        scene = stage.scene(name, frame)
        draw_walls(axes, scene.recording, scene.frame)
        fields = scene.fields
        x, y = np.meshgrid(fields.grid.axis, fields.grid.axis, indexing="ij")
        shown = fields.counted
        velocity = fields.velocity[shown] / scene.recording.size.frame_interval
        speed = np.linalg.norm(velocity, axis=-1)
        scale = colour_scale(Panel.STREAMLINES, limit)
        # the fastest arrow spans two and a half nodes
        unit = limit * fields.grid.cells / 2.5
        axes.quiver(
            *(x[shown], y[shown], *velocity.T, speed),
            cmap=scale.cmap,
            norm=scale.norm,
            angles="xy",
            scale_units="xy",
            scale=unit,
            width=0.006,
            zorder=2,
        )

    return drawing
