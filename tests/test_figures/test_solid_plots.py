"""Pictures of free surfaces in three dimensions: views, slices, titles that fit."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr
from drawn_scenarios import record
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from matplotlib.text import Text
from numpy.typing import NDArray

from lagbench.errors import UsageError
from lagbench.figures.animate import draw_film
from lagbench.figures.colours import MUTED
from lagbench.figures.panels import Panel, draw, limit_of
from lagbench.figures.plot import choose_moments, draw_scene
from lagbench.figures.recording import Recording

FRAMES = 3
BOTTOM = 0.125  # of the box of fluid-3d tiny


def fill(low: tuple[float, ...], high: tuple[float, ...]) -> NDArray[np.float32]:
    """Return particles that fill a block, four along a cell of the score grid."""
    axes = []
    for start, end in zip(low, high, strict=True):
        axis = np.arange(start + 1 / 128, end, 1 / 64)
        axes.append(axis)
    grid = np.meshgrid(*axes, indexing="ij")
    return np.stack(grid, axis=-1).reshape(-1, 3)


def liquid(start: NDArray[np.floating]) -> xr.Dataset:
    """Return a scenario of fluid-3d tiny whose particles rotate about the y axis."""
    middle = start.mean(axis=0)
    x, y, z = (start - middle).T
    frames = []
    for frame in range(FRAMES):
        angle = 0.02 * frame
        turned_x = np.cos(angle) * x + np.sin(angle) * z
        turned_z = np.cos(angle) * z - np.sin(angle) * x
        turned = np.stack([turned_x, y, turned_z], axis=-1)
        frames.append(middle + turned)
    position = np.stack(frames).astype(np.float32)
    material = np.zeros(len(start), np.int8)
    return xr.Dataset(
        {
            "position": (("frame", "particle", "axis"), position),
            "material": ("particle", material),
            "particle_mass": ((), 1.0 / 64**3),
        },
        coords={"frame": np.arange(FRAMES)},
        attrs={
            "split": "fluid-3d",
            "size": "tiny",
            "scenario": 3,
            "family": "made-up",
        },
    )


BEHIND = fill((0.2, 0.2, 0.6), (0.5, 0.5, 0.85))  # the middle of the box
BLOCK = liquid(BEHIND)
ON_THE_FLOOR = fill((0.2, BOTTOM, 0.2), (0.8, BOTTOM + 0.03, 0.8))
FILM = liquid(ON_THE_FLOOR)
DROP = liquid(fill((0.4, 0.4, 0.4), (0.58, 0.58, 0.58)))
"""So small that one node of the grid has a vorticity."""


def texts_of(drawn: Figure) -> list[str]:
    """Return the texts of a figure."""
    return [text.get_text() for text in drawn.findobj(Text) if text.get_text()]


@pytest.mark.parametrize("kind", [Panel.VORTICITY, Panel.STREAMLINES])
def test_a_slice_lies_where_the_liquid_is(kind: Panel) -> None:
    """The slice has the most nodes with a vorticity; the title says where it lies."""
    scene = record(BLOCK).scene(2)
    place = scene.fields.grid.spacing * scene.layer
    assert 0.6 < place < 0.85
    assert np.isfinite(scene.vorticity).sum() > 3
    assert np.isfinite(limit_of(kind, scene))
    words = texts_of(draw_scene(record(BLOCK).scene(2), kind=kind))
    assert any(f"across z at {place:.2f}" in text for text in words)


def test_where_material_is_too_thin_the_panel_says_so() -> None:
    """A film of liquid on the floor has no vorticity on the grid."""
    assert limit_of(Panel.VORTICITY, record(FILM).scene(2)) == 0.0
    words = texts_of(draw_scene(record(FILM).scene(2), kind=Panel.VORTICITY))
    assert any("too thin" in text for text in words)


def test_a_film_without_any_vorticity_is_refused() -> None:
    with pytest.raises(UsageError) as caught:
        next(draw_film([record(FILM)], Panel.VORTICITY, [0]))
    assert caught.value.where == "--kind"


def layers_of(recording: Recording) -> set[int | None]:
    """Return the layers of the slices of all frames."""
    return {recording.scene(frame).layer for frame in range(FRAMES)}


def test_a_film_shows_one_slice() -> None:
    """The slice of the best frame is that of all frames."""
    recording = record(BLOCK)
    layers = layers_of(recording)
    recording.fix_slice(range(FRAMES))
    assert recording.layer in layers
    assert layers_of(recording) == {recording.layer}


@pytest.mark.parametrize(("frames", "steps"), [(32, 6), (150, 7), (800, 40)])
def test_moments_of_a_row_lie_apart(frames: int, steps: int) -> None:
    """Neighbours of a short recording are a sixth of it apart, not a frame or two."""
    moments = choose_moments(frames)
    assert len(moments) == 6
    assert moments[0] == 0
    assert moments[-1] == frames - 1
    assert min(np.diff(moments)) == steps


BALL = BLOCK.assign_attrs(
    obstacle_x=0.7, obstacle_y=0.4, obstacle_z=0.3, obstacle_diameter=0.2
)
"""An obstacle away from the particles, in front of the plane that cuts them."""


def draw_ball(kind: Panel, scenario: xr.Dataset) -> NDArray[np.float64]:
    """Return the corners of the discs in a panel, shape [corner, 2]."""
    axes = Figure().add_subplot()
    draw(axes, kind, record(scenario).scene(0), limit=1.0)
    corners = [np.empty((0, 2))]
    for patch in axes.patches:
        if isinstance(patch, Polygon) and to_hex(patch.get_facecolor()) == MUTED:
            corners.append(np.asarray(patch.get_xy()))
    return np.concatenate(corners)


@pytest.mark.parametrize(
    ("kind", "centre"), [(Panel.FRONT, (0.7, 0.4)), (Panel.ABOVE, (0.7, 0.3))]
)
def test_a_view_shows_the_outline_of_an_obstacle(
    kind: Panel, centre: tuple[float, float]
) -> None:
    """Where its centre lies in the plane, and as large as it is."""
    from_centre = draw_ball(kind, BALL) - centre
    assert len(from_centre) > 0
    np.testing.assert_allclose(np.linalg.norm(from_centre, axis=1), 0.1, rtol=1e-5)
