"""MLPs and LSTMs against the thesis's tables and transcriptions in NumPy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
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
SMALL = {"widths": [16, 8]}

Array = NDArray[np.float64]


def parameter_count(model: torch.nn.Module) -> int:
    """Return how many numbers are trained."""
    return sum(parameter.numel() for parameter in model.parameters())


def float_arrays(model: torch.nn.Module) -> list[Array]:
    """Return the parameters in float64."""
    return [p.detach().numpy().astype(float) for p in model.parameters()]


@pytest.mark.parametrize(
    "study", MLP_STUDIES, ids=lambda study: f"{study.table}-{study.row}"
)
def test_parameters_of_the_thesis(study: MLPStudy) -> None:
    """The recipes of Tables 4.2 to 4.5 have as many parameters as the thesis prints."""
    split = "multimaterial"
    if study.table < "4.4":
        split = "fluid"
    # the last word of a variant's name tells the rows of a table apart
    row_names = {
        "4.2": study.activation,
        "4.3": study.widths[0],
        "4.4": len(study.widths),
        "4.5": study.row,
    }
    variant = f"table-{study.table}-{row_names[study.table]}"
    recipe = recipe_for(find("mlp"), split, "full", variant=variant)
    with torch.device("meta"):  # no memory for the weights
        model = MLP.build(recipe.model, replace(INFO, particles=2500))
    assert parameter_count(model) == study.parameters


ACTIVATIONS: dict[str, Callable[[Array], Array]] = {
    "elu": lambda a: np.where(a > 0, a, np.expm1(a)),
    "relu": lambda a: np.maximum(a, 0.0),
    "tanh": np.tanh,
    "sigmoid": lambda a: 1 / (1 + np.exp(-a)),
}


def next_positions(model: MLP, before: Array, last: Array, activation: str) -> Array:
    """Return the next positions by the equations, shape [particle, 2]."""
    statistics = {name: np.array(value) for name, value in INFO.statistics.items()}
    position_mean = statistics["position_mean"]
    position_std = statistics["position_std"]
    place = (last - position_mean) / position_std
    velocity = last - before
    speed = (velocity - statistics["velocity_mean"]) / statistics["velocity_std"]
    state = np.concatenate([place, speed], axis=1).ravel()

    arrays = float_arrays(model)
    last_layer = len(arrays) - 2
    for index in range(0, len(arrays), 2):
        weight = arrays[index]
        bias = arrays[index + 1]
        state = weight @ state + bias
        if index < last_layer:
            state = ACTIVATIONS[activation](state)
    next_place = state.reshape(-1, 4)[:, :2]
    positions: Array = next_place * position_std + position_mean
    return positions


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_a_step_is_the_equation(activation: str) -> None:
    """One step equals layers, activations and standardisation written out in NumPy."""
    model = MLP.build({**SMALL, "activation": activation}, INFO)
    window = SCENARIOS[0][:2]
    before, last = window.astype(float)
    expected = next_positions(model, before, last, activation)
    rollout = rolled(model, batch_of([window]), 1)
    np.testing.assert_allclose(rollout[:, 0].numpy(), expected, atol=1e-6)


def test_the_loss_is_equation_4_16() -> None:
    """It is the mean square over particles and standardised attributes."""
    model = MLP.build(SMALL, INFO)
    window = SCENARIOS[1][5:8]
    loss = 0.0
    for name, term in model(batch_of([window])).items():
        loss += model.weights[name] * float(term.detach())
    true_state = FrameState(INFO).standardise(torch.from_numpy(window))[2]
    state = model.next_state(model.start(batch_of([window[:2]])))[0]
    mean_square = (state - true_state).square().mean()
    assert loss == pytest.approx(float(mean_square.detach()), rel=1e-5)


def test_windows_side_by_side_do_not_mix() -> None:
    """A rollout of two scenarios equals those of each alone, by their last frames."""
    model = MLP.build(SMALL, INFO)
    windows = [scenario[:2] for scenario in SCENARIOS[:2]]
    together = rolled(model, batch_of(windows), 5)
    alone = [rolled(model, batch_of([window]), 5) for window in windows]
    torch.testing.assert_close(together, torch.cat(alone), atol=1e-6, rtol=1e-5)
    long = rolled(model, batch_of([SCENARIOS[0][0:6]]), 3)
    short = rolled(model, batch_of([SCENARIOS[0][4:6]]), 3)
    assert torch.equal(long, short)


def test_another_number_of_particles_is_refused() -> None:
    """The error has both numbers."""
    model = MLP.build(SMALL, INFO)
    with pytest.raises(DataError) as caught:
        model.start(batch_of([SCENARIOS[0][:2, :11]]))
    assert "12" in str(caught.value.expected)
    assert "11" in str(caught.value.got)


def test_a_change_of_nothing_is_persistence() -> None:
    """With ``target: change`` a network of zeros keeps every particle where it is."""
    model = MLP.build({**SMALL, "target": "change"}, INFO)
    for parameter in model.network[-1].parameters():
        torch.nn.init.zeros_(parameter)
    window = batch_of([SCENARIOS[0][:2]])
    persistence = window.position[:, -1:].expand(-1, 3, -1)
    torch.testing.assert_close(rolled(model, window, 3), persistence)


def test_noise_is_as_large_as_asked_and_only_in_training() -> None:
    """With a generator inputs get normal noise of the recipe's deviation."""
    model = MLP.build({**SMALL, "noise_std": 0.3}, INFO)
    state = torch.zeros(500, 1, 12, 4)
    noise = model.add_noise(state, torch.Generator().manual_seed(1))
    again = model.add_noise(state, torch.Generator().manual_seed(1))
    assert float(noise.std()) == pytest.approx(0.3, rel=0.02)
    assert torch.equal(noise, again)
    assert torch.equal(model.add_noise(state, None), state)


GATED: dict[str, Any] = {"latent": 8, "decoder": [6]}
BOTH = pytest.mark.parametrize("kind", [LSTM, LSTMWithMLP])


def first_window() -> FrameWindow:
    """Return the states of the first scenario's first two frames."""
    state = FrameState(INFO).standardise(torch.from_numpy(SCENARIOS[0][:2]))
    return FrameWindow(state[None], torch.zeros(1, 12, dtype=torch.int64))


@BOTH
@pytest.mark.parametrize("material", [0, 1])
def test_parameters_of_table_4_6(kind: type[LSTM], material: int) -> None:
    """Encoder, two LSTM layers of 1250, decoder, and an MLP between where there is."""
    info = replace(INFO, particles=2500)
    with torch.device("meta"):  # no memory for the weights
        model = kind.build({"material": bool(material)}, info)
    gate = 1250 * 1250 + 1250 * 1250 + 2 * 1250
    lstm_layer = 4 * gate
    encoder = counted((4 + material, 1250))
    decoder = counted((1250, 1250, 10_000))
    expected = encoder + 2 * lstm_layer + decoder
    if kind is LSTMWithMLP:
        expected += counted((1250, 1250))
    assert parameter_count(model) == expected


def lstm_outputs(layer: torch.nn.LSTM, inputs: Array) -> Array:
    """Return the outputs of an LSTM layer by its gates, shape [time, latent]."""
    input_weight, hidden_weight, input_bias, hidden_bias = float_arrays(layer)
    sigmoid = ACTIVATIONS["sigmoid"]
    hidden = np.zeros(layer.hidden_size)
    cell = np.zeros(layer.hidden_size)
    outputs = []
    for x in inputs:
        gates = input_weight @ x + input_bias + hidden_weight @ hidden + hidden_bias
        input_gate, forget_gate, candidate, output_gate = np.split(gates, 4)
        update = sigmoid(input_gate) * np.tanh(candidate)
        cell = sigmoid(forget_gate) * cell + update
        hidden = sigmoid(output_gate) * np.tanh(cell)
        outputs.append(hidden)
    return np.array(outputs)


def linear(layer: torch.nn.Module, x: Array) -> Array:
    """Return W x + b for rows x."""
    weight, bias = float_arrays(layer)
    rows: Array = x @ weight.T + bias
    return rows


@BOTH
def test_a_step_is_the_equations(kind: type[LSTM]) -> None:
    """Encoder, pooling, gates, the MLP between and decoder give the same state."""
    model = kind.build(GATED, INFO).eval()
    window = first_window()
    elu = ACTIVATIONS["elu"]
    state = window.state[0].numpy().astype(float)
    encoded = elu(linear(model.encoder[0], state))
    latent = lstm_outputs(model.first, encoded.mean(axis=1))
    if model.between is not None:
        latent = elu(linear(model.between[0], latent))
    last = lstm_outputs(model.second, latent)[-1]
    decoded = elu(linear(model.decoder[0], last))
    expected = linear(model.decoder[2], decoded).reshape(12, 4)
    next_state = model.next_state(window)[0].detach().numpy()
    np.testing.assert_allclose(next_state, expected, atol=1e-5)


@BOTH
def test_the_order_of_frames_matters_and_that_of_particles_does_not(
    kind: type[LSTM],
) -> None:
    """Shuffled particles give the same state; a repeated frame gives another."""
    model = kind.build(GATED, INFO).eval()
    window = first_window()
    state = model.next_state(window)
    order = torch.randperm(12, generator=torch.Generator().manual_seed(0))
    shuffled = FrameWindow(window.state[:, :, order], window.material)
    shuffled_state = model.next_state(shuffled)
    torch.testing.assert_close(state, shuffled_state, atol=1e-6, rtol=1e-5)
    doubled = FrameWindow(window.state[:, [1, 1]], window.material)
    assert not torch.allclose(state, model.next_state(doubled), atol=1e-6)


def test_a_rollout_starts_from_two_frames() -> None:
    """The first frame takes the second's velocity where its own is unknown."""
    model = LSTM.build(GATED, INFO)
    short = model.start(batch_of([SCENARIOS[0][:2]])).state[0]
    long = model.start(batch_of([SCENARIOS[0][:6]])).state[0]
    assert torch.equal(short[0, :, 2:], short[1, :, 2:])
    assert not torch.equal(long[0, :, 2:], long[1, :, 2:])
    assert model.history == 3


def test_dropout_acts_in_training_only() -> None:
    """Two passes differ in training and agree in a rollout."""
    window = first_window()
    model = LSTM.build(GATED, INFO).train()
    assert not torch.equal(model.next_state(window), model.next_state(window))
    model.eval()
    assert torch.equal(model.next_state(window), model.next_state(window))


def test_a_dropout_of_zero_drops_nothing() -> None:
    """Two passes agree in training too."""
    window = first_window()
    model = LSTM.build({**GATED, "dropout": [0.0, 0.0]}, INFO).train()
    assert torch.equal(model.next_state(window), model.next_state(window))


def test_the_density_term_compares_maps() -> None:
    """It is the squared error of the scorer's weights over their mean square."""
    model = LSTM.build({**GATED, "dropout": [0.0, 0.0]}, INFO)
    window = SCENARIOS[1][4:8]
    next_state = model.next_state(model.start(batch_of([window[:3]])))
    position = model.frame_state.position(next_state)[0].detach().numpy()
    grid = Grid(8, Placement.CELL_CENTRES)

    def weight_of(x: Any) -> Array:
        return gridding.transfer(x, np.zeros_like(x), grid).weight

    true_weight = weight_of(window[3])
    error = weight_of(position) - true_weight
    expected = np.square(error).sum() / np.square(true_weight).sum()
    density_term = float(model(batch_of([window]))["density"].detach())
    assert density_term == pytest.approx(expected, rel=1e-4)
    assert model.weights == {"density": 0.03}


@pytest.mark.parametrize("is_given", [False, True])
@pytest.mark.parametrize(("kind", "options"), [(MLP, SMALL), (LSTMWithMLP, GATED)])
def test_the_material_is_a_fifth_input(
    kind: type[FrameNetwork], options: dict[str, Any], is_given: bool
) -> None:
    """Materials change the prediction where the recipe gives them to the network."""
    window = [SCENARIOS[0][:2]]
    model = kind.build({**options, "material": is_given}, INFO)
    liquid = rolled(model, batch_of(window, [0] * 12), 1)
    mixed = rolled(model, batch_of(window, [0, 1, 2, 3] * 3), 1)
    assert torch.equal(liquid, mixed) is not is_given


@pytest.mark.parametrize(
    ("kind", "steps", "share"),
    [
        (MLP, 300, 0.1),
        (LSTM, 400, 0.2),
        (LSTMWithMLP, 400, 0.2),
    ],
)
def test_it_learns_a_rotation(
    kind: type[FrameNetwork], steps: int, share: float
) -> None:
    """A rollout from a new angle is soon far better than standing still."""
    torch.manual_seed(0)
    options: dict[str, Any] = {
        "latent": 32,
        "decoder": [32],
        "dropout": [0.0, 0.0],
    }
    if kind is MLP:
        options = {"widths": [64, 64]}
    model = kind.build(options, INFO)
    train(model, rotations(24), steps=steps)
    new_angle = rotations(30)[-1]
    assert share_of_persistence(model, new_angle, frames=20) < share


NETWORKS = ("mlp", "lstm", "lstm-mlp")
SPLITS = ("cavity", "curl-noise", "fluid", "multimaterial")


@pytest.mark.parametrize("size", ["tiny", "mini", "full"])
@pytest.mark.parametrize("split", SPLITS)
@pytest.mark.parametrize("name", [*NETWORKS, "var", "var-stable"])
def test_models_have_recipes_where_they_fit(name: str, split: str, size: str) -> None:
    """Plain VAR is not for full boxes.

    At mini a network has at most 4 M numbers, and a stable VAR takes at most 8.5 MB.
    """
    is_full_box = split in ("cavity", "curl-noise")
    if name == "var" and size == "full" and is_full_box:
        with pytest.raises(UsageError):
            recipe_for(find(name), split, size)
        return

    recipe = recipe_for(find(name), split, size)
    particles = load().size(split, size).particles
    with torch.device("meta"):  # no memory for the weights
        model = find(name).model.build(recipe.model, replace(INFO, particles=particles))
    numbers = sum(value.numel() for value in model.state_dict().values())
    if name in NETWORKS:
        most = {"tiny": 1e6, "mini": 4e6, "full": 2e8}
        assert recipe.model["material"] is (split == "multimaterial")
        assert recipe.model["target"] == "state"  # the thesis's form
        assert numbers <= most[size]
    elif name == "var-stable":
        assert 4 * numbers <= 8.5e6


@pytest.mark.parametrize("split", SPLITS)
@pytest.mark.parametrize("name", NETWORKS)
def test_variants_with_changes_differ_in_target_and_noise(
    name: str, split: str
) -> None:
    """``mini-change`` has the layers and training of ``mini``."""
    plain = recipe_for(find(name), split, "mini")
    change = recipe_for(find(name), split, "mini", variant="change")
    assert change.training == plain.training
    differing = {key for key in plain.model if plain.model[key] != change.model[key]}
    assert {"target"} <= differing <= {"target", "noise_std"}
