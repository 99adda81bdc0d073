"""Video files that grow frame by frame: MP4 through ffmpeg, GIF with one palette.

Files appear whole or not at all, without dates, and memory does not grow with their length.
"""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, cast

import numpy as np
from numpy.typing import NDArray

from .atomic import atomic_path
from .errors import UsageError, WorkFailedError
from .extras import require
from .palette import reduced

__all__ = ["SUFFIXES", "Write", "open_video"]

SUFFIXES = (".mp4", ".gif")
"""Endings of the files that can be written."""

Write = Callable[[NDArray[np.uint8]], None]
"""Appends one frame: RGB bytes, shape [row, column, 3]."""

_CODING = ["-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", "20", "-preset", "veryfast"]
_CONTAINER = ["-f", "mp4", "-movflags", "+faststart", "-map_metadata", "-1"]
_NO_DATES = ["-fflags", "+bitexact", "-flags:v", "+bitexact"]


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
    """Feed frames to ffmpeg through a pipe."""
    width, height = size
    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", f"{rate:g}", "-i", "-"]
    command = [_ffmpeg(), "-y", "-loglevel", "error", *source, *_CODING, *_CONTAINER, *_NO_DATES, str(path)]
    with tempfile.TemporaryFile() as log:
        # A session of its own: Ctrl-C shall reach us, not the encoder.
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stderr=log, start_new_session=True)
        pipe = cast("IO[bytes]", process.stdin)
        finished = False
        try:
            yield lambda frame: _send(pipe, frame)
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
            said = log.read().decode(errors="replace").strip()
            raise WorkFailedError(
                "ffmpeg cannot encode the video", where=str(path.parent), got=said or "nothing said"
            )


def _send(pipe: IO[bytes], frame: NDArray[np.uint8]) -> None:
    pipe.write(frame.tobytes())


def _ffmpeg() -> str:
    """Return the path of the encoder that imageio brings, or of the system's."""
    ffmpeg = require("imageio_ffmpeg", extra="plots")
    try:
        return str(ffmpeg.get_ffmpeg_exe())
    except RuntimeError as error:
        raise UsageError(
            "no ffmpeg", got=error, fix="pip install 'lagbench[plots]', or write a .gif"
        ) from None


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
