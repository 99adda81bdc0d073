"""scores.nc: the statistics of a submission per scenario and frame, and its preview.

Every score of the submission follows from it: ``read_statistics(path).scores()`` gives
the digits of scores.json. Statistics are float32 and NaN where undefined, those of long
rollouts rounded to 11 significant bits (see :func:`as_stored`), so that no full size
takes more than 1 MB; ``measured`` tells which were measured at all. What the best floor
scores in the ranking metric stands beside them, so that the skill can be formed again.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagbench.atomic import atomic_path
from lagbench.errors import WorkFailedError
from lagbench.metrics.aggregate import Score, Tally, aggregate
from lagbench.metrics.table import available
from lagbench.references.table import COUNTING

from .card import (
    FORMAT,
    IDENTITY,
    SUBMISSION,
    Preview,
    ScoreCard,
    Skill,
    printable,
    skill,
    unreadable_scores,
)

NETCDF_NAME = "scores.nc"

INDEX = 4096
"""About what HDF5 takes for the index of chunks; smaller variables are not compressed
[bytes].
"""

LEVELS = 65534
"""Greatest packed value of a preview; 65535 stands for what is missing."""

FILM_RANGE = (-0.5, 1.5)
"""Positions in the preview are clipped to this range [length]."""

_PREVIEW: Mapping[str, tuple[tuple[str, ...], str]] = {
    "vorticity": (
        ("side", "map_frame", "x_node", "y_node"),
        "vorticity per frame; side: truth, prediction",
    ),
    "histogram": (
        ("side", "map_frame", "bin"),
        "shares of 64 vorticity bins over the truth's range",
    ),
    "film": (
        ("side", "film_frame", "film_particle", "space"),
        "particle positions [length]",
    ),
}


def write_statistics(card: ScoreCard, path: Path, *, option: str = "--output") -> None:
    """Write scores.nc, whole or not at all; equal cards give equal bytes.

    ``option`` is what the user names another folder with, for the message.
    """
    import netCDF4

    with atomic_path(path, option=option) as temporary:
        try:
            with netCDF4.Dataset(
                temporary, "w", format="NETCDF4"
            ) as file:  # closing it writes most of it
                _define(file, card)
        except (OSError, RuntimeError) as error:
            fix = f"free disk space, or name a folder that you may write to: {option}"
            raise WorkFailedError(
                "cannot write scores", where=str(path), got=error, fix=fix
            ) from error


def _define(file: Any, card: ScoreCard) -> None:  # noqa: ANN401
    tallies = [card.tallies[SUBMISSION][i] for i in card.scenarios]
    names = tallies[0].names
    frames = tallies[0].frames
    file.setncatts(
        {
            "lagbench_scores": FORMAT,
            **{name: getattr(card.header, name) for name in IDENTITY},
            "predictions_sha256": card.predictions_sha256,
            "ranking_metric": card.ranking,
            "statistics": " ".join(names),
        }
    )
    _store(file, "scenario", ("scenario",), np.array(card.scenarios, np.int32))
    _store(file, "frame", ("frame",), np.array(frames, np.int32))
    if card.skill is not None:
        file.best_floor = card.skill.floor
        values = card.scores[card.skill.floor][card.ranking].values
        _store(file, "best_floor_value", ("scenario",), values)
    dims = ("statistic", "scenario", "frame")
    values = np.stack(
        [np.stack([tally.series(name) for tally in tallies]) for name in names]
    )
    measured = np.stack(
        [np.stack([tally.measured(name) for tally in tallies]) for name in names]
    )
    _store(file, "value", dims, values.astype(np.float32))
    _store(file, "measured", dims, measured.astype(np.int8))
    _define_preview(file.createGroup("preview"), card.preview)


def _define_preview(group: Any, preview: Preview) -> None:  # noqa: ANN401
    group.scenario = preview.scenario
    numbers = {
        "map_frame": preview.map_frames,
        "film_frame": preview.film_frames,
        "film_particle": preview.particles,
    }
    for name, held in numbers.items():
        _store(group, name, (name,), np.array(held, np.int32))
    _store(group, "material", ("film_particle",), preview.material)
    _store(group, "histogram_range", ("map_frame", "end"), preview.histogram_range)
    film = np.clip(preview.film, *FILM_RANGE)
    for name, values in {
        "vorticity": preview.vorticity,
        "histogram": preview.histogram,
        "film": film,
    }.items():
        dims, text = _PREVIEW[name]
        packed, attributes = _packed(values, FILM_RANGE if name == "film" else None)
        _store(group, name, dims, packed, {"long_name": text, **attributes})


def _packed(
    values: NDArray[np.float32], limits: tuple[float, float] | None
) -> tuple[NDArray[np.uint16], dict[str, Any]]:
    """Return values as uint16 and the CF attributes that unpack them."""
    wide = values.astype(np.float64)
    known = wide[np.isfinite(wide)]
    low, high = limits or (
        (float(known.min()), float(known.max())) if known.size else (0.0, 1.0)
    )
    scale = (high - low) / LEVELS or 1.0
    steps = np.where(np.isfinite(wide), np.rint((wide - low) / scale), LEVELS + 1)
    attributes = {
        "scale_factor": scale,
        "add_offset": low,
        "_FillValue": np.uint16(LEVELS + 1),
    }
    return steps.astype(np.uint16), attributes


def _store(
    group: Any,  # noqa: ANN401
    name: str,
    dims: tuple[str, ...],
    values: NDArray[Any],
    attributes: Mapping[str, Any] | None = None,
) -> None:
    given = dict(attributes or {})
    for dim, length in zip(dims, values.shape, strict=True):
        if dim not in group.dimensions:
            group.createDimension(dim, length)
    fill = given.pop("_FillValue", False)
    packed = values.nbytes > INDEX
    variable = group.createVariable(
        name,
        values.dtype,
        dims,
        compression="zlib" if packed else None,
        complevel=9,
        shuffle=True,
        fill_value=fill,
        chunksizes=values.shape if packed else None,
        contiguous=not packed,
    )
    variable.setncatts(given)
    variable.set_auto_maskandscale(False)
    variable[...] = values


@dataclass(frozen=True, kw_only=True, eq=False)
class StoredScores:
    """What a scores.nc holds beside its preview."""

    # split, size, version and hash of the data set, and the method
    identity: Mapping[str, str]
    predictions_sha256: str  # content hash of the predicted positions
    ranking: str  # name of the metric that ranks
    tallies: Mapping[int, Tally]  # statistics of the submission by scenario
    # name of the best floor; None where none that counts has a score
    best_floor: str | None = None
    # what it scores in the ranking metric, NaN where undefined, shape [scenario]
    best_floor_values: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))

    def skill(self) -> Skill | None:
        """Return how much better than the best floor; None where none that counts has a
        score.
        """
        ours = self._scored(self.ranking).get(self.ranking)
        if self.best_floor is None or ours is None:
            return None
        floor = replace(ours, values=self.best_floor_values)
        return skill([ours], {self.best_floor: floor})

    def scores(self) -> dict[str, Score]:
        """Return the scores of all installed metrics whose statistics are here, by
        name.
        """
        return self._scored(*available())

    def _scored(self, *wanted: str) -> dict[str, Score]:
        names = set(next(iter(self.tallies.values())).names)
        known = available()
        metrics = [
            known[name]
            for name in wanted
            if name in known and names.issuperset(known[name].of)
        ]
        return aggregate(metrics, self.tallies)


def read_statistics(path: Path) -> StoredScores:
    """Read the statistics of a scores.nc."""
    import netCDF4

    try:
        with netCDF4.Dataset(path, "r") as file:
            file.set_auto_maskandscale(False)
            if file.lagbench_scores != FORMAT:
                raise ValueError(f"layout {file.lagbench_scores!r}, not {FORMAT}")
            names = tuple(str(file.statistics).split())
            frames = tuple(file["frame"][:].tolist())
            scenarios = file["scenario"][:].tolist()
            named = {*IDENTITY, "predictions_sha256", "ranking_metric", "best_floor"}
            held = {
                name: file.getncattr(name)
                for name in named.intersection(file.ncattrs())
            }
            floor = held.get("best_floor")
            of_floor = np.empty(0)
            if floor is not None:
                of_floor = np.asarray(file["best_floor_value"][:], np.float64)
                if (
                    floor not in COUNTING
                    or of_floor.shape != (len(scenarios),)
                    or np.isinf(of_floor).any()
                ):
                    raise ValueError("not the scores of a floor")
            values = file["value"][:].astype(np.float64)
            measured = file["measured"][:]
            return StoredScores(
                identity={name: printable(held, name) for name in IDENTITY},
                predictions_sha256=printable(held, "predictions_sha256"),
                ranking=printable(held, "ranking_metric"),
                tallies={
                    scenario: _tally(names, frames, values[:, i], measured[:, i])
                    for i, scenario in enumerate(scenarios)
                },
                best_floor=floor,
                best_floor_values=of_floor,
            )
    except Exception as error:  # HDF5 on damaged bytes raises nearly any type
        raise unreadable_scores(path, error) from error


def _tally(
    names: tuple[str, ...],
    frames: tuple[int, ...],
    values: NDArray[np.float64],
    measured: NDArray[np.int8],
) -> Tally:
    if values.shape != (len(names), len(frames)):
        raise ValueError(
            f"{values.shape} values of {len(names)} statistics at {len(frames)} frames"
        )
    undefined = np.isnan(values) & (measured != 0)
    weight = ~np.isnan(values) & (measured != 0)
    total = np.where(weight, values, 0.0)
    return Tally(
        names, frames, total, weight.astype(np.int64), undefined.astype(np.int64)
    )
