"""The public figures of a data set at hand, which travel in every checkpoint."""

from __future__ import annotations

from pathlib import Path

from lagbench.data.layout import dataset_folder
from lagbench.data.local import locate, suggest_repair
from lagbench.data.manifest import read_manifest
from lagbench.data.registry import Registry
from lagbench.data.scenario import read_scenario
from lagbench.errors import DataError
from lagbench.store.copy import update_working_copy

from .baseline import Facts


def facts_of(
    split: str,
    size: str | None = None,
    *,
    root: str | Path | None = None,
    registry: Registry | None = None,
) -> Facts:
    """Return the public figures of a generated data set."""
    tier, home, _ = locate(split, size, root=root, registry=registry)
    folder = dataset_folder(home, tier.split, tier.name, tier.major)

    def absent(what: str) -> DataError:
        return DataError(what, where=str(folder), fix=suggest_repair(tier, root=home))

    update_working_copy(tier, home)
    manifest = read_manifest(home, tier.split, tier.name, tier.major)
    if manifest is None:
        raise absent("the data set is not generated")
    # what is here; where some subset is missing, what was recorded
    task = tier.task
    measured = tier.measured
    known = manifest.dataset_sha256 or (measured.dataset_sha256 if measured else None)
    statistics = manifest.statistics or (measured.statistics if measured else {})
    if known is None:
        raise absent("the data set is not complete")
    if not manifest.files:
        raise absent("the data set is empty")
    if not statistics:
        raise absent("the subset train is not complete, its statistics are unknown")
    update_working_copy(tier, home, [manifest.files[0].scenario])
    with read_scenario(folder / manifest.files[0].path) as file:
        moving_walls = "wall_velocity" in file.variables
    return Facts(
        split=tier.split,
        size=tier.name,
        version=tier.version,
        dataset_sha256=known,
        particles=tier.particles,
        bounds=tier.bounds,
        radius=task.radius,
        input_frames=task.input_frames,
        horizon=task.horizon,
        score_cells=task.score_grid.cells,
        score_placement=task.score_grid.placement,
        frame_interval=tier.frame_interval,
        moving_walls=moving_walls,
        statistics={name: (float(x), float(y)) for name, (x, y) in statistics.items()},
    )
