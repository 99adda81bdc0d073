"""Graph networks as simulators: oracles, symmetries, starts, walls, precision."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from simple_models import (
    batch,
    greatest_difference,
    jittered,
    network,
    oracle,
    rolled,
    swirl,
)
from torch import Tensor
from torch.testing import assert_close


def seeded(seed: int = 0) -> torch.Generator:
    """Return a seeded source of randomness."""
    generator = torch.Generator()
    return generator.manual_seed(seed)


def roll_out(model: Any, frames: NDArray[np.float64], count: int) -> Tensor:
    """Return the positions after a window, shape [particle, frame, 2]."""
    return rolled(model, batch(frames), count)


def rounded(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Round to multiples of a power of two: sums of these are exact in float32."""
    return np.round(values * 2**16) / 2**16


def test_an_oracle_makes_no_error_over_a_rollout() -> None:
    """With the true accelerations 90 frames end at the truth.

    They differ by the rounding of float32 only.
    """
    frames = swirl(0, 96)
    truth = batch(frames)
    exact = torch.from_numpy(frames).transpose(0, 1)
    model = oracle(exact)
    path = roll_out(model, frames[:6], 90)

    first = truth.position[:, 5]
    displacement = truth.position[:, 95] - first
    distance = displacement.norm(dim=1)
    assert float(distance.max()) > 0.2
    # The initial velocities are differences of float32 positions: 6e-8 a frame, which
    # accelerations do not mend.
    error = greatest_difference(path, truth.position[:, 6:])
    assert error < 90 * 6e-8


def test_untrained_models_of_accelerations_keep_velocities() -> None:
    window = batch(swirl(0, 6))
    time = torch.arange(1.0, 4.0)[:, None]
    last = window.position[:, -1]
    velocity = last - window.position[:, -2]
    straight = last[:, None] + time * velocity[:, None]
    path = rolled(network(), window, 3)
    assert_close(path, straight, rtol=0.0, atol=3e-7)


def test_a_shift_away_from_walls_shifts_the_rollout() -> None:
    """One vector moves all particles, and so the rollout; it is exact in binary."""
    rng = np.random.default_rng(0)
    start = rounded(jittered(0, 8, 0.3, 0.5))
    noise = rng.normal(0.0, 1e-3, (6, *start.shape))
    steps = rounded(noise)
    frames = start + steps.cumsum(axis=0)
    shift = np.array([0.25, 0.125])

    model = network(awake=True)
    window = batch(frames)
    path = rolled(model, window, 4)
    shifted_path = roll_out(model, frames + shift, 4)
    last = window.position[:, -1]
    assert greatest_difference(path[:, 0], last) > 1e-4
    expected = path + torch.from_numpy(shift).float()
    assert_close(shifted_path, expected, rtol=0.0, atol=2e-6)


def test_windows_side_by_side_do_not_see_each_other() -> None:
    """Two windows in one batch roll out as they do alone."""
    model = network(awake=True)
    first = swirl(0, 6)
    second = swirl(1, 6)
    together = rolled(model, batch(first, second), 3)
    first_alone = roll_out(model, first, 3)
    second_alone = roll_out(model, second, 3)
    alone = torch.cat([first_alone, second_alone])
    assert_close(together, alone, rtol=0.0, atol=1e-6)


def test_a_predicted_frame_moves_with_its_own_wall_velocity() -> None:
    """After the last known wall velocity that one stays."""
    window = batch(swirl(0, 8), walls=True)
    factor = torch.arange(8.0)[:, None, None]
    window.wall_velocity.mul_(factor)
    given = window.part(slice(6))
    state = network(wall_velocity=True).start(given)
    speeds = []
    for _ in range(3):
        left_wall = state.wall_velocity[0, 0, 0]
        speeds.append(float(left_wall[0]))
        last_velocity = state.velocity[:, -1]
        state = state.move(state.position, last_velocity)
    assert speeds == pytest.approx([6 * 0.005, 7 * 0.005, 7 * 0.005])


def flight_to_the_right_wall() -> Any:
    """Return a window of one particle that is at the wall, x = 0.9375, in 2 frames."""
    time = np.arange(6)
    x = 0.93 - 0.004 * (5 - time)
    y = 0.5 + 0.001 * time
    path = np.stack([x, y], axis=-1)
    return batch(path[:, None])


def test_a_particle_that_flies_out_stops_at_the_wall() -> None:
    """Its velocity says so."""
    model = network()
    x = []
    state = model.start(flight_to_the_right_wall())
    for _ in range(3):
        with torch.no_grad():
            state, position = model.advance(state)
        x.append(float(position[0, 0]))
    assert x == pytest.approx([0.934, 0.9375, 0.9375], abs=1e-6)
    x_velocity, y_velocity = state.velocity[0, -1].tolist()
    assert x_velocity == pytest.approx(0.0, abs=1e-7)
    assert y_velocity == pytest.approx(0.001, abs=1e-6)


def test_a_wall_passes_gradients_on() -> None:
    """A prediction that a wall stops learns to stop before it, where the truth does."""
    given_x = 0.9275 + 0.002 * np.arange(6)
    x = np.append(given_x, 0.936)
    y = np.full(7, 0.5)
    path = np.stack([x, y], axis=-1)
    arriving = path[:, None]
    model = network()
    terms = model(batch(arriving))
    decoder_bias = model.network.decoder[-1].bias
    (gradient,) = torch.autograd.grad(terms["acceleration"], decoder_bias)

    predicted = roll_out(model, arriving[:6], 1)
    assert float(predicted[0, 0, 0]) == 0.9375
    # The stopped position is 0.0015 off: 2 e / std^2, times the std that outputs are
    # multiplied by.
    expected = 2 * 0.0015 / 0.0002
    assert float(gradient[0]) == pytest.approx(expected, rel=1e-3)
