"""Pictures: right fields, right colours, equal bytes, refusals."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from drawn_scenarios import record
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from PIL import Image
from rotating_disc import OMEGA, write_swirl

from lagbench.data.registry import load
from lagbench.errors import UsageError
from lagbench.figures.canvas import ENDINGS, figure, save
from lagbench.figures.colours import MATERIAL_COLOURS, parse_rgb
from lagbench.figures.panels import (
    Panel,
    draw,
    limit_of,
    median_limit,
    strongest_limit,
)
from lagbench.figures.pictures import plot
from lagbench.figures.plot import contact_sheet, draw_frame
from lagbench.figures.recording import open_recording

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


def test_the_scale_of_speeds_leaves_out_the_extreme_per_cent(swirl: Path) -> None:
    """Speeds of a disc are OMEGA r; 99 of 100 particles are within 0.4 sqrt(0.99)."""
    with open_recording(swirl) as recording:
        scene = recording.scene(1)
        angular_velocity = OMEGA / recording.size.frame_interval
        expected = angular_velocity * 0.4 * np.sqrt(0.99)
        limit = limit_of(Panel.SPEED, scene)
        assert limit == pytest.approx(expected, rel=1e-3)


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
    scene = record(data).scene(1)
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


def sheet_of(split: str, root: Path) -> Path:
    """Draw the sheet of a split's tiny data."""
    registry = load()
    size = registry.size(split, "tiny")
    return contact_sheet(size, root, root / "s.png", registry=registry)


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
        sheet = sheet_of("fluid", tmp_path)
        height, _, _ = read_pixels(sheet).shape
        heights.append(height)
    one_circle, two_circles, with_splash = heights
    assert one_circle == two_circles
    assert two_circles < with_splash


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
    sheet = sheet_of("multimaterial", tmp_path)
    image = read_pixels(sheet)
    is_shown = []
    for colour in MATERIAL_COLOURS:
        pixels = has_colour(image, colour)
        is_shown.append(bool(pixels.any()))
    assert is_shown == [True, True, True, False, False]


def test_frames_at_rest_have_no_say_in_a_common_colour_scale() -> None:
    """Only where nothing moves anywhere the scale ends at 1."""
    limits = [0.0, 0.0, 0.0, 0.25, 0.75]
    assert strongest_limit(limits) == 0.75
    assert median_limit(limits) == 0.5
    for nothing in ([], [0.0, 0.0]):
        assert strongest_limit(nothing) == 1.0
        assert median_limit(nothing) == 1.0


def test_a_picture_has_the_same_bytes_twice(swirl: Path, tmp_path: Path) -> None:
    """As a picture, a page and a drawing."""
    for ending in ENDINGS:
        paths = []
        for name in ("first", "second"):
            path = tmp_path / f"{name}{ending}"
            paths.append(save(draw_frame(swirl, 2, kind="speed"), path))
        first, second = paths
        assert first.read_bytes() == second.read_bytes()


def test_plot_returns_a_figure_and_writes_a_file_only_where_asked(
    swirl: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    drawn = plot(swirl, frame=1, kind="vorticity", dpi=64)
    assert isinstance(drawn, Figure)
    assert not list(tmp_path.iterdir())
    plot(swirl, frame=1, kind="vorticity", dpi=64, output=tmp_path / "x.png")
    height, width, _ = read_pixels(tmp_path / "x.png").shape
    assert [width, height] == pytest.approx(64 * drawn.get_size_inches(), abs=1)


@pytest.mark.parametrize(
    "settings", [{"kind": "vortcity"}, {"kind": "front"}, {"dpi": 1e6}, {"frame": 6}]
)
def test_what_cannot_be_drawn_is_refused(
    swirl: Path, settings: dict[str, object]
) -> None:
    with pytest.raises(UsageError):
        plot(swirl, **settings)  # type: ignore[arg-type]


def test_a_moving_wall_is_marked(swirl: Path) -> None:
    """Arrowheads of the top wall, which slides to the right, point to the right."""
    drawn = draw_frame(swirl, 1, kind="material")
    panel = drawn.axes[0]
    heads = [patch for patch in panel.patches if isinstance(patch, Polygon)]
    assert len(heads) == 5
    for head in heads:
        tip, *base = head.get_xy()[:3]
        assert all(tip[0] > corner[0] for corner in base)
