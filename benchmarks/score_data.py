"""A made-up data set of the size of cavity full, and a submission to it.

Rotating discs that differ between scenarios carry the particles, so that fields and
errors are of realistic shape; nothing is learned from the values.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray

from lagbench.data.layout import ScenarioKey, scenario_path
from lagbench.data.registry import Registry, default_path, load
from lagbench.data.writer import ScenarioWriter
from lagbench.data.yamlfile import read_yaml
from lagbench.submission import PredictionsWriter

__all__ = ["ScoreData", "make_score_data", "write_scenario"]

SPEED = 0.0022
"""Per-frame speed of the rotating_disc, as in the cavity [length/frame]."""

Floats32 = NDArray[np.float32]

BOX = (0.0625, 0.875)
"""Lower corner and side of the box [length]."""


LAST_GIVEN = 5  # number of the last given frame


@dataclass(frozen=True)
class ScoreData:
    """The files of the data set and of the submission."""

    root: Path  # folder of all data sets
    registry: Registry  # registry that describes this one
    predictions: Path  # a predictions.nc


def make_score_data(
    folder: Path,
    *,
    horizon: int = 90,
    scenario_count: int | None = None,
    has_shipped_references: bool = True,
) -> ScoreData:
    """Write the test scenarios of 8192 particles and predictions with growing errors.

    Args:
        folder: an empty folder.
        horizon: frames to predict.
        scenario_count: test scenarios; all by default.
        has_shipped_references: claim the hash of the real data set, so that scoring
            finds the shipped scores of the reference predictors, as for a user, and
            measures the submission alone. They exist for a horizon of 90 only.
    """
    size = load().size("cavity", "full")
    scenarios = size.subsets["test"][:scenario_count]
    frames = size.task.input_frames + horizon
    root = folder / "root"
    hashes = {}
    for scenario in scenarios:
        key = ScenarioKey(
            split="cavity",
            size="full",
            version=size.version,
            scenario=scenario,
            subset="test",
        )
        positions = _flow(scenario, frames, size.particles)
        # Positions take the place of velocities, whose values do not matter here.
        flow = ((position, position) for position in positions)
        _, side = BOX
        fluid_mass = 1e-4 * side**2
        hashes[scenario] = write_scenario(
            root,
            key,
            flow,
            particles=size.particles,
            frames=frames,
            particle_mass=fluid_mass / size.particles,
        )
    registry_path = folder / "datasets.yaml"
    _write_registry(
        registry_path,
        horizon=horizon,
        frames=frames,
        hashes=hashes,
        has_shipped_references=has_shipped_references,
    )
    registry = load(registry_path)
    path = folder / "predictions.nc"
    writer = PredictionsWriter(
        path,
        split="cavity",
        size="full",
        method="rotating_disc",
        registry=registry,
    )
    with writer:
        for scenario in scenarios:
            predicted_flow = _flow(scenario, frames, size.particles, error=0.02)
            all_positions = np.stack(list(predicted_flow))
            predicted = all_positions[size.task.input_frames :]
            writer.add(scenario, predicted)
    return ScoreData(root, registry, path)


def _flow(
    scenario: int,
    frames: int,
    particles: int,
    *,
    error: float = 0.0,
) -> Iterator[Floats32]:
    """Yield positions frame by frame; an error makes the discs that much faster."""
    rng = np.random.Generator(np.random.PCG64(scenario))
    low, side = BOX
    high = low + side
    position = low + side * rng.random((particles, 2))
    wave_count = 1 + scenario % 3
    for frame in range(frames):
        yield position.astype(np.float32)
        phase = wave_count * np.pi * (position - low) / side
        phase_x = phase[:, 0]
        phase_y = phase[:, 1]
        velocity_x = np.sin(phase_x) * np.cos(phase_y)
        velocity_y = -np.cos(phase_x) * np.sin(phase_y)
        velocity = np.stack([velocity_x, velocity_y], axis=1)
        speed = SPEED
        if frame >= LAST_GIVEN:
            speed *= 1.0 + error
        position = np.clip(position + speed * velocity, low, high)


def write_scenario(
    root: Path,
    key: ScenarioKey,
    flow: Iterable[tuple[Floats32, Floats32]],
    *,
    particles: int,
    frames: int,
    particle_mass: float = 1e-8,
    wall_velocity: NDArray[np.float64] | None = None,
) -> str:
    """Write a scenario of positions and velocities; return its content hash."""
    writer = ScenarioWriter(
        scenario_path(root, key),
        key,
        particles=particles,
        frames=frames,
        frame_interval=0.1,
        material=np.zeros(particles),
        particle_mass=particle_mass,
        wall_velocity=wall_velocity,
        parameters={"start_frame": 0},
        seed="made up",
        device="cpu",
        generator="benchmarks",
    )
    with writer:
        for position, velocity in flow:
            writer.append(position, velocity)
    return writer.content_sha256


def _write_registry(
    path: Path,
    *,
    horizon: int,
    frames: int,
    hashes: dict[int, str],
    has_shipped_references: bool,
) -> None:
    """Write datasets.yaml with this horizon and the hashes of these scenarios."""
    content = read_yaml(default_path())
    cavity = content["splits"]["cavity"]
    size = cavity["sizes"]["full"]
    size["task"]["horizon"] = horizon
    size["frames"] = frames
    size["subsets"]["test"] = f"{min(hashes)}-{max(hashes)}"
    dataset_sha256 = "0" * 64
    if has_shipped_references:
        dataset_sha256 = content["measured"]["cavity"]["full"]["dataset_sha256"]
    scenario_hashes = {}
    for scenario, digest in hashes.items():
        scenario_hashes[scenario] = digest[:16]
    measured = {
        "dataset_sha256": dataset_sha256,
        "subset_sha256": {},
        "scenario_sha256": scenario_hashes,
        "statistics": {
            "position_std": [0.25, 0.25],
            "velocity_std": [0.0015, 0.0015],
        },
        "twin_floor": [1e-6] * horizon,
    }
    content["measured"] = {"cavity": {"full": measured}}
    path.write_text(yaml.safe_dump(content))
