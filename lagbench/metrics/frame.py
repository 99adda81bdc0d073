"""What a metric sees: truth and prediction of one frame, and all they share.

A :class:`FramePair` forms each intermediate (errors, grid fields, vorticity at the
counted nodes) once, on first use, for all metrics; a truth :class:`Snapshot` may serve
the pairs of several predictions. Memory is that of one frame.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lagbench.data import MATERIALS
from lagbench.data.grid import Fields, Grid, Placement, fields, vorticity
from lagbench.errors import ChecksFailedError, UsageError

Floats = NDArray[np.float64]

DIRECTIONS = 64
"""Directions on which clouds are projected, at equal angles over a half turn."""

WALL_TOLERANCE = 1e-6
"""A particle is outside when it is this far past a wall [length]: a few roundings of
float32.
"""

STRETCH = 2.0
"""A bond holds while its length is within this multiple of the first one."""

ELASTIC = ("jelly", "rope")
"""Materials whose bodies return to their shape."""

ROUNDING = 1e-12
"""Share of the greatest nodal velocity below which vorticity times spacing is nothing
but rounding.

Where n particles around a node move alike, ``sum(w u) / sum(w)`` is off by up to n
2^-52 of u in double precision, and omega h, half of four such velocities, by n 2^-51:
1e-13 for 225 particles. What turns lies far above: positions are float32, so that
beyond 1/32 velocities that differ do so by 2^-28 or more, 4e-9.
"""

PERCENTILES = (5, 25, 50, 75, 95)
"""Percentiles of the vorticity residual that are reported."""


def average(values: Floats) -> float:
    """Return the mean of all values: the bits of ``np.mean``, which takes twice as long
    on few values.
    """
    return float(np.add.reduce(values, axis=None)) / values.size


def mean_squared_error(error: Floats) -> float:
    """Return ``MSE = mean((y - yhat)^2)`` over particles and components (Eq. 3.3)."""
    return average(error**2)


def mean_absolute_error(error: Floats) -> float:
    """Return ``MAE = mean(|y - yhat|)`` over particles and components (Eq. 3.4)."""
    return average(np.abs(error))


def dot(a: Floats, b: Floats) -> float:
    """Return the sum of products; unlike BLAS's its bits do not depend on the number of
    threads.
    """
    return float(np.einsum("i,i->", a, b))


def lengths(vectors: Floats) -> Floats:
    """Return the Euclidean length of vectors, shape [particle]."""
    return np.asarray(np.sqrt(vectors[:, 0] ** 2 + vectors[:, 1] ** 2), np.float64)


def mean_square(vectors: Floats) -> Floats:
    """Return the mean over particles of the square of each component, shape [2]."""
    return np.array([dot(component, component) for component in vectors.T]) / len(
        vectors
    )


def sorted_projections(points: ArrayLike) -> NDArray[np.float32]:
    """Return the coordinates along each direction in ascending order [length], shape
    [direction, particle].

    In single precision, which is what positions are stored in: its sort is several
    times faster, and distances are good to 1e-7 of the box.
    """
    x, y = np.asarray(points, np.float32).T
    projected = np.empty((DIRECTIONS, len(x)), np.float32)
    for row, angle in zip(
        projected, np.arange(DIRECTIONS) * (math.pi / DIRECTIONS), strict=True
    ):
        row[:] = x * np.float32(math.cos(angle)) + y * np.float32(math.sin(angle))
        row.sort()
    return projected


@dataclass(frozen=True)
class Bonds:
    """Pairs of neighbouring particles of a body: which were together at first, and
    which still are.
    """

    pairs: NDArray[np.intp]  # numbers of the particles within the body, shape [pair, 2]
    reach: Floats  # greatest length at which each bond holds [length], shape [pair]

    @classmethod
    def within(cls, radius: float, position: Floats) -> Bonds:
        """Return the bonds of particles closer than a radius at first [length]."""
        from scipy.spatial import (
            cKDTree,
        )  # a fifth of a second that splits without bodies save

        found = cKDTree(position).query_pairs(radius, output_type="ndarray")
        pairs = np.asarray(found, np.intp).reshape(-1, 2)
        return cls(pairs, STRETCH * np.sqrt(_squared_lengths(position, pairs)))

    def share_held(self, position: Floats) -> float:
        """Return the share of bonds that hold at these positions [1]; NaN if there are
        none.
        """
        if not len(self.pairs):
            return math.nan
        return float(np.mean(_squared_lengths(position, self.pairs) <= self.reach**2))


def _squared_lengths(position: Floats, pairs: NDArray[np.intp]) -> Floats:
    gap = position[pairs[:, 0]] - position[pairs[:, 1]]
    return np.asarray(gap[:, 0] ** 2 + gap[:, 1] ** 2, np.float64)


@dataclass(frozen=True, kw_only=True)
class Setting:
    """What the metrics need to know of a split and size."""

    # of the score fields; nodes in cell centres say that the material fills the box
    grid: Grid
    input_frames: int  # given to the model
    horizon: int  # frames that it predicts
    # absolute frames at which slow metrics are measured
    frames_of_interest: tuple[int, ...]
    # of x, y [length] and u, v [length/frame] over train
    attribute_std: tuple[float, float, float, float]
    radius: float  # first-frame neighbours lie within this distance [length]
    materials: tuple[str, ...] = (
        "liquid",
    )  # of the split; two or more have metrics of their own
    # walls [length]
    bounds: tuple[tuple[float, float], tuple[float, float]] = (0.0, 1.0), (0.0, 1.0)

    @property
    def full_box(self) -> bool:
        """Whether the material fills the box: no surface, one material."""
        return self.grid.placement is Placement.CELL_CENTRES

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

    position: Floats  # x(f) [length], shape [particle, 2]
    velocity: Floats  # u(f) = x(f) - x(f-1) [length/frame], shape [particle, 2]
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
    def arms(self) -> Floats:
        """Positions relative to the centre of the box [length], shape [particle, 2]."""
        return np.asarray(
            self.position - np.mean(self.scenario.setting.bounds, axis=1), np.float64
        )

    @cached_property
    def fields(self) -> Fields:
        """Grid fields of these particles [per frame]."""
        return fields(
            self.position,
            self.velocity,
            self.scenario.setting.grid,
            full=self.scenario.full,
        )

    @cached_property
    def projections(self) -> NDArray[np.float32]:
        """Positions along fixed directions, sorted [length], shape [direction,
        particle].
        """
        return sorted_projections(self.position)

    @cached_property
    def material_projections(self) -> Mapping[str, NDArray[np.float32]]:
        """The same of the particles of each material, by its name."""
        members = self.scenario.members
        if len(members) == 1:
            return dict.fromkeys(members, self.projections)
        return {
            name: sorted_projections(self.position[index])
            for name, index in members.items()
        }


@dataclass(frozen=True, kw_only=True)
class Scenario:
    """What holds in all frames of one scenario."""

    setting: Setting  # the split and size
    # true positions from frame 0 to the last given one, [frame, particle, 2]
    given: NDArray[np.floating]
    # index into lagbench.data.MATERIALS, shape [particle]
    material: NDArray[np.integer]
    particle_mass: float  # of every particle [mass]
    area: float  # that the particles cover at first [length^2]
    # predicted frames until the truth rests; None: the whole horizon
    active_frames: int | None = None

    def __post_init__(self) -> None:
        """Refuse shapes that would only fail later, with a worse message."""
        if (
            self.given.ndim != 3
            or len(self.given) < 2
            or self.given.shape[1:] != (len(self.material), 2)
        ):
            expected = f"[2 or more frames, {len(self.material)} particles, 2]"
            got = str(self.given.shape)
            raise UsageError(
                "the given frames do not fit the scenario", expected=expected, got=got
            )

    @cached_property
    def full(self) -> float:
        """Weight of a full interior node [1]."""
        return self.setting.grid.full_weight(len(self.material), self.area)

    @cached_property
    def last_given(self) -> Snapshot:
        """The state that the prediction starts from."""
        return self.snapshot(self.given[-1], self.given[-2])

    @cached_property
    def active(self) -> range:
        """Absolute numbers of the predicted frames until the truth comes to rest; one
        at least.
        """
        frames = self.setting.predicted_frames
        if self.active_frames is None:
            return frames
        return frames[: max(1, self.active_frames)]

    @cached_property
    def members(self) -> Mapping[str, NDArray[np.intp]]:
        """Particle numbers of each material that occurs here."""
        found = {
            name: np.flatnonzero(self.material == value)
            for value, name in enumerate(MATERIALS)
        }
        return {name: particles for name, particles in found.items() if particles.size}

    @cached_property
    def bonds(self) -> Mapping[str, Bonds]:
        """Neighbours in frame 0 within each elastic body, by its material."""
        first = np.asarray(self.given[0], np.float64)
        elastic = {
            name: particles
            for name, particles in self.members.items()
            if name in ELASTIC
        }
        return {
            name: Bonds.within(self.setting.radius, first[index])
            for name, index in elastic.items()
        }

    def snapshot(self, position: ArrayLike, previous: ArrayLike) -> Snapshot:
        """Return the snapshot of positions and those one frame before, both [particle,
        2].
        """
        # columns contiguous: sums over particles and the grid transfer run along them
        x, before = (np.asarray(a, np.float64, order="F") for a in (position, previous))
        expected = (len(self.material), 2)
        got = f"{x.shape} and {before.shape}"
        if x.shape != expected or before.shape != expected:
            raise UsageError(
                "wrong shape of positions", expected=str(expected), got=got
            )
        if not np.isfinite(x).all():
            got = (
                f"{np.count_nonzero(~np.isfinite(x).all(axis=1))} of {len(x)} particles"
            )
            fix = "freeze the rollout at its last finite frame"
            raise ChecksFailedError("positions are not finite", got=got, fix=fix)
        return Snapshot(x, x - before, self)


def snapshots(
    scenario: Scenario,
    positions: Iterable[ArrayLike],
    *,
    previous: ArrayLike | None = None,
) -> Iterator[Snapshot]:
    """Yield the snapshots of consecutive frames [length], each [particle, 2], holding
    two frames at a time.

    ``previous`` are the positions one frame before the first; those last given by
    default.
    """
    if previous is None:
        before = scenario.given[-1]
    else:
        before = previous
    for position in positions:
        made = scenario.snapshot(position, before)
        yield made
        before = made.position


@dataclass(frozen=True)
class FramePair:
    """Truth and prediction of one frame of one scenario."""

    scenario: Scenario  # what holds in all its frames
    frame: int  # absolute frame number
    truth: Snapshot  # the simulated particles
    prediction: Snapshot  # the predicted particles, in the same order

    @cached_property
    def position_error(self) -> Floats:
        """Predicted minus true position [length], shape [particle, 2]."""
        return self.prediction.position - self.truth.position

    @cached_property
    def velocity_error(self) -> Floats:
        """Predicted minus true per-frame velocity [length/frame], shape [particle,
        2].
        """
        return self.prediction.velocity - self.truth.velocity

    @cached_property
    def position_square(self) -> Floats:
        """Mean squared position error of each component [length^2], shape [2]."""
        return mean_square(self.position_error)

    @cached_property
    def velocity_square(self) -> Floats:
        """Mean squared velocity error of each component [length^2/frame^2], shape
        [2].
        """
        return mean_square(self.velocity_error)

    @cached_property
    def predicted_fields(self) -> Fields:
        """Fields of the prediction where the truth's nodes count."""
        return replace(self.prediction.fields, counted=self.truth.fields.counted)

    @cached_property
    def outside(self) -> float:
        """Share of predicted particles that are past a wall [1]."""
        sides = zip(
            self.prediction.position.T, self.scenario.setting.bounds, strict=True
        )
        past = [
            (x < low - WALL_TOLERANCE) | (x > high + WALL_TOLERANCE)
            for x, (low, high) in sides
            if not (
                x.min() >= low - WALL_TOLERANCE and x.max() <= high + WALL_TOLERANCE
            )  # NaN too
        ]
        if past:
            return np.count_nonzero(np.logical_or.reduce(past)) / len(
                self.prediction.position
            )
        return 0.0

    @property
    def nodes(self) -> NDArray[np.bool_]:
        """Nodes at which vorticity and divergence are compared: the truth's."""
        return self.truth.fields.differentiable

    @cached_property
    def node_count(self) -> int:
        """How many nodes are compared."""
        return int(np.count_nonzero(self.nodes))

    @cached_property
    def true_vorticity(self) -> Floats:
        """Omega of the truth at the compared nodes [1/frame], shape [node]."""
        return vorticity(
            self.truth.fields.velocity, self.scenario.setting.grid.spacing
        )[self.nodes]

    @cached_property
    def predicted_vorticity(self) -> Floats:
        """Omega of the prediction at the compared nodes [1/frame], shape [node]."""
        return vorticity(
            self.prediction.fields.velocity, self.scenario.setting.grid.spacing
        )[self.nodes]

    @cached_property
    def truth_turns(self) -> bool:
        """Whether the true vorticity is more than rounding: bodies that only fly have
        none.
        """
        return self._turns(self.true_vorticity, self.truth)

    @cached_property
    def prediction_turns(self) -> bool:
        """Whether the predicted vorticity is more than rounding."""
        return self._turns(self.predicted_vorticity, self.prediction)

    def _turns(self, omega: Floats, snapshot: Snapshot) -> bool:
        greatest = np.abs(omega).max(initial=0.0) * self.scenario.setting.grid.spacing
        velocity = snapshot.fields.velocity
        if (
            greatest > ROUNDING * np.abs(velocity).max()
        ):  # nearly always, and picking nodes takes longer
            return True
        return bool(greatest > ROUNDING * np.abs(velocity[self.nodes]).max(initial=0.0))

    @cached_property
    def vorticity_residual(self) -> Floats:
        """``r = predicted - true`` (Eq. 5.22) at the compared nodes [1/frame], shape
        [node].
        """
        return self.predicted_vorticity - self.true_vorticity

    @cached_property
    def residual_percentiles(self) -> Mapping[int, float]:
        """Percentiles of the vorticity residual [1/frame], by percent."""
        ordered = np.sort(self.vorticity_residual)
        places = np.array(PERCENTILES) / 100.0 * (len(ordered) - 1)
        values = np.interp(places, np.arange(len(ordered)), ordered)
        return dict(zip(PERCENTILES, values.tolist(), strict=True))
