"""Strain of bodies since the scenario's first frame, from positions then and now.

    F = dx/dX,   e = (F F^T - 1) / 2

with X the positions in the first frame. A model that carries no stress of its own, as
grids and graphs do not, can tell by it which way elastic bodies push back. F is the
least-squares gradient of the mean displacements at the nodes around X. It is exact for
affine motion up to the edges of a body. A body that is thinner than a cell and turns
far looks strained.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from lagbench.errors import UsageError

from .baseline import Batch
from .particle_grid import ParticleGrid, Stencil

UNIT = 0.2  # strain that looks like 1 [1]; far beyond it all strains look alike
# share of a cell's square that is added to the nodes' spread: it bounds F where the
# nodes lie on a line
SLACK = 1e-3


@dataclass(frozen=True)
class RestShape:
    """The first frame of a batch's scenarios, prepared for the gradient F."""

    grid: ParticleGrid  # where displacements are averaged
    position: Tensor  # X [length], shape [particle, 2]
    stencil: Stencil  # nodes around them
    # sums of the weights at the nodes [1], shape [layer, 1, x node, y node]
    weight_sum: Tensor
    # offsets of the nodes, weighted, times the inverse of their spread [1/length],
    # shape [particle, 9, 2]
    lever: Tensor

    @classmethod
    def build(
        cls,
        grid: ParticleGrid,
        position: Tensor,
        layer: Tensor,
        layers: int,
        *,
        is_solid: Tensor | None = None,
    ) -> RestShape:
        """Return the rest shape of bodies at X [length], shape [particle, 2].

        Bodies that do not mix have layers of their own. ``is_solid``, bool, shape
        [particle], names the particles that show a strain; all of them by default.
        """
        position = grid.box.inside(position)
        stencil = grid.stencil(position, layer)
        one = torch.ones_like(position[:, :1])
        weight_sum = grid.spread(stencil, one, layers)
        weighted_offset = stencil.weight[:, :, None] * grid.offsets(stencil, position)
        identity = torch.eye(2, device=position.device)
        slack = SLACK * grid.spacing**2 * identity

        mean_offset = _relative_means(grid, stencil, weight_sum, position)
        spread = torch.einsum("pnd,pne->pde", mean_offset, weighted_offset)
        inverse_spread = torch.linalg.inv(spread + slack)
        lever = weighted_offset @ inverse_spread
        if is_solid is not None:
            lever = lever * is_solid[:, None, None]
        return cls(grid, position, stencil, weight_sum, lever)

    def strain(self, position: Tensor) -> Tensor:
        """Return the scaled strain tanh(e / UNIT) as (xx, xy, yy), shape [particle, 3].

        The strain e = (F F^T - 1) / 2 is symmetric; F = dx/dX leads from the positions
        X in the first frame to those now.

        Args:
            position: x, the positions now [length], shape [particle, 2].
        """
        displacement = self.grid.box.displacement(self.position, position)
        mean_offset = _relative_means(
            self.grid, self.stencil, self.weight_sum, displacement
        )
        gradient = torch.einsum("pnd,pne->pde", mean_offset, self.lever)  # F - 1
        strain = 0.5 * (gradient + gradient.mT + gradient @ gradient.mT)
        components = strain.flatten(1)[:, [0, 1, 3]]
        scaled = components / UNIT
        return scaled.tanh()


def first_frame(given: Batch) -> Tensor:
    """Return positions in the scenario's first frame [length], shape [particle, 2].

    Raises:
        UsageError: the batch does not hold them.
    """
    if given.origin is not None:
        return given.origin
    if bool((given.frame != 0).any()):
        raise UsageError(
            "the model needs the positions in the scenario's first frame: none, in "
            f"windows from frame {int(given.frame.max())}; make the windows with "
            "WindowDataset(..., origin=True)",
            where="batch.origin",
        )
    return given.position[:, 0]


def _relative_means(
    grid: ParticleGrid, stencil: Stencil, weight_sum: Tensor, value: Tensor
) -> Tensor:
    """Return mean values at the nodes around each particle less the particle's value.

    ``value`` has shape [particle, channel], the result shape [particle, 9, channel].
    """
    particles, channels = value.shape
    layers = len(weight_sum)
    sums = grid.spread(stencil, value, layers)
    mean = sums / weight_sum.clamp(min=1e-6)
    by_node = mean.permute(0, 2, 3, 1)
    by_node = by_node.reshape(-1, channels)
    nearby = by_node.index_select(0, stencil.node)
    nearby = nearby.view(particles, 9, -1)
    return nearby - value[:, None]
