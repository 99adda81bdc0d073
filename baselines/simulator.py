"""Graph networks that move particles: one step of features, network and integration.

    a = S^-1(network(features(x, v)))
    v' = v + a,   x' = x + v'                semi-implicit Euler, time in frames

after Sanchez-Gonzalez et al. (2020) and thesis sections 5.6 and 5.7. Training and
rollouts share :meth:`GraphNetwork.step`. The network's last layer starts at zero. So an
untrained model adds the mean acceleration of train to every velocity.

The loss has terms of motion (acceleration, velocity and position), and in boxes of two
dimensions without a periodic axis also of density and flow (divergence and vorticity),
after Eqs. 5.29-5.35 of the thesis. The terms are normalised: accelerations, velocities
and positions by their deviations in train, widened by the noise; the velocities on the
grid too, so that vorticity and divergence have the unit 1/length; density by that
around a particle. The training applies the weights.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple, Self

import torch
from pydantic import Field
from torch import Tensor, nn

from lagbench.baselines.operators.operator import Losses, Operator
from lagbench.data import WALL
from lagbench.data.grid import COUNTED_SHARE, EMPTY_SHARE
from lagbench.errors import UsageError

from .augmentation import Symmetry, augment, velocity_towards_path
from .baseline import (
    Baseline,
    Batch,
    DatasetInfo,
    Options,
    check_moving_walls,
    last_velocities,
)
from .deviations import root_mean_square
from .forcing import ForcingFeatures, skip_frames
from .free_flight import FreeFlight
from .graph import (
    NodeFeatures,
    Standardisation,
    edge_features,
    radius_graph,
)
from .network import EncodeProcessDecode, LayeredNetwork
from .particle_grid import ParticleGrid, score_grid
from .relaxation import Relaxation


class Motion(NamedTuple):
    """One frame of particles."""

    position: Tensor  # x(f) [length], shape [particle, axis]
    velocity: Tensor  # x(f) - x(f-1) [length/frame], shape [particle, axis]
    # velocity less that of the frame before [length/frame^2], shape [particle, axis];
    # in target and prediction that is the same frame, the model's input
    acceleration: Tensor


@dataclass(frozen=True, kw_only=True)
class ParticleState:
    """Input of a step."""

    position: Tensor  # last positions [length], shape [particle, axis]
    # last velocities, oldest first [length/frame], shape [particle, velocities, axis]
    velocity: Tensor
    material: Tensor  # material of each particle, int64, shape [particle]
    sample: Tensor  # window of each particle, ascending, int64, shape [particle]
    # velocity of the walls in the coming frames, the next one first [length/frame],
    # shape [window, frame, wall, axis]; beyond them the last one stays. None where
    # walls rest or the model does not see them.
    wall_velocity: Tensor | None
    # force on layers along y in the coming frames, the next one first
    # [length/frame^2], shape [window, frame, layer, axis]; beyond them the last one
    # stays. None where the model does not see it.
    body_force: Tensor | None = None
    # centre and radius of each window's obstacle [length], shape [window, axis + 1];
    # None where the model does not see it
    obstacle: Tensor | None = None
    # largest density that relaxation leaves alone [1], shape [window]; None before the
    # first step of a rollout, and without relaxation
    density_limit: Tensor | None = None

    def move(self, position: Tensor, velocity: Tensor) -> Self:
        """Return the state one frame on."""
        later_velocities = self.velocity[:, 1:]
        last_velocity = velocity.unsqueeze(1)
        velocities = torch.cat([later_velocities, last_velocity], dim=1)
        wall_velocity = self.wall_velocity
        if wall_velocity is not None:
            wall_velocity = skip_frames(wall_velocity)
        body_force = self.body_force
        if body_force is not None:
            body_force = skip_frames(body_force)
        return replace(
            self,
            position=position,
            velocity=velocities,
            wall_velocity=wall_velocity,
            body_force=body_force,
        )


PARTICLE_TERMS = ("acceleration", "velocity", "position")
GRID_TERMS = ("density", "divergence", "vorticity")
# the terms of Eq. 5.35, in its order but for positions
TERMS = PARTICLE_TERMS + GRID_TERMS


def loss_terms(
    predicted: Motion,
    target: Motion,
    sample: Tensor,
    *,
    grid: ParticleGrid | None,
    scales: Mapping[str, Tensor],
) -> dict[str, Tensor]:
    """Return the terms of the loss without their weights (Eqs. 5.29-5.34, p = 2).

    A term is ``(1/N) sum_i ||e_i||^2`` of normalised errors at N particles or nodes.
    Density is over the mean node weight around a true particle: that is the full weight
    of a box that is full, and it is defined for a splash too. Divergence and vorticity
    count at nodes whose four neighbours have enough true matter.

    Args:
        predicted: predicted motion.
        target: true motion.
        sample: window of each particle, ascending, shape [particle].
        grid: grid of density, divergence and vorticity; None leaves them out.
        scales: deviations of errors, one along each axis, by the names in
            :class:`Motion`.
    """
    terms: dict[str, Tensor] = {}
    for name in PARTICLE_TERMS:
        error = (getattr(predicted, name) - getattr(target, name)) / scales[name]
        terms[name] = (error**2).sum() / len(error)
    if grid is None:
        return terms

    with torch.no_grad():
        weight, momentum = grid.momenta(target.position, target.velocity, sample)
        full = (weight**2).sum() / weight.sum()
        is_counted = weight >= COUNTED_SHARE * full
        along_x = is_counted[:, 2:, 1:-1] & is_counted[:, :-2, 1:-1]
        along_y = is_counted[:, 1:-1, 2:] & is_counted[:, 1:-1, :-2]
        is_inner = along_x & along_y
        true_velocity = _node_velocity(weight, momentum, full)
    predicted_weight, momentum = grid.momenta(
        predicted.position, predicted.velocity, sample
    )
    density_error = (predicted_weight - weight) / full
    terms["density"] = (density_error**2).sum() / density_error.numel()

    error = _node_velocity(predicted_weight, momentum, full) - true_velocity
    slope_x, slope_y = grid.slopes(error)
    node_count = is_inner.sum().clamp(min=1)
    variance = (scales["velocity"] ** 2).mean()
    for name, rates in (
        ("divergence", slope_x[:, 0] + slope_y[:, 1]),
        ("vorticity", slope_x[:, 1] - slope_y[:, 0]),
    ):
        terms[name] = ((rates * is_inner) ** 2).sum() / variance / node_count
    return terms


def _node_velocity(weight: Tensor, momentum: Tensor, full: Tensor) -> Tensor:
    """Return mean velocities at the nodes, 0 where there is hardly any matter."""
    is_filled = (weight >= EMPTY_SHARE * full) & (weight > 0.0)
    # Empty nodes divide by 1: a quotient that `where` drops must not have an infinite
    # gradient.
    divisor = torch.where(is_filled, weight, 1.0)
    return torch.where(is_filled[:, None], momentum / divisor[:, None], 0.0)


WALL_REACH = 3.0
"""How far a particle sees a wall [radius]: the solver's grid carries its effect."""


class LossWeights(Options):
    """Weights of Eq. 5.35; a term of weight 0 is logged and not learnt from.

    With the default weights, the weighted terms start between 0.01 and 1. Over one
    step, errors of velocity and position are that of acceleration in other units, and
    density errors start at 1e-5: they have weight 0. The thesis weighs all terms by
    1.
    """

    acceleration: float = Field(default=0.5, ge=0.0, allow_inf_nan=False)
    velocity: float = Field(default=0.0, ge=0.0, allow_inf_nan=False)
    position: float = Field(default=0.0, ge=0.0, allow_inf_nan=False)
    density: float = Field(default=0.0, ge=0.0, allow_inf_nan=False)
    divergence: float = Field(default=0.1, ge=0.0, allow_inf_nan=False)
    vorticity: float = Field(default=0.1, ge=0.0, allow_inf_nan=False)


class GraphNetworkOptions(Options):
    """Options of a graph network."""

    in_training = frozenset(
        {
            "noise_std",
            "noise_spread",
            "loss",
            "pushforward",
            "recovery",
            "symmetry",
        }
    )
    of_weights = frozenset({"body_force", "obstacle"})
    retired: ClassVar[Mapping[str, object]] = {
        "forgetful": 0.0,
        "compression": 0.0,
        "loss_norm": "l2",
        "link_weight": None,
        "neighbours": None,
        "clamp": True,
        "target": "acceleration",
        "sum_messages": True,
        "wall_reach": 3.0,
        "rollout_loss_steps": 1,
    }

    latent: int = Field(default=128, ge=1)  # width of nodes, edges and hidden layers
    layers: int = Field(default=10, ge=1)  # processor layers
    velocities: int = Field(default=5, ge=1)  # last velocities that a particle shows
    # deviation of the noise on the last given velocity, per component [length/frame];
    # with noise_spread the largest one. Rollouts drift away with little noise, and
    # single steps get worse with much: docs/baselines.md has figures
    noise_std: float = Field(default=6.7e-4, ge=0.0, allow_inf_nan=False)
    # whether each window draws the deviation of its noise, from none to noise_std: the
    # model then learns from true states and from far ones
    noise_spread: bool = False
    loss: LossWeights = LossWeights()  # weights of the terms
    # largest number of own steps, without gradients, before the step whose error
    # counts: training then sees states of rollouts
    pushforward: int = Field(default=0, ge=0)
    # each frame the gap to the true path is to close by 1/recovery of it: a third is
    # left after so many frames; None asks for true velocities alone
    recovery: float | None = Field(default=None, gt=1.0, allow_inf_nan=False)
    # whether the velocities of moving walls in the next frame are features
    wall_velocity: bool = False
    # whether the force per unit mass at a particle in the next frame is a feature
    body_force: bool = False
    # whether distance and direction of an obstacle's surface are features; it is seen
    # as far as a wall
    obstacle: bool = False
    # training windows are replaced by random ones of these mirror images
    symmetry: Symmetry = Symmetry.NONE
    # connectivity radius [length]; the data set's when None
    radius: float | None = Field(default=None, gt=0.0, allow_inf_nan=False)
    # how far matter acts on matter; walls act half as far [radius]. A body that nothing
    # reaches gets one learned mean acceleration. None leaves it to the network.
    free_flight: float | None = Field(default=None, gt=0.0, allow_inf_nan=False)
    # iterations after each step of a rollout that move crowded particles apart; 0 for
    # none
    relaxation: int = Field(default=0, ge=0)
    # largest density that they leave alone, over the mean of the last given frame
    densest: float = Field(default=1.1, gt=1.0, allow_inf_nan=False)


class GraphNetwork(Baseline):
    """A graph network with an operator; :meth:`with_operator` makes its class.

    Class attributes:
        operator: the aggregation of every processor layer.
    """

    Options = GraphNetworkOptions
    options: GraphNetworkOptions
    any_size = True
    any_box = True
    knows_wall_particles = True
    operator: ClassVar[type[Operator]]

    def __init__(self, options: GraphNetworkOptions, info: DatasetInfo) -> None:
        super().__init__(options, info)
        self._check_options()
        self.radius = info.radius
        if options.radius is not None:
            self.radius = options.radius
        self.grid = score_grid(info)
        # Noise on the inputs widens velocities and accelerations.
        noise = options.noise_std
        self.position = self._standardisation("position", noise=0.0)
        self.velocity = self._standardisation("velocity", noise=noise)
        self.acceleration = self._standardisation("acceleration", noise=noise)
        wall_reach = WALL_REACH * self.radius
        self.features = NodeFeatures(
            info.bounds,
            self.velocity,
            self.acceleration,
            wall_reach,
            velocities=options.velocities,
            moving_walls=options.wall_velocity,
            periodic=info.box.periodic,
            wall_particles=info.wall_particles,
        )
        self.forcing = ForcingFeatures(
            info,
            body_force=options.body_force,
            obstacle=options.obstacle,
            force_unit=self.acceleration_std,
            reach=wall_reach,
        )
        self.network = self._make_network()
        self.free_flight: FreeFlight | None = None
        if options.free_flight is not None:
            self.free_flight = FreeFlight(
                info,
                reach=options.free_flight * self.radius,
                unit=self.acceleration_std,
            )
        self.relaxation: Relaxation | None = None
        if options.relaxation:
            self.relaxation = Relaxation(
                self.box,
                radius=self.radius,
                iterations=options.relaxation,
                densest=options.densest,
            )

    def _make_network(self) -> LayeredNetwork:
        """Return the network with new weights; untrained it returns zeros."""
        network = EncodeProcessDecode(
            self.operator,
            node_features=self.features.count + self.forcing.count,
            edge_features=self.info.box.dimension + 1,
            outputs=self.info.box.dimension,
            latent=self.options.latent,
            layers=self.options.layers,
        )
        last_layer = network.decoder[-1]
        for parameter in last_layer.parameters():
            nn.init.zeros_(parameter)
        return network

    def _check_options(self) -> None:
        """Refuse options that contradict each other, the data or the operator.

        Raises:
            UsageError: they do; it names the option.
        """
        options = self.options
        check_moving_walls(options.wall_velocity, self.info)
        box = self.info.box
        is_forced = options.body_force or options.obstacle
        contradictions = (
            (
                options.radius is not None and not box.allows_radius(options.radius),
                f"radius is above half of the shortest period, {box.largest_radius:g}",
            ),
            (
                options.noise_spread and options.noise_std == 0.0,
                "noise_spread needs model.noise_std above 0",
            ),
            (
                options.free_flight is not None and is_forced,
                "free_flight knows no force but gravity, and no obstacle",
            ),
        )
        for is_contradiction, words in contradictions:
            if is_contradiction:
                raise UsageError(f"model.{words}", where=self.method)

    @property
    def forcing_seen(self) -> frozenset[str]:
        """What the options ask for."""
        return self.forcing.names

    @property
    def acceleration_std(self) -> float:
        """Deviation of true accelerations, of one component [length/frame^2]."""
        return root_mean_square(self.info.statistics["acceleration_std"])

    def _standardisation(self, name: str, *, noise: float) -> Standardisation:
        statistics = self.info.statistics
        mean = statistics[f"{name}_mean"]
        std = statistics[f"{name}_std"]
        return Standardisation(mean, std, noise=noise)

    @classmethod
    def with_operator(cls, operator: type[Operator]) -> type[GraphNetwork]:
        """Return the class of the graph network with an operator.

        It is the same class for the same operator.
        """
        key = (cls, operator)
        if key not in _CLASSES:
            attributes = {
                "operator": operator,
                "method": operator.method,
                "__doc__": operator.__doc__,
            }
            _CLASSES[key] = type(f"{operator.__name__}Network", (cls,), attributes)
        return _CLASSES[key]

    @property
    def history(self) -> int:
        """One frame more than the velocities that a particle shows."""
        return self.options.velocities + 1

    @property
    def future(self) -> int:
        """Frames to predict in training, with gradients and without."""
        return 1 + self.options.pushforward

    @property
    def weights(self) -> Mapping[str, float]:
        """Weight of each term of the loss, the operator's own included."""
        return self.options.loss.model_dump() | dict(self.operator.weights)

    def compile_layers(self) -> None:
        """Compile the network's layers."""
        self.network.compile_layers()

    def forward(
        self, batch: Batch, generator: torch.Generator | None = None
    ) -> dict[str, Tensor]:
        """Return the terms of the loss (Eq. 5.35) and the operator's own, unweighted.

        In three dimensions, and with periodic axes, only the terms of particles exist.
        With ``recovery`` the target is the true velocity plus the velocity that leads
        back to the true path.

        Args:
            batch: windows of frames.
            generator: draws noise, and the number of steps before the one that counts;
                None for a validation, which has neither.
        """
        options = self.options
        if generator is not None:
            batch = augment(self, batch, generator, noise_spread=options.noise_spread)
            if options.noise_std > 0.0:
                position = self.box.inside(batch.position)
                batch = replace(batch, position=position)
        state = self.start(batch.part(slice(self.history)))
        frame = self.history  # the frame whose error counts
        if generator is not None and options.pushforward:
            end = options.pushforward + 1
            drawn = torch.randint(end, (), generator=generator, device=generator.device)
            # Operators have losses of their own in training only; nobody needs them
            # here.
            was_training = self.training
            self.eval()
            with torch.no_grad():
                for _ in range(int(drawn)):
                    state, _ = self.advance(state)
            self.train(was_training)
            frame += int(drawn)
        following, operator_losses = self.step(state, generator)

        target_position = batch.position[:, frame]
        true_position = batch.position[:, frame - 1]
        target_velocity = self.box.displacement(true_position, target_position)
        if options.recovery is not None:
            gap = self.box.displacement(state.position.detach(), true_position)
            way_back = velocity_towards_path(
                gap, options.recovery, acceleration_std=self.acceleration_std
            )
            target_velocity = target_velocity + way_back
        # Both accelerations start from the state's velocity.
        last_velocity = state.velocity[:, -1]
        target_acceleration = target_velocity - last_velocity
        target = Motion(target_position, target_velocity, target_acceleration)
        velocity = following.velocity[:, -1]
        predicted = Motion(following.position, velocity, velocity - last_velocity)
        scales = {
            "acceleration": self.acceleration.std,
            "velocity": self.velocity.std,
            "position": self.position.std,
        }
        terms = loss_terms(
            predicted, target, state.sample, grid=self.grid, scales=scales
        )
        return {**terms, **operator_losses}

    def start(self, given: Batch) -> ParticleState:
        """Return the state after the given frames.

        Where they are few, the first velocity repeats.
        """
        walls = None
        if self.options.wall_velocity and given.wall_velocity is not None:
            known_frames = given.wall_velocity.shape[1]
            next_frame = min(given.frames, known_frames - 1)
            per_second = given.wall_velocity[:, next_frame:]
            walls = per_second * self.info.frame_interval
        return ParticleState(
            position=given.position[:, -1],
            velocity=last_velocities(given.position, self.options.velocities, self.box),
            material=given.material,
            sample=given.sample,
            wall_velocity=walls,
            body_force=self.forcing.coming_force(given),
            obstacle=self.forcing.find_obstacle(given),
        )

    def advance(self, state: ParticleState) -> tuple[ParticleState, Tensor]:
        """Return the next state and positions [length], shape [particle, axis]."""
        following, _ = self.step(state)
        if self.relaxation is None:
            return following, following.position
        limit = state.density_limit
        if limit is None:  # the first step of a rollout
            limit = self.relaxation.limit(state.position, state.sample)
        obstacle = None
        if following.obstacle is not None:
            obstacle = following.obstacle[following.sample]
        position = self.relaxation(
            following.position, following.sample, limit, obstacle
        )
        correction = self.box.displacement(following.position, position)
        velocity = following.velocity.clone()
        velocity[:, -1] += correction
        held = self._hold_walls(state, position, velocity[:, -1])
        position, velocity[:, -1] = held
        following = replace(
            following, position=position, velocity=velocity, density_limit=limit
        )
        return following, position

    def step(
        self, state: ParticleState, generator: torch.Generator | None = None
    ) -> tuple[ParticleState, Losses]:
        """Return the state one frame on and the operator's own losses."""
        edge_index = self.find_edges(state)
        output, losses = self.predict(state, edge_index, generator)
        last_velocity = state.velocity[:, -1]
        velocity = last_velocity + self.acceleration.inverse(output)
        if self.free_flight is not None:
            acceleration = self.free_flight(
                velocity - last_velocity, state.position, last_velocity, state.sample
            )
            velocity = last_velocity + acceleration

        position = state.position + velocity
        constant = position.detach()
        inside = self.box.inside(constant)
        if state.obstacle is not None:
            inside = self.box.outside(inside, state.obstacle[state.sample])
        # with the gradient of the position: a clamp would have none at a wall
        inside = inside + (position - constant)
        correction = self.box.displacement(position, inside)
        velocity = velocity + correction.detach()
        inside, velocity = self._hold_walls(state, inside, velocity)
        return state.move(inside, velocity), losses

    def _hold_walls(
        self, state: ParticleState, position: Tensor, velocity: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return positions and velocities, those of walls as they were and zero."""
        if not self.info.wall_particles:
            return position, velocity
        is_wall = (state.material == WALL)[:, None]
        return (
            torch.where(is_wall, state.position, position),
            torch.where(is_wall, 0.0, velocity),
        )

    def find_edges(self, state: ParticleState) -> Tensor:
        """Return senders and receivers of neighbours, int64, shape [2, edge]."""
        return radius_graph(
            state.position.detach(),
            self.radius,
            state.sample,
            box=self.info.box,
        )

    def predict(
        self,
        state: ParticleState,
        edge_index: Tensor,
        generator: torch.Generator | None = None,
    ) -> tuple[Tensor, Losses]:
        """Return the standardised target [1], shape [particle, axis], and losses.

        The losses are those of the operator.
        """
        node = self._node_features(state)
        edge = edge_features(state.position, edge_index, self.radius, self.box)
        output: tuple[Tensor, Losses] = self.network(node, edge_index, edge, generator)
        return output

    def _node_features(self, state: ParticleState) -> Tensor:
        """Return the features of each particle [1], shape [particle, feature]."""
        walls = None
        if state.wall_velocity is not None:
            next_frame = state.wall_velocity[:, 0]
            walls = next_frame[state.sample]
        node: Tensor = self.features(
            state.position, state.velocity, state.material, walls
        )
        if not self.forcing.count:
            return node
        return torch.cat([node, self._forcing_features(state)], dim=1)

    def _forcing_features(self, state: ParticleState) -> Tensor:
        """Return the features of force and obstacle [1], shape [particle, feature]."""
        force = None
        if state.body_force is not None:
            force = state.body_force[:, 0]
        features: Tensor = self.forcing(
            state.position, state.sample, force, state.obstacle
        )
        return features


_CLASSES: dict[tuple[type[GraphNetwork], type[Operator]], type[GraphNetwork]] = {}
