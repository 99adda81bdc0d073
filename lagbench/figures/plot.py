"""Pictures of one frame, and contact sheets: scenarios of a split over time.

Needs matplotlib: ``pip install 'lagbench[plots]'``. The same frame gives the same
bytes.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lagbench.data.box import WALL_NAMES
from lagbench.data.local import suggest_repair
from lagbench.data.registry import Registry, Size
from lagbench.errors import DataError, UsageError

from .canvas import DPI, draw_header, figure, save, shrink
from .colours import MUTED
from .panels import (
    VIEWS,
    Panel,
    box_of,
    colour_bar,
    draw,
    draw_material_key,
    limit_of,
    median_limit,
    moving_walls,
    strongest_limit,
    title_of,
)
from .recording import (
    KIND_PARAMETERS,
    Recording,
    Scene,
    describe_parameters,
    open_recording,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ALL = "all"
KINDS = (ALL, *(str(panel) for panel in Panel))
"""What :func:`draw_frame` can draw."""

SEPARATOR = "  ·  "
# along each axis, against it and with it
DIRECTIONS = (("left", "right"), ("down", "up"), ("forward", "back"))

# lengths of a picture of one frame [inch]
SIDE = 3.25
GAP = 0.25
MARGIN = 0.25
TOP = 0.96
BAR = 0.66
LINE = 0.17  # second line of the title of a single panel

# lengths of a sheet [inch]
CELL = 1.3
CELL_GAP = 0.08
LABEL = 0.18
RIM = 0.22
HEAD = 0.7
FOOT = 0.58
NARROWEST = 5.0

LEAST_RIM = 0.03  # width of the walls that a cell shows at least [length]
MOST_ROWS = 6  # of a sheet of scenarios without kinds
# moments of a row over time, as shares of the last frame; those of a long recording
# are close where bodies fall and collide
TIMES = (0.0, 0.05, 0.1, 0.2, 0.5, 1.0)
EVEN_TIMES = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)
FEWEST_BETWEEN = 5  # frames between two moments; where there are fewer they are even


def check_kind(kind: str) -> None:
    """Refuse a kind of picture that :func:`draw_frame` cannot draw.

    Raises:
        UsageError: the kind is none of :data:`KINDS`.
    """
    if kind not in KINDS:
        raise UsageError(
            f"no kind of picture {kind!r}; choose {', '.join(KINDS)}", where="--kind"
        )


def draw_frame(
    source: str | Path,
    frame: int,
    *,
    kind: str = ALL,
    dpi: float = DPI,
    registry: Registry | None = None,
) -> Figure:
    """Draw one frame of a scenario; :func:`.canvas.save` writes the figure to a file.

    Args:
        source: scenario file.
        frame: absolute frame number; negative ones count from the end.
        kind: one of :data:`KINDS`; ``all`` draws three panels side by side.
        dpi: pixels per inch.
        registry: where splits are described; ours when None.

    Raises:
        UsageError: unknown kind, no such frame, no matplotlib.
        DataError: the scenario file is missing or damaged.
    """
    check_kind(kind)
    with open_recording(source, registry=registry) as recording:
        return draw_scene(recording.scene(frame), kind=kind, dpi=dpi)


def draw_scene(scene: Scene, *, kind: str = ALL, dpi: float = DPI) -> Figure:
    """Draw one frame; see :func:`draw_frame`."""
    recording = scene.recording
    if kind != ALL:
        _check_view(Panel(kind), recording.size)
        panels = [Panel(kind)]
    elif recording.is_solid and not recording.size.is_full_box:
        # a slice of a splash is thin or empty
        first = Panel.MATERIAL if recording.is_mixed else Panel.SPEED
        panels = [first, Panel.FRONT, Panel.ABOVE]
    elif recording.is_mixed:
        panels = [Panel.MATERIAL, Panel.SPEED, Panel.VORTICITY]
    else:
        panels = [Panel.SPEED, Panel.VORTICITY, Panel.STREAMLINES]
    width = 2 * MARGIN + len(panels) * SIDE + (len(panels) - 1) * GAP
    height = TOP + SIDE + BAR
    is_single = len(panels) == 1
    if is_single:
        height += LINE
    with figure(width, height, dpi=dpi) as drawn:
        subtitle = _describe_scene(scene)
        if is_single:
            subtitle = describe(recording)
        draw_header(drawn, recording.title, subtitle, left=MARGIN)
        for column, panel in enumerate(panels):
            left = (MARGIN + column * (SIDE + GAP)) / width
            axes = drawn.add_axes((left, BAR / height, SIDE / width, SIDE / height))
            title = title_of(panel, scene)
            if is_single:
                title = f"{title}\nframe {scene.frame}, t = {scene.time:.2f} s"
            shrink(axes.set_title(title), SIDE)
            limit = strongest_limit([limit_of(panel, scene)])
            draw(axes, panel, scene, limit=limit)

            bar_bottom = (BAR - 0.2) / height
            place = (left, bar_bottom, SIDE / width, 0.09 / height)
            below = drawn.add_axes(place)
            if panel is Panel.MATERIAL:
                draw_material_key(below, recording.material)
            else:
                colour_bar(below, panel, limit, is_solid=recording.is_solid)
        return drawn


def _check_view(panel: Panel, size: Size) -> None:
    """Refuse a view that a box of two dimensions does not have."""
    if panel in VIEWS and size.dimension == 2:
        raise UsageError(
            f"there is no view {str(panel)!r} of two dimensions; leave --kind out",
            where="--kind",
        )


def describe(recording: Recording) -> str:
    """Return split, size, scenario and what sets it apart.

    That reads like "cavity full · scenario 3 · Re 120".
    """
    parts = [
        f"{recording.size.split} {recording.size.name}",
        f"scenario {recording.scenario}",
        *describe_parameters(recording.parameters),
    ]
    return SEPARATOR.join(parts)


def _describe_scene(scene: Scene) -> str:
    """Return what :func:`describe` says, the frame, and how walls move."""
    parts = [
        describe(scene.recording),
        f"frame {scene.frame}",
        f"t = {scene.time:.2f} s",
    ]
    for wall, velocity in moving_walls(scene.recording, scene.frame):
        names = []
        for component, directions in zip(velocity, DIRECTIONS, strict=False):
            if component:
                names.append(directions[int(component > 0.0)])
        direction = " and ".join(names)
        speed = np.abs(velocity).max()
        name = WALL_NAMES[wall]
        parts.append(f"{name} wall moves {direction} at {speed:.3g} length/s")
    return SEPARATOR.join(parts)


def contact_sheet(
    tier: Size,
    folder: Path,
    output: str | Path,
    *,
    registry: Registry,
    kind: str = ALL,
    dpi: float = DPI,
    option: str = "--output",
) -> Path:
    """Draw the scenarios of a data set that lies in a root folder on one page.

    There is a row for the first scenario of each kind, or for each of the first ones
    where there are no kinds.

    Args:
        tier: the data set.
        folder: folder that holds all data sets.
        output: file to write, ending in .png, .pdf or .svg.
        registry: where splits are described.
        kind: what each panel shows; ``all`` stands for what suits the split.
        dpi: pixels per inch.
        option: the option that names another place, for messages.

    Raises:
        UsageError: unknown kind, no matplotlib.
        DataError: no scenario is there, or a file is damaged.
    """
    check_kind(kind)
    if kind != ALL:
        _check_view(Panel(kind), tier)
    files = []
    for ids in tier.subsets.values():
        paths = [tier.path(folder, scenario) for scenario in sorted(ids)]
        files += [path for path in paths if path.is_file()]
    if not files:
        fix = suggest_repair(tier, root=folder)
        raise DataError(
            f"nothing to draw: no scenario of {tier.split} {tier.name} is there; {fix}"
        )
    chosen = _first_of_each_kind(files, registry)
    rows = []
    for mark, path in chosen.items():
        with open_recording(path, registry=registry) as recording:
            scenes = [recording.scene(n) for n in choose_moments(recording.frames)]
        rows.append((f"{recording.scenario}  {mark}", scenes))
    first = rows[0][1][0].recording
    panel = Panel.SPEED
    if kind != ALL:
        panel = Panel(kind)
    elif any(scenes[0].recording.is_mixed for _, scenes in rows):
        panel = Panel.MATERIAL
    elif tier.is_full_box:
        panel = Panel.VORTICITY
    limits = []
    for _, scenes in rows:
        limits += [limit_of(panel, scene) for scene in scenes]
    choose = median_limit if panel is Panel.VORTICITY else strongest_limit
    limit = choose(limits)

    columns = len(TIMES)
    width = max(2 * RIM + columns * (CELL + CELL_GAP) - CELL_GAP, NARROWEST)
    # Of a low channel a cell shows the channel and its walls, else the unit square.
    low, high = 0.0, 1.0
    if not first.is_solid:
        left, right, bottom, top = box_of(first)
        rim = max(left, 1.0 - right, LEAST_RIM)
        low, high = max(0.0, bottom - rim), min(1.0, top + rim)
    panel_height = CELL * (high - low)
    row_height = panel_height + LABEL + CELL_GAP
    height = HEAD + len(rows) * row_height + FOOT
    title = f"{registry.split(tier.split).title} · {tier.split} {tier.name}"
    with figure(width, height, dpi=dpi) as drawn:
        draw_header(drawn, title, f"{len(rows)} scenarios over time", left=RIM)
        for row, (name, scenes) in enumerate(rows):
            bottom = height - HEAD - (row + 1) * row_height + CELL_GAP
            for column, scene in enumerate(scenes):
                left = RIM + column * (CELL + CELL_GAP)
                place = (
                    left / width,
                    bottom / height,
                    CELL / width,
                    panel_height / height,
                )
                axes = drawn.add_axes(place)
                label = name if column == 0 else f"frame {scene.frame}"
                text = axes.set_title(label, fontsize=7.5, color=MUTED, pad=2.5)
                shrink(text, CELL)
                draw(axes, panel, scene, limit=limit, detail=0.0)
                axes.set(ylim=(low, high))
        place = (RIM / width, 0.42 / height, 2.6 / width, 0.09 / height)
        below = drawn.add_axes(place)
        if panel is Panel.MATERIAL:
            materials = [scenes[0].recording.material for _, scenes in rows]
            draw_material_key(below, np.concatenate(materials))
        else:
            colour_bar(below, panel, limit, is_solid=first.is_solid)
        return save(drawn, output, option=option)


def _first_of_each_kind(files: Sequence[Path], splits: Registry) -> dict[str, Path]:
    """Return the first scenario of every kind, or the first ones by what they are."""
    kinds: dict[str, Path] = {}
    others: dict[str, Path] = {}
    for path in files:
        with open_recording(path, registry=splits) as recording:
            marks = describe_parameters(recording.parameters)
        for name in KIND_PARAMETERS:
            if name in recording.parameters:
                kinds.setdefault(str(recording.parameters[name]), path)
        if len(others) < MOST_ROWS:
            others.setdefault(" ".join(marks[:1]) or path.stem, path)
    return dict(sorted(kinds.items(), key=lambda item: item[1].name)) or others


def choose_moments(frames: int) -> list[int]:
    """Return the frames of a row over time, of a recording of so many frames."""
    last = frames - 1
    shares = TIMES
    if TIMES[1] * last < FEWEST_BETWEEN:
        shares = EVEN_TIMES
    return [round(share * last) for share in shares]
