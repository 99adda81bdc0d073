"""Write a local split: a folder with scenario files, manifest and description.

All of it is built beside the target and renamed at the end, so that a local split is
there whole or not at all. A block of frames of one trajectory is in memory at a time.
"""

from __future__ import annotations

import itertools
import math
import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from lagbench.atomic import check_writable, temporary_name, write_atomically
from lagbench.data import WALL
from lagbench.data.box import AXES, SMALL_SIDE, Box, parse_periodic
from lagbench.data.checksums import HASHED_SUBSETS, round_digits
from lagbench.data.grid import Placement, most_cells
from lagbench.data.layout import (
    MAX_ID,
    ScenarioKey,
    expand_path,
    format_ids,
    scenario_path,
)
from lagbench.data.local import DESCRIPTION, is_split_name
from lagbench.data.manifest import (
    FileEntry,
    Manifest,
    build_manifest,
    describe_file,
    write_manifest,
)
from lagbench.data.registry import NO_GENERATOR, load
from lagbench.data.scenario import read_scenario
from lagbench.data.statistics import file_statistics
from lagbench.data.writer import ScenarioWriter
from lagbench.data.yamlfile import format_yaml
from lagbench.errors import DataError, UsageError
from lagbench.metrics.coverage import CELLS, Cloud, fitting_cells
from lagbench.work.machine import describe_machine

from .names import Trajectory

SIZE = "full"
"""Size of every local split."""

VERSION = "1.0.0"
DEVICE = "cpu"

HEAD = (
    "# A local split of lagbench, written by `lagbench import`; its hashes stand under "
    '"measured".\n'
)

SPACINGS_PER_CELL = 2.5
"""Spacings of particles across a cell of the score grid; our splits have 1.8 to 2.6."""

FEWEST_CELLS = 4

Bounds = tuple[tuple[float, float], ...]
"""Low and high walls along x, y and, in three dimensions, z."""

Length = Annotated[float, Field(ge=1e-30, le=1e30)]


class Description(BaseModel):
    """What is known of data from elsewhere; lengths are those of the source."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    title: str = ""  # title of the split; its name when empty
    text: str = ""  # what the data are
    citation: str = "none"  # whom to cite
    licence: str = "unknown"  # licence of the data
    radius: Length | None = None  # connectivity radius; None for two spacings
    # time between frames [s]; None where the files say
    frame_interval: Annotated[float, Field(ge=1e-9, le=1e30)] | None = None
    # box that holds the particles; None for the extent of all positions
    bounds: Bounds | None = Field(None, min_length=2, max_length=3)
    periodic: tuple[str, ...] = ()  # names of the axes without walls; needs bounds
    rescale: bool = True  # whether to fit the bounds into the unit box
    density: Length = 1.0  # rest density [mass/length^d]
    # distance of neighbouring particles at first; None to measure it
    spacing: Length | None = None
    input_frames: int = Field(6, ge=2)  # frames given to a model
    # frames to predict; None for all that every test and valid scenario has
    horizon: int | None = Field(None, ge=1)
    # absolute frames that are reported; None for the last
    frames_of_interest: tuple[int, ...] | None = None
    # cells across of the score grid; None for one that suits the spacing
    cells: int | None = Field(None, ge=FEWEST_CELLS, le=4096)
    # whether material fills the box, so that vorticity ranks; else clouds rank
    full_box: bool = False

    @property
    def box(self) -> Box | None:
        """The box that holds the particles [length of the source].

        Raises:
            UsageError: an axis has no extent, or a periodic axis is that of no box.
        """
        if self.bounds is None:
            if self.periodic:
                raise UsageError(
                    "a periodic axis needs --bounds, whose ends are the period apart; "
                    "add them, as in --bounds 0,1,0,1"
                )
            return None
        return Box.from_bounds(
            self.bounds, parse_periodic(self.periodic, len(self.bounds))
        )


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
    frame_interval: float  # time between two frames [s]
    # the walls, or one period [length]: lowest and highest position along each axis
    bounds: Bounds
    periodic: tuple[str, ...]  # names of the axes without walls
    spacing: float  # distance of neighbouring particles at first [length]
    bytes: int  # length of the scenario files [bytes]
    dataset_sha256: str  # hash of the data set
    # what states the frame interval: option, metadata.json, or variable of the files
    interval_source: str = ""
    notes: tuple[str, ...] = ()  # what a user should know


def check_output(output: str | Path) -> Path:
    """Return the folder to make.

    Raises:
        UsageError: its name cannot be that of a local split, or it is there.
    """
    folder = Path(os.path.abspath(expand_path(output, "--output")))
    if not is_split_name(folder.name) or folder.name in load().splits:
        raise UsageError(
            f"--output: no split of your own can be named {folder.name!r}; use small "
            "letters, digits, - and _, a letter first, and no name of a split of "
            "lagbench, as in -o own"
        )
    if os.path.lexists(folder):
        raise UsageError(f"{folder} is there already; name another folder: --output")
    return folder


@dataclass(frozen=True, kw_only=True)
class BoxTransform:
    """How lengths of the source become the unit box's: ``(x - corner) / scale``."""

    scale: float = 1.0
    corner: tuple[float, ...] = (0.0, 0.0, 0.0)  # of the axes that there are

    @classmethod
    def fit(cls, box: Box) -> BoxTransform:
        """Return the transform that brings a box into the unit box.

        The scale is a power of two, which loses no bit: the least that is not below the
        longest side, but 1 for sides from 1/16 to 1. Where no score grid would fit the
        periods then, as in a box of side 2 pi, it is a multiple of the longest period,
        if that helps. The corner is 0 where that is enough.
        """
        longest = float(box.lengths.max())
        scale = 1.0
        if not SMALL_SIDE <= longest <= 1.0:
            scale = 2.0 ** math.ceil(math.log2(longest))
        if box.is_periodic:
            period = float(box.lengths[np.asarray(box.periodic)].max())
            multiple = period * math.ceil(longest / period)
            for candidate in (scale, multiple):
                bounds = [(0.0, float(side / candidate)) for side in box.lengths]
                scaled_box = Box.from_bounds(bounds, box.periodic)
                if any(map(scaled_box.has_whole_cells, range(FEWEST_CELLS, 65))):
                    scale = candidate
                    break
        corner = box.low
        if min(box.low) >= 0.0 and max(box.high) <= scale:
            corner = (0.0,) * box.dimension
        return cls(scale=scale, corner=corner)

    def apply(self, position: np.typing.NDArray[Any]) -> np.typing.NDArray[np.float64]:
        """Return positions in the unit box."""
        corner = np.asarray(self.corner[: position.shape[-1]])
        return np.asarray((position.astype(np.float64) - corner) / self.scale)


def write_local_split(
    folder: Path,
    description: Description,
    box: Box,
    trajectories: Mapping[str, Sequence[tuple[Callable[[], Trajectory], float]]],
    *,
    source: str,
    count: Callable[[], None],
) -> LocalSplit:
    """Write a local split; it appears whole or not at all.

    Args:
        folder: folder to make; its last part is the name of the split.
        description: what is known of the data, the radius and the interval too.
        box: the box that holds the particles [length of the source].
        trajectories: by subset, what opens a trajectory, and its spacing [length of the
            source].
        source: where the data come from.
        count: called after each trajectory.

    Raises:
        UsageError: the task does not fit the data, or no score grid fits the box.
        DataError: there are too many trajectories.
        WorkFailedError: the disk is full or not writable.
    """
    check_writable(folder, option="--output")
    root = temporary_name(folder)
    writer = _Writer(root, folder.name, description, box, source)
    try:
        root.mkdir(parents=True)
        for subset in HASHED_SUBSETS:
            for open_trajectory, spacing in trajectories[subset]:
                trajectory = open_trajectory()
                with closing(trajectory):
                    writer.write_scenario(subset, trajectory, spacing)
                count()
        manifest = writer.write_descriptions()
        size = load(root / folder.name / DESCRIPTION).size(folder.name, SIZE)
        if os.path.lexists(folder):
            raise UsageError(f"another call made {folder} meanwhile; use that")
        (root / folder.name).replace(folder)
    finally:
        shutil.rmtree(root, ignore_errors=True)
    particle_counts = [entry.particles for entry in manifest.files]
    return LocalSplit(
        folder=folder,
        name=size.split,
        size=size.name,
        scenarios={name: len(ids) for name, ids in size.subsets.items()},
        frames=sum(entry.frames for entry in manifest.files),
        particles=(min(particle_counts), max(particle_counts)),
        materials=tuple(sorted(writer.materials)),
        input_frames=size.task.input_frames,
        horizon=size.task.horizon,
        frame_interval=float(description.frame_interval or 1.0),
        bounds=size.bounds,
        periodic=size.periodic,
        spacing=writer.spacings[0],
        bytes=sum(entry.bytes for entry in manifest.files),
        dataset_sha256=str(manifest.dataset_sha256),
    )


class _Writer:
    """Write scenario files one by one, then manifest and description."""

    def __init__(
        self,
        root: Path,
        name: str,
        description: Description,
        box: Box,
        source: str,
    ) -> None:
        self.root = root
        self.name = name
        self.description = description
        self.source = source
        self.transform = BoxTransform(scale=1.0)
        if description.rescale:
            self.transform = BoxTransform.fit(box)
        low = self.transform.apply(np.array(box.low))
        high = self.transform.apply(np.array(box.high))
        bounds = list(zip(low.tolist(), high.tolist(), strict=True))
        self.box = Box.from_bounds(bounds, box.periodic)
        # 1 / (0.1 / 12 * 12) is 10
        self.rate = round_digits(1.0 / float(description.frame_interval or 1.0), 12)
        self.entries: list[FileEntry] = []
        self.spacings: list[float] = []  # of each scenario [length]
        self.materials: set[int] = set()
        if (low < 0.0).any() or (high > 1.0).any():
            raise UsageError(
                "the box of the data does not lie in the unit box; leave --no-rescale "
                "out"
            )

    def _key(self, scenario: int, subset: str) -> ScenarioKey:
        return ScenarioKey(
            split=self.name,
            size=SIZE,
            version=VERSION,
            scenario=scenario,
            subset=subset,
        )

    def write_scenario(
        self, subset: str, trajectory: Trajectory, spacing: float
    ) -> None:
        """Write the next scenario.

        Without velocities they are ``v(f) = (x(f) - x(f-1)) / interval``, and
        ``v(0) = v(1)``.
        """
        if len(self.entries) > MAX_ID:
            raise DataError(f"more than {MAX_ID + 1} trajectories; make two splits")
        scale = self.transform.scale
        wall_velocity = trajectory.wall_velocity
        if wall_velocity is not None:
            wall_velocity = wall_velocity / scale
        self.spacings.append(spacing / scale)
        key = self._key(len(self.entries), subset)
        density = self.description.density
        with ScenarioWriter(
            scenario_path(self.root, key),
            key,
            particles=len(trajectory.material),
            frames=trajectory.frames,
            frame_interval=1.0 / self.rate,
            material=trajectory.material,
            particle_mass=density * self.spacings[-1] ** self.box.dimension,
            wall_velocity=wall_velocity,
            parameters={"frame_rate": self.rate, "density": density},
            seed=NO_GENERATOR,
            device=DEVICE,
            generator=NO_GENERATOR,
            licence=self.description.licence,
            dimension=self.box.dimension,
            periodic=self._periodic_axes(),
        ) as writer:
            before: np.typing.NDArray[np.float32] | None = None
            for number, (source_position, velocity) in enumerate(trajectory.read()):
                inside = self.transform.apply(source_position)
                position = self.box.wrap(inside).astype(np.float32)
                if velocity is not None:
                    writer.append(position, (velocity / scale).astype(np.float32))
                    continue
                if before is not None:
                    step = self.box.displacement(before, position.astype(np.float64))
                    motion = (step * self.rate).astype(np.float32)
                    if number == 1:
                        writer.append(before, motion)
                    writer.append(position, motion)
                before = position
        self.entries.append(describe_file(self.root, key))
        self.materials.update(np.unique(trajectory.material).tolist())

    def _periodic_axes(self) -> list[str]:
        return list(itertools.compress(AXES, self.box.periodic))

    def write_descriptions(self) -> Manifest:
        """Write manifest and description; return the manifest."""
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
            split=self.name,
            size=SIZE,
            version=VERSION,
            subsets=ids,
            environment=describe_machine(DEVICE),
            recorded=short_hashes,
            statistics=file_statistics(train_paths, self.box),
        )
        write_manifest(self.root, manifest)
        measured: dict[str, Any] = {
            "dataset_sha256": manifest.dataset_sha256,
            "subset_sha256": manifest.subset_sha256,
            "scenario_sha256": short_hashes,
            "statistics": {
                name: list(row) for name, row in manifest.statistics.items()
            },
            "twin_floor": [],
        }
        registry = {
            "format": 1,
            "splits": {self.name: self._describe_split(ids)},
            "measured": {self.name: {SIZE: measured}},
        }
        text = HEAD + format_yaml(registry)
        write_atomically(self.root / self.name / DESCRIPTION, text.encode())
        return manifest

    def _describe_split(self, ids: Mapping[str, Sequence[int]]) -> dict[str, object]:
        """Return the description of the split as plain values."""
        description = self.description
        task = self._describe_task()
        size: dict[str, Any] = {
            "subsets": {name: format_ids(scenarios) for name, scenarios in ids.items()},
            "frames": self._count("frames"),
            "bounds": [list(ends) for ends in self.box.bounds],
            "parameters": {},
            "task": task,
        }
        if self.box.is_periodic:
            size["periodic"] = self._periodic_axes()
        particle_counts = self._count("particles")
        if isinstance(particle_counts, dict):
            size["particle_counts"] = particle_counts
        length = "length of the source"
        most_particles = max(entry.particles for entry in self.entries)
        mass = f"mass/length^{self.box.dimension}"
        rows: list[tuple[str, object, str, str]] = [
            ("particles", most_particles, "1", "most particles in one scenario"),
            ("grid", task["score_grid"]["cells"], "1", "cells across the unit box"),
            ("substeps_per_frame", 1, "1", "unknown here, so 1"),
            ("frame_rate", self.rate, "1/s", "recorded frames per second"),
            ("density", description.density, mass, "rest density"),
            ("spacing", self.spacings[0], "length", "distance of neighbours at first"),
            ("source_scale", self.transform.scale, length, "what a unit of length is"),
        ]
        for axis, place in zip(AXES, self.transform.corner, strict=False):
            meaning = f"{axis} in the source of the lower corner"
            rows.append((f"source_{axis}", place, length, meaning))
        parameters = {}
        for name, value, unit, meaning in rows:
            parameters[name] = {"value": value, "unit": unit, "description": meaning}
        return {
            "version": VERSION,
            "title": description.title or self.name,
            "description": description.text or self.source,
            "citation": description.citation,
            "licence": description.licence,
            "generator": NO_GENERATOR,
            "source": self.source,
            "parameters": parameters,
            "sizes": {SIZE: size},
        }

    def _count(self, quantity: str) -> int | dict[int, str]:
        """Return the frames or particles of a scenario; by ids where they differ."""
        scenarios_of: dict[int, list[int]] = {}
        for entry in self.entries:
            number = getattr(entry, quantity)
            scenarios_of.setdefault(number, []).append(entry.scenario)
        if len(scenarios_of) == 1:
            return next(iter(scenarios_of))
        return {number: format_ids(ids) for number, ids in sorted(scenarios_of.items())}

    def _describe_task(self) -> dict[str, Any]:
        """Return the key ``task`` of the size; what is not stated gets a default."""
        description = self.description
        predicted = [entry for entry in self.entries if entry.subset != "train"]
        shortest = min(entry.frames for entry in predicted)
        given = description.input_frames
        horizon = description.horizon or shortest - given
        last = given + horizon - 1
        if horizon < 1 or last >= shortest:
            raise UsageError(
                f"a scenario of test or valid has {shortest} frames, and the task "
                f"needs {given} given ones and {max(horizon, 1)} to predict; give "
                "fewer: --input-frames and --horizon"
            )
        interest = sorted(set(description.frames_of_interest or (last,)))
        if not given <= interest[0] <= interest[-1] <= last:
            raise UsageError(
                f"frames of interest are {interest}, and frames {given} to {last} are "
                "predicted; name some of these"
            )
        placement = Placement.NODES
        if description.full_box:
            placement = Placement.CELL_CENTRES
        cells = description.cells or self._suitable_cells(placement, (given, last))
        if cells > most_cells(self.box) or not self.box.has_whole_cells(cells):
            raise UsageError(
                f"{cells} cells across a length of 1 do not fit the box "
                f"{self.box.bounds}: at most {most_cells(self.box)}, and three or more "
                "whole ones along each period; give other --bounds, or other cells"
            )
        return {
            "input_frames": given,
            "horizon": horizon,
            "frames_of_interest": interest,
            "score_grid": {"cells": cells, "placement": placement.value},
            "radius": float(description.radius or 0.0) / self.transform.scale,
        }

    def _suitable_cells(self, placement: Placement, frames: tuple[int, int]) -> int:
        """Return cells across a score grid that suits the spacing.

        Where test scenarios cover too few nodes in these frames, it is the nearest
        number by which they cover enough.
        """
        if most_cells(self.box) < max(CELLS):
            raise UsageError(
                f"the periods of the box {self.box.bounds} are far longer than 1; "
                "leave --no-rescale out, or correct --bounds"
            )
        spacing = float(np.median(self.spacings))
        cells = round(1.0 / (SPACINGS_PER_CELL * spacing))
        cells = min(most_cells(self.box), max(FEWEST_CELLS, cells))
        clouds = partial(self._read_clouds, frames)
        suitable = fitting_cells(clouds, placement, near=cells, box=self.box)
        return cells if suitable is None else suitable

    def _read_clouds(self, frames: tuple[int, int]) -> Iterator[Cloud]:
        """Yield the particles of some frames of every test scenario."""
        for entry, spacing in zip(self.entries, self.spacings, strict=True):
            if entry.subset != "test":
                continue
            key = self._key(entry.scenario, "test")
            with read_scenario(scenario_path(self.root, key)) as file:
                is_scored = file.read("material") != WALL
                for frame in frames:
                    position = file.read("position", slice(frame, frame + 1))[0]
                    position = position[is_scored]
                    area = len(position) * spacing**self.box.dimension
                    yield Cloud(position, area)
