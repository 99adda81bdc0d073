"""What a generation will take, for orientation."""

from __future__ import annotations

import pytest

from lagbench.data.registry import load
from lagbench.generators.batch import perturbed_substep_count, substep_count
from lagbench.make import plan
from lagbench.make.plan import estimate


def test_perturbed_runs_of_test_scenarios_are_counted() -> None:
    """What generating simulates: every substep of scenarios and of perturbed runs,
    which end with the horizon.
    """
    size = load().size("cavity", "mini")
    test = size.subsets["test"]
    perturbed = 0
    plain = 0
    frames = 0
    for scenario in test:
        perturbed += perturbed_substep_count(size, scenario)
        plain += substep_count(size, scenario)
        frames += size.frame_count(scenario)
        frames += size.task.input_frames + size.task.horizon
    assert perturbed < plain
    particle_substeps = (plain + perturbed) * size.particles * size.refinement**2
    expected = particle_substeps * plan.PARTICLE_SUBSTEP_SECONDS[2]
    expected += frames * plan.FRAME_SECONDS
    assert estimate(size, test).core_seconds == pytest.approx(expected)
