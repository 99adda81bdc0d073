"""Weakly compressible flow in a full box: two or three axes, walled or periodic.

Equations and the bounds within which they hold stand in :mod:`.nodal_stress`, the
rules of walls and periodic axes in :mod:`.box_tables`.
"""

from collections.abc import Sequence

import numpy as np

from lagbench.errors import UsageError

from .box_tables import LANES, Singles
from .driver import Driver, check_program
from .full_box_parameters import FullBoxParameters
from .nodal_stress import NodalStress, broken_jacobian_bounds
from .obstacle import Obstacle, is_inside
from .solver import Health
from .split import InitialState

LEAST_GAP = 1.0
"""Cells of fluid, at least, between an obstacle and the faces of the box."""


class FullBox(Driver[FullBoxParameters]):
    """Solver of a full box; its methods are those of :class:`.Solver`.

    The particles of an obstacle are rows of the kernels' fields behind those of the
    fluid. Nobody else sees them.
    """

    _kernels: NodalStress

    def _compile(self, atomic: bool, threads: int) -> NodalStress:
        return NodalStress(
            self.parameters, scenarios=self.scenarios, atomic=atomic, threads=threads
        )

    @property
    def dimension(self) -> int:
        """Number of axes: 2 or 3."""
        return self.parameters.box.dimension

    def _start(self, states: Sequence[InitialState]) -> None:
        p = self.parameters
        kernels = self._kernels
        self._states = list(states)
        self._drive_towards(0)
        # nu dt / dx^2, shape [scenario]
        viscosities = np.array([state.viscosity for state in states])
        diffusion_number = viscosities * p.dt * p.grid**2
        kernels.diffusion_number.from_numpy(diffusion_number.astype(np.float32))
        if p.obstacle_particles:
            obstacles = [one.obstacle for one in states if one.obstacle is not None]
            kernels.place_obstacles(obstacles)
        if p.fringe_rate:
            streams = np.stack([one.stream for one in states if one.stream is not None])
            kernels.set_stream(streams.astype(np.float32))
        for field in (
            kernels.drag,
            kernels.node_state,
            kernels.next_state,
            kernels.node_gain,
        ):
            field.fill(0.0)

    def _inside(self, position: Singles) -> Singles:
        """Return positions between the walls, wrapped along periodic axes [length]."""
        box = self.parameters.box
        is_periodic = box.periodic
        start = np.asarray(box.low, np.float32)
        end = np.asarray(box.high, np.float32)
        wrapped = box.wrap(position).astype(np.float32)
        # Rounding to float32 may reach the end of a period, which is its start.
        wrapped = np.where((wrapped >= end) & is_periodic, start, wrapped)
        clipped = super()._inside(wrapped)
        return np.where(is_periodic, wrapped, clipped)

    def _fixed_positions(self, states: Sequence[InitialState]) -> Singles:
        """Return the positions of the obstacles' particles, filled up with zeros."""
        shape = (len(states), self.parameters.obstacle_particles, LANES)
        position = np.zeros(shape, np.float32)
        for rows, state in zip(position, states, strict=True):
            if state.obstacle is not None:
                rows[:, : self.dimension] = state.obstacle.position
        return position

    def move_walls(self, velocity: Singles) -> None:
        """Let walls slide [length/s], shape [scenario, 2 axis, axis]; with a program,
        up to its next frame.
        """
        self._kernels.move_walls(velocity)

    def _drive_towards(self, frame: int) -> None:
        """Set walls and forces as they act up to a frame."""
        walls = np.stack([state.walls_towards(frame) for state in self._states])
        self.move_walls(walls.astype(np.float32))
        if self.parameters.force_layers:
            forces = np.stack([state.force_towards(frame) for state in self._states])
            self._kernels.apply_force(forces.astype(np.float32))

    def _drive(self, end: int) -> int:
        is_driven = any(
            state.wall_velocity.ndim == 3 or state.body_force is not None
            for state in self._states
        )
        if not is_driven:
            return end
        interval = self.parameters.substeps_per_frame
        frame, past = divmod(self._substeps, interval)
        next_frame = frame + 1
        if past == 0:
            self._drive_towards(next_frame)
        return min(end, next_frame * interval)

    def jacobian(self) -> Singles:
        """Volume ratio J of the fluid's particles [1], shape [scenario, particle]."""
        state = self._kernels.particle_state.to_numpy()
        return np.asarray(state[:, : self.parameters.particles, 3])

    def grid_velocity(self) -> Singles:
        """Nodal velocities of the last substep [length/s].

        The shape is [scenario, *cells, axis]; a node is the middle of its cell.
        """
        kernels = self._kernels
        nodes = kernels.tables.shape
        values = kernels.next_state.to_numpy().reshape(self.scenarios, *nodes, -1)
        without_ghosts = (slice(1, -1),) * len(nodes)
        interior = values[(slice(None), *without_ghosts)]
        return np.asarray(interior[..., : self.dimension])

    def health(self) -> list[Health]:
        """Return what each scenario went through during the last advance.

        Before the first one these are the extremes of the loaded state.
        """
        kernels = self._kernels
        # largest velocity of any particle by component, and J, shape [scenario, 4]
        extremes = self._read(kernels.extremes).max(axis=1)
        # the fields of positions hold the largest -J of each particle
        lowest = self._read(kernels.x)[..., 3].max(axis=1)
        # largest velocity component of any node, shape [scenario]
        peaks = kernels.peak_speed.to_numpy().max(axis=1)
        healths = []
        for extreme, low, peak in zip(extremes, lowest, peaks, strict=True):
            *speeds, jacobian = extreme
            health = Health(
                finite=bool(np.isfinite([*extreme, low, peak]).all()),
                max_speed=float(np.max([*speeds, peak])),
                jacobian_min=float(-low),
                jacobian_max=float(jacobian),
            )
            healths.append(health)
        return healths

    def close(self) -> None:
        """Give the memory back, for good; kernels of other solvers in this process
        compile again.
        """
        self._kernels.release()

    def _broken_bounds(self, index: int, health: Health) -> dict[str, str]:
        return broken_jacobian_bounds(health.jacobian_min, health.jacobian_max)

    def _check_state(self, index: int, state: InitialState) -> None:
        super()._check_state(index, state)
        p = self.parameters
        box = p.box
        where = self.names[index]
        if state.friction != 0.0:
            raise UsageError(
                "a full box knows no friction; leave it out of the initial state",
                where=f"{where}, friction",
            )

        # Walls slide along themselves, and not faster than half a cell a substep.
        walls = state.wall_velocity
        shape = (2 * self.dimension, self.dimension)
        check_program(walls, shape, where=f"{where}, wall_velocity", has_one_row=True)
        bound = self._kernels.speed_bound
        wall = np.arange(len(box.periodic) * 2)
        may_move = np.full(shape, p.no_slip)
        may_move[wall, wall // 2] = False
        may_move[np.repeat(box.periodic, 2)] = False
        speeds = np.abs(walls)
        if not ((speeds == 0.0) | (may_move & (speeds <= bound / 2.0))).all():
            raise UsageError(
                f"only no-slip walls move, along themselves, up to dx/(2 dt) = "
                f"{bound / 2.0:.6g}; correct wall_velocity of the initial state",
                where=f"{where}, wall_velocity",
            )
        if p.force_layers or state.body_force is not None:
            row = (p.force_layers, self.dimension)
            check_program(state.body_force, row, where=f"{where}, body_force")
        self._check_obstacle(where, state.obstacle)

        stream = np.asarray(0.0 if state.stream is None else state.stream)
        has_stream = stream.shape == (self.dimension,) and np.abs(stream).max() <= bound
        if has_stream != bool(p.fringe_rate) or (
            state.stream is not None and not has_stream
        ):
            raise UsageError(
                f"a fringe needs a stream up to dx/dt = {bound:.6g}, and a stream a "
                "fringe; correct stream of the initial state, or fringe_rate of the "
                "split",
                where=f"{where}, stream",
            )

    def _check_obstacle(self, where: str, obstacle: Obstacle | None) -> None:
        """Refuse an obstacle that does not fit the solver or the box.

        Distances to the obstacle are not taken across periodic faces, and its particles
        index nodes without a check.
        """
        box = self.parameters.box
        count = 0
        is_inside_box = True
        if obstacle is not None:
            count = len(obstacle.position)
            shape = (count, self.dimension)
            reach = obstacle.radius + LEAST_GAP / self.parameters.grid
            centre = np.asarray(obstacle.centre)
            is_inside_box = (
                obstacle.radius > 0.0
                and centre.shape == shape[1:]
                and np.shape(obstacle.position) == shape
                and bool((centre - reach >= box.low).all())
                and bool((centre + reach <= box.high).all())
                and bool(is_inside(obstacle.position, centre, obstacle.radius).all())
            )
        if not is_inside_box or count != self.parameters.obstacle_particles:
            raise UsageError(
                "the obstacle needs obstacle_particles particles within its radius, "
                "and a cell of fluid around it; correct obstacle of the initial state",
                where=f"{where}, obstacle",
            )
