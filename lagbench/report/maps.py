"""Maps of the score grid: velocity, vorticity and its error."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lagbench.exam import Exam
from lagbench.metrics import FramePair

from .gallery import Gallery, Walls
from .markup import Markup, join, tag
from .page import Figure
from .panels import grid, image, ramp
from .png import diverging, sequential
from .subject import Subject

__all__ = ["field_figure", "inside", "limit_of", "scenario_figure", "vorticity_figure"]

Floats = NDArray[np.float64]

TOP = 99.5
"""Full colour is the percentile of the truth's magnitudes."""


def inside(exam: Exam, field: Floats) -> Floats:
    """Return the nodes of a field that lie within the walls, shape [x node, y node]."""
    grid_ = exam.setting.grid
    kept = []
    for low, high in exam.size.bounds:
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
            image(draw(inside(subject.exam, f), limit), walls, f"{what} of {n}, frame {frame}")
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
        return image(diverging(inside(subject.exam, field), limit), walls, f"{what}, frame {frame}")

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
                diverging(inside(subject.exam, field), limit),
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
