"""Weakly compressible flow in a full box: cavity and curl noise (design 4.3).

The equations stand in :mod:`.nodal_stress`. The walls lie half-way between nodes, at
``(wall + 1/2) / grid`` and its mirror image, and hold the fluid or let it slide.

Valid while max abs(v) dt <= dx, which also bounds every fixed-point sum, and while J stays in
(0, 8]. The settings of the split ``cavity`` reproduce Ghia, Ghia & Shin (1982) at Re 100 and 400.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lagbench.errors import UsageError, WorkFailedError

from . import backend
from .base import WALLS, ClosedBoxParameters, InitialState
from .nodal_stress import JACOBIAN_BOUND, NodalStress
from .solver import Device, Health

__all__ = ["ClosedBox"]


class ClosedBox:
    """Solver for scenarios that share :class:`ClosedBoxParameters`; see :class:`.Solver`.

    Args:
        parameters: constants that the scenarios share.
        device: where to run.
        scenarios: scenarios advanced together.
        threads: threads of ``Device.PARALLEL``; all that the process may use by default.
    """

    def __init__(
        self,
        parameters: ClosedBoxParameters,
        *,
        device: Device = Device.CPU,
        scenarios: int = 1,
        threads: int | None = None,
    ) -> None:
        """Start Taichi and take the memory; kernels compile when they first run."""
        self.parameters = parameters
        self.device = device
        self.scenarios = scenarios
        threads = backend.start(device, scenarios=scenarios, threads=threads)
        self._substep = NodalStress(
            parameters, scenarios=scenarios, atomic=device is not Device.CPU, threads=threads
        )
        self._substeps = 0
        self._averaged = 0

    def load(self, states: Sequence[InitialState]) -> None:
        """Start one scenario per state.

        Raises:
            UsageError: another number of states or particles than the solver was built for, or
                walls that move towards the fluid or without holding it.
            WorkFailedError: a state outside the bounds within which the solver is valid.
        """
        if len(states) != self.scenarios:
            raise UsageError("wrong number of scenarios", expected=self.scenarios, got=len(states))
        for index, state in enumerate(states):
            self._check_state(index, state)
        self._substep.x.from_numpy(self._kept(_stack(states, "position")))
        carried = np.ones((self.scenarios, self.parameters.particles, 4), np.float32)
        carried[:, :, :2] = _stack(states, "velocity")
        self._substep.carried.from_numpy(carried)
        for axis, field in enumerate((self._substep.slope_x, self._substep.slope_y)):
            slope = np.zeros_like(carried)
            slope[:, :, :2] = _stack(states, "affine")[:, :, :, axis]
            field.from_numpy(slope)
        self.move_walls(_stack(states, "wall_velocity"))
        p = self.parameters
        cells = np.array([state.area / p.particles for state in states]) * p.grid**2
        self._substep.fill.from_numpy(cells.astype(np.float32))
        spread = np.array([state.viscosity for state in states]) * p.dt * p.grid**2
        self._substep.spread.from_numpy(spread.astype(np.float32))
        self._substeps = 0
        for field in (self._substep.node, self._substep.moved, self._substep.gain):
            field.fill(0.0)
        self._substep.restart_extremes()
        self.restart_mean()

    def move_walls(self, velocity: NDArray[np.floating]) -> None:
        """Set the velocities of the walls from now on [length/s], shape [scenario, 4, 2]."""
        tangential = velocity[:, (0, 1, 2, 3), (1, 1, 0, 0)]
        self._substep.walls.speed.from_numpy(tangential.astype(np.float32))

    def advance(self, substeps: int, *, average: bool = False) -> None:
        """Advance every scenario.

        Args:
            substeps: how many.
            average: whether the nodal velocities count for :meth:`mean_grid_velocity`.

        Raises:
            WorkFailedError: a scenario broke the CFL bound or the bounds of J, or is not finite.
        """
        if substeps == 0:
            return
        self._substep.restart_extremes()
        if self.device is Device.CPU:
            self._substep.run_serially(substeps, int(average))
        else:
            for _ in range(substeps):
                self._substep.run_in_parallel()
                if average:
                    self._substep.add_to_mean()
        self._substeps += substeps
        self._averaged += substeps if average else 0
        for index, health in enumerate(self.health()):
            self._check_health(index, health, substeps)

    def position(self) -> NDArray[np.float32]:
        """Particle positions [length], shape [scenario, particle, 2]."""
        return np.asarray(self._substep.x.to_numpy())

    def velocity(self) -> NDArray[np.float32]:
        """Particle velocities v_p [length/s], shape [scenario, particle, 2]."""
        return np.asarray(self._substep.carried.to_numpy()[:, :, :2])

    def jacobian(self) -> NDArray[np.float32]:
        """Volume ratio J of the particles [1], shape [scenario, particle]."""
        return np.asarray(self._substep.carried.to_numpy()[:, :, 3])

    def grid_velocity(self) -> NDArray[np.float32]:
        """Nodal velocities of the last substep [length/s], shape [scenario, node_x, node_y, 2].

        Node (i, j) lies at (i, j) / grid; nodes beyond the ghost layer hold 0.
        """
        return np.asarray(self._substep.moved.to_numpy()[..., :2])

    def mean_grid_velocity(self) -> NDArray[np.float64]:
        """Mean nodal velocity of the substeps advanced with ``average=True``; shape as above."""
        return np.asarray(self._substep.total.to_numpy()) / max(self._averaged, 1)

    def restart_mean(self) -> None:
        """Forget the substeps averaged so far."""
        self._substep.total.fill(0.0)
        self._averaged = 0

    def displace(self, offset: NDArray[np.float32]) -> None:
        """Add an offset to the positions [length], shape [scenario, particle, 2]; kept in the box."""
        self._substep.x.from_numpy(self._kept(self.position() + offset.astype(np.float32)))

    def health(self) -> list[Health]:
        """Return what each scenario went through during the last advance."""
        extremes = self._substep.extremes.to_numpy().max(axis=1)
        peak = self._substep.peak.to_numpy().max(axis=(1, 2))
        return [
            Health(
                finite=bool(np.isfinite(most).all() and np.isfinite(nodal)),
                max_speed=float(np.max([most[0], most[1], nodal])),
                jacobian_min=float(-most[3]),
                jacobian_max=float(most[2]),
            )
            for most, nodal in zip(extremes, peak, strict=True)
        ]

    def _kept(self, position: NDArray[np.float32]) -> NDArray[np.float32]:
        return np.clip(position, np.float32(self._substep.least), np.float32(self._substep.most))

    def _check_state(self, index: int, state: InitialState) -> None:
        shape = (self.parameters.particles, 2)
        if state.position.shape != shape:
            raise UsageError(
                "wrong shape of positions",
                where=f"scenario {index}",
                expected=shape,
                got=state.position.shape,
            )
        normal = state.wall_velocity[(0, 1, 2, 3), (0, 0, 1, 1)]
        if np.any(normal != 0.0) or (not self.parameters.no_slip and np.any(state.wall_velocity != 0.0)):
            raise UsageError(
                "walls can only slide along themselves, and only no-slip walls can move",
                where=f"scenario {index}, wall_velocity in the order {', '.join(WALLS)}",
                got=state.wall_velocity.tolist(),
            )
        speed = np.abs(state.velocity).max()
        stretch = np.abs(state.affine).max() * self.parameters.dt
        if not (np.isfinite(state.position).all() and speed <= self._substep.speed_bound and stretch <= 2.0):
            raise WorkFailedError(
                "the initial state is outside the solver's bounds",
                where=f"scenario {index}",
                expected=f"finite, abs(v) <= dx/dt = {self._substep.speed_bound:.6g}, abs(C) dt <= 2",
                got=f"abs(v) = {speed:.6g}, abs(C) dt = {stretch:.6g}",
            )

    def _check_health(self, index: int, health: Health, substeps: int) -> None:
        fastest = self._substep.speed_bound
        bounds = {
            "every number is finite": health.finite,
            f"CFL: abs(v) <= dx/dt = {fastest:.6g}": health.max_speed <= fastest,
            "J > 0": health.jacobian_min > 0.0,
            f"J <= {JACOBIAN_BOUND:g}": health.jacobian_max <= JACOBIAN_BOUND,
        }
        broken = [name for name, holds in bounds.items() if not holds]
        if broken:
            raise WorkFailedError(
                "the simulation blew up",
                where=f"scenario {index}, substeps {self._substeps - substeps} to {self._substeps}",
                expected="; ".join(broken),
                got=health,
                fix="use a smaller dt or smaller velocities",
            )


def _stack(states: Sequence[InitialState], name: str) -> NDArray[np.float32]:
    return np.stack([getattr(state, name) for state in states]).astype(np.float32)
