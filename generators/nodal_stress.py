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
        tables = BoxTables(p.cells, periodic=box.periodic, no_slip=p.no_slip)
        self.tables = tables
        self.stride = tables.stride
        image_signs = tables.images.sign
        self.image_signs = image_signs.tolist()
        image_count = len(self.image_signs)
        self.image_numbers = tuple(range(image_count))

        self.inv_dx = float(p.grid)
        self.dt = p.dt
        self.origin = p.origin  # coordinate of node 0 of each axis [cells]
        # smallest and largest coordinate of a particle along each axis
        inset = np.where(box.periodic, 0.0, _INSET * dx)
        position_max = np.array(box.high) - inset
        self.position_min = (np.array(box.low) + inset).tolist()
        self.position_max = position_max.tolist()
        period = box.lengths
        self.period = period.tolist()

        self.speed_bound = dx / p.dt  # the CFL bound dx/dt [length/s]
        reach = _REACH[dimension]
        speed_reach = reach * self.speed_bound
        particles = self.particles
        velocity_scale = fixed_point_scale(particles, speed_reach)
        count_scale = fixed_point_scale(particles, JACOBIAN_BOUND)
        self.velocity_scale = velocity_scale
        self.count_scale = count_scale
        self.velocity_unit = 1.0 / velocity_scale
        self.count_unit = 1.0 / count_scale
        self.cell_scale = velocity_scale * dx

        # dt E / (2 rho dx): gain of velocity by a difference of Jbar over two cells
        self.pressure_factor = p.dt * p.modulus / (p.density * 2.0 * dx)
        self.slope_factor = 4.0 * self.inv_dx  # 4/dx
        # -beta dx^2
        self.shift_factor = -p.shift * dx * dx
        self.shift_bound = 0.1 * dx

        self._make_stencils()
        self._declare_fields()
        self._tree = self._place_fields()
        self._fill_tables()

    def _make_stencils(self) -> None:
        """List the rows that a particle touches, the pairs of a node's neighbours, and
        the weights of the pairs in a gradient.

        The kernels unroll them.
        """
        dimension = self.dimension
        # the rows of three nodes that a particle touches: steps along all but the last
        # axis
        row_axes = dimension - 1
        self.row_axes = tuple(range(row_axes))
        row_steps = itertools.product((-1, 0, 1), repeat=row_axes)
        self.row_steps = tuple(row_steps)

        # one of each pair of opposite neighbours; nearest first
        pairs = []
        middle = (0,) * dimension
        all_steps = itertools.product((1, 0, -1), repeat=dimension)
        for step in all_steps:
            if step > middle:
                pairs.append(step)
        pairs.sort(key=_axis_count)
        self.pairs = tuple(pairs)
        # the two of these differ along one axis only
        self.nearest_pairs = self.pairs[:dimension]

        # weight in a gradient of the difference of a pair, by the number of further
        # axes along which the two differ
        weights = []
        for further in range(dimension):
            weight = 0.75 ** (row_axes - further) * 0.125**further
            weights.append(weight)
        self.pair_weight = tuple(weights)
        self.further_counts = tuple(range(1, dimension))

    def _declare_fields(self) -> None:
        """Name the fields; they have no memory yet."""
        # of each particle: its position [length], and the largest -J since the
        # advance began
        self.x = _vector_field()
        self.particle_state = _vector_field()  # v_p, J_p
        # state of a particle at rest
        self.at_rest = (0.0, 0.0, 0.0, 1.0)
        # v and r of the nodes, at the particle
        self.grid_state = _vector_field()
        # derivative of the same along each axis
        self.slopes = [_vector_field() for _ in self.axes]
        # dt a and Jbar of the nodes, at the particle
        self.grid_gain = _vector_field()
        # largest abs(v) by component, and largest J, since the advance began
        self.extremes = _vector_field()
        # the three weights along each axis
        self.weights = [_vector_field() for _ in self.axes]
        # offset from the middle node [cells], and the bits of the lowest node's number
        self.stencil_place = _vector_field()

        # of each node: n v, n J
        self.sums = _sum_field()
        self.weight_sum = ti.field(i64)  # n
        self.drag = _vector_field()  # what moving walls add to n v
        self.node_state = _vector_field()  # v, r
        self.node_jacobian = _number_field()  # Jbar
        self.next_state = _vector_field()  # v, r after the forces
        self.node_gain = _vector_field()  # dt a, Jbar
        # largest absolute velocity component since the advance began
        self.peak_speed = _number_field()
        # 1 in the fluid, 0 inside an obstacle
        self.fluid_mask = _number_field()
        # dt sigma, equal in all scenarios
        self.fringe_damping = _number_field()
        self.force_layer = _index_field()
        # n of three nodes in a row
        self.row_sums = _sum_field()

        # of each scenario: nu dt / dx^2 and m / (rho dx^d)
        self.diffusion_number = _number_field()
        self.particle_volume = _number_field()
        # centre of the obstacle, and the least distance from it [length]
        self.obstacle = _vector_field()
        self.stream = _vector_field()  # U

        # tables, shape [ghost], [edge], [edge, image] and [interior]
        self.ghost_node = _index_field()
        self.ghost_source = _index_field()
        self.ghost_sign = _vector_field()
        self.edge_node = _index_field()
        self.image_ghost = _index_field()
        self.interior_node = _index_field()
        # what walls and forces do now, shape [scenario, ghost], [scenario, edge,
        # image] and [scenario, layer]
        self.ghost_drive = _vector_field()  # added to a ghost's v
        self.image_drag = _vector_field()  # n v per particle
        self.force_gain = _vector_field()  # dt f

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
        tables = self.tables
        scenarios = self.scenarios
        node_count = tables.node_count
        ghost_count = len(tables.ghosts.node)
        edge_count = len(tables.images.node)
        image_shape = tables.images.ghost.shape
        interior_shape = tables.interior.shape
        particle_shape = (scenarios, self.particles)
        node_shape = (scenarios, node_count)
        # Two more: a node counts the rows of the two nodes before it as well.
        row_shape = (scenarios, node_count + 2)
        drive_shape = (scenarios, ghost_count)
        drag_shape = (scenarios, *image_shape)
        force_shape = (scenarios, self.layer_count)
        mask_shape = (1, 1)
        if self.has_obstacle:
            mask_shape = node_shape
        fringe_count = 1
        if self.has_fringe:
            fringe_count = node_count
        return backend.place(
            (particle_shape, particle_fields),
            (node_shape, node_fields),
            (row_shape, [self.row_sums]),
            ((ghost_count,), ghost_fields),
            ((edge_count,), [self.edge_node]),
            (image_shape, [self.image_ghost]),
            (interior_shape, [self.interior_node]),
            ((node_count,), [self.force_layer]),
            (drive_shape, [self.ghost_drive]),
            (drag_shape, [self.image_drag]),
            (force_shape, [self.force_gain]),
            ((scenarios,), scenario_fields),
            (mask_shape, [self.fluid_mask]),
            ((fringe_count,), [self.fringe_damping]),
        )

    def _fill_tables(self) -> None:
        tables = self.tables
        ghosts = tables.ghosts
        images = tables.images
        self.ghost_node.from_numpy(ghosts.node)
        self.ghost_source.from_numpy(ghosts.source)
        self.ghost_sign.from_numpy(ghosts.sign)
        self.edge_node.from_numpy(images.node)
        self.image_ghost.from_numpy(images.ghost)
        self.interior_node.from_numpy(tables.interior)

        # the layer of each node along y; ghosts belong to the nearest one
        row_count = self.cells[1]
        last_row = row_count - 1
        row_with_ghosts = tables.index[:, 1]
        row = row_with_ghosts - 1
        row = np.clip(row, 0, last_row)
        layer_number = (row * self.layer_count // row_count).astype(np.int32)
        self.force_layer.from_numpy(layer_number)

        if self.has_fringe:
            places = self._node_places()
            x = places[:, 0]
            rates = self.parameters.fringe_rates(x)
            rounded_damping = (self.dt * rates).astype(np.float32)
            self.fringe_damping.from_numpy(rounded_damping)

    def _node_places(self) -> NDArray[np.float64]:
        """Return where the nodes lie [length], ghosts included, shape [node, axis]."""
        return np.asarray((self.tables.index + np.array(self.origin)) / self.inv_dx)

    def move_walls(self, velocity: Singles) -> None:
        """Let walls slide [length/s], shape [scenario, 2 axis, axis]."""
        drive = self.tables.ghost_drive(velocity)
        drag = self.tables.image_drag(velocity)
        self.ghost_drive.from_numpy(drive)
        self.image_drag.from_numpy(drag)

    def apply_force(self, acceleration: Singles) -> None:
        """Let a force act [length/s^2], shape [scenario, layer, axis]."""
        scenarios, layers, dimension = acceleration.shape
        velocity_gain = np.float32(self.dt) * acceleration
        shape = (scenarios, layers, LANES)
        gain = np.zeros(shape, np.float32)
        gain[..., :dimension] = velocity_gain
        self.force_gain.from_numpy(gain)

    def place_obstacles(self, obstacles: Sequence[Obstacle]) -> None:
        """Set the nodes that each scenario's obstacle holds at rest."""
        places = self._node_places()
        node_count = len(places)
        mask_shape = (self.scenarios, node_count)
        disc_shape = (self.scenarios, LANES)
        mask = np.empty(mask_shape, np.float32)
        discs = np.zeros(disc_shape, np.float32)
        inset = _INSET / self.inv_dx
        for s, obstacle in enumerate(obstacles):
            centre = obstacle.centre
            radius = obstacle.radius
            is_solid = is_inside(places, centre, radius)
            mask[s] = ~is_solid
            disc = discs[s]
            disc[: self.dimension] = centre
            disc[3] = radius + inset
        self.fluid_mask.from_numpy(mask)
        self.obstacle.from_numpy(discs)

    def set_stream(self, velocity: Singles) -> None:
        """Let the fringe draw to a velocity [length/s], shape [scenario, axis]."""
        shape = (self.scenarios, LANES)
        stream = np.zeros(shape, np.float32)
        stream[:, : self.dimension] = velocity
        self.stream.from_numpy(stream)

    def release(self) -> None:
        """Give the memory back; the fields cannot be used afterwards."""
        self._tree.destroy()

    # The phases: each function is one phase at one particle or node.

    @ti.func
    def clear(self, s: i32, n: i32) -> None:
        """Set a node's sums to zero."""
        zero = ti.Vector.zero(i64, LANES)
        self.sums[s, n] = zero
        row = n + 2
        self.row_sums[s, row] = zero

    @ti.func
    def locate(self, s: i32, p: i32) -> None:
        """Store the stencil of a particle for P2G and G2P: its nodes and weights."""
        x = self.x[s, p]
        number = 0
        offset = vec3(0.0)
        for axis in ti.static(self.axes):
            origin = self.origin[axis]
            cells = self.cells[axis]
            last_cell = cells - 1
            coordinate = x[axis]
            from_zero = coordinate * self.inv_dx  # [cells]
            scaled = from_zero - origin
            lowest = ti.cast(scaled - 0.5, i32)
            # A periodic coordinate may round up to the end of its last cell.
            lowest = ti.min(lowest, last_cell)
            f = scaled - ti.cast(lowest, f32)
            low, mid, high = spline_weights(f)
            weights = vec4(low, mid, high, 0.0)
            self.weights[axis][s, p] = weights
            offset[axis] = f - 1.0
            stride = self.stride[axis]
            number += lowest * stride
        number_bits = ti.bit_cast(number, f32)
        place = vec4(offset, number_bits)
        self.stencil_place[s, p] = place

    @ti.func
    def lowest_node(self, place: vec4) -> i32:
        """Return the number of the lowest node of a particle's stencil."""
        number_bits = place[3]
        return node_number(number_bits, self.tables.node_count)

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
            along_y = weight_y[step[1] + 1]
            across = across * along_y
            weights = across * weight_z
        return weights

    @ti.func
    def row_start(self, lowest: i32, step: Template) -> i32:
        """Return the number of the first node of a row."""
        number = lowest
        for axis in ti.static(self.row_axes):
            stride = self.stride[axis]
            number += (step[axis] + 1) * stride
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

        particle_state = self.particle_state[s, p]
        at_middle = scale * particle_state - place.x * step_x
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
                node = start + k
                weight = weights[k]
                at_node = stepped(at_row, row_step, k - 1)
                share = weight * at_node
                add_shifted(self.sums, s, node, share, self.atomic)
            # The fourth weight is 0, so that the fourth sum counts shifts.
            last = start + 2
            add_shifted(self.row_sums, s, last, weights, self.atomic)

    @ti.func
    def settle(self, s: i32, n: i32) -> None:
        """Take the shifts off a node's sums, and add up its n from three rows."""
        weight_sum, shifts = row_count(self.row_sums, s, n)
        shifted_total = self.sums[s, n]
        self.sums[s, n] = shifted_total - shifts
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
                ghost_total = self.sums[s, ghost]
                sign = self.image_sign(k)
                total += sign * ghost_total
                weight_sum += ghost_weight
                if ti.static(self.has_walls):
                    ghost_count = from_fixed(ghost_weight, self.count_unit)
                    drag_per_particle = self.image_drag[s, e, k]
                    drag += drag_per_particle * ghost_count
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
            jacobian_total = total[3]
            count = from_fixed(weight_sum, self.count_unit)
            received = from_fixed(total, self.velocity_unit)
            drag = self.drag[s, n]
            state = (received + drag) / count
            state[3] = count * particle_volume
            jacobian_sum = from_fixed(jacobian_total, self.count_unit)
            jacobian = jacobian_sum / count
        self.node_state[s, n] = state
        self.node_jacobian[s, n] = jacobian

    @ti.func
    def mirror(self, s: i32, g: i32) -> None:
        """Fill a ghost node before the forces."""
        n = self.ghost_node[g]
        source = self.ghost_source[g]
        sign = self.ghost_sign[g]
        drive = self.ghost_drive[s, g]
        state = self.node_state[s, source]
        jacobian = self.node_jacobian[s, source]
        self.node_state[s, n] = sign * state + drive
        self.node_jacobian[s, n] = jacobian

    @ti.func
    def mirror_forces(self, s: i32, g: i32) -> None:
        """Fill a ghost node after the forces; walls at rest mirror dt a."""
        n = self.ghost_node[g]
        source = self.ghost_source[g]
        sign = self.ghost_sign[g]
        drive = self.ghost_drive[s, g]
        state = self.next_state[s, source]
        gain = self.node_gain[s, source]
        ghost_gain = sign * gain
        self.next_state[s, n] = sign * state + drive
        self.node_gain[s, n] = ghost_gain

    @ti.func
    def neighbour(self, n: i32, step: Template, side: Template) -> i32:
        """Return the number of a node's neighbour, or of the opposite one."""
        number = n
        for axis in ti.static(self.axes):
            stride = self.stride[axis]
            number += side * step[axis] * stride
        return number

    @ti.func
    def pressure_gradient(self, s: i32, n: i32) -> vec4:
        """Return 2 dx grad Jbar, weighted 1/8, 3/4, 1/8 along every other axis."""
        # differences of Jbar, by the number of further axes along which pairs differ
        rises = ti.Matrix.zero(f32, 3, 3)
        for step in ti.static(self.pairs):
            ahead = self.neighbour(n, step, 1)
            behind = self.neighbour(n, step, -1)
            jacobian_ahead = self.node_jacobian[s, ahead]
            jacobian_behind = self.node_jacobian[s, behind]
            rise = jacobian_ahead - jacobian_behind
            further = ti.static(_axis_count(step) - 1)
            for axis in ti.static(self.axes):
                sum_before = rises[further, axis]
                sum_after = stepped(sum_before, rise, step[axis])
                rises[further, axis] = sum_after

        gradient = vec4(0.0)
        nearest_weight = self.pair_weight[0]
        for axis in ti.static(self.axes):
            nearest_rise = rises[0, axis]
            slope = nearest_weight * nearest_rise
            for further in ti.static(self.further_counts):
                weight = self.pair_weight[further]
                further_rise = rises[further, axis]
                slope = slope + weight * further_rise
            gradient[axis] = slope
        return gradient

    @ti.func
    def laplacian(self, s: i32, n: i32) -> vec4:
        """Return dx^2 times the Laplacian of (v, r), by the nearest neighbours."""
        neighbour_sum = vec4(0.0)
        for step in ti.static(self.nearest_pairs):
            ahead = self.neighbour(n, step, 1)
            behind = self.neighbour(n, step, -1)
            state_ahead = self.node_state[s, ahead]
            state_behind = self.node_state[s, behind]
            neighbour_sum = neighbour_sum + (state_ahead + state_behind)
        middle = self.node_state[s, n]
        return neighbour_sum - 2.0 * self.dimension * middle

    @ti.func
    def add_forces(self, s: i32, n: i32) -> None:
        """Add dt a = dt (E/rho) grad Jbar + dt nu lap v + dt f."""
        state = self.node_state[s, n]
        density = state[3]
        gradient = self.pressure_gradient(s, n)
        laplacian = self.laplacian(s, n)
        diffusion = self.diffusion_number[s]
        gain = self.pressure_factor * gradient + diffusion * laplacian
        if ti.static(self.has_force):
            layer = self.force_layer[n]
            force_gain = self.force_gain[s, layer]
            gain = gain + force_gain
        if ti.static(self.has_fringe):
            stream = self.stream[s]
            damping = self.fringe_damping[n]
            gain = gain + damping * (stream - state)
        v = state + gain
        if ti.static(self.has_obstacle):
            mask = self.fluid_mask[s, n]
            gain = mask * gain
            v = mask * v

        speed = ti.abs(v)
        peak = self.peak_speed[s, n]
        for axis in ti.static(self.axes):
            component = speed[axis]
            peak = largest(component, peak)
        self.peak_speed[s, n] = peak
        # The fourth lanes hold Jbar and r.
        jacobian = self.node_jacobian[s, n]
        gain[3] = jacobian
        v[3] = density
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
                node = start + k
                weight = weights[k]
                node_state = self.next_state[s, node]
                share = weight * node_state
                node_gain = self.node_gain[s, node]
                gain += weight * node_gain
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
            low_weight = weights[0]
            mid_weight = weights[1]
            high_weight = weights[2]
            start = self.row_start(lowest, step)
            middle = start + 1
            last = start + 2

            low_state = self.next_state[s, start]
            mid_state = self.next_state[s, middle]
            high_state = self.next_state[s, last]
            low_share = low_weight * low_state
            high_share = high_weight * high_state
            row_state = low_share + mid_weight * mid_state + high_share

            low_gain = self.node_gain[s, start]
            mid_gain = self.node_gain[s, middle]
            high_gain = self.node_gain[s, last]
            low_gain_share = low_weight * low_gain
            mid_gain_share = mid_weight * mid_gain
            row_gain = low_gain_share + mid_gain_share + high_weight * high_gain

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
        grid_density = grid_state[3]
        grid_gain = self.grid_gain[s, p]
        velocity_gain = grid_gain.xyz
        grid_jacobian = grid_gain[3]
        density = largest(grid_density, 0.5)
        volume = 1.0 / density
        old_state = self.particle_state[s, p]
        old_velocity = old_state.xyz
        old_jacobian = old_state[3]
        v = old_velocity + velocity_gain
        v = v + self.parameters.velocity_relaxation * (grid_velocity - v)

        shift = vec3(0.0)
        shift_change = vec3(0.0)  # of the velocity, along the shift
        divergence = 0.0
        shift_bound = self.shift_bound
        shift_strength = self.shift_factor * volume
        for axis in ti.static(self.axes):
            slope = self.slopes[axis][s, p]
            velocity_slope = slope.xyz
            density_slope = slope[3]
            strain_rate = slope[axis]
            wanted = shift_strength * density_slope
            axis_shift = bounded(wanted, -shift_bound, shift_bound)
            shift[axis] = axis_shift
            axis_change = axis_shift * velocity_slope
            if ti.static(axis == 0):
                shift_change = axis_change
                divergence = strain_rate
            else:
                shift_change = shift_change + axis_change
                divergence = divergence + strain_rate
        v = v + shift_change

        old_x = self.x[s, p]
        inside = vec3(0.0)
        for axis in ti.static(self.axes):
            flow_speed = grid_velocity[axis]
            axis_shift = shift[axis]
            old_coordinate = old_x[axis]
            target = old_coordinate + (self.dt * flow_speed + axis_shift)
            coordinate = self.kept_inside(target, axis)
            inside[axis] = coordinate
        x = inside
        if ti.static(self.has_obstacle):
            # Not of x itself: in three dimensions Taichi 1.7.4 then drops the result.
            x = self.kept_outside(s, inside)

        flowed = old_jacobian + self.dt * divergence * old_jacobian
        jacobian = self.relaxed(flowed, old_jacobian, grid_jacobian, volume)
        state = vec4(v, jacobian)
        self.particle_state[s, p] = state
        speed = ti.abs(v)
        reached = vec4(speed, jacobian)
        extremes = self.extremes[s, p]
        extremes = largest(reached, extremes)
        self.extremes[s, p] = extremes
        old_minus_jacobian = old_x[3]
        minus_jacobian = largest(-jacobian, old_minus_jacobian)
        position = vec4(x, minus_jacobian)
        self.x[s, p] = position

    @ti.func
    def hold(self, s: i32, p: i32) -> None:
        """Relax J_p of an obstacle's particle, which neither moves nor deforms."""
        grid_state = self.grid_state[s, p]
        grid_density = grid_state[3]
        density = largest(grid_density, 0.5)
        volume = 1.0 / density
        grid_gain = self.grid_gain[s, p]
        grid_jacobian = grid_gain[3]
        no_slope = vec4(0.0)
        for axis in ti.static(self.axes):
            self.slopes[axis][s, p] = no_slope
        old_state = self.particle_state[s, p]
        old_jacobian = old_state[3]
        jacobian = self.relaxed(old_jacobian, old_jacobian, grid_jacobian, volume)
        state = vec4(0.0, 0.0, 0.0, jacobian)
        self.particle_state[s, p] = state

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
        centre = obstacle.xyz
        radius = obstacle[3]
        way = target - centre
        square = way.x * way.x + way.y * way.y + way.z * way.z
        radius_square = radius * radius
        # A place at the very centre has no nearest one; it stays.
        is_near = square < radius_square
        is_off_centre = square > 0.0
        is_inside = is_near and is_off_centre
        way_out = (radius / ti.sqrt(ti.select(is_inside, square, 1.0)) - 1.0) * way
        return ti.select(is_inside, target + way_out, target)

    @ti.func
    def kept_inside(self, target: f32, axis: Template) -> f32:
        """Return a coordinate between the walls, or wrapped into [low, high)."""
        low = self.position_min[axis]
        high = self.position_max[axis]
        x = target
        if ti.static(self.periodic[axis]):
            period = self.period[axis]
            x = ti.select(x >= high, x - period, x)
            x = ti.select(x < low, x + period, x)
            # The sum may round up to the end of the period; NaN becomes its start.
            x = ti.select(x < high, x, low)
        else:
            x = bounded(x, low, high)
        return x

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
                n = self.interior_node[i]
                self.fold(0, n, particle_volume)
            for g in range(ghosts):
                self.mirror(0, g)
            for i in range(interior):
                n = self.interior_node[i]
                self.add_forces(0, n)
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
            n = self.interior_node[i]
            particle_volume = self.particle_volume[s]
            self.fold(s, n, particle_volume)
        ti.loop_config(parallelize=threads)
        for s, g in ti.ndrange(scenarios, ghosts):
            self.mirror(s, g)
        ti.loop_config(parallelize=threads)
        for s, i in ti.ndrange(scenarios, interior):
            n = self.interior_node[i]
            self.add_forces(s, n)
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
        fluid = self.parameters.particles
        nodes = self.tables.node_count
        self._restart_extremes(fluid, nodes)

    @ti.kernel
    def _restart_extremes(self, particles: i32, nodes: i32) -> Nothing:
        is_serial = ti.static(not self.atomic)
        scenarios = ti.static(self.scenarios)
        ti.loop_config(serialize=is_serial)
        for s, p in ti.ndrange(scenarios, particles):
            state = self.particle_state[s, p]  # v_p, J_p
            velocity = state.xyz
            jacobian = state[3]
            speed = ti.abs(velocity)
            extremes = vec4(speed, jacobian)
            self.extremes[s, p] = extremes
            # this lane keeps the largest -J
            self.x[s, p][3] = -jacobian
        ti.loop_config(serialize=is_serial)
        for s, n in ti.ndrange(scenarios, nodes):
            self.peak_speed[s, n] = 0.0


def _axis_count(step: tuple[int, ...]) -> int:
    """Return along how many axes a neighbour lies off."""
    nonzero = [value for value in step if value != 0]
    return len(nonzero)


def _vector_field() -> Any:  # noqa: ANN401 (Taichi is untyped)
    """Return a field of vectors of four."""
    return vec4.field()


def _number_field() -> Any:  # noqa: ANN401 (Taichi is untyped)
    """Return a field of numbers."""
    return ti.field(f32)


def _index_field() -> Any:  # noqa: ANN401 (Taichi is untyped)
    """Return a field of numbers of nodes, ghosts or layers."""
    return ti.field(i32)


def _sum_field() -> Any:  # noqa: ANN401 (Taichi is untyped)
    """Return a field of fixed-point sums of vectors of four."""
    return ti.Vector.field(LANES, i64)
