"""Export a data set to the formats of other code bases and of ParaView."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagbench.atomic import write_atomically
from lagbench.data import PARTICLE_KINDS
from lagbench.data.checksums import HASHED_SUBSETS
from lagbench.data.layout import expand_path
from lagbench.data.local import locate, suggest_repair
from lagbench.data.manifest import read_manifest
from lagbench.data.registry import Registry, Size
from lagbench.data.scenario import read_scenario
from lagbench.errors import DataError, UsageError
from lagbench.generators.constants import solver_constants
from lagbench.store.copy import scenario_files
from lagbench.work.run import Meter, Progress

from . import gns_npz, lagrangebench_h5, vtkhdf

FORMATS = {"gns-npz": ".npz", "lagrangebench-h5": ".h5", "vtkhdf": ".vtkhdf"}
"""Formats, and the endings of their files."""

FORCE = "force.py"
"""A program beside the data that LagrangeBench runs."""

WALL_LAYERS = 3
"""Layers of particles of a wall, as LagrangeBench's own lid-driven cavity has them."""

WALL_AXES = np.array([1, 1, 0, 0])
"""Axis along each wall: left, right, bottom, top."""

Run = tuple[NDArray[np.float32], NDArray[np.int64]]
"""Positions [frame, particle, axis] and the kind of each particle."""


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
    """Write train, valid and test of a data set in another format.

    One trajectory is in memory at a time. The same data give the same bytes with one
    version of NumPy and of HDF5.

    Args:
        split: name of the split, or path of a local split's folder.
        size: name of the size; None takes the only one with data, or mini where several
            have data.
        format: "gns-npz", "lagrangebench-h5", or "vtkhdf" with a file for each
            scenario.
        output: folder for the files.
        root: folder of all data sets, see :func:`lagbench.data.local.resolve_root`.
        from_walls: lagrangebench-h5 only: measure positions from the lower walls, so
            that the bounds that its models see are the walls; no bit is lost. Else
            positions are ours, and the bounds those of the unit box, which that
            program's neighbour search needs. None: from the walls in full boxes, and
            where walls may move or an axis is periodic.
        wall_particles: full boxes of two dimensions with four walls only: add
            particles beside the walls that move along with them, since no format has
            wall velocities.
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
    if format not in FORMATS:
        raise UsageError(f"no format {format!r}; name one of {', '.join(FORMATS)}")
    tier, data_root, rooted_registry = locate(split, size, root=root, registry=registry)
    target = expand_path(output, "--output")
    if (target / FORCE).exists():
        raise UsageError(
            f"{target / FORCE} is a program that readers of this format run; name "
            "another folder: --output"
        )
    if target.is_dir() and any(target.iterdir()) and not overwrite:
        raise UsageError(
            f"{target} holds files; name another folder: --output, or write beside and "
            "over them: --overwrite"
        )

    paths_of: dict[str, list[Path]] = {subset: [] for subset in HASHED_SUBSETS}
    frames_of: dict[str, list[int]] = {subset: [] for subset in HASHED_SUBSETS}
    files_by_id = scenario_files(tier, data_root, HASHED_SUBSETS)
    for scenario, path in sorted(files_by_id.items()):
        subset = tier.subset_of(scenario)
        paths_of[subset].append(path)
        with read_scenario(path) as file:
            frames_of[subset].append(file.header.frames)
    with read_scenario(paths_of["train"][0]) as file:
        volume = file.read_particle_mass() / float(tier.value("density"))
        has_moving_walls = "wall_velocity" in file.variables
    spacing = volume ** (1.0 / tier.dimension)
    walls = None
    if wall_particles:
        if not has_moving_walls or tier.box.is_periodic or tier.dimension != 2:
            raise UsageError(
                f"--wall-particles needs a box of two dimensions with four walls, and "
                f"{tier.split} has none; leave the option out"
            )
        walls = _WallParticles(tier.bounds, spacing)
    if from_walls is None:
        from_walls = tier.is_full_box or has_moving_walls or tier.box.is_periodic

    meter = Meter(progress)
    scenario_count = sum(map(len, paths_of.values()))
    meter.begin("exporting", total=scenario_count, scenarios=scenario_count)
    count = partial(meter.count, 1, scenarios=1)
    shapes: dict[str, list[tuple[int, int]]] = {}
    files: list[Path] = []
    if format == "vtkhdf":
        for subset, paths in paths_of.items():
            shapes[subset] = []
            for path in paths:
                copy = target / subset / f"{path.stem}.vtkhdf"
                shapes[subset].append(vtkhdf.write(copy, path))
                files.append(copy)
                count()
    else:
        origin = np.zeros(tier.dimension)
        if format == "lagrangebench-h5" and (from_walls or walls):
            thickness = walls.thickness if walls else 0.0
            lows = np.array(tier.bounds)[:, 0] - thickness
            # taking it off a float32 above it and below 16 loses no bit
            origin = np.floor(lows * 2**20) / 2**20
        module: Any = gns_npz if format == "gns-npz" else lagrangebench_h5
        for subset, paths in paths_of.items():
            files.append(target / f"{subset}{FORMATS[format]}")
            runs = _read_runs(paths, module, tier.frame_interval, walls, count)
            if format == "gns-npz":
                shapes[subset] = gns_npz.write(files[-1], runs)
            else:
                shapes[subset] = lagrangebench_h5.write(
                    files[-1], runs, length=min(frames_of[subset]), origin=origin
                )
        metadata = _describe(
            tier,
            module,
            shapes,
            spacing=spacing,
            origin=origin,
            from_walls=from_walls,
            walls=walls,
            title=rooted_registry.split(tier.split).title,
            record=_recorded_statistics(tier, data_root),
        )
        files.append(target / "metadata.json")
        text = json.dumps(metadata, indent=1) + "\n"
        write_atomically(files[-1], text.encode(), option="--output")
    frames = {subset: sum(n for n, _ in rows) for subset, rows in shapes.items()}
    present = sum(map(sum, frames_of.values()))
    return ExportResult(
        format=format,
        split=tier.split,
        size=tier.name,
        folder=target,
        files=tuple(files),
        trajectories={subset: len(rows) for subset, rows in shapes.items()},
        frames=frames,
        left_out=present - sum(frames.values()),
        loses_wall_motion=has_moving_walls and walls is None,
        bytes=sum(path.stat().st_size for path in files),
    )


class _WallParticles:
    """Layers of particles beside each wall of a box.

    They go along with the wall, and what leaves at one end comes in at the other.
    """

    def __init__(self, bounds: Sequence[Sequence[float]], spacing: float) -> None:
        self.thickness = WALL_LAYERS * spacing
        low, high = np.array(bounds).T
        depths = spacing * (np.arange(WALL_LAYERS) + 0.5)
        walls = []
        places = []
        for wall, axis in enumerate(WALL_AXES):
            count = max(1, round((high[axis] - low[axis]) / spacing))
            pitch = (high[axis] - low[axis]) / count
            along = low[axis] + pitch * (np.arange(count) + 0.5)
            other = 1 - axis
            is_low = wall in (0, 2)
            across = low[other] - depths if is_low else high[other] + depths
            place = np.empty((WALL_LAYERS, count, 2))
            place[..., axis] = along
            place[..., other] = across[:, None]
            places.append(place.reshape(-1, 2))
            walls.append(np.full(WALL_LAYERS * count, wall))
        self.wall = np.concatenate(walls)  # which each particle lies beside
        self._start = np.concatenate(places)
        self._low = low
        self._high = high

    def positions(
        self, wall_velocity: NDArray[np.floating], interval: float
    ) -> NDArray[np.float32]:
        """Return positions [frame, particle, axis] of particles that go with the walls.

        ``wall_velocity`` is [frame, wall, axis]; entry f acts from frame f-1 to f.
        """
        along = wall_velocity[:, np.arange(len(WALL_AXES)), WALL_AXES]
        steps = interval * along.astype(np.float64)
        steps[0] = 0.0
        travel = np.cumsum(steps, axis=0)[:, self.wall]
        axes = WALL_AXES[self.wall]
        rows = np.arange(len(axes))
        position = np.repeat(self._start[None], len(travel), axis=0)
        low = self._low[axes]
        length = self._high[axes] - low
        moved = position[:, rows, axes] - low + travel
        position[:, rows, axes] = low + moved % length
        return position.astype(np.float32)


def _read_runs(
    paths: Sequence[Path],
    module: Any,  # noqa: ANN401 (gns_npz or lagrangebench_h5)
    interval: float,
    walls: _WallParticles | None,
    count: Callable[[], None],
) -> Iterator[Run]:
    """Yield the trajectories of a subset."""
    numbers = np.array([module.KINDS[name] for name in PARTICLE_KINDS])
    for path in paths:
        with read_scenario(path) as file:
            position = file.read("position")
            kinds = numbers[file.read("material")]
            if walls is not None:
                wall_velocity = file.read("wall_velocity")
                beside = walls.positions(wall_velocity, interval)
                position = np.concatenate([position, beside], axis=1)
                ever_moves = (wall_velocity != 0.0).any(axis=(0, 2))[walls.wall]
                at_rest, moving = module.WALLS
                wall_kinds = np.where(ever_moves, moving, at_rest)
                kinds = np.concatenate([kinds, wall_kinds])
        yield position, kinds
        count()


def _recorded_statistics(
    size: Size, root: Path
) -> tuple[Mapping[str, Sequence[float]], str]:
    """Return statistics over train and the data set hash.

    They are those of the registry, else of the manifest.
    """
    statistics: Mapping[str, Sequence[float]] = {}
    digest = None
    if size.measured:
        statistics = size.measured.statistics
        digest = size.measured.dataset_sha256
    else:
        manifest = read_manifest(root, size.split, size.name, size.major)
        if manifest is not None:
            statistics = manifest.statistics
            digest = manifest.dataset_sha256
    needed = {"velocity_mean", "velocity_std", "acceleration_mean", "acceleration_std"}
    if digest is None or not needed <= set(statistics):
        raise DataError(
            f"{size.split} {size.name}: statistics of train are recorded nowhere, or "
            f"without an acceleration; {suggest_repair(size, root=root)}"
        )
    return statistics, digest


def _describe(
    size: Size,
    module: Any,  # noqa: ANN401 (gns_npz or lagrangebench_h5)
    shapes: Mapping[str, Sequence[tuple[int, int]]],
    *,
    spacing: float,
    origin: NDArray[np.float64],
    from_walls: bool,
    walls: _WallParticles | None,
    title: str,
    record: tuple[Mapping[str, Sequence[float]], str],
) -> dict[str, Any]:
    """Return the metadata of an export, with the keys of its format and our own."""
    statistics, digest = record
    bounds = (np.array(size.bounds) - origin[:, None]).tolist()
    metadata: dict[str, Any] = {
        "bounds": bounds,
        "default_connectivity_radius": size.task.radius,
        "dim": size.dimension,
        "periodic_boundary_conditions": list(size.box.periodic),
    }
    for prefix, name in (("vel", "velocity"), ("acc", "acceleration")):
        metadata[f"{prefix}_mean"] = list(statistics[f"{name}_mean"])
        # models divide by a deviation: 0 becomes 1
        deviations = statistics[f"{name}_std"]
        metadata[f"{prefix}_std"] = [deviation or 1.0 for deviation in deviations]
    frame_counts = {subset: rows[0][0] for subset, rows in shapes.items()}
    if module is gns_npz:
        every = [frames for rows in shapes.values() for frames, _ in rows]
        metadata |= {"sequence_length": min(every), "dt": size.frame_interval}
    else:
        viscosity = size.parameters.get("liquid_viscosity")
        gravity = size.parameters.get("gravity")
        no_slip = size.simulated and getattr(solver_constants(size), "no_slip", False)
        every = [particles for rows in shapes.values() for _, particles in rows]
        metadata |= {
            "case": size.split.upper(),
            "solver": "MPM" if size.simulated else "unknown",
            "density_evolution": False,
            "dx": spacing,
            "dt": size.dt,  # of the solver
            "write_every": size.substeps_per_frame,
            "t_end": (max(frame_counts.values()) - 1) * size.frame_interval,
            "viscosity": None if viscosity is None else viscosity.value,
            "p_bg_factor": 0.0,
            "g_ext_magnitude": 0.0 if gravity is None else gravity.value,
            "artificial_alpha": 0.0,
            "free_slip": not no_slip,
            "is_bc_trick": False,
            # one less than frames: the last one is a target only
            "sequence_length_train": frame_counts["train"] - 1,
            "sequence_length_test": frame_counts["test"] - 1,
            "num_trajs_train": len(shapes["train"]),
            "num_trajs_test": len(shapes["test"]),
            "num_particles_max": max(every),
        }
        # Its cell lists start at 0 and are as long as the bounds are apart: particles
        # beyond the difference would lose their neighbours.
        for axis, (low, high) in enumerate(size.bounds):
            if walls is not None:
                bounds[axis] = [0.0, high + walls.thickness - float(origin[axis])]
            elif not from_walls:
                is_periodic = size.box.periodic[axis]
                bounds[axis] = [low, high] if is_periodic else [0.0, 1.0]
    task = size.task
    metadata["lagbench"] = {
        "split": size.split,
        "size": size.name,
        "version": size.version,
        "title": title,
        "dataset_sha256": digest,
        "particle_type": module.KINDS,
        "origin": origin.tolist(),
        "bounds": [list(side) for side in size.bounds],
        "spacing": spacing,
        "density": size.value("density"),
        "input_frames": task.input_frames,
        "horizon": task.horizon,
        "frames_of_interest": list(task.frames_of_interest),
        "cells": task.score_grid.cells,
        "placement": task.score_grid.placement,
        "wall_particle_type": sorted(set(module.WALLS)) if walls else [],
    }
    return metadata
