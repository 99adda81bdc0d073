"""Particles by material, truth above predictions, six times (Figs. 4.11 to 4.13)."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from lagbench.format import MATERIALS
from lagbench.metrics import Snapshot
from lagbench.palette import MATERIAL_COLOURS, rgb

from .gallery import Gallery, Moment
from .markup import Markup, join
from .page import Figure, key
from .panels import grid, image
from .png import encode
from .subject import Subject

__all__ = ["paint", "particle_figures"]

SIDE = 176
"""Side of a painted panel [pixel]."""

FINE = 3
"""Panels are painted so many times larger and averaged, which smooths the rims of the dots."""

DOT = 1.3
"""Diameter of a dot in particle distances."""

ROWS = 24
"""Most rows of panels on the page; more would make it too heavy."""

SHADES = FINE * FINE


def particle_figures(subject: Subject, gallery: Gallery) -> Iterator[Figure]:
    """Yield one figure per scenario, as many as there is room for."""
    per_scenario = 1 + len(subject.entries)
    shown = subject.scenarios[: max(1, ROWS // per_scenario)]
    for scenario in shown:
        left_out = len(subject.scenarios) - len(shown) if scenario == shown[-1] else 0
        yield _figure(subject, gallery, scenario, left_out=left_out)


def _figure(subject: Subject, gallery: Gallery, scenario: int, *, left_out: int) -> Figure:
    moments, walls = gallery.at(scenario, subject.times), gallery.walls[scenario]
    rows = [("truth", [_panel(subject, gallery, m, m.truth, "truth") for m in moments])]
    for i, entry in enumerate(subject.entries):
        panels = [_panel(subject, gallery, m, m.pairs[i].prediction, "prediction") for m in moments]
        rows.append((entry.name, panels))
    present = np.unique(moments[0].setting_of.material).tolist()
    seconds = [f"frame {m.frame}\u2002{m.frame * subject.exam.size.frame_interval:.2f} s" for m in moments]
    more = f" For want of room {left_out} more test scenarios are not drawn." if left_out else ""
    what = f": {walls.mark}" if walls.mark else ""
    return Figure(
        name=f"particles-{scenario}",
        title=f"Particles, scenario {scenario}{what}",
        thesis="Fig. 4.11" if len(present) == 1 and present[0] == 0 else "Figs. 4.12, 4.13",
        body=join([key([(f"m{m}", MATERIALS[m]) for m in present], kind="square"), grid(seconds, rows)]),
        caption=join(
            [f"All particles by material, truth above predictions, inside the walls of the box.{more}"]
        ),
        wide=True,
    )


def _panel(subject: Subject, gallery: Gallery, moment: Moment, snapshot: Snapshot, what: str) -> Markup:
    material, area = moment.setting_of.material, moment.setting_of.area
    spacing = float(np.sqrt(area / len(material)))
    png = paint(snapshot.position, material, subject.exam.size.bounds, spacing)
    return image(png, gallery.walls[moment.scenario], f"{what}, frame {moment.frame}", smooth=True)


def paint(
    position: NDArray[np.floating],
    material: NDArray[np.integer],
    bounds: tuple[tuple[float, float], tuple[float, float]],
    spacing: float,
) -> bytes:
    """Return the particles inside the box as PNG; later particles lie on earlier ones.

    Args:
        position: positions [length], shape [particle, 2].
        material: material of each particle, shape [particle].
        bounds: walls of the box along x and along y [length].
        spacing: distance of neighbouring particles at first [length].
    """
    (left, right), (bottom, top) = bounds
    fine = SIDE * FINE
    disc = _disc(DOT * spacing / (right - left) * fine)
    margin = int(np.abs(disc).max()) + 1
    x, y = position.T
    shown = (x >= left) & (x <= right) & (y >= bottom) & (y <= top)
    column = np.minimum((x[shown] - left) / (right - left) * fine, fine - 1).astype(np.intp) + margin
    row = np.minimum((top - y[shown]) / (top - bottom) * fine, fine - 1).astype(np.intp) + margin
    canvas = np.zeros((fine + 2 * margin, fine + 2 * margin), np.uint8)
    colour = np.asarray(material)[shown].astype(np.uint8) + 1
    canvas[row[:, None] + disc[0], column[:, None] + disc[1]] = colour[:, None]
    return encode(_averaged(canvas[margin:-margin, margin:-margin]), _PALETTE)


def _disc(diameter: float) -> NDArray[np.intp]:
    """Return rows and columns of a dot's pixels from its middle, shape [2, pixel]."""
    reach = int(np.ceil(diameter / 2))
    offsets = np.mgrid[-reach : reach + 1, -reach : reach + 1].reshape(2, -1)
    inside = (offsets**2).sum(axis=0) <= max(diameter / 2, 0.5) ** 2
    return offsets[:, inside]


def _averaged(canvas: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return an image FINE times smaller: the commonest material of a block, as opaque as it is full."""
    blocks = canvas.reshape(SIDE, FINE, SIDE, FINE)
    counts = np.stack([(blocks == m + 1).sum(axis=(1, 3)) for m in range(len(MATERIALS))])
    filled = counts.sum(axis=0)
    entry = np.argmax(counts, axis=0) * SHADES + filled
    return np.where(filled > 0, entry, 0).astype(np.uint8)


def _palette() -> NDArray[np.uint8]:
    """Return nothing, then every material in every opacity, shape [entry, 4]."""
    table = np.zeros((1 + len(MATERIALS) * SHADES, 4), np.uint8)
    for m, colour in enumerate(MATERIAL_COLOURS):
        part = slice(1 + m * SHADES, 1 + (m + 1) * SHADES)
        table[part, :3] = rgb(colour)
        table[part, 3] = np.round(255.0 * np.arange(1, SHADES + 1) / SHADES)
    return table


_PALETTE = _palette()
