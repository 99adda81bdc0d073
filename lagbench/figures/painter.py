"""The painter of films: one frame of a scenario, straight into pixels.

That takes milliseconds where a figure takes longer. A panel is painted at twice its
size and averaged down, which smooths the rims of the dots. Pixels are packed into one
integer each, ``red + green 2^8 + blue 2^16``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .canvas import (
    DPI,
    build_speed_map,
    build_vorticity_map,
    figure,
    pixels_of,
)
from .colours import MATERIAL_COLOURS, parse_rgb
from .panels import Panel, box_of, draw_walls
from .particles import DOT_DIAMETER, paint_particles
from .recording import Recording, Scene

Packed = NDArray[np.uint32]

OVERSAMPLING = 2
UNIT_SQUARE = ((0.0, 1.0), (0.0, 1.0))

_LOW_BITS_OFF = np.uint32(0xFEFEFE)


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
    little_endian = np.ascontiguousarray(packed.astype("<u4"))
    return little_endian.view(np.uint8).reshape(*packed.shape, 4)[..., :3]


def halve(packed: Packed) -> Packed:
    """Return an image of half the size; each pixel is the mean of four.

    The mean is rounded down twice.
    """
    rows = _average(packed[0::2], packed[1::2])
    return _average(rows[:, 0::2], rows[:, 1::2])


def _average(a: Packed, b: Packed) -> Packed:
    """Return the mean of packed pixels, colour by colour."""
    shared_bits = a & b
    half_of_others = ((a ^ b) & _LOW_BITS_OFF) >> np.uint32(1)
    return shared_bits + half_of_others


class Painter:
    """Paints one recording, frame by frame."""

    def __init__(
        self, recording: Recording, panel: Panel, *, side: int, limit: float
    ) -> None:
        """Prepare all that does not move.

        Args:
            recording: the scenario.
            panel: speed, material or vorticity.
            side: side of the panel [pixel].
            limit: top of the colour scale.
        """
        self.panel = panel
        self.limit = limit
        self._side = side * OVERSAMPLING
        self._diameter = DOT_DIAMETER * recording.spacing * self._side  # [pixel]
        self._walls_by_direction: dict[bytes, Packed] = {}

        palette = pack(np.array([parse_rgb(colour) for colour in MATERIAL_COLOURS]))
        self._material_pixels = palette[recording.material]
        if panel is Panel.VORTICITY:
            colours = np.asarray(build_vorticity_map().colors)
        else:
            colours = np.asarray(build_speed_map().colors)
        self._scale = pack((colours[:, :3] * 255.0).round().astype(np.uint8))

        # middles of the pixels along one side, and those within the walls
        left, right, bottom, top = box_of(recording)
        self._middle = (np.arange(self._side) + 0.5) / self._side
        height = 1.0 - self._middle
        is_row_inside = (height >= bottom) & (height <= top)
        is_column_inside = (self._middle >= left) & (self._middle <= right)
        self._is_inside: NDArray[np.bool_] = is_row_inside[:, None] & is_column_inside

    def paint(self, scene: Scene) -> Packed:
        """Return the panel of one frame, shape [row, column], first row at the top."""
        walls = self._paint_walls(scene)
        if self.panel is Panel.VORTICITY:
            image = self._paint_vorticity(scene, walls)
        else:
            image = self._paint_particles(scene, walls)
        return halve(np.where(self._is_inside, image, walls))

    def _paint_vorticity(self, scene: Scene, walls: Packed) -> Packed:
        """Return a square around every node that has a vorticity, walls elsewhere."""
        grid = scene.fields.grid
        node = self._middle * grid.cells - grid.origin + 0.5
        index = np.clip(np.floor(node).astype(np.intp), 0, grid.nodes - 1)
        # rows from the top, as pixels have them
        rows = scene.vorticity.T[::-1]
        vorticity = rows[np.ix_(grid.nodes - 1 - index[::-1], index)]
        is_defined = np.isfinite(vorticity)
        share = 0.5 + 0.5 * np.where(is_defined, vorticity, 0.0) / self.limit
        return np.where(is_defined, self._look_up(share), walls)

    def _paint_particles(self, scene: Scene, walls: Packed) -> Packed:
        """Return a dot for every particle before the walls."""
        if self.panel is Panel.SPEED:
            colours = self._look_up(scene.speed / self.limit)
        else:
            colours = self._material_pixels
        return paint_particles(
            walls, scene.position, colours, view=UNIT_SQUARE, diameter=self._diameter
        )

    def _paint_walls(self, scene: Scene) -> Packed:
        """Return the empty box; it changes only where a wall turns."""
        wall_velocity = scene.recording.wall_velocity[scene.frame]
        directions = np.sign(wall_velocity).tobytes()
        if directions not in self._walls_by_direction:
            with figure(self._side / DPI, self._side / DPI) as drawn:
                axes = drawn.add_axes((0, 0, 1, 1))
                draw_walls(axes, scene.recording, scene.frame)
                self._walls_by_direction[directions] = pack(pixels_of(drawn))
        return self._walls_by_direction[directions]

    def _look_up(self, share: NDArray[np.float64]) -> Packed:
        """Return the colours of values, which are shares of the colour scale."""
        levels = len(self._scale)
        level = np.clip(share * levels, 0, levels - 1).astype(np.intp)
        return self._scale[level]
