"""Animations: pixels where particles are, right lengths and sizes, whole files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import imageio_ffmpeg
import numpy as np
import pytest
import xarray
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.testing import assert_array_equal
from numpy.typing import NDArray
from PIL import ImageSequence
from PIL.GifImagePlugin import GifImageFile
from rotating_disc import OMEGA, write_swirl

from lagbench.errors import DataError, UsageError, WorkFailedError
from lagbench.figures import animate as animation
from lagbench.figures.animate import animate
from lagbench.figures.colours import (
    MATERIAL_COLOURS,
    MOVING,
    PAPER,
    WALL,
    parse_rgb,
)
from lagbench.figures.encoders import encode_mp4
from lagbench.figures.painter import Painter, halve, pack, unpack
from lagbench.figures.panels import Panel
from lagbench.figures.recording import Scene, open_recording

Pixels = NDArray[np.uint8]

WIDTH = animation.SIDE + 2 * animation.MARGIN
HEIGHT = animation.TOP + animation.SIDE + animation.BOTTOM

images = hnp.array_shapes(min_dims=2, max_dims=2, max_side=5)
even_sizes = st.integers(1, 4)


@pytest.fixture(scope="module")
def swirl(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scenario of eight frames."""
    return write_swirl(tmp_path_factory.mktemp("root"), frames=8)


shapes_of_images = images.map(lambda shape: (*shape, 3))
shapes_of_even_images = even_sizes.map(lambda n: (2 * n, 2 * n, 3))


@given(hnp.arrays(np.uint8, shapes_of_images))
def test_packing_keeps_every_pixel(pixels: Pixels) -> None:
    """Unpack is the inverse of pack."""
    packed = pack(pixels)
    assert_array_equal(unpack(packed), pixels)


@given(hnp.arrays(np.uint8, shapes_of_even_images))
def test_halving_takes_the_mean_of_four(pixels: Pixels) -> None:
    """Each colour is the mean of four, at most 1.5 below for the two roundings."""
    side = len(pixels) // 2
    blocks = pixels.reshape(side, 2, side, 2, 3)
    exact = blocks.mean(axis=(1, 3))
    halved = halve(pack(pixels))
    difference = exact - unpack(halved)
    assert difference.min() >= 0.0
    assert difference.max() < 1.5


def paint(path: Path, panel: Panel, frame: int, side: int = 128) -> Pixels:
    """Paint one panel of a scenario."""
    with open_recording(path) as recording:
        painter = Painter(recording, panel, side=side, limit=2.0 * OMEGA)
        scene = recording.scene(frame)
        return unpack(painter.paint(scene))


def has_colour(pixels: Pixels, colour: str) -> NDArray[np.bool_]:
    """Return which pixels have a colour."""
    colour_of_pixel = parse_rgb(colour)
    is_equal: NDArray[np.bool_] = (pixels == colour_of_pixel).all(axis=-1)
    return is_equal


def test_dots_lie_where_the_particles_are(swirl: Path) -> None:
    """A disc of radius 0.4 is coloured inside, paper outside, and its box has walls."""
    image = paint(swirl, Panel.MATERIAL, 0)
    is_liquid = has_colour(image, MATERIAL_COLOURS[0])
    y, x = np.mgrid[0:128, 0:128] / 128.0 - 0.5
    radius = np.hypot(x, y)
    share_inside = is_liquid[radius < 0.35].mean()
    assert share_inside > 0.9
    assert not is_liquid[radius > 0.44].any()
    assert has_colour(image[64, 1], WALL)
    assert has_colour(image[1, 20], MOVING)


def test_the_first_row_is_the_top_of_the_box(tmp_path: Path) -> None:
    """Materials follow the particle number.

    The sunflower's last points lie on the rim, the first in the middle.
    """
    first_colour, second_colour, *_ = MATERIAL_COLOURS
    path = write_swirl(
        tmp_path,
        "multimaterial",
        0,
        walls=None,
        materials=2,
    )
    image = paint(path, Panel.MATERIAL, 0)
    middle = 64
    assert has_colour(image[middle, middle], first_colour)
    # 0.35 above the middle: the second material
    rim = image[middle - int(0.35 * 128), 60:68]
    assert has_colour(rim, second_colour).any()


def test_vorticity_of_a_rotating_disc_is_red_inside(swirl: Path) -> None:
    """Counter-clockwise rotation is red and even; outside the disc there is paper."""
    image = paint(swirl, Panel.VORTICITY, 3)
    # clear of the rim on the 8 x 8 grid
    middle = image[52:76, 52:76].reshape(-1, 3)
    red, _, blue = middle.astype(int).T
    assert (red > blue + 60).all()
    assert has_colour(image[12, 115], PAPER)


def test_speeds_are_symmetric_about_the_middle(swirl: Path) -> None:
    """A turning disc is dark in the middle and bright at the rim."""
    image = paint(swirl, Panel.SPEED, 2).astype(int)
    in_the_middle = image[64, 64].sum()
    at_the_rim = image[64, 64 + 48].sum()
    assert in_the_middle < at_the_rim


@pytest.mark.slow
def test_mp4_has_every_frame_and_an_even_size(swirl: Path, tmp_path: Path) -> None:
    """Eight frames at 30 a second; the same frames give the same bytes."""
    first = animate(swirl, tmp_path / "first.mp4")
    second = animate(swirl, tmp_path / "second.mp4")
    frame_count, seconds = imageio_ffmpeg.count_frames_and_secs(first)
    assert frame_count == 8
    assert seconds == pytest.approx(8 / 30, abs=0.02)
    meta = next(imageio_ffmpeg.read_frames(first))
    assert meta["size"] == (WIDTH, HEIGHT)
    assert WIDTH % 2 == 0
    assert HEIGHT % 2 == 0
    assert first.read_bytes() == second.read_bytes()


def test_two_scenarios_side_by_side_end_with_the_shorter(
    swirl: Path, tmp_path: Path
) -> None:
    """The picture is wider by a panel and a gap."""
    shorter = write_swirl(tmp_path, scenario=3, frames=5)
    path = animate(swirl, tmp_path / "pair.gif", beside=shorter)
    with GifImageFile(path) as image:
        assert image.n_frames == 5
        width, _ = image.size
    assert width == WIDTH + animation.GAP + animation.SIDE


def test_gif_repeats_and_has_the_same_bytes_twice(
    swirl: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Frames differ, all keep the exact white of the paper; nothing is logged."""
    options: dict[str, Any] = {"every": 3, "frames_per_second": 10}
    first = animate(swirl, tmp_path / "first.gif", **options)
    second = animate(swirl, tmp_path / "second.gif", **options)
    assert capfd.readouterr() == ("", "")
    assert first.read_bytes() == second.read_bytes()
    frames = []
    with GifImageFile(first) as image:
        assert image.n_frames == 3
        assert image.info["loop"] == 0  # for ever
        assert image.info["duration"] == 100
        for frame in ImageSequence.Iterator(image):
            pixels = frame.convert("RGB")
            frames.append(np.asarray(pixels))
    for frame in frames:
        assert has_colour(frame[-1, -1], PAPER)
    first_frame, _, last_frame = frames
    assert (first_frame != last_frame).any()


def test_an_error_leaves_no_file(
    swirl: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A painter that fails half-way leaves the target as it was."""
    target = tmp_path / "old.mp4"
    target.write_bytes(b"old")
    original = Painter.paint

    def fail_at_three(self: Painter, scene: Scene) -> object:
        if scene.frame == 3:
            raise DataError("frame 3 is damaged")
        return original(self, scene)

    monkeypatch.setattr(Painter, "paint", fail_at_three)
    with pytest.raises(DataError):
        animate(swirl, target)
    names = [path.name for path in tmp_path.iterdir()]
    assert names == ["old.mp4"]
    assert target.read_bytes() == b"old"


def test_ffmpeg_that_fails_is_reported(tmp_path: Path) -> None:
    """An option that ffmpeg refuses becomes an error of lagbench."""
    frame = np.zeros((16, 16, 3), np.uint8)
    path = tmp_path / "film.mp4"
    coding = ["-no_such_option", "1"]
    with (
        pytest.raises(WorkFailedError) as caught,
        encode_mp4(path, size=(16, 16), rate=30.0, coding=coding) as write,
    ):
        write(frame)
    assert caught.value.where == str(tmp_path)


def test_a_film_that_cannot_be_written_names_its_option(swirl: Path) -> None:
    """Where a file is in the way, the fix is the option that names the film."""
    with pytest.raises(WorkFailedError) as caught:
        animate(swirl, swirl / "x.gif", every=5)
    assert "--output" in str(caught.value.fix)


@pytest.mark.parametrize("kind", ["streamlines", "sped"])
def test_unknown_kinds_are_refused(swirl: Path, tmp_path: Path, kind: str) -> None:
    """The error names the option, and nothing is written."""
    with pytest.raises(UsageError) as caught:
        animate(swirl, tmp_path / "x.mp4", kind=kind)
    assert caught.value.where == "--kind"
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "options",
    [
        {"frames_per_second": 0},
        {"frames_per_second": float("nan")},
        {"frames_per_second": float("inf")},
        {"frames_per_second": 1e-9},
        {"every": 0},
        {"every": 1.5},
        {"every": 2.0},
    ],
)
def test_rates_and_steps_out_of_range_are_refused(
    swirl: Path, tmp_path: Path, options: dict[str, Any]
) -> None:
    """The error names the options, and nothing is written."""
    with pytest.raises(UsageError) as caught:
        animate(swirl, tmp_path / "x.mp4", **options)
    assert caught.value.where == "--fps, --every"
    assert not list(tmp_path.iterdir())


def test_frames_at_rest_do_not_set_the_colour_scale(
    swirl: Path, tmp_path: Path
) -> None:
    """A film that begins at rest has the colours of one that moves all the time."""
    with xarray.open_dataset(swirl, decode_times=False) as file:
        moving = file.load()
    resting = moving.copy(deep=True)
    resting["velocity"][:2] = 0.0
    resting["position"][:2] = resting["position"][0].values
    last_frames = []
    for name, scenario in (("moving", moving), ("resting", resting)):
        path = tmp_path / f"{name}.gif"
        animate(scenario, path, kind=Panel.SPEED)
        with GifImageFile(path) as film:
            film.seek(film.n_frames - 1)
            last_frames.append(np.asarray(film.convert("RGB")))
    assert_array_equal(*last_frames)
