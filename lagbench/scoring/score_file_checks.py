"""Read a score file from anybody: bounded, self-contained, and of the task's shape.

HDF5 lets a file show the bytes of other files as its own (external links, external
storage, virtual data sets) and unpack a few bytes to gigabytes. The headers tell, and
both are refused before a value is read.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from lagbench.data import MATERIALS
from lagbench.data.checksums import round_digits
from lagbench.data.hdf5 import open_hdf5, open_variable
from lagbench.data.registry import Size
from lagbench.data.structure import Structure, check_structure
from lagbench.errors import UnreadableFileError, check_regular
from lagbench.metrics.aggregate import Score
from lagbench.metrics.distributions import BINS
from lagbench.metrics.table import ranking_metric
from lagbench.submission.task_checks import frames_to_predict

from .published_scores import PublishedScores, unreadable_scores
from .scenario import FILM_RANGE, FRAMES, PARTICLES, SUBMISSION, Preview
from .score_file import SubmissionStatistics, statistics_in

MAX_SCORE_BYTES = 1_000_000  # longest score file [bytes]
# most that a score file may unpack to [bytes]; the largest of ours takes 3 MB
MAX_UNPACKED = 32 << 20

MAX_STATISTICS = 500

FILM_TOLERANCE = 1e-3
"""Rounding of packed positions beyond their range [length]."""

GROUP = "preview"
STRUCTURE = Structure(members=40, groups=(GROUP,), unpacked=MAX_UNPACKED)
"""Content that a score file may have: plain numbers, in the root and one group."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ScoreFile:
    """Content of a score file."""

    scores: SubmissionStatistics  # identity and statistics
    preview: Preview  # pictures of the first scenario
    precision: float  # step of the packed vorticity maps [1/frame]


def reported_frames(size: Size) -> tuple[int, ...]:
    """Return the frames of interest and the last one, absolute."""
    frames = tuple(frames_to_predict(size))
    interesting = {*size.task.frames_of_interest, frames[-1]}
    return tuple(sorted(interesting.intersection(frames)))


def read_score_file(path: Path, size: Size | None = None) -> ScoreFile:
    """Read a score file; with a size it must have the shape of that task.

    The scores are those of the subset that the size scores, see ``Size.scored_on``.

    Raises:
        UnreadableFileError: it is no score file, or of another task.
    """
    if path.is_symlink():  # it could lead out of the folder
        raise UnreadableFileError(
            "not a score file",
            where=str(path),
            expected="a regular file",
            got="a link",
            fix="put the file itself in its place",
        )
    check_regular(
        path,
        longest=MAX_SCORE_BYTES,
        fix="`lagbench submit` writes it beside the entry",
    )
    try:
        with open_hdf5(path) as file:
            check_structure(file, path, STRUCTURE)
            scores = statistics_in(file)
            _check_statistics(scores)
            preview, precision = _read_preview(file[GROUP])
        _check_shapes(preview)
        if size is not None:
            _check_task(scores, preview, size)
    except UnreadableFileError:
        raise
    except Exception as error:  # HDF5 on damaged bytes raises nearly any type
        raise unreadable_scores(path, error) from error
    return ScoreFile(scores=scores, preview=preview, precision=precision)


def read_published_scores(path: Path) -> PublishedScores:
    """Return the scores of a score file in the form of scores.json, with its digits.

    The only reference is the best one, and it has the ranking metric only.
    """
    statistics = read_score_file(path).scores
    submission: dict[str, Score] = {}
    for name, score in statistics.scores().items():
        values = [round_digits(value) for value in score.values.tolist()]
        submission[name] = replace(score, values=np.array(values))

    rows = {SUBMISSION: submission}
    ranking = statistics.ranking
    if statistics.best_reference is not None and ranking in submission:
        reference = replace(
            submission[ranking], values=statistics.best_reference_values
        )
        rows[statistics.best_reference] = {ranking: reference}
    return PublishedScores(
        identity=statistics.identity,
        subset=statistics.subset,
        predictions_sha256=statistics.predictions_sha256,
        ranking=ranking,
        scores=rows,
    )


def _read_preview(group: h5py.Group) -> tuple[Preview, float]:
    """Return the preview and the step of its vorticity maps [1/frame]."""
    vorticity, precision = _unpack(open_variable(group, "vorticity"))
    histogram, _ = _unpack(open_variable(group, "histogram"))
    film, _ = _unpack(open_variable(group, "film"))
    obstacle = None
    if "obstacle" in group.attrs:
        obstacle = _read_obstacle(group)
    preview = Preview(
        scenario=int(np.ravel(group.attrs["scenario"])[0]),
        map_frames=_read_integers(open_variable(group, "map_frame")),
        vorticity=vorticity,
        histogram=histogram,
        histogram_range=np.asarray(
            open_variable(group, "histogram_range")[...], np.float32
        ),
        film_frames=_read_integers(open_variable(group, "film_frame")),
        particles=_read_integers(open_variable(group, "film_particle")),
        material=_read_material(open_variable(group, "material")),
        film=film,
        obstacle=obstacle,
    )
    return preview, precision


def _read_material(variable: h5py.Dataset) -> NDArray[np.int8]:
    """Return the materials of the film's particles.

    Raises:
        ValueError: a number stands for no material.
    """
    numbers = variable[...]
    # before the cast, which wraps
    if not np.isin(numbers, range(len(MATERIALS))).all():
        raise ValueError("a particle of the film has an unknown material")
    return np.asarray(numbers, np.int8)


def _read_obstacle(group: h5py.Group) -> NDArray[np.float32]:
    """Return centre and radius of the obstacle [length].

    Raises:
        ValueError: they are no float32.
    """
    values = np.asarray(group.attrs["obstacle"])
    if values.dtype != np.float32:
        raise ValueError("the obstacle is no array of float32")
    return values


def _unpack(variable: h5py.Dataset) -> tuple[NDArray[np.float32], float]:
    """Return packed values, NaN where missing, and the step of the packing.

    Values beyond float32 are infinite.
    """
    scale = float(_first_number(variable.attrs["scale_factor"]))
    offset = float(_first_number(variable.attrs["add_offset"]))
    fill = int(_first_number(variable.attrs["_FillValue"]))
    steps = variable[...]
    is_finite = np.isfinite([scale, offset]).all()
    has_valid_scale = is_finite and scale > 0.0
    if steps.dtype != np.uint16 or not has_valid_scale:
        raise ValueError(f"{variable.name} is not packed as it should be")
    is_missing = steps == fill
    with np.errstate(over="ignore"):  # what is beyond float32 becomes infinite
        unpacked = steps * scale + offset
        values = np.where(is_missing, np.nan, unpacked)
        return values.astype(np.float32), scale


def _first_number(attribute: Any) -> Any:  # noqa: ANN401 (types of netCDF)
    """Return the number of an attribute, which may be an array."""
    return np.ravel(attribute)[0]


def _read_integers(variable: h5py.Dataset) -> tuple[int, ...]:
    return tuple(variable[...].astype(np.int64).tolist())


def _check_statistics(scores: SubmissionStatistics) -> None:
    tallies = list(scores.tallies.values())
    if not tallies or len(tallies[0].names) > MAX_STATISTICS:
        raise ValueError("no scenarios, or too many statistics")
    if not all(np.isfinite(tally.total).all() for tally in tallies):
        raise ValueError("infinite statistics")


def _check_shapes(preview: Preview) -> None:
    map_count = len(preview.map_frames)
    film_count = len(preview.film_frames)
    particle_count = len(preview.particles)
    nodes = preview.vorticity.shape[2:4]
    space = preview.film.shape[-1]
    shapes = {
        "vorticity": (preview.vorticity.shape, (2, map_count, *nodes)),
        "histogram": (preview.histogram.shape, (2, map_count, BINS)),
        "histogram_range": (preview.histogram_range.shape, (map_count, 2)),
        "material": (preview.material.shape, (particle_count,)),
        "film": (preview.film.shape, (2, film_count, particle_count, space)),
    }
    if preview.obstacle is not None:
        shapes["obstacle"] = (preview.obstacle.shape, (space + 1,))
    for name, (got, expected) in shapes.items():
        if got != expected:
            raise ValueError(f"{name} has shape {got}, not {expected}")
    if np.isinf(preview.vorticity).any() or np.isinf(preview.histogram).any():
        raise ValueError("a map or a histogram has infinite values")
    _check_obstacle(preview.obstacle)
    _check_histograms(preview)

    film = preview.film
    is_long = film_count > FRAMES or particle_count > PARTICLES
    if is_long or not np.isfinite(film).all():
        raise ValueError("the film is longer than films are, or has holes")
    if not film.size:
        return
    low, high = FILM_RANGE
    if film.min() < low - FILM_TOLERANCE or film.max() > high + FILM_TOLERANCE:
        raise ValueError("the film leaves its range")


def _check_histograms(preview: Preview) -> None:
    """Refuse shares without a range.

    A map frame without rotation has neither: its shares and its range are NaN.
    """
    low, high = preview.histogram_range.T
    has_range = np.isfinite(low) & np.isfinite(high) & (low <= high)
    has_no_range = np.isnan(low) & np.isnan(high)
    if not (has_range | has_no_range).all():
        raise ValueError("a histogram has an impossible range")
    has_shares = np.isfinite(preview.histogram).any(axis=(0, 2))
    if (has_shares & has_no_range).any():
        raise ValueError("a histogram has shares without a range")


def _check_obstacle(obstacle: NDArray[np.float32] | None) -> None:
    if obstacle is None:
        return
    if not np.isfinite(obstacle).all() or obstacle[-1] <= 0.0:
        raise ValueError("the obstacle has no place or no size")
    low, high = FILM_RANGE
    place = obstacle[:-1]
    if place.min() < low or place.max() > high or obstacle[-1] > high - low:
        raise ValueError("the obstacle leaves the range of films")


def _check_task(scores: SubmissionStatistics, preview: Preview, size: Size) -> None:
    """Refuse a file that is not of the task of a split and size."""
    if scores.subset != size.scored_subset:
        raise ValueError(f"scores of the subset {scores.subset[:40]!a}")
    frames = tuple(frames_to_predict(size))
    ids = tuple(sorted(size.scored_scenarios))
    scored_ids = tuple(sorted(scores.tallies))
    scored_frames = next(iter(scores.tallies.values())).frames
    if scored_ids != ids or scored_frames != frames:
        raise ValueError(f"other scenarios or frames than {size.split} {size.name} has")
    if scores.ranking != ranking_metric(size) or preview.scenario != ids[0]:
        raise ValueError("another ranking metric or another pictured scenario")

    grid = size.field_grid.section
    has_other_grid = preview.vorticity.shape[2:] != grid.shape
    if preview.film.shape[-1] != size.dimension:
        raise ValueError("a film of another dimension")
    if has_other_grid or preview.map_frames != reported_frames(size):
        raise ValueError("maps of another grid or of other frames")
    film_frames = preview.film_frames
    is_ordered = film_frames == tuple(sorted(film_frames))
    if not set(film_frames).issubset(frames) or not is_ordered:
        raise ValueError("a film of other frames")
