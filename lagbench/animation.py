"""A scenario as a moving picture: MP4 or GIF, two scenarios side by side where two are given.

Needs ``pip install 'lagbench[plots]'``. Frames are read, painted and encoded one at a time,
so memory does not grow with the length.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .canvas import DPI, figure, pixels_of
from .errors import UsageError, nearest
from .painter import Painter, unpack
from .palette import INK, MUTED
from .panels import Panel, colour_bar, limit_of, material_key
from .plots import describe
from .recording import Recording, open_recording
from .video import SUFFIXES, open_video

if TYPE_CHECKING:
    from .registry import Registry

__all__ = ["KINDS", "animate"]

KINDS = (Panel.SPEED, Panel.MATERIAL, Panel.VORTICITY)
"""What an animation can show."""

SLOWEST, FASTEST = 0.01, 1000.0
"""Frames per second that every player and both formats can hold [1/s]."""

SAMPLES = 12
"""Frames that set the colour scale, spread over the scenario."""

SIDE, GAP, MARGIN, TOP, BOTTOM = 512, 24, 24, 84, 76  # [pixel]; all even, as video coding wants it
BAR = 300  # length of the colour bar [pixel]
DIGIT, LINE = 10, 20  # cell of a digit of the counter [pixel]


def animate(
    source: str | Path,
    output: str | Path,
    *,
    beside: str | Path | None = None,
    kind: Panel | str | None = None,
    frames_per_second: float = 30.0,
    every: int = 1,
    quiet: bool = False,
    registry: Registry | None = None,
) -> Path:
    """Turn a scenario into an MP4 or GIF file; return its path.

    The file appears whole or not at all.

    Args:
        source: scenario file.
        output: file to write, ending in .mp4 or .gif.
        beside: second scenario file, drawn to the right with the same colour scale; frames
            are matched by number and end with the shorter of the two.
        kind: one of :data:`KINDS`; material where there are several, else speed, when None.
        frames_per_second: frames shown per second, 0.01 to 1000; a GIF rounds to hundredths of
            a second.
        every: show every n-th frame.
        quiet: show no progress; without a terminal on stderr none is shown anyway.
        registry: where splits are described; ours when None.

    Raises:
        UsageError: unknown kind or ending, a rate out of bounds, a step that is not positive,
            no matplotlib.
        DataError: a scenario file is missing or damaged.
        WorkFailedError: the video cannot be encoded or written.
    """
    path = Path(output)
    _check(path, kind, frames_per_second, every)
    with ExitStack() as stack:
        sources = [source] if beside is None else [source, beside]
        recordings = [stack.enter_context(open_recording(item, registry=registry)) for item in sources]
        film = _Film(recordings, _kind(kind, recordings))
        numbers = range(0, min(recording.frames for recording in recordings), every)
        write = stack.enter_context(open_video(path, film.size, frames_per_second))
        for frame in _counted(numbers, path, quiet=quiet):
            write(film.frame(frame))
    return path


def _check(path: Path, kind: Panel | str | None, rate: float, every: int) -> None:
    if path.suffix.lower() not in SUFFIXES:
        raise UsageError(
            "no such kind of video",
            where="output",
            expected=f"a name ending in {' or '.join(SUFFIXES)}",
            got=path,
        )
    if kind is not None and kind not in KINDS:
        raise UsageError(
            f"an animation cannot show {kind!r}", where="--kind", fix=nearest(str(kind), map(str, KINDS))
        )
    if not SLOWEST <= rate <= FASTEST or every < 1:  # nan lies in no interval
        raise UsageError(
            "an animation needs a positive rate and step",
            where="--fps, --every",
            expected=f"{SLOWEST:g} to {FASTEST:g} frames/s, every 1 or more",
            got=f"{rate} frames/s, every {every}",
        )


def _kind(kind: Panel | str | None, recordings: Sequence[Recording]) -> Panel:
    if kind is not None:
        return Panel(kind)
    mixed = any(np.unique(recording.material).size > 1 for recording in recordings)
    return Panel.MATERIAL if mixed else Panel.SPEED


def _counted(numbers: range, path: Path, *, quiet: bool) -> Iterator[int]:
    """Yield frame numbers; show how far the work is where somebody can see it."""
    if quiet or not sys.stderr.isatty():
        yield from numbers
        return
    from rich.console import Console
    from rich.progress import track

    yield from track(numbers, description=path.name, console=Console(stderr=True), transient=True)


class _Film:
    """Composes the frames: a still background, one painted panel per recording, a counter."""

    def __init__(self, recordings: Sequence[Recording], panel: Panel) -> None:
        limit = max(_limit(recording, panel) for recording in recordings)
        self._recordings = recordings
        self._painters = [Painter(recording, panel, side=SIDE, limit=limit) for recording in recordings]
        self._lefts = [MARGIN + column * (SIDE + GAP) for column in range(len(recordings))]
        width = self._lefts[-1] + SIDE + MARGIN
        self.size = (width, TOP + SIDE + BOTTOM)
        self._still = _background(recordings, panel, limit, self.size)
        self._counter = _Counter.of(recordings[0], right=width - MARGIN)

    def frame(self, number: int) -> NDArray[np.uint8]:
        """Return one frame as RGB bytes, shape [row, column, 3]."""
        image = self._still.copy()
        for recording, painter, left in zip(self._recordings, self._painters, self._lefts, strict=True):
            image[TOP : TOP + SIDE, left : left + SIDE] = unpack(painter.paint(recording.scene(number)))
        self._counter.draw(image, number)
        return image


def _limit(recording: Recording, panel: Panel) -> float:
    """Return a top of the colour scale that suits the whole recording."""
    if panel is Panel.MATERIAL:
        return 1.0
    numbers = np.linspace(0, recording.frames - 1, SAMPLES).astype(int)
    return max(limit_of(panel, recording.scene(int(number))) for number in np.unique(numbers))


def _background(
    recordings: Sequence[Recording], panel: Panel, limit: float, size: tuple[int, int]
) -> NDArray[np.uint8]:
    """Return all that does not move: titles, names of the scenarios, colour bar or key."""
    width, height = size
    with figure(width / DPI, height / DPI) as drawn:
        titles = dict.fromkeys(recording.title for recording in recordings)
        drawn.text(
            MARGIN / width, 1 - 14 / height, " | ".join(titles), fontsize=12, fontweight="bold", va="top"
        )
        for column, recording in enumerate(recordings):
            left = (MARGIN + column * (SIDE + GAP)) / width
            drawn.text(left, 1 - (TOP - 12) / height, describe(recording), fontsize=9, color=MUTED)
        below = drawn.add_axes((MARGIN / width, (BOTTOM - 24) / height, BAR / width, 10 / height))
        if panel is Panel.MATERIAL:
            material_key(below, np.concatenate([recording.material for recording in recordings]))
        else:
            colour_bar(below, panel, limit)
        return pixels_of(drawn)


@dataclass(frozen=True)
class _Counter:
    """Frame number and time at the bottom right, put together from digits drawn once.

    Attributes:
        digits: picture of each character, all of one size.
        right: right end [pixel].
        interval: time between frames [s].
        places: characters of the longest frame number and of the longest time.
    """

    digits: dict[str, NDArray[np.uint8]]
    right: int
    interval: float
    places: tuple[int, int]

    @staticmethod
    def of(recording: Recording, *, right: int) -> _Counter:
        """Return the counter of a recording."""
        last = recording.frames - 1
        interval = recording.size.frame_interval
        letters = {letter: _letter(letter) for letter in "0123456789.frames t="}
        return _Counter(letters, right, interval, (len(str(last)), len(f"{last * interval:.2f}")))

    def draw(self, image: NDArray[np.uint8], number: int) -> None:
        """Write the frame number and its time into an image."""
        text = f"frame {number:>{self.places[0]}}  {number * self.interval:>{self.places[1]}.2f} s"
        left = self.right - DIGIT * len(text)
        top = TOP + SIDE + 12
        for letter in text:
            image[top : top + LINE, left : left + DIGIT] = self.digits[letter]
            left += DIGIT


def _letter(letter: str) -> NDArray[np.uint8]:
    """Return the picture of one character in a cell of its own, shape [LINE, DIGIT, 3]."""
    with figure(DIGIT / DPI, LINE / DPI) as drawn:
        drawn.text(0.5, 0.25, letter, fontsize=8.5, family="DejaVu Sans Mono", ha="center", color=INK)
        return pixels_of(drawn)
