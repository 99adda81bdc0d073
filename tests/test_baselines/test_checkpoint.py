"""Checkpoints: what comes back, and what is refused."""

from __future__ import annotations

import json
import math
import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from simple_models import INFO, Drift, install

from lagbench.baselines.catalogue import find, list_names
from lagbench.baselines.checkpoint import (
    Checkpoint,
    OtherVersionWarning,
    check_data,
    load,
    restore,
    save,
)
from lagbench.baselines.dataset_info import read_dataset_info
from lagbench.data.registry import Registry
from lagbench.errors import DataError, UnreadableFileError, UsageError
from lagbench.make.generate import GenerationResult

ONE = torch.ones(1)


def example(**changes: Any) -> Checkpoint:
    """Return a checkpoint of a Drift whose parameter needs all bits of a float32."""
    options = {"start": 1 / 3}
    model = Drift.build(options, INFO)
    fields = {
        "baseline": "drift",
        "options": options,
        "info": INFO,
        "weights": model.state_dict(),
        "training": {"step": 3, "recipe": {"training": {"seed": 4}}},
    }
    return Checkpoint(**{**fields, **changes})


def test_a_checkpoint_comes_back_as_it_was_stored(tmp_path: Path) -> None:
    """Weights, words and the optimiser's state; views of more or less memory too."""
    row = torch.arange(10**6, dtype=torch.float32)
    optimizer = {"a/step": torch.tensor(3.0), "a/exp_avg": row[3:6]}
    weights = {"repeated": ONE.expand(5), "short": row[:2].to(torch.bfloat16)}
    stored = example(weights=weights, optimizer=optimizer)
    path = tmp_path / "a.safetensors"
    save(path, stored)
    loaded = load(path)
    assert (loaded.baseline, loaded.options) == (stored.baseline, stored.options)
    assert (loaded.info, loaded.training) == (INFO, stored.training)
    assert loaded.seed == 4
    assert loaded.optimizer is not None
    for name, value in weights.items():
        assert torch.equal(loaded.weights[name], value)
    for name, value in optimizer.items():
        assert torch.equal(loaded.optimizer[name], value)
    assert path.stat().st_size < 10**4


def a_pickle(path: Path) -> None:
    """A pickle under that suffix."""
    path.write_bytes(pickle.dumps({"weights": [1.0]}))


def cut_short(path: Path) -> None:
    """The last number is missing."""
    path.write_bytes(path.read_bytes()[:-4])


def change_header(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change the JSON text in the header; the numbers stay."""
    content = path.read_bytes()
    end = 8 + int.from_bytes(content[:8], "little")
    header = json.loads(content[8:end])
    text = json.loads(header["__metadata__"]["lagbench"])
    change(text)
    header["__metadata__"]["lagbench"] = json.dumps(text)
    encoded = json.dumps(header).encode()
    length = len(encoded).to_bytes(8, "little")
    path.write_bytes(length + encoded + content[end:])


def without_options(path: Path) -> None:
    """No options of the model."""
    change_header(path, lambda text: text.pop("options"))


def no_radius(path: Path) -> None:
    """A figure of the data set that none has."""
    change_header(path, lambda text: text["facts"].update(radius=math.inf))


@pytest.mark.parametrize("spoil", [a_pickle, cut_short, without_options, no_radius])
def test_other_files_are_unreadable(
    tmp_path: Path, spoil: Callable[[Path], None]
) -> None:
    path = tmp_path / "a.safetensors"
    save(path, example())
    spoil(path)
    with pytest.raises(UnreadableFileError) as caught:
        load(path)
    assert caught.value.where == str(path)


def test_complex_and_sparse_weights_are_not_saved(tmp_path: Path) -> None:
    for value in (ONE.to_sparse(), ONE.to(torch.complex64)):
        with pytest.raises(UsageError):
            save(tmp_path / "a.safetensors", example(weights={"a": value}))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "changes",
    [
        {"weights": {"a": math.nan * ONE, "calls": torch.tensor(0)}},
        {"weights": {"a": torch.zeros(2), "calls": torch.tensor(0)}},
        {"weights": {"a": torch.zeros(1)}},
        {"options": {"sart": 1}},
    ],
)
def test_weights_that_do_not_fit_the_model_are_refused(
    changes: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    install(monkeypatch, drift=Drift)
    with pytest.raises(UnreadableFileError) as caught:
        restore(example(**changes), where="a.safetensors")
    assert caught.value.where == "a.safetensors"


def test_data_of_another_version(
    generated: GenerationResult, unmeasured: Registry
) -> None:
    """They can be predicted, with a warning; missing data cannot."""
    root = generated.root
    where = "a.safetensors"
    info = read_dataset_info("curl-noise", "tiny", root=root)
    old = example(baseline="gns", info=replace(info, version="0.9.0"))
    with pytest.warns(OtherVersionWarning):
        check_data(old, root=root, registry=unmeasured, where=where)
    for split, there in (("curl-noise", root / "nowhere"), ("my-river", root)):
        stored = example(baseline="gns", info=replace(INFO, split=split))
        with pytest.raises(DataError):
            check_data(stored, root=there, registry=unmeasured, where=where)


KINDS = [
    f"{name}_{of}"
    for name in ("position", "velocity", "acceleration")
    for of in ("mean", "std")
]
WHOLE = replace(INFO, statistics=dict.fromkeys(KINDS, (0.5, 0.5)))

SMALL_MODELS: dict[str, dict[str, Any]] = {
    "neuralmpm": {"cells": 8, "width": 4, "materials": [0, 1, 2, 3]},
    "mlp": {"widths": [4]},
    "lstm": {"latent": 4, "decoder": [4]},
    "lstm-mlp": {"latent": 4, "decoder": [4]},
    "var": {"lags": 1},
    "var-stable": {"rank": 2},
    "hybrid-projection": {},
    "hybrid-coarse": {},
}
"""Options of small models; all others are graph networks."""


@pytest.mark.parametrize("baseline", list_names())
def test_every_baseline_comes_back_with_its_weights(baseline: str) -> None:
    options = SMALL_MODELS.get(baseline, {"latent": 4, "layers": 2})
    info = WHOLE
    if baseline == "hybrid-coarse":  # knows free surfaces only
        info = replace(WHOLE, split="multimaterial", size="tiny")
    model = find(baseline).model.build(options, info)
    stored = Checkpoint(
        baseline=baseline, options=options, info=info, weights=model.state_dict()
    )
    state = restore(stored).state_dict()
    for name, value in stored.weights.items():
        assert torch.equal(state[name], value), name


@pytest.mark.slow
def test_weights_of_the_board_can_be_run() -> None:
    """Every file beside an entry is one that today's models are built from."""
    weights = Path(__file__).parents[2] / "leaderboard/weights"
    for file in sorted(weights.rglob("*.safetensors")):
        model = restore(load(file), where=str(file))
        assert model.method
