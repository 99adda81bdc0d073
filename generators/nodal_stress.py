"""One substep of weakly compressible flow whose stress acts at the nodes.

The walls lie half-way between nodes; beyond each is one layer of ghost nodes, the
mirror images of the outermost interior nodes. Per substep, for particles of equal mass
m, positions x_p, grid spacing dx and weights w_ip:

1. P2G: n_i = sum w,  (n J)_i = sum w J_p,  (n v)_i = sum w (v_p + C_p (x_i - x_p)).
2. Fold: ghosts give what they received to their mirror images, normal momentum
   reversed, tangential momentum n (2 u_wall - v) at a no-slip wall and n v at a
   free-slip wall. Then v = (n v)/n,  Jbar = (n J)/n,  relative density
   r = n m / (rho dx^2); ghosts mirror them.
3. Forces: a = (E/rho) grad Jbar + nu lap v,  v <- v + dt a; ghosts mirror v and a.
4. G2P: v* = sum w v,  a* = sum w a,  r = max(sum w r, 1/2),
   grad q = (4/dx^2) sum w q (x_i - x_p),  C = grad v,
   shift s = -beta dx^2 grad(r)/r, each component within 0.1 dx,
   v_p <- (v_p + dt a*) + lambda (v* - v_p - dt a*) + C s,
   x_p <- x_p + dt v* + s, kept in the box,
   J_p <- J_p (1 + dt tr C) + kappa (Jbar - J_p) + theta (1/r - Jbar).

The mass of a particle cancels everywhere but in r, so nodes count particles, n, and no
sum is tiny. Sums are integers (:mod:`.transfer`): no order of particles or threads
changes a bit.

Valid while max abs(v) dt <= dx, which also bounds every fixed-point sum, and while J
stays in (0, 8]. Settings that reproduce Ghia, Ghia & Shin (1982) are those of the split
``cavity``.
"""

from typing import Any

import taichi as ti
from taichi import f32, f64, i32, i64
from taichi.math import vec2, vec4

from . import backend
from .split import ClosedBoxParameters
from .transfer import (
    Nothing,
    Template,
    Value,
    accumulate,
    base_node,
    bounded,
    fixed_point_scale,
    from_fixed,
    largest,
    masked,
    stencil,
    stepped,
)
from .walls import Walls

JACOBIAN_BOUND = 8.0  # largest J that the sums have room for [1]
_INSET = 1e-3  # distance that particles keep from a wall [cells]
_REACH = 16.0
"""Bound of abs(v_p + C (x_i - x_p)) over the speed bound dx/dt [1].

Walls move at half the bound or less, so ghosts at twice the bound or less; abs(C_ab) <=
(4/dx^2) max abs(v) sum w abs(x_i - x_p) <= 4/dt, and a node lies within 1.5 dx per
axis: 1 + 2 x 4 x 1.5 = 13.
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

    at_rest = (0.0, 0.0, 1.0, 1.0)  # state of a particle at rest

    def __init__(
        self,
        parameters: ClosedBoxParameters,
        *,
        scenarios: int,
        atomic: bool,
        threads: int,
    ) -> None:
        """Compute the constants of the scheme and allocate the fields."""
        p = parameters
        dx = 1.0 / p.grid
        low_wall = p.wall + 0.5  # coordinates of the walls [cells]
        high_ghost = p.grid - p.wall
        high_wall = high_ghost - 0.5
        self.parameters = parameters  # constants that the scenarios share
        self.scenarios = scenarios  # scenarios advanced together
        self.atomic = atomic  # whether several threads run the phases
        self.threads = threads  # threads of the parallel loops on a CPU
        # whether the velocities of the coming substeps are summed, for their mean
        self.averaging = False
        self.walls = Walls(grid=p.grid, wall=p.wall, no_slip=p.no_slip)
        self.particles = p.particles
        self.inv_dx = float(p.grid)
        self.width = p.grid + 1
        self.node_count = self.width**2
        self.dt = p.dt
        # smallest and largest coordinate of a particle [length]
        lowest_place = low_wall + _INSET  # [cells]
        highest_place = high_wall - _INSET
        self.position_min = lowest_place * dx
        self.position_max = highest_place * dx
        self.speed_bound = dx / p.dt  # the CFL bound dx/dt [length/s]
        reach_bound = _REACH * self.speed_bound
        self.velocity_scale = fixed_point_scale(p.particles, reach_bound)
        self.count_scale = fixed_point_scale(p.particles, JACOBIAN_BOUND)
        self.velocity_unit = 1.0 / self.velocity_scale
        self.count_unit = 1.0 / self.count_scale
        self.cell_scale = self.velocity_scale * dx
        # dt E / (2 rho dx): gain of velocity by a difference of Jbar over two cells
        divisor = p.density * 2.0 * dx
        impulse = p.dt * p.modulus
        self.pressure_factor = impulse / divisor
        self.slope_factor = 4.0 * self.inv_dx  # 4/dx
        minus_shift_length = -p.shift * dx
        self.shift_factor = minus_shift_length * dx  # -beta dx^2
        self.shift_bound = 0.1 * dx
        self._declare_fields()
        self._tree = self._place_fields()

    def _declare_fields(self) -> None:
        """Name the fields; they have no memory yet."""
        # of each particle: its position [length], and two zeros
        self.x = vec4.field()
        # what P2G spreads: v_x, v_y, 1, J
        self.particle_state = vec4.field()
        # v_x, v_y, r and Jbar of the nodes, at the particle
        self.grid_state = vec4.field()
        # d/dx of the same
        self.slope_x = vec4.field()
        # d/dy of the same
        self.slope_y = vec4.field()
        self.slopes = (self.slope_x, self.slope_y)
        # dt a of the nodes, at the particle, and two zeros
        self.grid_gain = vec4.field()
        # largest abs(v_x), abs(v_y), J and -J since the advance began
        self.extremes = vec4.field()
        # rows of its stencil
        self.first_row = vec4.field()
        self.second_row = vec4.field()
        self.third_row = vec4.field()
        self.weight_rows = [self.first_row, self.second_row, self.third_row]

        # of each node: n v_x, n v_y, n, n J
        self.sums = ti.Vector.field(4, i64)
        # v_x, v_y, r, Jbar before the forces of this substep
        self.node_state = vec4.field()
        # the same after them
        self.next_state = vec4.field()
        self.node_gain = vec2.field()  # dt a
        # largest absolute velocity component since the advance began
        self.peak_speed = ti.field(f32)
        # sum over time of the velocity
        self.velocity_sum = ti.Vector.field(2, f64)

        # of each scenario: nu dt / dx^2 and m / (rho dx^2)
        self.diffusion_number = ti.field(f32)
        self.particle_volume = ti.field(f32)

    def _place_fields(self) -> Any:  # noqa: ANN401 (Taichi is untyped)
        """Give the fields their memory, each an array of its own."""
        particle_fields = (
            self.x,
            self.particle_state,
            self.slope_x,
            self.slope_y,
            *self.weight_rows,
            self.grid_state,
            self.grid_gain,
            self.extremes,
        )
        node_fields = (
            self.sums,
            self.node_state,
            self.next_state,
            self.node_gain,
            self.peak_speed,
            self.velocity_sum,
        )
        scenario_fields = [
            self.walls.speed,
            self.diffusion_number,
            self.particle_volume,
        ]
        particle_shape = (self.scenarios, self.particles)
        node_shape = (self.scenarios, self.node_count)
        scenario_shape = (self.scenarios,)
        return backend.place(
            (particle_shape, particle_fields),
            (node_shape, node_fields),
            (scenario_shape, scenario_fields),
        )

    def release(self) -> None:
        """Give the memory back; the fields cannot be used afterwards."""
        self._tree.destroy()

    @ti.func
    def at(self, i: i32, j: i32) -> i32:
        """Return the number of a node."""
        column = i * self.width
        return column + j

    @ti.func
    def state_at(self, s: i32, i: i32, j: i32) -> vec4:
        """Return v_x, v_y, r and Jbar of a node before the forces."""
        node = self.at(i, j)
        return self.node_state[s, node]

    @ti.func
    def jacobian_at(self, s: i32, i: i32, j: i32) -> f32:
        """Return Jbar of a node before the forces."""
        state = self.state_at(s, i, j)
        return state[3]

    # The phases: each function is one phase at one particle or node.

    @ti.func
    def clear(self, s: i32, i: i32, j: i32) -> None:
        """Set the sums of a node of scenario s to zero, before P2G adds to them."""
        node = self.at(i, j)
        zero = ti.Vector.zero(i64, 4)
        self.sums[s, node] = zero

    @ti.func
    def locate(self, s: i32, p: i32) -> None:
        """Keep for P2G and G2P which nodes a particle touches, and the weights."""
        position = self.x[s, p]
        first, second, third = stencil(position, self.inv_dx, self.width)
        self.first_row[s, p] = first
        self.second_row[s, p] = second
        self.third_row[s, p] = third

    @ti.func
    def p2g(self, s: i32, p: i32) -> None:
        """Spread n v, n and n J, from the middle node to its neighbours, dx away."""
        base, offset = base_node(self.weight_rows, s, p)
        scale = vec4(
            self.velocity_scale,
            self.velocity_scale,
            self.count_scale,
            self.count_scale,
        )
        # n and J have no slope; a product with 0 is one, as nodes, and so slopes, are
        # finite.
        cell_scale = self.cell_scale
        slope_scale = vec4(cell_scale, cell_scale, 0.0, 0.0)
        # what is added from one node to the next, along x and along y
        slope_x = self.slope_x[s, p]
        step_x = slope_scale * slope_x
        slope_y = self.slope_y[s, p]
        step_y = slope_scale * slope_y

        state = self.particle_state[s, p]
        at_particle = scale * state
        change_x = offset.x * step_x
        at_middle = at_particle - change_x
        change_y = offset.y * step_y
        at_middle = at_middle - change_y
        for i in ti.static(range(3)):
            column = base + i * self.width
            at_column = stepped(at_middle, step_x, i - 1)
            for j in ti.static(range(3)):
                at_node = stepped(at_column, step_y, j - 1)
                node = column + j
                # A weight at a time: a name for the row makes this loop slower.
                weight = self.weight_rows[i][s, p][j]
                share = weight * at_node
                accumulate(self.sums, s, node, share, self.atomic)

    @ti.func
    def received(self, s: i32, i: i32, j: i32) -> Value:
        """Return the sums of a node and its mirror images, and the drag of the walls.

        The drag is the momentum that moving walls add.
        """
        node = self.at(i, j)
        total = self.sums[s, node]
        drag = vec2(0.0)
        ghost_i = self.walls.beyond(i)
        ghost_j = self.walls.beyond(j)
        is_beside_x_wall = ghost_i != i
        is_beside_y_wall = ghost_j != j
        # signs of n v_x, n v_y, n and n J in the image across an x wall, and a y wall
        tangential = self.walls.tangential
        x_sign = ti.Vector([-1, tangential, 1, 1])
        y_sign = ti.Vector([tangential, -1, 1, 1])

        # Walls across x slide along y, and the other way round.
        if is_beside_x_wall:
            ghost = self.at(ghost_i, j)
            image = self.sums[s, ghost]
            reflected = x_sign * image
            total += reflected
            count_sum = image[2]
            count = from_fixed(count_sum, self.count_unit)
            speed_y = self.walls.doubled_speed(s, 0, ghost_i)
            momentum_y = speed_y * count
            drag.y += momentum_y
        if is_beside_y_wall:
            ghost = self.at(i, ghost_j)
            image = self.sums[s, ghost]
            reflected = y_sign * image
            total += reflected
            count_sum = image[2]
            count = from_fixed(count_sum, self.count_unit)
            speed_x = self.walls.doubled_speed(s, 2, ghost_j)
            momentum_x = speed_x * count
            drag.x += momentum_x
        if is_beside_x_wall and is_beside_y_wall:
            ghost = self.at(ghost_i, ghost_j)
            image = self.sums[s, ghost]
            corner_sign = x_sign * y_sign
            reflected = corner_sign * image
            total += reflected
            count_sum = image[2]
            count = from_fixed(count_sum, self.count_unit)
            speed_x = self.walls.doubled_speed(s, 2, ghost_j)
            speed_y = self.walls.doubled_speed(s, 0, ghost_i)
            momentum_x = speed_x * count
            momentum_y = speed_y * count
            drag.x += momentum_x
            drag.y += momentum_y
        return total, drag

    @ti.func
    def fold(self, s: i32, i: i32, j: i32, particle_volume: f32) -> None:
        """Turn the sums of an interior node into v, r and Jbar."""
        velocity = vec2(0.0)
        density = 0.0
        jacobian = 1.0

        total, drag = self.received(s, i, j)
        momentum_sum = total.xy
        count_sum = total[2]
        jacobian_sum = total[3]
        if count_sum > 0:
            momentum = from_fixed(momentum_sum, self.velocity_unit)
            momentum = momentum + drag
            count = from_fixed(count_sum, self.count_unit)
            count_times_jacobian = from_fixed(jacobian_sum, self.count_unit)
            velocity = momentum / count
            density = count * particle_volume
            jacobian = count_times_jacobian / count

        node = self.at(i, j)
        state = vec4(velocity, density, jacobian)
        self.node_state[s, node] = state

    @ti.func
    def source(self, i: i32, j: i32) -> i32:
        """Return the number of the interior node that a ghost node mirrors."""
        source_i = self.walls.source(i)
        source_j = self.walls.source(j)
        return self.at(source_i, source_j)

    @ti.func
    def mirror(self, states: Template, s: i32, k: i32) -> None:
        """Fill the k-th ghost node of (v, r, Jbar).

        r and Jbar are even about the wall, v is odd about the velocity of the wall.
        """
        i, j = self.walls.ring(k)
        source = self.source(i, j)
        image = states[s, source]
        velocity = image.xy

        sign = self.walls.reflection(i, j)
        drive = self.walls.drive(s, i, j)
        reflected = sign * velocity
        image.xy = reflected + drive

        ghost = self.at(i, j)
        states[s, ghost] = image

    @ti.func
    def mirror_gain(self, s: i32, k: i32) -> None:
        """Fill the k-th ghost node of dt a: as the velocity by walls at rest."""
        i, j = self.walls.ring(k)
        source = self.source(i, j)
        gain = self.node_gain[s, source]

        sign = self.walls.reflection(i, j)
        reflected = sign * gain

        ghost = self.at(i, j)
        self.node_gain[s, ghost] = reflected

    @ti.func
    def pressure_gradient(self, s: i32, i: i32, j: i32) -> vec2:
        """Return 2 dx grad Jbar, weighted 1/8, 3/4, 1/8 across."""
        left = i - 1
        right = i + 1
        below = j - 1
        above = j + 1
        east = self.jacobian_at(s, right, j)
        west = self.jacobian_at(s, left, j)
        north = self.jacobian_at(s, i, above)
        south = self.jacobian_at(s, i, below)
        north_east = self.jacobian_at(s, right, above)
        south_west = self.jacobian_at(s, left, below)
        south_east = self.jacobian_at(s, right, below)
        north_west = self.jacobian_at(s, left, above)

        near_x = east - west
        near_y = north - south
        # along the two diagonals, and their sums along x and y
        rising = north_east - south_west
        falling = south_east - north_west
        far_x = rising + falling
        far_y = rising - falling

        near = vec2(near_x, near_y)
        far = vec2(far_x, far_y)
        near_share = 0.75 * near
        far_share = 0.125 * far
        return near_share + far_share

    @ti.func
    def laplacian(self, s: i32, i: i32, j: i32) -> vec4:
        """Return dx^2 times the Laplacian of (v, r, Jbar), by the four neighbours."""
        left = i - 1
        right = i + 1
        below = j - 1
        above = j + 1
        east = self.state_at(s, right, j)
        west = self.state_at(s, left, j)
        north = self.state_at(s, i, above)
        south = self.state_at(s, i, below)
        middle = self.state_at(s, i, j)
        along_x = east + west
        along_y = north + south
        neighbours = along_x + along_y
        four_middles = 4.0 * middle
        return neighbours - four_middles

    @ti.func
    def add_forces(self, s: i32, i: i32, j: i32) -> None:
        """Add dt a = dt (E/rho) grad Jbar + dt nu lap v."""
        node = self.at(i, j)
        state = self.node_state[s, node]
        gradient = self.pressure_gradient(s, i, j)
        laplacian = self.laplacian(s, i, j)
        diffusion = self.diffusion_number[s]

        pressure_gain = self.pressure_factor * gradient
        velocity_laplacian = laplacian.xy
        viscous_gain = diffusion * velocity_laplacian
        gain = pressure_gain + viscous_gain
        self.node_gain[s, node] = gain

        old_velocity = state.xy
        velocity = old_velocity + gain
        state.xy = velocity
        self.next_state[s, node] = state

        speed = ti.abs(velocity)
        peak = self.peak_speed[s, node]
        peak = largest(speed.y, peak)
        peak = largest(speed.x, peak)
        self.peak_speed[s, node] = peak

    @ti.func
    def g2p(self, s: i32, p: i32) -> None:
        """Interpolate (v, r, Jbar), their slopes and dt a."""
        lowest, offset = base_node(self.weight_rows, s, p)
        base = masked(lowest, self.node_count)
        state = vec4(0.0)
        gain = vec2(0.0)
        # sums of w q (x_i - x_middle) / dx, along x and along y
        moment_x = vec4(0.0)
        moment_y = vec4(0.0)
        for i in ti.static(range(3)):
            weights = self.weight_rows[i][s, p]
            column = base + i * self.width
            for j in ti.static(range(3)):
                node = column + j
                weight = weights[j]
                node_state = self.next_state[s, node]
                node_gain = self.node_gain[s, node]
                share = weight * node_state
                gain_share = weight * node_gain
                gain += gain_share
                state += share
                moment_x = stepped(moment_x, share, i - 1)
                moment_y = stepped(moment_y, share, j - 1)

        # the same about the particle
        offset_x = offset.x * state
        offset_y = offset.y * state
        moment_x = moment_x - offset_x
        moment_y = moment_y - offset_y
        slope_x = self.slope_factor * moment_x
        slope_y = self.slope_factor * moment_y
        self.slope_x[s, p] = slope_x
        self.slope_y[s, p] = slope_y
        self.grid_state[s, p] = state
        filled_gain = vec4(gain, 0.0, 0.0)
        self.grid_gain[s, p] = filled_gain

    @ti.func
    def update(self, s: i32, p: i32) -> None:
        """Relax v_p and J_p towards the grid, move and shift x_p."""
        grid_state = self.grid_state[s, p]
        grid_velocity = grid_state.xy
        grid_density = grid_state[2]
        grid_jacobian = grid_state[3]
        grid_gain = self.grid_gain[s, p]
        slope_x = self.slope_x[s, p]
        slope_y = self.slope_y[s, p]

        density = largest(grid_density, 0.5)
        volume = 1.0 / density
        density_slope_x = slope_x[2]
        density_slope_y = slope_y[2]
        density_slope = vec2(density_slope_x, density_slope_y)
        shift_per_slope = self.shift_factor * volume
        shift = shift_per_slope * density_slope
        bound = self.shift_bound
        shift = bounded(shift, -bound, bound)

        old_state = self.particle_state[s, p]
        old_velocity = old_state.xy
        velocity_gain = grid_gain.xy
        velocity = old_velocity + velocity_gain
        velocity_lag = grid_velocity - velocity
        relaxed = self.parameters.velocity_relaxation * velocity_lag
        velocity = velocity + relaxed
        # C s
        velocity_slope_x = slope_x.xy
        velocity_slope_y = slope_y.xy
        change_x = shift.x * velocity_slope_x
        change_y = shift.y * velocity_slope_y
        change = change_x + change_y
        velocity = velocity + change

        old_x = self.x[s, p]
        old_position = old_x.xy
        way = self.dt * grid_velocity
        step = way + shift
        moved = old_position + step
        inside = bounded(moved, self.position_min, self.position_max)
        x = vec4(inside, 0.0, 0.0)
        self.x[s, p] = x

        u_x = slope_x.x
        v_y = slope_y.y
        divergence = u_x + v_y
        old_jacobian = old_state[3]
        expansion = self.dt * divergence
        growth = expansion * old_jacobian
        lag = grid_jacobian - old_jacobian
        relaxation = self.parameters.jacobian_relaxation * lag
        compression = volume - grid_jacobian
        coupling = self.parameters.density_coupling * compression
        jacobian = old_jacobian + growth
        jacobian = jacobian + relaxation
        jacobian = jacobian + coupling
        state = vec4(velocity, 1.0, jacobian)
        self.particle_state[s, p] = state

        speed = ti.abs(velocity)
        reached = vec4(speed, jacobian, -jacobian)
        extremes = self.extremes[s, p]
        extremes = largest(reached, extremes)
        self.extremes[s, p] = extremes

    @ti.func
    def sum_velocity(self, s: i32, n: i32) -> None:
        """Add a node's velocity to its sum over time, outside the path of the bits."""
        state = self.next_state[s, n]
        velocity = state.xy
        exact = ti.cast(velocity, f64)
        velocity_sum = self.velocity_sum[s, n]
        velocity_sum = velocity_sum + exact
        self.velocity_sum[s, n] = velocity_sum

    # The drivers: the same phases in the same order.

    def run_serially(self, substeps: int) -> None:
        """Advance scenario 0 by many substeps in one thread."""
        average = int(self.averaging)
        self._serial_substeps(substeps, average)

    def run_in_parallel(self) -> None:
        """Advance every scenario by one substep: one launch per phase."""
        self._parallel_substep()
        if self.averaging:
            self._add_to_total()

    @ti.kernel
    def _serial_substeps(self, substeps: i32, average: i32) -> Nothing:
        particles = ti.static(self.particles)
        ring_size = ti.static(self.walls.ring_size)
        first_node, end_node = ti.static(self.walls.all_nodes)
        first_inner, end_inner = ti.static(self.walls.interior_nodes)
        ti.loop_config(serialize=True)
        for _ in range(substeps):
            # Read first, so that the address of the fields stays out of the loops: else
            # no vectors.
            particle_volume = self.particle_volume[0]
            for i in range(first_node, end_node):
                for j in range(first_node, end_node):
                    self.clear(0, i, j)
            for p in range(particles):
                self.locate(0, p)
            for p in range(particles):
                self.p2g(0, p)
            for i in range(first_inner, end_inner):
                for j in range(first_inner, end_inner):
                    self.fold(0, i, j, particle_volume)
            for k in range(ring_size):
                self.mirror(self.node_state, 0, k)
            for i in range(first_inner, end_inner):
                for j in range(first_inner, end_inner):
                    self.add_forces(0, i, j)
            for k in range(ring_size):
                self.mirror(self.next_state, 0, k)
                self.mirror_gain(0, k)
            if average:
                for n in range(self.node_count):
                    self.sum_velocity(0, n)
            for p in range(particles):
                self.g2p(0, p)
            for p in range(particles):
                self.update(0, p)

    @ti.kernel
    def _parallel_substep(self) -> Nothing:
        threads = ti.static(self.threads)
        scenarios = ti.static(self.scenarios)
        particles = ti.static(self.particles)
        ring_size = ti.static(self.walls.ring_size)
        all_nodes = ti.static(self.walls.all_nodes)
        interior = ti.static(self.walls.interior_nodes)
        ti.loop_config(parallelize=threads)
        for s, i, j in ti.ndrange(scenarios, all_nodes, all_nodes):
            self.clear(s, i, j)
        ti.loop_config(parallelize=threads)
        for s, p in ti.ndrange(scenarios, particles):
            self.locate(s, p)
            self.p2g(s, p)
        ti.loop_config(parallelize=threads)
        for s, i, j in ti.ndrange(scenarios, interior, interior):
            particle_volume = self.particle_volume[s]
            self.fold(s, i, j, particle_volume)
        ti.loop_config(parallelize=threads)
        for s, k in ti.ndrange(scenarios, ring_size):
            self.mirror(self.node_state, s, k)
        ti.loop_config(parallelize=threads)
        for s, i, j in ti.ndrange(scenarios, interior, interior):
            self.add_forces(s, i, j)
        ti.loop_config(parallelize=threads)
        for s, k in ti.ndrange(scenarios, ring_size):
            self.mirror(self.next_state, s, k)
            self.mirror_gain(s, k)
        ti.loop_config(parallelize=threads)
        for s, p in ti.ndrange(scenarios, particles):
            self.g2p(s, p)
            self.update(s, p)

    def restart_extremes(self) -> None:
        """Start an advance: the extremes are those of the present state."""
        self._restart_extremes(self.particles, self.node_count)

    @ti.kernel
    def _restart_extremes(self, particles: i32, nodes: i32) -> Nothing:
        # Counts are arguments: with some constants, such as 4,000, LLVM compiles for
        # twenty seconds.
        scenarios = ti.static(self.scenarios)
        is_serial = ti.static(not self.atomic)
        ti.loop_config(serialize=is_serial)
        for s, p in ti.ndrange(scenarios, particles):
            state = self.particle_state[s, p]
            velocity = state.xy
            jacobian = state[3]
            speed = ti.abs(velocity)
            extremes = vec4(speed, jacobian, -jacobian)
            self.extremes[s, p] = extremes
        ti.loop_config(serialize=is_serial)
        for s, n in ti.ndrange(scenarios, nodes):
            self.peak_speed[s, n] = 0.0

    @ti.kernel
    def _add_to_total(self) -> Nothing:
        for s, n in self.next_state:
            self.sum_velocity(s, n)
