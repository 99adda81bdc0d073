"""Models that a checkpoint asks for: those that its weights fill are built, larger ones are refused."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
from simple_models import FACTS, Drift, install

from lagbench.baselines.baseline import Facts
from lagbench.baselines.catalogue import find, names
from lagbench.baselines.checkpoint import Checkpoint, restore
from lagbench.errors import UnreadableFileError

KNOWN = ("position_mean", "position_std", "velocity_mean", "velocity_std")
WHOLE = replace(
    FACTS, statistics=dict.fromkeys((*KNOWN, "acceleration_mean", "acceleration_std"), (0.5, 0.5))
)

SMALL: dict[str, dict[str, Any]] = {
    "neuralmpm": {"cells": 8, "width": 4, "materials": [0, 1, 2, 3]},
    "mlp": {"widths": [4]},
    "lstm": {"latent": 4, "decoder": [4]},
    "lstm-mlp": {"latent": 4, "decoder": [4]},
    "var": {"lags": 1},
    "var-stable": {"rank": 2},
}
"""Options of small models; those of graph networks are below."""

LARGE: dict[str, dict[str, Any]] = {
    "mlp": {"widths": [10**7, 10**7]},
    "neuralmpm": {"width": 4 * 10**5},
    "var": {"lags": 10**9},
    "var-stable": {},
}
"""Options of models that no machine holds; by default a latent vector of 10^7 numbers."""


def stored(baseline: str) -> Checkpoint:
    """Return the checkpoint of a small model."""
    options = SMALL.get(baseline, {"latent": 4, "layers": 2})
    weights = find(baseline).model.build(options, WHOLE).state_dict()
    return Checkpoint(baseline=baseline, options=options, facts=WHOLE, weights=weights)


def particles(count: int) -> Facts:
    """Return the facts of a data set with as many particles."""
    return replace(WHOLE, particles=count)


@pytest.mark.parametrize("baseline", names())
def test_what_the_weights_fill_is_built(baseline: str) -> None:
    """Every baseline comes back with the numbers of its weights; no random number is drawn for the check."""
    found = stored(baseline)
    torch.manual_seed(3)
    find(baseline).model.build(found.options, WHOLE)
    expected = torch.rand(1)
    torch.manual_seed(3)
    model = restore(found)
    assert torch.equal(torch.rand(1), expected)
    for name, value in found.weights.items():
        assert torch.equal(model.state_dict()[name], value), name


@pytest.mark.parametrize("baseline", names())
def test_larger_models_are_refused(baseline: str) -> None:
    """Options for 10^10 numbers and more are refused as those of an unreadable file, at once."""
    found = stored(baseline)
    facts = particles(10**9) if baseline == "var-stable" else WHOLE
    options = {**found.options, **LARGE.get(baseline, {"latent": 10**7})}
    with pytest.raises(UnreadableFileError, match=r"larger model(.|\n)*weights of"):
        restore(replace(found, options=options, facts=facts), where="theirs.pt")


def test_layers_without_number_are_refused() -> None:
    """Ten million layers of one number each are not built either."""
    found = stored("gns")
    with pytest.raises(UnreadableFileError, match=r"larger model(.|\n)*tensors"):
        restore(replace(found, options={"latent": 1, "layers": 10**7}))


def test_weights_that_share_their_bytes_count_once() -> None:
    """A file cannot seem large by many names for the same bytes."""
    found = stored("mlp")
    one = torch.zeros(10**6)
    weights = {f"w{i}": one.view(1000, 1000) for i in range(100)}
    with pytest.raises(UnreadableFileError, match=r"weights of 1000000 numbers"):
        restore(replace(found, options={"widths": [2000, 2000]}, weights=weights))


class Reading(Drift):
    """Reads a number while it is built, which a tensor without numbers does not have."""

    def __init__(self, options: Any, facts: Facts) -> None:
        super().__init__(options, facts)
        self.half = float(torch.full((1,), 0.5))


def test_a_baseline_that_reads_numbers_is_built(monkeypatch: pytest.MonkeyPatch) -> None:
    """A stranger's baseline that cannot be measured beforehand is built as it is."""
    install(monkeypatch, reading=Reading)
    weights = {"a": torch.tensor([0.25]), "calls": torch.tensor(0)}
    model = restore(Checkpoint(baseline="reading", options={}, facts=FACTS, weights=weights))
    assert isinstance(model, Reading)
    assert (model.half, model.a.item()) == (0.5, 0.25)
