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


@pytest.mark.parametrize("target", ["acceleration", "velocity"])
def test_an_oracle_makes_no_error_over_a_rollout(target: str) -> None:
    """Fed the true accelerations or velocities, 90 frames end within float32 rounding
    of the truth.
    """
    truth = batch(swirl(0, 96))
    exact = torch.from_numpy(swirl(0, 96)).transpose(0, 1)
    found = rolled(oracle(exact, target), truth.part(slice(6)), 90)
    moved = float((truth.position[:, 95] - truth.position[:, 5]).norm(dim=1).max())
    assert moved > 0.2
    # The given velocities are differences of float32 positions: 6e-8 a frame if nothing
    # mends it.
    allowed = 90 * 6e-8 if target == "acceleration" else 1e-6
    assert float((found - truth.position[:, 6:]).abs().max()) < allowed


def test_untrained_models_keep_velocities_or_stand_still() -> None:
    """Target acceleration gives constant velocity; target velocity the train mean, here
    0.
    """
    given = batch(swirl(0, 6))
    steps = torch.arange(1.0, 4.0)[:, None]
    last = given.position[:, -1] - given.position[:, -2]
    straight = given.position[:, -1:] + steps * last[:, None]
    torch.testing.assert_close(
        rolled(network(), given, 3), straight, rtol=0.0, atol=3e-7
    )
    still = given.position[:, -1:].expand(-1, 3, -1)
    assert torch.equal(rolled(network(target="velocity"), given, 3), still)


@pytest.mark.parametrize("target", ["acceleration", "velocity"])
def test_a_shift_away_from_walls_shifts_the_rollout(target: str) -> None:
    """All particles moved by one vector: so is what follows (the shift is exact in
    binary).
    """
    rng = np.random.default_rng(0)
    start = np.round(jittered(0, 8, 0.3, 0.5) * 2**16) / 2**16
    drift = np.round(rng.normal(0.0, 1e-3, (6, *start.shape)) * 2**16) / 2**16
    frames = start + drift.cumsum(axis=0)
    shift = np.array([0.25, 0.125])
    model = network(awake=True, target=target)
    here, there = (
        rolled(model, batch(window), 4) for window in (frames, frames + shift)
    )
    assert float((here[:, 0] - batch(frames).position[:, -1]).abs().max()) > 1e-4
    torch.testing.assert_close(
        there, here + torch.from_numpy(shift).float(), rtol=0.0, atol=2e-6
    )


def mirrored(model: Any, axis: int) -> Any:
    """Return the model whose weights see the world mirrored along an axis.

    Every input that changes sign has its column negated, the two walls across have
    their columns swapped, and the output along the axis is negated.
    """
    twin = network(awake=True, target=model.options.target.value, wall_velocity=True)
    twin.load_state_dict(model.state_dict())
    with torch.no_grad():
        first = twin.network.node_encoder[0].weight
        first[:, axis:10:2] *= -1.0
        low = 10 + 2 * axis
        high = 11 + 2 * axis
        first[:, [low, high]] = first[:, [high, low]]
        walls = first[:, 30:].reshape(-1, 4, 2)
        walls[..., axis] *= -1.0
        walls[:, [2 * axis, 2 * axis + 1]] = walls[:, [2 * axis + 1, 2 * axis]]
        first[:, 30:] = walls.flatten(1)
        twin.network.edge_encoder[0].weight[:, axis] *= -1.0
        twin.network.decoder[-1].weight[axis] *= -1.0
        twin.network.decoder[-1].bias[axis] *= -1.0
    return twin


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("target", ["acceleration", "velocity"])
def test_a_mirrored_model_in_a_mirrored_world(target: str, axis: int) -> None:
    """Walls, their motion and the weights mirrored: the rollout is the mirror image."""
    rng = np.random.default_rng(0)
    windows = [
        jittered(seed) + rng.normal(0.0, 2e-3, (6, 256, 2)).cumsum(axis=0)
        for seed in (0, 1)
    ]
    given = batch(*windows, walls=True)
    given.wall_velocity[1] *= -0.5
    matrix = torch.eye(2).repeat(2, 1, 1)
    matrix[:, axis, axis] = -1.0
    turned = mirror_batch(given, matrix, info().bounds)
    model = network(awake=True, target=target, wall_velocity=True)
    here, there, plain = (
        rolled(m, w, 3)
        for m, w in ((model, given), (mirrored(model, axis), turned), (model, turned))
    )
    for found in (there, plain):
        found[..., axis] = 1.0 - found[..., axis]
    torch.testing.assert_close(there, here, rtol=0.0, atol=1e-6)
    assert float((plain - here).abs().max()) > 1e-5  # the weights matter


def test_windows_side_by_side_do_not_see_each_other() -> None:
    """Two windows in one batch roll out as they do alone."""
    model = network(awake=True)
    windows = [swirl(seed, 6) for seed in (0, 1)]
    alone = torch.cat([rolled(model, batch(window), 3) for window in windows])
    torch.testing.assert_close(
        rolled(model, batch(*windows), 3), alone, rtol=0.0, atol=1e-6
    )


def test_two_frames_are_enough_to_start_from() -> None:
    """The first velocity repeats before what is given; more than six frames count by
    their last six.
    """
    given = batch(swirl(0, 8))
    model = network()
    short = model.start(given.part(slice(2)))
    first = given.position[:, 1] - given.position[:, 0]
    assert torch.equal(short.velocity, first[:, None].expand(-1, 5, -1))
    assert torch.equal(short.position, given.position[:, 1])
    middle = model.start(given.part(slice(4)))
    assert torch.equal(middle.velocity[:, :3], first[:, None].expand(-1, 3, -1))
    assert torch.equal(middle.velocity[:, 2:], given.position[:, :4].diff(dim=1))
    long = model.start(given)
    six = model.start(given.part(slice(2, 8)))
    assert torch.equal(long.velocity, six.velocity)
    assert torch.equal(long.velocity, given.position[:, 2:].diff(dim=1))
    with pytest.raises(UsageError):
        model.start(given.part(slice(1)))
    model = network(awake=True, velocities=1)  # sees two frames and starts from two
    assert model.history == 2
    assert model.features.count == 22
    assert torch.equal(
        rolled(model, given, 2), rolled(model, given.part(slice(6, 8)), 2)
    )


def test_a_state_moved_by_the_truth_is_the_next_start() -> None:
    """The oldest velocity leaves, the new one comes last: the start of the window one
    frame on.
    """
    given = batch(swirl(0, 7))
    model = network()
    following = model.start(given.part(slice(1, 7)))
    moved = model.start(given.part(slice(6))).move(
        following.position, following.velocity[:, -1]
    )
    for field in fields(ParticleState):
        one = getattr(moved, field.name)
        other = getattr(following, field.name)
        assert one is other is None or torch.equal(one, other)


def test_walls_move_per_frame() -> None:
    """Wall velocities per second become per frame (half a second here), each particle
    its window's.

    A predicted frame moves with its own wall velocity; after the last known one that
    stays.
    """
    given = batch(swirl(0, 6), swirl(1, 6), walls=True)
    given.wall_velocity[1] *= 3.0
    state = network(wall_velocity=True).start(given)
    torch.testing.assert_close(
        state.wall_velocity[0, 0], torch.arange(1.0, 9.0).reshape(4, 2) / 200
    )
    torch.testing.assert_close(state.wall_velocity[1], 3.0 * state.wall_velocity[0])
    assert network().start(given).wall_velocity is None
    with pytest.raises(UsageError) as caught:
        network(wall_velocity=True, changes={"moving_walls": False})
    assert caught.value.where == "model.wall_velocity"
    whole = batch(swirl(0, 8), walls=True)
    whole.wall_velocity.mul_(torch.arange(8.0)[:, None, None])
    state = network(wall_velocity=True).start(whole.part(slice(6)))
    seen = []
    for _ in range(3):
        seen.append(float(state.wall_velocity[0, 0, 0, 0]))
        state = state.move(state.position, state.velocity[:, -1])
    assert seen == pytest.approx([6 * 0.005, 7 * 0.005, 7 * 0.005])


def test_particles_stay_in_the_box_unless_told_otherwise() -> None:
    """A particle that flies out stops at the wall and its velocity says so; without
    clamp it flies on.
    """
    flight = batch(
        np.array([[[0.93 - 0.004 * (5 - f), 0.5 + 0.001 * f]] for f in range(6)])
    )
    assert float(rolled(network(clamp=False), flight, 3)[0, -1, 0]) == pytest.approx(
        0.942, abs=1e-6
    )
    kept = network()
    places = []
    state = kept.start(flight)
    for _ in range(3):
        with torch.no_grad():
            state, position = kept.advance(state)
        places.append(float(position[0, 0]))
    assert places == pytest.approx([0.934, 0.9375, 0.9375], abs=1e-6)
    assert float(state.velocity[0, -1, 0]) == pytest.approx(0.0, abs=1e-7)
    assert float(state.velocity[0, -1, 1]) == pytest.approx(0.001, abs=1e-6)


@pytest.mark.parametrize("target", ["acceleration", "velocity"])
def test_no_rollout_leaves_the_box(target: str) -> None:
    """Whatever a network says: of 256 particles over 30 frames none is outside."""
    model = network(awake=True, target=target)
    torch.nn.init.normal_(model.network.decoder[-1].bias, std=50.0)
    found = rolled(model, batch(swirl(0, 6)), 30)
    low, high = torch.tensor(info().bounds).T
    assert bool(((found >= low) & (found <= high)).all())
    assert bool(((found == low) | (found == high)).any())  # some did try


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
    resting = np.repeat([[[0.9375, 0.3 + 0.05 * i] for i in range(8)]], 7, axis=0)
    model = Watched.build(SMALL | {"noise_std": 1e-3}, info())
    model(batch(resting), torch.Generator().manual_seed(0))
    x = model.seen[0].position[:, 0]
    assert float(x.min()) < float(x.max()) == 0.9375


def test_a_wall_passes_gradients_on() -> None:
    """A prediction that a wall stops learns to stop before it, where the truth does."""
    arriving = np.array(
        [[[0.9275 + 0.002 * f, 0.5]] for f in range(6)] + [[[0.936, 0.5]]]
    )
    model = network()
    (slope,) = torch.autograd.grad(
        model(batch(arriving))["acceleration"], model.network.decoder[-1].bias
    )
    assert float(rolled(model, batch(arriving[:6]), 1)[0, 0, 0]) == 0.9375
    # The stopped position is 0.0015 off: 2 e / std^2, times the std that outputs are
    # multiplied by.
    assert float(slope[0]) == pytest.approx(2 * 0.0015 / 0.0002, rel=1e-3)


def test_forcing_of_the_next_frame_moves_particles_near_walls() -> None:
    """Another wall velocity in the coming frame changes the step near walls, in an
    older frame nothing.
    """
    window = batch(np.repeat(jittered(0)[None], 7, axis=0), walls=True)
    model = network(awake=True, layers=1, wall_velocity=True, wall_reach=1.0)
    found = []
    for frame in (None, 5, 6):
        walls = window.wall_velocity.clone()
        if frame is not None:
            walls[:, frame] *= -3.0
        with torch.no_grad():
            state, _ = model.step(
                model.start(replace(window, wall_velocity=walls).part(slice(6)))
            )
        found.append(state.position)
    assert torch.equal(found[0], found[1])
    changed = (found[0] - found[2]).abs().amax(dim=1) > 0
    low, high = torch.tensor(info().bounds).T
    place = window.position[:, 5]
    near = torch.minimum(place - low, high - place).amin(dim=1)
    assert bool(changed[near < 0.9 * RADIUS].all())
    assert not bool(
        changed[near > 2.0 * RADIUS].any()
    )  # one layer: a neighbour's wall at most


def test_forgetful_windows_know_what_a_rollout_knows_at_its_start() -> None:
    """A forgetful window starts as from its last few frames do; every number comes up,
    but all of them.
    """
    window = batch(*(swirl(seed, 7) for seed in range(24)))
    model = Watched.build(SMALL | {"forgetful": 1.0}, info())
    model(window, torch.Generator().manual_seed(0))
    starts = [
        model.start(window.part(slice(6 - known, 6))).velocity for known in range(2, 7)
    ]
    numbers = set()
    for sample in range(24):
        mine = window.sample == sample
        (number,) = (
            i
            for i, start in enumerate(starts)
            if torch.equal(model.seen[0].velocity[mine], start[mine])
        )
        numbers.add(number)
    assert numbers == set(range(4))
    model(window)  # without a generator, as in validation, nothing is forgotten
    assert torch.equal(model.seen[1].velocity, starts[-1])


def test_half_precision_moves_particles_in_full() -> None:
    """Under bf16 autocast positions stay float32; a step and the loss differ by bf16's
    rounding only.
    """
    given = batch(swirl(0, 6))
    model = network(awake=True)
    exact = rolled(model, given, 1)
    with torch.autocast("cpu", torch.bfloat16):
        half = rolled(model, given, 1)
    assert half.dtype == torch.float32
    change = (exact[:, 0] - given.position[:, -1]).abs().max()
    assert 0.0 < float((half - exact).abs().max()) < 0.02 * float(change)
    window = batch(swirl(0, 7))
    disturbed = network(awake=True, noise_std=1e-3, symmetry="square")
    with torch.no_grad():
        full = disturbed(window, torch.Generator().manual_seed(0))
        with torch.autocast("cpu", torch.bfloat16):
            mixed = disturbed(window, torch.Generator().manual_seed(0))
    for name, value in full.items():
        assert mixed[name].dtype == torch.float32
        torch.testing.assert_close(mixed[name], value, rtol=0.02, atol=0.0)


def test_scales_are_no_weights() -> None:
    """Weights stored in half precision bring back a model with the scales in full."""
    model = network(awake=True)
    twin = network()
    twin.load_state_dict(
        {name: value.bfloat16() for name, value in model.state_dict().items()}
    )
    for scale in ("position", "velocity", "acceleration"):
        assert torch.equal(getattr(twin, scale).std, getattr(model, scale).std)
    assert float(twin.velocity.std[0]) == pytest.approx(0.004, rel=1e-7)
