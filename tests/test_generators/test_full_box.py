"""The solver of full boxes: two or three axes, walled or periodic."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from box_scenarios import ALL_LIDS, NO_SLIP, after, box, scenario
from full_box_scenarios import MIXED_BOX, MIXED_COUNTS, constants, mixed_state

from lagbench.data.box import Box
from lagbench.errors import UsageError
from lagbench.generators.full_box import FullBox
from lagbench.generators.full_box_parameters import FullBoxParameters


@pytest.mark.slow
def test_a_square_with_four_walls_has_the_bits_of_the_fast_solver() -> None:
    """Both formulations agree in every bit while four walls move."""
    low, high = box(NO_SLIP)
    values = dataclasses.asdict(NO_SLIP)
    del values["wall"]
    side = (low, high)
    square = Box.from_bounds([side, side])
    state = scenario(
        NO_SLIP,
        seed=1,
        speed=0.5,
        walls=ALL_LIDS,
        frames=10,
    )
    square_constants = FullBoxParameters(box=square, **values)
    solver = FullBox(square_constants)
    solver.load([state])
    solver.advance(60)
    expected = after(NO_SLIP, [state], 60)
    np.testing.assert_array_equal(solver.position(), expected["position"])
    np.testing.assert_array_equal(solver.velocity(), expected["velocity"])
    np.testing.assert_array_equal(solver.jacobian(), expected["jacobian"])
    solver.close()


@pytest.mark.parametrize(
    "wall",
    [0, 2],
    ids=["periodic axis", "along its normal"],
)
def test_walls_that_cannot_move_are_refused(wall: int) -> None:
    """A wall moves along itself only, and a periodic axis has none."""
    walls = np.zeros((6, 3))
    walls[wall, 1] = 0.1
    state = dataclasses.replace(mixed_state(), wall_velocity=walls)
    solver = FullBox(constants(MIXED_BOX, MIXED_COUNTS, force_layers=2))
    with pytest.raises(UsageError) as caught:
        solver.load([state])
    assert "wall_velocity" in str(caught.value.where)
