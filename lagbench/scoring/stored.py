"""Read a score file of a stranger: bounded, self-contained, of the shape that the task
has.

HDF5 lets a file show the bytes of other files as its own (external links, external
storage, virtual data sets) and unpack a few bytes to gigabytes. Both are refused by
looking at the headers, before a value is read. HDF5 is also C code that believes what
it reads, so strangers' files are first read in a child process under limits.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from lagbench.data.checksums import round_digits
from lagbench.data.grid import Grid, Placement
from lagbench.data.hdf5 import open_hdf5
from lagbench.data.registry import Size
from lagbench.data.structure import Structure, check_structure
from lagbench.errors import UnreadableFileError, check_regular
from lagbench.metrics.distributions import BINS
from lagbench.metrics.table import ranking_metric
from lagbench.submission.task_checks import frames_to_predict
from lagbench.work.machine import run_in_child

from .card import (
    FRAMES,
    PARTICLES,
    SUBMISSION,
    Preview,
    PublishedScores,
    unreadable_scores,
)
from .score_file import FILM_RANGE, StoredScores, read_statistics

MAX_SCORE_BYTES = 1_000_000  # longest score file [bytes]
# most that a score file may unpack to [bytes]; the largest of ours takes 3 MB
MAX_UNPACKED = 32 << 20

MAX_STATISTICS = 500

GROUP = "preview"
STRUCTURE = Structure(members=40, groups=(GROUP,), unpacked=MAX_UNPACKED)
"""What a score file may hold: plain numbers of its own, in one group beside the root.
"""

# computing time of the child for every 50 files, its start aside [s]
CPU_SECONDS = 10.0

FILES_PER_PART = 50

# files that may stop a child before the rest is left unread: each costs a child's whole
# time
MOST_STOPS = 5
# time for every 50 files together [s]; a busy machine may need minutes
WALL_SECONDS = 600.0

UNREAD = (
    "not read, because too many others had to be stopped or took all the time allowed"
)


@dataclass(frozen=True, kw_only=True, eq=False)
class Stored:
    """What a score file holds."""

    scores: StoredScores  # identity and statistics
    preview: Preview  # pictures of the first scenario
    precision: float  # step of the packed vorticity maps [1/frame]


def reported_frames(size: Size) -> tuple[int, ...]:
    """Return the frames of interest and the last one, absolute."""
    frames = tuple(frames_to_predict(size))
    return tuple(
        sorted({*size.task.frames_of_interest, frames[-1]}.intersection(frames))
    )


def read_stored(path: Path, size: Size | None = None) -> Stored:
    """Read a score file."""
    if path.is_symlink():  # it could lead out of the folder
        raise UnreadableFileError(
            "not a score file", where=str(path), expected="a regular file", got="a link"
        )
    check_regular(
        path,
        longest=MAX_SCORE_BYTES,
        fix="`lagbench submit` writes it beside the entry",
    )
    try:
        with open_hdf5(path) as file:
            check_structure(file, path, STRUCTURE)
        scores = read_statistics(path)
        tallies = list(scores.tallies.values())
        if not tallies or len(tallies[0].names) > MAX_STATISTICS:
            raise ValueError("no scenarios, or too many statistics")
        if not all(np.isfinite(tally.total).all() for tally in tallies):
            raise ValueError("infinite statistics")
        with open_hdf5(path) as file:
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
        if size is not None:
            _check_task(scores, preview, size)
    except UnreadableFileError:
        raise
    except Exception as error:  # HDF5 on damaged bytes raises nearly any type
        raise unreadable_scores(path, error) from error
    return Stored(scores=scores, preview=preview, precision=precision)


def published(path: Path) -> PublishedScores:
    """Return what a score file says as a scores.json would; of the floors it has the
    best, in one metric.
    """
    stored = read_stored(path).scores
    ours = {
        name: replace(
            score,
            values=np.array([round_digits(value) for value in score.values.tolist()]),
        )
        for name, score in stored.scores().items()
    }
    rows = {SUBMISSION: ours}
    if stored.best_floor is not None and stored.ranking in ours:
        floor = replace(ours[stored.ranking], values=stored.best_floor_values)
        rows[stored.best_floor] = {stored.ranking: floor}
    return PublishedScores(
        identity=stored.identity,
        predictions_sha256=stored.predictions_sha256,
        ranking=stored.ranking,
        scores=rows,
    )


def _unpacked(variable: h5py.Dataset) -> tuple[NDArray[np.float32], float]:
    """Return packed values, NaN where missing, and the step of the packing."""
    attributes: dict[str, Any] = dict(variable.attrs)
    scale, offset = (
        float(np.ravel(attributes[name])[0]) for name in ("scale_factor", "add_offset")
    )
    fill = int(np.ravel(attributes["_FillValue"])[0])
    steps = variable[...]
    if (
        steps.dtype != np.uint16
        or not np.isfinite([scale, offset]).all()
        or scale <= 0.0
    ):
        raise ValueError(f"{variable.name} is not packed as it should be")
    values = np.where(steps == fill, np.nan, steps * scale + offset)
    return values.astype(np.float32), scale


def _integers(variable: h5py.Dataset) -> tuple[int, ...]:
    return tuple(int(number) for number in variable[...].astype(np.int64))


def _check_shapes(preview: Preview) -> None:
    maps = len(preview.map_frames)
    frames = len(preview.film_frames)
    particles = len(preview.particles)
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
    if frames > FRAMES or particles > PARTICLES or not np.isfinite(preview.film).all():
        raise ValueError("the film is longer than films are, or has holes")
    low, high = FILM_RANGE
    if preview.film.size and (
        preview.film.min() < low - 1e-3 or preview.film.max() > high + 1e-3
    ):
        raise ValueError("the film leaves its range")


def _check_task(scores: StoredScores, preview: Preview, size: Size) -> None:
    frames = tuple(frames_to_predict(size))
    ids = tuple(sorted(size.subsets["test"]))
    found = next(iter(scores.tallies.values())).frames
    if tuple(sorted(scores.tallies)) != ids or found != frames:
        raise ValueError(f"other scenarios or frames than {size.split} {size.name} has")
    if scores.ranking != ranking_metric(size) or preview.scenario != ids[0]:
        raise ValueError("another ranking metric or another pictured scenario")
    task = size.task
    grid = Grid(task.score_grid.cells, Placement(task.score_grid.placement))
    if preview.vorticity.shape[
        -1
    ] != grid.nodes or preview.map_frames != reported_frames(size):
        raise ValueError("maps of another grid or of other frames")
    shown = preview.film_frames
    if not set(shown).issubset(frames) or shown != tuple(sorted(shown)):
        raise ValueError("a film of other frames")


def unreadable_in_child(paths: Sequence[Path]) -> dict[Path, str]:
    """Return the files that cannot be read, and why.

    A child that a file stops is started anew for the rest, :data:`MOST_STOPS` times at
    most and within :data:`WALL_SECONDS` for every :data:`FILES_PER_PART` files,
    whatever the files do.
    """
    found: dict[Path, str] = {}
    left = list(paths)
    stops = 0
    parts = 1 + len(paths) // FILES_PER_PART
    end = time.monotonic() + WALL_SECONDS * parts
    while left:
        if stops == MOST_STOPS or time.monotonic() >= end:
            return found | dict.fromkeys(left, UNREAD)
        room = end - time.monotonic()
        said, stopped = run_in_child(
            READ, [str(path) for path in left], seconds=CPU_SECONDS * parts, wall=room
        )
        found |= {
            path: why for path, why in zip(left, said, strict=False) if why is not None
        }
        if len(said) < len(left):
            found[left[len(said)]] = f"reading it had to be stopped: {stopped}"
            stops += 1
        left = left[len(said) + 1 :]
    return found


def unreadable(path: str) -> str | None:
    """Return why a file cannot be read, for a parent; None if it can."""
    try:
        read_stored(Path(path))
    except UnreadableFileError as error:
        return f"{error.what}: {error.got}"
    return None


READ = f"{__name__}.{unreadable.__name__}"
