"""What a user says of data from elsewhere, and what follows from it where nothing is said."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypedDict

from lagbench.data.local import is_name
from lagbench.data.registry import NO_GENERATOR, spell_ids
from lagbench.errors import UsageError

from .measure import Box, Measure

__all__ = ["Description", "Wishes", "rate_of", "split_yaml"]

SIZE = "full"
"""Size of every local split."""

VERSION = "1.0.0"
LEAST, MOST = 1e-30, 1e30
"""Least and greatest number that a length, a time or a density may be: squares of them are floats."""

FEWEST_CELLS, MOST_CELLS = 4, 4096
"""Cells across of a score grid."""

PER_CELL = 2.5
"""Spacings of particles across a cell of the score grid where the user gives none; the splits of
lagbench have 1.8 to 2.6."""

_UNITS: Mapping[str, tuple[str, str]] = {
    "particles": ("1", "particles in one test scenario; the most of any where they differ"),
    "grid": ("1", "cells across the unit box; predictions may leave the bounds by one"),
    "substeps_per_frame": ("1", "solver steps between recorded frames, 1 where they are unknown"),
    "frame_rate": ("1/s", "recorded frames per second"),
    "density": ("mass/length^2", "rest density"),
    "spacing": ("length", "distance of neighbouring particles at first"),
    "source_scale": ("length of the source", "what a unit of length is in the source"),
    "source_x": ("length of the source", "x in the source of the lower left corner"),
    "source_y": ("length of the source", "y in the source of the lower left corner"),
}


class Wishes(TypedDict, total=False):
    """What a user may say of data from elsewhere; see :class:`Description`."""

    title: str
    text: str
    citation: str
    licence: str
    radius: float
    frame_interval: float
    bounds: Box
    rescale: bool
    density: float
    spacing: float
    input_frames: int
    horizon: int
    frames_of_interest: Sequence[int]
    cells: int
    full_box: bool


@dataclass(frozen=True, kw_only=True)
class Description:
    """What is known of data from elsewhere; lengths are those of the source."""

    name: str  # name of the split
    title: str = ""  # title of the split; its name when empty
    text: str = ""  # what the data are
    citation: str = "none"  # whom to cite
    licence: str = "unknown"  # licence of the data
    source: str  # where they come from
    radius: float  # connectivity radius
    frame_interval: float  # time between frames [s]
    bounds: Box | None = None  # box that holds the particles; None where the positions say
    rescale: bool = False  # whether to fit the bounds into the unit box
    density: float = 1.0  # rest density [mass/length^2]
    spacing: float | None = None  # distance of neighbouring particles at first; None to estimate it
    input_frames: int = 6  # frames given to a model
    horizon: int | None = None  # frames to predict; None for all that every test scenario has
    # absolute frames at which the scorer reports; None for the last one
    frames_of_interest: Sequence[int] | None = None
    cells: int | None = None  # cells across of the score grid; None for one that suits the spacing
    full_box: bool = False  # whether material fills the box, so that vorticity ranks; else positions rank
    measure: Measure = field(init=False, default=Measure())

    def __post_init__(self) -> None:
        """Check what the user gave."""
        if not is_name(self.name):
            proposal = re.sub(r"[^a-z0-9_-]+", "-", self.name.lower()).strip("-_0123456789") or "own"
            raise UsageError(
                "a split cannot have that name",
                where="--output, its last part",
                expected="small letters, digits, - and _, a letter first",
                got=self.name,
                fix=f"--output {proposal}",
            )
        positive = {
            "--radius": self.radius,
            "--frame-interval": self.frame_interval,
            "--density": self.density,
        }
        positive |= {"--spacing": 1.0 if self.spacing is None else self.spacing}
        for option, value in positive.items():
            if not (LEAST <= value <= MOST):
                raise UsageError("not a number above 0 that computes", where=option, got=value)
        if self.bounds is not None and any(not -MOST <= low < high <= MOST for low, high in self.bounds):
            raise UsageError("bounds run from low to high", where="--bounds", got=self.bounds)
        if self.cells is not None and not FEWEST_CELLS <= self.cells <= MOST_CELLS:
            expected = f"{FEWEST_CELLS} to {MOST_CELLS}"
            raise UsageError("no such score grid", where="--cells", expected=expected, got=self.cells)
        if self.rescale:
            if self.bounds is None:
                raise UsageError("what is to fit the unit box?", where="--rescale", fix="add --bounds")
            object.__setattr__(self, "measure", Measure.fitting(self.bounds))


def split_yaml(
    about: Description,
    *,
    subsets: Mapping[str, Sequence[int]],
    frames: Mapping[int, int],
    particles: int,
    spacing: float,
    bounds: Box,
    measured: Mapping[str, object],
) -> dict[str, object]:
    """Return the content of split.yaml as plain values."""
    task = _task(about, shortest=min(frames[i] for i in subsets["test"]), spacing=spacing)
    cells = task["score_grid"]["cells"]
    values: dict[str, object] = {
        "particles": particles,
        "grid": cells,
        "substeps_per_frame": 1,
        "frame_rate": rate_of(about.frame_interval),
        "density": about.density,
        "spacing": spacing,
        "source_scale": about.measure.scale,
        "source_x": about.measure.corner[0],
        "source_y": about.measure.corner[1],
    }
    size = {
        "subsets": {name: spell_ids(ids) for name, ids in subsets.items()},
        "frames": _frame_groups(frames),
        "bounds": [list(pair) for pair in bounds],
        "parameters": {},
        "task": task,
    }
    split = {
        "version": VERSION,
        "title": about.title or about.name,
        "description": about.text or about.source,
        "citation": about.citation,
        "licence": about.licence,
        "generator": NO_GENERATOR,
        "source": about.source,
        "parameters": {
            name: {"value": value, "unit": _UNITS[name][0], "description": _UNITS[name][1]}
            for name, value in values.items()
        },
        "sizes": {SIZE: size},
    }
    return {"format": 1, "splits": {about.name: split}, "measured": {about.name: {SIZE: dict(measured)}}}


def _task(about: Description, *, shortest: int, spacing: float) -> dict[str, Any]:
    """Return the task, as far as the shortest test scenario allows one."""
    horizon = about.horizon or shortest - about.input_frames
    last = about.input_frames + horizon - 1
    if horizon < 1 or last >= shortest:
        raise UsageError(
            "a test scenario is too short for the task",
            where="--input-frames and --horizon",
            expected=f"together at most {shortest}",
            got=f"{about.input_frames} and {horizon}",
        )
    cells = about.cells or min(MOST_CELLS, max(FEWEST_CELLS, round(1.0 / (PER_CELL * spacing))))
    interest = sorted(set(about.frames_of_interest or (last,)))
    if not about.input_frames <= interest[0] <= interest[-1] <= last:
        raise UsageError(
            "a frame of interest is not predicted",
            where="--frames-of-interest",
            expected=f"frames {about.input_frames} to {last}",
            got=spell_ids(interest) if interest[0] >= 0 else interest,
        )
    return {
        "input_frames": about.input_frames,
        "horizon": horizon,
        "frames_of_interest": interest,
        "score_grid": {"cells": cells, "placement": "cell_centres" if about.full_box else "nodes"},
        "radius": about.radius / about.measure.scale,
    }


def rate_of(frame_interval: float) -> float:
    """Return frames per second to 12 digits: 1 / (0.1 / 12 * 12) is 10.

    >>> rate_of(0.1 / 12 * 12)
    10.0
    """
    return float(f"{1.0 / frame_interval:.12g}")


def _frame_groups(frames: Mapping[int, int]) -> int | dict[int, str]:
    """Return one count of frames, or the ids of each."""
    counts = sorted(set(frames.values()))
    if len(counts) == 1:
        return counts[0]
    return {count: spell_ids(i for i, c in sorted(frames.items()) if c == count) for count in counts}
