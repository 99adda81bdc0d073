"""scores.nc: the statistics of a submission per scenario and frame, and its preview.

Every score of the submission follows from it: ``read_statistics(path).scores()`` gives
the digits of scores.json. Statistics are float32 and NaN where undefined, those of long
rollouts rounded to 11 significant bits (see :func:`round_statistics`), so that no full
size takes more than 1 MB; ``measured`` marks those that were measured at all. The
scores of the best reference in the ranking metric are stored too, so that the skill can
be formed again.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagbench.atomic import atomic_path
from lagbench.data.variables import open_netcdf
from lagbench.errors import WorkFailedError
from lagbench.metrics.aggregate import Score, Tally, aggregate
from lagbench.metrics.table import available
from lagbench.references.table import NAIVE
from lagbench.submission.format import require_name

from .card import (
    FORMAT,
    IDENTITY,
    SUBMISSION,
    Preview,
    ScoreCard,
    unreadable_scores,
)
from .skill import Skill, compute_skill

NETCDF_NAME = "scores.nc"

INDEX = 4096
"""Size of the index of chunks in HDF5; smaller variables are not compressed [bytes]."""

LEVELS = 65534
"""Greatest packed value of a preview; 65535 marks missing values."""

FILM_RANGE = (-0.5, 1.5)
"""Positions in the preview are clipped to this range [length]."""

VORTICITY_DIMS = ("side", "map_frame", "x_node", "y_node")
HISTOGRAM_DIMS = ("side", "map_frame", "bin")
FILM_DIMS = ("side", "film_frame", "film_particle", "space")


def write_statistics(card: ScoreCard, path: Path, *, option: str = "--output") -> None:
    """Write scores.nc, whole or not at all; equal cards give equal bytes.

    ``option`` is the user's option for another folder, for the message.

    Raises:
        WorkFailedError: the file cannot be written.
    """
    with atomic_path(path, option=option) as temporary:
        try:
            # closing the file writes most of it
            with open_netcdf(temporary, "w") as file:
                _write_card(file, card)
        except (OSError, RuntimeError) as error:
            raise WorkFailedError(
                "cannot write scores",
                where=str(path),
                got=error,
                fix=f"free disk space, or name a folder that you may write to: "
                f"{option}",
            ) from error


def _write_card(file: Any, card: ScoreCard) -> None:  # noqa: ANN401
    tallies = []
    for i in card.scenarios:
        tallies.append(card.tallies[SUBMISSION][i])
    names = tallies[0].names
    frames = tallies[0].frames

    attributes: dict[str, Any] = {"lagbench_scores": FORMAT}
    for name in IDENTITY:
        attributes[name] = getattr(card.header, name)
    if card.header.subset != "test":
        attributes["subset"] = card.header.subset
    attributes["predictions_sha256"] = card.predictions_sha256
    attributes["ranking_metric"] = card.ranking
    attributes["statistics"] = " ".join(names)
    file.setncatts(attributes)

    _write_variable(file, "scenario", ("scenario",), np.array(card.scenarios, np.int32))
    _write_variable(file, "frame", ("frame",), np.array(frames, np.int32))
    if card.skill is not None:
        file.best_floor = card.skill.reference
        values = card.scores[card.skill.reference][card.ranking].values
        _write_variable(file, "best_floor_value", ("scenario",), values)

    values = _stack(tally.series(name) for name in names for tally in tallies)
    measured = _stack(tally.measured(name) for name in names for tally in tallies)
    shape = (len(names), len(tallies), len(frames))
    dims = ("statistic", "scenario", "frame")
    _write_variable(file, "value", dims, values.reshape(shape).astype(np.float32))
    _write_variable(file, "measured", dims, measured.reshape(shape).astype(np.int8))
    _write_preview(file.createGroup("preview"), card.preview)


def _stack(rows: Iterable[NDArray[Any]]) -> NDArray[Any]:
    return np.stack(list(rows))


def _write_preview(group: Any, preview: Preview) -> None:  # noqa: ANN401
    group.scenario = preview.scenario
    for name, numbers in (
        ("map_frame", preview.map_frames),
        ("film_frame", preview.film_frames),
        ("film_particle", preview.particles),
    ):
        _write_variable(group, name, (name,), np.array(numbers, np.int32))
    _write_variable(group, "material", ("film_particle",), preview.material)
    _write_variable(
        group, "histogram_range", ("map_frame", "end"), preview.histogram_range
    )

    _write_packed(
        group,
        "vorticity",
        VORTICITY_DIMS,
        preview.vorticity,
        limits=_defined_range(preview.vorticity),
        long_name="vorticity per frame; side: truth, prediction",
    )
    _write_packed(
        group,
        "histogram",
        HISTOGRAM_DIMS,
        preview.histogram,
        limits=_defined_range(preview.histogram),
        long_name="shares of 64 vorticity bins over the truth's range",
    )
    _write_packed(
        group,
        "film",
        FILM_DIMS,
        np.clip(preview.film, *FILM_RANGE),
        limits=FILM_RANGE,
        long_name="particle positions [length]",
    )


def _write_packed(
    group: Any,  # noqa: ANN401
    name: str,
    dims: tuple[str, ...],
    values: NDArray[np.float32],
    *,
    limits: tuple[float, float],
    long_name: str,
) -> None:
    """Write values as integers between two limits."""
    packed, packing = _pack(values, limits)
    _write_variable(group, name, dims, packed, {"long_name": long_name, **packing})


def _defined_range(values: NDArray[np.float32]) -> tuple[float, float]:
    """Return the least and greatest finite value; 0 and 1 where there is none."""
    wide = values.astype(np.float64)
    finite = wide[np.isfinite(wide)]
    if not finite.size:
        return (0.0, 1.0)
    return (float(finite.min()), float(finite.max()))


def _pack(
    values: NDArray[np.float32], limits: tuple[float, float]
) -> tuple[NDArray[np.uint16], dict[str, Any]]:
    """Return values as uint16 and the CF attributes that unpack them."""
    low, high = limits
    wide = values.astype(np.float64)
    scale = (high - low) / LEVELS or 1.0
    steps = np.rint((wide - low) / scale)
    packed = np.where(np.isfinite(wide), steps, LEVELS + 1)
    attributes = {
        "scale_factor": scale,
        "add_offset": low,
        "_FillValue": np.uint16(LEVELS + 1),
    }
    return packed.astype(np.uint16), attributes


def _write_variable(
    group: Any,  # noqa: ANN401
    name: str,
    dims: tuple[str, ...],
    values: NDArray[Any],
    attributes: Mapping[str, Any] | None = None,
) -> None:
    """Write a variable, compressed if it is large, and its new dimensions."""
    for dim, length in zip(dims, values.shape, strict=True):
        if dim not in group.dimensions:
            group.createDimension(dim, length)

    plain_attributes = dict(attributes or {})
    fill_value = plain_attributes.pop("_FillValue", False)
    is_large = values.nbytes > INDEX
    variable = group.createVariable(
        name,
        values.dtype,
        dims,
        compression="zlib" if is_large else None,
        complevel=9,
        shuffle=True,
        fill_value=fill_value,
        chunksizes=values.shape if is_large else None,
        contiguous=not is_large,
    )
    variable.setncatts(plain_attributes)
    variable.set_auto_maskandscale(False)
    variable[...] = values


@dataclass(frozen=True, kw_only=True, eq=False)
class SubmissionStatistics:
    """Content of a scores.nc beside its preview."""

    # split, size, version and hash of the data set, and the method
    identity: Mapping[str, str]
    predictions_sha256: str  # content hash of the predicted positions
    ranking: str  # name of the metric that ranks
    tallies: Mapping[int, Tally]  # statistics of the submission by scenario
    # name of the best reference; None where none that counts has a score
    best_reference: str | None = None
    # its scores in the ranking metric, NaN where undefined, shape [scenario]
    best_reference_values: NDArray[np.float64] = field(
        default_factory=lambda: np.empty(0)
    )

    def skill(self) -> Skill | None:
        """Return the skill; None where no reference that counts has a score."""
        ranking = self._aggregate([self.ranking]).get(self.ranking)
        if self.best_reference is None or ranking is None:
            return None
        reference = replace(ranking, values=self.best_reference_values)
        return compute_skill([ranking], {self.best_reference: reference})

    def scores(self) -> dict[str, Score]:
        """Return the scores of all installed metrics whose statistics are here."""
        return self._aggregate(available())

    def _aggregate(self, names: Iterable[str]) -> dict[str, Score]:
        """Return scores by the name of the metric."""
        statistics = set(next(iter(self.tallies.values())).names)
        table = available()
        metrics = []
        for name in names:
            if name in table and statistics.issuperset(table[name].of):
                metrics.append(table[name])
        return aggregate(metrics, self.tallies)


def read_statistics(path: Path) -> SubmissionStatistics:
    """Read the statistics of a scores.nc.

    Raises:
        UnreadableFileError: it is no scores.nc.
    """
    try:
        with open_netcdf(path) as file:
            file.set_auto_maskandscale(False)
            if file.lagbench_scores != FORMAT:
                raise ValueError(f"layout {file.lagbench_scores!r}, not {FORMAT}")
            reference, reference_values = _read_reference(file)
            return SubmissionStatistics(
                identity={name: _read_text(file, name) for name in IDENTITY},
                predictions_sha256=_read_text(file, "predictions_sha256"),
                ranking=_read_text(file, "ranking_metric"),
                tallies=_read_tallies(file),
                best_reference=reference,
                best_reference_values=reference_values,
            )
    except Exception as error:  # HDF5 on damaged bytes raises nearly any type
        raise unreadable_scores(path, error) from error


def _read_text(file: Any, name: str) -> str:  # noqa: ANN401
    text = file.getncattr(name)
    if not isinstance(text, str):
        raise ValueError(f"{name} is no text")
    return require_name(text)


def _read_reference(file: Any) -> tuple[str | None, NDArray[np.float64]]:  # noqa: ANN401
    """Return name and values of the best reference; None where the file has none."""
    if "best_floor" not in file.ncattrs():
        return None, np.empty(0)
    name = file.getncattr("best_floor")
    values = np.asarray(file["best_floor_value"][:], np.float64)
    has_right_shape = values.shape == (len(file["scenario"]),)
    if name not in NAIVE or not has_right_shape or np.isinf(values).any():
        raise ValueError("not the scores of a reference")
    return name, values


def _read_tallies(file: Any) -> dict[int, Tally]:  # noqa: ANN401
    """Return the statistics of each scenario."""
    names = tuple(str(file.statistics).split())
    frames = tuple(file["frame"][:].tolist())
    scenarios = file["scenario"][:].tolist()
    values = file["value"][:].astype(np.float64)
    measured = file["measured"][:]

    tallies = {}
    for i, scenario in enumerate(scenarios):
        is_measured = measured[:, i] != 0
        tallies[scenario] = _make_tally(names, frames, values[:, i], is_measured)
    return tallies


def _make_tally(
    names: tuple[str, ...],
    frames: tuple[int, ...],
    values: NDArray[np.float64],
    is_measured: NDArray[np.bool_],
) -> Tally:
    """Return the tally of values of shape [statistic, frame]."""
    if values.shape != (len(names), len(frames)):
        raise ValueError(
            f"{values.shape} values of {len(names)} statistics at {len(frames)} frames"
        )
    is_nan = np.isnan(values)
    has_value = ~is_nan & is_measured
    return Tally(
        names=names,
        frames=frames,
        total=np.where(has_value, values, 0.0),
        weight=has_value.astype(np.int64),
        undefined=(is_nan & is_measured).astype(np.int64),
    )
