"""scores.nc: the statistics of a submission per scenario and frame.

Every score of the submission follows from it: ``read_statistics(path).scores()`` gives
the digits of scores.json. Statistics are float32 and NaN where undefined, those of long
rollouts rounded to 11 significant bits (see :func:`round_statistics`), so that no full
size takes more than 1 MB; ``measured`` marks those that were measured at all. The
scores of the best reference in the ranking metric are stored too.

A file may come from anybody. HDF5 lets a file show the bytes of other files as its own
and unpack a few bytes to gigabytes: its headers tell, before a value is read.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from lagbench.atomic import atomic_path, explain_write_error
from lagbench.data.hdf5 import (
    list_variables,
    open_hdf5,
    open_netcdf,
    open_variable,
    read_attribute,
)
from lagbench.data.registry import Size
from lagbench.errors import UnreadableFileError
from lagbench.metrics.aggregate import Score, Tally, aggregate
from lagbench.metrics.table import available, ranking_metric
from lagbench.submission.format import IDENTITY, MAX_NAME, require_name
from lagbench.submission.truth import frames_to_predict

from .card import FORMAT, ScoreCard
from .task import SUBMISSION

NETCDF_NAME = "scores.nc"

MAX_SCORE_BYTES = 1_000_000
"""Longest score file of a leaderboard [bytes]."""

MAX_STATISTICS = 500

INDEX = 4096
"""Size of the index of chunks in HDF5; smaller variables are not compressed [bytes]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SubmissionStatistics:
    """Content of a scores.nc."""

    # split, size, version and hash of the data set, and the method
    identity: Mapping[str, str]
    subset: str  # subset that was predicted
    predictions_sha256: str  # content hash of the predicted positions
    ranking: str  # name of the metric that ranks
    tallies: Mapping[int, Tally]  # statistics of the submission by scenario
    # name of the best reference; None where none that counts has a score
    best_reference: str | None
    # its scores in the ranking metric, NaN where undefined, shape [scenario]
    best_reference_values: NDArray[np.float64]

    def scores(self) -> dict[str, Score]:
        """Return the scores of all installed metrics whose statistics are here.

        Metrics that are formed only when they are named are left out.
        """
        statistics = set(next(iter(self.tallies.values())).names)
        metrics = []
        for metric in available().values():
            if not metric.is_on_request and statistics.issuperset(metric.of):
                metrics.append(metric)
        return aggregate(metrics, self.tallies)


def read_statistics(path: str | Path, size: Size | None = None) -> SubmissionStatistics:
    """Read the statistics of a scores.nc.

    Args:
        path: the file.
        size: the task whose shape it must have, and the subset that it scores: of a
            file on a leaderboard, which may have 1 MB and is no link.

    Raises:
        UnreadableFileError: it is no scores.nc, or of another task.
    """
    path = Path(path)
    longest = None if size is None else MAX_SCORE_BYTES
    if size is not None and path.is_symlink():  # it could lead out of the folder
        raise UnreadableFileError("a link; put the file in its place", where=str(path))
    try:
        with open_hdf5(path, longest=longest) as file:
            list_variables(file)  # refuses links, and more than the file can hold
            statistics = _statistics_in(file)
        if size is not None:
            _check_task(statistics, size)
    except UnreadableFileError:
        raise
    except Exception as error:  # HDF5 on damaged bytes raises nearly any type
        raise unreadable_scores(path, error) from error
    return statistics


def unreadable_scores(path: Path, error: Exception) -> UnreadableFileError:
    """Return the error for a file that is no scores.json or scores.nc."""
    return UnreadableFileError(
        f"not a scores{path.suffix} of lagbench ({type(error).__name__}: "
        f"{str(error)[:MAX_NAME]}); score the predictions again",
        where=str(path),
    )


def _statistics_in(file: h5py.File) -> SubmissionStatistics:
    def text(name: str, default: object = None) -> str:
        value = read_attribute(file, name)
        value = default if value is None else value
        if not isinstance(value, str):
            raise ValueError(f"{name} is no text")
        return value

    layout = read_attribute(file, "lagbench_scores")
    if layout != FORMAT:
        raise ValueError(f"layout {layout!r}, not {FORMAT}")
    names = tuple(text("statistics").split())
    frames = tuple(open_variable(file, "frame")[...].tolist())
    scenarios = open_variable(file, "scenario")[...].tolist()
    # shape [statistic, scenario, frame]
    values = open_variable(file, "value")[...].astype(np.float64)
    is_measured = open_variable(file, "measured")[...] != 0
    # the scores of the reference are stored in the same order
    if not all(first < second for first, second in itertools.pairwise(scenarios)):
        raise ValueError("the ids of the scenarios do not ascend")
    shape = (len(names), len(scenarios), len(frames))
    if not scenarios or len(names) > MAX_STATISTICS:
        raise ValueError("no scenarios, or too many statistics")
    if values.shape != shape or is_measured.shape != shape:
        raise ValueError(f"values of shape {values.shape}, not {shape}")
    if np.isinf(values).any():
        raise ValueError("infinite statistics")
    has_value = is_measured & ~np.isnan(values)
    tallies = {}
    for i, scenario in enumerate(scenarios):
        tallies[scenario] = Tally(
            names=names,
            frames=frames,
            total=np.where(has_value[:, i], values[:, i], 0.0),
            weight=has_value[:, i].astype(np.int64),
            undefined=(is_measured & ~has_value)[:, i].astype(np.int64),
        )

    reference = None
    reference_values = np.empty(0)
    if read_attribute(file, "best_floor") is not None:
        reference = require_name(text("best_floor"))
        stored = open_variable(file, "best_floor_value")[...]
        reference_values = np.asarray(stored, np.float64)
        if reference_values.shape != shape[1:2] or np.isinf(reference_values).any():
            raise ValueError("not the scores of a reference")
    return SubmissionStatistics(
        identity={name: require_name(text(name)) for name in IDENTITY},
        subset=require_name(text("subset", "test")),
        predictions_sha256=require_name(text("predictions_sha256")),
        ranking=require_name(text("ranking_metric")),
        tallies=tallies,
        best_reference=reference,
        best_reference_values=reference_values,
    )


def _check_task(statistics: SubmissionStatistics, size: Size) -> None:
    """Refuse a file that is not of the task of a split and size."""
    if statistics.subset != size.scored_subset:
        raise ValueError(f"scores of the subset {statistics.subset[:40]!a}")
    frames = next(iter(statistics.tallies.values())).frames
    scenarios = sorted(size.scored_scenarios)
    if list(statistics.tallies) != scenarios or frames != tuple(
        frames_to_predict(size)
    ):
        raise ValueError(f"other scenarios or frames than {size.split} {size.name} has")
    if statistics.ranking != ranking_metric(size):
        raise ValueError("another ranking metric")


def write_statistics(card: ScoreCard, path: Path, *, option: str = "--output") -> None:
    """Write scores.nc, whole or not at all; equal cards give equal bytes.

    ``option`` is the user's option for another folder, for the message.

    Raises:
        WorkFailedError: the file cannot be written.
    """
    tallies = [card.tallies[SUBMISSION][scenario] for scenario in card.scenarios]
    names = tallies[0].names
    attributes: dict[str, Any] = {"lagbench_scores": FORMAT}
    for name in IDENTITY:
        attributes[name] = getattr(card.header, name)
    if card.header.subset != "test":
        attributes["subset"] = card.header.subset
    attributes["predictions_sha256"] = card.predictions_sha256
    attributes["ranking_metric"] = card.ranking
    attributes["statistics"] = " ".join(names)

    dims = ("statistic", "scenario", "frame")
    values = np.stack([tally.values for tally in tallies], axis=1)
    is_measured = [tally.weight + tally.undefined > 0 for tally in tallies]
    lengths = zip(dims, values.shape, strict=True)
    variables: dict[str, tuple[tuple[str, ...], NDArray[Any]]] = {
        "scenario": (("scenario",), np.array(card.scenarios, np.int32)),
        "frame": (("frame",), np.array(tallies[0].frames, np.int32)),
        "value": (dims, values.astype(np.float32)),
        "measured": (dims, np.stack(is_measured, axis=1).astype(np.int8)),
    }
    if card.skill is not None:
        reference = card.skill.reference
        attributes["best_floor"] = reference
        reference_values = card.scores[reference][card.ranking].values
        variables["best_floor_value"] = (("scenario",), reference_values)

    with atomic_path(path, option=option) as temporary:
        try:
            # closing the file writes most of it
            with open_netcdf(temporary, "w") as file:
                file.setncatts(attributes)
                for dim, length in lengths:
                    file.createDimension(dim, length)
                for name, (variable_dims, array) in variables.items():
                    is_large = array.nbytes > INDEX
                    variable = file.createVariable(
                        name,
                        array.dtype,
                        variable_dims,
                        compression="zlib" if is_large else None,
                        complevel=9,
                        shuffle=True,
                        fill_value=False,
                        chunksizes=array.shape if is_large else None,
                        contiguous=not is_large,
                    )
                    variable[...] = array
        except (OSError, RuntimeError) as error:
            raise explain_write_error(path, error, option=option) from error
