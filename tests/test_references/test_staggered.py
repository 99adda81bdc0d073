"""The staggered solver against closed forms, a published table and SciPy."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.fft import dct, fft

from lagbench.data.box import Box
from lagbench.references.staggered import (
    Forcing,
    StaggeredGrid,
    Velocity,
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
        number = np.moveaxis(np.indices(shape), 0, -1)
        place = grid.face_origin(component) + number * grid.spacing
        velocity = flow(place)
        result.append(velocity[..., component])
    return result


def taylor_green(place: np.ndarray) -> np.ndarray:
    """Return the flow of Taylor and Green (1937) in two dimensions."""
    x = WAVE * place[..., 0]
    y = WAVE * place[..., 1]
    u = np.sin(x) * np.cos(y)
    v = -np.cos(x) * np.sin(y)
    return np.stack([u, v], -1)


def abc_flow(place: np.ndarray) -> np.ndarray:
    """Return an Arnold-Beltrami-Childress flow: its vorticity is the flow itself."""
    x = place[..., 0]
    y = place[..., 1]
    z = place[..., 2]
    u = 1.0 * np.sin(z) + 0.4 * np.cos(y)
    v = 0.7 * np.sin(x) + 1.0 * np.cos(z)
    w = 0.4 * np.sin(y) + 0.7 * np.cos(x)
    return np.stack([u, v, w], -1)


def largest_error(result: Velocity, truth: Velocity) -> float:
    """Return the largest difference over all components."""
    errors = []
    for values, expected in zip(result, truth, strict=True):
        difference = np.abs(values - expected)
        errors.append(float(difference.max()))
    return max(errors)


def cubic_grid(
    cells: int,
    *,
    side: float = 1.0,
    periodic: bool = False,
    dimension: int = 2,
) -> StaggeredGrid:
    """Return a grid whose axes are alike; fluid slides along its walls."""
    bounds = [(0.0, side)] * dimension
    box = Box.from_bounds(bounds, [periodic] * dimension)
    cell_counts = (cells,) * dimension
    return StaggeredGrid(box, cells=cell_counts, no_slip=False)


def taylor_green_error(
    cells: int,
    *,
    periodic: bool,
    drift: float = 0.0,
) -> float:
    """Return the relative error of a decaying Taylor-Green vortex after half a second.

    Between free-slip walls half a wave apart the same flow stands still. In a periodic
    box it may drift with a uniform flow, which tests the advection.
    """
    side = 1.0 if periodic else 0.5
    grid = cubic_grid(cells, side=side, periodic=periodic)
    start = faces(grid, lambda place: taylor_green(place) + drift)
    viscosity = 0.01
    duration = 0.5
    end = grid.advance(
        start,
        duration=duration,
        viscosity=viscosity,
        wall_velocity=NO_WALLS,
    )
    decay_rate = 2.0 * viscosity * WAVE**2
    left = np.exp(-decay_rate * duration)

    def end_flow(place: np.ndarray) -> np.ndarray:
        origin = place - drift * duration
        return left * taylor_green(origin) + drift

    truth = faces(grid, end_flow)
    divergence = np.abs(grid.divergence(end))
    assert divergence.max() < 1e-11
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
        grid = cubic_grid(
            cells,
            side=side,
            periodic=True,
            dimension=3,
        )
        start = faces(grid, abc_flow)
        end = grid.advance(
            start,
            duration=0.5,
            viscosity=0.1,
            wall_velocity=np.zeros((6, 3)),
        )
        left = np.exp(-0.05)
        truth = [left * values for values in start]
        errors.append(largest_error(end, truth))
    assert errors[1] < 0.001
    assert 3.3 < errors[0] / errors[1] < 4.7


@pytest.mark.parametrize(("upwinding", "order"), [(None, 2), (0.0, 4), (1.0, 3)])
def test_a_stream_carries_a_shear_wave(upwinding: float | None, order: int) -> None:
    """The error falls with the order; only the upwind part takes energy."""
    errors = []
    for count in (32, 64):
        box = Box.from_bounds([(0.0, 1.0), (0.0, 1.0)], periodic=[True, True])
        grid = StaggeredGrid(
            box, cells=(count, count), no_slip=False, upwinding=upwinding
        )

        def wave(place: np.ndarray) -> np.ndarray:
            across = np.sin(WAVE * place[..., 0])
            return np.stack([np.ones_like(across), across], -1)

        def slope(place: np.ndarray) -> np.ndarray:
            along = -WAVE * np.cos(WAVE * place[..., 0])
            return np.stack([np.zeros_like(along), along], -1)

        velocity = faces(grid, wave)
        rate = grid.acceleration(velocity, viscosity=0.0, wall_velocity=NO_WALLS)
        errors.append(largest_error(rate, faces(grid, slope)))
        power = float(np.mean(velocity[1] * rate[1]))
        if upwinding:
            assert power < 0.0
        else:
            assert abs(power) < 1e-12
    assert errors[0] / errors[1] > 0.95 * 2**order


@pytest.mark.parametrize("dimension", [2, 3])
def test_the_roughest_flow_decays(dimension: int) -> None:
    """Viscosity alone damps what a grid resolves least, in as few steps as are taken.

    The flow changes its sign from cell to cell along all axes, and is so slow that
    viscosity sets the time step.
    """
    grid = cubic_grid(8, side=1.0, periodic=True, dimension=dimension)
    rng = np.random.default_rng(5)
    noise = []
    for component in range(dimension):
        noise.append(1e-6 * rng.normal(size=grid.face_shape(component)))
    flow = grid.project(noise)
    energies = []
    for _ in range(6):
        energies.append(sum(float(np.sum(values**2)) for values in flow))
        flow = grid.advance(
            flow,
            duration=0.1,
            viscosity=0.124,
            wall_velocity=np.zeros((2 * dimension, dimension)),
        )
    assert np.all(np.diff(energies) < 0.0)


@pytest.mark.slow
def test_a_driven_channel_comes_to_poiseuille_flow() -> None:
    """The profile is f y (L - y) / (2 nu) between walls at rest."""
    bounds = [(0.0, 1.0), (0.0, 0.5)]
    box = Box.from_bounds(bounds, [True, False])
    grid = StaggeredGrid(box, cells=(4, 16), no_slip=True)
    flow = grid.rest()
    viscosity = 0.05
    flow = grid.advance(
        flow,
        duration=10.0,
        viscosity=viscosity,
        wall_velocity=NO_WALLS,
        force=(0.1, 0.0),
    )
    y = (np.arange(16) + 0.5) / 32.0
    # The mirror image of no slip is linear: the profile is off by f h^2 / (8 nu).
    spacing = 1.0 / 32.0
    offset = 0.1 * spacing**2 / (8.0 * viscosity)
    arch = y * (0.5 - y)
    profile = 0.1 * arch / (2.0 * viscosity)
    columns = np.tile(profile + offset, (4, 1))
    assert_allclose(flow[0], columns, rtol=1e-6)
    assert_allclose(flow[1], 0.0, atol=1e-12)


def lid_driven(*, cells: int, solid: bool) -> Velocity:
    """Return the cavity at Re 100 after 12 s, when it has all but come to rest."""
    dimension = 2
    if solid:
        dimension = 3
    periodic = [False, False, True][:dimension]
    counts = (cells, cells, 2)[:dimension]
    bounds = [(0.0, 1.0)] * dimension
    box = Box.from_bounds(bounds, periodic)
    grid = StaggeredGrid(box, cells=counts, no_slip=True)
    walls = np.zeros((2 * dimension, dimension))
    walls[3, 0] = 1.0  # the lid: top, rightwards
    flow = grid.rest()
    return grid.advance(
        flow,
        duration=12.0,
        viscosity=0.01,
        wall_velocity=walls,
    )


def test_the_cavity_agrees_with_ghia() -> None:
    """Centre lines at Re 100: Ghia, Ghia and Shin, J. Comput. Phys. 48 (1982) 387."""
    u_by_height = {
        0.0547: -0.03717,
        0.1719: -0.1015,
        0.2813: -0.15662,
        0.4531: -0.2109,
        0.5: -0.20581,
        0.6172: -0.13641,
        0.7344: 0.00332,
        0.8516: 0.23151,
        0.9531: 0.68717,
    }
    height = list(u_by_height)
    u = list(u_by_height.values())
    cells = 32
    flow = lid_driven(cells=cells, solid=False)
    centre = (np.arange(cells) + 0.5) / cells
    u_at_middle = flow[0][cells // 2]
    profile = np.interp(height, centre, u_at_middle)
    assert_allclose(profile, u, atol=0.012)


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("periodic", [True, False])
def test_the_projection_keeps_nothing_of_a_gradient_and_all_of_the_rest(
    dimension: int,
    periodic: bool,
) -> None:
    bounds = [(0.0, 1.0)] * dimension
    other_axes = [not periodic] * (dimension - 1)
    box = Box.from_bounds(bounds, [periodic, *other_axes])
    counts = (6, 7, 5)[:dimension]
    grid = StaggeredGrid(box, cells=counts, no_slip=True)
    rng = np.random.default_rng(0)
    at_rest = grid.rest()
    velocity = [rng.normal(size=values.shape) for values in at_rest]
    for axis, values in enumerate(velocity):
        if not box.periodic[axis]:
            normal = np.moveaxis(values, axis, 0)
            normal[[0, -1]] = 0.0
    once = grid.project(velocity)
    twice = grid.project(once)
    divergence = np.abs(grid.divergence(once))
    assert divergence.max() < 1e-12
    assert largest_error(once, twice) < 1e-12


def test_modes_are_those_of_scipy_s_transforms() -> None:
    rng = np.random.default_rng(1)
    values = rng.normal(size=9)
    cosines, _ = poisson_modes(9, periodic=False)
    expected = dct(values, norm="ortho")
    assert_allclose(cosines @ values, expected)

    waves, rates = poisson_modes(9, periodic=True)
    power = (waves @ values) ** 2
    of_waves = power[1:].reshape(4, 2)
    wave_power = of_waves.sum(axis=1)
    spectrum = np.abs(fft(values)) ** 2 / 9
    assert_allclose(wave_power, 2.0 * spectrum[1:5])

    below = np.roll(values, 1)
    above = np.roll(values, -1)
    second_difference = below + above - 2.0 * values
    result = waves @ second_difference
    expected = -rates * (waves @ values)
    assert_allclose(result, expected, atol=1e-12)


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_linear_field_is_read_and_written_exactly(dimension: int) -> None:
    """Between the outermost faces a linear field passes through both transfers."""
    rng = np.random.default_rng(2)
    grid = cubic_grid(8, dimension=dimension)
    slope = rng.normal(size=(dimension, dimension))
    field = faces(grid, lambda place: 0.3 + place @ slope)
    points = rng.uniform(0.2, 0.8, (500, dimension))
    walls = np.zeros((2 * dimension, dimension))
    velocity = grid.at_particles(field, points, wall_velocity=walls)
    expected = 0.3 + points @ slope
    assert_allclose(velocity, expected, atol=1e-12)

    shape = (4,) * dimension
    values = rng.normal(size=shape)
    nodes = np.indices(shape).reshape(dimension, -1)
    at_nodes = interpolate(values, nodes.T.astype(float))
    assert_allclose(at_nodes, values.ravel(), atol=1e-14)


@pytest.mark.parametrize("periodic", [True, False])
def test_particles_give_back_the_flow_that_they_were_given(periodic: bool) -> None:
    side = 1.0 if periodic else 0.5
    grid = cubic_grid(20, side=side, periodic=periodic)
    rng = np.random.default_rng(3)
    position = rng.uniform(0.0, side, (3000, 2))
    field = grid.from_particles(
        position,
        taylor_green(position),
        wall_velocity=NO_WALLS,
    )
    assert largest_error(field, faces(grid, taylor_green)) < 0.05
    without = grid.from_particles(
        position,
        taylor_green(position),
        wall_velocity=NO_WALLS,
        corrections=0,
    )
    truth = faces(grid, taylor_green)
    assert largest_error(field, truth) < largest_error(without, truth)


def test_carried_particles_stay_on_their_streamlines() -> None:
    """The stream function of a steady Taylor-Green flow is kept by each particle."""
    grid = cubic_grid(64, periodic=True)
    field = faces(grid, taylor_green)
    rng = np.random.default_rng(4)
    position = rng.uniform(0.0, 1.0, (200, 2))

    def stream(place: np.ndarray) -> np.ndarray:
        wave_x, wave_y = np.sin(WAVE * place).T
        return np.asarray(wave_x * wave_y)

    start = stream(position)
    for _ in range(100):
        position = grid.carry(
            position,
            before=field,
            after=field,
            duration=0.005,
            wall_velocity=NO_WALLS,
        )
    assert_allclose(stream(position), start, atol=0.01)


def test_layers_are_driven_apart() -> None:
    """In a periodic box without viscosity each layer gains f t along x."""
    grid = cubic_grid(8, periodic=True)
    u, v = grid.advance(
        grid.rest(),
        duration=0.5,
        viscosity=0.0,
        wall_velocity=np.zeros((4, 2)),
        force=[[0.2, 0.0], [-0.2, 0.0]],
    )
    lower = u[:, :4]
    upper = u[:, 4:]
    assert_allclose(lower, 0.1, rtol=0, atol=1e-12)
    assert_allclose(upper, -0.1, rtol=0, atol=1e-12)
    assert_allclose(v, 0.0, rtol=0, atol=1e-12)


def test_a_body_stops_the_stream_and_a_fringe_keeps_it() -> None:
    """A disc in a channel: hardly any fluid goes through it, and as much goes past it
    faster. Behind the fringe the stream is even again.
    """
    box = Box.from_bounds([(0.0, 1.0), (0.25, 0.75)], periodic=[True, False])
    forcing = Forcing(
        obstacle=np.float32([0.3, 0.5, 0.1]),
        fringe_length=0.2,
        fringe_rate=40.0,
        stream=np.array([0.5, 0.0]),
    )
    grid = StaggeredGrid(box, cells=(48, 24), no_slip=False, forcing=forcing)
    field = grid.rest()
    field[0] += 0.5
    field = grid.advance(field, duration=2.0, viscosity=2e-3, wall_velocity=NO_WALLS)
    divergence = grid.divergence(field)
    assert np.abs(divergence).max() < 1e-10
    centre = np.array([[0.3, 0.5]])
    beside = np.array([[0.3, 0.68]])
    start = np.array([[0.02, 0.3], [0.02, 0.5], [0.02, 0.7]])
    inside = grid.at_particles(field, centre, wall_velocity=NO_WALLS)
    past = grid.at_particles(field, beside, wall_velocity=NO_WALLS)
    even = grid.at_particles(field, start, wall_velocity=NO_WALLS)
    assert np.abs(inside).max() < 0.02
    assert past[0, 0] > 0.65
    assert_allclose(even[:, 0], 0.5, atol=0.11)
    assert np.abs(even[:, 1]).max() < 0.02
