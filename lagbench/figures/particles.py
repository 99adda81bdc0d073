"""The painter of particles: a disc for every particle, straight into pixels.

Films and reports use it. Figures of matplotlib draw markers instead, which stay vectors
in PDF and SVG files.
"""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

# diameter of a drawn particle in particle spacings: neighbours overlap a little
DOT_DIAMETER = 1.25
# the same of a cube: smaller dots leave what is behind them visible
DOT_DIAMETER_SOLID = 0.75

Pixel = TypeVar("Pixel", bound=np.generic)

Interval = tuple[float, float]


def paint_particles(
    background: NDArray[Pixel],
    position: NDArray[np.floating],
    values: NDArray[Any],
    *,
    view: tuple[Interval, Interval],
    diameter: float,
) -> NDArray[Pixel]:
    """Return a copy of an image with a disc of its value for every particle.

    Later particles lie on earlier ones. Particles outside the view are left out, and
    discs end at the rim of the image.

    Args:
        background: the image to paint on, shape [row, column], first row at the top.
        position: positions of the particles [length], shape [particle, 2].
        values: pixel value of each particle, shape [particle].
        view: interval of x and of y that the image shows [length].
        diameter: diameter of a disc [pixel].
    """
    (left, right), (bottom, top) = view
    height, width = background.shape

    x, y = position.T
    is_column_inside = (x >= left) & (x <= right)
    is_row_inside = (y >= bottom) & (y <= top)
    is_inside = is_column_inside & is_row_inside
    x = x[is_inside]
    y = y[is_inside]
    across = (x - left) / (right - left) * width
    down = (top - y) / (top - bottom) * height
    column = np.minimum(across.astype(np.intp), width - 1)
    row = np.minimum(down.astype(np.intp), height - 1)

    # the margin holds what discs at the rim have beyond it
    disc_row, disc_column = disc_offsets(diameter)
    margin = int(disc_row.max(initial=0)) + 1
    image = np.pad(background, margin)
    padded_width = image.shape[1]

    # one flat index per pixel of a disc, shape [particle, pixel]
    middle = (row + margin) * padded_width + column + margin
    stamp = disc_row * padded_width + disc_column
    index = middle[:, None] + stamp
    pixels = image.reshape(-1)
    pixels[index] = values[is_inside][:, None]
    return image[margin:-margin, margin:-margin]


def disc_offsets(diameter: float) -> NDArray[np.intp]:
    """Return row and column of a disc's pixels from its middle, shape [2, pixel].

    A disc has one pixel at least.
    """
    reach = int(np.ceil(diameter / 2))
    offsets = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    radius = max(diameter / 2, 0.5)
    is_in_disc = (offsets**2).sum(axis=0) <= radius**2
    disc: NDArray[np.intp] = offsets[:, is_in_disc]
    return disc
