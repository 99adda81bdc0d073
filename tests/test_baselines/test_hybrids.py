"""The hybrids: what their closures do, and what they are without them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from simple_models import info

from lagbench.baselines.baseline import Batch, DatasetInfo
from lagbench.baselines.dataset_info import read_dataset_info
from lagbench.baselines.hybrid_coarse import (
    HybridCoarse,
)
from lagbench.baselines.hybrid_projection import ClosedGrid, HybridProjection
from lagbench.baselines.rollout import roll_out, scenario_batch, scenario_paths
from lagbench.data.box import Box
from lagbench.data.registry import Size, load
from lagbench.data.scenario import read_scenario
from lagbench.errors import DataError
from lagbench.make.generate import GenerationResult
from lagbench.references import coarse_solver
from lagbench.references.predictor import given_in
from lagbench.tensors import TensorWindow, collate

Array = NDArray[np.float64]

SIDE = 0.875
VISCOSITY = 2e-3


def cavity() -> Size:
    """The description of cavity tiny."""
    return load().size("cavity", "tiny")


def cavity_info(**changes: object) -> DatasetInfo:
    """Public figures that agree with those of cavity tiny."""
    size = cavity()
    values: dict[str, object] = {
        "bounds": size.bounds,
        "frame_interval": size.frame_interval,
        "score_cells": size.task.score_grid.cells,
        "input_frames": size.task.input_frames,
        "moving_walls": True,
    }
    return info(**(values | changes))


def turning(frames: int) -> Array:
    """Return particles in one vortex, shape [frame, particle, 2].

    The stream function is sin(pi x)^2 sin(pi y)^2 in units of the box.
    """
    low = np.array([bound[0] for bound in cavity().bounds])
    axis = (np.arange(24) + 0.5) / 24
    columns, rows = np.meshgrid(axis, axis, indexing="ij")
    place = np.stack([columns, rows], axis=-1).reshape(-1, 2)
    path = [low + SIDE * place]
    for _ in range(frames - 1):
        sine_x, sine_y = np.sin(np.pi * place).T
        twice_x, twice_y = np.sin(2 * np.pi * place).T
        u = sine_x**2 * twice_y
        v = -twice_x * sine_y**2
        flow = np.stack([u, v], axis=1)
        place = place + 0.004 * flow
        path.append(low + SIDE * place)
    return np.array(path)


def moving_lid(frames: int) -> Array:
    """Return wall velocities of a lid that slides [length/s], [frame, wall, 2]."""
    walls = np.zeros((frames, 4, 2))
    walls[:, 3, 0] = 0.1
    return walls


def batch_of(
    path: Array,
    walls: Array | None,
    viscosity: float | None,
) -> Batch:
    """Return one window of liquid."""
    particle_count = path.shape[1]
    position = path.transpose(1, 0, 2)
    wall_velocity = None
    if walls is not None:
        wall_velocity = torch.from_numpy(walls).float()
    window = TensorWindow(
        position=torch.from_numpy(position).float(),
        material=torch.zeros(particle_count, dtype=torch.int64),
        wall_velocity=wall_velocity,
        scenario=0,
        frame=0,
        viscosity=viscosity,
    )
    return collate([window])


def test_a_wave_decays_by_viscosity_and_hyperviscosity() -> None:
    """cos(k y) in a periodic box decays at nu q^2 + mu q^4.

    q^2 = (2 - 2 cos(k h)) / h^2 is that of central differences.
    """
    nu = 1e-3
    mu = 2e-5
    unit = (0.0, 1.0)
    box = Box.from_bounds((unit, unit), (True, True))
    grid = ClosedGrid(
        box,
        cells=(16, 16),
        no_slip=False,
        hyperviscosity=mu,
    )
    y = (np.arange(16) + 0.5) / 16
    k = 2 * np.pi
    wave = 1e-3 * np.cos(k * y)
    u = np.tile(wave, (16, 1))
    v = np.zeros((16, 16))
    later = grid.advance(
        [u, v],
        duration=4.0,
        viscosity=nu,
        wall_velocity=np.zeros((4, 2)),
    )
    q_squared = (2 - 2 * np.cos(k / 16)) * 16**2
    rate = nu * q_squared + mu * q_squared**2
    expected = np.exp(-rate * 4.0)
    ratio = later[0][0, 0] / u[0, 0]
    assert ratio == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("coefficient", [1e6, -3e38, float("nan")])
def test_damping_out_of_range_is_refused(coefficient: float) -> None:
    """A weights file could ask for more time steps than any machine can take."""
    model = HybridProjection.build({}, cavity_info())
    model.coefficients[2] = coefficient
    with pytest.raises(DataError) as raised:
        model.start(batch_of(turning(6), moving_lid(6), VISCOSITY))
    assert raised.value.where == "weights"


@pytest.mark.slow
def test_without_changes_it_is_the_coarse_solver(
    tiny_split: Callable[..., GenerationResult],
) -> None:
    """Positions are equal to the bit, in two scenarios side by side too."""
    size = load().size("multimaterial", "tiny")
    root = tiny_split("multimaterial").root
    paths = list(scenario_paths("multimaterial", size="tiny", root=root).values())
    expected = []
    for path in paths[:2]:
        with read_scenario(path) as file:
            scenario = given_in(file, size, root)
        coarse = coarse_solver.coarser(size, 2)
        assert coarse is not None
        rollout = coarse_solver.CoarseRollout(scenario, coarse)
        positions = [rollout.advance() for _ in scenario.predicted_frames]
        expected.append(np.float32(positions))

    figures = read_dataset_info("multimaterial", "tiny", root=root)
    model = HybridCoarse.build({}, figures)
    given = scenario_batch(paths[:2], slice(size.task.input_frames))
    rollouts = roll_out(model, given, size.task.horizon)
    for rollout, positions in zip(rollouts, expected, strict=True):
        np.testing.assert_array_equal(rollout.position.numpy(), positions)
