"""The contract of a baseline: loss terms of a batch, and a rollout step by step.

A baseline is one file: a subclass of :class:`Baseline` with its options, named by an entry
point of the group ``lagbench.baselines``. Training, checkpoints, rollouts, predictions and
scores then work without another line.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar, Self

import torch
from pydantic import BaseModel, ConfigDict
from torch import Tensor, nn

from lagbench.errors import UsageError
from lagbench.torch import Batch

from .facts import Facts

__all__ = [
    "Batch",
    "Baseline",
    "Options",
]


class Options(BaseModel):
    """Base of the options of a model: frozen, unknown keys are errors."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class Baseline(nn.Module):
    """A surrogate: the next positions from the last ones.

    Class attributes:
        Options: the model's options, a subclass of :class:`Options`; recipes fill it.
        method: what the board calls it.

    Args:
        options: the model's options.
        facts: public figures of the data set.
    """

    Options: ClassVar[type[Options]] = Options
    method: ClassVar[str]

    def __init__(self, options: Any, facts: Facts) -> None:  # noqa: ANN401 (each has its own)
        super().__init__()
        self.options = options
        self.facts = facts

    @classmethod
    def build(cls, options: Mapping[str, object], facts: Facts) -> Self:
        """Return an untrained model; options are checked by pydantic."""
        return cls(cls.Options.model_validate(dict(options)), facts)

    @property
    @abstractmethod
    def history(self) -> int:
        """Frames that a training window gives to the model, before those that it must predict."""

    @property
    def future(self) -> int:
        """Frames of a training window after the given ones: 1, or more with rollout losses."""
        return 1

    @abstractmethod
    def forward(self, batch: Batch, generator: torch.Generator | None = None) -> dict[str, Tensor]:
        """Return every term of the training loss, raw: weights are applied by the trainer.

        All model mathematics of a training step happen here, so that DDP sees them.

        Args:
            batch: windows of ``history + future`` frames.
            generator: source of noise; none is added when None (validation).
        """

    @property
    def weights(self) -> Mapping[str, float]:
        """Weight of each loss term; terms that are missing have weight 1, weight 0 is only logged."""
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
        """Advance by one frame: the next state and positions [length], shape [particle, 2]."""
