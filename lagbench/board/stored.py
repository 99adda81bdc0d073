"""Read a score file of a stranger: bounded, self-contained, of the shape that the task has.

HDF5 lets a file show the bytes of other files as its own (external links, external storage,
virtual data sets) and unpack a few bytes to gigabytes. Both are refused by looking at the
headers, before a value is read.
"""

from __future__ import annotations

import stat
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from lagbench.data.grid import Grid, Placement
from lagbench.data.registry import Size
from lagbench.errors import UnreadableFileError
from lagbench.metrics.distributions import BINS
from lagbench.scoring.card import unreadable_scores
from lagbench.scoring.scenario import FRAMES, PARTICLES, Preview
from lagbench.scoring.score_file import FILM_RANGE, StoredScores, read_statistics
from lagbench.scoring.task import ranking_metric
from lagbench.submission.hdf5 import opened
from lagbench.submission.task_checks import frames_to_predict

from .coverage import reported_frames

__all__ = ["MAX_SCORE_BYTES", "Stored", "read_stored"]

MAX_SCORE_BYTES = 300_000
"""Longest score file [bytes]."""

MAX_UNPACKED = 32 << 20
"""Most that a score file may unpack to [bytes]; the largest of ours takes 3 MB."""

MAX_LINKS = 40
MAX_STATISTICS = 500

GROUP = "preview"
FILTERS = (h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE)
NUMBERS = (h5py.h5t.INTEGER, h5py.h5t.FLOAT)
LAYOUTS = (h5py.h5d.COMPACT, h5py.h5d.CONTIGUOUS, h5py.h5d.CHUNKED)


@dataclass(frozen=True, kw_only=True, eq=False)
class Stored:
    """What a score file holds."""

    scores: StoredScores  # identity and statistics
    preview: Preview  # pictures of the first scenario
    precision: float  # step of the packed vorticity maps [1/frame]


def read_stored(path: Path, size: Size | None = None) -> Stored:
    """Read a score file."""
    _check_length(path)
    try:
        with opened(path) as file:
            _check_members(file)
        scores = read_statistics(path)
        _check_statistics(scores)
        preview, precision = _read_preview(path)
        if size is not None:
            _check_task(scores, preview, size)
    except UnreadableFileError:
        raise
    except Exception as error:  # HDF5 on damaged bytes raises nearly any type
        raise unreadable_scores(path, error) from error
    return Stored(scores=scores, preview=preview, precision=precision)


def _check_length(path: Path) -> None:
    try:
        status = path.lstat()
    except OSError as error:
        raise UnreadableFileError(
            "cannot read the score file",
            where=str(path),
            expected="the file that `lagbench submit` wrote beside the entry",
            got=error.strerror,
            fix="bring it back, or submit the predictions again; `lagbench leaderboard check` names all such",
        ) from error
    regular = stat.S_ISREG(status.st_mode)
    if not regular or status.st_size > MAX_SCORE_BYTES:
        raise UnreadableFileError(
            "not a score file",
            where=str(path),
            expected=f"a regular file of at most {MAX_SCORE_BYTES} bytes",
            got=f"{status.st_size} bytes" if regular else "a link, folder or device",
            fix="`lagbench submit` writes it",
        )


def _check_members(file: h5py.File) -> None:
    """Refuse links, foreign storage and filters, and data that unpack to too much."""
    total = 0
    for dataset in _datasets(file):
        plist = dataset.id.get_create_plist()
        filters = {plist.get_filter(i)[0] for i in range(plist.get_nfilters())}
        if plist.get_layout() not in LAYOUTS or plist.get_external_count() or not filters.issubset(FILTERS):
            raise ValueError("a variable that does not lie in this file, or is packed in another way")
        if dataset.id.get_type().get_class() not in NUMBERS:  # strings may share one long piece of heap
            raise ValueError("a variable that holds no plain numbers")
        total += dataset.id.get_space().get_simple_extent_npoints() * dataset.id.get_type().get_size()
        if plist.get_layout() == h5py.h5d.CHUNKED:
            total += int(np.prod(plist.get_chunk(), dtype=object)) * dataset.id.get_type().get_size()
        if total > MAX_UNPACKED:
            raise ValueError(f"more than {MAX_UNPACKED} bytes when unpacked")


def _datasets(file: h5py.File) -> Iterator[h5py.Dataset]:
    groups = [file["/"]]
    while groups:
        group = groups.pop()
        if group.id.get_num_objs() > MAX_LINKS:
            raise ValueError(f"more than {MAX_LINKS} members")
        for index in range(group.id.get_num_objs()):
            name = group.id.get_objname_by_idx(index)
            if group.id.links.get_info(name).type != h5py.h5l.TYPE_HARD:
                raise ValueError("a link instead of a variable")
            kind = h5py.h5o.get_info(group.id, name).type
            if kind == h5py.h5o.TYPE_DATASET:
                yield group[name]
            elif kind == h5py.h5o.TYPE_GROUP and group.name == "/" and name == GROUP.encode():
                groups.append(group[name])
            else:
                raise ValueError("a group that score files do not have")


def _check_statistics(scores: StoredScores) -> None:
    tallies = list(scores.tallies.values())
    if not tallies or len(tallies[0].names) > MAX_STATISTICS:
        raise ValueError("no scenarios, or too many statistics")
    if not all(np.isfinite(tally.total).all() for tally in tallies):
        raise ValueError("infinite statistics")


def _read_preview(path: Path) -> tuple[Preview, float]:
    with opened(path) as file:
        group = file[GROUP]
        vorticity, precision = _unpacked(group["vorticity"])
        histogram, _ = _unpacked(group["histogram"])
        film, _ = _unpacked(group["film"])
        preview = Preview(
            scenario=int(np.ravel(group.attrs["scenario"])[0]),
            map_frames=_integers(group["map_frame"]),
            vorticity=vorticity,
            histogram=histogram,
            histogram_range=np.asarray(group["histogram_range"][...], np.float32),
            film_frames=_integers(group["film_frame"]),
            particles=_integers(group["film_particle"]),
            material=np.asarray(group["material"][...], np.int8),
            film=film,
        )
    _check_shapes(preview)
    return preview, precision


def _unpacked(variable: h5py.Dataset) -> tuple[NDArray[np.float32], float]:
    """Return packed values, NaN where missing, and the step of the packing."""
    attributes: dict[str, Any] = dict(variable.attrs)
    scale, offset = (float(np.ravel(attributes[name])[0]) for name in ("scale_factor", "add_offset"))
    fill = int(np.ravel(attributes["_FillValue"])[0])
    steps = variable[...]
    if steps.dtype != np.uint16 or not np.isfinite([scale, offset]).all() or scale <= 0.0:
        raise ValueError(f"{variable.name} is not packed as it should be")
    values = np.where(steps == fill, np.nan, steps * scale + offset)
    return values.astype(np.float32), scale


def _integers(variable: h5py.Dataset) -> tuple[int, ...]:
    return tuple(int(number) for number in variable[...].astype(np.int64))


def _check_shapes(preview: Preview) -> None:
    maps, frames, particles = len(preview.map_frames), len(preview.film_frames), len(preview.particles)
    nodes = preview.vorticity.shape[-1]
    shapes = {
        "vorticity": (preview.vorticity.shape, (2, maps, nodes, nodes)),
        "histogram": (preview.histogram.shape, (2, maps, BINS)),
        "histogram_range": (preview.histogram_range.shape, (maps, 2)),
        "material": (preview.material.shape, (particles,)),
        "film": (preview.film.shape, (2, frames, particles, 2)),
    }
    for name, (got, expected) in shapes.items():
        if got != expected:
            raise ValueError(f"{name} has shape {got}, not {expected}")
    low, high = FILM_RANGE
    ends = preview.film[np.isfinite(preview.film)]
    if frames > FRAMES or particles > PARTICLES or ends.size < preview.film.size:
        raise ValueError("the film is longer than films are, or has holes")
    if ends.size and (ends.min() < low - 1e-3 or ends.max() > high + 1e-3):
        raise ValueError("the film leaves its range")


def _check_task(scores: StoredScores, preview: Preview, size: Size) -> None:
    frames, ids = tuple(frames_to_predict(size)), tuple(sorted(size.subsets["test"]))
    found = next(iter(scores.tallies.values())).frames
    if tuple(sorted(scores.tallies)) != ids or found != frames:
        raise ValueError(f"other scenarios or frames than {size.split} {size.name} has")
    if scores.ranking != ranking_metric(size) or preview.scenario != ids[0]:
        raise ValueError("another ranking metric or another pictured scenario")
    task = size.task
    grid = Grid(task.score_grid.cells, Placement(task.score_grid.placement))
    if preview.vorticity.shape[-1] != grid.nodes or preview.map_frames != reported_frames(size):
        raise ValueError("maps of another grid or of other frames")
    if not set(preview.film_frames).issubset(frames) or preview.film_frames != tuple(
        sorted(preview.film_frames)
    ):
        raise ValueError("a film of other frames")
