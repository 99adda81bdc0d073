"""Data made here have the hashes of datasets.yaml: the promise of
docs/determinism.md.
"""

from collections.abc import Callable
from pathlib import Path

import pytest
from turns import of_this_turn, turn

from lagbench.data.manifest import read_manifest
from lagbench.data.registry import load
from lagbench.make.generate import GenerationResult, generate
from lagbench.make.verify import verify

SPLITS = tuple(load().splits)

# Each compiles kernels of its own, which takes seconds.
OWN_KERNELS = (
    "decaying-vortices",
    "poiseuille",
    "curl-noise-3d",
    "cavity-3d",
    "fluid-3d",
    "multimaterial-3d",
    "cylinder",
)
OF_THIS_TURN = (
    *(name for name in SPLITS if name not in OWN_KERNELS),
    *of_this_turn(OWN_KERNELS, turns=len(OWN_KERNELS)),
)


@pytest.mark.parametrize("split", OF_THIS_TURN)
def test_tiny_is_made_to_the_bit(
    split: str, tiny_split: Callable[..., GenerationResult]
) -> None:
    """All of tiny: scenario, subset and data set hashes, statistics and limit."""
    size = load().size(split, "tiny")
    measured = size.measured
    assert measured is not None
    result = tiny_split(split)
    assert result.dataset_sha256 == measured.dataset_sha256
    manifest = read_manifest(result.root, split, "tiny", size.major)
    assert manifest is not None
    assert manifest.subset_sha256 == measured.subset_sha256
    for name, row in measured.statistics.items():
        assert tuple(manifest.statistics[name]) == row
    assert manifest.mean_twin_floor() == measured.twin_floor
    verified = verify(split, "tiny", root=result.root, complete=True)
    verified.check()
    assert verified.warnings == ()


@pytest.mark.slow
@pytest.mark.parametrize("split", of_this_turn(SPLITS, turns=4))
def test_one_scenario_is_made_to_the_bit(split: str, tmp_path: Path) -> None:
    """One scenario, of mini or of full, another one after every commit."""
    names = [name for name in ("mini", "full") if name in load().split(split).sizes]
    if not names:
        pytest.skip(f"{split} has neither mini nor full")
    name = names[(turn() + SPLITS.index(split)) % len(names)]
    size = load().size(split, name)
    if size.measured is None:
        pytest.skip(f"no hash of {split} {name} is recorded")
    scenario = size.scenarios[turn() // 2 % len(size.scenarios)]
    result = generate(split, name, scenarios=(scenario,), root=tmp_path)
    assert result.simulated == (scenario,)
    assert result.verdict == "what is there is equal to datasets.yaml"
