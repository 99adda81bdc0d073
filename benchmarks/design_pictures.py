"""Pictures of the design track for docs/design.md.

    python -m benchmarks.design_pictures

It writes docs/figures/design.png (a task of each family with the best parameters that
are known) and docs/figures/pour.gif (a poured body, frame by frame).
"""

from __future__ import annotations

import io
from pathlib import Path

import imageio.v3 as imageio
import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from lagbench.design.judge import known_errors
from lagbench.design.tasks import DesignTask, load_task

FIGURES = Path(__file__).parents[1] / "docs" / "figures"
LIQUID = "#2a6fdb"
MARKED = "#d9730d"
FRAMES_PER_SECOND = 20


def frame_axes(axes: Axes, task: DesignTask) -> None:
    """Draw the box of a task, and its bucket if it has one."""
    (left, right), (bottom, top) = task.size.bounds
    axes.set(xlim=(left, right), ylim=(bottom, top), xticks=[], yticks=[])
    axes.set_aspect("equal")
    if task.bucket is not None:
        low, high = task.bucket
        width, height = high - low
        bucket = Rectangle(low, width, height, fill=False, edgecolor=MARKED)
        axes.add_patch(bucket)


def show(axes: Axes, task: DesignTask, positions: np.ndarray, frame: int) -> None:
    """Draw the particles of a frame; a marked half has another colour."""
    frame_axes(axes, task)
    colours = np.full(len(positions[0]), LIQUID)
    if task.marked_axis is not None:
        low, high = task.size.bounds[0]
        is_marked = positions[0, :, task.marked_axis] < 0.5 * (low + high)
        colours[is_marked] = MARKED
    x, y = positions[frame].T
    axes.scatter(x, y, s=2.0, c=colours, linewidths=0)


def main() -> None:
    """Write both pictures."""
    mpl.use("agg")
    figure = Figure(figsize=(9.0, 6.2), layout="constrained")
    panels = figure.subplots(2, 3)
    runs = {}
    for column, name in enumerate(("pour-00", "stir-01", "identify-01")):
        task = load_task(name)
        positions = task.simulate(known_errors()[name].parameters)
        runs[name] = positions
        for row, frame in enumerate((0, task.frames)):
            show(panels[row, column], task, positions, frame)
            panels[row, column].set_title(f"{name}, frame {frame}", fontsize=10)
    figure.savefig(FIGURES / "design.png", dpi=110)

    task = load_task("pour-00")
    images = []
    for frame in range(task.frames + 1):
        film = Figure(figsize=(3.2, 3.2), layout="constrained")
        show(film.subplots(), task, runs["pour-00"], frame)
        buffer = io.BytesIO()
        film.savefig(buffer, dpi=80)
        images.append(imageio.imread(buffer.getvalue())[..., :3])
    imageio.imwrite(
        FIGURES / "pour.gif", images, duration=1000 / FRAMES_PER_SECOND, loop=0
    )


if __name__ == "__main__":
    main()
