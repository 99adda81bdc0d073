"""Training of graph networks: loss terms against NumPy, own steps, noise, gradients."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from simple_models import (
    SMALL,
    batch,
    info,
    jittered,
    network,
    oracle,
    rolled,
    swirl,
)
from torch import Tensor
from turns import of_this_turn

from lagbench.baselines.baseline import Batch
from lagbench.baselines.catalogue import find
from lagbench.baselines.particle_grid import ParticleGrid
from lagbench.baselines.simulator import (
    TERMS,
    Motion,
    loss_terms,
)
from lagbench.data import grid as scoring
from lagbench.data.grid import Grid

UNIT_BOX = ((0.0, 1.0), (0.0, 1.0))
GRID = Grid(10)
NODES = 12 * 12  # of the grid of the loss: one more beyond each wall
SCALES = {
    "position": torch.tensor((0.25, 0.3)),
    "velocity": torch.tensor((0.004, 0.003)),
    "acceleration": torch.tensor((2e-4, 1e-4)),
}
SPEED_VARIANCE = (0.004**2 + 0.003**2) / 2
SPEED = np.sqrt(SPEED_VARIANCE)
WINDOWS = 2
SAMPLE = torch.arange(WINDOWS).repeat_interleave(256)


def seeded(seed: int) -> torch.Generator:
    """Return a seeded source of randomness."""
    generator = torch.Generator()
    return generator.manual_seed(seed)


def two_swirls(frames: int, *, walls: bool = False) -> Batch:
    """Return two windows side by side."""
    first = swirl(0, frames)
    second = swirl(1, frames)
    return batch(first, second, walls=walls)


def draw_motions(seed: int) -> tuple[Motion, Motion]:
    """Return a prediction and its target of two windows in float64.

    The target is a patch of fluid, the prediction is moved and disturbed, so far that
    other nodes would count than in the target.
    """
    rng = np.random.default_rng(seed)
    first_window = jittered(seed, low=0.2, high=0.75)
    second_window = jittered(seed + 1, low=0.2, high=0.75)
    position = np.concatenate([first_window, second_window])
    x, y = position.T
    velocity = 0.01 * np.stack([y**2, -x], axis=1)
    error = rng.normal(0.0, 1e-3, velocity.shape)
    last_error = rng.normal(0.0, 1e-3, velocity.shape)
    last_velocity = velocity + last_error

    def as_motion(
        x: NDArray[np.float64],
        u: NDArray[np.float64],
    ) -> Motion:
        acceleration = u - last_velocity
        return Motion(
            torch.from_numpy(x),
            torch.from_numpy(u),
            torch.from_numpy(acceleration),
        )

    shift = np.array([0.03, -0.02])
    predicted_position = position + error + shift
    predicted = as_motion(predicted_position, velocity + error)
    target = as_motion(position, velocity)
    return predicted, target


def compute_terms(
    predicted: Motion,
    target: Motion,
    *,
    sample: Tensor = SAMPLE,
    cells: int = 10,
) -> dict[str, Tensor]:
    """Return the loss terms of a prediction and its target."""
    return loss_terms(
        predicted,
        target,
        sample,
        grid=ParticleGrid(UNIT_BOX, cells),
        scales=SCALES,
    )


def convert(motion: Motion, dtype: torch.dtype) -> Motion:
    """Return a motion in another precision."""
    return Motion(*(tensor.to(dtype) for tensor in motion))


def per_window(tensor: Tensor) -> NDArray[np.float64]:
    """Return values of particles by window, shape [window, particle, 2]."""
    values = tensor.numpy()
    return values.reshape(WINDOWS, 256, 2)


def transcribe_terms(predicted: Motion, target: Motion) -> dict[str, float]:
    """Return the six terms of Eqs. 5.29-5.34 by NumPy and lagbench.data.grid."""
    terms = {}
    for name in ("acceleration", "velocity", "position"):
        difference = getattr(predicted, name) - getattr(target, name)
        error = difference.numpy() / SCALES[name].numpy()
        terms[name] = (error**2).sum(axis=1).mean()

    true_position = per_window(target.position)
    true_velocity = per_window(target.velocity)
    sums = scoring.transfer(true_position, true_velocity, GRID)
    weight = sums.weight
    full = (weight**2).sum() / weight.sum()
    truth = scoring.fields(true_position, true_velocity, GRID, full=full)
    prediction = scoring.fields(
        per_window(predicted.position),
        per_window(predicted.velocity),
        GRID,
        full=full,
        counted=truth.counted,
    )
    density_error = prediction.density - truth.density
    terms["density"] = (density_error**2).sum() / (WINDOWS * NODES)
    for name in ("divergence", "vorticity"):
        difference = getattr(prediction, name) - getattr(truth, name)
        terms[name] = np.nanmean((difference / SPEED) ** 2)
    return terms


@pytest.mark.parametrize(
    ("dtype", "tolerance"),
    [
        (torch.float64, 1e-6),  # the deviations are float32
        (torch.float32, 2e-3),
    ],
)
def test_every_term_equals_its_equation_in_numpy(
    dtype: torch.dtype,
    tolerance: float,
) -> None:
    """All six terms, of two windows."""
    predicted, target = draw_motions(0)
    expected = transcribe_terms(predicted, target)
    assert set(expected) == set(TERMS)
    assert min(expected.values()) > 1e-6

    terms = compute_terms(
        convert(predicted, dtype),
        convert(target, dtype),
    )
    values = {name: float(value) for name, value in terms.items()}
    assert values == pytest.approx(expected, rel=tolerance)


def test_an_empty_window_of_vorticity_is_no_nan() -> None:
    """A splash so thin that no node has four counted neighbours costs 0, not NaN."""
    places = [[0.2, 0.2], [0.8, 0.8]]
    position = torch.tensor(places, dtype=torch.float64)
    at_rest = torch.zeros_like(position)
    velocity = at_rest + 0.01
    terms = compute_terms(
        Motion(position, velocity, velocity),
        Motion(position, at_rest, at_rest),
        sample=torch.tensor([0, 1]),
    )
    assert float(terms["vorticity"]) == 0.0
    for value in terms.values():
        assert torch.isfinite(value)


def test_an_oracle_has_no_loss() -> None:
    """All six terms are rounding errors of float32 positions."""
    frames = swirl(0, 7)
    exact = torch.from_numpy(frames).transpose(0, 1)
    terms = oracle(exact)(batch(frames))
    assert set(terms) == set(TERMS)
    for value in terms.values():
        assert float(value) < 2e-5


@pytest.mark.parametrize(
    ("recovery", "error"),
    [
        (None, 2.0),
        (4.0, 2.25),
    ],
)
def test_recovery_asks_for_a_share_of_the_gap(
    recovery: float | None, error: float
) -> None:
    """The particles stand still, while each step of the model adds a velocity.

    After one own step the gap is that velocity, and the next step has twice of it.
    """
    frame = jittered(0, low=0.3, high=0.7)
    still = np.repeat(frame[None], 9, axis=0)
    model = network(pushforward=1, recovery=recovery, noise_std=0.0)
    added = torch.full((2,), 1e-5)  # so small that the way back has no limit
    decoder_bias = model.network.decoder[-1].bias
    decoder_bias.data = model.acceleration(added)

    losses = set()
    for seed in range(8):
        terms = model(batch(still), seeded(seed))
        loss = float(terms["velocity"].detach())
        losses.add(round(loss, 9))
    standardised = added / model.velocity.std
    first = float(torch.sum(standardised**2))
    pushed = error**2 * first
    expected = [first, pushed]
    assert sorted(losses) == pytest.approx(expected, rel=2e-2)


def test_training_and_rollouts_take_the_same_step() -> None:
    """The loss is that of a rollout's first frame, to the bit."""
    window = two_swirls(7)
    model = network(awake=True)
    terms = model(window)

    state = model.start(window.part(slice(6)))
    last_velocity = state.velocity[:, -1]
    following, position = model.advance(state)
    velocity = following.velocity[:, -1]
    predicted = Motion(position, velocity, velocity - last_velocity)
    target_velocity = window.position.diff(dim=1)[:, 5]
    target = Motion(
        window.position[:, 6], target_velocity, target_velocity - last_velocity
    )
    expected = loss_terms(
        predicted,
        target,
        state.sample,
        grid=model.grid,
        scales={name: getattr(model, name).std for name in SCALES},
    )
    for name, value in terms.items():
        assert torch.equal(value, expected[name]), name


def test_noise_is_in_the_scales_and_in_the_target() -> None:
    """An untrained model errs by the true acceleration a less the noise s.

    Its loss is (a^2 + s^2) / (std^2 + s^2) an axis.
    """
    noise = 0.004
    speeds = (0.01, 0.01)
    windows = [swirl(seed, 7, speeds) for seed in range(20)]
    window = batch(*windows)
    model = network(noise_std=noise)
    with torch.no_grad():
        terms = model(window, seeded(0))
    velocity = window.position.diff(dim=1)
    acceleration = velocity.diff(dim=1)[:, -1].double()
    square = acceleration.square()
    mean_square = square.mean(dim=0).numpy()
    variance = np.array([0.004**2, 0.003**2])
    error = mean_square + noise**2
    ratio = error / (variance + noise**2)
    # 10,240 draws have an error of 2 %, and the truth has its share.
    loss = float(terms["velocity"])
    assert loss == pytest.approx(ratio.sum(), rel=0.05)


OPERATORS = ["gns", "supergat", "gat", "gatv2", "pointnet", "transformer"]
NETWORKS = [*OPERATORS, "egnn", "painn", "segnn", "upt", "corgi"]


@pytest.mark.slow
@pytest.mark.parametrize("name", of_this_turn(NETWORKS, turns=3))
def test_every_network_learns_a_swirl(name: str) -> None:
    """After forty steps a rollout is better than constant velocity in every frame.

    Constant velocity is better than standing still.
    """
    torch.manual_seed(0)
    model = find(name).model.build(SMALL, info())
    optimizer = torch.optim.Adam(model.parameters(), 3e-3)
    for step in range(40):
        optimizer.zero_grad()
        flow = swirl(step, 7, (0.05, 0.05))
        terms = model(batch(flow))
        loss = torch.tensor(0.0)
        for term, weight in model.weights.items():
            if term in terms:
                loss = loss + weight * terms[term]
        loss.backward()
        optimizer.step()

    frames = swirl(99, 26, (0.05, 0.05))
    truth = torch.from_numpy(frames).transpose(0, 1)
    last = truth[:, 5:6]
    velocity = last - truth[:, 4:5]
    time = torch.arange(1, 21)[:, None]

    def mean_square_error(path: Tensor) -> Tensor:
        difference = path - truth[:, 6:]
        return difference.square().mean((0, 2))

    path = rolled(model, batch(frames[:6]), 20)
    error = mean_square_error(path)
    straight_error = mean_square_error(last + velocity * time)
    still_error = mean_square_error(last)
    ratio = error / straight_error
    assert float(ratio.max()) < 0.75
    assert bool((straight_error < still_error).all())
