"""Files of other programs, made by the library of their field, become local splits."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pandas as pd
import pytest
import xarray as xr
from trajectories import vortex

from lagbench.baselines.predict import predict
from lagbench.baselines.train import train
from lagbench.errors import DataError, UnreadableFileError
from lagbench.exchange import adopt
from lagbench.scoring.score import score

INTERVAL = 0.125
RECIPE = """format: 1
recipes: {own/full: {training: {steps: 4, batch: 1, learning_rate: 1.0e-3}}}
"""

IDS = np.random.default_rng(0).permutation(144)
"""Identity of the particle in each row, where a format has one."""

MATERIAL = (np.arange(144) % 3 == 0).astype(int)
"""A third of the particles is jelly."""

NAMES = ("time", "particle", "space")


def solid(position: np.ndarray) -> np.ndarray:
    """Return positions with a third component, 0."""
    return np.concatenate([position, 0 * position[..., :1]], axis=-1)


def table_of(position: np.ndarray) -> pd.DataFrame:
    """Return a table with a row for each particle and time, in the order of IDS."""
    frames = []
    for number, frame in enumerate(position):
        columns = {"time": INTERVAL * number, "id": IDS, "material": MATERIAL[IDS]}
        columns |= {"x": frame[IDS, 0], "y": frame[IDS, 1]}
        frames.append(pd.DataFrame(columns))
    return pd.concat(frames)


def save_csv(path: Path, position: np.ndarray) -> None:
    table_of(position).to_csv(path.with_suffix(".csv"), index=False)


def save_parquet(path: Path, position: np.ndarray) -> None:
    table_of(position).to_parquet(path.with_suffix(".parquet"))


def save_vtk(path: Path, position: np.ndarray, suffix: str) -> None:
    """Write a folder of frames whose names sort wrongly as text."""
    pyvista = pytest.importorskip("pyvista")
    path.mkdir()
    for number, frame in enumerate(solid(position)):
        mesh = pyvista.PolyData(frame[IDS])
        mesh.point_data["id"] = IDS
        mesh.point_data["material"] = MATERIAL[IDS]
        mesh.field_data["TimeValue"] = [INTERVAL * number]
        if suffix == "vtu":
            mesh = mesh.cast_to_unstructured_grid()
        mesh.save(path / f"frame_{number}.{suffix}")


def save_pvd(path: Path, position: np.ndarray) -> None:
    """Write a collection of ParaView beside its files."""
    save_vtk(path, position, "vtp")
    lines = []
    for number in range(len(position)):
        lines.append(
            f'<DataSet timestep="{INTERVAL * number}" file="frame_{number}.vtp"/>'
        )
    text = f"<VTKFile type='Collection'><Collection>{''.join(lines)}</Collection>"
    (path / "film.pvd").write_text(f"{text}</VTKFile>")


def save_ply(path: Path, position: np.ndarray) -> None:
    meshio = pytest.importorskip("meshio")
    path.mkdir()
    for number, frame in enumerate(solid(position)):
        data = {"id": IDS.astype("i4"), "material": MATERIAL[IDS].astype("i4")}
        mesh = meshio.Mesh(frame[IDS], [("triangle", [[0, 1, 2]])], point_data=data)
        mesh.write(path / f"{number}.ply")


def save_lammps(path: Path, position: np.ndarray) -> None:
    lines = []
    for number, frame in enumerate(solid(position)):
        lines += ["ITEM: TIMESTEP", str(50 * number), "ITEM: NUMBER OF ATOMS", "144"]
        lines += ["ITEM: BOX BOUNDS ff ff pp", "0 1", "0 1", "-0.5 0.5"]
        lines.append("ITEM: ATOMS id type xs ys zs")
        for row in IDS:
            x, y, _ = frame[row].tolist()
            lines.append(f"{row} {MATERIAL[row] + 1} {x!r} {y!r} 0.5")
    path.with_suffix(".lammpstrj").write_text("\n".join(lines) + "\n")


def save_xyz(path: Path, position: np.ndarray) -> None:
    ase = pytest.importorskip("ase")
    from ase.io import write

    frames = []
    for number, frame in enumerate(solid(position)):
        atoms = ase.Atoms("Ar144", positions=frame[IDS])
        atoms.info["Time"] = INTERVAL * number
        atoms.arrays["id"] = IDS
        atoms.arrays["material"] = MATERIAL[IDS]
        frames.append(atoms)
    write(path.with_suffix(".xyz"), frames, format="extxyz")


def dataset_of(position: np.ndarray) -> xr.Dataset:
    return xr.Dataset(
        {
            "position": (NAMES, position[:, IDS]),
            "material": ("particle", MATERIAL[IDS]),
        },
        coords={
            "time": ("time", 1000.0 * INTERVAL * np.arange(16), {"units": "ms"}),
            "id": ("particle", IDS),
        },
    )


def save_netcdf(path: Path, position: np.ndarray) -> None:
    dataset_of(position).transpose("space", ...).to_netcdf(path.with_suffix(".nc"))


def save_zarr(path: Path, position: np.ndarray) -> None:
    pytest.importorskip("zarr")
    dataset_of(position).to_zarr(path.with_suffix(".zarr"), zarr_format=2)


def save_npz(path: Path, position: np.ndarray) -> None:
    times = INTERVAL * np.arange(16)
    np.savez(path, position=position, time=times, material=MATERIAL)


def save_hdf5(path: Path, position: np.ndarray) -> None:
    with h5py.File(path.with_suffix(".h5"), "w") as file:
        file["fluid/coords"] = position
        file["fluid/type"] = MATERIAL
        file["fluid/time"] = INTERVAL * np.arange(16)


def save_vtkhdf(path: Path, position: np.ndarray) -> None:
    """Write by pyvista, without times, each frame alone."""
    save_vtk(path, position, "vtkhdf")


FORMATS: dict[str, tuple[Callable[[Path, np.ndarray], None], dict[str, Any]]] = {
    "csv": (save_csv, {}),
    "parquet": (save_parquet, {}),
    "vtk": (lambda path, position: save_vtk(path, position, "vtk"), {}),
    "vtu": (lambda path, position: save_vtk(path, position, "vtu"), {}),
    "vtp": (lambda path, position: save_vtk(path, position, "vtp"), {}),
    "pvd": (save_pvd, {}),
    "ply": (save_ply, {"frame_interval": INTERVAL}),
    "lammps": (
        save_lammps,
        {"frame_interval": INTERVAL, "kinds": "1=liquid,2=jelly"},
    ),
    "xyz": (save_xyz, {}),
    "netcdf": (save_netcdf, {}),
    "zarr": (save_zarr, {}),
    "npz": (save_npz, {}),
    "hdf5": (
        save_hdf5,
        {"positions": "fluid/coords", "kinds": "0=liquid,1=jelly"},
    ),
}


def import_format(folder: Path, name: str, **options: Any) -> Any:
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


SEEDS = {"train": 0, "valid": 1, "test": 2}


def save_gns(folder: Path, name: str) -> None:
    """Write a run as the GNS programs do, with a tuple in an object array."""
    pair = np.empty(2, object)
    pair[0] = vortex(SEEDS[name])
    pair[1] = np.where(MATERIAL, 7, 5)
    np.savez(folder / f"{name}.npz", simulation_0=pair)


def save_lagrangebench(folder: Path, name: str) -> None:
    """Write a run as LagrangeBench's own script does, with two rows of padding."""
    position = np.concatenate([vortex(SEEDS[name]), np.zeros((16, 2, 2), "f4")], axis=1)
    kinds = np.concatenate([np.where(MATERIAL, 4, 0), [-1, -1]])
    with h5py.File(folder / f"{name}.h5", "w") as file:
        file.create_dataset("00000/position", data=position, compression="gzip")
        file["00000/particle_type"] = kinds


def save_neuralmpm(folder: Path, name: str) -> None:
    """Write a run as NeuralMPM's files are: positions, a boundary and GNS's kinds."""
    (folder / name).mkdir()
    with h5py.File(folder / name / "sim_0.h5", "w") as file:
        file["particles"] = vortex(SEEDS[name])
        file["boundary"] = np.zeros((16, 8, 2), "f4")
        file["types"] = np.where(MATERIAL, 7, 5)


@pytest.mark.parametrize("save", [save_gns, save_lagrangebench, save_neuralmpm])
def test_data_sets_of_other_code_bases_are_read(
    tmp_path: Path, save: Callable[[Path, str], None]
) -> None:
    """Their subsets, kinds and metadata; padding and boundaries are left out."""
    for name in SEEDS:
        save(tmp_path, name)
    metadata = {
        "bounds": [[0.1, 0.9], [0.1, 0.9]],
        "default_connectivity_radius": 0.1,
        "dim": 2,
        "dt": INTERVAL / 5,
        "write_every": 5,
        "periodic_boundary_conditions": [False, False],
    }
    (tmp_path / "metadata.json").write_text(json.dumps(metadata))
    own = adopt(tmp_path, output=tmp_path / "own")
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


def test_datasets_are_adopted_without_files(tmp_path: Path) -> None:
    """The trajectories of one dataset, or a list of datasets."""
    runs = xr.concat([dataset_of(vortex(seed)) for seed in range(3)], dim="trajectory")
    own = adopt(runs, output=tmp_path / "own")
    again = adopt(
        [dataset_of(vortex(seed)) for seed in range(3)], output=tmp_path / "b"
    )
    assert own.scenarios == again.scenarios == {"train": 1, "valid": 1, "test": 1}
    assert own.materials == (0, 1)


@pytest.mark.slow
@pytest.mark.parametrize("name", FORMATS)
def test_a_format_is_trained_on_and_scored(tmp_path: Path, name: str) -> None:
    own = import_format(tmp_path, name)
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
