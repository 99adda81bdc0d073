"""What a baseline may know of a data set: public figures of datasets.yaml, never a test scenario."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import Field, TypeAdapter

from lagbench.data.layout import dataset_folder
from lagbench.data.local import locate, remedy
from lagbench.data.manifest import Manifest, read_manifest
from lagbench.data.registry import Registry, Size
from lagbench.data.scenario import read_scenario
from lagbench.errors import DataError
from lagbench.store.copy import bring

__all__ = ["Facts", "facts_of"]

# Checked where facts are read from a file, which may be a stranger's: names are no paths.
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$")]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Count = Annotated[int, Field(gt=0)]
Pair = tuple[Finite, Finite]


@dataclass(frozen=True, kw_only=True)
class Facts:
    """Public figures of one size of a split; they travel in every checkpoint."""

    split: Name  # name of the split
    size: Name  # name of the size
    version: str  # semantic version of the split
    dataset_sha256: str  # hash of the data set
    particles: Count  # particles in one scenario
    bounds: tuple[Pair, Pair]  # box that holds the particles, (low, high) along x and y [length]
    radius: Positive  # connectivity radius [length]
    input_frames: Count  # frames given at the start of a test scenario
    horizon: Count  # frames to predict after them
    score_cells: Count  # cells across of the scorer's grid
    score_placement: str  # 'cell_centres' or 'nodes', where that grid's nodes lie
    frame_interval: Positive  # time between frames [s]
    moving_walls: bool  # whether scenario files hold wall_velocity
    # over train: position_mean, position_std [length], velocity_mean, velocity_std [length/frame],
    # acceleration_mean, acceleration_std [length/frame^2], one (x, y) pair each
    statistics: Mapping[str, Pair]

    def as_json(self) -> dict[str, Any]:
        """Return plain values, as checkpoints hold them."""
        return asdict(self)

    @classmethod
    def from_json(cls, values: object) -> Self:
        """Return the facts that :meth:`as_json` gave."""
        return TypeAdapter(cls).validate_python(values)


def facts_of(
    split: str, size: str | None = None, *, root: str | Path | None = None, registry: Registry | None = None
) -> Facts:
    """Return the public figures of a generated data set."""
    tier, folder, _ = locate(split, size, root=root, registry=registry)
    bring(tier, folder)
    manifest = read_manifest(folder, tier.split, tier.name, tier.major)
    if manifest is None:
        raise _absent(tier, folder, "the data set is not generated")
    task = tier.task
    return Facts(
        split=tier.split,
        size=tier.name,
        version=tier.version,
        dataset_sha256=_hash(tier, manifest, folder),
        particles=tier.particles,
        bounds=tier.bounds,
        radius=task.radius,
        input_frames=task.input_frames,
        horizon=task.horizon,
        score_cells=task.score_grid.cells,
        score_placement=task.score_grid.placement,
        frame_interval=tier.frame_interval,
        moving_walls=_moving_walls(tier, manifest, folder),
        statistics=_statistics(tier, manifest, folder),
    )


def _absent(size: Size, root: Path, what: str) -> DataError:
    return DataError(
        what,
        where=str(dataset_folder(root, size.split, size.name, size.major)),
        fix=remedy(size, root=root),
    )


def _hash(size: Size, manifest: Manifest, root: Path) -> str:
    """Return the hash of what is here; where some subset is missing, the recorded one."""
    recorded = size.measured.dataset_sha256 if size.measured else None
    known = manifest.dataset_sha256 or recorded
    if known is None:
        raise _absent(size, root, "the data set is not complete")
    return known


def _statistics(size: Size, manifest: Manifest, root: Path) -> dict[str, Pair]:
    """Return mean and std over train: measured here, else the recorded ones."""
    recorded = size.measured.statistics if size.measured else {}
    found = manifest.statistics or recorded
    if not found:
        raise _absent(size, root, "the subset train is not complete, its statistics are unknown")
    return {name: (float(x), float(y)) for name, (x, y) in found.items()}


def _moving_walls(size: Size, manifest: Manifest, root: Path) -> bool:
    if not manifest.files:
        raise _absent(size, root, "the data set is empty")
    folder = dataset_folder(root, size.split, size.name, size.major)
    bring(size, root, [manifest.files[0].scenario])
    with read_scenario(folder / manifest.files[0].path) as file:
        return "wall_velocity" in file.variables
