"""Graph networks as simulators: oracles, symmetries, starts, walls, precision."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from simple_models import (
    RADIUS,
    SMALL,
    batch,
    greatest_difference,
    info,
    jittered,
    network,
    oracle,
    rolled,
    swirl,
)
from torch import Tensor
from torch.testing import assert_close

from lagbench.baselines.augmentation import mirror_batch
from lagbench.baselines.operators.gns import GNS
from lagbench.baselines.simulator import GraphNetwork, ParticleState
from lagbench.errors import UsageError

TARGETS = pytest.mark.parametrize("target", ["acceleration", "velocity"])


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


@TARGETS
def test_an_oracle_makes_no_error_over_a_rollout(target: str) -> None:
    """With the true accelerations or velocities, 90 frames end at the truth.

    They differ by the rounding of float32 only.
    """
    frames = swirl(0, 96)
    truth = batch(frames)
    exact = torch.from_numpy(frames).transpose(0, 1)
    model = oracle(exact, target)
    path = roll_out(model, frames[:6], 90)

    first = truth.position[:, 5]
    displacement = truth.position[:, 95] - first
    distance = displacement.norm(dim=1)
    assert float(distance.max()) > 0.2
    # The initial velocities are differences of float32 positions: 6e-8 a frame, which
    # accelerations do not mend.
    tolerance = 1e-6
    if target == "acceleration":
        tolerance = 90 * 6e-8
    error = greatest_difference(path, truth.position[:, 6:])
    assert error < tolerance


def test_untrained_models_of_accelerations_keep_velocities() -> None:
    window = batch(swirl(0, 6))
    time = torch.arange(1.0, 4.0)[:, None]
    last = window.position[:, -1]
    velocity = last - window.position[:, -2]
    straight = last[:, None] + time * velocity[:, None]
    path = rolled(network(), window, 3)
    assert_close(path, straight, rtol=0.0, atol=3e-7)


@TARGETS
def test_a_shift_away_from_walls_shifts_the_rollout(target: str) -> None:
    """One vector moves all particles, and so the rollout; it is exact in binary."""
    rng = np.random.default_rng(0)
    start = rounded(jittered(0, 8, 0.3, 0.5))
    noise = rng.normal(0.0, 1e-3, (6, *start.shape))
    steps = rounded(noise)
    frames = start + steps.cumsum(axis=0)
    shift = np.array([0.25, 0.125])

    model = network(awake=True, target=target)
    window = batch(frames)
    path = rolled(model, window, 4)
    shifted_path = roll_out(model, frames + shift, 4)
    last = window.position[:, -1]
    assert greatest_difference(path[:, 0], last) > 1e-4
    expected = path + torch.from_numpy(shift).float()
    assert_close(shifted_path, expected, rtol=0.0, atol=2e-6)


def mirror_model(model: Any, axis: int) -> Any:
    """Return the model whose weights see the world mirrored along an axis.

    Every input that changes sign has its column negated, the two walls across have
    their columns swapped, and the output along the axis is negated.
    """
    mirrored = network(
        awake=True,
        target=model.options.target.value,
        wall_velocity=True,
    )
    mirrored.load_state_dict(model.state_dict())
    low = 2 * axis
    high = 2 * axis + 1
    with torch.no_grad():
        node_weight = mirrored.network.node_encoder[0].weight
        node_weight[:, axis:10:2] *= -1.0

        distance = node_weight[:, 10:14]
        from_low = distance[:, low].clone()
        distance[:, low] = distance[:, high]
        distance[:, high] = from_low

        columns = node_weight[:, 30:]
        wall_velocity = columns.reshape(-1, 4, 2)
        wall_velocity[..., axis] *= -1.0
        walls = [0, 1, 2, 3]
        walls[low] = high
        walls[high] = low
        columns[:] = wall_velocity[:, walls].flatten(1)

        edge_weight = mirrored.network.edge_encoder[0].weight
        edge_weight[:, axis] *= -1.0
        decoder = mirrored.network.decoder[-1]
        decoder.weight[axis] *= -1.0
        decoder.bias[axis] *= -1.0
    return mirrored


@pytest.mark.parametrize("axis", [0, 1])
@TARGETS
def test_a_mirrored_model_in_a_mirrored_world(target: str, axis: int) -> None:
    """Walls, their motion and the weights mirrored: the rollout is the mirror image."""
    rng = np.random.default_rng(0)
    windows = []
    for seed in (0, 1):
        steps = rng.normal(0.0, 2e-3, (6, 256, 2))
        path = steps.cumsum(axis=0)
        windows.append(jittered(seed) + path)
    window = batch(*windows, walls=True)
    window.wall_velocity[1] *= -0.5
    matrix = torch.eye(2).repeat(2, 1, 1)
    matrix[:, axis, axis] = -1.0
    image = mirror_batch(window, matrix, info().bounds)

    model = network(awake=True, target=target, wall_velocity=True)
    expected = rolled(model, window, 3)
    expected[..., axis] = 1.0 - expected[..., axis]
    mirrored = mirror_model(model, axis)
    path = rolled(mirrored, image, 3)
    assert_close(path, expected, rtol=0.0, atol=1e-6)

    # The weights matter: the model itself does not give the mirror image.
    unmirrored_path = rolled(model, image, 3)
    assert greatest_difference(unmirrored_path, expected) > 1e-5


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


def test_two_frames_are_enough_to_start_from() -> None:
    """The first velocity repeats in place of those before the window."""
    window = batch(swirl(0, 8))
    model = network()
    second_frame = window.position[:, 1]
    first_velocity = second_frame - window.position[:, 0]

    two_frames = window.part(slice(2))
    from_two = model.start(two_frames)
    repeated = first_velocity[:, None].expand(-1, 5, -1)
    assert torch.equal(from_two.velocity, repeated)
    assert torch.equal(from_two.position, second_frame)

    four_frames = window.part(slice(4))
    from_four = model.start(four_frames)
    velocity = four_frames.position.diff(dim=1)
    assert torch.equal(from_four.velocity[:, :3], repeated[:, :3])
    assert torch.equal(from_four.velocity[:, 2:], velocity)

    one_frame = window.part(slice(1))
    with pytest.raises(UsageError):
        model.start(one_frame)


def test_a_state_moved_by_the_truth_is_the_next_start() -> None:
    """The oldest velocity leaves and the new one comes last."""
    window = batch(swirl(0, 7))
    model = network()
    first_six = window.part(slice(6))
    last_six = window.part(slice(1, 7))
    state = model.start(first_six)
    next_start = model.start(last_six)
    last_velocity = next_start.velocity[:, -1]
    moved = state.move(next_start.position, last_velocity)
    for field in fields(ParticleState):
        value = getattr(moved, field.name)
        expected = getattr(next_start, field.name)
        if expected is None:
            assert value is None
        else:
            assert torch.equal(value, expected)


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


@TARGETS
def test_no_rollout_leaves_the_box(target: str) -> None:
    """Whatever a network says: of 256 particles over 30 frames none is outside."""
    model = network(awake=True, target=target)
    decoder_bias = model.network.decoder[-1].bias
    torch.nn.init.normal_(decoder_bias, std=50.0)
    path = roll_out(model, swirl(0, 6), 30)
    bounds = torch.tensor(info().bounds)
    low, high = bounds.T
    assert bool((path >= low).all())
    assert bool((path <= high).all())
    is_stopped = (path == low) | (path == high)
    assert bool(is_stopped.any())


class RecordingNetwork(GraphNetwork):
    """A graph network that records its inputs and predicts zeros."""

    operator = GNS
    method = "recording"

    def predict(
        self, state: ParticleState, *_: object
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Record the state."""
        earlier_states = getattr(self, "states", [])
        self.states = [*earlier_states, state]
        return torch.zeros_like(state.position), {}


def test_noise_stays_in_the_box() -> None:
    """Noise moves particles that rest at a wall to its inner side only."""
    y = 0.3 + 0.05 * np.arange(8)
    x = np.full(8, 0.9375)
    resting = np.stack([x, y], axis=-1)
    frames = np.repeat(resting[None], 7, axis=0)
    window = batch(frames)
    options = SMALL | {"noise_std": 1e-3}
    model = RecordingNetwork.build(options, info())
    model(window, seeded())
    noisy_x = model.states[0].position[:, 0]
    assert float(noisy_x.max()) == 0.9375
    assert float(noisy_x.min()) < 0.9375


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


def test_forcing_of_the_next_frame_moves_particles_near_walls() -> None:
    """A change of the wall velocity in an older frame changes nothing."""
    at_rest = jittered(0)[None]
    frames = np.repeat(at_rest, 7, axis=0)
    window = batch(frames, walls=True)
    model = network(
        awake=True,
        layers=1,
        wall_velocity=True,
        wall_reach=1.0,
    )

    def step_with(wall_velocity: Tensor) -> Tensor:
        forced = replace(window, wall_velocity=wall_velocity)
        given = forced.part(slice(6))
        with torch.no_grad():
            state, _ = model.step(model.start(given))
        return state.position

    def reverse_walls_at(frame: int) -> Tensor:
        wall_velocity = window.wall_velocity.clone()
        wall_velocity[:, frame] *= -3.0
        return wall_velocity

    position = step_with(window.wall_velocity)
    older_position = step_with(reverse_walls_at(5))
    assert torch.equal(older_position, position)

    difference = step_with(reverse_walls_at(6)) - position
    is_changed = difference.abs().amax(dim=1) > 0
    low, high = torch.tensor(info().bounds).T
    last = window.position[:, 5]
    nearer_wall = torch.minimum(last - low, high - last)
    wall_distance = nearer_wall.amin(dim=1)
    is_near = wall_distance < 0.9 * RADIUS
    is_far = wall_distance > 2.0 * RADIUS
    assert bool(is_changed[is_near].all())
    # One layer: a particle hears of the walls of its neighbours at most.
    assert not bool(is_changed[is_far].any())
