"""Hybrid: the projection solver, with a viscous closure whose coefficients are learned.

    du/dt + div(u u) = -grad p + nu' lap u - mu lap lap u,    div u = 0
    nu' = (1 + a) nu + b h^2 / T,    mu = c h^4 / T

with the viscosity nu that is given, the spacing h of the grid and the frame interval T.
The solver that made the data carries momentum through particles and a grid of its own:
it damps what its grid hardly sees. The textbook solver of
:mod:`lagbench.references.projection` does not; a, b and c say by how much it should.
With all three 0 the model is that solver, digit by digit.

The coefficients are fitted to rollouts of the solver over many frames of ``train``: a
solver with a learned part that is trained through its own steps (Um et al. 2020,
arXiv 2007.00016; Kochkov et al. 2021, PNAS 118). Three numbers need no gradient: the
simplex method of Nelder and Mead (1965) finds them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from pydantic import Field
from scipy.optimize import minimize
from torch import Tensor

from lagbench.data.box import Box
from lagbench.errors import DataError, UsageError
from lagbench.references.staggered import StaggeredGrid, Velocity

from .baseline import Baseline, Batch, DatasetInfo, Options

Floats = NDArray[np.float64]

STABLE_DECAY = 1.6
"""Time step times the fastest rate of decay, at most; Heun's scheme allows 2."""

FIRST_STEP = 0.02  # of the simplex method, in each coefficient
LARGEST = 2.0  # magnitude of a coefficient in the search
WORST_ERROR = 10.0  # error of coefficients with which the solver breaks down


class ClosedGrid(StaggeredGrid):
    """The staggered grid of the reference solver, with a hyperviscosity.

    Args:
        box: the box.
        cells: cells along each axis.
        no_slip: whether walls hold the fluid.
        hyperviscosity: mu [length^4/s].
    """

    def __init__(
        self, box: Box, *, cells: Sequence[int], no_slip: bool, hyperviscosity: float
    ) -> None:
        super().__init__(box, cells=cells, no_slip=no_slip)
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

        A wave of one cell decays by the viscosity and the hyperviscosity together, so
        their rates are added.
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
class FlowState:
    """One scenario on the way: its solver and where its fluid is."""

    grid: ClosedGrid
    field: Velocity  # face velocities [length/s]
    position: Floats  # particle positions [length], shape [particle, axis]
    walls: Floats  # wall velocities of all known frames [length/s]
    frame: int  # row of `walls` of the frame that was reached
    viscosity: float  # nu' [length^2/s]

    def wall_velocity(self, frame: int) -> Floats:
        """Return the wall velocities towards a frame; the last known ones stay."""
        last_known = len(self.walls) - 1
        known_frame = min(frame, last_known)
        return np.asarray(self.walls[known_frame])


@dataclass(frozen=True, kw_only=True)
class Flows:
    """State of a rollout: a flow for each window."""

    flows: tuple[FlowState, ...]
    device: torch.device


class HybridOptions(Options):
    """Options of the hybrid."""

    in_training = frozenset({"scenarios", "frames", "evaluations"})
    of_weights = frozenset({"resolution"})

    # cells over those of the score grid, along each axis
    resolution: float = Field(default=2.0, gt=0.0, le=4.0, allow_inf_nan=False)
    # whether b and c are fitted; else a alone
    numerical: bool = True
    scenarios: int = Field(default=12, ge=1)  # of train, to fit on, at most
    frames: int = Field(default=60, ge=2)  # that each of them is rolled out
    evaluations: int = Field(default=45, ge=1)  # of the fit, at most


class HybridProjection(Baseline):
    """The projection solver with a learned viscous closure."""

    method = "hybrid projection"
    closed_form: ClassVar[bool] = True
    fits_batches: ClassVar[bool] = True

    Options = HybridOptions
    options: HybridOptions
    coefficients: Tensor

    def __init__(self, options: HybridOptions, info: DatasetInfo) -> None:
        super().__init__(options, info)
        self.register_buffer("coefficients", torch.zeros(3))  # a, b, c

    @property
    def forcing_seen(self) -> frozenset[str]:
        """Neither a force nor an obstacle."""
        return frozenset()

    @property
    def history(self) -> int:
        """Given frames that the solver reads: the last two."""
        return 2

    def forward(
        self, batch: Batch, generator: torch.Generator | None = None
    ) -> dict[str, Tensor]:
        """Refuse: the coefficients are fitted as a whole, without steps.

        Raises:
            UsageError: always.
        """
        raise UsageError(
            f"{self.method} takes no training steps",
            where="HybridProjection.forward",
            fix="train it with `lagbench train`",
        )

    # --- the solver ---------------------------------------------------------------

    def start(self, given: Batch) -> Flows:
        """Return the flows that the last two given frames show.

        Raises:
            DataError: the viscosity is not known.
        """
        values = self.coefficients.double().cpu().numpy()
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
        frames = given.position[is_inside].double().cpu().numpy()
        _, frame_count, dimension = frames.shape
        walls = np.zeros((1, 2 * dimension, dimension))
        if given.wall_velocity is not None:
            known_walls = given.wall_velocity[window]
            walls = known_walls.double().cpu().numpy()
        viscosity, hyperviscosity = self._closure(given, window, coefficients)
        box = self.info.box
        grid = ClosedGrid(
            box,
            cells=self._cell_counts(box),
            no_slip=bool(walls.any()),
            hyperviscosity=hyperviscosity,
        )
        last_frame = frame_count - 1
        before = frames[:, -2]
        position = frames[:, -1]
        flow = FlowState(
            grid=grid,
            field=[],
            position=position,
            walls=walls,
            frame=last_frame,
            viscosity=viscosity,
        )
        wall_velocity = flow.wall_velocity(last_frame)
        step = box.displacement(before, position)
        velocity = step / interval
        if box.is_periodic:
            middle = box.inside(position - step / 2.0)
        else:
            middle = (position + before) / 2
        # The velocities of the last step hold half a frame before its end.
        field = grid.from_particles(middle, velocity, wall_velocity=wall_velocity)
        field = grid.advance(
            field,
            duration=0.5 * interval,
            viscosity=viscosity,
            wall_velocity=wall_velocity,
        )
        return replace(flow, field=field)

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
        # A file states it in float64; the solver's steps may hang on the last digit.
        stated = float(given.viscosity[window])
        relative, added, hyper = coefficients.tolist()  # a, b, c
        box = self.info.box
        cell_counts = np.asarray(self._cell_counts(box))
        cell_lengths = box.lengths / cell_counts
        spacing = float(cell_lengths.min())
        interval = self.info.frame_interval
        viscosity = (1.0 + relative) * stated + added * spacing**2 / interval
        hyperviscosity = max(hyper, 0.0) * spacing**4 / interval
        return max(viscosity, 0.0), hyperviscosity

    def _cell_counts(self, box: Box) -> tuple[int, ...]:
        cells_per_length = self.options.resolution * self.info.score_cells
        counts = []
        for length in box.lengths:
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
        wall_velocity = flow.wall_velocity(next_frame)
        field = flow.grid.advance(
            flow.field,
            duration=interval,
            viscosity=flow.viscosity,
            wall_velocity=wall_velocity,
        )
        position = flow.grid.carry(
            flow.position,
            before=flow.field,
            after=field,
            duration=interval,
            wall_velocity=wall_velocity,
        )
        return replace(flow, field=field, position=position, frame=next_frame)

    # --- the fit ------------------------------------------------------------------

    def fit(self, scenarios: Iterable[Batch]) -> Mapping[str, float]:
        """Fit the coefficients to scenarios of train; return errors to log.

        The error is that of the vorticity on the solver's grid over the true one's, the
        root of a mean over frames, and the mean over scenarios.

        Args:
            scenarios: whole scenarios, one a batch.
        """
        samples = []
        for scenario in islice(scenarios, self.options.scenarios):
            sample = self._prepare(scenario)
            samples.append(sample)
        size = 1
        if self.options.numerical:
            size = 3

        def measure(values: NDArray[np.float64]) -> float:
            coefficients = np.zeros(3)
            coefficients[:size] = values
            if np.abs(coefficients).max() > LARGEST:
                return WORST_ERROR
            errors = [self._error(sample, coefficients) for sample in samples]
            return float(np.mean(errors))

        start = np.zeros(size)
        plain_error = measure(start)
        steps = FIRST_STEP * np.eye(size)
        simplex = np.vstack([start, steps])
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
        best = torch.zeros(3)
        if minimum.fun < plain_error:
            best[:size] = torch.from_numpy(minimum.x).float()
        self.coefficients.copy_(best)
        relative, added, hyper = best.tolist()
        return {
            "error_without": plain_error,
            "error": float(minimum.fun),
            "relative": relative,
            "added": added,
            "hyper": hyper,
        }

    def _prepare(self, scenario: Batch) -> tuple[Batch, list[Floats]]:
        """Return the first frames of a scenario, and its true vorticity later on."""
        given_frames = self.info.input_frames
        last = min(scenario.frames, given_frames + self.options.frames)
        given = scenario.part(slice(given_frames))
        vorticity = []
        for frame in range(given_frames, last):
            window = scenario.part(slice(0, frame + 1))
            flow = self._observe(window)
            true_vorticity = compute_vorticity(flow.field, flow.grid)
            vorticity.append(true_vorticity)
        return given, vorticity

    def _observe(self, window: Batch) -> FlowState:
        """Return the flow of a window's last step, half a frame before its end."""
        interval = self.info.frame_interval
        box = self.info.box
        flow = self._begin_at_rest(window)
        frames = window.position[:, -2:].double().numpy()
        before = frames[:, 0]
        position = frames[:, 1]
        step = box.displacement(before, position)
        middle = box.inside(position - step / 2.0)
        velocity = step / interval
        wall_velocity = flow.wall_velocity(window.frames - 1)
        field = flow.grid.from_particles(middle, velocity, wall_velocity=wall_velocity)
        return replace(flow, field=field)

    def _begin_at_rest(self, window: Batch) -> FlowState:
        """Return the flow of a window without its field."""
        box = self.info.box
        dimension = window.position.shape[2]
        walls = np.zeros((1, 2 * dimension, dimension))
        if window.wall_velocity is not None:
            walls = window.wall_velocity[0].double().numpy()
        grid = ClosedGrid(
            box,
            cells=self._cell_counts(box),
            no_slip=bool(walls.any()),
            hyperviscosity=0.0,
        )
        return FlowState(
            grid=grid,
            field=[],
            position=np.zeros((0, dimension)),
            walls=walls,
            frame=0,
            viscosity=0.0,
        )

    def _error(self, sample: tuple[Batch, list[Floats]], coefficients: Floats) -> float:
        """Return the error of a rollout with some coefficients [1]."""
        given, true_vorticity = sample
        particles = len(given.position)
        everybody = torch.ones(particles, dtype=torch.bool)
        flow = self._begin(given, 0, everybody, coefficients)
        interval = self.info.frame_interval
        squared_error = 0.0
        squared_truth = 0.0
        field = flow.field
        for step, truth in enumerate(true_vorticity, start=1):
            wall_velocity = flow.wall_velocity(flow.frame + step)
            later = flow.grid.advance(
                field,
                duration=interval,
                viscosity=flow.viscosity,
                wall_velocity=wall_velocity,
            )
            # The mean of both ends stands for the step between two frames.
            middle = []
            for start, end in zip(field, later, strict=True):
                middle.append((start + end) / 2)
            vorticity = compute_vorticity(middle, flow.grid)
            difference = vorticity - truth
            squared_error += float(np.square(difference).sum())
            squared_truth += float(np.square(truth).sum())
            field = later
        if not np.isfinite(squared_error) or squared_truth == 0.0:
            return WORST_ERROR
        relative_error = float(np.sqrt(squared_error / squared_truth))
        return min(WORST_ERROR, relative_error)


def compute_vorticity(velocity: Velocity, grid: StaggeredGrid) -> Floats:
    """Return dv/dx - du/dy at the inner corners of a grid in two dimensions [1/s]."""
    u, v = velocity
    width, height = grid.spacing
    v_differences = np.diff(v, axis=0)
    u_differences = np.diff(u, axis=1)
    dv_dx = v_differences[:, 1:-1] / width
    du_dy = u_differences[1:-1] / height
    return np.asarray(dv_dx - du_dy)
