"""A liquid with a free surface in three dimensions: fluid-3d.

The equations stand in :mod:`.liquid_stress_3d`. The walls are free-slip and lie on node
``wall`` and its mirror image along each axis; gravity acts along the second one.

The solver is valid while no particle crosses more than a cell per substep along an
axis, max abs(v_i) dt <= dx (checked), and while sound does not either
(:func:`.free_surface.courant`).
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lagbench.errors import UsageError

from .free_surface import Energy, FreeSurfaceDriver
from .liquid_stress_3d import LiquidStress3D
from .split import InitialState, Material


class FreeSurface3D(FreeSurfaceDriver):
    """Solver of a liquid in a cube; its methods are those of :class:`.Solver`."""

    _kernels: LiquidStress3D

    @property
    def dimension(self) -> int:
        """Number of axes."""
        return 3

    def _compile(self, atomic: bool, threads: int) -> LiquidStress3D:
        return LiquidStress3D(
            self.parameters, scenarios=self.scenarios, atomic=atomic, threads=threads
        )

    def _start(self, states: Sequence[InitialState]) -> None:
        shape = (self.scenarios, self.parameters.particles, 2)
        self._kernels.ratio_range.from_numpy(np.ones(shape, np.float32))

    def affine(self) -> NDArray[np.float32]:
        """APIC matrices C = grad v [1/s], shape [scenario, particle, 3, 3]."""
        columns = [field.to_numpy()[..., :3] for field in self._kernels.slopes]
        return np.stack(columns, axis=-1)

    def volume_ratio(self) -> NDArray[np.float32]:
        """J of the liquid [1], shape [scenario, particle]."""
        return self._read(self._kernels.carried)[..., 3]

    def volume_ratio_extremes(
        self,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Smallest and largest J of each particle at any substep since the start [1],
        each of shape [scenario, particle].
        """
        ratio_range = self._kernels.ratio_range.to_numpy()
        return ratio_range[..., 0], ratio_range[..., 1]

    def energy(self) -> Energy:
        """Return the energy of each scenario, in float64 from the particles."""
        p = self.parameters
        mass = p.density * self._volume  # of a particle, shape [scenario]
        height = self.position()[..., 1].astype(np.float64) - self._kernels.least
        velocity_square = (self.velocity().astype(np.float64) ** 2).sum(axis=-1)
        affine_square = (self.affine().astype(np.float64) ** 2).sum(axis=(-2, -1))
        spin = affine_square / (4.0 * p.grid**2)
        ratio = self.volume_ratio().astype(np.float64)
        elastic_density = p.liquid_modulus * (ratio - 1.0 - np.log(ratio))
        return Energy(
            kinetic=0.5 * mass * (velocity_square + spin).sum(axis=-1),
            gravitational=p.gravity * mass * height.sum(axis=-1),
            elastic=self._volume * elastic_density.sum(axis=-1),
        )

    def _check_state(self, index: int, state: InitialState) -> None:
        super()._check_state(index, state)
        has_solids = bool((state.material != Material.LIQUID).any())
        if has_solids or state.friction != 0.0:
            raise UsageError(
                "no such initial state in three dimensions",
                where=f"scenario {index}",
                expected="liquid alone, walls without friction",
                got=f"materials {np.unique(state.material)}, friction "
                f"{state.friction:g}",
                fix="mend the split's initial_state",
            )
