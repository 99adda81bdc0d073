"""Particles by material over time: truth above predictions (Figs. 4.11 to 4.13)."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from lagbench.data import MATERIALS
from lagbench.errors import format_count
from lagbench.figures.colours import MATERIAL_RGB
from lagbench.figures.html import (
    Markup,
    ReportFigure,
    draw_image_panel,
    draw_key,
    draw_panel_grid,
    join,
)
from lagbench.figures.particles import DOT_DIAMETER, Interval, paint_particles
from lagbench.figures.png import encode_indexed_png
from lagbench.figures.solid import View
from lagbench.metrics.frame import Snapshot

from .subject import Gallery, Moment, Subject

SIDE = 176  # side of a panel [pixel]
# panels are painted so many times larger and averaged, which smooths the rims of dots
OVERSAMPLING = 3
SHADES = OVERSAMPLING**2  # opacities of a pixel

MOST_ROWS = 24  # of panels on the page; more would make it too heavy

FEWEST_DECIMALS = 2  # of a time in seconds

CAPTION = (
    "All particles by material, truth above predictions, inside the walls of the box."
)


def particle_figures(subject: Subject, gallery: Gallery) -> Iterator[ReportFigure]:
    """Yield one figure per scenario, as many as there is room for."""
    rows_per_scenario = 1 + len(subject.entries)
    scenario_count = max(1, MOST_ROWS // rows_per_scenario)
    shown = subject.scenarios[:scenario_count]
    omitted_count = len(subject.scenarios) - len(shown)
    for scenario in shown:
        caption = CAPTION
        if omitted_count and scenario == shown[-1]:
            count = format_count(omitted_count, "scenario")
            caption += f" Not drawn for want of room: {count}."
        yield _scenario_figure(subject, gallery, scenario, caption=caption)


def _scenario_figure(
    subject: Subject, gallery: Gallery, scenario: int, *, caption: str
) -> ReportFigure:
    moments = gallery.at(scenario, subject.times)
    label = gallery.labels[scenario]

    def draw_panel(moment: Moment, snapshot: Snapshot, what: str) -> Markup:
        png = _draw_snapshot(subject, snapshot)
        alt = f"{what}, frame {moment.frame}"
        return draw_image_panel(png, label.classes, alt, smooth=True)

    true_panels = []
    for moment in moments:
        true_panels.append(draw_panel(moment, moment.truth, "truth"))
    rows = [("truth", true_panels)]
    for entry in subject.entries:
        panels = []
        for moment in moments:
            snapshot = moment.pairs[entry.number].prediction
            panels.append(draw_panel(moment, snapshot, "prediction"))
        rows.append((entry.name, panels))

    interval = subject.task.size.frame_interval
    # so many that the times of two frames differ
    decimals = max(FEWEST_DECIMALS, math.ceil(-math.log10(interval)))
    columns = []
    for moment in moments:
        seconds = moment.frame * interval
        columns.append(f"{moment.title}\u2002{seconds:.{decimals}f} s")
    materials = np.unique(moments[0].truth.scenario.material).tolist()
    key = []
    for material in materials:
        key.append((f"m{material}", MATERIALS[material]))
    title = f"Particles, scenario {scenario}"
    if label.mark:
        title += f": {label.mark}"
    thesis = "Figs. 4.12, 4.13"
    if materials == [0]:
        thesis = "Fig. 4.11"
    return ReportFigure(
        name=f"particles-{scenario}",
        title=title,
        thesis=thesis,
        body=join([draw_key(key, kind="square"), draw_panel_grid(columns, rows)]),
        caption=caption,
        wide=True,
    )


def _draw_snapshot(subject: Subject, snapshot: Snapshot) -> bytes:
    material = snapshot.scenario.material
    volume = snapshot.scenario.area / len(material)
    box = subject.task.size.box
    if box.dimension == 2:
        return draw_materials(
            snapshot.position,
            material,
            view=(box.bounds[0], box.bounds[1]),
            spacing=float(np.sqrt(volume)),
        )
    view = View(box)
    order = np.argsort(-view.depth(snapshot.position), kind="stable")
    return draw_materials(
        view.place(snapshot.position[order]),
        material[order],
        view=((0.0, 1.0), (0.0, 1.0)),
        spacing=float(np.cbrt(volume)) * view.scale,
    )


def draw_materials(
    position: NDArray[np.floating],
    material: NDArray[np.integer],
    *,
    view: tuple[Interval, Interval],
    spacing: float,
) -> bytes:
    """Return a picture of particles by material as a PNG file.

    Args:
        position: positions of the particles [length], shape [particle, 2].
        material: number of each particle's material, shape [particle].
        view: interval of x and of y that the picture shows [length].
        spacing: distance of neighbouring particles at first [length].
    """
    (left, right), _ = view
    fine_side = SIDE * OVERSAMPLING
    diameter = DOT_DIAMETER * spacing / (right - left) * fine_side
    background = np.zeros((fine_side, fine_side), np.uint8)
    colour = np.asarray(material).astype(np.uint8) + 1  # 0 is no particle
    image = paint_particles(background, position, colour, view=view, diameter=diameter)

    # a block of fine pixels gets its commonest material, as opaque as the block is full
    blocks = image.reshape(SIDE, OVERSAMPLING, SIDE, OVERSAMPLING)
    counts_by_material = []
    for number in range(len(MATERIALS)):
        is_material = blocks == number + 1
        counts_by_material.append(is_material.sum(axis=(1, 3)))
    counts = np.array(counts_by_material)  # shape [material, row, column]
    filled = counts.sum(axis=0)
    commonest = np.argmax(counts, axis=0)
    entry = commonest * SHADES + filled
    index = np.where(filled > 0, entry, 0).astype(np.uint8)
    return encode_indexed_png(index, _build_palette())


def _build_palette() -> NDArray[np.uint8]:
    """Return nothing, then each material in each opacity, shape [entry, 4]."""
    nothing = (0, 0, 0, 0)
    entries = [nothing]
    for colour in MATERIAL_RGB:
        rgb = colour.tolist()
        for shade in range(1, SHADES + 1):
            opacity = round(255 * shade / SHADES)
            entries.append((*rgb, opacity))
    return np.array(entries, np.uint8)
