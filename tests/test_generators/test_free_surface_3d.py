"""A liquid with a free surface in a cube: bits, closed forms, the solver in two
dimensions, and the draws of fluid-3d.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from numpy.typing import NDArray

from lagbench.data.registry import Size, load
from lagbench.generators.batch import draw_initial_state
from lagbench.generators.constants import free_surface_walls, solver_constants
from lagbench.generators.draws import quantise
from lagbench.generators.fluid_3d import FAMILIES
from lagbench.generators.free_surface import FreeSurface
from lagbench.generators.free_surface_3d import FreeSurface3D
from lagbench.generators.shapes import Body, sample_points
from lagbench.generators.solids import Ball, Block, Solid
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


def start(
    state: InitialState, *, device: Device = Device.CPU, **changes: float
) -> FreeSurface3D:
    """Return a solver that stands at a state."""
    constants = FreeSurface3DParameters(
        particles=len(state.position), **(CONSTANTS | changes)
    )
    solver = build(constants, device=device)
    assert isinstance(solver, FreeSurface3D)
    solver.load([state])
    return solver


def test_threads_and_orders_of_particles_change_no_bit() -> None:
    """The serial driver, the parallel one, and the serial one with permuted
    particles.
    """
    state = falling_ball()
    order = np.random.default_rng(SEED).permutation(len(state.position))
    permuted = dataclasses.replace(
        state,
        position=state.position[order],
        velocity=state.velocity[order],
        affine=state.affine[order],
    )
    serial = start(state)
    serial.advance(150)
    shuffled = start(permuted)
    shuffled.advance(150)
    parallel = start(state, device=Device.PARALLEL)
    parallel.advance(150)

    for name in ("position", "velocity", "affine", "volume_ratio"):
        values = getattr(serial, name)()[0]
        assert np.array_equal(values, getattr(parallel, name)()[0])
        assert np.array_equal(values[order], getattr(shuffled, name)()[0])
    assert serial.position()[0, :, 1].min() < 0.13  # it has met the floor


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


def test_a_flow_that_is_even_along_z_is_that_of_two_dimensions() -> None:
    """Layers along z, two to a cell, have the weights of the plane.

    So the middle layer moves as the independent solver in two dimensions says, until
    the walls along z are felt: pressure acts from the second substep on, and reaches
    three cells farther in each.
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
                material=np.full(count, Material.LIQUID, np.int8),
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
    solid = start(state, **constants)

    substeps = 5
    solid.advance(substeps)
    flat.advance(substeps)
    ratio = flat.volume_ratio()[0]
    assert ratio.min() < 0.97  # pressure has acted
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
    [(Ball(0.25), math.pi / 48), (Block((0.5, 0.25, 0.125)), 1 / 64)],
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
    else:
        expected = np.array(solid.sides) ** 2 / 12.0
    assert moments == pytest.approx(expected, rel=2e-2)


def test_distances_of_solids() -> None:
    """Signed distances at points where they are known."""
    points = np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0], [0.3, 0.4, 0.0]])
    assert Ball(0.25).distance(points) == pytest.approx([-0.25, 0.25, 0.25])
    block = Block((0.4, 0.6, 1.0))
    assert block.distance(points) == pytest.approx([-0.2, 0.3, math.hypot(0.1, 0.1)])


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
