"""The input of NeuralMPM's U-Net: fields of particles, walls and forcing on a grid.

    g = P2G(1, v(f-H+1) .. v(f))

of each material, with the strain of solids if asked, the distances to the walls, and
the velocities of moving walls in the coming frames.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from lagbench.errors import DataError

from .augmentation import strain_matrix, wall_permutation
from .graph import MATERIALS
from .neuralmpm_options import NeuralMPMOptions
from .particle_grid import ParticleGrid, Stencil
from .projection import ProjectionState
from .strain import RestShape

# below this weight, in units of particles a radius apart, a node's velocity fades to 0
EMPTY_WEIGHT = 1e-3
REACH = 4  # cells over which the U-Net sees how far a wall is


@dataclass(frozen=True, kw_only=True)
class GridState:
    """Input of a call."""

    position: Tensor  # last positions [length], shape [particle, 2]
    # last velocities, oldest first [length/frame], shape [particle, velocities, 2]
    velocity: Tensor
    sample: Tensor  # window of each particle, int64, shape [particle]
    # layer of the grid: one for each window and material, int64, shape [particle]
    layer: Tensor
    # velocities of the walls from the last frame on [length/frame], shape [window,
    # frame, wall, 2]
    walls: Tensor
    # output of the context network for the given frames, shape [window, context]
    context: Tensor
    # logarithm of the given viscosity, in units of the U-Net, shape [window, 1]; no
    # column where the U-Net does not see it
    viscosity: Tensor
    # force on layers along y from the last frame on [length/frame^2], shape [window,
    # frame, layer, axis]; None where the U-Net does not see it
    body_force: Tensor | None = None
    rest_shape: RestShape | None = None  # None where strain is not asked for
    projection: ProjectionState | None = None  # None without a projection
    coming: tuple[Tensor, ...] = ()  # predicted positions of the frames to come


class FieldEncoder(nn.Module):
    """Transfers the particles of a state to the grid, in the U-Net's units.

    Args:
        grid: the U-Net's grid.
        options: options of the model.
        unit: weight of particles a radius apart [1].
        velocity_std: deviation of velocities [length/frame].
        acceleration_std: deviation of accelerations [length/frame^2].
    """

    slot: Tensor
    wall_distance: Tensor
    beside_walls: Tensor

    def __init__(
        self,
        grid: ParticleGrid,
        options: NeuralMPMOptions,
        *,
        unit: float,
        velocity_std: float,
        acceleration_std: float,
    ) -> None:
        super().__init__()
        self.grid = grid
        self.options = options
        self.unit = unit
        self.velocity_std = velocity_std
        self.acceleration_std = acceleration_std
        self.material_count = len(options.materials)

        slot = torch.full((MATERIALS,), -1)
        slot[list(options.materials)] = torch.arange(self.material_count)
        wall_distance = grid.wall_distance(REACH * grid.spacing)
        self.register_buffer("slot", slot, persistent=False)
        self.register_buffer("wall_distance", wall_distance, persistent=False)
        self.register_buffer("beside_walls", grid.beside_walls(), persistent=False)

    @property
    def field_channels(self) -> int:
        """Channels of :meth:`encode`."""
        axes = self.grid.dimension
        per_material = 1 + axes * self.options.velocities + 3 * self.options.strain
        return self.material_count * per_material + len(self.wall_distance)

    @property
    def forcing_channels(self) -> int:
        """Channels of :meth:`forcing`."""
        axes = self.grid.dimension
        kinds = int(self.options.wall_velocity) + int(self.options.body_force)
        return axes * self.options.bundle * kinds

    def layers(self, material: Tensor, sample: Tensor) -> Tensor:
        """Return the layer of each particle: one for each window and material.

        Raises:
            DataError: the model was not trained with one of the materials.
        """
        slot = self.slot[material]
        if bool((slot < 0).any()):
            raise DataError(
                "a material that the model does not know",
                where="model.materials",
                expected=list(self.options.materials),
                got=sorted(set(material.tolist())),
                fix="predict with weights that were trained with these materials",
            )
        return sample * self.material_count + slot

    def encode(self, state: GridState, stencil: Stencil) -> tuple[Tensor, Tensor]:
        """Return the fields of the particles, and the last velocity on the grid.

        The fields have shape [window, channel, x node, y node], the velocity
        [length/frame] shape [layer, 2, x node, y node]. Velocities enter the fields as
        the last one and the changes before it, each over its own deviation.
        """
        windows = len(state.walls)
        layers = windows * self.material_count
        axes = self.grid.dimension
        velocity_channels = axes * self.options.velocities

        carried = [torch.ones_like(state.position[:, :1]), state.velocity.flatten(1)]
        if state.rest_shape is not None:
            carried.append(state.rest_shape.strain(state.position))
        sums = self.grid.spread(stencil, torch.cat(carried, dim=1), layers)

        weight = sums[:, :1] / self.unit
        means = sums[:, 1:] / self.unit / weight.clamp(min=EMPTY_WEIGHT)
        velocity = means[:, :velocity_channels]
        velocity = velocity.reshape(layers, -1, axes, *self.grid.shape)
        changes = velocity.diff(dim=1) / self.acceleration_std
        scaled_velocity = velocity[:, -1] / self.velocity_std
        strain = means[:, velocity_channels:]

        per_material = torch.cat(
            [weight, scaled_velocity, changes.flatten(1, 2), strain], dim=1
        )
        wall_distance = self.wall_distance.expand(windows, *self.wall_distance.shape)
        of_window = per_material.reshape(windows, -1, *self.grid.shape)
        fields = torch.cat([of_window, wall_distance], dim=1)
        if self.options.mixture:
            return fields, self._mixture_velocity(sums[:, : 1 + velocity_channels])
        return fields, velocity[:, -1]

    def _mixture_velocity(self, sums: Tensor) -> Tensor:
        """Return the last velocity of all materials together, for each layer.

        ``sums`` are those of weights and velocities.
        """
        by_material = sums.view(
            -1, self.material_count, sums.shape[1], *self.grid.shape
        )
        total = by_material.sum(dim=1) / self.unit
        velocity = total[:, -self.grid.dimension :] / total[:, :1].clamp(
            min=EMPTY_WEIGHT
        )
        return velocity.repeat_interleave(self.material_count, dim=0)

    def forcing(self, walls: Tensor) -> Tensor:
        """Return the velocities of moving walls in the coming frames, beside the walls.

        ``walls`` are those of :class:`GridState`; the result has shape [window,
        channel, x node, y node].
        """
        frame = torch.arange(1, self.options.bundle + 1, device=walls.device)
        last_frame = walls.shape[1] - 1
        velocity = walls[:, frame.clamp(max=last_frame)] / self.velocity_std
        forcing = torch.einsum(
            "fmwc,w...->fmc...", velocity[:, :, self.grid.walls], self.beside_walls
        )
        return forcing.flatten(1, 2)

    def force(self, body_force: Tensor) -> Tensor:
        """Return the force on the fluid in the coming frames, at every node.

        ``body_force`` is that of :class:`GridState`; the result has shape [window,
        channel, x node, y node].
        """
        layer_count = body_force.shape[2]
        grid = self.grid
        share = (grid.get_buffer("axis_y") - grid.low[1]) / (grid.high[1] - grid.low[1])
        layer = (share * layer_count).long().clamp(0, layer_count - 1)
        frame = torch.arange(1, self.options.bundle + 1, device=body_force.device)
        coming = body_force[:, frame.clamp(max=body_force.shape[1] - 1)]
        # shape [window, frame, axis, y node]
        along_y = coming[:, :, layer].transpose(2, 3) / self.acceleration_std
        channels = along_y.flatten(1, 2).unsqueeze(2)
        if grid.dimension == 3:
            channels = channels.unsqueeze(4)
        return channels.expand(*channels.shape[:2], *grid.shape)

    def mirror_fields(self, matrix: Tensor) -> list[Tensor]:
        """Return the blocks by which a mirror image changes the fields of a node."""
        per_material = [torch.ones(1, 1)]
        per_material += [matrix] * self.options.velocities
        if self.options.strain:
            per_material.append(strain_matrix(matrix))
        walls = self.grid.walls
        permutation = wall_permutation(matrix)[walls][:, walls]
        return [*per_material * self.material_count, permutation]

    def mirror_forcing(self, matrix: Tensor) -> list[Tensor]:
        """Return the blocks by which a mirror image changes the forcing of a node."""
        kinds = int(self.options.wall_velocity) + int(self.options.body_force)
        return [matrix] * (self.options.bundle * kinds)
