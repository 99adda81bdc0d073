"""The solver of full boxes: two or three axes, walled or periodic."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from full_box_scenarios import MIXED_BOX, MIXED_COUNTS, constants, mixed_state

from lagbench.errors import UsageError
from lagbench.generators.full_box import FullBox


@pytest.mark.parametrize(
    "wall",
    [0, 2],
    ids=["periodic axis", "along its normal"],
)
def test_walls_that_cannot_move_are_refused(wall: int) -> None:
    """A wall moves along itself only, and a periodic axis has none."""
    walls = np.zeros((6, 3))
    walls[wall, 1] = 0.1
    walls[3, 0] = 0.2  # a motion that is allowed
    state = dataclasses.replace(mixed_state(), wall_velocity=walls)
    solver = FullBox(constants(MIXED_BOX, MIXED_COUNTS, force_layers=2))
    with pytest.raises(UsageError) as caught:
        solver.load([state])
    assert "wall_velocity" in str(caught.value.where)


LATE_NAN = np.zeros((4, 2, 3))
LATE_NAN[3, 1, 0] = np.nan


@pytest.mark.parametrize(
    ("name", "program"),
    [
        ("wall_velocity", np.zeros(0)),
        ("wall_velocity", np.zeros((0, 6, 3))),
        ("wall_velocity", np.zeros((6, 2))),
        ("wall_velocity", np.zeros((6, 3)).tolist()),
        ("wall_velocity", np.full((6, 3), "slow")),
        ("body_force", None),
        ("body_force", np.zeros((0, 2, 3))),
        ("body_force", np.zeros((2, 3))),
        ("body_force", np.zeros((4, 2, 3)).tolist()),
        ("body_force", LATE_NAN),
    ],
)
def test_a_program_that_is_none_is_refused(name: str, program: object) -> None:
    """A program of walls or forces is an array with finite rows."""
    state = dataclasses.replace(mixed_state(), **{name: program})  # type: ignore[arg-type]
    solver = FullBox(constants(MIXED_BOX, MIXED_COUNTS, force_layers=2))
    with pytest.raises(UsageError) as caught:
        solver.load([state])
    assert name in str(caught.value.where)
    solver.close()
