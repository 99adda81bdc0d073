"""NeuralMPM: particles to a grid, a U-Net, and back, for several frames a call.

    g = P2G(1, v(f-H+1) .. v(f)),  a(f+1) .. a(f+M) = U-Net(g, walls, forcing)
    v(f+k) = (1 - s) v(f+k-1) + G2P(s u(f+k-1) + a(f+k)),  u(f+k) = u(f+k-1) + a(f+k)
    x(f+k) = x(f+k-1) + v(f+k)

after Rochman Sharabi, Lewin and Louppe (2024), arXiv 2408.15753. u is the velocity on
the grid, of a material or of all together. Damping acts only on the difference between
the velocity of a particle and u, so that rollouts keep their energy. The accelerations
of a node are those of the matter around it in frame f, wherever that moves in the
bundle: one transfer each way serves all frames of a call. Training unrolls several
calls. The U-Net's last layer starts at zero: an untrained model keeps every velocity.
:mod:`~lagbench.baselines.neuralmpm_fields` makes the U-Net's input.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from lagbench.data import WALL
from lagbench.errors import DataError

from .augmentation import (
    augment,
    mirror_field,
    mirror_matrices,
    shift_batch,
    velocity_towards_path,
)
from .baseline import Baseline, Batch, DatasetInfo, last_velocities
from .deviations import root_mean_square
from .forcing import require_force, skip_frames
from .neuralmpm_fields import FieldEncoder, GridState
from .neuralmpm_options import NeuralMPMOptions, check_options
from .particle_grid import ParticleGrid
from .strain import RestShape, first_frame
from .unet import NODES_PER_COARSE_NODE, ContextNetwork, UNet

LIQUID = 0  # material without a shape to come back to
VISCOSITY_UNIT = 1e-3  # viscosity whose channel is 0 [length^2/s]
LEAST_VISCOSITY = 1e-6  # lower ones look like it: they act on no grid of ours

Frame = tuple[Tensor, Tensor]  # position [length] and velocity [length/frame]


class NeuralMPM(Baseline):
    """Grid surrogate: density and velocities of materials in, accelerations out."""

    Options = NeuralMPMOptions
    options: NeuralMPMOptions
    method = "NeuralMPM"
    any_size = True
    any_box = True
    knows_wall_particles = True

    def __init__(self, options: NeuralMPMOptions, info: DatasetInfo) -> None:
        super().__init__(options, info)
        check_options(options, info)
        periodic = info.box.periodic
        self.grid = ParticleGrid(
            info.bounds,
            options.cells,
            multiple=NODES_PER_COARSE_NODE,
            periodic=periodic,
        )
        radii_per_cell = self.grid.spacing / info.radius
        # sum of weights at a node among particles that lie a radius apart [1]
        weight_unit = radii_per_cell**info.box.dimension
        # The network reads velocities in units of their deviation [length/frame], and
        # predicts accelerations in units of theirs [length/frame^2].
        # A model that is trained on mirror images must not distinguish the axes.
        self.velocity_std = root_mean_square(info.statistics["velocity_std"])
        self.acceleration_std = root_mean_square(info.statistics["acceleration_std"])
        self.encoder = FieldEncoder(
            self.grid,
            options,
            weight_unit=weight_unit,
            velocity_std=self.velocity_std,
            acceleration_std=self.acceleration_std,
        )
        self.context: ContextNetwork | None = None
        if options.context:
            self.context = ContextNetwork(
                self.encoder.field_channels, options.context, options.width, periodic
            )
        inputs = (
            self.encoder.field_channels
            + self.encoder.forcing_channels
            + options.context
            + options.viscosity
        )
        # vectors at a node: an acceleration of each material in each frame
        self.output_vectors = len(options.materials) * options.bundle
        outputs = info.box.dimension * self.output_vectors
        self.network = UNet(inputs, outputs, options.width, periodic)

    @property
    def history(self) -> int:
        """One frame more than the velocities that the U-Net sees."""
        return self.options.velocities + 1

    @property
    def future(self) -> int:
        """Frames of all calls in training, with gradients and without."""
        calls = self.options.calls + self.options.pushforward
        return self.options.bundle * calls

    @property
    def origin(self) -> bool:
        """Whether the model compares bodies with the scenario's first frame."""
        return self.options.strain

    def forward(
        self, batch: Batch, generator: torch.Generator | None = None
    ) -> dict[str, Tensor]:
        """Return the squared error of velocity over the deviation of accelerations [1].

        It is a mean over frames. With ``recovery`` the target is the true velocity and
        the way back to the true path.
        """
        if generator is not None:
            batch = augment(self, batch, generator)
            if self.options.shift:
                batch = shift_batch(batch, self.box, generator)
        given = batch.part(slice(self.history))
        state = self.start(given, average=False)
        next_frame = self.history  # the first frame whose error counts
        if generator is not None and self.options.pushforward:
            end = self.options.pushforward + 1
            drawn = torch.randint(end, (), generator=generator, device=generator.device)
            with torch.no_grad():
                for _ in range(int(drawn)):
                    state, _ = self.call(state, average=False)
                    next_frame += self.options.bundle

        errors: list[Tensor] = []
        reached = state.position
        for _ in range(self.options.calls):
            state, frames = self.call(state, average=False)
            for position, velocity in frames:
                true_position = batch.position[:, next_frame - 1]
                next_true_position = batch.position[:, next_frame]
                true_velocity = self.box.displacement(true_position, next_true_position)
                gap = self.box.displacement(reached.detach(), true_position)
                way_back = velocity_towards_path(
                    gap, self.options.recovery, acceleration_std=self.acceleration_std
                )
                target = true_velocity + way_back
                error = (velocity - target) / self.acceleration_std
                squared_error = error.square()
                errors.append(squared_error.mean())
                reached = position
                next_frame += 1
        frame_errors = torch.stack(errors)
        return {"velocity": frame_errors.mean()}

    def start(self, given: Batch, *, average: bool = True) -> GridState:
        """Return the state after the given frames.

        Where they are few, the first velocity repeats. With ``average=False``, as in
        training, nothing is mirror-averaged, whatever the options say.

        Raises:
            DataError: viscosity or force are to be seen, and are not known.
        """
        options = self.options
        last_frame = given.frames - 1
        position = given.position[:, -self.history :]
        position = self.box.inside(position)
        layer = self.encoder.layers(given.material, given.sample)

        # What drives the flow, from the last frame on.
        dimension = position.shape[2]
        walls = position.new_zeros(given.windows, 1, 2 * dimension, dimension)
        if options.wall_velocity and given.wall_velocity is not None:
            per_second = given.wall_velocity[:, last_frame:]
            walls = per_second * self.info.frame_interval
        force = None
        if options.body_force:
            force = require_force(given, self.info)[:, last_frame:]

        viscosity = position.new_zeros(given.windows, 0)
        if options.viscosity:
            if given.viscosity is None:
                raise DataError(
                    "the viscosity is not known; train without it: --set "
                    "model.viscosity=false",
                    where=f"{self.info.split} {self.info.size}",
                )
            known_viscosity = given.viscosity.clamp(min=LEAST_VISCOSITY)
            viscosity = torch.log(known_viscosity / VISCOSITY_UNIT)[:, None]
        rest_shape = None
        if options.strain:
            rest_shape = RestShape.build(
                self.grid,
                first_frame(given),
                layer,
                given.windows * len(options.materials),
                is_solid=given.material != LIQUID,
            )
        state = GridState(
            position=position[:, -1],
            velocity=last_velocities(position, options.velocities, self.box),
            sample=given.sample,
            layer=layer,
            walls=walls,
            context=position.new_zeros(given.windows, 0),
            viscosity=viscosity,
            body_force=force,
            rest_shape=rest_shape,
        )
        if self.info.wall_particles:
            state = replace(state, is_wall=(given.material == WALL)[:, None])
        if self.context is not None:
            context = self._encode_context(state, self.context, average=average)
            state = replace(state, context=context)
        return state

    @property
    def forcing_seen(self) -> frozenset[str]:
        """The force by an option; an obstacle is the hole in the mass."""
        if self.options.body_force:
            return frozenset({"body_force", "obstacle"})
        return frozenset({"obstacle"})

    def _encode_context(
        self, state: GridState, network: ContextNetwork, *, average: bool
    ) -> Tensor:
        """Return the context of each window: the network's numbers about its scenario.

        They are mirror-averaged if the options and the caller want it.
        """
        stencil = self.grid.stencil(state.position, state.layer)
        fields, _ = self.encoder.encode(state, stencil)
        images = [fields]
        if average and self.options.average:
            images = []
            for matrix in mirror_matrices(self.options.symmetry, self.grid.dimension):
                blocks = self.encoder.mirror_fields(matrix)
                image = mirror_field(fields, matrix, blocks)
                images.append(image)
        contexts = [network(image) for image in images]
        of_images = torch.stack(contexts)
        return of_images.mean(dim=0)

    def advance(self, state: GridState) -> tuple[GridState, Tensor]:
        """Return the next state and positions [length]; call once for every bundle."""
        if not state.coming:
            state, frames = self.call(state)
            positions = [position for position, _ in frames]
            state = replace(state, coming=tuple(positions))
        next_position, *later_positions = state.coming
        state = replace(state, coming=tuple(later_positions))
        return state, next_position

    def call(
        self, state: GridState, *, average: bool = True
    ) -> tuple[GridState, list[Frame]]:
        """Return the state after a bundle of frames, and those frames.

        With ``average=False``, as in training, nothing is mirror-averaged, whatever the
        options say.
        """
        stencil = self.grid.stencil(state.position, state.layer)
        fields, grid_velocity = self.encoder.encode(state, stencil)
        constants = torch.cat([state.context, state.viscosity], dim=1)
        node_axes = [1] * self.grid.dimension
        one_node = constants.view(*constants.shape, *node_axes)
        parts = [fields, one_node.expand(-1, -1, *self.grid.shape)]
        if self.options.wall_velocity:
            parts.append(self.encoder.forcing(state.walls))
        if state.body_force is not None:
            parts.append(self.encoder.force(state.body_force))
        inputs = torch.cat(parts, dim=1)
        if average and self.options.average:
            output = self._predict_mirror_averaged(inputs)
        else:
            output = self.network(inputs)

        # One transfer serves the velocity and the accelerations of all frames.
        axes = self.grid.dimension
        output = output * self.acceleration_std
        of_layers = output.reshape(-1, axes * self.options.bundle, *self.grid.shape)
        field = torch.cat([grid_velocity, of_layers], dim=1)
        gathered = self.grid.gather(stencil, field)
        gathered = gathered.view(len(stencil.weight), -1, axes)
        velocity_around, *accelerations = gathered.unbind(dim=1)
        frames = self._integrate(state, velocity_around, accelerations)

        positions, velocities = zip(*frames, strict=True)
        velocity = torch.cat([state.velocity, torch.stack(velocities, dim=1)], dim=1)
        force = state.body_force
        if force is not None:
            force = skip_frames(force, len(frames))
        following = replace(
            state,
            position=positions[-1],
            velocity=velocity[:, -self.options.velocities :],
            walls=skip_frames(state.walls, len(frames)),
            body_force=force,
        )
        return following, frames

    def _predict_mirror_averaged(self, inputs: Tensor) -> Tensor:
        """Return the mean of the U-Net's outputs for all mirror images, mirrored back.

        A rollout of an image is then the image of the rollout: frame averaging over the
        whole group (Puny et al. 2022, arXiv 2110.03336).
        """
        constant_count = self.options.context + self.options.viscosity
        outputs = []
        for matrix in mirror_matrices(self.options.symmetry, self.grid.dimension):
            input_blocks = [
                *self.encoder.mirror_fields(matrix),
                torch.eye(constant_count),
                *self.encoder.mirror_forcing(matrix),
            ]
            image = mirror_field(inputs, matrix, input_blocks)
            image_output = self.network(image)
            inverse = matrix.T
            output_blocks = [inverse] * self.output_vectors
            output = mirror_field(image_output, inverse, output_blocks)
            outputs.append(output)
        of_images = torch.stack(outputs)
        return of_images.mean(dim=0)

    def _integrate(
        self,
        state: GridState,
        grid_velocity: Tensor,
        accelerations: Sequence[Tensor],
    ) -> list[Frame]:
        """Return the frames of a bundle.

        Args:
            state: input of the call.
            grid_velocity: u(f) at the particles, shape [particle, 2].
            accelerations: a of each frame at the particles, shape [particle, 2].
        """
        smoothing = self.options.smoothing  # s
        position = state.position
        velocity = state.velocity[:, -1]
        frames: list[Frame] = []
        for acceleration in accelerations:
            own_velocity = (1.0 - smoothing) * velocity
            smooth_velocity = smoothing * grid_velocity
            velocity = own_velocity + smooth_velocity + acceleration
            velocity = self.box.stop_at_walls(position, velocity)
            moved = position + velocity
            # The sum may round to a number beyond the wall.
            position = self.box.inside(moved)
            if state.is_wall is not None:
                velocity = torch.where(state.is_wall, 0.0, velocity)
                position = torch.where(state.is_wall, state.position, position)
            grid_velocity = grid_velocity + acceleration
            frames.append((position, velocity))
        return frames
