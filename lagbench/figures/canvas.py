"""Figures without a display: one style, one set of colours, PNG files with the same
bytes every time.

Materials take hues of Okabe & Ito (2008), which stay apart under every common colour
vision deficiency and in grey. Speed and vorticity take matplotlib maps that do as well.
All of them, with the blends that smooth edges, fit the 256 colours of one palette: PNG
and GIF files use it, stay small, and show each colour as drawn.
"""

from __future__ import annotations

import functools
import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from lagbench.atomic import write_atomically
from lagbench.errors import UsageError, require

if TYPE_CHECKING:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.colors import ListedColormap
    from matplotlib.figure import Figure
    from PIL.Image import Image

INK = "#1c2330"  # titles and labels
MUTED = "#667085"  # second lines and tick labels
PAPER = "#ffffff"  # background
WALL = "#d5d9e0"  # walls at rest
MOVING = "#d55e00"  # moving walls: vermilion, which jelly has too; no split has both

# liquid, jelly, snow, rope: blue, vermilion, sky blue, orange
MATERIAL_COLOURS = ("#0072b2", "#d55e00", "#56b4e9", "#e69f00")


def speed_map() -> ListedColormap:
    """Return the map of speeds: dark when slow, never so light that paper swallows
    it.
    """
    return _cut("plasma", 0.0, 0.9, 80)


def vorticity_map() -> ListedColormap:
    """Return the diverging map of vorticities: blue clockwise, red counter-clockwise,
    white none.
    """
    return _cut("RdBu_r", 0.04, 0.96, 81)  # the middle of an odd number is no vorticity


def rgb(colour: str) -> NDArray[np.uint8]:
    """Return a ``#rrggbb`` colour as three bytes.

    >>> rgb("#ff8000")
    array([255, 128,   0], dtype=uint8)
    """
    return np.frombuffer(bytes.fromhex(colour.removeprefix("#")), np.uint8)


@functools.cache
def colours() -> NDArray[np.uint8]:
    """Return the 256 colours of every file, paper first, shape [256, 3]."""
    paper = rgb(PAPER).astype(float)
    speeds = np.asarray(speed_map().colors)[:, :3] * 255.0
    drawn = [paper[None], speeds, np.asarray(vorticity_map().colors)[:, :3] * 255.0]
    # blends with the paper where edges are smoothed
    drawn += [_blend(speeds[::3], paper, 0.62), _blend(speeds[::5], paper, 0.3)]
    for colour, shares in (
        (INK, 8),
        (MUTED, 6),
        (MOVING, 4),
        (WALL, 3),
        *((m, 4) for m in MATERIAL_COLOURS),
    ):
        for share in np.arange(1, shares + 1) / shares:
            drawn.append(_blend(rgb(colour)[None].astype(float), paper, share))
    table = np.concatenate(drawn).round().astype(np.uint8)
    return np.concatenate([table, np.repeat(table[:1], 256 - len(table), axis=0)])


def reduced(image: Image) -> Image:
    """Return an RGB image with the nearest of :func:`colours` in each pixel."""
    images = require("PIL.Image", extra="plots")
    palette = images.new("P", (1, 1))
    palette.putpalette(colours().tobytes())
    return image.quantize(palette=palette, dither=images.Dither.NONE)


def _blend(
    table: NDArray[np.float64], paper: NDArray[np.float64], share: float
) -> NDArray[np.float64]:
    return share * table + (1.0 - share) * paper


def _cut(name: str, low: float, high: float, levels: int) -> ListedColormap:
    """Return a stretch of one of matplotlib's maps in so many colours."""
    matplotlib = require("matplotlib", extra="plots")
    colors = require("matplotlib.colors", extra="plots")
    cut: ListedColormap = colors.ListedColormap(
        matplotlib.colormaps[name](np.linspace(low, high, levels))
    )
    return cut


ENDINGS = (".png", ".pdf", ".svg")  # endings of files that pictures can be

DPI = 128  # a power of two: every whole number of pixels is exact in inches
COARSEST = 32
FINEST = 1200  # pixels per inch that a picture may have

_STYLE = {
    # ships with matplotlib, so that text has the same pixels everywhere
    "font.family": "DejaVu Sans",
    "font.size": 9.0,
    "text.color": INK,
    **dict.fromkeys(
        ("axes.labelcolor", "axes.edgecolor", "xtick.color", "ytick.color"), MUTED
    ),
    "axes.titlecolor": INK,
    "axes.titlesize": 10.0,
    "axes.titlelocation": "left",
    "axes.titlepad": 5.0,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "figure.facecolor": PAPER,
    "savefig.facecolor": PAPER,
}


@contextmanager
def figure(width: float, height: float, *, dpi: int = DPI) -> Iterator[Figure]:
    """Yield an empty figure in lagbench's style, whatever the user's matplotlibrc says;
    save it inside.
    """
    if not (isinstance(dpi, int | float | np.number) and COARSEST <= dpi <= FINEST):
        raise UsageError(
            "no such number of pixels per inch",
            where="--dpi",
            expected=f"{COARSEST} to {FINEST}",
            got=dpi,
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


def header(drawn: Figure, title: str, subtitle: str, *, left: float) -> None:
    """Write a title and a second, quieter line at the top left."""
    width, height = drawn.get_size_inches()
    drawn.text(
        left / width, 1 - 0.16 / height, title, fontsize=13, fontweight="bold", va="top"
    )
    drawn.text(
        left / width, 1 - 0.43 / height, subtitle, fontsize=9.5, color=MUTED, va="top"
    )


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


def save(drawn: Figure, output: str | Path) -> Path:
    """Write the figure to a file, with the same bytes every time and whole or not at
    all; return its path.
    """
    path = Path(output)
    ending = path.suffix.lower()
    if ending not in ENDINGS:
        expected = f"a name ending in {', '.join(ENDINGS)}"
        raise UsageError(
            "pictures are PNG, PDF or SVG files",
            where="output",
            expected=expected,
            got=path,
        )
    if ending == ".png":
        data = png_bytes(drawn)
    else:
        import matplotlib as mpl

        nothing = dict.fromkeys(
            ("Date",) if ending == ".svg" else ("CreationDate", "Producer", "Creator")
        )
        with mpl.rc_context({"svg.hashsalt": "lagbench"}), io.BytesIO() as buffer:
            drawn.savefig(buffer, format=ending[1:], metadata=nothing)
            data = buffer.getvalue()
    write_atomically(path, data, option="--output")
    return path
