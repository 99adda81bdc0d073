"""Ghost nodes of a closed box: which node mirrors which, and with what sign.

A wall lies half-way between an outermost interior node (``edge``) and the ghost node
beyond it (``ghost``). A vector's normal component is odd about the wall; its tangential
component is odd about the wall's own velocity where the wall holds the fluid, even
where it lets it slide. A ghost in a corner mirrors across both walls.
"""

import taichi as ti

from .transfer import Template, Value


@ti.data_oriented
class Walls:
    """The four walls of every scenario."""

    def __init__(self, *, grid: int, wall: int, no_slip: bool) -> None:
        """Set the indices; the field ``speed`` is the caller's to place."""
        self.ghost = (wall, grid - wall)  # low and high index of the ghost nodes
        # low and high index of the interior nodes
        self.edge = (wall + 1, grid - wall - 1)
        self.span = grid - 2 * wall
        self.ring_size = 4 * self.span  # number of ghost nodes around one scenario
        # sign with which a wall mirrors a tangential component
        self.tangential = 1
        if no_slip:
            self.tangential = -1
        # tangential velocity of each wall [length/s], order of WALLS; shape [scenario]
        self.speed = ti.Vector.field(4, ti.f32)

    @ti.func
    def beyond(self, i: ti.i32) -> ti.i32:
        """Return the ghost index next to an outermost interior index; others stay."""
        ghost = i
        if i == self.edge[0]:
            ghost = self.ghost[0]
        if i == self.edge[1]:
            ghost = self.ghost[1]
        return ghost

    @ti.func
    def doubled_speed(self, s: ti.i32, first: Template, ghost: ti.i32) -> ti.f32:
        """Return 2 u_wall of the wall before a ghost node [length/s].

        ``first`` is the index of the low wall of the pair.
        """
        speed = self.speed[s][first]
        if ghost == self.ghost[1]:
            speed = self.speed[s][first + 1]
        return 2.0 * speed

    @ti.func
    def source(self, i: ti.i32) -> ti.i32:
        """Return the interior index that a ghost index mirrors; interior ones stay."""
        return ti.min(ti.max(i, self.edge[0]), self.edge[1])

    @ti.func
    def ring(self, k: ti.i32) -> Value:
        """Return the k-th ghost node: once around, from the low left corner."""
        side = k // self.span
        along = k % self.span
        low = self.ghost[0]
        high = self.ghost[1]
        i = low
        j = low + along
        if side == 1:
            i = low + along
            j = high
        if side == 2:
            i = high
            j = high - along
        if side == 3:
            i = high - along
            j = low
        return i, j

    @ti.func
    def reflection(self, i: ti.i32, j: ti.i32) -> ti.math.vec2:
        """Return the signs with which a ghost node mirrors a vector."""
        tangential = float(self.tangential)
        sign = ti.Vector([1.0, 1.0])
        if i != self.source(i):
            sign = ti.Vector([-1.0, tangential])
        if j != self.source(j):
            sign = ti.Vector([sign[0] * tangential, -sign[1]])
        return sign

    @ti.func
    def drive(self, s: ti.i32, i: ti.i32, j: ti.i32) -> ti.math.vec2:
        """Return what moving walls add to a ghost's velocity [length/s].

        It is half as much in the last cells before a corner, and 0 in corners.
        """
        velocity = ti.Vector([0.0, 0.0])
        across_x = i != self.source(i)
        across_y = j != self.source(j)
        if across_x and not across_y:
            velocity[1] = self.doubled_speed(s, 0, i)
            if j == self.edge[0] or j == self.edge[1]:
                velocity[1] = 0.5 * velocity[1]
        if across_y and not across_x:
            velocity[0] = self.doubled_speed(s, 2, j)
            if i == self.edge[0] or i == self.edge[1]:
                velocity[0] = 0.5 * velocity[0]
        return velocity
