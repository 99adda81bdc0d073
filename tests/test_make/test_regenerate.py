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

# Each compiles kernels of its own, which takes up to 20 seconds.
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
    *(
        pytest.param(name, marks=pytest.mark.slow)
        for name in of_this_turn(OWN_KERNELS, turns=len(OWN_KERNELS))
    ),
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


TURNS = 8


def recorded_sizes() -> list[tuple[str, str]]:
    """Return splits and their sizes beyond tiny whose hashes are recorded.

    Those of three dimensions stand side by side: each turn gets its share of the long
    ones.
    """
    pairs = []
    for split in SPLITS:
        for name in load().split(split).sizes:
            is_recorded = load().size(split, name).measured is not None
            if name != "tiny" and is_recorded:
                pairs.append((split, name))
    return sorted(pairs, key=lambda pair: load().size(*pair).dimension)


@pytest.mark.slow
@pytest.mark.parametrize(("split", "name"), of_this_turn(recorded_sizes(), turns=TURNS))
def test_one_scenario_is_made_to_the_bit(split: str, name: str, tmp_path: Path) -> None:
    """One scenario of an eighth of all data sets; the turn picks both."""
    size = load().size(split, name)
    scenario = size.scenarios[turn() // TURNS % len(size.scenarios)]
    result = generate(split, name, scenarios=(scenario,), root=tmp_path)
    assert result.simulated == (scenario,)
    assert result.verdict.endswith("equal to datasets.yaml")
