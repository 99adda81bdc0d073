"""Graph networks as simulators: oracles, symmetries, starts, walls, precision."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
import torch
from simple_models import (
    RADIUS,
    SMALL,
    batch,
    info,
    jittered,
    network,
    oracle,
    rolled,
    swirl,
)

from lagbench.baselines.augmentation import mirror_batch
from lagbench.baselines.operators.gns import GNS
from lagbench.baselines.simulator import GraphNetwork, ParticleState
from lagbench.errors import UsageError


def assert_near(actual: Any, expected: Any, *, atol: float) -> None:
    """Compare with an absolute tolerance alone."""
    torch.testing.assert_close(actual, expected, rtol=0.0, atol=atol)


def largest_difference(a: torch.Tensor, b: torch.Tensor) -> float:
    """Return the largest absolute difference."""
    return float((a - b).abs().max())


@pytest.mark.parametrize("target", ["acceleration", "velocity"])
def test_an_oracle_makes_no_error_over_a_rollout(target: str) -> None:
    """Fed the true accelerations or velocities, 90 frames end at the truth.

    Float32 rounds: the given velocities are differences of positions, which err by
    6e-8 a frame where nothing mends it.
    """
    flow = swirl(0, 96)
    truth = batch(flow)
    exact = torch.from_numpy(flow).transpose(0, 1)
    rollout = rolled(oracle(exact, target), truth.part(slice(6)), 90)
    displacement = truth.position[:, 95] - truth.position[:, 5]
    assert float(displacement.norm(dim=1).max()) > 0.2
    tolerance = 1e-6
    if target == "acceleration":
        tolerance = 90 * 6e-8
    assert largest_difference(rollout, truth.position[:, 6:]) < tolerance


def test_untrained_models_keep_velocities_or_stand_still() -> None:
    """Target acceleration gives constant velocity, target velocity the train mean 0."""
    window = batch(swirl(0, 6))
    last = window.position[:, -1:]
    last_step = last - window.position[:, -2:-1]
    frames = torch.arange(1.0, 4.0)[:, None]
    straight = last + frames * last_step
    assert_near(rolled(network(), window, 3), straight, atol=3e-7)
    still = last.expand(-1, 3, -1)
    assert torch.equal(rolled(network(target="velocity"), window, 3), still)


@pytest.mark.parametrize("target", ["acceleration", "velocity"])
def test_a_shift_away_from_walls_shifts_the_rollout(target: str) -> None:
    """All particles moved by one vector: so is the rollout.

    The shift is exact in binary.
    """
    rng = np.random.default_rng(0)
    unit = 2.0**-16
    start = np.round(jittered(0, 8, 0.3, 0.5) / unit) * unit
    steps = np.round(rng.normal(0.0, 1e-3, (6, *start.shape)) / unit) * unit
    frames = start + steps.cumsum(axis=0)
    shift = np.array([0.25, 0.125])
    model = network(awake=True, target=target)
    window = batch(frames)
    rollout = rolled(model, window, 4)
    assert largest_difference(rollout[:, 0], window.position[:, -1]) > 1e-4
    shifted_rollout = rolled(model, batch(frames + shift), 4)
    expected = rollout + torch.from_numpy(shift).float()
    assert_near(shifted_rollout, expected, atol=2e-6)


def mirror_model(model: Any, axis: int) -> Any:
    """Return the model whose weights see the world mirrored along an axis.

    Every input that changes sign has its column negated, the two walls across have
    their columns swapped, and the output along the axis is negated.
    """
    image = network(awake=True, target=model.options.target.value, wall_velocity=True)
    image.load_state_dict(model.state_dict())
    low_wall = 2 * axis
    high_wall = 2 * axis + 1
    with torch.no_grad():
        first = image.network.node_encoder[0].weight
        first[:, axis:10:2] *= -1.0
        distances = first[:, 10:14]
        distances[:, [low_wall, high_wall]] = distances[:, [high_wall, low_wall]]
        walls = first[:, 30:].reshape(-1, 4, 2)
        walls[..., axis] *= -1.0
        walls[:, [low_wall, high_wall]] = walls[:, [high_wall, low_wall]]
        first[:, 30:] = walls.flatten(1)
        image.network.edge_encoder[0].weight[:, axis] *= -1.0
        image.network.decoder[-1].weight[axis] *= -1.0
        image.network.decoder[-1].bias[axis] *= -1.0
    return image


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("target", ["acceleration", "velocity"])
def test_a_mirrored_model_in_a_mirrored_world(target: str, axis: int) -> None:
    """With walls, their motion and weights mirrored the rollout is the mirror image."""
    rng = np.random.default_rng(0)
    windows = []
    for seed in (0, 1):
        steps = rng.normal(0.0, 2e-3, (6, 256, 2))
        windows.append(jittered(seed) + steps.cumsum(axis=0))
    window = batch(*windows, walls=True)
    window.wall_velocity[1] *= -0.5
    matrix = torch.eye(2).repeat(2, 1, 1)
    matrix[:, axis, axis] = -1.0
    image_window = mirror_batch(window, matrix, info().bounds)
    model = network(awake=True, target=target, wall_velocity=True)
    image_model = mirror_model(model, axis)

    rollout = rolled(model, window, 3)
    mirrored = rolled(image_model, image_window, 3)
    mirrored[..., axis] = 1.0 - mirrored[..., axis]
    assert_near(mirrored, rollout, atol=1e-6)
    # the weights matter
    unmirrored_weights = rolled(model, image_window, 3)
    unmirrored_weights[..., axis] = 1.0 - unmirrored_weights[..., axis]
    assert largest_difference(unmirrored_weights, rollout) > 1e-5


def test_windows_side_by_side_do_not_see_each_other() -> None:
    """Two windows in one batch roll out as they do alone."""
    model = network(awake=True)
    windows = [swirl(seed, 6) for seed in (0, 1)]
    alone = [rolled(model, batch(window), 3) for window in windows]
    together = rolled(model, batch(*windows), 3)
    assert_near(together, torch.cat(alone), atol=1e-6)


def test_two_frames_are_enough_to_start_from() -> None:
    """The first velocity repeats before the given frames."""
    window = batch(swirl(0, 8))
    model = network()
    first_step = window.position[:, 1:2] - window.position[:, 0:1]
    short = model.start(window.part(slice(2)))
    assert torch.equal(short.velocity, first_step.expand(-1, 5, -1))
    assert torch.equal(short.position, window.position[:, 1])

    middle = model.start(window.part(slice(4)))
    steps = window.position[:, :4].diff(dim=1)
    assert torch.equal(middle.velocity[:, :3], first_step.expand(-1, 3, -1))
    assert torch.equal(middle.velocity[:, 2:], steps)
    with pytest.raises(UsageError):
        model.start(window.part(slice(1)))


def test_more_frames_than_six_count_by_their_last_six() -> None:
    """Two frames are enough for a model of one velocity."""
    window = batch(swirl(0, 8))
    model = network()
    long = model.start(window)
    six = model.start(window.part(slice(2, 8)))
    assert torch.equal(long.velocity, six.velocity)
    assert torch.equal(long.velocity, window.position[:, 2:].diff(dim=1))

    small_model = network(awake=True, velocities=1)
    assert small_model.history == 2
    assert small_model.features.count == 22
    last_two = window.part(slice(6, 8))
    expected = rolled(small_model, last_two, 2)
    assert torch.equal(rolled(small_model, window, 2), expected)


def test_a_state_moved_by_the_truth_is_the_next_start() -> None:
    """The oldest velocity leaves and the new one comes last."""
    window = batch(swirl(0, 7))
    model = network()
    following = model.start(window.part(slice(1, 7)))
    state = model.start(window.part(slice(6)))
    moved = state.move(following.position, following.velocity[:, -1])
    for field in fields(ParticleState):
        value = getattr(moved, field.name)
        expected = getattr(following, field.name)
        if expected is None:
            assert value is None
        else:
            assert torch.equal(value, expected)


def test_wall_velocities_are_those_per_frame() -> None:
    """A frame is half a second here; each particle has the walls of its window."""
    window = batch(swirl(0, 6), swirl(1, 6), walls=True)
    window.wall_velocity[1] *= 3.0
    state = network(wall_velocity=True).start(window)
    first_walls = state.wall_velocity[0]
    per_frame = torch.arange(1.0, 9.0).reshape(4, 2) / 200
    torch.testing.assert_close(first_walls[0], per_frame)
    torch.testing.assert_close(state.wall_velocity[1], 3.0 * first_walls)
    assert network().start(window).wall_velocity is None
    with pytest.raises(UsageError) as caught:
        network(wall_velocity=True, changes={"moving_walls": False})
    assert caught.value.where == "model.wall_velocity"


def test_each_predicted_frame_moves_with_its_own_wall_velocity() -> None:
    """After the last known one that velocity stays."""
    window = batch(swirl(0, 8), walls=True)
    window.wall_velocity.mul_(torch.arange(8.0)[:, None, None])
    state = network(wall_velocity=True).start(window.part(slice(6)))
    wall_velocities = []
    for _ in range(3):
        wall_velocities.append(float(state.wall_velocity[0, 0, 0, 0]))
        state = state.move(state.position, state.velocity[:, -1])
    expected = [6 * 0.005, 7 * 0.005, 7 * 0.005]
    assert wall_velocities == pytest.approx(expected)


def test_particles_stay_in_the_box_unless_told_otherwise() -> None:
    """A particle that flies out stops at the wall; without clamp it flies on."""
    flight = []
    for frame in range(6):
        x = 0.93 - 0.004 * (5 - frame)
        y = 0.5 + 0.001 * frame
        flight.append([[x, y]])
    window = batch(np.array(flight))
    free = rolled(network(clamp=False), window, 3)
    assert float(free[0, -1, 0]) == pytest.approx(0.942, abs=1e-6)

    model = network()
    state = model.start(window)
    x_positions = []
    for _ in range(3):
        with torch.no_grad():
            state, position = model.advance(state)
        x_positions.append(float(position[0, 0]))
    assert x_positions == pytest.approx([0.934, 0.9375, 0.9375], abs=1e-6)
    x_velocity, y_velocity = state.velocity[0, -1].tolist()
    assert x_velocity == pytest.approx(0.0, abs=1e-7)
    assert y_velocity == pytest.approx(0.001, abs=1e-6)


@pytest.mark.parametrize("target", ["acceleration", "velocity"])
def test_no_rollout_leaves_the_box(target: str) -> None:
    """Of 256 particles over 30 frames none is outside, whatever a network says."""
    model = network(awake=True, target=target)
    torch.nn.init.normal_(model.network.decoder[-1].bias, std=50.0)
    rollout = rolled(model, batch(swirl(0, 6)), 30)
    low, high = torch.tensor(info().bounds).T
    is_inside = (rollout >= low) & (rollout <= high)
    is_at_wall = (rollout == low) | (rollout == high)
    assert bool(is_inside.all())
    assert bool(is_at_wall.any())


class Watched(GraphNetwork):
    """A graph network that keeps what it is shown, and says nothing."""

    operator = GNS
    method = "watched"

    def predict(
        self, state: ParticleState, *_: object
    ) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """Keep the state."""
        self.seen = [*getattr(self, "seen", []), state]
        return torch.zeros_like(state.position), {}


def test_noise_stays_in_the_box() -> None:
    """Particles that rest at a wall are disturbed to its inner side only."""
    column = [[0.9375, 0.3 + 0.05 * i] for i in range(8)]
    resting = np.repeat([column], 7, axis=0)
    model = Watched.build(SMALL | {"noise_std": 1e-3}, info())
    model(batch(resting), torch.Generator().manual_seed(0))
    x = model.seen[0].position[:, 0]
    assert float(x.max()) == 0.9375
    assert float(x.min()) < 0.9375


def test_a_wall_passes_gradients_on() -> None:
    """A prediction that a wall stops learns to stop before it, where the truth does."""
    arriving = [[[0.9275 + 0.002 * frame, 0.5]] for frame in range(6)]
    window = np.array([*arriving, [[0.936, 0.5]]])
    model = network()
    loss = model(batch(window))["acceleration"]
    bias = model.network.decoder[-1].bias
    (gradient,) = torch.autograd.grad(loss, bias)
    rollout = rolled(model, batch(window[:6]), 1)
    assert float(rollout[0, 0, 0]) == 0.9375
    # The stopped position is 0.0015 off: 2 e / std^2, times the std that outputs are
    # multiplied by.
    assert float(gradient[0]) == pytest.approx(2 * 0.0015 / 0.0002, rel=1e-3)


def test_forcing_of_the_next_frame_moves_particles_near_walls() -> None:
    """Another wall velocity changes the step near walls in the coming frame alone."""
    window = batch(np.repeat(jittered(0)[None], 7, axis=0), walls=True)
    model = network(awake=True, layers=1, wall_velocity=True, wall_reach=1.0)

    def step_with_other_walls(frame: int | None) -> torch.Tensor:
        walls = window.wall_velocity.clone()
        if frame is not None:
            walls[:, frame] *= -3.0
        given = replace(window, wall_velocity=walls).part(slice(6))
        with torch.no_grad():
            state, _ = model.step(model.start(given))
        return torch.as_tensor(state.position)

    unchanged = step_with_other_walls(None)
    assert torch.equal(unchanged, step_with_other_walls(5))
    change = (unchanged - step_with_other_walls(6)).abs().amax(dim=1)
    is_changed = change > 0
    low, high = torch.tensor(info().bounds).T
    place = window.position[:, 5]
    wall_distance = torch.minimum(place - low, high - place).amin(dim=1)
    assert bool(is_changed[wall_distance < 0.9 * RADIUS].all())
    # one layer sees a neighbour's wall at most
    assert not bool(is_changed[wall_distance > 2.0 * RADIUS].any())


def test_forgetful_windows_know_what_a_rollout_knows_at_its_start() -> None:
    """A forgetful window starts as from its last two to five frames.

    Without a generator, as in validation, nothing is forgotten.
    """
    window = batch(*(swirl(seed, 7) for seed in range(24)))
    model = Watched.build(SMALL | {"forgetful": 1.0}, info())
    model(window, torch.Generator().manual_seed(0))
    velocity = model.seen[0].velocity
    starts = []
    for frame_count in range(2, 7):
        given = window.part(slice(6 - frame_count, 6))
        starts.append(model.start(given).velocity)

    numbers = set()
    for sample in range(24):
        members = window.sample == sample
        matches = []
        for number, start in enumerate(starts):
            if torch.equal(velocity[members], start[members]):
                matches.append(number)
        assert len(matches) == 1
        numbers.update(matches)
    assert numbers == {0, 1, 2, 3}
    model(window)
    assert torch.equal(model.seen[1].velocity, starts[-1])


def test_half_precision_moves_particles_in_full() -> None:
    """Under bf16 autocast positions stay float32, and a step differs by rounding."""
    window = batch(swirl(0, 6))
    model = network(awake=True)
    full = rolled(model, window, 1)
    with torch.autocast("cpu", torch.bfloat16):
        half = rolled(model, window, 1)
    assert half.dtype == torch.float32
    step = largest_difference(full[:, 0], window.position[:, -1])
    rounding = largest_difference(half, full)
    assert 0.0 < rounding < 0.02 * step


def test_the_loss_in_half_precision_differs_by_rounding() -> None:
    """The terms of the loss stay float32."""
    window = batch(swirl(0, 7))
    model = network(awake=True, noise_std=1e-3, symmetry="square")
    with torch.no_grad():
        full = model(window, torch.Generator().manual_seed(0))
        with torch.autocast("cpu", torch.bfloat16):
            half = model(window, torch.Generator().manual_seed(0))
    for name, value in full.items():
        assert half[name].dtype == torch.float32
        torch.testing.assert_close(half[name], value, rtol=0.02, atol=0.0)


def test_scales_are_no_weights() -> None:
    """Weights stored in half precision bring back a model with the scales in full."""
    model = network(awake=True)
    rounded = {name: value.bfloat16() for name, value in model.state_dict().items()}
    restored = network()
    restored.load_state_dict(rounded)
    for scale in ("position", "velocity", "acceleration"):
        std = getattr(restored, scale).std
        assert torch.equal(std, getattr(model, scale).std)
    assert float(restored.velocity.std[0]) == pytest.approx(0.004, rel=1e-7)
