"""The MLP against Tables 4.2 to 4.5, a transcription in NumPy, and a motion it can learn."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from frame_cases import batch_of, facts_of, rollout, rotations, share_of_persistence, train
from numpy.typing import NDArray
from pydantic import ValidationError

from lagbench.baselines.baseline import Facts
from lagbench.baselines.catalogue import find
from lagbench.baselines.frame_model import FrameState
from lagbench.baselines.mlp import MLP
from lagbench.baselines.recipe import recipe_for
from lagbench.errors import DataError

SCENARIOS = rotations(4)
FACTS = facts_of(SCENARIOS)
SMALL = {"widths": [16, 8]}

Array = NDArray[np.float64]

PARAMETERS = {
    "fluid/full-table-4.2-sigmoid": 4_090_600,
    "fluid/full-table-4.2-tanh": 4_090_600,
    "fluid/full-table-4.2-relu": 4_090_600,
    "fluid/full-table-4.2-elu": 4_090_600,
    "fluid/full-table-4.3-100": 2_030_300,
    "fluid/full-table-4.3-200": 4_090_600,
    "fluid/full-table-4.3-400": 8_331_200,
    "fluid/full-table-4.3-800": 17_292_400,
    "fluid/full-table-4.3-1000": 22_013_000,
    "fluid/full-table-4.3-1600": 37_134_800,
    "multimaterial/full-table-4.4-3": 22_013_000,
    "multimaterial/full-table-4.4-4": 23_014_000,
    "multimaterial/full-table-4.4-5": 24_015_000,
    "multimaterial/full-table-4.4-6": 25_016_000,
    "multimaterial/full-table-4.4-7": 26_017_000,
    "multimaterial/full-table-4.5-1": 22_013_000,
    "multimaterial/full-table-4.5-2": 23_014_000,
    "multimaterial/full-table-4.5-3": 57_830_000,
    "multimaterial/full-table-4.5-4": 68_770_000,
    "fluid/full": 57_830_000,
}
"""Total parameters as the thesis's tables print them, by recipe."""


def untouched(options: dict[str, Any], facts: Facts) -> MLP:
    """Build without memory for the weights, to count them."""
    with torch.device("meta"):
        return MLP.build(options, facts)


@pytest.mark.parametrize(("recipe", "parameters"), PARAMETERS.items())
def test_parameters_of_the_thesis(recipe: str, parameters: int) -> None:
    """The recipes of Tables 4.2 to 4.5 have as many parameters as the thesis prints."""
    split, _, tier = recipe.partition("/")
    size, _, variant = tier.partition("-")
    options = recipe_for(find("mlp"), split, size, variant=variant or None).model
    model = untouched(dict(options), replace(FACTS, particles=2500))
    assert sum(p.numel() for p in model.parameters()) == parameters


ACTIVATIONS: dict[str, Callable[[Array], Array]] = {
    "elu": lambda a: np.where(a > 0, a, np.expm1(a)),
    "relu": lambda a: np.maximum(a, 0.0),
    "tanh": np.tanh,
    "sigmoid": lambda a: 1 / (1 + np.exp(-a)),
}


def transcribed(model: MLP, before: Array, last: Array, activation: str) -> Array:
    """Return the next positions by the equations, shape [particle, 2]."""
    known = {name: np.array(value) for name, value in FACTS.statistics.items()}
    state = np.concatenate(
        [
            (last - known["position_mean"]) / known["position_std"],
            (last - before - known["velocity_mean"]) / known["velocity_std"],
        ],
        axis=1,
    ).ravel()
    layers = [p.detach().numpy().astype(float) for p in model.parameters()]
    for index in range(0, len(layers), 2):
        state = layers[index] @ state + layers[index + 1]
        if index < len(layers) - 2:
            state = ACTIVATIONS[activation](state)
    following: Array = state.reshape(-1, 4)[:, :2] * known["position_std"] + known["position_mean"]
    return following


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_a_step_is_the_equation(activation: str) -> None:
    """One step of a rollout equals layers, activations and standardisation written out in NumPy."""
    model = MLP.build({**SMALL, "activation": activation}, FACTS)
    expected = transcribed(model, SCENARIOS[0][0].astype(float), SCENARIOS[0][1].astype(float), activation)
    found = rollout(model, batch_of([SCENARIOS[0][:2]]), 1)[:, 0].numpy()
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_the_loss_is_equation_4_16() -> None:
    """Weighted terms add up to the mean square over particles and standardised attributes."""
    model = MLP.build(SMALL, FACTS)
    window = SCENARIOS[1][5:8]
    terms = model(batch_of([window]))
    loss = sum(model.weights[name] * float(term.detach()) for name, term in terms.items())
    state = FrameState(FACTS).of(torch.from_numpy(window))
    predicted = model.next_state(model.start(batch_of([window[:2]])))[0]
    assert loss == pytest.approx(float((predicted - state[2]).square().mean().detach()), rel=1e-5)


def test_windows_do_not_mix() -> None:
    """A rollout of two scenarios side by side equals those of each alone."""
    model = MLP.build(SMALL, FACTS)
    both = rollout(model, batch_of([SCENARIOS[0][:2], SCENARIOS[1][:2]]), 5)
    alone = [rollout(model, batch_of([x[:2]]), 5) for x in SCENARIOS[:2]]
    torch.testing.assert_close(both, torch.cat(alone), atol=1e-6, rtol=1e-5)


def test_only_the_last_frame_and_its_velocity_count() -> None:
    """Six given frames start the rollout that their last two do."""
    model = MLP.build(SMALL, FACTS)
    long, short = (rollout(model, batch_of([SCENARIOS[0][first:6]]), 3) for first in (0, 4))
    assert torch.equal(long, short)


def test_the_material_is_a_fifth_input() -> None:
    """Materials change the prediction where the recipe gives them to the network, and only there."""
    window, kinds = [SCENARIOS[0][:2]], ([0] * 12, [0, 1, 2, 3] * 3)
    for given in (False, True):
        model = MLP.build({**SMALL, "material": given}, FACTS)
        first, second = (rollout(model, batch_of(window, kind), 1) for kind in kinds)
        assert torch.equal(first, second) is not given
    widths = [tuple(layer.shape) for layer in model.parameters()]
    assert widths[0] == (16, 5 * 12)
    assert widths[-2] == (4 * 12, 8)


def test_a_change_of_nothing_is_persistence() -> None:
    """With ``target: change`` a network that puts out zeros keeps every particle where it is."""
    model = MLP.build({**SMALL, "target": "change"}, FACTS)
    for parameter in model.network[-1].parameters():
        torch.nn.init.zeros_(parameter)
    given = batch_of([SCENARIOS[0][:2]])
    torch.testing.assert_close(rollout(model, given, 3), given.position[:, -1:].expand(-1, 3, -1))


def test_noise_is_as_large_as_asked_and_only_in_training() -> None:
    """Inputs get normal noise of the recipe's deviation with a generator, and none without."""
    model = MLP.build({**SMALL, "noise_std": 0.3}, FACTS)
    state = torch.zeros(500, 1, 12, 4)
    noise = model.disturbed(state, torch.Generator().manual_seed(1))
    assert float(noise.std()) == pytest.approx(0.3, rel=0.02)
    assert torch.equal(noise, model.disturbed(state, torch.Generator().manual_seed(1)))
    assert torch.equal(model.disturbed(state, None), state)


def test_it_learns_a_rotation() -> None:
    """After 300 steps a rollout from a new angle is far better than standing still."""
    torch.manual_seed(0)
    model = MLP.build({"widths": [64, 64]}, FACTS)
    before = share_of_persistence(model, rotations(1, seed=0, frames=30)[0], frames=20)
    train(model, rotations(24), steps=300)
    after = share_of_persistence(model, rotations(30)[-1], frames=20)
    assert after < 0.1 < before


def test_other_particles_are_refused() -> None:
    """Scenarios of another size raise an error that says how many particles it takes."""
    model = MLP.build(SMALL, FACTS)
    with pytest.raises(DataError, match="12 particles in each window\n  got: 11"):
        model.start(batch_of([SCENARIOS[0][:2, :11]]))


@pytest.mark.parametrize(
    "options", [{"widths": [0]}, {"activation": "gelu"}, {"noise_std": -1}, {"depth": 3}]
)
def test_options_are_checked(options: dict[str, Any]) -> None:
    """Widths of 0, unknown activations, negative noise and unknown keys are errors."""
    with pytest.raises(ValidationError):
        MLP.build(options, FACTS)
