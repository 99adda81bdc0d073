"""The free-surface solver's bits: drivers, orders of particles and NumPy agree exactly."""

from __future__ import annotations

import dataclasses
from typing import cast

import numpy as np
import pytest
from free_surface_scenarios import Part, parameters, run, scenario, snapshot, start
from reference_free_surface import FreeSurfaceReference

from lagbench.generators.free_surface import FreeSurface
from lagbench.generators.shapes import Disc, Rectangle
from lagbench.generators.solver import Device, build
from lagbench.generators.split import InitialState, Material
from lagbench.work.machine import available_cores

CONSTANTS = parameters()
SQUARE = Rectangle(0.2, 0.2)
LEFT_LOW, RIGHT_HIGH = (0.2, 0.18), (0.8, 0.8)


def falling(material: Material, friction: float = 0.0) -> InitialState:
    """Two bodies that hit opposite corners at once and come apart."""
    parts = (
        Part(material, SQUARE, LEFT_LOW, (-1.5, -1.5)),
        Part(material, Disc(0.1), RIGHT_HIGH, (2.0, 1.0)),
    )
    return scenario(CONSTANTS, *parts, seed=int(material), friction=friction, spin=4.0)


def cornered(gap: float, high: bool) -> InitialState:
    """One resting square of liquid that keeps a gap from two walls [cells]."""
    near = (CONSTANTS.wall + gap) / CONSTANTS.grid + 0.1
    centre = 1.0 - near if high else near
    return scenario(CONSTANTS, Part(Material.LIQUID, SQUARE, (centre, centre)), spin=4.0)


MIXED = scenario(
    CONSTANTS,
    Part(Material.LIQUID, SQUARE, (0.2, 0.35), (1.0, -2.0)),
    Part(Material.SNOW, Disc(0.1), (0.45, 0.2), (0.0, -1.0)),
    Part(Material.JELLY, Disc(0.1), (0.7, 0.2), (-1.0, -1.0)),
    Part(Material.ROPE, Rectangle(0.6, 0.06, (0.8, 0.6)), (0.5, 0.6), (0.5, 0.5)),
    friction=0.3,
    seed=9,
)
CASES = [pytest.param(falling(m), id=m.name.lower()) for m in Material]
CASES += [
    pytest.param(falling(Material.SNOW, friction=0.3), id="snow with friction"),
    pytest.param(MIXED, id="all four"),
]
THREADS = [
    1,
    pytest.param(2, marks=pytest.mark.skipif(available_cores() < 2, reason="one processor")),
]


def touched(state: InitialState, substeps: int) -> set[str]:
    """Return the walls whose nodes particles have touched within some substeps."""
    solver, low = start(CONSTANTS, [state]), CONSTANTS.wall / CONSTANTS.grid
    seen: set[str] = set()
    for _ in range(substeps // 10):
        solver.advance(10)
        x, y = solver.position()[0].T
        near = 1.5 / CONSTANTS.grid
        reached = {
            "left": x.min() < low + near,
            "right": x.max() > 1.0 - low - near,
            "bottom": y.min() < low + near,
            "top": y.max() > 1.0 - low - near,
        }
        seen |= {wall for wall, hit in reached.items() if hit}
    return seen


@pytest.mark.parametrize("state", CASES)
def test_numpy_gives_the_same_bits(state: InitialState) -> None:
    """An independent float32 implementation agrees in every bit over 400 substeps, walls included."""
    solver, reference = start(CONSTANTS, [state]), FreeSurfaceReference(CONSTANTS, state)
    for substeps in (1, 9, 90, 300):
        solver.advance(substeps)
        reference.advance(substeps)
        ours = snapshot(solver)
        shape = (CONSTANTS.particles, 2, 2)
        theirs = [
            reference.position,
            reference.velocity,
            np.stack(reference.affine, axis=1).reshape(shape),
            np.stack(reference.deformation, axis=1).reshape(shape),
            reference.ratio,
        ]
        for own, other in zip(ours, theirs, strict=True):
            assert other.dtype == np.float32
            np.testing.assert_array_equal(own[0], other)


@pytest.mark.parametrize("material", Material)
def test_scenarios_of_these_tests_reach_walls(material: Material) -> None:
    """The comparisons cover mirrored nodes: at least three walls are hit within 400 substeps."""
    assert len(touched(falling(material), 400)) >= 3


@pytest.mark.parametrize("threads", THREADS)
@pytest.mark.parametrize("state", CASES)
def test_parallel_driver_gives_the_same_bits(state: InitialState, threads: int) -> None:
    """Atomic adds from any number of threads, over the whole grid, change no bit in 400 substeps."""
    serial = run(CONSTANTS, [state], 400)
    parallel = run(CONSTANTS, [state], 400, device=Device.PARALLEL, threads=threads)
    for own, other in zip(serial, parallel, strict=True):
        np.testing.assert_array_equal(own, other)


@pytest.mark.parametrize("high", [False, True])
@pytest.mark.parametrize("gap", [0.6, 1.0, 1.6])
def test_rows_beyond_a_wall_are_never_stale(gap: float, high: bool) -> None:
    """Nodes that walls mirror are cleared even if no particle touches them.

    The serial driver visits only nodes near particles. Here a first scenario fills the rows
    beyond two walls; the second lies near these walls without touching those rows.
    """
    parallel = run(CONSTANTS, [cornered(gap, high)], 20, device=Device.PARALLEL, threads=1)
    run(CONSTANTS, [cornered(0.05, high)], 5)
    serial = run(CONSTANTS, [cornered(gap, high)], 20)
    for own, other in zip(serial, parallel, strict=True):
        np.testing.assert_array_equal(own, other)


def test_batched_scenarios_do_not_touch_each_other() -> None:
    """Scenarios of other materials, areas and frictions in one batch equal each one alone."""
    states = [falling(Material.LIQUID), falling(Material.SNOW, friction=0.3), MIXED]
    together = run(CONSTANTS, states, 200, device=Device.PARALLEL)
    for index, state in enumerate(states):
        for own, other in zip(run(CONSTANTS, [state], 200), together, strict=True):
            np.testing.assert_array_equal(own[0], other[index])


@pytest.mark.parametrize("state", CASES)
def test_order_of_particles_does_not_matter(state: InitialState) -> None:
    """Permuted particles give permuted results, bit for bit, over 400 substeps."""
    order = np.random.default_rng(4).permutation(CONSTANTS.particles)
    names = ("position", "velocity", "affine", "material")
    permuted = dataclasses.replace(state, **{name: getattr(state, name)[order] for name in names})
    for own, other in zip(run(CONSTANTS, [state], 400), run(CONSTANTS, [permuted], 400), strict=True):
        np.testing.assert_array_equal(own[:, order], other)


def test_pauses_do_not_matter() -> None:
    """Reading out between substeps changes nothing: 7 + 93 substeps are 100."""
    for own, other in zip(run(CONSTANTS, [MIXED], 100), run(CONSTANTS, [MIXED], 7, 0, 93), strict=True):
        np.testing.assert_array_equal(own, other)


def test_a_solver_forgets_its_last_scenario() -> None:
    """Loading again starts from the new state only: no field carries over."""
    fresh = cast("FreeSurface", build(CONSTANTS))
    fresh.load([MIXED])
    fresh.advance(100)
    run(CONSTANTS, [falling(Material.LIQUID)], 300)
    for own, other in zip(run(CONSTANTS, [MIXED], 100), snapshot(fresh), strict=True):
        np.testing.assert_array_equal(own, other)
