"""Animations: pixels where particles are, right lengths and sizes, whole files or
none.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import imageio_ffmpeg
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray
from PIL import ImageSequence
from PIL.GifImagePlugin import GifImageFile
from swirls import OMEGA, write_swirl

from lagbench.errors import DataError, UsageError, WorkFailedError
from lagbench.figures import animate as animation
from lagbench.figures import colours
from lagbench.figures.animate import animate
from lagbench.figures.encoders import encode_mp4
from lagbench.figures.painter import Painter, halve, pack, unpack
from lagbench.figures.panels import Panel
from lagbench.figures.recording import Scene, open_recording

SIDE = animation.SIDE + 2 * animation.MARGIN


@pytest.fixture(scope="module")
def swirl(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scenario of eight frames."""
    return write_swirl(tmp_path_factory.mktemp("root"), frames=8)


@given(
    hnp.arrays(
        np.uint8,
        hnp.array_shapes(min_dims=2, max_dims=2, max_side=5).map(lambda s: (*s, 3)),
    )
)
def test_packing_keeps_every_pixel(pixels: NDArray[np.uint8]) -> None:
    """Unpack is the inverse of pack."""
    np.testing.assert_array_equal(unpack(pack(pixels)), pixels)


@given(hnp.arrays(np.uint8, st.integers(1, 4).map(lambda n: (2 * n, 2 * n, 3))))
def test_halving_takes_the_mean_of_four(pixels: NDArray[np.uint8]) -> None:
    """Each colour of each pixel is the mean of four, at most 1.5 below for the two
    roundings.
    """
    n = len(pixels) // 2
    exact = pixels.reshape(n, 2, n, 2, 3).mean(axis=(1, 3))
    short = exact - unpack(halve(pack(pixels)))
    assert short.min() >= 0.0
    assert short.max() < 1.5


def paint(path: Path, panel: Panel, frame: int, side: int = 128) -> NDArray[np.uint8]:
    """Paint one panel of a scenario."""
    with open_recording(path) as recording:
        painter = Painter(recording, panel, side=side, limit=2.0 * OMEGA)
        return unpack(painter.paint(recording.scene(frame)))


def test_dots_lie_where_the_particles_are(swirl: Path) -> None:
    """A disc of radius 0.4 is coloured inside, paper outside, and its box has walls."""
    image = paint(swirl, Panel.MATERIAL, 0)
    blue = (image == colours.parse_rgb(colours.MATERIAL_COLOURS[0])).all(axis=-1)
    y, x = np.mgrid[0:128, 0:128] / 128.0 - 0.5
    radius = np.hypot(x, y)
    assert blue[radius < 0.35].mean() > 0.9
    assert not blue[radius > 0.44].any()
    assert tuple(image[64, 1]) == tuple(colours.parse_rgb(colours.WALL))
    assert tuple(image[1, 20]) == tuple(colours.parse_rgb(colours.MOVING))


def test_the_first_row_is_the_top_of_the_box(tmp_path: Path) -> None:
    """Materials by particle number: the sunflower's last points lie on the rim, the
    first in the middle.
    """
    path = write_swirl(tmp_path, "multimaterial", 0, walls=None, materials=2)
    image = paint(path, Panel.MATERIAL, 0)
    assert tuple(image[64, 64]) == tuple(colours.parse_rgb(colours.MATERIAL_COLOURS[0]))
    # 0.35 above the middle: the second material
    rim = image[64 - int(0.35 * 128), 60:68]
    assert (rim == colours.parse_rgb(colours.MATERIAL_COLOURS[1])).all(axis=-1).any()


def test_vorticity_of_a_rotating_disc_is_red_inside(swirl: Path) -> None:
    """Counter-clockwise rotation is red and even; outside the disc there is paper."""
    image = paint(swirl, Panel.VORTICITY, 3).astype(int)
    middle = image[52:76, 52:76].reshape(-1, 3)  # clear of the rim on the 8 x 8 grid
    assert (middle[:, 0] > middle[:, 2] + 60).all()
    assert tuple(image[12, 115]) == tuple(colours.parse_rgb(colours.PAPER))


def test_speeds_are_symmetric_about_the_middle(swirl: Path) -> None:
    """A turning disc is dark in the middle and bright at the rim."""
    image = paint(swirl, Panel.SPEED, 2).astype(int)
    assert image[64, 64].sum() < image[64, 64 + 48].sum()


def test_mp4_has_every_frame_and_an_even_size(swirl: Path, tmp_path: Path) -> None:
    """Eight frames at 30 a second, even sides; no date, so that the same frames give
    the same bytes.
    """
    first, second = (animate(swirl, tmp_path / name) for name in ("a.mp4", "b.mp4"))
    frames, seconds = imageio_ffmpeg.count_frames_and_secs(first)
    assert (frames, seconds) == (8, pytest.approx(8 / 30, abs=0.02))
    meta = next(imageio_ffmpeg.read_frames(first))
    assert meta["size"] == (SIDE, animation.TOP + animation.SIDE + animation.BOTTOM)
    assert all(length % 2 == 0 for length in meta["size"])
    assert first.read_bytes() == second.read_bytes()


def test_two_scenarios_side_by_side_end_with_the_shorter(
    swirl: Path, tmp_path: Path
) -> None:
    """The picture is wider by a panel and a gap and has as many frames as the shorter
    scenario.
    """
    shorter = write_swirl(tmp_path, scenario=3, frames=5)
    path = animate(swirl, tmp_path / "pair.gif", beside=shorter)
    with GifImageFile(path) as image:
        assert image.n_frames == 5
        assert image.size[0] == SIDE + animation.GAP + animation.SIDE


def test_gif_repeats_and_has_the_same_bytes_twice(
    swirl: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Frames differ, all keep the exact white of the paper, the loop never ends;
    nothing is logged.
    """
    options: dict[str, Any] = {"every": 3, "frames_per_second": 10}
    first, second = (
        animate(swirl, tmp_path / name, **options) for name in ("a.gif", "b.gif")
    )
    assert capfd.readouterr() == ("", "")
    assert first.read_bytes() == second.read_bytes()
    with GifImageFile(first) as image:
        assert (image.n_frames, image.info["loop"], image.info["duration"]) == (
            3,
            0,
            100,
        )
        frames = [
            np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(image)
        ]
    assert all(tuple(frame[-1, -1]) == (255, 255, 255) for frame in frames)
    assert (frames[0] != frames[2]).any()


def test_an_error_leaves_no_file(
    swirl: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A painter that fails half-way leaves the target as it was and no temporary
    file.
    """
    target = tmp_path / "old.mp4"
    target.write_bytes(b"old")
    original = Painter.paint

    def fails_at_three(self: Painter, scene: Scene) -> object:
        if scene.frame == 3:
            raise DataError("frame 3 is damaged")
        return original(self, scene)

    monkeypatch.setattr(Painter, "paint", fails_at_three)
    with pytest.raises(DataError, match="frame 3"):
        animate(swirl, target)
    assert [path.name for path in tmp_path.iterdir()] == ["old.mp4"]
    assert target.read_bytes() == b"old"


def test_ffmpeg_that_fails_is_reported(
    swirl: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What ffmpeg refuses becomes an error of lagbench, and no file is left."""
    monkeypatch.setattr(animation, "_CODING", ["-no_such_option", "1"])
    with pytest.raises(WorkFailedError, match="encode"):
        animate(swirl, tmp_path / "x.mp4")
    assert not list(tmp_path.iterdir())


def test_a_film_that_cannot_be_written_names_its_option(swirl: Path) -> None:
    """Where a file is in the way, the remedy is the option that names the film."""
    with pytest.raises(WorkFailedError) as told:
        animate(swirl, swirl / "x.gif", every=5)
    assert "--output" in str(told.value.fix)


@pytest.mark.parametrize(
    "options",
    [
        *({"kind": kind} for kind in ("streamlines", "sped")),
        *(
            {"frames_per_second": rate}
            for rate in (0, float("nan"), float("inf"), 1e-9)
        ),
        *({"every": step} for step in (0, 1.5, 2.0)),
    ],
)
def test_bad_options_are_refused(
    swirl: Path, tmp_path: Path, options: dict[str, object]
) -> None:
    """The error names the option, and nothing is written."""
    with pytest.raises(UsageError) as error:
        animate(swirl, tmp_path / "x.mp4", **options)  # type: ignore[arg-type]
    assert str(error.value.where) == (
        "--kind" if "kind" in options else "--fps, --every"
    )
    assert not list(tmp_path.iterdir())
