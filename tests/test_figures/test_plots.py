"""Pictures: right fields, right colours, small files with equal bytes, refusals."""

from __future__ import annotations

import math
import struct
import sys
from pathlib import Path
from typing import Any

import h5py
import matplotlib
import numpy as np
import pytest
import xarray as xr
from exchange_readers import straight_runs
from matplotlib.figure import Figure
from matplotlib.text import Text
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from PIL import Image
from rotating_disc import OMEGA, TOP_TO_THE_RIGHT, write_swirl

from lagbench import errors
from lagbench.errors import (
    DataError,
    UnreadableFileError,
    UsageError,
    WorkFailedError,
)
from lagbench.exchange import adopt
from lagbench.figures.canvas import (
    build_palette,
    build_speed_map,
    build_vorticity_map,
    figure,
    pixels_of,
)
from lagbench.figures.colours import (
    INK,
    MATERIAL_COLOURS,
    MOVING,
    MUTED,
    PAPER,
    WALL,
    parse_rgb,
)
from lagbench.figures.panels import (
    VIEWS,
    Panel,
    draw,
    draw_walls,
    limit_of,
    median_limit,
    strongest_limit,
)
from lagbench.figures.pictures import animate, plot
from lagbench.figures.plot import KINDS, contact_sheet, describe, plot_frame
from lagbench.figures.recording import open_recording
from lagbench.store.dataset import open_split

Pixels = NDArray[np.uint8]


@pytest.fixture(scope="module")
def swirl(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One cavity scenario whose top wall moves to the right."""
    return write_swirl(tmp_path_factory.mktemp("root"))


def read_pixels(path: Path) -> Pixels:
    """Return a picture as RGB bytes."""
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"))


def has_colour(pixels: Pixels, colour: str) -> NDArray[np.bool_]:
    """Return which pixels have a colour."""
    colour_of_pixel = parse_rgb(colour)
    is_equal: NDArray[np.bool_] = (pixels == colour_of_pixel).all(axis=-1)
    return is_equal


def chunk_names(png: bytes) -> set[bytes]:
    """Return the types of the chunks of a PNG file."""
    names = set()
    start = 8  # behind the signature
    while start < len(png):
        length, name = struct.unpack_from(">I4s", png, start)
        names.add(name)
        start += 12 + length
    return names


@pytest.mark.slow
def test_every_kind_of_picture_is_small_and_has_the_same_bytes_twice(
    swirl: Path, tmp_path: Path
) -> None:
    """PNGs hold no date or software; no two kinds are the same."""
    pictures = set()
    kinds = [kind for kind in KINDS if kind not in VIEWS]
    for kind in kinds:
        first_path = plot_frame(swirl, 2, tmp_path / "first.png", kind=kind)
        second_path = plot_frame(swirl, 2, tmp_path / "second.png", kind=kind)
        first = first_path.read_bytes()
        assert first == second_path.read_bytes()
        assert len(first) < 300_000
        chunks = chunk_names(first)
        assert chunks == {b"IHDR", b"PLTE", b"IDAT", b"IEND"}
        pictures.add(first)
    assert len(pictures) == len(kinds)


@pytest.mark.slow
def test_a_data_set_draws_what_its_file_draws(swirl: Path, tmp_path: Path) -> None:
    """A data set of several scenarios is refused."""
    from_file = plot_frame(swirl, -1, tmp_path / "file.png")
    with xr.open_dataset(swirl) as data:
        from_data = plot_frame(data, 5, tmp_path / "data.png")
        several = data.expand_dims(scenario=[0])
        with pytest.raises(UsageError) as caught:
            plot_frame(several, 0, tmp_path / "x.png")
    assert from_file.read_bytes() == from_data.read_bytes()
    assert "sel(scenario" in str(caught.value.fix)


def test_a_scenario_of_an_opened_split_draws_what_its_file_draws(
    tmp_path: Path,
) -> None:
    """The padding of the shorter of two scenarios is not drawn."""
    frame_counts = {0: 4, 1: 6}
    for scenario, frame_count in frame_counts.items():
        write_swirl(
            tmp_path,
            "fluid",
            scenario,
            frames=frame_count,
            walls=None,
            parameters={"family": "disc"},
        )
    with open_split("fluid", subset="train", size="tiny", root=tmp_path) as split:
        shorter = split.sel(scenario=0)
        from_split = plot_frame(shorter, -1, tmp_path / "split.png", kind="vorticity")
    file = tmp_path / "fluid/tiny/v3/train/0000.nc"
    from_file = plot_frame(file, 3, tmp_path / "file.png", kind="vorticity")
    assert from_split.read_bytes() == from_file.read_bytes()


CUTS = {
    "late": slice(1, None),
    "strided": slice(None, None, 2),
    "short": slice(0, 3),
    "one": 2,
}


def test_a_picture_of_a_file_elsewhere_has_the_name_of_the_file(
    swirl: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A folder that begins with v is not yet a version of a data set."""
    folder = tmp_path / "study" / "vortices" / "first"
    folder.mkdir(parents=True)
    (folder / "own.nc").symlink_to(swirl)
    monkeypatch.chdir(tmp_path)
    picture = plot(folder / "own.nc", kind="speed", frame=2)
    assert picture == Path("own-frame2.png")


def test_paths_of_pictures_may_begin_with_the_home_folder(
    swirl: Path, home_folder: Path
) -> None:
    """Those of files that are read, too; a damaged one is still the user's file."""
    (home_folder / "own.nc").symlink_to(swirl)
    (home_folder / "text.nc").write_text("no netCDF")
    picture = plot("~/own.nc", kind="speed", output="~/picture.png")
    assert picture == home_folder / "picture.png"
    assert picture.read_bytes()[:4] == b"\x89PNG"
    film = animate(
        Path("~/own.nc"), beside="~/own.nc", every=3, output=Path("~/film.gif")
    )
    assert film == home_folder / "film.gif"
    assert film.read_bytes()[:3] == b"GIF"
    with pytest.raises(UsageError) as caught:
        plot("~/own.nc", output="~/picture.png")
    assert str(picture) in str(caught.value.got)
    with pytest.raises(UsageError):
        plot("~/own.nc", output="~no-such-user/picture.png")
    for make_picture in (plot, animate):
        with pytest.raises(UnreadableFileError):
            make_picture("~/text.nc")


@pytest.mark.parametrize("cut", CUTS)
def test_a_data_set_cut_in_frames_is_refused(tmp_path: Path, cut: str) -> None:
    """Frames may be missing before, between or behind those that are left."""
    for scenario in (0, 1):
        write_swirl(
            tmp_path,
            "fluid",
            scenario,
            walls=None,
            parameters={"family": "disc"},
        )
    with open_split("fluid", subset="train", size="tiny", root=tmp_path) as data:
        part = data.isel(scenario=0, frame=CUTS[cut])
        with pytest.raises(UsageError) as caught:
            plot_frame(part, 0, tmp_path / "x.png")
    assert caught.value.where == "coordinate frame"


def adopt_straight_runs(folder: Path) -> Path:
    """Return a new local split ``mine`` in a folder; scenario 2 is its test."""
    runs = folder / "runs.npy"
    np.save(runs, np.stack(straight_runs(3)))
    adopted = adopt(
        runs,
        output=folder / "mine",
        radius=0.1,
        frame_interval=0.25,
    )
    return adopted.folder


def test_a_scenario_of_a_local_split_is_drawn_with_its_own_grid(tmp_path: Path) -> None:
    """An opened split and one of its files know the split that stands beside them."""
    folder = adopt_straight_runs(tmp_path)
    file = folder / "full/v1/test/0002.nc"
    from_file = plot_frame(file, 3, tmp_path / "file.png", kind="vorticity")
    expected = from_file.read_bytes()
    with open_split(str(folder)) as split, xr.open_dataset(file) as data:
        of_split = split.isel(scenario=0)
        for source in (of_split, data):
            picture = plot_frame(source, 3, tmp_path / "data.png", kind="vorticity")
            assert picture.read_bytes() == expected


@pytest.mark.parametrize("material", [-1, 77])
def test_a_material_that_is_none_is_refused(tmp_path: Path, material: int) -> None:
    """In a file and in a data set."""
    file = write_swirl(tmp_path)
    with h5py.File(file, "r+") as opened:
        opened["material"][0] = material
    with pytest.raises(DataError) as caught:
        plot_frame(file, 0, tmp_path / "x.png")
    assert str(file) in str(caught.value.where)
    with xr.open_dataset(file) as data, pytest.raises(DataError):
        plot_frame(data, 0, tmp_path / "x.png")


def test_a_damaged_file_of_a_named_split_is_damage_of_the_data_set(
    tmp_path: Path,
) -> None:
    """However the split is named; only a file that is named itself is unreadable."""
    folder = adopt_straight_runs(tmp_path)
    file = folder / "full/v1/test/0002.nc"
    file.write_bytes(file.read_bytes()[:2000])
    picture = tmp_path / "x.png"
    for source, root in ((folder, None), ("mine", tmp_path)):
        with pytest.raises(DataError):
            plot(source, root=root, output=picture)
    with pytest.raises(DataError):
        animate(folder, output=tmp_path / "x.gif", quiet=True)
    with pytest.raises(UnreadableFileError):
        plot(file, output=picture)


@pytest.mark.parametrize("frame", [0, 3])
def test_vorticity_of_solid_body_rotation(swirl: Path, frame: int) -> None:
    """It is twice the angular velocity: per frame on the grid, else per second."""
    with open_recording(swirl) as recording:
        scene = recording.scene(frame)
        # clear of the rim on the 8 x 8 grid
        per_frame = scene.fields.vorticity[3:5, 3:5]
        assert_allclose(per_frame, 2.0 * OMEGA, rtol=0.02)
        per_second = scene.vorticity[3:5, 3:5]
        expected = 2.0 * OMEGA / recording.size.frame_interval
        assert_allclose(per_second, expected, rtol=0.02)

        # the scale of its colours is in that unit too
        is_drawn = scene.fields.differentiable
        magnitudes = np.abs(scene.vorticity[is_drawn])
        expected = np.percentile(magnitudes, 99.0)
        limit = limit_of(Panel.VORTICITY, scene)
        assert limit == pytest.approx(expected)


def test_area_is_that_of_the_material(swirl: Path) -> None:
    """The disc has radius 0.4."""
    with open_recording(swirl) as recording:
        assert recording.area == pytest.approx(np.pi * 0.4**2)


@pytest.mark.parametrize(
    ("split", "units"),
    [
        ("cavity", ["1/s", "length/s", "length/s"]),
        ("multimaterial", ["1/s", "length/s"]),
    ],
)
def test_a_figure_has_one_unit_of_time(
    split: str,
    units: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Colour bars are in seconds, and so is the number at a moving wall."""
    texts: list[str] = []

    def collect(drawn: Figure, output: Path, *, option: str) -> Path:
        assert option == "--output"
        for text in drawn.findobj(Text):
            texts.append(text.get_text())
        return output

    monkeypatch.setattr("lagbench.figures.plot.save", collect)
    if split == "cavity":
        source = write_swirl(tmp_path)
    else:
        source = write_swirl(tmp_path, split, materials=3, walls=None)
    plot_frame(source, 2, tmp_path / "all.png", kind="all")
    drawn_units = []
    for text in texts:
        _, bracket, end = text.partition("[")
        if bracket:
            drawn_units.append(end.rstrip("]"))
    assert sorted(drawn_units) == units
    assert not any("/frame" in text for text in texts)


def test_the_scale_of_speeds_leaves_out_the_extreme_per_cent(swirl: Path) -> None:
    """Speeds of a disc are OMEGA r; 99 of 100 particles are within 0.4 sqrt(0.99)."""
    with open_recording(swirl) as recording:
        scene = recording.scene(1)
        angular_velocity = OMEGA / recording.size.frame_interval
        expected = angular_velocity * 0.4 * np.sqrt(0.99)
        limit = limit_of(Panel.SPEED, scene)
        assert limit == pytest.approx(expected, rel=1e-3)


def test_dpi_scales_a_picture(swirl: Path, tmp_path: Path) -> None:
    """Twice the pixels per inch are twice the pixels a side."""
    coarse_path = plot_frame(swirl, 0, tmp_path / "64.png", dpi=64, kind="vorticity")
    fine_path = plot_frame(swirl, 0, tmp_path / "128.png", dpi=128, kind="vorticity")
    height, width, _ = read_pixels(coarse_path).shape
    fine_height, fine_width, _ = read_pixels(fine_path).shape
    assert fine_height == pytest.approx(2 * height, abs=1)
    assert fine_width == pytest.approx(2 * width, abs=1)


@pytest.mark.parametrize("dpi", [0, -1, math.nan, 1e6, "128"])
def test_pixels_per_inch_out_of_range_are_refused(
    swirl: Path, tmp_path: Path, dpi: Any
) -> None:
    """The error names the option, and nothing is written, of a frame or of a sheet."""
    path = tmp_path / "x.png"
    root = swirl.parents[4]
    with pytest.raises(UsageError) as of_frame:
        plot_frame(swirl, 0, path, dpi=dpi)
    with pytest.raises(UsageError) as of_sheet:
        contact_sheet("cavity", "tiny", path, root=root, dpi=dpi)
    assert of_frame.value.where == "--dpi"
    assert of_sheet.value.where == "--dpi"
    assert not list(tmp_path.iterdir())


def test_captions_say_what_sets_a_scenario_apart(swirl: Path, tmp_path: Path) -> None:
    """Reynolds number, family or frequency stand beside split, size and id."""
    with open_recording(swirl) as recording:
        assert describe(recording) == "cavity tiny  ·  scenario 0  ·  Re 100"
    parameters = {"family": "splash"}
    splash = write_swirl(
        tmp_path,
        "fluid",
        3,
        walls=None,
        parameters=parameters,
    )
    with open_recording(splash) as recording:
        assert describe(recording) == "fluid tiny  ·  scenario 3  ·  family splash"


def build_uniform_flow(velocity: tuple[float, float], *, lattice: int) -> xr.Dataset:
    """Return decaying vortices without vortices: all particles have one velocity."""
    axis = (np.arange(lattice) + 0.5) / lattice
    x, y = np.meshgrid(axis, axis, indexing="ij")
    start = np.stack([x.ravel(), y.ravel()], axis=-1)
    step = np.array(velocity)
    frames = [(start + frame * step) % 1.0 for frame in range(3)]
    position = np.stack(frames).astype(np.float32)
    particle_count = len(start)
    return xr.Dataset(
        {
            "position": (("frame", "particle", "axis"), position),
            "material": ("particle", np.zeros(particle_count, np.int8)),
            "particle_mass": ((), 1e-4 / particle_count),
        },
        coords={"frame": np.arange(3)},
        attrs={"split": "decaying-vortices", "size": "tiny", "scenario": 3},
    )


def test_streamlines_of_a_periodic_box_reach_its_edges() -> None:
    """The field goes on beyond an edge of the box, so no line ends there."""
    data = build_uniform_flow((0.01, 0.004), lattice=40)
    with open_recording(data) as recording:
        scene = recording.scene(1)
        spacing = scene.fields.grid.spacing
    with figure(3, 3) as drawn:
        axes = drawn.add_axes((0, 0, 1, 1))
        draw(axes, Panel.STREAMLINES, scene, limit=1.0)
        (lines,) = axes.collections
        points = np.concatenate([path.vertices for path in lines.get_paths()])
        shown_low, shown_high = axes.get_xlim()
    assert spacing == pytest.approx(0.1)
    assert_allclose((shown_low, shown_high), (0.0, 1.0))
    for axis in range(2):
        assert points[:, axis].min() <= 0.0
        assert points[:, axis].max() >= 1.0


def test_streamlines_between_walls_stay_between_them(swirl: Path) -> None:
    """What lies beyond a wall is no fluid."""
    with open_recording(swirl) as recording:
        scene = recording.scene(1)
    with figure(3, 3) as drawn:
        axes = drawn.add_axes((0, 0, 1, 1))
        draw(axes, Panel.STREAMLINES, scene, limit=1.0)
        (lines,) = axes.collections
        points = np.concatenate([path.vertices for path in lines.get_paths()])
    assert points.min() >= 0.0
    assert points.max() <= 1.0


@pytest.mark.parametrize(
    ("kind", "frequency", "expected"),
    [("rings", 0, "vortex rings"), ("noise", 2, "frequency 2")],
)
def test_a_caption_names_vortex_rings_which_have_no_frequency(
    tmp_path: Path, kind: str, frequency: int, expected: str
) -> None:
    """Their files state the frequency 0."""
    parameters = {"kind": kind, "frequency": frequency}
    path = write_swirl(tmp_path, "curl-noise", 3, walls=None, parameters=parameters)
    with open_recording(path) as recording:
        assert describe(recording) == f"curl-noise tiny  ·  scenario 3  ·  {expected}"


def test_a_frame_counts_from_the_end(swirl: Path) -> None:
    """Frame -1 is the last; integers of NumPy are frame numbers too."""
    with open_recording(swirl) as recording:
        assert recording.scene(-1).frame == 5
        assert recording.scene(-6).frame == 0
        assert recording.scene(np.int64(1)).frame == 1


@pytest.mark.parametrize("frame", [6, -7, 1.0])
def test_a_frame_that_does_not_exist_is_refused(
    swirl: Path, tmp_path: Path, frame: Any
) -> None:
    """The error names the range of frames, for numbers beyond it and for floats."""
    with pytest.raises(UsageError) as caught:
        plot_frame(swirl, frame, tmp_path / "x.png")
    assert caught.value.where == "scenario 0"
    assert caught.value.expected == "0 to 5, or -6 to -1"
    assert not (tmp_path / "x.png").exists()


def test_one_frame_without_velocities_is_refused(swirl: Path, tmp_path: Path) -> None:
    """Nothing says how its particles move. With velocities it is drawn."""
    path = tmp_path / "x.png"
    with xr.open_dataset(swirl) as data:
        first_frame = data.isel(frame=[0])
        plot_frame(first_frame, 0, tmp_path / "first.png")
        with pytest.raises(UsageError) as caught:
            plot_frame(first_frame.drop_vars("velocity"), 0, path)
    assert caught.value.where == "scenario 0"
    assert caught.value.fix
    assert not path.exists()


@pytest.mark.parametrize("name", ["position", "material", "particle_mass"])
def test_a_data_set_without_a_variable_is_refused(
    swirl: Path, tmp_path: Path, name: str
) -> None:
    path = tmp_path / "x.png"
    with xr.open_dataset(swirl) as data, pytest.raises(UsageError) as caught:
        plot_frame(data.drop_vars(name), 0, path)
    assert name in str(caught.value.got)
    assert not path.exists()


@pytest.mark.parametrize("name", ["split", "size", "scenario"])
def test_a_data_set_without_a_name_is_refused(
    swirl: Path, tmp_path: Path, name: str
) -> None:
    """Its attributes went, as in sums of data sets."""
    path = tmp_path / "x.png"
    with xr.open_dataset(swirl) as data:
        nameless = data.copy()
        del nameless.attrs[name]
        with pytest.raises(UsageError) as caught:
            plot_frame(nameless, 0, path)
    assert name in str(caught.value.got)


def draw_empty_box(path: Path) -> Pixels:
    """Return the walls of a scenario at its first frame."""
    with open_recording(path) as recording, figure(2.0, 2.0) as page:
        axes = page.add_axes((0, 0, 1, 1))
        draw_walls(axes, recording, 0)
        return pixels_of(page)


def test_moving_walls_are_marked(tmp_path: Path) -> None:
    """The moving wall is vermilion, the others are grey."""
    path = write_swirl(tmp_path, walls=TOP_TO_THE_RIGHT)
    box = draw_empty_box(path)
    side = len(box)
    middle = side // 2
    band = int(0.025 * side)  # middle of the wall of tiny, which is 0.05 wide
    beside_the_arrowhead = int(0.2 * side)
    assert has_colour(box[band, beside_the_arrowhead], MOVING)
    assert has_colour(box[-band, middle], WALL)
    assert has_colour(box[middle, middle], PAPER)


def test_arrowheads_point_where_a_wall_slides(tmp_path: Path) -> None:
    """Reversed walls draw the mirror image."""
    to_right = write_swirl(tmp_path / "right", walls=TOP_TO_THE_RIGHT)
    to_left = write_swirl(tmp_path / "left", walls=-TOP_TO_THE_RIGHT)
    right = draw_empty_box(to_right).astype(int)
    left = draw_empty_box(to_left).astype(int)
    mirrored = right[:, ::-1]
    mirror_difference = np.abs(mirrored - left).mean()
    difference = np.abs(right - left).mean()
    assert mirror_difference < 0.2 * difference


@pytest.mark.slow
@pytest.mark.parametrize(
    ("ending", "head"),
    [
        ("pdf", b"%PDF"),
        ("svg", b"<?xml"),
    ],
)
def test_vector_pictures_have_the_same_bytes_twice(
    swirl: Path,
    tmp_path: Path,
    ending: str,
    head: bytes,
) -> None:
    """PDF and SVG state no date, and no version of the software."""
    first_path = plot_frame(swirl, 0, tmp_path / f"first.{ending}")
    second_path = plot_frame(swirl, 0, tmp_path / f"second.{ending}")
    first = first_path.read_bytes()
    assert first == second_path.read_bytes()
    assert first.startswith(head)
    assert f"Matplotlib v{matplotlib.__version__}".encode() not in first


def test_another_ending_is_refused(swirl: Path, tmp_path: Path) -> None:
    """Nothing is written."""
    with pytest.raises(UsageError):
        plot_frame(swirl, 0, tmp_path / "x.jpg", kind="vorticity")
    assert not list(tmp_path.iterdir())


def test_a_picture_that_cannot_be_written_names_its_option(swirl: Path) -> None:
    """Where a file is in the way, the fix is the option that names the picture."""
    with pytest.raises(WorkFailedError) as caught:
        plot_frame(swirl, 0, swirl / "x.png", kind="vorticity")
    assert "--output" in str(caught.value.fix)


def test_without_matplotlib_the_extra_is_named(
    swirl: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The message holds the command that installs what is missing."""
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(UsageError) as caught:
        plot_frame(swirl, 0, tmp_path / "x.png")
    assert "pip install 'lagbench[plots]'" in str(caught.value)


def test_a_broken_dependency_is_not_called_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An import that fails inside an installed module shows its own error."""
    (tmp_path / "broken_extra.py").write_text("import no_such_module_at_all\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ModuleNotFoundError):
        errors.require("broken_extra", extra="plots")


@pytest.mark.slow
def test_sheet_of_driven_scenarios_has_a_panel_for_each(tmp_path: Path) -> None:
    """More scenarios make a wider page; the same page has the same bytes."""

    def draw_sheet(name: str) -> Path:
        path = tmp_path / name
        return contact_sheet("cavity", "tiny", path, root=tmp_path, frame=2)

    write_swirl(tmp_path, scenario=0)
    one = read_pixels(draw_sheet("one.png"))
    for scenario in (1, 2, 3, 4):
        write_swirl(tmp_path, scenario=scenario)
    path = draw_sheet("five.png")
    five = read_pixels(path)
    assert five.shape[1] > one.shape[1]
    again = draw_sheet("again.png")
    assert again.read_bytes() == path.read_bytes()

    # each of the five panels shows the vermilion of its moving top wall
    is_moving_column = has_colour(five, MOVING).any(axis=0)
    starts = np.diff(is_moving_column.astype(int)) == 1
    assert np.count_nonzero(starts) >= 5


@pytest.mark.slow
def test_sheet_of_families_has_a_row_for_each(tmp_path: Path) -> None:
    """Scenarios of one family share a row, families lie below each other."""
    heights = []
    families = ["circle", "circle", "splash"]
    for scenario, family in enumerate(families):
        write_swirl(
            tmp_path,
            "fluid",
            scenario,
            walls=None,
            parameters={"family": family},
        )
        sheet = contact_sheet("fluid", "tiny", tmp_path / "s.png", root=tmp_path)
        height, _, _ = read_pixels(sheet).shape
        heights.append(height)
    one_circle, two_circles, with_splash = heights
    assert one_circle == two_circles
    assert two_circles < with_splash


@pytest.mark.slow
def test_a_sheet_shows_the_kind_that_is_named(swirl: Path, tmp_path: Path) -> None:
    root = swirl.parents[4]
    pages = set()
    for kind in (Panel.SPEED, Panel.VORTICITY, Panel.STREAMLINES):
        path = tmp_path / "s.png"
        contact_sheet("cavity", "tiny", path, root=root, kind=kind)
        pages.add(path.read_bytes())
    assert len(pages) == 3
    for kind in ("vortcity", Panel.FRONT):
        with pytest.raises(UsageError) as caught:
            contact_sheet("cavity", "tiny", tmp_path / "s.png", root=root, kind=kind)
        assert caught.value.where == "--kind"


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
    sheet = contact_sheet("multimaterial", "tiny", tmp_path / "s.png", root=tmp_path)
    image = read_pixels(sheet)
    is_shown = []
    for colour in MATERIAL_COLOURS:
        pixels = has_colour(image, colour)
        is_shown.append(bool(pixels.any()))
    assert is_shown == [True, True, True, False]


def test_sheet_of_nothing_names_the_command(tmp_path: Path) -> None:
    """Without scenarios the fix says how to make them."""
    with pytest.raises(DataError) as caught:
        contact_sheet("cavity", "tiny", tmp_path / "s.png", root=tmp_path)
    assert "lagbench generate --split cavity --size tiny" in str(caught.value.fix)


def test_sheet_of_an_unknown_split_names_the_nearest(tmp_path: Path) -> None:
    """A slip of the pen is pointed out."""
    with pytest.raises(UsageError) as caught:
        contact_sheet("cavty", "tiny", tmp_path / "s.png", root=tmp_path)
    assert "cavity" in str(caught.value.fix)


def test_every_colour_is_in_the_palette() -> None:
    """Every level of both maps and every flat colour keeps its value in a file."""
    palette = build_palette()
    assert palette.shape == (256, 3)
    colours = {tuple(colour) for colour in palette.tolist()}
    flat_colours = [PAPER, INK, MUTED, WALL, MOVING, *MATERIAL_COLOURS]
    for flat in flat_colours:
        rgb = parse_rgb(flat).tolist()
        assert tuple(rgb) in colours
    for colour_map in (build_speed_map(), build_vorticity_map()):
        shares = np.asarray(colour_map.colors)[:, :3]
        levels = np.rint(255.0 * shares).astype(int)
        for level in levels.tolist():
            assert tuple(level) in colours


def test_frames_at_rest_have_no_say_in_a_common_colour_scale() -> None:
    """Only where nothing moves anywhere the scale ends at 1."""
    limits = [0.0, 0.0, 0.0, 0.25, 0.75]
    assert strongest_limit(limits) == 0.75
    assert median_limit(limits) == 0.5
    for nothing in ([], [0.0, 0.0]):
        assert strongest_limit(nothing) == 1.0
        assert median_limit(nothing) == 1.0
