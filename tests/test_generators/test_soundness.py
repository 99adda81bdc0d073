"""How compressible a free surface was, and how many particles reached a bound."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from lagbench.data.registry import load
from lagbench.generators.constants import solver_constants
from lagbench.generators.soundness import FreeSurfaceSoundness, SoundnessRecorder
from lagbench.generators.split import FreeSurfaceParameters, Material

PLACES = [
    (split, size)
    for split in ("multimaterial", "multimaterial-3d")
    for size in ("tiny", "mini", "full")
]
COUNT = 4000  # particles


def constants(split: str, size: str) -> FreeSurfaceParameters:
    """Return the solver's constants of a data set."""
    parameters = solver_constants(load().size(split, size))
    assert isinstance(parameters, FreeSurfaceParameters)
    return parameters


def summary(
    parameters: FreeSurfaceParameters,
    material: Material,
    least: NDArray[np.float32],
    greatest: NDArray[np.float32],
) -> FreeSurfaceSoundness:
    """Return the summary of particles at rest by their extreme J or Jp."""
    kinds = np.full(len(least), material, np.int8)
    recorder = SoundnessRecorder(parameters, kinds)
    velocity = np.zeros((len(least), 2), np.float32)
    recorder.add(velocity, np.ones(len(least), np.float32))
    return recorder.summary(least, greatest)


def draw_extremes() -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the least and greatest Jp of particles; many are beyond their bounds."""
    rng = np.random.default_rng(5)
    first = rng.uniform(0.05, 1.9, COUNT)
    second = rng.uniform(0.05, 1.9, COUNT)
    least = np.minimum(first, second).astype(np.float32)
    greatest = np.maximum(first, second).astype(np.float32)
    return least, greatest


@pytest.mark.parametrize(("split", "size"), PLACES)
def test_snow_is_counted_where_its_hardening_meets_a_cap(split: str, size: str) -> None:
    """A cap f of the factor exp(xi (1 - Jp)) is met at Jp = 1 - ln(f) / xi."""
    p = constants(split, size)
    least, greatest = draw_extremes()
    stiffest_jp = 1.0 - np.log(p.snow_hardening_max) / p.snow_hardening
    softest_jp = 1.0 - np.log(p.snow_hardening_min) / p.snow_hardening
    is_hard = least <= max(stiffest_jp, p.snow_jp_min)
    is_soft = greatest >= softest_jp
    expected = np.count_nonzero(is_hard | is_soft)
    assert 0 < expected < COUNT
    snow = summary(p, Material.SNOW, least, greatest)
    assert snow.clamped_particles == expected


def test_a_compressed_liquid_is_counted() -> None:
    """At its least J; its greatest has no numerical bound."""
    p = constants("multimaterial", "tiny")
    bound = np.float32(p.jacobian_min)
    least = np.array([bound, bound + 0.1, 1.0], np.float32)
    greatest = np.ones(3, np.float32)
    liquid = summary(p, Material.LIQUID, least, greatest)
    assert liquid.clamped_particles == 1
    assert liquid.liquid_jacobian_min == bound
