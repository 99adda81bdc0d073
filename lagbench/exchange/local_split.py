"""Make a local split: scenario files, manifest and description in a folder of their own.

All of it is built beside the target and renamed at the end, so that a local split is there
whole or not at all. One frame of one trajectory is in memory at a time.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray

from lagbench.checksums import HASHED_SUBSETS
from lagbench.errors import DataError, UsageError, WorkFailedError
from lagbench.format import ScenarioWriter
from lagbench.identity import environment_of
from lagbench.layout import ScenarioKey, scenario_path
from lagbench.locating import DESCRIPTION
from lagbench.manifest import FileEntry, Manifest, describe_file, merge, write_manifest
from lagbench.progress import Meter, Progress
from lagbench.registry import NO_GENERATOR, load
from lagbench.scenario_ids import MAX_ID
from lagbench.statistics import file_statistics

from .description import SIZE, VERSION, Box, Description, estimate_spacing, rate_of, split_yaml
from .trajectory import Trajectory

__all__ = ["LocalSplit", "Subsets", "make_local_split", "output_name"]

Subsets = Mapping[str, Iterable[Trajectory]]
"""Trajectories of train, valid and test, in order."""

DEVICE = "cpu"
HEAD = '# A local split of lagbench, written by `lagbench {}`; its hashes stand under "measured".\n'


@dataclass(frozen=True, kw_only=True)
class LocalSplit:
    """A local split that was made.

    Attributes:
        folder: its folder, which ``--split`` takes.
        name: its name.
        size: its only size.
        scenarios: number of scenarios by subset.
        frames: frames of all scenarios.
        particles: the fewest and the most particles of a scenario.
        input_frames: frames given to a model.
        horizon: frames to predict.
        spacing: distance of neighbouring particles at first [length].
        bytes: length of the scenario files [bytes].
        dataset_sha256: hash of the data set.
        notes: what a user should know.
    """

    folder: Path
    name: str
    size: str
    scenarios: dict[str, int]
    frames: int
    particles: tuple[int, int]
    input_frames: int
    horizon: int
    spacing: float
    bytes: int
    dataset_sha256: str
    notes: tuple[str, ...] = ()


@dataclass
class _Building:
    """A local split on the way: what was written, and the box that its particles need."""

    about: Description
    root: Path
    spacing: float = 0.0
    entries: list[FileEntry] = field(default_factory=list)
    low: NDArray[np.float64] = field(default_factory=lambda: np.full(2, np.inf))
    high: NDArray[np.float64] = field(default_factory=lambda: np.full(2, -np.inf))

    def add(self, subset: str, trajectory: Trajectory) -> None:
        """Write the next scenario."""
        scenario = len(self.entries)
        if scenario > MAX_ID:
            raise DataError("too many trajectories", where=trajectory.name, expected=f"at most {MAX_ID + 1}")
        about = self.about
        if not self.spacing:
            first = trajectory.first()
            own = about.spacing or estimate_spacing(np.asarray(first), about.radius)
            self.spacing = own / about.measure.scale
        key = ScenarioKey(split=about.name, size=SIZE, version=VERSION, scenario=scenario, subset=subset)
        scale = about.measure.scale
        walls = None if trajectory.wall_velocity is None else np.asarray(trajectory.wall_velocity) / scale
        rate = rate_of(about.frame_interval)
        with ScenarioWriter(
            scenario_path(self.root, key),
            key,
            particles=trajectory.particles,
            frames=trajectory.frames,
            frame_interval=1.0 / rate,
            material=trajectory.material,
            particle_mass=about.density * self.spacing**2,
            wall_velocity=walls,
            parameters={"frame_rate": rate, "density": about.density, **trajectory.parameters},
            seed=NO_GENERATOR,
            device=DEVICE,
            generator=NO_GENERATOR,
            licence=about.licence,
        ) as writer:
            for position, velocity in self._frames(trajectory, rate):
                writer.append(position, velocity)
        self.entries.append(describe_file(self.root, key))

    def _frames(
        self, trajectory: Trajectory, rate: float
    ) -> Iterator[tuple[NDArray[np.float32], NDArray[np.float32]]]:
        """Yield positions and velocities in the unit box; without own velocities, differences.

        Then ``v(f) = (x(f) - x(f-1)) / interval``, and v(0) = v(1).
        """
        before: NDArray[np.float32] | None = None
        first: NDArray[np.float32] | None = None
        for number, (raw, own) in enumerate(trajectory.read()):
            position = self.about.measure.place(raw)
            self._check(trajectory, number, position)
            if own is not None:
                yield position, (own / self.about.measure.scale).astype(np.float32)
            elif before is None:
                first = position
            else:
                velocity = ((position.astype(np.float64) - before) * rate).astype(np.float32)
                if first is not None:
                    yield first, velocity
                    first = None
                yield position, velocity
            before = position

    def _check(self, trajectory: Trajectory, number: int, position: NDArray[np.float32]) -> None:
        """Refuse positions that are no numbers or lie outside the unit box; note their extent."""
        where = f"{trajectory.name}, frame {number}"
        low, high = position.min(axis=0), position.max(axis=0)
        if not (np.isfinite(low).all() and np.isfinite(high).all()):
            raise DataError("a position is not finite", where=where)
        if (low < 0.0).any() or (high > 1.0).any():
            raise DataError(
                "particles lie outside the unit box",
                where=where,
                expected="[0, 1] x [0, 1]",
                got=" x ".join(f"[{a:.6g}, {b:.6g}]" for a, b in zip(low, high, strict=True)),
                fix="fit the box of the data into the unit box: --rescale, and --bounds if none are stated",
            )
        self.low, self.high = np.minimum(self.low, low), np.maximum(self.high, high)

    def box(self) -> Box:
        """Return the stated bounds in the unit box, else the extent of the positions."""
        if self.about.bounds is not None:
            return self.about.measure.box(self.about.bounds)
        (left, bottom), (right, top) = self.low.tolist(), self.high.tolist()
        return (left, right), (bottom, top)

    def finish(self, command: str) -> Manifest:
        """Write manifest and description; return the manifest."""
        about = self.about
        ids = {name: [e.scenario for e in self.entries if e.subset == name] for name in HASHED_SUBSETS}
        folder = self.root / about.name
        train = [self.root / about.name / SIZE / "v1" / e.path for e in self.entries if e.subset == "train"]
        content = {entry.scenario: entry.content_sha256[:16] for entry in self.entries}
        manifest = merge(
            None,
            self.entries,
            split=about.name,
            size=SIZE,
            version=VERSION,
            subsets=ids,
            environment=environment_of(DEVICE),
            recorded=content,
            statistics=file_statistics(train),
        )
        write_manifest(self.root, manifest)
        measured: dict[str, object] = {
            "dataset_sha256": manifest.dataset_sha256,
            "subset_sha256": manifest.subset_sha256,
            "scenario_sha256": content,
            "statistics": {name: list(row) for name, row in manifest.statistics.items()},
            "twin_floor": [],
        }
        text = split_yaml(
            about,
            subsets=ids,
            frames={entry.scenario: entry.frames for entry in self.entries},
            particles=_particles(self.entries),
            spacing=self.spacing,
            bounds=self.box(),
            measured=measured,
        )
        body = yaml.safe_dump(text, sort_keys=False, allow_unicode=True, width=110)
        (folder / DESCRIPTION).write_text(HEAD.format(command) + body, encoding="utf-8")
        return manifest


def _particles(entries: Sequence[FileEntry]) -> int:
    """Return how many particles test scenarios have, where all have as many; else the most of any."""
    test = {entry.particles for entry in entries if entry.subset == "test"}
    return test.pop() if len(test) == 1 else max(entry.particles for entry in entries)


def output_name(output: str | Path) -> str:
    """Return the name of the split that a folder to make stands for: its last part."""
    return Path(os.path.abspath(Path(output).expanduser())).name


def make_local_split(
    about: Description,
    subsets: Subsets,
    output: str | Path,
    *,
    command: str,
    progress: Callable[[Progress], None] | None = None,
) -> LocalSplit:
    """Write a local split; it appears whole or not at all.

    Args:
        about: what is known of the data.
        subsets: trajectories of train, valid and test; each must have some.
        output: folder to make; its last part is the name of the split.
        command: command that makes it, for the head of its description.
        progress: called as the work advances.

    Raises:
        UsageError: the folder is there, its name is taken, or the task does not fit the data.
        DataError: a subset is empty, or positions are not finite or outside the unit box.
        WorkFailedError: the disk is full or not writable.
    """
    folder = Path(os.path.abspath(Path(output).expanduser()))
    if about.name in load().splits:
        raise UsageError(
            f"{about.name!r} is one of the splits of lagbench", where="--output", fix="use another name"
        )
    if folder.exists():
        raise UsageError(
            "the folder is there already", where=str(folder), fix="remove it, or use another name"
        )
    meter = Meter(progress)
    with _scratch(folder) as root:
        building = _Building(about, root)
        for subset in HASHED_SUBSETS:
            before = len(building.entries)
            meter.begin(f"writing {subset}", total=0, scenarios=0)
            for trajectory in subsets[subset]:
                building.add(subset, trajectory)
                meter.count(1, scenarios=1)
            if len(building.entries) == before:
                raise DataError("a subset is empty", where=subset, expected="at least one trajectory")
        manifest = building.finish(command)
        size = load(root / about.name / DESCRIPTION).size(about.name, SIZE)
        (root / about.name).replace(folder)
    counts = sorted(entry.particles for entry in manifest.files)
    return LocalSplit(
        folder=folder,
        name=about.name,
        size=SIZE,
        scenarios={name: len(ids) for name, ids in size.subsets.items()},
        frames=sum(entry.frames for entry in manifest.files),
        particles=(counts[0], counts[-1]),
        input_frames=size.task.input_frames,
        horizon=size.task.horizon,
        spacing=building.spacing,
        bytes=sum(entry.bytes for entry in manifest.files),
        dataset_sha256=str(manifest.dataset_sha256),
        notes=tuple(_notes(manifest)),
    )


def _notes(manifest: Manifest) -> Iterator[str]:
    """Yield what limits the use of the split."""
    test = {entry.particles for entry in manifest.files if entry.subset == "test"}
    if len(test) > 1:
        yield (
            f"test scenarios have {min(test)} to {max(test)} particles: the split can be opened and "
            "trained on; predictions and scores need one number for all"
        )


@contextmanager
def _scratch(folder: Path) -> Iterator[Path]:
    """Yield a folder beside the target that vanishes at the end."""
    root = folder.with_name(f".{folder.name}.{os.getpid()}.partial")
    try:
        root.mkdir(parents=True)
        yield root
    except OSError as error:
        raise WorkFailedError(
            "cannot write there",
            where=str(folder),
            got=error.strerror or error,
            fix="name another folder: --output",
        ) from error
    finally:
        shutil.rmtree(root, ignore_errors=True)
