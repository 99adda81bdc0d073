"""Pictures of the report, drawn by matplotlib: truth, predictions and their errors.

Each function yields :class:`Picture`; the order and the numbers of the thesis's figures
are those of chapters 4 and 5.
"""

from __future__ import annotations

import base64
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lagbench.data import MATERIALS
from lagbench.figures.canvas import (
    build_speed_map,
    build_vorticity_map,
    encode,
    figure,
    shrink,
)
from lagbench.figures.colours import (
    INK,
    MATERIAL_COLOURS,
    MUTED,
    SERIES,
    WALL,
)
from lagbench.figures.solid import View
from lagbench.metrics.aggregate import FEWEST_FOR_INTERVAL, Score, mean_over_seeds
from lagbench.metrics.frame import Snapshot
from lagbench.metrics.vorticity import STABLE_PEARSON

from .subject import Gallery, Moment, ReportRow, Subject, limit_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]

PANEL = 1.5  # side of a small panel [inch]
ROW_NAME = 1.1  # room for the names of rows of panels [inch]

TOLERATED = 3.0
"""Energies beyond so many times the truth's greatest energy are cut off."""

MOST_SCENARIOS = 6  # whose particles are drawn over time


@dataclass(frozen=True, kw_only=True)
class Picture:
    """One picture of the page."""

    name: str  # identifier, unique on the page
    title: str
    caption: str
    image: bytes  # a PNG file
    thesis: str  # the figure of the thesis that it corresponds to
    wide: bool = False  # whether it takes the width of the page

    @property
    def source(self) -> str:
        """The image as an address that a page holds in itself."""
        return f"data:image/png;base64,{base64.b64encode(self.image).decode()}"


def rollout_pictures(subject: Subject) -> Iterator[Picture]:
    """Yield errors over frames: means of all rows, then each test scenario."""
    main_error = "vorticity_mse" if subject.is_full_box else "attribute_mse"
    figures = {
        subject.ranking.name: "Fig. 5.11",
        main_error: "Fig. 5.11",
        "position_rmse": "Fig. 5.11",
        "velocity_rmse": "Fig. 5.11",
        "vorticity_pearson": "Fig. 5.13",
    }
    for name, thesis in figures.items():
        rows = subject.rows_with(name)
        if rows:
            yield _draw_means(subject, rows, name, thesis)


def _draw_means(
    subject: Subject, rows: Sequence[ReportRow], name: str, thesis: str
) -> Picture:
    """Return the mean over scenarios of each row, with intervals of entries."""
    metric = rows[0].scores[name].metric
    label = name.replace("_", " ")
    unit = ""
    if metric.unit != "1":
        unit = f" [{metric.unit.replace('^2', '²')}]"
    note = f"Mean over {len(subject.scenarios)} scenarios"
    if len(subject.scenarios) >= FEWEST_FOR_INTERVAL:
        note += "; the bands are 95 % bootstrap intervals over scenarios"
    with figure(6.4, 3.4) as drawn:
        axes = _curve_axes(drawn, f"{label}{unit}")
        true_score = rows[0].scores.get(f"{name}_true")
        if true_score is not None:
            values = mean_over_scenarios(true_score)
            _plot(axes, subject, values, color=INK, label="truth")
        for number, row in enumerate(rows):
            score = row.scores[name]
            if row.entry is None:
                style = ("--", ":", "-.")[number % 3]
                colour = MUTED
            else:
                style = "-"
                colour = SERIES[row.entry.number % len(SERIES)]
                bounds = np.array([score.interval_at(frame) for frame in score.frames])
                is_defined = np.isfinite(bounds).all(axis=1)
                low, high = bounds[is_defined].T
                frames = subject.frames[is_defined]
                axes.fill_between(frames, low, high, color=colour, alpha=0.15, lw=0)
            values = mean_over_scenarios(score)
            _plot(axes, subject, values, color=colour, style=style, label=row.name)
        if name == "position_rmse":
            limit = np.asarray(subject.task.predictability_limit)
            if len(limit) == len(subject.frames):
                name_of_limit = "perturbed solver"
                axes.plot(
                    subject.frames, limit, ":", color=INK, lw=1, label=name_of_limit
                )
        if name == "vorticity_pearson":
            axes.axhline(STABLE_PEARSON, color=MUTED, lw=0.8, ls=":")
            axes.set_ylim(top=1.0)
        else:
            # logarithmic where errors span more than a decade
            curves = [np.asarray(line.get_ydata(), float) for line in axes.get_lines()]
            joined = np.concatenate(curves)
            positive = joined[np.isfinite(joined) & (joined > 0.0)]
            if positive.size and positive.max() > 10.0 * positive.min():
                axes.set_yscale("log")
        axes.legend(frameon=False, fontsize=7, loc="upper left", bbox_to_anchor=(1, 1))
        return Picture(
            name=f"methods-{name.replace('_', '-')}",
            title=f"{label} over frames",
            thesis=thesis,
            caption=f"{metric.summary}{unit} ({metric.source}). {note}.",
            image=encode(drawn),
        )


def energy_pictures(subject: Subject) -> Iterator[Picture]:
    """Yield the kinetic energy relative to the last given frame, mean over scenarios.

    A surrogate that damps falls below the truth, one that blows up rises above it.
    """
    submission = subject.entries[0].card.submission
    true_values = 100.0 * mean_over_scenarios(submission["energy_retention_true"])
    with figure(6.4, 3.4) as drawn:
        axes = _curve_axes(drawn, "kinetic energy [% of the last given frame]")
        axes.plot(subject.frames, true_values, color=INK, label="truth")
        for row in subject.rows_with("energy_retention"):
            values = 100.0 * mean_over_scenarios(row.scores["energy_retention"])
            colour = MUTED
            if row.entry is not None:
                colour = SERIES[row.entry.number % len(SERIES)]
            axes.plot(subject.frames, values, color=colour, lw=1.2, label=row.name)
        top = TOLERATED * float(np.nanmax(true_values, initial=0.0))
        if top > 0.0:
            axes.set_ylim(0.0, min(top, axes.get_ylim()[1]))
        axes.legend(frameon=False, fontsize=7, loc="upper left", bbox_to_anchor=(1, 1))
        yield Picture(
            name="energy-kept",
            title="Kinetic energy kept",
            thesis="Fig. 5.19",
            caption="Kinetic energy relative to the last given frame, mean over "
            f"{len(subject.scenarios)} scenarios. More energy than the truth is no "
            "merit.",
            image=encode(drawn),
        )


def flow_pictures(subject: Subject, gallery: Gallery) -> Iterator[Picture]:
    """Yield fields on the score grid: at the key frame, over time, of all scenarios."""
    scenario = subject.scenarios[0]
    key_moment = gallery.moments[scenario, subject.key_frame]
    yield _draw_fields(subject, gallery, key_moment)

    moments = gallery.at(scenario, subject.times)
    columns = [moment.title for moment in moments]
    label = gallery.describe(scenario)
    limit = limit_of([moment.true_vorticity for moment in moments])
    rows = [("truth", [moment.true_vorticity for moment in moments])]
    for entry in subject.entries:
        predicted = [moment.predicted_vorticity(entry.number) for moment in moments]
        differences = []
        for field, moment in zip(predicted, moments, strict=True):
            differences.append(field - moment.true_vorticity)
        rows.append((entry.name, predicted))
        rows.append(("difference", differences))
    yield Picture(
        name="vorticity",
        title="Vorticity over time",
        thesis="Figs. 5.25–5.27",
        caption=f"{label} Difference: predicted − true, on the same scale, which ends "
        f"at {limit:.3g} per frame.",
        image=_draw_maps(subject, columns, rows, [limit] * len(moments)),
        wide=True,
    )

    frame = subject.key_frame
    moments = [gallery.moments[number, frame] for number in subject.scenarios]
    limits = [limit_of([moment.true_vorticity]) for moment in moments]
    rows = [("truth", [moment.true_vorticity for moment in moments])]
    for entry in subject.entries:
        predicted = [moment.predicted_vorticity(entry.number) for moment in moments]
        rows.append((entry.name, predicted))
    columns = [str(number) for number in subject.scenarios]
    yield Picture(
        name="every-scenario",
        title=f"Vorticity of every scenario at frame {frame}",
        thesis="Figs. 5.26, 5.27",
        caption="Each column has a colour scale of its own, set by its truth.",
        image=_draw_maps(subject, columns, rows, limits),
        wide=True,
    )


def _draw_fields(subject: Subject, gallery: Gallery, moment: Moment) -> Picture:
    """Return speed, vorticity and its error of all entries at one frame."""
    flows = [moment.truth.fields.section]
    for pair in moment.pairs:
        flows.append(pair.predicted_fields.section)
    is_compared = flows[0].counted
    speeds = []
    for flow in flows:
        speed = np.sqrt((flow.velocity**2).sum(axis=-1))
        speeds.append(np.where(is_compared, speed, np.nan))
    vorticities = [moment.true_vorticity]
    for entry in subject.entries:
        vorticities.append(moment.predicted_vorticity(entry.number))
    errors = [field - vorticities[0] for field in vorticities]
    speed_limit = limit_of(speeds[:1])
    limit = limit_of(vorticities[:1])

    columns = ["truth", *subject.names]
    with _panels(columns, ["speed", "vorticity", "error"]) as (drawn, panels):
        for column in range(len(columns)):
            speed_axes, vorticity_axes, error_axes = panels[:, column]
            _show_field(
                speed_axes, subject, speeds[column], speed_limit, is_signed=False
            )
            _show_field(vorticity_axes, subject, vorticities[column], limit)
            _show_field(error_axes, subject, errors[column], limit)
        image = encode(drawn)
    return Picture(
        name="fields",
        title=f"Fields side by side at frame {moment.frame}",
        thesis="Fig. 5.17",
        caption=f"{gallery.describe(moment.scenario)} Speeds reach "
        f"{speed_limit:.3g} length/frame, vorticities {limit:.3g} per frame. Grey: "
        "nodes that are not compared.",
        image=image,
        wide=True,
    )


def particle_pictures(subject: Subject, gallery: Gallery) -> Iterator[Picture]:
    """Yield particles by material over time, truth above predictions."""
    for scenario in subject.scenarios[:MOST_SCENARIOS]:
        moments = gallery.at(scenario, subject.times)
        interval = subject.task.size.frame_interval
        numbers = np.unique(moments[0].truth.scenario.material)
        materials = ", ".join(MATERIALS[number] for number in numbers)
        columns = [f"{moment.frame * interval:.3g} s" for moment in moments]
        names = ["truth", *subject.names]
        with _panels(columns, names) as (drawn, panels):
            for column, moment in enumerate(moments):
                snapshots = [moment.truth]
                snapshots += [pair.prediction for pair in moment.pairs]
                for axes, snapshot in zip(panels[:, column], snapshots, strict=True):
                    _show_particles(axes, subject, snapshot)
            image = encode(drawn)
        yield Picture(
            name=f"particles-{scenario}",
            title=f"Particles of scenario {scenario}",
            thesis="Figs. 4.11–4.13",
            caption=f"{gallery.describe(scenario)} All particles by material "
            f"({materials}), inside the walls of the box.",
            image=image,
            wide=True,
        )


def body_pictures(subject: Subject) -> Iterator[Picture]:
    """Yield how elastic bodies keep their shape and hold together (section 4.8.2)."""
    for name in ("shape_error", "connectivity"):
        rows = subject.rows_with(name)
        if rows:
            yield _draw_means(subject, rows, name, "section 4.8.2")


def mean_over_scenarios(score: Score) -> Floats:
    """Return the mean over scenarios of each frame, NaN where none is finite."""
    is_finite = np.isfinite(score.per_frame)
    return mean_over_seeds(np.where(is_finite, score.per_frame, np.nan))


def _curve_axes(drawn: Figure, y_label: str, *, x_label: str = "frame") -> Axes:
    """Return axes of a chart with room for a key at the right."""
    axes = drawn.add_axes((0.12, 0.16, 0.62, 0.78))
    axes.set(xlabel=x_label, ylabel=y_label)
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(color=WALL, lw=0.5)
    return axes


def _plot(
    axes: Axes,
    subject: Subject,
    values: Floats,
    *,
    color: str,
    label: str,
    style: str = "-",
) -> None:
    """Draw a line through the frames that have a value: some metrics skip frames."""
    is_defined = np.isfinite(values)
    axes.plot(
        subject.frames[is_defined],
        values[is_defined],
        linestyle=style,
        color=color,
        lw=1.4,
        label=label,
    )


@contextmanager
def _panels(
    columns: Sequence[str], rows: Sequence[str]
) -> Iterator[tuple[Figure, NDArray[np.object_]]]:
    """Yield a figure and its small panels, with a name for every column and row."""
    width = ROW_NAME + PANEL * len(columns)
    height = 0.3 + PANEL * len(rows)
    side = 0.95 * PANEL
    panels = np.empty((len(rows), len(columns)), object)
    with figure(width, height, dpi=96) as drawn:
        for row, name in enumerate(rows):
            bottom = height - 0.3 - PANEL * (row + 1)
            middle = (bottom + side / 2) / height
            text = drawn.text(0.06 / width, middle, name, va="center", fontsize=8)
            shrink(text, ROW_NAME - 0.12)
            for column, title in enumerate(columns):
                left = ROW_NAME + PANEL * column
                place = (left / width, bottom / height, side / width, side / height)
                axes = drawn.add_axes(place)
                if row == 0:
                    shrink(axes.set_title(title, fontsize=8), side)
                panels[row, column] = axes
        yield drawn, panels


def _draw_maps(
    subject: Subject,
    columns: Sequence[str],
    rows: Sequence[tuple[str, Sequence[Floats]]],
    limits: Sequence[float],
) -> bytes:
    """Return rows of maps of the vorticity; each column has its colour scale."""
    names = [name for name, _ in rows]
    with _panels(columns, names) as (drawn, panels):
        for row, (_, fields) in enumerate(rows):
            for axes, field, limit in zip(panels[row], fields, limits, strict=True):
                _show_field(axes, subject, field, limit)
        return encode(drawn)


def _show_field(
    axes: Axes, subject: Subject, field: Floats, limit: float, *, is_signed: bool = True
) -> None:
    """Show values at the nodes of the score grid, shape [x node, y node]."""
    grid = subject.task.config.grid.section
    extent: list[float] = []
    for axis in range(2):
        places = grid.places(axis)
        extent += [places[0] - grid.spacing / 2, places[-1] + grid.spacing / 2]
    axes.set_facecolor(WALL)
    axes.imshow(
        np.ma.masked_invalid(field.T),
        origin="lower",
        extent=(extent[0], extent[1], extent[2], extent[3]),
        interpolation="nearest",
        cmap=build_vorticity_map() if is_signed else build_speed_map(),
        vmin=-limit if is_signed else 0.0,
        vmax=limit,
    )
    _frame_panel(axes, subject)


def _show_particles(axes: Axes, subject: Subject, snapshot: Snapshot) -> None:
    """Show a dot for every particle by material; of cubes the view from the front."""
    position = np.asarray(snapshot.position, np.float64)
    colours = np.array(MATERIAL_COLOURS)[snapshot.scenario.material]
    if position.shape[1] == 2:
        x, y = position.T
        axes.scatter(x, y, s=1.5, c=colours, lw=0)
        _frame_panel(axes, subject)
        return
    view = View(subject.task.config.box)
    order = np.argsort(-view.depth(position), kind="stable")
    x, y = view.place(position[order]).T
    axes.scatter(x, y, s=0.8, c=colours[order], lw=0)
    for ends, _ in view.edges():
        axes.plot(*ends.T, color=WALL, lw=0.6)
    axes.set(xlim=(0, 1), ylim=(0, 1), xticks=[], yticks=[], aspect="equal")
    axes.set_frame_on(False)


def _frame_panel(axes: Axes, subject: Subject) -> None:
    """Cut a panel off at the walls of the box."""
    (left, right), (bottom, top) = subject.task.config.box.bounds[:2]
    axes.set(
        xlim=(left, right), ylim=(bottom, top), xticks=[], yticks=[], aspect="equal"
    )
    for spine in axes.spines.values():
        spine.set_color(WALL)
