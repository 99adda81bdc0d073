"""The test subset as metrics see it: the truth that submissions are scored against.

Scoring needs the files of ``test`` only; statistics of ``train`` are read from
datasets.yaml or, for a data set that is not recorded there, from its manifest.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lagbench.data import MATERIALS
from lagbench.data.box import parse_obstacle
from lagbench.data.local import suggest_repair
from lagbench.data.manifest import Manifest, read_manifest
from lagbench.data.registry import Size
from lagbench.data.scenario import ScenarioFile
from lagbench.errors import DataError
from lagbench.metrics.frame import Scenario, Snapshot, TaskConfig, snapshots
from lagbench.store.copy import update_working_copy
from lagbench.submission.truth import Truth

BLOCK_BYTES = 1 << 20
"""True positions are read in blocks of about this size [bytes].

A call for each frame costs more than its bytes.
"""


@dataclass(frozen=True)
class OpenScenario:
    """A scenario whose file is open."""

    scenario: Scenario  # properties that all its frames share
    file: ScenarioFile

    @property
    def obstacle(self) -> NDArray[np.float32] | None:
        """Centre and radius of a fixed obstacle [length]; None without one."""
        parameters = self.file.header.parameters
        dimension = self.scenario.config.box.dimension
        return parse_obstacle(parameters, dimension, where=str(self.file.path))

    def snapshots(self) -> Iterator[Snapshot]:
        """Yield the true snapshots of the predicted frames; a block is in memory."""
        return snapshots(self.scenario, self._frames())

    def _frames(self) -> Iterator[NDArray[np.float32]]:
        numbers = self.scenario.config.predicted_frames
        particle_bytes = 4 * self.scenario.config.box.dimension
        frame_bytes = particle_bytes * len(self.scenario.material)
        step = max(1, BLOCK_BYTES // frame_bytes)
        for first in numbers[::step]:
            last = min(first + step, numbers.stop)
            yield from self.file.read("position", slice(first, last))


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
            mass = file.read_particle_mass()
            input_frames = slice(0, self.config.input_frames)
            properties = Scenario(
                config=self.config,
                input_positions=file.read("position", input_frames),
                material=material,
                particle_mass=mass,
                area=mass * len(material) / self.density,
                active_frames=_active_frames(file),
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
    present: set[str] = set()
    for scenario in scenarios:
        present.update(_materials(truth, scenario))

    if size.measured:
        statistics: Mapping[str, tuple[float, ...]] = size.measured.statistics
        limit = size.measured.twin_floor
        if subset == "shift":
            limit = ()  # it was measured on test
    else:
        manifest = read_manifest(root, size.split, size.name, size.major)
        statistics = manifest.statistics if manifest else {}
        limit = _predictability_limit(manifest, scenarios)

    task = size.task
    config = TaskConfig(
        grid=size.field_grid,
        input_frames=task.input_frames,
        horizon=task.horizon,
        frames_of_interest=task.frames_of_interest,
        attribute_std=_attribute_std(size, root, statistics),
        radius=task.radius,
        materials=tuple(name for name in MATERIALS if name in present),
    )
    return ScoredTask(
        truth=truth,
        config=config,
        density=float(size.value("density")),
        predictability_limit=limit,
    )


def _active_frames(file: ScenarioFile) -> int | None:
    """Return the predicted frames until the truth rests, None if not stated."""
    stated = file.header.parameters.get("active_frames")
    if stated is None:
        return None
    if isinstance(stated, int | np.integer) and stated >= 0:
        return int(stated)
    raise DataError(
        "active_frames is no number of frames",
        where=str(file.path),
        expected="a whole number from 0",
        got=stated,
        fix="mend the parameter in the file, or make the data again",
    )


def _materials(truth: Truth, scenario: int) -> set[str]:
    """Return the materials of a scenario after a check of its length and of them."""
    needed = truth.size.task.input_frames + truth.size.task.horizon
    with truth.open(scenario) as file:
        frames = file.header.frames
        file.check_material()
        material = file.read("material")
    if frames < needed:
        raise DataError(
            f"a {truth.subset} scenario is too short",
            where=str(truth.path(scenario)),
            expected=f"{needed} frames",
            got=frames,
            fix="make the data again, or shorten the task in split.yaml",
        )
    return {MATERIALS[value] for value in np.unique(material).tolist()}


def _attribute_std(
    size: Size, root: Path, statistics: Mapping[str, tuple[float, ...]]
) -> tuple[float, ...]:
    """Return the standard deviations of position and velocity components over train."""
    dimension = size.box.dimension
    position_std = statistics.get("position_std", ())
    velocity_std = statistics.get("velocity_std", ())
    if len(position_std) != dimension or len(velocity_std) != dimension:
        raise DataError(
            "the statistics of train are not recorded",
            where=f"{size.record_name}, and the manifest of {size.split} {size.name} "
            f"in {root}",
            expected=f"position_std and velocity_std, {dimension} numbers each",
            got=", ".join(statistics) or "nothing",
            fix=suggest_repair(size, root=root),
        )
    return (*position_std, *velocity_std)


def _predictability_limit(
    manifest: Manifest | None, scenarios: Sequence[int]
) -> tuple[float, ...]:
    """Return the predictability limit (``twin_floor``) per frame.

    It is the mean over scenarios. Empty unless every scenario has one and all have the
    same number of frames.
    """
    if manifest is None:
        return ()
    limits = []
    for scenario in scenarios:
        entry = manifest.entry(scenario)
        if entry is None or not entry.twin_floor:
            return ()
        limits.append(entry.twin_floor)

    lengths = {len(limit) for limit in limits}
    if len(lengths) != 1:
        return ()
    return tuple(np.mean(limits, axis=0).tolist())
