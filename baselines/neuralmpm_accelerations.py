"""The output of NeuralMPM's U-Net: accelerations of the particles in the coming frames.

Two decoders have the same methods. :class:`FieldAccelerations` reads the output as
accelerations of each material at the nodes. :class:`StressAccelerations` reads it as
stresses of each material, and accelerations beside walls, so that momentum is conserved
away from walls, whatever the weights:

    a(f+k) = g + G2P(w(f+k) - P2G(s(f+k) grad b) / P2G(1))

with stresses s, which fade where matter is thin, and accelerations w beside walls. The
model adds the fall g. One grid moves all materials, as in the material-point method.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

import torch
from torch import Tensor

from .augmentation import strain_matrix
from .neuralmpm_fields import GridState
from .neuralmpm_options import NeuralMPMOptions
from .particle_grid import ParticleGrid, Stencil

# cells from a wall to nodes that it cannot push; particles feel it half a cell further
WALL_REACH = 2.5
STRESS_UNIT = 4.0  # stress by an output of 1, in deviations of accelerations times cell
# weight inside a body whose particles lie 1.6 to a radius; with less, matter is thin
FULL_WEIGHT = 2.5


class Accelerations(ABC):
    """Decodes the U-Net's output.

    Args:
        grid: the U-Net's grid.
        options: options of the model.
        weight_unit: sum of weights at a node among particles that lie a radius
            apart [1]; weights are divided by it.
    """

    def __init__(
        self, grid: ParticleGrid, options: NeuralMPMOptions, *, weight_unit: float
    ) -> None:
        self.grid = grid
        self.weight_unit = weight_unit
        self.frames = options.bundle
        self.material_count = len(options.materials)

    @property
    @abstractmethod
    def channels(self) -> int:
        """Channels of the output."""

    @abstractmethod
    def mirror(self, matrix: Tensor) -> list[Tensor]:
        """Return the blocks by which a mirror image changes the output at a node."""

    @abstractmethod
    def decode(
        self,
        state: GridState,
        stencil: Stencil,
        output: Tensor,
        grid_velocity: Tensor,
    ) -> tuple[Tensor, Sequence[Tensor]]:
        """Return the grid's velocity at the particles, and their accelerations.

        The velocity, and the acceleration in each coming frame, have shape [particle,
        axis].

        Args:
            state: input of the call.
            stencil: nodes around the particles in their layers.
            output: output of the U-Net [length/frame^2], shape [window, channel, x
                node, y node], in three dimensions with z nodes.
            grid_velocity: last velocity on the grid [length/frame], shape [layer, axis,
                x node, y node], in three dimensions with z nodes.
        """


class FieldAccelerations(Accelerations):
    """Accelerations of each material at the nodes, gathered at its particles."""

    @property
    def channels(self) -> int:
        """A component along each axis, of each material in each frame."""
        return self.grid.dimension * self.material_count * self.frames

    def mirror(self, matrix: Tensor) -> list[Tensor]:
        """Return the image of each acceleration."""
        acceleration_count = self.material_count * self.frames
        return [matrix] * acceleration_count

    def decode(
        self,
        state: GridState,
        stencil: Stencil,
        output: Tensor,
        grid_velocity: Tensor,
    ) -> tuple[Tensor, Sequence[Tensor]]:
        """Return the grid's velocity at the particles, and their accelerations."""
        axes = self.grid.dimension
        particles = len(stencil.weight)
        channels = axes * self.frames  # of a layer
        accelerations = output.reshape(-1, channels, *self.grid.shape)
        # One transfer serves the velocity and all frames.
        field = torch.cat([grid_velocity, accelerations], dim=1)
        gathered = self.grid.gather(stencil, field)
        gathered = gathered.view(particles, -1, axes)
        velocity, *particle_accelerations = gathered.unbind(dim=1)
        return velocity, particle_accelerations


class StressAccelerations(Accelerations):
    """Accelerations by stresses inside matter and by pushes beside walls."""

    @property
    def channels(self) -> int:
        """Components of the stress of each material and of the push of walls."""
        return self._stress_channels + 2 * self.frames

    @property
    def _stress_channels(self) -> int:
        """Three components of the stress of each material in each frame."""
        return 3 * self.material_count * self.frames

    def mirror(self, matrix: Tensor) -> list[Tensor]:
        """Return the images of the stresses, then those of the accelerations."""
        stress_count = self.material_count * self.frames
        stresses = [strain_matrix(matrix)] * stress_count
        accelerations = [matrix] * self.frames
        return stresses + accelerations

    def decode(
        self,
        state: GridState,
        stencil: Stencil,
        output: Tensor,
        grid_velocity: Tensor,
    ) -> tuple[Tensor, Sequence[Tensor]]:
        """Return the grid's velocity at the particles, and their accelerations."""
        grid = self.grid
        velocity = grid.gather(stencil, grid_velocity)
        stress, wall_push = output.tensor_split([self._stress_channels], dim=1)
        stress = stress.reshape(-1, 3 * self.frames, *grid.shape)
        node_stress = STRESS_UNIT * stress  # (xx, xy, yy) [length cell/frame^2]

        # All materials of a window move on one layer.
        windows = len(output)
        position = state.position
        shared = grid.stencil(position, state.sample)
        one = torch.ones_like(position[:, :1])
        mass = grid.spread(shared, one, windows)
        load = self._load(shared, mass)
        particle_stress = grid.gather(stencil, node_stress)
        particle_stress = particle_stress * load
        particle_stress = particle_stress.view(-1, self.frames, 3)

        inner_acceleration = grid.accelerate(shared, position, particle_stress, mass)
        wall_acceleration = self._wall_nearness() * wall_push
        node_acceleration = inner_acceleration + wall_acceleration
        acceleration = grid.gather(shared, node_acceleration)
        by_frame = acceleration.view(-1, self.frames, 2)
        return velocity, by_frame.unbind(dim=1)

    def _load(self, shared: Stencil, mass: Tensor) -> Tensor:
        """Return the share of its stress that a particle bears; a surface bears less.

        The shape is [particle, 1].
        """
        weight = self.grid.gather(shared, mass / self.weight_unit)
        filled_share = weight / FULL_WEIGHT
        filled_share = filled_share.clamp(max=1.0)
        return filled_share.square()

    def _wall_nearness(self) -> Tensor:
        """Return 1 at walls, falling to 0 at their reach, shape [x node, y node]."""
        reach = WALL_REACH * self.grid.spacing
        relative_distance = self.grid.wall_distance(reach)
        nearness = 1.0 - relative_distance.amin(dim=0)
        return nearness.clamp(0.0, 1.0)
