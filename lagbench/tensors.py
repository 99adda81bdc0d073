"""Windows of consecutive frames as tensors: one, and several side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Self

import torch
from torch import Tensor

from lagbench.errors import UsageError


class Window(NamedTuple):
    """Consecutive frames of one scenario."""

    position: Tensor  # particle positions [length], float32, shape [particle, frame, 2]
    material: Tensor  # 0 liquid, 1 jelly, 2 snow, 3 rope, int64, shape [particle]
    # velocity of the walls [length/s], float32, shape [frame, wall, 2], of these frames
    # and perhaps of later ones; None in a split without moving walls
    wall_velocity: Tensor | None
    scenario: int  # scenario id
    frame: int  # absolute number of the first frame
    # particle positions in the scenario's first frame [length], shape [particle, 2];
    # None unless asked for
    origin: Tensor | None = None


@dataclass(frozen=True, kw_only=True)
class Batch:
    """Several windows of consecutive frames, their particles in one row."""

    position: Tensor  # particle positions [length], float32, shape [particle, frame, 2]
    # window that each particle belongs to, ascending, int64, shape [particle]
    sample: Tensor
    material: Tensor  # 0 liquid, 1 jelly, 2 snow, 3 rope, int64, shape [particle]
    # what acts on the way to each frame of the windows, and to those after them as far
    # as it is known: the forcing of a scenario is given for all frames. Velocity of the
    # walls [length/s], shape [window, frame, wall, 2]; None in a split without moving
    # walls.
    wall_velocity: Tensor | None
    scenario: Tensor  # scenario id of each window, int64, shape [window]
    frame: Tensor  # absolute number of each window's first frame, int64, shape [window]
    # particle positions in the scenario's first frame [length], shape [particle, 2];
    # None unless asked for
    origin: Tensor | None = None

    @property
    def windows(self) -> int:
        """Windows in the batch."""
        return len(self.scenario)

    @property
    def frames(self) -> int:
        """Frames in every window."""
        return self.position.shape[1]

    def part(self, frames: slice) -> Self:
        """Return consecutive frames of every window; `frame` follows, and the forcing
        of later frames stays.

        Raises:
            UsageError: no frame is left, or not every frame is taken: forcing is given
                per frame.
        """
        kept = range(self.frames)[frames]
        if not kept or kept.step != 1:
            what = "a part of a batch is of consecutive frames"
            expected = f"some of {self.frames} frames, in steps of 1"
            raise UsageError(what, where="Batch.part", expected=expected, got=frames)
        first = kept[0]
        if self.wall_velocity is None:
            walls = None
        else:
            walls = self.wall_velocity[:, first:]
        return replace(
            self,
            position=self.position[:, frames],
            wall_velocity=walls,
            frame=self.frame + first,
        )

    def to(self, device: torch.device | str) -> Self:
        """Return the batch on a device."""
        held = {
            name: value
            for name, value in vars(self).items()
            if isinstance(value, Tensor)
        }
        return replace(self, **{name: value.to(device) for name, value in held.items()})

    def followed_by(self, position: Tensor) -> Self:
        """Return the windows one frame later: the first frame leaves, the next one
        joins.

        Its positions [length] have shape [particle, 2].
        """
        if self.wall_velocity is None:
            walls = None
        else:
            walls = self.wall_velocity[:, 1:]
        joined = torch.cat([self.position[:, 1:], position[:, None]], dim=1)
        return replace(self, position=joined, wall_velocity=walls, frame=self.frame + 1)


def collate(windows: Sequence[Window]) -> Batch:
    """Put windows side by side."""
    walls = [
        window.wall_velocity for window in windows if window.wall_velocity is not None
    ]
    origins = [window.origin for window in windows if window.origin is not None]
    frames = {window.position.shape[1] for window in windows}
    if len(frames) != 1 or not {len(walls), len(origins)} <= {0, len(windows)}:
        what = "windows do not fit side by side"
        expected = "windows of one split and one length"
        got = f"lengths {sorted(frames)}, {len(walls)} of {len(windows)} with moving walls,"
        got += f" {len(origins)} with their first frame"
        raise UsageError(what, where="collate", expected=expected, got=got)
    particles = torch.tensor([len(window.material) for window in windows])
    return Batch(
        position=torch.cat([window.position for window in windows]),
        sample=torch.arange(len(windows)).repeat_interleave(particles),
        material=torch.cat([window.material for window in windows]),
        wall_velocity=torch.stack([wall[: min(map(len, walls))] for wall in walls])
        if walls
        else None,
        scenario=torch.tensor([window.scenario for window in windows]),
        frame=torch.tensor([window.frame for window in windows]),
        origin=torch.cat(origins) if origins else None,
    )
