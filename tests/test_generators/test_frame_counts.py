"""The frame counts of fluid full follow the rule that datasets.yaml states."""

import random
from pathlib import Path

import numpy as np
import pytest
from turns import turn

from lagbench.data.registry import Size, load
from lagbench.generators.batch import ScenarioBatch, SimulationJob
from lagbench.generators.split import Device

FIXED = (0, 26)


def _share_left(size: Size, scenario: int) -> float:
    """Return the mean kinetic energy over frames 270-299 over the greatest of any
    frame.
    """
    job = SimulationJob(
        size=size,
        scenarios=(scenario,),
        root=Path("unused"),
        device=Device.CPU,
    )
    batch = ScenarioBatch(job, lambda _: None, frames=[300])
    energy = []
    for i, _ in batch.recordings():
        velocity = batch.frame(i)[1].astype(np.float64)
        energy.append(np.sum(velocity**2))
    last = np.mean(energy[270:])
    return float(last / max(energy))


def test_counts_sum_to_the_thesis() -> None:
    """19,200 frames in the first 40 scenarios (§4.3), 600 each in scenarios 0 and 26
    (Table 4.8).
    """
    size = load().size("fluid", "full")
    counts = [size.frame_count(i) for i in range(40)]
    fixed_counts = [size.frame_count(i) for i in FIXED]
    assert sum(counts) == 19_200
    assert fixed_counts == [600, 600]


@pytest.mark.slow
def test_longer_scenarios_are_those_that_still_move() -> None:
    """More frames never go with a smaller share of kinetic energy left; a fifth of
    train in turn.
    """
    size = load().size("fluid", "full")
    free = [i for i in size.subsets["train"] if i not in FIXED]
    # other neighbours at every turn
    generator = random.Random(turn())
    judged = generator.sample(free, len(free) // 5)

    def share_left(scenario: int) -> float:
        return _share_left(size, scenario)

    ranked = sorted(judged, key=share_left, reverse=True)
    counts = [size.frame_count(i) for i in ranked]
    assert counts == sorted(counts, reverse=True)
