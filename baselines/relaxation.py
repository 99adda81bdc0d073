"""Relaxation: after each step, particles that crowd together are moved apart.

In long rollouts of graph networks particles gather in some places and leave others.
Neural SPH (Toshev, Erbesdobler, Adams and Brandstetter 2024, arXiv 2402.06275) prevents
this by some steps of SPH after each step of the network. Here the steps are those of
position based fluids (Macklin and Mueller 2013, ACM Transactions on Graphics 32, 104),
which have no stiffness to choose. The density at particle i and its constraint are

    rho_i = sum_j W(x_i - x_j),   C_i = rho_i / (c rho_0) - 1 <= 0

with the kernel W(x) = (1 - |x|^2 / h^2)^3 up to the support h. rho_0 is the mean
density of the last given frame. The number c says how much denser a place may become.
Where C_i > 0, one iteration moves the particles by

    lambda_i = -C_i / (sum_k |grad_k C_i|^2 + epsilon)
    dx_i = s / (c rho_0) sum_j (lambda_i + lambda_j) grad W(x_i - x_j)

(Eqs. 1, 8, 11 and 12 of that paper, where s is 1). Where some particles of true states
exceed the limit, relaxation disturbs single steps.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from lagbench.tensors import TensorBox

from .graph import radius_graph

SUPPORT = {2: 2.0, 3: 1.5}
"""Support of the kernel in connectivity radii, by the dimension of the box.

Some 30 particles in the plane and 50 in space lie within it.
"""

SOFTNESS = 0.1
"""epsilon times the square of the support: it bounds steps where few are near."""

SHARE = 0.5
"""The factor s of a movement: with 1, neighbours that all move overshoot together."""


class Pairs(NamedTuple):
    """Pairs of particles near each other, both directions of each pair."""

    sender: Tensor  # int64, shape [pair]
    receiver: Tensor  # int64, shape [pair]
    way: Tensor  # from sender to receiver, over the support [1], shape [pair, axis]

    def of(self, chosen: Tensor) -> Pairs:
        """Return the pairs in which at least one particle is chosen.

        Args:
            chosen: whether a particle is chosen, shape [particle].
        """
        either = chosen[self.sender] | chosen[self.receiver]
        return Pairs(self.sender[either], self.receiver[either], self.way[either])


class Relaxation(nn.Module):
    """The correction of positions that keeps densities below a limit.

    Args:
        box: box that holds the particles.
        radius: connectivity radius of the network [length].
        iterations: corrections after a step.
        densest: largest density that is left alone, over the mean density of the last
            given frame.
    """

    def __init__(
        self, box: TensorBox, *, radius: float, iterations: int, densest: float
    ) -> None:
        super().__init__()
        self.box = box
        self.support = SUPPORT[box.box.dimension] * radius
        self.iterations = iterations
        self.densest = densest

    def density(self, position: Tensor, sample: Tensor) -> Tensor:
        """Return the density rho_i at each particle [1], shape [particle].

        Args:
            position: positions [length], shape [particle, axis].
            sample: window of each particle, ascending, int64, shape [particle].
        """
        sender, receiver = radius_graph(
            position, self.support, sample, box=self.box.box
        )
        return _density(self._measure(position, sender, receiver), len(position))

    def limit(self, position: Tensor, sample: Tensor) -> Tensor:
        """Return the largest density that is left alone [1], shape [window].

        Args:
            position: positions of the last given frame [length], shape
                [particle, axis].
            sample: window of each particle, ascending, int64, shape [particle].
        """
        density = self.density(position, sample)
        size = sample.bincount()
        sums = density.new_zeros(len(size)).index_add(0, sample, density)
        return self.densest * sums / size

    @torch.no_grad()
    def forward(
        self,
        position: Tensor,
        sample: Tensor,
        limit: Tensor,
        obstacle: Tensor | None = None,
    ) -> Tensor:
        """Return corrected positions [length], shape [particle, axis].

        Neighbours are sought once: the kernel of a particle that enters the support in
        an iteration is nearly 0.

        Args:
            position: positions [length], shape [particle, axis].
            sample: window of each particle, ascending, int64, shape [particle].
            limit: largest density of each window that is left alone, shape [window].
            obstacle: centre and radius of each particle's obstacle [length], shape
                [particle, axis + 1]; None without one.
        """
        own_limit = limit[sample]
        sender, receiver = radius_graph(
            position, self.support, sample, box=self.box.box
        )
        for _ in range(self.iterations):
            pairs = self._measure(position, sender, receiver)
            density = _density(pairs, len(position))
            excess = (density / own_limit - 1.0).clamp(min=0.0)  # C_i
            if not excess.any():
                break
            crowded = pairs.of(excess > 0.0)
            movement = _movement(crowded, excess, own_limit)
            position = self.box.inside(position + self.support * movement)
            if obstacle is not None:
                position = self.box.outside(position, obstacle)
        return position

    def _measure(self, position: Tensor, sender: Tensor, receiver: Tensor) -> Pairs:
        way = self.box.displacement(position[sender], position[receiver])
        return Pairs(sender, receiver, way / self.support)


def _density(pairs: Pairs, particles: int) -> Tensor:
    """Return the density at each particle, itself included [1], shape [particle]."""
    square_distance = pairs.way.square().sum(dim=1)
    kernel = (1.0 - square_distance).clamp(min=0.0) ** 3
    own = kernel.new_ones(particles)  # W(0)
    return own.index_add(0, pairs.receiver, kernel)


def _movement(pairs: Pairs, excess: Tensor, limit: Tensor) -> Tensor:
    """Return the movement of one iteration over the support, shape [particle, axis].

    Args:
        pairs: at least all pairs of particles of which one has an excess.
        excess: C_i of each particle, 0 where there is none, shape [particle].
        limit: largest density that is left alone at each particle, shape [particle].
    """
    particles = len(excess)
    # grad W over the limit, for each pair; the unit of length is the support
    square_distance = pairs.way.square().sum(dim=1, keepdim=True)
    slope = -6.0 * (1.0 - square_distance).clamp(min=0.0) ** 2
    gradient = slope * pairs.way / limit[pairs.receiver, None]

    # |grad_k C_i|^2 for k = i, and for each neighbour k of i
    own_gradient = gradient.new_zeros(particles, gradient.shape[1])
    own_gradient = own_gradient.index_add(0, pairs.receiver, gradient)
    squares = own_gradient.square().sum(dim=1)
    squares_of_pairs = gradient.square().sum(dim=1)
    squares = squares.index_add(0, pairs.receiver, squares_of_pairs)
    multiplier = -excess / (squares + SOFTNESS)  # lambda_i

    sums = multiplier[pairs.sender] + multiplier[pairs.receiver]
    push = sums[:, None] * gradient
    movement = torch.zeros_like(own_gradient)
    movement = movement.index_add(0, pairs.receiver, push)
    return SHARE * movement
