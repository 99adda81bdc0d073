"""Open a generated data set as one lazy xarray.Dataset."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from lagbench.data import registry
from lagbench.data.local import locate, remedy
from lagbench.data.scenario import damaged
from lagbench.errors import DataError

if TYPE_CHECKING:
    import xarray as xr

    from lagbench.data.layout import ScenarioKey
    from lagbench.data.manifest import Manifest


# Dask reads position and velocity in chunks of about this size [bytes]
CHUNK_BYTES = 4 << 20
PADDING = -1  # material of particles that a scenario does not have


def list_splits() -> tuple[str, ...]:
    """Return the names of all splits in the registry, sorted."""
    return tuple(sorted(registry.load().splits))


def load_manifest(
    split: str | Path, *, size: str | None = None, root: str | Path | None = None
) -> Manifest:
    """Return the manifest of a generated data set.

    Args:
        split: name of the split, or path of a local split's folder.
        size: name of the size; the only one that is there when None.
        root: folder of all data sets; else LAGBENCH_ROOT, else the user data folder.

    Raises:
        UsageError: unknown split or size.
        DataError: nothing is generated, or the manifest is damaged.
    """
    from lagbench.data.manifest import read_manifest

    from .copy import bring

    entry, folder, _ = locate(split, size, root=root)
    bring(entry, folder)
    manifest = read_manifest(folder, entry.split, entry.name, entry.major)
    if manifest is None:
        where = str(entry.folder(folder))
        fix = remedy(entry, root=folder)
        raise DataError("the data set has no manifest", where=where, fix=fix)
    return manifest


def open_split(
    split: str | Path,
    *,
    subset: str = "test",
    size: str | None = None,
    root: str | Path | None = None,
) -> xr.Dataset:
    """Open one subset of a generated data set; arrays are read when computed.

    Args:
        split: name of the split, or path of a local split's folder.
        subset: train, valid, test or, for multimaterial, extra.
        size: name of the size; the only one that is there when None.
        root: folder of all data sets; else LAGBENCH_ROOT, else the user data folder.

    Returns:
        ``position`` and ``velocity`` with dims (scenario, frame, particle, space) as
        dask arrays, ``material`` (scenario, particle), ``particle_mass`` (scenario), in
        a closed box ``wall_velocity`` (scenario, frame, wall, space), and
        ``frame_count`` and ``particle_count`` (scenario). Coordinate ``scenario`` holds
        the ids. Scenarios with fewer frames or particles than the largest are padded
        with NaN, material with -1.

    Raises:
        UsageError: unknown split, size or subset.
        DataError: scenarios are missing, damaged, or of another version.
    """
    from .copy import scenario_files

    entry, folder, _ = locate(split, size, root=root)
    paths = scenario_files(entry, folder, (subset,))
    fix = remedy(entry, root=folder)
    # What stays open after an error is closed by whichever thread collects garbage.
    with ExitStack() as opened:
        scenarios = [
            opened.enter_context(_open_scenario(path, entry.key(i), fix))
            for i, path in paths.items()
        ]
        joined = _joined(scenarios, list(paths))
        # local splits are found by it
        joined.encoding["source"] = str(next(iter(paths.values())).absolute())
        joined.set_close(opened.pop_all().close)
    return joined


def _joined(scenarios: Sequence[xr.Dataset], numbers: Sequence[int]) -> xr.Dataset:
    """Return scenarios along a new first dimension; those of unequal lengths are
    padded.
    """
    import xarray as xr

    ids = xr.Variable(
        "scenario", list(numbers), {"long_name": "scenario id", "units": "1"}
    )
    frames = [scenario.sizes["frame"] for scenario in scenarios]
    particles = [scenario.sizes["particle"] for scenario in scenarios]
    longest = scenarios[frames.index(max(frames))]
    fullest = scenarios[particles.index(max(particles))]
    labels = {"frame": longest["frame"], "particle": fullest["particle"]}
    padded = [
        scenario.drop_vars("time").reindex(labels, fill_value={"material": PADDING})
        for scenario in scenarios
    ]
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
        frames,
        {"long_name": "recorded frames", "units": "1"},
    )
    joined["particle_count"] = (
        "scenario",
        particles,
        {"long_name": "particles", "units": "1"},
    )
    for variable in joined.variables.values():
        variable.attrs.pop("content_sha256", None)
    return joined


def _open_scenario(path: Path, key: ScenarioKey, fix: str) -> xr.Dataset:
    """Open one file lazily and check that it is the scenario that its path says."""
    import xarray as xr

    with ExitStack() as opened:
        try:
            stored = opened.enter_context(
                xr.open_dataset(path, engine="netcdf4", cache=False)
            )
            frame_bytes = (
                stored["position"].dtype.itemsize
                * stored.sizes["particle"]
                * stored.sizes["space"]
            )
            scenario = stored.chunk(
                frame=max(1, CHUNK_BYTES // frame_bytes), particle=-1, space=-1
            )
            found = {
                name: scenario.attrs[name]
                for name in ("split", "size", "scenario", "version")
            }
        except Exception as error:  # HDF5 on damaged bytes raises nearly any type
            raise damaged(path, f"{type(error).__name__}: {error}", fix=fix) from error
        same_major = str(found["version"]).split(".")[0] == str(key.major)
        named = (found["split"], found["size"], int(found["scenario"]))
        if not same_major or named != (key.split, key.size, key.scenario):
            raise DataError(
                "a scenario file is another scenario",
                where=str(path),
                expected=key,
                got=found,
            )
        scenario.set_close(opened.pop_all().close)
    return scenario
