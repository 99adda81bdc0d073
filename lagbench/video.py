"""Video files that grow frame by frame: MP4 through ffmpeg, GIF with one palette.

Files appear whole or not at all, without dates, and memory does not grow with their length.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .atomic import atomic_path
from .errors import WorkFailedError
from .extras import require
from .palette import reduced

__all__ = ["SUFFIXES", "Write", "open_video"]

SUFFIXES = (".mp4", ".gif")
"""Endings of the files that can be written."""

Write = Callable[[NDArray[np.uint8]], None]
"""Appends one frame: RGB bytes, shape [row, column, 3]."""

_X264 = ["-f", "mp4", "-crf", "20", "-preset", "veryfast", "-movflags", "+faststart"]
_NO_DATES = ["-map_metadata", "-1", "-fflags", "+bitexact", "-flags:v", "+bitexact"]


@contextmanager
def open_video(path: Path, size: tuple[int, int], frames_per_second: float) -> Iterator[Write]:
    """Yield a function that appends a frame; the file appears when the body ends well.

    Args:
        path: target, ending in .mp4 or .gif.
        size: width and height of every frame, both even [pixel].
        frames_per_second: frames shown per second.

    Raises:
        UsageError: imageio or Pillow is not installed.
        WorkFailedError: the frames cannot be encoded or written.
    """
    with atomic_path(path) as temporary:
        gif = path.suffix.lower() == ".gif"
        coder = _gif(temporary, frames_per_second) if gif else _mp4(temporary, size, frames_per_second)
        with coder as write:
            yield write


@contextmanager
def _mp4(path: Path, size: tuple[int, int], rate: float) -> Iterator[Write]:
    ffmpeg = require("imageio_ffmpeg", extra="plots")
    stream = ffmpeg.write_frames(
        str(path),
        size,
        fps=rate,
        codec="libx264",
        quality=None,
        macro_block_size=2,
        ffmpeg_log_level="error",
        output_params=[*_X264, *_NO_DATES],
    )
    try:
        stream.send(None)
        yield lambda frame: stream.send(np.ascontiguousarray(frame))
    except OSError as error:
        raise WorkFailedError("ffmpeg cannot encode the video", where=str(path.parent), got=error) from error
    finally:
        stream.close()


@contextmanager
def _gif(path: Path, rate: float) -> Iterator[Write]:
    """Write a GIF that repeats for ever, all frames in lagbench's 256 colours."""
    images = require("PIL.Image", extra="plots")
    coder = require("PIL.GifImagePlugin", extra="plots")
    delay = max(20, 10 * round(100.0 / rate))  # hundredths of a second; viewers slow down below two
    with path.open("wb") as file:

        def write(frame: NDArray[np.uint8]) -> None:
            image = reduced(images.fromarray(frame))
            if not file.tell():
                file.writelines(coder.getheader(image, info={"loop": 0})[0])
            file.writelines(coder.getdata(image, duration=delay))

        yield write
        file.write(b";")
