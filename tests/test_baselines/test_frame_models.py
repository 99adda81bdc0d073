"""MLPs and LSTMs against the thesis's tables and transcriptions in NumPy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from simple_models import (
    batch_of,
    counted,
    info_of,
    rolled,
    rotations,
)
from torch import Tensor
from torch.testing import assert_close

from lagbench.baselines.catalogue import find
from lagbench.baselines.frame_model import FrameState, FrameWindow
from lagbench.baselines.lstm import LSTM, LSTMWithMLP
from lagbench.baselines.mlp import MLP
from lagbench.baselines.recipe import recipe_for
from lagbench.data import grid as gridding
from lagbench.data.grid import Grid, Placement
from studies.published import MLP_STUDIES, MLPStudy
from studies.thesis import recipe_of

SCENARIOS = rotations(4)
INFO = info_of(SCENARIOS)
FULL_INFO = replace(INFO, particles=2500)
SMALL = {"widths": [16, 8]}

Array = NDArray[np.float64]


def count_parameters(model: torch.nn.Module) -> int:
    """Return the number of parameters of a model."""
    sizes = [parameter.numel() for parameter in model.parameters()]
    return sum(sizes)


@pytest.mark.parametrize(
    "study",
    MLP_STUDIES,
    ids=lambda study: f"{study.table}-{study.row}",
)
def test_parameters_of_the_thesis(study: MLPStudy) -> None:
    """The recipes of Tables 4.2 to 4.5 have as many parameters as the thesis prints."""
    split = "multimaterial"
    if study.table < "4.4":
        split = "fluid"
    variant = recipe_of(study)
    recipe = recipe_for(find("mlp"), split, "full", variant=variant)
    with torch.device("meta"):  # no memory for the weights
        model = MLP.build(recipe.model, FULL_INFO)
    assert count_parameters(model) == study.parameters


Activation = Callable[[Array], Array]


def elu(a: Array) -> Array:
    """Return the exponential linear unit."""
    return np.where(a > 0, a, np.expm1(a))


def relu(a: Array) -> Array:
    """Return the positive part."""
    return np.maximum(a, 0.0)


def sigmoid(a: Array) -> Array:
    """Return the logistic function."""
    return 1 / (1 + np.exp(-a))


ACTIVATIONS: dict[str, Activation] = {
    "elu": elu,
    "relu": relu,
    "tanh": np.tanh,
    "sigmoid": sigmoid,
}


def as_float64(tensor: Tensor) -> Array:
    """Return a tensor as an array in double precision."""
    values = tensor.detach().numpy()
    return values.astype(float)


def parameters_of(module: torch.nn.Module) -> list[Array]:
    """Return the parameters of a module as arrays."""
    return [as_float64(parameter) for parameter in module.parameters()]


def transcribe_mlp(
    model: MLP,
    frames: Array,
    activation: str,
) -> Array:
    """Return the positions after two frames by the equations, shape [particle, 2]."""
    mean = {}
    std = {}
    for name in ("position", "velocity"):
        mean[name] = np.array(INFO.statistics[f"{name}_mean"])
        std[name] = np.array(INFO.statistics[f"{name}_std"])
    before, last = frames
    velocity = last - before
    position = (last - mean["position"]) / std["position"]
    velocity = (velocity - mean["velocity"]) / std["velocity"]
    state = np.concatenate([position, velocity], axis=1)
    state = state.ravel()

    parameters = parameters_of(model)
    weights = parameters[::2]
    biases = parameters[1::2]
    activate = ACTIVATIONS[activation]
    for weight, bias in zip(weights[:-1], biases[:-1], strict=True):
        state = activate(weight @ state + bias)
    state = weights[-1] @ state + biases[-1]

    particle_state = state.reshape(-1, 4)
    next_position: Array = particle_state[:, :2]
    return next_position * std["position"] + mean["position"]


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_a_step_is_the_equation(activation: str) -> None:
    """A step is layers, activations and standardisation, written out in NumPy."""
    options = {**SMALL, "activation": activation}
    model = MLP.build(options, INFO)
    frames = SCENARIOS[0][:2]
    expected = transcribe_mlp(model, frames.astype(float), activation)
    path = rolled(model, batch_of([frames]), 1)
    next_position = path[:, 0].numpy()
    assert_allclose(next_position, expected, atol=1e-6)


def test_the_loss_is_equation_4_16() -> None:
    """The weighted terms add up to the mean square over particles and attributes.

    The attributes are standardised.
    """
    model = MLP.build(SMALL, INFO)
    window = SCENARIOS[1][5:8]
    loss = 0.0
    terms = model(batch_of([window]))
    for name, term in terms.items():
        loss += model.weights[name] * float(term.detach())

    frames = torch.from_numpy(window)
    state = FrameState(INFO).standardise(frames)
    start = model.start(batch_of([window[:2]]))
    predicted = model.next_state(start)[0]
    difference = (predicted - state[2]).detach()
    mean_square = float(difference.square().mean())
    assert loss == pytest.approx(mean_square, rel=1e-5)


def test_noise_has_the_deviation_of_the_recipe_and_only_in_training() -> None:
    """Inputs get normal noise with a generator, and none without."""
    options = {**SMALL, "noise_std": 0.3}
    model = MLP.build(options, INFO)
    state = torch.zeros(500, 1, 12, 4)
    generator = torch.Generator()
    noise = model.add_noise(state, generator.manual_seed(1))
    same_noise = model.add_noise(state, generator.manual_seed(1))
    without_noise = model.add_noise(state, None)
    deviation = float(noise.std())
    assert deviation == pytest.approx(0.3, rel=0.02)
    assert torch.equal(noise, same_noise)
    assert torch.equal(without_noise, state)


GATED: dict[str, Any] = {
    "latent": 8,
    "decoder": [6],
}
WITHOUT_DROPOUT: dict[str, Any] = {
    **GATED,
    "dropout": [0.0, 0.0],
}
BOTH = pytest.mark.parametrize("kind", [LSTM, LSTMWithMLP])


def first_window() -> FrameWindow:
    """Return the states of the first scenario's first two frames."""
    frames = torch.from_numpy(SCENARIOS[0][:2])
    state = FrameState(INFO).standardise(frames)
    material = torch.zeros(1, 12, dtype=torch.int64)
    return FrameWindow(state[None], material)


@BOTH
@pytest.mark.parametrize("material", [0, 1])
def test_parameters_of_table_4_6(kind: type[LSTM], material: int) -> None:
    """Encoder, two LSTM layers of 1250, decoder; one variant has an MLP between them.

    The MLP adds 1250 x 1250 + 1250 parameters.
    """
    with torch.device("meta"):
        options = {"material": bool(material)}
        model = kind.build(options, FULL_INFO)
    encoder = counted((4 + material, 1250))
    gate = 1250 * 1250 + 1250 * 1250 + 2 * 1250
    lstm_layer = 4 * gate
    decoder = counted((1250, 1250, 10_000))
    expected = encoder + 2 * lstm_layer + decoder
    if kind is LSTMWithMLP:
        expected += counted((1250, 1250))
    assert count_parameters(model) == expected


def transcribe_lstm(
    layer: torch.nn.LSTM,
    inputs: Array,
) -> Array:
    """Return an LSTM layer's outputs over time by its gates, shape [time, latent]."""
    parameters = parameters_of(layer)
    input_weight, hidden_weight, input_bias, hidden_bias = parameters
    hidden = np.zeros(layer.hidden_size)
    cell = np.zeros(layer.hidden_size)
    outputs = []
    for x in inputs:
        from_input = input_weight @ x + input_bias
        from_hidden = hidden_weight @ hidden + hidden_bias
        i, f, g, o = np.split(from_input + from_hidden, 4)
        kept = sigmoid(f) * cell
        added = sigmoid(i) * np.tanh(g)
        cell = kept + added
        hidden = sigmoid(o) * np.tanh(cell)
        outputs.append(hidden)
    return np.array(outputs)


def transcribe_linear(
    layer: torch.nn.Module,
    x: Array,
) -> Array:
    """Return W x + b for rows x."""
    weight, bias = parameters_of(layer)
    rows: Array = x @ weight.T + bias
    return rows


def transcribe_step(model: LSTM, state: Array) -> Array:
    """Return the next state of particles after states of shape [time, particle, 4]."""
    encoded = elu(transcribe_linear(model.encoder[0], state))
    latent = transcribe_lstm(model.first, encoded.mean(axis=1))
    if model.between is not None:
        latent = elu(transcribe_linear(model.between[0], latent))
    last = transcribe_lstm(model.second, latent)[-1]
    decoded = elu(transcribe_linear(model.decoder[0], last))
    output = transcribe_linear(model.decoder[2], decoded)
    return output.reshape(12, 4)


@BOTH
def test_a_step_is_the_equations(kind: type[LSTM]) -> None:
    """Encoder, pooling, gates, the MLP between, and decoder, written out in NumPy."""
    model = kind.build(GATED, INFO).eval()
    window = first_window()
    given = as_float64(window.state[0])
    expected = transcribe_step(model, given)
    state = as_float64(model.next_state(window)[0])
    assert_allclose(state, expected, atol=1e-5)


@BOTH
def test_the_order_of_particles_means_nothing(kind: type[LSTM]) -> None:
    model = kind.build(GATED, INFO).eval()
    window = first_window()
    generator = torch.Generator().manual_seed(0)
    order = torch.randperm(12, generator=generator)
    other_state = window.state[:, :, order]
    shuffled = FrameWindow(other_state, window.material)
    state = model.next_state(window)
    shuffled_state = model.next_state(shuffled)
    assert_close(state, shuffled_state, atol=1e-6, rtol=1e-5)


def test_the_density_term_compares_maps() -> None:
    """It is the squared error of the scorer's particle weights over their square."""
    model = LSTM.build(WITHOUT_DROPOUT, INFO)
    window = SCENARIOS[1][4:8]
    start = model.start(batch_of([window[:3]]))
    next_state = model.next_state(start)
    predicted = model.frame_state.position(next_state)[0]
    position = predicted.detach().numpy()

    def transfer_weight(position: NDArray[np.floating[Any]]) -> Array:
        # a grid of as wide cells, with one more node beyond each wall
        grid = Grid(10, Placement.CELL_CENTRES)
        at_rest = np.zeros_like(position)
        moved = (np.clip(position, 0.0, 1.0) * 8 + 1) / 10
        return gridding.transfer(moved, at_rest, grid).weight

    weight = transfer_weight(position)
    true_weight = transfer_weight(window[3])
    square_error = np.square(weight - true_weight)
    true_square = np.square(true_weight)
    expected = square_error.sum() / true_square.sum()
    terms = model(batch_of([window]))
    density = float(terms["density"].detach())
    assert density == pytest.approx(expected, rel=1e-4)
    assert model.weights == {"density": 0.03}
