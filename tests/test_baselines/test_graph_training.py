"""Training of graph networks: the six loss terms against NumPy, own steps, noise,
weights, gradients.
"""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
import torch
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
DEVIATIONS = {
    "position": (0.25, 0.3),
    "velocity": (0.004, 0.003),
    "acceleration": (2e-4, 1e-4),
}
SCALES = {name: torch.tensor(pair) for name, pair in DEVIATIONS.items()}
SPEED = np.sqrt((0.004**2 + 0.003**2) / 2)
WINDOWS = 2
SAMPLE = torch.arange(WINDOWS).repeat_interleave(256)


def motion(seed: int) -> tuple[Motion, Motion]:
    """Return a prediction and a truth of two windows in float64: a patch of fluid,
    moved and disturbed.
    """
    rng = np.random.default_rng(seed)
    place = np.concatenate([jittered(s, low=0.2, high=0.75) for s in (seed, seed + 1)])
    swirl = 0.01 * np.stack([place[:, 1] ** 2, -place[:, 0]], axis=1)
    error = rng.normal(0.0, 1e-3, swirl.shape)
    moved = place + error + (0.03, -0.02)  # other nodes would count than in the truth
    last = swirl + rng.normal(0.0, 1e-3, swirl.shape)
    frames = [(moved, swirl + error), (place, swirl)]
    return tuple(Motion(*map(torch.from_numpy, (x, u, u - last))) for x, u in frames)  # type: ignore[return-value]


def terms(
    *motions: Motion,
    norm: str = "l2",
    sample: Tensor = SAMPLE,
    grid: Grid = GRID,
    **weights: float,
) -> dict[str, Tensor]:
    """Return the loss terms of a prediction and its target."""
    return loss_terms(
        *motions, sample, grid=grid, scales=SCALES, norm=LossNorm(norm), weights=weights
    )


def by_numpy(predicted: Motion, target: Motion, p: int) -> dict[str, float]:
    """Return the six terms by NumPy and lagbench.data.grid, term after term as Eqs.
    5.29-5.34 stand.
    """
    found = {}
    for name in ("acceleration", "velocity", "position"):
        error = (getattr(predicted, name) - getattr(target, name)).numpy() / SCALES[
            name
        ].numpy()
        found[name] = (np.abs(error) ** p).sum(axis=1).mean()
    shape = (WINDOWS, 256, 2)
    true_x, true_u, own_x, own_u = (
        frame.numpy().reshape(shape)
        for frame in (target[0], target[1], predicted[0], predicted[1])
    )
    weight = scoring.transfer(true_x, true_u, GRID).weight
    full = (weight**2).sum() / weight.sum()
    true = scoring.fields(true_x, true_u, GRID, full=full)
    own = scoring.fields(own_x, own_u, GRID, full=full, counted=true.counted)
    found["density"] = (np.abs(own.density - true.density) ** p).mean()
    for name in ("divergence", "vorticity"):
        error = (getattr(own, name) - getattr(true, name)) / SPEED
        found[name] = np.nanmean(np.abs(error) ** p)
    return found


@pytest.mark.parametrize(("norm", "p"), [("l1", 1), ("l2", 2)])
def test_every_term_equals_its_equation_in_numpy(norm: str, p: int) -> None:
    """All six, two windows, in float64 to 1e-6 (the deviations are float32) and in
    float32.
    """
    predicted, target = motion(0)
    expected = by_numpy(predicted, target, p)
    assert set(expected) == set(TERMS)
    assert min(expected.values()) > 1e-6
    single = [
        Motion(*(tensor.float() for tensor in frame)) for frame in (predicted, target)
    ]
    for motions, error in (((predicted, target), 1e-6), (single, 2e-3)):
        found = terms(*motions, norm=norm)
        assert {name: float(value) for name, value in found.items()} == pytest.approx(
            expected, rel=error
        )


@pytest.mark.parametrize("name", ["vorticity", "divergence"])
def test_a_linear_flow_costs_what_its_gradient_says(name: str) -> None:
    """Extra rotation W costs (2 W / speed)^2 of vorticity, extra expansion D (2 D /
    speed)^2 of divergence.

    Nodes at the rim of the grid average over half a stencil, so that only inner ones
    are exact.
    """
    # particles fill the unit box evenly
    axis = (torch.arange(128).double() + 0.5) / 128
    points = torch.cartesian_prod(axis, axis)
    x, y = (points - 0.5).T
    flow = 0.002 * torch.stack([-y, x] if name == "vorticity" else [x, y], dim=1)
    moving, rest = (
        Motion(points, velocity, velocity) for velocity in (flow, 0.0 * flow)
    )
    found = terms(
        moving, rest, sample=torch.zeros(128**2, dtype=torch.int64), grid=Grid(32)
    )
    expected = (0.004 / SPEED) ** 2
    assert float(found[name]) == pytest.approx(expected, rel=0.02)
    other = ({"vorticity", "divergence"} - {name}).pop()
    assert float(found[other]) < 1e-9 * expected
    assert float(found["density"]) == 0.0


def test_terms_of_weight_zero_are_logged_without_a_graph() -> None:
    """Their values stay; their gradient is not even recorded, nor the transfer's if
    none counts.
    """
    predicted, target = motion(0)
    moving = Motion(*(tensor.clone().requires_grad_() for tensor in predicted))
    everything = terms(moving, target)
    assert all(value.requires_grad for value in everything.values())
    some = terms(moving, target, vorticity=0.0, velocity=0.0)
    assert {name for name, value in some.items() if not value.requires_grad} == {
        "vorticity",
        "velocity",
    }
    none = terms(moving, target, **dict.fromkeys(GRID_TERMS, 0.0))
    assert {name for name, value in none.items() if not value.requires_grad} == set(
        GRID_TERMS
    )
    for found in (some, none):
        for name, value in found.items():
            torch.testing.assert_close(value, everything[name], rtol=0.0, atol=0.0)


@pytest.mark.parametrize("name", TERMS)
def test_every_term_pulls_towards_the_truth(name: str) -> None:
    """A small step against the gradient lowers the term as much as the gradient
    promises.
    """
    predicted, target = motion(4)
    moving = Motion(*(tensor.clone().requires_grad_() for tensor in predicted))
    loss = terms(moving, target)[name]
    gradients = torch.autograd.grad(loss, moving, allow_unused=True)
    value = float(loss.detach())
    size = sum(
        float((gradient**2).sum()) for gradient in gradients if gradient is not None
    )
    step = 1e-4 * value / size
    stepped = Motion(
        *(
            x if g is None else x - step * g
            for x, g in zip(predicted, gradients, strict=True)
        )
    )
    assert value - float(terms(stepped, target)[name]) == pytest.approx(
        1e-4 * value, rel=0.02
    )


def test_an_empty_window_of_vorticity_is_no_nan() -> None:
    """A splash so thin that no node has four counted neighbours costs 0, not NaN."""
    place = torch.tensor([[0.2, 0.2], [0.8, 0.8]], dtype=torch.float64)
    still = torch.zeros_like(place)
    moving = Motion(place, still + 0.01, still + 0.01)
    found = terms(moving, Motion(place, still, still), sample=torch.tensor([0, 1]))
    assert float(found["vorticity"]) == 0.0
    assert all(torch.isfinite(value) for value in found.values())


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
    assert (
        min(
            float(untrained[name]) for name in ("acceleration", "velocity", "vorticity")
        )
        > 1e-2
    )


def test_training_and_rollouts_take_the_same_step() -> None:
    """The loss over three own steps is that of the rollout's frames, to the last
    bit.
    """
    window = batch(swirl(0, 9), swirl(1, 9))
    model = network(awake=True, rollout_loss_steps=3)
    found = model(window)
    state = model.start(window.part(slice(6)))
    each = []
    scales = {name: getattr(model, name).std for name in SCALES}
    for frame in (6, 7, 8):
        last = state.velocity[:, -1]
        state, position = model.advance(state)
        velocity = window.position[:, frame] - window.position[:, frame - 1]
        predicted = Motion(
            position, state.velocity[:, -1], state.velocity[:, -1] - last
        )
        target = Motion(window.position[:, frame], velocity, velocity - last)
        asked = {
            "grid": model.grid,
            "scales": scales,
            "norm": model.options.loss_norm,
            "weights": {},
        }
        each.append(loss_terms(predicted, target, state.sample, **asked))
    for name, value in found.items():
        assert torch.equal(value, torch.stack([terms[name] for terms in each]).mean())


def test_rollout_losses_of_a_falling_particle_by_hand() -> None:
    """Constant velocity against acceleration g: after s steps v is off by s g, x by s
    (s + 1) g / 2.
    """
    time = np.arange(9.0)
    g = 2**-12
    fall = np.repeat(jittered(0)[None], 9, axis=0)
    fall[..., 1] += 0.5 * g * (time * (time - 5.0))[:, None] * 0.25
    with torch.no_grad():
        found = network(rollout_loss_steps=3, loss_norm="l1")(batch(fall))
    step = 0.25 * g
    assert float(found["velocity"]) == pytest.approx(
        step * (1 + 2 + 3) / 3 / 0.003, rel=2e-3
    )
    assert float(found["position"]) == pytest.approx(
        step * (1 + 3 + 6) / 3 / 0.3, rel=2e-3
    )
    assert float(found["acceleration"]) == pytest.approx(
        step * (1 + 2 + 3) / 3 / 0.0001, rel=2e-3
    )


def test_rollout_losses_pass_gradients_through_all_steps() -> None:
    """The last step alone, with the first two detached, has another gradient."""
    window = batch(swirl(0, 9))
    model = network(awake=True, rollout_loss_steps=3, loss={"velocity": 1.0})
    (through,) = torch.autograd.grad(
        model(window)["velocity"], model.network.decoder[-1].bias
    )
    state = model.start(window.part(slice(6)))
    total = 0.0
    for frame in (6, 7, 8):
        held = {f.name: getattr(state, f.name) for f in fields(ParticleState)}
        state, _ = model.step(
            ParticleState(
                **{
                    name: value if value is None else value.detach()
                    for name, value in held.items()
                }
            )
        )
        error = state.velocity[:, -1] - (
            window.position[:, frame] - window.position[:, frame - 1]
        )
        total = total + ((error / model.velocity.std) ** 2).sum(dim=1).mean() / 3
    (cut,) = torch.autograd.grad(total, model.network.decoder[-1].bias)
    assert float((through - cut).norm()) > 0.1 * float(cut.norm())


def test_training_leaves_the_batch_alone_and_repeats_with_its_seed() -> None:
    """Noise and images change no stored bit; equal seeds give equal terms, others do
    not.
    """
    window = batch(swirl(0, 7), swirl(1, 7), walls=True)
    window = replace(window, origin=window.position[:, 0].clone())
    kept = [getattr(window, f.name).clone() for f in fields(Batch)]
    model = network(awake=True, noise_std=1e-3, symmetry="square", wall_velocity=True)
    first, again, other = (
        model(window, torch.Generator().manual_seed(seed)) for seed in (1, 1, 2)
    )
    assert all(
        torch.equal(getattr(window, f.name), k)
        for f, k in zip(fields(Batch), kept, strict=True)
    )
    assert all(torch.equal(first[name], again[name]) for name in TERMS)
    assert not torch.equal(first["velocity"], other["velocity"])
    assert all(torch.equal(model(window)[name], model(window)[name]) for name in TERMS)


def test_noise_is_in_the_scales_and_in_the_target() -> None:
    """An untrained model errs by the true acceleration less noise: (a^2 + s^2) / (std^2
    + s^2) an axis.
    """
    noise = 0.004
    window = batch(*(swirl(seed, 7, (0.01, 0.01)) for seed in range(20)))
    with torch.no_grad():
        found = float(
            network(noise_std=noise)(window, torch.Generator().manual_seed(0))[
                "velocity"
            ]
        )
    change = window.position.diff(dim=1).diff(dim=1)[:, -1].double()
    variance = np.array([0.004**2, 0.003**2]) + noise**2
    expected = (((change**2).mean(dim=0).numpy() + noise**2) / variance).sum()
    assert found == pytest.approx(
        expected, rel=0.05
    )  # 10,240 draws: 2 %, and the share of the truth


def test_the_operators_own_loss_has_its_weight() -> None:
    """SuperGAT's link prediction is a seventh term of weight 1, or of the weight that
    is asked for.
    """
    linked = GraphNetwork.with_operator(SuperGAT)
    window = batch(swirl(0, 7))
    model = linked.build(SMALL, info())
    assert set(model(window, torch.Generator().manual_seed(0))) == {*TERMS, "link"}
    assert model.weights["link"] == 1.0
    heavy = linked.build(
        SMALL | {"link_weight": 0.5, "loss": {"vorticity": 0.0}}, info()
    )
    assert heavy.weights["link"] == 0.5
    assert heavy.weights["vorticity"] == 0.0
    assert "link" not in network().weights


@pytest.mark.parametrize("name", ["gns", "supergat"])
def test_terms_that_count_start_alive(
    name: str, generated: GenerationResult, unmeasured: Registry
) -> None:
    """On generated data every term of the recipe's loss starts between 0.01 and 1, the
    link loss too.
    """
    recipe = recipe_for(find(name), "curl-noise", "tiny")
    torch.manual_seed(0)
    made = read_dataset_info(
        "curl-noise", "tiny", root=generated.root, registry=unmeasured
    )
    model = find(name).model.build(recipe.model, made)
    data = WindowDataset(
        "curl-noise",
        size="tiny",
        root=generated.root,
        history=model.history,
        registry=unmeasured,
    )
    windows = collate([data[index] for index in range(0, len(data), 4)])
    with torch.no_grad():
        terms = model(windows, torch.Generator().manual_seed(0))
    counting = {
        term: model.weights[term] * float(value) for term, value in terms.items()
    }
    alive = {term: value for term, value in counting.items() if value}
    assert set(alive) == {"acceleration", "divergence", "vorticity"} | set(
        model.operator.weights
    )
    # Targets are standardised: half the sum of two components starts at 1 by
    # construction.
    assert all(0.01 < value < 1.05 for value in alive.values()), alive


@pytest.mark.parametrize(
    "name", ["gns", "supergat", "gat", "gatv2", "pointnet", "transformer"]
)
def test_every_operator_learns_a_swirl(name: str) -> None:
    """After forty steps a rollout of a new swirl is better than both floors, frame
    after frame.
    """
    torch.manual_seed(0)
    model = find(name).model.build(SMALL, info())
    optimizer = torch.optim.Adam(model.parameters(), 3e-3)
    for step in range(40):
        optimizer.zero_grad()
        terms = model(batch(swirl(step, 7, (0.05, 0.05))))
        sum(
            model.weights[term] * value
            for term, value in terms.items()
            if term in model.weights
        ).backward()
        optimizer.step()
    truth = torch.from_numpy(swirl(99, 26, (0.05, 0.05))).transpose(0, 1)
    last = truth[:, 5:6]
    speed = truth[:, 5:6] - truth[:, 4:5]
    error = (
        (rolled(model, batch(swirl(99, 26, (0.05, 0.05))[:6]), 20) - truth[:, 6:])
        .square()
        .mean((0, 2))
    )
    straight = (
        (last + speed * torch.arange(1, 21)[:, None] - truth[:, 6:])
        .square()
        .mean((0, 2))
    )
    still = (last - truth[:, 6:]).square().mean((0, 2))
    assert bool((error < 0.75 * straight).all())
    assert bool((straight < still).all())
