"""What a metric sees: truth and prediction of one frame, and all they share.

A :class:`FramePair` forms each intermediate (errors, grid fields, vorticity at the counted
nodes) once, on first use, for all metrics; a truth :class:`Snapshot` may serve the pairs of
several predictions. Memory is that of one frame.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lagbench.data.grid import Fields, Grid, fields
from lagbench.data.writer import MATERIALS
from lagbench.errors import ChecksFailedError, UsageError

from .bonds import Bonds
from .projections import sorted_projections

__all__ = ["ELASTIC", "PERCENTILES", "Floats", "FramePair", "Scenario", "Setting", "Snapshot", "snapshots"]

Floats = NDArray[np.float64]

ELASTIC = ("jelly", "rope")
"""Materials whose bodies return to their shape."""

PERCENTILES = (5, 25, 50, 75, 95)
"""Percentiles of the vorticity residual that are reported."""


@dataclass(frozen=True, kw_only=True)
class Setting:
    """What the metrics need to know of a split and size."""

    grid: Grid  # grid of the score fields
    input_frames: int  # frames given to the model
    horizon: int  # frames it predicts
    frames_of_interest: tuple[int, ...]  # absolute frames at which slow metrics are measured
    # standard deviations of (x, y, u, v) over train, u and v per frame
    # [length, length, length/frame, length/frame]
    attribute_std: tuple[float, float, float, float]
    radius: float  # first-frame neighbours lie within this distance [length]
    # materials of the split; per-material metrics are formed for two or more
    materials: tuple[str, ...] = ("liquid",)
    centre: tuple[float, float] = (0.5, 0.5)  # centre of the box [length]

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
    grid: Grid  # grid of the fields
    full: float  # weight of a full interior node [1]

    @cached_property
    def fields(self) -> Fields:
        """Grid fields of these particles [per frame]."""
        return fields(self.position, self.velocity, self.grid, full=self.full)

    @cached_property
    def projections(self) -> Floats:
        """Positions along fixed directions, sorted [length], shape [direction, particle]."""
        return sorted_projections(self.position)


@dataclass(frozen=True, kw_only=True)
class Scenario:
    """What holds in all frames of one scenario."""

    setting: Setting  # the split and size
    # true positions from frame 0 to the last given frame [length], shape
    # [frame, particle, 2]; at least two frames
    given: NDArray[np.floating]
    material: NDArray[np.integer]  # index into MATERIALS, shape [particle]
    particle_mass: float  # mass of every particle [mass]
    area: float  # area that the particles cover at first [length^2]

    def __post_init__(self) -> None:
        """Refuse shapes that would only fail later, with a worse message."""
        if self.given.ndim != 3 or len(self.given) < 2 or self.given.shape[1:] != (len(self.material), 2):
            raise UsageError(
                "the given frames do not fit the scenario",
                expected=f"[2 or more frames, {len(self.material)} particles, 2]",
                got=str(self.given.shape),
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
    def members(self) -> Mapping[str, NDArray[np.intp]]:
        """Particle numbers of each material that occurs here."""
        found = {name: np.flatnonzero(self.material == value) for value, name in enumerate(MATERIALS)}
        return {name: particles for name, particles in found.items() if particles.size}

    @cached_property
    def bonds(self) -> Mapping[str, Bonds]:
        """Neighbours in frame 0 within each elastic body, by its material."""
        first = np.asarray(self.given[0], np.float64)
        elastic = {name: particles for name, particles in self.members.items() if name in ELASTIC}
        return {name: Bonds.within(self.setting.radius, first[index]) for name, index in elastic.items()}

    def snapshot(self, position: ArrayLike, previous: ArrayLike) -> Snapshot:
        """Return the snapshot of positions and those one frame before, both [particle, 2]."""
        # columns contiguous: sums over particles and the grid transfer run along them
        x, before = (np.asarray(a, np.float64, order="F") for a in (position, previous))
        expected = (len(self.material), 2)
        if x.shape != expected or before.shape != expected:
            raise UsageError(
                "wrong shape of positions", expected=str(expected), got=f"{x.shape} and {before.shape}"
            )
        if not np.isfinite(x).all():
            raise ChecksFailedError(
                "positions are not finite",
                got=f"{np.count_nonzero(~np.isfinite(x).all(axis=1))} of {len(x)} particles",
                fix="freeze the rollout at its last finite frame",
            )
        return Snapshot(x, x - before, self.setting.grid, self.full)


def snapshots(
    scenario: Scenario, positions: Iterable[ArrayLike], *, previous: ArrayLike | None = None
) -> Iterator[Snapshot]:
    """Yield the snapshots of consecutive frames, holding two frames at a time.

    Args:
        scenario: the scenario they belong to.
        positions: positions of one frame after the other [length], each [particle, 2].
        previous: positions one frame before the first; those last given by default.
    """
    before = scenario.given[-1] if previous is None else previous
    for position in positions:
        yield scenario.snapshot(position, before)
        before = position


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
        """Predicted minus true per-frame velocity [length/frame], shape [particle, 2]."""
        return self.prediction.velocity - self.truth.velocity

    @cached_property
    def predicted_fields(self) -> Fields:
        """Fields of the prediction where the truth's nodes count."""
        return replace(self.prediction.fields, counted=self.truth.fields.counted)

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
        return self.truth.fields.vorticity[self.nodes]

    @cached_property
    def predicted_vorticity(self) -> Floats:
        """Omega of the prediction at the compared nodes [1/frame], shape [node]."""
        return self.predicted_fields.vorticity[self.nodes]

    @cached_property
    def vorticity_residual(self) -> Floats:
        """``r = predicted - true`` (Eq. 5.22) at the compared nodes [1/frame], shape [node]."""
        return self.predicted_vorticity - self.true_vorticity

    @cached_property
    def residual_percentiles(self) -> Mapping[int, float]:
        """Percentiles of the vorticity residual [1/frame], by percent."""
        values = np.percentile(self.vorticity_residual, PERCENTILES)
        return dict(zip(PERCENTILES, values.tolist(), strict=True))
