"""A scenario as a film: MP4 or GIF, one or two scenarios side by side.

Needs ``pip install 'lagbench[plots]'``. Frames are read, drawn and encoded one at a
time. Files appear whole or not at all, and the same frames give the same bytes.
"""

from __future__ import annotations

import operator
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

from lagbench.atomic import atomic_path
from lagbench.data.layout import expand_home
from lagbench.errors import UsageError, require
from lagbench.work.run import watched

from .canvas import DPI, figure, pixels_of, shrink
from .colours import MUTED
from .panels import (
    FEW_NODES,
    Panel,
    colour_bar,
    draw,
    draw_material_key,
    limit_of,
    median_limit,
    name_slice,
    strongest_limit,
)
from .pictures import data_name, find_scenario, require_place
from .plot import SEPARATOR, describe
from .recording import Recording, open_recording

if TYPE_CHECKING:
    from lagbench.data.registry import Registry

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

CODING = ("-crf", "20", "-preset", "veryfast", "-movflags", "+faststart")
NO_DATES = ("-map_metadata", "-1", "-fflags", "+bitexact", "-flags:v", "+bitexact")

SHORTEST_DELAY = 20  # viewers slow a GIF down below two hundredths of a second [ms]


def animate(
    source: str | Path,
    *,
    size: str | None = None,
    scenario: int | None = None,
    beside: int | str | Path | None = None,
    kind: Panel | str | None = None,
    frames_per_second: float = 30.0,
    every: int = 1,
    output: str | Path | None = None,
    overwrite: bool = False,
    root: str | Path | None = None,
    quiet: bool = False,
    registry: Registry | None = None,
) -> Path:
    """Make a film of a scenario, or of two side by side; return its path.

    Args:
        source: name of the split, path of a local split's folder, or a scenario file.
        size: name of the size; as :func:`lagbench.open_split` picks it when None.
        scenario: scenario id, where the source is a split; the first one of test when
            None.
        beside: id of a second scenario of the split, or another scenario file; it is
            drawn to the right with the same colour scale, and the film ends with the
            shorter of the two.
        kind: one of :data:`KINDS`; material where there are several, else speed, when
            None.
        frames_per_second: frames shown per second [1/s], 0.01 to 1000; a GIF rounds to
            hundredths of a second.
        every: show every n-th frame.
        output: file to write, ending in .mp4 or .gif; named after the data in the
            working folder when None.
        overwrite: whether to replace a file of that name.
        root: folder of all data sets; else LAGBENCH_ROOT, else the user data folder.
        quiet: show no progress; without a terminal on stderr none is shown anyway.
        registry: where splits are described; ours when None.

    Raises:
        UsageError: unknown split, size, scenario or kind, another ending, a rate out of
            bounds, no such folder, a file that must not be replaced, no matplotlib.
        DataError: a scenario is not on this machine, or damaged.
        WorkFailedError: the video cannot be encoded or written.
    """
    find = partial(find_scenario, source, size=size, root=root, registry=registry)
    sources = [find(scenario=scenario)]
    if isinstance(beside, str | Path):
        sources.append(expand_home(beside, "beside"))
    elif beside is not None:
        sources.append(find(scenario=operator.index(beside)))
    path = Path(f"{data_name(sources[0])}.mp4")
    if output is not None:
        path = expand_home(output, "output")
    if path.suffix.lower() not in SUFFIXES:
        raise UsageError(
            f"films are MP4 or GIF files, not {path.name}; name it "
            f"{path.stem or 'film'}.mp4",
            where="--output",
        )
    require_place(path, overwrite=overwrite)
    if kind is not None and kind not in KINDS:
        raise UsageError(
            f"a film cannot show {str(kind)!r}; choose {', '.join(KINDS)}",
            where="--kind",
        )
    if not SLOWEST <= frames_per_second <= FASTEST:
        raise UsageError(
            f"a film cannot show {frames_per_second} frames per second; give "
            f"{SLOWEST:g} to {FASTEST:g}",
            where="--fps",
        )
    if every < 1:
        raise UsageError(f"no step of {every} frames; give 1 or more", where="--every")

    with ExitStack() as stack:
        recordings = []
        for file in sources:
            recording = stack.enter_context(open_recording(file, registry=registry))
            recordings.append(recording)
        frame_count = min(recording.frames for recording in recordings)
        numbers: Iterable[int] = range(0, frame_count, every)
        if not quiet and watched():
            console = Console(stderr=True)
            numbers = track(
                numbers, description=path.name, console=console, transient=True
            )
        if kind:
            panel = Panel(kind)
        elif any(recording.is_mixed for recording in recordings):
            panel = Panel.MATERIAL
        else:
            panel = Panel.SPEED
        frames = draw_film(recordings, panel, numbers)

        temporary = stack.enter_context(atomic_path(path, option="--output"))
        if path.suffix.lower() == ".gif":
            _encode_gif(temporary, frames, rate=frames_per_second)
        else:
            _encode_mp4(temporary, frames, rate=frames_per_second)
    return path


def _encode_mp4(
    path: Path, frames: Iterator[NDArray[np.uint8]], *, rate: float
) -> None:
    """Write frames to an MP4 file through the ffmpeg of imageio."""
    ffmpeg = require("imageio_ffmpeg", extra="plots")
    first = next(frames)
    height, width, _ = first.shape
    writer = ffmpeg.write_frames(
        str(path),
        (width, height),
        fps=rate,
        codec="libx264",
        quality=None,
        macro_block_size=2,
        output_params=[*CODING, *NO_DATES, "-f", "mp4"],
    )
    writer.send(None)
    writer.send(first)
    for frame in frames:
        writer.send(frame)
    writer.close()


def _encode_gif(
    path: Path, frames: Iterator[NDArray[np.uint8]], *, rate: float
) -> None:
    """Write frames to a GIF file that repeats for ever, with the palette of the first.

    Rates are rounded to hundredths of a second.
    """
    images = require("PIL.Image", extra="plots")
    first = images.fromarray(next(frames)).quantize(256)

    def reduce() -> Iterator[object]:
        for frame in frames:
            exact = images.fromarray(frame)
            yield exact.quantize(palette=first, dither=images.Dither.NONE)

    first.save(
        path,
        format="GIF",
        save_all=True,
        append_images=reduce(),
        duration=max(SHORTEST_DELAY, 10 * round(100.0 / rate)),
        loop=0,
    )


def draw_film(
    recordings: Sequence[Recording], panel: Panel, numbers: Iterable[int]
) -> Iterator[NDArray[np.uint8]]:
    """Yield frames of a film as RGB bytes, shape [row, column, 3].

    The recordings stand side by side with one colour scale; a counter at the bottom
    shows frame and time.

    Raises:
        UsageError: a recording has no vorticity to show.
    """
    if panel is Panel.VORTICITY:
        for recording in recordings:
            frames = _sample_frames(recording)
            recording.fix_slice(frames)
            scenes = map(recording.scene, frames)
            most = max(np.isfinite(scene.vorticity).sum() for scene in scenes)
            if most < FEW_NODES:
                raise UsageError(
                    f"material is too thin for the grid: at most {most} nodes of a "
                    "frame have a vorticity; show speed or material",
                    where="--kind",
                )
    limit = _common_limit(recordings, panel)
    width = 2 * MARGIN + len(recordings) * (SIDE + GAP) - GAP
    height = TOP + SIDE + BOTTOM
    with figure(width / DPI, height / DPI) as drawn:
        titles = dict.fromkeys(recording.title for recording in recordings)
        title = drawn.text(
            MARGIN / width,
            1 - 14 / height,
            " | ".join(titles),
            fontsize=12,
            fontweight="bold",
            va="top",
        )
        shrink(title, (width - 2 * MARGIN) / DPI)
        panels = []
        for number, recording in enumerate(recordings):
            left = MARGIN + number * (SIDE + GAP)
            name = describe(recording)
            if panel is Panel.VORTICITY and recording.is_solid:
                name = f"{name}{SEPARATOR}{name_slice(recording.scene(0))}"
            y = 1 - (TOP - 12) / height
            text = drawn.text(left / width, y, name, fontsize=9, color=MUTED)
            shrink(text, SIDE / DPI)
            place = (left / width, BOTTOM / height, SIDE / width, SIDE / height)
            panels.append(drawn.add_axes(place))

        bar_bottom = (BOTTOM - 24) / height
        place = (MARGIN / width, bar_bottom, BAR / width, 10 / height)
        below = drawn.add_axes(place)
        if panel is Panel.MATERIAL:
            materials = [recording.material for recording in recordings]
            draw_material_key(below, np.concatenate(materials))
        else:
            colour_bar(below, panel, limit, is_solid=recordings[0].is_solid)
        counter = drawn.text(
            1 - MARGIN / width,
            bar_bottom,
            "",
            fontsize=8.5,
            family="DejaVu Sans Mono",
            ha="right",
        )

        interval = recordings[0].size.frame_interval
        last = recordings[0].frames - 1
        number_width = len(str(last))
        time_width = len(f"{last * interval:.2f}")
        for number in numbers:
            for axes, recording in zip(panels, recordings, strict=True):
                axes.clear()
                draw(axes, panel, recording.scene(number), limit=limit)
            time = f"{number * interval:>{time_width}.2f} s"
            counter.set_text(f"frame {number:>{number_width}}  {time}")
            yield pixels_of(drawn)


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


def _sample_frames(recording: Recording) -> list[int]:
    """Return some frames, spread over a recording."""
    numbers = np.linspace(0, recording.frames - 1, SAMPLES).astype(int)
    frames: list[int] = np.unique(numbers).tolist()
    return frames
