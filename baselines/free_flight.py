"""Free flight: a body that nothing touches moves with the acceleration of gravity.

The forces between the particles of a body cancel (Newton's third law). With equal
masses, the mean acceleration of its particles is then

    (1/N) sum_p a_p = g

A graph network does not know this: each of its particles gets an acceleration of its
own, and small errors of a sign add up. :class:`FreeFlight` corrects the mean, with one
learned vector g for all bodies.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor, nn

from lagbench.tensors import TensorBox

from .baseline import DatasetInfo
from .graph import radius_graph, wall_distance

FALL_UNIT = 10.0
"""Acceleration of a learned number of 1, in deviations: it learns fast enough."""


class Bodies(NamedTuple):
    """Which particles belong together."""

    body: Tensor  # number of each particle's body, from 0, int64, shape [particle]
    flies: Tensor  # whether a body is out of reach of all walls, bool, shape [body]


class FreeFlight(nn.Module):
    """The correction of accelerations that gives bodies in free flight their mean.

    Args:
        info: public figures of the data set.
        reach: distance up to which particles act on each other [length]. Walls act on
            particles up to half of it: in the material-point method both act through
            the nodes of a grid, and a particle reaches nodes up to half that far.
        unit: deviation of accelerations [length/frame^2].
    """

    def __init__(self, info: DatasetInfo, *, reach: float, unit: float) -> None:
        super().__init__()
        self.box = TensorBox(info.box)
        self.reach = reach
        self.unit = unit
        self.fall = nn.Parameter(torch.zeros(info.box.dimension))

    @property
    def gravity(self) -> Tensor:
        """Learned acceleration of a free body [length/frame^2], shape [axis]."""
        return FALL_UNIT * self.unit * self.fall

    def forward(
        self, acceleration: Tensor, position: Tensor, velocity: Tensor, sample: Tensor
    ) -> Tensor:
        """Return corrected accelerations [length/frame^2], shape [particle, axis].

        Args:
            acceleration: predicted accelerations, shape [particle, axis].
            position: positions [length], shape [particle, axis].
            velocity: last velocities [length/frame], shape [particle, axis].
            sample: window of each particle, ascending, int64, shape [particle].
        """
        bodies = find_bodies(position, velocity, sample, reach=self.reach, box=self.box)
        body_count = len(bodies.flies)
        size = bodies.body.bincount(minlength=body_count)
        sums = acceleration.new_zeros(body_count, acceleration.shape[1])
        sums = sums.index_add(0, bodies.body, acceleration)
        mean = sums / size[:, None]
        correction = (self.gravity - mean) * bodies.flies[:, None]
        return acceleration + correction[bodies.body]


def find_bodies(
    position: Tensor, velocity: Tensor, sample: Tensor, *, reach: float, box: TensorBox
) -> Bodies:
    """Return the bodies of particles that act on each other within the next frame.

    The result also tells which bodies are out of reach of all walls.

    Two particles belong to one body if they are within reach now or after one frame at
    their velocities, or if other particles link them.

    Args:
        position: positions [length], shape [particle, axis].
        velocity: velocities [length/frame], shape [particle, axis].
        sample: window of each particle, ascending, int64, shape [particle].
        reach: distance up to which particles act on each other [length]. A wall acts on
            particles up to half of this distance.
        box: box that holds the particles.
    """
    position = position.detach()
    next_position = box.inside(position + velocity.detach())
    bounds = box.box.bounds
    near_wall = torch.zeros(len(position), dtype=torch.bool, device=position.device)
    links = []
    for each in (position, next_position):
        scaled_distance = wall_distance(each, bounds, reach / 2, box.box.periodic)
        near_wall |= (scaled_distance < 1.0).any(dim=1)
        links.append(radius_graph(each, reach, sample, box=box.box))
    sender, receiver = torch.cat(links, dim=1).cpu().numpy()
    is_linked = np.ones(len(sender), np.bool_)
    shape = (len(position), len(position))
    matrix = coo_array((is_linked, (sender, receiver)), shape=shape)
    body_count, label = connected_components(matrix, directed=False)
    body = torch.from_numpy(label).to(position.device, torch.int64)
    touched = near_wall.new_zeros(body_count)
    touched[body[near_wall]] = True
    return Bodies(body, ~touched)
