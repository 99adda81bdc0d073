"""What the page's script draws: curves, films, maps and what opens for an entry.

Scores stand in the table's cells and nowhere else. Arrays are packed, twelve bits a
number, two letters each, films one letter; whatever occurs twice (frames, fields of the
truth) stands once, in ``pool``.

>>> pack([0.0, 0.5, 1.0, float("nan")])
['AAf__-__', 0.0, 1.0, 0]
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lagbench.data.checksums import round_digits
from lagbench.figures.html import MISSING as NOTHING
from lagbench.figures.html import text, words

from .model import Board, Curve, Histogram, Pictures, ReferenceRow, Row, Tab


class Fineness(NamedTuple):
    """How much of the pictures the page holds."""

    film_frames: int
    particles: int  # of a film
    maps: int  # frames of vorticity maps and histograms
    nodes: int  # of a map, a side


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

DIGITS = np.frombuffer(
    b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789-_", np.uint8
)
"""Letters that need no escape in HTML, JSON or a URL."""

LEVELS = 4094  # greatest packed value
MISSING = 4095  # what stands for NaN
DEEPEST = 1e-9  # a logarithmic range reaches no lower than this share of its top
MOST_STEPS = 31  # steps of a film's letter to either side of where a particle was going

Packed = list[str | float | int]
"""Text, least value, greatest value, and 1 where the steps are those of the logarithm.
"""

PackedFilm = list[str | float | int]
"""Text, least value, greatest value, 2, numbers of a frame, and the farthest that a
letter reaches.
"""


def payload(board: Board, fineness: Fineness = FINENESS[0]) -> dict[str, Any]:
    """Return everything that the page's script draws beside the tables."""
    writer = _Writer(fineness)
    return {"tabs": [writer.tab(tab) for tab in board.tabs], "pool": writer.pool}


def _numbers(values: Sequence[float]) -> list[float | str | None]:
    """Return numbers as JSON knows them: None for NaN, text for what is infinite."""
    return [
        None if math.isnan(x) else round_digits(x, 4) if math.isfinite(x) else f"{x}"
        for x in values
    ]


@dataclass
class _Writer:
    """Turns a board into plain values."""

    fineness: Fineness
    pool: list[Any] = field(default_factory=list)  # what is referred to by number
    _known: dict[str, int] = field(default_factory=dict)

    def tab(self, tab: Tab) -> dict[str, Any]:
        """Return a tab."""
        scale = float(np.nanmax(np.abs(tab.truth.vorticity), initial=0.0)) or 1.0
        return {
            "id": tab.id,
            "split": tab.size.split,
            "size": tab.size.name,
            "scenarios": list(tab.scenarios),
            "frames": [tab.frames[0], tab.frames[-1]],
            "marked": list(tab.marked),
            "ranking": tab.ranking,
            "curves": [{"key": name, "label": words(name)} for name in tab.curves],
            "energy": self._curve(tab.energy),
            "truth": self._pictures(tab.truth, scale),
            "floors": [
                {"id": floor.name, "name": floor.name, **self._series(floor, tab)}
                for floor in tab.floors
            ],
            "rows": [self._row(row, tab, scale) for row in tab.rows],
        }

    def _series(self, row: Row | ReferenceRow, tab: Tab) -> dict[str, Any]:
        """Return curves of a row, and the means of each scenario of the main
        metrics.
        """
        values = row.values
        return {
            "curves": {name: self._curve(curve) for name, curve in row.curves.items()},
            "energy": row.energy and self._curve(row.energy),
            "spread": {
                name: _numbers(values[name].per_scenario)
                for name in tab.columns
                if name in values
            },
        }

    def _row(self, row: Row, tab: Tab, scale: float) -> dict[str, Any]:
        entry = row.entry
        line = row.verified
        verified = "as submitted"
        if line:
            verified = (
                f"verified by the maintainers, lagbench {line.lagbench}, {line.date}"
            )
        about = {
            "training": entry.training,
            "hardware, self-reported": entry.hardware,
            "seeds": str(len(entry.predictions)),
            "licence": entry.licence,
            "submitted": f"{entry.date}, scored by lagbench {entry.score.lagbench}",
            "scores": verified,
            "notes": entry.notes,
        }
        predictions = [
            [
                NOTHING if made.seed is None else str(made.seed),
                text(mean),
                NOTHING if made.bytes is None else f"{text(made.bytes / 1e6)} MB",
                *(made.sha256, made.url, made.path, path.as_posix()),
            ]
            for made, mean, path in zip(
                entry.predictions, row.seed_means, entry.score_paths, strict=True
            )
        ]
        standing = "Not ranked."
        if row.rank is not None:
            if row.tied:
                told = "cannot be told from the leader at 5 %"
            else:
                told = "differs from the leader"
            if math.isnan(row.p):
                against = ""
            else:
                against = f"; it {told} (p = {text(row.p, 2)}, corrected)"
            if len(predictions) == 1:
                weights = "These weights: one seed only. "
            else:
                weights = ""
            standing = f"{weights}Rank {row.rank}{against}."
        return {
            "id": row.id,
            "name": entry.name,
            "active": row.active,
            "standing": standing,
            **self._series(row, tab),
            "at": {
                name: _numbers([value.at.get(frame, math.nan) for frame in tab.marked])
                for name in tab.columns
                if (value := row.values.get(name)) and value.at
            },
            "pictures": self._pictures(row.pictures, scale),
            "residuals": [
                self._histogram(row.residuals[i])
                for i in self._shown(tab.truth.map_frames)
            ],
            "command": entry.command,
            "about": [[name, said] for name, said in about.items() if said],
            "predictions": predictions,
        }

    def _curve(self, curve: Curve) -> dict[str, int]:
        return {
            "frames": self._pooled(list(curve.frames)),
            **{
                end: self._pooled(pack(getattr(curve, end), log=True))
                for end in ("mean", "low", "high")
            },
        }

    def _histogram(self, histogram: Histogram) -> list[Any]:
        low = round_digits(histogram.low, 6)
        high = round_digits(histogram.high, 6)
        return [low, high, self._pooled(pack(histogram.shares))]

    def _pictures(self, pictures: Pictures, scale: float) -> dict[str, Any]:
        """Return maps and film; values beyond four times the truth's greatest are cut
        off.
        """
        maps = self._shown(pictures.map_frames)
        film = spaced(len(pictures.film_frames), self.fineness.film_frames)
        particles = spaced(len(pictures.material), self.fineness.particles)
        fields = coarse(pictures.vorticity[maps], self.fineness.nodes)
        limits = (-4.0 * scale, 4.0 * scale)
        return {
            "scenario": pictures.scenario,
            "mapFrames": self._pooled([pictures.map_frames[i] for i in maps]),
            "nodes": fields.shape[-1],
            "maps": [self._pooled(pack(np.clip(one, *limits))) for one in fields],
            "histograms": [self._histogram(pictures.histograms[i]) for i in maps],
            "filmFrames": self._pooled([pictures.film_frames[i] for i in film]),
            "material": self._pooled(pictures.material[particles].tolist()),
            "film": self._pooled(pack_film(pictures.film[film][:, particles])),
        }

    def _shown(self, frames: Sequence[int]) -> list[int]:
        return spaced(len(frames), self.fineness.maps)

    def _pooled(self, value: list[Any]) -> int:
        said = json.dumps(value)
        if said not in self._known:
            self._known[said] = len(self.pool)
            self.pool.append(value)
        return self._known[said]


def pack(
    values: ArrayLike, *, limits: tuple[float, float] | None = None, log: bool = False
) -> Packed:
    """Return values in 4094 equal steps between the least and the greatest."""
    x = np.asarray(values, np.float64).ravel()
    known = x[np.isfinite(x)]
    low, high = limits or (
        (float(known.min()), float(known.max())) if known.size else (0.0, 1.0)
    )
    # what is smaller still cannot be written with a few digits: its ends may read back
    # as zero
    logarithmic = (
        log and bool(known.size) and low >= 0.0 and high > sys.float_info.min / DEEPEST
    )
    if logarithmic:
        positive = known[known > DEEPEST * high]
        low = float(positive.min())
        share = _share(np.log(np.clip(x, low, high)), math.log(low), math.log(high))
    else:
        share = _share(np.clip(x, low, high), low, high)
    steps = np.where(
        np.isfinite(x), np.rint(np.nan_to_num(share) * LEVELS), MISSING
    ).astype(np.int64)
    letters = np.stack([DIGITS[steps >> 6], DIGITS[steps & 63]], axis=-1)
    return [
        letters.tobytes().decode("ascii"),
        round_digits(low, 6),
        round_digits(high, 6),
        int(logarithmic),
    ]


def pack_film(
    film: ArrayLike, *, limits: tuple[float, float] = (-0.5, 1.5)
) -> PackedFilm:
    """Return positions over frames: the first as `pack` does, then one letter a number.

    A letter says how far a coordinate is from where it was going at constant velocity:
    sign(k) k^2 / 31^2 of the greatest such distance, k from -31 to 31, so that slow
    particles stand still and fast ones stay on their way. What was rounded off is made
    up for in the next frame. Positions are finite, shape [frame, particle, 2]; limits
    are those of the first frame [length].
    """
    wanted = np.asarray(film, np.float64)
    wanted = wanted.reshape(len(wanted), -1)
    low, high = limits
    start = np.clip(wanted[0], low, high)
    letters = [str(pack(start, limits=limits)[0])]
    now = low + (high - low) * np.rint(_share(start, low, high) * LEVELS) / LEVELS
    before = now
    # beside standing still, then constant velocity
    going = np.diff(wanted, 2, axis=0, prepend=wanted[:1])
    # No letter is off by more than 30.5 / 31^2 of the reach; three such errors stand
    # before a letter.
    farthest = float(np.abs(going).max(initial=0.0)) + 1.5 * (high - low) / LEVELS
    reach = round_digits(1.01 * farthest / (1.0 - 3.0 * 30.5 / MOST_STEPS**2), 6)
    for position in wanted[1:]:
        share = np.clip((position - (2.0 * now - before)) / reach, -1.0, 1.0)
        steps = np.sign(share) * np.rint(MOST_STEPS * np.sqrt(np.abs(share)))
        before, now = (
            now,
            2.0 * now - before + reach * steps * np.abs(steps) / MOST_STEPS**2,
        )
        letters.append(
            DIGITS[steps.astype(np.int64) + MOST_STEPS].tobytes().decode("ascii")
        )
    return [
        "".join(letters),
        round_digits(low, 6),
        round_digits(high, 6),
        2,
        wanted.shape[1],
        reach,
    ]


def _share(x: NDArray[np.float64], low: float, high: float) -> NDArray[np.float64]:
    if high > low:
        return (x - low) / (high - low)
    return np.zeros_like(x)


def spaced(length: int, count: int) -> list[int]:
    """Return at most so many evenly spaced indices, first and last included.

    >>> spaced(10, 4), spaced(3, 5), spaced(7, 1)
    ([0, 3, 6, 9], [0, 1, 2], [6])
    """
    if length <= count or count == 1:
        return list(range(length))[-count:]
    return [i * (length - 1) // (count - 1) for i in range(count)]


def coarse(field: NDArray[np.floating], nodes: int) -> NDArray[np.float64]:
    """Return a field, shape [..., x node, y node], with at most so many nodes a side:
    means of known ones.
    """
    side = -(-field.shape[-1] // nodes)
    if side == 1:
        return field.astype(np.float64)
    count = -(-field.shape[-1] // side)
    room = count * side - field.shape[-1]
    pad = [(0, 0)] * (field.ndim - 2) + [(0, room)] * 2
    whole = np.pad(field.astype(np.float64), pad, constant_values=np.nan)
    blocks = whole.reshape(*field.shape[:-2], count, side, count, side)
    known = np.isfinite(blocks)
    number = known.sum(axis=(-3, -1))
    total = np.where(known, blocks, 0.0).sum(axis=(-3, -1))
    return np.where(number > 0, total / np.maximum(number, 1), np.nan)


def embedded(value: object) -> str:
    r"""Return JSON that may stand in an HTML element, whatever the strings in it hold.

    >>> print(embedded({"name": "</script>"}))
    {"name":"\u003c/script\u003e"}
    """
    text = json.dumps(value, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    text = text.encode("utf-8", "replace").decode("utf-8")
    for letter in (
        "<>&\u2028\u2029"
    ):  # they could end an element, start one, or end a line of a script
        text = text.replace(letter, f"\\u{ord(letter):04x}")
    return text
