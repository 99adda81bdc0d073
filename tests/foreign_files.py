"""Trajectories as files of other programs, written by the library of their field."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import NDArray

INTERVAL = 0.125

NAMES = ("time", "particle", "space")


def ids_of(position: NDArray[np.floating]) -> NDArray[np.int64]:
    """Return the identity of the particle in each row, where a format has one."""
    return np.random.default_rng(0).permutation(position.shape[1])


def material_of(position: NDArray[np.floating]) -> NDArray[np.int64]:
    """Return materials: a third of the particles is jelly."""
    return (np.arange(position.shape[1]) % 3 == 0).astype(int)


def solid(position: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return positions with a third component, 0."""
    return np.concatenate([position, 0 * position[..., :1]], axis=-1)


def table_of(position: NDArray[np.floating]) -> pd.DataFrame:
    """Return a table with a row for each particle and time."""
    frames = []
    for number, frame in enumerate(position):
        columns = {
            "time": INTERVAL * number,
            "id": ids_of(position),
            "material": material_of(position)[ids_of(position)],
        }
        columns |= {"x": frame[ids_of(position), 0], "y": frame[ids_of(position), 1]}
        frames.append(pd.DataFrame(columns))
    return pd.concat(frames)


def save_csv(path: Path, position: NDArray[np.floating]) -> None:
    table_of(position).to_csv(path.with_suffix(".csv"), index=False)


def save_parquet(path: Path, position: NDArray[np.floating]) -> None:
    table_of(position).to_parquet(path.with_suffix(".parquet"))


def save_vtk(path: Path, position: NDArray[np.floating], suffix: str) -> None:
    """Write a folder of frames whose names sort wrongly as text."""
    import pyvista

    path.mkdir()
    for number, frame in enumerate(solid(position)):
        mesh = pyvista.PolyData(frame[ids_of(position)])
        mesh.point_data["id"] = ids_of(position)
        mesh.point_data["material"] = material_of(position)[ids_of(position)]
        mesh.field_data["TimeValue"] = [INTERVAL * number]
        if suffix == "vtu":
            mesh = mesh.cast_to_unstructured_grid()
        mesh.save(path / f"frame_{number}.{suffix}")


def save_pvd(path: Path, position: NDArray[np.floating]) -> None:
    """Write a collection of ParaView beside its files."""
    save_vtk(path, position, "vtp")
    lines = []
    for number in range(len(position)):
        lines.append(
            f'<DataSet timestep="{INTERVAL * number}" file="frame_{number}.vtp"/>'
        )
    text = f"<VTKFile type='Collection'><Collection>{''.join(lines)}</Collection>"
    (path / "film.pvd").write_text(f"{text}</VTKFile>")


def save_ply(path: Path, position: NDArray[np.floating]) -> None:
    import meshio

    path.mkdir()
    for number, frame in enumerate(solid(position)):
        data = {
            "id": ids_of(position).astype("i4"),
            "material": material_of(position)[ids_of(position)].astype("i4"),
        }
        mesh = meshio.Mesh(
            frame[ids_of(position)], [("triangle", [[0, 1, 2]])], point_data=data
        )
        mesh.write(path / f"{number}.ply")


def save_lammps(path: Path, position: NDArray[np.floating]) -> None:
    ids = ids_of(position)
    with path.with_suffix(".lammpstrj").open("w") as file:
        for number, frame in enumerate(position):
            file.write(f"ITEM: TIMESTEP\n{50 * number}\n")
            file.write(f"ITEM: NUMBER OF ATOMS\n{len(frame)}\n")
            file.write("ITEM: BOX BOUNDS ff ff pp\n0 1\n0 1\n-0.5 0.5\n")
            file.write("ITEM: ATOMS id type xs ys zs\n")
            columns = {"id": ids, "type": material_of(position)[ids] + 1}
            columns |= {"xs": frame[ids, 0], "ys": frame[ids, 1], "zs": 0.5}
            rows = pd.DataFrame(columns)
            rows.to_csv(file, sep=" ", header=False, index=False)


def save_xyz(path: Path, position: NDArray[np.floating]) -> None:
    import ase
    from ase.io import write

    frames = []
    for number, frame in enumerate(solid(position)):
        atoms = ase.Atoms(["Ar"] * len(frame), positions=frame[ids_of(position)])
        atoms.info["Time"] = INTERVAL * number
        atoms.arrays["id"] = ids_of(position)
        atoms.arrays["material"] = material_of(position)[ids_of(position)]
        frames.append(atoms)
    write(path.with_suffix(".xyz"), frames, format="extxyz")


def dataset_of(position: NDArray[np.floating]) -> xr.Dataset:
    return xr.Dataset(
        {
            "position": (NAMES, position[:, ids_of(position)]),
            "material": ("particle", material_of(position)[ids_of(position)]),
        },
        coords={
            "time": (
                "time",
                1000.0 * INTERVAL * np.arange(len(position)),
                {"units": "ms"},
            ),
            "id": ("particle", ids_of(position)),
        },
    )


def save_netcdf(path: Path, position: NDArray[np.floating]) -> None:
    dataset_of(position).transpose("space", ...).to_netcdf(path.with_suffix(".nc"))


def save_zarr(path: Path, position: NDArray[np.floating]) -> None:
    dataset_of(position).to_zarr(path.with_suffix(".zarr"), zarr_format=2)


def save_npz(path: Path, position: NDArray[np.floating]) -> None:
    times = INTERVAL * np.arange(len(position))
    np.savez(path, position=position, time=times, material=material_of(position))


def save_hdf5(path: Path, position: NDArray[np.floating]) -> None:
    with h5py.File(path.with_suffix(".h5"), "w") as file:
        file["fluid/coords"] = position
        file["fluid/type"] = material_of(position)
        file["fluid/time"] = INTERVAL * np.arange(len(position))


def save_vtkhdf(path: Path, position: NDArray[np.floating]) -> None:
    """Write by pyvista, without times, each frame alone."""
    save_vtk(path, position, "vtkhdf")


def save_gns(folder: Path, name: str, position: NDArray[np.floating]) -> None:
    """Write a run as the GNS programs do, with a tuple in an object array."""
    pair = np.empty(2, object)
    pair[0] = position
    pair[1] = np.where(material_of(position), 7, 5)
    np.savez(folder / f"{name}.npz", simulation_0=pair)


def save_lagrangebench(folder: Path, name: str, position: NDArray[np.floating]) -> None:
    """Write a run as LagrangeBench's own script does, with two rows of padding."""
    padded = np.concatenate([position, 0 * position[:, :2]], axis=1)
    kinds = np.concatenate([np.where(material_of(position), 4, 0), [-1, -1]])
    with h5py.File(folder / f"{name}.h5", "w") as file:
        file.create_dataset("00000/position", data=padded, compression="gzip")
        file["00000/particle_type"] = kinds


def save_neuralmpm(folder: Path, name: str, position: NDArray[np.floating]) -> None:
    """Write a run as NeuralMPM's files are: positions, a boundary and GNS's kinds."""
    (folder / name).mkdir()
    with h5py.File(folder / name / "sim_0.h5", "w") as file:
        file["particles"] = position
        file["boundary"] = 0 * position[:, :8]
        file["types"] = np.where(material_of(position), 7, 5)


FORMATS: dict[
    str, tuple[Callable[[Path, NDArray[np.floating]], None], dict[str, Any]]
] = {
    "csv": (save_csv, {}),
    "parquet": (save_parquet, {}),
    "vtk": (lambda path, position: save_vtk(path, position, "vtk"), {}),
    "vtu": (lambda path, position: save_vtk(path, position, "vtu"), {}),
    "vtp": (lambda path, position: save_vtk(path, position, "vtp"), {}),
    "pvd": (save_pvd, {}),
    "vtkhdf": (save_vtkhdf, {"frame_interval": INTERVAL}),
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
"""What writes a trajectory in each format, and the options of its import."""


CODE_BASES = {
    "gns-npz": save_gns,
    "lagrangebench-h5": save_lagrangebench,
    "neuralmpm": save_neuralmpm,
}
"""What writes a subset as a data set of another code base has it."""
