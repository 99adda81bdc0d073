"""Liquid, jelly, snow and rope with a free surface in a cube: fluid-3d and
multimaterial-3d.

The equations stand in :mod:`.particle_stress_3d`, the stresses of solids in
:mod:`.constitutive_3d`. The walls lie on node ``wall`` and its mirror image along each
axis; gravity acts along the second one.

The solver is valid while no particle crosses more than a cell per substep along an
axis, max abs(v_i) dt <= dx (checked), and while sound does not either
(:func:`.free_surface.courant`).
"""

import numpy as np

from .free_surface import FreeSurfaceDriver
from .particle_stress_3d import ParticleStress3D
from .solver import Singles


class FreeSurface3D(FreeSurfaceDriver):
    """Solver of a free surface in a cube; its methods are those of :class:`.Solver`."""

    _kernels: ParticleStress3D

    @property
    def dimension(self) -> int:
        """Number of axes."""
        return 3

    def _compile(self, atomic: bool, threads: int) -> ParticleStress3D:
        return ParticleStress3D(
            self.parameters, scenarios=self.scenarios, atomic=atomic, threads=threads
        )

    def deformation(self) -> Singles:
        """Deformation gradients F, elastic in snow, I in liquid [1], shape [scenario,
        particle, 3, 3].
        """
        columns = []
        for field in self._kernels.deformation_columns:
            column = field.to_numpy()
            columns.append(column[..., :3])
        return np.stack(columns, axis=-1)

    def _set_deformation(self, gradients: Singles) -> None:
        """Fill the fields of the columns of F, whose fourth component is not used."""
        scenarios, particles, _, _ = gradients.shape
        shape = (scenarios, particles, 4)
        for axis, field in enumerate(self._kernels.deformation_columns):
            column = np.zeros(shape, np.float32)
            column[..., :3] = gradients[..., axis]
            field.from_numpy(column)
