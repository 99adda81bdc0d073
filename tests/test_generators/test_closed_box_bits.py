"""The closed-box solver against an independent NumPy implementation, bit by bit."""

from __future__ import annotations

import numpy as np
import pytest
from box_scenarios import (
    ALL_LIDS,
    FREE_SLIP,
    NO_SLIP,
    after,
    box,
    loaded,
    scenario,
    snapshot,
)
from reference_closed_box import ReferenceClosedBox

from lagbench.generators.split import ClosedBoxParameters, InitialState

# Each module of kernels takes seconds to compile.
pytestmark = pytest.mark.slow


@pytest.mark.parametrize(
    ("constants", "state"),
    [
        pytest.param(
            NO_SLIP,
            scenario(NO_SLIP, seed=1, speed=0.5, walls=ALL_LIDS),
            id="four lids",
        ),
        pytest.param(
            NO_SLIP,
            scenario(NO_SLIP, seed=2, walls=(0.0, 0.0, 0.0, 0.4)),
            id="one lid, from rest",
        ),
        pytest.param(
            NO_SLIP,
            scenario(NO_SLIP, seed=4, walls=ALL_LIDS, frames=10),
            id="four programs",
        ),
        pytest.param(
            FREE_SLIP,
            scenario(FREE_SLIP, seed=3, speed=0.5, viscosity=0.0),
            id="free slip",
        ),
    ],
)
def test_numpy_gives_the_same_bits(
    constants: ClosedBoxParameters, state: InitialState
) -> None:
    """An independent float32 implementation agrees in every bit over 120 substeps with
    wall contact.
    """
    solver = loaded(constants, [state])
    reference = ReferenceClosedBox(constants, state)
    for substeps in (1, 1, 58, 60):
        solver.advance(substeps)
        reference.step(substeps)
        theirs = {
            "position": reference.x,
            "velocity": reference.v,
            "jacobian": reference.j,
        }
        for name, values in theirs.items():
            assert values.dtype == np.float32
            np.testing.assert_array_equal(
                snapshot(solver)[name][0],
                values,
                err_msg=name,
            )
    low, high = box(constants)
    gaps = [
        solver.position()[0].min(axis=0) - low,
        high - solver.position()[0].max(axis=0),
    ]
    assert np.max(gaps) < 0.25 / constants.grid
    assert np.abs(solver.velocity()).max() > 1e-2


def test_averaging_changes_no_bit() -> None:
    """The mean of the nodal velocities lies outside the path of the bits, and is the
    mean.
    """
    state = scenario(NO_SLIP, seed=9, speed=0.4, walls=ALL_LIDS)
    plain = after(NO_SLIP, [state], 30)
    averaged = loaded(NO_SLIP, [state])
    averaged.advance(26)
    frames = []
    for _ in range(4):
        averaged.advance(1, average=True)
        frames.append(averaged.grid_velocity().astype(np.float64))
    np.testing.assert_equal(snapshot(averaged), plain)
    np.testing.assert_allclose(
        averaged.mean_grid_velocity(),
        np.mean(frames, axis=0),
        rtol=0,
        atol=1e-15,
    )
