"""Write scores.nc (`score_file` reads it)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagbench.atomic import atomic_path, explain_write_error
from lagbench.data.hdf5 import open_netcdf

from .card import ScoreCard
from .published_scores import FORMAT, IDENTITY
from .scenario import FILL_STEP, FILM_RANGE, LAST_STEP, SUBMISSION, Preview

INDEX = 4096
"""Size of the index of chunks in HDF5; smaller variables are not compressed [bytes]."""

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
            raise explain_write_error(path, error, option=option) from error


def _write_card(file: Any, card: ScoreCard) -> None:  # noqa: ANN401
    submission = card.tallies[SUBMISSION]
    tallies = [submission[scenario] for scenario in card.scenarios]
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

    scenario_numbers = np.array(card.scenarios, np.int32)
    frame_numbers = np.array(frames, np.int32)
    _write_variable(file, "scenario", ("scenario",), scenario_numbers)
    _write_variable(file, "frame", ("frame",), frame_numbers)
    if card.skill is not None:
        reference = card.skill.reference
        file.best_floor = reference
        reference_values = card.scores[reference][card.ranking].values
        _write_variable(file, "best_floor_value", ("scenario",), reference_values)

    dims = ("statistic", "scenario", "frame")
    shape = (len(names), len(tallies), len(frames))
    values = np.empty(shape, np.float32)
    is_measured = np.empty(shape, np.int8)
    for row, name in enumerate(names):
        for column, tally in enumerate(tallies):
            values[row, column] = tally.series(name)
            is_measured[row, column] = tally.measured(name)
    _write_variable(file, "value", dims, values)
    _write_variable(file, "measured", dims, is_measured)
    _write_preview(file.createGroup("preview"), card.preview)


def _write_preview(group: Any, preview: Preview) -> None:  # noqa: ANN401
    group.scenario = preview.scenario
    if preview.obstacle is not None:
        group.obstacle = preview.obstacle
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
    """Write values that lie between two limits as 16-bit integers."""
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
    """Return values as uint16 and the CF attributes that unpack them.

    Finite values must lie within the limits; the others become the fill value.
    """
    low, high = limits
    wide = values.astype(np.float64)
    scale = (high - low) / LAST_STEP or 1.0
    steps = np.rint((wide - low) / scale)
    packed = np.where(np.isfinite(wide), steps, FILL_STEP)
    attributes = {
        "scale_factor": scale,
        "add_offset": low,
        "_FillValue": np.uint16(FILL_STEP),
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
