"""Panels of a picture: one frame seen one way, inside the walls of its box.

Needs matplotlib; :mod:`lagbench.figures.plot` composes them.
"""

from __future__ import annotations

import enum
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray

from lagbench.data import MATERIALS

from .canvas import INK, MATERIAL_COLOURS, MOVING, PAPER, WALL, speed_map, vorticity_map
from .recording import Recording, Scene

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.patches import Rectangle

Floats = NDArray[np.float64]


class Panel(enum.StrEnum):
    """What a panel shows."""

    SPEED = "speed"
    MATERIAL = "material"
    VORTICITY = "vorticity"
    STREAMLINES = "streamlines"


TITLES = {  # heading of each panel
    Panel.SPEED: "Particles by speed",
    Panel.MATERIAL: "Particles by material",
    Panel.VORTICITY: "Vorticity",
    Panel.STREAMLINES: "Streamlines",
}
UNITS = {  # what colour bars say: physical time throughout, as velocity in the files
    Panel.SPEED: "speed  [length/s]",
    Panel.VORTICITY: "vorticity  [1/s]",
    Panel.STREAMLINES: "speed on the grid  [length/s]",
}

# diameter of a drawn particle in particle spacings: neighbours overlap a little
DOT = 1.25
# particles drawn at the most; more would take memory and no eye would tell
MOST_DOTS = 1 << 16

# with neighbours to differentiate over, below which no streamline is drawn
FEW_NODES = 4
# along walls left, right, bottom, top
_ALONG = np.array([(0.0, 1.0), (0.0, 1.0), (1.0, 0.0), (1.0, 0.0)])


def limit_of(panel: Panel, scene: Scene) -> float:
    """Return the top of the colour scale: what all but the extreme per cent stay
    below.
    """
    if panel is Panel.SPEED:
        values = scene.speed
    elif panel is Panel.VORTICITY:
        values = np.abs(scene.vorticity[scene.fields.differentiable])
    else:
        values = _grid_speed(scene)[scene.fields.counted]
    if values.size:
        top = float(np.percentile(values, 99.0))
    else:
        top = 0.0
    return top or 1.0


def draw(
    axes: Axes, panel: Panel, scene: Scene, *, limit: float, detail: float = 1.0
) -> None:
    """Draw one frame inside its box."""
    draw_walls(axes, scene.recording, scene.frame)
    scale = colour_scale(panel, limit)
    if panel is Panel.MATERIAL:
        _draw_dots(axes, scene, np.array(MATERIAL_COLOURS)[scene.recording.material])
    elif panel is Panel.SPEED:
        _draw_dots(axes, scene, scale.to_rgba(scene.speed))
    elif panel is Panel.VORTICITY:
        _draw_field(axes, scene, scene.vorticity, scale)
    else:
        fields = scene.fields
        _draw_field(
            axes, scene, np.where(fields.counted, _grid_speed(scene), np.nan), scale
        )
        if fields.differentiable.sum() < FEW_NODES:
            return
        u, v = (
            np.ma.masked_array(fields.velocity[..., axis], ~fields.counted).T
            for axis in (0, 1)
        )
        axes.streamplot(
            fields.grid.axis,
            fields.grid.axis,
            u,
            v,
            density=0.7 + 0.7 * detail,
            color=PAPER,
            linewidth=0.35 + 0.45 * detail,
            arrowsize=0.3 + 0.4 * detail,
            maxlength=2.0,
            zorder=2,
        )


def box_of(recording: Recording) -> tuple[float, float, float, float]:
    """Return left, right, bottom and top wall of the box [length]."""
    (left, right), (bottom, top) = recording.size.bounds
    return left, right, bottom, top


def moving_walls(recording: Recording, frame: int) -> Iterator[tuple[int, Floats]]:
    """Yield each wall that slides towards a frame with its velocity along itself
    [length/s], shape [2].
    """
    for wall, velocity in enumerate(recording.wall_velocity[frame] * _ALONG):
        if velocity.any():
            yield wall, velocity


def draw_walls(axes: Axes, recording: Recording, frame: int) -> None:
    """Draw the walls as bands around the box; five arrowheads show which way a moving
    one slides.
    """
    from matplotlib.patches import Polygon, Rectangle

    axes.set(
        xlim=(0, 1), ylim=(0, 1), xticks=[], yticks=[], aspect="equal", frame_on=False
    )
    left, right, bottom, top = box_of(recording)
    bands = [
        (0, bottom, left, top - bottom),
        (right, bottom, 1 - right, top - bottom),
        (left, 0, right - left, bottom),
        (left, top, right - left, 1 - top),
    ]
    axes.add_patch(Rectangle((0, 0), 1, 1, color=WALL, lw=0, zorder=0))
    axes.add_patch(
        Rectangle(
            (left, bottom), right - left, top - bottom, color=PAPER, lw=0, zorder=0.5
        )
    )
    for wall, velocity in moving_walls(recording, frame):
        x, y, width, height = bands[wall]
        axes.add_patch(Rectangle((x, y), width, height, color=MOVING, lw=0, zorder=0.6))
        along = velocity / np.abs(velocity).max()
        size = 0.3 * min(width, height)
        across = np.array([-along[1], along[0]])
        length = np.abs(along) * max(width, height)
        for share in (-0.4, -0.2, 0.0, 0.2, 0.4):
            middle = np.array([x + width / 2, y + height / 2]) + share * length
            tip = middle + size * along
            tail = middle - 0.7 * size * along
            corners = [tip, tail + size * across, tail - size * across]
            axes.add_patch(Polygon(corners, closed=True, color=PAPER, lw=0, zorder=0.7))


def _draw_dots(axes: Axes, scene: Scene, colours: NDArray[Any]) -> None:
    """Draw a dot for every particle, or for every k-th of too many, cut off at the
    walls.
    """
    step = -(-len(scene.position) // MOST_DOTS)
    x, y = scene.position[::step].T
    # the marker area at which neighbouring particles overlap a little [point^2]
    inches = axes.get_position().width * axes.get_figure().get_figwidth()  # type: ignore[union-attr]
    area = float((DOT * 72.0 * inches * scene.recording.spacing) ** 2)
    dots = axes.scatter(x, y, step * area, colours[::step], linewidths=0, zorder=2)
    dots.set_clip_path(_box_patch(axes, scene.recording))


def _box_patch(axes: Axes, recording: Recording) -> Rectangle:
    """Return the inside of the box, to cut drawings off at the walls."""
    from matplotlib.patches import Rectangle

    left, right, bottom, top = box_of(recording)
    return Rectangle(
        (left, bottom), right - left, top - bottom, transform=axes.transData
    )


def _draw_field(axes: Axes, scene: Scene, field: Floats, scale: ScalarMappable) -> None:
    """Draw values at nodes as one square each, cut off at the walls; NaN stays
    paper.
    """
    grid = scene.fields.grid
    low = grid.axis[0] - grid.spacing / 2
    high = grid.axis[-1] + grid.spacing / 2
    image = axes.imshow(
        np.ma.masked_invalid(field.T),
        origin="lower",
        extent=(low, high, low, high),
        interpolation="nearest",
        cmap=scale.cmap,
        norm=cast("Normalize", scale.norm),
        zorder=1,
    )
    image.set_clip_path(_box_patch(axes, scene.recording))
    axes.set(xlim=(0, 1), ylim=(0, 1))


def _grid_speed(scene: Scene) -> Floats:
    """Return the speed at the nodes [length/s], shape [x node, y node]."""
    per_frame: Floats = np.sqrt((scene.fields.velocity**2).sum(axis=-1))
    return per_frame / scene.recording.size.frame_interval


def colour_scale(panel: Panel, limit: float) -> ScalarMappable:
    """Return the colours of speeds from 0, or vorticities from minus the limit, to the
    limit.
    """
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    if panel is Panel.VORTICITY:
        return ScalarMappable(Normalize(-limit, limit), vorticity_map())
    return ScalarMappable(Normalize(0.0, limit), speed_map())


def colour_bar(
    axes: Axes, panel: Panel, limit: float, *, label: str | None = None
) -> None:
    """Draw a horizontal colour bar with its unit; pointed where values lie beyond
    it.
    """
    from matplotlib.ticker import MaxNLocator

    drawn = axes.get_figure()
    if panel is Panel.VORTICITY:
        extend = "both"
    else:
        extend = "max"
    assert drawn is not None  # axes stand in a figure
    bar = drawn.colorbar(
        colour_scale(panel, limit), cax=axes, orientation="horizontal", extend=extend
    )
    bar.outline.set_visible(False)
    bar.set_label(label or UNITS[panel], labelpad=3)
    bar.ax.tick_params(length=0, pad=3)
    bar.locator = MaxNLocator(nbins=5, steps=[1, 2, 2.5, 5, 10])
    bar.update_ticks()


def material_key(axes: Axes, materials: NDArray[np.int8]) -> None:
    """Draw a key of the materials that occur."""
    from matplotlib.lines import Line2D

    axes.set_axis_off()
    handles = [
        Line2D(
            [],
            [],
            ls="",
            marker="o",
            ms=6,
            color=MATERIAL_COLOURS[m],
            label=MATERIALS[m],
        )
        for m in np.unique(materials)
    ]
    axes.legend(
        handles=handles,
        loc="upper left",
        bbox_to_anchor=(-0.02, 1.6),
        ncols=len(handles),
        frameon=False,
        handletextpad=0.1,
        columnspacing=1.2,
        labelcolor=INK,
        fontsize=9,
    )
