"""Weakly compressible flow in a full box: two or three axes, walled or periodic.

Equations and the bounds within which they hold stand in :mod:`.nodal_stress`, the
rules of walls and periodic axes in :mod:`.box_tables`.
"""

from collections.abc import Sequence

import numpy as np

from lagbench.data.box import AXES, WALL_NAMES
from lagbench.errors import UsageError

from .box_tables import LANES, Singles
from .driver import Driver, check_no_friction, check_program
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
        viscosities = [state.viscosity for state in states]
        viscosity = np.array(viscosities)
        timed_viscosity = viscosity * p.dt
        cells_square = p.grid**2
        diffusion_number = timed_viscosity * cells_square
        rounded_number = diffusion_number.astype(np.float32)
        kernels.diffusion_number.from_numpy(rounded_number)
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
        is_periodic = box.periodic
        start = np.asarray(box.low, np.float32)
        end = np.asarray(box.high, np.float32)
        exact = box.wrap(position)
        wrapped = exact.astype(np.float32)
        # Rounding to float32 may reach the end of a period, which is its start.
        is_at_end = wrapped >= end
        is_rounded_up = is_at_end & is_periodic
        wrapped = np.where(is_rounded_up, start, wrapped)
        clipped = super()._inside(wrapped)
        return np.where(is_periodic, wrapped, clipped)

    def _fixed_positions(self, states: Sequence[InitialState]) -> Singles:
        """Return the positions of the obstacles' particles, filled up with zeros."""
        scenarios = len(states)
        particles = self.parameters.obstacle_particles
        shape = (scenarios, particles, LANES)
        position = np.zeros(shape, np.float32)
        for index, state in enumerate(states):
            obstacle = state.obstacle
            if obstacle is not None:
                rows = position[index]
                rows[:, : self.dimension] = obstacle.position
        return position

    def move_walls(self, velocity: Singles) -> None:
        """Let walls slide [length/s], shape [scenario, 2 axis, axis]; with a program,
        up to its next frame.
        """
        self._kernels.move_walls(velocity)

    def _drive_towards(self, frame: int) -> None:
        """Set walls and forces as they act up to a frame."""
        kernels = self._kernels
        walls = [state.walls_towards(frame) for state in self._states]
        exact_velocity = np.stack(walls)
        self.move_walls(exact_velocity.astype(np.float32))
        if self.parameters.force_layers:
            forces = [state.force_towards(frame) for state in self._states]
            exact_force = np.stack(forces)
            body_force = exact_force.astype(np.float32)
            kernels.apply_force(body_force)

    def _drive(self, end: int) -> int:
        if not any(_has_program(state) for state in self._states):
            return end
        interval = self.parameters.substeps_per_frame
        frame, past = divmod(self._substeps, interval)
        next_frame = frame + 1
        if past == 0:
            self._drive_towards(next_frame)
        end_of_frame = next_frame * interval
        return min(end, end_of_frame)

    def jacobian(self) -> Singles:
        """Volume ratio J of the fluid's particles [1], shape [scenario, particle]."""
        particles = self.parameters.particles
        state = self._kernels.particle_state.to_numpy()
        fluid = state[:, :particles]
        jacobian = fluid[..., 3]
        return np.asarray(jacobian)

    def grid_velocity(self) -> Singles:
        """Nodal velocities of the last substep [length/s].

        The shape is [scenario, *cells, axis]; a node is the middle of its cell.
        """
        kernels = self._kernels
        nodes = kernels.tables.shape
        state = kernels.next_state.to_numpy()
        values = state.reshape(self.scenarios, *nodes, -1)
        without_ghosts = slice(1, -1)
        places = [slice(None)]
        for _ in nodes:
            places.append(without_ghosts)
        interior = values[tuple(places)]
        velocity = interior[..., : self.dimension]
        return np.asarray(velocity)

    def health(self) -> list[Health]:
        """Return what each scenario went through during the last advance.

        Before the first one these are the extremes of the loaded state.
        """
        kernels = self._kernels
        # largest velocity of any particle by component, and J, shape [scenario, 4]
        particle_extremes = self._read(kernels.extremes)
        extremes = particle_extremes.max(axis=1)
        # the fields of positions hold the largest -J of each particle
        positions = self._read(kernels.x)
        minus_jacobians = positions[..., 3]
        lowest = minus_jacobians.max(axis=1)
        # largest velocity component of any node, shape [scenario]
        node_peaks = kernels.peak_speed.to_numpy()
        peaks = node_peaks.max(axis=1)
        healths = []
        for extreme, low, peak in zip(extremes, lowest, peaks, strict=True):
            *speeds, jacobian = extreme
            numbers = [*extreme, low, peak]
            is_finite = np.isfinite(numbers)
            all_speeds = [*speeds, peak]
            max_speed = np.max(all_speeds)
            jacobian_min = -low
            health = Health(
                finite=bool(is_finite.all()),
                max_speed=float(max_speed),
                jacobian_min=float(jacobian_min),
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
        dimension = self.dimension
        cfl_bound = self._kernels.speed_bound
        speed_bound = cfl_bound / 2.0
        wall_count = 2 * dimension
        shape = (wall_count, dimension)
        where = f"scenario {index}, wall_velocity"
        velocity = state.wall_velocity
        check_program(velocity, shape, where=where, has_one_row=True)
        speeds = np.abs(velocity)
        wall = np.arange(wall_count)
        normal = wall // 2
        is_periodic = np.repeat(p.box.periodic, 2)
        may_move = np.full(shape, p.no_slip)
        may_move[wall, normal] = False  # a wall does not move along its normal
        may_move[is_periodic] = False
        is_slow = speeds <= speed_bound
        moves_well = may_move & is_slow
        is_at_rest = speeds == 0.0
        is_allowed = is_at_rest | moves_well
        if not is_allowed.all():
            refused = np.argwhere(~is_allowed)
            first = tuple(refused[0])
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
        body_force = state.body_force
        if body_force is None and layer_count == 0:
            return
        where = f"scenario {index}, body_force"
        row_shape = (layer_count, self.dimension)
        check_program(body_force, row_shape, where=where)

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
        radius = obstacle.radius
        centre = np.asarray(obstacle.centre)
        position = np.asarray(obstacle.position)
        if centre.shape != axes or position.shape[1:] != axes:
            expected = f"centre of {self.dimension} axes, positions [particle, axis]"
            got = f"centre of shape {centre.shape}, positions of shape {position.shape}"
            return expected, got
        if not radius > 0.0:
            return "a radius above 0", f"radius {radius:g}"
        gap = LEAST_GAP / self.parameters.grid
        reach = radius + gap
        low_end = centre - reach
        high_end = centre + reach
        is_clear_below = low_end >= box.low
        is_clear_above = high_end <= box.high
        is_clear = is_clear_below & is_clear_above
        if not is_clear.all():
            expected = f"a centre {reach:g} or more from all faces of the box"
            return expected, f"centre {obstacle.centre}"
        is_finite = np.isfinite(position)
        if not is_finite.all():
            return "finite positions", "NaN or infinity"
        is_own = is_inside(position, obstacle.centre, radius)
        if not is_own.all():
            expected = f"particles less than {radius:g} from the centre"
            return expected, "some farther away"
        return None

    def _check_stream(self, index: int, state: InitialState) -> None:
        """Refuse a stream where no fringe is, a fringe without one, or a fast one."""
        fringe_rate = self.parameters.fringe_rate
        if state.stream is None and not fringe_rate:
            return
        if not fringe_rate:
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
        has_axes = stream.shape == (self.dimension,)
        is_numeric = stream.dtype.kind in "fiu"
        is_valid = False
        if has_axes and is_numeric:
            speeds = np.abs(stream)
            max_speed = float(speeds.max())
            is_valid = max_speed <= speed_bound
        if not is_valid:
            what = "the stream is no possible velocity"
            if state.stream is None:
                what = "a fringe needs a stream"
            raise UsageError(
                what,
                where=f"scenario {index}, stream",
                expected=f"a velocity of {self.dimension} components up to dx/dt = "
                f"{speed_bound:.6g}",
                got=state.stream,
                fix="correct what initial_state returns: docs/extending.md",
            )


def _obstacles_of(states: Sequence[InitialState]) -> list[Obstacle]:
    """Return the obstacles of states that all have one."""
    obstacles = []
    for state in states:
        obstacle = state.obstacle
        if obstacle is not None:
            obstacles.append(obstacle)
    return obstacles


def _streams_of(states: Sequence[InitialState]) -> Singles:
    """Return the streams of states that all have one, shape [scenario, axis]."""
    streams = []
    for state in states:
        stream = state.stream
        if stream is not None:
            streams.append(stream)
    exact = np.stack(streams)
    return exact.astype(np.float32)


def _has_program(state: InitialState) -> bool:
    """Tell whether walls or forces change from frame to frame."""
    has_wall_program = state.wall_velocity.ndim == 3
    has_force = state.body_force is not None
    return has_wall_program or has_force
