"""The driven cube: its scenarios, and the solver beside an independent one."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np
import pytest
from scenario_draws import draw

from lagbench.data import registry
from lagbench.data.box import WALL_NAMES
from lagbench.data.manifest import read_manifest
from lagbench.generators import cavity_3d
from lagbench.generators.full_box import FullBox
from lagbench.make.generate import GenerationResult
from lagbench.references.staggered import StaggeredGrid

SIZE = registry.load().size("cavity-3d", "mini")


def test_walls_slide_along_both_of_their_axes() -> None:
    """Every subset holds all choices of walls alike; each program turns around, and no
    wall moves along its normal.
    """
    for ids in SIZE.subsets.values():
        choices = [scenario % len(cavity_3d.DRIVEN) for scenario in ids]
        counts = np.bincount(choices)
        assert len(set(counts)) == 1
    for scenario in range(len(cavity_3d.DRIVEN)):
        state = draw(SIZE, scenario)
        motion = state.wall_velocity
        frame_count = state.start_frame + SIZE.frame_count(scenario)
        assert motion.shape == (frame_count, 6, 3)
        speed_max = SIZE.value("speed_max")
        assert np.abs(motion).max() <= speed_max
        names = cavity_3d.DRIVEN[scenario]
        assert state.parameters["wall"] == "+".join(names)
        for wall, name in enumerate(WALL_NAMES):
            speed = motion[:, wall]
            goes_back = speed.min(axis=0) < 0.0
            goes_forth = speed.max(axis=0) > 0.0
            turns = goes_back & goes_forth
            is_tangential = np.arange(3) != wall // 2
            expected = is_tangential & (name in names)
            np.testing.assert_array_equal(turns, expected)
            assert not speed[:, ~expected].any()


@pytest.mark.slow
def test_the_fluid_is_nearly_incompressible(
    tiny_split: Callable[..., GenerationResult],
) -> None:
    """J of every particle at every substep, at the edges of the sliding walls too."""
    result = tiny_split("cavity-3d")
    size = registry.load().size("cavity-3d", "tiny")
    manifest = read_manifest(result.root, "cavity-3d", "tiny", size.major)
    assert manifest is not None
    stiffness = size.value("modulus") / size.value("density")
    sound_speed = math.sqrt(stiffness)
    for entry in manifest.files:
        assert entry.facts["jacobian_min"] > 0.9
        assert entry.facts["jacobian_max"] < 1.1
        assert entry.facts["max_speed"] < 0.15 * sound_speed


@pytest.mark.slow
def test_the_flow_is_that_of_a_staggered_grid() -> None:
    """Two walls that turn: after thirty frames the velocities of the nodes agree with
    those of an incompressible solver on as many cells, within 1.5 % of the wall speed.
    Nodes beside the walls are left out: there both grids have half a cell.
    """
    frames = 30
    drawn = draw(SIZE, 3)
    state = dataclasses.replace(drawn, start_frame=0)
    solver = FullBox(cavity_3d.solver_parameters(SIZE))
    solver.load([state])
    solver.advance(frames * SIZE.substeps_per_frame)
    velocity = solver.grid_velocity()[0].astype(np.float64)
    solver.close()

    cells = (SIZE.grid,) * 3
    grid = StaggeredGrid(SIZE.box, cells=cells, no_slip=True)
    field = grid.rest()
    for frame in range(frames):
        field = grid.advance(
            field,
            duration=SIZE.frame_interval,
            viscosity=state.viscosity,
            wall_velocity=state.walls_towards(frame + 1),
        )
    nodes = np.indices(cells).reshape(3, -1)
    centres = (nodes.T + 0.5) / SIZE.grid
    nodal_truth = grid.at_particles(
        field,
        centres,
        wall_velocity=state.walls_towards(frames),
    )
    truth = nodal_truth.reshape(velocity.shape)
    inner = (slice(1, -1),) * 3
    difference = (velocity - truth)[inner]
    error = np.sqrt(np.mean(difference**2))
    mean_speed = np.sqrt(np.mean(truth[inner] ** 2))
    speed = SIZE.value("speed_max")
    assert mean_speed > 0.03 * speed
    assert error < 0.015 * speed
