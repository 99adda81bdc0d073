"""Do jelly and rope keep their shape, and does matter keep its density: in the truth,
and in predictions?

    python benchmarks/held_in_shape.py --size mini --root DATA [PREDICTIONS ...]

rolls nothing out: for the truth of the test scenarios of multimaterial and for each
file of predictions it prints, by material, how far particles are from where shape
matching has them (lagbench.baselines.projection), mean over particles [length], and the
95th percentile of the density over the greatest of the first frame; both as the mean
over scenarios and frames, and the greatest of any scenario's frames.
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
NAMES = ("liquid", "jelly", "snow", "rope")
EVERY = 10
"""Frames between those that are looked at."""

Read = Callable[[int, int], NDArray[np.float32]]


def frame_of(file: Predictions, scenario: int, frame: int) -> NDArray[np.float32]:
    """Return the positions in one frame."""
    return np.asarray(file.frames(scenario, frame, 1)[0])


def figures(
    size: Size, root: Path, read: Read | None, cells: tuple[int, int]
) -> dict[int, Tensor]:
    """Return (deviation, density) of each material, shape [scenario and frame, 2]."""
    clusters, nodes = (ParticleGrid(size.bounds, each) for each in cells)
    rows: dict[int, list[list[float]]] = {kind: [] for kind in range(len(NAMES))}
    for scenario in size.subsets["test"]:
        with read_scenario(size.path(root, scenario)) as file:
            material = torch.from_numpy(file.read("material").astype(np.int64))
            first = torch.from_numpy(file.read("position", slice(0, 1))[0])
            frames = range(size.task.input_frames, file.header.frames, EVERY)
            truth = {
                frame: file.read("position", slice(frame, frame + 1))[0]
                for frame in frames
            }
        one = torch.zeros_like(material)
        shape = ShapeMatching.build(clusters, first, material, len(NAMES))
        density = DensityProjection.build(nodes, first, one, 1)
        for frame in frames:
            now = torch.from_numpy(
                truth[frame] if read is None else read(scenario, frame)
            )
            off = (shape.match(now) - now).norm(dim=1)
            dense, _ = density.relative_density(nodes.stencil(now, one))
            for kind in sorted(set(material.tolist())):
                own = material == kind
                rows[kind].append(
                    [float(off[own].mean()), float(dense[own].quantile(0.95))]
                )
    return {kind: torch.tensor(values) for kind, values in rows.items()}


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "predictions", nargs="*", type=Path, help="files to look at beside the truth"
    )
    parser.add_argument("--size", default="mini")
    parser.add_argument("--root", type=Path, help="where data sets are")
    parser.add_argument(
        "--cells",
        default="15,30",
        help="cells across the box: of clusters, of densities",
    )
    asked = parser.parse_args()
    clusters, nodes = (int(each) for each in asked.cells.split(","))
    size = load().size(SPLIT, asked.size)
    root = resolve_root(asked.root)
    lines = []
    with ExitStack() as stack:
        readers: dict[str, Read | None] = {"truth": None}
        for path in asked.predictions:
            file = stack.enter_context(open_predictions(path))
            readers[str(path)] = partial(frame_of, file)
        for name, read in readers.items():
            for kind, values in figures(size, root, read, (clusters, nodes)).items():
                mean = values.mean(dim=0).tolist()
                most = values.amax(dim=0).tolist()
                pairs = [
                    f"{each:.2g}"
                    for pair in zip(mean, most, strict=True)
                    for each in pair
                ]
                lines.append([name, NAMES[kind], *pairs])
    print(
        markdown(
            ["of", "material", "off its shape", "at most", "density", "at most"], lines
        )
    )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
