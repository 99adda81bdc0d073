"""Export a data set to formats of other code bases.

Their models train on it unchanged.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from lagbench.atomic import atomic_path
from lagbench.data.checksums import HASHED_SUBSETS
from lagbench.data.layout import expand_path
from lagbench.data.local import locate, suggest_repair
from lagbench.data.manifest import read_manifest
from lagbench.data.registry import Registry, Size
from lagbench.data.scenario import ScenarioFile, read_scenario
from lagbench.errors import DataError, UsageError
from lagbench.generators.constants import solver_constants
from lagbench.make.inventory import has_all_statistics
from lagbench.store.copy import scenario_files
from lagbench.work.run import Meter, Progress

from . import gns_npz
from .metadata import (
    ENDINGS,
    FORCE,
    NAME,
    SHORT_NAMES,
    WALL_NUMBERS,
    ExportInfo,
    Format,
    describe_export,
    material_numbers,
    parse_format,
    round_down,
    write_metadata,
)
from .trajectory import Bounds, Run

WALL_LAYERS = 3
"""Layers of particles of a wall, as LagrangeBench's own lid-driven cavity has them."""

WALL_AXES = (1, 1, 0, 0)
"""Axis along each wall: left, right, bottom, top."""

LOW_WALLS = (0, 2)
"""Left and bottom."""


@dataclass(frozen=True, kw_only=True)
class ExportResult:
    """What was written."""

    format: str  # name of the format
    split: str  # name of the split
    size: str  # name of the size
    folder: Path  # folder of the files
    files: tuple[Path, ...]  # the files
    trajectories: dict[str, int]  # number of trajectories by subset
    frames: dict[str, int]  # frames by subset, over all trajectories
    # frames that are not in the files, because that format needs equal lengths
    left_out: int
    # whether walls may move and the files do not tell how
    loses_wall_motion: bool
    bytes: int  # length of the files together [bytes]


def export(
    split: str | Path,
    size: str | None = None,
    *,
    format: str,
    output: str | Path,
    root: str | Path | None = None,
    from_walls: bool | None = None,
    wall_particles: bool = False,
    overwrite: bool = False,
    progress: Callable[[Progress], None] | None = None,
    registry: Registry | None = None,
) -> ExportResult:
    """Write train, valid and test of a data set, and metadata.json, in another format.

    One trajectory is in memory at a time. The same data give the same bytes with one
    version of NumPy.

    Args:
        split: name of the split, or path of a local split's folder.
        size: name of the size; None takes the only one with data, or mini where several
            have data.
        format: "gns-npz" or "lagrangebench-h5".
        output: folder for the files.
        root: folder of all data sets, see :func:`lagbench.data.local.resolve_root`.
        from_walls: lagrangebench-h5 only: measure positions from the lower walls, so
            that the bounds that its models see are the walls; no bit is lost. Else
            positions are ours, and the bounds those of the unit box, which that
            program's neighbour search needs. None: from the walls in full boxes, and
            where walls may move or an axis is periodic.
        wall_particles: full boxes of two dimensions with four walls only: add
            particles beside the walls that move along with them, since neither
            format has wall velocities.
        overwrite: whether to replace an earlier export, or to write beside other files.
        progress: called as the work advances.
        registry: where splits are described; ours when None.

    Raises:
        UsageError: unknown split, size or format, the folder holds files, or a
            ``force.py``, which the program that reads lagrangebench-h5 would run; or
            there are no walls.
        DataError: scenarios are missing or damaged, or their statistics are recorded
            nowhere.
        WorkFailedError: the disk is full or not writable.
    """
    file_format = parse_format(format)
    _check_from_walls(file_format, from_walls=from_walls)
    tier, data_root, rooted_registry = locate(split, size, root=root, registry=registry)
    target = expand_path(output, "--output")
    path_by_subset = {}
    for subset in HASHED_SUBSETS:
        path_by_subset[subset] = target / f"{subset}{ENDINGS[file_format]}"
    paths = tuple(path_by_subset.values())
    _check_target(target, paths, overwrite=overwrite)

    frames_by_subset = _frames_by_subset(tier, data_root)
    statistics, dataset_sha256 = _recorded_statistics(tier, data_root)
    spacing, has_wall_velocity = _inspect_scenario(
        next(iter(frames_by_subset["train"])), tier
    )
    if from_walls is None:
        is_measured_from_walls = (
            tier.is_full_box or has_wall_velocity or tier.box.is_periodic
        )
    else:
        is_measured_from_walls = from_walls
    walls = None
    if wall_particles:
        has_unit_box = from_walls is False and file_format is Format.LAGRANGEBENCH_H5
        _check_walls(
            tier, has_wall_velocity=has_wall_velocity, has_unit_box=has_unit_box
        )
        walls = WallParticles(tier.bounds, spacing)
    wall_thickness = None
    if walls is not None:
        wall_thickness = walls.thickness
    origin = (0.0,) * tier.dimension
    if file_format is Format.LAGRANGEBENCH_H5 and (is_measured_from_walls or walls):
        origin = _lower_corner(tier, wall_thickness or 0.0)

    with contextlib.suppress(OSError):  # written last, it says that an export is whole
        (target / NAME).unlink()
    meter = Meter(progress)
    scenario_count = sum(map(len, frames_by_subset.values()))
    meter.begin("exporting", total=len(frames_by_subset), scenarios=scenario_count)
    shapes: dict[str, list[tuple[int, int]]] = {}
    for subset, frames in frames_by_subset.items():
        path = path_by_subset[subset]
        runs = _read_runs(frames, file_format, tier.frame_interval, walls)
        if file_format is Format.GNS_NPZ:
            shapes[subset] = gns_npz.write(path, runs)
        else:
            shortest = min(frames.values())
            shapes[subset] = _write_h5(path, runs, length=shortest, origin=origin)
        meter.count(1, scenarios=len(frames))

    info = ExportInfo(
        title=rooted_registry.split(tier.split).title,
        dataset_sha256=dataset_sha256,
        statistics=statistics,
        spacing=spacing,
        origin=origin,
        from_walls=is_measured_from_walls,
        is_free_slip=_is_free_slip(tier),
        wall_thickness=wall_thickness,
    )
    metadata = describe_export(tier, file_format, shapes, info)
    metadata_path = write_metadata(target, metadata)
    written = (*paths, metadata_path)
    return _summarise(
        tier,
        file_format,
        target,
        written,
        frames_by_subset,
        shapes,
        loses_wall_motion=has_wall_velocity and not wall_particles,
    )


def _check_from_walls(file_format: Format, *, from_walls: bool | None) -> None:
    """Refuse the option --from-walls for a format that has none."""
    if from_walls and file_format is not Format.LAGRANGEBENCH_H5:
        raise UsageError(
            "this option is for lagrangebench-h5 only",
            where="--from-walls",
            expected="--format lagrangebench-h5",
            got=file_format.value,
            fix="leave --from-walls out",
        )


def _summarise(
    size: Size,
    file_format: Format,
    folder: Path,
    files: tuple[Path, ...],
    frames_of: Mapping[str, Mapping[Path, int]],
    shapes: Mapping[str, Sequence[tuple[int, int]]],
    *,
    loses_wall_motion: bool,
) -> ExportResult:
    """Return what was written.

    Args:
        size: the data set.
        file_format: format of the files.
        folder: folder of the files.
        files: the files, metadata.json too.
        frames_of: frames of each scenario file by subset.
        shapes: frames and particles of each trajectory that was written, by subset.
        loses_wall_motion: whether walls may move and the files do not tell how.
    """
    trajectory_counts = {}
    frame_counts = {}
    left_out = 0
    for subset, trajectories in shapes.items():
        written_frames = sum(frames for frames, _ in trajectories)
        present_frames = sum(frames_of[subset].values())
        trajectory_counts[subset] = len(trajectories)
        frame_counts[subset] = written_frames
        left_out += present_frames - written_frames
    return ExportResult(
        format=file_format.value,
        split=size.split,
        size=size.name,
        folder=folder,
        files=files,
        trajectories=trajectory_counts,
        frames=frame_counts,
        left_out=left_out,
        loses_wall_motion=loses_wall_motion,
        bytes=sum(path.stat().st_size for path in files),
    )


def _lower_corner(size: Size, wall_thickness: float) -> tuple[float, ...]:
    """Return what is taken off every position of lagrangebench-h5 [length].

    No position is below 0 then, where the bounds start.
    """
    return tuple(round_down(low - wall_thickness) for low, _ in size.bounds)


def _check_target(folder: Path, files: Sequence[Path], *, overwrite: bool) -> None:
    """Refuse a folder that must not be written to."""
    if (folder / FORCE).exists():
        raise UsageError(
            "the folder holds a program that readers of this format run",
            where=str(folder / FORCE),
            expected=f"a folder without {FORCE}",
            got=FORCE,
            fix="name another folder: --output",
        )
    existing = []
    for path in (*files, folder / NAME):
        if path.exists():
            existing.append(path.name)
    if existing and not overwrite:
        raise UsageError(
            "files of that name are there",
            where=str(folder),
            expected="a folder without files of these names",
            got=", ".join(existing),
            fix="replace them: --overwrite; or name another folder: --output",
        )
    if folder.is_dir() and not overwrite:
        others = []
        for path in sorted(folder.iterdir()):
            if not path.name.startswith("."):  # hidden, as some file browsers leave
                others.append(path.name)
        if others:
            raise UsageError(
                "the folder holds other files",
                where=str(folder),
                expected="an empty folder, or a new one",
                got=", ".join(others[:5]),
                fix="name another folder: --output; or write beside these files: "
                "--overwrite",
            )


def _check_walls(size: Size, *, has_wall_velocity: bool, has_unit_box: bool) -> None:
    """Refuse wall particles where no wall can move, or where they have no room."""
    if not has_wall_velocity or size.box.is_periodic or size.dimension != 2:
        raise UsageError(
            "wall particles need a box of two dimensions with four walls",
            where="--wall-particles",
            expected="a split such as cavity",
            got=size.split,
            fix="leave --wall-particles out",
        )
    if has_unit_box:
        raise UsageError(
            "wall particles lie outside the unit box's bounds",
            where="--wall-particles and --unit-box",
            expected="one of the two",
            got="both",
            fix="leave out --unit-box",
        )


def _inspect_scenario(path: Path, size: Size) -> tuple[float, bool]:
    """Return the spacing of particles [length], and whether walls may move."""
    with read_scenario(path) as file:
        mass = file.read_particle_mass()
        has_wall_velocity = "wall_velocity" in file.variables
    volume = mass / float(size.value("density"))
    if size.dimension == 2:
        return math.sqrt(volume), has_wall_velocity
    return math.cbrt(volume), has_wall_velocity


def _is_free_slip(size: Size) -> bool:
    """Return whether liquid slides along the walls, as with unknown solvers."""
    if not size.simulated:
        return True
    return not getattr(solver_constants(size), "no_slip", False)


class WallParticles:
    """Layers of particles beside each wall of a box.

    They go along with the wall, and what leaves at one end comes in at the other.
    """

    def __init__(self, bounds: Bounds, spacing: float) -> None:
        self.thickness = WALL_LAYERS * spacing
        self._bounds = np.array(bounds)
        low, high = self._bounds.T
        # wall, place along it [length], place across it [length]
        rows: list[tuple[int, float, float]] = []
        depths = spacing * (np.arange(WALL_LAYERS) + 0.5)
        for wall, axis in enumerate(WALL_AXES):
            other_axis = 1 - axis
            length = high[axis] - low[axis]
            count = max(1, round(length / spacing))
            pitch = length / count
            for depth in depths:
                if wall in LOW_WALLS:
                    across = low[other_axis] - depth
                else:
                    across = high[other_axis] + depth
                for number in range(count):
                    along = low[axis] + pitch * (number + 0.5)
                    rows.append((wall, along, across))
        walls, along, across = np.array(rows).T
        self.wall = walls.astype(int)  # which each particle lies beside
        self._along = along
        self._across = across

    def read_with_walls(
        self, file: ScenarioFile, travel: NDArray[np.float64], frame: int
    ) -> NDArray[np.float32]:
        """Return positions of a frame's particles and, behind them, of wall particles.

        ``travel`` is how far walls have gone [length], shape [frame, wall].
        """
        wall_axes = np.array(WALL_AXES)
        axis = wall_axes[self.wall]
        low, high = self._bounds[axis].T
        start = self._along - low
        moved = start + travel[frame, self.wall]
        along = low + moved % (high - low)
        is_along = axis[:, None] == [0, 1]  # [particle, space]
        exact_places = np.where(is_along, along[:, None], self._across[:, None])
        wall_position = exact_places.astype(np.float32)
        position = file.read("position", frame)
        return np.concatenate([position, wall_position])


def _read_runs(
    files: Iterable[Path],
    file_format: Format,
    interval: float,
    walls: WallParticles | None,
) -> Iterator[Run]:
    """Yield the scenarios of a subset, each open until the next one is asked for."""
    for path in files:
        with read_scenario(path) as file:
            kinds = material_numbers(file_format, file.read("material"))
            if walls is None:
                yield file.header.frames, partial(file.read, "position"), kinds
                continue
            wall_velocity = file.read("wall_velocity")
            wall_kinds = _wall_kinds(file_format, wall_velocity, walls)
            travel = _wall_travel(wall_velocity, interval)
            read_position = partial(walls.read_with_walls, file, travel)
            kinds = np.concatenate([kinds, wall_kinds])
            yield file.header.frames, read_position, kinds


def _wall_kinds(
    file_format: Format, wall_velocity: NDArray[np.floating], walls: WallParticles
) -> NDArray[np.int64]:
    """Return the number of each wall particle: of a wall at rest, or one that moves."""
    at_rest, moving = WALL_NUMBERS[file_format]
    ever_moves = (wall_velocity != 0.0).any(axis=(0, 2))
    return np.where(ever_moves[walls.wall], moving, at_rest)


def _wall_travel(
    wall_velocity: NDArray[np.floating], interval: float
) -> NDArray[np.float64]:
    """Return how far each wall has gone along itself [length], shape [frame, wall]."""
    walls = range(len(WALL_AXES))
    along = wall_velocity[:, walls, WALL_AXES].astype(np.float64)
    steps = interval * along
    steps[0] = 0.0  # velocity[f] acts from frame f-1 to f
    return np.cumsum(steps, axis=0)


def _write_h5(
    path: Path, runs: Iterable[Run], *, length: int, origin: tuple[float, ...]
) -> list[tuple[int, int]]:
    """Write one subset for LagrangeBench, whole or not at all.

    LagrangeBench takes the length of the first trajectory for all. So each run is cut
    into trajectories of this length, and the frames left over are not written. Chunks
    have one frame: LagrangeBench reads these 5 to 10 times faster than other chunks.

    Args:
        path: the file.
        runs: scenarios, or their active frames.
        length: frames of each trajectory.
        origin: point from which positions are measured [length].

    Returns:
        Frames and particles of each trajectory.
    """
    shift = np.asarray(origin, np.float32)
    shapes: list[tuple[int, int]] = []
    with (
        atomic_path(path, option="--output") as temporary,
        h5py.File(temporary, "w", libver="earliest") as out,
    ):
        for frame_count, read_position, kinds in runs:
            particle_count = len(kinds)
            for start in range(0, frame_count - length + 1, length):
                group = out.create_group(f"{len(shapes):05d}")
                stored = group.create_dataset(
                    "position",
                    shape=(length, particle_count, len(shift)),
                    dtype="<f4",
                    chunks=(1, particle_count, len(shift)),
                    compression="gzip",
                    compression_opts=1,
                    shuffle=True,
                    track_times=False,
                )
                for row in range(length):
                    stored[row] = read_position(start + row) - shift
                group.create_dataset(
                    "particle_type", data=kinds.astype("<i8"), track_times=False
                )
                shapes.append((length, particle_count))
    return shapes


def _recorded_statistics(
    size: Size, root: Path
) -> tuple[dict[str, tuple[float, ...]], str]:
    """Return statistics over train and the data set hash.

    They are those of the registry, else of the manifest.
    """
    if size.measured:
        statistics = dict(size.measured.statistics)
        _check_names_of_statistics(size, statistics)
        return statistics, size.measured.dataset_sha256
    manifest = read_manifest(root, size.split, size.name, size.major)
    if manifest is None or manifest.dataset_sha256 is None or not manifest.statistics:
        raise DataError(
            "the data set is not complete: the statistics of train are "
            "recorded nowhere",
            where=f"{size.split} {size.name} in {root}",
            expected="all scenarios of train",
            got="some, and no recorded statistics",
            fix=suggest_repair(size, root=root),
        )
    if not has_all_statistics(manifest, size):
        raise DataError(
            "the manifest has no whole statistics of train",
            where=f"{size.split} {size.name} in {root}, key statistics",
            expected="mean and standard deviation of position, velocity and "
            f"acceleration, each of {size.dimension} numbers",
            got=_count_numbers(manifest.statistics),
            fix=suggest_repair(size, root=root),
        )
    return dict(manifest.statistics), manifest.dataset_sha256


def _check_names_of_statistics(
    size: Size, statistics: Mapping[str, Sequence[float]]
) -> None:
    """Refuse recorded statistics that lack a quantity which the metadata state.

    Train with two frames for each scenario has velocities, but no acceleration.
    """
    missing_names = []
    for quantity in SHORT_NAMES.values():
        for name in (f"{quantity}_mean", f"{quantity}_std"):
            if name not in statistics:
                missing_names.append(name)
    if not missing_names:
        return
    raise DataError(
        "the recorded statistics of train lack a quantity",
        where=f"{size.split} {size.name} in {size.file}, key statistics",
        expected="mean and standard deviation of velocity and acceleration",
        got=f"no {', no '.join(missing_names)}",
        fix="make the split again with three frames or more in a scenario of train: "
        "an acceleration needs three",
    )


def _count_numbers(statistics: Mapping[str, Sequence[float]]) -> str:
    """Return the names of statistics, and how many numbers each has, for a message."""
    counts = [f"{name}: {len(row)}" for name, row in statistics.items()]
    return ", ".join(counts)


def _frames_by_subset(size: Size, root: Path) -> dict[str, dict[Path, int]]:
    """Return files and their frames by subset, in order of their ids.

    The header of each file is compared with the registry.
    """
    frames_of: dict[str, dict[Path, int]] = {subset: {} for subset in HASHED_SUBSETS}
    for scenario, path in sorted(scenario_files(size, root, HASHED_SUBSETS).items()):
        with read_scenario(path) as file:
            header = file.header
        expected_hash = size.registered_hash(scenario)
        is_right_scenario = (
            header.key.major == size.major and header.key.scenario == scenario
        )
        if not is_right_scenario or not header.content_sha256.startswith(expected_hash):
            raise DataError(
                "a scenario is not that of the registry",
                where=str(path),
                expected=f"scenario {scenario}, content hash {expected_hash or 'any'}",
                got=f"scenario {header.key.scenario}, content hash "
                f"{header.content_sha256[:16]}",
                fix=f"lagbench verify --split {size.split} --size {size.name}",
            )
        frames_of[size.subset_of(scenario)][path] = header.frames
    return frames_of
