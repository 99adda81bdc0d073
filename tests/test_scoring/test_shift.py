"""Predictions of the subset shift: written, validated and scored beside references."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from numpy.testing import assert_allclose

import lagbench
from lagbench.data.registry import load
from lagbench.errors import UnreadableFileError, UsageError
from lagbench.make.generate import GenerationResult
from lagbench.references.shipped import shipped, shipped_path
from lagbench.scoring.score_file import read_statistics
from lagbench.scoring.task import SUBMISSION
from lagbench.submission.truth import Truth
from lagbench.submission.writer import PredictionsWriter

SPLIT = "multimaterial"


@pytest.fixture(scope="module")
def root(tiny_split: Callable[..., GenerationResult]) -> Path:
    """A root with the tiny data, which have a subset shift."""
    return tiny_split(SPLIT).root


def write_still(path: Path, root: Path, subset: str, labelled: str) -> Path:
    """Write the last given frame of a subset's scenarios, repeated, under a label."""
    size = load().size(SPLIT, "tiny").scored_on(subset)
    truth = Truth(size, root)
    writer = PredictionsWriter(
        path,
        split=SPLIT,
        size="tiny",
        method="still",
        subset=subset,
        root=root,
    )
    with writer:
        for scenario in size.scored_scenarios:
            last = truth.given_frames(scenario)[-1]
            shape = writer.shape_of(scenario)
            writer.add(scenario, np.broadcast_to(last, shape))
    with h5py.File(path, "r+") as file:
        file.attrs["subset"] = labelled
    return path


def test_shift_is_scored_beside_its_references(root: Path, tmp_path: Path) -> None:
    """A fluid at rest scores as persistence does in the shipped scores of shift; both
    score files say which subset it was, and are no scores of test.
    """
    path = write_still(tmp_path / "still.nc", root, "shift", "shift")
    card = lagbench.score(path, root=root, workers=1)
    size = load().size(SPLIT, "tiny")
    assert card.scenarios == size.subsets["shift"]
    references = shipped(size.scored_on("shift"))
    assert references is not None
    persistence = references["persistence"].scores[card.ranking]
    still = card.scores[SUBMISSION][card.ranking]
    assert_allclose(still.values, persistence.values, rtol=1e-4)
    json_path, netcdf_path = card.files
    content = json.loads(json_path.read_text())
    assert content["subset"] == "shift"
    read_statistics(netcdf_path, size.scored_on("shift"))
    with pytest.raises(UnreadableFileError):
        read_statistics(netcdf_path, size)


def test_a_subset_holds_its_own_scenarios_only(root: Path, tmp_path: Path) -> None:
    """Predictions of test that claim to be shift fail the check of the scenarios; a
    subset that is not scored is refused.
    """
    path = write_still(tmp_path / "mixed.nc", root, "test", "shift")
    result = lagbench.validate(path, root=root)
    checks = {issue.check for issue in result.findings}
    assert "scenarios" in checks
    path = write_still(tmp_path / "train.nc", root, "test", "train")
    result = lagbench.validate(path, root=root)
    checks = {issue.check for issue in result.findings}
    assert "split" in checks
    size = load().size(SPLIT, "tiny")
    with pytest.raises(UsageError) as caught:
        size.scored_on("train")
    assert caught.value.where == f"{SPLIT} tiny"


def test_scores_of_shift_are_bound_to_their_subset() -> None:
    """Shipped scores of shift have a file of their own and the hash of the subset."""
    size = load().size(SPLIT, "mini")
    shift = size.scored_on("shift")
    assert shipped_path(shift) != shipped_path(size)
    assert size.measured is not None
    hashes = size.measured.subset_sha256
    content = json.loads(shipped_path(shift).read_text())
    assert content["subset_sha256"] == hashes["shift"]
    other_hashes = {**hashes, "shift": "0" * 64}
    measured = size.measured.model_copy(update={"subset_sha256": other_hashes})
    changed = size.model_copy(update={"measured": measured})
    assert shipped(changed.scored_on("shift")) is None
