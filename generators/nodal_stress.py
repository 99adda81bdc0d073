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

    def __init__(
        self,
        parameters: ClosedBoxParameters,
        *,
        scenarios: int,
        atomic: bool,
        threads: int,
    ) -> None:
        """Round the constants and take the memory."""
        p = parameters
        dx = 1.0 / p.grid
        self.parameters = parameters  # constants that the scenarios share
        self.scenarios = scenarios  # scenarios advanced together
        self.atomic = atomic  # whether several threads run the phases
        self.threads = threads  # threads of the parallel loops on a CPU
        self.averaging = False  # whether the substeps to come count for the total
        self.walls = Walls(grid=p.grid, wall=p.wall, no_slip=p.no_slip)
        self.inv_dx = float(p.grid)
        self.width = p.grid + 1
        self.node_count = self.width**2
        self.dt = p.dt
        self.least = (p.wall + 0.5 + _INSET) * dx  # smallest coordinate of a particle
        # largest coordinate of a particle
        self.most = (p.grid - p.wall - 0.5 - _INSET) * dx
        self.speed_bound = dx / p.dt  # the CFL bound dx/dt [length/s]
        self.velocity_scale = fixed_point_scale(p.particles, _REACH * self.speed_bound)
        self.count_scale = fixed_point_scale(p.particles, JACOBIAN_BOUND)
        self.velocity_unit = 1.0 / self.velocity_scale
        self.count_unit = 1.0 / self.count_scale
        self.cell_scale = self.velocity_scale * dx
        self.pressure = p.dt * p.modulus / (p.density * 2.0 * dx)
        self.gradient = 4.0 * self.inv_dx
        self.shift = -p.shift * dx * dx
        self.shift_bound = 0.1 * dx
        self._declare_fields()
        self._tree = self._place_fields()

    def _declare_fields(self) -> None:
        """Name the fields; they have no memory yet."""
        # particle positions [length], and two zeros
        self.x = ti.Vector.field(4, ti.f32)
        self.carried = ti.Vector.field(4, ti.f32)  # what P2G spreads: v_x, v_y, 1, J
        self.at_rest = (0.0, 0.0, 1.0, 1.0)  # of a particle at rest
        # d/dx of the nodal (v_x, v_y, r, Jbar) at the particles
        self.slope_x = ti.Vector.field(4, ti.f32)
        self.slope_y = ti.Vector.field(4, ti.f32)  # d/dy of the same
        self.slopes = (self.slope_x, self.slope_y)
        # largest abs(v_x), abs(v_y), J and -J of each particle since the advance began
        self.extremes = ti.Vector.field(4, ti.f32)
        self.rows = [ti.Vector.field(4, ti.f32) for _ in range(3)]  # of the stencil
        # nodal v_x, v_y, r, Jbar at the particles
        self.here = ti.Vector.field(4, ti.f32)
        # nodal dt a at the particles, and two zeros
        self.push = ti.Vector.field(4, ti.f32)
        self.sums = ti.Vector.field(4, ti.i64)  # n v_x, n v_y, n, n J
        self.node = ti.Vector.field(4, ti.f32)  # v_x, v_y, r, Jbar
        # the same after the forces of the last substep
        self.moved = ti.Vector.field(4, ti.f32)
        self.gain = ti.Vector.field(2, ti.f32)  # dt a
        # largest absolute velocity component since the advance began
        self.peak = ti.field(ti.f32)
        self.total = ti.Vector.field(2, ti.f64)  # sum over time of the nodal velocities
        self.spread = ti.field(ti.f32)  # nu dt / dx^2, shape [scenario]
        self.fill = ti.field(ti.f32)  # m / (rho dx^2), shape [scenario]

    def _place_fields(self) -> Any:  # noqa: ANN401 (Taichi is untyped)
        """Give the fields their memory, each an array of its own."""
        particle_fields = (
            self.x,
            self.carried,
            self.slope_x,
            self.slope_y,
            *self.rows,
            self.here,
            self.push,
            self.extremes,
        )
        node_fields = (
            self.sums,
            self.node,
            self.moved,
            self.gain,
            self.peak,
            self.total,
        )
        particle_shape = (self.scenarios, self.parameters.particles)
        node_shape = (self.scenarios, self.node_count)
        scenario_fields = [self.walls.speed, self.spread, self.fill]
        return backend.place(
            *((particle_shape, [field]) for field in particle_fields),
            *((node_shape, [field]) for field in node_fields),
            ((self.scenarios,), scenario_fields),
        )

    def release(self) -> None:
        """Give the memory back; the fields cannot be used afterwards."""
        self._tree.destroy()

    @ti.func
    def at(self, i: ti.i32, j: ti.i32) -> ti.i32:
        """Return the index of a node."""
        return i * self.width + j

    # The phases: each function is one phase at one particle or node.

    @ti.func
    def clear(self, s: ti.i32, i: ti.i32, j: ti.i32) -> None:
        """Set the sums of a node of scenario s to zero, before P2G adds to them."""
        self.sums[s, self.at(i, j)] = ti.Vector([0, 0, 0, 0], ti.i64)

    @ti.func
    def locate(self, s: ti.i32, p: ti.i32) -> None:
        """Keep for P2G and G2P which nodes a particle touches, and the weights."""
        first, second, third = stencil(self.x[s, p], self.inv_dx, self.width)
        self.rows[0][s, p] = first
        self.rows[1][s, p] = second
        self.rows[2][s, p] = third

    @ti.func
    def p2g(self, s: ti.i32, p: ti.i32) -> None:
        """Spread n v, n and n J, from the middle node to its neighbours, dx away."""
        base, offset = base_node(self.rows, s, p, self.node_count)
        scale = ti.Vector(
            [
                self.velocity_scale,
                self.velocity_scale,
                self.count_scale,
                self.count_scale,
            ]
        )
        # n and J have no slope; a product with 0 is one, as nodes, and so slopes, are
        # finite.
        only_v = ti.Vector([self.cell_scale, self.cell_scale, 0.0, 0.0])
        c_x = only_v * self.slope_x[s, p]
        c_y = only_v * self.slope_y[s, p]
        middle = scale * self.carried[s, p] - offset[0] * c_x - offset[1] * c_y
        for i, j in ti.static(ti.ndrange(3, 3)):
            column = stepped(middle, c_x, i - 1)
            value = stepped(column, c_y, j - 1)
            node = ti.Vector([s, base + i * self.width + j])
            weight = self.rows[i][s, p][j]
            accumulate(self.sums, node, weight * value, self.atomic)

    @ti.func
    def received(self, s: ti.i32, i: ti.i32, j: ti.i32) -> Value:
        """Return the sums of a node and its mirror images, and the drag of the walls.

        The drag is the momentum that moving walls add.
        """
        total = self.sums[s, self.at(i, j)]
        drag = ti.Vector([0.0, 0.0])
        tangential = self.walls.tangential
        x_ghost = self.walls.beyond(i)
        y_ghost = self.walls.beyond(j)
        if x_ghost != i:
            image = self.sums[s, self.at(x_ghost, j)]
            total += ti.Vector([-1, tangential, 1, 1]) * image
            count = from_fixed(image[2], self.count_unit)
            drag[1] += self.walls.doubled_speed(s, 0, x_ghost) * count
        if y_ghost != j:
            image = self.sums[s, self.at(i, y_ghost)]
            total += ti.Vector([tangential, -1, 1, 1]) * image
            count = from_fixed(image[2], self.count_unit)
            drag[0] += self.walls.doubled_speed(s, 2, y_ghost) * count
        if x_ghost != i and y_ghost != j:
            image = self.sums[s, self.at(x_ghost, y_ghost)]
            total += ti.Vector([-tangential, -tangential, 1, 1]) * image
            count = from_fixed(image[2], self.count_unit)
            drag[0] += self.walls.doubled_speed(s, 2, y_ghost) * count
            drag[1] += self.walls.doubled_speed(s, 0, x_ghost) * count
        return total, drag

    @ti.func
    def fold(self, s: ti.i32, i: ti.i32, j: ti.i32, fill: ti.f32) -> None:
        """Turn the sums of an interior node into v, r and Jbar."""
        total, drag = self.received(s, i, j)
        state = ti.Vector([0.0, 0.0, 0.0, 1.0])
        if total[2] > 0:
            count = from_fixed(total[2], self.count_unit)
            momentum_x = from_fixed(total[0], self.velocity_unit) + drag[0]
            momentum_y = from_fixed(total[1], self.velocity_unit) + drag[1]
            state[0] = momentum_x / count
            state[1] = momentum_y / count
            state[2] = count * fill
            state[3] = from_fixed(total[3], self.count_unit) / count
        self.node[s, self.at(i, j)] = state

    @ti.func
    def mirror(self, state: Template, s: ti.i32, k: ti.i32) -> None:
        """Fill the k-th ghost node of (v, r, Jbar).

        r and Jbar are even about the wall, v is odd about the velocity of the wall.
        """
        i, j = self.walls.ring(k)
        source = self.at(self.walls.source(i), self.walls.source(j))
        image = state[s, source]
        sign = self.walls.reflection(i, j)
        drive = self.walls.drive(s, i, j)
        v_x = sign[0] * image[0] + drive[0]
        v_y = sign[1] * image[1] + drive[1]
        state[s, self.at(i, j)] = ti.Vector([v_x, v_y, image[2], image[3]])

    @ti.func
    def mirror_gain(self, s: ti.i32, k: ti.i32) -> None:
        """Fill the k-th ghost node of dt a: as the velocity by walls at rest."""
        i, j = self.walls.ring(k)
        source = self.at(self.walls.source(i), self.walls.source(j))
        sign = self.walls.reflection(i, j)
        self.gain[s, self.at(i, j)] = sign * self.gain[s, source]

    @ti.func
    def force(self, s: ti.i32, i: ti.i32, j: ti.i32) -> None:
        """Add dt a = dt (E/rho) grad Jbar + dt nu lap v.

        Gradients are weighted 1/8, 3/4, 1/8 across.
        """
        east = self.node[s, self.at(i + 1, j)]
        west = self.node[s, self.at(i - 1, j)]
        north = self.node[s, self.at(i, j + 1)]
        south = self.node[s, self.at(i, j - 1)]
        north_east = self.node[s, self.at(i + 1, j + 1)][3]
        south_west = self.node[s, self.at(i - 1, j - 1)][3]
        rising = north_east - south_west
        south_east = self.node[s, self.at(i + 1, j - 1)][3]
        north_west = self.node[s, self.at(i - 1, j + 1)][3]
        falling = south_east - north_west
        grad_x = 0.75 * (east[3] - west[3]) + 0.125 * (rising + falling)
        grad_y = 0.75 * (north[3] - south[3]) + 0.125 * (rising - falling)

        here = self.node[s, self.at(i, j)]
        laplacian = ((east + west) + (north + south)) - 4.0 * here
        gain_x = self.pressure * grad_x + self.spread[s] * laplacian[0]
        gain_y = self.pressure * grad_y + self.spread[s] * laplacian[1]
        v_x = here[0] + gain_x
        v_y = here[1] + gain_y
        self.gain[s, self.at(i, j)] = ti.Vector([gain_x, gain_y])
        self.moved[s, self.at(i, j)] = ti.Vector([v_x, v_y, here[2], here[3]])
        peak = largest(ti.abs(v_y), self.peak[s, self.at(i, j)])
        self.peak[s, self.at(i, j)] = largest(ti.abs(v_x), peak)

    @ti.func
    def g2p(self, s: ti.i32, p: ti.i32) -> None:
        """Interpolate (v, r, Jbar), their slopes and dt a."""
        base, offset = base_node(self.rows, s, p, self.node_count)
        here = ti.Vector([0.0, 0.0, 0.0, 0.0])
        gain = ti.Vector([0.0, 0.0])
        slope_x = here
        slope_y = here
        for i, j in ti.static(ti.ndrange(3, 3)):
            w = self.rows[i][s, p][j]
            node = base + i * self.width + j
            share = w * self.moved[s, node]
            gain += w * self.gain[s, node]
            here += share
            slope_x = stepped(slope_x, share, i - 1)
            slope_y = stepped(slope_y, share, j - 1)
        self.slope_x[s, p] = self.gradient * (slope_x - offset[0] * here)
        self.slope_y[s, p] = self.gradient * (slope_y - offset[1] * here)
        self.here[s, p] = here
        self.push[s, p] = ti.Vector([gain[0], gain[1], 0.0, 0.0])

    @ti.func
    def update(self, s: ti.i32, p: ti.i32) -> None:
        """Relax v_p and J_p towards the grid, move and shift x_p."""
        here = self.here[s, p]
        slope_x = self.slope_x[s, p]
        slope_y = self.slope_y[s, p]
        volume = 1.0 / largest(here[2], 0.5)
        density_slope = ti.Vector([slope_x[2], slope_y[2]])
        shift = self.shift * volume * density_slope
        shift = bounded(shift, -self.shift_bound, self.shift_bound)

        grid_v = ti.Vector([here[0], here[1]])
        v = ti.Vector([self.carried[s, p][0], self.carried[s, p][1]])
        v = v + ti.Vector([self.push[s, p][0], self.push[s, p][1]])
        v = v + self.parameters.velocity_relaxation * (grid_v - v)
        along_x = shift[0] * ti.Vector([slope_x[0], slope_x[1]])
        along_y = shift[1] * ti.Vector([slope_y[0], slope_y[1]])
        v = v + (along_x + along_y)

        x = ti.Vector([self.x[s, p][0], self.x[s, p][1]])
        x = bounded(x + (self.dt * grid_v + shift), self.least, self.most)
        self.x[s, p] = ti.Vector([x[0], x[1], 0.0, 0.0])

        jacobian = self.carried[s, p][3]
        jacobian = (
            jacobian
            + self.dt * (slope_x[0] + slope_y[1]) * jacobian
            + self.parameters.jacobian_relaxation * (here[3] - jacobian)
            + self.parameters.density_coupling * (volume - here[3])
        )
        self.carried[s, p] = ti.Vector([v[0], v[1], 1.0, jacobian])
        reached = ti.Vector([ti.abs(v[0]), ti.abs(v[1]), jacobian, -jacobian])
        self.extremes[s, p] = largest(reached, self.extremes[s, p])

    @ti.func
    def sum_velocity(self, s: ti.i32, n: ti.i32) -> None:
        """Add a node's velocity to its sum over time, outside the path of the bits."""
        v = ti.Vector([self.moved[s, n][0], self.moved[s, n][1]])
        self.total[s, n] = self.total[s, n] + ti.cast(v, ti.f64)

    # The drivers: the same phases in the same order.

    def run_serially(self, substeps: int) -> None:
        """Advance scenario 0 by many substeps in one thread."""
        self._serial_substeps(substeps, int(self.averaging))

    def run_in_parallel(self) -> None:
        """Advance every scenario by one substep: one launch per phase."""
        self._parallel_substep()
        if self.averaging:
            self._add_to_total()

    @ti.kernel
    def _serial_substeps(self, substeps: ti.i32, average: ti.i32) -> Nothing:
        ti.loop_config(serialize=True)
        for _ in range(substeps):
            # Read first, so that the address of the fields stays out of the loops: else
            # no vectors.
            fill = self.fill[0]
            for i in range(self.walls.ghost[0], self.walls.ghost[1] + 1):
                for j in range(self.walls.ghost[0], self.walls.ghost[1] + 1):
                    self.clear(0, i, j)
            for p in range(self.parameters.particles):
                self.locate(0, p)
            for p in range(self.parameters.particles):
                self.p2g(0, p)
            for i in range(self.walls.edge[0], self.walls.edge[1] + 1):
                for j in range(self.walls.edge[0], self.walls.edge[1] + 1):
                    self.fold(0, i, j, fill)
            for k in range(self.walls.ring_size):
                self.mirror(self.node, 0, k)
            for i in range(self.walls.edge[0], self.walls.edge[1] + 1):
                for j in range(self.walls.edge[0], self.walls.edge[1] + 1):
                    self.force(0, i, j)
            for k in range(self.walls.ring_size):
                self.mirror(self.moved, 0, k)
                self.mirror_gain(0, k)
            if average:
                for n in range(self.node_count):
                    self.sum_velocity(0, n)
            for p in range(self.parameters.particles):
                self.g2p(0, p)
            for p in range(self.parameters.particles):
                self.update(0, p)

    @ti.kernel
    def _parallel_substep(self) -> Nothing:
        all_nodes = ti.static((self.walls.ghost[0], self.walls.ghost[1] + 1))
        interior = ti.static((self.walls.edge[0], self.walls.edge[1] + 1))
        ti.loop_config(parallelize=self.threads)
        for s, i, j in ti.ndrange(self.scenarios, all_nodes, all_nodes):
            self.clear(s, i, j)
        ti.loop_config(parallelize=self.threads)
        for s, p in ti.ndrange(self.scenarios, self.parameters.particles):
            self.locate(s, p)
            self.p2g(s, p)
        ti.loop_config(parallelize=self.threads)
        for s, i, j in ti.ndrange(self.scenarios, interior, interior):
            self.fold(s, i, j, self.fill[s])
        ti.loop_config(parallelize=self.threads)
        for s, k in ti.ndrange(self.scenarios, self.walls.ring_size):
            self.mirror(self.node, s, k)
        ti.loop_config(parallelize=self.threads)
        for s, i, j in ti.ndrange(self.scenarios, interior, interior):
            self.force(s, i, j)
        ti.loop_config(parallelize=self.threads)
        for s, k in ti.ndrange(self.scenarios, self.walls.ring_size):
            self.mirror(self.moved, s, k)
            self.mirror_gain(s, k)
        ti.loop_config(parallelize=self.threads)
        for s, p in ti.ndrange(self.scenarios, self.parameters.particles):
            self.g2p(s, p)
            self.update(s, p)

    def restart_extremes(self) -> None:
        """Start an advance: the extremes are those of the present state."""
        self._restart_extremes(self.parameters.particles, self.node_count)

    @ti.kernel
    def _restart_extremes(self, particles: ti.i32, nodes: ti.i32) -> Nothing:
        # Counts are arguments: with some constants, such as 4,000, LLVM compiles for
        # twenty seconds.
        ti.loop_config(serialize=ti.static(not self.atomic))
        for s, p in ti.ndrange(self.scenarios, particles):
            now = self.carried[s, p]
            speed_x = ti.abs(now[0])
            speed_y = ti.abs(now[1])
            self.extremes[s, p] = ti.Vector([speed_x, speed_y, now[3], -now[3]])
        ti.loop_config(serialize=ti.static(not self.atomic))
        for s, n in ti.ndrange(self.scenarios, nodes):
            self.peak[s, n] = 0.0

    @ti.kernel
    def _add_to_total(self) -> Nothing:
        for s, n in self.moved:
            self.sum_velocity(s, n)
