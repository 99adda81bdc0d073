"""Charts and rows of panels in one style: a colour per model, the truth in ink, small PNG files."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

from lagbench.draw.panels import Panel, colour_bar, draw, limit_of
from lagbench.draw.style import INK, MUTED, figure, pixels_of, png_bytes

from .roster import label
from .stage import Stage

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["COLOURS", "Line", "TRUTH", "charts", "colour", "named", "panel_rows", "png", "tidy"]

COLOURS: Mapping[str, str] = {
    "supergat": "#d55e00",
    "supergat-link": "#8c3b00",
    "supergat-unlinked": "#d9a46a",
    "gat": "#56b4e9",
    "gatv2": "#0072b2",
    "gns": "#b0569a",
    "gns-novorticity": "#e3b4d6",
    "pointnet": "#009e73",
    "transformer": "#e69f00",
    "mlp": "#0072b2",
    "lstm": "#009e73",
    "lstm-mlp": "#d55e00",
    "var": "#7f7f7f",
    "var-stable": "#b0569a",
}
"""Colours of Okabe & Ito (2008) and shades of them; SuperGAT is red, as in the thesis."""

TRUTH = INK
LEVELS = 96
"""Colours of a picture's file."""

SIDE, GAP, TOP, LEFT, BOTTOM = 1.5, 0.08, 0.34, 0.75, 0.62  # [inch]

Line = tuple[str, Stage, "str | None", Panel]
"""Heading, scenario, model (None for the truth) and kind of panel of a row."""

Drawing = Callable[["Axes", Stage, "str | None", int, float], None]


def colour(name: str) -> str:
    """Return a model's colour."""
    return COLOURS.get(name, MUTED)


def png(drawn: Figure) -> bytes:
    """Return the figure as PNG in few colours, without date or software; equal figures, equal bytes."""
    from PIL import Image

    image = Image.fromarray(pixels_of(drawn)).quantize(LEVELS, dither=Image.Dither.NONE)
    with io.BytesIO() as buffer:
        image.save(buffer, format="PNG", optimize=True)
        return buffer.getvalue()


@contextmanager
def charts(columns: int, rows: int = 1, *, width: float = 4.2, height: float = 3.0) -> Iterator[Charts]:
    """Yield axes of charts side by side.

    Args:
        columns: charts in a row.
        rows: rows.
        width: of a chart [inch].
        height: of a chart [inch].
    """
    with figure(columns * width, rows * height) as drawn:
        drawn.set_layout_engine("constrained")
        axes = drawn.subplots(rows, columns, squeeze=False)
        yield Charts(drawn, [one for row in axes for one in row])


class Charts:
    """A figure and its axes, row by row."""

    def __init__(self, drawn: Figure, axes: Sequence[Axes]) -> None:
        self.figure = drawn
        self.axes = axes

    def png(self) -> bytes:
        """Return the picture."""
        return png(self.figure)


def tidy(axes: Axes, title: str, x: str, y: str, *, legend: bool = True) -> None:
    """Set title, labels, light grid and legend of a chart."""
    axes.set(title=title, xlabel=x, ylabel=y)
    axes.grid(alpha=0.25, lw=0.5)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    if legend and axes.get_legend_handles_labels()[1]:
        axes.legend(frameon=False, fontsize=7.5)


def draw_panel(panel: Panel) -> Drawing:
    """Return what draws one panel of a frame, for :func:`panel_rows`."""

    def drawing(axes: Axes, stage: Stage, name: str | None, frame: int, limit: float) -> None:
        draw(axes, panel, stage.scene(name, frame), limit=limit, detail=0.35)

    return drawing


def panel_rows(
    rows: Sequence[Line],
    frames: Sequence[int],
    *,
    drawing: Drawing | None = None,
    across: bool = False,
) -> bytes:
    """Draw rows of panels, one column per frame, in common colours per kind of panel."""
    cells = [(row, frame) for row in rows for frame in frames]
    shape = (1, len(rows)) if across else (len(rows), len(frames))
    limits = {panel: _limit(rows, frames, panel) for panel in {row[3] for row in rows}}
    width = (0.1 if across else LEFT) + shape[1] * (SIDE + GAP) + 0.1
    height = TOP + shape[0] * (SIDE + GAP) + BOTTOM
    with figure(width, height) as drawn:
        for number, ((heading, stage, name, panel), frame) in enumerate(cells):
            line, column = divmod(number, shape[1])
            left = ((0.1 if across else LEFT) + column * (SIDE + GAP)) / width
            bottom = (height - TOP - (line + 1) * (SIDE + GAP) + GAP) / height
            axes = drawn.add_axes((left, bottom, SIDE / width, SIDE / height))
            (drawing or draw_panel(panel))(axes, stage, name, frame, limits[panel])
            if across or line == 0:
                axes.set_title(heading if across else f"frame {frame}", fontsize=8)
            if not across and column == 0:
                axes.set_ylabel(heading, fontsize=8, color=INK)
        _bars(drawn, limits, width, height)
        return png_bytes(drawn)


def _limit(rows: Sequence[Line], frames: Sequence[int], panel: Panel) -> float:
    """Return the top of a colour scale: the truth's, which predictions may exceed."""
    if panel is Panel.MATERIAL:
        return 1.0
    stages = {row[1].id: row[1] for row in rows if row[3] is panel}
    return max(limit_of(panel, stage.scene(None, frame)) for stage in stages.values() for frame in frames)


def _bars(drawn: Figure, limits: Mapping[Panel, float], width: float, height: float) -> None:
    shown = [panel for panel in limits if panel is not Panel.MATERIAL]
    for number, panel in enumerate(sorted(shown)):
        left = (0.35 + number * 2.5) / width
        axes = drawn.add_axes((left, 0.42 / height, min(2.0, width - 0.6) / width, 0.08 / height))
        colour_bar(axes, panel, limits[panel])


def named(name: str | None) -> str:
    """Return a heading: the model's label, or "truth"."""
    return "truth" if name is None else label(name)
