"""What was asked for, and where everything of it lies."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

from lagbench.data.local import rooted
from lagbench.data.manifest import read_manifest
from lagbench.data.registry import Registry, Size
from lagbench.errors import UsageError
from lagbench.scoring.task import ScoredTask, load_scored_task

from .evidence import Evidence, Sources
from .roster import Model

__all__ = ["Plan"]


@dataclass(frozen=True, kw_only=True)
class Plan:
    """One size to reproduce."""

    size: str  # name of the size
    root: Path  # folder of all data sets
    runs: Path  # folder of runs; what is there is not made again
    output: Path  # folder of tables and pictures
    seeds: tuple[int, ...] = (0,)  # seeds of every training; pictures show the first
    recipe: str | None = None  # variant of the recipes, as in 'short'; None for the size's own
    settings: tuple[str, ...] = ()  # changes to every recipe, as in training.steps=100
    device: str = "auto"  # 'cpu', 'cuda' or 'auto'
    threads: int | None = None  # threads on the CPU; one per core by default
    registry: Registry | None = None  # where splits are described; ours when None
    _evidence: dict[str, Evidence] = field(default_factory=dict, compare=False, repr=False)
    _exams: dict[str, ScoredTask] = field(default_factory=dict, compare=False, repr=False)

    @cached_property
    def described(self) -> Registry:
        """Splits, those of the root folder included."""
        return rooted(self.root, self.registry)

    def tier(self, split: str) -> Size:
        """Return what the registry says of a split at this size."""
        return self.described.size(split, self.size)

    def hash(self, split: str) -> str | None:
        """Return the hash of a split's data, those at hand before those recorded; None where unknown."""
        tier = self.tier(split)
        manifest = read_manifest(self.root, tier.split, tier.name, tier.major)
        recorded = tier.measured.dataset_sha256 if tier.measured else None
        return (manifest.dataset_sha256 if manifest else None) or recorded

    def has_recipe(self, split: str, model: Model) -> bool:
        """Return whether a model has the variant of the recipes that was asked for."""
        if self.recipe is None or self.recipe.endswith((".yaml", ".yml")):
            return True
        from lagbench.baselines.catalogue import find
        from lagbench.baselines.recipe import recipe_names

        try:
            known = recipe_names(find(model.baseline))
        except UsageError:  # it cannot be loaded: training says why
            return True
        return any(f"{where}/{self.size}-{self.recipe}" in known for where in (split, "*"))

    def home(self, split: str) -> Path:
        """Return the folder of a split's runs: ``runs/<split>/<size>[-<recipe>]``."""
        return self.runs / split / (f"{self.size}-{self.recipe}" if self.recipe else self.size)

    def folder(self, split: str, model: Model, seed: int) -> Path:
        """Return the folder of one training."""
        return self.home(split) / f"{model.name}-{seed}"

    def predictions(self, split: str, name: str) -> Path | None:
        """Return the predictions of a model's first seed; None where there are none, or no scores yet."""
        if name not in self.evidence(split).methods:
            return None
        paths = [self.home(split) / f"{name}-{seed}" / "predictions.nc" for seed in self.seeds]
        return next((path for path in paths if path.is_file()), None)

    def evidence(self, split: str) -> Evidence:
        """Return scores, costs and records of a split's runs; read once, after they are made."""
        if split not in self._evidence:
            sources = Sources(board=None, runs=self.runs, recipe=self.recipe, registry=self.described)
            self._evidence[split] = Evidence(sources, split, self.size)
        return self._evidence[split]

    @property
    def stale(self) -> list[Path]:
        """Score files of other data among the evidence that was read; they are left out."""
        return [path for evidence in self._evidence.values() for path in evidence.stale]

    def exam(self, split: str) -> ScoredTask:
        """Return the test subset of a split."""
        if split not in self._exams:
            self._exams[split] = load_scored_task(self.tier(split), self.root)
        return self._exams[split]
