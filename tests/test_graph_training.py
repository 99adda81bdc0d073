"""Training steps of graph networks: the rollout's own step, noise, weights, gradients."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest
import torch
from graph_cases import SMALL, batch, facts, jittered, network, oracle, rolled, swirl

from lagbench.baselines.baseline import Batch, facts_of
from lagbench.baselines.catalogue import find
from lagbench.baselines.loss import TERMS, Motion, Scales, State, loss_terms
from lagbench.baselines.operators.supergat import SuperGAT
from lagbench.baselines.recipe import recipe_for
from lagbench.baselines.simulator import GraphNetwork
from lagbench.data.registry import Registry
from lagbench.make.generate import GenerationResult
from lagbench.torch import WindowDataset, collate

OPERATORS = ("gns", "supergat", "gat", "gatv2", "pointnet", "transformer")


@pytest.mark.parametrize("target", ["acceleration", "velocity"])
def test_an_oracle_has_no_loss(target: str) -> None:
    """All six terms over four own steps are rounding errors of float32 positions."""
    truth = batch(swirl(0, 10))
    exact = torch.from_numpy(swirl(0, 10)).transpose(0, 1)
    found = oracle(exact, target, rollout_loss_steps=4)(truth)
    assert set(found) == set(TERMS)
    assert all(float(value) < 2e-5 for value in found.values())
    with torch.no_grad():
        untrained = network()(truth)
    assert min(float(untrained[name]) for name in ("acceleration", "velocity", "vorticity")) > 1e-2


def test_training_and_rollouts_take_the_same_step() -> None:
    """The loss over three own steps is that of the rollout's frames, to the last bit."""
    window = batch(swirl(0, 9), swirl(1, 9))
    model = network(awake=True, rollout_loss_steps=3)
    found = model(window)
    state, each = model.start(window.part(slice(6))), []
    scales = Scales(model.position.std, model.velocity.std, model.acceleration.std)
    for frame in (6, 7, 8):
        last = state.velocity[:, -1]
        state, position = model.advance(state)
        velocity = window.position[:, frame] - window.position[:, frame - 1]
        predicted = Motion(position, state.velocity[:, -1], state.velocity[:, -1] - last)
        target = Motion(window.position[:, frame], velocity, velocity - last)
        each.append(
            loss_terms(
                predicted, target, state.sample,
                grid=model.grid, scales=scales, norm=model.options.loss_norm, weights={},
            )
        )  # fmt: skip
    for name, value in found.items():
        assert torch.equal(value, torch.stack([terms[name] for terms in each]).mean())


def test_rollout_losses_of_a_falling_particle_by_hand() -> None:
    """Constant velocity against acceleration g: after s steps v is off by s g, x by s (s + 1) g / 2."""
    time, g = np.arange(9.0), 2**-12
    fall = np.repeat(jittered(0)[None], 9, axis=0)
    fall[..., 1] += 0.5 * g * (time * (time - 5.0))[:, None] * 0.25
    with torch.no_grad():
        found = network(rollout_loss_steps=3, loss_norm="l1")(batch(fall))
    step = 0.25 * g
    assert float(found["velocity"]) == pytest.approx(step * (1 + 2 + 3) / 3 / 0.003, rel=2e-3)
    assert float(found["position"]) == pytest.approx(step * (1 + 3 + 6) / 3 / 0.3, rel=2e-3)
    assert float(found["acceleration"]) == pytest.approx(step * (1 + 2 + 3) / 3 / 0.0001, rel=2e-3)


def test_rollout_losses_pass_gradients_through_all_steps() -> None:
    """The last step alone, with the first two detached, has another gradient."""
    window = batch(swirl(0, 9))
    model = network(awake=True, rollout_loss_steps=3, loss={"velocity": 1.0})
    (through,) = torch.autograd.grad(model(window)["velocity"], model.network.decoder[-1].bias)
    state, total = model.start(window.part(slice(6))), 0.0
    for frame in (6, 7, 8):
        state = State(**{f.name: _cut(getattr(state, f.name)) for f in fields(State)})
        state, _ = model.step(state)
        error = state.velocity[:, -1] - (window.position[:, frame] - window.position[:, frame - 1])
        total = total + ((error / model.velocity.std) ** 2).sum(dim=1).mean() / 3
    (cut,) = torch.autograd.grad(total, model.network.decoder[-1].bias)
    assert float((through - cut).norm()) > 0.1 * float(cut.norm())


def _cut(value: torch.Tensor | None) -> torch.Tensor | None:
    return None if value is None else value.detach()


def test_training_leaves_the_batch_alone_and_repeats_with_its_seed() -> None:
    """Noise and images change no stored bit; equal seeds give equal terms, others do not."""
    window = batch(swirl(0, 7), swirl(1, 7), walls=True)
    kept = [getattr(window, f.name).clone() for f in fields(Batch)]
    model = network(awake=True, noise_std=1e-3, symmetry="square", wall_velocity=True)
    first, again, other = (model(window, torch.Generator().manual_seed(seed)) for seed in (1, 1, 2))
    assert all(torch.equal(getattr(window, f.name), k) for f, k in zip(fields(Batch), kept, strict=True))
    assert all(torch.equal(first[name], again[name]) for name in TERMS)
    assert not torch.equal(first["velocity"], other["velocity"])
    assert all(torch.equal(model(window)[name], model(window)[name]) for name in TERMS)


def test_noise_is_in_the_scales_and_in_the_target() -> None:
    """An untrained model errs by the true acceleration less noise: (a^2 + s^2) / (std^2 + s^2) an axis."""
    noise = 0.004
    window = batch(*(swirl(seed, 7, (0.01, 0.01)) for seed in range(20)))
    with torch.no_grad():
        found = float(network(noise_std=noise)(window, torch.Generator().manual_seed(0))["velocity"])
    change = window.position.diff(dim=1).diff(dim=1)[:, -1].double()
    variance = np.array([0.004**2, 0.003**2]) + noise**2
    expected = (((change**2).mean(dim=0).numpy() + noise**2) / variance).sum()
    assert found == pytest.approx(expected, rel=0.05)  # 10,240 draws: 2 %, and the share of the truth


def test_the_operators_own_loss_has_its_weight() -> None:
    """SuperGAT's link prediction is a seventh term of weight 1, or of the weight that is asked for."""
    linked = GraphNetwork.with_operator(SuperGAT)
    window = batch(swirl(0, 7))
    model = linked.build(SMALL, facts())
    assert set(model(window, torch.Generator().manual_seed(0))) == {*TERMS, "link"}
    assert model.weights["link"] == 1.0
    heavy = linked.build(SMALL | {"link_weight": 0.5, "loss": {"vorticity": 0.0}}, facts())
    assert (heavy.weights["link"], heavy.weights["vorticity"]) == (0.5, 0.0)
    assert "link" not in network(link_weight=0.5).weights


@pytest.mark.parametrize("name", ["gns", "supergat"])
def test_terms_that_count_start_alive(name: str, generated: GenerationResult, unmeasured: Registry) -> None:
    """On generated data every term of the recipe's loss starts between 0.01 and 1, the link loss too."""
    recipe = recipe_for(find(name), "curl-noise", "tiny")
    torch.manual_seed(0)
    made = facts_of("curl-noise", "tiny", root=generated.root, registry=unmeasured)
    model = find(name).model.build(recipe.model, made)
    data = WindowDataset(
        "curl-noise", size="tiny", root=generated.root, history=model.history, registry=unmeasured
    )
    windows = collate([data[index] for index in range(0, len(data), 4)])
    with torch.no_grad():
        terms = model(windows, torch.Generator().manual_seed(0))
    counting = {term: model.weights[term] * float(value) for term, value in terms.items()}
    alive = {term: value for term, value in counting.items() if value}
    assert set(alive) == {"acceleration", "divergence", "vorticity"} | set(model.operator.weights)
    # Targets are standardised: half the sum of two components starts at 1 by construction.
    assert all(0.01 < value < 1.05 for value in alive.values()), alive


@pytest.mark.parametrize("name", OPERATORS)
def test_every_operator_learns_a_swirl(name: str) -> None:
    """After forty steps a rollout of a new swirl is better than both floors, frame after frame."""
    torch.manual_seed(0)
    model = find(name).model.build(SMALL, facts())
    optimizer = torch.optim.Adam(model.parameters(), 3e-3)
    for step in range(40):
        optimizer.zero_grad()
        terms = model(batch(swirl(step, 7, (0.05, 0.05))))
        sum(model.weights[term] * value for term, value in terms.items() if term in model.weights).backward()
        optimizer.step()
    truth = torch.from_numpy(swirl(99, 26, (0.05, 0.05))).transpose(0, 1)
    last, speed = truth[:, 5:6], truth[:, 5:6] - truth[:, 4:5]
    error = (rolled(model, batch(swirl(99, 26, (0.05, 0.05))[:6]), 20) - truth[:, 6:]).square().mean((0, 2))
    straight = (last + speed * torch.arange(1, 21)[:, None] - truth[:, 6:]).square().mean((0, 2))
    still = (last - truth[:, 6:]).square().mean((0, 2))
    assert bool((error < 0.75 * straight).all())
    assert bool((straight < still).all())
