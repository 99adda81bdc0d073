"""What is to be reproduced, and where everything of it lies."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from lagbench.data.local import load_rooted_registry
from lagbench.data.manifest import read_manifest
from lagbench.data.registry import Registry, Size
from lagbench.errors import UsageError
from lagbench.scoring.task import ScoredTask, load_scored_task

from .evidence import STUDIES as COMMITTED
from .evidence import WEIGHTS, Evidence, Sources, read_json
from .thesis import STUDIES, Model, Study

PREDICTIONS = "predictions.nc"

TABLES: Mapping[str, tuple[str, str]] = {
    "table_4_2": ("4.2", "fluid"),
    "table_4_3": ("4.3", "fluid"),
    "table_4_4": ("4.4", "multimaterial"),
    "table_4_5": ("4.5", "multimaterial"),
}
"""Number of the table in the thesis, and the split it is made on."""

SHARES: Mapping[str, tuple[float, int]] = {"mini": (0.1, 16), "tiny": (0.01, 64)}
"""Share of the thesis's epochs, and what its batch is divided by, by size."""

# what the rows came to, in a folder of runs or of committed studies
STUDY_FILE = "mlp_studies.json"


@dataclass(frozen=True, kw_only=True)
class Plan:
    """One size to reproduce: what was asked for, and where everything of it lies."""

    size: str
    root: Path  # folder of all data sets
    runs: Path  # folder of runs; what is there is not made again
    output: Path  # folder of tables and pictures
    weights: Path = WEIGHTS  # folder of committed weights
    studies: Path = COMMITTED  # folder of committed results that are no entries
    seeds: tuple[int, ...] = (0,)  # seeds of every training; pictures show the first
    # variant of the recipes, as in short; None for the size's own
    recipe: str | None = None
    settings: tuple[str, ...] = ()  # changes to every recipe, as in training.steps=100
    device: str = "auto"
    # of a training on the CPU; one per core by default, one with workers
    threads: int | None = None
    registry: Registry | None = None  # where splits are described; ours when None
    # folders of runs that could not be made, or are not those that were asked for:
    # nothing of them is shown
    failed: set[Path] = field(default_factory=set, compare=False, repr=False)
    _evidence: dict[str, Evidence] = field(
        default_factory=dict, compare=False, repr=False
    )
    _subsets: dict[str, ScoredTask] = field(
        default_factory=dict, compare=False, repr=False
    )

    @cached_property
    def described(self) -> Registry:
        """Splits, those of the root folder included."""
        return load_rooted_registry(self.root, self.registry)

    def tier(self, split: str) -> Size:
        """Return what the registry says of a split at this size."""
        return self.described.size(split, self.size)

    def hash(self, split: str) -> str | None:
        """Return the hash of a split's data, those at hand before those recorded; None
        where unknown.
        """
        tier = self.tier(split)
        manifest = read_manifest(self.root, tier.split, tier.name, tier.major)
        if tier.measured:
            recorded = tier.measured.dataset_sha256
        else:
            recorded = None
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
        return any(
            f"{where}/{self.size}-{self.recipe}" in known for where in (split, "*")
        )

    def home(self, split: str) -> Path:
        """Return the folder of a split's runs: ``runs/<split>/<size>[-<recipe>]``."""
        return (
            self.runs
            / split
            / (f"{self.size}-{self.recipe}" if self.recipe else self.size)
        )

    def folder(self, split: str, name: str, seed: int) -> Path:
        """Return the folder of one training."""
        return self.home(split) / f"{name}-{seed}"

    def predictions(self, split: str, name: str) -> Path | None:
        """Return a model's predictions, those of the first seed asked for; None where
        none were scored.
        """
        method = self.evidence(split).methods.get(name)
        held = sorted(
            method.seeds if method else (), key=lambda one: one.seed != self.seeds[0]
        )
        paths = [one.path.with_name(PREDICTIONS) for one in held]
        return next((path for path in paths if path.is_file()), None)

    @property
    def sources(self) -> Sources:
        """Where the evidence of these runs lies."""
        return Sources(
            board=None,
            weights=self.weights,
            runs=self.runs,
            recipe=self.recipe,
            registry=self.described,
            studies=self.studies,
            left_out=frozenset(self.failed),
        )

    def evidence(self, split: str) -> Evidence:
        """Return scores, costs and records of a split's runs; read once, after they are
        made.
        """
        if split not in self._evidence:
            self._evidence[split] = Evidence(self.sources, split, self.size)
        return self._evidence[split]

    @property
    def stale(self) -> list[Path]:
        """Score files of other data among the evidence that was read; they are left
        out.
        """
        return [path for evidence in self._evidence.values() for path in evidence.stale]

    def test_subset(self, split: str) -> ScoredTask:
        """Return the test subset of a split as the scorer sees it."""
        if split not in self._subsets:
            self._subsets[split] = load_scored_task(self.tier(split), self.root)
        return self._subsets[split]


def study_name(study: Study) -> str:
    """Return what a row is called in files and folders, as in ``mlp-4-2-1``."""
    return f"mlp-{study.table.replace('.', '-')}-{study.row}"


def study_rows(name: str) -> tuple[Study, ...]:
    """Return the rows of a table."""
    return tuple(study for study in STUDIES if study.table == TABLES[name][0])


def study_folder(plan: Plan, name: str, study: Study) -> Path:
    """Return the folder of a row's training; it lies apart from the runs that are
    scored.
    """
    return (
        plan.home(TABLES[name][1]) / "studies" / f"{study_name(study)}-{plan.seeds[0]}"
    )


def known_studies(homes: Iterable[Path], data: str | None) -> dict[str, Any]:
    """Return what rows came to, by :func:`study_name`: ``train``, ``valid`` and the
    record of ``training``.

    A row of a later folder goes before that of an earlier one; rows of data with
    another hash are left out.
    """
    held: dict[str, Any] = {}
    for home in homes:
        rows = read_json(home / STUDY_FILE).items()
        held |= {
            name: row
            for name, row in rows
            if data in (None, row["training"]["dataset_sha256"])
        }
    return held
