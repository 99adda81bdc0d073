"""NeuralMPM: particles to a grid, a U-Net, the grid to particles, several frames a
call.

    g = P2G(1, v(f-H+1) .. v(f)),  a(f+1) .. a(f+M) = U-Net(g, walls, forcing)
    v(f+k) = (1 - s) v(f+k-1) + G2P(s u(f+k-1) + a(f+k)),  u(f+k) = u(f+k-1) + a(f+k)
    x(f+k) = x(f+k-1) + v(f+k)

after Rochman Sharabi, Lewin and Louppe (2024), arXiv 2408.15753. u is the velocity on
the grid, of a material or of all together: only what particles have beyond it is
damped, so that rollouts keep their energy. A node's accelerations are those of the
matter that is there in frame f, wherever it goes in the bundle: one transfer each way
serves all of its frames. Training unrolls several calls. The U-Net's last layer starts
at zero: an untrained model keeps every velocity, but for what ``shape`` and ``density``
change.

With ``conserve`` bodies push each other and themselves as those of the material-point
method do,

    a(f+k) = g + G2P(w(f+k) - P2G(s(f+k) grad b) / P2G(1))

by stresses s of each material, which fade where matter is thin, and, beside walls only,
accelerations w: away from walls momentum is conserved, whatever the weights. One grid
pushes all materials.

With ``shape`` and ``density`` positions are then drawn to where elastic bodies have the
shape of the first frame and matter is not pressed together
(:mod:`~lagbench.baselines.projection`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

import torch
from pydantic import Field
from torch import Tensor, nn

from lagbench.errors import DataError, UsageError

from .augmentation import (
    Symmetry,
    disturbed,
    field_image,
    images,
    strain_image,
    wall_permutation,
    way_back,
)
from .baseline import (
    Baseline,
    Batch,
    Facts,
    Options,
    check_moving_walls,
    last_velocities,
)
from .graph import MATERIALS
from .particle_grid import ParticleGrid, Stencil
from .projection import Drawn, Projection
from .strain import Rest, first_frame
from .unet import COARSEST, Context, UNet

# below this weight, in units of particles a radius apart, a node's velocity fades to 0
EMPTY = 1e-3
REACH = 4  # cells over which the U-Net sees how far a wall is
LIQUID = 0  # material without a shape to come back to
# cells from a wall to nodes that it cannot push; particles feel it half a cell further
BESIDE = 2.5
STIFF = 4.0  # what a stress of 1 is, in deviations of accelerations times a cell
# weight inside a body whose particles lie 1.6 to a radius, and from which on it bears
# all
FULL = 2.5
HEAVY = 10.0  # what a fall of 1 is, in deviations of accelerations

Grids = Annotated[tuple[Annotated[int, Field(ge=2, le=256)], ...], Field(max_length=8)]


class NeuralMPMOptions(Options):
    """Options of the grid surrogate."""

    in_training = frozenset({"calls", "pushforward", "recovery", "noise_std"})
    of_weights = frozenset({"shape", "density"})  # weights are of grids in this order

    # cells of the network's grid across the box; even, so that walls lie between two
    # nodes on all sides
    cells: int = Field(default=18, ge=4, le=256, multiple_of=2)
    width: int = Field(default=32, ge=4, multiple_of=4)  # channels of the finest level
    velocities: int = Field(default=5, ge=1)  # last velocities that the U-Net sees
    bundle: int = Field(default=4, ge=1)  # frames that one call predicts
    # calls that training unrolls; gradients pass through all
    calls: int = Field(default=2, ge=1)
    # most calls before those, without gradients: training sees what rollouts come to
    pushforward: int = Field(default=0, ge=0)
    # each frame the gap to the true path is to close by 1/recovery of it: a third is
    # left after so many frames; None asks for true velocities alone
    recovery: float | None = Field(default=None, gt=1.0, allow_inf_nan=False)
    # share s of the grid's velocity per frame
    smoothing: float = Field(default=0.2, ge=0.0, le=1.0)
    # on the last velocity [length/frame]
    noise_std: float = Field(default=1e-4, ge=0.0, allow_inf_nan=False)
    # numbers read off the given frames and kept, such as a viscosity
    context: int = Field(default=0, ge=0)
    materials: tuple[int, ...] = (
        0,
    )  # materials that have density and velocity of their own
    # whether the velocity of the walls in the coming frames is a channel
    wall_velocity: bool = False
    # whether particles are damped towards the velocity of all materials together: one
    # grid carries them all
    mixture: bool = False
    # whether the U-Net gives stresses, and accelerations beside walls only: elsewhere
    # momentum is conserved
    conserve: bool = False
    # whether the U-Net sees how far solids are strained since the scenario's first
    # frame
    strain: bool = False
    # cells across the box of the grids on which elastic bodies are held in shape, one
    # after the other
    shape: Grids = ()
    # the same of those on which matter is pushed out of where it is denser than it was
    # anywhere at first
    density: Grids = ()
    # images that training windows are replaced by at random
    symmetry: Symmetry = Symmetry.NONE
    # whether calls of rollouts, not of training, are means over those images, at as
    # many times the cost
    average: bool = False


@dataclass(frozen=True, kw_only=True)
class GridState:
    """What a call starts from."""

    position: Tensor  # last positions [length], shape [particle, 2]
    # last velocities, oldest first [length/frame], shape [particle, velocities, 2]
    velocity: Tensor
    sample: Tensor  # window of each particle, int64, shape [particle]
    # layer of the grid: one for each window and material, int64, shape [particle]
    layer: Tensor
    # velocities of the walls from the last frame on [length/frame], shape [window,
    # frame, wall, 2]
    walls: Tensor
    context: Tensor  # what the given frames told, shape [window, context]
    rest: Rest | None = None  # None where strain is not asked for
    drawn: Drawn | None = None  # None where no projection is asked for
    coming: tuple[Tensor, ...] = ()  # predicted positions that are not yet given out


class NeuralMPM(Baseline):
    """Grid surrogate: density and velocities of every material in, accelerations of the
    next frames out.
    """

    Options = NeuralMPMOptions
    options: NeuralMPMOptions
    method = "NeuralMPM"
    any_size = True

    slot: Tensor
    geometry: Tensor
    beside: Tensor

    def __init__(self, options: NeuralMPMOptions, facts: Facts) -> None:
        super().__init__(options, facts)
        check_moving_walls(options.wall_velocity, facts)
        known = set(options.materials)
        if (
            not known
            or len(known) < len(options.materials)
            or not known <= set(range(MATERIALS))
        ):
            raise UsageError(
                "materials are named once each",
                where="model.materials",
                expected=f"some of {list(range(MATERIALS))}",
                got=list(options.materials),
            )
        if options.average and options.symmetry is Symmetry.NONE:
            raise UsageError(
                "there are no images to take the mean of",
                where="model.average",
                expected=f"model.symmetry {Symmetry.MIRROR} or {Symmetry.SQUARE}",
                got=str(options.symmetry),
                fix="set model.symmetry=mirror too, or leave model.average out",
            )
        self.grid = ParticleGrid(facts.bounds, options.cells, multiple=COARSEST)
        self.unit = (self.grid.spacing / facts.radius) ** 2
        # One scale for x and y: a model that is trained on turned windows must not tell
        # them apart.
        self.speed, self.change = (
            sum(std**2 / 2 for std in facts.statistics[name]) ** 0.5
            for name in ("velocity_std", "acceleration_std")
        )
        slot = torch.full((MATERIALS,), -1)
        slot[list(options.materials)] = torch.arange(len(options.materials))
        self.register_buffer("slot", slot, persistent=False)
        geometry = self.grid.wall_distance(REACH * self.grid.spacing)
        self.register_buffer("geometry", geometry, persistent=False)
        self.register_buffer("beside", self.grid.beside_walls(), persistent=False)
        kinds = len(options.materials)
        frames = options.bundle
        seen = kinds * (1 + 2 * options.velocities + 3 * options.strain) + len(geometry)
        self.context = (
            Context(seen, options.context, options.width) if options.context else None
        )
        forcing = 2 * frames * options.wall_velocity
        outputs = (3 * kinds + 2 if options.conserve else 2 * kinds) * frames
        self.network = UNet(seen + forcing + options.context, outputs, options.width)
        # what all matter falls by; images of the square fall nowhere
        falls = options.conserve and options.symmetry is not Symmetry.SQUARE
        self.fall = nn.Parameter(torch.zeros(())) if falls else None
        self.projection: Projection | None = None
        if options.shape or options.density:
            self.projection = Projection(
                facts.bounds, shape=options.shape, density=options.density
            )

    @property
    def history(self) -> int:
        """One frame more than the velocities that the U-Net sees."""
        return self.options.velocities + 1

    @property
    def future(self) -> int:
        """Frames of the calls that training makes: those without gradients and those it
        unrolls.
        """
        return self.options.bundle * (self.options.calls + self.options.pushforward)

    @property
    def origin(self) -> bool:
        """Strain is counted from the scenario's first frame, where bodies have their
        shape.
        """
        return self.options.strain or self.projection is not None

    def adapted(
        self, weights: Mapping[str, Tensor], options: Mapping[str, Any]
    ) -> tuple[Mapping[str, Tensor], Mapping[str, Any]]:
        """Take weights of grids of ``shape`` and ``density`` that stand first in both;
        others start anew.
        """
        projection = self.projection or Projection(
            self.facts.bounds, shape=(), density=()
        )
        return projection.adapted(weights, options, prefix="projection.")

    def forward(
        self, batch: Batch, generator: torch.Generator | None = None
    ) -> dict[str, Tensor]:
        """Return the squared error of velocity over the deviation of accelerations,
        mean over frames [1].

        With ``recovery`` the true velocity has the way back to the true path added to
        it.
        """
        options = self.options
        if generator is not None:
            batch = disturbed(self, batch, generator)
        state = self.start(batch.part(slice(self.history)), average=False)
        following = self.history  # the first frame whose error counts
        if generator is not None and options.pushforward:
            most = options.pushforward + 1
            with torch.no_grad():
                for _ in range(
                    int(
                        torch.randint(
                            most, (), generator=generator, device=generator.device
                        )
                    )
                ):
                    state, frames = self.call(state, average=False)
                    following += len(frames)
        errors: list[Tensor] = []
        reached = state.position
        for _ in range(options.calls):
            state, frames = self.call(state, average=False)
            for position, velocity in frames:
                path = batch.position[
                    :, following + len(errors) - 1 : following + len(errors) + 1
                ]
                gap = path[:, 0] - reached.detach()
                wanted = (
                    path[:, 1]
                    - path[:, 0]
                    + way_back(gap, options.recovery, change=self.change)
                )
                errors.append(((velocity - wanted) / self.change).square().mean())
                reached = position
        return {"velocity": torch.stack(errors).mean()}

    def start(self, given: Batch, *, average: bool = True) -> GridState:
        """Return the state after the given frames; where they are few, the first
        velocity repeats.

        ``average=False``, as in training, takes no means over images, whatever the
        options say.
        """
        position = given.position[:, -self.history :].clamp(
            self.grid.low, self.grid.high
        )
        velocity = last_velocities(position, self.options.velocities)
        slot = self.slot[given.material]
        if bool((slot < 0).any()):
            raise DataError(
                "a material that the model does not know",
                where="model.materials",
                expected=list(self.options.materials),
                got=sorted(set(given.material.tolist())),
                fix="predict with weights that were trained with these materials",
            )
        walls = position.new_zeros(given.windows, 1, len(self.beside), 2)
        if self.options.wall_velocity and given.wall_velocity is not None:
            walls = (
                given.wall_velocity[:, given.frames - 1 :] * self.facts.frame_interval
            )
        kinds = len(self.options.materials)
        drawn = None
        rest = None
        layer = given.sample * kinds + slot
        if self.projection is not None:
            drawn = self.projection.start(
                first_frame(given), given.material, given.sample, given.windows
            )
        if self.options.strain:
            solid = given.material != LIQUID
            rest = Rest.of(
                self.grid, first_frame(given), layer, given.windows * kinds, solid=solid
            )
        state = GridState(
            position=position[:, -1],
            velocity=velocity,
            sample=given.sample,
            layer=layer,
            walls=walls,
            context=position.new_zeros(given.windows, 0),
            rest=rest,
            drawn=drawn,
        )
        if self.context is None:
            return state
        fields, _ = self._fields(state, self.grid.stencil(state.position, state.layer))
        turned = [fields]
        if average and self.options.average:
            turned = [
                field_image(fields, one, self._turn(one))
                for one in images(self.options.symmetry)
            ]
        return replace(
            state,
            context=torch.stack([self.context(each) for each in turned]).mean(dim=0),
        )

    def advance(self, state: GridState) -> tuple[GridState, Tensor]:
        """Advance by one frame, calling the U-Net once for every bundle of them."""
        if not state.coming:
            state, frames = self.call(state)
            state = replace(state, coming=tuple(position for position, _ in frames))
        return replace(state, coming=state.coming[1:]), state.coming[0]

    def call(
        self, state: GridState, *, average: bool = True
    ) -> tuple[GridState, list[tuple[Tensor, Tensor]]]:
        """Return the state after a bundle of frames, and position and velocity in each
        of them.

        ``average`` as in :meth:`start`.
        """
        share = self.options.smoothing
        stencil = self.grid.stencil(state.position, state.layer)
        fields, on_grid = self._fields(state, stencil)
        parts = [
            fields,
            state.context[:, :, None, None].expand(-1, -1, *self.grid.shape),
        ]
        if self.options.wall_velocity:
            coming = torch.arange(1, self.options.bundle + 1, device=fields.device)
            moved = (
                state.walls[:, coming.clamp(max=state.walls.shape[1] - 1)] / self.speed
            )
            parts.append(
                torch.einsum("fmwc,wxy->fmcxy", moved, self.beside).flatten(1, 2)
            )
        seen = torch.cat(parts, dim=1)
        whole = average and self.options.average
        output = (
            self._mean_over_images(seen) if whole else self.network(seen)
        ) * self.change
        if self.options.conserve:
            on_grid = self.grid.gather(stencil, on_grid)
            accelerations = self._pushed(state, stencil, output)
        else:
            # accelerations in the coming frames [length/frame^2], shape [layer, 2
            # bundle, x node, y node]
            changes = output.reshape(-1, 2 * self.options.bundle, *self.grid.shape)
            predicted = torch.cat([on_grid, changes], dim=1)
            gathered = self.grid.gather(stencil, predicted).view(
                len(stencil.weight), -1, 2
            )
            on_grid, *accelerations = gathered.unbind(dim=1)
        position = state.position
        velocity = state.velocity[:, -1]
        frames: list[tuple[Tensor, Tensor]] = []
        for acceleration in accelerations:
            velocity = (1.0 - share) * velocity + share * on_grid + acceleration
            if self.projection is not None and state.drawn is not None:
                velocity = self.projection(state.drawn, position + velocity) - position
            velocity = velocity.clamp(
                self.grid.low - position, self.grid.high - position
            )
            # The sum may round to a number beyond the wall.
            position = (position + velocity).clamp(self.grid.low, self.grid.high)
            on_grid = on_grid + acceleration
            frames.append((position, velocity))
        last = torch.stack([one for _, one in frames], dim=1)
        velocities = torch.cat([state.velocity, last], dim=1)[
            :, -self.options.velocities :
        ]
        walls = state.walls[:, min(len(frames), state.walls.shape[1] - 1) :]
        return replace(
            state, position=position, velocity=velocities, walls=walls
        ), frames

    def _pushed(
        self, state: GridState, stencil: Stencil, output: Tensor
    ) -> Sequence[Tensor]:
        """Return the accelerations in the coming frames [length/frame^2], shape
        [particle, 2] each.

        The U-Net's output are stresses of each material in each frame, (xx, xy, yy) /
        STIFF [length cell/frame^2], then accelerations beside walls.
        """
        windows = len(output)
        frames = self.options.bundle
        stress, beside = output.tensor_split(
            [3 * len(self.options.materials) * frames], dim=1
        )
        stress = STIFF * stress.reshape(-1, 3 * frames, *self.grid.shape)
        # one layer for all materials
        shared = self.grid.stencil(state.position, state.sample)
        mass = self.grid.spread(shared, torch.ones_like(state.position[:, :1]), windows)
        filled = self.grid.gather(shared, mass / self.unit) / FULL
        load = filled.clamp(max=1.0).square()  # a surface bears less
        of_particle = self.grid.gather(stencil, stress) * load
        pushed = self.grid.pushed(
            shared, state.position, of_particle.view(-1, frames, 3), mass
        )
        near = (
            1.0 - self.grid.wall_distance(BESIDE * self.grid.spacing).amin(dim=0)
        ).clamp(0.0, 1.0)
        accelerations = self.grid.gather(shared, pushed + near * beside).view(
            -1, frames, 2
        )
        if self.fall is not None:
            accelerations = accelerations + HEAVY * self.change * torch.stack(
                [0.0 * self.fall, self.fall]
            )
        return accelerations.unbind(dim=1)

    def _mean_over_images(self, seen: Tensor) -> Tensor:
        """Return the mean over all images of what the U-Net says of one, turned back.

        A rollout of an image is then the image of the rollout: frame averaging over the
        whole group (Puny et al. 2022, arXiv 2110.03336).
        """
        options = self.options
        outputs = []
        for matrix in images(options.symmetry):
            if options.wall_velocity:
                forcing = [matrix] * options.bundle
            else:
                forcing = []
            blocks = [*self._turn(matrix), torch.eye(options.context), *forcing]
            said = self.network(field_image(seen, matrix, blocks))
            inner = len(options.materials) * options.bundle
            back = [matrix.T] * inner
            if options.conserve:
                back = [strain_image(matrix.T)] * inner + [matrix.T] * options.bundle
            outputs.append(field_image(said, matrix.T, back))
        return torch.stack(outputs).mean(dim=0)

    def _turn(self, matrix: Tensor) -> list[Tensor]:
        """Return what an image does to the channels of :meth:`_fields`, blocks of a
        diagonal matrix.
        """
        one = [torch.ones(1, 1), *[matrix] * self.options.velocities]
        one += [strain_image(matrix)] if self.options.strain else []
        return [*one * len(self.options.materials), wall_permutation(matrix)]

    def _fields(self, state: GridState, stencil: Stencil) -> tuple[Tensor, Tensor]:
        """Return what the U-Net sees of the particles, and the last velocity on the
        grid [length/frame].

        Velocities are told as the last one and the changes before it, each in its own
        unit.
        """
        windows = len(state.walls)
        layers = windows * len(self.options.materials)
        carried = [torch.ones_like(state.position[:, :1]), state.velocity.flatten(1)]
        if state.rest is not None:
            carried.append(state.rest.strain(state.position))
        sums = self.grid.spread(stencil, torch.cat(carried, dim=1), layers)
        weight = sums[:, :1] / self.unit
        means = sums[:, 1:] / self.unit / weight.clamp(min=EMPTY)
        shown = 2 * self.options.velocities
        velocity = means[:, :shown].reshape(layers, -1, 2, *self.grid.shape)
        changes = velocity.diff(dim=1) / self.change
        seen = torch.cat(
            [
                weight,
                velocity[:, -1] / self.speed,
                changes.flatten(1, 2),
                means[:, shown:],
            ],
            dim=1,
        )
        geometry = self.geometry.expand(windows, -1, -1, -1)
        fields = torch.cat(
            [seen.reshape(windows, -1, *self.grid.shape), geometry], dim=1
        )
        if not self.options.mixture:
            return fields, velocity[:, -1]
        kinds = len(self.options.materials)
        whole = (
            sums[:, : 1 + shown].view(windows, kinds, -1, *self.grid.shape).sum(dim=1)
            / self.unit
        )
        mean = whole[:, -2:] / whole[:, :1].clamp(min=EMPTY)
        return fields, mean.repeat_interleave(kinds, dim=0)
