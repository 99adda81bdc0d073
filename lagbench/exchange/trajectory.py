"""A trajectory from anywhere: what formats are read into, and what a local split is made of."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from lagbench.errors import DataError, UnreadableFileError

__all__ = ["Frame", "Trajectory", "check_array", "frames_of"]

Array = NDArray[np.floating]
Frame = tuple[Array, Array | None]
"""Positions [length of the source] and, where the source has them, velocities [its length/s]."""

PLANE = 2
"""Components of a position."""


@dataclass(frozen=True, kw_only=True)
class Trajectory:
    """One trajectory whose frames are read when asked for."""

    name: str  # file and key, for messages
    frames: int  # recorded frames
    # value of lagbench.data.scenario.MATERIALS of each particle, int8, shape [particle]
    material: NDArray[np.int8]
    read: Callable[[], Iterator[Frame]]  # returns the frames in order, one at a time
    # [length/s], shape [wall, 2] or [frame, wall, 2]; None where there is none
    wall_velocity: Array | None = None
    # facts that the scenario's file states and hashes
    parameters: Mapping[str, object] = field(default_factory=dict)

    @property
    def particles(self) -> int:
        """Particles in every frame."""
        return len(self.material)

    def first(self) -> Array:
        """Return the positions of the first frame, shape [particle, 2]."""
        return next(self.read())[0]


def check_array(name: str, shape: tuple[int, ...], dtype: np.dtype[np.generic]) -> None:
    """Refuse positions that are no floats of two components over frames and particles."""
    if len(shape) != 3 or dtype.kind != "f":
        raise UnreadableFileError(
            "these are no positions",
            where=name,
            expected="floats of shape (frame, particle, 2)",
            got=f"{dtype} of shape {shape}",
        )
    if shape[2] != PLANE:
        raise DataError(
            f"positions have {shape[2]} components",
            where=name,
            expected="2: lagbench holds plane data only",
            got=f"shape {shape}",
        )
    if shape[0] < 2 or shape[1] < 1:
        raise DataError("too little for a trajectory", where=name, expected="2 frames, 1 particle", got=shape)


def frames_of(position: Array, velocity: Array | None = None) -> Iterator[Frame]:
    """Yield the frames of arrays, in memory or mapped, of shape [frame, particle, 2]."""
    for number, frame in enumerate(position):
        yield np.asarray(frame), None if velocity is None else np.asarray(velocity[number])
