"""Hybrid: the projection solver, with a viscous closure whose coefficients are learned.

    du/dt + div(u u) = -grad p + nu' lap u - mu lap lap u,    div u = 0
    nu' = max(0, (1 + a) nu + b h^2 / T),    mu = max(0, c) h^4 / T

with the viscosity nu that is given, the spacing h of the grid and the frame interval T.
The solver that made the data carries momentum through particles and a grid of its own:
it damps what its grid hardly sees. The textbook solver of
:mod:`lagbench.references.projection` does not; a, b and c say by how much it should.
With all coefficients 0 the model is that solver, up to the rounding of float32.

In a channel with a fixed body there is a fourth coefficient d: the fluid stops within
the radius (1 + d) R of the centre, where R is the radius of the body. On their grids
both solvers stop the fluid at points inside the body only, so each has a body of its
own size. The error changes in steps with d, as points of the grid leave or enter the
body: a range of d gives the same flow. Particles stay outside of R.

The coefficients are fitted to rollouts of the solver over many frames of ``train``: a
solver with a learned part that is trained through its own steps (Um et al. 2020,
arXiv 2007.00016; Kochkov et al. 2021, PNAS 118). So few numbers need no gradient: the
simplex method of Nelder and Mead (1965) finds them. The error that they minimise is
that of the vorticity on the score grid, seen through the particles of the truth: a
finer grid has about one particle a cell, and there sampling noise hides the error.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from pydantic import Field
from scipy.optimize import minimize
from torch import Tensor

from lagbench.data.box import Box, keep_outside
from lagbench.data.registry import Size
from lagbench.data.registry import load as load_registry
from lagbench.errors import DataError, UsageError
from lagbench.references.projection import forcing_of
from lagbench.references.staggered import Forcing, StaggeredGrid, Velocity

from .baseline import Batch, DatasetInfo, Options
from .hybrid import Hybrid

Floats = NDArray[np.float64]

STABLE_DECAY = 1.6
"""Time step times the fastest rate of decay, at most; Heun's scheme allows 2."""

CLOSURE = 3  # number of the coefficients a, b, c
FIRST_STEP = 0.02  # of the simplex method, in a, b and c
FIRST_RADIUS_STEP = 0.1  # the same in d; less might change no point of the grid
LARGEST = 2.0  # magnitude of a coefficient; more would need very many time steps
WORST_ERROR = 10.0  # error of coefficients with which the solver breaks down


class ClosedGrid(StaggeredGrid):
    """The staggered grid of the reference solver, with a hyperviscosity.

    Args:
        box: the box.
        cells: cells along each axis.
        no_slip: whether walls hold the fluid.
        hyperviscosity: mu [length^4/s].
        forcing: what draws the velocity to given values; None for nothing.
    """

    def __init__(
        self,
        box: Box,
        *,
        cells: Sequence[int],
        no_slip: bool,
        hyperviscosity: float,
        forcing: Forcing | None = None,
    ) -> None:
        super().__init__(box, cells=cells, no_slip=no_slip, forcing=forcing)
        self.hyperviscosity = hyperviscosity

    def acceleration(
        self,
        velocity: Velocity,
        *,
        viscosity: float,
        wall_velocity: Floats,
        force: ArrayLike | None = None,
    ) -> Velocity:
        """Return the reference's acceleration less ``mu lap lap u`` [length/s^2]."""
        rates = super().acceleration(
            velocity, viscosity=viscosity, wall_velocity=wall_velocity, force=force
        )
        if self.hyperviscosity == 0.0:
            return rates
        at_rest = np.zeros_like(wall_velocity)
        for component, values in enumerate(velocity):
            ghosted_velocity = self._with_ghosts(values, component, wall_velocity)
            laplacian = self._laplacian(ghosted_velocity)
            ghosted_laplacian = self._with_ghosts(laplacian, component, at_rest)
            bilaplacian = self._laplacian(ghosted_laplacian)
            change = -self.hyperviscosity * bilaplacian
            if not self.box.periodic[component]:
                # Nothing flows through a wall.
                faces = np.moveaxis(change, component, 0)
                faces[0] = 0.0
                faces[-1] = 0.0
            rates[component] += change
        return rates

    def step_count(
        self,
        velocity: Velocity,
        *,
        duration: float,
        viscosity: float,
        wall_velocity: Floats,
    ) -> int:
        """Return how many time steps a duration takes at the least [1].

        The wave that changes its sign from cell to cell decays by the viscosity and the
        hyperviscosity together, so their rates are added.

        Args:
            velocity: of the faces.
            duration: time to advance [s].
            viscosity: with what the hybrid has learned [length^2/s].
            wall_velocity: of each wall.
        """
        steps = super().step_count(
            velocity,
            duration=duration,
            viscosity=viscosity,
            wall_velocity=wall_velocity,
        )
        if self.hyperviscosity == 0.0:
            return steps
        fastest_of_axes = 4.0 / self.spacing**2
        fastest_laplacian = float(fastest_of_axes.sum())
        viscous_rate = viscosity * fastest_laplacian
        hyperviscous_rate = self.hyperviscosity * fastest_laplacian**2
        decay_rate = viscous_rate + hyperviscous_rate
        stable_steps = np.ceil(duration * decay_rate / STABLE_DECAY)
        return max(steps, int(stable_steps))


@dataclass(frozen=True, kw_only=True)
class WindowForcing:
    """What drives the flow of one scenario towards each frame that is known."""

    walls: Floats  # wall velocities [length/s], shape [frame, 2 axis, axis]
    # acceleration of the fluid in layers [length/s^2], shape [frame, layer, axis]; None
    # without a force
    forces: Floats | None
    obstacle: Floats | None  # centre and radius [length], shape [axis + 1]

    @classmethod
    def of(cls, batch: Batch, window: int) -> WindowForcing:
        """Return what drives a window of a batch; walls at rest where none moves."""
        dimension = batch.position.shape[2]
        walls = np.zeros((1, 2 * dimension, dimension))
        if batch.wall_velocity is not None:
            walls = batch.wall_velocity[window].double().cpu().numpy()
        forces = None
        if batch.body_force is not None:
            forces = batch.body_force[window].double().cpu().numpy()
        obstacle = None
        if batch.obstacle is not None:
            obstacle = batch.obstacle[window].double().cpu().numpy()
        return cls(walls=walls, forces=forces, obstacle=obstacle)

    @property
    def has_moving_walls(self) -> bool:
        """Whether a wall ever moves."""
        return bool(self.walls.any())

    def wall_velocity(self, frame: int) -> Floats:
        """Return the wall velocities towards a frame; the last known ones stay."""
        known_frame = min(frame, len(self.walls) - 1)
        return np.asarray(self.walls[known_frame])

    def force(self, frame: int) -> Floats | None:
        """Return the acceleration towards a frame; the last known one stays."""
        if self.forces is None:
            return None
        known_frame = min(frame, len(self.forces) - 1)
        return np.asarray(self.forces[known_frame])


@dataclass(frozen=True, kw_only=True)
class FlowState:
    """One scenario on the way: its solver and where its fluid is."""

    grid: ClosedGrid
    forcing: WindowForcing
    viscosity: float  # nu' [length^2/s]
    field: Velocity  # face velocities [length/s]
    position: Floats  # particle positions [length], shape [particle, axis]
    frame: int  # number of the frame that was reached, counted from the window's first

    @property
    def is_finite(self) -> bool:
        """Whether all velocities are numbers; else the solver has broken down."""
        return all(np.isfinite(values).all() for values in self.field)

    def later_field(self, *, frame: int, duration: float) -> Velocity:
        """Return the face velocities after some time on the way to a frame.

        Velocities that are not finite stay as they are.
        """
        if not self.is_finite:
            return self.field
        with np.errstate(over="ignore", invalid="ignore"):
            return self.grid.advance(
                self.field,
                duration=duration,
                viscosity=self.viscosity,
                wall_velocity=self.forcing.wall_velocity(frame),
                force=self.forcing.force(frame),
            )


@dataclass(frozen=True, kw_only=True)
class Flows:
    """State of a rollout: a flow for each window."""

    flows: tuple[FlowState, ...]
    device: torch.device


class Observation:
    """What particles show of the true flow half-way between two frames.

    Args:
        grid: the score grid, on which the particles' velocities are averaged.
        position: particle positions [length], shape [particle, axis].
        velocity: velocities of the particles [length/s], shape [particle, axis].
        wall_velocity: as in :meth:`StaggeredGrid.acceleration`.
    """

    def __init__(
        self,
        grid: StaggeredGrid,
        position: Floats,
        velocity: Floats,
        wall_velocity: Floats,
    ) -> None:
        self.grid = grid
        self.position = position
        self.wall_velocity = wall_velocity
        self.true_vorticity = self._vorticity_of(velocity)

    def vorticity_of(self, field: Velocity, grid: StaggeredGrid) -> Floats:
        """Return the vorticity [1/s] that the particles would show in another flow.

        Args:
            field: face velocities of that flow [length/s].
            grid: its grid.
        """
        velocity = grid.at_particles(
            field, self.position, wall_velocity=self.wall_velocity
        )
        return self._vorticity_of(velocity)

    def _vorticity_of(self, velocity: Floats) -> Floats:
        # The mean around each face is enough: corrections would sharpen the noise too.
        field = self.grid.from_particles(
            self.position, velocity, wall_velocity=self.wall_velocity, corrections=0
        )
        return compute_vorticity(field, self.grid)


@dataclass(frozen=True, kw_only=True)
class Sample:
    """A scenario of the fit: the given frames, and what its particles show later."""

    given: Batch
    observations: tuple[Observation, ...]


class HybridOptions(Options):
    """Options of the hybrid."""

    in_training = frozenset({"numerical", "scenarios", "frames", "evaluations"})
    of_weights = frozenset({"resolution"})

    # cells over those of the score grid, along each axis
    resolution: float = Field(default=2.0, gt=0.0, le=4.0, allow_inf_nan=False)
    # whether b and c are fitted; else a alone, in a channel a and d
    numerical: bool = True
    scenarios: int = Field(default=12, ge=1)  # of train, to fit on, at most
    frames: int = Field(default=60, ge=2)  # that each of them is rolled out
    evaluations: int = Field(default=45, ge=1)  # of the fit, at most


class HybridProjection(Hybrid):
    """The projection solver with a learned viscous closure."""

    method = "hybrid projection"
    largest = LARGEST

    Options = HybridOptions
    options: HybridOptions

    def __init__(self, options: HybridOptions, info: DatasetInfo) -> None:
        super().__init__(options, info)
        self.channel = _find_channel(info)
        count = CLOSURE
        if self.channel is not None:
            count += 1
        self.register_buffer("coefficients", torch.zeros(count))  # a, b, c, d

    @classmethod
    def check_data_set(
        cls, split: str, size: str, box: Box, *, is_full_box: bool
    ) -> None:
        """Refuse a data set whose matter does not fill its box.

        :meth:`Baseline.check_data_set` describes the arguments.

        Raises:
            UsageError: the data set has a free surface.
        """
        super().check_data_set(split, size, box, is_full_box=is_full_box)
        if is_full_box:
            return
        raise UsageError(
            "the hybrid projection solver knows full boxes only",
            where=f"{split} {size}",
            expected="fluid that fills its box",
            got="a free surface",
            fix="train neuralmpm, or a graph network such as gns",
        )

    @property
    def forcing_seen(self) -> frozenset[str]:
        """The force that drives the flow, and the obstacle of a channel."""
        if self.channel is None:
            return frozenset({"body_force"})
        return frozenset({"body_force", "obstacle"})

    # --- the solver ---------------------------------------------------------------

    def start(self, given: Batch) -> Flows:
        """Return the flows that the last two given frames show.

        Raises:
            DataError: the viscosity is not known, or a coefficient is out of range.
        """
        values = self.checked_coefficients()
        flows = []
        for window in range(given.windows):
            is_inside = given.sample == window
            flow = self._begin(given, window, is_inside, values)
            flows.append(flow)
        return Flows(flows=tuple(flows), device=given.position.device)

    def _begin(
        self, given: Batch, window: int, is_inside: Tensor, coefficients: Floats
    ) -> FlowState:
        """Return the flow of one window, brought to its last given frame."""
        interval = self.info.frame_interval
        box = self.info.box
        forcing = WindowForcing.of(given, window)
        viscosity, hyperviscosity = self._closure(given, window, coefficients)
        grid = ClosedGrid(
            box,
            cells=self._cell_counts(self.options.resolution),
            no_slip=forcing.has_moving_walls,
            hyperviscosity=hyperviscosity,
            forcing=self._forcing(forcing.obstacle, coefficients),
        )
        frames = given.position[is_inside].double().cpu().numpy()
        before = frames[:, -2]
        position = frames[:, -1]
        last_frame = given.frames - 1

        step = box.displacement(before, position)
        if box.is_periodic:
            middle = box.inside(position - step / 2.0)
        else:
            middle = (position + before) / 2
        field = grid.from_particles(
            middle, step / interval, wall_velocity=forcing.wall_velocity(last_frame)
        )
        flow = FlowState(
            grid=grid,
            forcing=forcing,
            viscosity=viscosity,
            field=field,
            position=position,
            frame=last_frame,
        )
        # The velocities of the last step hold half a frame before its end.
        field = flow.later_field(frame=last_frame, duration=0.5 * interval)
        return replace(flow, field=field)

    def _forcing(self, obstacle: Floats | None, coefficients: Floats) -> Forcing | None:
        """Return the fringe of a channel and its body, with the radius (1 + d) R."""
        if self.channel is None or obstacle is None:
            return None
        relative_change = float(coefficients[CLOSURE])  # d
        body = obstacle.copy()
        body[-1] *= max(0.0, 1.0 + relative_change)
        return forcing_of(self.channel, body)

    def _closure(
        self, given: Batch, window: int, coefficients: Floats
    ) -> tuple[float, float]:
        """Return nu' [length^2/s] and mu [length^4/s] of a window."""
        if given.viscosity is None:
            raise DataError(
                "the viscosity is not known",
                where=f"{self.info.split} {self.info.size}",
                expected="a viscosity in each scenario file, or in the registry",
                got="none",
                fix="train neuralmpm, or a graph network such as gns",
            )
        # In float64, as the solver computes: its steps may hang on the last digit.
        stated = float(given.viscosity[window])
        relative, added, hyper = coefficients[:CLOSURE].tolist()  # a, b, c
        cell_counts = np.asarray(self._cell_counts(self.options.resolution))
        cell_lengths = self.info.box.lengths / cell_counts
        spacing = float(cell_lengths.min())
        interval = self.info.frame_interval
        viscosity = (1.0 + relative) * stated + added * spacing**2 / interval
        hyperviscosity = max(hyper, 0.0) * spacing**4 / interval
        return max(viscosity, 0.0), hyperviscosity

    def _cell_counts(self, resolution: float) -> tuple[int, ...]:
        """Return the cells along each axis, for cells over those of the score grid."""
        cells_per_length = resolution * self.info.score_cells
        counts = []
        for length in self.info.box.lengths:
            nearest = round(cells_per_length * length)
            counts.append(max(4, nearest))
        return tuple(counts)

    def advance(self, state: Flows) -> tuple[Flows, Tensor]:
        """Return the next state and positions [length], shape [particle, axis]."""
        flows = []
        positions = []
        for flow in state.flows:
            moved = self._advance_flow(flow)
            flows.append(moved)
            positions.append(moved.position)
        all_positions = np.concatenate(positions)
        position = torch.from_numpy(all_positions).float()
        state = replace(state, flows=tuple(flows))
        return state, position.to(state.device)

    def _advance_flow(self, flow: FlowState) -> FlowState:
        """Return a flow one frame later."""
        interval = self.info.frame_interval
        next_frame = flow.frame + 1
        field = flow.later_field(frame=next_frame, duration=interval)
        later = replace(flow, field=field, frame=next_frame)
        if not later.is_finite:
            return replace(later, position=np.full_like(flow.position, np.nan))
        position = flow.grid.carry(
            flow.position,
            before=flow.field,
            after=field,
            duration=interval,
            wall_velocity=flow.forcing.wall_velocity(next_frame),
        )
        obstacle = flow.forcing.obstacle
        if obstacle is not None and flow.grid.forcing is not None:
            position = flow.grid.box.inside(position)
            position = keep_outside(position, obstacle)
        return replace(later, position=position)

    # --- the fit ------------------------------------------------------------------

    @property
    def evaluations(self) -> int:
        """Times that the fit measures the error, at most: without damping too."""
        return self.options.evaluations + 1

    def fit(
        self, scenarios: Iterable[Batch], *, count: Callable[[int], None] | None = None
    ) -> Mapping[str, float]:
        """Fit the coefficients to scenarios of train; return errors to log.

        The error is that of the vorticity on the score grid over the true one's, the
        root of a mean over frames, and the mean over scenarios.

        Args:
            scenarios: whole scenarios, one a batch.
            count: is called with 1 after each evaluation.

        Raises:
            UsageError: no scenario is longer than the given frames.
        """
        samples: list[Sample] = []
        for scenario in itertools.islice(scenarios, self.options.scenarios):
            sample = self._prepare(scenario)
            if sample.observations:
                samples.append(sample)
        if not samples:
            raise UsageError(
                "no scenario has frames to fit the damping to",
                where="HybridProjection.fit",
                expected=f"more than {self.info.input_frames} frames in a scenario",
                got="none",
                fix="train on a data set with longer scenarios",
            )
        is_fitted = self._fitted_coefficients()

        def measure(values: NDArray[np.float64]) -> float:
            coefficients = np.zeros(len(is_fitted))
            coefficients[is_fitted] = values
            if np.abs(coefficients).max() > LARGEST:
                return WORST_ERROR
            errors = [self._error(sample, coefficients) for sample in samples]
            if count is not None:
                count(1)
            return float(np.mean(errors))

        first_steps = np.full(len(is_fitted), FIRST_STEP)
        first_steps[CLOSURE:] = FIRST_RADIUS_STEP
        start = np.zeros(int(is_fitted.sum()))
        plain_error = measure(start)
        corners = np.diag(first_steps[is_fitted])
        simplex = np.vstack([start, corners])
        minimum = minimize(
            measure,
            start,
            method="Nelder-Mead",
            options={
                "maxfev": self.options.evaluations,
                "initial_simplex": simplex,
                "xatol": 1e-4,
                "fatol": 1e-5,
            },
        )
        best = np.zeros(len(is_fitted))
        if minimum.fun < plain_error:
            best[is_fitted] = minimum.x
        self.coefficients.copy_(torch.from_numpy(best))
        numbers = {"error_without": plain_error, "error": float(minimum.fun)}
        names = ("relative", "added", "hyper", "radius")
        for name, value in zip(names, self.coefficients.tolist(), strict=False):
            numbers[name] = value
        return numbers

    def _fitted_coefficients(self) -> NDArray[np.bool_]:
        """Return which coefficients the fit changes, shape [coefficient]."""
        is_fitted = np.ones(len(self.coefficients), dtype=bool)
        if not self.options.numerical:
            is_fitted[1:CLOSURE] = False
        return is_fitted

    def _prepare(self, scenario: Batch) -> Sample:
        """Return the first frames of a scenario, and what its particles show later."""
        box = self.info.box
        given_frames = self.info.input_frames
        frame_count = min(scenario.frames, given_frames + self.options.frames)
        forcing = WindowForcing.of(scenario, 0)
        score_grid = StaggeredGrid(
            box, cells=self._cell_counts(1.0), no_slip=forcing.has_moving_walls
        )
        positions = scenario.position.double().numpy()
        observations = []
        for frame in range(given_frames, frame_count):
            before = positions[:, frame - 1]
            step = box.displacement(before, positions[:, frame])
            observation = Observation(
                score_grid,
                position=box.inside(before + step / 2.0),
                velocity=step / self.info.frame_interval,
                wall_velocity=forcing.wall_velocity(frame),
            )
            observations.append(observation)
        given = scenario.part(slice(given_frames))
        return Sample(given=given, observations=tuple(observations))

    def _error(self, sample: Sample, coefficients: Floats) -> float:
        """Return the error of a rollout with some coefficients [1]."""
        given = sample.given
        particle_count = len(given.position)
        all_particles = torch.ones(particle_count, dtype=torch.bool)
        flow = self._begin(given, 0, all_particles, coefficients)
        interval = self.info.frame_interval
        squared_error = 0.0
        squared_truth = 0.0
        for observation in sample.observations:
            next_frame = flow.frame + 1
            field = flow.later_field(frame=next_frame, duration=interval)
            later = replace(flow, field=field, frame=next_frame)
            if not later.is_finite:
                return WORST_ERROR
            # The mean of both ends stands for the step between two frames.
            middle = []
            for start, end in zip(flow.field, field, strict=True):
                middle.append((start + end) / 2)
            vorticity = observation.vorticity_of(middle, flow.grid)
            difference = vorticity - observation.true_vorticity
            squared_error += float(np.square(difference).sum())
            squared_truth += float(np.square(observation.true_vorticity).sum())
            flow = later
        if squared_truth == 0.0:
            return WORST_ERROR
        relative_error = float(np.sqrt(squared_error / squared_truth))
        return min(WORST_ERROR, relative_error)


def _find_channel(info: DatasetInfo) -> Size | None:
    """Return the description of a channel in datasets.yaml; None for other data."""
    registry = load_registry()
    split = registry.splits.get(info.split)
    if split is None or info.size not in split.sizes:
        return None
    size = registry.size(info.split, info.size)
    if not size.has_fringe:
        return None
    return size


def compute_vorticity(velocity: Velocity, grid: StaggeredGrid) -> Floats:
    """Return ``d u_b / d a - d u_a / d b`` for each pair of axes a < b [1/s].

    The edges on which both slopes stand: those inside the box, and along a periodic
    axis those of its seam too.

    Args:
        velocity: face velocities [length/s].
        grid: their grid.

    Returns:
        One number per pair of axes and edge, in one row.
    """
    rotations = []
    for a, b in itertools.combinations(range(grid.dimension), 2):
        slope_of_b = _slope_at_edges(velocity[b], grid, component=b, axis=a)
        slope_of_a = _slope_at_edges(velocity[a], grid, component=a, axis=b)
        rotation = slope_of_b - slope_of_a
        rotations.append(rotation.ravel())
    return np.concatenate(rotations)


def _slope_at_edges(
    values: Floats, grid: StaggeredGrid, *, component: int, axis: int
) -> Floats:
    """Return the slope of a component along another axis [1/s], on inner edges."""
    if grid.box.periodic[axis]:
        change = values - np.roll(values, 1, axis)
    else:
        change = np.diff(values, axis=axis)
    if not grid.box.periodic[component]:
        last = change.shape[component] - 1
        change = change.take(range(1, last), axis=component)
    return np.asarray(change / grid.spacing[axis])
