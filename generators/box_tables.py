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
        shape = [count + 2 for count in cells]
        self.shape = tuple(shape)
        self.node_count = math.prod(self.shape)
        # distance between the numbers of neighbours along each axis
        strides = []
        for axis in range(self.dimension):
            later_axes = self.shape[axis + 1 :]
            stride = math.prod(later_axes)
            strides.append(stride)
        self.stride = tuple(strides)
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

    def _tangential_sign(self) -> int:
        """Return the sign with which a wall mirrors a tangential component."""
        if self.no_slip:
            return -1
        return 1

    def _reflection(self, axis: int) -> NDArray[np.int64]:
        """Return the signs with which a wall across an axis mirrors (v, a scalar)."""
        tangential_sign = self._tangential_sign()
        sign = np.ones(LANES, np.int64)
        dimension = self.dimension
        sign[:dimension] = tangential_sign
        sign[axis] = -1
        return sign

    def _ghosts(self) -> Ghosts:
        node = np.flatnonzero(self._is_ghost).astype(np.int32)
        index = self.index[node]
        mirrored = np.clip(index, 1, self._last)
        # the node at the same place one period on
        wrapped = (index - 1) % self._last + 1
        source_index = np.where(self._is_walled, mirrored, wrapped)
        source = self._number(source_index)

        # whether a wall lies between a ghost and its source, shape [ghost, axis]
        is_outside = self._is_outside[node]
        is_across = is_outside & self._is_walled
        ghost_count = len(node)
        sign_shape = (ghost_count, LANES)
        sign = np.ones(sign_shape, np.float32)
        dimension = self.dimension
        for axis in range(dimension):
            is_axis_across = is_across[:, axis]
            is_mirrored = is_axis_across[:, None]
            reflection = self._reflection(axis)
            sign *= np.where(is_mirrored, reflection, 1).astype(np.float32)

        # Only one wall moves a ghost; where two meet, none does.
        is_single = is_across.sum(axis=1) == 1
        normal = np.argmax(is_across, axis=1)
        ghosts = np.arange(ghost_count)
        index_along_normal = index[ghosts, normal]
        wall = np.where(is_single, 2 * normal + (index_along_normal > 1), 0)

        axes = np.arange(dimension)
        ghost_normal = normal[:, None]
        has_one_wall = is_single[:, None]
        is_tangential = has_one_wall & (axes != ghost_normal)
        # In the last cells before a wall that the motion runs into it is halved.
        is_before_wall = ((index == 1) | (index == self._last)) & self._is_walled
        drive = np.where(is_before_wall, 1.0, 2.0) * is_tangential
        wall = wall.astype(np.int32)
        drive = drive.astype(np.float32)
        return Ghosts(
            node=node,
            source=source,
            sign=sign,
            wall=wall,
            drive=drive,
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
        subsets = []
        choices = (False, True)
        for crossed in itertools.product(choices, repeat=dimension):
            if any(crossed):
                subset = np.array(crossed)
                subsets.append(subset)
        edge_count = len(node)
        image_count = len(subsets)
        image_shape = (edge_count, image_count)
        sign_shape = (image_count, LANES)
        wall_shape = (edge_count, image_count, dimension)
        ghost = np.full(image_shape, -1, np.int32)
        sign = np.ones(sign_shape, np.int64)
        wall = np.full(wall_shape, -1, np.int32)

        for image, subset in enumerate(subsets):
            exists = (is_low | is_high | ~subset).all(axis=1)
            ghost_index = np.where(subset, beyond, index)
            number = self._number(ghost_index)
            ghost[:, image] = np.where(exists, number, -1)

            walled_subset = subset & self._is_walled
            image_exists = exists[:, None]
            wall[:, image] = np.where(image_exists & walled_subset, wall_across, -1)

            walled_axes = np.flatnonzero(walled_subset)
            for axis in walled_axes.tolist():
                reflection = self._reflection(axis)
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
        scenario_count = len(wall_velocity)
        ghost_count = len(ghosts.node)
        shape = (scenario_count, ghost_count, LANES)
        drive = np.zeros(shape, np.float32)
        wall = ghosts.wall
        ghost_wall_velocity = wall_velocity[:, wall]
        dimension = self.dimension
        drive[..., :dimension] = ghosts.drive * ghost_wall_velocity
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
        scenario_count = len(wall_velocity)
        image_shape = images.ghost.shape
        shape = (scenario_count, *image_shape, LANES)
        drag = np.zeros(shape, np.float32)
        zero = np.float32(0.0)
        twice_wall_velocity = np.float32(2.0) * wall_velocity
        dimension = self.dimension
        axes = np.arange(dimension)
        for normal in range(dimension):
            wall = images.wall[..., normal]
            is_crossed = wall >= 0
            is_tangential = axes != normal
            some_wall = np.maximum(wall, 0)
            momentum = twice_wall_velocity[:, some_wall]
            is_image_across = is_crossed[..., None]
            momentum = np.where(is_image_across & is_tangential, momentum, zero)
            drag[..., :dimension] += momentum
        return drag
