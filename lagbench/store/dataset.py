"""Open a generated data set as one lazy xarray.Dataset."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from lagbench.data import registry
from lagbench.data.box import AXES, parse_obstacle
from lagbench.data.layout import major_of
from lagbench.data.local import locate, suggest_repair
from lagbench.data.manifest import read_manifest
from lagbench.data.scenario import parse_viscosity, reading_error, select_parameters
from lagbench.errors import DataError, UsageError

from .copy import scenario_files, update_working_copy

if TYPE_CHECKING:
    from lagbench.data.layout import ScenarioKey
    from lagbench.data.manifest import Manifest


CHUNK_BYTES = 4 << 20
"""Dask reads position and velocity in chunks of about this size [bytes]."""

MOST_LETTERS = 200
"""Letters of a library's error in a message."""

POSITION_AXES = ("frame", "particle", "space")
PADDING = -1
"""Material of particles that a scenario does not have."""


def list_splits() -> tuple[str, ...]:
    """Return the names of all splits in the registry, sorted."""
    return tuple(sorted(registry.load().splits))


def load_manifest(
    split: str | Path, size: str | None = None, *, root: str | Path | None = None
) -> Manifest:
    """Return the manifest of a generated data set.

    Args:
        split: name of the split, or path of a local split's folder.
        size: name of the size; None takes the only one with data, or mini where several
            have data.
        root: folder of all data sets; else LAGBENCH_ROOT, else the user data folder.

    Raises:
        UsageError: unknown split or size.
        DataError: nothing is generated, or the manifest is damaged.
    """
    tier, root_folder, _ = locate(split, size, root=root)
    update_working_copy(tier, root_folder)
    manifest = read_manifest(root_folder, tier.split, tier.name, tier.major)
    if manifest is None:
        raise DataError(
            f"the data set has no manifest; {suggest_repair(tier, root=root_folder)}",
            where=str(tier.folder(root_folder)),
        )
    return manifest


def open_split(
    name: str | Path | None = None,
    size: str | None = None,
    *,
    split: str | Path | None = None,
    subset: str = "test",
    root: str | Path | None = None,
) -> xr.Dataset:
    """Open one subset of a generated data set; arrays are read when computed.

    Args:
        name: name of the split, or path of a local split's folder.
        size: name of the size; None takes the only one with data, or mini where several
            have data.
        split: the same as ``name``.
        subset: train, valid or test; also shift or extra where the split has it.
        root: folder of all data sets; else LAGBENCH_ROOT, else the user data folder.

    Returns:
        ``position`` and ``velocity`` with dims (scenario, frame, particle, space) as
        dask arrays, ``material`` (scenario, particle), ``particle_mass`` (scenario), in
        a full box with walls ``wall_velocity`` (scenario, frame, wall, space), where a
        force drives the flow ``body_force`` (scenario, frame, layer, space), and
        ``frame_count`` and ``particle_count`` (scenario). Coordinate ``scenario`` holds
        the ids, ``viscosity`` (scenario) the kinematic viscosity that a model is given
        [length^2/s], NaN where none is known; where there is a fixed obstacle,
        ``obstacle`` (scenario, disc) holds its centre and radius [length], NaN in
        scenarios without one. Scenarios with fewer frames or particles than the largest
        are padded with NaN, material with -1.

    Raises:
        UsageError: unknown split, size or subset.
        DataError: scenarios are missing, damaged, or of another version.
    """
    if name is not None and split is not None:
        raise UsageError(
            f"split={split!r} and {str(name)!r} both name the split; for train, valid "
            "or test use subset="
        )
    name = split if name is None else name
    if name is None or name in ("train", "valid", "test"):
        raise UsageError(
            f"{name!r} is no split; name one, as in "
            'open_split("cavity", subset="train")'
        )
    tier, root_folder, _ = locate(name, size, root=root)
    paths = scenario_files(tier, root_folder, (subset,))
    hint = suggest_repair(tier, root=root_folder)
    # Files left open after an error would be closed by the garbage collector, in any
    # thread.
    with ExitStack() as open_files:
        scenarios = []
        viscosities = []
        obstacles = []
        for scenario, path in paths.items():
            file = _open_scenario(path, tier.key(scenario), hint)
            scenarios.append(open_files.enter_context(file))
            parameters = select_parameters(file.attrs, where=str(path))
            stated = parse_viscosity(parameters.get("viscosity"), where=str(path))
            viscosity = tier.viscosity(stated)
            viscosities.append(math.nan if viscosity is None else viscosity)
            obstacle = parse_obstacle(parameters, tier.dimension, where=str(path))
            if obstacle is None:
                obstacle = np.full(tier.dimension + 1, np.nan, np.float32)
            obstacles.append(obstacle)
        layer_counts = {s.sizes["layer"] for s in scenarios if "layer" in s.sizes}
        if len(layer_counts) > 1:
            raise DataError(
                f"scenarios have forces in {sorted(layer_counts)} layers; {hint}",
                where=f"{tier.folder(root_folder)}, variable 'body_force'",
            )
        try:
            joined = _join_scenarios(scenarios, list(paths))
        except (ValueError, TypeError) as error:
            raise DataError(
                "scenario files do not fit together: "
                f"{f'{type(error).__name__}: {error}'[:MOST_LETTERS]}; lagbench "
                f"verify names wrong files; {hint}",
                where=str(tier.folder(root_folder)),
            ) from error
        # Lengths have no unit, as in scenario files.
        attributes = {"long_name": "given kinematic viscosity", "units": "s-1"}
        coordinate = ("scenario", viscosities, attributes)
        joined = joined.assign_coords(viscosity=coordinate)
        if np.isfinite(obstacles).any():
            attributes = {"long_name": "centre and radius of the fixed obstacle"}
            numbers = [*AXES[: tier.dimension], "radius"]
            joined = joined.assign_coords(
                disc=numbers, obstacle=(("scenario", "disc"), obstacles, attributes)
            )
        # Local splits are recognised by it.
        first_path = next(iter(paths.values()))
        joined.encoding["source"] = str(first_path.absolute())
        joined.set_close(open_files.pop_all().close)
    return joined


def _join_scenarios(
    scenarios: Sequence[xr.Dataset], numbers: Sequence[int]
) -> xr.Dataset:
    """Return scenarios along a new first dimension, padded to equal lengths."""
    ids = xr.Variable(
        "scenario", list(numbers), {"long_name": "scenario id", "units": "1"}
    )
    frame_counts = [scenario.sizes["frame"] for scenario in scenarios]
    particle_counts = [scenario.sizes["particle"] for scenario in scenarios]
    longest = scenarios[frame_counts.index(max(frame_counts))]
    largest = scenarios[particle_counts.index(max(particle_counts))]
    labels = {"frame": longest["frame"], "particle": largest["particle"]}
    padded = []
    for scenario in scenarios:
        timeless = scenario.drop_vars("time")
        padded.append(timeless.reindex(labels, fill_value={"material": PADDING}))
    joined = xr.concat(
        padded,
        dim=ids,
        data_vars="all",
        coords="minimal",
        join="exact",
        combine_attrs="drop_conflicts",
    )
    joined = joined.assign_coords(scenario=ids, time=longest["time"].compute())
    joined["frame_count"] = (
        "scenario",
        frame_counts,
        {"long_name": "recorded frames", "units": "1"},
    )
    joined["particle_count"] = (
        "scenario",
        particle_counts,
        {"long_name": "particles", "units": "1"},
    )
    for variable in joined.variables.values():
        variable.attrs.pop("content_sha256", None)
    return joined


def _open_scenario(path: Path, key: ScenarioKey, fix: str) -> xr.Dataset:
    """Open one file lazily and check that it is the scenario that its path says."""
    with ExitStack() as stack:
        try:
            # h5netcdf reads under the lock of h5py. With netCDF4 Python crashes when a
            # thread of Dask frees a file while another file is being opened.
            file = stack.enter_context(
                xr.open_dataset(path, engine="h5netcdf", cache=False)
            )
            value_bytes = file["position"].dtype.itemsize
            frame_bytes = value_bytes * file.sizes["particle"] * file.sizes["space"]
            frames_per_chunk = max(1, CHUNK_BYTES // frame_bytes)
            scenario = file.chunk(frame=frames_per_chunk, particle=-1, space=-1)
            position = file["position"]
            if position.dtype.kind != "f" or position.dims != POSITION_AXES:
                text = f"position holds {position.dtype}, with axes {position.dims}"
                raise ValueError(text)
            for name in ("frame", "particle"):
                numbers = np.arange(file.sizes[name])
                if not np.array_equal(file[name].to_numpy(), numbers):
                    text = f"{name} holds other numbers than 0 to {len(numbers) - 1}"
                    raise ValueError(text)
            stated = (
                file.attrs["split"],
                file.attrs["size"],
                int(file.attrs["scenario"]),
                major_of(file.attrs["version"]),
            )
            file["time"]  # a file of ours has it
        except Exception as error:  # HDF5 on damaged bytes raises nearly any type
            raise reading_error(path, error, fix=fix) from error
        expected = (key.split, key.size, key.scenario, key.major)
        if stated != expected:
            raise DataError(
                f"a file holds another scenario: got {stated}, expected {expected}; "
                f"{fix}",
                where=str(path),
            )
        scenario.set_close(stack.pop_all().close)
    return scenario
