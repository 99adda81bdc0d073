"""Drivers, threads, calls, orders of particles and the environment change no bit of a
result.
"""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
from typing import cast

import numpy as np
import pytest
from box_scenarios import (
    ALL_LIDS,
    FREE_SLIP,
    NO_SLIP,
    after,
    loaded,
    parameters,
    scenario,
    snapshot,
)

from lagbench.errors import UsageError
from lagbench.generators import backend
from lagbench.generators.full_box import FullBox
from lagbench.generators.solver import build
from lagbench.generators.split import Device


@pytest.mark.slow
@pytest.mark.parametrize("threads", [1, 2])
def test_drivers_give_the_same_bits(threads: int) -> None:
    """Serial frames, and parallel phases with atomics over two scenarios, agree after
    450 substeps.
    """
    constants, sliding = (NO_SLIP, 1.0) if threads == 2 else (FREE_SLIP, 0.0)
    left, right, bottom, top = (sliding * lid for lid in ALL_LIDS)
    states = [
        scenario(constants, seed=4, speed=0.4, walls=(left, right, bottom, top)),
        scenario(
            constants,
            seed=5,
            speed=0.4,
            walls=(0.0, 0.0, 0.0, top),
            viscosity=3e-3,
        ),
    ]
    together = after(constants, states, 450, device=Device.PARALLEL, threads=threads)
    for index, state in enumerate(states):
        own = {name: values[index : index + 1] for name, values in together.items()}
        np.testing.assert_equal(own, after(constants, [state], 450))


def test_what_the_runtime_cannot_do_is_refused() -> None:
    """The serial driver takes one scenario; the first solver of a process fixes the
    pool of threads.
    """
    loaded(NO_SLIP, [scenario(NO_SLIP)])
    with pytest.raises(UsageError) as caught:
        build(NO_SLIP, device=Device.CPU, scenarios=2)
    assert caught.value.where == "device cpu"
    with pytest.raises(UsageError) as caught:
        build(NO_SLIP, device=Device.PARALLEL, threads=10_000)
    assert caught.value.where == "device parallel"


def test_a_closed_solver_leaves_the_others_alone() -> None:
    """Releasing one solver's memory changes no bit of another one that goes on."""
    state = scenario(NO_SLIP, seed=11, speed=0.4, walls=ALL_LIDS)
    expected = after(NO_SLIP, [state], 60)
    solver = loaded(NO_SLIP, [state])
    other = build(parameters(grid=20))
    solver.advance(30)
    cast("FullBox", other).close()
    solver.advance(30)
    np.testing.assert_equal(snapshot(solver), expected)


def test_the_engine_is_imported_late_and_quietly() -> None:
    """Importing the solver leaves its engine alone; building one prints nothing."""
    script = (
        "import sys, lagbench.generators.solver as solver\n"
        "from lagbench.work.engine import ENGINES\n"
        "assert not set(ENGINES) & set(sys.modules)\n"
        "from lagbench.data.box import Box\n"
        "from lagbench.generators.full_box_parameters import FullBoxParameters\n"
        f"solver.build({NO_SLIP!r})\n"
        "assert set(ENGINES) & set(sys.modules)\n"
    )
    result = subprocess.run(
        [sys.executable, "-c", script],
        capture_output=True,
        text=True,
        check=True,
    )
    assert result.stdout == ""


@pytest.mark.parametrize(
    "device", [Device.CPU, pytest.param(Device.PARALLEL, marks=pytest.mark.slow)]
)
def test_a_wall_program_is_a_wall_moved_by_hand(device: Device) -> None:
    """Two programs, one shorter than the run, in calls that end within frames, act
    frame by frame.
    """
    lengths = {1: 11} if device is Device.CPU else {1: 11, 2: 5}
    states = [
        scenario(NO_SLIP, seed=k, walls=ALL_LIDS, frames=n) for k, n in lengths.items()
    ]
    solver = loaded(NO_SLIP, states, device=device)
    for substeps in (3, 17, 25, 20, 5):
        solver.advance(substeps)
    programmed = snapshot(solver)
    health = solver.health()
    resting = [
        dataclasses.replace(state, wall_velocity=np.zeros((4, 2))) for state in states
    ]
    by_hand = loaded(NO_SLIP, resting, device=device)
    for frame in range(1, 11):
        rows = [
            state.wall_velocity[min(frame, len(state.wall_velocity) - 1)]
            for state in states
        ]
        by_hand.move_walls(np.stack(rows).astype(np.float32))
        by_hand.advance(7)
    np.testing.assert_equal(snapshot(by_hand), programmed)
    assert np.abs(programmed["velocity"]).max() > 0.01
    assert health[0].max_speed > 0.0


def test_extremes_of_an_advance_span_its_frames() -> None:
    """A wall that is fast in the first of three frames only shows in the health of the
    whole advance.
    """
    program = np.zeros((4, 4, 2))
    program[1, 3, 0] = 0.5
    state = dataclasses.replace(
        scenario(NO_SLIP, seed=3, viscosity=1e-2), wall_velocity=program
    )
    solver = loaded(NO_SLIP, [state])
    solver.advance(21)
    fastest = solver.health()[0].max_speed
    solver.load([state])
    solver.advance(7)
    first = solver.health()[0].max_speed
    solver.advance(14)
    assert solver.health()[0].max_speed < first == fastest


START = """
from lagbench.generators import backend
from lagbench.generators.split import Device
backend.start(Device.CPU)
config = backend.ti.lang.impl.current_cfg()
print(config.arch, config.opt_level, config.advanced_optimization, config.debug)
import os
names = [name for name in os.environ if name.startswith("TI_")]
print(sorted(name for name in names if "VERSION" not in name))
"""

HOSTILE = {
    "TI_ARCH": "vulkan",
    "TI_OPT_LEVEL": "0",
    "TI_ADVANCED_OPTIMIZATION": "0",
}
HOSTILE |= {"TI_DEBUG": "1", "TI_DEFAULT_FP": "64"}


def started(**variables: str) -> list[str]:
    """Return what a fresh process prints about the runtime that it started."""
    own = {
        name: value for name, value in os.environ.items() if not name.startswith("TI_")
    } | variables
    command = [sys.executable, "-c", START]
    done = subprocess.run(
        command,
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
        env=own,
    )
    return done.stdout.splitlines()


@pytest.mark.slow
def test_the_environment_does_not_choose_the_arithmetic() -> None:
    """Device, optimisation and checks are the same with hostile variables, which stay
    as they were.
    """
    clean = started()
    hostile = started(**HOSTILE)
    assert clean[0].startswith(("Arch.x64", "Arch.arm64"))
    assert hostile[0] == clean[0]
    assert hostile[1] == str(sorted(HOSTILE))


REFUSED = """
from lagbench.errors import UsageError
from lagbench.generators import backend
from lagbench.generators.split import Device
try:
    backend.start(Device.CPU)
except UsageError as error:
    print(error.where)
"""


@pytest.mark.parametrize("name", backend.MEMORY_VARIABLES)
def test_a_variable_of_the_engine_that_is_no_number_is_named(name: str) -> None:
    """A fresh process refuses to start the runtime, without a traceback."""
    done = subprocess.run(
        [sys.executable, "-c", REFUSED],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
        env=os.environ | {name: "four"},
    )
    assert done.stdout == f"{name}\n"
