"""Small particle flows that the tests of the graph networks share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from lagbench.baselines.baseline import Batch, Facts
from lagbench.baselines.loss import State
from lagbench.baselines.operators.gns import GNS
from lagbench.baselines.simulator import GraphNetwork

RADIUS = 0.0625
"""A power of two: distances over it round nowhere."""

SMALL: dict[str, object] = {"latent": 16, "layers": 2, "noise_std": 0.0}
"""Options of a network that runs in milliseconds."""


def facts(**changes: object) -> Facts:
    """Return the figures of a box of 256 particles whose statistics have no mean."""
    plain = Facts(
        split="cavity",
        size="tiny",
        version="1.0.0",
        dataset_sha256="0" * 64,
        particles=256,
        bounds=((0.0625, 0.9375), (0.0625, 0.9375)),
        radius=RADIUS,
        input_frames=6,
        horizon=20,
        score_cells=10,
        score_placement="cell_centres",
        frame_interval=0.5,
        moving_walls=True,
        statistics={
            "position_mean": (0.5, 0.5),
            "position_std": (0.25, 0.3),
            "velocity_mean": (0.0, 0.0),
            "velocity_std": (0.004, 0.003),
            "acceleration_mean": (0.0, 0.0),
            "acceleration_std": (0.0002, 0.0001),
        },
    )
    return replace(plain, **changes)  # type: ignore[arg-type]


def batch(*windows: NDArray[np.float64] | NDArray[np.float32], walls: bool = False) -> Batch:
    """Return windows of shape [frame, particle, 2] side by side; walls slide at 0.01 to 0.08 if asked."""
    frames = len(windows[0])
    wall = torch.arange(1.0, 9.0).reshape(4, 2) / 100.0
    return Batch(
        position=torch.cat([torch.from_numpy(w.astype(np.float32)).transpose(0, 1) for w in windows]),
        sample=torch.repeat_interleave(
            torch.arange(len(windows)), torch.tensor([w.shape[1] for w in windows])
        ),
        material=torch.cat([torch.arange(w.shape[1]) % 4 for w in windows]),
        wall_velocity=wall.expand(len(windows), frames, 4, 2).clone() if walls else None,
        scenario=torch.arange(len(windows)),
        frame=torch.zeros(len(windows), dtype=torch.int64),
    )


def jittered(seed: int, side: int = 16, low: float = 0.0625, high: float = 0.9375) -> NDArray[np.float64]:
    """Return a jittered lattice of side^2 particles in a square, shape [particle, 2]."""
    rng = np.random.default_rng(seed)
    spacing = (high - low) / side
    axis = low + (np.arange(side) + 0.5) * spacing
    lattice = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    return lattice + rng.uniform(-0.3, 0.3, lattice.shape) * spacing


def swirl(seed: int, frames: int, speeds: Sequence[float] = (0.05, -0.03)) -> NDArray[np.float64]:
    """Return particles on circles about the middle, turning ever faster or slower.

    Args:
        seed: seed of the first positions.
        frames: frames F.
        speeds: angle per frame at first and at last.

    Returns:
        Positions, shape [F, particle, 2].
    """
    arm = jittered(seed) - 0.5
    arm *= 0.6  # the corners' circles stay in the box
    angle = np.linspace(*speeds, frames).cumsum()
    turn = np.stack([np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)], axis=-1)
    return 0.5 + np.einsum("fij,pj->fpi", turn.reshape(-1, 2, 2), arm)


def network(*, awake: bool = False, changes: Mapping[str, object] | None = None, **options: object) -> Any:
    """Return a small GNS in float32; awake ones have a decoder that is not zero."""
    torch.manual_seed(0)
    model = GraphNetwork.with_operator(GNS).build(SMALL | options, facts(**(changes or {})))
    if awake:
        torch.nn.init.normal_(model.network.decoder[-1].weight, std=0.1)
        torch.nn.init.normal_(model.network.decoder[-1].bias, std=0.1)
    return model


def rolled(model: Any, given: Batch, frames: int) -> torch.Tensor:
    """Return a rollout's positions, shape [particle, frame, 2]."""
    state, found = model.start(given), []
    with torch.no_grad():
        for _ in range(frames):
            state, position = model.advance(state)
            found.append(position)
    return torch.stack(found, dim=1)


def oracle(truth: torch.Tensor, target: str, **options: object) -> Any:
    """Return a simulator whose network is replaced by the truth, standardised, frame after frame.

    Args:
        truth: true positions in float64, shape [particle, frame, 2]; six are given.
        target: acceleration or velocity.
        options: further options.
    """
    velocity = truth.diff(dim=1)
    exact = {"velocity": velocity[:, 5:], "acceleration": velocity.diff(dim=1)[:, 4:]}[target]

    class Oracle(GraphNetwork):
        operator, method = GNS, "oracle"
        frame = 0

        def predict(self, state: State, *_: object) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
            scale = getattr(self, target)
            self.frame += 1
            return scale(exact[:, self.frame - 1].float()).to(state.position.dtype), {}

    means = {"velocity_mean": (1e-3, -2e-3), "acceleration_mean": (1e-5, 2e-5)}
    shifted = facts(statistics=dict(facts().statistics) | means)
    return Oracle.build(SMALL | {"target": target} | options, shifted)
