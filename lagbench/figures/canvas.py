"""Figures of matplotlib without a display: one style, files with equal bytes.

Speed and vorticity take maps of matplotlib that stay apart under every common colour
vision deficiency.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from lagbench.atomic import write_atomically
from lagbench.errors import UsageError, require

from .colours import INK, MUTED, PAPER

if TYPE_CHECKING:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.colors import ListedColormap
    from matplotlib.figure import Figure
    from matplotlib.text import Text

ENDINGS = (".png", ".pdf", ".svg")  # endings of files that pictures can be

DPI = 128  # a power of two: every whole number of pixels is exact in inches
COARSEST = 32
FINEST = 1200  # pixels per inch that a picture may have

_STYLE = {
    # ships with matplotlib, so that text has the same pixels everywhere
    "font.family": "DejaVu Sans",
    "font.size": 9.0,
    "text.color": INK,
    "axes.labelcolor": MUTED,
    "axes.edgecolor": MUTED,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "axes.titlecolor": INK,
    "axes.titlesize": 10.0,
    "axes.titlelocation": "left",
    "axes.titlepad": 5.0,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "figure.facecolor": PAPER,
    "savefig.facecolor": PAPER,
    # identifiers in SVG files follow from the salt
    "svg.hashsalt": "lagbench",
}

NO_METADATA = {
    ".png": ("Software",),
    ".svg": ("Date", "Creator"),
    ".pdf": ("CreationDate", "Producer", "Creator"),
}
"""Dates and versions that would make equal pictures differ."""


def build_speed_map() -> ListedColormap:
    """Return the colour map of speeds: dark when slow, and never as light as paper."""
    return _cut_map("plasma", low=0.0, high=0.9, levels=80)


def build_vorticity_map() -> ListedColormap:
    """Return the diverging colour map of vorticities.

    Blue is clockwise, red counter-clockwise, white no vorticity.
    """
    # the middle of an odd number of levels is no vorticity
    return _cut_map("RdBu_r", low=0.04, high=0.96, levels=81)


def _cut_map(name: str, *, low: float, high: float, levels: int) -> ListedColormap:
    """Return a stretch of a map of matplotlib in so many colours."""
    matplotlib = require("matplotlib", extra="plots")
    colors = require("matplotlib.colors", extra="plots")
    whole_map = matplotlib.colormaps[name]
    shares = np.linspace(low, high, levels)
    cut: ListedColormap = colors.ListedColormap(whole_map(shares))
    return cut


@contextmanager
def figure(width: float, height: float, *, dpi: float = DPI) -> Iterator[Figure]:
    """Yield an empty figure in lagbench's style; draw and save it inside the context.

    The user's matplotlibrc has no influence. Width and height are in inches.

    Raises:
        UsageError: the pixels per inch are out of range, or matplotlib is missing.
    """
    if not COARSEST <= dpi <= FINEST:
        raise UsageError(
            f"no picture has {dpi} pixels per inch; give {COARSEST} to {FINEST}"
        )
    matplotlib = require("matplotlib", extra="plots")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(_STYLE)
        drawn = Figure(figsize=(width, height), dpi=dpi)
        FigureCanvasAgg(drawn)
        yield drawn


def draw_header(drawn: Figure, title: str, subtitle: str, *, left: float) -> None:
    """Write a title and a quieter second line at the top left [inch]."""
    width, height = drawn.get_size_inches()
    x = left / width
    y = 1 - 0.16 / height
    first = drawn.text(x, y, title, fontsize=13, fontweight="bold", va="top")
    below = 1 - 0.43 / height
    second = drawn.text(x, below, subtitle, fontsize=9.5, color=MUTED, va="top")
    for text in (first, second):
        shrink(text, width - 2 * left)


def shrink(text: Text, width: float) -> None:
    """Make the letters of a text smaller where it is wider than a width [inch]."""
    drawn = text.get_figure()
    assert drawn is not None  # the text stands in a figure
    length = text.get_window_extent().width / drawn.dpi
    if length > width:
        text.set_fontsize(float(text.get_fontsize()) * width / length)


def pixels_of(drawn: Figure) -> NDArray[np.uint8]:
    """Return the figure as RGB bytes, shape [row, column, 3]."""
    canvas = cast("FigureCanvasAgg", drawn.canvas)
    canvas.draw()  # type: ignore[no-untyped-call]
    rgba = np.asarray(canvas.buffer_rgba())  # type: ignore[no-untyped-call]
    return rgba[..., :3].copy()


def encode(drawn: Figure, ending: str = ".png") -> bytes:
    """Return the figure as a PNG, SVG or PDF file without date or software."""
    matplotlib = require("matplotlib", extra="plots")
    metadata = dict.fromkeys(NO_METADATA[ending])
    with matplotlib.rc_context(), io.BytesIO() as buffer:
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(_STYLE)
        drawn.savefig(buffer, format=ending[1:], metadata=metadata)
        return buffer.getvalue()


def check_picture_name(output: str | Path, *, option: str = "--output") -> Path:
    """Return the path of a picture.

    Raises:
        UsageError: the name ends in none of :data:`ENDINGS`.
    """
    path = Path(output)
    if path.suffix.lower() not in ENDINGS:
        raise UsageError(
            f"{option}: pictures are PNG, PDF or SVG files, not {path.name}; "
            f"name it {path.stem or 'picture'}.png"
        )
    return path


def save(drawn: Figure, output: str | Path, *, option: str = "--output") -> Path:
    """Write the figure to a file, with equal bytes every time; return its path.

    The file appears whole or not at all.

    Args:
        drawn: the figure.
        output: path of the file.
        option: name of the option for the path, used in error messages.

    Raises:
        UsageError: the name ends in none of :data:`ENDINGS`.
        WorkFailedError: the file cannot be written.
    """
    path = check_picture_name(output, option=option)
    write_atomically(path, encode(drawn, path.suffix.lower()), option=option)
    return path
