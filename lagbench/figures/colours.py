"""The colours of all drawings.

Materials take hues of Okabe & Ito (2008), which stay apart under every common colour
vision deficiency and in grey. This module needs no plotting library.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

INK = "#1c2330"  # titles and labels
MUTED = "#667085"  # second lines and tick labels
PAPER = "#ffffff"  # background
WALL = "#d5d9e0"  # walls at rest
MOVING = "#d55e00"  # moving walls: vermilion, which jelly has too; no split has both

# liquid, jelly, snow, rope: blue, vermilion, sky blue, orange
MATERIAL_COLOURS = ("#0072b2", "#d55e00", "#56b4e9", "#e69f00", "#8a8a8a")

SERIES = ("#0072b2", "#d55e00", "#009e73", "#c2659a", "#d18f00", "#3f9fd8")
"""Series of a chart."""


def parse_rgb(colour: str) -> NDArray[np.uint8]:
    """Return a ``#rrggbb`` colour as three bytes.

    >>> parse_rgb("#ff8000")
    array([255, 128,   0], dtype=uint8)
    """
    return np.frombuffer(bytes.fromhex(colour.removeprefix("#")), np.uint8)
