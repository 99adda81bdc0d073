"""Pictures: right fields, right colours, small and deterministic files, clear
refusals.
"""

from __future__ import annotations

import math
import struct
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from exchange_readers import straight_runs
from matplotlib.figure import Figure
from matplotlib.text import Text
from numpy.typing import NDArray
from PIL import Image
from swirls import OMEGA, TOP_TO_THE_RIGHT, write_swirl

from lagbench import errors
from lagbench.errors import DataError, UsageError, WorkFailedError
from lagbench.exchange import adopt
from lagbench.figures import colours
from lagbench.figures.canvas import (
    build_palette,
    build_speed_map,
    build_vorticity_map,
    figure,
    pixels_of,
)
from lagbench.figures.panels import Panel, draw_walls, limit_of
from lagbench.figures.plot import KINDS, contact_sheet, describe, plot_frame
from lagbench.figures.recording import open_recording
from lagbench.store.dataset import open_split


@pytest.fixture(scope="module")
def swirl(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One cavity scenario whose top wall moves to the right."""
    return write_swirl(tmp_path_factory.mktemp("root"))


def pixels(path: Path) -> NDArray[np.uint8]:
    """Return a picture as RGB bytes."""
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"))


def test_every_kind_of_picture_is_small_and_has_the_same_bytes_twice(
    swirl: Path, tmp_path: Path
) -> None:
    """PNGs hold no date or software, fit a repository and repeat to the byte; no two
    kinds are the same.
    """
    drawn = set()
    for kind in KINDS:
        data, again = (
            plot_frame(swirl, 2, tmp_path / n, kind=kind).read_bytes()
            for n in ("a.png", "b.png")
        )
        assert data == again
        assert len(data) < 300_000
        at = 8
        chunks = set()  # behind the head: length, type, content and sum of each chunk
        while at < len(data):
            length, chunk = struct.unpack_from(">I4s", data, at)
            chunks.add(chunk)
            at += 12 + length
        assert chunks == {b"IHDR", b"PLTE", b"IDAT", b"IEND"}
        drawn.add(data)
    assert len(drawn) == len(KINDS)


def test_a_data_set_draws_what_its_file_draws(swirl: Path, tmp_path: Path) -> None:
    """A path and the xarray.Dataset opened from it give one picture; one of several
    scenarios is chosen.
    """
    from_file = plot_frame(swirl, -1, tmp_path / "file.png")
    with xr.open_dataset(swirl) as data:
        from_data = plot_frame(data, 5, tmp_path / "data.png")
        with pytest.raises(UsageError, match="one scenario") as caught:
            plot_frame(data.expand_dims(scenario=[0]), 0, tmp_path / "x.png")
    assert from_file.read_bytes() == from_data.read_bytes()
    assert "sel(scenario" in str(caught.value)


def test_a_scenario_of_an_opened_split_draws_what_its_file_draws(
    tmp_path: Path,
) -> None:
    """Padding of the shorter of two scenarios is not drawn: its last frame is its
    own.
    """
    for scenario, frames in ((0, 4), (1, 6)):
        write_swirl(
            tmp_path,
            "fluid",
            scenario,
            frames=frames,
            walls=None,
            parameters={"family": "disc"},
        )
    with open_split("fluid", subset="train", size="tiny", root=tmp_path) as split:
        from_split = plot_frame(split.sel(scenario=0), -1, tmp_path / "split.png")
    from_file = plot_frame(
        tmp_path / "fluid/tiny/v2/train/0000.nc", 3, tmp_path / "file.png"
    )
    assert from_split.read_bytes() == from_file.read_bytes()


CUTS = {
    "late": slice(1, None),
    "strided": slice(None, None, 2),
    "short": slice(0, 3),
    "one": 2,
}


@pytest.mark.parametrize("cut", CUTS)
def test_a_data_set_cut_in_frames_is_refused(tmp_path: Path, cut: str) -> None:
    """Whether frames are missing before, between or behind those that are left: they
    are called by place.
    """
    for scenario in (0, 1):
        write_swirl(
            tmp_path, "fluid", scenario, walls=None, parameters={"family": "disc"}
        )
    with open_split("fluid", subset="train", size="tiny", root=tmp_path) as data:
        less = data.isel(scenario=0, frame=CUTS[cut])
        with pytest.raises(UsageError) as caught:
            plot_frame(less, 0, tmp_path / "x.png")
    assert caught.value.where == "coordinate frame"


def test_a_scenario_of_a_local_split_is_drawn_with_its_own_grid(tmp_path: Path) -> None:
    """An opened split, and a data set of one of its files, know the split that stands
    beside them.
    """
    np.save(tmp_path / "runs.npy", np.stack(straight_runs(3)))
    made = adopt(
        tmp_path / "runs.npy", output=tmp_path / "mine", radius=0.1, frame_interval=0.25
    )
    file = made.folder / "full/v1/test/0002.nc"
    from_file = plot_frame(file, 3, tmp_path / "file.png").read_bytes()
    with open_split(str(made.folder)) as split, xr.open_dataset(file) as data:
        for source in (split.isel(scenario=0), data):
            assert (
                plot_frame(source, 3, tmp_path / "data.png").read_bytes() == from_file
            )


def test_fields_of_solid_body_rotation(swirl: Path) -> None:
    """Vorticity is twice the angular velocity, per frame on the grid, else per second,
    at frame 0 and later.

    The scale of its colours is in that unit too.
    """
    with open_recording(swirl) as recording:
        assert recording.area == pytest.approx(np.pi * 0.4**2)
        for frame in (0, 3):
            scene = recording.scene(frame)
            # clear of the rim on the 8 x 8 grid
            middle = scene.fields.vorticity[3:5, 3:5]
            np.testing.assert_allclose(middle, 2.0 * OMEGA, rtol=0.02)
            per_second = 2.0 * OMEGA / recording.size.frame_interval
            np.testing.assert_allclose(scene.vorticity[3:5, 3:5], per_second, rtol=0.02)
            held = np.abs(scene.vorticity[scene.fields.differentiable])
            assert limit_of(Panel.VORTICITY, scene) == pytest.approx(
                np.percentile(held, 99.0)
            )


@pytest.mark.parametrize("split", ["cavity", "multimaterial"])
def test_a_figure_has_one_unit_of_time(
    split: str, swirl: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Colour bars are in seconds, as the files' velocity is; so is the number at a
    moving wall.
    """
    said: list[str] = []

    def look(drawn: Figure, output: Path) -> Path:
        texts = [text.get_text() for text in drawn.findobj(Text)]
        said.extend(
            text
            for text in texts
            if "/s" in text or "frame]" in text or "/frame" in text
        )
        return output

    monkeypatch.setattr("lagbench.figures.plot.save", look)
    source = (
        swirl
        if split == "cavity"
        else write_swirl(tmp_path, split, materials=3, walls=None)
    )
    plot_frame(source, 2, tmp_path / "all.png", kind="all")
    units = [text.partition("[")[2].rstrip("]") for text in said if "[" in text]
    assert sorted(units) == ["1/s", *["length/s"] * (2 if split == "cavity" else 1)]
    assert not any("/frame" in text for text in said)


def test_the_scale_of_speeds_leaves_out_the_extreme_per_cent(swirl: Path) -> None:
    """Speeds of a disc are OMEGA r: 99 of 100 particles are within r = 0.4
    sqrt(0.99).
    """
    with open_recording(swirl) as recording:
        scene = recording.scene(1)
        expected = OMEGA / recording.size.frame_interval * 0.4 * np.sqrt(0.99)
        assert limit_of(Panel.SPEED, scene) == pytest.approx(expected, rel=1e-3)


def test_dpi_scales_a_picture(swirl: Path, tmp_path: Path) -> None:
    """Twice the pixels per inch are twice the pixels a side."""
    one, two = (
        plot_frame(swirl, 0, tmp_path / f"{dpi}.png", dpi=dpi) for dpi in (64, 128)
    )
    with Image.open(one) as small, Image.open(two) as large:
        assert large.size == pytest.approx((2 * small.width, 2 * small.height), abs=1)


@pytest.mark.parametrize("dpi", [0, -1, math.nan, 1e6, "128"])
def test_pixels_per_inch_out_of_range_are_refused(
    swirl: Path, tmp_path: Path, dpi: Any
) -> None:
    """The error names the option, and nothing is written, of a frame or of a sheet."""
    with pytest.raises(UsageError) as one:
        plot_frame(swirl, 0, tmp_path / "x.png", dpi=dpi)
    with pytest.raises(UsageError) as many:
        contact_sheet(
            "cavity", "tiny", tmp_path / "x.png", root=swirl.parents[4], dpi=dpi
        )
    assert one.value.where == many.value.where == "--dpi"
    assert not list(tmp_path.iterdir())


def test_captions_say_what_sets_a_scenario_apart(swirl: Path, tmp_path: Path) -> None:
    """Reynolds number, family or frequency stand beside split, size and id."""
    with open_recording(swirl) as recording:
        assert describe(recording) == "cavity tiny  ·  scenario 0  ·  Re 100"
    splash = write_swirl(
        tmp_path, "fluid", 3, walls=None, parameters={"family": "splash"}
    )
    with open_recording(splash) as recording:
        assert describe(recording) == "fluid tiny  ·  scenario 3  ·  family splash"


def test_a_frame_counts_from_the_end_or_is_refused(swirl: Path, tmp_path: Path) -> None:
    """Frame -1 is the last; for floats, not NumPy's integers, and beyond the ends the
    range is named.
    """
    with open_recording(swirl) as recording:
        assert [recording.scene(frame).frame for frame in (-1, np.int64(1))] == [5, 1]
    for frame, words in (
        (6, "no frame 6"),
        (-7, "no frame -7"),
        (1.0, "a whole number"),
    ):
        with pytest.raises(UsageError, match=words) as caught:
            plot_frame(swirl, frame, tmp_path / "x.png")  # type: ignore[arg-type]
        assert (caught.value.where, caught.value.expected) == ("scenario 0", "0 to 5")
    assert not (tmp_path / "x.png").exists()


def test_moving_walls_are_marked_and_point_where_they_slide(tmp_path: Path) -> None:
    """The moving wall is vermilion, the others grey; reversed walls draw the mirror
    image.
    """
    drawn = {}
    for name, walls in (("right", TOP_TO_THE_RIGHT), ("left", -TOP_TO_THE_RIGHT)):
        path = write_swirl(tmp_path / name, walls=walls)
        with open_recording(path) as recording, figure(2.0, 2.0) as page:
            draw_walls(page.add_axes((0, 0, 1, 1)), recording, 0)
            drawn[name] = pixels_of(page)
    right = drawn["right"].astype(int)
    left = drawn["left"]
    side = len(drawn["right"])
    band = int(0.025 * side)  # middle of the wall of tiny, which is 0.05 wide
    assert tuple(right[band, int(0.2 * side)]) == tuple(colours.parse_rgb(colours.MOVING))
    assert tuple(right[-band, side // 2]) == tuple(colours.parse_rgb(colours.WALL))
    assert tuple(right[side // 2, side // 2]) == tuple(colours.parse_rgb(colours.PAPER))
    assert np.abs(right[:, ::-1] - left).mean() < 0.2 * np.abs(right - left).mean()


@pytest.mark.parametrize(("ending", "head"), [("pdf", b"%PDF"), ("svg", b"<?xml")])
def test_vector_pictures_have_the_same_bytes_twice(
    swirl: Path, tmp_path: Path, ending: str, head: bytes
) -> None:
    """PDF and SVG hold no date."""
    first, second = (
        plot_frame(swirl, 0, tmp_path / f"{n}.{ending}").read_bytes() for n in "ab"
    )
    assert first == second
    assert first.startswith(head)


def test_a_picture_that_cannot_be_written_names_its_option(
    swirl: Path, tmp_path: Path
) -> None:
    """Another ending is refused; where a file is in the way, the remedy is the option
    that names it.
    """
    with pytest.raises(UsageError):
        plot_frame(swirl, 0, tmp_path / "x.jpg")
    assert not list(tmp_path.iterdir())
    with pytest.raises(WorkFailedError) as told:
        plot_frame(swirl, 0, swirl / "x.png")
    assert "--output" in str(told.value.fix)


def test_without_matplotlib_the_extra_is_named(
    swirl: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The message holds the command that installs what is missing."""
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(UsageError, match="matplotlib is not installed") as caught:
        plot_frame(swirl, 0, tmp_path / "x.png")
    assert "pip install 'lagbench[plots]'" in str(caught.value)


def test_a_broken_dependency_is_not_called_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An import that fails inside an installed module shows its own error."""
    (tmp_path / "broken_extra.py").write_text("import no_such_module_at_all\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ModuleNotFoundError, match="no_such_module_at_all"):
        errors.require("broken_extra", extra="plots")


def test_sheet_of_driven_scenarios(tmp_path: Path) -> None:
    """A sheet has a panel per scenario: more scenarios, a wider page with another
    picture.
    """
    write_swirl(tmp_path, scenario=0)
    one = pixels(
        contact_sheet("cavity", "tiny", tmp_path / "one.png", root=tmp_path, frame=2)
    )
    for scenario in (1, 2, 3, 4):
        write_swirl(tmp_path, scenario=scenario)
    path = contact_sheet(
        "cavity", "tiny", tmp_path / "five.png", root=tmp_path, frame=2
    )
    five = pixels(path)
    assert five.shape[1] > one.shape[1]
    again = contact_sheet(
        "cavity", "tiny", tmp_path / "again.png", root=tmp_path, frame=2
    )
    assert again.read_bytes() == path.read_bytes()
    # each of the five panels shows the orange of its moving top wall
    orange = (five == colours.parse_rgb(colours.MOVING)).all(axis=-1).any(axis=0)
    assert np.count_nonzero(np.diff(orange.astype(int)) == 1) >= 5


def test_sheet_of_families_has_a_row_for_each(tmp_path: Path) -> None:
    """Scenarios of one family share a row, families over time lie below each other."""
    heights = []
    for scenario, family in enumerate(["circle", "circle", "splash"]):
        write_swirl(
            tmp_path, "fluid", scenario, walls=None, parameters={"family": family}
        )
        heights.append(
            pixels(
                contact_sheet("fluid", "tiny", tmp_path / "s.png", root=tmp_path)
            ).shape[0]
        )
    assert heights[0] == heights[1] < heights[2]


def test_sheet_of_materials_shows_their_colours(tmp_path: Path) -> None:
    """Pairs of materials are coloured by material, each colour as the key has it."""
    write_swirl(
        tmp_path,
        "multimaterial",
        0,
        walls=None,
        materials=3,
        parameters={"pair": "made-up"},
    )
    image = pixels(
        contact_sheet("multimaterial", "tiny", tmp_path / "s.png", root=tmp_path)
    )
    for material, colour in enumerate(colours.MATERIAL_COLOURS):
        assert (image == colours.parse_rgb(colour)).all(axis=-1).any() == (material < 3)


def test_sheet_of_nothing_names_the_command(tmp_path: Path) -> None:
    """Without scenarios the message says how to make them; unknown names get the
    nearest one.
    """
    with pytest.raises(DataError, match="nothing to draw") as caught:
        contact_sheet("cavity", "tiny", tmp_path / "s.png", root=tmp_path)
    assert "lagbench generate --split cavity --size tiny" in str(caught.value)
    with pytest.raises(UsageError, match="did you mean 'cavity'"):
        contact_sheet("cavty", "tiny", tmp_path / "s.png", root=tmp_path)


def test_all_that_is_drawn_is_in_the_palette() -> None:
    """Every level of both maps and every flat colour keeps its exact value in a
    file.
    """
    table = {tuple(colour) for colour in build_palette().tolist()}
    assert build_palette().shape == (256, 3)
    flat = (
        colours.PAPER,
        colours.INK,
        colours.MUTED,
        colours.WALL,
        colours.MOVING,
        *colours.MATERIAL_COLOURS,
    )
    assert {tuple(colours.parse_rgb(colour).tolist()) for colour in flat} <= table
    for levels in (build_speed_map(), build_vorticity_map()):
        drawn = (np.asarray(levels.colors)[:, :3] * 255.0).round().astype(int)
        assert {tuple(colour) for colour in drawn.tolist()} <= table
