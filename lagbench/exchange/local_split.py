"""Make a local split: a folder with scenario files, manifest and description.

All of it is built beside the target and renamed at the end, so that a local split is
there whole or not at all. One frame of one trajectory is in memory at a time.
"""

from __future__ import annotations

import errno
import itertools
import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import filelock
import numpy as np
from numpy.typing import NDArray

from lagbench.atomic import SUFFIX, check_writable, temporary_name, write_atomically
from lagbench.data.box import AXES, SMALL_SIDE, Box, parse_periodic, unit_box
from lagbench.data.checksums import HASHED_SUBSETS
from lagbench.data.grid import MOST_NODES, Placement, most_cells
from lagbench.data.layout import (
    MAX_ID,
    ScenarioKey,
    expand_path,
    format_ids,
    scenario_path,
)
from lagbench.data.local import DESCRIPTION
from lagbench.data.manifest import (
    FileEntry,
    Manifest,
    build_manifest,
    describe_file,
    write_manifest,
)
from lagbench.data.registry import NO_GENERATOR, Size, load
from lagbench.data.scenario import read_scenario
from lagbench.data.statistics import file_statistics
from lagbench.data.writer import ScenarioWriter
from lagbench.data.yamlfile import format_yaml
from lagbench.errors import (
    DISK_FULL_ERRORS,
    LIMIT_FIXES,
    DataError,
    UsageError,
    WorkFailedError,
    format_count,
)
from lagbench.metrics.coverage import CELLS, Cloud, fitting_cells
from lagbench.metrics.significance import FEWEST_SCENARIOS
from lagbench.work.machine import describe_machine
from lagbench.work.run import Meter, Progress

from .crossings import CrossingCheck
from .periods import PeriodCheck, check_overlap
from .trajectory import (
    FEWEST_CELLS,
    Bounds,
    Description,
    Trajectory,
    check_name,
    estimate_spacing,
)
from .velocities import MotionCheck

SIZE = "full"
"""Size of every local split."""

VERSION = "1.0.0"
DEVICE = "cpu"

HEAD = (
    "# A local split of lagbench, written by `lagbench {}`; "
    'its hashes stand under "measured".\n'
)

LOCK_NAME = ".lock"
"""File in a folder beside the target that the process which builds it has locked."""

SPACINGS_PER_CELL = 2.5
"""Spacings of particles across a cell of the score grid; our splits have 1.8 to 2.6."""


@dataclass(frozen=True, kw_only=True)
class LocalSplit:
    """A local split that was made."""

    folder: Path  # its folder, which ``--split`` takes
    name: str  # its name
    size: str  # its only size
    scenarios: dict[str, int]  # number of scenarios by subset
    frames: int  # frames of all scenarios
    particles: tuple[int, int]  # the fewest and the most particles of a scenario
    materials: tuple[int, ...]  # numbers of the materials of all scenarios
    input_frames: int  # frames given to a model
    horizon: int  # frames to predict
    # the walls, or one period [length]: lowest and highest position along each axis
    bounds: Bounds
    periodic: tuple[str, ...]  # names of the axes without walls
    spacing: float  # distance of neighbouring particles at first [length]
    bytes: int  # length of the scenario files [bytes]
    dataset_sha256: str  # hash of the data set
    notes: tuple[str, ...] = ()  # what a user should know


def output_name(output: str | Path) -> str:
    """Return the name of the split that a folder to make stands for: its last part."""
    return Path(os.path.abspath(expand_path(output, "--output"))).name


def check_output(output: str | Path | None) -> Path:
    """Return the folder to make.

    Raises:
        UsageError: none is named, its name cannot be that of a local split, or it is
            there.
    """
    if output is None:
        raise UsageError(
            "no folder is named",
            where="--output",
            expected="a folder to make, whose last part names the split",
            got="nothing",
            fix="name one, as in -o own",
        )
    folder = Path(os.path.abspath(expand_path(output, "--output")))
    check_name(folder.name)
    if folder.name in load().splits:
        raise UsageError(
            f"{folder.name!r} is one of the splits of lagbench",
            where="--output",
            expected="another name",
            got=str(folder),
            fix="use another name, as in -o own",
        )
    if os.path.lexists(folder):
        raise UsageError(
            "the folder is there already",
            where=str(folder),
            expected="a folder to make",
            got="a folder or file of that name",
            fix="use another name: --output",
        )
    return folder


def find_bounds(trajectories: Iterable[Trajectory]) -> Bounds:
    """Return the extent of all positions of trajectories, in their length.

    Raises:
        DataError: a position is not finite in float32, or trajectories differ in their
            number of components.
    """
    low: NDArray[np.float64] | None = None
    high: NDArray[np.float64] | None = None
    for trajectory in trajectories:
        for number, (position, _) in enumerate(trajectory.read()):
            frame_low = position.min(axis=0).astype(np.float64)
            frame_high = position.max(axis=0).astype(np.float64)
            ends = np.stack([frame_low, frame_high])
            if not _in_float32(ends).all():
                where = f"{trajectory.name}, frame {number}"
                raise _not_finite(position, position, where)
            if low is None or high is None:
                low = frame_low
                high = frame_high
            if len(low) != len(frame_low):
                raise _mixed_dimensions(trajectory, len(low))
            low = np.minimum(low, frame_low)
            high = np.maximum(high, frame_high)
    if low is None or high is None:
        return ()
    return tuple(zip(low.tolist(), high.tolist(), strict=True))


def _in_float32(values: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Return whether each value is a finite number of float32."""
    with np.errstate(over="ignore"):  # what is beyond float32 becomes infinite
        return np.isfinite(values.astype(np.float32))


def _mixed_dimensions(trajectory: Trajectory, dimension: int) -> DataError:
    """Return the error for a trajectory of another dimension than those before."""
    return DataError(
        "positions have another number of components",
        where=trajectory.name,
        expected=f"{dimension} components, as the trajectories before have",
        got=f"{trajectory.dimension} components",
        fix="adopt trajectories of two and of three dimensions apart, each kind "
        "into a folder of its own: -o FOLDER",
    )


def _not_finite(
    position: NDArray[np.floating], raw_position: NDArray[np.floating], where: str
) -> DataError:
    """Return the error for a frame in which a position is not finite.

    Args:
        position: positions [length], shape [particle, axis].
        raw_position: the same ones as the file has them, for the message.
        where: trajectory and frame.
    """
    is_finite = _in_float32(position).all(axis=1)
    particle = int(np.argmin(is_finite))
    return DataError(
        "a position is not finite",
        where=f"{where}, particle {particle}",
        expected="finite numbers, no larger than those of float32",
        got=np.asarray(raw_position)[particle].tolist(),
        fix="leave the particle out, or end the trajectory before this frame",
    )


def make_local_split(
    description: Description,
    subsets: Mapping[str, Iterable[Trajectory]],
    output: str | Path,
    *,
    command: str,
    counts: Mapping[str, int] | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> LocalSplit:
    """Write a local split; it appears whole or not at all.

    Args:
        description: what is known of the data.
        subsets: the trajectories of train, valid and test.
        output: folder to make; its last part is the name of the split.
        command: the command that stands in the head of the description.
        counts: trajectories of each subset, where they are known before.
        progress: called as the work advances.

    Raises:
        UsageError: the name is taken, the folder is there, another call made it
            meanwhile, or the task does not fit.
        DataError: a subset is empty, or a trajectory cannot be used.
        WorkFailedError: the disk is full or not writable, or another call makes the
            folder.
    """
    folder = check_output(output)
    _check_cells(description)
    meter = Meter(progress)
    with _staging_folder(folder) as root:
        builder = SplitBuilder(description, root)
        for subset in HASHED_SUBSETS:
            count = counts[subset] if counts else 0
            meter.begin(f"writing {subset}", total=count, scenarios=count)
            entry_count = len(builder.entries)
            for trajectory in subsets[subset]:
                builder.add(subset, trajectory)
                meter.count(1, scenarios=1)
            if len(builder.entries) == entry_count:
                raise DataError(
                    "a subset is empty",
                    where=subset,
                    expected="at least one trajectory",
                    got="none",
                    fix="put one there",
                )
        manifest = builder.finish(command)
        built = root / description.name
        size = load(built / DESCRIPTION).size(description.name, SIZE)
        _move_to_place(built, folder)
    materials = tuple(sorted(builder.materials))
    local_split = _summarise(
        folder, size, manifest, spacing=builder.spacing, materials=materials
    )
    notes = builder.periods.describe_extent(spacing=builder.spacing)
    return replace(local_split, notes=(*local_split.notes, *notes))


def _check_cells(description: Description) -> None:
    """Refuse a stated score grid that does not fit the periods of the box."""
    cells = description.cells
    box = description.box
    if cells is None or box is None:
        return
    _check_nodes(cells, box)
    if box.has_whole_cells(cells):
        return
    raise UsageError(
        "the score grid has no whole cells along the periodic axes",
        where="--cells",
        expected="cells that divide each period into three or more of them",
        got=f"{cells} across a length of 1, in the box {format_bounds(box.bounds)}",
        fix="leave --cells out, and add --rescale if the periods need it",
    )


def _check_nodes(cells: int, box: Box) -> None:
    """Refuse a stated score grid whose fields would fill the memory."""
    most = most_cells(box)
    if cells <= most:
        return
    if most < FEWEST_CELLS:
        raise _period_error(box)
    proposal = most
    while proposal > FEWEST_CELLS and not box.has_whole_cells(proposal):
        proposal -= 1
    raise UsageError(
        "the score grid has too many nodes",
        where="--cells",
        expected=f"{FEWEST_CELLS} to {most} in this box, which are at most "
        f"{MOST_NODES} nodes",
        got=f"{cells} across a length of 1, in the box {format_bounds(box.bounds)}",
        fix=f"give fewer, as in --cells {proposal}; or leave --cells out",
    )


def _period_error(box: Box) -> UsageError:
    """Return the error for periods so long that score grids have too many nodes."""
    return UsageError(
        "the periods are far longer than the unit box",
        where="--bounds, or bounds of the metadata",
        expected=f"periods near 1, for a score grid of at most {MOST_NODES} nodes",
        got=format_bounds(box.bounds),
        fix="add --rescale, which fits the box into the unit box; or correct --bounds",
    )


def _summarise(
    folder: Path,
    size: Size,
    manifest: Manifest,
    *,
    spacing: float,
    materials: tuple[int, ...],
) -> LocalSplit:
    """Return what is told of a local split that was made."""
    particle_counts = []
    frame_count = 0
    byte_count = 0
    for entry in manifest.files:
        particle_counts.append(entry.particles)
        frame_count += entry.frames
        byte_count += entry.bytes
    return LocalSplit(
        folder=folder,
        name=size.split,
        size=size.name,
        scenarios={name: len(ids) for name, ids in size.subsets.items()},
        frames=frame_count,
        particles=(min(particle_counts), max(particle_counts)),
        materials=materials,
        input_frames=size.task.input_frames,
        horizon=size.task.horizon,
        bounds=size.bounds,
        periodic=size.periodic,
        spacing=spacing,
        bytes=byte_count,
        dataset_sha256=str(manifest.dataset_sha256),
        notes=(
            *_describe_motion(manifest.statistics),
            *_describe_size(size.bounds),
            *_describe_test(len(size.subsets["test"])),
        ),
    )


def format_bounds(bounds: Bounds) -> str:
    """Return the bounds of a split for a message; there is one axis at least.

    >>> format_bounds(((0.0, 1.0), (0.25, 2.0)))
    '[0, 1] x [0.25, 2]'
    """
    low, high = np.array(bounds).T
    return format_box(low, high)


def _describe_motion(statistics: Mapping[str, Sequence[float]]) -> Iterator[str]:
    """Yield a note for the user if all particles of train stand still."""
    if not any(statistics["velocity_std"]) and not any(statistics["velocity_mean"]):
        yield (
            "no particle of train moves from one frame to the next: check the order of "
            "the axes, and that the frames differ"
        )


def _describe_size(bounds: Bounds) -> Iterator[str]:
    """Yield a note for the user if the box is far smaller than the unit box."""
    side = max(high - low for low, high in bounds)
    if side < SMALL_SIDE:
        yield (
            f"the longest side of the box is {side:.2g}: score grids and models are "
            "made for sides near 1. --rescale enlarges the box"
        )


def _describe_test(count: int) -> Iterator[str]:
    """Yield a note for the user if test has too few trajectories for a p-value."""
    if count < FEWEST_SCENARIOS:
        yield (
            f"{format_count(count, 'trajectory')} for test: under {FEWEST_SCENARIOS} "
            "no difference between methods can be significant; put more into test "
            "(option --test of adopt)"
        )


@contextmanager
def _staging_folder(folder: Path) -> Iterator[Path]:
    """Yield a folder beside the target that vanishes at the end.

    Those that killed calls for the same target left are removed first.

    Raises:
        WorkFailedError: it cannot be made or written to, or another call has it.
    """
    check_writable(folder, option="--output")
    _remove_abandoned(folder)
    root = temporary_name(folder)
    try:
        root.mkdir(parents=True)
    except FileExistsError as error:
        raise _error_of_other_call(folder, root) from error
    except OSError as error:
        raise _write_error(folder, error.strerror or error) from error

    lock = filelock.FileLock(root / LOCK_NAME)
    try:
        lock.acquire(timeout=0)
    except filelock.Timeout as error:
        raise _error_of_other_call(folder, root) from error
    except (OSError, NotImplementedError):
        pass  # on disks without locks no call removes the folder
    try:
        yield root
    except WorkFailedError as error:
        if not _is_below(root, error.where):
            raise
        raise _write_error(folder, error.got) from error
    except OSError as error:
        # others come from the source, or from who watches the progress
        is_full = error.errno in DISK_FULL_ERRORS or error.errno == errno.EFBIG
        if not is_full and not _is_below(root, error.filename):
            raise
        raise _write_error(folder, error.strerror or error) from error
    finally:
        lock.release()
        shutil.rmtree(root, ignore_errors=True)


def _error_of_other_call(folder: Path, root: Path) -> WorkFailedError:
    return WorkFailedError(
        "another call makes this folder",
        where=str(folder),
        expected="one call at a time for a folder",
        got=f"{root.name} beside it, in which another call writes",
        fix="wait until that one ends, or name another folder: --output",
    )


def _is_below(root: Path, place: object) -> bool:
    """Return whether an error is about a place in a folder."""
    return str(place).startswith(f"{root}{os.sep}")


def _remove_abandoned(folder: Path) -> None:
    """Remove the folders that killed calls for the same target left beside it.

    The system has dropped the lock of a killed process. On network disks whose locks
    hold for one machine only, two machines may not build the same target.
    """
    for leftover in folder.parent.glob(f".{folder.name}.*{SUFFIX}"):
        lock_path = leftover / LOCK_NAME
        lock = filelock.FileLock(lock_path)
        try:
            if not lock_path.is_file():
                continue
            lock.acquire(timeout=0)
        except (OSError, NotImplementedError):  # its process works, or is not known
            continue
        lock.release()
        shutil.rmtree(leftover, ignore_errors=True)


def _write_error(folder: Path, reason: object) -> WorkFailedError:
    return WorkFailedError(
        "cannot write there",
        where=str(folder),
        expected="a folder that you may write to, on a disk with space",
        got=reason,
        fix="free disk space, or name another folder: --output; if there is space, "
        f"{LIMIT_FIXES[errno.EFBIG]}",
    )


def _move_to_place(built: Path, folder: Path) -> None:
    """Rename a folder that is whole to the folder to make.

    The operating system renames no folder over one with files, so that of two calls for
    the same folder one is first, and the other one is refused.

    Raises:
        UsageError: another call made the folder meanwhile.
    """
    try:
        built.replace(folder)
    except OSError as error:
        if not os.path.lexists(folder):
            raise
        raise UsageError(
            "another call made this folder meanwhile",
            where=str(folder),
            expected="no such folder, as at the start of this call",
            got="a folder or file of that name, which is left as it is",
            fix="use what is there, or call again with another name: --output",
        ) from error


@dataclass
class SplitBuilder:
    """Write a local split: scenario files one by one, then manifest and description."""

    description: Description
    root: Path  # root folder in which the split's folder is built
    # distance of neighbouring particles at first [length]; 0 before the first scenario
    spacing: float = 0.0
    # of the scenarios written so far, by id
    entries: list[FileEntry] = field(default_factory=list)
    materials: set[int] = field(default_factory=set)  # numbers of all their materials
    # extent of the positions of all particles [length]
    low: NDArray[np.float64] = field(default_factory=lambda: np.full(1, np.inf))
    high: NDArray[np.float64] = field(default_factory=lambda: np.full(1, -np.inf))
    dimension: int = 0  # components of a position; 0 before the first scenario
    # whether trajectories have velocities of walls; None before the first
    has_walls: bool | None = None
    periods: PeriodCheck = field(init=False)

    def __post_init__(self) -> None:
        """Prepare the check of the stated periods."""
        # Without bounds no axis is periodic, whatever the dimension.
        box = self.description.box or unit_box(2)
        self.periods = PeriodCheck(box, scale=self.description.transform.scale)

    def add(self, subset: str, trajectory: Trajectory) -> None:
        """Write the next scenario."""
        scenario = len(self.entries)
        if scenario > MAX_ID:
            raise DataError(
                "too many trajectories",
                where=trajectory.name,
                expected=f"at most {MAX_ID + 1}",
                got="one more",
                fix="leave some out, or make two splits",
            )
        self._check_dimension(trajectory)
        if not self.entries and self.description.cells is not None:
            _check_nodes(self.description.cells, self._box)
        self._check_walls(trajectory)
        if not self.spacing:
            self.spacing = self._measure_spacing(trajectory)

        description = self.description
        wall_velocity = None
        if trajectory.wall_velocity is not None:
            wall_velocity = (
                np.asarray(trajectory.wall_velocity) / description.transform.scale
            )
        parameters = {
            "frame_rate": description.rate,
            "density": description.density,
            **trajectory.parameters,
        }
        key = self._key(scenario, subset)
        with ScenarioWriter(
            scenario_path(self.root, key),
            key,
            particles=len(trajectory.material),
            frames=trajectory.frames,
            frame_interval=1.0 / description.rate,
            material=trajectory.material,
            particle_mass=description.density * self.spacing**self.dimension,
            wall_velocity=wall_velocity,
            parameters=parameters,
            seed=NO_GENERATOR,
            device=DEVICE,
            generator=NO_GENERATOR,
            licence=description.licence,
            dimension=self.dimension,
            periodic=description.periodic,
        ) as writer:
            for position, velocity in self._read_frames(trajectory):
                writer.append(position, velocity)
        self.entries.append(describe_file(self.root, key))
        self.materials.update(np.unique(trajectory.material).tolist())

    def _check_dimension(self, trajectory: Trajectory) -> None:
        """Refuse positions with other components than the bounds or those before."""
        bounds = self.description.bounds
        if not self.dimension:
            self.dimension = trajectory.dimension if bounds is None else len(bounds)
        if trajectory.dimension == self.dimension:
            return
        if self.entries or bounds is None:
            raise _mixed_dimensions(trajectory, self.dimension)
        raise DataError(
            "positions have another number of components",
            where=trajectory.name,
            expected=f"{self.dimension} components, as --bounds has pairs",
            got=f"{trajectory.dimension} components",
            fix="give --bounds with a pair for each component of a position",
        )

    def _check_walls(self, trajectory: Trajectory) -> None:
        """Refuse trajectories of which only some have velocities of walls."""
        has_walls = trajectory.wall_velocity is not None
        if self.has_walls is None:
            self.has_walls = has_walls
        if self.has_walls == has_walls:
            return
        expected = "no wall_velocity, as before"
        if self.has_walls:
            expected = "wall_velocity, as before"
        raise DataError(
            "only some trajectories have velocities of walls",
            where=trajectory.name,
            expected=expected,
            got="wall_velocity" if has_walls else "no wall_velocity",
            fix="give zeros where walls rest",
        )

    def _measure_spacing(self, trajectory: Trajectory) -> float:
        """Return the distance of neighbouring particles at first [length]."""
        description = self.description
        raw_position, _ = next(trajectory.read())
        raw_position = np.asarray(raw_position)
        position = self._wrap(description.transform.transform_positions(raw_position))
        where = f"{trajectory.name}, frame 0"
        self._check_positions(position, raw_position, trajectory, where=where)
        spacing = description.spacing
        if not spacing:
            spacing = estimate_spacing(
                raw_position, description.radius, description.source_box
            )
        return spacing / description.transform.scale

    def _key(self, scenario: int, subset: str) -> ScenarioKey:
        return ScenarioKey(
            split=self.description.name,
            size=SIZE,
            version=VERSION,
            scenario=scenario,
            subset=subset,
        )

    def _read_frames(
        self, trajectory: Trajectory
    ) -> Iterator[tuple[NDArray[np.float32], NDArray[np.float32]]]:
        """Yield positions and velocities in the unit box.

        A trajectory without velocities gets differences of positions:
        ``v(f) = (x(f) - x(f-1)) / interval``, and ``v(0) = v(1)``.
        """
        description = self.description
        transform = description.transform
        before: NDArray[np.float32] | None = None
        motion = MotionCheck(rate=description.rate)
        crossings = CrossingCheck(periodic=description.periodic)
        last = trajectory.frames - 1
        for number, (raw_position, raw_velocity) in enumerate(trajectory.read()):
            where = f"{trajectory.name}, frame {number}"
            unwrapped = transform.transform_positions(raw_position)
            position = self._wrap(unwrapped)
            self._check_positions(position, raw_position, trajectory, where=where)
            if number in (0, last // 2, last):
                check_overlap(unwrapped, self._box, scale=transform.scale, where=where)
            self.periods.add(unwrapped)
            if before is not None:
                step = self._box.displacement(before, position.astype(np.float64))
                crossings.add(step, self._lengths, frame=number)
            if crossings.has_any:
                # the frames that are left are read for other axes only
                before = position
                continue
            if raw_velocity is not None:
                velocity = self._transform_velocities(raw_velocity, where=where)
                if before is not None:
                    motion.add(velocity, step)
                yield position, velocity
            elif before is not None:
                velocity = (step * description.rate).astype(np.float32)
                if number == 1:
                    yield before, velocity
                yield position, velocity
            before = position
        crossings.finish(where=trajectory.name)
        self.periods.finish(where=trajectory.name, spacing=self.spacing)
        motion.finish(where=f"{trajectory.name}, velocity")

    @property
    def _box(self) -> Box:
        """The stated box in the unit box, else the unit box itself."""
        return self.description.box or unit_box(self.dimension)

    def _wrap(self, position: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return positions [length] that are wrapped along periodic axes."""
        return self._box.wrap(position).astype(np.float32, copy=False)

    @property
    def _lengths(self) -> NDArray[np.float64]:
        """Lengths of the box along its axes; those of the positions where unknown."""
        if self.description.box is not None:
            return self.description.box.lengths
        return np.asarray(self.high - self.low, np.float64)

    def _transform_velocities(
        self, raw_velocity: NDArray[np.floating], *, where: str
    ) -> NDArray[np.float32]:
        """Return velocities in the unit box [length/s]; refuse what is not finite."""
        with np.errstate(over="ignore"):  # what is beyond float32 becomes infinite
            velocity = raw_velocity / self.description.transform.scale
            velocity = velocity.astype(np.float32)
        if not np.isfinite(velocity).all():
            raise DataError(
                "a velocity is not finite",
                where=where,
                expected="numbers",
                got="NaN, infinity, or a number beyond float32",
                fix="leave velocities out: they are then differences of positions",
            )
        return velocity

    def _check_positions(
        self,
        position: NDArray[np.float32],
        raw_position: NDArray[np.floating],
        trajectory: Trajectory,
        *,
        where: str,
    ) -> None:
        """Refuse positions not finite, outside the unit box, or far outside the bounds.

        Their extent is noted. The raw positions are those of the file.
        """
        low = position.min(axis=0)
        high = position.max(axis=0)
        if not (np.isfinite(low).all() and np.isfinite(high).all()):
            raise _not_finite(position, raw_position, where)
        if (low < 0.0).any() or (high > 1.0).any():
            raise DataError(
                "particles lie outside the unit box",
                where=where,
                expected=" x ".join(["[0, 1]"] * self.dimension),
                got=f"{self._format_extent(trajectory)}, the extent of the trajectory",
                fix="fit the box of the data into the unit box: --rescale, with "
                "--bounds if its walls are known",
            )
        self._check_stated_bounds(low, high, trajectory, where=where)
        self.low = np.minimum(self.low, low)
        self.high = np.maximum(self.high, high)

    def _format_extent(self, trajectory: Trajectory) -> str:
        """Return the box that all positions of a trajectory fill, in the unit box."""
        extent = self._source_extent(trajectory)
        low, high = np.array(self.description.transform.transform_box(extent)).T
        return format_box(low, high)

    def _source_extent(self, trajectory: Trajectory) -> Bounds:
        """Return the box that a trajectory needs, in the length of the source.

        Along a periodic axis that is the period: positions beyond it are wrapped.
        """
        sides = list(find_bounds([trajectory]))
        description = self.description
        for axis, name in enumerate(AXES[: len(sides)]):
            if name in description.periodic and description.bounds is not None:
                sides[axis] = description.bounds[axis]
        return tuple(sides)

    def _check_stated_bounds(
        self,
        low: NDArray[np.float32],
        high: NDArray[np.float32],
        trajectory: Trajectory,
        *,
        where: str,
    ) -> None:
        """Refuse particles outside the stated bounds by more than their spacing.

        Features, clamps and scores rest on the bounds.
        """
        description = self.description
        if description.bounds is None or not self.spacing:
            return
        transform = description.transform
        excess = 0.0  # largest distance outside the bounds [length]
        for axis, (left, right) in enumerate(
            transform.transform_box(description.bounds)
        ):
            excess = max(excess, left - low[axis], high[axis] - right)
        if excess <= self.spacing:
            return
        # of all frames: bounds that hold this one only would be refused by a later one
        source_low, source_high = np.array(self._source_extent(trajectory)).T
        raise UsageError(
            "particles lie outside the stated bounds, by more than their spacing",
            where=f"{where}; --bounds, or bounds of the metadata",
            expected=f"bounds that hold {format_box(source_low, source_high)}, the "
            "extent of the trajectory",
            got=format_bounds(description.bounds),
            fix="state the box of the data, in their own length",
        )

    def finish(self, command: str) -> Manifest:
        """Write manifest and description; return the manifest."""
        name = self.description.name
        short_hashes = {}
        train_paths = []
        ids: dict[str, list[int]] = {subset: [] for subset in HASHED_SUBSETS}
        for entry in self.entries:
            ids[entry.subset].append(entry.scenario)
            short_hashes[entry.scenario] = entry.content_sha256[:16]
            if entry.subset == "train":
                key = self._key(entry.scenario, entry.subset)
                train_paths.append(scenario_path(self.root, key))
        manifest = build_manifest(
            None,
            self.entries,
            split=name,
            size=SIZE,
            version=VERSION,
            subsets=ids,
            environment=describe_machine(DEVICE),
            recorded=short_hashes,
            statistics=file_statistics(train_paths, self._box),
        )
        write_manifest(self.root, manifest)

        statistics = {}
        for quantity, row in manifest.statistics.items():
            statistics[quantity] = list(row)
        measured: dict[str, object] = {
            "dataset_sha256": manifest.dataset_sha256,
            "subset_sha256": manifest.subset_sha256,
            "scenario_sha256": short_hashes,
            "statistics": statistics,
            "twin_floor": [],
        }
        registry = {
            "format": 1,
            "splits": {name: self._describe_split(ids)},
            "measured": {name: {SIZE: measured}},
        }
        text = HEAD.format(command) + format_yaml(registry)
        write_atomically(self.root / name / DESCRIPTION, text.encode())
        return manifest

    def _describe_split(self, ids: Mapping[str, Sequence[int]]) -> dict[str, object]:
        """Return the description of the split as plain values."""
        description = self.description
        task = self._describe_task()
        parameters = {}
        for name, value, unit, meaning in self._list_parameters(task):
            parameters[name] = {"value": value, "unit": unit, "description": meaning}
        size = {
            "subsets": {name: format_ids(scenarios) for name, scenarios in ids.items()},
            "frames": self._describe_frames(),
            "bounds": self._bounds(),
            **self._describe_periodic(),
            **self._describe_particle_counts(),
            "parameters": {},
            "task": task,
        }
        return {
            "version": VERSION,
            "title": description.title or description.name,
            "description": description.text or description.source,
            "citation": description.citation,
            "licence": description.licence,
            "generator": NO_GENERATOR,
            "source": description.source,
            "parameters": parameters,
            "sizes": {SIZE: size},
        }

    def _list_parameters(
        self, task: Mapping[str, Any]
    ) -> list[tuple[str, object, str, str]]:
        """Return name, value, unit and meaning of each parameter."""
        description = self.description
        transform = description.transform
        return [
            (
                "particles",
                self._particle_count(),
                "1",
                "particles in one scenario; the most of any where they differ",
            ),
            (
                "grid",
                task["score_grid"]["cells"],
                "1",
                "cells across the unit box; predictions may be one cell out of bounds",
            ),
            (
                "substeps_per_frame",
                1,
                "1",
                "solver steps between recorded frames: unknown here, so 1",
            ),
            ("frame_rate", description.rate, "1/s", "recorded frames per second"),
            ("density", description.density, self._density_unit, "rest density"),
            (
                "spacing",
                self.spacing,
                "length",
                "distance of neighbouring particles at first",
            ),
            (
                "source_scale",
                transform.scale,
                "length of the source",
                "what a unit of length is in the source",
            ),
            *self._list_corner(),
        ]

    def _list_corner(self) -> list[tuple[str, object, str, str]]:
        """Return name, value, unit and meaning of the corner's place in the source."""
        rows: list[tuple[str, object, str, str]] = []
        corner = self.description.transform.corner
        for axis, place in zip(AXES[: self.dimension], corner, strict=False):
            meaning = f"{axis} in the source of the lower left corner"
            rows.append((f"source_{axis}", place, "length of the source", meaning))
        return rows

    @property
    def _density_unit(self) -> str:
        return f"mass/length^{self.dimension}"

    def _test_entries(self) -> list[FileEntry]:
        test_entries = []
        for entry in self.entries:
            if entry.subset == "test":
                test_entries.append(entry)
        return test_entries

    def _predicted_entries(self) -> list[FileEntry]:
        """Return the entries of test and valid, those of test first."""
        entries = self._test_entries()
        for entry in self.entries:
            if entry.subset == "valid":
                entries.append(entry)
        return entries

    def _particle_count(self) -> int:
        """Return the particles of a scenario; the most of any if they differ."""
        return max(entry.particles for entry in self.entries)

    def _bounds(self) -> list[list[float]]:
        """Return the stated walls [length], else the extent of the positions."""
        description = self.description
        sides: Bounds = tuple(zip(self.low, self.high, strict=True))
        if description.bounds:
            sides = description.transform.transform_box(description.bounds)
        for axis, (low, high) in zip(AXES, sides, strict=False):
            if low < high:
                continue
            raise UsageError(
                "the box has no extent along an axis",
                where=f"--bounds, {axis}",
                expected="two different ends",
                got=f"all particles at {float(low):g}",
                fix="state the walls or the period of the box with --bounds",
            )
        return [[float(low), float(high)] for low, high in sides]

    def _describe_periodic(self) -> dict[str, object]:
        """Return the key of the periodic axes; none where there are only walls."""
        is_periodic = parse_periodic(self.description.periodic, self.dimension)
        if not any(is_periodic):
            return {}
        return {"periodic": list(itertools.compress(AXES, is_periodic))}

    def _describe_particle_counts(self) -> dict[str, object]:
        """Return the key of the numbers of particles; none where all are alike."""
        scenarios_of: dict[int, list[int]] = {}
        for entry in self.entries:
            scenarios_of.setdefault(entry.particles, []).append(entry.scenario)
        if len(scenarios_of) == 1:
            return {}
        counts = {}
        for count in sorted(scenarios_of):
            counts[count] = format_ids(scenarios_of[count])
        return {"particle_counts": counts}

    def _describe_frames(self) -> int | dict[int, str]:
        """Return the number of frames; by scenario ids where it differs."""
        scenarios_of: dict[int, list[int]] = {}
        for entry in self.entries:
            scenarios_of.setdefault(entry.frames, []).append(entry.scenario)
        frame_counts = sorted(scenarios_of)
        if len(frame_counts) == 1:
            return frame_counts[0]
        return {count: format_ids(scenarios_of[count]) for count in frame_counts}

    def _describe_task(self) -> dict[str, Any]:
        """Return the key ``task`` of the size; what is not stated gets a default.

        The horizon is by default what the shortest test or valid scenario leaves:
        trainings predict those of valid.

        Raises:
            UsageError: a test or valid scenario is too short for the task, or a frame
                of interest is not predicted.
        """
        description = self.description
        shortest_entry = min(self._predicted_entries(), key=_count_frames)
        shortest = shortest_entry.frames
        horizon = description.horizon
        if horizon is None:
            horizon = shortest - description.input_frames
        last = description.input_frames + horizon - 1
        if horizon < 1 or last >= shortest:
            got = f"{description.input_frames} given"
            if description.horizon:
                got += f", {horizon} to predict"
            raise UsageError(
                f"a {shortest_entry.subset} scenario is too short for the task",
                where="--input-frames and --horizon",
                expected=f"together at most {shortest} frames, one of them to predict",
                got=got,
                fix="give fewer frames, or longer trajectories of test and valid",
            )

        interest = sorted(set(description.frames_of_interest or (last,)))
        if not description.input_frames <= interest[0] <= interest[-1] <= last:
            got = str(interest)
            if interest[0] >= 0:
                got = format_ids(interest)
            raise UsageError(
                "a frame of interest is not predicted",
                where="--frames-of-interest",
                expected=f"frames {description.input_frames} to {last}",
                got=got,
                fix="name frames of these, or leave --frames-of-interest out: the last "
                "one is taken",
            )

        placement = Placement.NODES
        if description.full_box:
            placement = Placement.CELL_CENTRES
        cells = description.cells
        if not cells:
            ends = (description.input_frames, last)
            cells = self._suitable_cells(placement, ends)
        return {
            "input_frames": description.input_frames,
            "horizon": horizon,
            "frames_of_interest": interest,
            "score_grid": {"cells": cells, "placement": placement.value},
            "radius": description.radius / description.transform.scale,
        }

    def _suitable_cells(self, placement: Placement, frames: tuple[int, int]) -> int:
        """Return cells across a score grid that suits the spacing.

        Where test scenarios cover too few nodes in these frames, it is the nearest
        number by which they cover enough.
        """
        box = self._box
        most = most_cells(box)
        if most < max(CELLS):
            raise _period_error(box)
        cells = round(1.0 / (SPACINGS_PER_CELL * self.spacing))
        cells = min(most, max(FEWEST_CELLS, cells))
        clouds = partial(self._read_clouds, frames)
        suitable_cells = fitting_cells(clouds, placement, near=cells, box=box)
        if suitable_cells is not None:
            return suitable_cells
        if box.has_whole_cells(cells):
            return cells
        raise UsageError(
            "no score grid has whole cells along the periodic axes",
            where="--periodic and --bounds",
            expected="periods that are whole numbers of one cell",
            got=format_bounds(box.bounds),
            fix="add --rescale; if that does not help, give --bounds whose periods "
            "have a ratio of small whole numbers",
        )

    def _read_clouds(self, frames: tuple[int, int]) -> Iterator[Cloud]:
        """Yield the particles of some frames of every test scenario."""
        for entry in self._test_entries():
            key = self._key(entry.scenario, "test")
            with read_scenario(scenario_path(self.root, key)) as file:
                for frame in frames:
                    position = file.read("position", slice(frame, frame + 1))[0]
                    area = len(position) * self.spacing**self.dimension
                    yield Cloud(position, area)


def _count_frames(entry: FileEntry) -> int:
    return entry.frames


def format_box(low: NDArray[np.floating], high: NDArray[np.floating]) -> str:
    """Return a box for a message.

    >>> format_box(np.array([0.0, 0.25]), np.array([1.0, 2.0]))
    '[0, 1] x [0.25, 2]'
    """
    sides = zip(low, high, strict=True)
    return " x ".join(f"[{left:.6g}, {right:.6g}]" for left, right in sides)
