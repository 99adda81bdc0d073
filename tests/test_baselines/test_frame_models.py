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
    share_of_persistence,
    train,
)
from torch import Tensor
from torch.testing import assert_close

from lagbench.baselines.catalogue import find
from lagbench.baselines.frame_model import FrameNetwork, FrameState, FrameWindow
from lagbench.baselines.lstm import LSTM, LSTMWithMLP
from lagbench.baselines.mlp import MLP
from lagbench.baselines.recipe import recipe_for
from lagbench.data import grid as gridding
from lagbench.data.grid import Grid, Placement
from lagbench.data.registry import load
from lagbench.errors import DataError, UsageError
from studies.thesis.published import MLP_STUDIES, MLPStudy

SCENARIOS = rotations(4)
INFO = info_of(SCENARIOS)
FULL_INFO = replace(INFO, particles=2500)
SMALL = {"widths": [16, 8]}

Array = NDArray[np.float64]


def count_parameters(model: torch.nn.Module) -> int:
    """Return the number of parameters of a model."""
    return sum(parameter.numel() for parameter in model.parameters())


def recipe_variant(study: MLPStudy) -> str:
    """Return the recipe of a row of the thesis's tables."""
    # What tells the recipe of a row from the others of its table.
    distinctions = {
        "4.2": study.activation,
        "4.3": study.widths[0],
        "4.4": len(study.widths),
        "4.5": study.row,
    }
    return f"table-{study.table}-{distinctions[study.table]}"


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
    recipe = recipe_for(find("mlp"), split, "full", variant=recipe_variant(study))
    with torch.device("meta"):  # no memory for the weights
        model = MLP.build(recipe.model, FULL_INFO)
    assert count_parameters(model) == study.parameters


ACTIVATIONS: dict[str, Callable[[Array], Array]] = {
    "elu": lambda a: np.where(a > 0, a, np.expm1(a)),
    "relu": lambda a: np.maximum(a, 0.0),
    "tanh": np.tanh,
    "sigmoid": lambda a: 1 / (1 + np.exp(-a)),
}


def as_float64(tensor: Tensor) -> Array:
    """Return a tensor as an array in double precision."""
    return tensor.detach().numpy().astype(float)


def transcribe_mlp(model: MLP, frames: Array, activation: str) -> Array:
    """Return the positions after two frames by the equations, shape [particle, 2]."""
    statistics = {name: np.array(value) for name, value in INFO.statistics.items()}
    before, last = frames
    velocity = last - before
    position = (last - statistics["position_mean"]) / statistics["position_std"]
    velocity = (velocity - statistics["velocity_mean"]) / statistics["velocity_std"]
    state = np.concatenate([position, velocity], axis=1).ravel()

    parameters = [as_float64(parameter) for parameter in model.parameters()]
    weights = parameters[::2]
    biases = parameters[1::2]
    activate = ACTIVATIONS[activation]
    for weight, bias in zip(weights[:-1], biases[:-1], strict=True):
        state = activate(weight @ state + bias)
    state = weights[-1] @ state + biases[-1]

    next_position: Array = state.reshape(-1, 4)[:, :2]
    return next_position * statistics["position_std"] + statistics["position_mean"]


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_a_step_is_the_equation(activation: str) -> None:
    """A step is layers, activations and standardisation, written out in NumPy."""
    model = MLP.build({**SMALL, "activation": activation}, INFO)
    frames = SCENARIOS[0][:2]
    expected = transcribe_mlp(model, frames.astype(float), activation)
    path = rolled(model, batch_of([frames]), 1)
    assert_allclose(path[:, 0].numpy(), expected, atol=1e-6)


def test_the_loss_is_equation_4_16() -> None:
    """The weighted terms add up to the mean square over particles and attributes.

    The attributes are standardised.
    """
    model = MLP.build(SMALL, INFO)
    window = SCENARIOS[1][5:8]
    loss = 0.0
    for name, term in model(batch_of([window])).items():
        loss += model.weights[name] * float(term.detach())

    state = FrameState(INFO).standardise(torch.from_numpy(window))
    predicted = model.next_state(model.start(batch_of([window[:2]])))[0]
    mean_square = (predicted - state[2]).square().mean()
    assert loss == pytest.approx(float(mean_square.detach()), rel=1e-5)


def test_windows_side_by_side_do_not_see_each_other() -> None:
    model = MLP.build(SMALL, INFO)
    windows = [SCENARIOS[0][:2], SCENARIOS[1][:2]]
    together = rolled(model, batch_of(windows), 5)
    alone = [rolled(model, batch_of([window]), 5) for window in windows]
    assert_close(together, torch.cat(alone), atol=1e-6, rtol=1e-5)


def test_a_rollout_uses_the_last_two_frames() -> None:
    model = MLP.build(SMALL, INFO)
    from_six = rolled(model, batch_of([SCENARIOS[0][0:6]]), 3)
    from_two = rolled(model, batch_of([SCENARIOS[0][4:6]]), 3)
    assert torch.equal(from_six, from_two)


def test_scenarios_of_another_size_are_refused() -> None:
    """The error says how many particles the model takes, and how many came."""
    model = MLP.build(SMALL, INFO)
    window = batch_of([SCENARIOS[0][:2, :11]])
    with pytest.raises(DataError, match="12 particles in each window\n  got: 11"):
        model.start(window)


def test_a_change_of_nothing_is_persistence() -> None:
    """With ``target: change`` the output 0 keeps every particle where it is."""
    model = MLP.build({**SMALL, "target": "change"}, INFO)
    for parameter in model.network[-1].parameters():
        torch.nn.init.zeros_(parameter)
    window = batch_of([SCENARIOS[0][:2]])
    expected = window.position[:, -1:].expand(-1, 3, -1)
    assert_close(rolled(model, window, 3), expected)


def test_noise_has_the_deviation_of_the_recipe_and_only_in_training() -> None:
    """Inputs get normal noise with a generator, and none without."""
    model = MLP.build({**SMALL, "noise_std": 0.3}, INFO)
    state = torch.zeros(500, 1, 12, 4)
    noise = model.add_noise(state, torch.Generator().manual_seed(1))
    same_noise = model.add_noise(state, torch.Generator().manual_seed(1))
    assert float(noise.std()) == pytest.approx(0.3, rel=0.02)
    assert torch.equal(noise, same_noise)
    assert torch.equal(model.add_noise(state, None), state)


GATED: dict[str, Any] = {"latent": 8, "decoder": [6]}
WITHOUT_DROPOUT: dict[str, Any] = {**GATED, "dropout": [0.0, 0.0]}
BOTH = pytest.mark.parametrize("kind", [LSTM, LSTMWithMLP])


def first_window() -> FrameWindow:
    """Return the states of the first scenario's first two frames."""
    frames = torch.from_numpy(SCENARIOS[0][:2])
    state = FrameState(INFO).standardise(frames)
    return FrameWindow(state[None], torch.zeros(1, 12, dtype=torch.int64))


@BOTH
@pytest.mark.parametrize("material", [0, 1])
def test_parameters_of_table_4_6(kind: type[LSTM], material: int) -> None:
    """Encoder, two LSTM layers of 1250, decoder; one variant has an MLP between them.

    The MLP adds 1250 x 1250 + 1250 parameters.
    """
    with torch.device("meta"):
        model = kind.build({"material": bool(material)}, FULL_INFO)
    encoder = counted((4 + material, 1250))
    lstm_layer = 4 * (1250 * 1250 + 1250 * 1250 + 2 * 1250)
    decoder = counted((1250, 1250, 10_000))
    expected = encoder + 2 * lstm_layer + decoder
    if kind is LSTMWithMLP:
        expected += counted((1250, 1250))
    assert count_parameters(model) == expected


def transcribe_lstm(layer: torch.nn.LSTM, inputs: Array) -> Array:
    """Return an LSTM layer's outputs over time by its gates, shape [time, latent]."""
    parameters = [as_float64(parameter) for parameter in layer.parameters()]
    input_weight, hidden_weight, input_bias, hidden_bias = parameters
    sigmoid = ACTIVATIONS["sigmoid"]
    hidden = np.zeros(layer.hidden_size)
    cell = np.zeros(layer.hidden_size)
    outputs = []
    for x in inputs:
        from_input = input_weight @ x + input_bias
        from_hidden = hidden_weight @ hidden + hidden_bias
        i, f, g, o = np.split(from_input + from_hidden, 4)
        cell = sigmoid(f) * cell + sigmoid(i) * np.tanh(g)
        hidden = sigmoid(o) * np.tanh(cell)
        outputs.append(hidden)
    return np.array(outputs)


def transcribe_linear(layer: torch.nn.Module, x: Array) -> Array:
    """Return W x + b for rows x."""
    weight, bias = layer.parameters()
    rows: Array = x @ as_float64(weight).T + as_float64(bias)
    return rows


def transcribe_step(model: LSTM, state: Array) -> Array:
    """Return the next state of particles after states of shape [time, particle, 4]."""
    elu = ACTIVATIONS["elu"]
    encoded = elu(transcribe_linear(model.encoder[0], state))
    latent = transcribe_lstm(model.first, encoded.mean(axis=1))
    if model.between is not None:
        latent = elu(transcribe_linear(model.between[0], latent))
    last = transcribe_lstm(model.second, latent)[-1]
    decoded = elu(transcribe_linear(model.decoder[0], last))
    return transcribe_linear(model.decoder[2], decoded).reshape(12, 4)


@BOTH
def test_a_step_is_the_equations(kind: type[LSTM]) -> None:
    """Encoder, pooling, gates, the MLP between, and decoder, written out in NumPy."""
    model = kind.build(GATED, INFO).eval()
    window = first_window()
    expected = transcribe_step(model, as_float64(window.state[0]))
    state = model.next_state(window)[0].detach().numpy()
    assert_allclose(state, expected, atol=1e-5)


@BOTH
def test_the_order_of_particles_means_nothing(kind: type[LSTM]) -> None:
    model = kind.build(GATED, INFO).eval()
    window = first_window()
    order = torch.randperm(12, generator=torch.Generator().manual_seed(0))
    shuffled = FrameWindow(window.state[:, :, order], window.material)
    state = model.next_state(window)
    assert_close(state, model.next_state(shuffled), atol=1e-6, rtol=1e-5)


@BOTH
def test_both_frames_matter(kind: type[LSTM]) -> None:
    model = kind.build(GATED, INFO).eval()
    window = first_window()
    last_twice = FrameWindow(window.state[:, [1, 1]], window.material)
    state = model.next_state(window)
    assert not torch.allclose(state, model.next_state(last_twice), atol=1e-6)


def test_a_rollout_starts_from_two_frames() -> None:
    """The first frame takes the velocity of the second, as its own is unknown."""
    model = LSTM.build(GATED, INFO)
    from_two = model.start(batch_of([SCENARIOS[0][:2]])).state[0]
    from_six = model.start(batch_of([SCENARIOS[0][:6]])).state[0]
    assert torch.equal(from_two[0, :, 2:], from_two[1, :, 2:])
    assert not torch.equal(from_six[0, :, 2:], from_six[1, :, 2:])
    assert model.history == 3


def test_dropout_acts_in_training_only() -> None:
    """Two passes differ in training and agree in a rollout."""
    window = first_window()
    model = LSTM.build(GATED, INFO).train()
    assert not torch.equal(model.next_state(window), model.next_state(window))
    model.eval()
    assert torch.equal(model.next_state(window), model.next_state(window))


def test_a_dropout_of_0_drops_nothing() -> None:
    window = first_window()
    model = LSTM.build(WITHOUT_DROPOUT, INFO).train()
    assert torch.equal(model.next_state(window), model.next_state(window))


def test_the_density_term_compares_maps() -> None:
    """It is the squared error of the scorer's particle weights over their square."""
    model = LSTM.build(WITHOUT_DROPOUT, INFO)
    window = SCENARIOS[1][4:8]
    next_state = model.next_state(model.start(batch_of([window[:3]])))
    position = model.frame_state.position(next_state)[0].detach().numpy()

    def transfer_weight(position: NDArray[np.floating[Any]]) -> Array:
        grid = Grid(8, Placement.CELL_CENTRES)
        return gridding.transfer(position, np.zeros_like(position), grid).weight

    weight = transfer_weight(position)
    true_weight = transfer_weight(window[3])
    expected = np.square(weight - true_weight).sum() / np.square(true_weight).sum()
    density = float(model(batch_of([window]))["density"].detach())
    assert density == pytest.approx(expected, rel=1e-4)
    assert model.weights == {"density": 0.03}


@pytest.mark.parametrize(
    ("kind", "options"),
    [
        (MLP, SMALL),
        (LSTMWithMLP, GATED),
    ],
)
@pytest.mark.parametrize("material", [False, True])
def test_materials_matter_where_the_recipe_asks_for_them(
    kind: type[FrameNetwork],
    options: dict[str, Any],
    material: bool,
) -> None:
    """The material is then a fifth input of the network."""
    frames = SCENARIOS[0][:2]
    model = kind.build({**options, "material": material}, INFO)
    liquid = rolled(model, batch_of([frames], [0] * 12), 1)
    mixed = rolled(model, batch_of([frames], [0, 1, 2, 3] * 3), 1)
    assert torch.equal(liquid, mixed) is not material


@pytest.mark.parametrize(
    ("kind", "options", "steps", "share"),
    [
        (MLP, {"widths": [64, 64]}, 300, 0.1),
        (LSTM, {"latent": 32, "decoder": [32], "dropout": [0.0, 0.0]}, 400, 0.2),
        (LSTMWithMLP, {"latent": 32, "decoder": [32], "dropout": [0.0, 0.0]}, 400, 0.2),
    ],
)
def test_it_learns_a_rotation(
    kind: type[FrameNetwork],
    options: dict[str, Any],
    steps: int,
    share: float,
) -> None:
    """A rollout from a new angle is soon far better than standing still."""
    torch.manual_seed(0)
    model = kind.build(options, INFO)
    train(model, rotations(24), steps=steps)
    new_scenario = rotations(30)[-1]
    assert share_of_persistence(model, new_scenario, frames=20) < share


NETWORKS = ("mlp", "lstm", "lstm-mlp")
SPLITS = ("cavity", "curl-noise", "fluid", "multimaterial")
MOST_NUMBERS = {
    "tiny": 1e6,
    "mini": 4e6,
    "full": 2e8,
}


def build_from_recipe(name: str, split: str, size: str) -> Any:
    """Return the model of a recipe without memory for its weights."""
    recipe = recipe_for(find(name), split, size)
    particles = load().size(split, size).particles
    with torch.device("meta"):
        return find(name).model.build(recipe.model, replace(INFO, particles=particles))


def count_numbers(model: torch.nn.Module) -> int:
    """Return the number of values in the state of a model."""
    return sum(value.numel() for value in model.state_dict().values())


@pytest.mark.parametrize("size", ["tiny", "mini", "full"])
@pytest.mark.parametrize("split", SPLITS)
@pytest.mark.parametrize("name", NETWORKS)
def test_networks_have_recipes_for_every_split(
    name: str,
    split: str,
    size: str,
) -> None:
    """They have the thesis's form, and mini at most 4 M numbers."""
    recipe = recipe_for(find(name), split, size)
    assert recipe.model["material"] is (split == "multimaterial")
    assert recipe.model["target"] == "state"
    model = build_from_recipe(name, split, size)
    assert count_numbers(model) <= MOST_NUMBERS[size]


@pytest.mark.parametrize("size", ["tiny", "mini", "full"])
@pytest.mark.parametrize("split", SPLITS)
def test_plain_var_has_no_recipe_for_full_boxes(split: str, size: str) -> None:
    if size == "full" and split in ("cavity", "curl-noise"):
        with pytest.raises(UsageError, match="no recipe"):
            recipe_for(find("var"), split, size)
    else:
        build_from_recipe("var", split, size)


@pytest.mark.parametrize("size", ["tiny", "mini", "full"])
@pytest.mark.parametrize("split", SPLITS)
def test_a_stable_var_takes_8_megabytes_at_most(split: str, size: str) -> None:
    model = build_from_recipe("var-stable", split, size)
    assert 4 * count_numbers(model) <= 8.5e6


@pytest.mark.parametrize("split", SPLITS)
@pytest.mark.parametrize("name", NETWORKS)
def test_variants_with_changes_differ_in_that_only(name: str, split: str) -> None:
    """``mini-change`` has another target, and other noise, than ``mini``.

    Layers and training are the same.
    """
    plain = recipe_for(find(name), split, "mini")
    change = recipe_for(find(name), split, "mini", variant="change")
    assert change.training == plain.training
    differing = set()
    for key, value in plain.model.items():
        if value != change.model[key]:
            differing.add(key)
    assert {"target"} <= differing <= {"target", "noise_std"}
