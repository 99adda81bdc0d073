"""Windows of trajectories side by side: what every baseline is trained on and rolled out from."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Self

import torch
from torch import Tensor

__all__ = ["Batch"]


@dataclass(frozen=True, kw_only=True)
class Batch:
    """Several windows of consecutive frames, their particles in one row.

    Attributes:
        position: particle positions [length], float32, shape [particle, frame, 2].
        sample: window that each particle belongs to, ascending, int64, shape [particle].
        material: 0 liquid, 1 jelly, 2 snow, 3 rope, int64, shape [particle].
        wall_velocity: velocity of the walls over the frames of the windows [length/s], shape
            [window, frame, wall, 2]; None in a split without moving walls.
        scenario: scenario id of each window, int64, shape [window].
        frame: absolute number of each window's first frame, int64, shape [window].
    """

    position: Tensor
    sample: Tensor
    material: Tensor
    wall_velocity: Tensor | None
    scenario: Tensor
    frame: Tensor

    @property
    def windows(self) -> int:
        """Windows in the batch."""
        return len(self.scenario)

    @property
    def frames(self) -> int:
        """Frames in every window."""
        return self.position.shape[1]

    def part(self, frames: slice) -> Self:
        """Return some frames of every window; `frame` follows."""
        first = range(self.frames)[frames][0]
        walls = None if self.wall_velocity is None else self.wall_velocity[:, frames]
        return replace(self, position=self.position[:, frames], wall_velocity=walls, frame=self.frame + first)

    def to(self, device: torch.device | str) -> Self:
        """Return the batch on a device."""
        moved = {
            field.name: value.to(device)
            for field in fields(self)
            if isinstance(value := getattr(self, field.name), Tensor)
        }
        return replace(self, **moved)
