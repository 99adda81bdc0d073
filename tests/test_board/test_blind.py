"""Blind tests: new scenarios from a seed, and the scores of models on them."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from model_board import NAME, PATH, ModelBoard

from lagbench.board.blind import score_blind
from lagbench.board.entry import read_entry
from lagbench.data.drawn import DRAWN_IDS, drawn_registry, drawn_root
from lagbench.data.registry import load
from lagbench.data.scenario import read_scenario
from lagbench.errors import DataError
from lagbench.make.generate import generate

SEED = 64 * "5"


@pytest.mark.slow
def test_models_are_scored_on_new_scenarios(
    model_board: ModelBoard, tmp_path: Path
) -> None:
    """The draws follow from the seed; the public scores are those of the entry."""
    shutil.copytree(model_board.root, tmp_path / "data")
    with pytest.raises(DataError):
        score_blind(model_board.folder, [NAME], SEED, root=tmp_path / "data")
    root = drawn_root(tmp_path / "data", SEED)
    registry = drawn_registry(load(), "curl-noise", "tiny", SEED)
    generate("curl-noise", "tiny", root=root, registry=registry, workers=1)
    size = registry.size("curl-noise", "tiny")
    word = str(int(16 * "5", 16))
    with read_scenario(size.path(root, DRAWN_IDS[0])) as file:
        assert file.header.seed == ", ".join([*4 * [word], str(DRAWN_IDS[0])])

    (score,) = score_blind(model_board.folder, [NAME], SEED, root=tmp_path / "data")
    entry = read_entry(model_board.folder / PATH)
    stated = entry.score.metrics[entry.score.ranking_metric].mean
    assert score.public == pytest.approx(stated, rel=1e-6)
    assert score.blind > 0.0
    assert score.blind != score.public
    assert score.blind_skill < 1.0
