"""The test subset as metrics see it, and the measurement of its scenarios.

Scoring needs the files of ``test`` only; statistics of ``train`` are read from
datasets.yaml or, for a data set that is not recorded there, from its manifest. The
truth's snapshots and fields are formed once for the submission and the references
beside it; memory is that of a few frames, whatever the horizon.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lagbench.data import MATERIALS, WALL
from lagbench.data.local import suggest_repair
from lagbench.data.manifest import read_manifest
from lagbench.data.registry import Size
from lagbench.data.scenario import ScenarioFile
from lagbench.errors import DataError
from lagbench.metrics.aggregate import Tally, measure, round_statistics
from lagbench.metrics.frame import (
    FramePair,
    Scenario,
    Snapshot,
    TaskConfig,
    snapshots,
)
from lagbench.metrics.metric import Metric
from lagbench.references.predictor import Given, Prediction, ReferencePredictor
from lagbench.store.copy import update_working_copy
from lagbench.submission.truth import Truth
from lagbench.work.executor import Report

from .flags import Trace, Tracer

SUBMISSION = "submission"
"""Row of the submission; reference predictors have rows of their names."""

BLOCK_BYTES = 1 << 20
"""True positions are read in blocks of about this size [bytes].

A call for each frame costs more than its bytes.
"""


@dataclass(frozen=True)
class OpenScenario:
    """A scenario whose file is open."""

    scenario: Scenario  # properties that all its frames share
    file: ScenarioFile

    def snapshots(self) -> Iterator[Snapshot]:
        """Yield the true snapshots of the predicted frames; a block is in memory."""
        numbers = self.scenario.config.predicted_frames
        frame_bytes = 4 * self.scenario.input_positions[0].size
        step = max(1, BLOCK_BYTES // frame_bytes)

        def frames() -> Iterator[NDArray[np.float32]]:
            for first in numbers[::step]:
                last = min(first + step, numbers.stop)
                yield from self.file.read("position", slice(first, last))

        return snapshots(self.scenario, frames())


@dataclass(frozen=True, kw_only=True)
class ScoredTask:
    """The test subset of a split and size; in a training, the valid subset."""

    truth: Truth  # its files
    config: TaskConfig  # of the split and size
    density: float  # rest density [mass/length^2]
    # position RMSE of the perturbed solver run per predicted frame [length]; empty
    # where it is not recorded
    predictability_limit: tuple[float, ...] = ()

    @property
    def size(self) -> Size:
        """The split and size in the registry."""
        return self.truth.size

    @property
    def scenarios(self) -> tuple[int, ...]:
        """Ids of the scenarios, ascending."""
        return tuple(sorted(self.size.subsets[self.truth.subset]))

    @contextmanager
    def opened(self, scenario: int) -> Iterator[OpenScenario]:
        """Yield a scenario while its file is open."""
        with self.truth.open(scenario) as file:
            material = file.read("material")
            scored = None
            if (material == WALL).any():
                scored = np.flatnonzero(material != WALL)
                material = material[scored]
            mass = file.read_particle_mass()
            stated = file.header.parameters.get("active_frames")
            active_frames = None
            if isinstance(stated, int | np.integer) and stated >= 0:
                active_frames = int(stated)
            elif stated is not None:
                raise DataError(
                    f"active_frames is {stated!r:.40}, no number of frames; make the "
                    "data again",
                    where=str(file.path),
                )
            input_frames = slice(0, self.config.input_frames)
            given = file.read("position", input_frames)
            properties = Scenario(
                config=self.config,
                input_positions=given if scored is None else given[:, scored],
                material=material,
                particle_mass=mass,
                area=mass * len(material) / self.density,
                scored=scored,
                active_frames=active_frames,
            )
            yield OpenScenario(properties, file)


def load_scored_task(
    size: Size, root: Path, *, subset: str | None = None, is_hashed: bool = False
) -> ScoredTask:
    """Check that a subset is there and collect what the metrics need.

    Args:
        size: the split and size.
        root: folder of all data sets.
        subset: the subset whose truth is needed; that which the size scores when None.
        is_hashed: whether the caller has fetched and hashed the files just before, so
            that they are not hashed again.

    Raises:
        DataError: files are missing, damaged or too short, or the statistics of train
            are not recorded.
    """
    truth = Truth(size, root, subset)
    subset = truth.subset
    if not is_hashed:
        update_working_copy(size, root, size.subsets[subset])
        truth.require()
        truth.check()

    scenarios = sorted(size.subsets[subset])
    task = size.task
    needed = task.input_frames + task.horizon
    present: set[str] = set()
    for scenario in scenarios:
        with truth.open(scenario) as file:
            if file.header.frames < needed:
                raise DataError(
                    f"{file.header.frames} frames, the task needs {needed}; make the "
                    "data again, or shorten the task in split.yaml",
                    where=str(truth.path(scenario)),
                )
            file.check_material()
            numbers = np.unique(file.read("material")).tolist()
        present.update(MATERIALS[number] for number in numbers if number != WALL)

    statistics: Mapping[str, tuple[float, ...]] = {}
    limit: tuple[float, ...] = ()
    manifest = None
    if size.measured:
        statistics = size.measured.statistics
        if subset != "shift":  # it was measured on test
            limit = size.measured.twin_floor
    else:
        manifest = read_manifest(root, size.split, size.name, size.major)
    if manifest is not None:
        statistics = manifest.statistics
        entries = [manifest.entry(scenario) for scenario in scenarios]
        limits = [() if entry is None else entry.twin_floor for entry in entries]
        # every scenario has one, and all have the same number of frames
        if limits[0] and len({len(one) for one in limits}) == 1:
            limit = tuple(np.mean(limits, axis=0).tolist())
    position_std = statistics.get("position_std", ())
    velocity_std = statistics.get("velocity_std", ())
    if not len(position_std) == len(velocity_std) == size.dimension:
        raise DataError(
            "position_std and velocity_std of train are not recorded, neither in "
            f"{size.record_name} nor in the manifest; "
            f"{suggest_repair(size, root=root)}",
            where=f"{size.split} {size.name} in {root}",
        )

    config = TaskConfig(
        grid=size.field_grid,
        input_frames=task.input_frames,
        horizon=task.horizon,
        frames_of_interest=task.frames_of_interest,
        attribute_std=(*position_std, *velocity_std),
        radius=task.radius,
        materials=tuple(name for name in MATERIALS if name in present),
    )
    return ScoredTask(
        truth=truth,
        config=config,
        density=float(size.value("density")),
        predictability_limit=limit,
    )


def predict_reference(reference: ReferencePredictor, given: Given) -> Prediction:
    """Return the prediction of a reference; train is fetched if it is read."""
    if reference.reads_train:
        update_working_copy(given.size, given.root, given.size.subsets["train"])
    return reference.predict(given)


def measure_rows(
    scenario: Scenario,
    truth: Iterator[Snapshot],
    rows: Mapping[str, Iterator[Snapshot]],
    *,
    metrics: tuple[Metric, ...],
    report: Report = lambda _: None,
) -> tuple[dict[str, Tally], Trace]:
    """Measure rows of predictions of one scenario side by side, frame by frame.

    Returns:
        The rounded statistics by row, and the trace of the first row.
    """
    frames = scenario.config.predicted_frames
    tracer = Tracer(scenario)
    first = next(iter(rows))
    measured: dict[str, dict[int, dict[str, float]]] = {name: {} for name in rows}
    for frame, true, *predicted in zip(frames, truth, *rows.values(), strict=True):
        for name, snapshot in zip(rows, predicted, strict=True):
            pair = FramePair(scenario, frame, true, snapshot)
            measured[name][frame] = measure(pair, metrics)
            if name == first:
                tracer.add(pair)
        report(1)

    names = [metric.name for metric in metrics if metric.statistic is not None]
    tallies = {}
    for name, values in measured.items():
        tallies[name] = round_statistics(Tally.of(names, frames, values))
    return tallies, tracer.trace
