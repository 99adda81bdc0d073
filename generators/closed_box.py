"""Weakly compressible flow in a full box: cavity and curl noise.

Equations, walls and the bounds within which they hold stand in :mod:`.nodal_stress`.
The settings of the split ``cavity`` reproduce Ghia, Ghia & Shin (1982) at Re 100 and
400.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagbench.data import WALLS
from lagbench.errors import UsageError

from .driver import Driver, check_no_friction, check_program, check_undriven
from .nodal_stress import NodalStress, broken_jacobian_bounds
from .solver import Health, Singles
from .split import ClosedBoxParameters, InitialState

# left and right face along x, bottom and top along y
_WALL_NUMBERS = (0, 1, 2, 3)
_NORMAL_AXES = (0, 0, 1, 1)
_TANGENT_AXES = (1, 1, 0, 0)


class ClosedBox(Driver[ClosedBoxParameters]):
    """Solver of a full box; its methods are those of :class:`.Solver`."""

    _kernels: NodalStress

    def _compile(self, atomic: bool, threads: int) -> NodalStress:
        return NodalStress(
            self.parameters, scenarios=self.scenarios, atomic=atomic, threads=threads
        )

    def _start(self, states: Sequence[InitialState]) -> None:
        p = self.parameters
        kernels = self._kernels
        self._states = list(states)
        self._move_walls_towards(0)
        # nu dt / dx^2, shape [scenario]
        viscosities = [state.viscosity for state in states]
        viscosity = np.array(viscosities)
        timed_viscosity = viscosity * p.dt
        cells_square = p.grid**2
        diffusion_number = timed_viscosity * cells_square
        rounded_number = diffusion_number.astype(np.float32)
        kernels.diffusion_number.from_numpy(rounded_number)
        for field in (
            kernels.node_state,
            kernels.next_state,
            kernels.node_gain,
            kernels.velocity_sum,
        ):
            field.fill(0.0)
        self._averaged = 0  # substeps that the sums of velocities hold

    def move_walls(self, velocity: Singles) -> None:
        """Let walls slide [length/s], shape [scenario, 4, 2]; with a program, up to its
        next frame.
        """
        walls = self._kernels.walls
        tangential = velocity[:, _WALL_NUMBERS, _TANGENT_AXES]
        walls.speed.from_numpy(tangential)

    def _move_walls_towards(self, frame: int) -> None:
        velocities = [state.walls_towards(frame) for state in self._states]
        exact_velocity = np.stack(velocities)
        velocity = exact_velocity.astype(np.float32)
        self.move_walls(velocity)

    def _drive(self, end: int) -> int:
        if not any(_has_program(state) for state in self._states):
            return end
        interval = self.parameters.substeps_per_frame
        frame, past = divmod(self._substeps, interval)
        next_frame = frame + 1
        if past == 0:
            self._move_walls_towards(next_frame)
        end_of_frame = next_frame * interval
        return min(end, end_of_frame)

    def advance(self, substeps: int, *, average: bool = False) -> None:
        """Advance every scenario."""
        self._kernels.averaging = average
        if average:
            self._averaged += substeps
        super().advance(substeps)

    def jacobian(self) -> Singles:
        """Volume ratio J of the particles [1], shape [scenario, particle]."""
        state = self._kernels.particle_state.to_numpy()
        jacobian = state[:, :, 3]
        return np.asarray(jacobian)

    def grid_velocity(self) -> Singles:
        """Nodal velocities of the last substep [length/s], shape [scenario, node_x,
        node_y, 2].

        Node (i, j) lies at (i, j) / grid; nodes beyond the ghost layer hold 0.
        """
        state = self._kernels.next_state.to_numpy()
        velocity = state[..., :2]
        return self._on_grid(velocity)

    def mean_grid_velocity(self) -> NDArray[np.float64]:
        """Mean nodal velocity of the substeps advanced with ``average=True``; shape as
        above.
        """
        velocity_sum = self._kernels.velocity_sum.to_numpy()
        total = self._on_grid(velocity_sum)
        count = max(self._averaged, 1)
        return total / count

    def _on_grid(self, values: NDArray[Any]) -> NDArray[Any]:
        width = self.parameters.grid + 1
        shape = (self.scenarios, width, width, 2)
        return values.reshape(shape)

    def health(self) -> list[Health]:
        """Return what each scenario went through during the last advance.

        Before the first one these are the extremes of the loaded state.
        """
        kernels = self._kernels
        # largest abs(v_x), abs(v_y), J and -J of any particle, shape [scenario, 4]
        particle_extremes = self._read(kernels.extremes)
        extremes = particle_extremes.max(axis=1)
        # largest velocity component of any node, shape [scenario]
        node_peaks = kernels.peak_speed.to_numpy()
        peaks = node_peaks.max(axis=1)
        healths = []
        for extreme, peak in zip(extremes, peaks, strict=True):
            u, v, jacobian, minus_jacobian = extreme
            numbers = [*extreme, peak]
            is_finite = np.isfinite(numbers)
            speeds = [u, v, peak]
            max_speed = np.max(speeds)
            jacobian_min = -minus_jacobian
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
        check_undriven(index, state)
        check_no_friction(index, state)
        velocity = state.wall_velocity
        where = f"scenario {index}, wall_velocity"
        check_program(velocity, (4, 2), where=where, has_one_row=True)
        cfl_bound = self._kernels.speed_bound
        speed_bound = cfl_bound / 2.0
        speeds = np.abs(velocity)
        is_slow = speeds <= speed_bound
        is_slow_enough = is_slow.all()
        normal = velocity[..., _WALL_NUMBERS, _NORMAL_AXES]
        has_normal_motion = normal.any()
        is_sliding = speeds.any()
        may_slide = self.parameters.no_slip or not is_sliding
        if has_normal_motion or not is_slow_enough or not may_slide:
            by_frame = speeds.reshape(-1, 4, 2)
            largest_speeds = by_frame.max(axis=0)
            order = ", ".join(WALLS)
            raise UsageError(
                "walls can only slide along themselves, and only no-slip walls "
                "can move",
                where=f"{where} in the order {order}",
                expected=f"speeds up to dx/(2 dt) = {speed_bound:.6g}",
                got=f"speeds up to {largest_speeds.tolist()}",
                fix="correct what initial_state returns: docs/extending.md",
            )


def _has_program(state: InitialState) -> bool:
    """Tell whether walls change from frame to frame."""
    return state.wall_velocity.ndim != 2
