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
from scipy.spatial import cKDTree
from turns import of_this_turn

from lagbench.data.registry import Size, load
from lagbench.generators.batch import draw_initial_state
from lagbench.generators.constants import free_surface_walls, solver_constants
from lagbench.generators.constitutive import lame
from lagbench.generators.draws import quantise
from lagbench.generators.fluid_3d import FAMILIES
from lagbench.generators.free_surface import FreeSurface, courant
from lagbench.generators.multimaterial import PAIRS
from lagbench.generators.shapes import (
    Ball,
    Block,
    Body,
    Rod,
    Shape,
    body_at,
    sample_points,
)
from lagbench.generators.solver import build
from lagbench.generators.split import (
    Device,
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
PARTICLES = 408
"""Of nearly all tests, since a solver of another number compiles anew."""


Vector = tuple[float, float, float]


def full_of(material: Material, count: int) -> NDArray[np.int8]:
    """Return the materials of particles that are all alike."""
    return np.full(count, material, np.int8)


def alike(velocity: tuple[float, ...], count: int) -> Array:
    """Return the velocities of particles that move as one."""
    return np.tile(velocity, (count, 1))


def liquid(
    position: Array,
    velocity: Array,
    volume: float,
    affine: Array | None = None,
) -> InitialState:
    """Return an initial state of liquid in a cube."""
    count = len(position)
    if affine is None:
        affine = np.zeros((count, 3, 3))
    return InitialState(
        position=quantise(position),
        velocity=quantise(velocity),
        affine=quantise(affine),
        material=full_of(Material.LIQUID, count),
        area=volume,
        wall_velocity=np.zeros((6, 3)),
    )


@functools.cache
def compiled(device: Device, particle_count: int) -> FreeSurface:
    """Return a solver; one of as many particles is taken again, since it compiles.

    The first steps take ten seconds of compilation, so the tests with one are slow.
    """
    constants = FreeSurfaceParameters(
        particles=particle_count, dimension=3, **CONSTANTS
    )
    solver = build(constants, device=device)
    assert isinstance(solver, FreeSurface)
    return solver


def start(state: InitialState, *, device: Device = Device.CPU) -> FreeSurface:
    """Return a solver that stands at a state; the next call may take it over."""
    solver = compiled(device, len(state.position))
    solver.load([state])
    return solver


@dataclass(frozen=True)
class Piece:
    """A body: what it is made of, its shape, where it lies and how fast it moves."""

    material: Material
    solid: Shape
    centre: Vector
    velocity: Vector


def pieces(
    *parts: Piece,
    count: int = PARTICLES,
    friction: float = 0.0,
    spin: float = 0.0,
) -> InitialState:
    """Fill bodies with particles by volume; each flies and turns at random."""
    rng = np.random.default_rng(SEED)
    volumes = np.array([part.solid.measure for part in parts])
    shares = np.append(0.0, volumes.cumsum()) / volumes.sum()
    ends = np.rint(shares * count).astype(int)
    counts = np.diff(ends)
    bodies = []
    for part, n in zip(parts, counts, strict=True):
        body = body_at(part.solid, *part.centre)
        bodies.append(sample_points(rng, body, n))
    velocities = np.array([part.velocity for part in parts])
    velocity = np.repeat(velocities, counts, axis=0)
    materials = np.array([part.material for part in parts], np.int8)
    gradient = 2.0 * rng.random((count, 3, 3)) - 1.0
    return InitialState(
        position=np.concatenate(bodies),
        velocity=quantise(velocity),
        affine=quantise(spin * gradient),
        material=np.repeat(materials, counts),
        area=float(volumes.sum()),
        wall_velocity=np.zeros((6, 3)),
        friction=friction,
    )


BLOCK = Block((0.2, 0.2, 0.2))
ROPE = Rod(0.5, 0.06, (0.6, 0.0, 0.8))


def falling(material: Material, friction: float = 0.0) -> InitialState:
    """Return two bodies that hit opposite corners at once."""
    low_corner = (0.24, 0.24, 0.3)
    high_corner = (0.76, 0.76, 0.7)
    return pieces(
        Piece(material, BLOCK, low_corner, (-1.5, -1.5, 1.0)),
        Piece(material, Ball(0.1), high_corner, (2.0, 1.0, 1.0)),
        friction=friction,
        spin=4.0,
    )


BALL = Ball(0.12)
MIXED = pieces(
    Piece(Material.LIQUID, BALL, (0.3, 0.3, 0.3), (1.0, -2.0, 0.0)),
    Piece(Material.SNOW, BLOCK, (0.6, 0.26, 0.3), (0.0, -1.0, -1.5)),
    Piece(Material.JELLY, BALL, (0.6, 0.26, 0.65), (-1.0, -1.0, 1.0)),
    Piece(Material.ROPE, ROPE, (0.5, 0.6, 0.5), (0.5, 1.0, 0.5)),
    friction=0.3,
)
CASES = [
    *(pytest.param(falling(m), id=m.name.lower()) for m in Material),
    pytest.param(falling(Material.SNOW, friction=0.3), id="snow with friction"),
    pytest.param(MIXED, id="all four"),
]
ARRAYS = ("position", "velocity", "affine", "deformation", "volume_ratio")


def snapshot(solver: FreeSurface) -> list[NDArray[np.float32]]:
    """Return every array that the state of the first scenario consists of."""
    first_scenario = []
    for name in ARRAYS:
        values = getattr(solver, name)()
        first_scenario.append(values[0])
    return first_scenario


@pytest.mark.slow
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


@pytest.mark.slow
@pytest.mark.parametrize("state", CASES)
def test_threads_and_orders_of_particles_change_no_bit(state: InitialState) -> None:
    """The serial driver, the parallel one, and the serial one with permuted
    particles.
    """
    rng = np.random.default_rng(SEED)
    order = rng.permutation(len(state.position))
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
    permuted_arrays = [array[order] for array in expected]
    np.testing.assert_equal(snapshot(shuffled), permuted_arrays)


CENTRE = (0.5, 0.5, 0.5)
AT_REST = (0.0, 0.0, 0.0)


def total_momentum(solver: FreeSurface) -> Array:
    """Return the sum of velocities, per unit particle mass."""
    velocity = solver.velocity()[0]
    return velocity.sum(axis=0, dtype=np.float64)


@pytest.mark.slow
@pytest.mark.parametrize("material", Material)
def test_momentum_and_spin_are_conserved(material: Material) -> None:
    """Far from walls momentum changes by the weight alone, and the angular momentum
    about the centre of mass stays what it was.
    """
    spin = np.array([1.0, 2.0, -1.5])
    piece = Piece(material, Ball(0.15), CENTRE, AT_REST)
    ball = pieces(piece)
    gradient = np.cross(np.eye(3), -spin).T  # C d = spin x d
    drift = np.array([0.1, 0.2, 0.0])
    rotation = np.cross(spin, ball.position - 0.5)
    count = len(ball.position)
    turning = dataclasses.replace(
        ball,
        velocity=quantise(drift + rotation),
        affine=np.tile(gradient, (count, 1, 1)),
    )
    solver = start(turning)
    momentum = total_momentum(solver)
    before = angular_momentum(solver)
    substeps = 60
    solver.advance(substeps)
    time = substeps * CONSTANTS["dt"]
    gain = np.array([0.0, -count * CONSTANTS["gravity"] * time, 0.0])
    after = total_momentum(solver)
    np.testing.assert_allclose(after, momentum + gain, atol=1e-4 * count)
    change = np.linalg.norm(angular_momentum(solver) - before)
    assert change <= 2e-3 * np.linalg.norm(before)


def angular_momentum(solver: FreeSurface) -> Array:
    """Sum of r x v about the centre of mass and of the APIC part, dx^2/4 times the
    axial vector of C - C^T.
    """
    position = solver.position()[0].astype(np.float64)
    r = position - position.mean(axis=0)
    v = solver.velocity()[0].astype(np.float64)
    c = solver.affine()[0].astype(np.float64)
    antisymmetric = c - c.transpose(0, 2, 1)
    axial_x = antisymmetric[:, 2, 1]
    axial_y = antisymmetric[:, 0, 2]
    axial_z = antisymmetric[:, 1, 0]
    axial = np.stack([axial_x, axial_y, axial_z], axis=1)
    cell = 1.0 / solver.parameters.grid
    orbital = np.cross(r, v)
    spin = 0.25 * cell * cell * axial
    return np.asarray((orbital + spin).sum(axis=0))


@pytest.mark.slow
def test_energy_of_a_stretched_body_by_hand() -> None:
    """Moving, it has m v^2 / 2; stretched along x by s, V (mu + lambda / 2)
    (s - 1)^2.
    """
    piece = Piece(Material.JELLY, Ball(0.15), CENTRE, (0.5, -1.0, 1.0))
    state = pieces(piece)
    solver = start(state)
    energy = solver.energy()
    kinetic = 0.5 * state.area * 2.25
    assert energy.kinetic[0] == pytest.approx(kinetic)
    assert energy.elastic[0] == pytest.approx(0.0, abs=1e-12)
    rate = 30.0
    along_x = np.array([rate, 0.0, 0.0])
    velocity = (state.position - 0.5) * along_x
    count = len(state.position)
    pulled = dataclasses.replace(
        state,
        velocity=quantise(velocity),
        affine=np.tile(np.diag(along_x), (count, 1, 1)),
    )
    solver = start(pulled)
    solver.advance(1)
    deformation = solver.deformation()[0].astype(np.float64)
    stretch = deformation[:, 0, 0]
    p = solver.parameters
    mu, la = lame(p.jelly_modulus, p.jelly_poisson)
    mean_square = np.mean((stretch - 1.0) ** 2)
    expected = state.area * (mu + 0.5 * la) * mean_square
    expected_stretch = 1.0 + rate * CONSTANTS["dt"]
    elastic = solver.energy().elastic[0]
    assert stretch.mean() == pytest.approx(expected_stretch, rel=1e-2)
    assert elastic == pytest.approx(expected, rel=2e-2)


@functools.cache
def compiled_in_the_plane(particle_count: int) -> FreeSurface:
    """Return a solver in two dimensions."""
    parameters = FreeSurfaceParameters(particles=particle_count, **CONSTANTS)
    solver = build(parameters)
    assert isinstance(solver, FreeSurface)
    return solver


@pytest.mark.slow
@pytest.mark.parametrize("material", Material)
def test_a_flow_that_is_even_along_z_is_that_of_two_dimensions(
    material: Material,
) -> None:
    """Layers along z, two to a cell, have the weights of the plane.

    So the middle layer moves as the solver in two dimensions says, until the walls
    along z are felt: stress acts from the second substep on. It comes from the node
    above the wall, reaches a cell and a half beyond it, and two cells farther in each.
    """
    low = CONSTANTS["wall"] / CONSTANTS["grid"]
    depth = 1.0 - 2.0 * low
    layers_per_length = 2 * CONSTANTS["grid"]
    layer_count = round(layers_per_length * depth)
    count = PARTICLES // layer_count
    rng = np.random.default_rng(SEED)
    corner = rng.uniform((low, low), (0.22, 0.28), (count, 2))
    gradient = 30.0 * rng.random((count, 2, 2)) - 15.0
    plane = quantise(corner)
    velocity = quantise(alike((-3.0, -2.0), count))
    affine = quantise(gradient)
    area = 0.02
    flat = compiled_in_the_plane(count)
    flat_state = InitialState(
        position=plane,
        velocity=velocity,
        affine=affine,
        material=full_of(material, count),
        area=area,
    )
    flat.load([flat_state])

    middles = np.arange(layer_count) + 0.5
    layers = low + middles / layers_per_length
    shape = (layer_count, count)
    position = np.empty((*shape, 3))
    position[..., :2] = plane
    position[..., 2] = layers[:, None]
    velocities = np.zeros((*shape, 3))
    velocities[..., :2] = velocity
    affines = np.zeros((*shape, 3, 3))
    affines[..., :2, :2] = affine
    state = liquid(
        position.reshape(-1, 3),
        velocities.reshape(-1, 3),
        area * depth,
        affines.reshape(-1, 3, 3),
    )
    materials = full_of(material, layer_count * count)
    state = dataclasses.replace(state, material=materials)
    solid = start(state)

    substeps = 3
    solid.advance(substeps)
    flat.advance(substeps)
    ratio = flat.volume_ratio()[0]
    assert flat.jacobian()[0].min() < 0.98  # stress has acted
    middle = layer_count // 2
    solid_position = solid.position().reshape(*shape, 3)[middle]
    solid_velocity = solid.velocity().reshape(*shape, 3)[middle]
    solid_ratio = solid.volume_ratio().reshape(shape)[middle]
    xy = solid_position[:, :2]
    z = solid_position[:, 2]
    plane_velocity = solid_velocity[:, :2]
    assert xy == pytest.approx(flat.position()[0], abs=1e-6)
    assert z == pytest.approx(layers[middle], abs=1e-6)
    assert plane_velocity == pytest.approx(flat.velocity()[0], abs=1e-4)
    assert solid_ratio == pytest.approx(ratio, abs=1e-5)


@pytest.mark.slow
def test_a_splash_is_sound() -> None:
    """The energy never rises by more than 2 % of what is dissipated, particles stay in
    the box, no J reaches its bound.
    """
    size = load().size("fluid-3d", "tiny")
    state = draw_initial_state(size, 3)
    solver = build(size_constants(size))
    assert isinstance(solver, FreeSurface)
    solver.load([state])
    totals = []
    for _ in range(60):
        energy = solver.energy()
        totals.append(float(energy.total[0]))
        solver.advance(size.substeps_per_frame)
    rises = np.diff(totals)
    assert totals[-1] < totals[0]
    all_rises = rises[rises > 0.0].sum()
    dissipated = totals[0] - totals[-1]
    assert all_rises < 0.02 * dissipated
    least, greatest = solver.volume_ratio_extremes()
    assert least.min() > 0.8
    assert greatest.max() == 1.0
    low, high = free_surface_walls(size)
    assert low < solver.position().min()
    assert solver.position().max() < high


def size_constants(size: Size) -> FreeSurfaceParameters:
    """Return the constants of a size of fluid-3d."""
    constants = solver_constants(size)
    assert isinstance(constants, FreeSurfaceParameters)
    return constants


@pytest.mark.parametrize(
    ("solid", "volume"),
    [
        (Ball(0.25), math.pi / 48),
        (Block((0.5, 0.25, 0.125)), 1 / 64),
        (Rod(0.5, 0.125, (0.0, 0.0, 1.0)), math.pi / 128),
    ],
)
def test_points_fill_solids_evenly(solid: Shape, volume: float) -> None:
    """The volume is the closed form's; the points lie inside and have its moments."""
    assert solid.measure == pytest.approx(volume)
    body = Body(solid, np.full(3, 0.5))
    rng = np.random.default_rng(1)
    points = sample_points(rng, body, 4000)
    local = points - 0.5
    centre = local.mean(axis=0)
    assert solid.distance(local).max() < 1e-6
    assert centre == pytest.approx(np.zeros(3), abs=2e-3)
    moments = np.mean(local**2, axis=0)
    if isinstance(solid, Ball):
        expected = np.full(3, solid.radius**2 / 5.0)
    elif isinstance(solid, Rod):
        across = solid.radius**2 / 4.0
        along = solid.length**2 / 12.0
        expected = np.array([across, across, along])
    else:
        assert isinstance(solid, Block)
        expected = np.array(solid.sides) ** 2 / 12.0
    assert moments == pytest.approx(expected, rel=2e-2)


def test_distances_of_solids() -> None:
    """Signed distances at points where they are known."""
    points = np.array(
        [
            [0.0, 0.0, 0.0],
            [0.5, 0.0, 0.0],
            [0.3, 0.4, 0.0],
        ]
    )
    from_edge = math.hypot(0.1, 0.1)
    of_ball = Ball(0.25).distance(points)
    of_block = Block((0.4, 0.6, 1.0)).distance(points)
    of_rod = Rod(0.6, 0.2, (0.0, 1.0, 0.0)).distance(points)
    assert of_ball == pytest.approx([-0.25, 0.25, 0.25])
    assert of_block == pytest.approx([-0.2, 0.3, from_edge])
    assert of_rod == pytest.approx([-0.2, 0.3, from_edge])


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


@pytest.mark.parametrize("size_name", ["tiny", "mini"])
def test_pairs_of_multimaterial_3d(size_name: str) -> None:
    """Pairs by id modulo 6 lie in the box, apart from each other; particles follow the
    volumes; both fly towards one point; walls are rough where nothing is liquid.
    """
    size = load().size("multimaterial-3d", size_name)
    low, high = free_surface_walls(size)
    for scenario in range(12):
        state = draw_initial_state(size, scenario)
        pair = PAIRS[scenario % 6]
        stated = state.parameters
        assert stated["pair"] == "-".join(kind.name.lower() for kind in pair)
        assert low < state.position.min()
        assert state.position.max() < high
        share = float(stated["first_volume"]) / state.area
        count = round(share * size.particles)
        first = state.position[:count]
        second = state.position[count:]
        assert set(state.material[:count]) == {pair[0]}
        assert set(state.material[count:]) == {pair[1]}
        gap = cKDTree(first).query(second)[0].min()
        assert gap >= size.value("gap")
        assert (state.friction > 0.0) == (Material.LIQUID not in pair)
        centres = np.stack([first.mean(axis=0), second.mean(axis=0)])
        velocities = state.velocity[[0, -1]]
        meeting = centres + velocities / float(stated["attraction"])
        np.testing.assert_allclose(meeting[0], meeting[1], atol=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("scenario", of_this_turn(range(6), turns=3))
def test_pairs_of_materials_are_sound(scenario: int) -> None:
    """The energy never rises by more than 2 % of what is dissipated, and no solid
    inverts.
    """
    size = load().size("multimaterial-3d", "tiny")
    state = draw_initial_state(size, scenario)
    constants = solver_constants(size)
    assert isinstance(constants, FreeSurfaceParameters)
    assert max(courant(constants).values()) <= 0.8
    solver = solver_of_pairs(constants)
    solver.load([state])
    totals = []
    for _ in range(30):
        totals.append(float(solver.energy().total[0]))
        solver.advance(2 * size.substeps_per_frame)
        (health,) = solver.health()
        assert health.jacobian_min > 0.2
        assert health.max_speed * constants.dt * constants.grid <= 0.8
    highest_rise = np.max(totals - np.minimum.accumulate(totals))
    assert highest_rise <= 0.02 * (totals[0] - min(totals))


@functools.cache
def solver_of_pairs(constants: FreeSurfaceParameters) -> FreeSurface:
    """Return a solver; it is taken again, since it compiles."""
    solver = build(constants)
    assert isinstance(solver, FreeSurface)
    return solver


@pytest.mark.slow
def test_dam_break_in_three_dimensions_follows_the_experiment() -> None:
    """The front is within 5 % of Martin and Moyce (1952)."""
    result = dam_break.run("mini", "fluid-3d")
    assert result.deviation <= 0.05
    assert (np.diff(result.front) > 0.0).all()
