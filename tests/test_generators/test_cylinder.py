"""Flow past a cylinder: its scenarios, and how the disc is told."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.image import imread
from scenario_draws import draw

import lagbench
from lagbench.data import registry
from lagbench.data.manifest import read_manifest
from lagbench.data.scenario import read_scenario
from lagbench.figures.colours import WALL
from lagbench.figures.plot import contact_sheet
from lagbench.generators import cylinder
from lagbench.make.generate import GenerationResult
from lagbench.references import given_in
from lagbench.references.projection import forcing_of

REGISTRY = registry.load()
SIZES = {
    name: REGISTRY.size("cylinder", name) for name in REGISTRY.split("cylinder").sizes
}


@pytest.mark.parametrize("name", sorted(SIZES))
def test_drawn_discs_are_free_of_fluid(name: str) -> None:
    """The disc stands off the middle by whole spacings and keeps its distance from the
    walls; every particle of the lattice is fluid or disc.
    """
    size = SIZES[name]
    radius = 0.5 * size.value("obstacle_diameter")
    heights = set()
    for scenario in size.scenarios[:8]:
        state = draw(size, scenario)
        assert state.obstacle is not None
        x, y = state.obstacle.centre
        heights.add(y)
        assert x == size.value("obstacle_x")
        assert y == state.parameters["obstacle_y"]
        steps = (y - 0.5) * size.value("lattice")
        assert steps == pytest.approx(round(steps), abs=1e-9)
        low, high = size.bounds[1]
        assert min(y - low, high - y) > 2.0 * radius
        way = state.position - state.obstacle.centre
        assert np.hypot(*way.T).min() > radius - 2e-6
        inside = state.obstacle.position - state.obstacle.centre
        assert np.hypot(*inside.T).max() < radius
        lattice = size.value("lattice") ** 2 * size.box.volume
        assert len(way) + len(inside) == round(lattice)
        assert 80.0 <= float(state.parameters["reynolds"]) <= 200.0
    assert len(heights) > 2


CENTRE = np.array([0.4, 0.5])
FLOWS = {
    "eddy": functools.partial(cylinder.eddy, centre=CENTRE, radius=0.3, speed=0.2),
    "potential flow": functools.partial(
        cylinder.potential_flow, centre=CENTRE, radius=0.1, speed=0.2
    ),
}


@pytest.mark.parametrize("name", sorted(FLOWS))
def test_a_flow_has_the_gradient_that_it_says(name: str) -> None:
    """Against central differences; neither flow has a divergence."""
    flow = FLOWS[name]
    rng = np.random.default_rng(5)
    points = rng.random((60, 2))
    points = points[np.hypot(*(points - CENTRE).T) > 0.1]
    _, gradient = flow(points)
    step = 1e-6
    for axis in range(2):
        way = np.zeros(2)
        way[axis] = step
        rise = flow(points + way)[0] - flow(points - way)[0]
        slope = rise / (2.0 * step)
        np.testing.assert_allclose(gradient[:, :, axis], slope, atol=1e-8)
    divergence = gradient[:, 0, 0] + gradient[:, 1, 1]
    np.testing.assert_allclose(divergence, 0.0, atol=1e-14)


def test_no_fluid_flows_through_the_disc_at_the_start() -> None:
    """The normal component of the potential flow is 0 on the rim, and its speed there
    is 2 U at most; far away it is the stream.
    """
    angle = np.linspace(0.0, 6.0, 25)
    normal = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    velocity, _ = FLOWS["potential flow"](CENTRE + 0.1 * normal)
    through = np.sum(velocity * normal, axis=1)
    np.testing.assert_allclose(through, 0.0, atol=1e-15)
    assert np.hypot(*velocity.T).max() == pytest.approx(0.4, rel=0.01)
    far, _ = FLOWS["potential flow"](np.array([[9.0, 0.5]]))
    np.testing.assert_allclose(far[0], [0.2, 0.0], atol=1e-4)


@pytest.mark.slow
def test_windows_state_the_disc_and_no_particle_enters_it(
    tiny_split: Callable[..., GenerationResult],
) -> None:
    """Windows, `open_split` and the references get centre and radius; in all frames the
    particles lie outside; J stays near 1.
    """
    root = tiny_split("cylinder").root
    size = SIZES["tiny"]
    radius = 0.5 * size.value("obstacle_diameter")
    with lagbench.open_split("cylinder", size="tiny", root=root) as data:
        told = data["obstacle"].values
        position = data["position"].values.astype(np.float64)
        np.testing.assert_array_equal(told[:, 0], np.float32(size.value("obstacle_x")))
        np.testing.assert_array_equal(told[:, 2], np.float32(radius))
        for row, frames in zip(told.astype(np.float64), position, strict=True):
            distance = np.linalg.norm(frames - row[:2], axis=-1)
            assert distance.min() > radius
        assert data["position"].sizes["particle"] == size.particles

    windows = lagbench.windows("cylinder", subset="test", size="tiny", root=root)
    first = windows[0]
    assert first.obstacle is not None
    np.testing.assert_array_equal(first.obstacle, told[0])

    with read_scenario(size.path(root, size.subsets["test"][0])) as file:
        given = given_in(file, size, root)
    assert given.obstacle is not None
    np.testing.assert_array_equal(given.obstacle, told[0])
    forcing = forcing_of(given.size, given.obstacle)
    assert forcing is not None
    assert forcing.stream[0] == size.value("speed")

    manifest = read_manifest(root, "cylinder", "tiny", size.major)
    assert manifest is not None
    for entry in manifest.files:
        assert entry.facts["jacobian_min"] > 0.85
        assert entry.facts["jacobian_max"] < 1.15


@pytest.mark.slow
def test_a_sheet_of_a_channel_is_low(
    tiny_split: Callable[..., GenerationResult], tmp_path: Path
) -> None:
    """A cell shows the channel and thin walls: less than a tenth of the page is wall.

    The square around the channel would be wall for one half.
    """
    root = tiny_split("cylinder").root
    size = REGISTRY.size("cylinder", "tiny")
    path = contact_sheet(size, root, tmp_path / "sheet.png", registry=REGISTRY)
    image = imread(path)
    wall_colour = to_rgb(WALL)
    is_wall = np.all(np.isclose(image[..., :3], wall_colour, atol=1e-3), axis=-1)
    share = is_wall.mean()
    assert 0.0 < share < 0.1
