"""A training to do, with what it writes: checkpoints, training.json and its budget."""

from __future__ import annotations

import functools
import math
import platform
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

from torch import Tensor

from lagbench.data.checksums import round_digits
from lagbench.data.registry import Registry
from lagbench.submission.budget import MOST_VALIDATIONS, Budget, track_of
from lagbench.work.run import Meter

from .baseline import Baseline, DatasetInfo, count_parameters
from .checkpoint import Checkpoint
from .machine import hardware
from .recipe import Recipe
from .run_folder import RunFolder
from .training_log import TrainingLog

LOG_FORMAT = 1  # of training.json
# libraries whose versions decide the result
LIBRARIES = (
    "lagbench",
    "torch",
    "torch-geometric",
    "pytorch-lightning",
    "numpy",
    "scipy",
)


@dataclass(frozen=True, kw_only=True)
class TrainingJob:
    """A training to do."""

    recipe: Recipe  # model and training options
    info: DatasetInfo  # public figures of the data set
    folder: RunFolder  # where files go
    earlier: Checkpoint | None  # checkpoint to go on from; None at the start
    root: Path  # folder of all data sets
    registry: Registry  # where the split is described
    device: str = "cpu"  # 'cpu' or 'cuda'
    processes: int = 1  # processes that share the training
    workers: int = 0  # processes that read windows ahead
    meter: Meter = field(default_factory=Meter)  # counts steps

    def start_log(self) -> TrainingLog:
        """Return the log, which goes on where an earlier run ended."""
        if self.earlier is None:
            return TrainingLog()
        return TrainingLog.continue_from(self.earlier.training)

    def budget(self, log: TrainingLog) -> Budget:
        """Return the budget of the training so far, for predictions and entries.

        Hours include those of the weights of its start; epochs, steps and validations
        are its own.
        """
        machine = hardware(self.device)
        if self.device == "cpu":
            device = str(machine["processor"])
        else:
            device = str(machine["device"])
        training_seconds: float | None = log.cpu_seconds - log.validation_cpu_seconds
        if self.workers:
            # Processes that read windows ahead are still alive: the system does not
            # tell their processor time.
            training_seconds = None
        start_record = self.recipe.start or {}
        start = start_record.get("took", {})
        ascii_device = device.encode("ascii", "replace").decode()

        return Budget(
            windows=log.windows_seen or None,
            epochs=round_digits(log.epochs, 6),
            steps=log.step,
            start_steps=start.get("steps"),
            cpu_hours=_sum_hours(training_seconds, start.get("cpu_hours", 0.0)),
            validation_hours=_sum_hours(
                log.validation_cpu_seconds, start.get("validation_hours", 0.0)
            ),
            gpu_hours=_sum_hours(log.gpu_seconds, start.get("gpu_hours", 0.0)),
            device=ascii_device[:100],
            threads=machine["threads"],
            metric=log.metric,
            best=log.best_value,
            best_step=log.best_step,
            validations=_select_validations(log),
        )

    def checkpoint(
        self,
        log: TrainingLog,
        weights: Mapping[str, Tensor],
        optimizer: Mapping[str, Tensor] | None = None,
    ) -> Checkpoint:
        """Return a checkpoint of the present step."""
        training = {
            "recipe": self.recipe.as_json(),
            "processes": self.processes,
            **asdict(log),
            "budget": self.budget(log).model_dump(mode="json"),
        }
        return Checkpoint(
            baseline=self.recipe.baseline,
            options=self.recipe.model,
            info=self.info,
            weights=weights,
            training=training,
            optimizer=optimizer,
        )

    def log_as_json(
        self, model: Baseline, log: TrainingLog, **counts: int
    ) -> dict[str, Any]:
        """Return the content of training.json; ``counts`` are entered too."""
        info = self.info
        budget = self.budget(log)
        return {
            "format": LOG_FORMAT,
            "baseline": self.recipe.baseline,
            "method": model.method,
            "recipe": self.recipe.as_json(),
            "split": info.split,
            "size": info.size,
            "dataset_version": info.version,
            "dataset_sha256": info.dataset_sha256,
            "parameters": count_parameters(model),
            "processes": self.processes,
            "hardware": hardware(self.device),
            "versions": dict(_library_versions()),
            "budget": budget.model_dump(mode="json"),
            "track": track_of(info.size, budget),
            **counts,
            **asdict(log),
        }


# Each look reads the description of an installed library, and a training stores often.
@functools.cache
def _library_versions() -> Mapping[str, str]:
    """Return the versions of Python and of the libraries that a training depends on."""
    versions = {"python": platform.python_version()}
    for name in LIBRARIES:
        versions[name] = version(name)
    return versions


def _sum_hours(seconds: float | None, start_hours: float | None) -> float | None:
    """Return the hours of a training and its start; None where one is unknown."""
    if seconds is None or start_hours is None:
        return None
    hours = seconds / 3600.0 + start_hours
    return round_digits(hours, 6)


def _select_validations(log: TrainingLog) -> tuple[tuple[int, float], ...]:
    """Return step and value of finite validations.

    Of too many validations for a budget, every n-th stays, the last one among them.
    """
    validations = []
    for entry in log.validation:
        value = entry[str(log.metric)]
        if math.isfinite(value):
            step = int(entry["step"])
            validations.append((step, value))
    least_stride = math.ceil(len(validations) / MOST_VALIDATIONS)
    stride = max(1, least_stride)
    latest_first = validations[::-1]
    chosen = latest_first[::stride]
    return tuple(chosen[::-1])
