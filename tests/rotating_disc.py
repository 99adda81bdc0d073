"""Scenario files of a body in solid-body rotation, for tests of what is drawn."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lagbench.data import registry
from lagbench.data.layout import ScenarioKey, scenario_path
from lagbench.data.writer import ScenarioWriter

OMEGA = 0.05
"""Angular velocity [1/frame]."""

TOP_TO_THE_RIGHT = np.array([[0.0, 0.0], [0.0, 0.0], [0.0, 0.0], [0.125, 0.0]])


def disc(count: int, radius: float) -> NDArray[np.float64]:
    """Points of a sunflower pattern of even density around the middle of the box."""
    k = np.arange(count) + 0.5
    r = radius * np.sqrt(k / count)
    angle = k * np.pi * (3.0 - np.sqrt(5.0))
    return 0.5 + np.stack([r * np.cos(angle), r * np.sin(angle)], axis=-1)


def write_swirl(
    root: Path,
    split: str = "cavity",
    scenario: int = 0,
    *,
    size: str = "tiny",
    frames: int = 6,
    walls: NDArray[np.float64] | None = TOP_TO_THE_RIGHT,
    materials: int = 1,
    parameters: Mapping[str, object] | None = None,
) -> Path:
    """Write a disc of radius 0.4 that turns by OMEGA a frame; return the file's
    path.
    """
    tier = registry.load().size(split, size)
    subset = tier.subset_of(scenario)
    key = ScenarioKey(
        split=split,
        size=size,
        version=tier.version,
        scenario=scenario,
        subset=subset,
    )
    count = tier.particles
    start = disc(count, 0.4) - 0.5
    path = scenario_path(root, key)
    with ScenarioWriter(
        path,
        key,
        particles=count,
        frames=frames,
        frame_interval=tier.frame_interval,
        material=np.arange(count) * materials // count,
        particle_mass=float(tier.value("density")) * np.pi * 0.4**2 / count,
        wall_velocity=walls,
        parameters={"start_frame": 0, **(parameters or {})},
        seed="none",
        device="cpu",
        generator=tier.generator,
        reynolds=None if walls is None else 100.0,
    ) as writer:
        for frame in range(frames):
            c = np.cos(OMEGA * frame)
            s = np.sin(OMEGA * frame)
            x = start @ np.array([[c, s], [-s, c]])
            velocity = (
                OMEGA / tier.frame_interval * np.stack([-x[:, 1], x[:, 0]], axis=-1)
            )
            writer.append((x + 0.5).astype(np.float32), velocity.astype(np.float32))
    return path
