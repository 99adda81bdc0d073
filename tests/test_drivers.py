"""Drivers, threads, calls and orders of particles give one and the same result, bit by bit."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from typing import cast

import numpy as np
import pytest
from box_scenarios import ALL_LIDS, after, loaded, parameters, scenario, snapshot

from lagbench.errors import UsageError
from lagbench.generators.closed_box import ClosedBox
from lagbench.generators.solver import Device, build

NO_SLIP = parameters()
FREE_SLIP = parameters(no_slip=False, wall=1, velocity_relaxation=0.002, density_coupling=0.002, shift=0.002)


@pytest.mark.parametrize("threads", [1, 2])
def test_drivers_give_the_same_bits(threads: int) -> None:
    """Serial frames, and parallel phases with atomics over two scenarios, agree after 450 substeps."""
    states = [
        scenario(NO_SLIP, seed=4, speed=0.4, walls=ALL_LIDS),
        scenario(NO_SLIP, seed=5, speed=0.4, walls=(0.0, 0.0, 0.0, 0.3), viscosity=3e-3),
    ]
    together = after(NO_SLIP, states, 450, device=Device.PARALLEL, threads=threads)
    for index, state in enumerate(states):
        for name, values in after(NO_SLIP, [state], 450).items():
            np.testing.assert_array_equal(values[0], together[name][index], err_msg=name)


def test_threads_lose_no_contribution() -> None:
    """Two threads that add 20,000 particles to the same nine nodes, 100 times, lose none of them."""
    constants = parameters(particles=20_000, modulus=1e-30)
    state = scenario(constants)
    crowd = dataclasses.replace(
        state,
        position=np.full_like(state.position, 0.5),
        velocity=np.full_like(state.velocity, 0.25),
    )
    serial = after(constants, [crowd], 100)
    threaded = after(constants, [crowd], 100, device=Device.PARALLEL, threads=2)
    for name, values in serial.items():
        np.testing.assert_array_equal(values, threaded[name], err_msg=name)


def test_frames_do_not_matter() -> None:
    """450 substeps in one call and in calls of 50 give the same bits."""
    state = scenario(NO_SLIP, seed=6, speed=0.4, walls=ALL_LIDS)
    at_once = after(NO_SLIP, [state], 450)
    frames = loaded(NO_SLIP, [state])
    for _ in range(9):
        frames.advance(50)
    for name, values in snapshot(frames).items():
        np.testing.assert_array_equal(values, at_once[name], err_msg=name)


@pytest.mark.parametrize("device", [Device.CPU, Device.PARALLEL])
def test_the_order_of_particles_does_not_matter(device: Device) -> None:
    """Particles in another order move in the same way, bit by bit, over 450 substeps."""
    state = scenario(FREE_SLIP, seed=7, speed=0.4, viscosity=0.0)
    order = np.random.default_rng(8).permutation(FREE_SLIP.particles)
    shuffled = dataclasses.replace(
        state, position=state.position[order], velocity=state.velocity[order], affine=state.affine[order]
    )
    straight, mixed = after(FREE_SLIP, [state], 450), after(FREE_SLIP, [shuffled], 450, device=device)
    np.testing.assert_array_equal(straight.pop("grid_velocity"), mixed["grid_velocity"])
    for name, values in straight.items():
        np.testing.assert_array_equal(values[0][order], mixed[name][0], err_msg=name)


def test_the_serial_driver_takes_one_scenario() -> None:
    """More scenarios than the serial driver can hold are refused, with the way out."""
    with pytest.raises(UsageError, match="one worker per scenario"):
        build(NO_SLIP, device=Device.CPU, scenarios=2)


def test_more_threads_than_the_pool_are_refused() -> None:
    """Taichi's pool is fixed by the first solver of a process."""
    loaded(NO_SLIP, [scenario(NO_SLIP)])
    with pytest.raises(UsageError, match="another process"):
        build(NO_SLIP, device=Device.PARALLEL, threads=10_000)


def test_a_closed_solver_leaves_the_others_alone() -> None:
    """Releasing one solver's memory changes no bit of another one that goes on."""
    state = scenario(NO_SLIP, seed=11, speed=0.4, walls=ALL_LIDS)
    expected = after(NO_SLIP, [state], 60)
    solver, other = loaded(NO_SLIP, [state]), build(parameters(grid=20))
    solver.advance(30)
    cast("ClosedBox", other).close()
    solver.advance(30)
    for name, values in snapshot(solver).items():
        np.testing.assert_array_equal(values, expected[name], err_msg=name)


def test_taichi_is_imported_late_and_quietly() -> None:
    """Importing the solver leaves Taichi alone; building one prints nothing."""
    script = (
        "import sys, lagbench.generators.solver as solver\n"
        "assert 'taichi' not in sys.modules\n"
        "from lagbench.generators.split import ClosedBoxParameters\n"
        f"solver.build({NO_SLIP!r})\n"
        "assert 'taichi' in sys.modules\n"
    )
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert result.stdout == ""


@pytest.mark.parametrize("device", [Device.CPU, Device.PARALLEL])
def test_a_wall_program_is_a_wall_moved_by_hand(device: Device) -> None:
    """Two programs, one shorter than the run, in calls that end within frames, act frame by frame."""
    constants = parameters(substeps_per_frame=10)
    states = [
        scenario(constants, seed=seed, walls=ALL_LIDS, frames=count) for seed, count in ((1, 9), (2, 5))
    ]
    states = states[: 1 if device is Device.CPU else 2]
    solver = loaded(constants, states, device=device)
    for substeps in (3, 17, 25, 20, 5):
        solver.advance(substeps)
    programmed = snapshot(solver)
    health = solver.health()
    resting = [dataclasses.replace(state, wall_velocity=np.zeros((4, 2))) for state in states]
    by_hand = loaded(constants, resting, device=device)
    for frame in range(1, 8):
        rows = [state.wall_velocity[min(frame, len(state.wall_velocity) - 1)] for state in states]
        by_hand.move_walls(np.stack(rows).astype(np.float32))
        by_hand.advance(10)
    for name, values in snapshot(by_hand).items():
        np.testing.assert_array_equal(values, programmed[name], err_msg=name)
    assert np.abs(programmed["velocity"]).max() > 0.01
    assert health[0].max_speed > 0.0


def test_extremes_of_an_advance_span_its_frames() -> None:
    """A wall that is fast in the first of three frames only shows in the health of the whole advance."""
    constants = parameters(substeps_per_frame=10)
    state = scenario(constants, seed=3, viscosity=1e-2)
    program = np.zeros((4, 4, 2))
    program[1, 3, 0] = 0.5
    state = dataclasses.replace(state, wall_velocity=program)
    solver = loaded(constants, [state])
    solver.advance(30)
    fastest = solver.health()[0].max_speed
    solver.load([state])
    solver.advance(10)
    first = solver.health()[0].max_speed
    solver.advance(20)
    assert solver.health()[0].max_speed < first == fastest
