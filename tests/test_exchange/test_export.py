"""Exports are what the programs that read them expect, and come back as they were."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import xarray as xr
from numpy.typing import NDArray
from trajectories import vortex

from lagbench.errors import UsageError
from lagbench.exchange import adopt, export
from lagbench.exchange.local_split import LocalSplit

MATERIAL = np.arange(144) % 4
BOUNDS = ((0.125, 0.875), (0.125, 0.875))


@pytest.fixture(scope="module")
def split(tmp_path_factory: pytest.TempPathFactory) -> LocalSplit:
    """Three runs of 16, 16 and 20 frames with all materials and moving walls."""
    folder = tmp_path_factory.mktemp("source")
    for number, frames in enumerate((16, 16, 20)):
        walls = np.zeros((frames, 4, 2))
        walls[:, 3, 0] = 0.5
        np.savez(
            folder / str(number),
            position=vortex(number, frames),
            material=MATERIAL,
            wall_velocity=walls,
        )
    return adopt(
        folder,
        output=folder / "own",
        radius=0.1,
        frame_interval=0.1,
        bounds=BOUNDS,
        full_box=True,
        input_frames=5,
        horizon=8,
        frames_of_interest=(7, 12),
    )


def read_positions(split: LocalSplit) -> dict[str, NDArray[Any]]:
    positions = {}
    for path in split.folder.rglob("0*.nc"):
        with xr.open_dataset(path) as file:
            positions[path.parent.name] = file.position.values
    return positions


@pytest.mark.parametrize("name", ["gns-npz", "lagrangebench-h5"])
def test_an_export_comes_back(split: LocalSplit, tmp_path: Path, name: str) -> None:
    """Positions, materials, interval and box, from where the export measures them."""
    export(split.folder, format=name, output=tmp_path / "out")
    back = adopt(tmp_path / "out", output=tmp_path / "back")
    assert back.materials == split.materials
    metadata = json.loads((tmp_path / "out/metadata.json").read_text())
    origin = np.array(metadata["lagbench"]["origin"])
    np.testing.assert_allclose(
        np.array(back.bounds) + origin[:, None], split.bounds, atol=1e-7
    )
    positions = read_positions(back)
    for subset, position in read_positions(split).items():
        frames = len(positions[subset])
        np.testing.assert_allclose(
            positions[subset] + origin, position[:frames], rtol=0, atol=1e-7
        )


def test_gns_programs_read_an_export(split: LocalSplit, tmp_path: Path) -> None:
    """Every key is positions and kinds; the metadata have statistics per frame."""
    export(split.folder, format="gns-npz", output=tmp_path)
    with np.load(tmp_path / "train.npz", allow_pickle=True) as file:
        (item,) = [file[key] for key in file.files]
    position, kinds = item
    np.testing.assert_array_equal(kinds, np.array([5, 7, 6, 8])[MATERIAL])
    metadata = json.loads((tmp_path / "metadata.json").read_text())
    velocity = np.diff(position.astype(np.float64), axis=0)
    np.testing.assert_allclose(
        metadata["vel_std"], velocity.reshape(-1, 2).std(axis=0), rtol=1e-5
    )
    acceleration = np.diff(velocity, axis=0).reshape(-1, 2)
    np.testing.assert_allclose(metadata["acc_std"], acceleration.std(axis=0), rtol=1e-4)
    assert metadata["dt"] == pytest.approx(0.1)
    assert metadata["sequence_length"] == 16


def test_lagrangebench_reads_an_export(split: LocalSplit, tmp_path: Path) -> None:
    """Positions lie from 0 to the length of the bounds; chunks have one frame."""
    export(split.folder, format="lagrangebench-h5", output=tmp_path)
    metadata = json.loads((tmp_path / "metadata.json").read_text())
    low, high = np.array(metadata["bounds"]).T
    with h5py.File(tmp_path / "test.h5") as file:
        position = file["00000/position"]
        assert position.chunks == (1, 144, 2)
        assert (position[:] >= 0.0).all()
        assert (position[:] <= high - low + 1e-6).all()
        np.testing.assert_array_equal(
            file["00000/particle_type"], np.array([0, 4, 5, 6])[MATERIAL]
        )
    assert metadata["dt"] * metadata["write_every"] == pytest.approx(0.1)


def test_vtk_opens_an_export(split: LocalSplit, tmp_path: Path) -> None:
    """As a film, with positions, velocities and materials at each time."""
    reader_module = pytest.importorskip("vtkmodules.vtkIOHDF")
    convert = pytest.importorskip("vtkmodules.util.numpy_support").vtk_to_numpy
    result = export(split.folder, format="vtkhdf", output=tmp_path)
    assert len(result.files) == 3
    reader = reader_module.vtkHDFReader()
    reader.SetFileName(str(tmp_path / "test/0002.vtkhdf"))
    reader.UpdateInformation()
    assert reader.GetNumberOfSteps() == 20
    for frame in (0, 7, 19):
        reader.SetStep(frame)
        reader.Update()
        grid = reader.GetOutputDataObject(0)
        points = convert(grid.GetPoints().GetData())
        np.testing.assert_array_equal(points[:, :2], vortex(2, 20)[frame])
        assert not points[:, 2].any()
        data = grid.GetPointData()
        np.testing.assert_array_equal(convert(data.GetArray("material")), MATERIAL)
        assert data.HasArray("velocity")
        assert reader.GetTimeValue() == pytest.approx(0.1 * frame)
    back = adopt(
        [tmp_path / "train", tmp_path / "valid", tmp_path / "test"],
        output=tmp_path / "back",
        bounds=BOUNDS,
    )
    np.testing.assert_array_equal(
        read_positions(back)["test"], read_positions(split)["test"]
    )


def test_an_export_does_not_overwrite(split: LocalSplit, tmp_path: Path) -> None:
    """Nor lies it beside a program that readers of the format would run."""
    export(split.folder, format="gns-npz", output=tmp_path / "out")
    with pytest.raises(UsageError, match="holds files"):
        export(split.folder, format="gns-npz", output=tmp_path / "out")
    export(split.folder, format="gns-npz", output=tmp_path / "out", overwrite=True)
    (tmp_path / "out/force.py").touch()
    with pytest.raises(UsageError, match=r"force\.py"):
        export(split.folder, format="vtkhdf", output=tmp_path / "out", overwrite=True)
