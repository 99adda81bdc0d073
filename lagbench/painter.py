"""Frames of an animation, drawn straight into pixels: milliseconds where a figure takes longer.

A panel is painted at twice its size and averaged down, which smooths the rims of the dots.
Pixels are packed into one integer, ``red + green 2^8 + blue 2^16``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .canvas import DPI, figure, pixels_of
from .palette import MATERIAL_COLOURS, rgb, speed_map, vorticity_map
from .panels import DOT, Panel, box_of, draw_walls
from .recording import Recording, Scene

if TYPE_CHECKING:
    from matplotlib.colors import ListedColormap

__all__ = ["Packed", "Painter", "halve", "pack", "unpack"]

Packed = NDArray[np.uint32]

OVERSAMPLING = 2
_EVEN = np.uint32(0xFEFEFE)


def pack(pixels: NDArray[np.uint8]) -> Packed:
    """Return RGB bytes, shape [..., 3], as packed pixels.

    >>> hex(pack(np.array([[0x11, 0x22, 0x33]], np.uint8))[0])
    '0x332211'
    """
    red, green, blue = np.moveaxis(pixels.astype(np.uint32), -1, 0)
    packed: Packed = red | green << np.uint32(8) | blue << np.uint32(16)
    return packed


def unpack(packed: Packed) -> NDArray[np.uint8]:
    """Return packed pixels as RGB bytes, shape [..., 3]."""
    return np.ascontiguousarray(packed.astype("<u4")).view(np.uint8).reshape(*packed.shape, 4)[..., :3]


def halve(packed: Packed) -> Packed:
    """Return an image of half the size: each pixel the mean of four, rounded down twice."""
    rows = _mean(packed[0::2], packed[1::2])
    return _mean(rows[:, 0::2], rows[:, 1::2])


def _mean(a: Packed, b: Packed) -> Packed:
    """Return the mean of packed pixels: the shared bits and half of the others, colour by colour."""
    return (a & b) + (((a ^ b) & _EVEN) >> np.uint32(1))


@dataclass(frozen=True)
class _Disc:
    """Offsets of the pixels of a dot from its middle, as rows and columns."""

    rows: NDArray[np.intp]
    columns: NDArray[np.intp]

    @staticmethod
    def of(diameter: float) -> _Disc:
        """Return a disc of a diameter in pixels, one pixel at least."""
        reach = int(np.ceil(diameter / 2))
        grid = np.mgrid[-reach : reach + 1, -reach : reach + 1]
        inside = (grid**2).sum(axis=0) <= max(diameter / 2, 0.5) ** 2
        return _Disc(grid[0][inside], grid[1][inside])


class Painter:
    """Paints one recording, frame by frame.

    Args:
        recording: scenario to paint.
        panel: speed, material or vorticity.
        side: side of the square panel [pixel].
        limit: top of the colour scale.
    """

    def __init__(self, recording: Recording, panel: Panel, *, side: int, limit: float) -> None:
        """Paint what does not move."""
        self.panel = panel
        self.limit = limit
        self._side = side * OVERSAMPLING
        self._disc = _Disc.of(DOT * recording.spacing * self._side)
        self._margin = int(self._disc.rows.max(initial=0)) + 1
        with figure(self._side / DPI, self._side / DPI) as drawn:
            draw_walls(drawn.add_axes((0, 0, 1, 1)), recording)
            self._walls = pack(pixels_of(drawn))
        self._materials = pack(np.array([rgb(colour) for colour in MATERIAL_COLOURS]))[recording.material]
        self._colours = _table(vorticity_map() if panel is Panel.VORTICITY else speed_map())
        self._inside = _inside(recording, self._side)

    def paint(self, scene: Scene) -> Packed:
        """Return the panel of one frame, shape [row, column], first row at the top."""
        if self.panel is Panel.VORTICITY:
            return halve(self._field(scene))
        return halve(self._dots(scene))

    def _dots(self, scene: Scene) -> Packed:
        """Draw a dot for every particle, cut off at the walls; later particles lie on earlier ones."""
        margin = self._margin
        image = np.pad(self._walls, margin)
        shown = ((scene.position >= 0.0) & (scene.position <= 1.0)).all(axis=-1)
        x, y = scene.position[shown].T
        column = np.minimum((x * self._side).astype(np.intp), self._side - 1) + margin
        row = np.minimum(((1.0 - y) * self._side).astype(np.intp), self._side - 1) + margin
        width = image.shape[1]
        stamp = self._disc.rows * width + self._disc.columns
        colours = self._materials if self.panel is Panel.MATERIAL else self._by_speed(scene)
        places = (row * width + column)[:, None] + stamp
        image.reshape(-1)[places] = colours[shown][:, None]
        return np.where(self._inside, image[margin:-margin, margin:-margin], self._walls)

    def _by_speed(self, scene: Scene) -> Packed:
        return self._colours[_level(scene.speed / self.limit, len(self._colours))]

    def _field(self, scene: Scene) -> Packed:
        """Draw a square around every node that has a vorticity; paper elsewhere."""
        fields = scene.fields
        middle = (np.arange(self._side) + 0.5) / self._side
        index = np.floor(middle * fields.grid.cells - fields.grid.origin + 0.5).astype(np.intp)
        index = np.clip(index, 0, fields.grid.nodes - 1)
        omega = fields.vorticity.T[::-1][np.ix_(fields.grid.nodes - 1 - index[::-1], index)]
        defined = np.isfinite(omega) & self._inside
        level = _level(0.5 + 0.5 * np.where(defined, omega, 0.0) / self.limit, len(self._colours))
        return np.where(defined, self._colours[level], self._walls)


def _level(share: NDArray[np.float64], levels: int) -> NDArray[np.intp]:
    """Return the entry of a table of so many colours for shares of its scale."""
    return np.clip(share * levels, 0, levels - 1).astype(np.intp)


def _table(colours: ListedColormap) -> Packed:
    return pack((np.asarray(colours.colors)[:, :3] * 255.0).round().astype(np.uint8))


def _inside(recording: Recording, side: int) -> NDArray[np.bool_]:
    """Return the pixels within the walls, shape [row, column]."""
    left, right, bottom, top = box_of(recording)
    middle = (np.arange(side) + 0.5) / side
    columns = (middle >= left) & (middle <= right)
    rows = (1.0 - middle >= bottom) & (1.0 - middle <= top)
    inside: NDArray[np.bool_] = rows[:, None] & columns
    return inside
