"""Films: right lengths and sizes, the truth's colours, whole files."""

from __future__ import annotations

from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
from PIL import ImageSequence
from PIL.GifImagePlugin import GifImageFile
from rotating_disc import write_swirl

from lagbench.errors import UsageError
from lagbench.figures import animate as films
from lagbench.figures.animate import animate, draw_film
from lagbench.figures.panels import Panel
from lagbench.figures.recording import open_recording

WIDTH = films.SIDE + 2 * films.MARGIN
HEIGHT = films.TOP + films.SIDE + films.BOTTOM


@pytest.fixture(scope="module")
def swirl(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scenario of four frames that turns counter-clockwise."""
    return write_swirl(tmp_path_factory.mktemp("root"), frames=4)


def test_mp4_has_every_frame_and_the_same_bytes_twice(
    swirl: Path, tmp_path: Path
) -> None:
    path = animate(swirl, output=tmp_path / "film.mp4", frames_per_second=10)
    frames, seconds = imageio_ffmpeg.count_frames_and_secs(str(path))
    assert frames == 4
    assert seconds == pytest.approx(0.4)
    meta = next(imageio_ffmpeg.read_frames(str(path)))
    assert meta["size"] == (WIDTH, HEIGHT)
    again = animate(swirl, output=tmp_path / "again.mp4", frames_per_second=10)
    assert again.read_bytes() == path.read_bytes()


def test_gif_repeats_and_ends_with_the_shorter_of_two(
    swirl: Path, tmp_path: Path
) -> None:
    other = write_swirl(tmp_path, frames=3)
    path = animate(swirl, output=tmp_path / "film.gif", beside=other)
    again = animate(swirl, output=tmp_path / "again.gif", beside=other)
    assert again.read_bytes() == path.read_bytes()
    with GifImageFile(path) as image:
        assert image.info["loop"] == 0
        assert len(list(ImageSequence.Iterator(image))) == 3
        assert image.size == (WIDTH + films.SIDE + films.GAP, HEIGHT)


def test_vorticity_of_a_counter_clockwise_disc_is_red(swirl: Path) -> None:
    with open_recording(swirl) as recording:
        frame, *_ = draw_film([recording], Panel.VORTICITY, [2])
    middle_row = films.TOP + films.SIDE // 2
    middle_column = films.MARGIN + films.SIDE // 2
    red, _, blue = frame[middle_row, middle_column].astype(int)
    assert red > blue + 50


def test_an_error_leaves_no_file(swirl: Path, tmp_path: Path) -> None:
    damaged = tmp_path / "damaged.nc"
    damaged.write_bytes(swirl.read_bytes()[:3000])
    target = tmp_path / "films"
    target.mkdir()
    for ending in (".mp4", ".gif"):
        with pytest.raises(Exception, match=r"damaged\.nc"):
            animate(damaged, output=target / f"film{ending}")
    assert not list(target.iterdir())


@pytest.mark.parametrize(
    ("settings", "where"),
    [
        ({"kind": "streamlines"}, "--kind"),
        ({"frames_per_second": 0.0}, "--fps"),
        ({"frames_per_second": np.nan}, "--fps"),
        ({"every": 0}, "--every"),
    ],
)
def test_settings_out_of_range_are_refused(
    swirl: Path, tmp_path: Path, settings: dict[str, object], where: str
) -> None:
    with pytest.raises(UsageError) as caught:
        animate(swirl, output=tmp_path / "film.gif", **settings)  # type: ignore[arg-type]
    assert caught.value.where == where
