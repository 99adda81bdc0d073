"""How far a body is strained since the scenario's first frame, from positions there and
now.

    F = dx/dX,   e = (F F^T - 1) / 2

with X the positions in the first frame. A model that carries no stress of its own, as
grids and graphs do not, can tell by it which way elastic bodies push back. F is the
least-squares gradient of the mean displacements at the nodes around X, good for affine
motion up to the edges of a body. What is thinner than a cell and turns far looks
strained.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from lagbench.errors import UsageError

from .baseline import Batch
from .particle_grid import ParticleGrid, Stencil

UNIT = 0.2  # strain that looks like 1 [1]; far beyond it all strains look alike
# share of a cell's square on top of the nodes' spread: bounds F where they lie on a
# line
SLACK = 1e-3


@dataclass(frozen=True)
class Rest:
    """The first frame of a batch's scenarios, and all that F needs of it."""

    grid: ParticleGrid  # where displacements are averaged
    position: Tensor  # X [length], shape [particle, 2]
    stencil: Stencil  # nodes around them
    # sums of the weights at the nodes [1], shape [layer, 1, x node, y node]
    count: Tensor
    # offsets of the nodes, weighted, times the inverse of their spread [1/length],
    # shape [particle, 9, 2]
    lever: Tensor

    @classmethod
    def of(
        cls,
        grid: ParticleGrid,
        position: Tensor,
        layer: Tensor,
        layers: int,
        *,
        solid: Tensor | None = None,
    ) -> Rest:
        """Return what F needs of X [length], shape [particle, 2].

        Bodies that do not mix have layers of their own. ``solid`` says who shows a
        strain, bool, shape [particle]; all by default.
        """
        position = position.clamp(grid.low, grid.high)
        stencil = grid.stencil(position, layer)
        count = grid.spread(stencil, torch.ones_like(position[:, :1]), layers)
        offsets = stencil.weight[:, :, None] * grid.offsets(stencil, position)
        slack = SLACK * grid.spacing**2 * torch.eye(2, device=position.device)
        with torch.autocast(
            position.device.type, enabled=False
        ):  # three digits are too few for a strain
            spread = torch.einsum(
                "pnd,pne->pde", _around(grid, stencil, count, position), offsets
            )
            lever = offsets @ torch.linalg.inv(spread + slack)
        if solid is not None:
            lever = lever * solid[:, None, None]
        return cls(grid, position, stencil, count, lever)

    def strain(self, position: Tensor) -> Tensor:
        """Return ``tanh(e / 0.2)`` at positions x as (xx, xy, yy) [1], shape [particle,
        3].
        """
        moved = _around(self.grid, self.stencil, self.count, position - self.position)
        with torch.autocast(position.device.type, enabled=False):
            gradient = torch.einsum("pnd,pne->pde", moved, self.lever)  # F - 1
            strain = 0.5 * (gradient + gradient.mT + gradient @ gradient.mT)
        return (strain.flatten(1)[:, [0, 1, 3]] / UNIT).tanh()


def first_frame(given: Batch) -> Tensor:
    """Return the positions in the scenario's first frame [length], shape [particle,
    2].
    """
    if given.origin is not None:
        return given.origin
    if bool((given.frame != 0).any()):
        raise UsageError(
            "the model needs the positions in the scenario's first frame",
            where="batch.origin",
            expected="the positions in it",
            got=f"none, in windows from frame {int(given.frame.max())}",
            fix="make the windows with WindowDataset(..., origin=True)",
        )
    return given.position[:, 0]


def _around(
    grid: ParticleGrid, stencil: Stencil, count: Tensor, value: Tensor
) -> Tensor:
    """Return mean values at the nodes around each particle less its own, shape
    [particle, 9, channel].
    """
    mean = grid.spread(stencil, value, len(count)) / count.clamp(min=1e-6)
    nodes = (
        mean.permute(0, 2, 3, 1)
        .reshape(-1, value.shape[1])
        .index_select(0, stencil.node)
    )
    return nodes.view(len(value), 9, -1) - value[:, None]
