"""Compare what the package computes with the golden set (golden.py)."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import golden
import pytest

import lagbench
from lagbench.make.generate import GenerationResult

RECORDED = json.loads(golden.GOLDEN_FILE.read_text())


@pytest.fixture(scope="module")
def root(
    tmp_path_factory: pytest.TempPathFactory,
    generated: GenerationResult,
    tiny_split: Callable[..., GenerationResult],
) -> Path:
    """A folder with the tiny data of the quick splits."""
    folder = tmp_path_factory.mktemp("golden")
    for result in (generated, tiny_split("fluid")):
        (folder / result.split).symlink_to(result.root / result.split)
    return folder


@pytest.mark.parametrize("split", golden.QUICK_SPLITS)
def test_tiny_data_keep_their_bits(root: Path, split: str) -> None:
    manifest = lagbench.load_manifest(split, size="tiny", root=root)
    assert manifest.dataset_sha256 == RECORDED["datasets"][split]


@pytest.mark.slow
@pytest.mark.parametrize(
    "split", sorted(RECORDED["datasets"].keys() - set(golden.QUICK_SPLITS))
)
def test_other_tiny_data_keep_their_bits(tmp_path: Path, split: str) -> None:
    assert golden.dataset_hash(split, tmp_path) == RECORDED["datasets"][split]


@pytest.mark.parametrize("name", golden.PREDICTIONS)
def test_scores_keep_their_values(root: Path, tmp_path: Path, name: str) -> None:
    path = golden.write_prediction(name, root, tmp_path)
    scores = golden.score(path, root)
    recorded = RECORDED["scores"][name]
    assert scores["metrics"] == pytest.approx(recorded["metrics"], rel=1e-7)
    assert scores["references"] == pytest.approx(recorded["references"], rel=1e-7)
    assert scores["ranking_metric"] == recorded["ranking_metric"]
    assert scores["skill"] == recorded["skill"]


def test_short_training_keeps_its_losses(root: Path, tmp_path: Path) -> None:
    training = golden.train(root, tmp_path)
    recorded = RECORDED["training"]
    if training["processor"] == recorded["processor"]:
        assert training == recorded
    assert training["loss"] == pytest.approx(recorded["loss"], rel=1e-3)
    assert training["weight_sums"] == pytest.approx(recorded["weight_sums"], rel=1e-3)


def test_commands_print_the_same_data(root: Path, tmp_path: Path) -> None:
    outputs = dict(golden.command_outputs(root, tmp_path))
    assert outputs == RECORDED["commands"]


@pytest.mark.slow
def test_board_rows_keep_their_numbers(root: Path) -> None:
    assert golden.board_rows(root) == RECORDED["board"]
