"""Pictures of one frame, and contact sheets: many scenarios of a split on one page.

Needs matplotlib: ``pip install 'lagbench[plots]'``. The same frame gives the same
bytes. Splits whose scenarios draw a ``family`` or ``pair`` get a sheet of one row per
kind over time; the others get a table of scenarios at one frame.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lagbench.data.box import WALL_NAMES
from lagbench.data.layout import has_file
from lagbench.data.local import locate, suggest_repair
from lagbench.data.registry import Registry, Size
from lagbench.errors import DataError, UsageError
from lagbench.store.copy import update_working_copy

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
from .recording import Recording, Scene, name_start, open_recording

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ALL = "all"
KINDS = (ALL, *(str(panel) for panel in Panel))
"""What :func:`draw_frame` can draw."""

SEPARATOR = "  ·  "
KIND_PARAMETERS = ("family", "pair")  # parameters that say of which kind a scenario is
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
COLUMNS = 6  # of a table of scenarios at one frame
# moments of a row over time, as shares of the last frame; those of a long recording
# are close where bodies fall and collide
TIMES = (0.0, 0.05, 0.1, 0.2, 0.5, 1.0)
EVEN_TIMES = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)
FEWEST_BETWEEN = 5  # frames between two moments; where there are fewer they are even
# moments of flows that walls drive, as shares of the last frame of interest
MOMENTS = (1 / 9, 1 / 2, 1.0)
# most scenarios on a sheet of flows that walls drive, and of flows that only decay
MOST_DRIVEN = 30
MOST_DECAYING = 36
# the fluid itself seldom moves faster than this share of the wall's speed
WALL_SHARE = 0.6


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
    source: str | Path | xr.Dataset,
    frame: int,
    *,
    kind: str = ALL,
    dpi: float = DPI,
    registry: Registry | None = None,
) -> Figure:
    """Draw one frame of a scenario; :func:`.canvas.save` writes the figure to a file.

    Args:
        source: scenario file, or a data set of one scenario.
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
        scene = recording.scene(frame)
    panels = _choose_panels(kind, recording)
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


def _choose_panels(kind: str, recording: Recording) -> list[Panel]:
    if kind != ALL:
        _check_view(Panel(kind), recording.size)
        return [Panel(kind)]
    if recording.is_solid and not recording.size.is_full_box:
        # a slice of a splash is thin or empty
        first = Panel.MATERIAL if recording.is_mixed else Panel.SPEED
        return [first, Panel.FRONT, Panel.ABOVE]
    if recording.is_mixed:
        return [Panel.MATERIAL, Panel.SPEED, Panel.VORTICITY]
    return [Panel.SPEED, Panel.VORTICITY, Panel.STREAMLINES]


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
        *_describe_parameters(recording),
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
        direction = _name_direction(velocity)
        speed = np.abs(velocity).max()
        name = WALL_NAMES[wall]
        parts.append(f"{name} wall moves {direction} at {speed:.3g} length/s")
    return SEPARATOR.join(parts)


def _name_direction(velocity: NDArray[np.float64]) -> str:
    """Return the direction of a velocity, along each axis along which it points."""
    names = []
    for component, (backward, forward) in zip(velocity, DIRECTIONS, strict=False):
        if component:
            names.append(forward if component > 0.0 else backward)
    return " and ".join(names)


def _describe_parameters(recording: Recording) -> list[str]:
    """Return Reynolds number, kind and start of the flow, those that there are."""
    parts = []
    if recording.reynolds is not None:
        parts.append(f"Re {recording.reynolds:.0f}")
    for name in KIND_PARAMETERS:
        if name in recording.parameters:
            parts.append(f"{name} {recording.parameters[name]}")
    start = name_start(recording.parameters)
    if start:
        parts.append(start)
    return parts


@dataclass(frozen=True)
class SheetCell:
    """A small panel of a contact sheet."""

    scene: Scene
    label: str
    limit: float  # top of the colour scale


@dataclass(frozen=True, kw_only=True)
class ContactSheet:
    """What a contact sheet shows."""

    rows: Sequence[Sequence[SheetCell]]
    panel: Panel  # what every cell shows
    subtitle: str  # second line of the title
    limit: float  # top of the colour bar
    unit: str | None = None  # label of the colour bar where it is not the panel's own


def contact_sheet(
    split: str,
    size: str,
    output: str | Path,
    *,
    root: str | Path | None = None,
    kind: Panel | str | None = None,
    frame: int | None = None,
    dpi: float = DPI,
    registry: Registry | None = None,
) -> Path:
    """Draw many scenarios of a split on one page; return the path of the file.

    Args:
        split: name of the split.
        size: name of the size.
        output: file to write, ending in .png, .pdf or .svg.
        root: folder that holds all data sets; see ``resolve_root``.
        kind: what each panel shows; the default, as ``all``, suits the split.
        frame: frame to show where the sheet is a table of scenarios; when None, the
            first, the last frame of interest of what starts at rest, or three frames up
            to that of what is driven.
        dpi: pixels per inch.
        registry: where splits are described; ours when None.

    Raises:
        UsageError: unknown split, size or kind, no matplotlib.
        DataError: no scenario is there, or a file is damaged.
    """
    tier, folder, splits = locate(split, size, root=root, registry=registry)
    update_working_copy(tier, folder, tier.scenarios)
    panel = None
    if kind is not None and kind != ALL:
        check_kind(kind)
        panel = Panel(kind)
        _check_view(panel, tier)
    return draw_contact_sheet(
        tier, folder, output, registry=splits, panel=panel, frame=frame, dpi=dpi
    )


def draw_contact_sheet(
    tier: Size,
    folder: Path,
    output: str | Path,
    *,
    registry: Registry,
    panel: Panel | None = None,
    frame: int | None = None,
    dpi: float = DPI,
    option: str = "--output",
) -> Path:
    """Draw the scenarios of a data set that lies in a root folder on one page.

    Args:
        tier: the data set.
        folder: folder that holds all data sets.
        output: file to write, ending in .png, .pdf or .svg.
        registry: where splits are described.
        panel: what each panel shows; the default suits the split.
        frame: see ``contact_sheet``.
        dpi: pixels per inch.
        option: the option that names another place, for messages.

    Raises:
        DataError: no scenario is there, or a file is damaged.
    """
    files = _list_existing_files(tier, folder)
    if not files:
        fix = suggest_repair(tier, root=folder)
        raise DataError(
            f"nothing to draw: no scenario of {tier.split} {tier.name} is there; {fix}"
        )
    kinds = _first_of_each_kind(files, registry)
    if kinds:
        sheet = _arrange_over_time(kinds, panel, registry)
    else:
        sheet = _arrange_table(files, panel, frame=frame, splits=registry)
    title = f"{registry.split(tier.split).title} · {tier.split} {tier.name}"
    return _draw_sheet(sheet, title, output, dpi=dpi, option=option)


def _list_existing_files(size: Size, root: Path) -> list[Path]:
    """Return the scenario files that exist, subset by subset, each by id."""
    files = []
    for ids in size.subsets.values():
        for scenario in sorted(ids):
            path = size.path(root, scenario)
            if has_file(path):
                files.append(path)
    return files


def _first_of_each_kind(files: Sequence[Path], splits: Registry) -> dict[str, Path]:
    """Return the first scenario of every family or pair, in the order of names."""
    paths: dict[str, Path] = {}
    for path in files:
        with open_recording(path, registry=splits) as recording:
            parameters = recording.parameters
        for name in KIND_PARAMETERS:
            kind = str(parameters.get(name, ""))
            if kind:
                paths.setdefault(kind, path)
                break

    def file_name(kind: str) -> str:
        return paths[kind].name

    paths_by_name = {}
    for kind in sorted(paths, key=file_name):
        paths_by_name[kind] = paths[kind]
    return paths_by_name


def choose_moments(frames: int) -> list[int]:
    """Return the frames of a row over time, of a recording of so many frames."""
    last = frames - 1
    shares = TIMES
    if TIMES[1] * last < FEWEST_BETWEEN:
        shares = EVEN_TIMES
    return [round(share * last) for share in shares]


def _arrange_over_time(
    kinds: Mapping[str, Path], panel: Panel | None, splits: Registry
) -> ContactSheet:
    """Return one row per kind: the same moments of each, one colour scale."""
    rows = []
    is_mixed = False
    for path in kinds.values():
        row = []
        with open_recording(path, registry=splits) as recording:
            is_mixed = is_mixed or recording.is_mixed
            for number in choose_moments(recording.frames):
                row.append(recording.scene(number))
        rows.append(row)
    if panel is None and is_mixed:
        panel = Panel.MATERIAL
    elif panel is None:
        panel = Panel.SPEED

    limits = []
    for scene in itertools.chain(*rows):
        limits.append(limit_of(panel, scene))
    limit = strongest_limit(limits)
    cells = []
    for kind, row in zip(kinds, rows, strict=True):
        line = []
        for scene in row:
            label = f"frame {scene.frame}"
            if scene is row[0]:
                label = f"{scene.recording.scenario}  {kind}"
            line.append(SheetCell(scene, label, limit))
        cells.append(line)
    return ContactSheet(
        rows=cells,
        panel=panel,
        subtitle="the first scenario of each kind over time",
        limit=limit,
    )


def _arrange_table(
    files: Sequence[Path], panel: Panel | None, *, frame: int | None, splits: Registry
) -> ContactSheet:
    """Return a table of scenarios at one frame, or at three where walls drive them."""
    with open_recording(files[0], registry=splits) as recording:
        is_driven = bool(recording.wall_velocity.any())
        if frame is None:
            frames = _choose_frames(recording)
        else:
            frames = [frame]
    if is_driven:
        shown_files = files[:MOST_DRIVEN]
        panel = panel or Panel.STREAMLINES
    else:
        shown_files = files[:MOST_DECAYING]
        panel = panel or Panel.VORTICITY

    scenes = []
    limits = []
    for path in shown_files:
        with open_recording(path, registry=splits) as recording:
            for number in frames:
                scene = recording.scene(number)
                scenes.append(scene)
                limits.append(limit_of(panel, scene))
    common_limit = median_limit(limits)

    # speeds of driven flows are compared with the speed of the wall
    is_wall_scaled = is_driven and panel in (Panel.STREAMLINES, Panel.SPEED)
    cells = []
    for number, scene in enumerate(scenes):
        is_first_of_scenario = number % len(frames) == 0
        if is_first_of_scenario:
            recording = scene.recording
            marks = _describe_parameters(recording)[:1]
            label = "   ".join([str(recording.scenario), *marks])
        else:
            label = f"frame {scene.frame}"
        limit = common_limit
        if is_wall_scaled:
            wall_speed = np.abs(scene.recording.wall_velocity).max()
            limit = WALL_SHARE * wall_speed
        cells.append(SheetCell(scene, label, limit))

    columns = COLUMNS
    if len(frames) > 1:
        columns = 3 * len(frames)
    rows = []
    for first in range(0, len(cells), columns):
        rows.append(cells[first : first + columns])
    shown_frames = ", ".join(str(scene.frame) for scene in scenes[: len(frames)])
    subtitle = f"{len(shown_files)} scenarios at frame {shown_frames}"
    if is_wall_scaled:
        return ContactSheet(
            rows=rows,
            panel=panel,
            subtitle=subtitle,
            limit=WALL_SHARE,
            unit="speed / wall speed",
        )
    return ContactSheet(rows=rows, panel=panel, subtitle=subtitle, limit=common_limit)


def _choose_frames(recording: Recording) -> list[int]:
    """Return the frames of a table of scenarios like this one."""
    latest = recording.size.task.frames_of_interest[-1]
    latest = min(latest, recording.frames - 1)
    if recording.wall_velocity.any():
        return [round(share * latest) for share in MOMENTS]
    starts_at_rest = not recording.scene(0).speed.any()
    if starts_at_rest:
        return [latest]
    return [0]


def _draw_sheet(
    sheet: ContactSheet, title: str, output: str | Path, *, dpi: float, option: str
) -> Path:
    """Draw a contact sheet; return the path of its file."""
    columns = max(map(len, sheet.rows))
    width = max(2 * RIM + columns * (CELL + CELL_GAP) - CELL_GAP, NARROWEST)
    low, high = _heights_shown(sheet.rows[0][0].scene.recording)
    panel_height = CELL * (high - low)
    row_height = panel_height + LABEL + CELL_GAP
    height = HEAD + len(sheet.rows) * row_height + FOOT
    with figure(width, height, dpi=dpi) as drawn:
        draw_header(drawn, title, sheet.subtitle, left=RIM)
        cell_width = CELL / width
        cell_height = panel_height / height
        for row, cells in enumerate(sheet.rows):
            bottom = height - HEAD - (row + 1) * row_height + CELL_GAP
            for column, cell in enumerate(cells):
                left = RIM + column * (CELL + CELL_GAP)
                place = (left / width, bottom / height, cell_width, cell_height)
                axes = drawn.add_axes(place)
                _draw_cell(axes, sheet.panel, cell)
                axes.set(ylim=(low, high))
        _draw_key(drawn, sheet, width=width, height=height)
        return save(drawn, output, option=option)


def _heights_shown(recording: Recording) -> tuple[float, float]:
    """Return the lowest and the highest place that a cell shows [length].

    A cell shows the unit square, or of a low channel the channel and its walls.
    """
    if recording.is_solid:
        return 0.0, 1.0
    left, right, bottom, top = box_of(recording)
    rim = max(left, 1.0 - right, LEAST_RIM)
    return max(0.0, bottom - rim), min(1.0, top + rim)


def _draw_cell(axes: Axes, panel: Panel, cell: SheetCell) -> None:
    title = axes.set_title(cell.label, fontsize=7.5, color=MUTED, pad=2.5)
    shrink(title, CELL)
    draw(axes, panel, cell.scene, limit=cell.limit, detail=0.0)


def _draw_key(
    drawn: Figure, sheet: ContactSheet, *, width: float, height: float
) -> None:
    """Draw the colour bar or the key of materials below the cells."""
    place = (RIM / width, 0.42 / height, 2.6 / width, 0.09 / height)
    below = drawn.add_axes(place)
    if sheet.panel is Panel.MATERIAL:
        materials = []
        for cell in itertools.chain(*sheet.rows):
            materials.append(cell.scene.recording.material)
        draw_material_key(below, np.concatenate(materials))
    else:
        is_solid = sheet.rows[0][0].scene.recording.is_solid
        colour_bar(below, sheet.panel, sheet.limit, label=sheet.unit, is_solid=is_solid)
