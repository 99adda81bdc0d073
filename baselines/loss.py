"""Loss of a predicted frame: six terms of motion, density and flow (thesis Eqs. 5.29-5.35).

All terms are in normalised units, as in the thesis: accelerations, velocities and positions
over their deviations in train; the grid's velocities too, so that vorticity and divergence
have the unit 1/length; density over that around a particle. Weights are applied by the trainer.
Rollouts share the state and the step between two frames.
"""

from __future__ import annotations

import enum
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import torch
from torch import Tensor

from lagbench.data.grid import Grid

from .torch_grid import Fields, counted_nodes, fields, node_velocity, transfer

__all__ = ["LossNorm", "Motion", "Scales", "State", "integrate", "loss_terms"]


class Motion(NamedTuple):
    """One frame of particles."""

    position: Tensor  # x(f) [length], shape [particle, 2]
    velocity: Tensor  # x(f) - x(f-1) [length/frame], shape [particle, 2]
    # velocity less that of the frame before, in target and prediction the same frame, which is the model's
    # input [length/frame^2], shape [particle, 2]
    acceleration: Tensor


@dataclass(frozen=True, kw_only=True)
class State:
    """What a step starts from."""

    position: Tensor  # last positions [length], shape [particle, 2]
    velocity: Tensor  # last velocities, oldest first [length/frame], shape [particle, velocities, 2]
    material: Tensor  # material of each particle, int64, shape [particle]
    sample: Tensor  # window of each particle, ascending, int64, shape [particle]
    # velocity of the walls in the coming frames, the next one first [length/frame], shape
    # [window, frame, 4, 2]; beyond them the last one stays. None where walls rest or do not matter.
    wall_velocity: Tensor | None

    def moved(self, position: Tensor, velocity: Tensor) -> Self:
        """Return the state one frame on."""
        last = torch.cat([self.velocity[:, 1:], velocity.unsqueeze(1)], dim=1)
        walls = self.wall_velocity
        if walls is not None and walls.shape[1] > 1:
            walls = walls[:, 1:]
        return replace(self, position=position, velocity=last, wall_velocity=walls)


def integrate(position: Tensor, velocity: Tensor, acceleration: Tensor) -> tuple[Tensor, Tensor]:
    """Return x' and v' after a step of semi-implicit Euler: ``v' = v + a, x' = x + v'``, time in frames."""
    velocity = velocity + acceleration
    return position + velocity, velocity


PARTICLE_TERMS = ("acceleration", "velocity", "position")
GRID_TERMS = ("density", "divergence", "vorticity")
TERMS = PARTICLE_TERMS + GRID_TERMS  # the terms of Eq. 5.35, in its order but for positions


class LossNorm(enum.StrEnum):
    """The p of the norms: L2 is the squared error, L1 the absolute one."""

    L1 = "l1"
    L2 = "l2"


class Scales(NamedTuple):
    """Deviations that errors are divided by, (x, y) each, shape [2]; named as in :class:`Motion`."""

    position: Tensor
    velocity: Tensor
    acceleration: Tensor

    @property
    def speed(self) -> Tensor:
        """Root mean square of the velocity's two deviations [length/frame], shape []."""
        return (self.velocity**2).mean().sqrt()


def mean_norm(error: Tensor, norm: LossNorm, count: Tensor | int | None = None) -> Tensor:
    """Return ``(1/N) sum_i ||e_i||_p`` of normalised errors, shape [..., component] (Eqs. 5.29-5.34).

    0 is perfect; N counts particles or nodes, by default those of the array.
    """
    each = error**2 if norm is LossNorm.L2 else error.abs()
    return each.sum() / (each[..., 0].numel() if count is None else count)


def loss_terms(
    predicted: Motion,
    target: Motion,
    sample: Tensor,
    *,
    grid: Grid,
    scales: Scales,
    norm: LossNorm,
    weights: Mapping[str, float],
) -> dict[str, Tensor]:
    """Return the six terms, raw; those of weight 0 without a graph. Missing weights are 1."""
    terms = {}
    for name in PARTICLE_TERMS:
        with _graph(weights, name):
            error = getattr(predicted, name) - getattr(target, name)
            terms[name] = mean_norm(error / getattr(scales, name), norm)
    windows = int(sample[-1]) + 1
    with torch.no_grad():
        sums = transfer(target.position, target.velocity, grid, sample=sample, windows=windows)
        # A node's weight around a particle, on the average: the full weight of a box that is full,
        # and defined for a splash too, whose area is not known here.
        full = float((sums.weight**2).sum() / sums.weight.sum())
        velocity = node_velocity(sums, full)
        true = Fields(grid, sums.weight, velocity, counted_nodes(sums.weight, full), full)
    with _graph(weights, *GRID_TERMS):  # the prediction's fields at the nodes that count in the truth
        own = fields(
            predicted.position,
            predicted.velocity,
            grid,
            full=full,
            sample=sample,
            windows=windows,
            counted=true.counted,
        )
    with _graph(weights, "density"):
        terms["density"] = mean_norm((own.density - true.density).unsqueeze(-1), norm)
    count = true.differentiable.sum().clamp(min=1)
    for name in ("divergence", "vorticity"):
        with _graph(weights, name):
            error = (getattr(own, name) - getattr(true, name)) / scales.speed
            terms[name] = mean_norm(error.unsqueeze(-1), norm, count)
    return terms


def _graph(weights: Mapping[str, float], *names: str) -> torch.set_grad_enabled:
    """Record a graph only if one is recorded at all and one of the terms counts."""
    counts = any(weights.get(name, 1.0) != 0.0 for name in names)
    return torch.set_grad_enabled(torch.is_grad_enabled() and counts)
