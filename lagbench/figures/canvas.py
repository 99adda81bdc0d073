"""Figures of matplotlib without a display: one style, PNG files with equal bytes.

Speed and vorticity take maps of matplotlib that stay apart under every common colour
vision deficiency. All colours, with the blends that smooth edges, fit the 256 colours
of a palette: PNG and GIF files use it, stay small, and show each colour as drawn.
Pictures of three dimensions, where far particles are pale, have a palette of their own.
"""

from __future__ import annotations

import functools
import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from lagbench.atomic import write_atomically
from lagbench.errors import UsageError, require

from .colours import (
    INK,
    MATERIAL_RGB,
    MOVING,
    MUTED,
    PAPER,
    PAPER_RGB,
    WALL,
    parse_rgb,
)

if TYPE_CHECKING:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.colors import ListedColormap
    from matplotlib.figure import Figure
    from matplotlib.text import Text
    from PIL.Image import Image

ENDINGS = (".png", ".pdf", ".svg")  # endings of files that pictures can be

DPI = 128  # a power of two: every whole number of pixels is exact in inches
COARSEST = 32
FINEST = 1200  # pixels per inch that a picture may have

PALETTE_SIZE = 256

# flat colours, each with the number of blends with paper that smooth its edges
BLENDS = (
    (parse_rgb(INK), 8),
    (parse_rgb(MUTED), 6),
    (parse_rgb(MOVING), 4),
    (parse_rgb(WALL), 3),
    *((colour, 4) for colour in MATERIAL_RGB),
)

FADES = (0.85, 0.7, 0.55, 0.4)
"""Shares of their own colour that far particles keep; paper is the rest."""

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
}


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


@functools.cache
def build_palette() -> NDArray[np.uint8]:
    """Return the 256 colours of every file, paper first, shape [256, 3]."""
    paper = PAPER_RGB.astype(float)
    speeds = _exact_colours(build_speed_map())
    vorticities = _exact_colours(build_vorticity_map())
    tables = [paper[None], speeds, vorticities]

    # edges of dots by speed are smoothed too; fewer levels do there
    every_third = speeds[::3]
    tables.append(_blend(every_third, paper, share=0.62))
    every_fifth = speeds[::5]
    tables.append(_blend(every_fifth, paper, share=0.3))

    for colour, blend_count in BLENDS:
        pure = colour.astype(float)
        for number in range(1, blend_count + 1):
            share = number / blend_count
            blended = _blend(pure[None], paper, share=share)
            tables.append(blended)
    return _fill_up(tables)


def _fill_up(tables: Sequence[NDArray[np.float64]]) -> NDArray[np.uint8]:
    """Return 256 colours: those of the tables, then paper, the first of them."""
    exact = np.concatenate(tables)
    palette = exact.round().astype(np.uint8)
    missing = PALETTE_SIZE - len(palette)
    filling = np.repeat(palette[:1], missing, axis=0)
    return np.concatenate([palette, filling])


@functools.cache
def build_solid_palette() -> NDArray[np.uint8]:
    """Return the 256 colours of pictures of three dimensions, shape [256, 3].

    Particles by speed are paler the farther they are. No vorticity has a sign there.
    """
    paper = PAPER_RGB.astype(float)
    speeds = _exact_colours(build_speed_map())
    tables = [paper[None], speeds]
    for share in FADES:
        faded = _blend(speeds[::2], paper, share=share)
        tables.append(faded)
    for colour, blend_count in BLENDS[:2]:
        pure = colour.astype(float)
        for number in range(1, blend_count + 1):
            share = number / blend_count
            blended = _blend(pure[None], paper, share=share)
            tables.append(blended)
    return _fill_up(tables)


def colour_bytes(colour_map: ListedColormap) -> NDArray[np.uint8]:
    """Return the colours of a map as RGB bytes, shape [level, 3]."""
    exact = _exact_colours(colour_map)
    return exact.round().astype(np.uint8)


def _exact_colours(colour_map: ListedColormap) -> NDArray[np.float64]:
    """Return the colours of a map from 0 to 255, shape [level, 3]."""
    rgba = np.asarray(colour_map.colors)
    return rgba[:, :3] * 255.0


def _blend(
    colours: NDArray[np.float64], paper: NDArray[np.float64], *, share: float
) -> NDArray[np.float64]:
    return share * colours + (1.0 - share) * paper


def choose_palette(image: Image) -> NDArray[np.uint8]:
    """Return that of both palettes which comes nearer to an RGB image, [256, 3]."""
    exact = np.asarray(image, np.float64)
    palettes = (build_palette(), build_solid_palette())
    errors = []
    for palette in palettes:
        reduced_image = reduce_colours(image, palette)
        reduced = np.asarray(reduced_image.convert("RGB"), np.float64)
        difference = reduced - exact
        squared_error = np.sum(difference**2)
        errors.append(float(squared_error))
    best = int(np.argmin(errors))
    return palettes[best]


def reduce_colours(image: Image, palette: NDArray[np.uint8]) -> Image:
    """Return an RGB image with the nearest colour of a palette in each pixel."""
    images = require("PIL.Image", extra="plots")
    holder = images.new("P", (1, 1))
    holder.putpalette(palette.tobytes())
    return image.quantize(palette=holder, dither=images.Dither.NONE)


@contextmanager
def figure(width: float, height: float, *, dpi: float = DPI) -> Iterator[Figure]:
    """Yield an empty figure in lagbench's style; save it inside the context.

    The user's matplotlibrc has no influence. Width and height are in inches.

    Raises:
        UsageError: the pixels per inch are out of range, or matplotlib is missing.
    """
    is_number = isinstance(dpi, int | float | np.number)
    if not (is_number and COARSEST <= dpi <= FINEST):
        raise UsageError(
            "no such number of pixels per inch",
            where="--dpi",
            expected=f"{COARSEST} to {FINEST}",
            got=dpi,
            fix="leave it out, or give a number in this range",
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


def png_bytes(drawn: Figure) -> bytes:
    """Return the figure as a PNG file in 256 colours, without date or software."""
    images = require("PIL.Image", extra="plots")
    exact = images.fromarray(pixels_of(drawn))
    image = reduce_colours(exact, choose_palette(exact))
    with io.BytesIO() as buffer:
        image.save(buffer, format="PNG", optimize=True)
        return buffer.getvalue()


def renamed(path: Path, ending: str) -> str:
    """Return a name like that of a file, with another ending.

    >>> renamed(Path("out/a.txt"), ".png"), renamed(Path(".."), ".png")
    ('a.png', 'picture.png')
    """
    stem = path.stem.rstrip(".") or "picture"
    return f"{stem}{ending}"


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
    path = Path(output)
    ending = path.suffix.lower()
    if ending not in ENDINGS:
        raise UsageError(
            "pictures are PNG, PDF or SVG files",
            where=option,
            expected=f"a name ending in {', '.join(ENDINGS)}",
            got=path,
            fix=f"name it {renamed(path, ENDINGS[0])}",
        )
    if ending == ".png":
        data = png_bytes(drawn)
    else:
        data = _vector_bytes(drawn, ending)
    write_atomically(path, data, option=option)
    return path


def _vector_bytes(drawn: Figure, ending: str) -> bytes:
    """Return the figure as a PDF or SVG file without date or software."""
    matplotlib = require("matplotlib", extra="plots")
    if ending == ".svg":
        fields = ["Date", "Creator"]
    else:
        fields = ["CreationDate", "Producer", "Creator"]
    no_metadata = dict.fromkeys(fields)
    # identifiers in SVG files follow from the salt
    with matplotlib.rc_context({"svg.hashsalt": "lagbench"}), io.BytesIO() as buffer:
        drawn.savefig(buffer, format=ending[1:], metadata=no_metadata)
        return buffer.getvalue()
