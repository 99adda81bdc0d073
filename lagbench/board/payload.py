"""What the page's script reads: the board as plain values.

Means keep nine significant digits, other numbers six; arrays are packed, and whatever occurs twice (frames,
fields of the truth) stands once, in ``pool``.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from lagbench.report.html import words

from .columns import COSTS, Column, columns_of, metric_column, presets_of
from .embedding import clean
from .model import Board, Cost, Curve, Detail, Histogram, Pictures, Prediction, RaisedFlag, Row, Tab, Value
from .packing import coarse, pack, rounded, spaced

__all__ = ["FINENESS", "MEAN_DIGITS", "Fineness", "payload", "tab_id"]

MEAN_DIGITS = 9
"""Significant digits of means, as in scores.json; other numbers have six."""


class Fineness(NamedTuple):
    """How much of the pictures the page holds."""

    film_frames: int
    particles: int  # particles of a film
    maps: int  # frames of vorticity maps and histograms
    nodes: int  # nodes of a map a side


FINENESS = (
    Fineness(45, 200, 4, 40),
    Fineness(36, 200, 4, 40),
    Fineness(30, 200, 4, 40),
    Fineness(26, 180, 4, 40),
    Fineness(23, 160, 4, 40),
    Fineness(30, 180, 4, 20),
    Fineness(26, 160, 4, 20),
    Fineness(23, 144, 4, 20),
    Fineness(20, 128, 4, 20),
    Fineness(16, 112, 3, 20),
    Fineness(12, 96, 2, 20),
    Fineness(6, 40, 1, 12),
)
"""From the finest to the coarsest; the page takes the finest that fits."""


def tab_id(tab: Tab) -> str:
    """Return the name of a tab in addresses."""
    return f"{tab.split}-{tab.size}"


def payload(board: Board, fineness: Fineness = FINENESS[0]) -> dict[str, Any]:
    """Return everything that the page's script draws."""
    writer = _Writer(fineness)
    tabs = [writer.tab(tab, board) for tab in board.tabs]
    columns = [*(metric_column(metric) for metric in board.metrics.values()), *COSTS]
    return {
        "columns": {column.key: _column(column) for column in columns},
        "tabs": tabs,
        "pool": writer.pool,
    }


def _column(column: Column) -> dict[str, Any]:
    return {
        "label": clean(column.label),
        "unit": clean(column.unit),
        "direction": str(column.direction),
        "perfect": column.perfect,
        "form": column.form,
        "reported": column.reported,
        "meaning": clean(column.meaning),
    }


def _number(value: float | None, digits: int = 6) -> float | str | None:
    """Return a number as JSON knows it: None for NaN, text for what is infinite."""
    if value is None or math.isnan(value):
        return None
    short = rounded(value, digits)
    if math.isinf(short):
        return "Infinity" if short > 0 else "-Infinity"
    return int(short) if short == int(short) and abs(short) < 1e15 else short


def _numbers(values: Sequence[float]) -> list[float | str | None]:
    return [_number(value) for value in values]


@dataclass
class _Writer:
    """Turns a board into plain values."""

    fineness: Fineness  # how much of the pictures is kept
    pool: list[Any] = field(default_factory=list)  # what is referred to by number
    _known: dict[str, int] = field(default_factory=dict)

    def tab(self, tab: Tab, board: Board) -> dict[str, Any]:
        """Return a tab."""
        keys = columns_of(tab, board.metrics)
        names = [key for key in keys if key in board.metrics]
        scale = float(np.nanmax(np.abs(tab.truth.vorticity), initial=0.0)) or 1.0
        return {
            "id": tab_id(tab),
            "split": tab.split,
            "size": tab.size,
            "title": clean(tab.title),
            "scenarios": list(tab.scenarios),
            "frames": [tab.frames[0], tab.frames[-1]],
            "marked": list(tab.frames_of_interest),
            "interval": tab.frame_interval,
            "ranking": tab.ranking,
            "metrics": names,
            "presets": {name: list(chosen) for name, chosen in presets_of(tab, board.metrics).items()},
            "curves": [{"key": name, "label": words(name)} for name in tab.curves],
            "energy": self._curve(tab.energy),
            "scale": rounded(scale),
            "truth": self._pictures(tab.truth, scale),
            "rows": [self._row(row, names, tab, scale) for row in tab.rows],
        }

    def _row(self, row: Row, names: Sequence[str], tab: Tab, scale: float) -> dict[str, Any]:
        return {
            "id": row.id,
            "name": clean(row.name),
            "authors": clean(", ".join(row.authors)),
            **{key: clean(getattr(row, key)) for key in ("affiliation", "licence", "date", "reason")},
            "code": row.code and clean(row.code),
            "paper": row.paper and clean(row.paper),
            "floor": row.floor,
            "status": row.status,
            "by": row.superseded_by,
            "current": row.current,
            "version": clean(row.dataset_version),
            "rank": row.rank,
            "shared": row.shared,
            "p": _number(row.p),
            "seeds": row.seeds,
            "parameters": row.parameters,
            "cost": _cost(row.cost),
            "flags": [_flag(flag) for flag in row.flags],
            "warnings": [_flag(flag) for flag in row.warnings],
            "diverged": row.diverged,
            "values": [_value(row.values[name]) if name in row.values else None for name in names],
            "spread": {
                name: _numbers([rounded(v, 4) for v in row.values[name].per_scenario])
                for name in tab.columns
                if name in row.values
            },
            "at": {
                name: _numbers([rounded(row.values[name].at[f], 4) for f in tab.frames_of_interest])
                for name in tab.columns
                if name in row.values and row.values[name].at
            },
            **self._detail(row.detail, tab, scale),
        }

    def _detail(self, detail: Detail, tab: Tab, scale: float) -> dict[str, Any]:
        return {
            "curves": {name: self._curve(curve) for name, curve in detail.curves.items()},
            "energy": self._curve(detail.energy),
            "pictures": self._pictures(detail.pictures, scale),
            "residuals": [self._histogram(detail.residuals[i]) for i in self._shown(tab.truth.map_frames)],
            **{key: clean(getattr(detail, key)) for key in ("command", "training", "hardware", "notes")},
            "predictions": [_prediction(found) for found in detail.predictions],
            "scored": clean(f"{detail.scored_by}, lagbench {detail.lagbench_version}"),
        }

    def _curve(self, curve: Curve) -> dict[str, int]:
        return {
            "frames": self._pooled(list(curve.frames)),
            **{name: self._packed(getattr(curve, name), log=True) for name in ("mean", "low", "high")},
        }

    def _histogram(self, histogram: Histogram) -> list[Any]:
        return [rounded(histogram.low), rounded(histogram.high), self._packed(histogram.shares)]

    def _pictures(self, pictures: Pictures, scale: float) -> dict[str, Any]:
        """Return maps and film; values beyond four times the truth's greatest are cut off."""
        maps, film = (
            self._shown(pictures.map_frames),
            spaced(len(pictures.film_frames), self.fineness.film_frames),
        )
        particles = spaced(len(pictures.material), self.fineness.particles)
        fields = coarse(pictures.vorticity[maps], self.fineness.nodes)
        limits = (-4.0 * scale, 4.0 * scale)
        return {
            "scenario": pictures.scenario,
            "mapFrames": self._pooled([pictures.map_frames[i] for i in maps]),
            "nodes": fields.shape[-1],
            "maps": [self._packed(np.clip(one, *limits)) for one in fields],
            "histograms": [self._histogram(pictures.histograms[i]) for i in maps],
            "filmFrames": self._pooled([pictures.film_frames[i] for i in film]),
            "material": self._pooled(pictures.material[particles].tolist()),
            "film": self._packed(pictures.film[film][:, particles], limits=(-0.5, 1.5)),
        }

    def _shown(self, frames: Sequence[int]) -> list[int]:
        return spaced(len(frames), self.fineness.maps)

    def _packed(self, values: ArrayLike, **options: Any) -> int:  # noqa: ANN401
        return self._pooled(pack(values, **options))

    def _pooled(self, value: list[Any]) -> int:
        text = json.dumps(value)
        if text not in self._known:
            self._known[text] = len(self.pool)
            self.pool.append(value)
        return self._known[text]


def _value(value: Value) -> list[float | str | int | None]:
    """Return mean, interval, deviation over seeds, undefined frames; trailing gaps are left out."""
    mean = _number(value.mean, MEAN_DIGITS)
    listed = [mean, *_numbers([value.low, value.high, value.std]), value.undefined or None]
    return listed[: max((i + 1 for i, found in enumerate(listed) if found is not None), default=0)]


def _cost(cost: Cost | None) -> dict[str, Any] | None:
    if cost is None:
        return None
    return {
        "seconds_per_frame": _number(cost.seconds_per_frame),
        "solver_seconds_per_frame": _number(cost.solver_seconds_per_frame),
        "speed_up": _number(cost.speed_up),
        "device": clean(cost.device),
    }


def _flag(flag: RaisedFlag) -> list[Any]:
    return [clean(flag.name), list(_cleaned(flag.reasons))]


def _cleaned(texts: Sequence[str]) -> Iterator[str]:
    return (clean(text) for text in texts)


def _prediction(found: Prediction) -> dict[str, Any]:
    return {
        "seed": found.seed,
        "sha256": clean(found.sha256),
        "url": found.url and clean(found.url),
        "path": found.path and clean(found.path),
        "size": found.size,
        "score": clean(found.score_file),
        "mean": _number(found.mean),
    }
