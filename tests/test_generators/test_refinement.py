"""A finer run is the same scenario, and a file holds one of each r^d particles."""

from __future__ import annotations

import numpy as np
import pytest

from lagbench.data.registry import Size, load
from lagbench.generators.batch import draw_initial_state
from lagbench.generators.constants import solver_constants
from lagbench.generators.full_box_parameters import FullBoxParameters
from lagbench.generators.refinement import recorded_particles, refined
from lagbench.generators.solver import build

SPLITS = tuple(load().splits)


def tiny(split: str) -> Size:
    return load().size(split, "tiny")


@pytest.mark.parametrize("split", SPLITS)
@pytest.mark.parametrize("times", [2, 3])
def test_a_finer_run_is_the_same_scenario(split: str, times: int) -> None:
    """What was drawn stays; the recorded particles start where those of the coarse run
    do, within a spacing of the finer run, each once and of the same material.
    """
    size = tiny(split)
    coarse = draw_initial_state(size, 0)
    fine = draw_initial_state(refined(size, times), 0)
    for name, value in coarse.parameters.items():
        if not name.startswith("initial_"):  # sums over the particles
            assert fine.parameters[name] == value
    assert np.array_equal(fine.wall_velocity, coarse.wall_velocity)
    assert fine.viscosity == coarse.viscosity
    assert fine.area == pytest.approx(coarse.area, rel=2e-2)

    rows = recorded_particles(coarse, fine)
    assert len(np.unique(rows)) == len(coarse.position)
    assert np.array_equal(fine.material[rows], coarse.material)
    spacing = (fine.area / len(fine.position)) ** (1.0 / size.dimension)
    distance = np.linalg.norm(fine.position[rows] - coarse.position, axis=1)
    assert distance.max() < 1.5 * spacing


@pytest.mark.parametrize("split", SPLITS)
def test_walls_and_rates_stay(split: str) -> None:
    """A finer run has the same walls; in a full box it relaxes as much in a frame."""
    size = tiny(split)
    fine_size = refined(size, 2)
    coarse = solver_constants(size)
    fine = solver_constants(fine_size)
    assert fine.grid == 2 * coarse.grid
    assert fine.dt == coarse.dt / 2
    if isinstance(fine, FullBoxParameters):
        assert fine.box == coarse.box
        rate = fine.jacobian_relaxation / fine.dt
        assert rate == pytest.approx(coarse.jacobian_relaxation / coarse.dt)
    else:
        assert fine.wall / fine.grid == coarse.wall / coarse.grid


@pytest.mark.slow
def test_a_finer_solver_takes_the_finer_state() -> None:
    size = refined(tiny("cavity"), 2)
    solver = build(solver_constants(size), threads=1)
    solver.load([draw_initial_state(size, 0)])
    solver.advance(size.substeps_per_frame)
    assert solver.position().shape == (1, size.particles, 2)
