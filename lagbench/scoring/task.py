"""The test subset as metrics see it: what submissions are scored on.

Scoring needs the files of ``test`` only; what follows from ``train`` stands in
datasets.yaml or, for a data set that is not recorded there, in its manifest.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lagbench.data import MATERIALS
from lagbench.data.grid import Grid, Placement
from lagbench.data.local import suggest_repair
from lagbench.data.manifest import Manifest, read_manifest
from lagbench.data.registry import Size
from lagbench.data.scenario import ScenarioFile
from lagbench.errors import DataError
from lagbench.metrics.frame import Scenario, Setting, Snapshot, snapshots
from lagbench.store.copy import update_working_copy
from lagbench.submission.truth import Truth

BLOCK_BYTES = 1 << 20
"""True positions are read in blocks of about this size: a call for each frame costs
more than its bytes.
"""


@dataclass(frozen=True)
class OpenScenario:
    """A scenario whose file is open."""

    scenario: Scenario  # what holds in all its frames
    file: ScenarioFile

    def snapshots(self) -> Iterator[Snapshot]:
        """Yield the true snapshots of the predicted frames, a block in memory at a
        time.
        """
        return snapshots(self.scenario, self._frames())

    def _frames(self) -> Iterator[NDArray[np.float32]]:
        numbers = self.scenario.setting.predicted_frames
        step = max(1, BLOCK_BYTES // (8 * len(self.scenario.material)))
        for first in numbers[::step]:
            yield from self.file.read(
                "position", slice(first, min(first + step, numbers.stop))
            )


@dataclass(frozen=True, kw_only=True)
class ScoredTask:
    """The test subset of one split and size; while a model is trained, the valid
    subset.
    """

    truth: Truth  # its files
    setting: Setting  # the split and size, as metrics see it
    density: float  # rest density [mass/length^2]
    # position RMSE of the nudged twin per predicted frame [length]; empty where it is
    # recorded nowhere
    twin_floor: tuple[float, ...] = ()

    @property
    def size(self) -> Size:
        """What the registry says of the split and size."""
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
            mass = float(file.read("particle_mass"))
            held = Scenario(
                setting=self.setting,
                given=file.read("position", slice(0, self.setting.input_frames)),
                material=material,
                particle_mass=mass,
                area=mass * len(material) / self.density,
                active_frames=_active_frames(file),
            )
            yield OpenScenario(held, file)


def load_scored_task(size: Size, root: Path, *, subset: str = "test") -> ScoredTask:
    """Check that a subset is there and gather what the metrics need to know."""
    update_working_copy(size, root, size.subsets[subset])
    truth = Truth(size, root, subset)
    truth.require()
    truth.check()
    scenarios = sorted(size.subsets[subset])
    present = set().union(*(_materials(truth, scenario) for scenario in scenarios))
    if size.measured:
        manifest = None
    else:
        manifest = read_manifest(root, size.split, size.name, size.major)
    task = size.task
    return ScoredTask(
        truth=truth,
        density=float(size.value("density")),
        twin_floor=size.measured.twin_floor
        if size.measured
        else _floor(manifest, scenarios),
        setting=Setting(
            grid=Grid(task.score_grid.cells, Placement(task.score_grid.placement)),
            input_frames=task.input_frames,
            horizon=task.horizon,
            frames_of_interest=task.frames_of_interest,
            attribute_std=_attribute_std(size, root, manifest),
            radius=task.radius,
            materials=tuple(name for name in MATERIALS if name in present),
            bounds=size.bounds,
        ),
    )


def _active_frames(file: ScenarioFile) -> int | None:
    """Return how many predicted frames pass until the truth rests, None where the file
    does not say.
    """
    stated = file.header.parameters.get("active_frames")
    if stated is None or (isinstance(stated, int | np.integer) and stated >= 0):
        if stated is None:
            return None
        return int(stated)
    raise DataError(
        "active_frames is no number of frames",
        where=str(file.path),
        expected=">= 0",
        got=stated,
    )


def _materials(truth: Truth, scenario: int) -> set[str]:
    """Return the materials of a scenario after checking that its file is long
    enough.
    """
    needed = truth.size.task.input_frames + truth.size.task.horizon
    with truth.open(scenario) as file:
        frames = file.header.frames
        material = file.read("material")
    if frames < needed:
        where = str(truth.path(scenario))
        what = f"a {truth.subset} scenario is too short"
        raise DataError(what, where=where, expected=f"{needed} frames", got=frames)
    return {MATERIALS[value] for value in np.unique(material).tolist()}


def _attribute_std(
    size: Size, root: Path, manifest: Manifest | None
) -> tuple[float, float, float, float]:
    """Return the standard deviations of x, y, u, v over train."""
    known: Mapping[str, tuple[float, ...]] = manifest.statistics if manifest else {}
    if size.measured:
        known = size.measured.statistics
    try:
        (x, y), (u, v) = known["position_std"], known["velocity_std"]
    except (KeyError, ValueError):
        raise DataError(
            "the statistics of train are recorded nowhere",
            where=f"datasets.yaml, and the manifest of {size.split} {size.name} "
            f"in {root}",
            expected="position_std and velocity_std, two numbers each",
            got=", ".join(known) or "nothing",
            fix=suggest_repair(size, root=root),
        ) from None
    return x, y, u, v


def _floor(manifest: Manifest | None, test: Sequence[int]) -> tuple[float, ...]:
    """Return the mean twin floor over the test scenarios, empty unless all have one."""
    entries = [manifest.entry(scenario) if manifest else None for scenario in test]
    rows = [entry.twin_floor for entry in entries if entry and entry.twin_floor]
    if len(rows) < len(test) or len({len(row) for row in rows}) != 1:
        return ()
    return tuple(np.mean(rows, axis=0).tolist())
