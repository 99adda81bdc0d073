"""The log of a training: its steps, losses, validations and processor time.

Checkpoints and training.json hold it.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Self

# state of a training that ended because validations brought no new best
STOPPED_EARLY = "stopped early"
# states of a training that cannot go on
OVER = ("finished", STOPPED_EARLY)


@dataclass
class TrainingLog:
    """What a training has done so far. Its fields are keys of training.json."""

    state: str = "running"  # running, interrupted, finished, stopped early or failed
    step: int = 0  # optimiser steps made
    # raw loss terms of the last step that was logged, and their weighted sum 'total'
    loss: dict[str, float] = field(default_factory=dict)
    windows_seen: int = 0  # training windows of all steps
    epochs: float = 0.0  # the same over the windows of the training subsets
    metric: str | None = None  # of validations; None before the first one
    # step and value of every validation, under the metric's name
    validation: list[dict[str, float]] = field(default_factory=list)
    best_step: int | None = None  # step of the best validation; None before the first
    best_value: float | None = None  # its value
    cpu_seconds: float = 0.0  # processor time of all processes, in all runs [s]
    validation_cpu_seconds: float = 0.0  # of it that of validations [s]
    gpu_seconds: float = 0.0  # time of all runs times the GPUs in use [s]
    wall_seconds: float = 0.0  # time of all runs [s]

    def __post_init__(self) -> None:
        """Start the clocks."""
        self._cpu = _processor_seconds()
        self._wall = time.monotonic()

    @classmethod
    def continue_from(cls, stored: Mapping[str, Any]) -> Self:
        """Return the log that a checkpoint holds, with clocks that start now."""
        names = [entry.name for entry in fields(cls)]
        return cls(**{name: stored[name] for name in names if name in stored})

    def read_clocks(self, processes: int = 1, *, device: str = "cpu") -> None:
        """Add the times since the last reading to the costs of the training.

        Args:
            processes: number of processes that train, each of which costs as much
                processor time as this one, and a GPU.
            device: device of the model.
        """
        cpu = _processor_seconds()
        wall = time.monotonic()
        self.cpu_seconds += (cpu - self._cpu) * processes
        self.wall_seconds += wall - self._wall
        if device != "cpu":
            self.gpu_seconds += (wall - self._wall) * processes
        self._cpu = cpu
        self._wall = wall

    def add_validation(self, metric: str, value: float) -> bool:
        """Add a validation at the present step; return whether it is the best."""
        self.metric = metric
        self.validation.append({"step": self.step, metric: value})
        if not math.isfinite(value):
            return False
        if self.best_value is not None and value >= self.best_value:
            return False
        self.best_step = self.step
        self.best_value = value
        return True

    def validations_since_best(self) -> int:
        """Return how many validations came after the best one."""
        best_step = self.best_step or 0
        return sum(entry["step"] > best_step for entry in self.validation)


def _processor_seconds() -> float:
    children = os.times()  # of this process it has hundredths of a second only
    return time.process_time() + children.children_user + children.children_system
