"""The box that holds the particles: its dimension, walls, periodic axes and obstacle.

Every question about space goes through a :class:`Box`: how far apart two points are,
whether a point lies inside, which walls there are. A box has two or three dimensions.
Along each axis it either ends at two walls or repeats itself.

A fixed round obstacle may stand in it, which no particle enters. Scenario files state
it by the attributes ``obstacle_x``, ``obstacle_y``, in three dimensions ``obstacle_z``,
and ``obstacle_diameter`` [length].
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lagbench.errors import DataError, UsageError

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

Floats = NDArray[np.float64]

AXES = ("x", "y", "z")
"""Names of the axes, in the order of the components of a position."""

WALL_NAMES = ("left", "right", "bottom", "top", "front", "back")
"""Names of the walls: the lower and the upper one of each axis, axis by axis."""

SMALL_SIDE = 1.0 / 16.0
"""Longest side below which a box is far smaller than the unit box [length]."""

LARGEST_FLOAT32 = float(np.finfo(np.float32).max)
"""Largest coordinate or diameter that an obstacle may have [length]."""


@dataclass(frozen=True)
class Box:
    """A box with walls or periodic ends along each axis.

    >>> box = Box.from_bounds([(0.0, 1.0), (0.0, 1.0)], periodic=[True, False])
    >>> box.displacement([0.9, 0.2], [0.1, 0.7]).round(3)
    array([0.2, 0.5])
    """

    low: tuple[float, ...]  # lower end of each axis [length]
    high: tuple[float, ...]  # upper end of each axis [length]
    periodic: tuple[bool, ...]  # whether an axis repeats itself

    def __post_init__(self) -> None:
        """Refuse boxes without extent and those that are neither flat nor solid.

        Raises:
            UsageError: the dimension is not 2 or 3, or an axis has no extent.
        """
        if self.dimension not in (2, 3):
            raise UsageError(
                f"a box has two or three dimensions: {self.dimension}; give a value "
                "for each axis",
                where="low",
            )
        for axis, low, high in zip(AXES, self.low, self.high, strict=False):
            if not low < high:
                raise UsageError(
                    f"an axis of a box has no extent: {low} and {high}; exchange "
                    "them, or correct one",
                    where=axis,
                )

    @classmethod
    def from_bounds(
        cls,
        bounds: Sequence[Sequence[float]],
        periodic: Sequence[bool] | None = None,
    ) -> Self:
        """Return a box from its ends along each axis, walled where nothing is said.

        Args:
            bounds: lower and upper end of each axis [length], shape [axis, 2].
            periodic: whether each axis repeats itself, shape [axis].

        Raises:
            UsageError: as in :meth:`__post_init__`.
        """
        if periodic is None:
            periodic = [False] * len(bounds)
        return cls(
            low=tuple(float(low) for low, _ in bounds),
            high=tuple(float(high) for _, high in bounds),
            periodic=tuple(bool(value) for value in periodic),
        )

    @property
    def dimension(self) -> int:
        """Number of axes: 2 or 3."""
        return len(self.low)

    @property
    def bounds(self) -> tuple[tuple[float, float], ...]:
        """Lower and upper end of each axis [length], shape [axis, 2]."""
        return tuple(zip(self.low, self.high, strict=True))

    @cached_property
    def lengths(self) -> Floats:
        """Extent along each axis [length], shape [axis]."""
        return np.asarray(np.subtract(self.high, self.low), np.float64)

    @property
    def volume(self) -> float:
        """Volume, or the area in two dimensions [length^dimension]."""
        return float(np.prod(self.lengths))

    @cached_property
    def centre(self) -> Floats:
        """Middle of the box [length], shape [axis]."""
        return np.asarray(np.mean(self.bounds, axis=1), np.float64)

    @cached_property
    def lower_walls(self) -> Floats:
        """Lower wall of each axis [length], -inf along periodic axes, shape [axis]."""
        return np.where(self.periodic, -np.inf, self.low)

    @cached_property
    def upper_walls(self) -> Floats:
        """Upper wall of each axis [length], inf along periodic axes, shape [axis]."""
        return np.where(self.periodic, np.inf, self.high)

    @cached_property
    def is_periodic(self) -> bool:
        """Whether any axis repeats itself."""
        return any(self.periodic)

    @property
    def largest_radius(self) -> float:
        """Half of the shortest period [length]; infinite without a periodic axis.

        Within a larger radius a particle would be a neighbour by two of its images.
        """
        if not self.is_periodic:
            return math.inf
        return 0.5 * float(self.lengths[np.asarray(self.periodic)].min())

    def allows_radius(self, radius: float) -> bool:
        """Tell whether a radius [length] is at most the largest one, but for rounding.

        A period is a difference of two bounds, so it is rounded.
        """
        return radius <= self.largest_radius * (1.0 + 1e-6)

    @property
    def walls(self) -> tuple[str, ...]:
        """Names of the walls: two for each axis that is not periodic."""
        names: list[str] = []
        for axis, is_periodic in enumerate(self.periodic):
            if not is_periodic:
                names.extend(WALL_NAMES[2 * axis : 2 * axis + 2])
        return tuple(names)

    def displacement(self, start: ArrayLike, end: ArrayLike) -> Floats:
        """Return the shortest way from one point to another (minimum image).

        Along an axis with walls this is ``end - start``. Along a periodic axis of
        length L it lies in [-L/2, L/2].

        Args:
            start: points [length], shape [..., axis].
            end: points [length], shape [..., axis].
        """
        way = np.asarray(np.subtract(end, start))
        if not self.is_periodic:
            return way
        period = np.where(self.periodic, self.lengths, np.inf)
        return np.asarray(way - _nearest_multiple(way, period))

    def wrap(self, position: ArrayLike) -> Floats:
        """Return positions moved by whole periods into [low, high) of periodic axes.

        Components along axes with walls stay as they are, even beyond a wall. Infinity
        along a periodic axis becomes NaN.

        Args:
            position: points [length], shape [..., axis].
        """
        points = np.asarray(position)
        if not self.is_periodic:
            return points
        wrapped = np.array(points, copy=True)
        for axis, is_periodic in enumerate(self.periodic):
            if is_periodic:
                low = self.low[axis]
                high = self.high[axis]
                column = points[..., axis]
                # Nearly always in truth; NaN and infinity are not inside.
                if column.min(initial=low) >= low and column.max(initial=low) < high:
                    continue
                with np.errstate(invalid="ignore"):  # infinity becomes NaN
                    moved = low + np.mod(column - low, high - low)
                # The sum can round up to the upper end, which is the lower one.
                moved = np.where(moved >= high, low, moved)
                # Components that lie inside keep their bits.
                is_inside = (column >= low) & (column < high)
                wrapped[..., axis] = np.where(is_inside, column, moved)
        return wrapped

    def inside(self, position: ArrayLike) -> Floats:
        """Return positions inside: those beyond a wall are put on it, others wrapped.

        Args:
            position: points [length], shape [..., axis].
        """
        return self.wrap(np.clip(position, self.lower_walls, self.upper_walls))

    def has_whole_cells(self, cells: int) -> bool:
        """Tell whether every periodic axis is three or more whole cells long.

        Args:
            cells: cells across a length of 1.
        """
        periods = self.lengths[np.asarray(self.periodic)] * cells
        count = np.rint(periods)
        is_whole = np.abs(periods - count) <= 1e-9 * count
        return bool((is_whole & (count >= 3)).all())

    def unwrap(self, position: ArrayLike) -> Floats:
        """Return the points of one body as one piece: the images nearest to the first.

        Along an axis with walls the components stay as they are. A body must be
        smaller than half a period.

        Args:
            position: points of a body [length], shape [particle, axis].
        """
        points = np.asarray(position)
        if not self.is_periodic or not len(points):
            return points
        first = points[0]
        images = first + self.displacement(first, points)
        return np.where(self.periodic, images, points)

    def tree(self, position: ArrayLike) -> cKDTree:
        """Return a tree of points in which periodic axes have no end.

        It is asked for the neighbours of :meth:`tree_points`.

        Args:
            position: points [length], shape [particle, axis].
        """
        # Commands that look for no neighbours save a fifth of a second.
        from scipy.spatial import cKDTree

        period = None
        if self.is_periodic:
            period = np.where(self.periodic, self.lengths, 0.0)  # 0: not periodic
        return cKDTree(self.tree_points(position), boxsize=period)

    def tree_points(self, position: ArrayLike) -> Floats:
        """Return points as a tree knows them, from the lower ends of a periodic box."""
        points = np.asarray(position)
        if not self.is_periodic:
            return points
        from_low = np.asarray(self.wrap(points) - self.low)
        # The difference can round to the period, which is the lower end again.
        is_at_end = np.asarray(self.periodic) & (from_low >= self.lengths)
        from_low[is_at_end] = 0.0
        return from_low

    def contains(
        self, position: ArrayLike, *, tolerance: float = 0.0
    ) -> NDArray[np.bool_]:
        """Tell which points lie between the walls.

        Args:
            position: points [length], shape [..., axis].
            tolerance: distance beyond a wall that still counts as inside [length].

        Returns:
            Booleans, shape [...]. A point that is no number does not lie inside.
        """
        points = np.asarray(position)
        above = points >= np.asarray(self.low) - tolerance
        below = points <= np.asarray(self.high) + tolerance
        along_axis = np.where(self.periodic, np.isfinite(points), above & below)
        return np.asarray(along_axis.all(axis=-1))


UNIT_SQUARE = Box.from_bounds([(0.0, 1.0), (0.0, 1.0)])
"""The box of side 1 with four walls."""


UNIT_CUBE = Box.from_bounds([(0.0, 1.0), (0.0, 1.0), (0.0, 1.0)])
"""The box of side 1 with six walls."""


def unit_box(dimension: int) -> Box:
    """Return the box of side 1 with walls on every side, of 2 or 3 dimensions."""
    if dimension == 2:
        return UNIT_SQUARE
    return UNIT_CUBE


def describe_bounds(bounds: Sequence[Sequence[float]], periodic: Sequence[str]) -> str:
    """Return the ends and the periodic axes of a box, for a reader.

    >>> describe_bounds([(0.0, 1.0), (0.25, 2.0)], ["x"])
    '[0, 1] x [0.25, 2], periodic x'

    Args:
        bounds: lower and upper end of each axis [length], shape [axis, 2].
        periodic: names of the periodic axes.
    """
    text = " x ".join(f"[{low:.6g}, {high:.6g}]" for low, high in bounds)
    if periodic:
        text += f", periodic {', '.join(periodic)}"
    return text


def parse_periodic(axes: Sequence[str], dimension: int) -> tuple[bool, ...]:
    """Return for each axis whether it is named, shape [axis].

    >>> parse_periodic(["x"], 2)
    (True, False)

    Args:
        axes: names of the periodic axes, such as ``["x", "y"]``.
        dimension: number of axes of the box.

    Raises:
        UsageError: a name is that of no axis of the box, or appears twice.
    """
    names = AXES[:dimension]
    unknown_axes = sorted(map(repr, set(axes) - set(names)))
    fault = None
    if unknown_axes:
        fault = f"periodic axes: the box has no axis {', '.join(unknown_axes)}"
    elif len(set(axes)) != len(axes):
        fault = "periodic axes are named once each"
    if fault is not None:
        raise UsageError(
            f"{fault}: got {', '.join(map(str, axes))}, expected axes of the box, "
            f"each at most once: {', '.join(names)}; name axes of the box, as in "
            f"{names[0]} or {','.join(names)}",
            where="periodic",
        )
    return tuple(name in axes for name in names)


def _nearest_multiple(difference: Floats, period: Floats) -> Floats:
    """Return the multiple of the period that is nearest to each component [length].

    An infinite period stands for an axis with walls: its multiple is 0.
    """
    finite = np.isfinite(period)
    length = np.where(finite, period, 1.0)
    return np.where(finite, length * np.rint(difference / length), 0.0)


# --- the obstacle in the box ----------------------------------------------------------


def parse_obstacle(
    attributes: Mapping[str, object], dimension: int, *, where: str
) -> NDArray[np.float32] | None:
    """Return centre and radius of the obstacle that attributes state; None without one.

    >>> stated = {"obstacle_x": 0.25, "obstacle_y": 0.5, "obstacle_diameter": 0.125}
    >>> parse_obstacle(stated, 2, where="a file")
    array([0.25  , 0.5   , 0.0625], dtype=float32)

    Args:
        attributes: parameters of a scenario by name.
        dimension: number of axes of the box.
        where: the file.

    Returns:
        [length], shape [axis + 1], the radius last.

    Raises:
        DataError: the attributes are no finite numbers, or the diameter is not above 0.
    """
    if "obstacle_diameter" not in attributes:
        return None
    names = [f"obstacle_{axis}" for axis in AXES[:dimension]]
    names.append("obstacle_diameter")
    values = []
    for name in names:
        stated = np.asarray(attributes.get(name))
        is_number = stated.size == 1 and stated.dtype.kind in "iuf"
        # no comparison holds for what is not a number
        if not is_number or not (abs(stated) <= LARGEST_FLOAT32).all():
            raise DataError(
                f"the obstacle has no place or no size: {attributes.get(name)}; mend "
                "the attribute, or make the file again",
                where=f"{where}, attribute {name}",
            )
        values.append(float(stated.item()))
    if values[-1] <= 0.0:
        raise DataError(
            f"the obstacle has no size: {values[-1]}; mend the attribute, or make the "
            "file again",
            where=f"{where}, attribute obstacle_diameter",
        )
    values[-1] *= 0.5
    return np.array(values, np.float32)


def keep_outside(
    position: NDArray[np.float64], obstacle: NDArray[np.floating]
) -> NDArray[np.float64]:
    """Return positions of which those inside an obstacle are put on its surface.

    A point at the very centre stays there. Points outside are computed anew too, so
    they may change by a rounding: the bits of recorded predictions depend on it.

    Args:
        position: points [length], shape [point, axis].
        obstacle: centre and radius [length], shape [axis + 1].
    """
    centre = obstacle[:-1].astype(np.float64)
    radius = float(obstacle[-1])
    offset = position - centre
    distance = np.sqrt((offset * offset).sum(axis=1))
    is_inside = (distance < radius) & (distance > 0.0)
    stretch = np.ones(len(position))
    stretch[is_inside] = radius / distance[is_inside]
    return np.asarray(centre + stretch[:, None] * offset)
