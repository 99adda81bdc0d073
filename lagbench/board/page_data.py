"""The data that the page's script draws from: tables, curves, maps, films, details.

Everything is plain values for JSON. Long arrays stand in an :class:`ArrayStore`, and a
reference to each of them in the JSON. Infinite numbers are texts there, undefined ones
are null.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagbench.data.box import Box
from lagbench.data.checksums import round_digits
from lagbench.figures.colours import MATERIAL_COLOURS
from lagbench.figures.numbers import MISSING, text, words
from lagbench.figures.solid import View
from lagbench.scoring.scenario import spaced

from .columns import describe_check, format_ranks
from .encoding import ArrayStore, Reference
from .entry import Entry, Status
from .model import (
    BoardRow,
    Curve,
    Floats,
    Histogram,
    Pictures,
    ReferenceRow,
    Tab,
    Value,
)
from .table import heading_of
from .table_view import Line, TableView, describe_verification, target_loss

FILM_FRAMES = 20  # most frames of a film
FILM_PARTICLES = 80  # most particles of a film
CURVE_LEVELS = 2000  # steps of a curve: six to a pixel
MAP_LEVELS = 500  # steps of a vorticity map: more than a colour has
FILM_LEVELS = 1000  # steps across a film: two to a pixel
HISTOGRAM_LEVELS = 500  # steps of a histogram: two to a pixel
OBSTACLE_DIGITS = 4  # of the place and radius of an obstacle in a film
PERIOD_DIGITS = 4  # of a period in a film
SHOWN_DIGITS = 3  # of the values at frames of interest

# Values of maps are cut off at so many times the truth's greatest: an explosion would
# leave nothing of the others.
MAP_RANGE = 4.0

MOST_SPREADS = 8  # most metrics that details show for every scenario

MATERIAL_NAMES = ("liquid", "jelly", "snow", "rope")

COLOURS = {
    "materials": list(MATERIAL_COLOURS),
    "clockwise": MATERIAL_COLOURS[0],
    "counterClockwise": MATERIAL_COLOURS[1],
}
"""Colours of films and maps; those of charts stand in the style sheet."""

Plain = dict[str, Any]
Floats32 = NDArray[np.float32]


def page_data(
    views: Sequence[TableView], hero: tuple[Tab, BoardRow] | None = None
) -> tuple[bytes, bytes]:
    """Return the data of all tabs as JSON, and the arrays that it refers to.

    Args:
        views: the tables of all tabs.
        hero: tab and row whose film stands first on the page.
    """
    arrays = ArrayStore()
    columns: list[Plain] = []  # most tabs have the same ones
    keepers = _list_keepers(views)
    tabs = []
    for view in views:
        tabs.append(_TabWriter(view, arrays, columns, keepers).tab())
    first_film = None
    if hero is not None:
        first_film = _hero(*hero, arrays)
    data = {
        "colours": COLOURS,
        "hero": first_film,
        "columns": columns,
        "tabs": tabs,
        "starts": arrays.starts(),
    }
    encoded = json.dumps(
        data, ensure_ascii=True, allow_nan=False, separators=(",", ":")
    )
    return encoded.encode(), arrays.to_bytes()


@dataclass(frozen=True)
class _Keeper:
    """An entry that may keep the weights of another one."""

    status: Status
    address: str  # of its details on the page


def _list_keepers(views: Sequence[TableView]) -> Mapping[str, _Keeper]:
    """Return the entries of all tabs by place, as in cavity/mini/gns."""
    keepers = {}
    for view in views:
        tab = view.tab
        for row in tab.rows:
            address = f"#tab={tab.id}&entry={row.id}"
            place = "/".join(row.entry.place)
            keepers[place] = _Keeper(row.entry.status, address)
    return keepers


def _hero(tab: Tab, row: BoardRow, arrays: ArrayStore) -> Plain | None:
    """Return the film that stands first, with all its particles and frames."""
    if tab.truth is None or row.pictures is None:
        return None
    films = []
    for pictures in (tab.truth, row.pictures):
        films.append(_add_film(pictures.film, arrays))
    materials = row.pictures.material.tolist()
    return {
        "tab": tab.id,
        "entry": row.id,
        "frames": list(row.pictures.film_frames),
        "material": materials,
        "films": films,
        "obstacle": _plain_obstacle(row.pictures),
        "key": [[i, MATERIAL_NAMES[i]] for i in sorted(set(materials))],
    }


def _add_film(film: Floats32, arrays: ArrayStore) -> Reference:
    """Add positions of shape [film frame, particle, 2]."""
    frames = film.reshape(len(film), -1)
    return arrays.add(frames, kind="film", levels=FILM_LEVELS)


def _picture_periods(box: Box) -> list[list[float]]:
    """Return the step of a period in a picture, for each periodic axis of the box.

    Shape [periodic axis, 2], along x and y, in sides of the picture.
    """
    periods = []
    for axis, is_periodic in enumerate(box.periodic):
        if not is_periodic:
            continue
        step = np.zeros(box.dimension)
        step[axis] = box.lengths[axis]
        if box.dimension == 3:
            view = View(box)
            step = view.place(step) - view.place(np.zeros(3))
        periods.append([round_digits(value, PERIOD_DIGITS) for value in step.tolist()])
    return periods


def _plain_obstacle(pictures: Pictures) -> list[float] | None:
    """Return x, y and radius of the obstacle in a film; None without one."""
    if pictures.obstacle is None:
        return None
    return [round_digits(value, OBSTACLE_DIGITS) for value in pictures.obstacle]


class _TabWriter:
    """Turns one tab into plain values and arrays."""

    def __init__(
        self,
        view: TableView,
        arrays: ArrayStore,
        columns: list[Plain],
        keepers: Mapping[str, _Keeper],
    ) -> None:
        self._view = view
        self._tab = view.tab
        self._arrays = arrays
        self._all_columns = columns
        self._keepers = keepers
        greatest = 0.0
        if self._tab.truth is not None:
            true_vorticity = np.abs(self._tab.truth.vorticity)
            greatest = float(np.nanmax(true_vorticity, initial=0.0))
        self._map_limit = MAP_RANGE * (greatest or 1.0)

    def tab(self) -> Plain:
        """Return the tab."""
        tab = self._tab
        rows = []
        references = []
        for line in self._view.lines:
            if isinstance(line.row, ReferenceRow):
                references.append(self._reference(line, line.row))
            else:
                rows.append(self._row(line, line.row))
        curves = []
        for name in tab.curves:
            curves.append({"key": name, "label": words(name)})
        return {
            "id": tab.id,
            "split": tab.size.split,
            "size": tab.size.name,
            "scenarios": list(tab.scenarios),
            "frames": [tab.frames[0], tab.frames[-1]],
            "marked": list(tab.marked),
            "ranking": tab.ranking,
            "columns": self._columns(),
            "presets": self._view.presets,
            "curves": curves,
            "pictured": tab.pictured,
            "energy": self._mean_curve(tab.energy),
            "periods": _picture_periods(tab.size.box),
            "truth": self._pictures(tab.truth),
            "references": references,
            "rows": rows,
        }

    def _columns(self) -> list[int]:
        """Return the places of the tab's columns among those of all tabs."""
        places = []
        for key, column in self._view.columns.items():
            heading = heading_of(column)
            plain = {
                "key": key,
                "label": heading.label,
                "marks": list(heading.marks),
                "meaning": heading.meaning,
                "quantity": column.quantity,
                "direction": str(column.direction),
                "form": column.form,
            }
            if plain not in self._all_columns:
                self._all_columns.append(plain)
            places.append(self._all_columns.index(plain))
        return places

    def _reference(self, line: Line, row: ReferenceRow) -> Plain:
        """Return a reference predictor's line: curves without bands, no pictures."""
        energy = None
        if row.energy is not None:
            energy = self._mean_curve(row.energy)
        curves = {}
        for name, curve in row.curves.items():
            curves[name] = self._mean_curve(curve)
        return {
            **self._line(line),
            "status": "reference",
            "curves": curves,
            "energy": energy,
            "spread": self._spread(row.values),
        }

    def _row(self, line: Line, row: BoardRow) -> Plain:
        entry = row.entry
        status = "active"
        if not row.active:
            status = "inactive"
        residuals = []
        pictures = None
        curves = dict(islice(row.curves.items(), 1))
        if row.variant_of is None:
            # variants have one curve, no maps and no film: the page would be too long
            curves = dict(row.curves)
            pictures = self._pictures(row.pictures)
            residuals = [self._histogram(residual) for residual in row.residuals]
        flags = []
        for chip in line.chips:
            flags.append([chip.kind, chip.label, chip.meaning])
        return {
            **self._line(line),
            "status": status,
            "active": row.active,
            "rank": row.rank,
            "variantOf": row.variant_of,
            "flags": flags,
            "byline": line.byline,
            "links": list(line.links),
            "search": _search_text(line, entry),
            "standing": _describe_standing(row),
            "curves": self._curves(curves),
            "energy": self._curve(row.energy),
            "spread": self._spread(row.values),
            "at": self._at_marked_frames(row.values),
            "pictures": pictures,
            "residuals": residuals,
            "command": entry.command,
            "about": [*_about(row), *self._about_shared_weights(entry)],
            "predictions": list(_predictions(row)),
        }

    def _about_shared_weights(self, entry: Entry) -> Iterator[tuple[str, ...]]:
        """Yield whose weights an entry predicts with: label, words and address.

        An entry that is not on the page has no address.
        """
        for place in entry.shared_with:
            words_of_keeper = f"those of {place}"
            keeper = self._keepers.get(place)
            if keeper is None:
                yield "weights", words_of_keeper
                continue
            if keeper.status is not Status.ACTIVE:
                words_of_keeper += f", which is {keeper.status}"
            yield "weights", words_of_keeper, keeper.address

    def _line(self, line: Line) -> Plain:
        """Return the cells of a line, each kind in the order of the columns."""
        values = []
        losses = {}
        texts = []
        notes = {}
        classes = {}
        for index, (key, cell) in enumerate(line.cells.items()):
            values.append(plain_number(cell.value))
            loss = target_loss(cell, self._view.columns[key])
            if loss is not None:
                losses[index] = plain_number(loss)
            texts.append(cell.text)
            if cell.note:
                notes[index] = cell.note
            if cell.classes and key not in self._view.main:
                classes[index] = " ".join(cell.classes)
        ranking_cell = line.cells[self._tab.ranking]
        interval: list[float | str | None] = []
        if ranking_cell.interval is not None:
            for bound in ranking_cell.interval:
                interval.append(plain_number(bound))
        return {
            "id": line.id,
            "name": line.name,
            "place": line.place,
            "values": values,
            "losses": losses,
            "texts": texts,
            "notes": notes,
            "classes": classes,
            "interval": interval,
        }

    def _spread(self, values: Mapping[str, Value]) -> Plain:
        """Return the mean of every scenario, of the main metrics."""
        spread = {}
        for name in self._tab.columns[:MOST_SPREADS]:
            if name in values:
                # one row: neighbouring scenarios have nothing in common
                row = np.array([values[name].per_scenario])
                spread[name] = self._arrays.add(row, kind="spread")
        return spread

    def _at_marked_frames(self, values: Mapping[str, Value]) -> Plain:
        at = {}
        for name in self._tab.columns:
            if name not in values or not values[name].at:
                continue
            by_frame = values[name].at
            numbers = []
            for frame in self._tab.marked:
                numbers.append(_as_shown(by_frame.get(frame, math.nan)))
            at[name] = numbers
        return at

    def _curves(self, curves: Mapping[str, Curve]) -> Plain:
        return {name: self._curve(curve) for name, curve in curves.items()}

    def _curve(self, curve: Curve) -> Plain:
        """Return a curve with the lower and the upper end of its band."""
        values = np.stack([curve.mean, curve.low, curve.high], axis=1)
        return self._points(curve, values)

    def _mean_curve(self, curve: Curve) -> Plain:
        """Return a curve that is drawn without its band."""
        return self._points(curve, curve.mean[:, None])

    def _points(self, curve: Curve, values: Floats) -> Plain:
        """Return frames and values of shape [frame, 1 or 3]."""
        return {
            "frames": self._arrays.add_whole(curve.frames, kind="frames"),
            "values": self._arrays.add(
                values, kind="curve", prefer_logarithmic=True, levels=CURVE_LEVELS
            ),
        }

    def _histogram(self, histogram: Histogram) -> Plain:
        return {
            "low": round_digits(histogram.low, 6),
            "high": round_digits(histogram.high, 6),
            "shares": self._arrays.add(
                histogram.shares, kind="histogram", levels=HISTOGRAM_LEVELS
            ),
        }

    def _pictures(self, pictures: Pictures | None) -> Plain | None:
        """Return maps and film."""
        if pictures is None:
            return None
        fields = pictures.vorticity.astype(np.float64)
        fields = np.clip(fields, -self._map_limit, self._map_limit)
        frames = spaced(len(pictures.film_frames), FILM_FRAMES)
        particles = spaced(len(pictures.material), FILM_PARTICLES)
        film = pictures.film[frames][:, particles]  # shape [frame, particle, 2]
        maps_of_vorticity = []
        for field in fields:
            vorticity_map = self._arrays.add(field, kind="map", levels=MAP_LEVELS)
            maps_of_vorticity.append(vorticity_map)
        histograms = []
        for histogram in pictures.histograms:
            histograms.append(self._histogram(histogram))
        film_frames = []
        for i in frames:
            film_frames.append(pictures.film_frames[i])
        return {
            "scenario": pictures.scenario,
            "mapFrames": list(pictures.map_frames),
            "nodes": fields.shape[-1],
            "maps": maps_of_vorticity,
            "histograms": histograms,
            "filmFrames": film_frames,
            "material": pictures.material[particles].tolist(),
            "film": _add_film(film, self._arrays),
            "obstacle": _plain_obstacle(pictures),
        }


def plain_number(value: float | str) -> float | str | None:
    """Return a value as JSON knows it: None for NaN, text for what is infinite.

    >>> plain_number(0.1234567890123), plain_number(math.inf), plain_number(math.nan)
    (0.123456789, 'Infinity', None)
    """
    if isinstance(value, str):
        return value
    if math.isnan(value):
        return None
    if math.isinf(value):
        return "Infinity" if value > 0 else "-Infinity"
    return round_digits(value)


def _as_shown(value: float) -> float | str | None:
    """Return a number with the digits that the page shows.

    The page shows whole numbers without a fraction, so no other number becomes one.

    >>> _as_shown(0.123456), _as_shown(0.99999), _as_shown(12345.0)
    (0.123, 0.99999, 12345.0)
    """
    if math.isfinite(value):
        shown = round_digits(value, SHOWN_DIGITS)
        if not shown.is_integer():
            return shown
    return plain_number(value)


def _search_text(line: Line, entry: Entry) -> str:
    """Return the words in which the page's filter looks for terms, in small letters."""
    words_of_line = [line.name, line.byline, entry.training, entry.hardware]
    words_of_line += [chip.label for chip in line.chips]
    for cell in line.cells.values():
        if isinstance(cell.value, str):
            words_of_line.append(cell.value)
    return " ".join(words_of_line).lower()


def _describe_standing(row: BoardRow) -> str:
    if row.variant_of is not None:
        return f"A variant of {row.variant_of}, not ranked."
    if row.rank is None:
        return "Not ranked."
    standing = f"Rank {format_ranks(row.rank, row.rank_range)}"
    if len(row.entry.predictions) == 1:
        standing = f"These weights: one seed only. {standing}"
    if math.isnan(row.p):
        return f"{standing}."
    claim = "differs from the leader"
    if row.tied:
        claim = "cannot be told from the leader at 5 %"
    return f"{standing}; it {claim} (p = {text(row.p, 2)}, corrected)."


def _about(row: BoardRow) -> Iterator[tuple[str, str]]:
    """Yield the description of a method: labels and words."""
    entry = row.entry
    verified = describe_check(row)
    if row.verified is not None:
        verified = describe_verification(row.verified)
    about = {
        "training": entry.training,
        "hardware, self-reported": entry.hardware,
        "seeds": str(len(entry.predictions)),
        "licence": entry.licence,
        "submitted": f"{entry.date}, scored by lagbench {entry.score.lagbench}",
        "scores": verified,
        "notes": entry.notes,
    }
    for label, words_of_entry in about.items():
        if words_of_entry:
            yield label, words_of_entry


def _predictions(row: BoardRow) -> Iterator[Plain]:
    """Yield the predictions of each seed as the details list them."""
    entry = row.entry
    seeds = zip(entry.predictions, row.seed_means, entry.score_paths, strict=True)
    for prediction, mean, score_path in seeds:
        seed = MISSING
        if prediction.seed is not None:
            seed = str(prediction.seed)
        size = MISSING
        if prediction.bytes is not None:
            size = f"{text(prediction.bytes / 1e6)} MB"
        yield {
            "seed": seed,
            "mean": text(mean),
            "size": size,
            "sha256": prediction.sha256,
            "url": prediction.url,
            "path": prediction.path,
            "scoreFile": score_path.as_posix(),
        }
