"""The data that the page's script draws from: tables, curves, maps, films, details.

Everything is plain values for JSON. Long arrays stand in an :class:`ArrayStore`, and a
reference to each of them in the JSON. Infinite numbers are texts there, undefined ones
are null.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from lagbench.data.checksums import round_digits
from lagbench.figures.colours import MATERIAL_COLOURS
from lagbench.figures.html import MISSING, text, words

from .encoding import ArrayStore
from .entry import Entry
from .model import BoardRow, Curve, Histogram, Pictures, ReferenceRow, Value
from .sampling import coarsen, spaced
from .table_view import Line, TableView, target_loss

FILM_FRAMES = 26  # most frames of a film
FILM_PARTICLES = 160  # most particles of a film
FILM_LEVELS = 2000  # steps across a film: four to a pixel
MAP_FRAMES = 4  # most frames of vorticity maps and histograms
MAP_NODES = 20  # most nodes of a map, a side

# Values of maps are cut off at so many times the truth's greatest: an explosion would
# leave nothing of the others.
MAP_RANGE = 4.0

COLOURS = {
    "materials": list(MATERIAL_COLOURS),
    "clockwise": MATERIAL_COLOURS[0],
    "counterClockwise": MATERIAL_COLOURS[1],
}
"""Colours of films and maps; those of charts stand in the style sheet."""

Plain = dict[str, Any]


def page_data(views: Sequence[TableView]) -> tuple[bytes, bytes]:
    """Return the data of all tabs as JSON, and the arrays that it refers to."""
    arrays = ArrayStore()
    tabs = []
    for view in views:
        tabs.append(_TabWriter(view, arrays).tab())
    data = {"colours": COLOURS, "tabs": tabs}
    encoded = json.dumps(data, ensure_ascii=True, allow_nan=False)
    return encoded.encode(), arrays.to_bytes()


class _TabWriter:
    """Turns one tab into plain values and arrays."""

    def __init__(self, view: TableView, arrays: ArrayStore) -> None:
        self._view = view
        self._tab = view.tab
        self._arrays = arrays
        greatest = float(np.nanmax(np.abs(self._tab.truth.vorticity), initial=0.0))
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
            "columns": list(self._columns()),
            "presets": self._view.presets,
            "curves": curves,
            "energy": self._curve(tab.energy),
            "truth": self._pictures(tab.truth),
            "references": references,
            "rows": rows,
        }

    def _columns(self) -> Iterator[Plain]:
        for key, column in self._view.columns.items():
            yield {
                "key": key,
                "label": column.label,
                "quantity": column.quantity,
                "direction": str(column.direction),
                "form": column.form,
            }

    def _reference(self, line: Line, row: ReferenceRow) -> Plain:
        energy = None
        if row.energy is not None:
            energy = self._curve(row.energy)
        return {
            **self._line(line),
            "status": "reference",
            "curves": self._curves(row.curves),
            "energy": energy,
            "spread": self._spread(row.values),
        }

    def _row(self, line: Line, row: BoardRow) -> Plain:
        entry = row.entry
        status = "active"
        if not row.active:
            status = "inactive"
        residuals = []
        for i in spaced(len(row.residuals), MAP_FRAMES):
            residuals.append(self._histogram(row.residuals[i]))
        flags = []
        for chip in line.chips:
            flags.append([chip.kind, chip.label, chip.meaning])
        return {
            **self._line(line),
            "status": status,
            "active": row.active,
            "rank": row.rank,
            "flags": flags,
            "byline": line.byline,
            "links": list(line.links),
            "search": _search_text(line, entry),
            "standing": _describe_standing(row),
            "curves": self._curves(row.curves),
            "energy": self._curve(row.energy),
            "spread": self._spread(row.values),
            "at": self._at_marked_frames(row.values),
            "pictures": self._pictures(row.pictures),
            "residuals": residuals,
            "command": entry.command,
            "about": list(_about(row)),
            "predictions": list(_predictions(row)),
        }

    def _line(self, line: Line) -> Plain:
        """Return the cells of a line, each kind in the order of the columns."""
        values = []
        losses = []
        texts = []
        notes = []
        for key, cell in line.cells.items():
            values.append(plain_number(cell.value))
            loss = target_loss(cell, self._view.columns[key])
            losses.append(None if loss is None else plain_number(loss))
            texts.append(cell.text)
            notes.append(cell.note)
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
            "interval": interval,
        }

    def _spread(self, values: Mapping[str, Value]) -> Plain:
        """Return the mean of every scenario, of the main metrics."""
        spread = {}
        for name in self._tab.columns:
            if name in values:
                means = []
                for scenario_mean in values[name].per_scenario:
                    means.append(plain_number(scenario_mean))
                spread[name] = means
        return spread

    def _at_marked_frames(self, values: Mapping[str, Value]) -> Plain:
        at = {}
        for name in self._tab.columns:
            if name not in values or not values[name].at:
                continue
            by_frame = values[name].at
            numbers = []
            for frame in self._tab.marked:
                numbers.append(plain_number(by_frame.get(frame, math.nan)))
            at[name] = numbers
        return at

    def _curves(self, curves: Mapping[str, Curve]) -> Plain:
        return {name: self._curve(curve) for name, curve in curves.items()}

    def _curve(self, curve: Curve) -> Plain:
        # shape [frame, 3]
        values = np.stack([curve.mean, curve.low, curve.high], axis=1)
        return {
            "frames": self._arrays.add_whole(curve.frames),
            "values": self._arrays.add(values, prefer_logarithmic=True),
        }

    def _histogram(self, histogram: Histogram) -> Plain:
        return {
            "low": round_digits(histogram.low, 6),
            "high": round_digits(histogram.high, 6),
            "shares": self._arrays.add(histogram.shares),
        }

    def _pictures(self, pictures: Pictures) -> Plain:
        """Return maps and film."""
        maps = spaced(len(pictures.map_frames), MAP_FRAMES)
        fields = coarsen(pictures.vorticity[maps], MAP_NODES)
        fields = np.clip(fields, -self._map_limit, self._map_limit)

        frames = spaced(len(pictures.film_frames), FILM_FRAMES)
        particles = spaced(len(pictures.material), FILM_PARTICLES)
        film = pictures.film[frames][:, particles]  # shape [frame, particle, 2]
        map_frames = []
        for i in maps:
            map_frames.append(pictures.map_frames[i])
        maps_of_vorticity = []
        for field in fields:
            maps_of_vorticity.append(self._arrays.add(field))
        histograms = []
        for i in maps:
            histograms.append(self._histogram(pictures.histograms[i]))
        film_frames = []
        for i in frames:
            film_frames.append(pictures.film_frames[i])
        return {
            "scenario": pictures.scenario,
            "mapFrames": map_frames,
            "nodes": fields.shape[-1],
            "maps": maps_of_vorticity,
            "histograms": histograms,
            "filmFrames": film_frames,
            "material": pictures.material[particles].tolist(),
            "film": self._arrays.add(film.reshape(len(frames), -1), levels=FILM_LEVELS),
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


def _search_text(line: Line, entry: Entry) -> str:
    """Return the words in which the page's filter looks for terms, in small letters."""
    words_of_line = [line.name, line.byline, entry.training, entry.hardware]
    words_of_line += [chip.label for chip in line.chips]
    words_of_line += [cell.text for cell in line.cells.values()]
    return " ".join(words_of_line).lower()


def _describe_standing(row: BoardRow) -> str:
    if row.rank is None:
        return "Not ranked."
    standing = f"Rank {row.rank}"
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
    verified = "as submitted"
    if row.verified is not None:
        line = row.verified
        verified = f"verified by the maintainers, lagbench {line.lagbench}, {line.date}"
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
        length = MISSING
        if prediction.bytes is not None:
            length = f"{text(prediction.bytes / 1e6)} MB"
        yield {
            "seed": seed,
            "mean": text(mean),
            "size": length,
            "sha256": prediction.sha256,
            "url": prediction.url,
            "path": prediction.path,
            "scoreFile": score_path.as_posix(),
        }
