"""Do jelly and rope keep their shape, and does matter keep its density?

    python benchmarks/shape_and_density.py --size mini --root DATA [PREDICTIONS ...]

prints two numbers by material, for the truth of the test scenarios of multimaterial and
for each file of predictions. The first is the distance of particles from their places
by shape matching (lagbench.baselines.projection), mean over particles [length]. The
second is the 95th percentile of the density over the greatest one of the first frame.
Both are given as the mean over scenarios and frames, and as the greatest of all.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lagbench.baselines.particle_grid import ParticleGrid
from lagbench.baselines.projection import DensityProjection, ShapeMatching
from lagbench.data.local import resolve_root
from lagbench.data.registry import Size, load
from lagbench.data.scenario import read_scenario
from lagbench.figures.tables import markdown
from lagbench.submission.predictions import Predictions, open_predictions

SPLIT = "multimaterial"
MATERIALS = ("liquid", "jelly", "snow", "rope")
FRAME_STEP = 10
"""Frames between those that are measured."""

Positions = NDArray[np.float32]
"""Positions of particles in a frame [length], shape [particle, 2]."""

ReadFrame = Callable[[int, int], Positions]
"""Return the positions of a scenario in a frame."""


def read_predicted(file: Predictions, scenario: int, frame: int) -> Positions:
    """Return the predicted positions in one frame."""
    (position,) = file.frames(scenario, frame, 1)
    return np.asarray(position)


def measure(
    size: Size,
    root: Path,
    read_frame: ReadFrame | None,
    cells: tuple[int, int],
) -> dict[int, Tensor]:
    """Return deviation and density of each material, shape [scenario and frame, 2].

    The deviation is the mean distance of particles from the places where their bodies
    in the first frame would put them [length]. The density is the 95th percentile over
    particles, relative to the densest place of the first frame [1]. A scenario has rows
    for the materials that it has.

    Args:
        size: the data set.
        root: folder of all data sets.
        read_frame: reads predicted positions; None measures the truth.
        cells: cells across the box, of the grid of bodies and of that of densities.
    """
    cluster_cells, density_cells = cells
    cluster_grid = ParticleGrid(size.bounds, cluster_cells)
    density_grid = ParticleGrid(size.bounds, density_cells)
    material_count = len(MATERIALS)
    rows: dict[int, list[list[float]]] = {}
    for kind in range(material_count):
        rows[kind] = []
    for scenario in size.subsets["test"]:
        truth = {}
        path = size.path(root, scenario)
        with read_scenario(path) as file:
            stored_material = file.read("material")
            first_position = file.read("position", 0)
            first_measured = size.task.input_frames
            for frame in range(first_measured, file.header.frames, FRAME_STEP):
                truth[frame] = file.read("position", frame)

        material = torch.from_numpy(stored_material.astype(np.int64))
        single_material = torch.zeros_like(material)
        first = torch.from_numpy(first_position)
        shape = ShapeMatching.build(cluster_grid, first, material, material_count)
        density = DensityProjection.build(density_grid, first, single_material, 1)
        kinds = sorted(set(material.tolist()))
        for frame, true_position in truth.items():
            measured_position = true_position
            if read_frame is not None:
                measured_position = read_frame(scenario, frame)
            position = torch.from_numpy(measured_position)
            correction = shape.match(position) - position
            deviation = correction.norm(dim=1)
            stencil = density_grid.stencil(position, single_material)
            relative_density, _ = density.relative_density(stencil)
            for kind in kinds:
                is_kind = material == kind
                kind_deviation = deviation[is_kind]
                kind_density = relative_density[is_kind]
                mean_deviation = float(kind_deviation.mean())
                high_density = float(kind_density.quantile(0.95))
                rows[kind].append([mean_deviation, high_density])

    by_material = {}
    for kind, values in rows.items():
        by_material[kind] = torch.tensor(values)
    return by_material


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "predictions", nargs="*", type=Path, help="files to measure beside the truth"
    )
    parser.add_argument("--size", default="mini")
    parser.add_argument("--root", type=Path, help="folder of all data sets")
    parser.add_argument(
        "--cells",
        default="15,30",
        help="cells across the box: of clusters, of densities",
    )
    options = parser.parse_args()
    cluster_cells, density_cells = options.cells.split(",")
    cells = (int(cluster_cells), int(density_cells))
    size = load().size(SPLIT, options.size)
    root = resolve_root(options.root)
    lines = []
    with ExitStack() as stack:
        readers: dict[str, ReadFrame | None] = {"truth": None}
        for path in options.predictions:
            file = stack.enter_context(open_predictions(path))
            readers[str(path)] = partial(read_predicted, file)
        for name, read_frame in readers.items():
            by_material = measure(size, root, read_frame, cells)
            for kind, values in by_material.items():
                mean_deviation, mean_density = values.mean(dim=0).tolist()
                most_deviation, most_density = values.amax(dim=0).tolist()
                line = [
                    name,
                    MATERIALS[kind],
                    f"{mean_deviation:.2g}",
                    f"{most_deviation:.2g}",
                    f"{mean_density:.2g}",
                    f"{most_density:.2g}",
                ]
                lines.append(line)
    heads = ["of", "material", "off its shape", "at most", "density", "at most"]
    print(markdown(heads, lines))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
