"""Particles in motion: the frame of a loss, the state of a rollout, the step between two."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import torch
from torch import Tensor

__all__ = ["Motion", "State", "integrate"]


class Motion(NamedTuple):
    """One frame of particles.

    Attributes:
        position: x(f) [length], shape [particle, 2].
        velocity: x(f) - x(f-1) [length/frame], shape [particle, 2].
        acceleration: velocity less that of the frame before, in target and prediction the same
            frame, which is the model's input [length/frame^2], shape [particle, 2].
    """

    position: Tensor
    velocity: Tensor
    acceleration: Tensor


@dataclass(frozen=True, kw_only=True)
class State:
    """What a step starts from.

    Attributes:
        position: last positions [length], shape [particle, 2].
        velocity: last velocities, oldest first [length/frame], shape [particle, 5, 2].
        material: material of each particle, int64, shape [particle].
        sample: window of each particle, ascending, int64, shape [particle].
        wall_velocity: velocity of the walls in the last given frame, as each particle sees them
            [length/frame], shape [particle, 4, 2]; None where walls rest or do not matter.
    """

    position: Tensor
    velocity: Tensor
    material: Tensor
    sample: Tensor
    wall_velocity: Tensor | None

    def moved(self, position: Tensor, velocity: Tensor) -> Self:
        """Return the state one frame on."""
        last = torch.cat([self.velocity[:, 1:], velocity.unsqueeze(1)], dim=1)
        return replace(self, position=position, velocity=last)


def integrate(position: Tensor, velocity: Tensor, acceleration: Tensor) -> tuple[Tensor, Tensor]:
    """Advance by semi-implicit Euler: ``v' = v + a, x' = x + v'``, time in frames.

    Args:
        position: x [length], shape [particle, 2].
        velocity: v [length/frame], shape [particle, 2].
        acceleration: a [length/frame^2], shape [particle, 2].

    Returns:
        x' and v'.
    """
    velocity = velocity + acceleration
    return position + velocity, velocity
