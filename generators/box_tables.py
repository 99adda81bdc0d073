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
        strides = []
        for axis in range(self.dimension):
            later_axes = self.shape[axis + 1 :]
            strides.append(math.prod(later_axes))
        self.stride = tuple(strides)
        # the multi-index of each node, 0 and cells + 1 for ghosts, shape [node, axis]
        indices = np.indices(self.shape)
        self.index = indices.reshape(self.dimension, -1).T
        self._last = np.array(self.cells)
        self._is_walled = ~np.array(self.periodic)
        is_below = self.index < 1
        is_above = self.index > self._last
        self._is_outside = is_below | is_above
        # numbers of the interior nodes, shape [interior]
        is_interior = ~self._is_outside.any(axis=1)
        self.interior = np.flatnonzero(is_interior).astype(np.int32)
        self.ghosts = self._ghosts()
        self.images = self._images()

    def _number(self, index: NDArray[np.integer]) -> Integers:
        """Return the numbers of nodes with these multi-indices."""
        steps = index * self.stride
        return np.asarray(steps.sum(axis=-1), np.int32)

    def _tangential_sign(self) -> int:
        """Return the sign with which a wall mirrors a tangential component."""
        if self.no_slip:
            return -1
        return 1

    def _reflection(self, axis: int) -> NDArray[np.int64]:
        """Return the signs with which a wall across an axis mirrors (v, a scalar)."""
        sign = np.ones(LANES, np.int64)
        sign[: self.dimension] = self._tangential_sign()
        sign[axis] = -1
        return sign

    def _ghosts(self) -> Ghosts:
        is_ghost = self._is_outside.any(axis=1)
        node = np.flatnonzero(is_ghost).astype(np.int32)
        index = self.index[node]
        mirrored = np.clip(index, 1, self._last)
        from_first = index - 1
        wrapped = from_first % self._last + 1
        source_index = np.where(self._is_walled, mirrored, wrapped)
        source = self._number(source_index)

        # whether a wall lies between a ghost and its source, shape [ghost, axis]
        is_across = self._is_outside[node] & self._is_walled
        ghost_count = len(node)
        sign_shape = (ghost_count, LANES)
        sign = np.ones(sign_shape, np.float32)
        for axis in range(self.dimension):
            is_mirrored = is_across[:, axis, None]
            reflection = self._reflection(axis)
            factor = np.where(is_mirrored, reflection, 1)
            sign *= factor.astype(np.float32)

        # Only one wall moves a ghost; where two meet, none does.
        wall_count = is_across.sum(axis=1)
        is_single = wall_count == 1
        normal = np.argmax(is_across, axis=1)
        ghosts = np.arange(ghost_count)
        index_along_normal = index[ghosts, normal]
        is_upper = index_along_normal > 1
        nearest_wall = 2 * normal + is_upper
        wall = np.where(is_single, nearest_wall, 0)
        axes = np.arange(self.dimension)
        is_along_wall = axes != normal[:, None]
        is_tangential = is_single[:, None] & is_along_wall
        # In the last cells before a wall that the motion runs into it is halved.
        is_first = index == 1
        is_last = index == self._last
        is_before_wall = (is_first | is_last) & self._is_walled
        share = np.where(is_before_wall, 1.0, 2.0)
        drive = share * is_tangential
        return Ghosts(
            node=node,
            source=source,
            sign=sign,
            wall=wall.astype(np.int32),
            drive=drive.astype(np.float32),
        )

    def _images(self) -> Images:
        interior_index = self.index[self.interior]
        is_low = interior_index == 1
        is_high = interior_index == self._last
        has_images = (is_low | is_high).any(axis=1)
        node = self.interior[has_images]
        index = interior_index[has_images]
        is_low = is_low[has_images]
        is_high = is_high[has_images]
        # index of the ghost that stands for a node: the next one across a wall, the
        # one beyond the other end along a periodic axis
        is_below = np.where(self._is_walled, is_low, is_high)
        beyond = np.where(is_below, 0, self._last + 1)
        low_wall = 2 * np.arange(self.dimension)
        wall_across = low_wall + is_high

        subsets = []
        for crossed in itertools.product((False, True), repeat=self.dimension):
            if any(crossed):
                subsets.append(np.array(crossed))
        edge_count = len(node)
        image_count = len(subsets)
        image_shape = (edge_count, image_count)
        sign_shape = (image_count, LANES)
        wall_shape = (edge_count, image_count, self.dimension)
        ghost = np.full(image_shape, -1, np.int32)
        sign = np.ones(sign_shape, np.int64)
        wall = np.full(wall_shape, -1, np.int32)
        for image, subset in enumerate(subsets):
            may_cross = is_low | is_high | ~subset
            exists = may_cross.all(axis=1)
            ghost_index = np.where(subset, beyond, index)
            number = self._number(ghost_index)
            ghost[:, image] = np.where(exists, number, -1)
            walled_subset = subset & self._is_walled
            crosses_wall = exists[:, None] & walled_subset
            wall[:, image] = np.where(crosses_wall, wall_across, -1)
            for axis in np.flatnonzero(walled_subset):
                reflection = self._reflection(int(axis))
                sign[image] *= reflection
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
        moved = wall_velocity[:, ghosts.wall]
        drive[..., : self.dimension] = ghosts.drive * moved
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
        axes = np.arange(self.dimension)
        twice_wall_velocity = np.float32(2.0) * wall_velocity
        for normal in range(self.dimension):
            wall = images.wall[..., normal]
            is_crossed = wall >= 0
            is_tangential = axes != normal
            some_wall = np.maximum(wall, 0)
            momentum = twice_wall_velocity[:, some_wall]
            counts = is_crossed[..., None] & is_tangential
            momentum = np.where(counts, momentum, np.float32(0.0))
            drag[..., : self.dimension] += momentum
        return drag
