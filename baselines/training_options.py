"""How a model is trained: the budget, the optimiser, and how often it is looked at."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, model_validator

__all__ = ["Schedule", "TrainingOptions"]


class _Strict(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Schedule(_Strict):
    """Learning rate over the steps, as a factor on the recipe's rate.

    ``constant`` 1; ``cosine`` (1 + cos(pi t)) / 2 falling to ``floor``, t from 0 to 1 after the
    warm-up; ``exponential`` factor^(step / every). A warm-up rises linearly before.

    Attributes:
        kind: its name; a recipe may give it alone.
        factor: of the exponential decay.
        every: steps in which it decays by the factor.
        floor: share of the rate that the cosine ends at.
    """

    kind: Literal["constant", "cosine", "exponential"] = "constant"
    factor: float = Field(default=0.1, gt=0, le=1)
    every: int = Field(default=5_000_000, gt=0)
    floor: float = Field(default=0.01, ge=0, le=1)

    def at(self, step: int, *, steps: int, warmup: int = 0) -> float:
        """Return the factor on the learning rate at a step, counted from 0.

        >>> [Schedule(kind="cosine", floor=0).at(step, steps=4) for step in (0, 2, 4)]
        [1.0, 0.5, 0.0]
        >>> Schedule(kind="exponential", factor=0.1, every=100).at(200, steps=1000)
        0.010000000000000002
        """
        rise = min(1.0, (step + 1) / (warmup + 1))
        if self.kind == "exponential":
            return float(rise * self.factor ** (step / self.every))
        if self.kind == "constant":
            return rise
        done = min(1.0, max(0, step - warmup) / max(1, steps - warmup))
        return rise * (self.floor + (1 - self.floor) * (1 + math.cos(math.pi * done)) / 2)


def _named(value: object) -> object:
    return {"kind": value} if isinstance(value, str) else value


class TrainingOptions(_Strict):
    """Options of a training; recipes fill them.

    Attributes:
        steps: optimiser steps; or give ``epochs``.
        epochs: passes over all windows.
        batch: windows of a step, in every process.
        learning_rate: of Adam, times the number of processes (thesis section 5.7.3).
        weight_decay: decoupled (AdamW) where it is above 0.
        schedule: the rate over the steps.
        warmup_steps: steps over which the rate rises from 0.
        clip: largest norm of the gradient; None clips nothing.
        precision: ``bf16`` runs matrix products in bfloat16, weights stay float32; ``auto``
            does so where the hardware multiplies in it.
        windows: subsets to train on.
        validate_every: steps between validations; a tenth of all by default, 0 never.
        validation_frames: frames of a validation rollout.
        validation_scenarios: scenarios of ``valid`` that are rolled out.
        patience: validations without a new best before training stops; None never.
        checkpoint_every: steps between checkpoints; a twentieth of all by default.
        log_every: steps between entries in TensorBoard.
        seed: seed of weights, order of windows, and noise.
    """

    steps: int | None = Field(default=None, gt=0)
    epochs: float | None = Field(default=None, gt=0, allow_inf_nan=False)
    batch: int = Field(default=2, gt=0)
    learning_rate: float = Field(default=1e-4, gt=0, allow_inf_nan=False)
    weight_decay: float = Field(default=0.0, ge=0, allow_inf_nan=False)
    schedule: Annotated[Schedule, BeforeValidator(_named)] = Schedule()
    warmup_steps: int = Field(default=0, ge=0)
    clip: float | None = Field(default=None, gt=0, allow_inf_nan=False)
    precision: Literal["float32", "bf16", "auto"] = "float32"
    windows: tuple[str, ...] = ("train",)
    validate_every: int | None = Field(default=None, ge=0)
    validation_frames: int = Field(default=20, gt=0)
    validation_scenarios: int = Field(default=2, gt=0)
    patience: int | None = Field(default=None, gt=0)
    checkpoint_every: int | None = Field(default=None, gt=0)
    log_every: int = Field(default=10, gt=0)
    seed: int = Field(default=0, ge=0, lt=2**63)

    @model_validator(mode="before")
    @classmethod
    def _one_budget(cls, data: object) -> object:
        if isinstance(data, Mapping) and data.get("steps") and data.get("epochs"):
            message = "give steps or epochs, not both"
            raise ValueError(message)
        return data

    @model_validator(mode="after")
    def _own_subsets(self) -> TrainingOptions:
        if {"test", "valid"} & set(self.windows) or not self.windows:
            message = (
                f"windows={self.windows}: a model is trained on train (and extra), never on test, and not on"
                " valid, by which its weights are chosen"
            )
            raise ValueError(message)
        return self

    def total_steps(self, windows: int, *, processes: int = 1) -> int:
        """Return the optimiser steps of the training.

        Args:
            windows: windows in the data.
            processes: processes that share every pass.
        """
        if self.steps is not None:
            return self.steps
        return max(1, math.ceil((self.epochs or 1.0) * windows / (self.batch * processes)))
