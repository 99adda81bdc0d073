"""The input of NeuralMPM's U-Net: fields of particles, walls and forcing on a grid.

    g = P2G(1, v(f-H+1) .. v(f))

of each material, with the strain of solids if asked, the distances to the walls, and
the velocities of moving walls in the coming frames.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from lagbench.data import PARTICLE_KINDS
from lagbench.errors import DataError

from .augmentation import strain_matrix, wall_permutation
from .neuralmpm_options import NeuralMPMOptions
from .particle_grid import ParticleGrid, Stencil
from .strain import RestShape

# below this weight, in units of particles a radius apart, a node's velocity fades to 0
EMPTY_WEIGHT = 1e-3
REACH = 4  # cells over which the U-Net sees how far a wall is


@dataclass(frozen=True, kw_only=True)
class GridState:
    """Input of a call."""

    position: Tensor  # last positions [length], shape [particle, axis]
    # last velocities, oldest first [length/frame], shape [particle, velocities, axis]
    velocity: Tensor
    sample: Tensor  # window of each particle, int64, shape [particle]
    # layer of the grid: one for each window and material, int64, shape [particle]
    layer: Tensor
    # velocities of the walls from the last frame on [length/frame], shape [window,
    # frame, wall, axis]
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
    is_wall: Tensor | None = None  # [particle, 1]; None where walls are no particles
    coming: tuple[Tensor, ...] = ()  # predicted positions of the frames to come


class FieldEncoder(nn.Module):
    """Transfers the particles of a state to the grid, in the U-Net's units.

    Args:
        grid: the U-Net's grid.
        options: options of the model.
        weight_unit: sum of weights at a node among particles that lie a radius
            apart [1]; weights are divided by it.
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
        weight_unit: float,
        velocity_std: float,
        acceleration_std: float,
    ) -> None:
        super().__init__()
        self.grid = grid
        self.options = options
        self.weight_unit = weight_unit
        self.velocity_std = velocity_std
        self.acceleration_std = acceleration_std
        self.material_count = len(options.materials)

        slot = torch.full((len(PARTICLE_KINDS),), -1)
        slots = torch.arange(self.material_count)
        slot[list(options.materials)] = slots
        reach = REACH * grid.spacing
        wall_distance = grid.wall_distance(reach)
        beside_walls = grid.beside_walls()
        self.register_buffer("slot", slot, persistent=False)
        self.register_buffer("wall_distance", wall_distance, persistent=False)
        self.register_buffer("beside_walls", beside_walls, persistent=False)

    @property
    def field_channels(self) -> int:
        """Channels of :meth:`encode`."""
        axes = self.grid.dimension
        velocity_channels = axes * self.options.velocities
        strain_channels = 3 * self.options.strain
        per_material = 1 + velocity_channels + strain_channels
        wall_channels = len(self.wall_distance)
        return self.material_count * per_material + wall_channels

    @property
    def forcing_channels(self) -> int:
        """Channels of :meth:`forcing`."""
        axes = self.grid.dimension
        return axes * self.options.bundle * self._forcing_kinds

    @property
    def _forcing_kinds(self) -> int:
        """Number of forcings that the U-Net sees: moving walls, a force, or both."""
        options = self.options
        return int(options.wall_velocity) + int(options.body_force)

    def layers(self, material: Tensor, sample: Tensor) -> Tensor:
        """Return the layer of each particle: one for each window and material.

        Raises:
            DataError: the model was not trained with one of the materials.
        """
        slot = self.slot[material]
        is_unknown = slot < 0
        if bool(is_unknown.any()):
            present_materials = sorted(set(material.tolist()))
            all_materials = sorted({*self.options.materials, *present_materials})
            raise DataError(
                f"a material that the model does not know: got {present_materials}, "
                f"expected {list(self.options.materials)}; train with --set "
                f"'model.materials={all_materials}', or with the numbers of all "
                "materials of the data; trained weights know only the materials of "
                "their training",
                where="model.materials",
            )
        return sample * self.material_count + slot

    def encode(self, state: GridState, stencil: Stencil) -> tuple[Tensor, Tensor]:
        """Return the fields of the particles, and the last velocity on the grid.

        The fields have shape [window, channel, x node, y node], the velocity
        [length/frame] shape [layer, 2, x node, y node]. Velocities enter the fields as
        the last one and the changes before it, each over its own deviation.
        """
        grid = self.grid
        windows = len(state.walls)
        layers = windows * self.material_count
        axes = grid.dimension
        velocity_channels = axes * self.options.velocities

        one = torch.ones_like(state.position[:, :1])
        carried = [one, state.velocity.flatten(1)]
        if state.rest_shape is not None:
            strain = state.rest_shape.strain(state.position)
            carried.append(strain)
        value = torch.cat(carried, dim=1)
        sums = grid.spread(stencil, value, layers)

        weight = sums[:, :1] / self.weight_unit
        divisor = weight.clamp(min=EMPTY_WEIGHT)
        means = sums[:, 1:] / self.weight_unit / divisor
        velocity = means[:, :velocity_channels]
        velocity = velocity.reshape(layers, -1, axes, *grid.shape)
        mean_strain = means[:, velocity_channels:]

        last_velocity = velocity[:, -1]
        scaled_velocity = last_velocity / self.velocity_std
        changes = velocity.diff(dim=1)
        scaled_changes = changes / self.acceleration_std
        scaled_changes = scaled_changes.flatten(1, 2)
        channels = [
            weight,
            scaled_velocity,
            scaled_changes,
            mean_strain,
        ]
        per_material = torch.cat(channels, dim=1)
        per_window = per_material.reshape(windows, -1, *grid.shape)
        wall_distance = self.wall_distance.expand(windows, *self.wall_distance.shape)
        fields = torch.cat([per_window, wall_distance], dim=1)
        if not self.options.mixture:
            return fields, last_velocity

        # the last velocity of all materials together, for each layer
        by_material = sums.view(windows, self.material_count, -1, *grid.shape)
        total = by_material.sum(dim=1)[:, : 1 + velocity_channels] / self.weight_unit
        mixture = total[:, -axes:] / total[:, :1].clamp(min=EMPTY_WEIGHT)
        return fields, mixture.repeat_interleave(self.material_count, dim=0)

    def forcing(self, walls: Tensor) -> Tensor:
        """Return the velocities of moving walls in the coming frames, beside the walls.

        ``walls`` are those of :class:`GridState`; the result has shape [window,
        channel, x node, y node].
        """
        wall_velocity = self._coming_frames(walls) / self.velocity_std
        wall_velocity = wall_velocity[:, :, self.grid.walls]
        forcing = torch.einsum("fmwc,w...->fmc...", wall_velocity, self.beside_walls)
        return forcing.flatten(1, 2)

    def _coming_frames(self, forcing: Tensor) -> Tensor:
        """Return the forcing of the frames of the bundle; the last known one repeats.

        ``forcing`` has shape [window, frame, ...] and starts with the last frame.
        """
        last_frame = forcing.shape[1] - 1
        bundle = self.options.bundle
        frame = torch.arange(1, bundle + 1, device=forcing.device)
        known_frame = frame.clamp(max=last_frame)
        return forcing[:, known_frame]

    def force(self, body_force: Tensor) -> Tensor:
        """Return the force on the fluid in the coming frames, at every node.

        ``body_force`` is that of :class:`GridState`; the result has shape [window,
        channel, x node, y node].
        """
        grid = self.grid
        height = grid.axes[1]
        low = grid.low[1]
        high = grid.high[1]
        relative_height = (height - low) / (high - low)
        layer_count = body_force.shape[2]
        layer = (relative_height * layer_count).long()
        layer = layer.clamp(0, layer_count - 1)

        coming = self._coming_frames(body_force)
        # shape [window, frame, axis, y node]
        along_y = coming[:, :, layer].transpose(2, 3)
        along_y = along_y / self.acceleration_std
        channels = along_y.flatten(1, 2)
        channels = channels.unsqueeze(2)
        if grid.dimension == 3:
            channels = channels.unsqueeze(4)
        windows, channel_count = channels.shape[:2]
        return channels.expand(windows, channel_count, *grid.shape)

    def mirror_fields(self, matrix: Tensor) -> list[Tensor]:
        """Return the blocks by which a mirror image changes the fields of a node."""
        per_material = [torch.ones(1, 1)]
        per_material += [matrix] * self.options.velocities
        if self.options.strain:
            per_material.append(strain_matrix(matrix))
        walls = self.grid.walls
        permutation = wall_permutation(matrix)
        permutation = permutation[walls][:, walls]
        return [*per_material * self.material_count, permutation]

    def mirror_forcing(self, matrix: Tensor) -> list[Tensor]:
        """Return the blocks by which a mirror image changes the forcing of a node."""
        block_count = self.options.bundle * self._forcing_kinds
        return [matrix] * block_count
