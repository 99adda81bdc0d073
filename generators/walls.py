"""Ghost nodes of a closed box: which node mirrors which, and with what sign.

A wall lies half-way between an outermost interior node (``edge``) and the ghost node
beyond it (``ghost``). A vector's normal component is odd about the wall; its tangential
component is odd about the wall's own velocity where the wall holds the fluid, even
where it lets it slide. A ghost in a corner mirrors across both walls.
"""

import taichi as ti
from taichi import f32, i32
from taichi.math import vec2, vec4

from .transfer import Template, Value


@ti.data_oriented
class Walls:
    """The four walls of every scenario."""

    def __init__(self, *, grid: int, wall: int, no_slip: bool) -> None:
        """Set the indices; the field ``speed`` is the caller's to place."""
        low_ghost = wall
        high_ghost = grid - wall
        low_edge = low_ghost + 1
        high_edge = high_ghost - 1
        self.ghost = (low_ghost, high_ghost)  # indices of the ghost nodes
        self.edge = (low_edge, high_edge)  # of the outermost interior nodes
        # the same as ranges along either axis: first index, and the one behind the last
        self.all_nodes = (low_ghost, high_ghost + 1)
        self.interior_nodes = (low_edge, high_edge + 1)
        self.span = grid - 2 * wall
        self.ring_size = 4 * self.span  # number of ghost nodes around one scenario
        # sign with which a wall mirrors a tangential component
        self.tangential = 1
        if no_slip:
            self.tangential = -1
        # tangential velocity of each wall [length/s], order of WALLS; shape [scenario]
        self.speed = vec4.field()

    @ti.func
    def beyond(self, i: i32) -> i32:
        """Return the ghost index next to an outermost interior index; others stay."""
        ghost = i
        if i == self.edge[0]:
            ghost = self.ghost[0]
        if i == self.edge[1]:
            ghost = self.ghost[1]
        return ghost

    @ti.func
    def doubled_speed(self, s: i32, first: Template, ghost: i32) -> f32:
        """Return 2 u_wall of the wall before a ghost node [length/s].

        ``first`` is the index of the low wall of the pair.
        """
        speeds = self.speed[s]
        speed = speeds[first]
        if ghost == self.ghost[1]:
            speed = speeds[first + 1]
        return 2.0 * speed

    @ti.func
    def source(self, i: i32) -> i32:
        """Return the interior index that a ghost index mirrors; interior ones stay."""
        raised = ti.max(i, self.edge[0])
        return ti.min(raised, self.edge[1])

    @ti.func
    def ring(self, k: i32) -> Value:
        """Return the k-th ghost node: once around, from the low left corner."""
        side = k // self.span
        steps = k % self.span
        low = self.ghost[0]
        high = self.ghost[1]
        forth = low + steps
        back = high - steps
        i = low
        j = forth
        if side == 1:
            i = forth
            j = high
        if side == 2:
            i = high
            j = back
        if side == 3:
            i = back
            j = low
        return i, j

    @ti.func
    def reflection(self, i: i32, j: i32) -> vec2:
        """Return the signs with which a ghost node mirrors a vector."""
        tangential = float(self.tangential)
        sign = vec2(1.0)
        if i != self.source(i):
            sign = vec2(-1.0, tangential)
        if j != self.source(j):
            sign = vec2(sign.x * tangential, -sign.y)
        return sign

    @ti.func
    def drive(self, s: i32, i: i32, j: i32) -> vec2:
        """Return what moving walls add to a ghost's velocity [length/s].

        It is half as much in the last cells before a corner, and 0 in corners.
        """
        velocity = vec2(0.0)
        is_beyond_x_wall = i != self.source(i)
        is_beyond_y_wall = j != self.source(j)
        if is_beyond_x_wall and not is_beyond_y_wall:
            speed = self.doubled_speed(s, 0, i)
            if self.is_edge(j):
                speed = 0.5 * speed
            velocity.y = speed
        if is_beyond_y_wall and not is_beyond_x_wall:
            speed = self.doubled_speed(s, 2, j)
            if self.is_edge(i):
                speed = 0.5 * speed
            velocity.x = speed
        return velocity

    @ti.func
    def is_edge(self, i: i32) -> Value:
        """Tell whether an index is that of an outermost interior node."""
        return i == self.edge[0] or i == self.edge[1]
