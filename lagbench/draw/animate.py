"""A scenario as a moving picture: MP4 or GIF, two scenarios side by side where two are
given.

Needs ``pip install 'lagbench[plots]'``. Frames are read, painted and encoded one at a
time, so memory does not grow with the length; files appear whole or not at all, without
dates. Frames are drawn straight into pixels: milliseconds where a figure takes longer.
A panel is painted at twice its size and averaged down, which smooths the rims of the
dots. Pixels are packed into one integer, ``red + green 2^8 + blue 2^16``.
"""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import IO, TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from lagbench.atomic import atomic_path
from lagbench.errors import UsageError, WorkFailedError, require, suggest_name
from lagbench.work.progress import watched

from .panels import DOT, Panel, box_of, colour_bar, draw_walls, limit_of, material_key
from .plot import describe
from .recording import Recording, Scene, open_recording
from .style import (
    DPI,
    INK,
    MATERIAL_COLOURS,
    MUTED,
    figure,
    pixels_of,
    reduced,
    rgb,
    speed_map,
    vorticity_map,
)

if TYPE_CHECKING:
    from lagbench.data.registry import Registry

__all__ = ["KINDS", "SUFFIXES", "animate", "check_ending"]

Packed = NDArray[np.uint32]

OVERSAMPLING = 2


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
    return (
        np.ascontiguousarray(packed.astype("<u4"))
        .view(np.uint8)
        .reshape(*packed.shape, 4)[..., :3]
    )


def halve(packed: Packed) -> Packed:
    """Return an image of half the size: each pixel the mean of four, rounded down
    twice.
    """
    rows = _mean(packed[0::2], packed[1::2])
    return _mean(rows[:, 0::2], rows[:, 1::2])


def _mean(a: Packed, b: Packed) -> Packed:
    """Return the mean of packed pixels: the shared bits and half of the others, colour
    by colour.
    """
    return (a & b) + (((a ^ b) & np.uint32(0xFEFEFE)) >> np.uint32(1))


class Painter:
    """Paints one recording, frame by frame."""

    def __init__(
        self, recording: Recording, panel: Panel, *, side: int, limit: float
    ) -> None:
        """Paint what does not move."""
        self.panel = panel  # speed, material or vorticity
        self.limit = limit  # top of the colour scale
        self._side = side * OVERSAMPLING
        diameter = DOT * recording.spacing * self._side
        reach = int(np.ceil(diameter / 2))
        grid = np.mgrid[-reach : reach + 1, -reach : reach + 1]
        # rows and columns of a dot's pixels from its middle, one pixel at least
        self._disc = grid[:, (grid**2).sum(axis=0) <= max(diameter / 2, 0.5) ** 2]
        self._margin = int(self._disc[0].max(initial=0)) + 1
        self._drawn_walls: dict[bytes, Packed] = {}
        self._materials = pack(np.array([rgb(colour) for colour in MATERIAL_COLOURS]))[
            recording.material
        ]
        if panel is Panel.VORTICITY:
            colours = vorticity_map()
        else:
            colours = speed_map()
        self._colours = pack(
            (np.asarray(colours.colors)[:, :3] * 255.0).round().astype(np.uint8)
        )
        left, right, bottom, top = box_of(recording)
        self._middle = (np.arange(self._side) + 0.5) / self._side
        rows = (1.0 - self._middle >= bottom) & (1.0 - self._middle <= top)
        columns = (self._middle >= left) & (self._middle <= right)
        self._inside: NDArray[np.bool_] = rows[:, None] & columns

    def paint(self, scene: Scene) -> Packed:
        """Return the panel of one frame, shape [row, column], first row at the top."""
        walls = self._walls(scene)
        if (
            self.panel is Panel.VORTICITY
        ):  # a square around every node that has one; paper elsewhere
            grid = scene.fields.grid
            index = np.floor(self._middle * grid.cells - grid.origin + 0.5).astype(
                np.intp
            )
            index = np.clip(index, 0, grid.nodes - 1)
            omega = scene.vorticity.T[::-1][np.ix_(grid.nodes - 1 - index[::-1], index)]
            defined = np.isfinite(omega) & self._inside
            level = _level(
                0.5 + 0.5 * np.where(defined, omega, 0.0) / self.limit,
                len(self._colours),
            )
            return halve(np.where(defined, self._colours[level], walls))
        # A dot for every particle, cut off at the walls; later particles lie on earlier
        # ones.
        margin = self._margin
        image = np.pad(walls, self._margin)
        shown = ((scene.position >= 0.0) & (scene.position <= 1.0)).all(axis=-1)
        x, y = scene.position[shown].T
        column = np.minimum((x * self._side).astype(np.intp), self._side - 1) + margin
        row = (
            np.minimum(((1.0 - y) * self._side).astype(np.intp), self._side - 1)
            + margin
        )
        width = image.shape[1]
        stamp = self._disc[0] * width + self._disc[1]
        colours = self._materials
        if self.panel is Panel.SPEED:
            colours = self._colours[
                _level(scene.speed / self.limit, len(self._colours))
            ]
        places = (row * width + column)[:, None] + stamp
        image.reshape(-1)[places] = colours[shown][:, None]
        return halve(
            np.where(self._inside, image[margin:-margin, margin:-margin], walls)
        )

    def _walls(self, scene: Scene) -> Packed:
        """Return the empty box; it changes only where a wall turns."""
        signs = np.sign(scene.recording.wall_velocity[scene.frame]).tobytes()
        if signs not in self._drawn_walls:
            with figure(self._side / DPI, self._side / DPI) as drawn:
                draw_walls(drawn.add_axes((0, 0, 1, 1)), scene.recording, scene.frame)
                self._drawn_walls[signs] = pack(pixels_of(drawn))
        return self._drawn_walls[signs]


def _level(share: NDArray[np.float64], levels: int) -> NDArray[np.intp]:
    """Return the entry of a table of so many colours for shares of its scale."""
    return np.clip(share * levels, 0, levels - 1).astype(np.intp)


SUFFIXES = (".mp4", ".gif")  # endings of the files that can be written
# appends one frame: RGB bytes, shape [row, column, 3]
Write = Callable[[NDArray[np.uint8]], object]

_CODING = [
    "-c:v",
    "libx264",
    "-pix_fmt",
    "yuv420p",
    "-crf",
    "20",
    "-preset",
    "veryfast",
]
_CONTAINER = ["-f", "mp4", "-movflags", "+faststart", "-map_metadata", "-1"]
_NO_DATES = ["-fflags", "+bitexact", "-flags:v", "+bitexact"]


@contextmanager
def _mp4(path: Path, size: tuple[int, int], rate: float) -> Iterator[Write]:
    """Feed frames to ffmpeg through a pipe: that which imageio brings, or the
    system's.
    """
    try:
        ffmpeg = str(require("imageio_ffmpeg", extra="plots").get_ffmpeg_exe())
    except RuntimeError as error:
        fix = "pip install 'lagbench[plots]', or write a .gif"
        raise UsageError("no ffmpeg", got=error, fix=fix) from None
    width, height = size
    source = [
        "-f",
        "rawvideo",
        "-pix_fmt",
        "rgb24",
        "-s",
        f"{width}x{height}",
        "-r",
        f"{rate:g}",
        "-i",
        "-",
    ]
    command = [
        ffmpeg,
        "-y",
        "-loglevel",
        "error",
        *source,
        *_CODING,
        *_CONTAINER,
        *_NO_DATES,
        str(path),
    ]
    with tempfile.TemporaryFile() as log:
        # A session of its own: Ctrl-C shall reach us, not the encoder.
        process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stderr=log, start_new_session=True
        )
        pipe = cast("IO[bytes]", process.stdin)
        finished = False
        try:
            yield lambda frame: pipe.write(frame.tobytes())
            pipe.close()
            finished = process.wait() == 0
        except BrokenPipeError:
            process.wait()
        finally:
            process.kill()
            process.wait()
            with suppress(BrokenPipeError):
                pipe.close()
        if not finished:
            log.seek(0)
            said = log.read().decode(errors="replace").strip() or "nothing said"
            raise WorkFailedError(
                "ffmpeg cannot encode the video", where=str(path.parent), got=said
            )


@contextmanager
def _gif(path: Path, rate: float) -> Iterator[Write]:
    """Write a GIF that repeats for ever, all frames in lagbench's 256 colours."""
    images = require("PIL.Image", extra="plots")
    coder = require("PIL.GifImagePlugin", extra="plots")
    # hundredths of a second; viewers slow down below two
    delay = max(20, 10 * round(100.0 / rate))
    with path.open("wb") as file:

        def write(frame: NDArray[np.uint8]) -> None:
            image = reduced(images.fromarray(frame))
            if not file.tell():
                file.writelines(coder.getheader(image, info={"loop": 0})[0])
            file.writelines(coder.getdata(image, duration=delay))

        yield write
        file.write(b";")


KINDS = (Panel.SPEED, Panel.MATERIAL, Panel.VORTICITY)  # what an animation can show
SLOWEST = 0.01
FASTEST = 1000.0  # frames per second that every player and both formats can hold [1/s]
SAMPLES = 12  # frames that set the colour scale, spread over the scenario

SIDE = 512
GAP = 24
MARGIN = 24
TOP = 84
BOTTOM = 76  # [pixel]; all even, as video coding wants it
BAR = 300  # length of the colour bar [pixel]
DIGIT = 10
LINE = 20  # cell of a digit of the counter [pixel]


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
    if kind is not None and kind not in KINDS:
        fix = suggest_name(str(kind), map(str, KINDS))
        raise UsageError(f"an animation cannot show {kind!r}", where="--kind", fix=fix)
    whole = isinstance(every, int | np.integer)
    if (
        not SLOWEST <= frames_per_second <= FASTEST or not whole or every < 1
    ):  # nan lies in no interval
        raise UsageError(
            "an animation needs a positive rate and step",
            where="--fps, --every",
            expected=f"{SLOWEST:g} to {FASTEST:g} frames/s, every whole number "
            f"from 1 on",
            got=f"{frames_per_second} frames/s, every {every}",
        )
    with ExitStack() as stack:
        if beside is None:
            sources = [source]
        else:
            sources = [source, beside]
        recordings = [
            stack.enter_context(open_recording(item, registry=registry))
            for item in sources
        ]
        mixed = any(np.unique(recording.material).size > 1 for recording in recordings)
        film = _Film(
            recordings, Panel(kind or (Panel.MATERIAL if mixed else Panel.SPEED))
        )
        numbers: Iterable[int] = range(
            0, min(recording.frames for recording in recordings), every
        )
        temporary = stack.enter_context(atomic_path(path, option="--output"))
        rate = frames_per_second
        gif = path.suffix.lower() == ".gif"
        write = stack.enter_context(
            _gif(temporary, rate) if gif else _mp4(temporary, film.size, rate)
        )
        if not quiet and watched():
            from rich.console import Console
            from rich.progress import track

            numbers = track(
                numbers,
                description=path.name,
                console=Console(stderr=True),
                transient=True,
            )
        for frame in numbers:
            write(film.frame(frame))
    return path


def check_ending(path: Path) -> None:
    """Refuse a name that is none of a film."""
    if path.suffix.lower() not in SUFFIXES:
        expected = f"a name ending in {' or '.join(SUFFIXES)}"
        raise UsageError(
            "no such kind of video", where="output", expected=expected, got=path
        )


class _Film:
    """Composes the frames: a still background, one painted panel per recording, a
    counter.
    """

    def __init__(self, recordings: Sequence[Recording], panel: Panel) -> None:
        """Draw all that does not move: titles, names of the scenarios, colour bar or
        key, and the digits.
        """
        limit = 1.0
        if panel is not Panel.MATERIAL:  # one scale that suits whole recordings
            tops = []
            for recording in recordings:
                numbers = np.unique(
                    np.linspace(0, recording.frames - 1, SAMPLES).astype(int)
                ).tolist()
                limits = [
                    limit_of(panel, recording.scene(number)) for number in numbers
                ]
                # No vorticity is white: on the scale of the strongest frame most of a
                # film would be pale.
                tops.append(
                    float(np.median(limits))
                    if panel is Panel.VORTICITY
                    else max(limits)
                )
            limit = max(tops)
        self._recordings = recordings
        self._painters = [
            Painter(recording, panel, side=SIDE, limit=limit)
            for recording in recordings
        ]
        self._lefts = [
            MARGIN + column * (SIDE + GAP) for column in range(len(recordings))
        ]
        width, height = self.size = (
            self._lefts[-1] + SIDE + MARGIN,
            TOP + SIDE + BOTTOM,
        )
        with figure(width / DPI, height / DPI) as drawn:
            title = " | ".join(
                dict.fromkeys(recording.title for recording in recordings)
            )
            drawn.text(
                MARGIN / width,
                1 - 14 / height,
                title,
                fontsize=12,
                fontweight="bold",
                va="top",
            )
            for recording, left in zip(recordings, self._lefts, strict=True):
                name = describe(recording)
                drawn.text(
                    left / width, 1 - (TOP - 12) / height, name, fontsize=9, color=MUTED
                )
            below = drawn.add_axes(
                (MARGIN / width, (BOTTOM - 24) / height, BAR / width, 10 / height)
            )
            if panel is Panel.MATERIAL:
                material_key(
                    below,
                    np.concatenate([recording.material for recording in recordings]),
                )
            else:
                colour_bar(below, panel, limit)
            self._still = pixels_of(drawn)
        self._digits = {}
        for letter in "0123456789.frames t=":
            with figure(DIGIT / DPI, LINE / DPI) as drawn:
                drawn.text(
                    0.5,
                    0.25,
                    letter,
                    fontsize=8.5,
                    family="DejaVu Sans Mono",
                    ha="center",
                    color=INK,
                )
                self._digits[letter] = pixels_of(drawn)

    def frame(self, number: int) -> NDArray[np.uint8]:
        """Return one frame as RGB bytes, shape [row, column, 3]."""
        image = self._still.copy()
        for recording, painter, left in zip(
            self._recordings, self._painters, self._lefts, strict=True
        ):
            image[TOP : TOP + SIDE, left : left + SIDE] = unpack(
                painter.paint(recording.scene(number))
            )
        # Frame number and time at the bottom right, as wide as those of the last frame.
        interval = self._recordings[0].size.frame_interval
        last = self._recordings[0].frames - 1
        places = len(str(last))
        digits = len(f"{last * interval:.2f}")
        text = f"frame {number:>{places}}  {number * interval:>{digits}.2f} s"
        left = self.size[0] - MARGIN - DIGIT * len(text)
        top = TOP + SIDE + 12
        drawn = np.concatenate([self._digits[letter] for letter in text], axis=1)
        image[top : top + LINE, left : self.size[0] - MARGIN] = drawn
        return image
