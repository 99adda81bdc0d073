"""Figures without a display: one style, and PNG files with the same bytes every time."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from .atomic import write_atomically
from .errors import UsageError
from .extras import require
from .palette import INK, MUTED, PAPER, reduced

if TYPE_CHECKING:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

__all__ = ["DPI", "figure", "header", "pixels_of", "png_bytes", "save_png"]

DPI = 128  # a power of two: every whole number of pixels is exact in inches

_STYLE = {
    "font.family": "DejaVu Sans",  # ships with matplotlib, so that text has the same pixels everywhere
    "font.size": 9.0,
    "text.color": INK,
    "axes.labelcolor": MUTED,
    "axes.titlecolor": INK,
    "axes.titlesize": 10.0,
    "axes.titlelocation": "left",
    "axes.titlepad": 5.0,
    "axes.edgecolor": MUTED,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "figure.facecolor": PAPER,
    "savefig.facecolor": PAPER,
}


@contextmanager
def figure(width: float, height: float) -> Iterator[Figure]:
    """Yield an empty figure in lagbench's style, whatever the user's matplotlibrc says.

    Draw and save it inside the context.

    Args:
        width: width [inch].
        height: height [inch].

    Raises:
        UsageError: matplotlib is not installed.
    """
    matplotlib = require("matplotlib", extra="plots")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(_STYLE)
        drawn = Figure(figsize=(width, height), dpi=DPI)
        FigureCanvasAgg(drawn)
        yield drawn


def header(drawn: Figure, title: str, subtitle: str, *, left: float) -> None:
    """Write a title and a second, quieter line at the top left.

    Args:
        drawn: the figure.
        title: first line.
        subtitle: second line.
        left: distance from the left edge [inch].
    """
    width, height = drawn.get_size_inches()
    drawn.text(left / width, 1 - 0.16 / height, title, fontsize=13, fontweight="bold", va="top")
    drawn.text(left / width, 1 - 0.43 / height, subtitle, fontsize=9.5, color=MUTED, va="top")


def pixels_of(drawn: Figure) -> NDArray[np.uint8]:
    """Return the figure as RGB bytes, shape [row, column, 3]."""
    canvas = cast("FigureCanvasAgg", drawn.canvas)
    canvas.draw()  # type: ignore[no-untyped-call]
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()  # type: ignore[no-untyped-call]


def png_bytes(drawn: Figure) -> bytes:
    """Return the figure as PNG without date or software, in lagbench's 256 colours."""
    from PIL import Image

    image = reduced(Image.fromarray(pixels_of(drawn)))
    with io.BytesIO() as buffer:
        image.save(buffer, format="PNG", optimize=True)
        return buffer.getvalue()


def save_png(drawn: Figure, output: str | Path) -> Path:
    """Write the figure to a file that appears whole or not at all; return its path.

    Raises:
        UsageError: the name does not end in .png.
    """
    path = Path(output)
    if path.suffix.lower() != ".png":
        raise UsageError("pictures are PNG files", where="output", expected="a name ending in .png", got=path)
    write_atomically(path, png_bytes(drawn))
    return path
