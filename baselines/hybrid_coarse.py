"""Hybrid: the solver on a coarser grid, with constants that are learned.

On a grid with fewer cells the material-point solver damps the flow more: each
transfer between particles and nodes averages over a larger cell. Softer matter carries
sound more slowly. It allows longer time steps, so there are fewer transfers, and each
frame loses less. The hybrid changes the constants of the solver accordingly:

    viscosity     max(0, 1 + a) nu          (liquid; elastic damping of solids likewise)
    modulus       exp(b) K                  (liquid)
    relaxation    min(1, exp(c) kappa)      (share of the grid's J in a time step)
    coupling      min(1, exp(d) theta)      (pull of J towards the density of the grid)
    moduli        exp(e) E                  (all solids)

The time steps of a frame follow from the fastest sound: the number of sound's cells in
a time step stays what it is in the classical solver on the same grid. This is
``coarse-solver``, or with ``times=1.5`` ``coarse-solver-two-thirds``. With all five 0
the model is that solver, to the bit.

The coefficients are fitted to rollouts on ``train``. The error to minimise is the
metric of free surfaces, ``cloud_distance``. Splashes are chaotic: the error jumps by
some percent between neighbouring coefficients, and a descent stops at the next jump. So
a quadratic polynomial is fitted to the errors at many points of a box, and its minimum
is taken (a response surface, Box and Wilson 1951, J. R. Stat. Soc. B 13).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from scipy.optimize import Bounds, minimize
from scipy.stats.qmc import Halton
from torch import Tensor

from lagbench.data.box import Box
from lagbench.data.registry import Size
from lagbench.data.registry import load as load_registry
from lagbench.errors import DataError, UsageError, WorkFailedError
from lagbench.metrics.frame import sliced_wasserstein2
from lagbench.references.coarse_solver import SOLVED, CoarseRollout, coarser
from lagbench.references.predictor import Given

from .baseline import Batch, DatasetInfo, Options
from .hybrid import Hybrid

Floats = NDArray[np.float64]

COEFFICIENTS = ("viscosity", "modulus", "relaxation", "coupling", "moduli")
"""Names of the coefficients a to e, in their order."""

OF_LIQUID = 4
"""The first so many coefficients matter where all matter is liquid."""

RANGES = ((-1.0, 0.0), (-1.6, 0.2), (-1.0, 1.0), (-0.7, 1.1), (-1.2, 0.2))
"""Ends of each coefficient in the fit: less damping, softer, and both sides of 0."""

LARGEST = 3.0
"""Magnitude of a coefficient: a modulus changes by a factor of 20 at most."""

MOST_SUBSTEPS = 2000
"""Time steps of a frame, at most."""

WORST_ERROR = 1.0
"""Error of coefficients with which the solver breaks down [length]."""

SOLIDS = ("jelly", "snow", "rope")
"""Materials with a modulus of their own."""


@dataclass(frozen=True, kw_only=True)
class TrueRollout:
    """A scenario of the fit: what is given of it, and where its particles go."""

    given: Given
    true_frames: Mapping[int, Floats]  # positions [length] by absolute frame


@dataclass(frozen=True, kw_only=True)
class CoarseFlows:
    """State of a rollout: one for each window."""

    rollouts: tuple[CoarseRollout, ...]
    device: torch.device


class HybridCoarseOptions(Options):
    """Options of the hybrid."""

    in_training = frozenset({"scenarios", "frame_step", "evaluations"})
    of_weights = frozenset({"times"})

    # cells of the data's grid over its own, along each axis; 1.5 keeps two of three
    times: int | float = Field(default=2, ge=1.5, le=4, allow_inf_nan=False)
    scenarios: int = Field(default=24, ge=1)  # of train, to fit on, at most
    frame_step: int = Field(default=10, ge=1)  # frames between those compared
    evaluations: int = Field(default=96, ge=1)  # points at which the error is measured


class HybridCoarse(Hybrid):
    """The coarse solver with learned constants."""

    method = "hybrid coarse solver"
    largest = LARGEST

    Options = HybridCoarseOptions
    options: HybridCoarseOptions

    def __init__(self, options: HybridCoarseOptions, info: DatasetInfo) -> None:
        super().__init__(options, info)
        _check_split(info.split, info.size)
        self.size = load_registry().size(info.split, info.size)
        coarse = coarser(self.size, Fraction(options.times))
        if coarse is None:
            fitting_times = _list_fitting_times(self.size)
            fix = "a larger size, or neuralmpm"
            if fitting_times:
                choices = " or ".join(f"{times:g}" for times in fitting_times)
                fix = f"--set model.times={choices}; or neuralmpm"
            raise UsageError(
                f"{self.method} has no such grid for {info.split} {info.size}",
                where="model.times",
                expected="walls on nodes of the coarser grid, and enough cells",
                got=options.times,
                fix=fix,
            )
        self.coarse = coarse
        self.register_buffer("coefficients", torch.zeros(len(COEFFICIENTS)))

    @classmethod
    def check_data_set(
        cls, split: str, size: str, box: Box, *, is_full_box: bool
    ) -> None:
        """Refuse a data set other than the free surfaces of lagbench.

        :meth:`Baseline.check_data_set` describes the arguments.

        Raises:
            UsageError: the solver does not know the data set.
        """
        super().check_data_set(split, size, box, is_full_box=is_full_box)
        _check_split(split, size)

    # --- the solver ---------------------------------------------------------------

    def start(self, given: Batch) -> CoarseFlows:
        """Return the rollouts from the last two given frames.

        Raises:
            DataError: the mass is not known, or a coefficient is out of range.
        """
        values = self.checked_coefficients()
        changed = change_constants(self.coarse, values)
        rollouts = []
        for window in range(given.windows):
            scenario = self._given(given, window)
            rollouts.append(CoarseRollout(scenario, changed))
        return CoarseFlows(rollouts=tuple(rollouts), device=given.position.device)

    def advance(self, state: CoarseFlows) -> tuple[CoarseFlows, Tensor]:
        """Return the next state and positions [length], shape [particle, axis].

        The solver keeps its state itself, so a state can be advanced once only.
        """
        positions = [_next_position(rollout) for rollout in state.rollouts]
        all_positions = np.concatenate(positions)
        position = torch.from_numpy(all_positions).float()
        return state, position.to(state.device)

    def _given(self, batch: Batch, window: int) -> Given:
        """Return what a batch gives of a scenario."""
        if batch.particle_mass is None:
            raise DataError(
                "the mass of the particles is not known",
                where=f"{self.info.split} {self.info.size}",
                expected="particle_mass in each scenario file",
                got="none",
                fix="train neuralmpm, or a graph network such as gns",
            )
        is_inside = batch.sample == window
        frames = batch.position[is_inside].double().cpu().numpy()
        particle_count, _, dimension = frames.shape
        mass = float(batch.particle_mass[window]) * particle_count
        parameters: dict[str, object] = {}
        if batch.friction is not None:
            parameters["friction"] = float(batch.friction[window])
        return Given(
            size=self.size,
            root=Path(),
            position=frames.swapaxes(0, 1),
            material=batch.material[is_inside].cpu().numpy().astype(np.int8),
            walls=np.zeros((batch.frames + 1, 2 * dimension, dimension)),
            area=mass / float(self.size.value("density")),
            parameters=parameters,
        )

    # --- the fit ------------------------------------------------------------------

    @property
    def evaluations(self) -> int:
        """Times that the fit measures the error: without changes and at the end too."""
        return self.options.evaluations + 2

    def fit(
        self, scenarios: Iterable[Batch], *, count: Callable[[int], None] | None = None
    ) -> Mapping[str, float]:
        """Fit the coefficients to scenarios of train; return errors to log.

        The error is the mean of ``cloud_distance`` over frames and scenarios [length].

        Args:
            scenarios: whole scenarios, one a batch.
            count: is called with 1 after each evaluation.

        Raises:
            UsageError: no scenario moves in a frame that is compared.
        """
        true_rollouts: list[TrueRollout] = []
        for scenario in itertools.islice(scenarios, self.options.scenarios):
            true_rollout = self.prepare_truth(scenario)
            if true_rollout.true_frames:
                true_rollouts.append(true_rollout)
        if not true_rollouts:
            raise UsageError(
                "no scenario has frames to fit the constants to",
                where="HybridCoarse.fit",
                expected="a scenario in which matter still moves in frame "
                f"{self._first_compared}",
                got="none",
                fix="a smaller model.frame_step, or a data set with longer scenarios",
            )
        fitted = len(COEFFICIENTS)
        if not has_solids(self.size):
            fitted = OF_LIQUID
        ranges = np.array(RANGES[:fitted])

        def measure(values: Floats) -> float:
            coefficients = np.zeros(len(COEFFICIENTS))
            coefficients[:fitted] = values
            changed = change_constants(self.coarse, coefficients)
            errors = [_error(each, changed) for each in true_rollouts]
            if count is not None:
                count(1)
            return float(np.mean(errors))

        plain_error = measure(np.zeros(fitted))
        points = spread_points(ranges, self.options.evaluations)
        errors = np.array([measure(point) for point in points])
        best_point = points[np.argmin(errors)]
        error = float(errors.min())
        if len(points) >= 2 * count_terms(fitted):
            best_point = minimum_of_surface(points, np.log(errors), ranges)
            error = measure(best_point)
        best = torch.zeros(len(COEFFICIENTS))
        if error < plain_error:
            best[:fitted] = torch.from_numpy(best_point).float()
        error = min(error, plain_error)
        self.coefficients.copy_(best)
        numbers = dict(zip(COEFFICIENTS, best.tolist(), strict=True))
        return {"error_without": plain_error, "error": error, **numbers}

    @property
    def _first_compared(self) -> int:
        """The first frame in which the fit compares a rollout with the truth."""
        return self.info.input_frames + self.options.frame_step - 1

    def prepare_truth(self, scenario: Batch) -> TrueRollout:
        """Return what a scenario gives, and the frames in which its truth moves."""
        given_frames = self.info.input_frames
        positions = scenario.position.numpy().swapaxes(0, 1)
        last = min(len(positions), given_frames + self.info.horizon)
        true_frames = {}
        for frame in range(self._first_compared, last, self.options.frame_step):
            step = np.abs(positions[frame] - positions[frame - 1]).max()
            if step > 0.0:
                # A copy: a view would keep all frames of the scenario in memory.
                true_frames[frame] = positions[frame].astype(np.float64)
        given = self._given(scenario.part(slice(given_frames)), 0)
        return TrueRollout(given=given, true_frames=true_frames)


def _next_position(rollout: CoarseRollout) -> Floats:
    """Return the positions in the next frame, no numbers if the solver breaks down."""
    try:
        return rollout.advance()
    except WorkFailedError:
        return np.full_like(rollout.position, np.nan)


def _list_fitting_times(size: Size) -> list[float]:
    """Return the values of the option ``times`` that a data set allows."""
    fitting_times = []
    for times in (1.5, 2.0, 3.0, 4.0):
        if coarser(size, Fraction(times)) is not None:
            fitting_times.append(times)
    return fitting_times


def _check_split(split: str, size: str) -> None:
    """Refuse a split that the solver does not know.

    Args:
        split: name of the split.
        size: name of the size, for the message.

    Raises:
        UsageError: it is no split of free surfaces of lagbench.
    """
    if split in SOLVED:
        return
    raise UsageError(
        "the hybrid coarse solver knows the free surfaces of lagbench only",
        where=f"{split} {size}",
        expected=", ".join(SOLVED),
        got=split,
        fix="train neuralmpm, or a graph network such as gns",
    )


def has_solids(size: Size) -> bool:
    """Return whether the data set has materials other than liquid."""
    return any(f"{solid}_modulus" in size.parameters for solid in SOLIDS)


def change_constants(coarse: Size, coefficients: Sequence[float] | Floats) -> Size:
    """Return a size with the constants that the coefficients stand for.

    Args:
        coarse: the size of the classical coarse solver.
        coefficients: a to e, by the names in :data:`COEFFICIENTS`.
    """
    a, b, c, d, e = (float(value) for value in coefficients)
    damping = max(0.0, 1.0 + a)
    factors = {
        "liquid_viscosity": damping,
        "elastic_damping": damping,
        "liquid_modulus": math.exp(b),
        "jacobian_relaxation": math.exp(c),
        "density_coupling": math.exp(d),
    }
    for solid in SOLIDS:
        factors[f"{solid}_modulus"] = math.exp(e)

    parameters = dict(coarse.parameters)
    for name, factor in factors.items():
        if name not in parameters or factor == 1.0:
            continue
        value = float(coarse.value(name)) * factor
        if name in ("jacobian_relaxation", "density_coupling"):
            value = min(1.0, value)
        parameters[name] = parameters[name].model_copy(update={"value": value})
    changed = coarse.model_copy(update={"parameters": parameters})

    speed_ratio = fastest_sound(changed) / fastest_sound(coarse)
    substeps = math.ceil(coarse.substeps_per_frame * speed_ratio)
    substeps = min(max(substeps, 1), MOST_SUBSTEPS)
    parameters["substeps_per_frame"] = parameters["substeps_per_frame"].model_copy(
        update={"value": substeps}
    )
    return coarse.model_copy(update={"parameters": parameters})


def fastest_sound(size: Size) -> float:
    """Return the largest speed of sound over all materials [length/s].

    Its square is K / rho in liquid. In solids it is (1 - p) / ((1 + p)(1 - 2 p)) E /
    rho with Poisson's ratio p; in snow times its greatest hardening.
    """
    density = float(size.value("density"))
    squares = [float(size.value("liquid_modulus")) / density]
    for solid in SOLIDS:
        if f"{solid}_modulus" not in size.parameters:
            continue
        modulus = float(size.value(f"{solid}_modulus"))
        poisson = float(size.value(f"{solid}_poisson"))
        factor = (1.0 - poisson) / ((1.0 + poisson) * (1.0 - 2.0 * poisson))
        square = modulus * factor / density
        if solid == "snow":
            square *= float(size.value("snow_hardening_max"))
        squares.append(square)
    return math.sqrt(max(squares))


def spread_points(ranges: Floats, count: int) -> Floats:
    """Return points that fill a box evenly, shape [point, coefficient].

    They are those of Halton's sequence, without its first, a corner. Nothing is drawn.

    Args:
        ranges: lower and upper end of each coefficient, shape [coefficient, 2].
        count: how many points.
    """
    sequence = Halton(len(ranges), scramble=False)
    sequence.fast_forward(1)
    shares = sequence.random(count)
    low, high = ranges.T
    return np.asarray(low + shares * (high - low))


def count_terms(dimension: int) -> int:
    """Return the terms of a quadratic polynomial of so many variables."""
    return (dimension + 1) * (dimension + 2) // 2


def minimum_of_surface(points: Floats, values: Floats, ranges: Floats) -> Floats:
    """Return where the quadratic polynomial that fits values best is least in a box.

    Args:
        points: where the values were measured, shape [point, coefficient].
        values: shape [point].
        ranges: ends of the box, shape [coefficient, 2].
    """
    polynomial, *_ = np.linalg.lstsq(_terms(points), values, rcond=None)

    def surface(point: Floats) -> float:
        return float((_terms(point[None]) @ polynomial).item())

    # The polynomial may have a saddle: each descent ends at a minimum of its own.
    lowest = np.argsort(values)[:5]
    low, high = ranges.T
    bounds = Bounds(low, high)
    minima = [minimize(surface, points[k], bounds=bounds) for k in lowest]
    best = min(minima, key=lambda minimum: float(minimum.fun))
    return np.asarray(best.x, np.float64)


def _terms(points: Floats) -> Floats:
    """Return 1, all coefficients, and all their products, shape [point, term]."""
    with_one = np.column_stack([np.ones(len(points)), points])
    width = with_one.shape[1]
    columns = []
    for i in range(width):
        for j in range(i, width):
            columns.append(with_one[:, i] * with_one[:, j])
    return np.column_stack(columns)


def _error(true: TrueRollout, changed: Size) -> float:
    """Return the mean distance of the clouds of a rollout from the true ones [length].

    It is that of ``cloud_distance``: of each material, by its share of the particles.
    """
    material = true.given.material
    last = max(true.true_frames)
    distances = []
    try:
        rollout = CoarseRollout(true.given, changed)
        while rollout.frame <= last:
            frame = rollout.frame
            position = rollout.advance()
            if frame not in true.true_frames:
                continue
            true_position = true.true_frames[frame]
            distance = 0.0
            for kind in np.unique(material):
                members = material == kind
                share = float(members.mean())
                distance += share * sliced_wasserstein2(
                    true_position[members], position[members]
                )
            distances.append(distance)
    except WorkFailedError:
        return WORST_ERROR
    return float(np.mean(distances))
