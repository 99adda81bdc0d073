"""Graph networks that move particles: one step from features to positions, rolled out
or trained.

    a = S^-1(network(features(x, v)))        or  v' = S^-1(network(features(x, v)))
    v' = v + a,   x' = x + v'                semi-implicit Euler, time in frames

after Sanchez-Gonzalez et al. (2020) and thesis §§5.6-5.7. Training and rollouts share
:meth:`GraphNetwork.step`. The network's last layer starts at zero: an untrained model
with target acceleration keeps every velocity, and training starts from there.

The loss has six terms of motion, density and flow (thesis Eqs. 5.29-5.35) in normalise
units, as in the thesis: accelerations, velocities and positions over their deviations
in train; the grid's velocities too, so that vorticity and divergence have the unit
1/length; density over that around a particle. Weights are applied by the trainer.
"""

from __future__ import annotations

import enum
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple, Self

import torch
from pydantic import Field
from torch import Tensor, nn

from lagbench.baselines.operators.operator import Losses, Operator
from lagbench.data.grid import Grid, Placement
from lagbench.errors import UsageError

from .augmentation import Symmetry, disturbed
from .baseline import (
    Baseline,
    Batch,
    Facts,
    Options,
    check_moving_walls,
    last_velocities,
)
from .graph import EDGE_FEATURES, NodeFeatures, Scale, edge_features, radius_graph
from .network import EncodeProcessDecode
from .torch_grid import fields, transfer


class Motion(NamedTuple):
    """One frame of particles."""

    position: Tensor  # x(f) [length], shape [particle, 2]
    velocity: Tensor  # x(f) - x(f-1) [length/frame], shape [particle, 2]
    # velocity less that of the frame before, in target and prediction the same frame,
    # which is the model's input [length/frame^2], shape [particle, 2]
    acceleration: Tensor


@dataclass(frozen=True, kw_only=True)
class State:
    """What a step starts from."""

    position: Tensor  # last positions [length], shape [particle, 2]
    # last velocities, oldest first [length/frame], shape [particle, velocities, 2]
    velocity: Tensor
    material: Tensor  # material of each particle, int64, shape [particle]
    sample: Tensor  # window of each particle, ascending, int64, shape [particle]
    # velocity of the walls in the coming frames, the next one first [length/frame],
    # shape [window, frame, 4, 2]; beyond them the last one stays. None where walls rest
    # or do not matter.
    wall_velocity: Tensor | None

    def moved(self, position: Tensor, velocity: Tensor) -> Self:
        """Return the state one frame on."""
        last = torch.cat([self.velocity[:, 1:], velocity.unsqueeze(1)], dim=1)
        walls = self.wall_velocity
        if walls is not None and walls.shape[1] > 1:
            walls = walls[:, 1:]
        return replace(self, position=position, velocity=last, wall_velocity=walls)


PARTICLE_TERMS = ("acceleration", "velocity", "position")
GRID_TERMS = ("density", "divergence", "vorticity")
# the terms of Eq. 5.35, in its order but for positions
TERMS = PARTICLE_TERMS + GRID_TERMS


class LossNorm(enum.StrEnum):
    """The p of the norms: L2 is the squared error, L1 the absolute one."""

    L1 = "l1"
    L2 = "l2"


def mean_norm(
    error: Tensor, norm: LossNorm, count: Tensor | int | None = None
) -> Tensor:
    """Return ``(1/N) sum_i ||e_i||_p`` of normalise errors, shape [..., component]
    (Eqs. 5.29-5.34).

    0 is perfect; N counts particles or nodes, by default those of the array.
    """
    if norm is LossNorm.L2:
        each = error**2
    else:
        each = error.abs()
    return each.sum() / (each[..., 0].numel() if count is None else count)


def loss_terms(
    predicted: Motion,
    target: Motion,
    sample: Tensor,
    *,
    grid: Grid,
    scales: Mapping[str, Tensor],
    norm: LossNorm,
    weights: Mapping[str, float],
) -> dict[str, Tensor]:
    """Return the six terms, raw; those of weight 0 without a graph. Missing weights are
    1.

    Errors are divided by ``scales``, deviations (x, y) by the names in :class:`Motion`.
    """
    terms = {}
    for name in PARTICLE_TERMS:
        with _graph(weights, name):
            error = getattr(predicted, name) - getattr(target, name)
            terms[name] = mean_norm(error / scales[name], norm)
    windows = int(sample[-1]) + 1
    with torch.no_grad():
        sums = transfer(
            target.position, target.velocity, grid, sample=sample, windows=windows
        )
        # A node's weight around a particle, on the average: the full weight of a box
        # that is full, and defined for a splash too, whose area is not known here.
        full = float((sums.weight**2).sum() / sums.weight.sum())
        true = fields(sums, grid, full)
    with _graph(
        weights, *GRID_TERMS
    ):  # the prediction's fields at the nodes that count in the truth
        sums = transfer(
            predicted.position, predicted.velocity, grid, sample=sample, windows=windows
        )
        own = fields(sums, grid, full, true.counted)
    with _graph(weights, "density"):
        terms["density"] = mean_norm((own.density - true.density).unsqueeze(-1), norm)
    count = true.differentiable.sum().clamp(min=1)
    speed = (scales["velocity"] ** 2).mean().sqrt()
    for name in ("divergence", "vorticity"):
        with _graph(weights, name):
            error = (getattr(own, name) - getattr(true, name)) / speed
            terms[name] = mean_norm(error.unsqueeze(-1), norm, count)
    return terms


def _graph(weights: Mapping[str, float], *names: str) -> torch.set_grad_enabled:
    """Record a graph only if one is recorded at all and one of the terms counts."""
    counts = any(weights.get(name, 1.0) != 0.0 for name in names)
    return torch.set_grad_enabled(torch.is_grad_enabled() and counts)


class Target(enum.StrEnum):
    """What the network predicts; untrained, it gives the train mean of it."""

    ACCELERATION = "acceleration"
    VELOCITY = "velocity"


class LossWeights(Options):
    """Weights of Eq. 5.35; a term of weight 0 is logged and not learnt from.

    By default those that count start between 0.01 and 1. Over one step, errors of
    velocity and position are that of acceleration in other units, and density errors
    start at 1e-5: they have weight 0. The thesis weighs all terms by 1.
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
            "forgetful",
            "noise_std",
            "loss",
            "loss_norm",
            "link_weight",
            "rollout_loss_steps",
            "symmetry",
        }
    )
    of_weights = frozenset({"target", "sum_messages"})

    latent: int = Field(default=128, ge=1)  # width of nodes, edges and hidden layers
    layers: int = Field(default=10, ge=1)  # processor layers
    # whether the sums of a node's messages are inputs of its operator; not for GNS,
    # which is the sum itself
    sum_messages: bool = True
    velocities: int = Field(default=5, ge=1)  # last velocities that a particle shows
    # share of training windows that know but some of their last velocities, as rollouts
    # do at their start
    forgetful: float = Field(default=0.0, ge=0.0, le=1.0)
    target: Target = Target.ACCELERATION  # what the network predicts
    # deviation of the noise on the last given velocity, per component [length/frame];
    # some times the one of an acceleration is good: rollouts of models that saw less
    # drift away
    noise_std: float = Field(default=6.7e-4, ge=0.0, allow_inf_nan=False)
    loss: LossWeights = LossWeights()  # weights of the six terms
    loss_norm: LossNorm = LossNorm.L2  # L2 or L1
    # weight of an operator's link prediction; the operator's own when None
    link_weight: float | None = Field(default=None, ge=0.0, allow_inf_nan=False)
    # own steps that the loss is averaged over; gradients pass through all
    rollout_loss_steps: int = Field(default=1, ge=1)
    # whether the velocities of moving walls in the next frame are features
    wall_velocity: bool = False
    # how far a particle sees a wall [radius]; the solver's grid carries a wall's effect
    # beyond one radius
    wall_reach: float = Field(default=3.0, gt=0.0, allow_inf_nan=False)
    # images that training windows are replaced by at random
    symmetry: Symmetry = Symmetry.NONE
    # connectivity radius [length]; the data set's when None
    radius: float | None = Field(default=None, gt=0.0, allow_inf_nan=False)
    # neighbours that a particle hears at most, the nearest; all within the radius when
    # None
    neighbours: int | None = Field(default=None, ge=1)
    # keep particles in the box, and their velocities true to that, in training and in
    # rollouts
    clamp: bool = True


class GraphNetwork(Baseline):
    """A graph network that gathers by an operator; :meth:`with_operator` names it.

    Class attributes:
        operator: what every processor layer gathers by.
    """

    Options = GraphNetworkOptions
    options: GraphNetworkOptions
    any_size = True
    operator: ClassVar[type[Operator]]

    def __init__(self, options: GraphNetworkOptions, facts: Facts) -> None:
        super().__init__(options, facts)
        check_moving_walls(options.wall_velocity, facts)
        if options.link_weight is not None and "link" not in self.operator.weights:
            raise UsageError(
                f"{self.method} predicts no links",
                where="model.link_weight",
                expected="null",
                got=options.link_weight,
                fix="leave the option out, or train supergat",
            )
        noise = options.noise_std
        statistics = facts.statistics
        if options.radius is None:
            self.radius = facts.radius
        else:
            self.radius = options.radius
        self.grid = Grid(facts.score_cells, Placement(facts.score_placement))
        self.position, self.velocity, self.acceleration = (
            Scale(statistics[f"{name}_mean"], statistics[f"{name}_std"], noise=widening)
            for name, widening in (
                ("position", 0.0),
                ("velocity", noise),
                ("acceleration", noise),
            )
        )
        self.features = NodeFeatures(
            facts.bounds,
            self.velocity,
            self.acceleration,
            options.wall_reach * self.radius,
            velocities=options.velocities,
            moving_walls=options.wall_velocity,
        )
        self.network = EncodeProcessDecode(
            self.operator,
            node_features=self.features.count,
            edge_features=EDGE_FEATURES,
            latent=options.latent,
            layers=options.layers,
            sum_messages=options.sum_messages,
        )
        for parameter in self.network.decoder[-1].parameters():
            nn.init.zeros_(parameter)

    @classmethod
    def with_operator(cls, operator: type[Operator]) -> type[GraphNetwork]:
        """Return the graph network with an operator; the same class for the same
        operator.
        """
        key = (cls, operator)
        if key not in _CLASSES:
            names = {
                "operator": operator,
                "method": operator.method,
                "__doc__": operator.__doc__,
            }
            _CLASSES[key] = type(f"{operator.__name__}Network", (cls,), names)
        return _CLASSES[key]

    @property
    def history(self) -> int:
        """One frame more than the velocities that a particle shows."""
        return self.options.velocities + 1

    @property
    def future(self) -> int:
        """Frames to predict in training: as many as the loss has rollout steps."""
        return self.options.rollout_loss_steps

    @property
    def weights(self) -> Mapping[str, float]:
        """Weight of each term of the loss, the operator's own included."""
        own = dict(self.operator.weights)
        if self.options.link_weight is not None:
            own["link"] = self.options.link_weight
        return self.options.loss.model_dump() | own

    def compile_layers(self) -> None:
        """Compile the network's layers."""
        self.network.compile_layers()

    def forward(
        self, batch: Batch, generator: torch.Generator | None = None
    ) -> dict[str, Tensor]:
        """Return the six terms of Eq. 5.35 and the operator's own, raw, means over the
        steps.
        """
        options = self.options
        if generator is not None:
            batch = disturbed(self, batch, generator)
            if options.noise_std > 0.0:
                batch = replace(batch, position=self._inside(batch.position))
        state = self.start(batch.part(slice(self.history)))
        if generator is not None and options.forgetful > 0.0 and options.velocities > 1:
            # Some windows know but their last velocities, of which the first repeats.
            last = options.velocities
            device = generator.device
            forgotten = torch.randint(
                1, last, (batch.windows,), generator=generator, device=device
            )
            forgotten *= (
                torch.rand(batch.windows, generator=generator, device=device)
                < options.forgetful
            )
            first = forgotten.to(state.sample.device)[state.sample, None]
            index = (
                torch.arange(last, device=first.device)
                .expand(len(first), -1)
                .clamp(min=first)
            )
            known = state.velocity.gather(1, index[..., None].expand(-1, -1, 2))
            state = replace(state, velocity=known)
        scales = {name: getattr(self, name).std for name in PARTICLE_TERMS}
        steps = []
        for frame in range(self.history, self.history + self.future):
            following, own = self.step(state, generator)
            target = batch.position[:, frame]
            velocity = target - batch.position[:, frame - 1]
            # both accelerations start from the state's velocity
            before = state.velocity[:, -1]
            predicted = following.velocity[:, -1]
            terms = loss_terms(
                Motion(following.position, predicted, predicted - before),
                Motion(target, velocity, velocity - before),
                state.sample,
                grid=self.grid,
                scales=scales,
                norm=options.loss_norm,
                weights=self.weights,
            )
            if taken := terms.keys() & own.keys():
                raise UsageError(
                    "an operator's loss has the name of one of ours",
                    where=f"{self.operator.__qualname__}.forward",
                    got=", ".join(sorted(taken)),
                    fix="rename it",
                )
            steps.append(terms | dict(own))
            state = following
        return {
            name: torch.stack([terms[name] for terms in steps]).mean()
            for name in steps[0]
        }

    def start(self, given: Batch) -> State:
        """Return the state after the given frames; where they are few, the first
        velocity repeats.
        """
        walls = None
        if self.options.wall_velocity and given.wall_velocity is not None:
            known = given.wall_velocity.shape[1]
            walls = (
                given.wall_velocity[:, min(given.frames, known - 1) :]
                * self.facts.frame_interval
            )
        return State(
            position=given.position[:, -1],
            velocity=last_velocities(given.position, self.options.velocities),
            material=given.material,
            sample=given.sample,
            wall_velocity=walls,
        )

    def advance(self, state: State) -> tuple[State, Tensor]:
        """Advance by one frame: the next state and positions [length], shape [particle,
        2].
        """
        following, _ = self.step(state)
        return following, following.position

    def step(
        self, state: State, generator: torch.Generator | None = None
    ) -> tuple[State, Losses]:
        """Return the state one frame on and the operator's own losses."""
        output, own = self.predict(state, self.edges(state), generator)
        if self.options.target is Target.VELOCITY:
            velocity = self.velocity.inverse(output)
        else:
            velocity = state.velocity[:, -1] + self.acceleration.inverse(output)
        position = state.position + velocity
        inside = self._inside(position)
        return state.moved(inside, velocity + (inside - position).detach()), own

    def edges(self, state: State) -> Tensor:
        """Search the neighbours: senders and receivers, int64, shape [2, edge]."""
        most = self.options.neighbours
        return radius_graph(
            state.position.detach(), self.radius, state.sample, most=most
        )

    def predict(
        self, state: State, edge_index: Tensor, generator: torch.Generator | None = None
    ) -> tuple[Tensor, Losses]:
        """Return the standardised target [1], shape [particle, 2], and the operator's
        own losses.
        """
        if state.wall_velocity is None:
            walls = None
        else:
            walls = state.wall_velocity[:, 0][state.sample]
        node = self.features(state.position, state.velocity, state.material, walls)
        edge = edge_features(state.position, edge_index, self.radius)
        output: tuple[Tensor, Losses] = self.network(node, edge_index, edge, generator)
        return output

    def _inside(self, position: Tensor) -> Tensor:
        """Return positions in the box, with the gradient of those given: a wall would
        stop it.
        """
        if not self.options.clamp:
            return position
        low, high = position.new_tensor(self.facts.bounds).T
        return position.detach().clamp(low, high) + (position - position.detach())


_CLASSES: dict[tuple[type[GraphNetwork], type[Operator]], type[GraphNetwork]] = {}
