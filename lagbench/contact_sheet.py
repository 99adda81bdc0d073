"""Contact sheets: many scenarios of a split on one page, to be looked at.

Splits whose scenarios draw a ``family`` or ``pair`` get one row per kind over time; the
others get a table of scenarios at one frame. Needs matplotlib.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from .canvas import figure, header, save_png
from .errors import DataError
from .format import ScenarioKey, scenario_path
from .locating import locate
from .palette import MUTED
from .panels import Panel, colour_bar, draw, limit_of, material_key
from .recording import Recording, Scene, open_recording
from .registry import Registry, Size
from .remedy import remedy
from .store.bringing import bring

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["contact_sheet", "scenario_files"]

COLUMNS = 6
TIMES = (0.0, 0.05, 0.1, 0.2, 0.5, 1.0)
"""Moments of a row over time, as shares of the last frame."""

DRIVEN, DECAYING = 30, 36
"""Scenarios on a sheet of flows that walls drive, and of those that only decay (Figs. 5.7, 5.20)."""

SIDE, GAP, LABEL, MARGIN, TOP, BAR = 1.3, 0.08, 0.18, 0.22, 0.7, 0.58  # [inch]
KIND_PARAMETERS = ("family", "pair")
WALL_SHARE = 0.6  # the fluid itself seldom moves faster than this share of the wall's speed


@dataclass(frozen=True, kw_only=True)
class _Cell:
    """One small panel: a scene, its label, and the top of its colour scale."""

    scene: Scene
    label: str
    limit: float


@dataclass(frozen=True, kw_only=True)
class _Sheet:
    """What is on a page.

    Attributes:
        rows: the small panels.
        panel: what they show.
        subtitle: second line of the title.
        limit: top of the colour bar.
        unit: label of the colour bar where it is not the panel's own.
    """

    rows: Sequence[Sequence[_Cell]]
    panel: Panel
    subtitle: str
    limit: float
    unit: str | None = None


def contact_sheet(
    split: str,
    size: str,
    output: str | Path,
    *,
    root: str | Path | None = None,
    kind: Panel | str | None = None,
    frame: int | None = None,
    registry: Registry | None = None,
) -> Path:
    """Draw many scenarios of a split on one page as a PNG file; return its path.

    Args:
        split: name of the split.
        size: name of the size.
        output: file to write, ending in .png.
        root: folder that holds all data sets; see ``resolve_root``.
        kind: what each panel shows; the default suits the split.
        frame: frame to show where the sheet is a table of scenarios; when None, the first, or
            the last frame of interest of what starts at rest or is driven.
        registry: where splits are described; ours when None.

    Raises:
        UsageError: unknown split, size or kind, no matplotlib.
        DataError: no scenario is there, or a file is damaged.
    """
    tier, folder, splits = locate(split, size, root=root, registry=registry)
    bring(tier, folder, tier.scenarios)
    files = scenario_files(tier, folder)
    if not files:
        raise DataError(
            "nothing to draw",
            where=f"{tier.split} {size} under {folder}",
            fix=remedy(tier, root=folder),
        )
    panel = None if kind is None else Panel(kind)
    kinds = _first_of_each_kind(files, splits)
    sheet = _over_time(kinds, panel, splits) if kinds else _table(files, panel, frame, splits)
    columns = max(len(row) for row in sheet.rows)
    width = 2 * MARGIN + columns * (SIDE + GAP) - GAP
    height = TOP + len(sheet.rows) * (SIDE + LABEL + GAP) + BAR
    with figure(max(width, 5.0), height) as drawn:
        header(drawn, f"{splits.split(tier.split).title} · {tier.split} {size}", sheet.subtitle, left=MARGIN)
        _draw_sheet(drawn, sheet)
        return save_png(drawn, output)


def scenario_files(size: Size, root: Path) -> list[Path]:
    """Return the scenario files that are there: train, valid, test, extra, each by id."""
    keys = (
        ScenarioKey(split=size.split, size=size.name, version=size.version, scenario=i, subset=subset)
        for subset, ids in size.subsets.items()
        for i in sorted(ids)
    )
    return [path for path in (scenario_path(root, key) for key in keys) if path.is_file()]


def _kind_of(recording: Recording) -> str:
    names = [str(recording.parameters[name]) for name in KIND_PARAMETERS if name in recording.parameters]
    return names[0] if names else ""


def _first_of_each_kind(files: Sequence[Path], splits: Registry) -> dict[str, Path]:
    """Return the first scenario of every family or pair, in order of appearance."""
    found: dict[str, Path] = {}
    for path in files:
        with open_recording(path, registry=splits) as recording:
            if kind := _kind_of(recording):
                found.setdefault(kind, path)
    return dict(sorted(found.items(), key=lambda item: item[1].name))


def _over_time(kinds: dict[str, Path], panel: Panel | None, splits: Registry) -> _Sheet:
    """Return one row per kind: the same moments of each, one colour scale."""
    rows = [list(_moments(path, splits)) for path in kinds.values()]
    if panel is None:
        mixed = any(np.unique(row[0].recording.material).size > 1 for row in rows)
        panel = Panel.MATERIAL if mixed else Panel.SPEED
    limit = max(limit_of(panel, scene) for row in rows for scene in row)
    cells = [
        [_Cell(scene=s, label=_moment_label(kind, s, first=s is row[0]), limit=limit) for s in row]
        for kind, row in zip(kinds, rows, strict=True)
    ]
    return _Sheet(rows=cells, panel=panel, subtitle="the first scenario of each kind over time", limit=limit)


def _moments(path: Path, splits: Registry) -> Iterator[Scene]:
    with open_recording(path, registry=splits) as recording:
        for share in TIMES:
            yield recording.scene(round(share * (recording.frames - 1)))


def _moment_label(kind: str, scene: Scene, *, first: bool) -> str:
    return f"{scene.recording.scenario}  {kind}" if first else f"frame {scene.frame}"


def _table(files: Sequence[Path], panel: Panel | None, frame: int | None, splits: Registry) -> _Sheet:
    """Return a table of scenarios at one frame."""
    with open_recording(files[0], registry=splits) as recording:
        driven = bool(recording.wall_velocity.any())
        panel = panel or (Panel.STREAMLINES if driven else Panel.VORTICITY)
        if frame is None:
            starts_at_rest = driven or not recording.scene(0).speed.any()
            latest = recording.size.task.frames_of_interest[-1] if starts_at_rest else 0
            frame = min(latest, recording.frames - 1)
    scenes = []
    for path in files[: DRIVEN if driven else DECAYING]:
        with open_recording(path, registry=splits) as recording:
            scenes.append(recording.scene(frame))
    scaled = driven and panel in (Panel.STREAMLINES, Panel.SPEED)
    common = float(np.median([limit_of(panel, scene) for scene in scenes]))
    limits = [WALL_SHARE * np.abs(s.recording.wall_velocity).max() if scaled else common for s in scenes]
    cells = [_Cell(scene=s, label=_name(s), limit=m) for s, m in zip(scenes, limits, strict=True)]
    return _Sheet(
        rows=[cells[i : i + COLUMNS] for i in range(0, len(cells), COLUMNS)],
        panel=panel,
        subtitle=f"{len(cells)} scenarios at frame {scenes[0].frame}",
        limit=WALL_SHARE if scaled else common,
        unit="speed / wall speed" if scaled else None,
    )


def _name(scene: Scene) -> str:
    recording = scene.recording
    if recording.reynolds is not None:
        return f"{recording.scenario}   Re {recording.reynolds:.0f}"
    if "frequency" in recording.parameters:
        return f"{recording.scenario}   frequency {recording.parameters['frequency']}"
    return str(recording.scenario)


def _draw_sheet(drawn: Figure, sheet: _Sheet) -> None:
    width, height = drawn.get_size_inches()
    for row, cells in enumerate(sheet.rows):
        for column, cell in enumerate(cells):
            left = MARGIN + column * (SIDE + GAP)
            bottom = height - TOP - (row + 1) * (SIDE + LABEL + GAP) + GAP
            axes = drawn.add_axes((left / width, bottom / height, SIDE / width, SIDE / height))
            axes.set_title(cell.label, fontsize=7.5, color=MUTED, pad=2.5)
            draw(axes, sheet.panel, cell.scene, limit=cell.limit, detail=0.0)
    below = drawn.add_axes((MARGIN / width, 0.42 / height, 2.6 / width, 0.09 / height))
    if sheet.panel is Panel.MATERIAL:
        material_key(below, np.concatenate([c.scene.recording.material for row in sheet.rows for c in row]))
    else:
        colour_bar(below, sheet.panel, sheet.limit, label=sheet.unit)
