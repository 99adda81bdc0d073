"""The staggered solver against closed forms, a published table and SciPy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.fft import dct, fft

from lagbench.data.box import Box
from lagbench.references.staggered import (
    StaggeredGrid,
    Velocity,
    fill_gaps,
    interpolate,
    poisson_modes,
)

WAVE = 2.0 * np.pi
NO_WALLS = np.zeros((4, 2))


def faces(grid: StaggeredGrid, flow: object) -> Velocity:
    """Return a flow, a function of points, at the faces of a grid."""
    result = []
    for component in range(grid.dimension):
        shape = grid.face_shape(component)
        number = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1)
        place = grid.face_origin(component) + number * grid.spacing
        result.append(flow(place)[..., component])
    return result


def taylor_green(place: np.ndarray) -> np.ndarray:
    """Return the flow of Taylor and Green (1937) in two dimensions."""
    x = WAVE * place[..., 0]
    y = WAVE * place[..., 1]
    return np.stack([np.sin(x) * np.cos(y), -np.cos(x) * np.sin(y)], -1)


def abc_flow(place: np.ndarray) -> np.ndarray:
    """Return an Arnold-Beltrami-Childress flow: its vorticity is the flow itself."""
    x = place[..., 0]
    y = place[..., 1]
    z = place[..., 2]
    return np.stack(
        [
            1.0 * np.sin(z) + 0.4 * np.cos(y),
            0.7 * np.sin(x) + 1.0 * np.cos(z),
            0.4 * np.sin(y) + 0.7 * np.cos(x),
        ],
        -1,
    )


def largest_error(result: Velocity, truth: Velocity) -> float:
    """Return the largest difference over all components."""
    return max(float(np.abs(a - b).max()) for a, b in zip(result, truth, strict=True))


def taylor_green_error(cells: int, *, periodic: bool, drift: float = 0.0) -> float:
    """Return the relative error of a decaying Taylor-Green vortex after half a second.

    Between free-slip walls half a wave apart the same flow stands still. In a periodic
    box it may drift with a uniform flow, which tests the advection.
    """
    side = 1.0 if periodic else 0.5
    box = Box.from_bounds([(0.0, side)] * 2, [periodic] * 2)
    grid = StaggeredGrid(box, cells=(cells, cells), no_slip=False)
    start = faces(grid, lambda place: taylor_green(place) + drift)
    viscosity = 0.01
    duration = 0.5
    end = grid.advance(
        start, duration=duration, viscosity=viscosity, wall_velocity=NO_WALLS
    )
    left = np.exp(-2.0 * viscosity * WAVE**2 * duration)
    truth = faces(
        grid, lambda place: left * taylor_green(place - drift * duration) + drift
    )
    assert float(np.abs(grid.divergence(end)).max()) < 1e-11
    return largest_error(end, truth) / left


@pytest.mark.parametrize("periodic", [True, False])
def test_taylor_green_decays_as_its_closed_form(periodic: bool) -> None:
    cells = 32 if periodic else 16
    assert taylor_green_error(cells, periodic=periodic) < 0.002


def test_the_error_falls_with_the_square_of_the_spacing() -> None:
    coarse = taylor_green_error(24, periodic=True, drift=0.3)
    fine = taylor_green_error(48, periodic=True, drift=0.3)
    assert 3.5 < coarse / fine < 4.5


def test_a_beltrami_flow_decays_in_three_dimensions() -> None:
    """With curl u = u the advection is a gradient: u decays as exp(-nu t)."""
    side = 2.0 * np.pi
    errors = []
    for cells in (12, 24):
        box = Box.from_bounds([(0.0, side)] * 3, [True] * 3)
        grid = StaggeredGrid(box, cells=(cells,) * 3, no_slip=False)
        start = faces(grid, abc_flow)
        end = grid.advance(
            start, duration=0.5, viscosity=0.1, wall_velocity=np.zeros((6, 3))
        )
        truth = [np.exp(-0.05) * values for values in start]
        errors.append(largest_error(end, truth))
    assert errors[1] < 0.001
    assert 3.3 < errors[0] / errors[1] < 4.7


def test_a_driven_channel_comes_to_poiseuille_flow() -> None:
    """The profile is f y (L - y) / (2 nu) between walls at rest."""
    box = Box.from_bounds([(0.0, 1.0), (0.0, 0.5)], [True, False])
    grid = StaggeredGrid(box, cells=(4, 16), no_slip=True)
    flow = grid.rest()
    viscosity = 0.05
    flow = grid.advance(
        flow,
        duration=20.0,
        viscosity=viscosity,
        wall_velocity=NO_WALLS,
        force=(0.1, 0.0),
    )
    y = (np.arange(16) + 0.5) / 32.0
    # The mirror image of no slip is linear: the profile is off by f h^2 / (8 nu).
    offset = 0.1 * (1.0 / 32.0) ** 2 / (8.0 * viscosity)
    profile = 0.1 * y * (0.5 - y) / (2.0 * viscosity) + offset
    np.testing.assert_allclose(flow[0], np.tile(profile, (4, 1)), rtol=1e-6)
    np.testing.assert_allclose(flow[1], 0.0, atol=1e-12)


def lid_driven(*, cells: int, solid: bool) -> Velocity:
    """Return the cavity at Re 100 after 12 s, when it has all but come to rest."""
    bounds = [(0.0, 1.0)] * (3 if solid else 2)
    periodic = [False, False, True][: len(bounds)]
    counts = (cells, cells, 2)[: len(bounds)]
    grid = StaggeredGrid(Box.from_bounds(bounds, periodic), cells=counts, no_slip=True)
    walls = np.zeros((2 * len(bounds), len(bounds)))
    walls[3, 0] = 1.0  # the lid: top, rightwards
    return grid.advance(grid.rest(), duration=12.0, viscosity=0.01, wall_velocity=walls)


def test_the_cavity_agrees_with_ghia() -> None:
    """Centre lines at Re 100: Ghia, Ghia and Shin, J. Comput. Phys. 48 (1982) 387."""
    height = [0.0547, 0.1719, 0.2813, 0.4531, 0.5, 0.6172, 0.7344, 0.8516, 0.9531]
    u = [-0.03717, -0.1015, -0.15662, -0.2109, -0.20581, -0.13641, 0.00332, 0.23151]
    u.append(0.68717)
    cells = 32
    flow = lid_driven(cells=cells, solid=False)
    centre = (np.arange(cells) + 0.5) / cells
    profile = np.interp(height, centre, flow[0][cells // 2])
    np.testing.assert_allclose(profile, u, atol=0.012)


def test_a_thin_periodic_box_is_the_flat_cavity() -> None:
    flat = lid_driven(cells=10, solid=False)
    solid = lid_driven(cells=10, solid=True)
    for component in range(2):
        for layer in range(2):
            np.testing.assert_allclose(
                solid[component][..., layer], flat[component], atol=1e-12
            )
    np.testing.assert_allclose(solid[2], 0.0, atol=1e-12)


@pytest.mark.parametrize("bounds", [[(0.0, 1.0)] * 2, [(0.0, 1.0)] * 3])
@pytest.mark.parametrize("periodic", [True, False])
def test_the_projection_keeps_nothing_of_a_gradient_and_all_of_the_rest(
    bounds: list[tuple[float, float]], periodic: bool
) -> None:
    box = Box.from_bounds(bounds, [periodic] + [not periodic] * (len(bounds) - 1))
    grid = StaggeredGrid(box, cells=(6, 7, 5)[: len(bounds)], no_slip=True)
    rng = np.random.default_rng(0)
    velocity = [rng.normal(size=values.shape) for values in grid.rest()]
    for axis, values in enumerate(velocity):
        if not box.periodic[axis]:
            np.moveaxis(values, axis, 0)[[0, -1]] = 0.0
    once = grid.project(velocity)
    twice = grid.project(once)
    assert float(np.abs(grid.divergence(once)).max()) < 1e-12
    assert largest_error(once, twice) < 1e-12


def test_modes_are_those_of_scipy_s_transforms() -> None:
    rng = np.random.default_rng(1)
    values = rng.normal(size=9)
    cosines, _ = poisson_modes(9, periodic=False)
    np.testing.assert_allclose(cosines @ values, dct(values, norm="ortho"))
    waves, rates = poisson_modes(9, periodic=True)
    power = (waves @ values) ** 2
    spectrum = np.abs(fft(values)) ** 2 / 9
    np.testing.assert_allclose(power[1:].reshape(4, 2).sum(1), 2.0 * spectrum[1:5])
    second_difference = np.roll(values, 1) - 2.0 * values + np.roll(values, -1)
    np.testing.assert_allclose(
        waves @ second_difference, -rates * (waves @ values), atol=1e-12
    )


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_linear_field_is_read_and_written_exactly(dimension: int) -> None:
    """Between the outermost faces a linear field passes through both transfers."""
    rng = np.random.default_rng(2)
    box = Box.from_bounds([(0.0, 1.0)] * dimension)
    grid = StaggeredGrid(box, cells=(8,) * dimension, no_slip=False)
    slope = rng.normal(size=(dimension, dimension))
    field = faces(grid, lambda place: 0.3 + place @ slope)
    points = rng.uniform(0.2, 0.8, (500, dimension))
    found = grid.at_particles(
        field, points, wall_velocity=np.zeros((2 * dimension, dimension))
    )
    np.testing.assert_allclose(found, 0.3 + points @ slope, atol=1e-12)
    values = rng.normal(size=(4,) * dimension)
    corner = np.stack(np.meshgrid(*[np.arange(4)] * dimension, indexing="ij"), -1)
    at_nodes = interpolate(values, corner.reshape(-1, dimension).astype(float))
    np.testing.assert_allclose(at_nodes, values.ravel(), atol=1e-14)


@pytest.mark.parametrize("periodic", [True, False])
def test_particles_give_back_the_flow_that_they_were_given(periodic: bool) -> None:
    side = 1.0 if periodic else 0.5
    box = Box.from_bounds([(0.0, side)] * 2, [periodic] * 2)
    grid = StaggeredGrid(box, cells=(20, 20), no_slip=False)
    rng = np.random.default_rng(3)
    position = rng.uniform(0.0, side, (3000, 2))
    field = grid.from_particles(
        position, taylor_green(position), wall_velocity=NO_WALLS
    )
    assert largest_error(field, faces(grid, taylor_green)) < 0.05
    without = grid.from_particles(
        position, taylor_green(position), wall_velocity=NO_WALLS, corrections=0
    )
    truth = faces(grid, taylor_green)
    assert largest_error(field, truth) < largest_error(without, truth)


def test_carried_particles_stay_on_their_streamlines() -> None:
    """The stream function of a steady Taylor-Green flow is kept by each particle."""
    box = Box.from_bounds([(0.0, 1.0)] * 2, [True, True])
    grid = StaggeredGrid(box, cells=(64, 64), no_slip=False)
    field = faces(grid, taylor_green)
    rng = np.random.default_rng(4)
    position = rng.uniform(0.0, 1.0, (200, 2))

    def stream(place: np.ndarray) -> np.ndarray:
        return np.asarray(np.sin(WAVE * place[:, 0]) * np.sin(WAVE * place[:, 1]))

    start = stream(position)
    for _ in range(100):
        position = grid.carry(
            position, before=field, after=field, duration=0.005, wall_velocity=NO_WALLS
        )
    np.testing.assert_allclose(stream(position), start, atol=0.01)


def test_gaps_are_filled_from_their_edges() -> None:
    weight = np.array([[1.0, 0.0, 0.0], [2.0, 0.0, 4.0]])
    sums = weight * np.array([[1.0, 9.0, 9.0], [3.0, 9.0, 7.0]])
    filled = fill_gaps(sums, weight)
    np.testing.assert_allclose(filled, [[1.0, 1.0, 7.0], [3.0, 5.0, 7.0]])
    np.testing.assert_array_equal(fill_gaps(0.0 * sums, 0.0 * weight), 0.0)


def test_layers_are_driven_apart() -> None:
    """In a periodic box without viscosity each layer gains f t along x."""
    box = Box.from_bounds([(0.0, 1.0), (0.0, 1.0)], periodic=[True, True])
    grid = StaggeredGrid(box, cells=(8, 8), no_slip=False)
    field = grid.advance(
        grid.rest(),
        duration=0.5,
        viscosity=0.0,
        wall_velocity=np.zeros((4, 2)),
        force=[[0.2, 0.0], [-0.2, 0.0]],
    )
    np.testing.assert_allclose(field[0][:, :4], 0.1, rtol=0, atol=1e-12)
    np.testing.assert_allclose(field[0][:, 4:], -0.1, rtol=0, atol=1e-12)
    np.testing.assert_allclose(field[1], 0.0, rtol=0, atol=1e-12)
