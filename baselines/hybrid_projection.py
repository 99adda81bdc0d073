"""Hybrid: the projection solver, with a viscous closure whose coefficients are learned.

    du/dt + div(u u) = -grad p + nu' lap u - mu lap lap u,    div u = 0
    nu' = max(0, (1 + a) nu + b h^2 / T),    mu = max(0, c) h^4 / T

with the viscosity nu that is given, the spacing h of the grid and the frame interval T.
The solver that made the data carries momentum through particles and a grid of its own:
it damps what its grid hardly sees. The textbook solver of
:mod:`lagbench.references.projection` does not; a, b and c say by how much it should.
With all coefficients 0 the model is that solver with central differences, up to the
rounding of float32, but for its start: it reads the last two given frames.

In a channel with a fixed body there is a fourth coefficient d: the fluid stops within
the radius (1 + d) R of the centre, where R is the radius of the body. On their grids
both solvers stop the fluid at points inside the body only, so each has a body of its
own size. Particles stay outside of R.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from lagbench.data.box import Box, keep_outside
from lagbench.data.registry import Size
from lagbench.data.registry import load as load_registry
from lagbench.errors import DataError
from lagbench.references.projection import forcing_of
from lagbench.references.staggered import Forcing, StaggeredGrid, Velocity

from .baseline import Batch, DatasetInfo
from .hybrid import Hybrid, HybridOptions

Floats = NDArray[np.float64]

STABLE_DECAY = 1.6
"""Time step times the fastest rate of decay, at most; Heun's scheme allows 2."""

CLOSURE = 3  # number of the coefficients a, b, c
RESOLUTION = 2.0  # cells over those of the score grid, along each axis


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
            self._stop_at_walls(change, component)
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
class ProjectedFlow:
    """One scenario on the way: its solver and where its fluid is."""

    grid: ClosedGrid
    viscosity: float  # nu' [length^2/s]
    walls: Floats  # wall velocities [length/s], shape [frame, 2 axis, axis]
    # acceleration of the fluid in layers [length/s^2], shape [frame, layer, axis]; None
    # without a force
    forces: Floats | None
    obstacle: Floats | None  # centre and radius [length], shape [axis + 1]
    field: Velocity  # face velocities [length/s]
    position: Floats  # particle positions [length], shape [particle, axis]
    frame: int  # number of the frame that was reached, counted from the window's first

    def wall_velocity(self, frame: int) -> Floats:
        """Return the wall velocities towards a frame; the last known ones stay."""
        return np.asarray(self.walls[min(frame, len(self.walls) - 1)])

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
        force = None
        if self.forces is not None:
            force = self.forces[min(frame, len(self.forces) - 1)]
        with np.errstate(over="ignore", invalid="ignore"):
            return self.grid.advance(
                self.field,
                duration=duration,
                viscosity=self.viscosity,
                wall_velocity=self.wall_velocity(frame),
                force=force,
            )


class HybridProjection(Hybrid):
    """The projection solver with a learned viscous closure."""

    method = "hybrid projection"
    largest = 2.0  # more would need very many time steps

    Options = HybridOptions

    def __init__(self, options: HybridOptions, info: DatasetInfo) -> None:
        super().__init__(options, info)
        self.channel: Size | None = None
        split = load_registry().splits.get(info.split)
        if split is not None and info.size in split.sizes:
            size = load_registry().size(info.split, info.size)
            if size.has_fringe:
                self.channel = size
        count = CLOSURE + (self.channel is not None)
        self.register_buffer("coefficients", torch.zeros(count))  # a, b, c, d

    def start(self, given: Batch) -> list[ProjectedFlow]:
        """Return the flows that the last two given frames show.

        Raises:
            DataError: the viscosity is not known, or a coefficient is out of range.
        """
        return [self._begin(given, window) for window in range(given.windows)]

    def _begin(self, given: Batch, window: int) -> ProjectedFlow:
        """Return the flow of one window, brought to its last given frame."""
        interval = self.info.frame_interval
        box = self.info.box
        if given.viscosity is None:
            raise DataError(
                "the viscosity is not known: neither the files nor the data set state "
                "one",
                where=f"{self.info.split} {self.info.size}",
            )

        def read(values: Tensor | None) -> Floats | None:
            """Return the values of the window; None where the batch has none."""
            return None if values is None else values[window].double().numpy()

        walls = read(given.wall_velocity)
        if walls is None:
            walls = np.zeros((1, 2 * box.dimension, box.dimension))
        obstacle = read(given.obstacle)

        coefficients = self.checked_coefficients()
        cells_per_length = RESOLUTION * self.info.score_cells
        cells = [max(4, round(cells_per_length * length)) for length in box.lengths]
        spacing = float((box.lengths / np.asarray(cells)).min())
        # In float64, as the solver computes: its steps may hang on the last digit.
        stated = float(given.viscosity[window])
        relative, added, hyper = coefficients[:CLOSURE].tolist()  # a, b, c
        viscosity = (1.0 + relative) * stated + added * spacing**2 / interval
        hyperviscosity = max(hyper, 0.0) * spacing**4 / interval
        forcing = None
        if self.channel is not None and obstacle is not None:
            body = obstacle.copy()
            body[-1] *= max(0.0, 1.0 + float(coefficients[CLOSURE]))  # d
            forcing = forcing_of(self.channel, body)
        grid = ClosedGrid(
            box,
            cells=cells,
            no_slip=bool(walls.any()),
            hyperviscosity=hyperviscosity,
            forcing=forcing,
        )

        frames = given.position[given.sample == window].double().numpy()
        before = frames[:, -2]
        position = frames[:, -1]
        last_frame = given.frames - 1
        step = box.displacement(before, position)
        if box.is_periodic:
            middle = box.inside(position - step / 2.0)
        else:
            middle = (position + before) / 2
        flow = ProjectedFlow(
            grid=grid,
            viscosity=max(viscosity, 0.0),
            walls=walls,
            forces=read(given.body_force),
            obstacle=obstacle,
            field=[],
            position=position,
            frame=last_frame,
        )
        field = grid.from_particles(
            middle, step / interval, wall_velocity=flow.wall_velocity(last_frame)
        )
        flow = replace(flow, field=field)
        # The velocities of the last step hold half a frame before its end.
        field = flow.later_field(frame=last_frame, duration=0.5 * interval)
        return replace(flow, field=field)

    def advance(self, state: list[ProjectedFlow]) -> tuple[list[ProjectedFlow], Tensor]:
        """Return the next state and positions [length], shape [particle, axis]."""
        interval = self.info.frame_interval
        flows = []
        for flow in state:
            frame = flow.frame + 1
            field = flow.later_field(frame=frame, duration=interval)
            later = replace(flow, field=field, frame=frame)
            if later.is_finite:
                position = flow.grid.carry(
                    flow.position,
                    before=flow.field,
                    after=field,
                    duration=interval,
                    wall_velocity=flow.wall_velocity(frame),
                )
                if flow.obstacle is not None and flow.grid.forcing is not None:
                    position = flow.grid.box.inside(position)
                    position = keep_outside(position, flow.obstacle)
            else:
                position = np.full_like(flow.position, np.nan)
            flows.append(replace(later, position=position))
        positions = np.concatenate([flow.position for flow in flows])
        return flows, torch.from_numpy(positions).float()
