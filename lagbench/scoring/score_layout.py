"""What scores.json and scores.nc have in common: layout, identity, preview."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lagbench.errors import UnreadableFileError
from lagbench.submission.format import MAX_NAME

FORMAT = 1
"""Number of the layout of scores.json and scores.nc; stored as ``lagbench_scores``."""

IDENTITY = ("split", "size", "dataset_version", "dataset_sha256", "method")
"""Fields that identify the predicted data set and the method."""

SUBMISSION = "submission"
"""Row of the submission; reference predictors have rows of their names."""

LAST_STEP = 65534
"""Greatest packed value of a preview."""

FILL_STEP = 65535
"""Packed value that marks a missing one."""

FILM_RANGE = (-0.5, 1.5)
"""Positions in the preview are clipped to this range [length]."""

FRAMES = 45
"""Frames of the particle film, evenly spaced over the horizon."""

PARTICLES = 200
"""Particles of the film, evenly spaced over the particle numbers."""


def spaced(length: int, count: int) -> list[int]:
    """Return at most so many evenly spaced indices, first and last included.

    >>> spaced(10, 4), spaced(3, 5), spaced(7, 1)
    ([0, 3, 6, 9], [0, 1, 2], [6])
    """
    if length <= count:
        return list(range(length))
    last = length - 1
    if count == 1:
        return [last]
    indices = []
    for number in range(count):
        index = number * last // (count - 1)
        indices.append(index)
    return indices


@dataclass(frozen=True, eq=False)
class Preview:
    """Pictures of one scenario; index 0 of ``side`` is the truth, 1 the prediction."""

    scenario: int  # id of the scenario
    map_frames: tuple[int, ...]  # frames of interest and the last one
    # at the compared nodes, NaN elsewhere [1/frame], shape [side, map frame, x node, y
    # node]
    vorticity: NDArray[np.float32]
    # shares of 64 bins over the truth's range of omega, NaN where there is none [1],
    # shape [side, map frame, bin]
    histogram: NDArray[np.float32]
    histogram_range: NDArray[np.float32]  # that range [1/frame], shape [map frame, 2]
    film_frames: tuple[int, ...]
    particles: tuple[int, ...]  # numbers of the particles in the film
    material: NDArray[np.int8]  # their materials, shape [film particle]
    # their positions [length], shape [side, film frame, film particle, axis]
    film: NDArray[np.float32]
    # centre and radius of a fixed obstacle [length], shape [axis + 1]; None without one
    obstacle: NDArray[np.float32] | None = None


def unreadable_scores(path: Path, error: Exception) -> UnreadableFileError:
    """Return the error for a file that is no scores.json or scores.nc."""
    return UnreadableFileError(
        f"not a scores{path.suffix} of lagbench",
        where=str(path),
        expected="what `lagbench score` writes beside the predictions",
        got=f"{type(error).__name__}: {str(error)[:MAX_NAME]}",
        fix="score the predictions again: lagbench score predictions.nc",
    )
