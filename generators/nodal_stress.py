"""One substep of weakly compressible flow whose stress acts at the nodes.

In two or three dimensions, with a force f per mass that acts at the nodes. Nodes are
the middles of cells; beyond each wall is one layer of ghost nodes, the mirror images of
the outermost interior nodes, and beyond an end of a periodic axis the nodes of the
other end (:mod:`.box_tables`). Per substep, for particles of equal mass m, positions
x_p, grid spacing dx and weights w_ip:

1. P2G: n_i = sum w,  (n J)_i = sum w J_p,  (n v)_i = sum w (v_p + C_p (x_i - x_p)).
2. Fold: ghosts give what they received to their mirror images, normal momentum
   reversed, tangential momentum n (2 u_wall - v) at a no-slip wall and n v at a
   free-slip wall. Then v = (n v)/n,  Jbar = (n J)/n,  relative density
   r = n m / (rho dx^d); ghosts mirror them.
3. Forces: a = (E/rho) grad Jbar + nu lap v + f,  v <- v + dt a; ghosts mirror v and a.
   Gradients are central differences, weighted 1/8, 3/4, 1/8 along every other axis. In
   a fringe f also holds sigma (U - v), which draws the velocity to the stream U
   (Nordstrom, Nordin and Henningson, SIAM J. Sci. Comput. 20 (1999) 1365). Nodes
   inside an obstacle are at rest: v = 0, a = 0.
4. G2P: v* = sum w v,  a* = sum w a,  r = max(sum w r, 1/2),
   grad q = (4/dx^2) sum w q (x_i - x_p),  C = grad v,
   shift s = -beta dx^2 grad(r)/r, each component within 0.1 dx,
   v_p <- (v_p + dt a*) + lambda (v* - v_p - dt a*) + C s,
   x_p <- x_p + dt v* + s, kept between walls and wrapped along periodic axes,
   J_p <- J_p (1 + dt tr C) + kappa (Jbar - J_p) + theta (1/r - Jbar).
   Particles of the fluid that would enter an obstacle are put on its surface. Those of
   an obstacle neither move nor get a velocity, but their J follows that of the nodes,
   so that the pressure goes on inside.

The mass of a particle cancels everywhere but in r, so nodes count particles, n, and no
sum is tiny. Sums are integers (:mod:`.transfer`): no order of particles or threads
changes a bit. The numbers n are summed in rows of three nodes, so that P2G adds vectors
of four throughout: component k of ``rows`` at a node counts for the k-th node from
there along the last axis.

Valid while max abs(v) dt <= dx, which also bounds every fixed-point sum, and while J
stays in (0, 8]. Settings that reproduce Ghia, Ghia & Shin (1982) are those of the split
``cavity``.
"""

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import backend
from .box_tables import LANES, BoxTables, Singles
from .full_box_parameters import FullBoxParameters
from .language import f32, i32, i64, ti, vec3, vec4
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

JACOBIAN_BOUND = 8.0  # largest J that the sums have room for [1]
_INSET = 1e-3  # distance that particles keep from a wall [cells]
_ROW = (0, 1, 2)  # the nodes of a row
_REACH = {2: 16.0, 3: 32.0}
"""Bound of abs(v_p + C (x_i - x_p)) over the speed bound dx/dt [1], by dimension.

Walls move at half the bound or less, so ghosts at twice the bound or less; abs(C_ab) <=
(4/dx^2) max abs(v) sum w abs(x_i - x_p) <= 4/dt, and a node lies within 1.5 dx per
axis: 1 + 2 x 4 x 1.5 = 13, and 1 + 3 x 4 x 1.5 = 19 in three dimensions.
"""


def broken_jacobian_bounds(lowest: float, highest: float) -> dict[str, str]:
    """Return the bounds of J that extremes lie outside, each with the value reached."""
    broken = {}
    if lowest <= 0.0:
        broken["J > 0"] = f"J = {lowest:.6g}"
    if highest > JACOBIAN_BOUND:
        broken[f"J <= {JACOBIAN_BOUND:g}"] = f"J = {highest:.6g}"
    return broken


@ti.data_oriented
class NodalStress:
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
        box = p.box
        dx = 1.0 / p.grid
        self.parameters = parameters  # constants that the scenarios share
        self.scenarios = scenarios  # scenarios advanced together
        self.atomic = atomic  # whether several threads run the phases
        self.threads = threads  # threads of the parallel loops on a CPU

        dimension = box.dimension
        self.dimension = dimension
        self.axes = tuple(range(dimension))
        self.has_z = dimension == 3
        self.periodic = box.periodic
        self.has_walls = not all(self.periodic)
        self.has_obstacle = p.obstacle_particles > 0
        self.has_fringe = p.fringe_rate > 0.0
        self.has_force = p.force_layers > 0
        # particles of the fluid, and behind them those of the obstacle
        self.particles = p.particles + p.obstacle_particles
        # the field of forces has a layer even where no force acts
        self.layer_count = max(1, p.force_layers)

        self.cells = p.cells
        self.tables = BoxTables(p.cells, periodic=box.periodic, no_slip=p.no_slip)
        self.stride = self.tables.stride
        self.image_signs = self.tables.images.sign.tolist()
        self.image_numbers = tuple(range(len(self.image_signs)))

        self.inv_dx = float(p.grid)
        self.dt = p.dt
        self.origin = p.origin  # coordinate of node 0 of each axis [cells]
        # smallest and largest coordinate of a particle along each axis
        inset = np.where(box.periodic, 0.0, _INSET * dx)
        self.position_min = (np.array(box.low) + inset).tolist()
        self.position_max = (np.array(box.high) - inset).tolist()
        self.period = box.lengths.tolist()

        self.speed_bound = dx / p.dt  # the CFL bound dx/dt [length/s]
        speed_reach = _REACH[dimension] * self.speed_bound
        self.velocity_scale = fixed_point_scale(self.particles, speed_reach)
        self.count_scale = fixed_point_scale(self.particles, JACOBIAN_BOUND)
        self.velocity_unit = 1.0 / self.velocity_scale
        self.count_unit = 1.0 / self.count_scale
        self.cell_scale = self.velocity_scale * dx

        # dt E / (2 rho dx): gain of velocity by a difference of Jbar over two cells
        self.pressure_factor = p.dt * p.modulus / (p.density * 2.0 * dx)
        self.slope_factor = 4.0 * self.inv_dx  # 4/dx
        # -beta dx^2
        self.shift_factor = -p.shift * dx * dx
        self.shift_bound = 0.1 * dx

        # The kernels unroll what follows.
        # the rows of three nodes that a particle touches: steps along all but the last
        # axis
        self.row_axes = self.axes[:-1]
        self.row_steps = tuple(itertools.product((-1, 0, 1), repeat=dimension - 1))
        # one of each pair of opposite neighbours of a node; nearest first
        pairs = []
        for step in itertools.product((1, 0, -1), repeat=dimension):
            if step > (0,) * dimension:
                pairs.append(step)
        self.pairs = tuple(sorted(pairs, key=_axis_count))
        # the two of these differ along one axis only
        self.nearest_pairs = self.pairs[:dimension]
        # weight in a gradient of the difference of a pair, by the number of further
        # axes along which the two differ
        self.pair_weight = tuple(
            0.75 ** (dimension - 1 - further) * 0.125**further for further in self.axes
        )

        self._declare_fields()
        self._tree = self._place_fields()
        self._fill_tables()

    def _declare_fields(self) -> None:
        """Name the fields; they have no memory yet."""
        # of each particle: its position [length], and the largest -J since the
        # advance began
        self.x = vec4.field()
        self.particle_state = vec4.field()  # v_p, J_p
        # state of a particle at rest
        self.at_rest = (0.0, 0.0, 0.0, 1.0)
        # v and r of the nodes, at the particle
        self.grid_state = vec4.field()
        # derivative of the same along each axis
        self.slopes = [vec4.field() for _ in self.axes]
        # dt a and Jbar of the nodes, at the particle
        self.grid_gain = vec4.field()
        # largest abs(v) by component, and largest J, since the advance began
        self.extremes = vec4.field()
        # the three weights along each axis
        self.weights = [vec4.field() for _ in self.axes]
        # offset from the middle node [cells], and the bits of the lowest node's number
        self.stencil_place = vec4.field()

        # of each node: n v, n J
        self.sums = ti.Vector.field(LANES, i64)
        self.weight_sum = ti.field(i64)  # n
        self.drag = vec4.field()  # what moving walls add to n v
        self.node_state = vec4.field()  # v, r
        self.node_jacobian = ti.field(f32)  # Jbar
        self.next_state = vec4.field()  # v, r after the forces
        self.node_gain = vec4.field()  # dt a, Jbar
        # largest absolute velocity component since the advance began
        self.peak_speed = ti.field(f32)
        # 1 in the fluid, 0 inside an obstacle
        self.fluid_mask = ti.field(f32)
        # dt sigma, equal in all scenarios
        self.fringe_damping = ti.field(f32)
        self.force_layer = ti.field(i32)
        # n of three nodes in a row
        self.row_sums = ti.Vector.field(LANES, i64)

        # of each scenario: nu dt / dx^2 and m / (rho dx^d)
        self.diffusion_number = ti.field(f32)
        self.particle_volume = ti.field(f32)
        # centre of the obstacle, and the least distance from it [length]
        self.obstacle = vec4.field()
        self.stream = vec4.field()  # U

        # tables, shape [ghost], [edge], [edge, image] and [interior]
        self.ghost_node = ti.field(i32)
        self.ghost_source = ti.field(i32)
        self.ghost_sign = vec4.field()
        self.edge_node = ti.field(i32)
        self.image_ghost = ti.field(i32)
        self.interior_node = ti.field(i32)
        # what walls and forces do now, shape [scenario, ghost], [scenario, edge,
        # image] and [scenario, layer]
        self.ghost_drive = vec4.field()  # added to a ghost's v
        self.image_drag = vec4.field()  # n v per particle
        self.force_gain = vec4.field()  # dt f

    def _place_fields(self) -> Any:  # noqa: ANN401 (Taichi is untyped)
        """Give the fields their memory, each an array of its own."""
        particle_fields = (
            self.x,
            self.particle_state,
            *self.slopes,
            self.extremes,
            *self.weights,
            self.stencil_place,
            self.grid_state,
            self.grid_gain,
        )
        node_fields = (
            self.sums,
            self.weight_sum,
            self.drag,
            self.node_state,
            self.next_state,
            self.node_jacobian,
            self.node_gain,
            self.peak_speed,
        )
        ghost_fields = (self.ghost_node, self.ghost_source, self.ghost_sign)
        scenario_fields = (
            self.diffusion_number,
            self.particle_volume,
            self.obstacle,
            self.stream,
        )
        scenarios = self.scenarios
        node_count = self.tables.node_count
        ghost_count = len(self.tables.ghosts.node)
        edge_count = len(self.tables.images.node)
        image_shape = self.tables.images.ghost.shape
        node_shape = (scenarios, node_count)
        mask_shape = node_shape if self.has_obstacle else (1, 1)
        fringe_count = node_count if self.has_fringe else 1
        return backend.place(
            ((scenarios, self.particles), particle_fields),
            (node_shape, node_fields),
            # Two more: a node counts the rows of the two nodes before it as well.
            ((scenarios, node_count + 2), [self.row_sums]),
            ((ghost_count,), ghost_fields),
            ((edge_count,), [self.edge_node]),
            (image_shape, [self.image_ghost]),
            (self.tables.interior.shape, [self.interior_node]),
            ((node_count,), [self.force_layer]),
            ((scenarios, ghost_count), [self.ghost_drive]),
            ((scenarios, *image_shape), [self.image_drag]),
            ((scenarios, self.layer_count), [self.force_gain]),
            ((scenarios,), scenario_fields),
            (mask_shape, [self.fluid_mask]),
            ((fringe_count,), [self.fringe_damping]),
        )

    def _fill_tables(self) -> None:
        tables = self.tables
        self.ghost_node.from_numpy(tables.ghosts.node)
        self.ghost_source.from_numpy(tables.ghosts.source)
        self.ghost_sign.from_numpy(tables.ghosts.sign)
        self.edge_node.from_numpy(tables.images.node)
        self.image_ghost.from_numpy(tables.images.ghost)
        self.interior_node.from_numpy(tables.interior)

        # the layer of each node along y; ghosts belong to the nearest one
        row_count = self.cells[1]
        row = np.clip(tables.index[:, 1] - 1, 0, row_count - 1)
        layer_number = row * self.layer_count // row_count
        self.force_layer.from_numpy(layer_number.astype(np.int32))

        if self.has_fringe:
            rates = self.parameters.fringe_rates(self._node_places()[:, 0])
            self.fringe_damping.from_numpy((self.dt * rates).astype(np.float32))

    def _node_places(self) -> NDArray[np.float64]:
        """Return where the nodes lie [length], ghosts included, shape [node, axis]."""
        return np.asarray((self.tables.index + np.array(self.origin)) / self.inv_dx)

    def move_walls(self, velocity: Singles) -> None:
        """Let walls slide [length/s], shape [scenario, 2 axis, axis]."""
        self.ghost_drive.from_numpy(self.tables.ghost_drive(velocity))
        self.image_drag.from_numpy(self.tables.image_drag(velocity))

    def apply_force(self, acceleration: Singles) -> None:
        """Let a force act [length/s^2], shape [scenario, layer, axis]."""
        gain = np.zeros((*acceleration.shape[:2], LANES), np.float32)
        gain[..., : self.dimension] = np.float32(self.dt) * acceleration
        self.force_gain.from_numpy(gain)

    def place_obstacles(self, obstacles: Sequence[Obstacle]) -> None:
        """Set the nodes that each scenario's obstacle holds at rest."""
        places = self._node_places()
        mask = np.empty((self.scenarios, len(places)), np.float32)
        discs = np.zeros((self.scenarios, LANES), np.float32)
        for s, obstacle in enumerate(obstacles):
            mask[s] = ~is_inside(places, obstacle.centre, obstacle.radius)
            discs[s, : self.dimension] = obstacle.centre
            discs[s, 3] = obstacle.radius + _INSET / self.inv_dx
        self.fluid_mask.from_numpy(mask)
        self.obstacle.from_numpy(discs)

    def set_stream(self, velocity: Singles) -> None:
        """Let the fringe draw to a velocity [length/s], shape [scenario, axis]."""
        stream = np.zeros((self.scenarios, LANES), np.float32)
        stream[:, : self.dimension] = velocity
        self.stream.from_numpy(stream)

    def release(self) -> None:
        """Give the memory back; the fields cannot be used afterwards."""
        self._tree.destroy()

    # The phases: each function is one phase at one particle or node.

    @ti.func
    def clear(self, s: i32, n: i32) -> None:
        """Set a node's sums to zero."""
        self.sums[s, n] = ti.Vector.zero(i64, LANES)
        self.row_sums[s, n + 2] = ti.Vector.zero(i64, LANES)

    @ti.func
    def locate(self, s: i32, p: i32) -> None:
        """Store the stencil of a particle for P2G and G2P: its nodes and weights."""
        x = self.x[s, p]
        number = 0
        offset = vec3(0.0)
        for axis in ti.static(self.axes):
            scaled = x[axis] * self.inv_dx - self.origin[axis]  # [cells]
            # A periodic coordinate may round up to the end of its last cell.
            lowest = ti.min(ti.cast(scaled - 0.5, i32), self.cells[axis] - 1)
            f = scaled - ti.cast(lowest, f32)
            low, mid, high = spline_weights(f)
            self.weights[axis][s, p] = vec4(low, mid, high, 0.0)
            offset[axis] = f - 1.0
            number += lowest * self.stride[axis]
        self.stencil_place[s, p] = vec4(offset, ti.bit_cast(number, f32))

    @ti.func
    def lowest_node(self, place: vec4) -> i32:
        """Return the number of the lowest node of a particle's stencil."""
        return node_number(place[3], self.tables.node_count)

    @ti.func
    def load_along(self, fields: Template, s: i32, p: i32) -> Value:
        """Return a particle's vectors in three fields: one field for each of x, y, z.

        In two dimensions the third is zero. Callers load before they write anything:
        LLVM cannot know that the fields do not overlap, and would read again after each
        write.
        """
        first = fields[0][s, p]
        second = fields[1][s, p]
        third = vec4(0.0)
        if ti.static(self.has_z):
            third = fields[2][s, p]
        return first, second, third

    @ti.func
    def row_weights(
        self, weight_x: vec4, weight_y: vec4, weight_z: vec4, step: Template
    ) -> Value:
        """Return the weights of the three nodes of a row, and a zero."""
        across = weight_x[step[0] + 1]
        weights = across * weight_y
        if ti.static(self.has_z):
            weights = across * weight_y[step[1] + 1] * weight_z
        return weights

    @ti.func
    def row_start(self, lowest: i32, step: Template) -> i32:
        """Return the number of the first node of a row."""
        number = lowest
        for axis in ti.static(self.row_axes):
            number += (step[axis] + 1) * self.stride[axis]
        return number

    @ti.func
    def p2g(self, s: i32, p: i32) -> None:
        """Spread n v, n and n J, from the middle node to its neighbours, dx away."""
        place = self.stencil_place[s, p]
        lowest = self.lowest_node(place)
        weight_x, weight_y, weight_z = self.load_along(self.weights, s, p)
        slope_x, slope_y, slope_z = self.load_along(self.slopes, s, p)
        # Weights carry the scale of n and J, so that v lacks the rest of its own. All
        # are powers of two, which round nothing.
        weight_x = self.count_scale * weight_x
        rest = self.velocity_scale / self.count_scale
        scale = vec4(rest, rest, rest, 1.0)
        # J has no slope; a product with 0 is one, as nodes, and so slopes, are finite.
        cell = self.cell_scale / self.count_scale
        slope_scale = vec4(cell, cell, cell, 0.0)
        step_x = slope_scale * slope_x
        step_y = slope_scale * slope_y
        step_z = slope_scale * slope_z

        at_middle = scale * self.particle_state[s, p] - place.x * step_x
        at_middle = at_middle - place.y * step_y
        if ti.static(self.has_z):
            at_middle = at_middle - place.z * step_z

        for step in ti.static(self.row_steps):
            weights = self.row_weights(weight_x, weight_y, weight_z, step)
            start = self.row_start(lowest, step)
            at_row = stepped(at_middle, step_x, step[0])
            row_step = step_y
            if ti.static(self.has_z):
                at_row = stepped(at_row, step_y, step[1])
                row_step = step_z
            for k in ti.static(_ROW):
                share = weights[k] * stepped(at_row, row_step, k - 1)
                add_shifted(self.sums, s, start + k, share, self.atomic)
            # The fourth weight is 0, so that the fourth sum counts shifts.
            add_shifted(self.row_sums, s, start + 2, weights, self.atomic)

    @ti.func
    def settle(self, s: i32, n: i32) -> None:
        """Take the shifts off a node's sums, and add up its n from three rows."""
        weight_sum, shifts = row_count(self.row_sums, s, n)
        self.sums[s, n] = self.sums[s, n] - shifts
        self.weight_sum[s, n] = weight_sum

    @ti.func
    def image_sign(self, k: Template) -> Value:
        """Return the signs with which the k-th image of a node counts for (v, J)."""
        return ti.Vector(ti.static(self.image_signs[k]), i64)

    @ti.func
    def add_images(self, s: i32, e: i32) -> None:
        """Add to a node beside ghosts what its images received, and the walls' drag."""
        n = self.edge_node[e]
        total = self.sums[s, n]
        weight_sum = self.weight_sum[s, n]
        drag = vec4(0.0)
        for k in ti.static(self.image_numbers):
            ghost = self.image_ghost[e, k]
            if ghost >= 0:
                ghost_weight = self.weight_sum[s, ghost]
                total += self.image_sign(k) * self.sums[s, ghost]
                weight_sum += ghost_weight
                if ti.static(self.has_walls):
                    ghost_count = from_fixed(ghost_weight, self.count_unit)
                    drag += self.image_drag[s, e, k] * ghost_count
        self.sums[s, n] = total
        self.weight_sum[s, n] = weight_sum
        self.drag[s, n] = drag

    @ti.func
    def fold(self, s: i32, n: i32, particle_volume: f32) -> None:
        """Turn the sums of an interior node into v, r and Jbar."""
        state = vec4(0.0)
        jacobian = 1.0
        weight_sum = self.weight_sum[s, n]
        if weight_sum > 0:
            total = self.sums[s, n]
            count = from_fixed(weight_sum, self.count_unit)
            received = from_fixed(total, self.velocity_unit)
            state = (received + self.drag[s, n]) / count
            state[3] = count * particle_volume
            jacobian = from_fixed(total[3], self.count_unit) / count
        self.node_state[s, n] = state
        self.node_jacobian[s, n] = jacobian

    @ti.func
    def mirror(self, s: i32, g: i32) -> None:
        """Fill a ghost node before the forces."""
        n = self.ghost_node[g]
        source = self.ghost_source[g]
        state = self.ghost_sign[g] * self.node_state[s, source]
        jacobian = self.node_jacobian[s, source]
        self.node_state[s, n] = state + self.ghost_drive[s, g]
        self.node_jacobian[s, n] = jacobian

    @ti.func
    def mirror_forces(self, s: i32, g: i32) -> None:
        """Fill a ghost node after the forces; walls at rest mirror dt a."""
        n = self.ghost_node[g]
        source = self.ghost_source[g]
        sign = self.ghost_sign[g]
        state = sign * self.next_state[s, source]
        gain = sign * self.node_gain[s, source]
        self.next_state[s, n] = state + self.ghost_drive[s, g]
        self.node_gain[s, n] = gain

    @ti.func
    def neighbour(self, n: i32, step: Template, side: Template) -> i32:
        """Return the number of a node's neighbour, or of the opposite one."""
        number = n
        for axis in ti.static(self.axes):
            number += side * step[axis] * self.stride[axis]
        return number

    @ti.func
    def pressure_gradient(self, s: i32, n: i32) -> vec4:
        """Return 2 dx grad Jbar, weighted 1/8, 3/4, 1/8 along every other axis."""
        # differences of Jbar, by the number of further axes along which pairs differ
        rises = ti.Matrix.zero(f32, 3, 3)
        for step in ti.static(self.pairs):
            ahead = self.neighbour(n, step, 1)
            behind = self.neighbour(n, step, -1)
            rise = self.node_jacobian[s, ahead] - self.node_jacobian[s, behind]
            further = ti.static(_axis_count(step) - 1)
            for axis in ti.static(self.axes):
                rises[further, axis] = stepped(rises[further, axis], rise, step[axis])

        gradient = vec4(0.0)
        for axis in ti.static(self.axes):
            gradient[axis] = self.pair_weight[0] * rises[0, axis]
            for further in ti.static(self.axes[1:]):
                weighted_rise = self.pair_weight[further] * rises[further, axis]
                gradient[axis] = gradient[axis] + weighted_rise
        return gradient

    @ti.func
    def laplacian(self, s: i32, n: i32) -> vec4:
        """Return dx^2 times the Laplacian of (v, r), by the nearest neighbours."""
        neighbour_sum = vec4(0.0)
        for step in ti.static(self.nearest_pairs):
            ahead = self.neighbour(n, step, 1)
            behind = self.neighbour(n, step, -1)
            pair_sum = self.node_state[s, ahead] + self.node_state[s, behind]
            neighbour_sum = neighbour_sum + pair_sum
        return neighbour_sum - 2.0 * self.dimension * self.node_state[s, n]

    @ti.func
    def add_forces(self, s: i32, n: i32) -> None:
        """Add dt a = dt (E/rho) grad Jbar + dt nu lap v + dt f."""
        state = self.node_state[s, n]
        gradient = self.pressure_gradient(s, n)
        laplacian = self.laplacian(s, n)
        gain = self.pressure_factor * gradient + self.diffusion_number[s] * laplacian
        if ti.static(self.has_force):
            gain = gain + self.force_gain[s, self.force_layer[n]]
        if ti.static(self.has_fringe):
            gain = gain + self.fringe_damping[n] * (self.stream[s] - state)
        v = state + gain
        if ti.static(self.has_obstacle):
            mask = self.fluid_mask[s, n]
            gain = mask * gain
            v = mask * v

        speed = ti.abs(v)
        peak = self.peak_speed[s, n]
        for axis in ti.static(self.axes):
            peak = largest(speed[axis], peak)
        self.peak_speed[s, n] = peak
        # The fourth lanes hold Jbar and r.
        gain[3] = self.node_jacobian[s, n]
        v[3] = state[3]
        self.node_gain[s, n] = gain
        self.next_state[s, n] = v

    @ti.func
    def g2p(self, s: i32, p: i32) -> None:
        """Interpolate (v, r), its slopes, dt a and Jbar."""
        if ti.static(self.has_z):
            self.g2p_solid(s, p)
        else:
            self.g2p_flat(s, p)

    @ti.func
    def g2p_flat(self, s: i32, p: i32) -> None:
        """Interpolate in two dimensions, node by node."""
        place = self.stencil_place[s, p]
        lowest = self.lowest_node(place)
        weight_x, weight_y, weight_z = self.load_along(self.weights, s, p)
        state = vec4(0.0)
        gain = vec4(0.0)
        # first moments of the state about the middle node [cells]
        moment_x = vec4(0.0)
        moment_y = vec4(0.0)
        for step in ti.static(self.row_steps):
            weights = self.row_weights(weight_x, weight_y, weight_z, step)
            start = self.row_start(lowest, step)
            for k in ti.static(_ROW):
                share = weights[k] * self.next_state[s, start + k]
                gain += weights[k] * self.node_gain[s, start + k]
                state += share
                moment_x = stepped(moment_x, share, step[0])
                moment_y = stepped(moment_y, share, k - 1)
        self.grid_state[s, p] = state
        self.grid_gain[s, p] = gain

        # from there to the particle
        moment_x = moment_x - place.x * state
        moment_y = moment_y - place.y * state
        slope_y = self.slope_factor * moment_y
        self.slopes[0][s, p] = self.slope_factor * moment_x
        self.slopes[1][s, p] = slope_y

    @ti.func
    def g2p_solid(self, s: i32, p: i32) -> None:
        """Interpolate in three dimensions, row by row along z, which takes fewer
        sums.
        """
        place = self.stencil_place[s, p]
        lowest = self.lowest_node(place)
        weight_x, weight_y, weight_z = self.load_along(self.weights, s, p)
        state = vec4(0.0)
        gain = vec4(0.0)
        # first moments of the state about the middle node [cells]
        moment_x = vec4(0.0)
        moment_y = vec4(0.0)
        moment_z = vec4(0.0)
        for step in ti.static(self.row_steps):
            weights = self.row_weights(weight_x, weight_y, weight_z, step)
            start = self.row_start(lowest, step)
            low_share = weights[0] * self.next_state[s, start]
            mid_share = weights[1] * self.next_state[s, start + 1]
            high_share = weights[2] * self.next_state[s, start + 2]
            row_state = low_share + mid_share + high_share

            low_gain = weights[0] * self.node_gain[s, start]
            mid_gain = weights[1] * self.node_gain[s, start + 1]
            row_gain = low_gain + mid_gain + weights[2] * self.node_gain[s, start + 2]

            state += row_state
            gain += row_gain
            moment_x = stepped(moment_x, row_state, step[0])
            moment_y = stepped(moment_y, row_state, step[1])
            moment_z += high_share - low_share
        self.grid_state[s, p] = state
        self.grid_gain[s, p] = gain

        # from there to the particle
        moment_x = moment_x - place.x * state
        moment_y = moment_y - place.y * state
        moment_z = moment_z - place.z * state
        slope_y = self.slope_factor * moment_y
        slope_z = self.slope_factor * moment_z
        self.slopes[0][s, p] = self.slope_factor * moment_x
        self.slopes[1][s, p] = slope_y
        self.slopes[2][s, p] = slope_z

    @ti.func
    def update(self, s: i32, p: i32) -> None:
        """Relax v_p and J_p towards the grid, move and shift x_p."""
        grid_state = self.grid_state[s, p]
        grid_velocity = grid_state.xyz
        grid_gain = self.grid_gain[s, p]
        volume = 1.0 / largest(grid_state[3], 0.5)
        old_state = self.particle_state[s, p]
        old_jacobian = old_state[3]
        v = old_state.xyz + grid_gain.xyz
        v = v + self.parameters.velocity_relaxation * (grid_velocity - v)

        shift = vec3(0.0)
        shift_change = vec3(0.0)  # of the velocity, along the shift
        divergence = 0.0
        shift_bound = self.shift_bound
        shift_strength = self.shift_factor * volume
        for axis in ti.static(self.axes):
            slope = self.slopes[axis][s, p]
            shift[axis] = bounded(shift_strength * slope[3], -shift_bound, shift_bound)
            axis_change = shift[axis] * slope.xyz
            if ti.static(axis == 0):
                shift_change = axis_change
                divergence = slope[axis]
            else:
                shift_change = shift_change + axis_change
                divergence = divergence + slope[axis]
        v = v + shift_change

        old_x = self.x[s, p]
        inside = vec3(0.0)
        for axis in ti.static(self.axes):
            target = old_x[axis] + (self.dt * grid_velocity[axis] + shift[axis])
            inside[axis] = self.kept_inside(target, axis)
        x = inside
        if ti.static(self.has_obstacle):
            # Not of x itself: in three dimensions Taichi 1.7.4 then drops the result.
            x = self.kept_outside(s, inside)

        flowed = old_jacobian + self.dt * divergence * old_jacobian
        jacobian = self.relaxed(flowed, old_jacobian, grid_gain[3], volume)
        self.particle_state[s, p] = vec4(v, jacobian)
        reached = vec4(ti.abs(v), jacobian)
        self.extremes[s, p] = largest(reached, self.extremes[s, p])
        self.x[s, p] = vec4(x, largest(-jacobian, old_x[3]))

    @ti.func
    def hold(self, s: i32, p: i32) -> None:
        """Relax J_p of an obstacle's particle, which neither moves nor deforms."""
        volume = 1.0 / largest(self.grid_state[s, p][3], 0.5)
        for axis in ti.static(self.axes):
            self.slopes[axis][s, p] = vec4(0.0)
        old_jacobian = self.particle_state[s, p][3]
        grid_jacobian = self.grid_gain[s, p][3]
        jacobian = self.relaxed(old_jacobian, old_jacobian, grid_jacobian, volume)
        self.particle_state[s, p] = vec4(0.0, 0.0, 0.0, jacobian)

    @ti.func
    def relaxed(
        self,
        flowed: f32,
        old_jacobian: f32,
        grid_jacobian: f32,
        volume: f32,
    ) -> f32:
        """Return J_p, after the flow changed it, drawn towards Jbar and 1/r."""
        lag = grid_jacobian - old_jacobian
        coupling = self.parameters.density_coupling * (volume - grid_jacobian)
        return flowed + self.parameters.jacobian_relaxation * lag + coupling

    @ti.func
    def kept_outside(self, s: i32, target: vec3) -> Value:
        """Return a place, or the nearest on the obstacle's surface if inside."""
        obstacle = self.obstacle[s]
        radius = obstacle[3]
        way = target - obstacle.xyz
        square = way.x * way.x + way.y * way.y + way.z * way.z
        # A place at the very centre has no nearest one; it stays.
        is_inside = square < radius * radius and square > 0.0
        way_out = (radius / ti.sqrt(ti.select(is_inside, square, 1.0)) - 1.0) * way
        return ti.select(is_inside, target + way_out, target)

    @ti.func
    def kept_inside(self, target: f32, axis: Template) -> f32:
        """Return a coordinate between the walls, or wrapped into [low, high)."""
        low = self.position_min[axis]
        high = self.position_max[axis]
        x = target
        if ti.static(self.periodic[axis]):
            x = ti.select(x >= high, x - self.period[axis], x)
            x = ti.select(x < low, x + self.period[axis], x)
            # The sum may round up to the end of the period; NaN becomes its start.
            x = ti.select(x < high, x, low)
        else:
            x = bounded(x, low, high)
        return x

    # The drivers: the same phases in the same order.

    def run_serially(self, substeps: int) -> None:
        """Advance scenario 0 by many substeps in one thread."""
        self._serial_substeps(substeps, *self._counts())

    def run_in_parallel(self) -> None:
        """Advance every scenario by one substep: one launch per phase."""
        self._parallel_substep(*self._counts())

    def _counts(self) -> tuple[int, ...]:
        """Return the numbers of particles, of those of the fluid, and of nodes."""
        tables = self.tables
        return (
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
        substeps: i32,
        particles: i32,
        fluid: i32,
        nodes: i32,
        interior: i32,
        edges: i32,
        ghosts: i32,
    ) -> Nothing:
        ti.loop_config(serialize=True)
        for _ in range(substeps):
            # Read before the loops: with the address of the fields inside them LLVM
            # would not vectorise.
            particle_volume = self.particle_volume[0]
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
                self.fold(0, self.interior_node[i], particle_volume)
            for g in range(ghosts):
                self.mirror(0, g)
            for i in range(interior):
                self.add_forces(0, self.interior_node[i])
            for g in range(ghosts):
                self.mirror_forces(0, g)
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
        particles: i32,
        fluid: i32,
        nodes: i32,
        interior: i32,
        edges: i32,
        ghosts: i32,
    ) -> Nothing:
        threads = ti.static(self.threads)
        scenarios = ti.static(self.scenarios)
        ti.loop_config(parallelize=threads)
        for s, n in ti.ndrange(scenarios, nodes):
            self.clear(s, n)
        ti.loop_config(parallelize=threads)
        for s, p in ti.ndrange(scenarios, particles):
            self.locate(s, p)
            self.p2g(s, p)
        ti.loop_config(parallelize=threads)
        for s, n in ti.ndrange(scenarios, nodes):
            self.settle(s, n)
        ti.loop_config(parallelize=threads)
        for s, e in ti.ndrange(scenarios, edges):
            self.add_images(s, e)
        ti.loop_config(parallelize=threads)
        for s, i in ti.ndrange(scenarios, interior):
            self.fold(s, self.interior_node[i], self.particle_volume[s])
        ti.loop_config(parallelize=threads)
        for s, g in ti.ndrange(scenarios, ghosts):
            self.mirror(s, g)
        ti.loop_config(parallelize=threads)
        for s, i in ti.ndrange(scenarios, interior):
            self.add_forces(s, self.interior_node[i])
        ti.loop_config(parallelize=threads)
        for s, g in ti.ndrange(scenarios, ghosts):
            self.mirror_forces(s, g)
        ti.loop_config(parallelize=threads)
        for s, p in ti.ndrange(scenarios, particles):
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
    def _restart_extremes(self, particles: i32, nodes: i32) -> Nothing:
        is_serial = ti.static(not self.atomic)
        scenarios = ti.static(self.scenarios)
        ti.loop_config(serialize=is_serial)
        for s, p in ti.ndrange(scenarios, particles):
            state = self.particle_state[s, p]  # v_p, J_p
            self.extremes[s, p] = vec4(ti.abs(state.xyz), state[3])
            # this lane keeps the largest -J
            self.x[s, p][3] = -state[3]
        ti.loop_config(serialize=is_serial)
        for s, n in ti.ndrange(scenarios, nodes):
            self.peak_speed[s, n] = 0.0


def _axis_count(step: tuple[int, ...]) -> int:
    """Return along how many axes a neighbour lies off."""
    return len(step) - step.count(0)
