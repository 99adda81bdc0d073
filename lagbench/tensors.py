"""Windows of consecutive frames as tensors, and the box that holds their particles."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Self

import numpy as np
import torch
from torch import Tensor, nn

from lagbench.data.box import Box
from lagbench.data.summary import summarise_arrays
from lagbench.errors import UsageError


class TensorBox(nn.Module):
    """A :class:`~lagbench.data.box.Box` for tensors on any device.

    It has no weights: its buffers do not enter checkpoints.
    """

    lower_walls: Tensor
    upper_walls: Tensor
    start: Tensor
    period: Tensor

    def __init__(self, box: Box) -> None:
        super().__init__()
        self.box = box
        period = np.where(box.periodic, box.lengths, np.inf)
        for name, values in (
            ("lower_walls", box.lower_walls),
            ("upper_walls", box.upper_walls),
            ("start", box.low),
            ("period", period),
        ):
            buffer = torch.tensor(values, dtype=torch.float32)
            self.register_buffer(name, buffer, persistent=False)

    def displacement(self, start: Tensor, end: Tensor) -> Tensor:
        """Return the shortest way from one point to another (minimum image).

        Along an axis with walls this is ``end - start``.

        Args:
            start: points [length], shape [..., axis].
            end: points [length], shape [..., axis].
        """
        way = end - start
        if not self.box.is_periodic:
            return way
        # Along an axis with walls the quotient is 0; 0 times infinity is no number.
        count = torch.round(way.detach() / self.period)
        return way - torch.where(count == 0.0, 0.0, count * self.period)

    def inside(self, position: Tensor) -> Tensor:
        """Return positions inside the box.

        Those beyond a wall are put on it. Along periodic axes they are wrapped.

        Args:
            position: points [length], shape [..., axis].
        """
        return self.wrap(position.clamp(self.lower_walls, self.upper_walls))

    def outside(self, position: Tensor, obstacle: Tensor) -> Tensor:
        """Return positions outside: those in an obstacle are put on its surface.

        A particle moves along the radius. One in the very centre moves along x. Along
        periodic axes the nearest image of the obstacle counts.

        Args:
            position: points [length], shape [..., axis].
            obstacle: centre and radius of each point's obstacle [length], shape
                [..., axis + 1].
        """
        centre = obstacle[..., :-1]
        radius = obstacle[..., -1:]
        way = self.displacement(centre, position)
        length = way.norm(dim=-1, keepdim=True)
        along_x = torch.zeros_like(way)
        along_x[..., 0] = 1.0
        divisor = torch.where(length > 0.0, length, 1.0)
        normal = torch.where(length > 0.0, way / divisor, along_x)
        on_surface = self.inside(position - way + radius * normal)
        return torch.where(length < radius, on_surface, position)

    def wrap(self, position: Tensor) -> Tensor:
        """Return positions moved by whole periods into [low, high) of periodic axes.

        Args:
            position: points [length], shape [..., axis].
        """
        if not self.box.is_periodic:
            return position
        count = torch.floor((position.detach() - self.start) / self.period)
        wrapped = position - torch.where(count == 0.0, 0.0, count * self.period)
        # The difference can round up to the upper end, which is the lower one, or to
        # less than the lower end.
        is_at_end = wrapped >= self.start + self.period
        is_before_start = (count != 0.0) & (wrapped < self.start)
        return torch.where(is_at_end | is_before_start, self.start, wrapped)

    def stop_at_walls(self, position: Tensor, velocity: Tensor) -> Tensor:
        """Return velocities that lead no particle past a wall [length/frame].

        Args:
            position: points in the box [length], shape [..., axis].
            velocity: ways to the next frame [length/frame], shape [..., axis].
        """
        return velocity.clamp(self.lower_walls - position, self.upper_walls - position)


class TensorWindow(NamedTuple):
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
    # kinematic viscosity [length^2/s]: the scenario's, else that of the data set; None
    # where none is known
    viscosity: float | None = None
    # acceleration of the fluid [length/s^2] in layers of equal height along y, lowest
    # first, float32, shape [frame, layer, axis], of these frames and perhaps of later
    # ones; None where no force drives the flow
    body_force: Tensor | None = None
    # centre and radius of a fixed obstacle [length], float32, shape [axis + 1]; None
    # without one
    obstacle: Tensor | None = None
    # mass of one particle [mass]; None where it is not known
    particle_mass: float | None = None
    # Coulomb friction of the walls [1]; None where the file states none
    friction: float | None = None

    def __repr__(self) -> str:
        """Return the names and shapes of what the window holds."""
        return summarise_arrays("Window", self._asdict())


@dataclass(frozen=True, kw_only=True, repr=False)
class Batch:
    """Several windows of consecutive frames, their particles in one row."""

    position: Tensor  # particle positions [length], float32, shape [particle, frame, 2]
    # window that each particle belongs to, ascending, int64, shape [particle]
    sample: Tensor
    material: Tensor  # 0 liquid, 1 jelly, 2 snow, 3 rope, int64, shape [particle]
    # velocity of the walls [length/s], shape [window, frame, wall, 2]: the forcing on
    # the way to each frame of the windows, and to later frames as far as it is known;
    # None in a split without moving walls
    wall_velocity: Tensor | None
    scenario: Tensor  # scenario id of each window, int64, shape [window]
    frame: Tensor  # absolute number of each window's first frame, int64, shape [window]
    # particle positions in the scenario's first frame [length], shape [particle, 2];
    # None unless asked for
    origin: Tensor | None = None
    # kinematic viscosity of each window [length^2/s], float32, shape [window]; None
    # where none is known
    viscosity: Tensor | None = None
    # acceleration of the fluid [length/s^2] in layers of equal height along y, lowest
    # first, shape [window, frame, layer, axis]: the forcing as wall_velocity is; None
    # where no force drives the flow
    body_force: Tensor | None = None
    # centre and radius of each window's fixed obstacle [length], shape [window, axis +
    # 1]; None without one
    obstacle: Tensor | None = None
    # mass of one particle of each window [mass], float64, shape [window]; None where it
    # is not known
    particle_mass: Tensor | None = None
    # Coulomb friction of the walls in each window [1], float64, shape [window]; None
    # where the files state none
    friction: Tensor | None = None

    def __repr__(self) -> str:
        """Return the names and shapes of what the batch holds."""
        return summarise_arrays("Batch", vars(self))

    @property
    def windows(self) -> int:
        """Windows in the batch."""
        return len(self.scenario)

    @property
    def frames(self) -> int:
        """Frames in every window."""
        return self.position.shape[1]

    def part(self, frames: slice) -> Self:
        """Return consecutive frames of every window.

        `frame` becomes the first frame of the part. The wall velocities and forces of
        later frames are kept.

        Args:
            frames: the frames to take, as in ``slice(2)``.

        Raises:
            UsageError: no slice of whole numbers, no frame is left, or not every frame
                is taken: forcing is given per frame.
        """
        frame_numbers = range(0)
        if isinstance(frames, slice):
            with suppress(TypeError, ValueError):  # ends that are no whole numbers
                frame_numbers = range(self.frames)[frames]
        if not frame_numbers or frame_numbers.step != 1:
            raise UsageError(
                f"a part of a batch has some of its {self.frames} frames, in steps of "
                "1, as in batch.part(slice(2))",
                where="Batch.part",
            )
        first = frame_numbers[0]
        wall_velocity = self.wall_velocity
        if wall_velocity is not None:
            wall_velocity = wall_velocity[:, first:]
        body_force = self.body_force
        if body_force is not None:
            body_force = body_force[:, first:]
        return replace(
            self,
            position=self.position[:, frames],
            wall_velocity=wall_velocity,
            body_force=body_force,
            frame=self.frame + first,
        )

    def to(self, device: torch.device | str | int) -> Self:
        """Return the batch on a device."""
        moved_tensors = {}
        for name, value in vars(self).items():
            if isinstance(value, Tensor):
                moved_tensors[name] = value.to(device)
        return replace(self, **moved_tensors)

    def followed_by(self, position: Tensor) -> Self:
        """Return the windows one frame later, without their first frame.

        Args:
            position: particle positions of the next frame [length], shape
                [particle, 2].
        """
        wall_velocity = self.wall_velocity
        if wall_velocity is not None:
            wall_velocity = wall_velocity[:, 1:]
        body_force = self.body_force
        if body_force is not None:
            body_force = body_force[:, 1:]
        next_positions = torch.cat([self.position[:, 1:], position[:, None]], dim=1)
        return replace(
            self,
            position=next_positions,
            wall_velocity=wall_velocity,
            body_force=body_force,
            frame=self.frame + 1,
        )


def collate(windows: Sequence[TensorWindow]) -> Batch:
    """Put windows side by side.

    Raises:
        UsageError: the windows differ in length, in whether walls move or a force
            drives the flow, or in whether their viscosity is known.
    """
    lengths = {window.position.shape[1] for window in windows}
    is_uniform = len(lengths) == 1
    optional: dict[str, Tensor | None] = {}
    for name, join in JOINS.items():
        values = [getattr(window, name) for window in windows]
        known = [value for value in values if value is not None]
        is_uniform &= len(known) in (0, len(values))
        optional[name] = join(known) if known else None
    if not is_uniform:
        raise UsageError(
            "windows do not fit side by side: their lengths or variables differ; "
            "collate windows of one WindowDataset",
            where="collate",
        )

    particle_counts = torch.tensor([len(window.material) for window in windows])
    return Batch(
        position=torch.cat([window.position for window in windows]),
        sample=torch.arange(len(windows)).repeat_interleave(particle_counts),
        material=torch.cat([window.material for window in windows]),
        scenario=torch.tensor([window.scenario for window in windows]),
        frame=torch.tensor([window.frame for window in windows]),
        **optional,
    )


def _in_double(values: Sequence[float]) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def _stack_forcing(forcings: Sequence[Tensor]) -> Tensor:
    """Return the forcing of all windows as far as that of each is known.

    The shape is [window, frame, wall or layer, axis].
    """
    shared_length = min(len(forcing) for forcing in forcings)
    return torch.stack([forcing[:shared_length] for forcing in forcings])


JOINS: Mapping[str, Callable[[Any], Tensor]] = {
    "wall_velocity": _stack_forcing,
    "origin": torch.cat,
    "viscosity": torch.tensor,
    "body_force": _stack_forcing,
    "obstacle": torch.stack,
    "particle_mass": _in_double,
    "friction": _in_double,
}
"""How what windows may hold is put side by side."""
