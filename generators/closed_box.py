"""Weakly compressible flow in a full box: cavity and curl noise (design 4.3).

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

from .driver import Driver
from .nodal_stress import JACOBIAN_BOUND, NodalStress
from .solver import Health
from .split import ClosedBoxParameters, InitialState


class ClosedBox(Driver[ClosedBoxParameters]):
    """Solver for scenarios that share :class:`ClosedBoxParameters`; see
    :class:`.Solver`.
    """

    _kernels: NodalStress

    def _compile(self, atomic: bool, threads: int) -> NodalStress:
        return NodalStress(
            self.parameters, scenarios=self.scenarios, atomic=atomic, threads=threads
        )

    def _start(self, states: Sequence[InitialState]) -> None:
        p = self.parameters
        k = self._kernels
        self._states = list(states)
        self._move_walls_towards(0)
        spread = np.array([state.viscosity for state in states]) * p.dt * p.grid**2
        k.spread.from_numpy(spread.astype(np.float32))
        for field in (k.node, k.moved, k.gain):
            field.fill(0.0)
        k.total.fill(0.0)
        self._averaged = 0

    def move_walls(self, velocity: NDArray[np.float32]) -> None:
        """Let walls slide [length/s], shape [scenario, 4, 2]; with a program, up to its
        next frame.
        """
        self._kernels.walls.speed.from_numpy(velocity[:, (0, 1, 2, 3), (1, 1, 0, 0)])

    def _move_walls_towards(self, frame: int) -> None:
        self.move_walls(
            np.stack([state.walls_towards(frame) for state in self._states]).astype(
                np.float32
            )
        )

    def _drive(self, end: int) -> int:
        if all(state.wall_velocity.ndim == 2 for state in self._states):
            return end
        frame, past = divmod(self._substeps, self.parameters.substeps_per_frame)
        if past == 0:
            self._move_walls_towards(frame + 1)
        return min(end, (frame + 1) * self.parameters.substeps_per_frame)

    def advance(self, substeps: int, *, average: bool = False) -> None:
        """Advance every scenario."""
        self._kernels.averaging = average
        self._averaged += substeps if average else 0
        super().advance(substeps)

    def jacobian(self) -> NDArray[np.float32]:
        """Volume ratio J of the particles [1], shape [scenario, particle]."""
        return np.asarray(self._kernels.carried.to_numpy()[:, :, 3])

    def grid_velocity(self) -> NDArray[np.float32]:
        """Nodal velocities of the last substep [length/s], shape [scenario, node_x,
        node_y, 2].

        Node (i, j) lies at (i, j) / grid; nodes beyond the ghost layer hold 0.
        """
        return self._on_grid(self._kernels.moved.to_numpy()[..., :2])

    def mean_grid_velocity(self) -> NDArray[np.float64]:
        """Mean nodal velocity of the substeps advanced with ``average=True``; shape as
        above.
        """
        return self._on_grid(self._kernels.total.to_numpy()) / max(self._averaged, 1)

    def _on_grid(self, values: NDArray[Any]) -> NDArray[Any]:
        width = self.parameters.grid + 1
        return values.reshape(self.scenarios, width, width, 2)

    def health(self) -> list[Health]:
        """Return what each scenario went through during the last advance."""
        extremes = self._read(self._kernels.extremes).max(axis=1)
        peak = self._kernels.peak.to_numpy().max(axis=1)
        return [
            Health(
                finite=bool(np.isfinite(most).all() and np.isfinite(nodal)),
                max_speed=float(np.max([most[0], most[1], nodal])),
                jacobian_min=float(-most[3]),
                jacobian_max=float(most[2]),
            )
            for most, nodal in zip(extremes, peak, strict=True)
        ]

    def close(self) -> None:
        """Give the memory back, for good; kernels of other solvers in this process
        compile again.
        """
        self._kernels.release()

    def _broken(self, index: int, health: Health) -> dict[str, str]:
        bounds = {
            "J > 0": (health.jacobian_min <= 0.0, health.jacobian_min),
            f"J <= {JACOBIAN_BOUND:g}": (
                health.jacobian_max > JACOBIAN_BOUND,
                health.jacobian_max,
            ),
        }
        return {
            name: f"J = {value:.6g}" for name, (left, value) in bounds.items() if left
        }

    def _check_state(self, index: int, state: InitialState) -> None:
        super()._check_state(index, state)
        fastest = self._kernels.speed_bound / 2.0
        normal = state.wall_velocity[..., (0, 1, 2, 3), (0, 0, 1, 1)]
        sliding = bool(np.any(state.wall_velocity != 0.0))
        steady = bool(np.all(np.abs(state.wall_velocity) <= fastest))
        if (
            np.any(normal != 0.0)
            or not steady
            or (sliding and not self.parameters.no_slip)
        ):
            raise UsageError(
                "walls can only slide along themselves, and only no-slip walls "
                "can move",
                where=f"scenario {index}, wall_velocity in the order "
                f"{', '.join(WALLS)}",
                expected=f"speeds up to dx/(2 dt) = {fastest:.6g}",
                got=f"speeds up to "
                f"{np.abs(state.wall_velocity).reshape(-1, 4, 2).max(axis=0).tolist()}",
            )
