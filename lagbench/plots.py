"""Pictures of one frame: particles, vorticity, streamlines, with the walls around them.

Needs matplotlib: ``pip install 'lagbench[plots]'``. The same frame gives the same bytes.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from .canvas import figure, header, save_png
from .contact_sheet import contact_sheet
from .errors import UsageError, nearest
from .panels import TITLES, Panel, colour_bar, draw, limit_of, material_key, moving_walls
from .recording import Recording, Scene, open_recording

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.figure import Figure

    from .registry import Registry

__all__ = ["KINDS", "Panel", "contact_sheet", "describe", "plot_frame"]

ALL = "all"
KINDS = (ALL, *(str(panel) for panel in Panel))
"""What :func:`plot_frame` can draw."""

SIDE, GAP, MARGIN, TOP, BAR = 3.25, 0.25, 0.25, 0.96, 0.66  # [inch]
WALLS = ("left", "right", "bottom", "top")
MARKS = ("family", "pair", "frequency")
SEPARATOR = "  ·  "
DIRECTIONS = {(1, 0): "right", (-1, 0): "left", (0, 1): "up", (0, -1): "down"}


def plot_frame(
    source: str | Path | xr.Dataset,
    frame: int,
    output: str | Path,
    *,
    kind: str = ALL,
    registry: Registry | None = None,
) -> Path:
    """Draw one frame of a scenario as a PNG file; return its path.

    Args:
        source: scenario file, or a data set of one scenario.
        frame: absolute frame number; negative ones count from the end.
        output: file to write, ending in .png.
        kind: one of :data:`KINDS`; ``all`` draws three panels side by side.
        registry: where splits are described; ours when None.

    Raises:
        UsageError: unknown kind, no such frame, a name that is no .png, no matplotlib.
        DataError: the scenario file is missing or damaged.
    """
    if kind not in KINDS:
        raise UsageError(f"no kind of picture {kind!r}", where="--kind", fix=nearest(kind, KINDS))
    with open_recording(source, registry=registry) as recording:
        scene = recording.scene(frame)
    panels = _panels(recording) if kind == ALL else [Panel(kind)]
    width = 2 * MARGIN + len(panels) * SIDE + (len(panels) - 1) * GAP
    with figure(width, TOP + SIDE + BAR) as drawn:
        single = len(panels) == 1
        subtitle = describe(recording) if single else SEPARATOR.join([describe(recording), *_moment(scene)])
        header(drawn, recording.title, subtitle, left=MARGIN)
        _draw_panels(drawn, panels, scene)
        return save_png(drawn, output)


def describe(recording: Recording) -> str:
    """Return split, size, scenario and what sets it apart, as in "cavity full · scenario 3 · Re 120"."""
    parts = [f"{recording.size.split} {recording.size.name}", f"scenario {recording.scenario}"]
    if recording.reynolds is not None:
        parts.append(f"Re {recording.reynolds:.0f}")
    parts += [f"{name} {recording.parameters[name]}" for name in MARKS if name in recording.parameters]
    return SEPARATOR.join(parts)


def _moment(scene: Scene) -> list[str]:
    """Return frame and time, and which walls move, which way, how fast."""
    return [f"frame {scene.frame}", f"t = {scene.time:.2f} s", *_motions(scene.recording)]


def _motions(recording: Recording) -> list[str]:
    """Say which walls move, which way, how fast."""
    return [
        f"{WALLS[wall]} wall moves {DIRECTIONS[_sign(v[0]), _sign(v[1])]} at {np.abs(v).max():.3g} length/s"
        for wall, v in moving_walls(recording)
    ]


def _sign(value: float) -> int:
    return int(np.sign(value))


def _panels(recording: Recording) -> list[Panel]:
    """Return the three panels that suit a scenario."""
    if np.unique(recording.material).size > 1:
        return [Panel.MATERIAL, Panel.SPEED, Panel.VORTICITY]
    return [Panel.SPEED, Panel.VORTICITY, Panel.STREAMLINES]


def _draw_panels(drawn: Figure, panels: Sequence[Panel], scene: Scene) -> None:
    width, height = drawn.get_size_inches()
    for column, panel in enumerate(panels):
        left = (MARGIN + column * (SIDE + GAP)) / width
        axes = drawn.add_axes((left, BAR / height, SIDE / width, SIDE / height))
        moment = f" at frame {scene.frame}, t = {scene.time:.2f} s" if len(panels) == 1 else ""
        axes.set_title(TITLES[panel] + moment)
        limit = limit_of(panel, scene)
        draw(axes, panel, scene, limit=limit)
        below = drawn.add_axes((left, (BAR - 0.2) / height, SIDE / width, 0.09 / height))
        if panel is Panel.MATERIAL:
            material_key(below, scene.recording.material)
        else:
            colour_bar(below, panel, limit)
