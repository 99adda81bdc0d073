"""The six loss terms against a NumPy route through the scorer's grid, and by hand."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from graph_cases import jittered
from numpy.typing import NDArray

from lagbench.baselines.loss import GRID_TERMS, TERMS, LossNorm, Motion, Scales, loss_terms, mean_norm
from lagbench.data import grid as scoring

GRID = scoring.Grid(10)
SCALES = Scales(torch.tensor([0.25, 0.3]), torch.tensor([0.004, 0.003]), torch.tensor([2e-4, 1e-4]))
WINDOWS = 2
SAMPLE = torch.arange(WINDOWS).repeat_interleave(256)


def motion(seed: int) -> tuple[Motion, Motion]:
    """Return a prediction and a truth of two windows in float64: a patch of fluid, moved and disturbed."""
    rng = np.random.default_rng(seed)
    place = np.concatenate([jittered(s, low=0.2, high=0.75) for s in (seed, seed + 1)])
    swirl = 0.01 * np.stack([place[:, 1] ** 2, -place[:, 0]], axis=1)
    error = rng.normal(0.0, 1e-3, swirl.shape)
    moved = place + error + (0.03, -0.02)  # other nodes would count than in the truth
    last = swirl + rng.normal(0.0, 1e-3, swirl.shape)
    frames = [(moved, swirl + error), (place, swirl)]
    return tuple(Motion(*map(torch.from_numpy, (x, u, u - last))) for x, u in frames)  # type: ignore[return-value]


def terms(predicted: Motion, target: Motion, norm: str = "l2", **weights: float) -> dict[str, torch.Tensor]:
    """Return the loss terms on the test's grid."""
    return loss_terms(
        predicted, target, SAMPLE, grid=GRID, scales=SCALES, norm=LossNorm(norm), weights=weights
    )


def by_numpy(predicted: Motion, target: Motion, p: int) -> dict[str, float]:
    """Return the six terms by NumPy and lagbench.data.grid, term after term as Eqs. 5.29-5.34 stand."""
    found = {}
    for name in ("acceleration", "velocity", "position"):
        error = (getattr(predicted, name) - getattr(target, name)).numpy() / getattr(SCALES, name).numpy()
        found[name] = (np.abs(error) ** p).sum(axis=1).mean()
    shape = (WINDOWS, 256, 2)
    true_x, true_u, own_x, own_u = (
        frame.numpy().reshape(shape) for frame in (target[0], target[1], predicted[0], predicted[1])
    )
    weight = scoring.transfer(true_x, true_u, GRID).weight
    full = (weight**2).sum() / weight.sum()
    true = scoring.fields(true_x, true_u, GRID, full=full)
    own = scoring.fields(own_x, own_u, GRID, full=full, counted=true.counted)
    found["density"] = (np.abs(own.density - true.density) ** p).mean()
    speed = np.sqrt((0.004**2 + 0.003**2) / 2)
    for name in ("divergence", "vorticity"):
        error = (getattr(own, name) - getattr(true, name)) / speed
        found[name] = np.nanmean(np.abs(error) ** p)
    return found


@pytest.mark.parametrize(("norm", "p"), [("l1", 1), ("l2", 2)])
def test_every_term_equals_its_equation_in_numpy(norm: str, p: int) -> None:
    """All six, two windows, in float64 to 1e-6 (the deviations are float32) and in float32."""
    predicted, target = motion(0)
    expected = by_numpy(predicted, target, p)
    assert set(expected) == set(TERMS)
    assert min(expected.values()) > 1e-6
    found = terms(predicted, target, norm)
    assert {name: float(value) for name, value in found.items()} == pytest.approx(expected, rel=1e-6)
    single = [Motion(*(tensor.float() for tensor in frame)) for frame in (predicted, target)]
    found = terms(single[0], single[1], norm)
    assert {name: float(value) for name, value in found.items()} == pytest.approx(expected, rel=2e-3)


def test_a_perfect_prediction_has_no_loss() -> None:
    """The truth against itself is 0 in every term, to the last bit."""
    _, target = motion(2)
    assert {float(value) for value in terms(target, target).values()} == {0.0}


def test_norms_by_hand() -> None:
    """Errors (3, 4) and (0, 1): squares 25 + 1 over 2 particles, absolute values 7 + 1 over 2."""
    error = torch.tensor([[3.0, -4.0], [0.0, 1.0]])
    assert float(mean_norm(error, LossNorm.L2)) == 13.0
    assert float(mean_norm(error, LossNorm.L1)) == 4.0


def test_scales_by_hand() -> None:
    """An error of one deviation in each component costs 2 in velocity, or 1 + 1 absolute."""
    _, target = motion(0)
    predicted = target._replace(velocity=target.velocity + SCALES.velocity)
    for norm in ("l1", "l2"):
        assert float(terms(predicted, target, norm)["velocity"]) == pytest.approx(2.0, rel=1e-5)


def lattice() -> NDArray[np.float64]:
    """Return 128 x 128 particles that fill the unit box evenly."""
    axis = (np.arange(128) + 0.5) / 128
    return np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)


@pytest.mark.parametrize("name", ["vorticity", "divergence"])
def test_a_linear_flow_costs_what_its_gradient_says(name: str) -> None:
    """Extra rotation W costs (2 W / speed)^2 of vorticity, extra expansion D (2 D / speed)^2 of divergence.

    Nodes at the rim of the grid average over half a stencil, so that only inner ones are exact.
    """
    place = lattice()
    x, y = (place - 0.5).T
    flow = {"vorticity": np.stack([-y, x], axis=1), "divergence": np.stack([x, y], axis=1)}[name]
    rest, moving = (torch.from_numpy(0.002 * factor * flow) for factor in (0.0, 1.0))
    points = torch.from_numpy(place)
    sample = torch.zeros(len(place), dtype=torch.int64)
    found = loss_terms(
        Motion(points, moving, moving),
        Motion(points, rest, rest),
        sample,
        grid=scoring.Grid(32),
        scales=SCALES,
        norm=LossNorm.L2,
        weights={},
    )
    expected = (0.004 / float(SCALES.speed)) ** 2
    assert float(found[name]) == pytest.approx(expected, rel=0.02)
    other = ({"vorticity", "divergence"} - {name}).pop()
    assert float(found[other]) < 1e-9 * expected
    assert float(found["density"]) == 0.0


def test_terms_of_weight_zero_are_logged_without_a_graph() -> None:
    """Their values stay; their gradient is not even recorded, nor the transfer's if none counts."""
    predicted, target = motion(0)
    moving = Motion(*(tensor.clone().requires_grad_() for tensor in predicted))
    everything = terms(moving, target)
    assert all(value.requires_grad for value in everything.values())
    some = terms(moving, target, vorticity=0.0, velocity=0.0)
    assert {name for name, value in some.items() if not value.requires_grad} == {"vorticity", "velocity"}
    none = terms(moving, target, **dict.fromkeys(GRID_TERMS, 0.0))
    assert {name for name, value in none.items() if not value.requires_grad} == set(GRID_TERMS)
    for found in (some, none):
        for name, value in found.items():
            torch.testing.assert_close(value, everything[name], rtol=0.0, atol=0.0)


@pytest.mark.parametrize("name", TERMS)
def test_every_term_pulls_towards_the_truth(name: str) -> None:
    """A small step against the gradient lowers the term as much as the gradient promises."""
    predicted, target = motion(4)
    moving = Motion(*(tensor.clone().requires_grad_() for tensor in predicted))
    loss = terms(moving, target)[name]
    gradients = torch.autograd.grad(loss, moving, allow_unused=True)
    value = float(loss.detach())
    size = sum(float((gradient**2).sum()) for gradient in gradients if gradient is not None)
    step = 1e-4 * value / size
    stepped = Motion(*(x if g is None else x - step * g for x, g in zip(predicted, gradients, strict=True)))
    assert value - float(terms(stepped, target)[name]) == pytest.approx(1e-4 * value, rel=0.02)


def test_an_empty_window_of_vorticity_is_no_nan() -> None:
    """A splash so thin that no node has four counted neighbours costs 0, not NaN."""
    place = torch.tensor([[0.2, 0.2], [0.8, 0.8]], dtype=torch.float64)
    still = torch.zeros_like(place)
    frame = Motion(place, still, still)
    found = loss_terms(
        Motion(place, still + 0.01, still + 0.01),
        frame,
        torch.tensor([0, 1]),
        grid=GRID,
        scales=SCALES,
        norm=LossNorm.L2,
        weights={},
    )
    assert float(found["vorticity"]) == 0.0
    assert all(torch.isfinite(value) for value in found.values())
