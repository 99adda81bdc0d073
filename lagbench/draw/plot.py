"""Pictures of one frame, and contact sheets: many scenarios of a split on one page.

Needs matplotlib: ``pip install 'lagbench[plots]'``. The same frame gives the same
bytes. Splits whose scenarios draw a ``family`` or ``pair`` get a sheet of one row per
kind over time; the others get a table of scenarios at one frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lagbench.data import WALLS
from lagbench.data.local import locate, suggest_repair
from lagbench.data.registry import Registry, Size
from lagbench.errors import DataError, UsageError, suggest_name
from lagbench.store.copy import update_working_copy

from .panels import (
    TITLES,
    Panel,
    colour_bar,
    draw,
    limit_of,
    material_key,
    moving_walls,
)
from .recording import Recording, Scene, open_recording
from .style import DPI, MUTED, figure, header, save

if TYPE_CHECKING:
    import xarray as xr

__all__ = [
    "KINDS",
    "Panel",
    "check_kind",
    "contact_sheet",
    "describe",
    "plot_frame",
    "scenario_files",
]


COLUMNS = 6
TIMES = (
    0.0,
    0.05,
    0.1,
    0.2,
    0.5,
    1.0,
)  # moments of a row over time, as shares of the last frame
# the same of the last frame of interest, for flows that walls drive
MOMENTS = 1 / 9, 1 / 2, 1.0
DRIVEN = 30
# scenarios on a sheet of flows that walls drive, that only decay (Figs. 5.7, 5.20)
DECAYING = 36
CELL = 1.3
CELL_GAP = 0.08
LABEL = 0.18
RIM = 0.22
HEAD = 0.7
FOOT = 0.58  # of a sheet [inch]
KIND_PARAMETERS = ("family", "pair")
# the fluid itself seldom moves faster than this share of the wall's speed
WALL_SHARE = 0.6


_Cell = tuple[Scene, str, float]  # a small panel: scene, label, top of the colour scale


@dataclass(frozen=True, kw_only=True)
class _Sheet:
    """What is on a page."""

    rows: Sequence[Sequence[_Cell]]
    panel: Panel  # what they show
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
    dpi: int = DPI,
    registry: Registry | None = None,
) -> Path:
    """Draw many scenarios of a split on one page; return the path of the file.

    Args:
        split: name of the split.
        size: name of the size.
        output: file to write, ending in .png, .pdf or .svg.
        root: folder that holds all data sets; see ``resolve_root``.
        kind: what each panel shows; the default suits the split.
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
    files = scenario_files(tier, folder)
    if not files:
        where = f"{tier.split} {size} under {folder}"
        raise DataError(
            "nothing to draw", where=where, fix=suggest_repair(tier, root=folder)
        )
    if kind is None:
        panel = None
    else:
        panel = Panel(kind)
    found: dict[str, Path] = {}  # the first scenario of every family or pair
    for path in files:
        with open_recording(path, registry=splits) as recording:
            named = [
                str(recording.parameters[n])
                for n in KIND_PARAMETERS
                if n in recording.parameters
            ]
            if named and named[0]:
                found.setdefault(named[0], path)
    kinds = dict(sorted(found.items(), key=lambda item: item[1].name))
    if kinds:
        sheet = _over_time(kinds, panel, splits)
    else:
        sheet = _table(files, panel, frame, splits)
    columns = max(len(row) for row in sheet.rows)
    width = max(2 * RIM + columns * (CELL + CELL_GAP) - CELL_GAP, 5.0)
    height = HEAD + len(sheet.rows) * (CELL + LABEL + CELL_GAP) + FOOT
    with figure(width, height, dpi=dpi) as drawn:
        header(
            drawn,
            f"{splits.split(tier.split).title} · {tier.split} {size}",
            sheet.subtitle,
            left=RIM,
        )
        for row, cells in enumerate(sheet.rows):
            for column, (scene, label, limit) in enumerate(cells):
                left = RIM + column * (CELL + CELL_GAP)
                bottom = (
                    height - HEAD - (row + 1) * (CELL + LABEL + CELL_GAP) + CELL_GAP
                )
                axes = drawn.add_axes(
                    (left / width, bottom / height, CELL / width, CELL / height)
                )
                axes.set_title(label, fontsize=7.5, color=MUTED, pad=2.5)
                draw(axes, sheet.panel, scene, limit=limit, detail=0.0)
        below = drawn.add_axes((RIM / width, 0.42 / height, 2.6 / width, 0.09 / height))
        if sheet.panel is Panel.MATERIAL:
            shown = [
                scene.recording.material for row in sheet.rows for scene, *_ in row
            ]
            material_key(below, np.concatenate(shown))
        else:
            colour_bar(below, sheet.panel, sheet.limit, label=sheet.unit)
        return save(drawn, output)


def scenario_files(size: Size, root: Path) -> list[Path]:
    """Return the scenario files that are there: train, valid, test, extra, each by
    id.
    """
    paths = (size.path(root, i) for ids in size.subsets.values() for i in sorted(ids))
    return [path for path in paths if path.is_file()]


def _over_time(kinds: dict[str, Path], panel: Panel | None, splits: Registry) -> _Sheet:
    """Return one row per kind: the same moments of each, one colour scale."""
    rows = []
    for path in kinds.values():
        with open_recording(path, registry=splits) as recording:
            rows.append(
                [
                    recording.scene(round(share * (recording.frames - 1)))
                    for share in TIMES
                ]
            )
    if panel is None:
        mixed = any(np.unique(row[0].recording.material).size > 1 for row in rows)
        if mixed:
            panel = Panel.MATERIAL
        else:
            panel = Panel.SPEED
    limit = max(limit_of(panel, scene) for row in rows for scene in row)
    cells = []
    for kind, row in zip(kinds, rows, strict=True):
        labels = [
            f"{row[0].recording.scenario}  {kind}",
            *(f"frame {scene.frame}" for scene in row[1:]),
        ]
        cells.append(
            [(scene, label, limit) for scene, label in zip(row, labels, strict=True)]
        )
    return _Sheet(
        rows=cells,
        panel=panel,
        subtitle="the first scenario of each kind over time",
        limit=limit,
    )


def _table(
    files: Sequence[Path], panel: Panel | None, frame: int | None, splits: Registry
) -> _Sheet:
    """Return a table of scenarios at one frame, or at three of what is driven."""
    with open_recording(files[0], registry=splits) as recording:
        driven = bool(recording.wall_velocity.any())
        panel = panel or (Panel.STREAMLINES if driven else Panel.VORTICITY)
        if frame is not None:
            frames = [frame]
        else:
            frames = [0]
        if frame is None and (driven or not recording.scene(0).speed.any()):
            latest = min(
                recording.size.task.frames_of_interest[-1], recording.frames - 1
            )
            if driven:
                frames = [round(share * latest) for share in MOMENTS]
            else:
                frames = [latest]
    scenes = []
    for path in files[: DRIVEN if driven else DECAYING]:
        with open_recording(path, registry=splits) as recording:
            scenes += [recording.scene(moment) for moment in frames]
    scaled = driven and panel in (Panel.STREAMLINES, Panel.SPEED)
    common = float(np.median([limit_of(panel, scene) for scene in scenes]))
    limits = [
        WALL_SHARE * np.abs(s.recording.wall_velocity).max() if scaled else common
        for s in scenes
    ]
    labels = [f"frame {scene.frame}" for scene in scenes]
    for i in range(0, len(scenes), len(frames)):  # the first of each scenario
        recording = scenes[i].recording
        labels[i] = "   ".join(
            [str(recording.scenario), *_marks(recording, ("frequency",))[:1]]
        )
    cells = list(zip(scenes, labels, limits, strict=True))
    shown = ", ".join(str(scene.frame) for scene in scenes[: len(frames)])
    if len(frames) == 1:
        columns = COLUMNS
    else:
        columns = 3 * len(frames)
    return _Sheet(
        rows=[cells[i : i + columns] for i in range(0, len(cells), columns)],
        panel=panel,
        subtitle=f"{len(cells) // len(frames)} scenarios at frame {shown}",
        limit=WALL_SHARE if scaled else common,
        unit="speed / wall speed" if scaled else None,
    )


ALL = "all"
KINDS = (ALL, *(str(panel) for panel in Panel))
"""What :func:`plot_frame` can draw."""

SIDE = 3.25
GAP = 0.25
MARGIN = 0.25
TOP = 0.96
BAR = 0.66  # of a frame [inch]
SEPARATOR = "  ·  "
DIRECTIONS = {(1, 0): "right", (-1, 0): "left", (0, 1): "up", (0, -1): "down"}


def check_kind(kind: str) -> None:
    """Refuse a kind of picture that :func:`plot_frame` cannot draw."""
    if kind not in KINDS:
        raise UsageError(
            f"no kind of picture {kind!r}",
            where="--kind",
            fix=suggest_name(kind, KINDS),
        )


def plot_frame(
    source: str | Path | xr.Dataset,
    frame: int,
    output: str | Path,
    *,
    kind: str = ALL,
    dpi: int = DPI,
    registry: Registry | None = None,
) -> Path:
    """Draw one frame of a scenario; return the path of the file.

    Args:
        source: scenario file, or a data set of one scenario.
        frame: absolute frame number; negative ones count from the end.
        output: file to write, ending in .png, .pdf or .svg.
        kind: one of :data:`KINDS`; ``all`` draws three panels side by side.
        dpi: pixels per inch.
        registry: where splits are described; ours when None.

    Raises:
        UsageError: unknown kind, no such frame, a name with another ending, no
            matplotlib.
        DataError: the scenario file is missing or damaged.
    """
    check_kind(kind)
    with open_recording(source, registry=registry) as recording:
        scene = recording.scene(frame)
    mixed = np.unique(recording.material).size > 1
    three = [Panel.SPEED, Panel.VORTICITY]
    if mixed:
        three = [Panel.MATERIAL, *three]
    else:
        three = [*three, Panel.STREAMLINES]
    if kind == ALL:
        panels = three
    else:
        panels = [Panel(kind)]
    width = 2 * MARGIN + len(panels) * SIDE + (len(panels) - 1) * GAP
    height = TOP + SIDE + BAR
    with figure(width, height, dpi=dpi) as drawn:
        subtitle = describe(recording)
        if len(panels) > 1:
            # frame and time, and which walls move, which way, how fast
            said = [subtitle, f"frame {scene.frame}", f"t = {scene.time:.2f} s"]
            for wall, v in moving_walls(recording, scene.frame):
                way = DIRECTIONS[int(np.sign(v[0])), int(np.sign(v[1]))]
                said.append(
                    f"{WALLS[wall]} wall moves {way} at {np.abs(v).max():.3g} length/s"
                )
            subtitle = SEPARATOR.join(said)
        header(drawn, recording.title, subtitle, left=MARGIN)
        for column, panel in enumerate(panels):
            left = (MARGIN + column * (SIDE + GAP)) / width
            axes = drawn.add_axes((left, BAR / height, SIDE / width, SIDE / height))
            if len(panels) == 1:
                moment = f" at frame {scene.frame}, t = {scene.time:.2f} s"
            else:
                moment = ""
            axes.set_title(TITLES[panel] + moment)
            limit = limit_of(panel, scene)
            draw(axes, panel, scene, limit=limit)
            below = drawn.add_axes(
                (left, (BAR - 0.2) / height, SIDE / width, 0.09 / height)
            )
            if panel is Panel.MATERIAL:
                material_key(below, recording.material)
            else:
                colour_bar(below, panel, limit)
        return save(drawn, output)


def describe(recording: Recording) -> str:
    """Return split, size, scenario and what sets it apart, as in "cavity full ·
    scenario 3 · Re 120".
    """
    parts = [
        f"{recording.size.split} {recording.size.name}",
        f"scenario {recording.scenario}",
    ]
    return SEPARATOR.join([*parts, *_marks(recording, ("family", "pair", "frequency"))])


def _marks(recording: Recording, names: Sequence[str]) -> list[str]:
    if recording.reynolds is None:
        marks = []
    else:
        marks = [f"Re {recording.reynolds:.0f}"]
    return marks + [
        f"{name} {recording.parameters[name]}"
        for name in names
        if name in recording.parameters
    ]
