"""Export a data set to what other code bases read, so that their models train on it
unchanged.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from lagbench.atomic import atomic_path
from lagbench.data.checksums import HASHED_SUBSETS
from lagbench.data.local import locate, suggest_repair
from lagbench.data.manifest import read_manifest
from lagbench.data.registry import Registry, Size
from lagbench.data.scenario import ScenarioFile, read_scenario
from lagbench.errors import DataError, UsageError
from lagbench.generators.constants import solver_constants
from lagbench.store.copy import scenario_files
from lagbench.work.progress import Meter, Progress

from . import gns_npz
from .metadata import (
    ENDINGS,
    NAME,
    WALL_NUMBERS,
    Format,
    describe,
    floor_of,
    numbers_of,
    parse_format,
    write_metadata,
)
from .trajectory import Box, Run

FORCE = "force.py"  # name of the program beside the data that LagrangeBench would run
# layers of particles of a wall, as LagrangeBench's own lid-driven cavity has them
LAYERS = 3
ALONG = (1, 1, 0, 0)  # axis along each wall: left, right, bottom, top


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
    force: bool = False,
    progress: Callable[[Progress], None] | None = None,
    registry: Registry | None = None,
) -> ExportResult:
    """Write train, valid and test of a data set, and metadata.json, in another format.

    One trajectory is in memory at a time. The same data give the same bytes with one
    version of NumPy.

    Args:
        split: name of the split, or path of a local split's folder.
        size: name of the size; the only one that is there when None.
        format: "gns-npz" or "lagrangebench-h5".
        output: folder for the files.
        root: folder of all data sets, see :func:`lagbench.data.local.resolve_root`.
        from_walls: lagrangebench-h5 only: measure positions from the lower walls, so
            that the bounds that its models see are the walls; no bit is lost. Else
            positions are ours, and the bounds those of the unit box, which that
            program's neighbour search needs. None: from the walls in closed boxes.
        wall_particles: closed boxes only: add particles beside the walls that move
            along with them, since neither format has wall velocities.
        force: write over an earlier export.
        progress: called as the work advances.
        registry: where splits are described; ours when None.

    Raises:
        UsageError: unknown split, size or format, files are there already, or a
            ``force.py`` is, which the program that reads lagrangebench-h5 would run; or
            there are no walls.
        DataError: scenarios are missing or damaged, or their statistics are recorded
            nowhere.
        WorkFailedError: the disk is full or not writable.
    """
    form = parse_format(format)
    if from_walls and form is not Format.LAGRANGEBENCH_H5:
        raise UsageError(
            "only lagrangebench-h5 needs it", where="--from-walls", got=form.value
        )
    tier, home, splits = locate(split, size, root=root, registry=registry)
    folder = Path(output)
    ending = ENDINGS[form]
    _check_target(
        folder, [f"{subset}{ending}" for subset in HASHED_SUBSETS], force=force
    )
    frames_of = _frames_of(tier, home)
    statistics, digest = _recorded(tier, home)
    with read_scenario(next(iter(frames_of["train"]))) as file:
        spacing = math.sqrt(
            float(file.read("particle_mass")) / float(tier.value("density"))
        )
        closed = "wall_velocity" in file.variables
    walls = None
    if wall_particles:
        if not closed:
            raise UsageError(
                "the box has no walls that could move",
                where="--wall-particles",
                got=tier.split,
            )
        if from_walls is False and form is Format.LAGRANGEBENCH_H5:
            what = "wall particles lie outside the unit box's bounds"
            raise UsageError(
                what,
                where="--wall-particles and --unit-box",
                fix="leave out --unit-box",
            )
        walls = WallParticles(tier.bounds, spacing)
    if from_walls is None:
        measured = closed
    else:
        measured = from_walls
    # What is taken off every position, so that none is below 0 where bounds start
    # there.
    shifted = form is Format.LAGRANGEBENCH_H5 and (measured or wall_particles)
    if walls:
        beyond = walls.thickness
    else:
        beyond = 0.0
    left, bottom = (
        floor_of(low - beyond) if shifted else 0.0 for low, _ in tier.bounds
    )
    with contextlib.suppress(OSError):  # written last, it says that an export is whole
        (folder / NAME).unlink()
    meter = Meter(progress)
    meter.begin(
        "exporting", total=len(frames_of), scenarios=sum(map(len, frames_of.values()))
    )
    shapes: dict[str, list[tuple[int, int]]] = {}
    for subset, files in frames_of.items():
        target = folder / f"{subset}{ending}"
        runs = _runs(files, form, tier.frame_interval, walls)
        if form is Format.GNS_NPZ:
            shapes[subset] = gns_npz.write(target, runs)
        else:
            shapes[subset] = _write_h5(
                target, runs, length=min(files.values()), origin=(left, bottom)
            )
        meter.count(1, scenarios=len(files))
    metadata = describe(
        tier,
        form,
        shapes,
        statistics,
        title=splits.split(tier.split).title,
        dataset_sha256=digest,
        spacing=spacing,
        origin=(left, bottom),
        from_walls=measured,
        free_slip=not (
            tier.simulated and getattr(solver_constants(tier), "no_slip", False)
        ),
        wall=walls.thickness if walls else None,
    )
    written = (
        *(folder / f"{subset}{ending}" for subset in frames_of),
        write_metadata(folder, metadata),
    )
    frames = {
        subset: sum(count for count, _ in rows) for subset, rows in shapes.items()
    }
    return ExportResult(
        format=form.value,
        split=tier.split,
        size=tier.name,
        folder=folder,
        files=written,
        trajectories={subset: len(rows) for subset, rows in shapes.items()},
        frames=frames,
        left_out=sum(sum(files.values()) for files in frames_of.values())
        - sum(frames.values()),
        bytes=sum(path.stat().st_size for path in written),
    )


class WallParticles:
    """Layers of particles beside each wall of a box: they go along and come in again at
    its other end.
    """

    def __init__(self, bounds: Box, spacing: float) -> None:
        self.thickness = LAYERS * spacing
        self._bounds = np.array(bounds)
        low, high = self._bounds.T
        # wall, place along it, place across it
        rows: list[tuple[int, float, float]] = []
        for wall, axis in enumerate(ALONG):
            count = max(1, round((high[axis] - low[axis]) / spacing))
            pitch = (high[axis] - low[axis]) / count
            for depth in spacing * (np.arange(LAYERS) + 0.5):
                if wall in (0, 2):
                    across = low[1 - axis] - depth
                else:
                    across = high[1 - axis] + depth
                rows += [
                    (wall, low[axis] + pitch * (n + 0.5), across) for n in range(count)
                ]
        walls, along, across = np.array(rows).T
        self.wall = walls.astype(int)  # which each particle lies beside
        self._along = along
        self._across = across

    def join(
        self, file: ScenarioFile, travel: NDArray[np.float64], frame: int
    ) -> NDArray[np.float32]:
        """Return the positions of a frame and, behind them, of walls that have gone so
        far [frame, wall].
        """
        axis = np.array(ALONG)[self.wall]
        low, high = self._bounds[axis].T
        along = low + (self._along - low + travel[frame, self.wall]) % (high - low)
        places = np.where(
            axis[:, None] == [0, 1], along[:, None], self._across[:, None]
        )
        return np.concatenate([file.read("position", frame), places.astype(np.float32)])


def _runs(
    files: Iterable[Path], form: Format, interval: float, walls: WallParticles | None
) -> Iterator[Run]:
    """Yield the scenarios of a subset, each open until the next one is asked for."""
    for path in files:
        with read_scenario(path) as file:
            kinds = numbers_of(form, file.read("material"))
            position = partial(file.read, "position")
            if walls is not None:
                velocity = file.read("wall_velocity")
                still, moving = WALL_NUMBERS[form]
                ever = (velocity != 0.0).any(axis=(0, 2))
                kinds = np.concatenate(
                    [kinds, np.where(ever[walls.wall], moving, still)]
                )
                steps = interval * velocity[:, range(len(ALONG)), ALONG].astype(
                    np.float64
                )
                steps[0] = 0.0  # velocity[f] acts from frame f-1 to f
                position = partial(walls.join, file, np.cumsum(steps, axis=0))
            yield file.header.frames, position, kinds


def _write_h5(
    path: Path, runs: Iterable[Run], *, length: int, origin: Sequence[float]
) -> list[tuple[int, int]]:
    """Write one subset for LagrangeBench, whole or not at all; return frames and
    particles by trajectory.
    """
    shapes: list[tuple[int, int]] = []
    with (
        atomic_path(path, option="--output") as temporary,
        h5py.File(temporary, "w", libver="earliest") as out,
    ):
        for frames, position, kinds in runs:
            # That reader takes the length of the first trajectory for all: longer runs
            # become several, and what is left over is not written. It reads chunks of
            # one frame 5 to 10 times faster.
            for start in range(0, frames - length + 1, length):
                group = out.create_group(f"{len(shapes):05d}")
                stored = group.create_dataset(
                    "position",
                    shape=(length, len(kinds), 2),
                    dtype="<f4",
                    chunks=(1, len(kinds), 2),
                    compression="gzip",
                    compression_opts=1,
                    shuffle=True,
                    track_times=False,
                )
                for row in range(length):
                    stored[row] = position(start + row) - np.asarray(origin, np.float32)
                group.create_dataset(
                    "particle_type", data=kinds.astype("<i8"), track_times=False
                )
                shapes.append((length, len(kinds)))
    return shapes


def _check_target(folder: Path, names: Sequence[str], *, force: bool) -> None:
    """Refuse a folder that must not be written to."""
    if (folder / FORCE).exists():
        raise UsageError(
            "the folder holds a program that readers of this format run",
            where=str(folder / FORCE),
            fix="name another folder: --output",
        )
    there = [name for name in (*names, NAME) if (folder / name).exists()]
    if there and not force:
        raise UsageError(
            "files of that name are there",
            where=str(folder),
            got=", ".join(there),
            fix="name another folder, or write over them: --force",
        )


def _recorded(size: Size, root: Path) -> tuple[dict[str, tuple[float, ...]], str]:
    """Return statistics over train and data set hash: those of the registry, else of
    the manifest.
    """
    if size.measured:
        return dict(size.measured.statistics), size.measured.dataset_sha256
    manifest = read_manifest(root, size.split, size.name, size.major)
    if manifest is None or manifest.dataset_sha256 is None or not manifest.statistics:
        raise DataError(
            "the data set is not complete: the statistics of train are "
            "recorded nowhere",
            where=f"{size.split} {size.name} in {root}",
            fix=suggest_repair(size, root=root),
        )
    return dict(manifest.statistics), manifest.dataset_sha256


def _frames_of(size: Size, root: Path) -> dict[str, dict[Path, int]]:
    """Return files and their frames by subset, in order of their ids, after a look at
    each header.
    """
    frames: dict[str, dict[Path, int]] = {subset: {} for subset in HASHED_SUBSETS}
    for scenario, path in sorted(scenario_files(size, root, HASHED_SUBSETS).items()):
        with read_scenario(path) as file:
            found = file.header
        if size.measured:
            known = size.measured.scenario_sha256.get(scenario)
        else:
            known = None
        same = (found.key.major, found.key.scenario) == (size.major, scenario)
        if not (same and found.content_sha256.startswith(known or "")):
            raise DataError(
                "a scenario is not that of the registry",
                where=str(path),
                expected=f"scenario {scenario}, content hash {known or 'any'}",
                got=f"scenario {found.key.scenario}, content hash "
                f"{found.content_sha256[:16]}",
                fix=f"lagbench verify --split {size.split} --size {size.name}",
            )
        frames[size.subset_of(scenario)][path] = found.frames
    return frames
