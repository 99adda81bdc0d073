"""Maps of the score grid: velocity, vorticity and its error.

Particles by material, truth above predictions, six times (Figs. 4.11 to 4.13).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from lagbench.data.scenario import MATERIALS
from lagbench.draw.style import MATERIAL_COLOURS, rgb
from lagbench.metrics.frame import FramePair, Snapshot
from lagbench.scoring.task import ScoredTask

from .html import Markup, join, tag
from .page import Figure, grid, image, key, ramp
from .png import diverging, encode, sequential
from .subject import Gallery, Moment, Subject, Walls

__all__ = [
    "field_figure",
    "inside",
    "limit_of",
    "scenario_figure",
    "vorticity_figure",
    "paint",
    "particle_figures",
]


Floats = NDArray[np.float64]

TOP = 99.5
"""Full colour is the percentile of the truth's magnitudes."""


def inside(task: ScoredTask, field: Floats) -> Floats:
    """Return the nodes of a field that lie within the walls, shape [x node, y node]."""
    grid_ = task.setting.grid
    kept = []
    for low, high in task.size.bounds:
        room = 0.26 * grid_.spacing  # nodes on a wall are seen, those in it are not
        kept.append((grid_.axis >= low - room) & (grid_.axis <= high + room))
    return field[np.ix_(*kept)]


def limit_of(fields: Sequence[Floats]) -> float:
    """Return the magnitude of full colour: what almost all nodes stay below."""
    values = np.concatenate([np.abs(field[np.isfinite(field)]) for field in fields])
    top = float(np.percentile(values, TOP)) if values.size else 0.0
    return top if np.isfinite(top) and top > 0.0 else 1.0


def field_figure(subject: Subject, gallery: Gallery) -> Figure:
    """Return velocity and vorticity of all entries at the key frame (Fig. 5.17)."""
    scenario, frame = subject.scenarios[0], subject.key_frame
    moment, walls = gallery.moments[scenario, frame], gallery.walls[scenario]
    speeds = [_speed(moment.pairs[0], true=True), *(_speed(pair) for pair in moment.pairs)]
    omegas = [moment.true_vorticity, *(_vorticity(pair) for pair in moment.pairs)]
    errors = [omega - omegas[0] for omega in omegas]
    fast, strong = limit_of(speeds[:1]), limit_of(omegas[:1])
    names = ["truth", *(entry.name for entry in subject.entries)]

    def pictures(what: str, fields: Sequence[Floats], limit: float, *, signed: bool) -> list[Markup]:
        draw = diverging if signed else sequential
        return [
            image(draw(inside(subject.task, f), limit), walls, f"{what} of {n}, frame {frame}")
            for n, f in zip(names, fields, strict=True)
        ]

    rows = [
        ("speed", pictures("speed", speeds, fast, signed=False)),
        ("vorticity", pictures("vorticity", omegas, strong, signed=True)),
        ("vorticity error", [tag("span"), *pictures("vorticity error", errors, strong, signed=True)[1:]]),
    ]
    keys = [
        ramp("sequential", fast, "speed [length/frame]"),
        ramp("diverging", strong, "vorticity and its error [1/frame]", signed=True),
    ]
    return Figure(
        name="fields",
        title=f"Fields side by side at frame {frame}",
        thesis="Fig. 5.17",
        body=join([*keys, grid(names, rows, width=8.5)]),
        caption=join(
            [
                _where(scenario, walls),
                " Grey: nodes that are not compared; the colours are those of the truth's range.",
            ]
        ),
        wide=True,
    )


def vorticity_figure(subject: Subject, gallery: Gallery) -> Figure:
    """Return vorticity over time: truth, predictions, differences (Figs. 5.25 to 5.27)."""
    scenario = subject.scenarios[0]
    moments, walls = gallery.at(scenario, subject.times), gallery.walls[scenario]
    limit = limit_of([moment.true_vorticity for moment in moments])

    def picture(field: Floats, what: str, frame: int) -> Markup:
        return image(diverging(inside(subject.task, field), limit), walls, f"{what}, frame {frame}")

    rows = [("truth", [picture(m.true_vorticity, "true vorticity", m.frame) for m in moments])]
    for i, entry in enumerate(subject.entries):
        fields = [_vorticity(moment.pairs[i]) for moment in moments]
        rows.append(
            (entry.name, [picture(f, "predicted", m.frame) for f, m in zip(fields, moments, strict=True)])
        )
        differences = [field - m.true_vorticity for field, m in zip(fields, moments, strict=True)]
        rows.append(
            (
                "difference",
                [picture(f, "difference", m.frame) for f, m in zip(differences, moments, strict=True)],
            )
        )
    return Figure(
        name="vorticity",
        title="Vorticity over time",
        thesis="Figs. 5.25–5.27",
        body=join(
            [
                ramp("diverging", limit, "vorticity [1/frame]", signed=True),
                grid([f"frame {moment.frame}" for moment in moments], rows),
            ]
        ),
        caption=join([_where(scenario, walls), " Difference: predicted − true, on the same scale."]),
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
                gallery.walls[moment.scenario],
                f"{what}, scenario {moment.scenario}",
            )
            for field, limit, moment in zip(fields, limits, moments, strict=True)
        ]

    rows = [("truth", pictures("true vorticity", [moment.true_vorticity for moment in moments]))]
    for i, entry in enumerate(subject.entries):
        rows.append((entry.name, pictures("predicted", [_vorticity(m.pairs[i]) for m in moments])))
    columns = [
        join([f"scenario {m.scenario}", *_short(gallery.walls[m.scenario])], tag("br")) for m in moments
    ]
    return Figure(
        name="every-scenario",
        title=f"Every test scenario at frame {frame}",
        thesis="Figs. 5.26, 5.27",
        body=grid(columns, rows, width=5.0),
        caption=tag(
            "span",
            "Vorticity; each column has a colour scale of its own, set by its truth. Orange edges move.",
        ),
        wide=True,
    )


def _short(walls: Walls) -> list[str]:
    parts = [walls.mark] if walls.mark else []
    return parts + ([f"Re {walls.reynolds:.0f}"] if walls.reynolds is not None else [])


def _where(scenario: int, walls: Walls) -> str:
    said = f"Scenario {scenario}"
    details = _short(walls)
    if walls.moving:
        verb = "walls move" if len(walls.moving) > 1 else "wall moves"
        details.append(f"{' and '.join(walls.moving)} {verb} (orange)")
    return f"{said}: {', '.join(details)}." if details else f"{said}."


def _vorticity(pair: FramePair) -> Floats:
    """Return the predicted vorticity where it is compared, NaN elsewhere."""
    return np.where(pair.nodes, pair.predicted_fields.vorticity, np.nan)


def _speed(pair: FramePair, *, true: bool = False) -> Floats:
    """Return the speed at the nodes that count [length/frame], NaN elsewhere."""
    held = pair.truth.fields if true else pair.predicted_fields
    speed = np.sqrt((held.velocity**2).sum(axis=-1))
    return np.where(held.counted, speed, np.nan)


SIDE = 176
"""Side of a painted panel [pixel]."""

FINE = 3
"""Panels are painted so many times larger and averaged, which smooths the rims of the dots."""

DOT = 1.3
"""Diameter of a dot in particle distances."""

ROWS = 24
"""Most rows of panels on the page; more would make it too heavy."""

SHADES = FINE * FINE


def particle_figures(subject: Subject, gallery: Gallery) -> Iterator[Figure]:
    """Yield one figure per scenario, as many as there is room for."""
    per_scenario = 1 + len(subject.entries)
    shown = subject.scenarios[: max(1, ROWS // per_scenario)]
    for scenario in shown:
        left_out = len(subject.scenarios) - len(shown) if scenario == shown[-1] else 0
        yield _figure(subject, gallery, scenario, left_out=left_out)


def _figure(subject: Subject, gallery: Gallery, scenario: int, *, left_out: int) -> Figure:
    moments, walls = gallery.at(scenario, subject.times), gallery.walls[scenario]
    rows = [("truth", [_panel(subject, gallery, m, m.truth, "truth") for m in moments])]
    for i, entry in enumerate(subject.entries):
        panels = [_panel(subject, gallery, m, m.pairs[i].prediction, "prediction") for m in moments]
        rows.append((entry.name, panels))
    present = np.unique(moments[0].setting_of.material).tolist()
    seconds = [f"frame {m.frame}\u2002{m.frame * subject.task.size.frame_interval:.2f} s" for m in moments]
    more = f" For want of room {left_out} more test scenarios are not drawn." if left_out else ""
    what = f": {walls.mark}" if walls.mark else ""
    return Figure(
        name=f"particles-{scenario}",
        title=f"Particles, scenario {scenario}{what}",
        thesis="Fig. 4.11" if len(present) == 1 and present[0] == 0 else "Figs. 4.12, 4.13",
        body=join([key([(f"m{m}", MATERIALS[m]) for m in present], kind="square"), grid(seconds, rows)]),
        caption=join(
            [f"All particles by material, truth above predictions, inside the walls of the box.{more}"]
        ),
        wide=True,
    )


def _panel(subject: Subject, gallery: Gallery, moment: Moment, snapshot: Snapshot, what: str) -> Markup:
    material, area = moment.setting_of.material, moment.setting_of.area
    spacing = float(np.sqrt(area / len(material)))
    png = paint(snapshot.position, material, subject.task.size.bounds, spacing)
    return image(png, gallery.walls[moment.scenario], f"{what}, frame {moment.frame}", smooth=True)


def paint(
    position: NDArray[np.floating],
    material: NDArray[np.integer],
    bounds: tuple[tuple[float, float], tuple[float, float]],
    spacing: float,
) -> bytes:
    """Return the particles inside the box as PNG; later particles lie on earlier ones.

    Args:
        position: positions [length], shape [particle, 2].
        material: material of each particle, shape [particle].
        bounds: walls of the box along x and along y [length].
        spacing: distance of neighbouring particles at first [length].
    """
    (left, right), (bottom, top) = bounds
    fine = SIDE * FINE
    disc = _disc(DOT * spacing / (right - left) * fine)
    margin = int(np.abs(disc).max()) + 1
    x, y = position.T
    shown = (x >= left) & (x <= right) & (y >= bottom) & (y <= top)
    column = np.minimum((x[shown] - left) / (right - left) * fine, fine - 1).astype(np.intp) + margin
    row = np.minimum((top - y[shown]) / (top - bottom) * fine, fine - 1).astype(np.intp) + margin
    canvas = np.zeros((fine + 2 * margin, fine + 2 * margin), np.uint8)
    colour = np.asarray(material)[shown].astype(np.uint8) + 1
    canvas[row[:, None] + disc[0], column[:, None] + disc[1]] = colour[:, None]
    return encode(_averaged(canvas[margin:-margin, margin:-margin]), _PALETTE)


def _disc(diameter: float) -> NDArray[np.intp]:
    """Return rows and columns of a dot's pixels from its middle, shape [2, pixel]."""
    reach = int(np.ceil(diameter / 2))
    offsets = np.mgrid[-reach : reach + 1, -reach : reach + 1].reshape(2, -1)
    inside = (offsets**2).sum(axis=0) <= max(diameter / 2, 0.5) ** 2
    return offsets[:, inside]


def _averaged(canvas: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return an image FINE times smaller: the commonest material of a block, as opaque as it is full."""
    blocks = canvas.reshape(SIDE, FINE, SIDE, FINE)
    counts = np.stack([(blocks == m + 1).sum(axis=(1, 3)) for m in range(len(MATERIALS))])
    filled = counts.sum(axis=0)
    entry = np.argmax(counts, axis=0) * SHADES + filled
    return np.where(filled > 0, entry, 0).astype(np.uint8)


def _palette() -> NDArray[np.uint8]:
    """Return nothing, then every material in every opacity, shape [entry, 4]."""
    table = np.zeros((1 + len(MATERIALS) * SHADES, 4), np.uint8)
    for m, colour in enumerate(MATERIAL_COLOURS):
        part = slice(1 + m * SHADES, 1 + (m + 1) * SHADES)
        table[part, :3] = rgb(colour)
        table[part, 3] = np.round(255.0 * np.arange(1, SHADES + 1) / SHADES)
    return table


_PALETTE = _palette()
