"""Weakly compressible flow in a full box: two or three axes, walled or periodic.

Equations and the bounds within which they hold stand in :mod:`.nodal_stress_nd`, the
rules of walls and periodic axes in :mod:`.box_tables`.
"""

from collections.abc import Sequence

import numpy as np

from lagbench.data.box import AXES, WALL_NAMES
from lagbench.errors import UsageError

from .box_tables import LANES, Singles
from .driver import Driver, check_no_friction, check_program
from .full_box_parameters import FullBoxParameters
from .nodal_stress import broken_jacobian_bounds
from .nodal_stress_nd import NodalStressND
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

    _kernels: NodalStressND

    def _compile(self, atomic: bool, threads: int) -> NodalStressND:
        return NodalStressND(
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
        viscosities = [state.viscosity for state in states]
        viscosity = np.array(viscosities)
        diffusion_number = viscosity * p.dt * p.grid**2
        kernels.diffusion_number.from_numpy(diffusion_number.astype(np.float32))
        if p.obstacle_particles:
            obstacles = _obstacles_of(states)
            kernels.place_obstacles(obstacles)
        if p.fringe_rate:
            streams = _streams_of(states)
            kernels.set_stream(streams)
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
        start = np.asarray(box.low, np.float32)
        end = np.asarray(box.high, np.float32)
        wrapped = box.wrap(position).astype(np.float32)
        # Rounding to float32 may reach the end of a period, which is its start.
        is_at_end = wrapped >= end
        is_rounded_up = is_at_end & box.periodic
        wrapped = np.where(is_rounded_up, start, wrapped)
        clipped = super()._inside(wrapped)
        return np.where(box.periodic, wrapped, clipped)

    def _fixed_positions(self, states: Sequence[InitialState]) -> Singles:
        """Return the positions of the obstacles' particles, filled up with zeros."""
        shape = (len(states), self.parameters.obstacle_particles, LANES)
        position = np.zeros(shape, np.float32)
        for rows, state in zip(position, states, strict=True):
            if state.obstacle is not None:
                rows[:, : self.dimension] = state.obstacle.position
        return position

    def _drive_towards(self, frame: int) -> None:
        """Set walls and forces as they act up to a frame."""
        walls = [state.walls_towards(frame) for state in self._states]
        wall_velocity = np.stack(walls)
        self._kernels.move_walls(wall_velocity.astype(np.float32))
        if self.parameters.force_layers:
            forces = [state.force_towards(frame) for state in self._states]
            body_force = np.stack(forces)
            self._kernels.apply_force(body_force.astype(np.float32))

    def _drive(self, end: int) -> int:
        if not any(_has_program(state) for state in self._states):
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
        fluid = state[:, : self.parameters.particles]
        return np.asarray(fluid[..., 3])

    def grid_velocity(self) -> Singles:
        """Nodal velocities of the last substep [length/s].

        The shape is [scenario, *cells, axis]; a node is the middle of its cell.
        """
        nodes = self._kernels.tables.shape
        state = self._kernels.next_state.to_numpy()
        values = state.reshape(self.scenarios, *nodes, -1)
        without_ghosts = slice(1, -1)
        places = [slice(None)]
        for _ in nodes:
            places.append(without_ghosts)
        interior = values[tuple(places)]
        return np.asarray(interior[..., : self.dimension])

    def health(self) -> list[Health]:
        """Return what each scenario went through during the last advance.

        Before the first one these are the extremes of the loaded state.
        """
        # largest velocity of any particle by component, and J, shape [scenario, 4]
        particle_extremes = self._read(self._kernels.extremes)
        extremes = particle_extremes.max(axis=1)
        # the fields of positions hold the largest -J of each particle
        positions = self._read(self._kernels.x)
        lowest = positions[..., 3].max(axis=1)
        # largest velocity component of any node, shape [scenario]
        node_peaks = self._kernels.peak_speed.to_numpy()
        peaks = node_peaks.max(axis=1)
        healths = []
        for extreme, low, peak in zip(extremes, lowest, peaks, strict=True):
            *speeds, jacobian = extreme
            is_finite = np.isfinite([*extreme, low, peak])
            max_speed = np.max([*speeds, peak])
            health = Health(
                finite=bool(is_finite.all()),
                max_speed=float(max_speed),
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
        check_no_friction(index, state)
        self._check_obstacle(index, state)
        self._check_walls(index, state)
        self._check_force(index, state)
        self._check_stream(index, state)

    def _check_walls(self, index: int, state: InitialState) -> None:
        """Refuse walls that move as no wall of this box can."""
        p = self.parameters
        speed_bound = self._kernels.speed_bound / 2.0
        wall_count = 2 * self.dimension
        shape = (wall_count, self.dimension)
        where = f"scenario {index}, wall_velocity"
        check_program(state.wall_velocity, shape, where=where, has_one_row=True)
        speeds = np.abs(state.wall_velocity)
        wall = np.arange(wall_count)
        normal = wall // 2
        is_periodic = np.repeat(p.box.periodic, 2)
        may_move = np.full(shape, p.no_slip)
        may_move[wall, normal] = False  # a wall does not move along its normal
        may_move[is_periodic] = False
        moves_well = may_move & (speeds <= speed_bound)
        is_allowed = (speeds == 0.0) | moves_well
        if not is_allowed.all():
            first = tuple(np.argwhere(~is_allowed)[0])
            wall_number, axis = first[-2:]
            raise UsageError(
                "walls can only slide along themselves, and only no-slip walls "
                "can move",
                where=where,
                expected=f"speeds up to dx/(2 dt) = {speed_bound:.6g} along no-slip "
                "walls, zeros across walls and along periodic axes",
                got=f"speed {speeds[first]:.6g} of wall {WALL_NAMES[wall_number]} "
                f"along {AXES[axis]}",
                fix="correct what initial_state returns: docs/extending.md",
            )

    def _check_force(self, index: int, state: InitialState) -> None:
        """Refuse a body force of other layers than the solver has."""
        layer_count = self.parameters.force_layers
        if state.body_force is None and layer_count == 0:
            return
        where = f"scenario {index}, body_force"
        check_program(state.body_force, (layer_count, self.dimension), where=where)

    def _check_obstacle(self, index: int, state: InitialState) -> None:
        """Refuse an obstacle whose number of particles is not the solver's."""
        count = self.parameters.obstacle_particles
        particle_count = 0
        if state.obstacle is not None:
            self._check_place(index, state.obstacle)
            particle_count = len(state.obstacle.position)
        if particle_count != count:
            raise UsageError(
                "the obstacle does not fit the solver",
                where=f"scenario {index}, obstacle",
                expected=f"{count} particles",
                got=f"{particle_count} particles",
                fix="correct what initial_state returns: docs/extending.md",
            )

    def _check_place(self, index: int, obstacle: Obstacle) -> None:
        """Refuse an obstacle that does not fit the box."""
        misfit = self._find_misfit(obstacle)
        if misfit is None:
            return
        expected, got = misfit
        raise UsageError(
            "the obstacle does not fit the box",
            where=f"scenario {index}, obstacle",
            expected=expected,
            got=got,
            fix="correct what initial_state returns: docs/extending.md",
        )

    def _find_misfit(self, obstacle: Obstacle) -> tuple[str, str] | None:
        """Return what is expected of an obstacle and what it has; None where it fits.

        It has the axes of the box and a radius above 0, keeps a gap from all faces of
        the box, and no particle lies outside its own radius. Distances to the obstacle
        are not taken across periodic faces, and its particles index nodes without a
        check.
        """
        box = self.parameters.box
        axes = (self.dimension,)
        centre = np.asarray(obstacle.centre)
        position = np.asarray(obstacle.position)
        if centre.shape != axes or position.shape[1:] != axes:
            expected = f"centre of {self.dimension} axes, positions [particle, axis]"
            got = f"centre of shape {centre.shape}, positions of shape {position.shape}"
            return expected, got
        if not obstacle.radius > 0.0:
            return "a radius above 0", f"radius {obstacle.radius:g}"
        reach = obstacle.radius + LEAST_GAP / self.parameters.grid
        is_clear_below = centre - reach >= box.low
        is_clear_above = centre + reach <= box.high
        is_clear = is_clear_below & is_clear_above
        if not is_clear.all():
            expected = f"a centre {reach:g} or more from all faces of the box"
            return expected, f"centre {obstacle.centre}"
        if not np.isfinite(position).all():
            return "finite positions", "NaN or infinity"
        if not is_inside(position, obstacle.centre, obstacle.radius).all():
            expected = f"particles less than {obstacle.radius:g} from the centre"
            return expected, "some farther away"
        return None

    def _check_stream(self, index: int, state: InitialState) -> None:
        """Refuse a stream where no fringe is, a fringe without one, or a fast one."""
        if state.stream is None and not self.parameters.fringe_rate:
            return
        if not self.parameters.fringe_rate:
            raise UsageError(
                "a stream needs a fringe",
                where=f"scenario {index}, stream; parameter fringe_rate of the split",
                expected="a fringe_rate above 0, or no stream",
                got=f"fringe_rate 0, and the stream {state.stream}",
                fix="declare fringe_rate and fringe_length under parameters of the "
                "split, or let initial_state return no stream",
            )
        speed_bound = self._kernels.speed_bound
        stream = np.asarray(state.stream)
        is_velocity = stream.shape == (self.dimension,) and stream.dtype.kind in "fiu"
        if not is_velocity or float(np.abs(stream).max()) > speed_bound:
            raise UsageError(
                "a fringe needs a stream",
                where=f"scenario {index}, stream",
                expected=f"a velocity of {self.dimension} components up to dx/dt = "
                f"{speed_bound:.6g}",
                got=state.stream,
                fix="correct what initial_state returns: docs/extending.md",
            )


def _obstacles_of(states: Sequence[InitialState]) -> list[Obstacle]:
    """Return the obstacles of states that all have one."""
    return [state.obstacle for state in states if state.obstacle is not None]


def _streams_of(states: Sequence[InitialState]) -> Singles:
    """Return the streams of states that all have one, shape [scenario, axis]."""
    streams = [state.stream for state in states if state.stream is not None]
    return np.stack(streams).astype(np.float32)


def _has_program(state: InitialState) -> bool:
    """Tell whether walls or forces change from frame to frame."""
    return state.wall_velocity.ndim == 3 or state.body_force is not None
