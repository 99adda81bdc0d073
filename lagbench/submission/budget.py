"""What a training took, as training.json, predictions.nc and entries of the leaderboard
say it.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, StringConstraints, ValidationError

Track = Literal["equal compute", "converged"]
"""What trainings are compared by: the same processor time, or until more of it brings
nothing.
"""

EQUAL_MINUTES = {"mini": 15.0, "full": 60.0}
"""Processor time of a training of equal compute, by size [min]."""

TOLERANCE = 0.05
"""Share by which the processor time may be longer."""

CONVERGED = 0.02
"""Greatest share by which the validation error falls while the budget of a converged
training doubles.
"""

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


def budget_in(text: str) -> Budget | None:
    """Return the budget that a text holds as JSON; None where it is none."""
    try:
        return Budget.model_validate_json(text)
    except ValidationError:
        return None


def track_of(size: str, budget: Budget) -> Track | None:
    """Return the track that a training belongs to, by its record alone; None for none.

    Equal compute: at most 15 minutes of processor time at mini and 60 at full, 5 % more
    allowed, without a GPU; validations do not count. Converged: over the last doubling
    of the steps the best validation fell by less than 2 %, and every window was seen.
    """
    most = EQUAL_MINUTES.get(size)
    on_cpu = budget.cpu_hours is not None and not budget.gpu_hours
    if (
        most is not None
        and on_cpu
        and 60.0 * (budget.cpu_hours or 0.0) <= most * (1.0 + TOLERANCE)
    ):
        return "equal compute"
    first = budget.start_steps or 0
    steps = first + (budget.steps or 0)
    before = [
        (step, value)
        for step, value in budget.validations
        if first + step <= (steps + 1) // 2
    ]
    # A validation near half the steps must tell what the last doubling brought.
    if not before or budget.best is None or first + before[-1][0] < 0.4 * steps:
        return None
    if budget.epochs is not None and budget.epochs < 1.0 and not first:
        return None
    half = min(value for _, value in before)
    if half > 0.0 and (half - budget.best) / half < CONVERGED:
        return "converged"
    return None
