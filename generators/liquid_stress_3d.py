"""One substep of MLS-MPM in three dimensions: a liquid with a free surface.

The equations are those of the liquid in :mod:`.particle_stress`, in a cube. For
particles of equal mass m, positions x_p, grid spacing dx, weights w_ip and
o = (x_i - x_p) / dx:

1. P2G:  n_i = sum w,   (n v)_i = sum w (v_p + A_p o),   (n J)_i = sum w J_p,
   with A = dx C - (4 dt / (rho dx)) tau,
   tau = K (J - 1) I + rho nu (C + C^T).
2. Grid: v_i = (n v)_i / n_i + dt g; the walls take the outward normal velocity.
   Jbar = (n J)/n. Relative density r_i = n_i m / (rho dx^3), where n_i counts mirror
   images at the walls.
3. G2P:  v_p = sum w v_i,   C_p = (4/dx) sum w v_i o^T,
   x_p <- x_p + dt v_p, kept in the box.
   J <- J (1 + dt tr C) + kappa (Jbar - J), then
   J <- J + theta (1/max(r, 1) - J), within [J_min, J_max].

The second axis points up. Only ``+ - * /`` and comparisons are used, and sums are
integers (:mod:`.transfer`): no order of particles or threads changes a bit.

Source: Hu et al. 2018; Jiang et al. 2015 (APIC).
"""

import taichi as ti

from . import backend
from .constitutive import larger
from .split import FreeSurfaceParameters
from .transfer import (
    Nothing,
    accumulate,
    bounded,
    fixed_point_scale,
    from_fixed,
    stepped,
    to_fixed,
)

_INSET = 1e-3  # distance that particles keep from a wall [cells]
# bound of abs(v_p + A o) over dx/dt, the largest speed [1], twice that of the plane
_REACH = 128.0
_HUGE = 3e38  # stands for what is not a number where extremes are kept
_AXES = (0, 1, 2)


@ti.data_oriented
class LiquidStress3D:
    """Fields of a batch of scenarios and the kernels that advance them."""

    def __init__(
        self,
        parameters: FreeSurfaceParameters,
        *,
        scenarios: int,
        atomic: bool,
        threads: int,
    ) -> None:
        """Round the constants and take the memory."""
        p = parameters
        self.parameters = parameters  # constants that the scenarios share
        self.scenarios = scenarios  # scenarios advanced together
        self.atomic = atomic  # whether several threads run the phases
        self.threads = threads  # threads of the parallel loops on a CPU
        self.inv_dx = float(p.grid)
        self.dx = 1.0 / p.grid
        self.dt = p.dt
        self.width = p.grid + 1  # nodes along an axis
        self.stride = (self.width**2, self.width, 1)  # of a node's number, by axis
        self.low = p.wall
        self.high = p.grid - p.wall
        # smallest and largest coordinate of a particle
        self.least = (self.low + _INSET) * self.dx
        self.most = (self.high - _INSET) * self.dx
        self.speed_bound = self.dx / p.dt  # the CFL bound dx/dt [length/s]
        # of abs(v) + abs(A o), what sums have room for
        self.reach_bound = _REACH * self.speed_bound
        self.velocity_scale = fixed_point_scale(p.particles, self.reach_bound)
        self.count_scale = fixed_point_scale(p.particles, max(1.0, p.jacobian_max))
        self.velocity_unit = 1.0 / self.velocity_scale
        self.count_unit = 1.0 / self.count_scale
        self.impulse = 4.0 * p.dt * p.grid / p.density
        self.fall = p.gravity * p.dt
        self.viscosity = p.density * p.liquid_viscosity
        self._declare_fields()
        self._place_fields()

    def _declare_fields(self) -> None:
        """Name the fields; they have no memory yet."""
        self.x = ti.Vector.field(4, ti.f32)  # particle positions [length], and a zero
        self.carried = ti.Vector.field(4, ti.f32)  # what P2G spreads: v_p, J_p
        self.at_rest = (0.0, 0.0, 0.0, 1.0)  # of a particle at rest
        # derivative of the nodal v at the particles, along each axis: columns of C
        self.slopes = [ti.Vector.field(4, ti.f32) for _ in _AXES]
        # columns of A, scaled
        self.pull = [ti.Vector.field(4, ti.f32) for _ in _AXES]
        # the three weights of a particle along each axis
        self.weights = [ti.Vector.field(4, ti.f32) for _ in _AXES]
        # offset from the middle node [cells], and the bits of the lowest node's number
        self.spot = ti.Vector.field(4, ti.f32)
        # largest velocity component, smallest and largest J, largest abs(v) + abs(A o)
        # since the advance began
        self.extremes = ti.Vector.field(4, ti.f32)
        # smallest and largest J since the start
        self.ratio_range = ti.Vector.field(2, ti.f32)
        self.sums = ti.Vector.field(4, ti.i64)  # n v, n J
        self.count = ti.field(ti.i64)  # n
        self.node = ti.Vector.field(4, ti.f32)  # v, Jbar
        self.density = ti.field(ti.f32)  # r
        self.fill = ti.field(ti.f32)  # m / (rho dx^3), shape [scenario]

    def _place_fields(self) -> None:
        """Give the fields their memory, each an array of its own."""
        particle_fields = (
            self.x,
            self.carried,
            *self.slopes,
            *self.pull,
            *self.weights,
            self.spot,
            self.extremes,
            self.ratio_range,
        )
        particle_shape = (self.scenarios, self.parameters.particles)
        node_shape = (self.scenarios, self.width**3)
        backend.place(
            *((particle_shape, [field]) for field in particle_fields),
            (node_shape, [self.sums]),
            (node_shape, [self.count]),
            (node_shape, [self.node]),
            (node_shape, [self.density]),
            ((self.scenarios,), [self.fill]),
        )

    # The phases: each function is one phase at one particle or node.

    @ti.func
    def at(self, i: ti.i32, j: ti.i32, k: ti.i32) -> ti.i32:
        """Return the number of a node."""
        return (i * self.width + j) * self.width + k

    @ti.func
    def clear(self, s: ti.i32, n: ti.i32) -> None:
        """Set the sums of a node to zero, before P2G adds to them."""
        self.sums[s, n] = ti.Vector.zero(ti.i64, 4)
        self.count[s, n] = ti.i64(0)

    @ti.func
    def locate(self, s: ti.i32, p: ti.i32) -> None:
        """Keep for P2G and G2P which nodes a particle touches, and the weights."""
        number = 0
        offset = ti.Vector([0.0, 0.0, 0.0])
        for axis in ti.static(_AXES):
            scaled = self.x[s, p][axis] * self.inv_dx
            lowest = ti.cast(scaled - 0.5, ti.i32)
            f = scaled - ti.cast(lowest, ti.f32)
            to_low = 1.5 - f
            to_mid = f - 1.0
            to_high = f - 0.5
            low = 0.5 * (to_low * to_low)
            mid = 0.75 - to_mid * to_mid
            high = 0.5 * (to_high * to_high)
            self.weights[axis][s, p] = ti.Vector([low, mid, high, 0.0])
            offset[axis] = to_mid
            number += lowest * ti.static(self.stride[axis])
        bits = ti.bit_cast(number, ti.f32)
        self.spot[s, p] = ti.Vector([offset[0], offset[1], offset[2], bits])

    @ti.func
    def stress(self, s: ti.i32, p: ti.i32) -> None:
        """Compute A of a particle, and the largest that it spreads."""
        carried = self.carried[s, p]
        pressure = self.parameters.liquid_modulus * (carried[3] - 1.0)
        reach = ti.Vector([0.0, 0.0, 0.0])
        for column in ti.static(_AXES):
            slope = self.slopes[column][s, p]
            a = ti.Vector([0.0, 0.0, 0.0, 0.0])
            for row in ti.static(_AXES):
                shear = slope[row] + self.slopes[row][s, p][column]
                tau = self.viscosity * shear
                if ti.static(row == column):
                    tau = tau + pressure
                a[row] = self.dx * slope[row] - self.impulse * tau
                reach[row] = reach[row] + 1.5 * ti.abs(a[row])
            self.pull[column][s, p] = self.velocity_scale * a
        seen = self.extremes[s, p]
        most = seen[3]
        for row in ti.static(_AXES):
            most = larger(finite(ti.abs(carried[row]) + reach[row]), most)
        self.extremes[s, p] = ti.Vector([seen[0], seen[1], seen[2], most])

    @ti.func
    def p2g(self, s: ti.i32, p: ti.i32) -> None:
        """Spread n v, n and n J, from the middle node to its neighbours, dx away."""
        spot = self.spot[s, p]
        lowest = ti.bit_cast(spot[3], ti.i32)
        a_x = self.pull[0][s, p]
        a_y = self.pull[1][s, p]
        a_z = self.pull[2][s, p]
        scale = ti.Vector(
            [
                self.velocity_scale,
                self.velocity_scale,
                self.velocity_scale,
                self.count_scale,
            ]
        )
        middle = scale * self.carried[s, p]
        middle = middle - spot[0] * a_x - spot[1] * a_y - spot[2] * a_z
        weight_x = self.weights[0][s, p]
        weight_y = self.weights[1][s, p]
        weight_z = self.weights[2][s, p]
        for i, j in ti.static(ti.ndrange(3, 3)):
            share = weight_x[i] * weight_y[j]
            row_value = stepped(stepped(middle, a_x, i - 1), a_y, j - 1)
            row = lowest + (i * self.width + j) * self.width
            for k in ti.static(range(3)):
                weight = share * weight_z[k]
                value = stepped(row_value, a_z, k - 1)
                node = ti.Vector([s, row + k])
                accumulate(self.sums, node, weight * value, self.atomic)
                self.add_count(node, weight)

    @ti.func
    def add_count(self, node: ti.math.ivec2, weight: ti.f32) -> None:
        """Add a weight to n of a node."""
        scaled = to_fixed(self.count_scale * weight)
        if ti.static(self.atomic):
            ti.atomic_add(self.count[node], scaled)
        else:
            # Even in serial code `+=` is an atomic.
            self.count[node] = self.count[node] + scaled

    @ti.func
    def update(self, s: ti.i32, i: ti.i32, j: ti.i32, k: ti.i32, fill: ti.f32) -> None:
        """Divide by n, add gravity, meet the walls; an empty node is at rest."""
        number = self.at(i, j, k)
        state = ti.Vector([0.0, 0.0, 0.0, 1.0])
        density = 0.0
        if self.count[s, number] > 0:
            n = from_fixed(self.count[s, number], self.count_unit)
            total = self.sums[s, number]
            u = from_fixed(total[0], self.velocity_unit) / n
            v = from_fixed(total[1], self.velocity_unit) / n - self.fall
            w = from_fixed(total[2], self.velocity_unit) / n
            jacobian = from_fixed(total[3], self.count_unit) / n
            state = ti.Vector(
                [
                    self.contact(i, u),
                    self.contact(j, v),
                    self.contact(k, w),
                    jacobian,
                ]
            )
            count = self.mirrored_count(s, i, j, k)
            density = from_fixed(count, self.count_unit) * fill
        self.node[s, number] = state
        self.density[s, number] = density

    @ti.func
    def contact(self, index: ti.i32, velocity: ti.f32) -> ti.f32:
        """Return the velocity along an axis behind the contact with its walls."""
        moves_out = (index <= self.low and velocity < 0.0) or (
            index >= self.high and velocity > 0.0
        )
        return ti.select(moves_out, 0.0, velocity)

    @ti.func
    def image(self, index: ti.i32) -> ti.i32:
        """Return the mirror image of a node within a cell of a wall, else -1."""
        mirrored = -1
        if index <= self.low + 1:
            mirrored = 2 * self.low - index
        if index >= self.high - 1:
            mirrored = 2 * self.high - index
        return mirrored

    @ti.func
    def mirrored_count(self, s: ti.i32, i: ti.i32, j: ti.i32, k: ti.i32) -> ti.i64:
        """Return n of a node with its mirror images.

        Without them a wall node would hold half a cell and a corner an eighth.
        """
        images = ti.Vector([self.image(i), self.image(j), self.image(k)])
        count = ti.i64(0)
        for a, b, c in ti.static(ti.ndrange(2, 2, 2)):
            place_x = ti.select(a == 1, images[0], i)
            place_y = ti.select(b == 1, images[1], j)
            place_z = ti.select(c == 1, images[2], k)
            if place_x >= 0 and place_y >= 0 and place_z >= 0:
                count += self.count[s, self.at(place_x, place_y, place_z)]
        return count

    @ti.func
    def g2p(self, s: ti.i32, p: ti.i32) -> None:
        """Gather v, Jbar and r with the slopes of v; move the particle, update J."""
        spot = self.spot[s, p]
        lowest = ti.bit_cast(spot[3], ti.i32)
        weight_x = self.weights[0][s, p]
        weight_y = self.weights[1][s, p]
        weight_z = self.weights[2][s, p]
        here = ti.Vector([0.0, 0.0, 0.0, 0.0])
        slope_x = here
        slope_y = here
        slope_z = here
        density = 0.0
        for i, j in ti.static(ti.ndrange(3, 3)):
            share = weight_x[i] * weight_y[j]
            row = lowest + (i * self.width + j) * self.width
            for k in ti.static(range(3)):
                weight = share * weight_z[k]
                part = weight * self.node[s, row + k]
                here += part
                slope_x += ((i - 1.0) - spot[0]) * part
                slope_y += ((j - 1.0) - spot[1]) * part
                slope_z += ((k - 1.0) - spot[2]) * part
                density += weight * self.density[s, row + k]
        gradient = 4.0 * self.inv_dx
        self.slopes[0][s, p] = gradient * slope_x
        self.slopes[1][s, p] = gradient * slope_y
        self.slopes[2][s, p] = gradient * slope_z
        self.flow(s, p, here, density)

    @ti.func
    def flow(self, s: ti.i32, p: ti.i32, here: ti.math.vec4, density: ti.f32) -> None:
        """Move a particle with the grid, and update its J."""
        x = ti.Vector([0.0, 0.0, 0.0])
        speed = 0.0
        for axis in ti.static(_AXES):
            target = self.x[s, p][axis] + self.dt * here[axis]
            x[axis] = bounded(target, self.least, self.most)
            speed = larger(finite(ti.abs(here[axis])), speed)
        self.x[s, p] = ti.Vector([x[0], x[1], x[2], 0.0])

        old = self.carried[s, p][3]
        divergence = (
            self.slopes[0][s, p][0] + self.slopes[1][s, p][1] + self.slopes[2][s, p][2]
        )
        j = old + self.dt * divergence * old
        j += self.parameters.jacobian_relaxation * (here[3] - old)
        j += self.parameters.density_coupling * (1.0 / larger(density, 1.0) - j)
        j = bounded(j, self.parameters.jacobian_min, self.parameters.jacobian_max)
        self.carried[s, p] = ti.Vector([here[0], here[1], here[2], j])

        seen = self.extremes[s, p]
        self.extremes[s, p] = ti.Vector(
            [
                larger(speed, seen[0]),
                ti.select(j < seen[1], j, seen[1]),
                larger(j, seen[2]),
                seen[3],
            ]
        )
        range_seen = self.ratio_range[s, p]
        self.ratio_range[s, p] = ti.Vector(
            [ti.select(j < range_seen[0], j, range_seen[0]), larger(j, range_seen[1])]
        )

    # The drivers: the same phases in the same order.

    def run_serially(self, substeps: int) -> None:
        """Advance scenario 0 by many substeps in one thread."""
        self._serial_substeps(substeps, self.parameters.particles, self.width)

    def run_in_parallel(self) -> None:
        """Advance every scenario by one substep: one launch per phase."""
        self._parallel_substep(self.parameters.particles, self.width)

    @ti.kernel
    def _serial_substeps(
        self, substeps: ti.i32, particles: ti.i32, width: ti.i32
    ) -> Nothing:
        ti.loop_config(serialize=True)
        for _ in range(substeps):
            fill = self.fill[0]
            for n in range(width * width * width):
                self.clear(0, n)
            for p in range(particles):
                self.locate(0, p)
            for p in range(particles):
                self.stress(0, p)
            for p in range(particles):
                self.p2g(0, p)
            for i in range(width):
                for j in range(width):
                    for k in range(width):
                        self.update(0, i, j, k, fill)
            for p in range(particles):
                self.g2p(0, p)

    @ti.kernel
    def _parallel_substep(self, particles: ti.i32, width: ti.i32) -> Nothing:
        ti.loop_config(parallelize=self.threads)
        for s, n in ti.ndrange(self.scenarios, width * width * width):
            self.clear(s, n)
        ti.loop_config(parallelize=self.threads)
        for s, p in ti.ndrange(self.scenarios, particles):
            self.locate(s, p)
            self.stress(s, p)
            self.p2g(s, p)
        ti.loop_config(parallelize=self.threads)
        for s, i, j, k in ti.ndrange(self.scenarios, width, width, width):
            self.update(s, i, j, k, self.fill[s])
        ti.loop_config(parallelize=self.threads)
        for s, p in ti.ndrange(self.scenarios, particles):
            self.g2p(s, p)

    def restart_extremes(self) -> None:
        """Start an advance: the extremes are those of the present state."""
        self._restart_extremes(self.parameters.particles)

    @ti.kernel
    def _restart_extremes(self, particles: ti.i32) -> Nothing:
        ti.loop_config(serialize=ti.static(not self.atomic))
        for s, p in ti.ndrange(self.scenarios, particles):
            now = self.carried[s, p]
            speed = 0.0
            for axis in ti.static(_AXES):
                speed = larger(finite(ti.abs(now[axis])), speed)
            self.extremes[s, p] = ti.Vector([speed, now[3], now[3], 0.0])


@ti.func
def finite(value: ti.f32) -> ti.f32:
    """Return a positive value, or :data:`_HUGE` if it is not a finite number."""
    return ti.select(value < _HUGE, value, _HUGE)
