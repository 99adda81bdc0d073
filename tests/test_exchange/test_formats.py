"""Files of other programs, made by the library of their field, become local splits."""

from __future__ import annotations

import json
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from foreign_files import (
    CODE_BASES,
    FORMATS,
    INTERVAL,
    dataset_of,
    material_of,
    save_lammps,
    table_of,
)
from trajectories import vortex

from lagbench.baselines.predict import predict
from lagbench.baselines.train import train
from lagbench.errors import DataError, LagbenchError, UnreadableFileError, UsageError
from lagbench.exchange import adopt
from lagbench.exchange.local_split import LocalSplit
from lagbench.exchange.names import name_trajectory
from lagbench.exchange.readers import Reading, list_sources
from lagbench.scoring.score import score

RECIPE = """format: 1
recipes: {own/full: {training: {steps: 4, batch: 1, learning_rate: 1.0e-3}}}
"""

MATERIAL = material_of(vortex(0))

SEEDS = {"train": 0, "valid": 1, "test": 2}

LIBRARIES = {"parquet": "pyarrow", "ply": "meshio", "xyz": "ase", "zarr": "zarr"}
LIBRARIES |= dict.fromkeys(("vtk", "vtu", "vtp", "pvd", "vtkhdf"), "pyvista")
"""Libraries of the fields that write a format."""


def import_format(folder: Path, name: str, **options: Any) -> LocalSplit:
    pytest.importorskip(LIBRARIES.get(name, "numpy"))
    save, needed = FORMATS[name]
    source = folder / "runs"
    source.mkdir()
    for number in range(4):
        save(source / f"run{number}", vortex(number))
    return adopt(source, output=folder / "own", **needed, **options)


@pytest.mark.parametrize("name", FORMATS)
def test_a_format_gives_the_same_split_as_arrays(tmp_path: Path, name: str) -> None:
    """Positions, materials and the frame interval; rows are ordered by their ids."""
    own = import_format(tmp_path, name)
    assert own.scenarios == {"train": 2, "valid": 1, "test": 1}
    assert own.materials == (0, 1)
    with xr.open_dataset(own.folder / "full/v1/test/0003.nc") as file:
        np.testing.assert_allclose(file.position, vortex(3), rtol=0, atol=1e-7)
        np.testing.assert_array_equal(file.material, MATERIAL)
        assert file.frame_rate == 1.0 / INTERVAL


def test_the_dump_is_what_ase_reads(tmp_path: Path) -> None:
    """The text above is a dump of LAMMPS for another reader, too."""
    io = pytest.importorskip("ase.io")
    save_lammps(tmp_path / "run", vortex(0))
    frames = io.read(tmp_path / "run.lammpstrj", index=":", format="lammps-dump-text")
    assert len(frames) == 16
    last = frames[-1].get_positions()
    np.testing.assert_allclose(last[:, :2], vortex(0)[-1], atol=1e-7)


def import_code_base(folder: Path, name: str) -> LocalSplit:
    for subset, seed in SEEDS.items():
        CODE_BASES[name](folder, subset, vortex(seed))
    metadata = {
        "bounds": [[0.1, 0.9], [0.1, 0.9]],
        "default_connectivity_radius": 0.1,
        "dim": 2,
        "dt": INTERVAL / 5,
        "write_every": 5,
        "periodic_boundary_conditions": [False, False],
    }
    (folder / "metadata.json").write_text(json.dumps(metadata))
    return adopt(folder, output=folder / "own")


@pytest.mark.parametrize("name", CODE_BASES)
def test_data_sets_of_other_code_bases_are_read(tmp_path: Path, name: str) -> None:
    """Their subsets, kinds and metadata; padding and boundaries are left out."""
    own = import_code_base(tmp_path, name)
    assert own.bounds == ((0.1, 0.9), (0.1, 0.9))
    assert own.materials == (0, 1)
    with xr.open_dataset(own.folder / "full/v1/test/0002.nc") as file:
        np.testing.assert_array_equal(file.position, vortex(SEEDS["test"]))
        assert file.frame_rate == 1.0 / INTERVAL


def test_a_pickle_that_calls_something_is_not_run(tmp_path: Path) -> None:
    class Harm:
        def __reduce__(self) -> Any:
            return (Path.touch, (tmp_path / "harm",))

    for name in ("train", "valid", "test"):
        pair = np.empty(2, object)
        pair[0] = Harm()
        np.savez(tmp_path / f"{name}.npz", simulation_0=pair)
    with pytest.raises(UnreadableFileError, match="wants to call"):
        adopt(tmp_path, output=tmp_path / "own", frame_interval=0.1)
    assert not (tmp_path / "harm").exists()


def test_particles_that_enter_or_leave_are_refused(tmp_path: Path) -> None:
    """With other numbers or ids; the message says what can be done."""
    position = vortex(0)
    frames = [frame[: 144 - 2 * (number > 4)] for number, frame in enumerate(position)]
    columns = []
    for number, frame in enumerate(frames):
        table = pd.DataFrame({"time": number / 8, "x": frame[:, 0], "y": frame[:, 1]})
        columns.append(table)
    pd.concat(columns).to_csv(tmp_path / "left.csv", index=False)
    ids = np.tile(np.arange(144), (16, 1))
    ids[9:, 7] = 200
    np.savez(tmp_path / "other.npz", position=position, id=ids)
    for name, text in (("left.csv", "frame 5: 142"), ("other.npz", "frame 9: 1")):
        with pytest.raises(DataError, match=rf"{text} particles.*cut the trajectory"):
            adopt([tmp_path / name] * 3, output=tmp_path / "own", frame_interval=0.125)


@pytest.mark.parametrize("column", ["time", "t"])
def test_a_table_names_the_column_of_times(tmp_path: Path, column: str) -> None:
    for number in range(3):
        table = table_of(vortex(number)).rename(columns={"time": column})
        table.to_csv(tmp_path / f"{number}.csv", index=False)
    own = adopt(tmp_path, output=tmp_path / "own")
    assert (own.frame_interval, own.interval_source) == (
        INTERVAL,
        f"{column} in the files",
    )
    assert not any("not used" in note for note in own.notes)
    own = adopt(tmp_path, output=tmp_path / "again", frame_interval=INTERVAL)
    assert own.interval_source == "--frame-interval"


@pytest.mark.parametrize("column", ["step", "frame", "timestep"])
def test_numbers_of_steps_are_no_times(tmp_path: Path, column: str) -> None:
    """As decimal numbers, too; they must be even."""
    tables = []
    for number in range(3):
        table = table_of(vortex(number)).rename(columns={"time": column})
        tables.append(table.assign(**{column: 10 * table[column] / INTERVAL}))
        tables[-1].to_csv(tmp_path / f"{number}.csv", index=False)
    with pytest.raises(UsageError, match="--frame-interval"):
        adopt(tmp_path, output=tmp_path / "own")
    own = adopt(tmp_path, output=tmp_path / "own", frame_interval=0.01)
    assert own.frame_interval == 0.01
    gap = tables[0][tables[0][column] != 50]
    gap.to_csv(tmp_path / "0.csv", index=False)
    with pytest.raises(DataError, match=r"frame 5.*even"):
        adopt(tmp_path, output=tmp_path / "again", frame_interval=0.01)


@pytest.mark.parametrize(
    ("columns", "text"),
    [
        (["time"], r"two rows have id .*a column time"),
        (["time", "id"], r"3 files, each taken for a frame.*a column time"),
    ],
)
def test_a_table_without_times_is_a_frame(
    tmp_path: Path, columns: list[str], text: str
) -> None:
    for number in range(3):
        table = table_of(vortex(number)).drop(columns=columns)
        table.to_csv(tmp_path / f"{number}.csv", index=False)
    with pytest.raises(LagbenchError, match=text):
        adopt(tmp_path, output=tmp_path / "own")


def test_a_double_row_is_named(tmp_path: Path) -> None:
    table = table_of(vortex(0)).reset_index(drop=True)
    double = table[(table["time"] == 5 * INTERVAL) & (table["id"] == 7)]
    pd.concat([table, double]).to_csv(tmp_path / "run.csv", index=False)
    with pytest.raises(DataError, match=r"two rows have time 0\.625 and id 7"):
        adopt([tmp_path / "run.csv"] * 3, output=tmp_path / "own")


def test_datasets_are_adopted_without_files(tmp_path: Path) -> None:
    """The trajectories of one dataset, or a list of datasets."""
    runs = xr.concat([dataset_of(vortex(seed)) for seed in range(3)], dim="trajectory")
    own = adopt(runs, output=tmp_path / "own")
    again = adopt(
        [dataset_of(vortex(seed)) for seed in range(3)], output=tmp_path / "b"
    )
    assert own.scenarios == again.scenarios == {"train": 1, "valid": 1, "test": 1}
    assert own.materials == (0, 1)


@pytest.mark.parametrize("suffix", [".h5", ".nc"])
def test_positions_stay_in_the_file_until_they_are_read(
    tmp_path: Path, suffix: str
) -> None:
    """Of 8 MB not one is in memory before frames are asked for."""
    path = tmp_path / f"run{suffix}"
    position = np.zeros((200, 5000, 2), np.float32)
    dataset_of(position).drop_vars("id").to_netcdf(path)
    (source,) = list_sources(path, Reading(positions="position")).sources
    tracemalloc.start()
    trajectory = name_trajectory(source.open(), "run", {})
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    trajectory.close()
    assert trajectory.frames == 200
    assert peak < 1 << 20


@pytest.mark.slow
@pytest.mark.parametrize("name", [*FORMATS, *CODE_BASES])
def test_a_format_is_trained_on_and_scored(tmp_path: Path, name: str) -> None:
    """One epoch, prediction and score."""
    import_any = import_format if name in FORMATS else import_code_base
    own = import_any(tmp_path, name)
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text(RECIPE)
    train(
        "gns",
        str(own.folder),
        output=tmp_path / "run",
        recipe=str(recipe),
        settings=("model.latent=8", "model.layers=1"),
        device="cpu",
    )
    predict(
        tmp_path / "run/weights.safetensors",
        tmp_path / "predictions.nc",
        root=tmp_path,
        device="cpu",
    )
    card = score(tmp_path / "predictions.nc", root=tmp_path, write=False)
    assert np.isfinite(card.scores["submission"]["position_rmse"].values).all()
