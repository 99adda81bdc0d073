"""The order of the axes of a user's arrays: frame, particle, space."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagbench.errors import DataError, UsageError

ORDER = ("frame", "particle", "space")
"""The order of a trajectory, and of an array whose order is not stated."""

LARGEST = 1e30
"""Greatest position whose square is a float [length]."""

SAMPLES = 32
"""Frames that are looked at to see whether the order may be another."""

STEP_RATIO = 0.5
"""Steps along the second axis over those along the first, below which frames may be the
second axis: particles move little between two frames, and two particles are apart.
"""


def parse_order(names: Sequence[str]) -> tuple[str, ...]:
    """Return the order of the axes that a user states.

    Raises:
        UsageError: it is not an order of the three axes.
    """
    if sorted(names) != sorted(ORDER):
        raise UsageError(
            "this is no order of axes",
            where="axes",
            expected=f"{', '.join(ORDER)}, each once",
            got=", ".join(map(ascii, names)) or "no name",
            fix="name the axes of an array of positions in their order",
        )
    return tuple(names)


class OrderedArray:
    """An array of positions or velocities, read by frame whatever its order is."""

    def __init__(
        self,
        array: Any,  # noqa: ANN401 (arrays, also netCDF's)
        order: tuple[str, ...],
    ) -> None:
        self._array = array
        self._order = order

    @property
    def shape(self) -> tuple[int, ...]:
        """Lengths of frame, particle and space, where the array has three axes."""
        shape = tuple(self._array.shape)
        if len(shape) != len(ORDER):
            return shape
        return tuple(shape[self._order.index(name)] for name in ORDER)

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the values; netCDF's types of texts and lists are objects."""
        stored = getattr(self._array, "datatype", self._array.dtype)
        if isinstance(stored, np.dtype):
            return stored
        return np.dtype(object)

    def __getitem__(self, frame: int) -> NDArray[Any]:
        """Return one frame, shape [particle, axis]."""
        place: list[int | slice] = [slice(None)] * len(ORDER)
        place[self._order.index("frame")] = frame
        values = np.asarray(self._array[tuple(place)])
        if self._order.index("particle") > self._order.index("space"):
            values = values.T
        return values


def check_order(positions: OrderedArray, *, where: str) -> None:
    """Refuse positions whose first two axes look exchanged.

    Then a "frame" would be the path of one particle: it spans less than what looks like
    the path of a particle, which is a cloud, and what looks like two frames is farther
    apart than what looks like two particles.

    Raises:
        DataError: frames and particles look exchanged.
    """
    frame_count, particle_count, _ = positions.shape
    if frame_count < 3 or particle_count < 3:
        return
    numbers = np.unique(np.linspace(0, frame_count - 2, SAMPLES).astype(int))
    first = np.stack([positions[frame] for frame in numbers]).astype(np.float64)
    second = np.stack([positions[frame + 1] for frame in numbers]).astype(np.float64)
    largest = max(np.abs(first).max(), np.abs(second).max())
    if not largest <= LARGEST:
        return  # told as such when it is read

    frame_span = _median_span(first, axis=1)
    particle_span = _median_span(first, axis=0)
    frame_step = np.median(np.linalg.norm(second - first, axis=-1))
    particle_step = np.median(np.linalg.norm(np.diff(first, axis=1), axis=-1))
    spans_less = frame_span < particle_span
    if not spans_less or particle_step >= STEP_RATIO * frame_step:
        return
    raise DataError(
        "frames and particles look exchanged",
        where=where,
        expected=f"axes in the order {', '.join(ORDER)}: particles move little between "
        "two frames",
        got=f"shape {positions.shape}: median step {frame_step:.3g} along the first "
        f"axis, {particle_step:.3g} along the second",
        fix="exchange the first two axes, or state the order: --describe, key axes: "
        "[particle, frame, space]; if the order is right: [frame, particle, space]",
    )


def _median_span(positions: NDArray[np.float64], *, axis: int) -> float:
    """Return the median length of the diagonal that the points along an axis span."""
    sides = np.ptp(positions, axis=axis)
    return float(np.median(np.linalg.norm(sides, axis=-1)))
