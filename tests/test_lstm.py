"""The LSTMs against their gates written out in NumPy, their symmetries, and a motion they can learn."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from frame_cases import batch_of, counted, facts_of, rotations, share_of_persistence, train
from numpy.typing import NDArray
from pydantic import ValidationError

from lagbench.baselines.frame_model import FrameState, FrameWindow
from lagbench.baselines.lstm import LSTM, LSTMWithMLP
from lagbench.data import grid as gridding
from lagbench.data.grid import Grid, Placement

SCENARIOS = rotations(4)
FACTS = facts_of(SCENARIOS)
SMALL: dict[str, Any] = {"latent": 8, "decoder": [6]}
BOTH = pytest.mark.parametrize("kind", [LSTM, LSTMWithMLP])

Array = NDArray[np.float64]


def window_of(frames: int = 2) -> FrameWindow:
    """Return the states of the first scenario's first frames."""
    state = FrameState(FACTS).of(torch.from_numpy(SCENARIOS[0][:frames]))
    return FrameWindow(state[None], torch.zeros(1, 12, dtype=torch.int64))


@BOTH
@pytest.mark.parametrize("material", [0, 1])
def test_parameters_of_table_4_6(kind: type[LSTM], material: int) -> None:
    """Encoder, two LSTM layers of 1250, decoder; the MLP between them adds 1250 x 1250 + 1250."""
    with torch.device("meta"):
        model = kind.build({"material": bool(material)}, replace(FACTS, particles=2500))
    layer = 4 * (1250 * 1250 + 1250 * 1250 + 2 * 1250)
    expected = counted((4 + material, 1250)) + 2 * layer + counted((1250, 1250, 10_000))
    expected += counted((1250, 1250)) if kind is LSTMWithMLP else 0
    assert sum(p.numel() for p in model.parameters()) == expected


def elu(a: Array) -> Array:
    """Return x or exp(x) - 1."""
    return np.where(a > 0, a, np.expm1(a))


def sigmoid(a: Array) -> Array:
    """Return 1 / (1 + exp(-x))."""
    return 1 / (1 + np.exp(-a))


def cells(layer: torch.nn.LSTM, inputs: Array) -> Array:
    """Return the outputs of an LSTM layer over time by its gates, shape [time, latent]."""
    (w, r, b, c) = (p.detach().numpy().astype(float) for p in layer.parameters())
    h = cell = np.zeros(layer.hidden_size)
    outputs = []
    for x in inputs:
        i, f, g, o = np.split(w @ x + b + r @ h + c, 4)
        cell = sigmoid(f) * cell + sigmoid(i) * np.tanh(g)
        h = sigmoid(o) * np.tanh(cell)
        outputs.append(h)
    return np.array(outputs)


def linear(layer: torch.nn.Module, x: Array) -> Array:
    """Return W x + b for rows x."""
    weight, bias = (p.detach().numpy().astype(float) for p in layer.parameters())
    rows: Array = x @ weight.T + bias
    return rows


@BOTH
def test_a_step_is_the_equations(kind: type[LSTM]) -> None:
    """Encoder, pooling, gates, the MLP between, and decoder, written out, give the same state."""
    model = kind.build(SMALL, FACTS).eval()
    window = window_of()
    latent = elu(linear(model.encoder[0], window.state[0].numpy().astype(float))).mean(axis=1)
    latent = cells(model.first, latent)
    if model.between is not None:
        latent = elu(linear(model.between[0], latent))
    last = cells(model.second, latent)[-1]
    expected = linear(model.decoder[2], elu(linear(model.decoder[0], last))).reshape(12, 4)
    found = model.next_state(window)[0].detach().numpy()
    np.testing.assert_allclose(found, expected, atol=1e-5)


@BOTH
def test_pooling_forgets_the_order_of_particles(kind: type[LSTM]) -> None:
    """Renumbered particles give the same prediction, one to each number."""
    model = kind.build(SMALL, FACTS).eval()
    window = window_of()
    order = torch.randperm(12, generator=torch.Generator().manual_seed(0))
    shuffled = FrameWindow(window.state[:, :, order], window.material)
    torch.testing.assert_close(model.next_state(window), model.next_state(shuffled), atol=1e-6, rtol=1e-5)


def test_both_frames_count() -> None:
    """The earlier of the two states changes the prediction."""
    model = LSTM.build(SMALL, FACTS).eval()
    window = window_of()
    doubled = FrameWindow(window.state[:, [1, 1]], window.material)
    assert not torch.allclose(model.next_state(window), model.next_state(doubled), atol=1e-6)


def test_a_rollout_starts_from_two_frames() -> None:
    """Two given frames are enough: the first takes the second's velocity, as its own is unknown."""
    model = LSTM.build(SMALL, FACTS)
    given = SCENARIOS[0][:2]
    states = model.start(batch_of([given])).state[0]
    assert torch.equal(states[0, :, 2:], states[1, :, 2:])
    assert model.history == 3
    longer = model.start(batch_of([SCENARIOS[0][:6]])).state[0]
    assert not torch.equal(longer[0, :, 2:], longer[1, :, 2:])


def test_dropout_acts_in_training_only() -> None:
    """Two passes differ in training and agree in a rollout; a share of 0 drops nothing."""
    window = window_of()
    model = LSTM.build(SMALL, FACTS).train()
    assert not torch.equal(model.next_state(window), model.next_state(window))
    assert torch.equal(model.eval().next_state(window), model.next_state(window))
    still = LSTM.build({**SMALL, "dropout": [0.0, 0.0]}, FACTS).train()
    assert torch.equal(still.next_state(window), still.next_state(window))


def test_the_material_is_a_fifth_input() -> None:
    """Materials change the prediction where the recipe gives them to the network."""
    model = LSTMWithMLP.build({**SMALL, "material": True}, FACTS).eval()
    window = window_of()
    other = FrameWindow(window.state, window.material + 2)
    assert not torch.allclose(model.next_state(window), model.next_state(other), atol=1e-6)


def test_the_density_term_compares_maps() -> None:
    """It is the squared error of the scorer's particle weights over their mean square."""
    model = LSTM.build({**SMALL, "dropout": [0.0, 0.0]}, FACTS)
    window = SCENARIOS[1][4:8]
    state = model.start(batch_of([window[:3]]))
    predicted = model.frame_state.position(model.next_state(state))[0].detach().numpy()
    grid = Grid(8, Placement.CELL_CENTRES)
    guess, truth = (gridding.transfer(x, np.zeros_like(x), grid).weight for x in (predicted, window[3]))
    expected = np.square(guess - truth).sum() / np.square(truth).sum()
    assert float(model(batch_of([window]))["density"].detach()) == pytest.approx(expected, rel=1e-4)
    assert model.weights == {"density": 0.03}


@pytest.mark.parametrize("options", [{"dropout": [0.2, 1.0]}, {"latent": 0}, {"density_weight": -1}])
def test_options_are_checked(options: dict[str, Any]) -> None:
    """Dropping all, no latent vector and negative weights are errors."""
    with pytest.raises(ValidationError):
        LSTM.build(options, FACTS)


@BOTH
def test_it_learns_a_rotation(kind: type[LSTM]) -> None:
    """After 400 steps a rollout from a new angle is far better than standing still."""
    torch.manual_seed(0)
    model = kind.build({"latent": 32, "decoder": [32], "dropout": [0.0, 0.0]}, FACTS)
    train(model, rotations(24), steps=400)
    assert share_of_persistence(model, rotations(30)[-1], frames=20) < 0.2
