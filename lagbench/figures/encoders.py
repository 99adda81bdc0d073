"""Encoders of films: frames go in one at a time, and an MP4 or GIF file comes out.

Files hold no dates: the same frames give the same bytes.
"""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, cast

import numpy as np
from numpy.typing import NDArray

from lagbench.errors import UsageError, WorkFailedError, require

from .canvas import choose_palette, reduce_colours

# appends one frame: RGB bytes, shape [row, column, 3]
WriteFrame = Callable[[NDArray[np.uint8]], object]

X264 = ("-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", "20", "-preset", "veryfast")
"""Options of ffmpeg that say how a video is coded."""

_INPUT = ("-f", "rawvideo", "-pix_fmt", "rgb24")
_CONTAINER = ("-f", "mp4", "-movflags", "+faststart", "-map_metadata", "-1")
_NO_DATES = ("-fflags", "+bitexact", "-flags:v", "+bitexact")

SHORTEST_DELAY = 20  # viewers slow a GIF down below two hundredths of a second [ms]


@contextmanager
def encode_mp4(
    path: Path, *, size: tuple[int, int], rate: float, coding: Sequence[str] = X264
) -> Iterator[WriteFrame]:
    """Yield a function that appends a frame to an MP4 file.

    Frames go through a pipe to ffmpeg: the one of imageio, or else the system's.

    Args:
        path: file to write.
        size: width and height of a frame [pixel], both even.
        rate: frames shown per second [1/s].
        coding: options of ffmpeg that say how the video is coded.

    Raises:
        UsageError: there is no ffmpeg.
        WorkFailedError: ffmpeg cannot encode the video.
    """
    try:
        ffmpeg = str(require("imageio_ffmpeg", extra="plots").get_ffmpeg_exe())
    except RuntimeError as error:
        fix = "pip install 'lagbench[plots]', or write a .gif"
        raise UsageError(
            "no ffmpeg",
            where=str(path),
            expected="the ffmpeg that imageio-ffmpeg brings",
            got=error,
            fix=fix,
        ) from None

    width, height = size
    command = [ffmpeg, "-y", "-loglevel", "error", *_INPUT]
    command += ["-s", f"{width}x{height}", "-r", f"{rate:g}", "-i", "-"]
    command += [*coding, *_CONTAINER, *_NO_DATES, str(path)]
    with tempfile.TemporaryFile() as log:
        # A session of its own: Ctrl-C shall reach us, not the encoder.
        process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stderr=log, start_new_session=True
        )
        pipe = cast("IO[bytes]", process.stdin)
        is_complete = False
        try:
            yield lambda frame: pipe.write(frame.tobytes())
            pipe.close()
            is_complete = process.wait() == 0
        except BrokenPipeError:
            process.wait()
        finally:
            process.kill()
            process.wait()
            with suppress(BrokenPipeError):
                pipe.close()
        if not is_complete:
            log.seek(0)
            message = log.read().decode(errors="replace").strip()
            raise WorkFailedError(
                "ffmpeg cannot encode the video",
                where=str(path.parent),
                expected="a video",
                got=message or "no message",
                fix="free disk space, or write a GIF: -o FILE.gif",
            )


@contextmanager
def encode_gif(path: Path, *, rate: float) -> Iterator[WriteFrame]:
    """Yield a function that appends a frame to a GIF file that repeats for ever.

    All frames share the palette of the first. Rates are rounded to hundredths of a
    second.
    """
    images = require("PIL.Image", extra="plots")
    plugin = require("PIL.GifImagePlugin", extra="plots")
    delay = max(SHORTEST_DELAY, 10 * round(100.0 / rate))
    palettes: list[NDArray[np.uint8]] = []
    with path.open("wb") as file:

        def write(frame: NDArray[np.uint8]) -> None:
            exact = images.fromarray(frame)
            if not palettes:
                palettes.append(choose_palette(exact))
            image = reduce_colours(exact, palettes[0])
            is_first = file.tell() == 0
            if is_first:
                header, _ = plugin.getheader(image, info={"loop": 0})
                file.writelines(header)
            blocks = plugin.getdata(image, duration=delay)
            file.writelines(blocks)

        yield write
        file.write(b";")
