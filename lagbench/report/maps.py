"""Maps: velocity, vorticity and its error on the score grid; particles by material
(Figs. 4.11 to 4.13).

They are small PNG pictures of indexed colours with opacity, which suit light and dark
pages: nothing is drawn where the page is to shine through. The same pixels give the
same bytes.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from lagbench.data import MATERIALS
from lagbench.draw.style import MATERIAL_COLOURS, rgb
from lagbench.metrics.frame import FramePair, Snapshot
from lagbench.scoring.task import ScoredTask

from .html import Figure, Markup, grid, image, join, key, ramp, tag
from .subject import Gallery, Moment, Subject, Walls, limit_of

Floats = NDArray[np.float64]

Bytes = NDArray[np.uint8]

Draw = Callable[[Floats, float], bytes]
"""From a field, shape [x node, y node], and the value of full colour to a picture."""

CLOCKWISE = "#0072b2"
COUNTER = "#d55e00"
FAST = "#009e73"
"""Colours of negative and positive values and of great magnitudes (Okabe & Ito 2008).
"""

LEVELS = 100  # steps of opacity on either side of 0
NOTHING = 2 * LEVELS + 1  # entry of the palette for nodes without a value
VOID = (128, 128, 128, 34)  # their red, green, blue and opacity


def encode(index: Bytes, palette: Bytes) -> bytes:
    """Return an indexed PNG of the palette's entry per pixel, first row at the top,
    shape [row, column].
    """
    height, width = index.shape
    rows = np.concatenate([np.zeros((height, 1), np.uint8), index], axis=1)
    parts = [
        (b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 3, 0, 0, 0)),
        (b"PLTE", palette[:, :3].tobytes()),
        (b"tRNS", palette[:, 3].tobytes()),
        (b"IDAT", zlib.compress(rows.tobytes(), 9)),
        (b"IEND", b""),
    ]
    whole = b"\x89PNG\r\n\x1a\n"
    for name, data in parts:
        whole += (
            struct.pack(">I", len(data))
            + name
            + data
            + struct.pack(">I", zlib.crc32(name + data))
        )
    return whole


def diverging(field: NDArray[np.floating], limit: float) -> bytes:
    """Return a picture of signed values: blue below 0, vermilion above, clear at 0,
    full at the limit.
    """
    return _coloured(field, limit, _DIVERGING)


def sequential(field: NDArray[np.floating], limit: float) -> bytes:
    """Return a picture of magnitudes: clear at 0, green at the limit."""
    return _coloured(field, limit, _SEQUENTIAL)


def _coloured(field: NDArray[np.floating], limit: float, palette: Bytes) -> bytes:
    """Return values at nodes, NaN where there is none, shape [x node, y node], as rows
    from the top.
    """
    share = np.clip(np.nan_to_num(field / limit, nan=0.0), -1.0, 1.0)
    index = np.where(np.isnan(field), NOTHING, np.round(LEVELS + LEVELS * share))
    return encode(np.ascontiguousarray(index.T[::-1]).astype(np.uint8), palette)


def _ramp(below: str, above: str) -> Bytes:
    side = np.arange(-LEVELS, LEVELS + 1)
    table = np.empty((NOTHING + 1, 4), np.uint8)
    table[:-1, :3] = np.where(side[:, None] < 0, rgb(below), rgb(above))
    table[:-1, 3] = np.round(255.0 * np.abs(side) / LEVELS)
    table[NOTHING] = VOID
    return table


_DIVERGING = _ramp(CLOCKWISE, COUNTER)
_SEQUENTIAL = _ramp(FAST, FAST)


def inside(task: ScoredTask, field: Floats) -> Floats:
    """Return the nodes of a field that lie within the walls, shape [x node, y node]."""
    axis = task.config.grid.axis
    room = 0.26 * task.config.grid.spacing  # nodes in a wall are not seen
    kept = [
        (axis >= low - room) & (axis <= high + room) for low, high in task.size.bounds
    ]
    return field[np.ix_(*kept)]


def field_figure(subject: Subject, gallery: Gallery) -> Figure:
    """Return velocity and vorticity of all entries at the key frame (Fig. 5.17)."""
    scenario = subject.scenarios[0]
    frame = subject.key_frame
    moment = gallery.moments[scenario, frame]
    walls = gallery.walls[scenario]
    flows = [moment.truth.fields, *(pair.predicted_fields for pair in moment.pairs)]
    # NaN at nodes that do not count
    speeds = [
        np.where(flow.counted, np.sqrt((flow.velocity**2).sum(axis=-1)), np.nan)
        for flow in flows
    ]
    omegas = [moment.true_vorticity, *(_vorticity(pair) for pair in moment.pairs)]
    errors = [omega - omegas[0] for omega in omegas]
    fast = limit_of(speeds[:1])
    strong = limit_of(omegas[:1])
    names = ["truth", *(entry.name for entry in subject.entries)]

    def pictures(
        what: str, fields: Sequence[Floats], draw: Draw, limit: float
    ) -> list[Markup]:
        return [
            image(
                draw(inside(subject.task, f), limit),
                walls.classes,
                f"{what} of {n}, frame {frame}",
            )
            for n, f in zip(names, fields, strict=True)
        ]

    rows = [
        ("speed", pictures("speed", speeds, sequential, fast)),
        ("vorticity", pictures("vorticity", omegas, diverging, strong)),
        (
            "vorticity error",
            [tag("span"), *pictures("vorticity error", errors, diverging, strong)[1:]],
        ),
    ]
    keys = [
        ramp("sequential", fast, "speed [length/frame]"),
        ramp("diverging", strong, "vorticity and its error [1/frame]", signed=True),
    ]
    grey = " Grey: nodes that are not compared; the colours are those of the truth's range."
    return Figure(
        name="fields",
        title=f"Fields side by side at frame {frame}",
        thesis="Fig. 5.17",
        body=join([*keys, grid(names, rows, width=8.5)]),
        caption=_where(scenario, walls) + grey,
        wide=True,
    )


def vorticity_figure(subject: Subject, gallery: Gallery) -> Figure:
    """Return vorticity over time: truth, predictions, differences (Figs. 5.25 to
    5.27).
    """
    scenario = subject.scenarios[0]
    moments = gallery.at(scenario, subject.times)
    walls = gallery.walls[scenario]
    frames = [f"frame {moment.frame}" for moment in moments]
    limit = limit_of([moment.true_vorticity for moment in moments])

    def picture(field: Floats, what: str, frame: int) -> Markup:
        return image(
            diverging(inside(subject.task, field), limit),
            walls.classes,
            f"{what}, frame {frame}",
        )

    rows = [
        (
            "truth",
            [picture(m.true_vorticity, "true vorticity", m.frame) for m in moments],
        )
    ]
    for i, entry in enumerate(subject.entries):
        fields = [(_vorticity(m.pairs[i]), m) for m in moments]
        rows.append(
            (entry.name, [picture(field, "predicted", m.frame) for field, m in fields])
        )
        apart = [
            picture(field - m.true_vorticity, "difference", m.frame)
            for field, m in fields
        ]
        rows.append(("difference", apart))
    return Figure(
        name="vorticity",
        title="Vorticity over time",
        thesis="Figs. 5.25–5.27",
        body=join(
            [
                ramp("diverging", limit, "vorticity [1/frame]", signed=True),
                grid(frames, rows),
            ]
        ),
        caption=f"{_where(scenario, walls)} Difference: predicted − true, on the "
        f"same scale.",
        wide=True,
    )


def scenario_figure(subject: Subject, gallery: Gallery) -> Figure:
    """Return vorticity at the key frame in every test scenario (Figs. 5.26, 5.27)."""
    frame = subject.key_frame
    moments = [gallery.moments[scenario, frame] for scenario in subject.scenarios]
    limits = [limit_of([moment.true_vorticity]) for moment in moments]

    def pictures(what: str, fields: Sequence[Floats]) -> list[Markup]:
        return [
            image(
                diverging(inside(subject.task, field), limit),
                gallery.walls[moment.scenario].classes,
                f"{what}, scenario {moment.scenario}",
            )
            for field, limit, moment in zip(fields, limits, moments, strict=True)
        ]

    rows = [
        (
            "truth",
            pictures("true vorticity", [moment.true_vorticity for moment in moments]),
        )
    ]
    for i, entry in enumerate(subject.entries):
        rows.append(
            (
                entry.name,
                pictures("predicted", [_vorticity(m.pairs[i]) for m in moments]),
            )
        )
    columns = [
        join([f"scenario {m.scenario}", *_short(gallery.walls[m.scenario])], tag("br"))
        for m in moments
    ]
    said = "Vorticity; each column has a colour scale of its own, set by its truth. Orange edges move."
    return Figure(
        name="every-scenario",
        title=f"Every test scenario at frame {frame}",
        thesis="Figs. 5.26, 5.27",
        body=grid(columns, rows, width=5.0),
        caption=tag("span", said),
        wide=True,
    )


def _short(walls: Walls) -> list[str]:
    if walls.mark:
        parts = [walls.mark]
    else:
        parts = []
    return parts + ([f"Re {walls.reynolds:.0f}"] if walls.reynolds is not None else [])


def _where(scenario: int, walls: Walls) -> str:
    details = _short(walls)
    if walls.moving:
        if len(walls.moving) > 1:
            verb = "walls move"
        else:
            verb = "wall moves"
        details.append(f"{' and '.join(walls.moving)} {verb} (orange)")
    return f"Scenario {scenario}" + (f": {', '.join(details)}." if details else ".")


def _vorticity(pair: FramePair) -> Floats:
    """Return the predicted vorticity where it is compared, NaN elsewhere."""
    return np.where(pair.nodes, pair.predicted_fields.vorticity, np.nan)


SIDE = 176  # side of a painted panel [pixel]
# panels are painted so many times larger and averaged, which smooths the rims of the
# dots
FINE = 3
DOT = 1.3  # diameter of a dot in particle distances
ROWS = 24  # most rows of panels on the page; more would make it too heavy

SHADES = FINE * FINE


def particle_figures(subject: Subject, gallery: Gallery) -> Iterator[Figure]:
    """Yield one figure per scenario, as many as there is room for."""
    shown = subject.scenarios[: max(1, ROWS // (1 + len(subject.entries)))]
    for scenario in shown:
        moments = gallery.at(scenario, subject.times)
        walls = gallery.walls[scenario]
        rows = [
            ("truth", [_panel(subject, gallery, m, m.truth, "truth") for m in moments])
        ]
        for i, entry in enumerate(subject.entries):
            panels = [
                _panel(subject, gallery, m, m.pairs[i].prediction, "prediction")
                for m in moments
            ]
            rows.append((entry.name, panels))
        present = np.unique(moments[0].truth.scenario.material).tolist()
        interval = subject.task.size.frame_interval
        seconds = [f"frame {m.frame}\u2002{m.frame * interval:.2f} s" for m in moments]
        said = "All particles by material, truth above predictions, inside the walls of the box."
        left_out = len(subject.scenarios) - len(shown)
        if left_out and scenario == shown[-1]:
            said += f" For want of room {left_out} more test scenarios are not drawn."
        yield Figure(
            name=f"particles-{scenario}",
            title=f"Particles, scenario {scenario}"
            + (f": {walls.mark}" if walls.mark else ""),
            thesis="Fig. 4.11"
            if len(present) == 1 and present[0] == 0
            else "Figs. 4.12, 4.13",
            body=join(
                [
                    key([(f"m{m}", MATERIALS[m]) for m in present], kind="square"),
                    grid(seconds, rows),
                ]
            ),
            caption=said,
            wide=True,
        )


def _panel(
    subject: Subject, gallery: Gallery, moment: Moment, snapshot: Snapshot, what: str
) -> Markup:
    material = snapshot.scenario.material
    spacing = float(np.sqrt(snapshot.scenario.area / len(material)))
    png = paint(snapshot.position, material, subject.task.size.bounds, spacing)
    return image(
        png,
        gallery.walls[moment.scenario].classes,
        f"{what}, frame {moment.frame}",
        smooth=True,
    )


def paint(
    position: NDArray[np.floating],
    material: NDArray[np.integer],
    bounds: tuple[tuple[float, float], tuple[float, float]],
    spacing: float,
) -> bytes:
    """Return the particles inside the box as PNG; later particles lie on earlier ones.

    Bounds are the walls along x and y, spacing is the distance of neighbouring
    particles at first [length].
    """
    (left, right), (bottom, top) = bounds
    fine = SIDE * FINE
    # rows and columns of a dot's pixels from its middle
    diameter = DOT * spacing / (right - left) * fine
    reach = int(np.ceil(diameter / 2))
    offsets = np.mgrid[-reach : reach + 1, -reach : reach + 1].reshape(2, -1)
    disc = offsets[:, (offsets**2).sum(axis=0) <= max(diameter / 2, 0.5) ** 2]
    margin = int(np.abs(disc).max()) + 1
    x, y = position.T
    shown = (x >= left) & (x <= right) & (y >= bottom) & (y <= top)
    column = (
        np.minimum((x[shown] - left) / (right - left) * fine, fine - 1).astype(np.intp)
        + margin
    )
    row = (
        np.minimum((top - y[shown]) / (top - bottom) * fine, fine - 1).astype(np.intp)
        + margin
    )
    canvas = np.zeros((fine + 2 * margin, fine + 2 * margin), np.uint8)
    colour = np.asarray(material)[shown].astype(np.uint8) + 1
    canvas[row[:, None] + disc[0], column[:, None] + disc[1]] = colour[:, None]
    # the commonest material of a block, as opaque as the block is full
    blocks = canvas[margin:-margin, margin:-margin].reshape(SIDE, FINE, SIDE, FINE)
    counts = np.stack(
        [(blocks == m + 1).sum(axis=(1, 3)) for m in range(len(MATERIALS))]
    )
    filled = counts.sum(axis=0)
    entry = np.argmax(counts, axis=0) * SHADES + filled
    return encode(np.where(filled > 0, entry, 0).astype(np.uint8), _PALETTE)


# nothing, then every material in every opacity, shape [entry, 4]
_PALETTE = np.round(
    [
        (0, 0, 0, 0),
        *(
            (*rgb(colour), 255 * k / SHADES)
            for colour in MATERIAL_COLOURS
            for k in range(1, SHADES + 1)
        ),
    ]
).astype(np.uint8)
