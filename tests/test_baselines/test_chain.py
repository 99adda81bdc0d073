"""From nothing to a score on the newer splits: generate, train, predict, score."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import lagbench
from lagbench.baselines.predict import predict
from lagbench.baselines.train import train
from lagbench.data.registry import load
from lagbench.make.generate import GenerationResult

SPLITS = ("poiseuille", "cavity-3d")
STEPS = 20


@pytest.mark.slow
@pytest.mark.parametrize("split", SPLITS)
def test_a_trained_model_gets_a_skill(
    split: str,
    tiny_split: Callable[..., GenerationResult],
    tmp_path: Path,
) -> None:
    """The recipe of the split trains; its predictions are valid and are scored beside
    the shipped reference predictors.
    """
    root = tiny_split(split).root
    trained = train(
        "neuralmpm",
        split,
        "tiny",
        root=root,
        output=tmp_path / "model",
        settings=(f"training.steps={STEPS}", "training.warmup_steps=2"),
    )
    output = tmp_path / "predictions.nc"
    predict(trained.weights, output, root=root)
    assert not lagbench.validate(output, root=root).errors
    card = lagbench.score(output, root=root)
    size = load().size(split, "tiny")
    assert set(card.scores) >= {"persistence", "frozen-field", "projection"}
    assert card.skill is not None
    assert np.isfinite(card.skill.value)
    scores = card.submission["vorticity_nrmse"]
    assert len(scores.values) == len(size.subsets["test"])
    assert np.isfinite(scores.values).all()
