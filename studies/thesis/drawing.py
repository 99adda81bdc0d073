"""Rollouts from open files, and charts and rows of panels in one style."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from lagbench.data.scenario import ScenarioFile
from lagbench.figures.canvas import encode, figure, pixels_of
from lagbench.figures.colours import INK
from lagbench.figures.panels import (
    Panel,
    colour_bar,
    colour_scale,
    draw,
    draw_walls,
    limit_of,
    strongest_limit,
)
from lagbench.figures.recording import Recording, Scene, open_recording
from lagbench.metrics.frame import FramePair, Scenario, Snapshot
from lagbench.submission.predictions import Predictions, open_predictions

from .plan import Plan

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Picture

Floats = NDArray[np.float64]

TRUTH_COLOUR = INK
LEVELS = 96  # colours of a chart's file
# a kind of panel of our own: arrows at the nodes, coloured by speed as streamlines are
QUIVER = "quiver"

SMOOTHED = 25
"""Entries of the log in the mean of a drawn point, centred; fewer at both ends."""

SIDE = 1.5
GAP = 0.08
TOP = 0.34
LEFT = 0.75
BOTTOM = 0.62  # [inch]


@dataclass(eq=False)
class OpenRollouts:
    """Truth and predictions of one test scenario, frame by frame, from open files."""

    scenario: Scenario  # the scenario as metrics see it
    recording: Recording  # the scenario as pictures see it
    file: ScenarioFile
    predictions: Mapping[str, Predictions]  # by model
    _true_snapshots: dict[int, Snapshot] = field(default_factory=dict)

    def position(self, name: str | None, frame: int) -> Floats:
        """Return positions [length], shape [particle, 2].

        None is the truth. In a given frame a model has the positions of the truth.
        """
        first_predicted = self.scenario.config.predicted_frames[0]
        if name is None or frame < first_predicted:
            return np.asarray(self.file.read("position", frame), np.float64)
        predictions = self.predictions[name]
        frames = predictions.frames(self.recording.scenario, frame, 1)
        return np.asarray(frames[0], np.float64)

    def snapshot(self, name: str | None, frame: int) -> Snapshot:
        """Return a frame as metrics see it; None is the truth, made once per frame."""
        if name is None and frame in self._true_snapshots:
            return self._true_snapshots[frame]
        snapshot = self.scenario.snapshot(
            self.position(name, frame), self.position(name, frame - 1)
        )
        if name is None:
            self._true_snapshots[frame] = snapshot
        return snapshot

    def pair(self, name: str, frame: int) -> FramePair:
        """Return truth and prediction of a frame."""
        truth = self.snapshot(None, frame)
        prediction = self.snapshot(name, frame)
        return FramePair(self.scenario, frame, truth, prediction)

    def scene(self, name: str | None, frame: int) -> Scene:
        """Return a frame as pictures see it."""
        position = self.position(name, frame)
        displacement = position - self.position(name, frame - 1)
        return Scene(
            recording=self.recording,
            frame=frame,
            position=position,
            velocity=displacement / self.recording.size.frame_interval,
            displacement=displacement,
        )


@contextmanager
def open_rollouts(
    plan: Plan, split: str, *, scenario: int, names: Iterable[str]
) -> Iterator[OpenRollouts]:
    """Open a test scenario with the predictions of models.

    Models without a run are left out.
    """
    with ExitStack() as stack:
        truth = stack.enter_context(plan.test_subset(split).opened(scenario))
        recording = stack.enter_context(
            open_recording(truth.file.path, registry=plan.described)
        )
        predictions = {}
        for name in names:
            path = plan.predictions(split, name)
            if path is not None:
                predictions[name] = stack.enter_context(open_predictions(path))
        yield OpenRollouts(truth.scenario, recording, truth.file, predictions)


@contextmanager
def charts(
    count: int, columns: int, *, width: float = 4.2, height: float = 3.0
) -> Iterator[list[Axes]]:
    """Yield the axes of charts in columns; width and height are a chart's [inch]."""
    rows = -(-count // columns)
    with figure(columns * width, rows * height) as picture:
        picture.set_layout_engine("constrained")
        grid = picture.subplots(rows, columns, squeeze=False)
        axes: list[Axes] = grid.ravel().tolist()
        for unused in axes[count:]:
            unused.set_axis_off()
        yield axes[:count]


def charts_png(axes: Sequence[Axes]) -> bytes:
    """Return charts as PNG in few colours; equal charts give equal bytes.

    The file names neither a date nor software.
    """
    from PIL import Image

    picture = cast("Picture", axes[0].get_figure(root=True))
    image = Image.fromarray(pixels_of(picture))
    image = image.quantize(LEVELS, dither=Image.Dither.NONE)
    with io.BytesIO() as buffer:
        image.save(buffer, format="PNG", optimize=True)
        return buffer.getvalue()


def tidy_axes(axes: Axes, title: str, *, x: str, y: str, legend: bool = True) -> None:
    """Set title, labels, light grid and legend of a chart."""
    axes.set(title=title, xlabel=x, ylabel=y)
    axes.grid(alpha=0.25, lw=0.5)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    _, labels = axes.get_legend_handles_labels()
    if legend and labels:
        axes.legend(frameon=False, fontsize=7.5)


PanelRow = tuple[str, OpenRollouts, str | None]
"""Heading, scenario, and model; None for the truth."""


def panel_rows(rows: Sequence[PanelRow], frames: Sequence[int], panel: str) -> bytes:
    """Draw a row of panels per heading and a column per frame, in common colours.

    Of one frame the rows stand side by side, with their headings above. The colour
    scale is that of the truth; predictions may exceed it.
    """
    scale = Panel.STREAMLINES if panel == QUIVER else Panel(panel)
    is_one_frame = len(frames) == 1
    if is_one_frame:
        column_count = len(rows)
        line_count = 1
        left_margin = 0.1
    else:
        column_count = len(frames)
        line_count = len(rows)
        left_margin = LEFT
    width = left_margin + column_count * (SIDE + GAP) + 0.1
    height = TOP + line_count * (SIDE + GAP) + BOTTOM

    limit = 1.0
    has_scale = scale is not Panel.MATERIAL
    if has_scale:
        limit = _common_limit(rows, frames, scale)

    with figure(width, height) as picture:
        cells = [(row, frame) for row in rows for frame in frames]
        for count, ((heading, rollouts, name), frame) in enumerate(cells):
            line, column = divmod(count, column_count)
            left = (left_margin + column * (SIDE + GAP)) / width
            bottom = (height - TOP - (line + 1) * (SIDE + GAP) + GAP) / height
            axes = picture.add_axes((left, bottom, SIDE / width, SIDE / height))
            scene = rollouts.scene(name, frame)
            if panel == QUIVER:
                _draw_arrows(axes, scene, limit)
            else:
                draw(axes, scale, scene, limit=limit, detail=0.35)

            if is_one_frame:
                axes.set_title(heading, fontsize=8)
            elif line == 0:
                axes.set_title(f"frame {frame}", fontsize=8)
            if not is_one_frame and column == 0:
                axes.set_ylabel(heading, fontsize=8, color=INK)
        if has_scale:
            bar_width = min(2.0, width - 0.6)
            place = (0.35 / width, 0.42 / height, bar_width / width, 0.08 / height)
            colour_bar(picture.add_axes(place), scale, limit)
        return encode(picture)


def _common_limit(
    rows: Sequence[PanelRow], frames: Sequence[int], scale: Panel
) -> float:
    """Return the limit of the colour scale over the true frames of all scenarios."""
    scenarios = {rollouts.recording.scenario: rollouts for _, rollouts, _ in rows}
    limits = []
    for rollouts in scenarios.values():
        for frame in frames:
            limits.append(limit_of(scale, rollouts.scene(None, frame)))
    return strongest_limit(limits)


def _draw_arrows(axes: Axes, scene: Scene, limit: float) -> None:
    """Draw the velocity at the nodes; an arrow of the limit's speed spans 2.5 node
    spacings.

    Faster nodes have longer arrows.
    """
    draw_walls(axes, scene.recording, scene.frame)
    fields = scene.fields
    scale = colour_scale(Panel.STREAMLINES, limit)
    node_x, node_y = np.meshgrid(fields.grid.axis, fields.grid.axis, indexing="ij")
    is_shown = fields.counted
    # velocities at the shown nodes [length / time], shape [node, 2]
    velocity = fields.velocity[is_shown] / scene.recording.size.frame_interval
    speed = np.linalg.norm(velocity, axis=-1)
    axes.quiver(
        node_x[is_shown],
        node_y[is_shown],
        velocity[:, 0],
        velocity[:, 1],
        speed,
        cmap=scale.cmap,
        norm=scale.norm,
        angles="xy",
        scale_units="xy",
        scale=limit * fields.grid.cells / 2.5,
        width=0.006,
        zorder=2,
    )


@dataclass(frozen=True, eq=False)
class LossCurve:
    """The loss of a training over its steps; empty arrays where it left no log."""

    steps: Floats
    loss: Floats


def plot_losses(
    axes: Axes, curves: Mapping[str, LossCurve], colours: Mapping[str, str]
) -> None:
    """Plot smoothed losses by name; a name without a colour takes the next one."""
    for name, curve in curves.items():
        if curve.loss.size:
            axes.plot(
                curve.steps,
                smooth(curve.loss),
                lw=1.1,
                label=name,
                color=colours.get(name),
            )
            axes.set_yscale("log")
    title = f"mean of {SMOOTHED} entries"
    tidy_axes(axes, title, x="optimiser step", y="training loss")


def loss_over_steps(folder: Path, term: str = "total") -> LossCurve:
    """Return the loss of a training from its losses.csv."""
    path = folder / "losses.csv"
    if not path.is_file():
        return LossCurve(np.empty(0), np.empty(0))
    # a training that was continued repeats steps: the last value of a step counts
    loss_by_step = {}
    with path.open(newline="") as stream:
        for row in csv.DictReader(stream):
            loss_by_step[int(row["step"])] = float(row[term])
    steps = sorted(loss_by_step)
    losses = [loss_by_step[step] for step in steps]
    return LossCurve(np.array(steps, float), np.array(losses))


def smooth(values: Floats) -> Floats:
    """Return the mean of each value and its neighbours, :data:`SMOOTHED` in all.

    At the ends there are fewer neighbours, as many on each side.
    """
    total = np.concatenate([[0.0], np.cumsum(values)])
    index = np.arange(len(values))
    distance_to_end = np.minimum(index, index[::-1])
    reach = np.minimum(SMOOTHED // 2, distance_to_end)
    means: Floats = (total[index + reach + 1] - total[index - reach]) / (2 * reach + 1)
    return means
