"""Periods that the positions contradict.

A particle that crosses a periodic boundary may jump in the file by the true period. And
particles within a true period that is longer than the stated one come to lie on one
another when they are moved into the stated one.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from lagbench.data.box import AXES, Box
from lagbench.errors import UsageError

Floats = NDArray[np.float64]

LEAST_JUMP = 0.125
"""Step that may be a jump across a boundary, over the stated period, at least."""

CALM = 0.25
"""Steps before and after a jump, over the jump, at most: a fast particle has none."""

FEWEST_JUMPS = 5
"""Jumps from which a period is measured."""

MOST_JUMPS = 100_000
"""Jumps along an axis that are kept; those that follow are left out."""

WINDOW = 1.1
"""Extent of positions that were wrapped, over the length of the jumps, at most.

Positions that were not wrapped spread farther than a particle goes in a step.
"""

MOST_SPREAD = 0.05
"""Median deviation of jumps that have one length, over that length, at most."""

DEVIATIONS = 5.0
"""Deviations by which the stated period may differ from the measured one."""

SPACING_SHARE = 0.25
"""Difference between these periods that is always accepted [spacing]."""

NEIGHBOURS = 8
"""Nearest particles among which the nearest image is looked for."""

CONTACT_QUANTILE = 0.05
"""Quantile of the distances to the nearest particle that stands for contact."""

REGULAR = 0.5
"""Contact over the median of these distances, at least, where particles keep apart:
1 on a lattice, 0.3 and 0.4 for random places in two and three dimensions.
"""

OVERLAP = 0.55
"""Distance below which a particle lies on the image of another one [contact].

Lattices that are moved along an axis come as near as 0.5.
"""

BESIDE = 1.5
"""Distance below which a particle lies beside an image, over the median distance to the
nearest particle.
"""

MOST_OVERLAPS = 0.1
"""Share of the particles beside images that may lie on them."""

FEWEST_OVERLAPS = 5
"""Particles that lie on images before a period counts as wrong."""

MOST_PERIODS = 3.0
"""Extent up to which overlaps are looked for [period].

Particles that were far apart at first have no common distance of contact.
"""

PLACE = "--bounds, or bounds of the metadata"


class PeriodCheck:
    """Measures the periods of positions that were wrapped when they were recorded.

    Such a particle makes one long step between short ones when it crosses a boundary.
    The length of this step, without the mean of the short ones, is the period.
    Positions that were not wrapped have no such steps.
    """

    def __init__(self, box: Box, *, scale: float) -> None:
        self._box = box  # the stated box, in the unit box
        self._scale = scale  # lengths of the source in a unit of length
        self._axes = np.flatnonzero(box.periodic)
        # greatest extent of the particles in a first frame [length], [axis]
        self._first_extent = np.zeros(len(self._axes))
        self._before: Floats | None = None  # positions in the frame before
        # ends of the positions of this trajectory [length], [axis]
        self._low = np.zeros(len(self._axes))
        self._high = np.zeros(len(self._axes))
        self._steps: list[Floats] = []  # the last steps [length], at most three
        self._clear()

    def _clear(self) -> None:
        """Forget all jumps."""
        count = len(self._axes)
        self._jumps: list[list[float]] = [[] for _ in range(count)]  # [length]
        # of particles that do not jump: squared changes of steps [length^2]
        self._square = np.zeros(count)
        self._count = np.zeros(count)
        # greatest extent of the positions of a trajectory [length]
        self._extent = np.zeros(count)

    def add(self, position: NDArray[np.floating]) -> None:
        """Look at the next frame of a trajectory.

        Args:
            position: positions that are not moved by periods [length], shape
                [particle, axis].
        """
        if not len(self._axes):
            return
        point = position[:, self._axes].astype(np.float64)
        low = point.min(axis=0)
        high = point.max(axis=0)
        if self._before is None:
            self._low = low
            self._high = high
            self._first_extent = np.maximum(self._first_extent, high - low)
        else:
            self._steps.append(point - self._before)
        self._low = np.minimum(self._low, low)
        self._high = np.maximum(self._high, high)
        self._before = point
        if len(self._steps) == 3:
            self._find_jumps()
            self._steps.pop(0)

    def _find_jumps(self) -> None:
        """Look for jumps in the second one of three steps."""
        before, step, after = self._steps
        change = np.abs(step - 0.5 * (before + after))
        size = np.abs(step)
        size_beside = np.maximum(np.abs(before), np.abs(after))
        least_jump = LEAST_JUMP * self._box.lengths[self._axes]
        is_jump = (size > least_jump) & (size_beside < CALM * size)
        is_calm = np.maximum(size, size_beside) < least_jump
        self._square += np.sum(change**2, axis=0, where=is_calm)
        self._count += np.count_nonzero(is_calm, axis=0)
        for axis, jumps in enumerate(self._jumps):
            if len(jumps) < MOST_JUMPS:
                jumps.extend(change[is_jump[:, axis], axis].tolist())

    def finish(self, *, where: str, spacing: float) -> None:
        """End a trajectory; refuse periods that its jumps contradict.

        Trajectories with too few jumps are judged with those that follow.

        Args:
            where: name of the trajectory.
            spacing: distance of neighbouring particles [length].

        Raises:
            UsageError: jumps of particles have another length than a stated period.
        """
        self._extent = np.maximum(self._extent, self._high - self._low)
        self._before = None
        self._steps.clear()
        expected = []
        got = []
        for number, axis in enumerate(self._axes):
            stated = float(self._box.lengths[axis])
            measured = self._measure_wrong_period(number, stated, spacing)
            if measured is None:
                continue
            name = AXES[axis]
            length = measured * self._scale
            expected.append(f"about {length:.4g} along {name}, by which particles jump")
            got.append(f"{stated * self._scale:.6g} along {name}")
        if expected:
            raise UsageError(
                "a stated period is not that of the positions",
                where=f"{where}; {PLACE}",
                expected=f"a period of {' and '.join(expected)} at the boundary",
                got=f"a period of {' and '.join(got)}",
                fix="state the two ends of the true period, in the length of the data",
            )
        if max(map(len, self._jumps), default=0) >= FEWEST_JUMPS:
            self._clear()

    def _measure_wrong_period(
        self, number: int, stated: float, spacing: float
    ) -> float | None:
        """Return the measured period of an axis if it contradicts the stated one."""
        jumps = np.array(self._jumps[number])
        if len(jumps) < FEWEST_JUMPS:
            return None
        measured = float(np.median(jumps))
        spread = float(np.median(np.abs(jumps - measured)))
        if spread > MOST_SPREAD * measured or self._extent[number] > WINDOW * measured:
            return None
        calm_count = max(1.0, float(self._count[number]))
        calm_change = math.sqrt(float(self._square[number]) / calm_count)
        tolerance = max(SPACING_SHARE * spacing, DEVIATIONS * max(spread, calm_change))
        if abs(measured - stated) <= tolerance:
            return None
        return measured

    def describe_extent(self, *, spacing: float) -> Iterator[str]:
        """Yield a note for the user if a first frame is longer than a stated period.

        Args:
            spacing: distance of neighbouring particles [length].
        """
        for axis, extent in zip(self._axes, self._first_extent, strict=True):
            stated = float(self._box.lengths[axis])
            if extent > stated + spacing:
                yield (
                    f"the first frame of a trajectory spans {extent * self._scale:.4g} "
                    f"along {AXES[axis]}, more than the stated period "
                    f"{stated * self._scale:.6g}. That is right if particles have left "
                    "the box before this frame; otherwise correct --bounds"
                )


def check_overlap(
    position: NDArray[np.floating], box: Box, *, scale: float, where: str
) -> None:
    """Refuse periods by which particles come to lie on one another.

    Only particles that keep apart before they are moved are looked at: random places
    come as near by themselves. Particles that drift over several periods keep apart
    when they are moved by the true ones.

    Args:
        position: positions of a frame that are not moved by periods [length], shape
            [particle, axis].
        box: the stated box.
        scale: lengths of the source in a unit of length.
        where: trajectory and frame.

    Raises:
        UsageError: particles lie on the images of others.
    """
    is_periodic = np.asarray(box.periodic)
    points = position.astype(np.float64)
    span = np.ptp(points, axis=0)
    is_wider = is_periodic & (span > box.lengths)
    if len(points) < FEWEST_OVERLAPS or not is_wider.any():
        return
    if (span > MOST_PERIODS * box.lengths)[is_periodic].any():
        return

    walled_box = Box.from_bounds(box.bounds)
    # the nearest particle is itself
    distances = np.asarray(walled_box.tree(points).query(points, k=2)[0])
    contact, median = np.quantile(distances[:, 1], (CONTACT_QUANTILE, 0.5))
    if contact < REGULAR * median:
        return
    image_distance = _nearest_images(points, box)
    beside_count = int(np.count_nonzero(image_distance < BESIDE * median))
    overlap_count = int(np.count_nonzero(image_distance < OVERLAP * contact))
    if overlap_count < FEWEST_OVERLAPS or overlap_count < MOST_OVERLAPS * beside_count:
        return

    spans = []
    periods = []
    for axis in np.flatnonzero(is_wider):
        spans.append(f"{span[axis] * scale:.4g} along {AXES[axis]}")
        periods.append(f"{box.lengths[axis] * scale:.6g} along {AXES[axis]}")
    raise UsageError(
        "particles lie on one another when they are moved into the stated periods",
        where=f"{where}; {PLACE}",
        expected=f"periods that keep particles {OVERLAP * contact * scale:.2g} apart; "
        f"the frame spans {' and '.join(spans)}",
        got=f"a period of {' and '.join(periods)}, by which {overlap_count} of "
        f"{len(points)} particles come nearer to others",
        fix="state the two ends of the true period, or leave out --periodic where the "
        "box has walls",
    )


def _nearest_images(points: Floats, box: Box) -> Floats:
    """Return the distance from each particle to the nearest image of another one.

    An image is a particle moved by periods; the distance is infinite if the nearest
    particles are no images.
    """
    count = min(NEIGHBOURS, len(points))
    distances, neighbours = box.tree(points).query(box.tree_points(points), k=count)
    way = points[neighbours] - points[:, None, :]
    shortest_period = 2.0 * box.largest_radius
    is_image = np.linalg.norm(way, axis=2) > distances + 0.25 * shortest_period
    image_distances = np.where(is_image, distances, np.inf)
    return np.asarray(image_distances.min(axis=1), np.float64)
