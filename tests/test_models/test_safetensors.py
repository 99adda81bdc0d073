"""Registered architectures that a program of one's own trained."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from conftest import SIZE, SPLIT
from simple_models import SMALL

from lagbench.baselines.checkpoint import load, restore
from lagbench.baselines.predict import predict
from lagbench.board.check import check_board
from lagbench.board.entry import Meta
from lagbench.board.reproduce import reproduce
from lagbench.board.submit import submit
from lagbench.board.verified import Level
from lagbench.errors import UnreadableFileError, UsageError
from lagbench.make.generate import GenerationResult
from lagbench.models.registered import build_registered, export_safetensors


def small_model(generated: GenerationResult) -> Any:
    """Return a small graph network for the tiny curl noise that moves particles."""
    torch.manual_seed(3)
    model: Any = build_registered(
        "gns", split=SPLIT, size=SIZE, options=SMALL, root=generated.root
    )
    torch.nn.init.normal_(model.network.decoder[-1].weight, std=0.1)
    return model


def test_weights_and_recipe_come_back(
    tmp_path: Path, generated: GenerationResult
) -> None:
    """To the bit, with the options that have defaults; integers may be NumPy's."""
    model = small_model(generated)
    path = export_safetensors(
        model,
        tmp_path / "new/model.safetensors",
        baseline="gns",
        seed=np.int64(3),
        step=np.int32(5),
    )
    checkpoint = load(path)
    restored = restore(checkpoint)
    assert (checkpoint.baseline, checkpoint.seed) == ("gns", 3)
    assert checkpoint.training["step"] == 5
    assert restored.options == model.options
    for name, value in model.state_dict().items():
        assert torch.equal(restored.state_dict()[name], value), name


def test_what_cannot_be_exported_is_refused(
    tmp_path: Path, generated: GenerationResult
) -> None:
    """Another suffix, another architecture, weights that are not finite."""
    model = small_model(generated)
    with pytest.raises(UsageError):
        export_safetensors(model, tmp_path / "model.pt", baseline="gns")
    with pytest.raises(UnreadableFileError):
        export_safetensors(model, tmp_path / "a.safetensors", baseline="neuralmpm")
    next(model.parameters()).data[:] = torch.nan
    with pytest.raises(UnreadableFileError):
        export_safetensors(model, tmp_path / "a.safetensors", baseline="gns")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_an_entry_carries_a_file_of_safetensors(
    tmp_path: Path, generated: GenerationResult
) -> None:
    """It is submitted, checked, and predicts the scores of its entry again."""
    board = tmp_path / "board"
    root = generated.root
    model = small_model(generated)
    path = export_safetensors(model, tmp_path / "m.safetensors", baseline="gns")
    predictions = tmp_path / "predictions.nc"
    predict(path, predictions, root=root, device="cpu", threads=1, method="own")
    meta = Meta(authors=("A. Author",), command="make")
    submit([predictions], meta, board=board, root=root, new_board=True, weights=[path])
    weights = board / "weights/curl-noise/tiny/own_0.safetensors"
    assert weights.read_bytes() == path.read_bytes()
    assert check_board(board, root=root).findings == ()

    result = reproduce(board, ["curl-noise/tiny/own"], root=root, costs=False)
    (line,) = result.lines.values()
    assert line.level is Level.REPRODUCED
    assert line.reproduced[0].difference == 0.0
