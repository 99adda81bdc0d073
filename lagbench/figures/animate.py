"""A scenario as a moving picture: MP4 or GIF, one or two scenarios side by side.

Needs ``pip install 'lagbench[plots]'``. Frames are read, painted and encoded one at a
time, so memory does not grow with the length of a film. Files appear whole or not at
all.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

from lagbench.atomic import atomic_path
from lagbench.errors import UsageError, format_count, suggest_name
from lagbench.work.run import watched

from .canvas import DPI, figure, pixels_of, renamed, shrink
from .colours import INK, MUTED
from .encoders import encode_gif, encode_mp4
from .painter import Painter, unpack
from .panels import (
    FEW_NODES,
    Panel,
    colour_bar,
    draw_material_key,
    limit_of,
    median_limit,
    name_slice,
    strongest_limit,
)
from .plot import SEPARATOR, describe
from .recording import Recording, open_recording

if TYPE_CHECKING:
    from lagbench.data.registry import Registry

__all__ = ["KINDS", "SUFFIXES", "animate", "check_ending"]

SUFFIXES = (".mp4", ".gif")  # endings of the files that can be written
KINDS = (Panel.SPEED, Panel.MATERIAL, Panel.VORTICITY)  # what an animation can show

# frames per second that every player and both formats can hold [1/s]
SLOWEST = 0.01
FASTEST = 1000.0

SAMPLES = 12  # frames that set the colour scale, spread over the scenario

# lengths of a frame [pixel]; all even, as video coding wants it
SIDE = 512
GAP = 24
MARGIN = 24
TOP = 84
BOTTOM = 76
BAR = 300  # length of the colour bar
# cell of a letter of the counter
LETTER_WIDTH = 10
LETTER_HEIGHT = 20

LETTERS = "0123456789.frames "  # letters of the counter


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
        beside: second scenario file, drawn to the right with the same colour scale;
            frames are matched by number and end with the shorter of the two.
        kind: one of :data:`KINDS`; material where there are several, else speed, when
            None.
        frames_per_second: frames shown per second, 0.01 to 1000; a GIF rounds to
            hundredths of a second.
        every: show every n-th frame.
        quiet: show no progress; without a terminal on stderr none is shown anyway.
        registry: where splits are described; ours when None.

    Raises:
        UsageError: unknown kind or ending, a rate out of bounds, a step that is not
            positive, no matplotlib.
        DataError: a scenario file is missing or damaged.
        WorkFailedError: the video cannot be encoded or written.
    """
    path = Path(output)
    check_ending(path)
    _check_kind(kind)
    _check_pace(frames_per_second, every)
    sources = [source]
    if beside is not None:
        sources.append(beside)

    with ExitStack() as stack:
        recordings = []
        for file in sources:
            recording = stack.enter_context(open_recording(file, registry=registry))
            recordings.append(recording)
        film = Film(recordings, _choose_panel(kind, recordings))

        temporary = stack.enter_context(atomic_path(path, option="--output"))
        if path.suffix.lower() == ".gif":
            encoder = encode_gif(temporary, rate=frames_per_second)
        else:
            encoder = encode_mp4(temporary, size=film.size, rate=frames_per_second)
        write = stack.enter_context(encoder)

        frame_count = min(recording.frames for recording in recordings)
        numbers: Iterable[int] = range(0, frame_count, every)
        if not quiet and watched():
            numbers = _show_progress(numbers, path.name)
        for number in numbers:
            write(film.frame(number))
    return path


def check_ending(path: Path) -> None:
    """Refuse a file name that has not the ending of a film.

    Raises:
        UsageError: the name ends in none of :data:`SUFFIXES`.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise UsageError(
            "no such kind of video",
            where="--output",
            expected=f"a name ending in {' or '.join(SUFFIXES)}",
            got=path,
            fix=f"name it {renamed(path, SUFFIXES[0])}",
        )


def _check_kind(kind: Panel | str | None) -> None:
    if kind is not None and kind not in KINDS:
        fix = suggest_name(str(kind), map(str, KINDS))
        raise UsageError(
            f"an animation cannot show {str(kind)!r}",
            where="--kind",
            expected=", ".join(KINDS),
            got=ascii(str(kind)),
            fix=fix,
        )


def _check_pace(frames_per_second: float, every: int) -> None:
    is_rate = SLOWEST <= frames_per_second <= FASTEST  # nan lies in no interval
    is_step = isinstance(every, int | np.integer) and every >= 1
    if not (is_rate and is_step):
        raise UsageError(
            "an animation needs a positive rate and step",
            where="--fps, --every",
            expected=f"{SLOWEST:g} to {FASTEST:g} frames/s, every whole number "
            "from 1 on",
            got=f"{frames_per_second} frames/s, every {every}",
            fix="leave both out, or give numbers in these ranges",
        )


def _choose_panel(kind: Panel | str | None, recordings: Sequence[Recording]) -> Panel:
    if kind:
        return Panel(kind)
    if any(recording.is_mixed for recording in recordings):
        return Panel.MATERIAL
    return Panel.SPEED


def _show_progress(numbers: Iterable[int], name: str) -> Iterable[int]:
    """Return the same numbers; a bar on stderr shows how many are done."""
    console = Console(stderr=True)
    return track(numbers, description=name, console=console, transient=True)


class Film:
    """Composes the frames: a still background, one panel per recording, a counter."""

    def __init__(self, recordings: Sequence[Recording], panel: Panel) -> None:
        """Choose slices and a colour scale, and draw all that does not move.

        Raises:
            UsageError: a recording has no vorticity to show.
        """
        self._recordings = recordings
        self._panel = panel
        if panel is Panel.VORTICITY:
            for recording in recordings:
                frames = _sample_frames(recording)
                recording.fix_slice(frames)
                _check_vorticity(recording, frames)
        self._limit = _common_limit(recordings, panel)

        # The panels stand side by side.
        self._painters = []
        self._lefts = []  # left side of each panel [pixel]
        left = MARGIN
        for recording in recordings:
            painter = Painter(recording, panel, side=SIDE, limit=self._limit)
            self._painters.append(painter)
            self._lefts.append(left)
            left += SIDE + GAP

        width = self._lefts[-1] + SIDE + MARGIN
        height = TOP + SIDE + BOTTOM
        self.size = (width, height)
        self._background = self._draw_background()

        # The counter of each frame is composed of these pictures.
        self._counter_letters = {}
        for letter in LETTERS:
            self._counter_letters[letter] = _draw_letter(letter)

    def frame(self, number: int) -> NDArray[np.uint8]:
        """Return one frame as RGB bytes, shape [row, column, 3]."""
        image = self._background.copy()
        for recording, painter, left in zip(
            self._recordings, self._painters, self._lefts, strict=True
        ):
            scene = recording.scene(number)
            panel = unpack(painter.paint(scene))
            image[TOP : TOP + SIDE, left : left + SIDE] = panel

        # the counter stands at the bottom right
        text = self._counter_text(number)
        letters = [self._counter_letters[letter] for letter in text]
        counter = np.concatenate(letters, axis=1)
        right = self.size[0] - MARGIN
        left = right - counter.shape[1]
        top = TOP + SIDE + 12
        image[top : top + LETTER_HEIGHT, left:right] = counter
        return image

    def _counter_text(self, number: int) -> str:
        """Return frame number and time, as wide as those of the last frame."""
        interval = self._recordings[0].size.frame_interval
        last = self._recordings[0].frames - 1
        number_width = len(str(last))
        time_width = len(f"{last * interval:.2f}")
        time = number * interval
        return f"frame {number:>{number_width}}  {time:>{time_width}.2f} s"

    def _draw_background(self) -> NDArray[np.uint8]:
        """Return title, names of the scenarios and colour bar or key as RGB bytes."""
        width, height = self.size
        with figure(width / DPI, height / DPI) as drawn:
            titles = dict.fromkeys(recording.title for recording in self._recordings)
            title = drawn.text(
                MARGIN / width,
                1 - 14 / height,
                " | ".join(titles),
                fontsize=12,
                fontweight="bold",
                va="top",
            )
            shrink(title, (width - 2 * MARGIN) / DPI)
            name_height = 1 - (TOP - 12) / height
            for recording, left in zip(self._recordings, self._lefts, strict=True):
                name = describe(recording)
                if self._panel is Panel.VORTICITY and recording.is_solid:
                    name = f"{name}{SEPARATOR}{name_slice(recording.scene(0))}"
                text = drawn.text(
                    left / width, name_height, name, fontsize=9, color=MUTED
                )
                shrink(text, SIDE / DPI)

            bar_bottom = (BOTTOM - 24) / height
            place = (MARGIN / width, bar_bottom, BAR / width, 10 / height)
            below = drawn.add_axes(place)
            if self._panel is Panel.MATERIAL:
                materials = [recording.material for recording in self._recordings]
                draw_material_key(below, np.concatenate(materials))
            else:
                is_solid = self._recordings[0].is_solid
                colour_bar(below, self._panel, self._limit, is_solid=is_solid)
            return pixels_of(drawn)


def _common_limit(recordings: Sequence[Recording], panel: Panel) -> float:
    """Return the top of one colour scale that suits whole recordings."""
    if panel is Panel.MATERIAL:
        return 1.0
    tops = []
    for recording in recordings:
        limits = []
        for number in _sample_frames(recording):
            limits.append(limit_of(panel, recording.scene(number)))
        if not any(limits):
            continue  # nothing moves: the others have the scale
        if panel is Panel.VORTICITY:
            # No vorticity is white: on the scale of the strongest frame most of a film
            # would be pale.
            tops.append(median_limit(limits))
        else:
            tops.append(strongest_limit(limits))
    return strongest_limit(tops)


def _check_vorticity(recording: Recording, frames: Sequence[int]) -> None:
    """Refuse a film of a vorticity that hardly a node has in any frame."""
    most = 0
    for frame in frames:
        count = int(np.isfinite(recording.scene(frame).vorticity).sum())
        most = max(most, count)
    if most >= FEW_NODES:
        return
    raise UsageError(
        "there is no vorticity to show: material is too thin for the grid",
        where="--kind",
        expected=f"{FEW_NODES} nodes of the grid with a vorticity; or speed or "
        "material, which need no grid",
        got=f"vorticity, which at most {format_count(most, 'node')} of a frame has",
        fix="leave --kind out",
    )


def _sample_frames(recording: Recording) -> list[int]:
    """Return some frames, spread over a recording."""
    numbers = np.linspace(0, recording.frames - 1, SAMPLES).astype(int)
    frames: list[int] = np.unique(numbers).tolist()
    return frames


def _draw_letter(letter: str) -> NDArray[np.uint8]:
    """Return a letter of the counter as RGB bytes, shape [row, column, 3]."""
    with figure(LETTER_WIDTH / DPI, LETTER_HEIGHT / DPI) as drawn:
        drawn.text(
            0.5,
            0.25,
            letter,
            fontsize=8.5,
            family="DejaVu Sans Mono",
            ha="center",
            color=INK,
        )
        return pixels_of(drawn)
