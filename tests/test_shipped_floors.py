"""What the package ships of the floors belongs to the data sets that the registry describes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from lagbench.data.layout import major_of
from lagbench.data.registry import load
from lagbench.floors import floors_of, shipped
from lagbench.floors.shipped import FOLDER, shipped_path
from lagbench.scoring.skill import best_floor
from lagbench.scoring.task import ranking_metric

LARGEST = 200_000
"""Bytes of one file at the most."""


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.json")), ids=lambda path: path.stem)
def test_shipped_scores_belong_to_the_registry(path: Path) -> None:
    """Hash, floors, scenarios and ranking metric are those of the size that the file names."""
    said = json.loads(path.read_text())
    size = load().size(said["split"], said["size"])
    assert path == shipped_path(size)
    assert path.stat().st_size < LARGEST
    if major_of(said["dataset_version"]) != size.major:
        pytest.skip("measured on another version of the data")
    held = shipped(size)
    assert held is not None
    assert list(held) == [floor.name for floor in floors_of(size)]
    ranking = ranking_metric(size)
    for floor in held.values():
        score = floor.scores[ranking]
        assert score.scenarios == tuple(sorted(size.subsets["test"]))
        assert score.mean > 0.0
        assert floor.correlation.shape == score.values.shape
    assert best_floor({name: floor.scores[ranking] for name, floor in held.items()}) is not None
