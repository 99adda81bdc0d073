"""The contract of a baseline: loss terms of a batch, and a rollout step by step.

A baseline is one file: a subclass of :class:`Baseline` with its options, named by an
entry point of the group ``lagbench.baselines``. Training, checkpoints, rollouts,
predictions and scores then work without another line. It may know a data set's public
figures, of datasets.yaml, and never a test scenario.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Self

import torch
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ValidatorFunctionWrapHandler,
    field_validator,
)
from torch import Tensor, nn

from lagbench.errors import UsageError
from lagbench.tensors import Batch

__all__ = [
    "Baseline",
    "Batch",
    "Facts",
    "Options",
    "Settings",
    "check_moving_walls",
    "last_velocities",
    "rescaled",
]


class Settings(BaseModel):
    """Base of what recipes and ``--set`` fill: frozen; unknown keys and yes for a
    number are errors.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    @field_validator("*", mode="wrap")
    @classmethod
    def _no_number(cls, value: object, handler: ValidatorFunctionWrapHandler) -> object:
        found: object = handler(value)
        if _counted(value, found):
            raise ValueError("a number, not yes or no")
        return found


def _counted(given: object, found: object) -> bool:
    """Tell whether a yes or no became 1 or 0 anywhere in a value that was checked."""
    if isinstance(given, bool):
        return isinstance(found, int | float) and not isinstance(found, bool)
    if isinstance(given, Mapping) and isinstance(found, Mapping):
        return any(_counted(value, found.get(name)) for name, value in given.items())
    if isinstance(given, list | tuple) and isinstance(found, list | tuple):
        return any(map(_counted, given, found))
    return False


class Options(Settings):
    """Base of the options of a model.

    Class attributes: in_training: names of the options of the training; a trained model
        refuses changes of them. of_weights: names of options that say what weights mean
        where their shapes do not tell; likewise.
    """

    in_training: ClassVar[frozenset[str]] = frozenset()
    of_weights: ClassVar[frozenset[str]] = frozenset()


class Baseline(nn.Module):
    """A surrogate: the next positions from the last ones.

    Class attributes: Options: the model's options, a subclass of :class:`Options`;
        recipes fill it. method: what the board calls it. any_size: whether weights of
        one size can be run at another: other particles, other distances.

    Args:
        options: the model's options.
        facts: public figures of the data set.
    """

    Options: ClassVar[type[Options]] = Options
    method: ClassVar[str]
    any_size: ClassVar[bool] = False

    def __init__(self, options: Any, facts: Facts) -> None:  # noqa: ANN401 (each has its own)
        super().__init__()
        self.options = options
        self.facts = facts

    @classmethod
    def build(cls, options: Mapping[str, object], facts: Facts) -> Self:
        """Return an untrained model; options are checked by pydantic."""
        return cls(cls.Options.model_validate(dict(options)), facts)

    def adapted(
        self, weights: Mapping[str, Tensor], options: Mapping[str, Any]
    ) -> tuple[Mapping[str, Tensor], Mapping[str, Any]]:
        """Return weights that a training starts from, and their options, as this model
        takes them on.

        As they are by default. Weights are refused whose shapes are not this model's,
        or whose options, those returned, differ in what says what weights mean.

        Args:
            weights: parameters and buffers by name, of a model with those options.
            options: plain values by name, without those of the training.
        """
        return weights, options

    @property
    @abstractmethod
    def history(self) -> int:
        """Frames that a training window gives to the model, before those that it must
        predict.
        """

    @property
    def future(self) -> int:
        """Frames of a training window after the given ones: 1, or more with rollout
        losses.
        """
        return 1

    @property
    def origin(self) -> bool:
        """Whether training windows hold the positions in the scenario's first frame."""
        return False

    @abstractmethod
    def forward(
        self, batch: Batch, generator: torch.Generator | None = None
    ) -> dict[str, Tensor]:
        """Return every term of the training loss, raw: weights are applied by the
        trainer.

        All model mathematics of a training step happen here, so that DDP sees them.

        Args:
            batch: windows of ``history + future`` frames.
            generator: source of noise; none is added when None (validation).
        """

    @property
    def weights(self) -> Mapping[str, float]:
        """Weight of each loss term; terms that are missing have weight 1, weight 0 is
        only logged.
        """
        return {}

    def compile_layers(self) -> None:
        """Compile, in place, what a training step repeats.

        Raises:
            UsageError: by default, the model has nothing to compile.
        """
        raise UsageError(
            f"{self.method} has no layers to compile",
            where="training.compile",
            expected="false; true for graph networks",
            got=True,
            fix="leave the option out",
        )

    @abstractmethod
    def start(self, given: Batch) -> Any:  # noqa: ANN401 (each model has its own state)
        """Return the state of a rollout from the given frames, at least two of them."""

    @abstractmethod
    def advance(self, state: Any) -> tuple[Any, Tensor]:  # noqa: ANN401
        """Advance by one frame: the next state and positions [length], shape [particle,
        2].
        """


def last_velocities(position: Tensor, count: int) -> Tensor:
    """Return the last velocities [length/frame], shape [particle, count, 2], oldest
    first, of given frames.

    Where the frames are few, the first velocity repeats.
    """
    velocity = position[:, -count - 1 :].diff(dim=1)
    if not velocity.shape[1]:
        raise UsageError(
            "too few frames to start from",
            expected=f"2 or more, {count + 1} for all",
            got=position.shape[1],
        )
    missing = count - velocity.shape[1]
    return torch.cat([velocity[:, :1].expand(-1, missing, -1), velocity], dim=1)


def check_moving_walls(asked: bool, facts: Facts) -> None:
    """Refuse a model that wants the velocities of walls where none moves."""
    if asked and not facts.moving_walls:
        raise UsageError(
            f"the walls of {facts.split} do not move",
            where="model.wall_velocity",
            expected=False,
            got=True,
            fix="leave the option out",
        )


# Checked where facts are read from a file, which may be a stranger's: names are no
# paths.
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$")]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Count = Annotated[int, Field(gt=0, lt=10**12)]
Pair = tuple[Finite, Finite]


@dataclass(frozen=True, kw_only=True)
class Facts:
    """Public figures of one size of a split; they travel in every checkpoint."""

    split: Name  # name of the split
    size: Name  # name of the size
    version: str  # semantic version of the split
    dataset_sha256: str  # hash of the data set
    particles: Count  # particles in one scenario
    # box that holds the particles, (low, high) along x and y [length]
    bounds: tuple[Pair, Pair]
    radius: Positive  # connectivity radius [length]
    input_frames: Count  # frames given at the start of a test scenario
    horizon: Count  # frames to predict after them
    score_cells: Count  # cells across of the scorer's grid
    score_placement: str  # 'cell_centres' or 'nodes', where that grid's nodes lie
    frame_interval: Positive  # time between frames [s]
    moving_walls: bool  # whether scenario files hold wall_velocity
    # over train: position_mean, position_std [length], velocity_mean, velocity_std
    # [length/frame], acceleration_mean, acceleration_std [length/frame^2], one (x, y)
    # pair each
    statistics: Mapping[str, Pair]


def rescaled(trained: Facts, here: Facts) -> Facts:
    """Return the facts of a size for weights of another: what they multiply stays as it
    was trained.

    Statistics [length, length/frame, length/frame^2] are those of the training. Bodies
    fill the same area with more or fewer particles, so the radius [length] goes with
    the root of that.
    """
    radius = trained.radius * math.sqrt(trained.particles / here.particles)
    return replace(here, radius=radius, statistics=trained.statistics)
