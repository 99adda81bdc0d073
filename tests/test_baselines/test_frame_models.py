"""MLPs and LSTMs against the thesis's tables and transcriptions in NumPy; recipes of
all frame models.
"""

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


@pytest.mark.parametrize(
    "study", MLP_STUDIES, ids=lambda study: f"{study.table}-{study.row}"
)
def test_parameters_of_the_thesis(study: MLPStudy) -> None:
    """The recipes of Tables 4.2 to 4.5 have as many parameters as the thesis prints."""
    split = "fluid" if study.table < "4.4" else "multimaterial"
    # what tells a row's recipe from the others of its table
    ends = {
        "4.2": study.activation,
        "4.3": study.widths[0],
        "4.4": len(study.widths),
        "4.5": study.row,
    }
    recipe = recipe_for(
        find("mlp"), split, "full", variant=f"table-{study.table}-{ends[study.table]}"
    )
    with torch.device("meta"):  # no memory for the weights
        model = MLP.build(recipe.model, replace(INFO, particles=2500))
    assert sum(p.numel() for p in model.parameters()) == study.parameters


ACTIVATIONS: dict[str, Callable[[Array], Array]] = {
    "elu": lambda a: np.where(a > 0, a, np.expm1(a)),
    "relu": lambda a: np.maximum(a, 0.0),
    "tanh": np.tanh,
    "sigmoid": lambda a: 1 / (1 + np.exp(-a)),
}


def transcribed(model: MLP, before: Array, last: Array, activation: str) -> Array:
    """Return the next positions by the equations, shape [particle, 2]."""
    known = {name: np.array(value) for name, value in INFO.statistics.items()}
    place = (last - known["position_mean"]) / known["position_std"]
    speed = (last - before - known["velocity_mean"]) / known["velocity_std"]
    state = np.concatenate([place, speed], axis=1).ravel()
    layers = [p.detach().numpy().astype(float) for p in model.parameters()]
    for index in range(0, len(layers), 2):
        state = layers[index] @ state + layers[index + 1]
        if index < len(layers) - 2:
            state = ACTIVATIONS[activation](state)
    following: Array = (
        state.reshape(-1, 4)[:, :2] * known["position_std"] + known["position_mean"]
    )
    return following


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_a_step_is_the_equation(activation: str) -> None:
    """One step of a rollout equals layers, activations and standardisation written out
    in NumPy.
    """
    model = MLP.build({**SMALL, "activation": activation}, INFO)
    expected = transcribed(
        model, SCENARIOS[0][0].astype(float), SCENARIOS[0][1].astype(float), activation
    )
    found = rolled(model, batch_of([SCENARIOS[0][:2]]), 1)[:, 0].numpy()
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_the_loss_is_equation_4_16() -> None:
    """Weighted terms add up to the mean square over particles and standardised
    attributes.
    """
    model = MLP.build(SMALL, INFO)
    window = SCENARIOS[1][5:8]
    terms = model(batch_of([window]))
    loss = sum(
        model.weights[name] * float(term.detach()) for name, term in terms.items()
    )
    state = FrameState(INFO).standardise(torch.from_numpy(window))
    predicted = model.next_state(model.start(batch_of([window[:2]])))[0]
    assert loss == pytest.approx(
        float((predicted - state[2]).square().mean().detach()), rel=1e-5
    )


def test_windows_do_not_mix_and_are_of_as_many_particles() -> None:
    """A rollout of two scenarios side by side equals those of each alone, of their last
    two frames.

    Scenarios of another size raise an error that says how many particles it takes.
    """
    model = MLP.build(SMALL, INFO)
    both = rolled(model, batch_of([SCENARIOS[0][:2], SCENARIOS[1][:2]]), 5)
    alone = [rolled(model, batch_of([x[:2]]), 5) for x in SCENARIOS[:2]]
    torch.testing.assert_close(both, torch.cat(alone), atol=1e-6, rtol=1e-5)
    long, short = (
        rolled(model, batch_of([SCENARIOS[0][first:6]]), 3) for first in (0, 4)
    )
    assert torch.equal(long, short)
    with pytest.raises(DataError) as caught:
        model.start(batch_of([SCENARIOS[0][:2, :11]]))
    assert caught.value.where == "batch"


def test_a_change_of_nothing_is_persistence() -> None:
    """With ``target: change`` a network that puts out zeros keeps every particle where
    it is.
    """
    model = MLP.build({**SMALL, "target": "change"}, INFO)
    for parameter in model.network[-1].parameters():
        torch.nn.init.zeros_(parameter)
    given = batch_of([SCENARIOS[0][:2]])
    torch.testing.assert_close(
        rolled(model, given, 3), given.position[:, -1:].expand(-1, 3, -1)
    )


def test_noise_is_as_large_as_asked_and_only_in_training() -> None:
    """Inputs get normal noise of the recipe's deviation with a generator, and none
    without.
    """
    model = MLP.build({**SMALL, "noise_std": 0.3}, INFO)
    state = torch.zeros(500, 1, 12, 4)
    noise = model.add_noise(state, torch.Generator().manual_seed(1))
    assert float(noise.std()) == pytest.approx(0.3, rel=0.02)
    assert torch.equal(noise, model.add_noise(state, torch.Generator().manual_seed(1)))
    assert torch.equal(model.add_noise(state, None), state)


GATED: dict[str, Any] = {"latent": 8, "decoder": [6]}
BOTH = pytest.mark.parametrize("kind", [LSTM, LSTMWithMLP])


def window_of() -> FrameWindow:
    """Return the states of the first scenario's first two frames."""
    state = FrameState(INFO).standardise(torch.from_numpy(SCENARIOS[0][:2]))
    return FrameWindow(state[None], torch.zeros(1, 12, dtype=torch.int64))


@BOTH
@pytest.mark.parametrize("material", [0, 1])
def test_parameters_of_table_4_6(kind: type[LSTM], material: int) -> None:
    """Encoder, two LSTM layers of 1250, decoder; the MLP between them adds 1250 x 1250
    + 1250.
    """
    with torch.device("meta"):
        model = kind.build({"material": bool(material)}, replace(INFO, particles=2500))
    layer = 4 * (1250 * 1250 + 1250 * 1250 + 2 * 1250)
    expected = counted((4 + material, 1250)) + 2 * layer + counted((1250, 1250, 10_000))
    expected += counted((1250, 1250)) if kind is LSTMWithMLP else 0
    assert sum(p.numel() for p in model.parameters()) == expected


def cells(layer: torch.nn.LSTM, inputs: Array) -> Array:
    """Return the outputs of an LSTM layer over time by its gates, shape [time,
    latent].
    """
    (w, r, b, c) = (p.detach().numpy().astype(float) for p in layer.parameters())
    sigmoid = ACTIVATIONS["sigmoid"]
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
    """Encoder, pooling, gates, the MLP between, and decoder, written out, give the same
    state.
    """
    model = kind.build(GATED, INFO).eval()
    window = window_of()
    elu = ACTIVATIONS["elu"]
    latent = elu(linear(model.encoder[0], window.state[0].numpy().astype(float))).mean(
        axis=1
    )
    latent = cells(model.first, latent)
    if model.between is not None:
        latent = elu(linear(model.between[0], latent))
    last = cells(model.second, latent)[-1]
    expected = linear(model.decoder[2], elu(linear(model.decoder[0], last))).reshape(
        12, 4
    )
    found = model.next_state(window)[0].detach().numpy()
    np.testing.assert_allclose(found, expected, atol=1e-5)
    # the order of particles is nothing, that of frames is not
    order = torch.randperm(12, generator=torch.Generator().manual_seed(0))
    shuffled = FrameWindow(window.state[:, :, order], window.material)
    torch.testing.assert_close(
        model.next_state(window), model.next_state(shuffled), atol=1e-6, rtol=1e-5
    )
    doubled = FrameWindow(window.state[:, [1, 1]], window.material)
    assert not torch.allclose(
        model.next_state(window), model.next_state(doubled), atol=1e-6
    )


def test_a_rollout_starts_from_two_frames() -> None:
    """Two given frames are enough: the first takes the second's velocity, as its own is
    unknown.
    """
    model = LSTM.build(GATED, INFO)
    short, long = (
        model.start(batch_of([SCENARIOS[0][:frames]])).state[0] for frames in (2, 6)
    )
    assert torch.equal(short[0, :, 2:], short[1, :, 2:])
    assert not torch.equal(long[0, :, 2:], long[1, :, 2:])
    assert model.history == 3


def test_dropout_acts_in_training_only() -> None:
    """Two passes differ in training and agree in a rollout; a share of 0 drops
    nothing.
    """
    window = window_of()
    model = LSTM.build(GATED, INFO).train()
    assert not torch.equal(model.next_state(window), model.next_state(window))
    assert torch.equal(model.eval().next_state(window), model.next_state(window))
    still = LSTM.build({**GATED, "dropout": [0.0, 0.0]}, INFO).train()
    assert torch.equal(still.next_state(window), still.next_state(window))


def test_the_density_term_compares_maps() -> None:
    """It is the squared error of the scorer's particle weights over their mean
    square.
    """
    model = LSTM.build({**GATED, "dropout": [0.0, 0.0]}, INFO)
    window = SCENARIOS[1][4:8]
    state = model.start(batch_of([window[:3]]))
    predicted = model.frame_state.position(model.next_state(state))[0].detach().numpy()
    grid = Grid(8, Placement.CELL_CENTRES)
    guess, truth = (
        gridding.transfer(x, np.zeros_like(x), grid).weight
        for x in (predicted, window[3])
    )
    expected = np.square(guess - truth).sum() / np.square(truth).sum()
    assert float(model(batch_of([window]))["density"].detach()) == pytest.approx(
        expected, rel=1e-4
    )
    assert model.weights == {"density": 0.03}


@pytest.mark.parametrize(("kind", "options"), [(MLP, SMALL), (LSTMWithMLP, GATED)])
def test_the_material_is_a_fifth_input(
    kind: type[FrameNetwork], options: dict[str, Any]
) -> None:
    """Materials change the prediction where the recipe gives them to the network, and
    only there.
    """
    window = [SCENARIOS[0][:2]]
    kinds = ([0] * 12, [0, 1, 2, 3] * 3)
    for given in (False, True):
        model = kind.build({**options, "material": given}, INFO)
        first, second = (rolled(model, batch_of(window, kind), 1) for kind in kinds)
        assert torch.equal(first, second) is not given


@pytest.mark.parametrize(
    ("kind", "steps", "share"),
    [(MLP, 300, 0.1), (LSTM, 400, 0.2), (LSTMWithMLP, 400, 0.2)],
)
def test_it_learns_a_rotation(
    kind: type[FrameNetwork], steps: int, share: float
) -> None:
    """After some hundred steps a rollout from a new angle is far better than standing
    still.
    """
    torch.manual_seed(0)
    recurrent = {"latent": 32, "decoder": [32], "dropout": [0.0, 0.0]}
    model = kind.build({"widths": [64, 64]} if kind is MLP else recurrent, INFO)
    train(model, rotations(24), steps=steps)
    assert share_of_persistence(model, rotations(30)[-1], frames=20) < share


NETWORKS = ("mlp", "lstm", "lstm-mlp")
SPLITS = ("cavity", "curl-noise", "fluid", "multimaterial")


@pytest.mark.parametrize("size", ["tiny", "mini", "full"])
@pytest.mark.parametrize("split", SPLITS)
@pytest.mark.parametrize("name", [*NETWORKS, "var", "var-stable"])
def test_models_have_recipes_where_they_fit(name: str, split: str, size: str) -> None:
    """Plain VAR is not for full boxes; mini has at most 4 M numbers, a stable VAR 8
    MB.
    """
    if name == "var" and size == "full" and split in ("cavity", "curl-noise"):
        with pytest.raises(UsageError) as caught:
            recipe_for(find(name), split, size)
        assert caught.value.where == "--split, --size, --recipe"
        return
    recipe = recipe_for(find(name), split, size)
    with torch.device("meta"):  # no memory for the weights
        info = replace(INFO, particles=load().size(split, size).particles)
        model = find(name).model.build(recipe.model, info)
    numbers = sum(value.numel() for value in model.state_dict().values())
    if name in NETWORKS:
        assert recipe.model["material"] is (split == "multimaterial")
        assert recipe.model["target"] == "state"  # the thesis's form
        assert numbers <= {"tiny": 1e6, "mini": 4e6, "full": 2e8}[size]
    elif name == "var-stable":
        assert 4 * numbers <= 8.5e6


@pytest.mark.parametrize("split", SPLITS)
@pytest.mark.parametrize("name", NETWORKS)
def test_variants_with_changes_differ_in_that_only(name: str, split: str) -> None:
    """``mini-change`` has the layers and training of ``mini``; its target, and its
    noise, are others.
    """
    plain, change = (
        recipe_for(find(name), split, "mini", variant=variant)
        for variant in (None, "change")
    )
    assert change.training == plain.training
    differing = {key for key in plain.model if plain.model[key] != change.model[key]}
    assert {"target"} <= differing <= {"target", "noise_std"}
