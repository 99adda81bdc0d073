"""The HDF5 format of VTK, which ParaView opens as a film: one file for a trajectory.

The layout is that of version 2.2, an unstructured grid whose cells are its points:
https://docs.vtk.org/en/latest/vtk_file_formats/vtkhdf_file_format/
"""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np

from lagbench.atomic import atomic_path
from lagbench.data.scenario import read_scenario

VERTEX = 1
"""Number of the cell type of a single point."""


def write(path: Path, scenario: Path) -> None:
    """Write a scenario file, whole or not at all.

    Positions [length] and velocities [length/s] get a third component, 0, in two
    dimensions. Materials and ids are written once.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with (
        read_scenario(scenario) as source,
        atomic_path(path, option="--output") as temporary,
        h5py.File(temporary, "w") as file,
    ):
        frame_count = source.header.frames
        material = source.read("material")
        particle_count = len(material)
        root = file.create_group("VTKHDF")
        root.attrs["Version"] = (2, 2)
        root.attrs.create("Type", np.bytes_("UnstructuredGrid"))
        for name in ("NumberOfPoints", "NumberOfCells", "NumberOfConnectivityIds"):
            root[name] = np.array([particle_count])
        root["Connectivity"] = np.arange(particle_count)
        root["Offsets"] = np.arange(particle_count + 1)
        root["Types"] = np.full(particle_count, VERTEX, np.uint8)
        data = root.create_group("PointData")
        data["material"] = material
        data["id"] = np.arange(particle_count)

        steps = root.create_group("Steps")
        steps.attrs["NSteps"] = frame_count
        steps["Values"] = source.read("time")
        zeros = np.zeros(frame_count, int)
        starts = particle_count * np.arange(frame_count)
        steps["PointOffsets"] = starts
        steps["PartOffsets"] = zeros
        steps["NumberOfParts"] = zeros + 1
        steps["CellOffsets"] = zeros[:, None]
        steps["ConnectivityIdOffsets"] = zeros[:, None]
        offsets = steps.create_group("PointDataOffsets")
        offsets["material"] = zeros
        offsets["id"] = zeros

        arrays = {"position": "Points"}
        if "velocity" in source.variables:
            arrays["velocity"] = "PointData/velocity"
            offsets["velocity"] = starts
        for name, place in arrays.items():
            stored = root.create_dataset(
                place,
                shape=(frame_count * particle_count, 3),
                dtype="<f4",
                chunks=(particle_count, 3),
                compression="gzip",
                compression_opts=1,
                shuffle=True,
            )
            for frame in range(frame_count):
                values = np.zeros((particle_count, 3), np.float32)
                components = source.read(name, slice(frame, frame + 1))[0]
                values[:, : components.shape[1]] = components
                stored[starts[frame] : starts[frame] + particle_count] = values
