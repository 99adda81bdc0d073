"""Projections: corrections of the positions in every frame, whatever the forces are.

Waves cross a stiff body or a liquid within few frames. From one frame to the next its
parts move almost rigidly, or without being compressed. Forces that a coarse grid gives
once a frame do not achieve this. Constraints on positions do (position-based dynamics,
Mueller et al. 2007, doi 10.1016/j.jvcir.2007.01.005); velocities are then those of the
positions. Where all particles have one mass and walls are far, no projection moves a
centre of mass.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import torch
from torch import Tensor, nn

from .graph import MATERIALS, Bounds
from .particle_grid import ParticleGrid, Stencil

ELASTIC = (1, 3)  # jelly and rope, the materials that come back to their shape
# scale of the learned numbers: the few here then learn as fast as thousands of others
LEARNING_SCALE = 30.0
# log-odds, before training, of the share of the way to their shape that bodies go
INITIAL_SHARE = 3.0
LARGEST_PUSH = 2.0  # greatest k of DensityProjection
# change of the density limit by a learned number of 1; more would blow up bodies
LIMIT_SCALE = 0.2

TINY = 1e-16  # square of a cluster's moment [length^4] below which it has no direction
# the least share of a node's spline inside the box to divide by; nodes in reach of
# particles have more
LEAST_SHARE_INSIDE = 4e-4
# excess of density beyond which the pressure rises no more [1]
LARGEST_EXCESS = 1.0


@dataclass(frozen=True)
class ShapeMatching:
    """Overlapping clusters of a body's particles, one around each node.

        x'_p = sum_i b_i(X_p) (c_i + R_i (X_p - C_i))

    with C_i and c_i the means of positions in the first frame and now, weighted by the
    b_i, and R_i the rotation that fits a cluster's motion best: shape matching (Mueller
    et al. 2005, doi 10.1145/1073204.1073216) by overlapping regions (Rivers and James
    2007, doi 10.1145/1276377.1276480). As the b_i sum to 1 and the R_i fit best, the
    sums of x' - x and of x cross (x' - x) over a body are 0: the correction neither
    moves nor turns it.
    """

    stencil: Stencil  # nodes around X
    layer: Tensor  # layer of each particle, int64, shape [particle]
    particle_count: Tensor  # particles of each layer, at least 1, shape [layer, 1]
    node_count: int  # of all layers
    inverse_weight: Tensor  # 1 over the sum of weights at a node [1], shape [node, 1]
    arm: Tensor  # X_p - C_i [length], shape [particle, 9, 2]

    @classmethod
    def build(
        cls, grid: ParticleGrid, position: Tensor, layer: Tensor, layers: int
    ) -> ShapeMatching:
        """Return the clusters of bodies at X [length], shape [particle, 2].

        Each body is in a layer of its own. Clusters reach one and a half cells.
        """
        position = grid.box.inside(position)
        stencil = grid.stencil(position, layer)

        # A cluster whose arms do not add up to 0 turns a little in every frame:
        # rounding would spin bodies. So the means are in float64.
        exact_position = position.double()
        exact_weight = stencil.weight.double()
        exact_stencil = Stencil(exact_weight, stencil.node)
        one = torch.ones_like(exact_position[:, :1])
        value = torch.cat([one, exact_position], dim=1)
        sums = grid.spread(exact_stencil, value, layers)
        sums = sums.permute(0, 2, 3, 1)
        sums = sums.reshape(-1, 3)  # [node, (weight, x, y)]

        node_weight = sums[:, :1]
        inverse_weight = 1.0 / node_weight.clamp(min=1e-6)
        centre = sums[:, 1:] * inverse_weight  # C_i, shape [node, 2]
        nearby_centre = centre.index_select(0, stencil.node)
        nearby_centre = nearby_centre.view(-1, 9, 2)
        arm = exact_position[:, None] - nearby_centre

        particle_count = position.new_zeros(layers, 1)
        particle_count = particle_count.index_add(0, layer, one.to(position))
        return cls(
            stencil=stencil,
            layer=layer,
            particle_count=particle_count.clamp(min=1.0),
            node_count=len(inverse_weight),
            inverse_weight=inverse_weight.to(position),
            arm=arm.to(position),
        )

    def match(self, position: Tensor) -> Tensor:
        """Return x' from x [length], both of shape [particle, 2].

        It is the mean of the places that the clusters of a particle have for it.
        """
        weight = self.stencil.weight
        arm_x, arm_y = self.arm.unbind(dim=2)
        # Moments are taken about the middle of each body: about a far point rounding
        # would be larger.
        middle = self._body_middle(position)
        from_middle = position - middle
        x, y = from_middle[:, None].unbind(dim=2)  # each [particle, 1]

        # Sums over the particles around each node: mean place and rotation.
        cosine = x * arm_x + y * arm_y
        sine = y * arm_x - x * arm_y
        x_of_nodes = x.expand_as(weight)
        y_of_nodes = y.expand_as(weight)
        components = [x_of_nodes, y_of_nodes, cosine, sine]
        moments = torch.stack(components, dim=2)
        weighted_moments = weight[..., None] * moments
        contributions = weighted_moments.flatten(0, 1)
        sums = contributions.new_zeros(self.node_count, 4)
        sums = sums.index_add(0, self.stencil.node, contributions)
        centre = sums[:, :2] * self.inverse_weight  # c_i

        # A lone particle turns nothing: the root's gradient must not be infinite there.
        turn = sums[:, 2:]
        squares = turn.square()
        square = squares.sum(dim=1, keepdim=True)
        length = (square + TINY).sqrt()
        rotation = turn / length  # (cosine, sine) of R_i
        motion = torch.cat([centre, rotation], dim=1)

        # Back at the particles: c_i + R_i (X_p - C_i) of their nine nodes.
        nearby_motion = motion.index_select(0, self.stencil.node)
        nearby_motion = nearby_motion.view(-1, 9, 4)
        centre_x, centre_y, cosine, sine = nearby_motion.unbind(dim=2)
        place_x = centre_x + cosine * arm_x - sine * arm_y
        place_y = centre_y + sine * arm_x + cosine * arm_y
        places = torch.stack([place_x, place_y], dim=2)
        weighted_places = weight[..., None] * places
        return middle + weighted_places.sum(dim=1)

    def _body_middle(self, position: Tensor) -> Tensor:
        """Return the mean position of each particle's body, shape [particle, 2]."""
        layer_count = len(self.particle_count)
        sums = position.new_zeros(layer_count, 2)
        sums = sums.index_add(0, self.layer, position)
        mean = sums / self.particle_count
        return mean.index_select(0, self.layer)


@dataclass(frozen=True)
class DensityProjection:
    """A push out of regions that are denser than the first frame was anywhere.

        x' = x + d G2P(a),   m_i a_i = k sum_p min(max(rho_p - l_p, 0), 1) grad b_i(x_p)
        rho = G2P(P2G(1) / V) / (its greatest value in the window's first frame)

    with d the width of a cell, a from :meth:`ParticleGrid.accelerate` by that pressure,
    and V the share of a node's spline inside the box. Density constraints of particles
    (Macklin and Mueller 2013, doi 10.1145/2461912.2461984) and density projection on
    grids (Kugelstadt et al. 2019, doi 10.1109/TVCG.2019.2947437) do the same; this is
    one explicit step. Away from walls momentum is conserved.
    """

    grid: ParticleGrid  # where density is measured
    inverse_share: Tensor  # 1 / V [1], shape [x node, y node]
    sample: Tensor  # window of each particle, int64, shape [particle]
    # greatest density in the first frame of each window [particle/cell], shape [window]
    greatest: Tensor

    @classmethod
    def build(
        cls, grid: ParticleGrid, position: Tensor, sample: Tensor, windows: int
    ) -> DensityProjection:
        """Return the projection of windows from positions in their first frame.

        Positions [length] have shape [particle, 2].
        """
        share_inside = grid.share_inside()
        inverse_share = 1.0 / share_inside.clamp(min=LEAST_SHARE_INSIDE)
        unit = position.new_ones(windows)
        unscaled = cls(grid, inverse_share, sample, unit)

        position = grid.box.inside(position)
        stencil = grid.stencil(position, sample)
        density, _ = unscaled.relative_density(stencil)
        greatest = position.new_zeros(windows)
        greatest = greatest.scatter_reduce(0, sample, density, "amax")
        return cls(grid, inverse_share, sample, greatest)

    def relative_density(self, stencil: Stencil) -> tuple[Tensor, Tensor]:
        """Return rho of the particles with these nodes [1], and P2G(1).

        Their shapes are [particle] and [window, 1, x node, y node].
        """
        one = torch.ones_like(stencil.weight[:, :1])
        windows = len(self.greatest)
        mass = self.grid.spread(stencil, one, windows)
        node_density = mass * self.inverse_share
        gathered = self.grid.gather(stencil, node_density)
        density = gathered[:, 0]
        greatest = self.greatest[self.sample]
        return density / greatest, mass

    def correct(self, position: Tensor, push: Tensor, limit: Tensor) -> Tensor:
        """Return x' from x [length], both of shape [particle, 2].

        Args:
            position: x; positions beyond a wall are put on it.
            push: k [1]; about 1 removes the excess within a few steps.
            limit: l [1], shape [particle].
        """
        position = self.grid.box.inside(position)
        stencil = self.grid.stencil(position, self.sample)
        density, mass = self.relative_density(stencil)
        excess = density - limit
        pressure = push * excess.clamp(0.0, LARGEST_EXCESS)
        shear = torch.zeros_like(pressure)
        components = [pressure, shear, pressure]  # (xx, xy, yy)
        stress = -torch.stack(components, dim=1)
        node_acceleration = self.grid.accelerate(
            stencil, position, stress[:, None], mass
        )
        acceleration = self.grid.gather(stencil, node_acceleration)
        return position + self.grid.spacing * acceleration


@dataclass(frozen=True)
class ProjectionState:
    """First frame of a batch of windows, prepared for the projections."""

    # numbers of the particles that come back to their shape, int64, [elastic particle]
    elastic: Tensor
    # place of their materials in ELASTIC, int64, shape [elastic particle]
    elastic_kind: Tensor
    shapes: tuple[ShapeMatching, ...]
    densities: tuple[DensityProjection, ...]
    material: Tensor  # of each particle, int64, shape [particle]


class Projection(nn.Module):
    """Density projection of all matter, then shape matching of elastic bodies.

    The network learns how far each grid corrects. It also learns the density limit of
    each material, as a share of the first frame's greatest density. A limit a little
    below 1 puts a liquid under pressure, and the network learns to bear it.

    Args:
        bounds: box (low, high) along x and y [length].
        shape: cells across the box of the grids of :class:`ShapeMatching`, in turn.
        density: cells across the box of the grids of :class:`DensityProjection`.
    """

    def __init__(
        self,
        bounds: Bounds,
        *,
        shape: Sequence[int],
        density: Sequence[int],
    ) -> None:
        super().__init__()
        self.grid_cells = {
            "shape": tuple(shape),
            "density": tuple(density),
        }
        self.clusters = nn.ModuleList()
        for cells in shape:
            self.clusters.append(ParticleGrid(bounds, cells))
        self.cells = nn.ModuleList()
        for cells in density:
            self.cells.append(ParticleGrid(bounds, cells))

        # The names of the parameters are those in files of weights. A parameter without
        # a gradient would stop training on several devices, so there are none without
        # grids.
        if shape:
            share_count = (len(shape), len(ELASTIC))
            initial_share = INITIAL_SHARE / LEARNING_SCALE
            shares = torch.full(share_count, initial_share)
            self.held = nn.Parameter(shares)
        if density:
            pushes = torch.zeros(len(density))
            limits = torch.zeros(MATERIALS)
            self.push = nn.Parameter(pushes)
            self.limit = nn.Parameter(limits)

    def adapt_weights(
        self,
        weights: Mapping[str, Tensor],
        options: Mapping[str, Any],
        *,
        prefix: str,
    ) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Return the weights and options of a model, adapted to the grids of this one.

        Grids that stand first in both keep their weights, the others start anew. The
        weight ``held`` has shape [grid, elastic material], ``push`` [grid]; ``limit``,
        [material], is of no grid and stays.

        Args:
            weights: weights of the model by name.
            options: its options by name.
            prefix: name of this module in the model, and a dot.
        """
        weights = dict(weights)
        options = dict(options)
        initial = self.state_dict(prefix=prefix)
        weight_of_option = {"shape": "held", "density": "push"}
        for option, weight_name in weight_of_option.items():
            grids = self.grid_cells[option]
            shared_count = _count_shared(grids, options[option])
            options[option] = list(grids)

            name = prefix + weight_name
            learned = weights.pop(name, None)
            if learned is not None and grids:
                shared = learned[:shared_count]
                rest = initial[name][shared_count:]
                weights[name] = torch.cat([shared, rest])

        adapted = dict(initial)
        for name, value in weights.items():
            if name in initial or not name.startswith(prefix):
                adapted[name] = value
        return adapted, options

    def start(
        self,
        first: Tensor,
        material: Tensor,
        sample: Tensor,
        windows: int,
    ) -> ProjectionState:
        """Return the state of the projections from the first frames of windows.

        Particles of one material in one window are one body.

        Args:
            first: positions in the first frame [length], shape [particle, 2].
            material: material of each particle, int64, shape [particle].
            sample: window of each particle, int64, shape [particle].
            windows: number of windows.
        """
        device = material.device
        kind_count = len(ELASTIC)
        # place of each material in ELASTIC; -1 for those that are not elastic
        kind_of_material = torch.full((MATERIALS,), -1, device=device)
        kinds = torch.arange(kind_count, device=device)
        kind_of_material[list(ELASTIC)] = kinds
        kind = kind_of_material[material]
        is_elastic = kind >= 0
        elastic = is_elastic.nonzero()[:, 0]
        elastic_kind = kind[elastic]

        # One layer of nodes for each window and elastic material.
        layer = sample[elastic] * kind_count + elastic_kind
        layers = windows * kind_count
        elastic_first = first[elastic]
        shapes = []
        for module in self.clusters:
            grid = cast(ParticleGrid, module)
            shape = ShapeMatching.build(grid, elastic_first, layer, layers)
            shapes.append(shape)
        densities = []
        for module in self.cells:
            grid = cast(ParticleGrid, module)
            density = DensityProjection.build(grid, first, sample, windows)
            densities.append(density)
        return ProjectionState(
            elastic=elastic,
            elastic_kind=elastic_kind,
            shapes=tuple(shapes),
            densities=tuple(densities),
            material=material,
        )

    def forward(self, state: ProjectionState, position: Tensor) -> Tensor:
        """Return the corrected positions of a frame [length], shape [particle, 2].

        The result may lie beyond walls. Where there are density projections, positions
        beyond walls are first put on them.
        """
        if state.densities:
            limit_of_material = 1.0 + LIMIT_SCALE * self.limit
            limit = limit_of_material[state.material]
            log_odds = LEARNING_SCALE * self.push
            pushes = LARGEST_PUSH * log_odds.sigmoid()
            for push, density in zip(pushes, state.densities, strict=True):
                position = density.correct(position, push, limit)
        if state.shapes:
            elastic = position.index_select(0, state.elastic)
            log_odds = LEARNING_SCALE * self.held
            shares = log_odds.sigmoid()
            for share_of_kind, shape in zip(shares, state.shapes, strict=True):
                matched = shape.match(elastic)
                correction = matched - elastic
                share = share_of_kind[state.elastic_kind]
                elastic = elastic + share[:, None] * correction
            position = position.index_copy(0, state.elastic, elastic)
        return position


def _count_shared(first: Sequence[int], second: Sequence[int]) -> int:
    """Return the length of the common start of two lists of grid sizes [cells]."""
    count = 0
    for one_cells, other_cells in zip(first, second, strict=False):
        if one_cells != other_cells:
            break
        count += 1
    return count
