"""Free flight: a body that nothing touches moves with the acceleration of gravity.

The forces between the particles of a body cancel (Newton's third law). With equal
masses, the mean acceleration of its particles is then

    (1/N) sum_p a_p = g

A graph network does not know this: each of its particles gets an acceleration of its
own, and small errors of a sign add up. :class:`FreeFlight` corrects the mean, with one
learned vector g for all bodies.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor, nn

from lagbench.data.box import Box
from lagbench.tensors import TensorBox

from .baseline import DatasetInfo
from .graph import radius_graph, wall_distance

FALL_UNIT = 10.0
"""Acceleration of a learned number of 1, in deviations: it learns fast enough."""

CLUSTER_REACH = 1 / 3
"""Reach within which clusters are sought first, over the reach of forces."""

LARGE_CLUSTER = 100
"""Particles of a cluster whose neighbours are sought with a tree of its own."""


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

    A body has far too many pairs within reach to list them all. So the search finds
    clusters of near particles first, and then the links between these clusters.

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
    states = (position, next_position)
    near_wall = torch.zeros(len(position), dtype=torch.bool, device=position.device)
    links = []
    cluster_reach = CLUSTER_REACH * reach
    wall_reach = reach / 2
    for each in states:
        scaled_distance = wall_distance(each, bounds, wall_reach, box.box.periodic)
        near_wall |= (scaled_distance < 1.0).any(dim=1)
        links.append(radius_graph(each, cluster_reach, sample, box=box.box))
    cluster, _ = _connected(torch.cat(links, dim=1), len(position))
    for each in states:
        links.append(_link_clusters(each, cluster, sample, reach, box.box))

    body, body_count = _connected(torch.cat(links, dim=1), len(position))
    touched = near_wall.new_zeros(body_count)
    touched[body[near_wall]] = True
    return Bodies(body, ~touched)


def _link_clusters(
    position: Tensor, cluster: Tensor, sample: Tensor, reach: float, box: Box
) -> Tensor:
    """Return links between particles of different clusters, int64, shape [2, link].

    If a particle of a cluster is within reach of a particle of another cluster, a link
    joins the two. Pairs inside a large cluster are not listed.

    Args:
        position: positions [length], shape [particle, axis].
        cluster: number of each particle's cluster, from 0, shape [particle].
        sample: window of each particle, shape [particle].
        reach: largest length of a link [length].
        box: box that holds the particles.
    """
    x = position.double().cpu().numpy()
    label = cluster.cpu().numpy()
    window = sample.cpu().numpy()
    is_finite = np.isfinite(x).all(axis=1)
    size = np.bincount(label)
    is_large = size[label] >= LARGE_CLUSTER
    parts = [np.empty((2, 0), np.int64)]
    for number in np.unique(window):
        is_member = is_finite & (window == number)
        small = np.flatnonzero(is_member & ~is_large)
        parts.append(_pairs_within(x, small, reach, box))
        for large in np.unique(label[is_member & is_large]):
            own = np.flatnonzero(is_member & (label == large))
            others = np.flatnonzero(is_member & (label != large))
            parts.append(_links_to(x, own, others, reach, box))
    return torch.from_numpy(np.concatenate(parts, axis=1)).to(position.device)


def _pairs_within(
    x: NDArray[np.float64], members: NDArray[np.int64], reach: float, box: Box
) -> NDArray[np.int64]:
    """Return all pairs of these particles within reach, shape [2, pair]."""
    pairs = box.tree(x[members]).query_pairs(reach, output_type="ndarray")
    return members[pairs].T


def _links_to(
    x: NDArray[np.float64],
    own: NDArray[np.int64],
    others: NDArray[np.int64],
    reach: float,
    box: Box,
) -> NDArray[np.int64]:
    """Return links of other particles to the nearest particle of a cluster, in reach.

    Args:
        x: positions [length], shape [particle, axis].
        own: particles of a cluster.
        others: particles of all other clusters of the window.
        reach: largest length of a link [length].
        box: box that holds the particles.
    """
    own_tree = box.tree(x[own])
    other_points = box.tree_points(x[others])
    bound = math.nextafter(reach, math.inf)  # the tree leaves out what is as far
    answer = own_tree.query(other_points, distance_upper_bound=bound)
    nearest = np.asarray(answer[1])
    is_linked = nearest < len(own)
    return np.stack([own[nearest[is_linked]], others[is_linked]])


def _connected(links: Tensor, particles: int) -> tuple[Tensor, int]:
    """Return the component of each particle, shape [particle], and their number."""
    sender, receiver = links.cpu().numpy()
    is_linked = np.ones(len(sender), np.bool_)
    shape = (particles, particles)
    matrix = coo_array((is_linked, (sender, receiver)), shape=shape)
    count, label = connected_components(matrix, directed=False)
    component = torch.from_numpy(label).to(links.device, torch.int64)
    return component, count
