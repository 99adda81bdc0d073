"""Projections: what positions are drawn to in every frame, whatever a network has said
of forces.

Waves cross a stiff body or a liquid within few frames. From one to the next its parts
move almost rigidly, or without being pressed together, which forces that are told once
a frame on a coarse grid do not achieve. Constraints on positions do (position-based
dynamics, Mueller et al. 2007, doi 10.1016/j.jvcir.2007.01.005); velocities are then
those of the positions. Where all particles have one mass and walls are far, no
projection moves a centre of mass.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import takewhile
from typing import Any, cast

import torch
from torch import Tensor, nn

from .graph import MATERIALS, Bounds
from .particle_grid import ParticleGrid, Stencil

ELASTIC = (1, 3)  # jelly and rope, the materials that come back to their shape
# what a weight counts for: the few here are to be learned as fast as thousands of
# others
HEAVY = 30.0
# log-odds of the share of the way to their shape that bodies go, before training
HELD = 3.0
MOST_PUSH = 2.0  # greatest k of Density
# what a change of 1 is to the density that is not too much; with more, bodies are blown
# up
LIMIT = 0.2

TINY = 1e-16  # square of a cluster's moment [length^4] below which it has no direction
# least share of a node's spline inside the box that divides its weight; in reach none
# is less
LEAST = 4e-4
# excess of density beyond which matter is pushed no farther at once [1]
MOST_EXCESS = 1.0


@dataclass(frozen=True)
class Shape:
    """Overlapping clusters of a body's particles, one around each node of its first
    frame.

        x'_p = sum_i b_i(X_p) (c_i + R_i (X_p - C_i))

    with C_i and c_i the means of positions in the first frame and now, weighted by the
    b_i, and R_i the rotation that fits a cluster's motion best: shape matching (Mueller
    et al. 2005, doi 10.1145/1073204.1073216) by overlapping regions (Rivers and James
    2007, doi 10.1145/1276377.1276480). As the b_i sum to 1 and the R_i fit best, the
    sums of x' - x and of x cross (x' - x) over a body are 0: it is neither moved nor
    turned.
    """

    stencil: Stencil  # nodes around X
    layer: Tensor  # layer of each particle, int64, shape [particle]
    count: Tensor  # particles of each layer, at least 1, shape [layer, 1]
    nodes: int  # of all layers
    inverse: Tensor  # 1 over the sum of the weights at a node [1], shape [node, 1]
    arm: Tensor  # X_p - C_i [length], shape [particle, 9, 2]

    @classmethod
    def of(
        cls, grid: ParticleGrid, position: Tensor, layer: Tensor, layers: int
    ) -> Shape:
        """Return the clusters of bodies at X [length], [particle, 2], each in a layer
        of its own.

        They reach one and a half cells.
        """
        position = position.clamp(grid.low, grid.high)
        stencil = grid.stencil(position, layer)
        # A cluster whose arms do not add up to 0 turns a little in every frame:
        # rounding would spin bodies.
        exact = position.double()
        one = torch.ones_like(position[:, :1])
        exact_stencil = Stencil(stencil.weight.double(), stencil.node)
        sums = grid.spread(
            exact_stencil, torch.cat([one.double(), exact], dim=1), layers
        )
        sums = sums.permute(0, 2, 3, 1).reshape(-1, 3)
        inverse = 1.0 / sums[:, :1].clamp(min=1e-6)
        arm = exact[:, None] - (sums[:, 1:] * inverse).index_select(
            0, stencil.node
        ).view(-1, 9, 2)
        count = position.new_zeros(layers, 1).index_add(0, layer, one).clamp(min=1.0)
        return cls(
            stencil, layer, count, len(inverse), inverse.to(position), arm.to(position)
        )

    def matched(self, position: Tensor) -> Tensor:
        """Return x', the mean of where the clusters of a particle have it, from x
        [length], [particle, 2].
        """
        weight, (along_x, along_y) = self.stencil.weight, self.arm.unbind(dim=2)
        # Moments are taken about the middle of each body: about a far point they would
        # be rounded more.
        mean = (
            position.new_zeros(len(self.count), 2).index_add(0, self.layer, position)
            / self.count
        )
        middle = mean.index_select(0, self.layer)
        x, y = (position - middle)[:, None].unbind(dim=2)
        cosine = x * along_x + y * along_y
        sine = y * along_x - x * along_y
        moments = torch.stack(
            [x.expand_as(weight), y.expand_as(weight), cosine, sine], dim=2
        )
        parts = (weight[..., None] * moments).flatten(0, 1)
        sums = parts.new_zeros(self.nodes, 4).index_add(0, self.stencil.node, parts)
        # A lone particle turns nothing: the root's gradient must not be infinite there.
        length = (sums[:, 2:].square().sum(dim=1, keepdim=True) + TINY).sqrt()
        motion = torch.cat([sums[:, :2] * self.inverse, sums[:, 2:] / length], dim=1)
        x, y, cosine, sine = (
            motion.index_select(0, self.stencil.node).view(-1, 9, 4).unbind(dim=2)
        )
        there = [
            x + cosine * along_x - sine * along_y,
            y + sine * along_x + cosine * along_y,
        ]
        return middle + (weight[..., None] * torch.stack(there, dim=2)).sum(dim=1)


@dataclass(frozen=True)
class Density:
    """How dense matter was at most in the first frame, and a push out of where it is
    too dense beside that.

        x' = x + d G2P(a),   m_i a_i = k sum_p min(max(rho_p - l_p, 0), 1) grad b_i(x_p)
        rho = G2P(P2G(1) / V) / (its greatest value in the window's first frame)

    with d the width of a cell, a from :meth:`ParticleGrid.pushed` by that pressure, and
    V the share of a node's spline inside the box: what density constraints of particles
    (Macklin and Mueller 2013, doi 10.1145/2461912.2461984) and density projection on
    grids (Kugelstadt et al. 2019, doi 10.1109/TVCG.2019.2947437) do, by one explicit
    step. Away from walls momentum is kept.
    """

    grid: ParticleGrid  # where density is measured
    inverse: Tensor  # 1 / V [1], shape [x node, y node]
    sample: Tensor  # window of each particle, int64, shape [particle]
    # greatest density in the first frame of each window [particle/cell], shape [window]
    most: Tensor

    @classmethod
    def of(
        cls, grid: ParticleGrid, position: Tensor, sample: Tensor, windows: int
    ) -> Density:
        """Return the density in windows of positions in the first frame [length], shape
        [particle, 2].
        """
        inverse = 1.0 / grid.inside().clamp(min=LEAST)
        empty = cls(grid, inverse, sample, position.new_ones(windows))
        found, _ = empty.relative(
            grid.stencil(position.clamp(grid.low, grid.high), sample)
        )
        most = position.new_zeros(windows).scatter_reduce(0, sample, found, "amax")
        return cls(grid, inverse, sample, most)

    def relative(self, stencil: Stencil) -> tuple[Tensor, Tensor]:
        """Return rho of particles whose nodes these are [1], shape [particle], and
        P2G(1).
        """
        one = torch.ones_like(stencil.weight[:, :1])
        mass = self.grid.spread(stencil, one, len(self.most))
        return self.grid.gather(stencil, mass * self.inverse)[:, 0] / self.most[
            self.sample
        ], mass

    def eased(self, position: Tensor, push: Tensor, limit: Tensor) -> Tensor:
        """Return x' [length] from x, both of shape [particle, 2], with l [1], shape
        [particle], as the limit.

        A push k of about 1 takes away what is too much within a few steps.
        """
        position = position.clamp(self.grid.low, self.grid.high)
        stencil = self.grid.stencil(position, self.sample)
        rho, mass = self.relative(stencil)
        pressure = push * (rho - limit).clamp(0.0, MOST_EXCESS)
        none = torch.zeros_like(pressure)
        stress = -torch.stack([pressure, none, pressure], dim=1)[:, None]
        moved = self.grid.gather(
            stencil, self.grid.pushed(stencil, position, stress, mass)
        )
        return position + self.grid.spacing * moved


@dataclass(frozen=True)
class Drawn:
    """What a batch of windows is drawn to."""

    elastic: Tensor  # numbers of the particles that come back to their shape, int64, shape [elastic particle]
    # where their materials stand in ELASTIC, int64, shape [elastic particle]
    kind: Tensor
    shapes: tuple[Shape, ...]
    densities: tuple[Density, ...]
    material: Tensor  # of each particle, int64, shape [particle]


class Projection(nn.Module):
    """Matter pushed out of where it is too dense, then elastic bodies drawn to their
    shape.

    How far is learned, for each grid, and so is which share of the first frame's
    greatest density is too dense for a material: a little below 1 a liquid is under
    pressure, which the network learns to bear.

    Args:
        bounds: box (low, high) along x and y [length].
        shape: cells across the box of the grids of :class:`Shape`, one after the other.
        density: the same of :class:`Density`.
    """

    def __init__(
        self, bounds: Bounds, *, shape: Sequence[int], density: Sequence[int]
    ) -> None:
        super().__init__()
        self.across = {"shape": tuple(shape), "density": tuple(density)}
        self.clusters = nn.ModuleList(ParticleGrid(bounds, cells) for cells in shape)
        self.cells = nn.ModuleList(ParticleGrid(bounds, cells) for cells in density)
        # Weights that no grid needs would get no gradient, which training on several
        # devices refuses.
        if shape:
            self.held = nn.Parameter(
                torch.full((len(shape), len(ELASTIC)), HELD / HEAVY)
            )
        if density:
            self.push = nn.Parameter(torch.zeros(len(density)))
            self.limit = nn.Parameter(torch.zeros(MATERIALS))

    def adapted(
        self, weights: Mapping[str, Tensor], options: Mapping[str, Any], *, prefix: str
    ) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Return weights and options with our own start for all grids but those that
        stand first in both.

        ``held`` has shape [grid, elastic material], ``push`` [grid]; ``limit``,
        [material], is kept. ``prefix`` is this module's name in the model of weights
        and options, and a dot.
        """
        weights = dict(weights)
        options = dict(options)
        own = self.state_dict(prefix=prefix)
        for option, name in (
            ("shape", "held"),
            ("density", "push"),
        ):  # what is of one grid each
            ours = list(self.across[option])
            known = list(options[option])
            shared = len(
                list(
                    takewhile(
                        lambda pair: pair[0] == pair[1], zip(ours, known, strict=False)
                    )
                )
            )
            options[option] = ours
            learned = weights.pop(prefix + name, None)
            if learned is not None and ours:
                weights[prefix + name] = torch.cat(
                    [learned[:shared], own[prefix + name][shared:]]
                )
        kept = {
            name: value
            for name, value in weights.items()
            if name in own or not name.startswith(prefix)
        }
        return {**own, **kept}, options

    def start(
        self, first: Tensor, material: Tensor, sample: Tensor, windows: int
    ) -> Drawn:
        """Return what windows are drawn to, from first frames [length], shape
        [particle, 2].

        Materials and windows (``sample``) are int64, [particle]; particles of one
        material are one body.
        """
        kind = torch.full((MATERIALS,), -1, device=material.device)
        kind[list(ELASTIC)] = torch.arange(len(ELASTIC), device=material.device)
        elastic = (kind[material] >= 0).nonzero()[:, 0]
        kind = kind[material[elastic]]
        layer = sample[elastic] * len(ELASTIC) + kind
        bodies = windows * len(ELASTIC)
        shapes = [
            Shape.of(cast(ParticleGrid, grid), first[elastic], layer, bodies)
            for grid in self.clusters
        ]
        densities = [
            Density.of(cast(ParticleGrid, grid), first, sample, windows)
            for grid in self.cells
        ]
        return Drawn(elastic, kind, tuple(shapes), tuple(densities), material)

    def forward(self, drawn: Drawn, position: Tensor) -> Tensor:
        """Return the positions that a frame comes to [length], shape [particle, 2].

        They may lie beyond walls; where densities are asked for, what lies there is put
        back first.
        """
        if drawn.densities:
            limit = (1.0 + LIMIT * self.limit)[drawn.material]
            for push, density in zip(
                MOST_PUSH * (HEAVY * self.push).sigmoid(), drawn.densities, strict=True
            ):
                position = density.eased(position, push, limit)
        if drawn.shapes:
            there = position.index_select(0, drawn.elastic)
            for share, shape in zip(
                (HEAVY * self.held).sigmoid(), drawn.shapes, strict=True
            ):
                there = there + share[drawn.kind][:, None] * (
                    shape.matched(there) - there
                )
            position = position.index_copy(0, drawn.elastic, there)
        return position
