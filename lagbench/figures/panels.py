"""Panels of a picture: one frame seen one way, inside the walls of its box.

Needs matplotlib; :mod:`lagbench.figures.plot` composes them.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray

from lagbench.data import PARTICLE_KINDS
from lagbench.errors import require

from .canvas import build_speed_map, build_vorticity_map
from .colours import INK, MATERIAL_COLOURS, MOVING, MUTED, PAPER, WALL
from .recording import Recording, Scene
from .solid import SLICE, View, shade

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
    FRONT = "front"
    ABOVE = "above"


TITLES = {  # heading of each panel
    Panel.SPEED: "Particles by speed",
    Panel.MATERIAL: "Particles by material",
    Panel.VORTICITY: "Vorticity",
    Panel.STREAMLINES: "Streamlines",
    Panel.FRONT: "From the front",
    Panel.ABOVE: "From above",
}
VIEWS = (Panel.FRONT, Panel.ABOVE)
"""Panels of boxes of three dimensions only: particles by speed, in true scale."""

UNIT_SQUARE: dict[str, Any] = {
    "xlim": (0, 1),
    "ylim": (0, 1),
    "xticks": [],
    "yticks": [],
    "aspect": "equal",
    "frame_on": False,
}
"""Settings of axes that show a box."""

VIEW_FADE = 0.5
"""Depth of the farthest particle of a view: it is less pale than in the cube."""

CORNERS = 73
"""Corners of the polygon that shows a disc, one every five degrees."""

OF_PARTICLES = (Panel.SPEED, Panel.MATERIAL, *VIEWS)
"""Panels that show particles, not fields on the grid."""

UNITS = {  # label of each colour bar; time is physical, as in velocities of the files
    Panel.SPEED: "speed  [length/s]",
    Panel.VORTICITY: "vorticity  [1/s]",
    Panel.STREAMLINES: "speed on the grid  [length/s]",
    Panel.FRONT: "speed  [length/s]",
    Panel.ABOVE: "speed  [length/s]",
}
TOO_THIN = "material is too thin here\nfor a field on the grid"


def title_of(panel: Panel, scene: Scene) -> str:
    """Return the heading of a panel; fields of three dimensions are slices."""
    title = TITLES[panel]
    if not scene.recording.is_solid or panel in OF_PARTICLES:
        return title
    if panel is Panel.VORTICITY:
        title = "Vorticity magnitude"
    return f"{title}, {name_slice(scene)}"


def name_slice(scene: Scene) -> str:
    """Return where the plane lies that is drawn of a box of three dimensions."""
    if scene.recording.size.is_full_box:
        return SLICE
    return f"across z at {place_of_slice(scene):.2f}"


def place_of_slice(scene: Scene) -> float:
    """Return where the plane that is drawn cuts the third axis [length]."""
    size = scene.recording.size
    if size.is_full_box:
        return float(size.box.centre[2])
    return float(size.field_grid.places(2)[scene.layer])


# diameter of a drawn particle in particle spacings: neighbours overlap a little
DOT_DIAMETER = 1.25
# the same of a cube: smaller dots leave what is behind them visible
DOT_DIAMETER_SOLID = 0.75

# particles drawn at the most; more would take memory and no eye would tell
MOST_DOTS = 1 << 16
POINTS_PER_INCH = 72.0

# nodes with neighbours to differentiate over, below which no field is drawn: a node or
# two say nothing of a flow
FEW_NODES = 4

# places of the arrowheads on a moving wall, as shares of its length from its middle
_ARROWHEADS = (-0.4, -0.2, 0.0, 0.2, 0.4)


def limit_of(panel: Panel, scene: Scene) -> float:
    """Return the top of the colour scale: the 99th percentile of what is shown.

    It is 0 where nothing moves; see :func:`strongest_limit` and :func:`median_limit`.
    """
    if panel is Panel.SPEED or panel in VIEWS:
        values = scene.speed
    elif panel is Panel.VORTICITY:
        values = np.abs(scene.vorticity[np.isfinite(scene.vorticity)])
    else:
        values = _grid_speed(scene)[scene.fields.counted]
    if values.size == 0:
        return 0.0
    return float(np.percentile(values, 99.0))


def strongest_limit(limits: Sequence[float]) -> float:
    """Return one top of the colour scales of frames: the largest; 1 if none moves."""
    return max(limits, default=0.0) or 1.0


def median_limit(limits: Sequence[float]) -> float:
    """Return one top of the colour scales of frames: their median; 1 if none moves.

    Frames in which nothing moves do not count.
    """
    moving = [limit for limit in limits if limit > 0.0]
    if not moving:
        return 1.0
    return float(np.median(moving))


def draw(
    axes: Axes, panel: Panel, scene: Scene, *, limit: float, detail: float = 1.0
) -> None:
    """Draw one frame inside its box.

    Args:
        axes: where to draw.
        panel: what to show.
        scene: the frame.
        limit: top of the colour scale.
        detail: how dense and thick streamlines are, 0 to 1.
    """
    # as seen from above, as a cube, cut by a plane, or as seen from the front
    recording = scene.recording
    if panel is Panel.ABOVE:
        draw_walls(axes, recording, scene.frame, plane=(0, 2))
    elif recording.is_solid and panel in (Panel.MATERIAL, Panel.SPEED):
        draw_cube(axes, recording, scene.frame)
    elif recording.is_solid and panel not in OF_PARTICLES:
        draw_walls(axes, recording, scene.frame, cut=place_of_slice(scene))
    else:
        draw_walls(axes, recording, scene.frame)

    scale = colour_scale(panel, limit, is_solid=recording.is_solid)
    if panel is Panel.MATERIAL:
        colours = np.array(MATERIAL_COLOURS)[recording.material]
        _draw_dots(axes, scene, colours, panel)
    elif panel in OF_PARTICLES:
        colours = scale.to_rgba(scene.speed)
        _draw_dots(axes, scene, colours, panel)
    elif panel is Panel.VORTICITY:
        _draw_field(axes, scene, scene.vorticity, scale)
    else:
        # nodes that count too few particles show no speed
        speed = np.where(scene.fields.counted, _grid_speed(scene), np.nan)
        _draw_field(axes, scene, speed, scale)
        _draw_streamlines(axes, scene, detail=detail)


def box_of(
    recording: Recording, plane: tuple[int, int] = (0, 1)
) -> tuple[float, float, float, float]:
    """Return left, right, bottom and top wall of the box [length].

    The plane names the axes to the right and upwards.
    """
    horizontal, vertical = plane
    left, right = recording.size.bounds[horizontal]
    bottom, top = recording.size.bounds[vertical]
    return left, right, bottom, top


def moving_walls(recording: Recording, frame: int) -> Iterator[tuple[int, Floats]]:
    """Yield number and velocity of each wall that slides in the time before a frame.

    Velocities are those along the wall [length/s], shape [axis].
    """
    for wall, velocity in enumerate(recording.wall_velocity[frame]):
        velocity = velocity.copy()
        velocity[wall // 2] = 0.0
        if velocity.any():
            yield wall, velocity


def _add_rectangle(
    axes: Axes,
    place: tuple[float, float, float, float],
    colour: str,
    *,
    order: float,
) -> None:
    """Fill a rectangle from its left end, bottom, width and height; no outline."""
    from matplotlib.patches import Rectangle

    left, bottom, width, height = place
    rectangle = Rectangle(
        (left, bottom), width, height, color=colour, linewidth=0, zorder=order
    )
    axes.add_patch(rectangle)


def draw_walls(
    axes: Axes,
    recording: Recording,
    frame: int,
    *,
    plane: tuple[int, int] = (0, 1),
    cut: float | None = None,
) -> None:
    """Draw the walls as bands around the box, and an obstacle in it.

    Arrowheads on a moving wall show which way it slides.

    Args:
        axes: where to draw.
        recording: the scenario.
        frame: number of the frame.
        plane: axes to the right and upwards.
        cut: where a plane cuts the third axis, if it shows less than the whole box.
    """
    axes.set(**UNIT_SQUARE)
    left, right, bottom, top = box_of(recording, plane)
    width = right - left
    height = top - bottom
    _add_rectangle(axes, (0.0, 0.0, 1.0, 1.0), WALL, order=0)
    _add_rectangle(axes, (left, bottom, width, height), PAPER, order=0.5)
    if recording.obstacle is not None:
        centre = recording.obstacle[:-1].astype(np.float64)
        radius = float(recording.obstacle[-1])
        if cut is not None:
            radius = math.sqrt(max(0.0, radius**2 - (cut - centre[2]) ** 2))
        _draw_disc(axes, centre[list(plane)], radius)

    # x, y, width and height of the walls at both ends of both axes
    horizontal, vertical = plane
    bands = {
        2 * horizontal: (0, bottom, left, height),
        2 * horizontal + 1: (right, bottom, 1 - right, height),
        2 * vertical: (left, 0, width, bottom),
        2 * vertical + 1: (left, top, width, 1 - top),
    }
    for wall, velocity in moving_walls(recording, frame):
        along_plane = velocity[list(plane)]
        if wall in bands and along_plane.any():
            _draw_moving_wall(axes, bands[wall], along_plane)


def _draw_disc(axes: Axes, centre: Floats, radius: float) -> None:
    """Draw a disc over fields and under dots; one without a radius is not there."""
    if radius == 0.0:
        return
    x, y = centre
    angle = np.linspace(0.0, 2.0 * math.pi, CORNERS)
    edge_x = x + radius * np.cos(angle)
    edge_y = y + radius * np.sin(angle)
    axes.fill(edge_x, edge_y, color=MUTED, linewidth=0, zorder=1.5)


def draw_cube(axes: Axes, recording: Recording, frame: int) -> None:
    """Draw the edges of a box of three dimensions, and an obstacle in it.

    Walls that move are filled.
    """
    axes.set(**UNIT_SQUARE)
    view = View(recording.size.box)
    if recording.obstacle is not None:
        centre = view.place(recording.obstacle[:-1])
        _draw_disc(axes, centre, view.scale * float(recording.obstacle[-1]))
    for wall, _ in moving_walls(recording, frame):
        corners = view.wall(wall)
        axes.fill(
            *np.transpose(corners), facecolor=MOVING, alpha=0.18, lw=0, zorder=0.5
        )
    for ends, is_front in view.edges():
        x, y = ends.T
        order = 3.0 if is_front else 1.0
        axes.plot(x, y, color=WALL, lw=0.8, zorder=order)


def _draw_moving_wall(
    axes: Axes, band: tuple[float, float, float, float], velocity: Floats
) -> None:
    """Draw a band with arrowheads that point along its velocity."""
    x, y, width, height = band
    _add_rectangle(axes, band, MOVING, order=0.6)

    along = velocity / np.abs(velocity).max()
    along_x, along_y = along
    across = np.array([-along_y, along_x])
    centre = np.array([x + width / 2, y + height / 2])
    length = np.abs(along) * max(width, height)
    size = 0.3 * min(width, height)
    half_base = size * across
    for share in _ARROWHEADS:
        middle = centre + share * length
        tip = middle + size * along
        tail = middle - 0.7 * size * along
        left = tail + half_base
        right = tail - half_base
        corners_x, corners_y = np.transpose([tip, left, right])
        axes.fill(corners_x, corners_y, color=PAPER, lw=0, zorder=0.7)


def _draw_dots(axes: Axes, scene: Scene, colours: NDArray[Any], panel: Panel) -> None:
    """Draw a dot for every particle, or for every k-th of too many.

    Dots are cut off at the walls. In three dimensions farther ones are drawn first,
    and paler.
    """
    recording = scene.recording
    step = math.ceil(len(scene.position) / MOST_DOTS)
    position = scene.position[::step]
    colours = colours[::step]
    scale = 1.0
    dot_diameter = DOT_DIAMETER
    if recording.is_solid:
        dot_diameter = DOT_DIAMETER_SOLID
        low, high = np.transpose(recording.size.box.bounds)
        share = np.clip((position - low) / (high - low), 0.0, 1.0)
        if panel is Panel.FRONT:
            place = position[:, :2]
            depth = VIEW_FADE * share[:, 2]
        elif panel is Panel.ABOVE:
            place = position[:, [0, 2]]
            depth = VIEW_FADE * (1.0 - share[:, 1])
        else:
            view = View(recording.size.box)
            place = view.place(position)
            depth = view.depth(position)
            scale = view.scale
        order = np.argsort(-depth, kind="stable")
        matplotlib_colors = require("matplotlib.colors", extra="plots")
        rgb = matplotlib_colors.to_rgba_array(colours)[order, :3]
        colours = shade(rgb, depth[order], np.ones(3))
        position = place[order]
    x, y = position.T
    length = dot_diameter * recording.spacing * scale
    diameter = length * POINTS_PER_INCH * _side_of(axes)  # [point]
    area = step * float(diameter**2)  # [point^2]
    dots = axes.scatter(x, y, area, colours, linewidths=0, zorder=2)
    if panel in VIEWS:
        plane = (0, 2) if panel is Panel.ABOVE else (0, 1)
        dots.set_clip_path(_box_patch(axes, recording, plane))
    elif not recording.is_solid:
        dots.set_clip_path(_box_patch(axes, recording))


def _side_of(axes: Axes) -> float:
    """Return the side of a panel [inch]."""
    drawn = axes.get_figure()
    assert drawn is not None  # axes stand in a figure
    width: float = drawn.get_figwidth()  # type: ignore[union-attr]
    return float(axes.get_position().width * width)


def _box_patch(
    axes: Axes, recording: Recording, plane: tuple[int, int] = (0, 1)
) -> Rectangle:
    """Return the inside of the box, to cut drawings off at the walls."""
    from matplotlib.patches import Rectangle

    left, right, bottom, top = box_of(recording, plane)
    return Rectangle(
        (left, bottom), right - left, top - bottom, transform=axes.transData
    )


def _draw_field(axes: Axes, scene: Scene, field: Floats, scale: ScalarMappable) -> None:
    """Draw a square for the value at each node, cut off at the walls.

    NaN stays paper. Where few nodes have a value, the panel says so instead.
    """
    if np.isfinite(field).sum() < FEW_NODES:
        axes.set(xlim=(0, 1), ylim=(0, 1))
        size = POINTS_PER_INCH * _side_of(axes) / 24.0  # a line has about 24 letters
        axes.text(0.5, 0.5, TOO_THIN, color=MUTED, fontsize=min(9.0, size), ha="center")
        return
    grid = scene.fields.grid
    half_spacing = grid.spacing / 2
    extent = []
    for axis in range(2):
        places = grid.places(axis)
        extent += [places[0] - half_spacing, places[-1] + half_spacing]
    image = axes.imshow(
        np.ma.masked_invalid(field.T),
        origin="lower",
        extent=tuple(extent),
        interpolation="nearest",
        cmap=scale.cmap,
        norm=cast("Normalize", scale.norm),
        zorder=1,
    )
    image.set_clip_path(_box_patch(axes, scene.recording))
    axes.set(xlim=(0, 1), ylim=(0, 1))


def _draw_streamlines(axes: Axes, scene: Scene, *, detail: float) -> None:
    """Draw white streamlines of the velocity at the nodes that count.

    Along a periodic axis images of the nodes carry them on to the edges of the box.
    """
    fields = scene.fields
    if fields.differentiable.sum() < FEW_NODES:
        return
    grid = fields.grid
    x_images, y_images = map(int, grid.box.periodic[:2])  # at each end of an axis
    x = np.pad(grid.places(0), x_images, "reflect", reflect_type="odd")
    y = np.pad(grid.places(1), y_images, "reflect", reflect_type="odd")
    # lines stay as close to each other on an axis that has images
    density = 0.7 + 0.7 * detail
    x_density = density * (len(x) / grid.shape[0])
    y_density = density * (len(y) / grid.shape[1])
    images = [(x_images, x_images), (y_images, y_images)]
    u, v = np.moveaxis(fields.velocity, -1, 0)
    is_missing = np.pad(~fields.counted, images, mode="wrap")
    u = np.ma.masked_array(np.pad(u, images, mode="wrap"), is_missing)
    v = np.ma.masked_array(np.pad(v, images, mode="wrap"), is_missing)
    patch_count = len(axes.patches)
    stream = axes.streamplot(
        x,
        y,
        u.T,
        v.T,
        density=(x_density, y_density),
        color=PAPER,
        linewidth=0.35 + 0.45 * detail,
        arrowsize=0.3 + 0.4 * detail,
        maxlength=2.0,
        zorder=2,
    )
    if grid.box.is_periodic:
        inside = _box_patch(axes, scene.recording)
        stream.lines.set_clip_path(inside)
        for arrowhead in axes.patches[patch_count:]:
            arrowhead.set_clip_path(inside)


def _grid_speed(scene: Scene) -> Floats:
    """Return the speed at the nodes [length/s], shape [x node, y node]."""
    per_frame: Floats = np.sqrt((scene.fields.velocity**2).sum(axis=-1))
    return per_frame / scene.recording.size.frame_interval


def colour_scale(
    panel: Panel, limit: float, *, is_solid: bool = False
) -> ScalarMappable:
    """Return the colours of values up to a limit.

    Speeds and magnitudes start at 0, vorticities of the plane at minus the limit.
    """
    from matplotlib.cm import ScalarMappable

    if panel is Panel.VORTICITY and not is_solid:
        scale = ScalarMappable(cmap=build_vorticity_map())
        scale.set_clim(-limit, limit)
    else:
        scale = ScalarMappable(cmap=build_speed_map())
        scale.set_clim(0.0, limit)
    return scale


def colour_bar(
    axes: Axes,
    panel: Panel,
    limit: float,
    *,
    label: str | None = None,
    is_solid: bool = False,
) -> None:
    """Draw a horizontal colour bar with its unit.

    Its ends are pointed where values may lie beyond them.
    """
    if panel is Panel.VORTICITY and not is_solid:
        pointed = "both"
    else:
        pointed = "max"
    drawn = axes.get_figure()
    assert drawn is not None  # axes stand in a figure
    scale = colour_scale(panel, limit, is_solid=is_solid)
    bar = drawn.colorbar(scale, cax=axes, orientation="horizontal", extend=pointed)
    bar.outline.set_visible(False)
    bar.set_label(label or UNITS[panel], labelpad=3)
    bar.ax.tick_params(length=0, pad=3)
    bar.ax.locator_params(axis="x", nbins=5)


def draw_material_key(axes: Axes, materials: NDArray[np.int8]) -> None:
    """Draw a key of the materials that occur."""
    handles = []
    for material in np.unique(materials):
        colour = MATERIAL_COLOURS[material]
        name = PARTICLE_KINDS[material]
        handles += axes.plot(
            [],
            [],
            linestyle="",
            marker="o",
            markersize=6,
            color=colour,
            label=name,
        )
    axes.set_axis_off()
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
