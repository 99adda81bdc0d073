"""The budget of a training: steps, hours, validations.

It stands in training.json, in predictions.nc and in entries of the leaderboard.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, StringConstraints, ValidationError

Track = Literal["equal compute", "converged"]
"""What trainings share: the same processor time, or enough of it to converge."""

EQUAL_MINUTES = {"mini": 15.0, "full": 60.0}
"""Processor time of a training of equal compute, by size [min]."""

TOLERANCE = 0.05
"""Share by which the processor time may be longer."""

CONVERGED = 0.02
"""Greatest share by which the validation error of a converged training falls.

It falls by that while the budget doubles.
"""

EARLIEST_HALF = 0.4
"""Share of the steps from which on a validation stands for the first half."""

MOST_VALIDATIONS = 20
"""Validations that a budget holds; of more of them some are left out."""

Amount = Annotated[float, Field(ge=0, lt=1e12, allow_inf_nan=False)]
Count = Annotated[int, Field(ge=0, lt=10**15)]
Value = Annotated[float, Field(allow_inf_nan=False)]
Text = Annotated[str, StringConstraints(pattern=r"^[ -~]{1,100}$")]


class Budget(BaseModel):
    """What the training of one seed took."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    windows: Count | None = Field(default=None, description="training windows seen")
    epochs: Amount | None = Field(
        default=None, description="windows seen over those of the training subset"
    )
    steps: Count | None = Field(default=None, description="optimiser steps")
    start_steps: Count | None = Field(
        default=None,
        description="steps behind the weights that it started from; hours are "
        "with theirs",
    )
    cpu_hours: Amount | None = Field(
        default=None, description="processor time without validations"
    )
    validation_hours: Amount | None = Field(
        default=None, description="processor time of validations"
    )
    gpu_hours: Amount | None = Field(
        default=None, description="0 where no GPU was used"
    )
    device: Text | None = Field(default=None, description="processor, or GPU")
    threads: Count | None = Field(
        default=None, description="threads of a process on the CPU"
    )
    metric: Annotated[str, StringConstraints(pattern=r"^[a-z0-9_]{1,60}$")] | None = (
        Field(default=None, description="what was validated by; lower is better")
    )
    best: Value | None = Field(
        default=None, description="the least validation error; its weights predict"
    )
    best_step: Count | None = None
    validations: Annotated[
        tuple[Annotated[tuple[Count, Value], Field(strict=False)], ...],
        Field(max_length=MOST_VALIDATIONS, strict=False, description="step and value"),
    ] = ()


def parse_budget(text: str) -> Budget | None:
    """Return the budget that a text holds as JSON; None where it is none."""
    try:
        return Budget.model_validate_json(text)
    except ValidationError:
        return None


def track_of(size: str, budget: Budget) -> Track | None:
    """Return the track that a training belongs to, by its budget alone.

    Equal compute: at most 15 minutes of processor time at mini and 60 at full, 5 % more
    allowed, without a GPU; validations do not count. Converged: over the last doubling
    of the steps the best validation fell by less than 2 %, and every window was seen.
    None for neither.
    """
    if is_equal_compute(size, budget):
        return "equal compute"
    if is_converged(budget):
        return "converged"
    return None


def is_equal_compute(size: str, budget: Budget) -> bool:
    """Return whether the processor time is within that of equal compute."""
    allowed_minutes = EQUAL_MINUTES.get(size)
    if allowed_minutes is None or budget.cpu_hours is None:
        return False
    if budget.gpu_hours != 0.0:  # a GPU was used, or nothing is stated
        return False
    minutes = 60.0 * budget.cpu_hours
    return minutes <= allowed_minutes * (1.0 + TOLERANCE)


def is_converged(budget: Budget) -> bool:
    """Return whether the last doubling of the steps brought next to nothing."""
    start_steps = budget.start_steps or 0
    is_epoch_known = budget.epochs is not None and budget.epochs >= 1.0
    if not is_epoch_known and not start_steps:
        return False
    if budget.best is None:
        return False

    all_steps = start_steps + (budget.steps or 0)
    early_errors = []  # validation errors in the first half of the steps
    last_early_step = 0
    for step, error in budget.validations:
        if start_steps + step <= (all_steps + 1) // 2:
            early_errors.append(error)
            last_early_step = start_steps + step
    # A validation near half the steps must tell what the last doubling brought.
    if not early_errors or last_early_step < EARLIEST_HALF * all_steps:
        return False

    best_early_error = min(early_errors)
    if best_early_error <= 0.0:
        return False
    return (best_early_error - budget.best) / best_early_error < CONVERGED
