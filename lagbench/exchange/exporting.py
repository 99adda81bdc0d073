"""Export a data set to the formats of other code bases and of ParaView."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
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
from lagbench.store.copy import scenario_files
from lagbench.work.run import Meter, Progress

from . import gns_npz, lagrangebench_h5, vtkhdf

CODE_BASES = {"gns-npz": gns_npz, "lagrangebench-h5": lagrangebench_h5}
"""Formats of code bases, which have a file for each subset, and their modules."""

FORMATS = (*CODE_BASES, "vtkhdf")

FORCE = "force.py"
"""A program beside the data that LagrangeBench runs."""

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
        overwrite: whether to replace an earlier export, or to write beside other files.
        progress: called as the work advances.
        registry: where splits are described; ours when None.

    Raises:
        UsageError: unknown split, size or format, the folder holds files, or a
            ``force.py``, which the program that reads lagrangebench-h5 would run.
        DataError: scenarios are missing or damaged, or their statistics are recorded
            nowhere.
        WorkFailedError: the disk is full or not writable.
    """
    if format not in FORMATS:
        raise UsageError(f"no format {format!r}; name one of {', '.join(FORMATS)}")
    tier, data_root, _ = locate(split, size, root=root, registry=registry)
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
    files_by_id = scenario_files(tier, data_root, HASHED_SUBSETS)
    with read_scenario(next(iter(files_by_id.values()))) as file:
        volume = file.read_particle_mass() / float(tier.value("density"))
        has_moving_walls = "wall_velocity" in file.variables
    module: Any = CODE_BASES.get(format)
    origin = np.zeros(tier.dimension, np.float32)
    is_closed = tier.is_full_box or has_moving_walls or tier.box.is_periodic
    if module is lagrangebench_h5 and is_closed:
        # taking it off a float32 above it and below 16 loses no bit
        origin = (np.floor(np.array(tier.box.low) * 2**20) / 2**20).astype(np.float32)

    meter = Meter(progress)
    meter.begin("exporting", total=len(files_by_id), scenarios=len(files_by_id))
    files: list[Path] = []
    trajectories: dict[str, int] = {}
    frames: dict[str, int] = {}
    left_out = 0
    for subset in HASHED_SUBSETS:
        ids = tier.subsets[subset]
        paths = [files_by_id[scenario] for scenario in ids]
        lengths = [tier.frame_count(scenario) for scenario in ids]
        if module is None:
            for path in paths:
                files.append(target / subset / f"{path.stem}.vtkhdf")
                vtkhdf.write(files[-1], path)
                meter.count(1, scenarios=1)
        else:
            if module is lagrangebench_h5:
                # it takes the length of the first trajectory for all
                shortest = min(lengths)
                left_out += sum(length % shortest for length in lengths)
                lengths = [shortest] * sum(length // shortest for length in lengths)
            files.append(target / f"{subset}{module.SUFFIX}")
            module.write(files[-1], _read_runs(paths, module, origin, lengths, meter))
        trajectories[subset] = len(lengths)
        frames[subset] = sum(lengths)
    if module is not None:
        metadata = _describe(tier, data_root, module, origin, is_closed=is_closed)
        metadata["dx"] = volume ** (1.0 / tier.dimension)
        files.append(target / "metadata.json")
        text = json.dumps(metadata, indent=1) + "\n"
        write_atomically(files[-1], text.encode(), option="--output")
    return ExportResult(
        format=format,
        split=tier.split,
        size=tier.name,
        folder=target,
        files=tuple(files),
        trajectories=trajectories,
        frames=frames,
        left_out=left_out,
        loses_wall_motion=has_moving_walls,
        bytes=sum(path.stat().st_size for path in files),
    )


def _read_runs(
    paths: Sequence[Path],
    module: Any,  # noqa: ANN401 (gns_npz or lagrangebench_h5)
    origin: NDArray[np.float32],
    lengths: Sequence[int],
    meter: Meter,
) -> Iterator[Run]:
    """Yield trajectories of these lengths; a scenario may have several."""
    numbers = np.array([module.KINDS[name] for name in PARTICLE_KINDS])
    rest = list(lengths)
    for path in paths:
        with read_scenario(path) as file:
            position = file.read("position") - origin
            kinds = numbers[file.read("material")]
        while rest and len(position) >= rest[0]:
            length = rest.pop(0)
            yield position[:length], kinds
            position = position[length:]
        meter.count(1, scenarios=1)


def _describe(
    size: Size,
    root: Path,
    module: Any,  # noqa: ANN401 (gns_npz or lagrangebench_h5)
    origin: NDArray[np.float32],
    *,
    is_closed: bool,
) -> dict[str, Any]:
    """Return what metadata.json says of a data set, and where that is from."""
    recorded = size.measured or read_manifest(root, size.split, size.name, size.major)
    if recorded is None or "acceleration_mean" not in recorded.statistics:
        raise DataError(
            f"{size.split} {size.name}: statistics of train are recorded nowhere, or "
            f"without an acceleration; {suggest_repair(size, root=root)}"
        )
    bounds = np.array(size.bounds) - origin[:, None]
    if module is lagrangebench_h5 and not is_closed:
        # Its cell lists start at 0 and are as long as the bounds are apart: particles
        # beyond the difference would lose their neighbours.
        bounds[:] = [0.0, 1.0]
    metadata: dict[str, Any] = {
        "bounds": bounds.tolist(),
        "default_connectivity_radius": size.task.radius,
        "dim": size.dimension,
        "periodic_boundary_conditions": list(size.box.periodic),
        "dt": size.frame_interval,
        "write_every": 1,
        "sequence_length": min(map(size.frame_count, size.scenarios)),
        "num_particles_max": size.particles,
        "lagbench": {
            "split": size.split,
            "size": size.name,
            "version": size.version,
            "dataset_sha256": recorded.dataset_sha256,
            "origin": origin.tolist(),
        },
    }
    for prefix, name in (("vel", "velocity"), ("acc", "acceleration")):
        metadata[f"{prefix}_mean"] = list(recorded.statistics[f"{name}_mean"])
        # models divide by a deviation: 0 becomes 1
        deviations = recorded.statistics[f"{name}_std"]
        metadata[f"{prefix}_std"] = [deviation or 1.0 for deviation in deviations]
    return metadata
