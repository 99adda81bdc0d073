"""Small cases for models of whole frames: facts, batches, and motions they can learn."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lagbench.baselines.baseline import Baseline, Batch, Facts

Floats = NDArray[np.float32]

TURN = 0.1
"""Angle that :func:`rotations` turn by per frame [rad]."""


def facts_of(scenarios: Sequence[Floats]) -> Facts:
    """Return facts whose statistics are those of some scenarios of shape [frame, particle, 2]."""
    statistics = {}
    for name, order in (("position", 0), ("velocity", 1), ("acceleration", 2)):
        values = np.concatenate([np.diff(x.astype(float), order, axis=0).reshape(-1, 2) for x in scenarios])
        statistics[f"{name}_mean"] = pair(values.mean(axis=0))
        statistics[f"{name}_std"] = pair(values.std(axis=0))
    return Facts(
        split="fluid",
        size="tiny",
        version="1.0.0",
        dataset_sha256="0" * 64,
        particles=scenarios[0].shape[1],
        bounds=((0.0, 1.0), (0.0, 1.0)),
        radius=0.1,
        input_frames=2,
        horizon=20,
        score_cells=8,
        score_placement="cell_centres",
        frame_interval=1.0,
        moving_walls=False,
        statistics=statistics,
    )


def pair(values: NDArray[np.float64]) -> tuple[float, float]:
    """Return two numbers as Facts hold them."""
    return float(values[0]), float(values[1])


def batch_of(windows: Sequence[Floats], material: Sequence[int] | None = None) -> Batch:
    """Put windows of shape [frame, particle, 2] side by side; materials repeat in every window."""
    particles = [window.shape[1] for window in windows]
    rows = torch.cat([torch.from_numpy(np.ascontiguousarray(w.swapaxes(0, 1))) for w in windows])
    each = torch.zeros(particles[0], dtype=torch.int64) if material is None else torch.tensor(material)
    return Batch(
        position=rows,
        sample=torch.arange(len(windows)).repeat_interleave(torch.tensor(particles)),
        material=each.repeat(len(windows))
        if material is not None
        else torch.zeros(len(rows), dtype=torch.int64),
        wall_velocity=None,
        scenario=torch.arange(len(windows)),
        frame=torch.zeros(len(windows), dtype=torch.int64),
    )


def rotations(scenarios: int, *, frames: int = 40, particles: int = 12, seed: int = 0) -> list[Floats]:
    """Return one lopsided cloud that turns about the centre of the box, from other angles."""
    rng = np.random.default_rng(seed)
    cloud = np.array([0.25, 0.0]) + rng.normal(0.0, 0.06, (particles, 2))
    angle = rng.uniform(0.0, 2 * np.pi, scenarios)[:, None] + TURN * np.arange(frames)
    c, s = np.cos(angle), np.sin(angle)
    turn = np.stack([np.stack([c, s], -1), np.stack([-s, c], -1)], -2)
    return list((0.5 + np.einsum("pi,sfij->sfpj", cloud, turn)).astype(np.float32))


def train(model: Baseline, scenarios: Sequence[Floats], *, steps: int, batch: int = 32) -> None:
    """Take Adam steps on random windows, as little as it needs."""
    rng, length = np.random.default_rng(0), model.history + model.future
    generator = torch.Generator().manual_seed(0)
    optimiser = torch.optim.Adam(model.parameters(), lr=3e-3)
    falling = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    for _ in range(steps):
        picks = [
            (int(rng.integers(len(scenarios))), int(rng.integers(len(scenarios[0]) - length + 1)))
            for _ in range(batch)
        ]
        terms = model(batch_of([scenarios[s][f : f + length] for s, f in picks]), generator)
        loss = sum((model.weights.get(name, 1.0) * term for name, term in terms.items()), torch.zeros(()))
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        falling.step()


def rollout(model: Baseline, given: Batch, frames: int) -> Tensor:
    """Return predicted positions, shape [particle, frame, 2]."""
    state: Any = model.eval().start(given)
    predicted = []
    with torch.no_grad():
        for _ in range(frames):
            state, position = model.advance(state)
            predicted.append(position)
    return torch.stack(predicted, dim=1)


def share_of_persistence(model: Baseline, scenario: Floats, *, frames: int, given: int = 2) -> float:
    """Return the rollout's squared error over that of standing still, both in positions."""
    truth = torch.from_numpy(scenario[given : given + frames].swapaxes(0, 1).copy())
    start = batch_of([scenario[:given]])
    still = (truth - start.position[:, -1:]).square().mean()
    return float((rollout(model, start, frames) - truth).square().mean() / still)


def counted(widths: Sequence[int]) -> int:
    """Return the parameters of dense layers with biases, by hand."""
    return sum(before * after + after for before, after in pairwise(widths))
