"""The public figures of a generated data set; every checkpoint holds them."""

from __future__ import annotations

from pathlib import Path

from lagbench.data import WALL
from lagbench.data.box import parse_obstacle
from lagbench.data.layout import dataset_folder
from lagbench.data.local import locate, suggest_repair
from lagbench.data.manifest import read_manifest
from lagbench.data.registry import Registry, Size
from lagbench.data.scenario import read_scenario
from lagbench.errors import DataError
from lagbench.store.copy import update_working_copy

from .baseline import DatasetInfo


def read_dataset_info(
    split: str | Path,
    size: str | None = None,
    *,
    root: str | Path | None = None,
    registry: Registry | None = None,
) -> DatasetInfo:
    """Return the public figures of a generated data set.

    Raises:
        DataError: the data set is not there, or not complete.
    """
    tier, root_folder, _ = locate(split, size, root=root, registry=registry)
    folder = dataset_folder(root_folder, tier.split, tier.name, tier.major)
    hint = suggest_repair(tier, root=root_folder)

    update_working_copy(tier, root_folder)
    manifest = read_manifest(root_folder, tier.split, tier.name, tier.major)
    if manifest is None:
        raise DataError(
            f"the data set is not generated: no manifest; {hint}", where=str(folder)
        )
    # Data at hand have the hash and the statistics of datasets.yaml where they are not
    # complete; but not where they may have other bits.
    dataset_sha256 = manifest.dataset_sha256
    statistics = manifest.statistics
    if tier.measured is not None:
        if not dataset_sha256 and manifest.identity == "bitwise":
            dataset_sha256 = tier.measured.dataset_sha256
        statistics = statistics or tier.measured.statistics
    if not manifest.files or dataset_sha256 is None or not statistics:
        raise DataError(
            f"{len(manifest.files)} of {len(tier.scenarios)} scenarios are there; "
            f"{hint}",
            where=str(folder),
        )
    rows = {}
    for name, row in statistics.items():
        rows[name] = tuple(float(value) for value in row)

    first_file = manifest.files[0]
    update_working_copy(tier, root_folder, [first_file.scenario])
    with read_scenario(folder / first_file.path) as file:
        moving_walls = "wall_velocity" in file.variables
        wall_particles = bool((file.read("material") == WALL).any())

    task = tier.task
    return DatasetInfo(
        split=tier.split,
        size=tier.name,
        version=tier.version,
        dataset_sha256=dataset_sha256,
        particles=tier.particles,
        bounds=tier.bounds,
        periodic=tier.periodic,
        radius=task.radius,
        input_frames=task.input_frames,
        horizon=task.horizon,
        score_cells=task.score_grid.cells,
        score_placement=task.score_grid.placement,
        frame_interval=tier.frame_interval,
        moving_walls=moving_walls,
        wall_particles=wall_particles,
        statistics=rows,
    )


def find_forcing(size: Size, root: Path) -> frozenset[str]:
    """Return which of "body_force" and "obstacle" act in the scenarios of a data set.

    One scenario that is here stands for all.

    Args:
        size: the data set.
        root: folder of all data sets.
    """
    for scenario in size.scenarios:
        path = size.path(root, scenario)
        if path.is_file():
            break
    else:
        return frozenset()

    forcing = set()
    with read_scenario(path) as file:
        header = file.header
        if "body_force" in file.variables:
            forcing.add("body_force")
        where = str(header.key)
        if parse_obstacle(header.parameters, size.dimension, where=where) is not None:
            forcing.add("obstacle")
    return frozenset(forcing)
