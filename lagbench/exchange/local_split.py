"""Make a local split: scenario files, manifest and description in a folder of their
own.

All of it is built beside the target and renamed at the end, so that a local split is
there whole or not at all. One frame of one trajectory is in memory at a time.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lagbench.atomic import temporary_name
from lagbench.data.checksums import HASHED_SUBSETS
from lagbench.data.grid import Placement
from lagbench.data.layout import ScenarioKey, expand_path, scenario_path
from lagbench.data.local import DESCRIPTION
from lagbench.data.manifest import (
    FileEntry,
    Manifest,
    build_manifest,
    describe_file,
    write_manifest,
)
from lagbench.data.registry import MAX_ID, NO_GENERATOR, format_ids, load
from lagbench.data.scenario import read_scenario
from lagbench.data.statistics import file_statistics
from lagbench.data.writer import ScenarioWriter
from lagbench.data.yamlfile import format_yaml
from lagbench.errors import DataError, UsageError, WorkFailedError
from lagbench.metrics.coverage import Cloud, fitting_cells
from lagbench.work.machine import describe_machine
from lagbench.work.progress import Meter, Progress

from .trajectory import (
    FEWEST_CELLS,
    MOST_CELLS,
    Description,
    Trajectory,
    estimate_spacing,
)

SIZE = "full"  # size of every local split
VERSION = "1.0.0"
DEVICE = "cpu"
HEAD = '# A local split of lagbench, written by `lagbench {}`; its hashes stand under "measured".\n'
# spacings of particles across a cell of the score grid; our own splits have 1.8 to 2.6
PER_CELL = 2.5


@dataclass(frozen=True, kw_only=True)
class LocalSplit:
    """A local split that was made."""

    folder: Path  # its folder, which ``--split`` takes
    name: str  # its name
    size: str  # its only size
    scenarios: dict[str, int]  # number of scenarios by subset
    frames: int  # frames of all scenarios
    particles: tuple[int, int]  # the fewest and the most particles of a scenario
    input_frames: int  # frames given to a model
    horizon: int  # frames to predict
    spacing: float  # distance of neighbouring particles at first [length]
    bytes: int  # length of the scenario files [bytes]
    dataset_sha256: str  # hash of the data set
    notes: tuple[str, ...] = ()  # what a user should know


def output_name(output: str | Path) -> str:
    """Return the name of the split that a folder to make stands for: its last part."""
    return Path(os.path.abspath(expand_path(output, "--output"))).name


def make_local_split(
    about: Description,
    subsets: Mapping[str, Iterable[Trajectory]],
    output: str | Path,
    *,
    command: str,
    counts: Mapping[str, int] | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> LocalSplit:
    """Write a local split of the trajectories of train, valid and test; it appears
    whole or not at all.

    The last part of ``output`` is the name of the split, ``command`` stands in the head
    of its description; ``counts`` are the trajectories of each subset, where they are
    known before.
    """
    folder = Path(os.path.abspath(expand_path(output, "--output")))
    if about.name in load().splits:
        what = f"{about.name!r} is one of the splits of lagbench"
        raise UsageError(what, where="--output", fix="use another name")
    if folder.exists():
        fix = "remove it, or use another name"
        raise UsageError("the folder is there already", where=str(folder), fix=fix)
    meter = Meter(progress)
    with _scratch(folder) as root:
        building = _Building(about, root)
        for subset in HASHED_SUBSETS:
            before = len(building.entries)
            if counts:
                total = counts[subset]
            else:
                total = 0
            meter.begin(f"writing {subset}", total=total, scenarios=total)
            for trajectory in subsets[subset]:
                building.add(subset, trajectory)
                meter.count(1, scenarios=1)
            if len(building.entries) == before:
                raise DataError(
                    "a subset is empty",
                    where=subset,
                    expected="at least one trajectory",
                )
        manifest = building.finish(command)
        size = load(root / about.name / DESCRIPTION).size(about.name, SIZE)
        (root / about.name).replace(folder)
    particles = [entry.particles for entry in manifest.files]
    tested = {entry.particles for entry in manifest.files if entry.subset == "test"}
    note = (
        f"test scenarios have {min(tested)} to {max(tested)} particles: the split can "
        f"be opened and "
        "trained on; predictions and scores need one number for all"
    )
    return LocalSplit(
        folder=folder,
        name=about.name,
        size=SIZE,
        scenarios={name: len(ids) for name, ids in size.subsets.items()},
        frames=sum(entry.frames for entry in manifest.files),
        particles=(min(particles), max(particles)),
        input_frames=size.task.input_frames,
        horizon=size.task.horizon,
        spacing=building.spacing,
        bytes=sum(entry.bytes for entry in manifest.files),
        dataset_sha256=str(manifest.dataset_sha256),
        notes=(note,) if len(tested) > 1 else (),
    )


@contextmanager
def _scratch(folder: Path) -> Iterator[Path]:
    """Yield a folder beside the target that vanishes at the end."""
    root = temporary_name(folder)
    try:
        root.mkdir(parents=True)
        try:
            yield root
        finally:
            shutil.rmtree(root, ignore_errors=True)
    except (OSError, WorkFailedError) as error:
        raise WorkFailedError(
            "cannot write there",
            where=str(folder),
            got=error.got
            if isinstance(error, WorkFailedError)
            else error.strerror or error,
            fix="free disk space, or name another folder: --output",
        ) from error


@dataclass
class _Building:
    """A local split on the way: scenario files one by one, then manifest and
    description.
    """

    about: Description
    root: Path  # root folder in which the split's folder is built
    # distance of neighbouring particles at first [length]; 0 before the first scenario
    spacing: float = 0.0
    # of the scenarios written so far, by id
    entries: list[FileEntry] = field(default_factory=list)
    # of any particle [length]
    low: NDArray[np.float64] = field(default_factory=lambda: np.full(2, np.inf))
    high: NDArray[np.float64] = field(default_factory=lambda: np.full(2, -np.inf))
    # whether trajectories have velocities of walls; None before the first
    walled: bool | None = None

    def add(self, subset: str, trajectory: Trajectory) -> None:
        """Write the next scenario."""
        scenario = len(self.entries)
        if scenario > MAX_ID:
            raise DataError(
                "too many trajectories",
                where=trajectory.name,
                expected=f"at most {MAX_ID + 1}",
            )
        walled = trajectory.wall_velocity is not None
        if self.walled not in (None, walled):
            raise DataError(
                "velocities of walls in some trajectories only",
                where=trajectory.name,
                expected="wall_velocity, as before"
                if self.walled
                else "no wall_velocity, as before",
                fix="give zeros where walls rest",
            )
        self.walled = walled
        scale = self.about.measure.scale
        about = self.about
        if not self.spacing:
            first = np.asarray(next(trajectory.read())[0])
            self._check(trajectory, 0, about.measure.place(first))
            self.spacing = (
                about.spacing or estimate_spacing(first, about.radius)
            ) / scale
        key = self._key(scenario, subset)
        if trajectory.wall_velocity is None:
            walls = None
        else:
            walls = np.asarray(trajectory.wall_velocity) / scale
        with ScenarioWriter(
            scenario_path(self.root, key),
            key,
            particles=len(trajectory.material),
            frames=trajectory.frames,
            frame_interval=1.0 / about.rate,
            material=trajectory.material,
            particle_mass=about.density * self.spacing**2,
            wall_velocity=walls,
            parameters={
                "frame_rate": about.rate,
                "density": about.density,
                **trajectory.parameters,
            },
            seed=NO_GENERATOR,
            device=DEVICE,
            generator=NO_GENERATOR,
            licence=about.licence,
        ) as writer:
            for position, velocity in self._frames(trajectory):
                writer.append(position, velocity)
        self.entries.append(describe_file(self.root, key))

    def _key(self, scenario: int, subset: str) -> ScenarioKey:
        name = self.about.name
        return ScenarioKey(
            split=name, size=SIZE, version=VERSION, scenario=scenario, subset=subset
        )

    def _frames(
        self, trajectory: Trajectory
    ) -> Iterator[tuple[NDArray[np.float32], NDArray[np.float32]]]:
        """Yield positions and velocities in the unit box; without own velocities,
        differences.
        """
        before: NDArray[np.float32] | None = None
        for number, (raw, own) in enumerate(trajectory.read()):
            position = self.about.measure.place(raw)
            self._check(trajectory, number, position)
            if own is not None:
                with np.errstate(
                    over="ignore"
                ):  # what is beyond float32 becomes infinite
                    velocity = (own / self.about.measure.scale).astype(np.float32)
                if not np.isfinite(velocity).all():
                    raise DataError(
                        "a velocity is not finite",
                        where=f"{trajectory.name}, frame {number}",
                    )
                yield position, velocity
            elif before is not None:
                velocity = (
                    (position.astype(np.float64) - before) * self.about.rate
                ).astype(np.float32)
                if number == 1:  # v(f) = (x(f) - x(f-1)) / interval, and v(0) = v(1)
                    yield before, velocity
                yield position, velocity
            before = position

    def _check(
        self, trajectory: Trajectory, number: int, position: NDArray[np.float32]
    ) -> None:
        """Refuse positions that are no numbers or lie outside the unit box; note their
        extent.
        """
        where = f"{trajectory.name}, frame {number}"
        low = position.min(axis=0)
        high = position.max(axis=0)
        if not (np.isfinite(low).all() and np.isfinite(high).all()):
            raise DataError("a position is not finite", where=where)
        if (low < 0.0).any() or (high > 1.0).any():
            raise DataError(
                "particles lie outside the unit box",
                where=where,
                expected="[0, 1] x [0, 1]",
                got=" x ".join(
                    f"[{a:.6g}, {b:.6g}]" for a, b in zip(low, high, strict=True)
                ),
                fix="fit the box of the data into the unit box: --rescale, and "
                "--bounds if none are stated",
            )
        about = self.about
        if about.bounds is not None and self.spacing:
            box = about.measure.box(about.bounds)
            beyond = max(
                max(a - p, q - b) for (a, b), p, q in zip(box, low, high, strict=True)
            )
            if beyond > self.spacing:  # features, clamps and scores rest on the bounds
                scale = about.measure.scale
                corner = np.asarray(about.measure.corner)
                extent = zip(low * scale + corner, high * scale + corner, strict=True)
                raise UsageError(
                    "particles lie outside the stated bounds, by more than "
                    "their spacing",
                    where=f"{where}; --bounds, or bounds of the metadata",
                    expected=f"bounds that hold "
                    f"{' x '.join(f'[{a:.6g}, {b:.6g}]' for a, b in extent)}",
                    got=about.bounds,
                    fix="state the box of the data, in their own length",
                )
        self.low, self.high = np.minimum(self.low, low), np.maximum(self.high, high)

    def finish(self, command: str) -> Manifest:
        """Write manifest and description; return the manifest."""
        about = self.about
        content = {entry.scenario: entry.content_sha256[:16] for entry in self.entries}
        ids = {
            name: [e.scenario for e in self.entries if e.subset == name]
            for name in HASHED_SUBSETS
        }
        keys = [self._key(i, "train") for i in ids["train"]]
        manifest = build_manifest(
            None,
            self.entries,
            split=about.name,
            size=SIZE,
            version=VERSION,
            subsets=ids,
            environment=describe_machine(DEVICE),
            recorded=content,
            statistics=file_statistics([scenario_path(self.root, key) for key in keys]),
        )
        write_manifest(self.root, manifest)
        measured: dict[str, object] = {
            "dataset_sha256": manifest.dataset_sha256,
            "subset_sha256": manifest.subset_sha256,
            "scenario_sha256": content,
            "statistics": {
                name: list(row) for name, row in manifest.statistics.items()
            },
            "twin_floor": [],
        }
        splits = {about.name: self._split(ids)}
        described = {
            "format": 1,
            "splits": splits,
            "measured": {about.name: {SIZE: measured}},
        }
        text = HEAD.format(command) + format_yaml(described)
        (self.root / about.name / DESCRIPTION).write_text(text, encoding="utf-8")
        return manifest

    def _split(self, ids: Mapping[str, Sequence[int]]) -> dict[str, object]:
        """Return the description of the split as plain values."""
        about = self.about
        bounds = (
            about.measure.box(about.bounds)
            if about.bounds
            else zip(self.low, self.high, strict=True)
        )
        lengths = sorted({entry.frames for entry in self.entries})
        tested = [entry for entry in self.entries if entry.subset == "test"]
        task = self._task(shortest=min(entry.frames for entry in tested))
        cells = task["score_grid"]["cells"]  # type: ignore[index]
        counts = {entry.particles for entry in tested}
        if len(counts) == 1:
            particles = counts.pop()
        else:
            particles = max(entry.particles for entry in self.entries)
        most = "particles in one test scenario; the most of any where they differ"
        origin = "length of the source"
        parameters = {
            "particles": (particles, "1", most),
            "grid": (
                cells,
                "1",
                "cells across the unit box; predictions may leave the bounds by one",
            ),
            "substeps_per_frame": (
                1,
                "1",
                "solver steps between recorded frames, 1 where they are unknown",
            ),
            "frame_rate": (about.rate, "1/s", "recorded frames per second"),
            "density": (about.density, "mass/length^2", "rest density"),
            "spacing": (
                self.spacing,
                "length",
                "distance of neighbouring particles at first",
            ),
            "source_scale": (
                about.measure.scale,
                origin,
                "what a unit of length is in the source",
            ),
            "source_x": (
                about.measure.corner[0],
                origin,
                "x in the source of the lower left corner",
            ),
            "source_y": (
                about.measure.corner[1],
                origin,
                "y in the source of the lower left corner",
            ),
        }
        frames = {
            n: format_ids([e.scenario for e in self.entries if e.frames == n])
            for n in lengths
        }
        size = {
            "subsets": {name: format_ids(scenarios) for name, scenarios in ids.items()},
            "frames": lengths[0] if len(lengths) == 1 else frames,
            "bounds": [[float(low), float(high)] for low, high in bounds],
            "parameters": {},
            "task": task,
        }
        return {
            "version": VERSION,
            "title": about.title or about.name,
            "description": about.text or about.source,
            "citation": about.citation,
            "licence": about.licence,
            "generator": NO_GENERATOR,
            "source": about.source,
            "parameters": {
                name: {"value": value, "unit": unit, "description": words}
                for name, (value, unit, words) in parameters.items()
            },
            "sizes": {SIZE: size},
        }

    def _task(self, *, shortest: int) -> dict[str, object]:
        """Return the task, as far as the shortest test scenario allows one."""
        about = self.about
        if about.horizon is None:
            horizon = shortest - about.input_frames
        else:
            horizon = about.horizon
        last = about.input_frames + horizon - 1
        if horizon < 1 or last >= shortest:
            raise UsageError(
                "a test scenario is too short for the task",
                where="--input-frames and --horizon",
                expected=f"together at most {shortest} frames, one of them to predict",
                got=f"{about.input_frames} given"
                + (f", {horizon} to predict" if about.horizon else ""),
            )
        interest = sorted(set(about.frames_of_interest or (last,)))
        if not about.input_frames <= interest[0] <= interest[-1] <= last:
            raise UsageError(
                "a frame of interest is not predicted",
                where="--frames-of-interest",
                expected=f"frames {about.input_frames} to {last}",
                got=format_ids(interest) if interest[0] >= 0 else interest,
            )
        if about.full_box:
            placement = Placement.CELL_CENTRES
        else:
            placement = Placement.NODES
        cells = about.cells or self._suitable_cells(
            placement, (about.input_frames, last)
        )
        return {
            "input_frames": about.input_frames,
            "horizon": horizon,
            "frames_of_interest": interest,
            "score_grid": {"cells": cells, "placement": placement.value},
            "radius": about.radius / about.measure.scale,
        }

    def _suitable_cells(self, placement: Placement, frames: tuple[int, int]) -> int:
        """Return cells of some spacings, or as near as test scenarios cover enough
        nodes in these frames.
        """
        suits = min(
            MOST_CELLS, max(FEWEST_CELLS, round(1.0 / (PER_CELL * self.spacing)))
        )

        def clouds() -> Iterator[Cloud]:
            for entry in self.entries:
                if entry.subset == "test":
                    key = self._key(entry.scenario, "test")
                    with read_scenario(scenario_path(self.root, key)) as file:
                        for frame in frames:
                            position = file.read("position", slice(frame, frame + 1))[0]
                            yield Cloud(position, len(position) * self.spacing**2)

        return fitting_cells(clouds, placement, near=suits) or suits
