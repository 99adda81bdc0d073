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
    colour_bytes,
    figure,
    pixels_of,
)
from .colours import MATERIAL_RGB, PAPER_RGB
from .panels import Panel, box_of, draw_cube, draw_walls, place_of_slice
from .particles import DOT_DIAMETER, DOT_DIAMETER_SOLID, paint_particles
from .recording import Recording, Scene
from .solid import View, shade

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
    channels = little_endian.view(np.uint8).reshape(*packed.shape, 4)
    return channels[..., :3]


def halve(packed: Packed) -> Packed:
    """Return an image of half the size; each pixel is the mean of four.

    The mean is rounded down twice.
    """
    even_rows = packed[0::2]
    odd_rows = packed[1::2]
    rows = _average(even_rows, odd_rows)
    even_columns = rows[:, 0::2]
    odd_columns = rows[:, 1::2]
    return _average(even_columns, odd_columns)


def _average(a: Packed, b: Packed) -> Packed:
    """Return the mean of packed pixels, colour by colour."""
    shared_bits = a & b
    other_bits = (a ^ b) & _LOW_BITS_OFF
    return shared_bits + (other_bits >> np.uint32(1))


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
        self._view = None
        scale = 1.0
        if recording.is_solid and panel is not Panel.VORTICITY:
            self._view = View(recording.size.box)
            scale = self._view.scale
        dot_diameter = DOT_DIAMETER_SOLID if recording.is_solid else DOT_DIAMETER
        spacing = recording.spacing * scale
        self._diameter = dot_diameter * spacing * self._side  # [pixel]
        self._walls_by_direction: dict[bytes, Packed] = {}

        palette = pack(np.array(MATERIAL_RGB))
        self._material_pixels = palette[recording.material]
        self._is_signed = panel is Panel.VORTICITY and not recording.is_solid
        if self._is_signed:
            colour_map = build_vorticity_map()
        else:
            colour_map = build_speed_map()
        self._scale = pack(colour_bytes(colour_map))

        # middles of the pixels along one side, and the pixels within the walls
        number = np.arange(self._side)
        self._middle = (number + 0.5) / self._side
        if self._view is None:
            self._is_inside = _find_inside(recording, self._middle)
        else:
            self._is_inside = np.ones((self._side, self._side), bool)

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
        nearest = []
        for axis, count in enumerate(grid.shape):
            distance = self._middle - grid.start[axis]
            node = distance * grid.cells - grid.origin
            number = np.floor(node + 0.5)
            number = number.astype(np.intp)
            nearest.append(np.clip(number, 0, count - 1))
        column, upward_row = nearest
        last_row = grid.shape[1] - 1
        row = last_row - upward_row[::-1]

        # first row at the top, as pixels have it
        rows = scene.vorticity.T[::-1]
        vorticity = rows[np.ix_(row, column)]
        is_defined = np.isfinite(vorticity)
        finite_vorticity = np.where(is_defined, vorticity, 0.0)
        share = finite_vorticity / self.limit
        if self._is_signed:
            share = 0.5 + 0.5 * share
        colours = self._look_up(share)
        return np.where(is_defined, colours, walls)

    def _paint_particles(self, scene: Scene, walls: Packed) -> Packed:
        """Return a dot for every particle before the walls."""
        if self.panel is Panel.SPEED:
            colours = self._look_up(scene.speed / self.limit)
        else:
            colours = self._material_pixels
        position = scene.position
        if self._view is not None:
            # farther particles are painted first, and paler
            depth = self._view.depth(position)
            order = np.argsort(-depth, kind="stable")
            position = self._view.place(position[order])
            rgb = unpack(colours[order]).astype(np.float64)
            paper = PAPER_RGB.astype(np.float64)
            colours = pack(shade(rgb, depth[order], paper).round().astype(np.uint8))
        return paint_particles(
            walls,
            position,
            colours,
            view=UNIT_SQUARE,
            diameter=self._diameter,
        )

    def _paint_walls(self, scene: Scene) -> Packed:
        """Return the empty box; it changes only where a wall turns."""
        wall_velocity = scene.recording.wall_velocity[scene.frame]
        directions = np.sign(wall_velocity).tobytes()
        walls = self._walls_by_direction.get(directions)
        if walls is None:
            side = self._side / DPI  # [inch]
            with figure(side, side) as drawn:
                axes = drawn.add_axes((0, 0, 1, 1))
                if self._view is not None:
                    draw_cube(axes, scene.recording, scene.frame)
                elif scene.recording.is_solid:
                    cut = place_of_slice(scene)
                    draw_walls(axes, scene.recording, scene.frame, cut=cut)
                else:
                    draw_walls(axes, scene.recording, scene.frame)
                walls = pack(pixels_of(drawn))
            self._walls_by_direction[directions] = walls
        return walls

    def _look_up(self, share: NDArray[np.float64]) -> Packed:
        """Return the colours of values, which are shares of the colour scale."""
        level_count = len(self._scale)
        level = np.clip(share * level_count, 0, level_count - 1)
        return self._scale[level.astype(np.intp)]


def _find_inside(
    recording: Recording, middle: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Return the pixels within the walls, shape [row, column], first row at the top.

    Args:
        recording: its box has the walls.
        middle: middles of the pixels along a side of the panel, from 0 to 1.
    """
    left, right, bottom, top = box_of(recording)
    height = 1.0 - middle
    is_row_inside = (height >= bottom) & (height <= top)
    is_column_inside = (middle >= left) & (middle <= right)
    return is_row_inside[:, None] & is_column_inside
