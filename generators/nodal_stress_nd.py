"""One substep of weakly compressible flow in two or three dimensions.

The equations are those of :mod:`.nodal_stress` in d dimensions, with a force f per mass
that acts at the nodes:

1. P2G: n_i = sum w,  (n J)_i = sum w J_p,  (n v)_i = sum w (v_p + C_p (x_i - x_p)).
2. Fold: ghosts give what they received to the nodes that they stand for
   (:mod:`.box_tables`), then v = (n v)/n,  Jbar = (n J)/n,  r = n m / (rho dx^d).
3. Forces: a = (E/rho) grad Jbar + nu lap v + f,  v <- v + dt a. Gradients are central
   differences, weighted 1/8, 3/4, 1/8 along every other axis. In a fringe f also holds
   sigma (U - v), which draws the velocity to the stream U (Nordstrom, Nordin and
   Henningson, SIAM J. Sci. Comput. 20 (1999) 1365). Nodes inside an obstacle are at
   rest: v = 0, a = 0.
4. G2P as in two dimensions. Particles stay between walls, and are wrapped along
   periodic axes. Particles of the fluid that would enter an obstacle are put on its
   surface. Those of an obstacle neither move nor get a velocity, but their J follows
   that of the nodes, so that the pressure goes on inside.

In a square with four walls the bits are those of :mod:`.nodal_stress`, which is faster
there. Sums are integers (:mod:`.transfer`): no order of particles or threads changes a
bit. The numbers n are summed in rows of three nodes, so that P2G adds vectors of four
throughout: component k of ``rows`` at a node counts for the k-th node from there along
the last axis.

Valid while max abs(v) dt <= dx and while J stays in (0, 8].
"""

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from . import backend
from .box_tables import LANES, BoxTables
from .full_box_parameters import FullBoxParameters
from .nodal_stress import JACOBIAN_BOUND
from .obstacle import Obstacle, is_inside
from .transfer import (
    Nothing,
    Template,
    Value,
    add_shifted,
    bounded,
    fixed_point_scale,
    from_fixed,
    largest,
    node_number,
    row_count,
    spline_weights,
    stepped,
)

_INSET = 1e-3  # distance that particles keep from a wall [cells]
_REACH = {2: 16.0, 3: 32.0}
"""Bound of abs(v_p + C (x_i - x_p)) over the speed bound dx/dt [1], by dimension: 1 +
2 x 4 x 1.5 = 13 and 1 + 3 x 4 x 1.5 = 19; :mod:`.nodal_stress` says why.
"""


@ti.data_oriented
class NodalStressND:
    """Fields of a batch of scenarios and the kernels that advance them."""

    def __init__(
        self,
        parameters: FullBoxParameters,
        *,
        scenarios: int,
        atomic: bool,
        threads: int,
    ) -> None:
        """Round the constants, make the tables and take the memory."""
        p = parameters
        dx = 1.0 / p.grid
        self.parameters = parameters  # constants that the scenarios share
        self.scenarios = scenarios  # scenarios advanced together
        self.atomic = atomic  # whether several threads run the phases
        self.threads = threads  # threads of the parallel loops on a CPU
        self.dimension = p.box.dimension
        self.periodic = p.box.periodic
        self.has_walls = not all(p.box.periodic)
        self.has_obstacle = p.obstacle_particles > 0
        self.has_fringe = p.fringe_rate > 0.0
        # particles of the fluid, and behind them those of the obstacle
        self.particles = p.particles + p.obstacle_particles
        self.cells = p.cells
        self.tables = BoxTables(p.cells, periodic=p.box.periodic, no_slip=p.no_slip)
        self.inv_dx = float(p.grid)
        self.dt = p.dt
        self.origin = p.origin  # coordinate of node 0 of each axis [cells]
        inset = np.where(p.box.periodic, 0.0, _INSET * dx)
        # smallest and largest coordinate of a particle along each axis
        self.least = (np.array(p.box.low) + inset).tolist()
        self.most = (np.array(p.box.high) - inset).tolist()
        self.period = p.box.lengths.tolist()
        self.speed_bound = dx / p.dt  # the CFL bound dx/dt [length/s]
        speed_reach = _REACH[self.dimension] * self.speed_bound
        self.velocity_scale = fixed_point_scale(self.particles, speed_reach)
        self.count_scale = fixed_point_scale(self.particles, JACOBIAN_BOUND)
        self.velocity_unit = 1.0 / self.velocity_scale
        self.count_unit = 1.0 / self.count_scale
        self.cell_scale = self.velocity_scale * dx
        self.pressure = p.dt * p.modulus / (p.density * 2.0 * dx)
        self.gradient = 4.0 * self.inv_dx
        self.shift = -p.shift * dx * dx
        self.shift_bound = 0.1 * dx
        self.image_signs = self.tables.images.sign.tolist()
        self._make_stencils()
        self._declare_fields()
        self._tree = self._place_fields()
        self._fill_tables()

    def _make_stencils(self) -> None:
        """List the neighbours of a node, which the kernels unroll."""
        steps = (-1, 0, 1)
        # the rows of three nodes that a particle touches: steps along all but the last
        # axis
        self.row_steps = tuple(itertools.product(steps, repeat=self.dimension - 1))
        # one of each pair of opposite neighbours, with the weight of their difference
        # in a gradient; nearest first
        pairs = []
        for step in itertools.product((1, 0, -1), repeat=self.dimension):
            if step > (0,) * self.dimension:
                pairs.append(step)
        self.pairs = tuple(sorted(pairs, key=_axis_count))
        # weight of the pairs that differ along so many axes, less one
        self.pair_weight = tuple(
            0.75 ** (self.dimension - 1 - more) * 0.125**more
            for more in range(self.dimension)
        )

    def _declare_fields(self) -> None:
        """Name the fields; they have no memory yet."""
        # particle positions [length], and the largest -J since the advance began
        self.x = ti.Vector.field(LANES, ti.f32)
        self.carried = ti.Vector.field(LANES, ti.f32)  # v_p, J_p
        self.at_rest = (0.0, 0.0, 0.0, 1.0)  # of a particle at rest
        # derivative of the nodal (v, r) at the particles, along each axis
        self.slopes = [ti.Vector.field(LANES, ti.f32) for _ in range(self.dimension)]
        # largest abs(v) by component, and J, of each particle since the advance began
        self.extremes = ti.Vector.field(LANES, ti.f32)
        # the three weights of a particle along each axis
        self.weights = [ti.Vector.field(LANES, ti.f32) for _ in range(self.dimension)]
        # offset from the middle node [cells], and the bits of the lowest node's number
        self.spot = ti.Vector.field(LANES, ti.f32)
        self.here = ti.Vector.field(LANES, ti.f32)  # nodal v, r at the particles
        self.push = ti.Vector.field(LANES, ti.f32)  # nodal dt a, Jbar at the particles

        self.sums = ti.Vector.field(LANES, ti.i64)  # n v, n J
        self.rows = ti.Vector.field(LANES, ti.i64)  # n of three nodes in a row
        self.count = ti.field(ti.i64)  # n
        self.drag = ti.Vector.field(LANES, ti.f32)  # what moving walls add to n v
        self.node = ti.Vector.field(LANES, ti.f32)  # v, r
        self.moved = ti.Vector.field(LANES, ti.f32)  # the same after the forces
        self.ratio = ti.field(ti.f32)  # Jbar
        self.gain = ti.Vector.field(LANES, ti.f32)  # dt a, Jbar
        # largest absolute velocity component since the advance began
        self.peak = ti.field(ti.f32)
        self.spread = ti.field(ti.f32)  # nu dt / dx^2, shape [scenario]
        self.fill = ti.field(ti.f32)  # m / (rho dx^d), shape [scenario]
        # 1 at nodes of the fluid, 0 at those at rest inside an obstacle
        self.open = ti.field(ti.f32)
        # centre of the obstacle, and the least distance from it [length]
        self.obstacle = ti.Vector.field(LANES, ti.f32)
        self.damping = ti.field(ti.f32)  # dt sigma of the fringe, shape [node]
        self.stream = ti.Vector.field(LANES, ti.f32)  # U, shape [scenario]

        # tables, shape [ghost], [edge], [edge, image], [interior] and [node]
        self.ghost = ti.field(ti.i32)
        self.source = ti.field(ti.i32)
        self.sign = ti.Vector.field(LANES, ti.f32)
        self.edge = ti.field(ti.i32)
        self.image = ti.field(ti.i32)
        self.interior = ti.field(ti.i32)
        self.layer = ti.field(ti.i32)
        # what walls and forces do now, shape [scenario, ghost], [scenario, edge,
        # image] and [scenario, layer]
        self.drive = ti.Vector.field(LANES, ti.f32)  # added to a ghost's v
        self.image_drag = ti.Vector.field(LANES, ti.f32)  # n v per particle
        self.force = ti.Vector.field(LANES, ti.f32)  # dt f

    def _place_fields(self) -> Any:  # noqa: ANN401 (Taichi is untyped)
        """Give the fields their memory, each an array of its own."""
        particle_fields = (
            self.x,
            self.carried,
            *self.slopes,
            self.extremes,
            *self.weights,
            self.spot,
            self.here,
            self.push,
        )
        node_fields = (
            self.sums,
            self.count,
            self.drag,
            self.node,
            self.moved,
            self.ratio,
            self.gain,
            self.peak,
        )
        tables = self.tables
        particle_shape = (self.scenarios, self.particles)
        node_shape = (self.scenarios, tables.node_count)
        # Two more: a node counts the rows of the two nodes before it as well.
        row_shape = (self.scenarios, tables.node_count + 2)
        ghost_shape = tables.ghosts.node.shape
        image_shape = tables.images.ghost.shape
        layer_count = max(1, self.parameters.force_layers)
        obstacle_shape = node_shape if self.has_obstacle else (1, 1)
        fringe_shape = (tables.node_count,) if self.has_fringe else (1,)
        return backend.place(
            *((particle_shape, [field]) for field in particle_fields),
            *((node_shape, [field]) for field in node_fields),
            (row_shape, [self.rows]),
            *((ghost_shape, [field]) for field in (self.ghost, self.source, self.sign)),
            (tables.images.node.shape, [self.edge]),
            (image_shape, [self.image]),
            (tables.interior.shape, [self.interior]),
            ((tables.node_count,), [self.layer]),
            ((self.scenarios, *ghost_shape), [self.drive]),
            ((self.scenarios, *image_shape), [self.image_drag]),
            ((self.scenarios, layer_count), [self.force]),
            ((self.scenarios,), [self.spread, self.fill]),
            (obstacle_shape, [self.open]),
            ((self.scenarios,), [self.obstacle, self.stream]),
            (fringe_shape, [self.damping]),
        )

    def _fill_tables(self) -> None:
        tables = self.tables
        self.ghost.from_numpy(tables.ghosts.node)
        self.source.from_numpy(tables.ghosts.source)
        self.sign.from_numpy(tables.ghosts.sign)
        self.edge.from_numpy(tables.images.node)
        self.image.from_numpy(tables.images.ghost)
        self.interior.from_numpy(tables.interior)
        # the layer of each node along y; ghosts belong to the nearest one
        row = np.clip(tables.index[:, 1] - 1, 0, self.cells[1] - 1)
        layer = row * max(1, self.parameters.force_layers) // self.cells[1]
        self.layer.from_numpy(layer.astype(np.int32))
        if self.has_fringe:
            rates = self.parameters.fringe_rates(self._node_places()[:, 0])
            self.damping.from_numpy((self.dt * rates).astype(np.float32))

    def _node_places(self) -> NDArray[np.float64]:
        """Return where the nodes lie [length], ghosts included, shape [node, axis]."""
        place = (self.tables.index + np.array(self.origin)) / self.inv_dx
        return np.asarray(place)

    def move_walls(self, velocity: NDArray[np.float32]) -> None:
        """Let walls slide [length/s], shape [scenario, 2 axis, axis]."""
        self.drive.from_numpy(self.tables.ghost_drive(velocity))
        self.image_drag.from_numpy(self.tables.image_drag(velocity))

    def apply_force(self, acceleration: NDArray[np.float32]) -> None:
        """Let a force act [length/s^2], shape [scenario, layer, axis]."""
        scenarios, layers, dimension = acceleration.shape
        gain = np.zeros((scenarios, layers, LANES), np.float32)
        gain[..., :dimension] = np.float32(self.dt) * acceleration
        self.force.from_numpy(gain)

    def place_obstacles(self, obstacles: Sequence[Obstacle]) -> None:
        """Set the nodes that each scenario's obstacle holds at rest."""
        place = self._node_places()
        is_open = np.empty((self.scenarios, len(place)), np.float32)
        values = np.zeros((self.scenarios, LANES), np.float32)
        for index, obstacle in enumerate(obstacles):
            is_open[index] = ~is_inside(place, obstacle.centre, obstacle.radius)
            values[index, : self.dimension] = obstacle.centre
            values[index, 3] = obstacle.radius + _INSET / self.inv_dx
        self.open.from_numpy(is_open)
        self.obstacle.from_numpy(values)

    def set_stream(self, velocity: NDArray[np.float32]) -> None:
        """Let the fringe draw to a velocity [length/s], shape [scenario, axis]."""
        stream = np.zeros((self.scenarios, LANES), np.float32)
        stream[:, : self.dimension] = velocity
        self.stream.from_numpy(stream)

    def release(self) -> None:
        """Give the memory back; the fields cannot be used afterwards."""
        self._tree.destroy()

    # The phases: each function is one phase at one particle or node.

    @ti.func
    def clear(self, s: ti.i32, n: ti.i32) -> None:
        """Set a node's sums to zero."""
        zero = ti.Vector([0, 0, 0, 0], ti.i64)
        self.sums[s, n] = zero
        self.rows[s, n + 2] = zero

    @ti.func
    def locate(self, s: ti.i32, p: ti.i32) -> None:
        """Keep for P2G and G2P which nodes a particle touches, and the weights."""
        number = 0
        offset = ti.Vector([0.0, 0.0, 0.0])
        for axis in ti.static(range(self.dimension)):
            scaled = self.x[s, p][axis] * self.inv_dx - ti.static(self.origin[axis])
            # A periodic coordinate may round up to the end of its last cell.
            last = ti.static(self.cells[axis] - 1)
            lowest = ti.min(ti.cast(scaled - 0.5, ti.i32), last)
            f = scaled - ti.cast(lowest, ti.f32)
            low, mid, high = spline_weights(f)
            self.weights[axis][s, p] = ti.Vector([low, mid, high, 0.0])
            offset[axis] = f - 1.0
            number += lowest * ti.static(self.tables.stride[axis])
        bits = ti.bit_cast(number, ti.f32)
        self.spot[s, p] = ti.Vector([offset[0], offset[1], offset[2], bits])

    @ti.func
    def load_along(self, fields: Template, s: ti.i32, p: ti.i32) -> Value:
        """Return a particle's vectors in three fields: one field for each of x, y, z.

        In two dimensions the third is zero. Callers load before they write anything:
        LLVM cannot know that the fields do not overlap, and would read again after each
        write.
        """
        third = ti.Vector([0.0, 0.0, 0.0, 0.0])
        if ti.static(self.dimension == 3):
            third = fields[2][s, p]
        return fields[0][s, p], fields[1][s, p], third

    @ti.func
    def row_shares(
        self,
        weight_x: ti.math.vec4,
        weight_y: ti.math.vec4,
        weight_z: ti.math.vec4,
        step: Template,
    ) -> Value:
        """Return the weights of the three nodes of a row, and a zero."""
        shares = weight_x[step[0] + 1] * weight_y
        if ti.static(self.dimension == 3):
            shares = (weight_x[step[0] + 1] * weight_y[step[1] + 1]) * weight_z
        return shares

    @ti.func
    def row_start(self, lowest: ti.i32, step: Template) -> ti.i32:
        """Return the number of the first node of a row."""
        number = lowest
        for axis in ti.static(range(self.dimension - 1)):
            number += ti.static((step[axis] + 1) * self.tables.stride[axis])
        return number

    @ti.func
    def p2g(self, s: ti.i32, p: ti.i32) -> None:
        """Spread n v, n and n J, from the middle node to its neighbours, dx away."""
        spot = self.spot[s, p]
        lowest = node_number(spot[3], self.tables.node_count)
        weight_x, weight_y, weight_z = self.load_along(self.weights, s, p)
        slope_x, slope_y, slope_z = self.load_along(self.slopes, s, p)
        # Weights carry the scale of n and J, so that v lacks the rest of its own. All
        # are powers of two, which round nothing.
        weight_x = self.count_scale * weight_x
        rest = ti.static(self.velocity_scale / self.count_scale)
        scale = ti.Vector([rest, rest, rest, 1.0])
        # J has no slope; a product with 0 is one, as nodes, and so slopes, are finite.
        cell = ti.static(self.cell_scale / self.count_scale)
        only_v = ti.Vector([cell, cell, cell, 0.0])
        c_x = only_v * slope_x
        c_y = only_v * slope_y
        c_z = only_v * slope_z
        middle = scale * self.carried[s, p] - spot[0] * c_x - spot[1] * c_y
        if ti.static(self.dimension == 3):
            middle = middle - spot[2] * c_z
        for step in ti.static(self.row_steps):
            shares = self.row_shares(weight_x, weight_y, weight_z, step)
            start = self.row_start(lowest, step)
            value = stepped(middle, c_x, step[0])
            along = c_y
            if ti.static(self.dimension == 3):
                value = stepped(value, c_y, step[1])
                along = c_z
            for k in ti.static(range(3)):
                share = shares[k] * stepped(value, along, k - 1)
                add_shifted(self.sums, ti.Vector([s, start + k]), share, self.atomic)
            # The fourth share is 0, so that the fourth sum counts shifts.
            add_shifted(self.rows, ti.Vector([s, start + 2]), shares, self.atomic)

    @ti.func
    def settle(self, s: ti.i32, n: ti.i32) -> None:
        """Take the shifts off a node's sums, and add up its n from three rows."""
        count, shifts = row_count(self.rows, s, n)
        self.sums[s, n] = self.sums[s, n] - shifts
        self.count[s, n] = count

    @ti.func
    def image_sign(self, k: Template) -> Value:
        """Return the signs with which the k-th image of a node counts for (v, J)."""
        signs = ti.static(self.image_signs[k])
        return ti.Vector([signs[0], signs[1], signs[2], signs[3]], ti.i64)

    @ti.func
    def add_images(self, s: ti.i32, e: ti.i32) -> None:
        """Add to a node beside ghosts what its images received, and the walls' drag."""
        n = self.edge[e]
        total = self.sums[s, n]
        count = self.count[s, n]
        drag = ti.Vector([0.0, 0.0, 0.0, 0.0])
        for k in ti.static(range(self.tables.images.ghost.shape[1])):
            ghost = self.image[e, k]
            if ghost >= 0:
                total += self.image_sign(k) * self.sums[s, ghost]
                count += self.count[s, ghost]
                if ti.static(self.has_walls):
                    ghost_count = from_fixed(self.count[s, ghost], self.count_unit)
                    drag += self.image_drag[s, e, k] * ghost_count
        self.sums[s, n] = total
        self.count[s, n] = count
        self.drag[s, n] = drag

    @ti.func
    def fold(self, s: ti.i32, n: ti.i32, fill: ti.f32) -> None:
        """Turn the sums of an interior node into v, r and Jbar."""
        state = ti.Vector([0.0, 0.0, 0.0, 0.0])
        ratio = 1.0
        if self.count[s, n] > 0:
            total = self.sums[s, n]
            count = from_fixed(self.count[s, n], self.count_unit)
            momentum = from_fixed(total, self.velocity_unit) + self.drag[s, n]
            v = momentum / count
            ratio = from_fixed(total[3], self.count_unit) / count
            state = ti.Vector([v[0], v[1], v[2], count * fill])
        self.node[s, n] = state
        self.ratio[s, n] = ratio

    @ti.func
    def mirror(self, s: ti.i32, g: ti.i32) -> None:
        """Fill a ghost node before the forces."""
        n = self.ghost[g]
        source = self.source[g]
        self.node[s, n] = self.sign[g] * self.node[s, source] + self.drive[s, g]
        self.ratio[s, n] = self.ratio[s, source]

    @ti.func
    def mirror_moved(self, s: ti.i32, g: ti.i32) -> None:
        """Fill a ghost node after the forces; walls at rest mirror dt a."""
        n = self.ghost[g]
        source = self.source[g]
        self.moved[s, n] = self.sign[g] * self.moved[s, source] + self.drive[s, g]
        self.gain[s, n] = self.sign[g] * self.gain[s, source]

    @ti.func
    def neighbour(self, n: ti.i32, step: Template, side: Template) -> ti.i32:
        """Return the number of a node's neighbour, or of the opposite one."""
        number = n
        for axis in ti.static(range(self.dimension)):
            number += ti.static(side * step[axis] * self.tables.stride[axis])
        return number

    @ti.func
    def add_forces(self, s: ti.i32, n: ti.i32) -> None:
        """Add dt a = dt (E/rho) grad Jbar + dt nu lap v + dt f."""
        here = self.node[s, n]
        zero = ti.Vector([0.0, 0.0, 0.0, 0.0])
        # differences of Jbar, by the number of axes along which the pairs differ
        rises = ti.Matrix([[0.0] * 3] * 3)
        around = zero
        for step in ti.static(self.pairs):
            ahead = self.neighbour(n, step, 1)
            behind = self.neighbour(n, step, -1)
            rise = self.ratio[s, ahead] - self.ratio[s, behind]
            more = ti.static(_axis_count(step) - 1)
            for axis in ti.static(range(self.dimension)):
                rises[more, axis] = stepped(rises[more, axis], rise, step[axis])
            if ti.static(more == 0):
                around = around + (self.node[s, ahead] + self.node[s, behind])
        gradient = zero
        for axis in ti.static(range(self.dimension)):
            slope = ti.static(self.pair_weight[0]) * rises[0, axis]
            for more in ti.static(range(1, self.dimension)):
                slope = slope + ti.static(self.pair_weight[more]) * rises[more, axis]
            gradient[axis] = slope
        laplacian = around - ti.static(2.0 * self.dimension) * here
        gain = self.pressure * gradient + self.spread[s] * laplacian
        if ti.static(self.parameters.force_layers > 0):
            gain = gain + self.force[s, self.layer[n]]
        if ti.static(self.has_fringe):
            gain = gain + self.damping[n] * (self.stream[s] - here)
        v = here + gain
        if ti.static(self.has_obstacle):
            gain = self.open[s, n] * gain
            v = self.open[s, n] * v
        self.gain[s, n] = ti.Vector([gain[0], gain[1], gain[2], self.ratio[s, n]])
        self.moved[s, n] = ti.Vector([v[0], v[1], v[2], here[3]])
        peak = self.peak[s, n]
        for axis in ti.static(range(self.dimension)):
            peak = largest(ti.abs(v[axis]), peak)
        self.peak[s, n] = peak

    @ti.func
    def g2p(self, s: ti.i32, p: ti.i32) -> None:
        """Interpolate (v, r), its slopes, dt a and Jbar."""
        if ti.static(self.dimension == 2):
            self.g2p_flat(s, p)
        else:
            self.g2p_solid(s, p)

    @ti.func
    def g2p_flat(self, s: ti.i32, p: ti.i32) -> None:
        """Interpolate in two dimensions, node by node as :mod:`.nodal_stress` does."""
        spot = self.spot[s, p]
        lowest = node_number(spot[3], self.tables.node_count)
        weight_x, weight_y, weight_z = self.load_along(self.weights, s, p)
        here = ti.Vector([0.0, 0.0, 0.0, 0.0])
        push = here
        slope_x = here
        slope_y = here
        for step in ti.static(self.row_steps):
            shares = self.row_shares(weight_x, weight_y, weight_z, step)
            start = self.row_start(lowest, step)
            for k in ti.static(range(3)):
                share = shares[k] * self.moved[s, start + k]
                push += shares[k] * self.gain[s, start + k]
                here += share
                slope_x = stepped(slope_x, share, step[0])
                slope_y = stepped(slope_y, share, k - 1)
        self.here[s, p] = here
        self.push[s, p] = push
        self.slopes[0][s, p] = self.gradient * (slope_x - spot[0] * here)
        self.slopes[1][s, p] = self.gradient * (slope_y - spot[1] * here)

    @ti.func
    def g2p_solid(self, s: ti.i32, p: ti.i32) -> None:
        """Interpolate velocity, its gain and its gradient to a particle in three
        dimensions.

        Nodes are summed row by row along z, which takes fewer sums. ``spot`` holds the
        particle's place among the 27 nodes, and the number of the lowest one.
        """
        spot = self.spot[s, p]
        lowest = node_number(spot[3], self.tables.node_count)
        weight_x, weight_y, weight_z = self.load_along(self.weights, s, p)
        here = ti.Vector([0.0, 0.0, 0.0, 0.0])
        push = here
        slope_x = here
        slope_y = here
        slope_z = here
        for step in ti.static(self.row_steps):
            shares = self.row_shares(weight_x, weight_y, weight_z, step)
            start = self.row_start(lowest, step)
            low = shares[0] * self.moved[s, start]
            mid = shares[1] * self.moved[s, start + 1]
            high = shares[2] * self.moved[s, start + 2]
            row = low + mid + high
            row_push = shares[0] * self.gain[s, start]
            row_push = row_push + shares[1] * self.gain[s, start + 1]
            row_push = row_push + shares[2] * self.gain[s, start + 2]
            here += row
            push += row_push
            slope_x = stepped(slope_x, row, step[0])
            slope_y = stepped(slope_y, row, step[1])
            slope_z += high - low
        self.here[s, p] = here
        self.push[s, p] = push
        self.slopes[0][s, p] = self.gradient * (slope_x - spot[0] * here)
        self.slopes[1][s, p] = self.gradient * (slope_y - spot[1] * here)
        self.slopes[2][s, p] = self.gradient * (slope_z - spot[2] * here)

    @ti.func
    def update(self, s: ti.i32, p: ti.i32) -> None:
        """Relax v_p and J_p towards the grid, move and shift x_p."""
        here = self.here[s, p]
        push = self.push[s, p]
        carried = self.carried[s, p]
        volume = 1.0 / largest(here[3], 0.5)
        v = ti.Vector([carried[0], carried[1], carried[2]])
        grid_v = ti.Vector([here[0], here[1], here[2]])
        v = v + ti.Vector([push[0], push[1], push[2]])
        v = v + self.parameters.velocity_relaxation * (grid_v - v)

        shift = ti.Vector([0.0, 0.0, 0.0])
        carry = ti.Vector([0.0, 0.0, 0.0])
        divergence = 0.0
        for axis in ti.static(range(self.dimension)):
            slope = self.slopes[axis][s, p]
            away = self.shift * volume * slope[3]
            shift[axis] = bounded(away, -self.shift_bound, self.shift_bound)
            along = shift[axis] * ti.Vector([slope[0], slope[1], slope[2]])
            if ti.static(axis == 0):
                carry = along
                divergence = slope[0]
            else:
                carry = carry + along
                divergence = divergence + slope[axis]
        v = v + carry

        place = ti.Vector([0.0, 0.0, 0.0])
        for axis in ti.static(range(self.dimension)):
            target = self.x[s, p][axis] + (self.dt * grid_v[axis] + shift[axis])
            place[axis] = self.kept_inside(target, axis)
        x = place
        if ti.static(self.has_obstacle):
            # Not of x itself: in three dimensions Taichi 1.7.4 then drops the result.
            x = self.kept_outside(s, place)
        jacobian = carried[3]
        jacobian = (
            jacobian
            + self.dt * divergence * jacobian
            + self.parameters.jacobian_relaxation * (push[3] - jacobian)
            + self.parameters.density_coupling * (volume - push[3])
        )
        self.carried[s, p] = ti.Vector([v[0], v[1], v[2], jacobian])
        reached = ti.Vector([ti.abs(v[0]), ti.abs(v[1]), ti.abs(v[2]), jacobian])
        self.extremes[s, p] = largest(reached, self.extremes[s, p])
        lowest = largest(-jacobian, self.x[s, p][3])
        self.x[s, p] = ti.Vector([x[0], x[1], x[2], lowest])

    @ti.func
    def hold(self, s: ti.i32, p: ti.i32) -> None:
        """Relax J_p of an obstacle's particle, which neither moves nor deforms."""
        here = self.here[s, p]
        push = self.push[s, p]
        volume = 1.0 / largest(here[3], 0.5)
        for axis in ti.static(range(self.dimension)):
            self.slopes[axis][s, p] = ti.Vector([0.0, 0.0, 0.0, 0.0])
        jacobian = self.carried[s, p][3]
        jacobian = (
            jacobian
            + self.parameters.jacobian_relaxation * (push[3] - jacobian)
            + self.parameters.density_coupling * (volume - push[3])
        )
        self.carried[s, p] = ti.Vector([0.0, 0.0, 0.0, jacobian])

    @ti.func
    def kept_outside(self, s: ti.i32, target: ti.math.vec3) -> Value:
        """Return a place, or the nearest on the obstacle's surface if inside."""
        obstacle = self.obstacle[s]
        way = target - ti.Vector([obstacle[0], obstacle[1], obstacle[2]])
        square = way[0] * way[0] + way[1] * way[1] + way[2] * way[2]
        # A place at the very centre has no nearest one; it stays.
        is_inside = (square < obstacle[3] * obstacle[3]) and (square > 0.0)
        stretch = obstacle[3] / ti.sqrt(ti.select(is_inside, square, 1.0))
        moved = target + (stretch - 1.0) * way
        return ti.select(is_inside, moved, target)

    @ti.func
    def kept_inside(self, target: ti.f32, axis: Template) -> ti.f32:
        """Return a coordinate between the walls, or wrapped into [low, high)."""
        least = ti.static(self.least[axis])
        most = ti.static(self.most[axis])
        result = target
        if ti.static(self.periodic[axis]):
            period = ti.static(self.period[axis])
            result = ti.select(result >= most, result - period, result)
            result = ti.select(result < least, result + period, result)
            # The sum may round up to the end of the period; NaN becomes its start.
            result = ti.select(result < most, result, least)
        else:
            result = bounded(result, least, most)
        return result

    # The drivers: the same phases in the same order.

    def run_serially(self, substeps: int) -> None:
        """Advance scenario 0 by many substeps in one thread."""
        tables = self.tables
        self._serial_substeps(
            substeps,
            self.particles,
            self.parameters.particles,
            tables.node_count,
            len(tables.interior),
            len(tables.images.node),
            len(tables.ghosts.node),
        )

    def run_in_parallel(self) -> None:
        """Advance every scenario by one substep: one launch per phase."""
        tables = self.tables
        self._parallel_substep(
            self.particles,
            self.parameters.particles,
            tables.node_count,
            len(tables.interior),
            len(tables.images.node),
            len(tables.ghosts.node),
        )

    @ti.kernel
    def _serial_substeps(
        self,
        substeps: ti.i32,
        particles: ti.i32,
        fluid: ti.i32,
        nodes: ti.i32,
        interior: ti.i32,
        edges: ti.i32,
        ghosts: ti.i32,
    ) -> Nothing:
        ti.loop_config(serialize=True)
        for _ in range(substeps):
            # Read before the loops: with the address of the fields inside them LLVM
            # would not vectorise.
            fill = self.fill[0]
            for n in range(nodes):
                self.clear(0, n)
            for p in range(particles):
                self.locate(0, p)
            for p in range(particles):
                self.p2g(0, p)
            for n in range(nodes):
                self.settle(0, n)
            for e in range(edges):
                self.add_images(0, e)
            for i in range(interior):
                self.fold(0, self.interior[i], fill)
            for g in range(ghosts):
                self.mirror(0, g)
            for i in range(interior):
                self.add_forces(0, self.interior[i])
            for g in range(ghosts):
                self.mirror_moved(0, g)
            for p in range(particles):
                self.g2p(0, p)
            for p in range(fluid):
                self.update(0, p)
            if ti.static(self.has_obstacle):
                for p in range(fluid, particles):
                    self.hold(0, p)

    @ti.kernel
    def _parallel_substep(
        self,
        particles: ti.i32,
        fluid: ti.i32,
        nodes: ti.i32,
        interior: ti.i32,
        edges: ti.i32,
        ghosts: ti.i32,
    ) -> Nothing:
        ti.loop_config(parallelize=self.threads)
        for s, n in ti.ndrange(self.scenarios, nodes):
            self.clear(s, n)
        ti.loop_config(parallelize=self.threads)
        for s, p in ti.ndrange(self.scenarios, particles):
            self.locate(s, p)
            self.p2g(s, p)
        ti.loop_config(parallelize=self.threads)
        for s, n in ti.ndrange(self.scenarios, nodes):
            self.settle(s, n)
        ti.loop_config(parallelize=self.threads)
        for s, e in ti.ndrange(self.scenarios, edges):
            self.add_images(s, e)
        ti.loop_config(parallelize=self.threads)
        for s, i in ti.ndrange(self.scenarios, interior):
            self.fold(s, self.interior[i], self.fill[s])
        ti.loop_config(parallelize=self.threads)
        for s, g in ti.ndrange(self.scenarios, ghosts):
            self.mirror(s, g)
        ti.loop_config(parallelize=self.threads)
        for s, i in ti.ndrange(self.scenarios, interior):
            self.add_forces(s, self.interior[i])
        ti.loop_config(parallelize=self.threads)
        for s, g in ti.ndrange(self.scenarios, ghosts):
            self.mirror_moved(s, g)
        ti.loop_config(parallelize=self.threads)
        for s, p in ti.ndrange(self.scenarios, particles):
            self.g2p(s, p)
            if ti.static(self.has_obstacle):
                if p < fluid:
                    self.update(s, p)
                else:
                    self.hold(s, p)
            else:
                self.update(s, p)

    def restart_extremes(self) -> None:
        """Start an advance: the extremes are those of the present state."""
        self._restart_extremes(self.parameters.particles, self.tables.node_count)

    @ti.kernel
    def _restart_extremes(self, particles: ti.i32, nodes: ti.i32) -> Nothing:
        ti.loop_config(serialize=ti.static(not self.atomic))
        for s, p in ti.ndrange(self.scenarios, particles):
            now = self.carried[s, p]  # v_p, J_p
            reached = ti.Vector(
                [ti.abs(now[0]), ti.abs(now[1]), ti.abs(now[2]), now[3]]
            )
            self.extremes[s, p] = reached
            self.x[s, p][3] = -now[3]  # this lane keeps the largest -J
        ti.loop_config(serialize=ti.static(not self.atomic))
        for s, n in ti.ndrange(self.scenarios, nodes):
            self.peak[s, n] = 0.0


def _axis_count(step: tuple[int, ...]) -> int:
    """Return along how many axes a neighbour lies off."""
    return sum(1 for value in step if value != 0)
