"""Floors of a split of the user's own: those of its kind of box, computed while scoring."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from score_bench import bench_of, straight

from lagbench.data.registry import Registry, Size, load
from lagbench.floors import floors_of, shipped
from lagbench.make.generate import GenerationResult
from lagbench.scoring.floors import measurable
from lagbench.scoring.scenario import SUBMISSION


def own(size: Size, *, placement: str) -> Size:
    """Return a split of a user's own: without generator, gravity or recorded scores."""
    parameters = {name: value for name, value in size.parameters.items() if name != "gravity"}
    grid = size.task.score_grid.model_copy(update={"placement": placement})
    task = size.task.model_copy(update={"score_grid": grid})
    told = {"split": "own", "name": "full", "generator": "none", "parameters": parameters, "task": task}
    return size.model_copy(update=told)


@pytest.mark.parametrize(
    ("placement", "names"),
    [
        ("cell_centres", "persistence constant-velocity frozen-field analog"),
        ("nodes", "persistence constant-velocity analog"),
    ],
)
def test_floors_go_by_the_kind_of_box(placement: str, names: str) -> None:
    """A full box has the frozen field; without gravity there is no free flight; nothing is solved."""
    size = own(load().size("fluid", "mini"), placement=placement)
    assert " ".join(floor.name for floor in floors_of(size)) == names
    assert shipped(size) is None


def test_an_analog_needs_all_of_train(
    generated: GenerationResult, unmeasured: Registry, copied: Callable[[], Path]
) -> None:
    """One scenario of train that is missing: the other floors are measured, and scoring works."""
    bench, root = bench_of(generated, unmeasured), copied()
    assert "analog" in measurable(bench.size, root)
    train = root / bench.size.split / bench.size.name / f"v{bench.size.major}" / "train"
    next(iter(sorted(train.glob("*.nc")))).unlink()
    expected = ("persistence", "constant-velocity", "frozen-field")
    assert measurable(bench.size, root) == expected
    shutil.rmtree(train)
    alone = type(bench)(root, bench.registry, bench.size)
    card = alone.evaluate(bench.submit(root / "predictions.nc", straight))
    assert tuple(card.scores) == (SUBMISSION, *expected)
    assert card.skill is not None
