"""Where the nodes of a full box lie, and what its ghost nodes stand for, as tables.

Along each axis stand ``cells`` interior nodes, half a cell from the ends of the box,
and one ghost node beyond either end. Across a wall a ghost is the mirror image of the
outermost interior node; along a periodic axis it is the interior node of the other end.
Along an edge or in a corner of the box both rules apply, axis by axis.

The kernels read these tables and know no faces, edges or corners. So two and three
dimensions, walls and periodic axes are one code path. Nodes are numbered with the last
axis running fastest, ghosts included.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Integers = NDArray[np.int32]
Singles = NDArray[np.float32]

LANES = 4
"""Numbers of a node or particle that the kernels hold in one vector."""


@dataclass(frozen=True)
class Ghosts:
    """What the ghost nodes copy: state(node) = sign x state(source) + drive."""

    node: Integers  # numbers of the ghost nodes, shape [ghost]
    source: Integers  # interior node that each copies, shape [ghost]
    # sign of each velocity component and of the density, shape [ghost, lane]
    sign: Singles
    wall: Integers  # the wall that moves the ghost, in the order of Box.walls' rows
    # what a ghost gets of its wall's velocity, shape [ghost, axis]
    drive: Singles


@dataclass(frozen=True)
class Images:
    """Which ghosts give their sums to which interior nodes beside them."""

    node: Integers  # interior nodes that have images, shape [edge]
    # the ghosts of each, one per set of axes that are crossed, or -1: [edge, image]
    ghost: Integers
    # sign of each velocity component and of J in what a ghost gives, [image, lane]
    sign: NDArray[np.int64]
    # the wall that each axis of an image crosses, or -1: [edge, image, axis]
    wall: Integers


class BoxTables:
    """Tables of one box.

    Args:
        cells: interior nodes along each axis.
        periodic: whether each axis repeats itself.
        no_slip: whether the walls hold the fluid; else it slides along them.
    """

    def __init__(
        self,
        cells: Sequence[int],
        *,
        periodic: Sequence[bool],
        no_slip: bool,
    ) -> None:
        self.dimension = len(cells)
        self.cells = tuple(cells)
        self.periodic = tuple(periodic)
        self.no_slip = no_slip
        # nodes along each axis, ghosts included
        self.shape = tuple(count + 2 for count in cells)
        self.node_count = math.prod(self.shape)
        # distance between the numbers of neighbours along each axis
        self.stride = tuple(
            math.prod(self.shape[axis + 1 :]) for axis in range(self.dimension)
        )
        # the multi-index of each node, 0 and cells + 1 for ghosts, shape [node, axis]
        self.index = np.indices(self.shape).reshape(self.dimension, -1).T
        self._last = np.array(self.cells)
        self._is_walled = ~np.array(self.periodic)
        # whether a node lies beyond an end of each axis, shape [node, axis]
        self._is_outside = (self.index < 1) | (self.index > self._last)
        self._is_ghost = self._is_outside.any(axis=1)
        # numbers of the interior nodes, shape [interior]
        self.interior = np.flatnonzero(~self._is_ghost).astype(np.int32)
        self.ghosts = self._ghosts()
        self.images = self._images()

    def _number(self, index: NDArray[np.integer]) -> Integers:
        """Return the numbers of nodes with these multi-indices."""
        return np.asarray((index * self.stride).sum(axis=-1), np.int32)

    def _reflection(self, axis: int) -> NDArray[np.int64]:
        """Return the signs with which a wall across an axis mirrors (v, a scalar)."""
        sign = np.ones(LANES, np.int64)
        if self.no_slip:
            sign[: self.dimension] = -1
        sign[axis] = -1
        return sign

    def _ghosts(self) -> Ghosts:
        node = np.flatnonzero(self._is_ghost).astype(np.int32)
        index = self.index[node]
        mirrored = np.clip(index, 1, self._last)
        # the node at the same place one period on
        wrapped = (index - 1) % self._last + 1
        source = self._number(np.where(self._is_walled, mirrored, wrapped))

        # whether a wall lies between a ghost and its source, shape [ghost, axis]
        is_across = self._is_outside[node] & self._is_walled
        sign = np.ones((len(node), LANES), np.float32)
        for axis in range(self.dimension):
            is_mirrored = is_across[:, axis, None]
            reflection = self._reflection(axis)
            sign *= np.where(is_mirrored, reflection, 1).astype(np.float32)

        # Only one wall moves a ghost; where two meet, none does.
        is_single = is_across.sum(axis=1) == 1
        normal = np.argmax(is_across, axis=1)
        index_along_normal = index[np.arange(len(node)), normal]
        wall = np.where(is_single, 2 * normal + (index_along_normal > 1), 0)

        is_other_axis = np.arange(self.dimension) != normal[:, None]
        is_tangential = is_single[:, None] & is_other_axis
        # In the last cells before a wall that the motion runs into it is halved.
        is_before_wall = ((index == 1) | (index == self._last)) & self._is_walled
        drive = np.where(is_before_wall, 1.0, 2.0) * is_tangential
        return Ghosts(
            node=node,
            source=source,
            sign=sign,
            wall=wall.astype(np.int32),
            drive=drive.astype(np.float32),
        )

    def _images(self) -> Images:
        interior_index = self.index[self.interior]
        is_end = (interior_index == 1) | (interior_index == self._last)
        has_images = is_end.any(axis=1)
        node = self.interior[has_images]
        index = interior_index[has_images]
        is_low = index == 1
        is_high = index == self._last
        # index of the ghost that stands for a node: the next one across a wall, the
        # one beyond the other end along a periodic axis
        is_below = np.where(self._is_walled, is_low, is_high)
        dimension = self.dimension
        beyond = np.where(is_below, 0, self._last + 1)
        wall_across = 2 * np.arange(dimension) + is_high

        # whether an image crosses each axis, one array per image
        subsets = np.array(list(itertools.product((False, True), repeat=dimension))[1:])
        ghost = np.full((len(node), len(subsets)), -1, np.int32)
        sign = np.ones((len(subsets), LANES), np.int64)
        wall = np.full((*ghost.shape, dimension), -1, np.int32)

        for image, subset in enumerate(subsets):
            exists = (is_low | is_high | ~subset).all(axis=1)
            number = self._number(np.where(subset, beyond, index))
            ghost[:, image] = np.where(exists, number, -1)
            walled_subset = subset & self._is_walled
            crosses_wall = exists[:, None] & walled_subset
            wall[:, image] = np.where(crosses_wall, wall_across, -1)
            for axis in np.flatnonzero(walled_subset).tolist():
                sign[image] *= self._reflection(axis)
        return Images(node=node, ghost=ghost, sign=sign, wall=wall)

    def ghost_drive(self, wall_velocity: Singles) -> Singles:
        """Return what moving walls add to the velocity of the ghosts [length/s].

        Args:
            wall_velocity: velocity of each wall [length/s], shape [scenario, 2 axis,
                axis]; rows of periodic axes are not read.

        Returns:
            Shape [scenario, ghost, lane].
        """
        ghosts = self.ghosts
        shape = (len(wall_velocity), len(ghosts.node), LANES)
        drive = np.zeros(shape, np.float32)
        ghost_wall_velocity = wall_velocity[:, ghosts.wall]
        drive[..., : self.dimension] = ghosts.drive * ghost_wall_velocity
        return drive

    def image_drag(self, wall_velocity: Singles) -> Singles:
        """Return the momentum per particle that moving walls give to what ghosts got.

        It is twice the tangential velocity of each wall that an image crosses.

        Args:
            wall_velocity: as in :meth:`ghost_drive`.

        Returns:
            [length/s], shape [scenario, edge, image, lane].
        """
        images = self.images
        shape = (len(wall_velocity), *images.ghost.shape, LANES)
        drag = np.zeros(shape, np.float32)
        twice_wall_velocity = np.float32(2.0) * wall_velocity
        axes = np.arange(self.dimension)
        for normal in axes.tolist():
            wall = images.wall[..., normal]
            momentum = twice_wall_velocity[:, np.maximum(wall, 0)]
            is_given = (wall >= 0)[..., None] & (axes != normal)
            momentum = np.where(is_given, momentum, np.float32(0.0))
            drag[..., : self.dimension] += momentum
        return drag
