"""Small flows with closed forms that the tests of the metrics share."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lagbench.data.grid import Grid
from lagbench.metrics import METRICS, FramePair, Scenario, TaskConfig, snapshots

Floats = NDArray[np.float64]

CONFIG = TaskConfig(
    grid=Grid(10),
    input_frames=2,
    horizon=6,
    frames_of_interest=(3, 5),
    attribute_std=(0.3, 0.3, 0.01, 0.01),
    radius=0.075,
)
"""Ten cells across, two frames given, six predicted."""


def lattice(side: int = 20) -> Floats:
    """Fill the unit box with side x side particles."""
    axis = (np.arange(side) + 0.5) / side
    return np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)


def swirl(position: Floats) -> Floats:
    """Return the Taylor-Green velocity that closes at the walls of the unit box."""
    s = np.pi * position
    return np.stack(
        [np.sin(s[:, 0]) * np.cos(s[:, 1]), -np.cos(s[:, 0]) * np.sin(s[:, 1])], axis=1
    )


def rollout(frames: int = 8, side: int = 20, speed: float = 0.01) -> Floats:
    """Return positions carried by the swirl, whose speed wavers, shape [frame,
    particle, 2].
    """
    positions = [lattice(side)]
    for frame in range(frames - 1):
        positions.append(
            positions[-1] + speed * (1 + 0.3 * np.sin(frame)) * swirl(positions[-1])
        )
    return np.array(positions)


def scenario_of(
    positions: Floats,
    *,
    material: ArrayLike | None = None,
    **changes: Any,
) -> Scenario:
    """Return the scenario whose given frames are the first two; ``changes`` go to the
    config.
    """
    kinds = (
        np.zeros(positions.shape[1], np.int8)
        if material is None
        else np.asarray(material, np.int8)
    )
    config = replace(CONFIG, **changes)
    return Scenario(
        config=config,
        input_positions=positions[: config.input_frames],
        material=kinds,
        particle_mass=1.0 / positions.shape[1],
        area=1.0,
    )


def pairs_of(scenario: Scenario, truth: Floats, prediction: Floats) -> list[FramePair]:
    """Return the frame pairs of whole trajectories; the prediction's given frames are
    not read.
    """
    first = scenario.config.input_frames
    sides = (
        snapshots(scenario, positions[first:]) for positions in (truth, prediction)
    )
    numbered = zip(scenario.config.predicted_frames, *sides, strict=True)
    return [FramePair(scenario, frame, t, p) for frame, t, p in numbered]


def pair_of(
    position: ArrayLike,
    velocity: ArrayLike,
    predicted_velocity: ArrayLike,
    *,
    predicted_position: ArrayLike | None = None,
    material: ArrayLike | None = None,
    **changes: Any,
) -> FramePair:
    """Return one frame pair with these velocities u = x(f) - x(f-1), at frame 2.

    The mass of each particle is 1 / particles.
    """
    x = np.asarray(position, np.float64)
    u = np.asarray(velocity, np.float64)
    y = x if predicted_position is None else np.asarray(predicted_position, np.float64)
    scenario = scenario_of(np.stack([x - 2 * u, x - u]), material=material, **changes)
    predicted = scenario.snapshot(y, y - np.asarray(predicted_velocity, np.float64))
    return FramePair(scenario, 2, scenario.snapshot(x, x - u), predicted)


def measured(pair: FramePair, *names: str) -> list[float]:
    """Measure metrics of one pair."""
    return [METRICS[name].measure(pair) for name in names]
