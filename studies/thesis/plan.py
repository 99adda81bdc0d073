"""What to reproduce at one size, and where its files lie."""

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

from .published import MLP_STUDIES, MLPStudy
from .roster import RosterModel
from .split_results import (
    WEIGHTS,
    Sources,
    SplitResults,
    read_json,
)

PREDICTIONS = "predictions.nc"

TABLES: Mapping[str, tuple[str, str]] = {
    "table_4_2": ("4.2", "fluid"),
    "table_4_3": ("4.3", "fluid"),
    "table_4_4": ("4.4", "multimaterial"),
    "table_4_5": ("4.5", "multimaterial"),
}
"""Tables of MLPs: their number in the thesis, and the split that they are made on."""

SHARES: Mapping[str, tuple[float, int]] = {"mini": (0.1, 16), "tiny": (0.01, 64)}
"""Share of the thesis's epochs, and divisor of its batch, by size."""

# results of the rows of these tables, in a folder of runs or of other results
STUDY_FILE = "mlp_studies.json"


@dataclass(frozen=True, kw_only=True)
class Plan:
    """One size to reproduce: the user's choices, and the folders of its files."""

    size: str
    root: Path  # folder of all data sets
    runs: Path  # folder of runs; complete runs there are kept
    output: Path  # folder of tables and pictures
    weights: Path = WEIGHTS  # folder of committed weights
    studies: Path | None = None  # folder of results without an entry
    seeds: tuple[int, ...] = (0,)  # seeds of every training; pictures show the first
    recipe: str | None = None  # variant of the recipes: short; None for the size's own
    settings: tuple[str, ...] = ()  # changes to every recipe: training.steps=100
    device: str = "auto"
    # CPU threads of a training; one per core by default, one with workers
    threads: int | None = None
    registry: Registry | None = None  # descriptions of the splits; ours when None
    # folders of runs that failed or have another recipe: nothing of them is shown
    failed: set[Path] = field(default_factory=set, compare=False, repr=False)
    _results: dict[str, SplitResults] = field(
        default_factory=dict, compare=False, repr=False
    )
    _subsets: dict[str, ScoredTask] = field(
        default_factory=dict, compare=False, repr=False
    )

    @cached_property
    def described(self) -> Registry:
        """Descriptions of the splits, those in the root folder included."""
        return load_rooted_registry(self.root, self.registry)

    def tier(self, split: str) -> Size:
        """Return the description of a split at this size."""
        return self.described.size(split, self.size)

    def hash(self, split: str) -> str | None:
        """Return the hash of a split's data; None where unknown.

        The hash of the data in the root folder wins over the recorded one.
        """
        tier = self.tier(split)
        manifest = read_manifest(self.root, tier.split, tier.name, tier.major)
        if manifest is not None and manifest.dataset_sha256:
            return manifest.dataset_sha256
        if tier.measured:
            return tier.measured.dataset_sha256
        return None

    def has_recipe(self, split: str, model: RosterModel) -> bool:
        """Return whether a model has a recipe for a split, of the chosen variant.

        A model that stands for a variant of the recipes has no other one.
        """
        if self.recipe is not None and self.recipe.endswith((".yaml", ".yml")):
            return True
        if self.recipe is not None and model.recipe not in (None, self.recipe):
            return False

        # these load torch
        from lagbench.baselines.catalogue import find
        from lagbench.baselines.recipe import recipe_names

        try:
            names = recipe_names(find(model.baseline))
        except UsageError:  # the model cannot be loaded: training says why
            return True
        variant = self.recipe or model.recipe
        if variant is None and not names:  # its defaults are its recipe
            return True
        size_name = self.size
        if variant is not None:
            size_name = f"{self.size}-{variant}"
        return f"{split}/{size_name}" in names or f"*/{size_name}" in names

    def home(self, split: str) -> Path:
        """Return the folder of a split's runs: ``runs/<split>/<size>[-<recipe>]``."""
        if self.recipe:
            return self.runs / split / f"{self.size}-{self.recipe}"
        return self.runs / split / self.size

    def folder(self, split: str, name: str, seed: int) -> Path:
        """Return the folder of one training."""
        return self.home(split) / f"{name}-{seed}"

    def predictions(self, split: str, name: str) -> Path | None:
        """Return a model's file of predictions; None where none was scored.

        The first chosen seed comes before the others.
        """
        method = self.results(split).methods.get(name)
        if method is None:
            return None
        first_seed = self.seeds[0]
        trainings = sorted(
            method.trainings, key=lambda training: training.seed != first_seed
        )
        for training in trainings:
            path = training.path.with_name(PREDICTIONS)
            if path.is_file():
                return path
        return None

    @property
    def sources(self) -> Sources:
        """The folders that the results of these runs are read from."""
        return Sources(
            board=None,
            weights=self.weights,
            runs=self.runs,
            recipe=self.recipe,
            registry=self.described,
            studies=self.studies,
            excluded_runs=frozenset(self.failed),
        )

    def results(self, split: str) -> SplitResults:
        """Return the results of a split's runs; they are read once, after the runs."""
        if split not in self._results:
            self._results[split] = SplitResults(self.sources, split, self.size)
        return self._results[split]

    @property
    def stale(self) -> list[Path]:
        """Score files of other data among the results that were read."""
        paths = []
        for results in self._results.values():
            paths += results.stale
        return paths

    def test_subset(self, split: str) -> ScoredTask:
        """Return the test subset of a split as the scorer sees it."""
        if split not in self._subsets:
            self._subsets[split] = load_scored_task(self.tier(split), self.root)
        return self._subsets[split]


def study_name(study: MLPStudy) -> str:
    """Return the name of a row in files and folders, as in ``mlp-4-2-1``."""
    return f"mlp-{study.table.replace('.', '-')}-{study.row}"


def study_rows(name: str) -> tuple[MLPStudy, ...]:
    """Return the rows of a table."""
    table_number, _ = TABLES[name]
    return tuple(study for study in MLP_STUDIES if study.table == table_number)


def study_folder(plan: Plan, name: str, study: MLPStudy) -> Path:
    """Return the folder of a row's training, apart from the runs that are scored."""
    _, split = TABLES[name]
    return plan.home(split) / "studies" / f"{study_name(study)}-{plan.seeds[0]}"


def read_study_results(homes: Iterable[Path], data: str | None) -> dict[str, Any]:
    """Return our results for rows of the tables of MLPs, by :func:`study_name`.

    Each has the errors ``train`` and ``valid``, the ``seed``, and the record of its
    ``training``.

    Args:
        homes: folders that may hold such results; a later one wins.
        data: hash of the data set; results of other data are left out. None takes all.
    """
    studies: dict[str, Any] = {}
    for home in homes:
        for name, row in read_json(home / STUDY_FILE).items():
            if data is None or row["training"]["dataset_sha256"] == data:
                studies[name] = row
    return studies
