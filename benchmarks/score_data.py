"""A data set of the size of cavity full, and a submission to it, made without
simulating.

Particles are carried by swirls that differ between scenarios, so that fields and errors
are of realistic shape; nothing is learned from the values.
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
"""Per-frame speed of the swirls, as in the cavity [length/frame]."""

BOX = (0.0625, 0.875)
"""Lower corner and side of the box [length]."""


@dataclass(frozen=True)
class ScoreData:
    """Where the data set and the submission are."""

    root: Path  # folder of all data sets
    registry: Registry  # registry that describes this one
    predictions: Path  # a predictions.nc


def make_score_data(folder: Path, *, horizon: int = 90) -> ScoreData:
    """Write the test scenarios of 8192 particles and predictions with growing errors.

    The registry claims the hash of the real data set, so that scoring finds the shipped
    floors, as a user's does, and measures the submission alone.

    Args:
        folder: an empty folder.
        horizon: frames to predict.
    """
    size = load().size("cavity", "full")
    frames = size.task.input_frames + horizon
    root = folder / "root"
    hashes = {}
    for scenario in size.subsets["test"]:
        key = ScenarioKey(
            split="cavity",
            size="full",
            version=size.version,
            scenario=scenario,
            subset="test",
        )
        flow = (
            (position, position) for position in _flow(scenario, frames, size.particles)
        )
        mass = 1e-4 * BOX[1] ** 2 / size.particles
        hashes[scenario] = write_scenario(
            root, key, flow, particles=size.particles, frames=frames, particle_mass=mass
        )
    registry = load(_write_registry(folder / "datasets.yaml", horizon, frames, hashes))
    path = folder / "predictions.nc"
    writer = PredictionsWriter(
        path, split="cavity", size="full", method="swirls", registry=registry
    )
    with writer:
        for scenario in size.subsets["test"]:
            guess = list(_flow(scenario, frames, size.particles, error=0.02))[
                size.task.input_frames :
            ]
            writer.add(scenario, np.stack(guess))
    return ScoreData(root, registry, path)


def _flow(
    scenario: int, frames: int, particles: int, *, error: float = 0.0
) -> Iterator[NDArray[np.float32]]:
    """Yield positions frame by frame; an error makes the swirls faster by that
    share.
    """
    rng = np.random.Generator(np.random.PCG64(scenario))
    low, side = BOX
    x = low + side * rng.random((particles, 2))
    waves = 1 + scenario % 3
    for frame in range(frames):
        yield x.astype(np.float32)
        s = waves * np.pi * (x - low) / side
        u = np.stack(
            [np.sin(s[:, 0]) * np.cos(s[:, 1]), -np.cos(s[:, 0]) * np.sin(s[:, 1])],
            axis=1,
        )
        x = np.clip(
            x + SPEED * (1.0 + (error if frame >= 5 else 0.0)) * u, low, low + side
        )


def write_scenario(
    root: Path,
    key: ScenarioKey,
    flow: Iterable[tuple[NDArray[np.float32], NDArray[np.float32]]],
    *,
    particles: int,
    frames: int,
    particle_mass: float = 1e-8,
    wall_velocity: NDArray[np.float64] | None = None,
) -> str:
    """Write a made-up scenario of positions and velocities, frame by frame; return its
    content hash.
    """
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
    path: Path, horizon: int, frames: int, hashes: dict[int, str]
) -> Path:
    held = read_yaml(default_path())
    size = held["splits"]["cavity"]["sizes"]["full"]
    size["task"]["horizon"] = horizon
    size["frames"] = frames
    held["measured"] = {
        "cavity": {
            "full": {
                "dataset_sha256": held["measured"]["cavity"]["full"]["dataset_sha256"],
                "subset_sha256": {},
                "scenario_sha256": {i: digest[:16] for i, digest in hashes.items()},
                "statistics": {
                    "position_std": [0.25, 0.25],
                    "velocity_std": [0.0015, 0.0015],
                },
                "twin_floor": [1e-6] * horizon,
            }
        }
    }
    path.write_text(yaml.safe_dump(held))
    return path
