"""Maps on the score grid: speed, vorticity and its error.

Maps are small PNG pictures of indexed colours with opacity, which suit light and dark
pages: the page shines through where a value is 0. Equal pixels give equal bytes.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from lagbench.figures.colours import parse_rgb
from lagbench.figures.html import (
    Markup,
    ReportFigure,
    draw_image_panel,
    draw_panel_grid,
    draw_ramp,
    join,
    tag,
)
from lagbench.figures.png import encode_indexed_png
from lagbench.figures.solid import SLICE
from lagbench.scoring.task import ScoredTask

from .subject import Gallery, Moment, ScenarioLabel, Subject, limit_of

Floats = NDArray[np.float64]
Bytes = NDArray[np.uint8]

# from a field, shape [x node, y node], and the value of full colour to a picture
DrawMap = Callable[[Floats, float], bytes]

# colours of negative and positive values and of magnitudes (Okabe & Ito 2008)
CLOCKWISE = "#0072b2"
COUNTER_CLOCKWISE = "#d55e00"
FAST = "#009e73"

LEVELS = 100  # steps of opacity on either side of 0
NO_VALUE = 2 * LEVELS + 1  # entry of the palette for nodes without a value
NO_VALUE_COLOUR = (128, 128, 128, 34)  # red, green, blue and opacity

# a node in a wall is seen where it is less than this share of a spacing inside it
WALL_SHARE = 0.26


def draw_diverging_map(field: NDArray[np.floating], limit: float) -> bytes:
    """Return a picture of signed values.

    Blue is below 0, vermilion above, clear is 0, and colours are full at the limit.
    """
    palette = _build_palette(CLOCKWISE, COUNTER_CLOCKWISE)
    return _draw_map(field, limit, palette)


def draw_sequential_map(field: NDArray[np.floating], limit: float) -> bytes:
    """Return a picture of magnitudes: clear at 0, green at the limit."""
    return _draw_map(field, limit, _build_palette(FAST, FAST))


def _draw_map(field: NDArray[np.floating], limit: float, palette: Bytes) -> bytes:
    """Return a picture of values at nodes, shape [x node, y node]; NaN is grey."""
    relative = np.nan_to_num(field / limit, nan=0.0)
    share = np.clip(relative, -1.0, 1.0)
    level = np.round(LEVELS + LEVELS * share)
    is_missing = np.isnan(field)
    index = np.where(is_missing, NO_VALUE, level)
    index = index.astype(np.uint8)
    rows = index.T[::-1]  # first row at the top
    return encode_indexed_png(np.ascontiguousarray(rows), palette)


@functools.cache
def _build_palette(below: str, above: str) -> Bytes:
    """Return the colour of each level, then that of no value, shape [entry, 4]."""
    entries = []
    for level in range(-LEVELS, LEVELS + 1):
        colour = above
        if level < 0:
            colour = below
        opacity = round(255.0 * abs(level) / LEVELS)
        entries.append((*parse_rgb(colour), opacity))
    entries.append(NO_VALUE_COLOUR)
    return np.array(entries, np.uint8)


def crop_to_walls(task: ScoredTask, field: Floats) -> Floats:
    """Return the nodes of a field that lie within the walls, shape [x node, y node]."""
    grid = task.config.grid.section
    slack = WALL_SHARE * grid.spacing
    insides = []
    for axis, (low, high) in enumerate(grid.box.bounds):
        places = grid.places(axis)
        insides.append((places >= low - slack) & (places <= high + slack))
    return field[np.ix_(*insides)]


def aspect_of(field: NDArray[np.floating]) -> float:
    """Return width over height of a field, shape [x node, y node]."""
    column_count, row_count = field.shape
    return float(column_count / row_count)


def field_figure(subject: Subject, gallery: Gallery) -> ReportFigure:
    """Return velocity and vorticity of all entries at the key frame (Fig. 5.17)."""
    scenario = subject.scenarios[0]
    frame = subject.key_frame
    moment = gallery.moments[scenario, frame]
    label = gallery.labels[scenario]
    names = ["truth", *subject.names]

    speeds = _masked_speeds(moment)
    vorticities = [moment.true_vorticity]
    for entry in subject.entries:
        vorticities.append(moment.predicted_vorticity(entry.number))
    errors = []
    for vorticity in vorticities:
        errors.append(vorticity - vorticities[0])
    speed_limit = limit_of(speeds[:1])
    vorticity_limit = limit_of(vorticities[:1])

    def draw_row(
        what: str, fields: Sequence[Floats], draw_map: DrawMap, limit: float
    ) -> list[Markup]:
        panels = []
        for name, field in zip(names, fields, strict=True):
            shown = crop_to_walls(subject.task, field)
            png = draw_map(shown, limit)
            alt = f"{what} of {name}, frame {frame}"
            aspect = aspect_of(shown)
            panel = draw_image_panel(png, label.classes, alt, aspect=aspect)
            panels.append(panel)
        return panels

    error_name = "vorticity error"
    error_panels = draw_row(error_name, errors, draw_diverging_map, vorticity_limit)
    error_panels[0] = tag("span")  # the truth has no error
    rows = [
        ("speed", draw_row("speed", speeds, draw_sequential_map, speed_limit)),
        (
            "vorticity",
            draw_row("vorticity", vorticities, draw_diverging_map, vorticity_limit),
        ),
        (error_name, error_panels),
    ]
    unit = "vorticity and its error [1/frame]"
    body = [
        draw_ramp("sequential", speed_limit, "speed [length/frame]"),
        draw_ramp("diverging", vorticity_limit, unit, signed=True),
        draw_panel_grid(names, rows, width=8.5),
    ]
    return ReportFigure(
        name="fields",
        title=f"Fields side by side at frame {frame}",
        thesis="Fig. 5.17",
        body=join(body),
        caption=f"{_describe_scenario(scenario, label)} Grey: nodes that are not "
        "compared; the colours are those of the truth's range.",
        wide=True,
    )


def _masked_speeds(moment: Moment) -> list[Floats]:
    """Return the speed of truth and entries at the nodes.

    It is NaN at nodes that are not compared (the truth's).
    """
    flows = [moment.truth.fields.section]
    for pair in moment.pairs:
        flows.append(pair.predicted_fields.section)
    speeds = []
    for flow in flows:
        squares = flow.velocity**2
        speed = np.sqrt(squares.sum(axis=-1))
        speeds.append(np.where(flow.counted, speed, np.nan))
    return speeds


def vorticity_figure(subject: Subject, gallery: Gallery) -> ReportFigure:
    """Return vorticity over time: truth, predictions, differences (5.25 to 5.27)."""
    scenario = subject.scenarios[0]
    moments = gallery.at(scenario, subject.times)
    label = gallery.labels[scenario]
    limit = limit_of(_true_vorticities(moments))

    def draw_panel(field: Floats, what: str, frame: int) -> Markup:
        shown = crop_to_walls(subject.task, field)
        png = draw_diverging_map(shown, limit)
        alt = f"{what}, frame {frame}"
        return draw_image_panel(png, label.classes, alt, aspect=aspect_of(shown))

    true_panels = []
    for moment in moments:
        true_field = moment.true_vorticity
        true_panels.append(draw_panel(true_field, "true vorticity", moment.frame))
    rows = [("truth", true_panels)]
    for entry in subject.entries:
        panels = []
        difference_panels = []
        for moment in moments:
            field = moment.predicted_vorticity(entry.number)
            difference = field - moment.true_vorticity
            panels.append(draw_panel(field, "predicted", moment.frame))
            panel = draw_panel(difference, "difference", moment.frame)
            difference_panels.append(panel)
        rows.append((entry.name, panels))
        rows.append(("difference", difference_panels))

    columns = [moment.title for moment in moments]
    ramp = draw_ramp("diverging", limit, "vorticity [1/frame]", signed=True)
    return ReportFigure(
        name="vorticity",
        title="Vorticity over time",
        thesis="Figs. 5.25–5.27",
        body=join([ramp, draw_panel_grid(columns, rows)]),
        caption=f"{_describe_scenario(scenario, label)} Difference: predicted − true, "
        "on the same scale.",
        wide=True,
    )


def _true_vorticities(moments: Sequence[Moment]) -> list[Floats]:
    return [moment.true_vorticity for moment in moments]


def scenario_figure(subject: Subject, gallery: Gallery) -> ReportFigure:
    """Return vorticity at the key frame in every test scenario (5.26 and 5.27)."""
    frame = subject.key_frame
    moments = []
    for scenario in subject.scenarios:
        moments.append(gallery.moments[scenario, frame])
    true_fields = _true_vorticities(moments)
    limits = [limit_of([field]) for field in true_fields]

    def draw_row(what: str, fields: Sequence[Floats]) -> list[Markup]:
        panels = []
        for moment, field, limit in zip(moments, fields, limits, strict=True):
            shown = crop_to_walls(subject.task, field)
            png = draw_diverging_map(shown, limit)
            classes = gallery.labels[moment.scenario].classes
            alt = f"{what}, scenario {moment.scenario}"
            aspect = aspect_of(shown)
            panels.append(draw_image_panel(png, classes, alt, aspect=aspect))
        return panels

    what = "Vorticity"
    if subject.task.config.box.dimension == 3:
        what = f"Vorticity across a slice {SLICE}"
    rows = [("truth", draw_row("true vorticity", true_fields))]
    for entry in subject.entries:
        fields = []
        for moment in moments:
            fields.append(moment.predicted_vorticity(entry.number))
        rows.append((entry.name, draw_row("predicted", fields)))
    columns = []
    for moment in moments:
        details = gallery.labels[moment.scenario].details
        columns.append(join([f"scenario {moment.scenario}", *details], tag("br")))
    return ReportFigure(
        name="every-scenario",
        title=f"Every scenario at frame {frame}",
        thesis="Figs. 5.26, 5.27",
        body=draw_panel_grid(columns, rows, width=5.0),
        caption=f"{what}; each column has a colour scale of its own, set by its "
        "truth. Orange edges move.",
        wide=True,
    )


def _describe_scenario(scenario: int, label: ScenarioLabel) -> str:
    """Return a sentence that names a scenario and its moving walls."""
    details = list(label.details)
    if label.moving:
        verb = "wall moves"
        if len(label.moving) > 1:
            verb = "walls move"
        details.append(f"{' and '.join(label.moving)} {verb} (orange)")
    if label.is_slice:
        details.append(f"a slice {SLICE}, and the vorticity across it")
    if not details:
        return f"Scenario {scenario}."
    return f"Scenario {scenario}: {', '.join(details)}."
