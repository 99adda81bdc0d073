"""scores.nc: the statistics of a submission per scenario and frame, and its preview.

Every score of the submission follows from it: ``read_statistics(path).scores()`` gives
the digits of scores.json. Statistics are float32 and NaN where undefined, those of long
rollouts rounded to 11 significant bits (see :func:`round_statistics`), so that no full
size takes more than 1 MB; ``measured`` marks those that were measured at all. The
scores of the best reference in the ranking metric are stored too, so that the skill can
be formed again.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from lagbench.data.hdf5 import open_hdf5, open_variable, read_attribute
from lagbench.errors import UnreadableFileError
from lagbench.metrics.aggregate import Score, Tally, aggregate
from lagbench.metrics.metric import Metric
from lagbench.metrics.table import available
from lagbench.submission.format import require_name

from .published_scores import FORMAT, IDENTITY, unreadable_scores
from .skill import Skill, compute_skill

NETCDF_NAME = "scores.nc"


@dataclass(frozen=True, kw_only=True, eq=False)
class SubmissionStatistics:
    """Content of a scores.nc beside its preview."""

    # split, size, version and hash of the data set, and the method
    identity: Mapping[str, str]
    subset: str  # subset that was predicted
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
        """Return the scores of all installed metrics whose statistics are here.

        Metrics that are formed only when they are named are left out.
        """
        names = []
        for name, metric in available().items():
            if not metric.is_on_request:
                names.append(name)
        return self._aggregate(names)

    def _aggregate(self, names: Iterable[str]) -> dict[str, Score]:
        """Return scores by the name of the metric, without metrics that fail."""
        statistics = set(next(iter(self.tallies.values())).names)
        table = available()
        metrics: dict[str, Metric] = {}
        for name in names:
            if name in table and statistics.issuperset(table[name].of):
                metrics[name] = table[name]
        return aggregate(metrics.values(), self.tallies)


def read_statistics(path: str | Path) -> SubmissionStatistics:
    """Read the statistics of a scores.nc.

    Raises:
        UnreadableFileError: it is no scores.nc.
    """
    path = Path(path)
    try:
        with open_hdf5(path) as file:
            return statistics_in(file)
    except UnreadableFileError:
        raise
    except Exception as error:  # HDF5 on damaged bytes raises nearly any type
        raise unreadable_scores(path, error) from error


def statistics_in(file: h5py.File) -> SubmissionStatistics:
    """Return the statistics of an open scores.nc.

    Damaged bytes raise nearly any type.

    Raises:
        ValueError: it is no scores.nc.
    """
    layout = read_attribute(file, "lagbench_scores")
    if layout != FORMAT:
        raise ValueError(f"layout {layout!r}, not {FORMAT}")
    reference, reference_values = _read_reference(file)
    subset = "test"
    if "subset" in file.attrs:
        subset = _read_text(file, "subset")
    return SubmissionStatistics(
        identity={name: _read_text(file, name) for name in IDENTITY},
        subset=subset,
        predictions_sha256=_read_text(file, "predictions_sha256"),
        ranking=_read_text(file, "ranking_metric"),
        tallies=_read_tallies(file),
        best_reference=reference,
        best_reference_values=reference_values,
    )


def _read_text(file: h5py.File, name: str) -> str:
    text = read_attribute(file, name)
    if not isinstance(text, str):
        raise ValueError(f"{name} is no text")
    return require_name(text)


def _read_reference(file: h5py.File) -> tuple[str | None, NDArray[np.float64]]:
    """Return name and values of the best reference; None where the file has none."""
    name = read_attribute(file, "best_floor")
    if name is None:
        return None, np.empty(0)
    values = np.asarray(open_variable(file, "best_floor_value")[...], np.float64)
    has_right_shape = values.shape == open_variable(file, "scenario").shape
    if not has_right_shape or np.isinf(values).any():
        raise ValueError("not the scores of a reference")
    return require_name(str(name)), values


def _read_tallies(file: h5py.File) -> dict[int, Tally]:
    """Return the statistics of each scenario."""
    statistics = read_attribute(file, "statistics")
    if not isinstance(statistics, str):
        raise ValueError("statistics is no text")
    names = tuple(statistics.split())
    frames = tuple(open_variable(file, "frame")[...].tolist())
    scenarios = open_variable(file, "scenario")[...].tolist()
    # the scores of the reference are stored in the same order
    if not all(first < second for first, second in itertools.pairwise(scenarios)):
        raise ValueError("the ids of the scenarios do not ascend")
    # shape [statistic, scenario, frame]
    values = open_variable(file, "value")[...].astype(np.float64)
    is_measured = open_variable(file, "measured")[...] != 0  # of the same shape

    tallies = {}
    for i, scenario in enumerate(scenarios):
        tallies[scenario] = _make_tally(names, frames, values[:, i], is_measured[:, i])
    return tallies


def _make_tally(
    names: tuple[str, ...],
    frames: tuple[int, ...],
    values: NDArray[np.float64],
    is_measured: NDArray[np.bool_],
) -> Tally:
    """Return a tally.

    Args:
        names: the statistics.
        frames: absolute numbers of the frames.
        values: NaN where undefined, shape [statistic, frame].
        is_measured: of the same shape.
    """
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
