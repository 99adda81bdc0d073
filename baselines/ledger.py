"""The ledger of a training: what it did, what it cost, on what machine."""

from __future__ import annotations

import platform
import resource
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.metadata import version
from typing import Any, Self

__all__ = ["OVER", "STOPPED_EARLY", "Ledger", "versions"]

STOPPED_EARLY = "stopped early"
"""State of a training whose validations brought nothing new; it is over."""

OVER = ("finished", STOPPED_EARLY)
"""States of a training that is not to be gone on with."""


@dataclass
class Ledger:
    """What a training has done so far; it goes into checkpoints and training.json.

    Attributes:
        state: running, interrupted, finished, stopped early or failed.
        step: optimiser steps made.
        loss: raw loss terms of the last step looked at, and their weighted sum ``total``.
        validation: step and position RMSE of every validation [length].
        best_step: step of the best validation; None before the first.
        best_rmse: its RMSE [length].
        cpu_seconds: processor time of all processes, in all runs [s].
        wall_seconds: time of all runs [s].
    """

    state: str = "running"
    step: int = 0
    loss: dict[str, float] = field(default_factory=dict)
    validation: list[dict[str, float]] = field(default_factory=list)
    best_step: int | None = None
    best_rmse: float | None = None
    cpu_seconds: float = 0.0
    wall_seconds: float = 0.0

    def __post_init__(self) -> None:
        """Start the clocks."""
        self._cpu, self._wall = _processor_seconds(), time.monotonic()

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Self:
        """Return a ledger that goes on where stored values end."""
        known = {name: values[name] for name in cls.__dataclass_fields__ if name in values}
        return cls(**known)

    def as_json(self) -> dict[str, Any]:
        """Return plain values."""
        return {name: getattr(self, name) for name in self.__dataclass_fields__}

    def read_clocks(self, processes: int = 1) -> None:
        """Add the time since the last reading, of as many processes as train alike."""
        cpu, wall = _processor_seconds(), time.monotonic()
        self.cpu_seconds += (cpu - self._cpu) * processes
        self.wall_seconds += wall - self._wall
        self._cpu, self._wall = cpu, wall

    def validated(self, rmse: float) -> bool:
        """Enter a validation at the present step; return whether it is the best so far."""
        self.validation.append({"step": self.step, "rmse": rmse})
        if self.best_rmse is not None and not rmse < self.best_rmse:
            return False
        self.best_step, self.best_rmse = self.step, rmse
        return True

    def since_best(self) -> int:
        """Return how many validations came after the best one."""
        steps = [int(entry["step"]) for entry in self.validation]
        return sum(step > (self.best_step or 0) for step in steps)


def versions() -> dict[str, str]:
    """Return the versions of the libraries that decide the result."""
    packages = ("lagbench", "torch", "torch-geometric", "pytorch-lightning", "numpy", "scipy")
    return {"python": platform.python_version(), **{name: version(name) for name in packages}}


def _processor_seconds() -> float:
    own, children = resource.getrusage(resource.RUSAGE_SELF), resource.getrusage(resource.RUSAGE_CHILDREN)
    return sum(usage.ru_utime + usage.ru_stime for usage in (own, children))
