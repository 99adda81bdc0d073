"""Small scenario files and data sets with made-up values, for tests of everything
around them.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lagbench.data.layout import ScenarioKey, scenario_path
from lagbench.data.writer import ScenarioWriter

PARAMETERS = {"dt": 0.002, "grid": 16, "start_frame": 2, "wall_moving": "top"}

DIMS = {
    "frame": ("frame",),
    "time": ("frame",),
    "particle": ("particle",),
    "space": ("space",),
    "wall": ("wall",),
    "position": ("frame", "particle", "space"),
    "velocity": ("frame", "particle", "space"),
    "material": ("particle",),
    "particle_mass": (),
    "wall_velocity": ("frame", "wall", "space"),
}
"""Dimensions of every variable of a closed-box file."""


def make_key(
    scenario: int = 3,
    *,
    split: str = "cavity",
    size: str = "tiny",
    subset: str = "test",
    version: str = "2.2.0",
) -> ScenarioKey:
    """Return the key of a cavity tiny scenario unless told otherwise."""
    return ScenarioKey(
        split=split, size=size, version=version, scenario=scenario, subset=subset
    )


def frames_of(scenario: int, frames: int, particles: int) -> NDArray[np.float32]:
    """Positions that move by less than 0.01 a frame, shape [frame, particle, 2]."""
    rng = np.random.Generator(np.random.PCG64(scenario))
    start = 0.1 + 0.8 * rng.random((1, particles, 2))
    steps = 0.01 * (rng.random((frames, particles, 2)) - 0.5)
    return (start + np.cumsum(steps, axis=0)).astype(np.float32)


def write_scenario(
    root: Path,
    key: ScenarioKey,
    *,
    frames: int = 4,
    particles: int = 8,
    walls: bool = True,
    parameters: Mapping[str, object] = PARAMETERS,
    seed: str = "PCG64(SeedSequence([1, 1, 3]))",
    facts: Mapping[str, float] | None = None,
) -> tuple[Path, str]:
    """Write one scenario; return its path and content hash."""
    path = scenario_path(root, key)
    positions = frames_of(key.scenario, frames, particles)
    with ScenarioWriter(
        path,
        key,
        particles=particles,
        frames=frames,
        frame_interval=0.1,
        material=np.arange(particles) % 4,
        particle_mass=1e-4 / particles,
        wall_velocity=np.array([[0, 0], [0, 0], [0, 0], [0.125, 0]]) if walls else None,
        parameters=parameters,
        seed=seed,
        device="cpu",
        generator="lagbench.generators.cavity",
        reynolds=100.0 if walls else None,
    ) as writer:
        for position in positions:
            writer.append(position, -position)
        if facts is not None:
            writer.state_facts(facts)
    return path, writer.content_sha256
