"""A free surface in a cube: bits, closed forms, the solver in two dimensions, and the
draws of fluid-3d and multimaterial-3d.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray
from reference_free_surface_3d import FreeSurfaceReference3D

from lagbench.data.registry import Size, load
from lagbench.generators.batch import draw_initial_state
from lagbench.generators.constants import free_surface_walls, solver_constants
from lagbench.generators.constitutive import lame
from lagbench.generators.draws import quantise
from lagbench.generators.fluid_3d import FAMILIES
from lagbench.generators.free_surface import FreeSurface
from lagbench.generators.free_surface_3d import FreeSurface3D
from lagbench.generators.shapes import Body, body_at, sample_points
from lagbench.generators.solids import Ball, Block, Rod, Solid, cube_root
from lagbench.generators.solver import Device, build
from lagbench.generators.split import (
    FreeSurface3DParameters,
    FreeSurfaceParameters,
    InitialState,
    Material,
)
from validation import dam_break

Array = NDArray[np.float64]

CONSTANTS = {
    "grid": 16,
    "dt": 1 / 480,
    "wall": 2,
    "gravity": 2.5,
    "density": 1.0,
    "liquid_modulus": 250.0,
    "liquid_viscosity": 1e-3,
    "jacobian_relaxation": 0.2,
    "density_coupling": 0.015,
    "jacobian_min": 0.1,
    "jacobian_max": 1.0,
}
SEED = 20261125


def liquid(
    position: Array, velocity: Array, volume: float, affine: Array | None = None
) -> InitialState:
    """Return an initial state of liquid in a cube."""
    count = len(position)
    if affine is None:
        affine = np.zeros((count, 3, 3))
    return InitialState(
        position=quantise(position),
        velocity=quantise(velocity),
        affine=quantise(affine),
        material=np.full(count, Material.LIQUID, np.int8),
        area=volume,
        wall_velocity=np.zeros((6, 3)),
    )


def falling_ball() -> InitialState:
    """Return the state of a ball that turns as it flies."""
    rng = np.random.default_rng(SEED)
    ball = Ball(0.16)
    position = sample_points(rng, Body(ball, np.array((0.4, 0.45, 0.5))), 400)
    affine = 4.0 * rng.random((400, 3, 3)) - 2.0
    return liquid(position, np.tile((1.0, -1.5, 0.5), (400, 1)), ball.volume, affine)


@functools.cache
def compiled(device: Device, particle_count: int, **changes: float) -> FreeSurface3D:
    """Return a solver; one of the same constants is taken again, since it compiles."""
    constants = FreeSurface3DParameters(
        particles=particle_count, **(CONSTANTS | changes)
    )
    solver = build(constants, device=device)
    assert isinstance(solver, FreeSurface3D)
    return solver


def start(
    state: InitialState, *, device: Device = Device.CPU, **changes: float
) -> FreeSurface3D:
    """Return a solver that stands at a state; the next call may take it over."""
    solver = compiled(device, len(state.position), **changes)
    solver.load([state])
    return solver


@dataclass(frozen=True)
class Piece:
    """A body: what it is made of, its shape, where it lies and how fast it moves."""

    material: Material
    solid: Solid
    centre: tuple[float, float, float]
    velocity: tuple[float, float, float]


def pieces(
    *parts: Piece, count: int = 400, friction: float = 0.0, spin: float = 0.0
) -> InitialState:
    """Fill bodies with particles by volume; each flies and turns at random."""
    rng = np.random.default_rng(SEED)
    volumes = np.array([part.solid.volume for part in parts])
    ends = np.rint(np.append(0.0, volumes.cumsum()) / volumes.sum() * count).astype(int)
    counts = np.diff(ends)
    bodies = []
    for part, n in zip(parts, counts, strict=True):
        bodies.append(sample_points(rng, body_at(part.solid, *part.centre), n))
    velocities = np.array([part.velocity for part in parts])
    materials = np.array([part.material for part in parts], np.int8)
    return InitialState(
        position=np.concatenate(bodies),
        velocity=quantise(np.repeat(velocities, counts, axis=0)),
        affine=quantise(spin * (2.0 * rng.random((count, 3, 3)) - 1.0)),
        material=np.repeat(materials, counts),
        area=float(volumes.sum()),
        wall_velocity=np.zeros((6, 3)),
        friction=friction,
    )


def falling(material: Material, friction: float = 0.0) -> InitialState:
    """Return two bodies that hit opposite corners at once."""
    block = Block((0.2, 0.2, 0.2))
    return pieces(
        Piece(material, block, (0.24, 0.24, 0.3), (-1.5, -1.5, 1.0)),
        Piece(material, Ball(0.1), (0.76, 0.76, 0.7), (2.0, 1.0, 1.0)),
        friction=friction,
        spin=4.0,
    )


MIXED = pieces(
    Piece(Material.LIQUID, Ball(0.12), (0.3, 0.3, 0.3), (1.0, -2.0, 0.0)),
    Piece(Material.SNOW, Block((0.2, 0.2, 0.2)), (0.6, 0.26, 0.3), (0.0, -1.0, -1.5)),
    Piece(Material.JELLY, Ball(0.12), (0.6, 0.26, 0.65), (-1.0, -1.0, 1.0)),
    Piece(
        Material.ROPE, Rod(0.5, 0.06, (0.6, 0.0, 0.8)), (0.5, 0.6, 0.5), (0.5, 1.0, 0.5)
    ),
    friction=0.3,
)
NAMED = {m.name.lower(): falling(m) for m in Material}
NAMED |= {"snow with friction": falling(Material.SNOW, friction=0.3), "all four": MIXED}
CASES = [pytest.param(state, id=name) for name, state in NAMED.items()]
ARRAYS = ("position", "velocity", "affine", "deformation", "volume_ratio")


def snapshot(solver: FreeSurface3D) -> list[NDArray[np.float32]]:
    """Return every array that the state of the first scenario consists of."""
    return [getattr(solver, name)()[0] for name in ARRAYS]


@pytest.mark.parametrize("state", CASES)
def test_numpy_gives_the_same_bits(state: InitialState) -> None:
    """An independent float32 implementation agrees in every bit, walls included."""
    solver = start(state)
    reference = FreeSurfaceReference3D(solver.parameters, state)
    for substeps in (1, 9, 140):
        solver.advance(substeps)
        reference.advance(substeps)
        expected = [
            reference.position,
            reference.velocity,
            reference.affine,
            reference.deformation,
            reference.ratio,
        ]
        assert {array.dtype for array in expected} == {np.dtype(np.float32)}
        np.testing.assert_equal(snapshot(solver), expected)


def test_scenarios_of_these_tests_reach_walls_and_yield() -> None:
    """The comparisons cover mirrored nodes, friction and plastic flow."""
    solver = start(MIXED)
    near = (CONSTANTS["wall"] + 1.5) / CONSTANTS["grid"]
    touched = np.zeros(6, bool)
    for _ in range(15):
        solver.advance(10)
        position = solver.position()[0]
        gaps = [position.min(axis=0), 1.0 - position.max(axis=0)]
        touched |= np.concatenate(gaps) < near
    assert touched.sum() >= 4
    is_snow = MIXED.material == Material.SNOW
    assert solver.volume_ratio()[0, is_snow].min() < 0.97


@pytest.mark.parametrize("state", CASES)
def test_threads_and_orders_of_particles_change_no_bit(state: InitialState) -> None:
    """The serial driver, the parallel one, and the serial one with permuted
    particles.
    """
    order = np.random.default_rng(SEED).permutation(len(state.position))
    permuted = dataclasses.replace(
        state,
        position=state.position[order],
        velocity=state.velocity[order],
        affine=state.affine[order],
        material=state.material[order],
    )
    serial = start(state)
    serial.advance(150)
    expected = snapshot(serial)
    parallel = start(state, device=Device.PARALLEL)
    parallel.advance(150)
    np.testing.assert_equal(snapshot(parallel), expected)
    shuffled = start(permuted)
    shuffled.advance(150)
    np.testing.assert_equal(snapshot(shuffled), [array[order] for array in expected])


@pytest.mark.parametrize("material", Material)
def test_momentum_and_spin_are_conserved(material: Material) -> None:
    """Without gravity and walls, linear and angular momentum stay what they were."""
    spin = np.array([1.0, 2.0, -1.5])
    ball = pieces(Piece(material, Ball(0.15), (0.5, 0.5, 0.5), (0.0, 0.0, 0.0)))
    gradient = np.cross(np.eye(3), -spin).T  # C d = spin x d
    velocity = np.array([0.1, 0.2, 0.0]) + np.cross(spin, ball.position - 0.5)
    turning = dataclasses.replace(
        ball,
        velocity=quantise(velocity),
        affine=np.tile(gradient, (len(velocity), 1, 1)),
    )
    solver = start(turning, gravity=0.0)
    momentum = solver.velocity()[0].sum(axis=0, dtype=np.float64)
    before = angular_momentum(solver)
    solver.advance(60)
    after = solver.velocity()[0].sum(axis=0, dtype=np.float64)
    np.testing.assert_allclose(after, momentum, atol=1e-4 * len(velocity))
    change = np.linalg.norm(angular_momentum(solver) - before)
    assert change <= 2e-3 * np.linalg.norm(before)


def angular_momentum(solver: FreeSurface3D) -> Array:
    """Sum of r x v and of the APIC part, dx^2/4 times the axial vector of C - C^T."""
    r = solver.position()[0].astype(np.float64)
    v = solver.velocity()[0].astype(np.float64)
    c = solver.affine()[0].astype(np.float64)
    axial = np.stack(
        [
            c[:, 2, 1] - c[:, 1, 2],
            c[:, 0, 2] - c[:, 2, 0],
            c[:, 1, 0] - c[:, 0, 1],
        ],
        axis=1,
    )
    cell = 1.0 / solver.parameters.grid
    orbital = np.cross(r, v)
    return np.asarray((orbital + 0.25 * cell * cell * axial).sum(axis=0))


def test_energy_of_a_stretched_body_by_hand() -> None:
    """Moving, it has m v^2 / 2; stretched along x by s, V (mu + lambda / 2)
    (s - 1)^2.
    """
    state = pieces(Piece(Material.JELLY, Ball(0.15), (0.5, 0.5, 0.5), (0.5, -1.0, 1.0)))
    solver = start(state)
    energy = solver.energy()
    assert energy.kinetic[0] == pytest.approx(0.5 * state.area * 2.25)
    assert energy.elastic[0] == pytest.approx(0.0, abs=1e-12)
    rate = 30.0
    pulled = dataclasses.replace(
        state,
        velocity=quantise((state.position - 0.5) * (rate, 0.0, 0.0)),
        affine=np.tile(np.diag([rate, 0.0, 0.0]), (len(state.position), 1, 1)),
    )
    solver = start(pulled, gravity=0.0, jelly_modulus=1e-3)
    solver.advance(1)
    stretch = solver.deformation()[0, :, 0, 0].astype(np.float64)
    mu, la = lame(1e-3, 0.3)
    expected = state.area * (mu + 0.5 * la) * np.mean((stretch - 1.0) ** 2)
    assert stretch.mean() == pytest.approx(1.0 + rate * CONSTANTS["dt"], rel=1e-2)
    assert solver.energy().elastic[0] == pytest.approx(expected, rel=2e-2)


def test_friction_decelerates_by_mu_g() -> None:
    """A block that slides over a rough floor, askew, loses mu g of speed in a second
    along its way.
    """
    block = Block((0.2, 0.1, 0.2))
    height = CONSTANTS["wall"] / CONSTANTS["grid"] + 0.05
    velocity = (0.6, 0.0, 0.8)
    way = np.array(velocity)
    state = pieces(Piece(Material.JELLY, block, (0.35, height, 0.3), velocity))
    speeds = []
    for friction in (0.0, 0.2):
        solver = start(dataclasses.replace(state, friction=friction))
        solver.advance(120)
        mean = solver.velocity()[0].mean(axis=0, dtype=np.float64)
        speeds.append(float(mean @ way))
    time = 120 * CONSTANTS["dt"]
    assert (speeds[0] - speeds[1]) / time == pytest.approx(0.2 * 2.5, rel=0.15)


def test_free_flight_is_a_parabola() -> None:
    """A ball without spin moves by v t - g t (t + dt) / 2, as semi-implicit steps."""
    ball = Body(Ball(0.1), np.array((0.4, 0.6, 0.5)))
    position = sample_points(np.random.default_rng(0), ball, 300)
    velocity = (0.5, 0.25, -0.25)
    solver = start(liquid(position, np.tile(velocity, (300, 1)), Ball(0.1).volume))
    substeps = 60
    solver.advance(substeps)
    time = substeps * CONSTANTS["dt"]
    fall = 0.5 * CONSTANTS["gravity"] * time * (time + CONSTANTS["dt"])
    expected = np.array(velocity) * time - [0.0, fall, 0.0]
    moved = solver.position()[0].mean(axis=0) - position.mean(axis=0)
    assert moved == pytest.approx(expected, abs=2e-6)


@pytest.mark.parametrize("material", Material)
def test_a_flow_that_is_even_along_z_is_that_of_two_dimensions(
    material: Material,
) -> None:
    """Layers along z, two to a cell, have the weights of the plane.

    So the middle layer moves as the solver in two dimensions says, until the walls
    along z are felt: stress acts from the second substep on, and reaches three cells
    farther in each.
    """
    constants = CONSTANTS | {"grid": 32, "wall": 2}
    count = 150
    rng = np.random.default_rng(SEED)
    low = constants["wall"] / constants["grid"]
    plane = quantise(rng.uniform((low, low), (0.2, 0.25), (count, 2)))
    velocity = quantise(np.tile((-3.0, -2.0), (count, 1)))
    affine = quantise(30.0 * rng.random((count, 2, 2)) - 15.0)
    area = 0.02
    flat = build(FreeSurfaceParameters(particles=count, **constants))
    assert isinstance(flat, FreeSurface)
    flat.load(
        [
            InitialState(
                position=plane,
                velocity=velocity,
                affine=affine,
                material=np.full(count, material, np.int8),
                area=area,
            )
        ]
    )

    depth = 1.0 - 2.0 * low
    layer_count = round(2 * constants["grid"] * depth)
    layers = low + (np.arange(layer_count) + 0.5) / (2 * constants["grid"])
    position = np.empty((layer_count, count, 3))
    position[..., :2] = plane
    position[..., 2] = layers[:, None]
    velocities = np.zeros((layer_count, count, 3))
    velocities[..., :2] = velocity
    affines = np.zeros((layer_count, count, 3, 3))
    affines[..., :2, :2] = affine
    state = liquid(
        position.reshape(-1, 3),
        velocities.reshape(-1, 3),
        area * depth,
        affines.reshape(-1, 3, 3),
    )
    state = dataclasses.replace(
        state, material=np.full(len(state.material), material, np.int8)
    )
    solid = start(state, **constants)

    substeps = 5
    solid.advance(substeps)
    flat.advance(substeps)
    ratio = flat.volume_ratio()[0]
    assert flat.jacobian()[0].min() < 0.98  # stress has acted
    middle = layer_count // 2
    shape = (layer_count, count)
    position_of_middle = solid.position().reshape(*shape, 3)[middle]
    velocity_of_middle = solid.velocity().reshape(*shape, 3)[middle]
    ratio_of_middle = solid.volume_ratio().reshape(shape)[middle]
    assert position_of_middle[:, :2] == pytest.approx(flat.position()[0], abs=1e-6)
    assert position_of_middle[:, 2] == pytest.approx(layers[middle], abs=1e-6)
    assert velocity_of_middle[:, :2] == pytest.approx(flat.velocity()[0], abs=1e-4)
    assert ratio_of_middle == pytest.approx(ratio, abs=1e-5)


def test_a_splash_is_sound() -> None:
    """The energy never rises by more than 2 % of what is dissipated, particles stay in
    the box, no J reaches its bound.
    """
    size = load().size("fluid-3d", "tiny")
    state = draw_initial_state(size, 3)
    solver = build(size_constants(size))
    assert isinstance(solver, FreeSurface3D)
    solver.load([state])
    totals = []
    for _ in range(60):
        totals.append(float(solver.energy().total[0]))
        solver.advance(size.substeps_per_frame)
    rises = np.diff(totals)
    assert totals[-1] < totals[0]
    assert rises[rises > 0.0].sum() < 0.02 * (totals[0] - totals[-1])
    least, greatest = solver.volume_ratio_extremes()
    assert least.min() > 0.8
    assert greatest.max() == 1.0
    low, high = free_surface_walls(size)
    assert low < solver.position().min()
    assert solver.position().max() < high


def size_constants(size: Size) -> FreeSurface3DParameters:
    """Return the constants of a size of fluid-3d."""
    constants = solver_constants(size)
    assert isinstance(constants, FreeSurface3DParameters)
    return constants


@pytest.mark.parametrize(
    ("solid", "volume"),
    [
        (Ball(0.25), math.pi / 48),
        (Block((0.5, 0.25, 0.125)), 1 / 64),
        (Rod(0.5, 0.125, (0.0, 0.0, 1.0)), math.pi / 128),
    ],
)
def test_points_fill_solids_evenly(solid: Solid, volume: float) -> None:
    """The volume is the closed form's; the points lie inside and have its moments."""
    assert solid.volume == pytest.approx(volume)
    body = Body(solid, np.full(3, 0.5))
    points = sample_points(np.random.default_rng(1), body, 4000)
    local = points - 0.5
    assert solid.distance(local).max() < 1e-6
    assert local.mean(axis=0) == pytest.approx(np.zeros(3), abs=2e-3)
    moments = np.mean(local**2, axis=0)
    if isinstance(solid, Ball):
        expected = np.full(3, solid.radius**2 / 5.0)
    elif isinstance(solid, Rod):
        across = solid.radius**2 / 4.0
        expected = np.array([across, across, solid.length**2 / 12.0])
    else:
        assert isinstance(solid, Block)
        expected = np.array(solid.sides) ** 2 / 12.0
    assert moments == pytest.approx(expected, rel=2e-2)


def test_distances_of_solids() -> None:
    """Signed distances at points where they are known."""
    points = np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0], [0.3, 0.4, 0.0]])
    assert Ball(0.25).distance(points) == pytest.approx([-0.25, 0.25, 0.25])
    block = Block((0.4, 0.6, 1.0))
    assert block.distance(points) == pytest.approx([-0.2, 0.3, math.hypot(0.1, 0.1)])
    rod = Rod(0.6, 0.2, (0.0, 1.0, 0.0))
    assert rod.distance(points) == pytest.approx([-0.2, 0.3, math.hypot(0.1, 0.1)])


def test_a_turned_rod_fits_its_bounding_box() -> None:
    """Points of the surface reach the box and never leave it."""
    axis = np.array([2.0, -1.0, 2.0]) / 3.0
    rod = Rod(0.5, 0.1, (float(axis[0]), float(axis[1]), float(axis[2])))
    angle = np.linspace(0.0, 2.0 * np.pi, 721)[:, None]
    first = np.cross(axis, [0.0, 0.0, 1.0])
    first /= np.linalg.norm(first)
    second = np.cross(axis, first)
    rim = 0.1 * (np.cos(angle) * first + np.sin(angle) * second)
    end = 0.25 * axis + rim
    surface = np.concatenate([end, end - 0.5 * axis])
    assert np.abs(rod.distance(surface)).max() < 1e-12
    assert np.abs(surface).max(axis=0) == pytest.approx(rod.reach, rel=1e-4)


def test_solids_of_a_volume() -> None:
    """They have it, and a block the aspects asked for."""
    block = Block.of_volume(0.01, (0.8, 1.25))
    assert block.volume == pytest.approx(0.01, rel=1e-14)
    assert block.sides[0] / block.sides[1] == pytest.approx(0.8)
    assert block.sides[2] / block.sides[1] == pytest.approx(1.25)
    assert Ball.of_volume(0.01).volume == pytest.approx(0.01, rel=1e-14)
    values = np.geomspace(1e-6, 1e6, 200)
    roots = [cube_root(float(value)) for value in values]
    np.testing.assert_allclose(roots, np.cbrt(values), rtol=1e-15)


@pytest.mark.parametrize("size_name", ["tiny", "mini"])
def test_families_of_fluid_3d(size_name: str) -> None:
    """Families by id modulo 4; bodies lie in the box, a column stands on the floor
    along one axis, a splash has a ball above a pool at rest.
    """
    size = load().size("fluid-3d", size_name)
    low, high = free_surface_walls(size)
    for scenario in range(8):
        state = draw_initial_state(size, scenario)
        family = FAMILIES[scenario % 4]
        assert state.parameters["family"] == family
        assert low <= state.position.min()
        assert state.position.max() <= high
        extent = state.position.max(axis=0) - state.position.min(axis=0)
        if family == "dam-break":
            assert state.position[:, 1].min() < low + 0.03
            assert not state.velocity.any()
            along = 2 - 2 * (scenario // 4 % 2)
            assert extent[along] > 0.9 * (high - low)
        if family == "splash":
            moves = state.velocity.any(axis=1)
            assert 0.0 < moves.mean() < 0.3
            highest = state.position[~moves, 1].max()
            assert state.position[moves, 1].min() > highest


@pytest.mark.slow
def test_dam_break_in_three_dimensions_follows_the_experiment() -> None:
    """The front is within 5 % of Martin and Moyce (1952)."""
    result = dam_break.run("mini", "fluid-3d")
    assert result.deviation <= 0.05
    assert (np.diff(result.front) > 0.0).all()
