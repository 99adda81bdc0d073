"""The free-surface solver's bits: drivers, orders of particles and NumPy agree
exactly.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from free_surface_scenarios import Part, parameters, run, scenario, snapshot
from reference_free_surface import FreeSurfaceReference

from lagbench.generators.free_surface import FreeSurface
from lagbench.generators.shapes import Disc, Rectangle
from lagbench.generators.split import Device, InitialState, Material
from lagbench.work.machine import available_cores

# Each module of kernels takes seconds to compile.
pytestmark = pytest.mark.slow

CONSTANTS = parameters()
SQUARE = Rectangle(0.2, 0.2)
DISC = Disc(0.1)
ROPE = Rectangle(0.6, 0.06, (0.8, 0.6))


def falling(material: Material, friction: float = 0.0) -> InitialState:
    """Two bodies that hit opposite corners at once and come apart."""
    low = Part(material, SQUARE, (0.2, 0.18), (-1.5, -1.5))
    high = Part(material, DISC, (0.8, 0.8), (2.0, 1.0))
    return scenario(
        CONSTANTS,
        low,
        high,
        seed=int(material),
        friction=friction,
        spin=4.0,
    )


def cornered(gap: float, high: bool) -> InitialState:
    """One resting square of liquid that keeps a gap from two walls [cells]."""
    middle = CONSTANTS.wall + gap
    centre = middle / CONSTANTS.grid + 0.1
    if high:
        centre = 1.0 - centre
    square = Part(Material.LIQUID, SQUARE, (centre, centre))
    return scenario(CONSTANTS, square, spin=4.0)


MIXED = scenario(
    CONSTANTS,
    Part(Material.LIQUID, SQUARE, (0.2, 0.35), (1.0, -2.0)),
    Part(Material.SNOW, DISC, (0.45, 0.2), (0.0, -1.0)),
    Part(Material.JELLY, DISC, (0.7, 0.2), (-1.0, -1.0)),
    Part(Material.ROPE, ROPE, (0.5, 0.6), (0.5, 0.5)),
    friction=0.3,
    seed=9,
)
BRAKED_SNOW = falling(Material.SNOW, friction=0.3)
CASES = [
    *(pytest.param(falling(m), id=m.name.lower()) for m in Material),
    pytest.param(BRAKED_SNOW, id="snow with friction"),
    pytest.param(MIXED, id="all four"),
]


@pytest.mark.parametrize("state", CASES)
def test_numpy_gives_the_same_bits(state: InitialState) -> None:
    reference = FreeSurfaceReference(CONSTANTS, state)
    reference.advance(100)
    shape = (CONSTANTS.particles, 2, 2)
    expected = [
        reference.position,
        reference.velocity,
        np.stack(reference.affine, axis=1).reshape(shape),
        np.stack(reference.deformation, axis=1).reshape(shape),
        reference.ratio,
    ]
    solved = [array[0] for array in run(CONSTANTS, [state], 100)]
    np.testing.assert_equal(solved, expected)


@pytest.mark.skipif(available_cores() < 2, reason="one processor")
@pytest.mark.parametrize("state", CASES)
def test_atomic_adds_from_two_threads_change_no_bit(state: InitialState) -> None:
    serial = run(CONSTANTS, [state], 400)
    parallel = run(CONSTANTS, [state], 400, device=Device.PARALLEL, threads=2)
    np.testing.assert_equal(parallel, serial)


@pytest.mark.parametrize("high", [False, True])
@pytest.mark.parametrize("gap", [0.6, 1.0, 1.6])
def test_rows_beyond_a_wall_are_never_stale(gap: float, high: bool) -> None:
    """Nodes that walls mirror are cleared even if no particle touches them.

    The serial driver visits only nodes near particles. Here a first scenario fills the
    rows beyond two walls; the second lies near these walls without touching those rows.
    """
    state = cornered(gap, high)
    parallel = run(
        CONSTANTS,
        [state],
        20,
        device=Device.PARALLEL,
        threads=1,
    )
    beyond_the_walls = cornered(0.05, high)
    run(CONSTANTS, [beyond_the_walls], 5)
    serial = run(CONSTANTS, [state], 20)
    np.testing.assert_equal(serial, parallel)


def test_batched_scenarios_do_not_touch_each_other() -> None:
    """Scenarios of other materials, areas and frictions in one batch equal each one
    alone.
    """
    liquid = falling(Material.LIQUID)
    states = [liquid, BRAKED_SNOW, MIXED]
    together = run(CONSTANTS, states, 200, device=Device.PARALLEL)
    for index, state in enumerate(states):
        member = [array[[index]] for array in together]
        alone = run(CONSTANTS, [state], 200)
        np.testing.assert_equal(member, alone)


@pytest.mark.parametrize("state", CASES)
def test_order_of_particles_does_not_matter(state: InitialState) -> None:
    """Permuted particles give permuted results, bit for bit, over 400 substeps."""
    rng = np.random.default_rng(4)
    order = rng.permutation(CONSTANTS.particles)
    permuted = dataclasses.replace(
        state,
        position=state.position[order],
        velocity=state.velocity[order],
        affine=state.affine[order],
        material=state.material[order],
    )
    straight = run(CONSTANTS, [state], 400)
    expected = [array[:, order] for array in straight]
    shuffled = run(CONSTANTS, [permuted], 400)
    np.testing.assert_equal(shuffled, expected)


def test_pauses_do_not_matter() -> None:
    """Reading out between substeps changes nothing: 7 + 93 substeps are 100."""
    paused = run(CONSTANTS, [MIXED], 7, 0, 93)
    straight = run(CONSTANTS, [MIXED], 100)
    np.testing.assert_equal(paused, straight)


def test_a_solver_forgets_its_last_scenario() -> None:
    """Loading again starts from the new state only: no field carries over."""
    fresh = FreeSurface(CONSTANTS)
    fresh.load([MIXED])
    fresh.advance(100)
    run(CONSTANTS, [falling(Material.LIQUID)], 300)
    again = run(CONSTANTS, [MIXED], 100)
    np.testing.assert_equal(again, snapshot(fresh))
