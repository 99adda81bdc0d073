"""The input of a metric: truth and prediction of one frame, and all they share.

A :class:`FramePair` forms each intermediate (errors, grid fields, vorticity at the
counted nodes) once, on first use, for all metrics; a truth :class:`Snapshot` may serve
the pairs of several predictions. Memory is that of one frame.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lagbench.data import MATERIALS
from lagbench.data.box import UNIT_SQUARE, Box
from lagbench.data.grid import Fields, Grid, curl, fields
from lagbench.errors import ChecksFailedError, UsageError

Floats = NDArray[np.float64]

DIRECTIONS = 64
"""Directions on which clouds are projected."""

GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))
"""Angle from one direction to the next on the spiral of a Fibonacci lattice [rad]."""

WALL_TOLERANCE = 1e-6
"""A particle is outside when it is this far past a wall, a few float32 ulp [length].
"""

STRETCH = 2.0
"""A bond is intact while its length is within this multiple of its first length."""

ELASTIC = ("jelly", "rope")
"""Materials whose bodies return to their shape."""

ROUNDING = 1e-12
"""Share of the greatest nodal velocity below which vorticity times spacing is rounding.

Where n particles around a node move alike, ``sum(w u) / sum(w)`` is off by up to n
2^-52 of u in double precision, and omega h, half of four such velocities, by n 2^-51:
1e-13 for 225 particles. Rotation lies far above: positions are float32, so that
different velocities beyond 1/32 differ by 2^-28 or more, 4e-9.
"""

PERCENTILES = (5, 25, 50, 75, 95)
"""Percentiles of the vorticity residual that are reported."""


def average(values: Floats) -> float:
    """Return the mean of all values.

    The bits are those of ``np.mean``, which takes twice as long on few values.
    """
    return float(np.add.reduce(values, axis=None)) / values.size


def mean_squared_error(error: Floats) -> float:
    """Return ``MSE = mean((y - yhat)^2)`` over particles and components (Eq. 3.3)."""
    return average(error**2)


def mean_absolute_error(error: Floats) -> float:
    """Return ``MAE = mean(|y - yhat|)`` over particles and components (Eq. 3.4)."""
    return average(np.abs(error))


def dot(a: Floats, b: Floats) -> float:
    """Return the sum of products of two vectors.

    Unlike those of BLAS, its bits do not depend on the number of threads.
    """
    return float(np.einsum("i,i->", a, b))


def lengths(vectors: Floats) -> Floats:
    """Return the Euclidean length of vectors, shape [particle]."""
    return np.asarray(np.sqrt(sum_of_squares(vectors)), np.float64)


def sum_of_squares(vectors: Floats) -> Floats:
    """Return the squared Euclidean length of vectors, shape [particle]."""
    squares = vectors[:, 0] ** 2
    for component in vectors.T[1:]:
        squares = squares + component**2
    return np.asarray(squares, np.float64)


def mean_square(vectors: Floats) -> Floats:
    """Return the mean over particles of the square of each component, shape [axis]."""
    sums = np.array([dot(component, component) for component in vectors.T])
    return sums / len(vectors)


def sorted_projections(points: ArrayLike) -> NDArray[np.float32]:
    """Return the coordinates along each direction in ascending order [length].

    The precision is single, as that of stored positions: the sort is several times
    faster, and distances are good to 1e-7 of the box. Along a periodic axis the points
    are taken where they lie in the box, not at their nearest images.

    Args:
        points: points [length], shape [particle, axis].

    Returns:
        Shape [direction, particle].
    """
    components = np.asarray(points, np.float32).T
    dimension, particle_count = components.shape
    projections = np.empty((DIRECTIONS, particle_count), np.float32)

    for row, direction in zip(projections, directions(dimension), strict=True):
        row[:] = components[0] * direction[0]
        for component, share in zip(components[1:], direction[1:], strict=True):
            row += component * share
        row.sort()

    return projections


def sliced_wasserstein2(x: ArrayLike, y: ArrayLike) -> float:
    """Return ``sqrt(mean_ki(((x.d_k)_(i) - (y.d_k)_(i))^2))`` [length].

    Of two clouds of as many particles [length], shape [particle, axis]; the projections
    on each direction d_k are sorted. The directions are fixed: nothing is drawn. A
    shift by s gives ``|s| / sqrt(2)``, in three dimensions ``|s| / sqrt(3)`` to 1 %.
    """
    return projection_distance(sorted_projections(x), sorted_projections(y))


def projection_distance(x: NDArray[np.float32], y: NDArray[np.float32]) -> float:
    """Return the root mean square of the differences of sorted projections [length]."""
    squares = []
    for a, b in zip(x, y, strict=True):
        difference = np.subtract(a, b, dtype=np.float64)
        squares.append(float(np.mean(difference**2)))
    return math.sqrt(math.fsum(squares) / len(squares))


@cache
def directions(dimension: int) -> NDArray[np.float32]:
    """Return the fixed unit vectors on which clouds are projected, [direction, axis].

    In two dimensions they stand at equal angles over a half turn. In three they are a
    Fibonacci lattice on the half sphere z > 0 (Swinbank and Purser 2006, doi
    10.1256/qj.05.227): opposite directions sort a cloud alike.
    """
    number = np.arange(DIRECTIONS)
    if dimension == 2:
        angles = number * (math.pi / DIRECTIONS)
        rows = [(math.cos(angle), math.sin(angle)) for angle in angles]
        return np.array(rows, np.float32)

    height = (number + 0.5) / DIRECTIONS  # equal areas of the half sphere
    radius = np.sqrt(1.0 - height**2)
    angles = number * GOLDEN_ANGLE
    columns = (radius * np.cos(angles), radius * np.sin(angles), height)
    return np.stack(columns, axis=1).astype(np.float32)


@dataclass(frozen=True)
class Bonds:
    """Pairs of neighbouring particles of a body in the first frame."""

    pairs: NDArray[np.intp]  # numbers of the particles within the body, shape [pair, 2]
    breaking_length: Floats  # length beyond which a bond is broken [length], [pair]
    box: Box = UNIT_SQUARE  # that holds the particles

    @classmethod
    def within(cls, radius: float, position: Floats, box: Box = UNIT_SQUARE) -> Bonds:
        """Return the bonds of particles closer than a radius in the first frame.

        Args:
            radius: largest length of a bond [length].
            position: positions in the first frame [length], shape [particle, axis].
            box: box that holds the particles.
        """
        neighbours = box.tree(position).query_pairs(radius, output_type="ndarray")
        pairs = np.asarray(neighbours, np.intp).reshape(-1, 2)
        first_length = np.sqrt(_squared_lengths(position, pairs, box))
        return cls(pairs, STRETCH * first_length, box)

    def intact_share(self, position: Floats) -> float:
        """Return the share of unbroken bonds at these positions [1], NaN without bonds.

        Positions have the shape [particle, axis].
        """
        if not len(self.pairs):
            return math.nan
        square = _squared_lengths(position, self.pairs, self.box)
        return float(np.mean(square <= self.breaking_length**2))


def _squared_lengths(position: Floats, pairs: NDArray[np.intp], box: Box) -> Floats:
    """Return the squared distance of each pair [length^2], shape [pair]."""
    gap = box.displacement(position[pairs[:, 1]], position[pairs[:, 0]])
    return sum_of_squares(gap)


@dataclass(frozen=True, kw_only=True)
class TaskConfig:
    """The task of a split and size, as far as metrics depend on it."""

    # of the score fields; nodes in cell centres mean that the material fills the box
    grid: Grid
    input_frames: int  # frames that the model is given
    horizon: int  # frames that the model predicts
    # absolute frames at which slow metrics are measured
    frames_of_interest: tuple[int, ...]
    # of the position's components [length], then the velocity's [length/frame], over
    # train
    attribute_std: tuple[float, ...]
    radius: float  # distance of neighbours in the first frame [length]
    # of the split; two or more have metrics of their own
    materials: tuple[str, ...] = ("liquid",)

    @property
    def box(self) -> Box:
        """The box that holds the particles."""
        return self.grid.box

    @property
    def is_full_box(self) -> bool:
        """Whether one fluid fills the box; else the material has a free surface."""
        return self.grid.placement.is_full_box

    @property
    def predicted_frames(self) -> range:
        """Absolute numbers of the frames that are scored."""
        return range(self.input_frames, self.input_frames + self.horizon)

    @cached_property
    def slow_frames(self) -> frozenset[int]:
        """Frames of interest and the last predicted one."""
        return frozenset((*self.frames_of_interest, self.predicted_frames[-1]))


@dataclass(frozen=True)
class Snapshot:
    """Particles of one frame, of truth or of a prediction."""

    position: Floats  # x(f) [length], shape [particle, axis]
    # u(f), the way from x(f-1) to x(f) [length/frame], shape [particle, axis]
    velocity: Floats
    scenario: Scenario  # that they belong to

    @cached_property
    def speed_square(self) -> float:
        """Sum of ``|u|^2`` over the particles [length^2/frame^2]."""
        return sum(dot(u, u) for u in self.velocity.T)

    @cached_property
    def speeds(self) -> Floats:
        """``|u|`` of each particle [length/frame], shape [particle]."""
        return lengths(self.velocity)

    @cached_property
    def lever_arms(self) -> Floats:
        """Ways from the centre of the box [length], shape [particle, axis]."""
        box = self.scenario.config.box
        return box.displacement(box.centre, self.position)

    @cached_property
    def fields(self) -> Fields:
        """Grid fields of these particles [per frame]."""
        fields_of_frame = fields(
            self.position,
            self.velocity,
            self.scenario.config.grid,
            full=self.scenario.full_weight,
        )
        return replace(
            fields_of_frame,
            weight=_read_only(fields_of_frame.weight),
            velocity=_read_only(fields_of_frame.velocity),
        )

    @cached_property
    def projections(self) -> NDArray[np.float32]:
        """Positions along fixed directions, sorted [length], [direction, particle]."""
        return sorted_projections(self.position)

    @cached_property
    def material_projections(self) -> Mapping[str, NDArray[np.float32]]:
        """Sorted projections of the particles of each material, by its name."""
        members = self.scenario.members
        if len(members) == 1:
            return dict.fromkeys(members, self.projections)

        return {
            name: sorted_projections(self.position[particles])
            for name, particles in members.items()
        }

    @cached_property
    def velocity_projections(self) -> Mapping[str, NDArray[np.float32]]:
        """Velocities of each material along fixed directions, sorted [length/frame]."""
        return {
            name: sorted_projections(self.velocity[particles])
            for name, particles in self.scenario.members.items()
        }


@dataclass(frozen=True, kw_only=True)
class Scenario:
    """Properties that all frames of one scenario share."""

    config: TaskConfig  # of the split and size
    # true positions from frame 0 to the last input frame, [frame, particle, axis]
    input_positions: NDArray[np.floating]
    # index into lagbench.data.MATERIALS, shape [particle]
    material: NDArray[np.integer]
    particle_mass: float  # of every particle [mass]
    area: float  # that the particles cover at first [length^2]
    # rows of a file's frames that are scored; None: all
    scored: NDArray[np.intp] | None = None
    # predicted frames until the truth rests; None: the whole horizon
    active_frames: int | None = None

    def __post_init__(self) -> None:
        """Refuse shapes that would only fail later, with a worse message."""
        shape = self.input_positions.shape
        if len(shape) == 3 and shape[0] >= 2 and shape[1:] == self._frame_shape:
            return
        raise UsageError(
            f"shape {shape}; give 2 or more frames of shape {self._frame_shape}",
            where="input_positions",
        )

    @property
    def _frame_shape(self) -> tuple[int, int]:
        """Shape of the positions of one frame: particles and axes."""
        return len(self.material), self.config.box.dimension

    @cached_property
    def full_weight(self) -> float:
        """Weight of a full interior node [1]."""
        return self.config.grid.full_weight(len(self.material), self.area)

    @cached_property
    def initial_snapshot(self) -> Snapshot:
        """The last input frame, from which the prediction starts."""
        return self.snapshot(self.input_positions[-1], self.input_positions[-2])

    @cached_property
    def moving_frames(self) -> range:
        """Numbers of the predicted frames until the truth rests; at least one."""
        frames = self.config.predicted_frames
        if self.active_frames is None:
            return frames
        return frames[: max(1, self.active_frames)]

    @cached_property
    def members(self) -> Mapping[str, NDArray[np.intp]]:
        """Particle numbers of each material that occurs here."""
        members = {}
        for value, name in enumerate(MATERIALS):
            particles = np.flatnonzero(self.material == value)
            if particles.size:
                members[name] = particles
        return members

    @cached_property
    def bonds(self) -> Mapping[str, Bonds]:
        """Neighbours in frame 0 within each elastic body, by its material."""
        first = np.asarray(self.input_positions[0], np.float64)
        bonds = {}
        for name, particles in self.members.items():
            if name in ELASTIC:
                bonds[name] = Bonds.within(
                    self.config.radius, first[particles], self.config.box
                )
        return bonds

    def select(self, position: ArrayLike) -> NDArray[np.floating]:
        """Return the particles of a frame that are scored: those of walls are not."""
        rows = np.asarray(position)
        if self.scored is None or len(rows) == len(self.material):
            return rows
        return rows[self.scored]

    def snapshot(self, position: ArrayLike, previous: ArrayLike) -> Snapshot:
        """Return the snapshot of a frame from its positions and those one frame before.

        Along periodic axes positions are wrapped into the box.

        Args:
            position: positions of the frame [length], shape [particle, axis].
            previous: positions one frame before [length], shape [particle, axis].

        Raises:
            UsageError: an array has another shape.
            ChecksFailedError: positions are not finite.
        """
        # columns contiguous: sums over particles and the grid transfer run along them
        x = np.asarray(position, np.float64, order="F")
        before = np.asarray(previous, np.float64, order="F")

        expected = self._frame_shape
        if x.shape != expected or before.shape != expected:
            raise UsageError(f"shapes {x.shape} and {before.shape}, not {expected}")
        for points in (x, before):
            is_finite = np.isfinite(points)
            if not is_finite.all():
                count = np.count_nonzero(~is_finite.all(axis=1))
                raise ChecksFailedError(
                    f"{count} of {len(points)} particles are not at finite positions; "
                    "freeze the rollout at its last finite frame"
                )

        box = self.config.box
        return Snapshot(
            position=_read_only(box.wrap(x)),
            velocity=_read_only(box.displacement(before, x)),
            scenario=self,
        )


def _read_only(values: Floats) -> Floats:
    """Return a view of an array that a metric cannot change for the other metrics."""
    view = values.view()
    view.setflags(write=False)
    return view


def snapshots(
    scenario: Scenario,
    positions: Iterable[ArrayLike],
    *,
    previous: ArrayLike | None = None,
) -> Iterator[Snapshot]:
    """Yield the snapshots of consecutive frames; two frames are in memory at a time.

    Args:
        scenario: the scenario of the particles.
        positions: positions of each frame [length], shape [particle, axis].
        previous: positions one frame before the first; by default those of the last
            input frame.
    """
    if previous is None:
        before = scenario.input_positions[-1]
    else:
        before = previous

    for position in positions:
        snapshot = scenario.snapshot(scenario.select(position), before)
        yield snapshot
        before = snapshot.position


@dataclass(frozen=True)
class FramePair:
    """Truth and prediction of one frame of one scenario."""

    scenario: Scenario  # properties that all its frames share
    frame: int  # absolute frame number
    truth: Snapshot  # the simulated particles
    prediction: Snapshot  # the predicted particles, in the same order

    @cached_property
    def position_error(self) -> Floats:
        """Ways from true to predicted positions [length], shape [particle, axis].

        Along periodic axes they are the shortest (minimum image).
        """
        box = self.scenario.config.box
        return box.displacement(self.truth.position, self.prediction.position)

    @cached_property
    def velocity_error(self) -> Floats:
        """Predicted minus true velocity [length/frame], shape [particle, axis]."""
        return self.prediction.velocity - self.truth.velocity

    @cached_property
    def position_square(self) -> Floats:
        """Mean squared position error of each component [length^2], shape [axis]."""
        return mean_square(self.position_error)

    @cached_property
    def velocity_square(self) -> Floats:
        """Mean squared velocity error by component [length^2/frame^2], [axis]."""
        return mean_square(self.velocity_error)

    @cached_property
    def predicted_fields(self) -> Fields:
        """Fields of the prediction where the truth's nodes count."""
        return replace(self.prediction.fields, counted=self.truth.fields.counted)

    @cached_property
    def outside_share(self) -> float:
        """Share of predicted particles that are past a wall [1]."""
        position = self.prediction.position
        box = self.scenario.config.box
        # Nearly always: where the extremes lie inside, all particles do.
        is_above = position.min(axis=0) >= box.lower_walls - WALL_TOLERANCE
        is_below = position.max(axis=0) <= box.upper_walls + WALL_TOLERANCE
        if is_above.all() and is_below.all():
            return 0.0
        is_inside = box.contains(position, tolerance=WALL_TOLERANCE)
        return np.count_nonzero(~is_inside) / len(position)

    @property
    def nodes(self) -> NDArray[np.bool_]:
        """Nodes at which vorticity and divergence are compared: the truth's."""
        return self.truth.fields.differentiable

    @cached_property
    def node_count(self) -> int:
        """Number of nodes that are compared."""
        return int(np.count_nonzero(self.nodes))

    @cached_property
    def true_vorticity(self) -> Floats:
        """Omega of the truth at the compared nodes [1/frame], shape [node].

        In three dimensions the components of every node, shape [3 node].
        """
        return self._vorticity(self.truth)

    @cached_property
    def predicted_vorticity(self) -> Floats:
        """Omega of the prediction at the compared nodes, as that of the truth."""
        return self._vorticity(self.prediction)

    def _vorticity(self, snapshot: Snapshot) -> Floats:
        grid = self.scenario.config.grid
        omega = curl(snapshot.fields.velocity, grid.spacing, grid.box.periodic)
        return _read_only(omega[self.nodes].reshape(-1))

    @cached_property
    def truth_rotates(self) -> bool:
        """Whether the true vorticity is more than rounding, unlike that of a flight."""
        return self._rotates(self.true_vorticity, self.truth)

    @cached_property
    def prediction_rotates(self) -> bool:
        """Whether the predicted vorticity is more than rounding."""
        return self._rotates(self.predicted_vorticity, self.prediction)

    def _rotates(self, omega: Floats, snapshot: Snapshot) -> bool:
        spacing = self.scenario.config.grid.spacing
        greatest = np.abs(omega).max(initial=0.0) * spacing
        velocity = snapshot.fields.velocity

        # nearly always true, and picking nodes takes longer
        if greatest > ROUNDING * np.abs(velocity).max():
            return True
        nodal_velocity = np.abs(velocity[self.nodes]).max(initial=0.0)
        return bool(greatest > ROUNDING * nodal_velocity)

    @cached_property
    def vorticity_residual(self) -> Floats:
        """``r = predicted - true`` (Eq. 5.22) at the nodes [1/frame], shape [node]."""
        return self.predicted_vorticity - self.true_vorticity

    @cached_property
    def residual_percentiles(self) -> Mapping[int, float]:
        """Percentiles of the vorticity residual [1/frame], by percent."""
        ordered = np.sort(self.vorticity_residual)
        places = np.array(PERCENTILES) / 100.0 * (len(ordered) - 1)
        values = np.interp(places, np.arange(len(ordered)), ordered)
        return dict(zip(PERCENTILES, values.tolist(), strict=True))
