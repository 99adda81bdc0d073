"""Trajectories of cavity full's size in our format and in two that others read, without simulating.

Every scenario is a solid-body rotation of random particles at its own speed, so that files
compress as real ones do (to about four fifths) and take seconds to make.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np
import yaml
from numpy.typing import NDArray

from lagbench.data.registry import Registry, default_path, load
from lagbench.data.writer import ScenarioKey, ScenarioWriter, scenario_path
from lagbench.data.yamlfile import read_yaml

__all__ = ["FRAMES", "PARTICLES", "trajectory", "write_gns_npz", "write_lagrangebench_h5", "write_ours"]

FRAMES, PARTICLES = 600, 8192
"""Size of one scenario of cavity full."""

RADIUS = 0.43
"""Particles fill a disc of this radius about the centre of the box [length]."""

Frames = NDArray[np.float32]


def trajectory(scenario: int) -> Frames:
    """Return positions [length], shape [frame, particle, 2]."""
    return np.stack(list(_rotation(scenario)))


def _rotation(scenario: int) -> Iterator[Frames]:
    rng = np.random.Generator(np.random.PCG64(scenario))
    distance = RADIUS * np.sqrt(rng.random(PARTICLES))
    angle = 2.0 * np.pi * rng.random(PARTICLES)
    for frame in range(FRAMES):
        turned = angle + 0.005 * (1 + scenario % 5) * frame
        x = 0.5 + distance * np.cos(turned)
        yield np.stack([x, 0.5 + distance * np.sin(turned)], axis=1).astype(np.float32)


def write_ours(root: Path, scenarios: int) -> Registry:
    """Write the train subset as lagbench does; return the registry that describes it."""
    held = read_yaml(default_path())
    size = held["splits"]["cavity"]["sizes"]["full"]
    size["subsets"] = {"train": f"0-{scenarios - 1}", "valid": f"{scenarios}", "test": f"{scenarios + 1}"}
    held["measured"] = {}
    path = root / "datasets.yaml"
    path.write_text(yaml.safe_dump(held))
    registry = load(path)
    version = registry.split("cavity").version
    for i in range(scenarios):
        key = ScenarioKey(split="cavity", size="full", version=version, scenario=i, subset="train")
        _write_scenario(scenario_path(root, key), key)
    return registry


def _write_scenario(path: Path, key: ScenarioKey) -> None:
    still = np.zeros((PARTICLES, 2), np.float32)
    writer = ScenarioWriter(
        path,
        key,
        particles=PARTICLES,
        frames=FRAMES,
        frame_interval=0.1,
        material=np.zeros(PARTICLES),
        particle_mass=1e-8,
        wall_velocity=np.zeros((4, 2)),
        parameters={"start_frame": 0},
        seed="made up",
        device="cpu",
        generator="benchmarks",
    )
    with writer:
        for position in _rotation(key.scenario):
            writer.append(position, still)


def write_gns_npz(path: Path, scenarios: int) -> None:
    """Write what geoelements/gns loads into memory: one array per trajectory."""
    arrays = {f"simulation_trajectory_{i}": trajectory(i) for i in range(scenarios)}
    np.savez_compressed(path, **arrays)  # type: ignore[arg-type]


def write_lagrangebench_h5(path: Path, scenarios: int) -> None:
    """Write what LagrangeBench reads: a group per trajectory, gzip in the chunks that h5py guesses."""
    with h5py.File(path, "w") as file:
        for i in range(scenarios):
            file.create_dataset(f"{i:05d}/particle_type", data=np.zeros(PARTICLES, np.int64))
            file.create_dataset(f"{i:05d}/position", data=trajectory(i), compression="gzip")
