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
    x, y = np.meshgrid(axis, axis, indexing="ij")
    points = np.stack([x, y], axis=-1)
    return points.reshape(-1, 2)


def swirl(position: Floats) -> Floats:
    """Return the Taylor-Green velocity that closes at the walls of the unit box."""
    phase_x, phase_y = np.pi * position.T
    u = np.sin(phase_x) * np.cos(phase_y)
    v = -np.cos(phase_x) * np.sin(phase_y)
    return np.stack([u, v], axis=1)


def rollout(frames: int = 8, side: int = 20, speed: float = 0.01) -> Floats:
    """Return positions carried by the swirl, whose speed wavers, shape [frame,
    particle, 2].
    """
    position = lattice(side)
    positions = [position]
    for frame in range(frames - 1):
        frame_speed = speed * (1 + 0.3 * np.sin(frame))
        position = position + frame_speed * swirl(position)
        positions.append(position)
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
    particle_count = positions.shape[1]
    if material is None:
        material = np.zeros(particle_count)
    config = replace(CONFIG, **changes)
    return Scenario(
        config=config,
        input_positions=positions[: config.input_frames],
        material=np.asarray(material, np.int8),
        particle_mass=1.0 / particle_count,
        area=1.0,
    )


def pairs_of(scenario: Scenario, truth: Floats, prediction: Floats) -> list[FramePair]:
    """Return the frame pairs of whole trajectories; the prediction's given frames are
    not read.
    """
    config = scenario.config
    first = config.input_frames
    true_snapshots = snapshots(scenario, truth[first:])
    predicted_snapshots = snapshots(scenario, prediction[first:])
    pairs = []
    for frame, true, predicted in zip(
        config.predicted_frames, true_snapshots, predicted_snapshots, strict=True
    ):
        pairs.append(FramePair(scenario, frame, true, predicted))
    return pairs


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
    if predicted_position is None:
        predicted_position = position
    x = np.asarray(position, np.float64)
    u = np.asarray(velocity, np.float64)
    y = np.asarray(predicted_position, np.float64)
    v = np.asarray(predicted_velocity, np.float64)
    input_positions = np.stack([x - 2 * u, x - u])
    scenario = scenario_of(input_positions, material=material, **changes)
    truth = scenario.snapshot(x, x - u)
    prediction = scenario.snapshot(y, y - v)
    return FramePair(scenario, 2, truth, prediction)


def measure(pair: FramePair, name: str) -> float:
    """Measure a metric of one pair."""
    return METRICS[name].measure(pair)


def measured(pair: FramePair, *names: str) -> list[float]:
    """Measure metrics of one pair."""
    return [measure(pair, name) for name in names]
