"""The models of entries: which entries have them, how they are opened and scored."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray

from lagbench.data.local import load_rooted_registry, resolve_root
from lagbench.data.registry import Registry, Size
from lagbench.errors import LagbenchError, UsageError, check_installed, suggest_name
from lagbench.metrics.aggregate import Tally
from lagbench.metrics.frame import snapshots
from lagbench.metrics.table import select
from lagbench.models.onnx_model import OnnxModel
from lagbench.scoring.task import SUBMISSION, ScoredTask, measure_rows
from lagbench.work.run import Meter, Progress

from .entry import Entry, Prediction, find_model, is_current, read_entry
from .folder import Folder


class Runner(Protocol):
    """A model that predicts scenarios one by one."""

    def predict(
        self, scenario_file: Path, frames: int | None = None
    ) -> NDArray[np.float32]:
        """Return positions of the next frames, [frame, particle, axis] [length]."""
        ...

    def time(self, scenario_file: Path, frames: int) -> float:
        """Return the processor time of a frame [s]."""
        ...

    def close(self) -> None:
        """Free what the model holds."""
        ...


def exit_code_of(failures: Mapping[str, LagbenchError]) -> int:
    """Return the exit code of the first failure; 0 without any."""
    return next((error.exit_code for error in failures.values()), 0)


def choose_data_sets(
    known: Collection[tuple[str, str]],
    split: str | None,
    size: str | None,
    *,
    board: Path,
) -> tuple[tuple[str, str], ...]:
    """Return the (split, size) with entries; only those of a split or size, if given.

    Raises:
        UsageError: a split or size is given that has no entries.
    """
    chosen = []
    for known_split, known_size in known:
        if split in (None, known_split) and size in (None, known_size):
            chosen.append((known_split, known_size))
    if not chosen and (split or size):
        request = " ".join(name for name in (split, size) if name)
        names = [" ".join(data_set) for data_set in known]
        raise UsageError(
            f"no entries of {request!a} in {board}; {suggest_name(request, names)}"
        )
    return tuple(chosen)


@dataclass(frozen=True, kw_only=True)
class ModelRuns:
    """The models of a board's entries, and where and how they are run."""

    folder: Folder
    root: Path  # of all data sets
    registry: Registry
    threads: int
    meter: Meter

    @classmethod
    def of(
        cls,
        board: str | Path,
        *,
        threads: int,
        root: str | Path | None,
        registry: Registry | None,
        progress: Callable[[Progress], None] | None,
    ) -> Self:
        """Return the runs of a board.

        Raises:
            UsageError: no leaderboard.
        """
        folder = Folder(board)
        folder.require()
        data_root = resolve_root(root)
        return cls(
            folder=folder,
            root=data_root,
            registry=load_rooted_registry(data_root, registry),
            threads=threads,
            meter=Meter(progress),
        )

    def size(self, entry: Entry) -> Size:
        """Return the data set of an entry."""
        return self.registry.size(entry.split, entry.size)

    def choose(
        self, names: Sequence[str], *, split: str | None, size: str | None
    ) -> list[Entry]:
        """Return entries by name, or all active ones of the present data with models.

        Raises:
            UsageError: no such entry, or one that has no model; or no entries of the
                split or size.
        """
        known = {}
        for path in self.folder.entries():
            known["/".join(path.with_suffix("").parts[1:])] = path
        chosen = []
        for name in names:
            if name not in known:
                nearest = difflib.get_close_matches(name, known, cutoff=0.0)
                raise UsageError(
                    f"no entry {name!a} in {self.folder.path}; nearest: "
                    f"{', '.join(nearest) or 'none'}; `lagbench leaderboard show` "
                    "prints all"
                )
            entry = read_entry(self.folder.path / known[name])
            if not entry.models:
                raise UsageError(
                    f"{name} has no model to run; its submitter may add one: lagbench "
                    "submit --weights FILE --replace"
                )
            chosen.append(entry)
        if names:
            return chosen

        data_sets = choose_data_sets(
            self.folder.data_sets(), split, size, board=self.folder.path
        )
        for path in known.values():
            if path.parts[1:3] not in data_sets:
                continue
            entry = read_entry(self.folder.path / path)
            present = is_current(entry.dataset, self.size(entry))
            if entry.models and present:
                chosen.append(entry)
        return chosen

    def open(self, entry: Entry, prediction: Prediction) -> Runner:
        """Return the model of a seed, ready to predict.

        Raises:
            UsageError: the seed has no model, or torch is not installed.
            ChecksFailedError: the file is not the one that the entry names.
            UnreadableFileError: the file is damaged.
            DataError: it was trained on other data.
        """
        if prediction.weights is None:
            raise UsageError(f"{name_seed(entry, prediction)} has no model")
        path = find_model(self.folder, prediction.weights)
        if path.suffix == ".onnx":
            return OnnxModel(path, size=self.size(entry), root=self.root)

        check_installed("torch", extra="baselines")
        from lagbench.baselines.runner import WeightsRunner

        return WeightsRunner(
            path,
            size=entry.size,
            root=self.root,
            registry=self.registry,
            settings=prediction.settings,
            threads=self.threads,
        )

    def tallies(
        self,
        entry: Entry,
        prediction: Prediction,
        task: ScoredTask,
        scenarios: Sequence[int],
    ) -> dict[int, Tally]:
        """Return the statistics of scenarios that the model of a seed predicts.

        They are those that the entry's ranking metric needs.
        """
        count = len(scenarios)
        with closing(self.open(entry, prediction)) as model:
            self.meter.begin(name_seed(entry, prediction), total=count, scenarios=count)
            tallies = {}
            for scenario in scenarios:
                tallies[scenario] = score_positions(
                    task,
                    scenario,
                    model.predict(task.truth.path(scenario)),
                    entry.score.ranking_metric,
                )
                self.meter.count(1, scenarios=1)
        return tallies


def score_positions(
    task: ScoredTask,
    scenario: int,
    position: Iterable[NDArray[np.float32]],
    metric: str,
) -> Tally:
    """Return the statistics of a predicted scenario that a metric needs."""
    with task.opened(scenario) as truth:
        rows = {SUBMISSION: snapshots(truth.scenario, position)}
        tallies, _ = measure_rows(
            truth.scenario, truth.snapshots(), rows, metrics=select([metric])
        )
    return tallies[SUBMISSION]


def name_seed(entry: Entry, prediction: Prediction) -> str:
    """Return the name of one seed of an entry, as in ``cavity/mini/gns, seed 0``."""
    name = "/".join(entry.place)
    if prediction.seed is None:
        return name
    return f"{name}, seed {prediction.seed}"
