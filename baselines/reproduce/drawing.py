"""Figures of the thesis and the sheets beside them; rollouts, charts and rows of panels
in one style.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from lagbench.atomic import write_atomically
from lagbench.data.scenario import ScenarioFile
from lagbench.draw.panels import (
    Panel,
    colour_bar,
    colour_scale,
    draw,
    draw_walls,
    limit_of,
)
from lagbench.draw.recording import Recording, Scene, open_recording
from lagbench.draw.style import INK, figure, pixels_of, png_bytes
from lagbench.draw.tables import Table, markdown
from lagbench.errors import require
from lagbench.metrics.frame import FramePair, Scenario, Snapshot
from lagbench.submission.predictions import Predictions, open_predictions

from .plan import Plan

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Picture

Floats = NDArray[np.float64]

TRUTH = INK
LEVELS = 96  # colours of a chart's file
# a kind of panel of our own: arrows at the nodes, coloured by speed as streamlines are
QUIVER = "quiver"

SMOOTHED = 25
"""Entries of the log that a drawn point is the mean of, as many before it as after;
fewer at both ends.
"""

SIDE = 1.5
GAP = 0.08
TOP = 0.34
LEFT = 0.75
BOTTOM = 0.62  # [inch]


@dataclass(eq=False)
class Rollouts:
    """Truth and predictions of one test scenario, frame by frame, from open files."""

    scenario: Scenario  # what holds in all its frames, as metrics see it
    recording: Recording  # the same as pictures see it
    file: ScenarioFile
    # by model, in the order in which they were asked for
    predictions: Mapping[str, Predictions]
    _truth: dict[int, Snapshot] = field(default_factory=dict)

    def position(self, name: str | None, frame: int) -> Floats:
        """Return positions [length], [particle, 2], of the truth (None, and given
        frames) or a prediction.
        """
        if name is None or frame < self.scenario.config.predicted_frames[0]:
            return np.asarray(self.file.read("position", frame), np.float64)
        return np.asarray(
            self.predictions[name].frames(self.recording.scenario, frame, 1)[0],
            np.float64,
        )

    def snapshot(self, name: str | None, frame: int) -> Snapshot:
        """Return a frame as metrics see it; the truth's is formed once."""
        if name is None and frame in self._truth:
            return self._truth[frame]
        found = self.scenario.snapshot(
            self.position(name, frame), self.position(name, frame - 1)
        )
        if name is None:
            self._truth[frame] = found
        return found

    def pair(self, name: str, frame: int) -> FramePair:
        """Return truth and prediction of a frame."""
        return FramePair(
            self.scenario, frame, self.snapshot(None, frame), self.snapshot(name, frame)
        )

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
def opened(
    plan: Plan, split: str, scenario: int, names: Iterable[str]
) -> Iterator[Rollouts]:
    """Open a test scenario with the predictions of models; those without a run are left
    out.
    """
    paths = {name: plan.predictions(split, name) for name in names}
    with ExitStack() as stack:
        truth = stack.enter_context(plan.test_subset(split).opened(scenario))
        recording = stack.enter_context(
            open_recording(truth.file.path, registry=plan.described)
        )
        predictions = {
            name: stack.enter_context(open_predictions(path))
            for name, path in paths.items()
            if path
        }
        yield Rollouts(truth.scenario, recording, truth.file, predictions)


@contextmanager
def charts(
    count: int, columns: int, *, width: float = 4.2, height: float = 3.0
) -> Iterator[list[Axes]]:
    """Yield axes of so many charts in so many columns; a chart has this width and
    height [inch].
    """
    rows = -(-count // columns)
    with figure(columns * width, rows * height) as picture:
        picture.set_layout_engine("constrained")
        axes: list[Axes] = (
            picture.subplots(rows, columns, squeeze=False).ravel().tolist()
        )
        for unused in axes[count:]:
            unused.set_axis_off()
        yield axes[:count]


def png(axes: Sequence[Axes]) -> bytes:
    """Return charts as PNG in few colours, without date or software; equal charts,
    equal bytes.
    """
    from PIL import Image

    picture = cast("Picture", axes[0].get_figure(root=True))
    image = Image.fromarray(pixels_of(picture)).quantize(
        LEVELS, dither=Image.Dither.NONE
    )
    with io.BytesIO() as buffer:
        image.save(buffer, format="PNG", optimize=True)
        return buffer.getvalue()


def tidy(axes: Axes, title: str, x: str, y: str, *, legend: bool = True) -> None:
    """Set title, labels, light grid and legend of a chart."""
    axes.set(title=title, xlabel=x, ylabel=y)
    axes.grid(alpha=0.25, lw=0.5)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    if legend and axes.get_legend_handles_labels()[1]:
        axes.legend(frameon=False, fontsize=7.5)


def panel_rows(
    rows: Sequence[tuple[str, Rollouts, str | None]], frames: Sequence[int], panel: str
) -> bytes:
    """Draw rows of (heading, scenario, model or None for the truth), a column per
    frame, in common colours.

    Of one frame rows stand side by side, headings above. The colour scale is the
    truth's, which predictions may exceed.
    """
    if panel == QUIVER:
        scale = Panel.STREAMLINES
    else:
        scale = Panel(panel)
    cells = [(row, frame) for row in rows for frame in frames]
    across = len(frames) == 1
    columns, lines = (len(rows), 1) if across else (len(frames), len(rows))
    if across:
        left_margin = 0.1
    else:
        left_margin = LEFT
    width = left_margin + columns * (SIDE + GAP) + 0.1
    height = TOP + lines * (SIDE + GAP) + BOTTOM
    limit = 1.0
    if scale is not Panel.MATERIAL:
        scenarios = {row[1].recording.scenario: row[1] for row in rows}.values()
        limit = max(
            limit_of(scale, one.scene(None, frame))
            for one in scenarios
            for frame in frames
        )
    with figure(width, height) as picture:
        for count, ((heading, rollouts, name), frame) in enumerate(cells):
            line, column = divmod(count, columns)
            left = (left_margin + column * (SIDE + GAP)) / width
            bottom = (height - TOP - (line + 1) * (SIDE + GAP) + GAP) / height
            axes = picture.add_axes((left, bottom, SIDE / width, SIDE / height))
            if panel == QUIVER:
                _draw_arrows(axes, rollouts.scene(name, frame), limit)
            else:
                draw(axes, scale, rollouts.scene(name, frame), limit=limit, detail=0.35)
            if across or line == 0:
                axes.set_title(heading if across else f"frame {frame}", fontsize=8)
            if not across and column == 0:
                axes.set_ylabel(heading, fontsize=8, color=INK)
        if scale is not Panel.MATERIAL:
            place = (
                0.35 / width,
                0.42 / height,
                min(2.0, width - 0.6) / width,
                0.08 / height,
            )
            colour_bar(picture.add_axes(place), scale, limit)
        return png_bytes(picture)


def _draw_arrows(axes: Axes, scene: Scene, limit: float) -> None:
    """Draw the velocity at the nodes; the fastest arrow spans two and a half of
    them.
    """
    draw_walls(axes, scene.recording, scene.frame)
    fields = scene.fields
    scale = colour_scale(Panel.STREAMLINES, limit)
    x, y = np.meshgrid(fields.grid.axis, fields.grid.axis, indexing="ij")
    shown = fields.counted
    velocity = fields.velocity[shown] / scene.recording.size.frame_interval
    axes.quiver(
        *(x[shown], y[shown], *velocity.T, np.linalg.norm(velocity, axis=-1)),
        cmap=scale.cmap,
        norm=scale.norm,
        angles="xy",
        scale_units="xy",
        scale=limit * fields.grid.cells / 2.5,
        width=0.006,
        zorder=2,
    )


@dataclass(frozen=True, kw_only=True)
class Figure:
    """A figure, table or section of the thesis: one row of the catalogue."""

    name: str = ""  # as in fig_5_10 or table_5_4: its key in the catalogue
    title: str  # what it shows
    draw: Callable[[Plan, Figure], Sheet]
    # models whose scored runs it shows, by split
    needs: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    studies: str = ""  # table of MLPs whose trainings it shows
    cases: tuple[int, ...] = (
        0,
    )  # scenarios of the thesis: T0, T1, ...; ids on the free surface
    # absolute; empty for the frame at which the thesis compares models
    frames: tuple[int, ...] = ()
    # show the whole rollout: pictures spread over it, errors over the horizon
    whole: bool = False
    panels: tuple[str, ...] = ()  # kinds of picture, one each
    # of its table; of curves: the models', the truth's own, then means over the horizon
    metrics: tuple[str, ...] = ()
    said: str = ""  # what the thesis says of it

    @property
    def split(self) -> str:
        """The split that it is about, the first of several."""
        return next(iter(self.needs))

    @property
    def models(self) -> tuple[str, ...]:
        """The models that it shows on that split."""
        return self.needs[self.split]


@dataclass(frozen=True, kw_only=True)
class Sheet:
    """One table or figure of the thesis, ours beside it."""

    notes: tuple[str, ...] = ()  # sentences; one paragraph each
    tables: tuple[Table, ...] = ()
    # PNG files by what is added to their name
    pictures: Mapping[str, bytes] = field(default_factory=dict)

    @property
    def text(self) -> str:
        """Notes and tables as Markdown."""
        return "\n\n".join(
            [*self.notes, *(markdown(held.columns, held.rows) for held in self.tables)]
        )


def write_sheet(sheet: Sheet, folder: Path, name: str, head: str) -> str:
    """Write ``<name>.md``, ``<name>[-n].csv`` and pictures; return the Markdown, which
    the head opens.
    """
    parts = [head, *sheet.notes]
    for count, held in enumerate(sheet.tables, start=1):
        parts += [f"**{held.title}**"] if held.title else []
        parts.append(markdown(held.columns, held.rows))
        if len(sheet.tables) > 1:
            ending = f"-{count}"
        else:
            ending = ""
        with io.StringIO() as buffer:
            csv.writer(buffer, lineterminator="\n").writerows(
                [held.columns, *held.rows]
            )
            write_atomically(
                folder / f"{name}{ending}.csv",
                buffer.getvalue().encode(),
                option="--output",
            )
    for what, picture in sheet.pictures.items():
        path = folder / (f"{name}-{what}.png" if what else f"{name}.png")
        write_atomically(path, picture, option="--output")
        parts.append(f"![{name} {what}]({path.name})")
    text = "\n\n".join(parts) + "\n"
    write_atomically(folder / f"{name}.md", text.encode(), option="--output")
    return text


def plot_losses(
    axes: Axes, curves: Mapping[str, tuple[str | None, Floats, Floats]]
) -> None:
    """Plot smoothed losses by name: colour, steps and loss of each."""
    for name, (line, steps, loss) in curves.items():
        if loss.size:
            axes.plot(steps, smoothed(loss), lw=1.1, label=name, color=line)
            axes.set_yscale("log")
    tidy(axes, f"mean of {SMOOTHED} entries", "optimiser step", "training loss")


def loss_over_steps(folder: Path, term: str = "total") -> tuple[Floats, Floats]:
    """Return steps and loss of a training as TensorBoard was told; empty where it left
    no log.
    """
    logs = folder / "tensorboard"
    tag = f"loss/{term}"
    if not logs.is_dir():
        return np.empty(0), np.empty(0)
    module = require(
        "tensorboard.backend.event_processing.event_accumulator", extra="baselines"
    )
    held = module.EventAccumulator(str(logs), size_guidance={"scalars": 0}).Reload()
    if tag not in held.Tags()["scalars"]:
        return np.empty(0), np.empty(0)
    # a training that went on repeats steps; what was told last holds
    entries = sorted({entry.step: entry.value for entry in held.Scalars(tag)}.items())
    return np.array([step for step, _ in entries], float), np.array(
        [loss for _, loss in entries]
    )


def smoothed(values: Floats) -> Floats:
    """Return the mean of each value and its neighbours, :data:`SMOOTHED` in all where
    there are.
    """
    total = np.concatenate([[0.0], np.cumsum(values)])
    place = np.arange(len(values))
    reach = np.minimum(SMOOTHED // 2, np.minimum(place, place[::-1]))
    found: Floats = (total[place + reach + 1] - total[place - reach]) / (2 * reach + 1)
    return found
