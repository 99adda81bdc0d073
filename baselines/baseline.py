"""The contract of a baseline: loss terms of a batch, and a rollout step by step.

A baseline is one file: a subclass of :class:`Baseline` with its options. An entry point
of the group ``lagbench.baselines`` names it. Training, checkpoints, rollouts,
predictions and scores then work without another line. A baseline may know the public
figures of a data set in datasets.yaml, and never a test scenario.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Self

import torch
from pydantic import BaseModel, ConfigDict, Field, model_validator
from torch import Tensor, nn

from lagbench.data.box import Box, parse_periodic
from lagbench.errors import UsageError
from lagbench.tensors import Batch as Batch
from lagbench.tensors import TensorBox


class Settings(BaseModel):
    """Base of the options that recipes and ``--set`` fill; unknown keys are errors."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class Options(Settings):
    """Base of the options of a model.

    Class attributes:
        in_training: names of options of the training. A trained model refuses changes
            of them.
        of_weights: names of options that say what weights mean where the shapes of the
            weights do not. A trained model refuses changes of them too.
        retired: options that weights of earlier versions state, with the value that
            each of them had where it did nothing.
    """

    in_training: ClassVar[frozenset[str]] = frozenset()
    of_weights: ClassVar[frozenset[str]] = frozenset()
    retired: ClassVar[Mapping[str, object]] = {}

    @model_validator(mode="before")
    @classmethod
    def _drop_retired(cls, values: object) -> object:
        if not isinstance(values, Mapping):
            return values
        return {
            name: value
            for name, value in values.items()
            if cls.retired.get(name, ...) != value
        }


class Baseline(nn.Module):
    """A surrogate: the next positions from the last ones.

    Class attributes:
        Options: the model's options, a subclass of :class:`Options`; recipes fill it.
        method: name of the model on the board.
        any_size: whether weights of one size can be run at another, with other
            particles and other distances.
        any_box: whether the model knows periodic boxes as well as walls, and three
            dimensions as well as two.
        computes_on_cpu: whether its rollouts compute on the CPU, on whatever device the
            batch lies, as solvers in NumPy do. Predictions then stay on the CPU.
        closed_form: whether the model is fitted as a whole instead of trained step by
            step. It then has a method ``fit`` beside the contract. ``fit(scenarios)``
            gets an iterator over the scenarios of train. Each is a batch of a single
            window of all frames, with what its file states beside the positions. The
            method sets buffers of the model and returns numbers to log, by name.
            Nothing calls :meth:`forward`.
        knows_wall_particles: whether the model holds particles of the material ``wall``
            at their places. Others refuse such data.

    Args:
        options: the model's options.
        info: public figures of the data set.
    """

    Options: ClassVar[type[Options]] = Options
    method: ClassVar[str]
    any_size: ClassVar[bool] = False
    any_box: ClassVar[bool] = False
    computes_on_cpu: ClassVar[bool] = False
    closed_form: ClassVar[bool] = False
    knows_wall_particles: ClassVar[bool] = False

    def __init__(self, options: Any, info: DatasetInfo) -> None:  # noqa: ANN401 (each has its own)
        super().__init__()
        is_walled_square = info.box.dimension == 2 and not info.box.is_periodic
        if not (self.any_box or is_walled_square):
            raise UsageError(
                f"{self.method} knows boxes of two dimensions between walls only; "
                "train neuralmpm, or a graph network such as gns; or state any_box = "
                "True in its class",
                where=f"the box of {info.split} {info.size}",
            )
        if info.wall_particles and not self.knows_wall_particles:
            raise UsageError(
                f"{self.method} knows no particles of walls; train neuralmpm or a "
                "graph network such as gns, or import the data without them: --kinds "
                "KIND=drop",
                where=f"{info.split} {info.size}",
            )
        self.options = options
        self.info = info
        self.box = TensorBox(info.box)

    @classmethod
    def build(cls, options: Mapping[str, object], info: DatasetInfo) -> Self:
        """Return an untrained model; options are checked by pydantic."""
        return cls(cls.Options.model_validate(dict(options)), info)

    @property
    def forcing_seen(self) -> frozenset[str] | None:
        """What the model sees of "body_force" and "obstacle", by the names in batches.

        A training warns of what drives the flow and is not seen. None means that the
        model does not say; then nothing warns.
        """
        return None

    @property
    @abstractmethod
    def history(self) -> int:
        """Frames that a training window gives to the model, before those to predict."""

    @property
    def future(self) -> int:
        """Frames to predict of a training window: 1, or more with rollout losses."""
        return 1

    @property
    def origin(self) -> bool:
        """Whether training windows hold the positions in the scenario's first frame."""
        return False

    @abstractmethod
    def forward(
        self, batch: Batch, generator: torch.Generator | None = None
    ) -> dict[str, Tensor]:
        """Return every term of the training loss; the training applies the weights.

        All mathematics of the model in a training step happen here, so that DDP sees
        them.

        Args:
            batch: windows of ``history + future`` frames.
            generator: source of noise; none is added when None (validation).
        """

    @property
    def weights(self) -> Mapping[str, float]:
        """Weight of each loss term.

        A term without a weight has weight 1; a term of weight 0 is only logged.
        """
        return {}

    def compile_layers(self) -> None:
        """Compile the layers that a training step repeats, in place.

        Raises:
            UsageError: the model has no layers to compile; this is the default.
        """
        raise UsageError(
            f"{self.method} has no layers to compile; leave the option out",
            where="training.compile",
        )

    @abstractmethod
    def start(self, given: Batch) -> Any:  # noqa: ANN401 (each model has its own state)
        """Return the state of a rollout from the given frames, at least two of them."""

    @abstractmethod
    def advance(self, state: Any) -> tuple[Any, Tensor]:  # noqa: ANN401
        """Return the next state and positions [length], shape [particle, axis]."""


def count_parameters(model: Baseline) -> int:
    """Return how many numbers of a model are trained.

    These are its parameters, or the coefficients of a closed form.
    """
    count = 0
    if model.closed_form:
        for tensor in model.state_dict().values():
            if tensor.is_floating_point():
                count += tensor.numel()
        return count
    for parameter in model.parameters():
        if parameter.requires_grad:
            count += parameter.numel()
    return count


def last_velocities(position: Tensor, count: int, box: TensorBox) -> Tensor:
    """Return the last velocities of given frames, oldest first.

    They have shape [particle, count, axis] and the unit length/frame. Where the frames
    are few, the first velocity repeats.

    Args:
        position: given frames [length], shape [particle, frame, axis].
        count: number of velocities.
        box: box that holds the particles.

    Raises:
        UsageError: there are fewer than two frames.
    """
    frames = position[:, -count - 1 :]
    velocity = box.displacement(frames[:, :-1], frames[:, 1:])
    if not velocity.shape[1]:
        raise UsageError(
            f"too few frames to start from: got {position.shape[1]}, expected 2 or "
            f"more, {count + 1} for all"
        )
    missing_count = count - velocity.shape[1]
    first_velocity = velocity[:, :1]
    repeated = first_velocity.expand(-1, missing_count, -1)
    return torch.cat([repeated, velocity], dim=1)


def check_moving_walls(sees_wall_velocity: bool, info: DatasetInfo) -> None:
    """Refuse a model that sees the velocities of walls where no wall moves."""
    if sees_wall_velocity and not info.moving_walls:
        raise UsageError(
            f"the walls of {info.split} do not move; leave the option out",
            where="model.wall_velocity",
        )


# Checkpoints hold these values. A checkpoint may come from a stranger, so a name must
# not be a path.
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$")]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Count = Annotated[int, Field(gt=0, lt=10**12)]
Pair = tuple[Finite, Finite]


@dataclass(frozen=True, kw_only=True)
class DatasetInfo:
    """Public figures of one size of a split; every checkpoint holds them."""

    split: Name  # name of the split
    size: Name  # name of the size
    version: str  # semantic version of the split
    dataset_sha256: str  # hash of the data set
    particles: Count  # particles in one scenario
    # box that holds the particles, (low, high) along each axis [length]
    bounds: Annotated[tuple[Pair, ...], Field(min_length=2, max_length=3)]
    radius: Positive  # connectivity radius [length]
    input_frames: Count  # frames given at the start of a test scenario
    horizon: Count  # frames to predict after them
    score_cells: Count  # cells across of the scorer's grid
    score_placement: str  # 'cell_centres' or 'nodes', where that grid's nodes lie
    frame_interval: Positive  # time between frames [s]
    moving_walls: bool  # whether scenario files hold wall_velocity
    # over train: position_mean, position_std [length], velocity_mean, velocity_std
    # [length/frame], acceleration_mean, acceleration_std [length/frame^2], one number
    # for each axis
    statistics: Mapping[str, tuple[Finite, ...]]
    periodic: tuple[str, ...] = ()  # names of the axes that have no walls
    wall_particles: bool = False  # whether walls are particles too

    @property
    def box(self) -> Box:
        """The box that holds the particles."""
        periodic = parse_periodic(self.periodic, len(self.bounds))
        return Box.from_bounds(self.bounds, periodic)


def rescale(trained: DatasetInfo, target: DatasetInfo) -> DatasetInfo:
    """Return the info of a size for weights that were trained at another size.

    Statistics [length, length/frame, length/frame^2] stay those of the training. Bodies
    fill the same area with more or fewer particles, so the radius [length] goes with
    the square root of the area per particle, or the cube root of the volume.
    """
    ratio = trained.particles / target.particles
    radius = trained.radius * math.sqrt(ratio)
    if len(trained.bounds) == 3:
        radius = trained.radius * math.cbrt(ratio)
    return replace(target, radius=radius, statistics=trained.statistics)
