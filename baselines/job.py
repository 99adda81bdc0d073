"""A training as it was asked for: recipe, data, folder, machine."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lagbench.progress import Meter
from lagbench.registry import Registry

from .baseline import Baseline
from .checkpoint import Checkpoint
from .facts import Facts
from .ledger import Ledger, versions
from .machine import hardware
from .recipe import Recipe
from .run_folder import RunFolder
from .windows import scenario_paths

__all__ = ["Job", "parameter_count"]

FORMAT = 1


@dataclass(frozen=True, kw_only=True)
class Job:
    """A training to do.

    Attributes:
        recipe: model and training options.
        facts: public figures of the data set.
        folder: where files go.
        earlier: checkpoint to go on from; None at the start.
        root: folder of all data sets.
        registry: where the split is described.
        device: ``cpu`` or ``cuda``.
        processes: processes that share the training.
        workers: processes that read windows ahead.
        meter: counts steps.
    """

    recipe: Recipe
    facts: Facts
    folder: RunFolder
    earlier: Checkpoint | None
    root: Path
    registry: Registry
    device: str = "cpu"
    processes: int = 1
    workers: int = 0
    meter: Meter = field(default_factory=Meter)

    def files(self, subset: str) -> dict[int, Path]:
        """Return the scenario files of a subset by id.

        Raises:
            UsageError: there is no such subset.
            DataError: files are missing.
        """
        facts = self.facts
        return scenario_paths(
            facts.split, subset=subset, size=facts.size, root=self.root, registry=self.registry
        )

    def ledger(self) -> Ledger:
        """Return the ledger that goes on where an earlier run ended, in the state that it ended in."""
        return Ledger() if self.earlier is None else Ledger.from_json(self.earlier.training)

    def checkpoint(self, **changes: Any) -> Checkpoint:  # noqa: ANN401 (its fields)
        """Return a checkpoint with the fields that do not change."""
        fixed = {"recipe": self.recipe.as_json(), "processes": self.processes}
        training = {**fixed, **changes.pop("training", {})}
        return Checkpoint(
            baseline=self.recipe.baseline,
            options=self.recipe.model,
            facts=self.facts,
            weights=changes.pop("weights", {}),
            training=training,
            **changes,
        )

    def record(self, model: Baseline, **changes: Any) -> dict[str, Any]:  # noqa: ANN401 (plain values)
        """Return what training.json says."""
        facts = self.facts
        return {
            "format": FORMAT,
            "baseline": self.recipe.baseline,
            "method": model.method,
            "recipe": self.recipe.as_json(),
            "split": facts.split,
            "size": facts.size,
            "dataset_version": facts.version,
            "dataset_sha256": facts.dataset_sha256,
            "parameters": parameter_count(model),
            "processes": self.processes,
            "hardware": hardware(self.device),
            "versions": versions(),
            **changes,
        }


def parameter_count(model: Baseline) -> int:
    """Return the trained numbers of a model: parameters, or the coefficients of a closed form."""
    if getattr(model, "closed_form", False):
        return sum(value.numel() for value in model.state_dict().values() if value.is_floating_point())
    return sum(p.numel() for p in model.parameters() if p.requires_grad)
