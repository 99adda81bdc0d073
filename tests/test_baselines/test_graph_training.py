"""Training of graph networks: loss terms against NumPy, own steps, noise, gradients."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from simple_models import SMALL, batch, info, jittered, network, oracle, rolled, swirl
from torch import Tensor

from lagbench.baselines.baseline import Batch
from lagbench.baselines.catalogue import find
from lagbench.baselines.dataset_info import read_dataset_info
from lagbench.baselines.operators.supergat import SuperGAT
from lagbench.baselines.recipe import recipe_for
from lagbench.baselines.simulator import (
    GRID_TERMS,
    TERMS,
    GraphNetwork,
    LossNorm,
    Motion,
    ParticleState,
    loss_terms,
)
from lagbench.data import grid as scoring
from lagbench.data.grid import Grid
from lagbench.data.registry import Registry
from lagbench.make.generate import GenerationResult
from lagbench.torch import WindowDataset, collate

GRID = Grid(10)
SCALES = {
    "position": torch.tensor((0.25, 0.3)),
    "velocity": torch.tensor((0.004, 0.003)),
    "acceleration": torch.tensor((2e-4, 1e-4)),
}
SPEED = np.sqrt((0.004**2 + 0.003**2) / 2)
WINDOWS = 2
SAMPLE = torch.arange(WINDOWS).repeat_interleave(256)


def seeded(seed: int) -> torch.Generator:
    """Return a seeded source of randomness."""
    return torch.Generator().manual_seed(seed)


def draw_motions(seed: int) -> tuple[Motion, Motion]:
    """Return a prediction and its target of two windows in float64.

    The target is a patch of fluid, the prediction is moved and disturbed, so far that
    other nodes would count than in the target.
    """
    rng = np.random.default_rng(seed)
    first_window = jittered(seed, low=0.2, high=0.75)
    second_window = jittered(seed + 1, low=0.2, high=0.75)
    position = np.concatenate([first_window, second_window])
    velocity = 0.01 * np.stack([position[:, 1] ** 2, -position[:, 0]], axis=1)
    error = rng.normal(0.0, 1e-3, velocity.shape)
    last_velocity = velocity + rng.normal(0.0, 1e-3, velocity.shape)

    def as_motion(x: NDArray[np.float64], u: NDArray[np.float64]) -> Motion:
        acceleration = u - last_velocity
        return Motion(
            torch.from_numpy(x),
            torch.from_numpy(u),
            torch.from_numpy(acceleration),
        )

    predicted = as_motion(position + error + (0.03, -0.02), velocity + error)
    return predicted, as_motion(position, velocity)


def compute_terms(
    predicted: Motion,
    target: Motion,
    *,
    norm: str = "l2",
    sample: Tensor = SAMPLE,
    grid: Grid = GRID,
    **weights: float,
) -> dict[str, Tensor]:
    """Return the loss terms of a prediction and its target."""
    return loss_terms(
        predicted,
        target,
        sample,
        grid=grid,
        scales=SCALES,
        norm=LossNorm(norm),
        weights=weights,
    )


def require_gradients(motion: Motion) -> Motion:
    """Return a copy of a motion that has gradients."""
    return Motion(*(tensor.clone().requires_grad_() for tensor in motion))


def per_window(tensor: Tensor) -> NDArray[np.float64]:
    """Return values of particles by window, shape [window, particle, 2]."""
    return tensor.numpy().reshape(WINDOWS, 256, 2)


def transcribe_terms(predicted: Motion, target: Motion, p: int) -> dict[str, float]:
    """Return the six terms of Eqs. 5.29-5.34 by NumPy and lagbench.data.grid."""
    terms = {}
    for name in ("acceleration", "velocity", "position"):
        difference = getattr(predicted, name) - getattr(target, name)
        error = difference.numpy() / SCALES[name].numpy()
        terms[name] = (np.abs(error) ** p).sum(axis=1).mean()

    true_position = per_window(target.position)
    true_velocity = per_window(target.velocity)
    weight = scoring.transfer(true_position, true_velocity, GRID).weight
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
    terms["density"] = (np.abs(density_error) ** p).mean()
    for name in ("divergence", "vorticity"):
        error = (getattr(prediction, name) - getattr(truth, name)) / SPEED
        terms[name] = np.nanmean(np.abs(error) ** p)
    return terms


@pytest.mark.parametrize(
    ("norm", "p"),
    [
        ("l1", 1),
        ("l2", 2),
    ],
)
@pytest.mark.parametrize(
    ("dtype", "tolerance"),
    [
        (torch.float64, 1e-6),  # the deviations are float32
        (torch.float32, 2e-3),
    ],
)
def test_every_term_equals_its_equation_in_numpy(
    norm: str,
    p: int,
    dtype: torch.dtype,
    tolerance: float,
) -> None:
    """All six terms, of two windows."""
    predicted, target = draw_motions(0)
    expected = transcribe_terms(predicted, target, p)
    assert set(expected) == set(TERMS)
    assert min(expected.values()) > 1e-6

    terms = compute_terms(
        Motion(*(tensor.to(dtype) for tensor in predicted)),
        Motion(*(tensor.to(dtype) for tensor in target)),
        norm=norm,
    )
    values = {name: float(value) for name, value in terms.items()}
    assert values == pytest.approx(expected, rel=tolerance)


@pytest.mark.parametrize(
    ("name", "other_name"),
    [
        ("vorticity", "divergence"),
        ("divergence", "vorticity"),
    ],
)
def test_a_linear_flow_costs_what_its_gradient_says(name: str, other_name: str) -> None:
    """Extra rotation W costs (2 W / speed)^2 of vorticity.

    Extra expansion D costs (2 D / speed)^2 of divergence. Nodes at the rim of the grid
    average over half a stencil, so that only inner ones are exact.
    """
    # The particles fill the unit box evenly.
    axis = (torch.arange(128).double() + 0.5) / 128
    points = torch.cartesian_prod(axis, axis)
    x, y = (points - 0.5).T
    if name == "vorticity":
        flow = 0.002 * torch.stack([-y, x], dim=1)
    else:
        flow = 0.002 * torch.stack([x, y], dim=1)
    at_rest = torch.zeros_like(flow)

    terms = compute_terms(
        Motion(points, flow, flow),
        Motion(points, at_rest, at_rest),
        sample=torch.zeros(128**2, dtype=torch.int64),
        grid=Grid(32),
    )
    expected = (0.004 / SPEED) ** 2
    assert float(terms[name]) == pytest.approx(expected, rel=0.02)
    assert float(terms[other_name]) < 1e-9 * expected
    assert float(terms["density"]) == 0.0


@pytest.mark.parametrize(
    "ignored",
    [
        ("vorticity", "velocity"),
        GRID_TERMS,
    ],
)
def test_terms_of_weight_zero_are_logged_without_a_graph(
    ignored: tuple[str, ...],
) -> None:
    """Their values stay, but torch records no gradient for them."""
    predicted, target = draw_motions(0)
    predicted = require_gradients(predicted)
    all_terms = compute_terms(predicted, target)
    for value in all_terms.values():
        assert value.requires_grad

    weights = dict.fromkeys(ignored, 0.0)
    terms = compute_terms(predicted, target, **weights)
    without_gradient = set()
    for name, value in terms.items():
        torch.testing.assert_close(value, all_terms[name], rtol=0.0, atol=0.0)
        if not value.requires_grad:
            without_gradient.add(name)
    assert without_gradient == set(ignored)


@pytest.mark.parametrize("name", TERMS)
def test_every_term_pulls_towards_the_truth(name: str) -> None:
    """A small step against the gradient lowers the term as the gradient promises."""
    predicted, target = draw_motions(4)
    variable = require_gradients(predicted)
    loss = compute_terms(variable, target)[name]
    gradients = []
    for gradient in torch.autograd.grad(loss, variable, allow_unused=True):
        if gradient is None:
            gradient = torch.zeros_like(predicted.position)
        gradients.append(gradient)

    value = float(loss.detach())
    promised_decrease = 1e-4 * value
    square = sum(float((gradient**2).sum()) for gradient in gradients)
    step = promised_decrease / square
    stepped = []
    for tensor, gradient in zip(predicted, gradients, strict=True):
        stepped.append(tensor - step * gradient)
    value_after = float(compute_terms(Motion(*stepped), target)[name])
    assert value - value_after == pytest.approx(promised_decrease, rel=0.02)


def test_an_empty_window_of_vorticity_is_no_nan() -> None:
    """A splash so thin that no node has four counted neighbours costs 0, not NaN."""
    position = torch.tensor([[0.2, 0.2], [0.8, 0.8]], dtype=torch.float64)
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


@pytest.mark.parametrize("target", ["acceleration", "velocity"])
def test_an_oracle_has_no_loss(target: str) -> None:
    """All six terms over four own steps are rounding errors of float32 positions."""
    frames = swirl(0, 10)
    exact = torch.from_numpy(frames).transpose(0, 1)
    terms = oracle(exact, target, rollout_loss_steps=4)(batch(frames))
    assert set(terms) == set(TERMS)
    for value in terms.values():
        assert float(value) < 2e-5


def test_an_oracle_has_no_loss_after_own_steps() -> None:
    """However many steps without gradients come first, the right frame is compared."""
    frames = swirl(0, 12)
    exact = torch.from_numpy(frames).transpose(0, 1)
    model = oracle(exact, "acceleration", pushforward=4, noise_std=0.0)
    assert model.future == 5
    for seed in range(8):
        model.frame = 0
        terms = model(batch(frames), seeded(seed))
        for name in TERMS:
            assert float(terms[name]) < 2e-5


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
    still = np.repeat(jittered(0, low=0.3, high=0.7)[None], 9, axis=0)
    model = network(pushforward=1, recovery=recovery, noise_std=0.0)
    added = torch.full((2,), 1e-5)  # so small that the way back has no limit
    model.network.decoder[-1].bias.data = model.acceleration(added)

    losses = set()
    for seed in range(8):
        terms = model(batch(still), seeded(seed))
        losses.add(round(float(terms["velocity"]), 9))
    first = float(torch.sum((added / model.velocity.std) ** 2))
    pushed = error**2 * first
    assert sorted(losses) == pytest.approx([first, pushed], rel=2e-2)


def test_an_untrained_network_has_a_loss() -> None:
    with torch.no_grad():
        terms = network()(batch(swirl(0, 10)))
    for name in ("acceleration", "velocity", "vorticity"):
        assert float(terms[name]) > 1e-2


def test_training_and_rollouts_take_the_same_step() -> None:
    """The loss over three own steps is that of the rollout's frames, to the bit."""
    window = batch(swirl(0, 9), swirl(1, 9))
    model = network(awake=True, rollout_loss_steps=3)
    terms = model(window)

    scales = {name: getattr(model, name).std for name in SCALES}
    true_velocity = window.position.diff(dim=1)
    state = model.start(window.part(slice(6)))
    terms_of_frames = []
    for frame in (6, 7, 8):
        last_velocity = state.velocity[:, -1]
        state, position = model.advance(state)
        velocity = state.velocity[:, -1]
        predicted = Motion(position, velocity, velocity - last_velocity)
        target_velocity = true_velocity[:, frame - 1]
        target = Motion(
            window.position[:, frame],
            target_velocity,
            target_velocity - last_velocity,
        )
        frame_terms = loss_terms(
            predicted,
            target,
            state.sample,
            grid=model.grid,
            scales=scales,
            norm=model.options.loss_norm,
            weights={},
        )
        terms_of_frames.append(frame_terms)

    for name, value in terms.items():
        values = [frame_terms[name] for frame_terms in terms_of_frames]
        assert torch.equal(value, torch.stack(values).mean())


def test_rollout_losses_of_a_falling_particle_by_hand() -> None:
    """The model predicts constant velocity, while the particles fall.

    After s steps of acceleration g the velocity is off by s g, the position by
    s (s + 1) g / 2.
    """
    time = np.arange(9.0)
    g = 0.25 * 2**-12
    fall = np.repeat(jittered(0)[None], 9, axis=0)
    fall[..., 1] += 0.5 * g * (time * (time - 5.0))[:, None]
    with torch.no_grad():
        terms = network(rollout_loss_steps=3, loss_norm="l1")(batch(fall))
    velocity_error = g * (1 + 2 + 3) / 3
    position_error = g * (1 + 3 + 6) / 3
    expected = {
        "velocity": velocity_error / 0.003,
        "position": position_error / 0.3,
        "acceleration": velocity_error / 0.0001,
    }
    values = {name: float(terms[name]) for name in expected}
    assert values == pytest.approx(expected, rel=2e-3)


def detach_state(state: ParticleState) -> ParticleState:
    """Return the state without a graph of gradients."""
    values = {}
    for field in fields(ParticleState):
        value = getattr(state, field.name)
        if value is not None:
            value = value.detach()
        values[field.name] = value
    return ParticleState(**values)


def test_rollout_losses_pass_gradients_through_all_steps() -> None:
    """With states that are detached after each step the gradient is another one."""
    window = batch(swirl(0, 9))
    model = network(awake=True, rollout_loss_steps=3, loss={"velocity": 1.0})
    bias = model.network.decoder[-1].bias
    loss = model(window)["velocity"]
    (gradient,) = torch.autograd.grad(loss, bias)

    true_velocity = window.position.diff(dim=1)
    state = model.start(window.part(slice(6)))
    detached_loss = torch.tensor(0.0)
    for frame in (6, 7, 8):
        state, _ = model.step(detach_state(state))
        difference = state.velocity[:, -1] - true_velocity[:, frame - 1]
        error = (difference / model.velocity.std) ** 2
        detached_loss = detached_loss + error.sum(dim=1).mean() / 3
    (detached_gradient,) = torch.autograd.grad(detached_loss, bias)
    difference = float((gradient - detached_gradient).norm())
    assert difference > 0.1 * float(detached_gradient.norm())


@pytest.mark.parametrize(
    ("symmetry", "is_forced"),
    [
        ("square", False),
        ("mirror", True),
    ],
)
def test_training_leaves_the_batch_alone(symmetry: str, is_forced: bool) -> None:
    """Noise and mirror images change no stored bit."""
    window = batch(swirl(0, 7), swirl(1, 7), walls=True)
    origin = window.position[:, 0].clone()
    viscosity = torch.full((window.windows,), 1e-3)
    window = replace(window, origin=origin, viscosity=viscosity)
    if is_forced:
        # on two layers, shape [window, frame, layer, axis]
        force = torch.full((window.windows, 7, 2, 2), 0.1)
        window = replace(window, body_force=force)
    before = {}
    for field in fields(Batch):
        value = getattr(window, field.name)
        if value is not None:
            before[field.name] = value.clone()
    assert ("body_force" in before) is is_forced
    model = network(awake=True, noise_std=1e-3, symmetry=symmetry, wall_velocity=True)
    model(window, seeded(1))
    for name, value in before.items():
        assert torch.equal(getattr(window, name), value)


def test_training_repeats_with_its_seed() -> None:
    """Equal seeds give equal terms, others do not; without a seed nothing is random."""
    window = batch(swirl(0, 7), swirl(1, 7), walls=True)
    window = replace(window, origin=window.position[:, 0].clone())
    model = network(awake=True, noise_std=1e-3, symmetry="square", wall_velocity=True)
    terms = model(window, seeded(1))
    same_seed = model(window, seeded(1))
    another_seed = model(window, seeded(2))
    without_noise = model(window)
    again_without_noise = model(window)
    for name in TERMS:
        assert torch.equal(terms[name], same_seed[name])
        assert torch.equal(without_noise[name], again_without_noise[name])
    assert not torch.equal(terms["velocity"], another_seed["velocity"])


def test_noise_is_in_the_scales_and_in_the_target() -> None:
    """An untrained model errs by the true acceleration a less the noise s.

    Its loss is (a^2 + s^2) / (std^2 + s^2) an axis.
    """
    noise = 0.004
    window = batch(*(swirl(seed, 7, (0.01, 0.01)) for seed in range(20)))
    with torch.no_grad():
        terms = network(noise_std=noise)(window, seeded(0))
    acceleration = window.position.diff(dim=1).diff(dim=1)[:, -1].double()
    mean_square = (acceleration**2).mean(dim=0).numpy()
    variance = np.array([0.004**2, 0.003**2])
    expected = ((mean_square + noise**2) / (variance + noise**2)).sum()
    # 10,240 draws have an error of 2 %, and the truth has its share.
    assert float(terms["velocity"]) == pytest.approx(expected, rel=0.05)


def test_the_operators_own_loss_has_its_weight() -> None:
    """SuperGAT's link prediction is a seventh term of weight 1 by default."""
    linked = GraphNetwork.with_operator(SuperGAT)
    model = linked.build(SMALL, info())
    terms = model(batch(swirl(0, 7)), seeded(0))
    assert set(terms) == {*TERMS, "link"}
    assert model.weights["link"] == 1.0
    assert "link" not in network().weights


def test_weights_of_terms_can_be_chosen() -> None:
    options = {"link_weight": 0.5, "loss": {"vorticity": 0.0}}
    model = GraphNetwork.with_operator(SuperGAT).build(SMALL | options, info())
    assert model.weights["link"] == 0.5
    assert model.weights["vorticity"] == 0.0


@pytest.mark.parametrize("name", ["gns", "supergat"])
def test_terms_that_count_start_alive(
    name: str,
    generated: GenerationResult,
    unmeasured: Registry,
) -> None:
    """Every term of a recipe's loss starts between 0.01 and 1 on generated data."""
    recipe = recipe_for(find(name), "curl-noise", "tiny")
    torch.manual_seed(0)
    location: dict[str, Any] = {
        "root": generated.root,
        "registry": unmeasured,
    }
    dataset_info = read_dataset_info("curl-noise", "tiny", **location)
    model = find(name).model.build(recipe.model, dataset_info)
    dataset = WindowDataset(
        "curl-noise",
        size="tiny",
        history=model.history,
        **location,
    )
    windows = collate([dataset[index] for index in range(0, len(dataset), 4)])
    with torch.no_grad():
        terms = model(windows, seeded(0))

    counted_terms = {}
    for term, value in terms.items():
        weighted = model.weights[term] * float(value)
        if weighted:
            counted_terms[term] = weighted
    expected = {"acceleration", "divergence", "vorticity", *model.operator.weights}
    assert set(counted_terms) == expected
    # Targets are standardised: half the sum of two components starts at 1 by
    # construction.
    for weighted in counted_terms.values():
        assert 0.01 < weighted < 1.05


@pytest.mark.parametrize(
    "name", ["gns", "supergat", "gat", "gatv2", "pointnet", "transformer"]
)
def test_every_operator_learns_a_swirl(name: str) -> None:
    """After forty steps a rollout is better than constant velocity in every frame.

    Constant velocity is better than standing still.
    """
    torch.manual_seed(0)
    model = find(name).model.build(SMALL, info())
    optimizer = torch.optim.Adam(model.parameters(), 3e-3)
    for step in range(40):
        optimizer.zero_grad()
        terms = model(batch(swirl(step, 7, (0.05, 0.05))))
        loss = torch.tensor(0.0)
        for term, weight in model.weights.items():
            if term in terms:
                loss = loss + weight * terms[term]
        loss.backward()
        optimizer.step()

    frames = swirl(99, 26, (0.05, 0.05))
    truth = torch.from_numpy(frames).transpose(0, 1)
    last = truth[:, 5:6]
    velocity = truth[:, 5:6] - truth[:, 4:5]
    time = torch.arange(1, 21)[:, None]

    def mean_square_error(path: Tensor) -> Tensor:
        return (path - truth[:, 6:]).square().mean((0, 2))

    error = mean_square_error(rolled(model, batch(frames[:6]), 20))
    straight_error = mean_square_error(last + velocity * time)
    still_error = mean_square_error(last)
    assert bool((error < 0.75 * straight_error).all())
    assert bool((straight_error < still_error).all())
