"""One substep of MLS-MPM with a free surface in three dimensions.

The equations are those of :mod:`.particle_stress`, in a cube; the relative density is
r_i = n_i m / (rho dx^3). The stresses of solids stand in :mod:`.constitutive_3d`. Where
a wall is rough, Coulomb friction brakes both tangential components alike. The second
axis points up.

Only ``+ - * /``, ``sqrt`` and comparisons are used, and sums are integers
(:mod:`.transfer`): no order of particles or threads changes a bit.

Source: Hu et al. 2018; Jiang et al. 2015 (APIC).
"""

import taichi as ti

from .constitutive import hardening, larger, liquid_stress
from .constitutive_3d import corotated_stress, determinant, plastic_return
from .free_surface_kernels import LIQUID, ROPE, SNOW, FreeSurfaceKernels, finite
from .transfer import (
    Nothing,
    Template,
    Value,
    add_shifted,
    bounded,
    from_fixed,
    node_number,
    row_count,
    spline_weights,
    stepped,
)

_AXES = (0, 1, 2)


@ti.data_oriented
class ParticleStress3D(FreeSurfaceKernels):
    """Fields of a batch of scenarios and the kernels that advance them."""

    dimension = 3
    reach = 128.0  # twice that of the plane
    at_rest = (0.0, 0.0, 0.0, 1.0)

    def _declare_fields(self) -> None:
        """Name the fields; they have no memory yet.

        P2G spreads v, and J of liquid or 1. Slopes are those of v and Jbar.
        """
        super()._declare_fields()
        self.stride = (self.width**2, self.width, 1)  # of a node's number, by axis
        # columns of the deformation gradients of the solids [1], and a zero
        self.f = [ti.Vector.field(4, ti.f32) for _ in _AXES]
        # columns of A, scaled
        self.pull = [ti.Vector.field(4, ti.f32) for _ in _AXES]
        # the three weights of a particle along each axis
        self.weights = [ti.Vector.field(4, ti.f32) for _ in _AXES]
        # offset from the middle node [cells], and the bits of the lowest node's number
        self.spot = ti.Vector.field(4, ti.f32)
        # v and Jbar of the nodes at the particles
        self.here = ti.Vector.field(4, ti.f32)
        self.density = ti.field(ti.f32)  # r of the nodes at the particles
        self.sums = ti.Vector.field(4, ti.i64)  # n v, n J
        self.rows = ti.Vector.field(4, ti.i64)  # n of three nodes in a row
        # v, Jbar, r and three zeros: one address for what G2P reads
        self.node = ti.Vector.field(8, ti.f32)

    def _particle_fields(self) -> tuple[ti.Field, ...]:
        single_fields = (self.spot, self.here, self.density)
        return *self.f, *self.pull, *self.weights, *single_fields

    def _node_fields(self) -> tuple[ti.Field, ...]:
        return self.sums, self.node

    def _row_fields(self) -> tuple[ti.Field, ...]:
        return (self.rows,)

    # The phases: each function is one phase at one particle or node.

    @ti.func
    def at(self, i: ti.i32, j: ti.i32, k: ti.i32) -> ti.i32:
        """Return the number of a node."""
        return (i * self.width + j) * self.width + k

    @ti.func
    def clear(self, s: ti.i32, n: ti.i32) -> None:
        """Set the sums of a node to zero, before P2G adds to them."""
        self.sums[s, n] = ti.Vector.zero(ti.i64, 4)

    @ti.func
    def clear_row(self, s: ti.i32, n: ti.i32) -> None:
        """Set the sums of the row that ends at a node to zero."""
        self.rows[s, n] = ti.Vector.zero(ti.i64, 4)

    @ti.func
    def locate(self, s: ti.i32, p: ti.i32) -> None:
        """Keep for P2G and G2P which nodes a particle touches, and the weights."""
        number = 0
        offset = ti.Vector([0.0, 0.0, 0.0])
        for axis in ti.static(_AXES):
            scaled = self.x[s, p][axis] * self.inv_dx
            lowest = ti.cast(scaled - 0.5, ti.i32)
            f = scaled - ti.cast(lowest, ti.f32)
            low, mid, high = spline_weights(f)
            self.weights[axis][s, p] = ti.Vector([low, mid, high, 0.0])
            offset[axis] = f - 1.0
            number += lowest * ti.static(self.stride[axis])
        bits = ti.bit_cast(number, ti.f32)
        self.spot[s, p] = ti.Vector([offset[0], offset[1], offset[2], bits])

    @ti.func
    def gradient(self, s: ti.i32, p: ti.i32) -> ti.math.mat3:
        """Return C of a particle."""
        slope_x = self.slopes[0][s, p]
        slope_y = self.slopes[1][s, p]
        slope_z = self.slopes[2][s, p]
        return columns(slope_x, slope_y, slope_z)

    @ti.func
    def deformation(self, s: ti.i32, p: ti.i32) -> ti.math.mat3:
        """Return F of a particle."""
        return columns(self.f[0][s, p], self.f[1][s, p], self.f[2][s, p])

    @ti.func
    def elastic_stress(self, s: ti.i32, p: ti.i32, pressure: ti.f32) -> ti.math.mat3:
        """Return the Kirchhoff stress without viscosity, of a liquid or a solid."""
        kind = self.matter[s, p][0]
        mu = self.jelly[0]
        la = self.jelly[1]
        if kind == ROPE:
            mu = self.rope[0]
            la = self.rope[1]
        if kind == SNOW:
            factor = hardening(
                self.matter[s, p][1],
                self.parameters.snow_hardening,
                self.parameters.snow_hardening_min,
                self.parameters.snow_hardening_max,
            )
            mu = self.snow[0] * factor
            la = self.snow[1] * factor
        isotropic = ti.Matrix(
            [[pressure, 0.0, 0.0], [0.0, pressure, 0.0], [0.0, 0.0, pressure]]
        )
        elastic = corotated_stress(self.deformation(s, p), mu, la)
        return ti.select(kind == LIQUID, isotropic, elastic)

    @ti.func
    def viscosity(self, s: ti.i32, p: ti.i32) -> ti.f32:
        """Return the dynamic viscosity of a liquid, or the damping of a solid."""
        kind = self.matter[s, p][0]
        damping = ti.select(kind == SNOW, 0.0, self.solid_viscosity)
        return ti.select(kind == LIQUID, self.liquid_viscosity, damping)

    @ti.func
    def stress(self, s: ti.i32, p: ti.i32, solid: Template) -> None:
        """Compute A of a particle, and the largest that it spreads."""
        carried = self.carried[s, p]
        pressure = liquid_stress(carried[3], self.parameters.liquid_modulus)
        c = self.gradient(s, p)
        viscosity = self.liquid_viscosity
        elastic = ti.Matrix.zero(ti.f32, 3, 3)
        if ti.static(solid):
            viscosity = self.viscosity(s, p)
            elastic = self.elastic_stress(s, p, pressure)
        reach = ti.Vector([0.0, 0.0, 0.0])
        for column in ti.static(_AXES):
            a = ti.Vector([0.0, 0.0, 0.0, 0.0])
            for row in ti.static(_AXES):
                tau = viscosity * (c[row, column] + c[column, row])
                if ti.static(solid):
                    tau = tau + elastic[row, column]
                elif ti.static(row == column):
                    tau = tau + pressure
                a[row] = self.dx * c[row, column] - self.impulse * tau
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
        lowest = node_number(spot[3], self.node_count)
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
            weights = share * weight_z
            for k in ti.static(range(3)):
                value = weights[k] * stepped(row_value, a_z, k - 1)
                add_shifted(self.sums, ti.Vector([s, row + k]), value, self.atomic)
            # The fourth weight is 0, so that the fourth sum counts shifts.
            counts = self.count_scale * weights
            add_shifted(self.rows, ti.Vector([s, row + 2]), counts, self.atomic)

    @ti.func
    def update(
        self,
        s: ti.i32,
        i: ti.i32,
        j: ti.i32,
        k: ti.i32,
        fill: ti.f32,
        friction: ti.f32,
    ) -> None:
        """Divide by n, add gravity, meet the walls; an empty node is at rest."""
        number = self.at(i, j, k)
        state = ti.Vector([0.0, 0.0, 0.0, 1.0])
        density = 0.0
        count, shifts = row_count(self.rows, s, number)
        if count > 0:
            n = from_fixed(count, self.count_unit)
            total = self.sums[s, number] - shifts
            u = from_fixed(total[0], self.velocity_unit) / n
            v = from_fixed(total[1], self.velocity_unit) / n - self.fall
            w = from_fixed(total[2], self.velocity_unit) / n
            jacobian = from_fixed(total[3], self.count_unit) / n
            u, v, w = self.contact(i, u, v, w, friction)
            v, w, u = self.contact(j, v, w, u, friction)
            w, u, v = self.contact(k, w, u, v, friction)
            state = ti.Vector([u, v, w, jacobian])
            mirrored = self.mirrored_count(s, i, j, k)
            density = from_fixed(mirrored, self.count_unit) * fill
        self.node[s, number] = ti.Vector(
            [state[0], state[1], state[2], state[3], density, 0.0, 0.0, 0.0]
        )

    @ti.func
    def contact(
        self,
        index: ti.i32,
        normal: ti.f32,
        first: ti.f32,
        second: ti.f32,
        friction: ti.f32,
    ) -> Value:
        """Return the velocity behind the contact with a wall, in the same order.

        ``index`` counts nodes along the normal of the two walls across an axis;
        ``first`` and ``second`` are the tangential components.
        """
        new_normal = normal
        new_first = first
        new_second = second
        if self.is_outward(index, normal):
            sliding = ti.sqrt(first * first + second * second)
            loss = friction * ti.abs(normal) / larger(sliding, 1e-9)
            kept = larger(1.0 - loss, 0.0)
            new_normal = 0.0
            new_first = first * kept
            new_second = second * kept
        return new_normal, new_first, new_second

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
                number = self.at(place_x, place_y, place_z)
                count += row_count(self.rows, s, number)[0]
        return count

    @ti.func
    def g2p(self, s: ti.i32, p: ti.i32) -> None:
        """Gather v, Jbar and r with the slopes of v."""
        spot = self.spot[s, p]
        lowest = node_number(spot[3], self.node_count)
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
                node = self.node[s, row + k]
                part = weight * node[:4]
                here += part
                slope_x += ((i - 1.0) - spot[0]) * part
                slope_y += ((j - 1.0) - spot[1]) * part
                slope_z += ((k - 1.0) - spot[2]) * part
                density += weight * node[4]
        gradient = 4.0 * self.inv_dx
        self.slopes[0][s, p] = gradient * slope_x
        self.slopes[1][s, p] = gradient * slope_y
        self.slopes[2][s, p] = gradient * slope_z
        self.here[s, p] = here
        self.density[s, p] = density

    @ti.func
    def flow(self, s: ti.i32, p: ti.i32, solid: Template) -> None:
        """Move a particle with the grid, and update J of a liquid."""
        here = self.here[s, p]
        x = ti.Vector([0.0, 0.0, 0.0])
        speed = 0.0
        for axis in ti.static(_AXES):
            target = self.x[s, p][axis] + self.dt * here[axis]
            x[axis] = bounded(target, self.least, self.most)
            speed = larger(finite(ti.abs(here[axis])), speed)
        self.x[s, p] = ti.Vector([x[0], x[1], x[2], 0.0])

        matter = self.matter[s, p]
        old = matter[1]
        divergence = (
            self.slopes[0][s, p][0] + self.slopes[1][s, p][1] + self.slopes[2][s, p][2]
        )
        j = old + self.dt * divergence * old
        j += self.parameters.jacobian_relaxation * (here[3] - old)
        volume = 1.0 / larger(self.density[s, p], 1.0)
        j += self.parameters.density_coupling * (volume - j)
        j = bounded(j, self.parameters.jacobian_min, self.parameters.jacobian_max)
        ratio = j
        spread = j
        if ti.static(solid):
            ratio = ti.select(matter[0] == LIQUID, j, old)
            spread = ti.select(matter[0] == LIQUID, j, 1.0)
        self.carried[s, p] = ti.Vector([here[0], here[1], here[2], spread])
        self.keep_ratio(s, p, ratio)

        seen = self.extremes[s, p]
        self.extremes[s, p] = ti.Vector(
            [larger(speed, seen[0]), seen[1], seen[2], seen[3]]
        )
        if ti.static(not solid):
            self.keep_jacobian(s, p)

    @ti.func
    def keep_ratio(self, s: ti.i32, p: ti.i32, ratio: ti.f32) -> None:
        """Keep J of a liquid or Jp of snow, and the extremes since the start."""
        matter = self.matter[s, p]
        least = ti.select(ratio < matter[2], ratio, matter[2])
        self.matter[s, p] = ti.Vector(
            [matter[0], ratio, least, larger(ratio, matter[3])]
        )

    @ti.func
    def jacobian(self, s: ti.i32, p: ti.i32) -> ti.f32:
        """Return J of a liquid or det F of a solid."""
        matter = self.matter[s, p]
        in_solid = determinant(self.deformation(s, p))
        return ti.select(matter[0] == LIQUID, matter[1], in_solid)

    @ti.func
    def keep_jacobian(self, s: ti.i32, p: ti.i32) -> None:
        """Keep the extremes of J of a liquid or det F of a solid in this advance."""
        jacobian = self.jacobian(s, p)
        seen = self.extremes[s, p]
        least = ti.select(jacobian < seen[1], jacobian, seen[1])
        self.extremes[s, p] = ti.Vector(
            [seen[0], least, larger(jacobian, seen[2]), seen[3]]
        )

    @ti.func
    def deform(self, s: ti.i32, p: ti.i32) -> None:
        """Update F of a solid with the velocity gradient: F <- (I + dt C) F."""
        is_liquid = self.matter[s, p][0] == LIQUID
        f = self.deformation(s, p)
        f = ti.select(is_liquid, f, f + self.dt * (self.gradient(s, p) @ f))
        self.keep_deformation(s, p, f)

    @ti.func
    def apply_snow_plasticity(self, s: ti.i32, p: ti.i32) -> None:
        """Bring F of a snow particle back to its yield limits; others stay as they are.

        F from :meth:`deform` is the trial gradient. What it loses goes into Jp.
        """
        if self.matter[s, p][0] == SNOW:
            trial = self.deformation(s, p)
            f, growth = plastic_return(trial, self.yield_low, self.yield_high)
            jp_min = self.parameters.snow_jp_min
            jp_max = self.parameters.snow_jp_max
            jp = bounded(self.matter[s, p][1] * growth, jp_min, jp_max)
            self.keep_deformation(s, p, f)
            self.keep_ratio(s, p, jp)

    @ti.func
    def keep_deformation(self, s: ti.i32, p: ti.i32, f: ti.math.mat3) -> None:
        """Store F, column by column."""
        for column in ti.static(_AXES):
            self.f[column][s, p] = ti.Vector(
                [f[0, column], f[1, column], f[2, column], 0.0]
            )

    # The drivers: the same phases in the same order.

    def run_serially(self, substeps: int) -> None:
        """Advance scenario 0 by many substeps in one thread, on the nodes that
        particles touch.
        """
        self._serial_substeps(substeps, self.parameters.particles, self.solid)

    def run_in_parallel(self) -> None:
        """Advance every scenario by one substep: one launch per phase."""
        self._parallel_substep(self.parameters.particles, self.width, self.solid)

    @ti.kernel
    def _serial_substeps(
        self, substeps: ti.i32, particles: ti.i32, solid: Template
    ) -> Nothing:
        ti.loop_config(serialize=True)
        for _ in range(substeps):
            fill = self.fill[0]
            friction = self.friction[0]
            first, last = self.touched_nodes(particles)
            for i in range(first[0], last[0]):
                for j in range(first[1], last[1]):
                    for k in range(first[2], last[2]):
                        self.clear(0, self.at(i, j, k))
                    # The nodes at the end lie in rows that end two nodes behind.
                    for k in range(first[2], last[2] + 2):
                        self.clear_row(0, self.at(i, j, k))
            for p in range(particles):
                self.locate(0, p)
            for p in range(particles):
                self.stress(0, p, solid)
            for p in range(particles):
                self.p2g(0, p)
            for i in range(first[0], last[0]):
                for j in range(first[1], last[1]):
                    for k in range(first[2], last[2]):
                        self.update(0, i, j, k, fill, friction)
            for p in range(particles):
                self.g2p(0, p)
            for p in range(particles):
                self.flow(0, p, solid)
            if ti.static(solid):
                for p in range(particles):
                    self.deform(0, p)
                for p in range(particles):
                    self.apply_snow_plasticity(0, p)
                for p in range(particles):
                    self.keep_jacobian(0, p)

    @ti.kernel
    def _parallel_substep(
        self, particles: ti.i32, width: ti.i32, solid: Template
    ) -> Nothing:
        ti.loop_config(parallelize=self.threads)
        for s, n in ti.ndrange(self.scenarios, width * width * width):
            self.clear(s, n)
            self.clear_row(s, n)
        ti.loop_config(parallelize=self.threads)
        for s, p in ti.ndrange(self.scenarios, particles):
            self.locate(s, p)
            self.stress(s, p, solid)
            self.p2g(s, p)
        ti.loop_config(parallelize=self.threads)
        for s, i, j, k in ti.ndrange(self.scenarios, width, width, width):
            self.update(s, i, j, k, self.fill[s], self.friction[s])
        ti.loop_config(parallelize=self.threads)
        for s, p in ti.ndrange(self.scenarios, particles):
            self.g2p(s, p)
            self.flow(s, p, solid)
            if ti.static(solid):
                self.deform(s, p)
                self.apply_snow_plasticity(s, p)
                self.keep_jacobian(s, p)

    def restart_extremes(self) -> None:
        """Start an advance: the extremes are those of the present state."""
        self._restart_extremes(self.parameters.particles)

    @ti.kernel
    def _restart_extremes(self, particles: ti.i32) -> Nothing:
        ti.loop_config(serialize=ti.static(not self.atomic))
        for s, p in ti.ndrange(self.scenarios, particles):
            now = self.carried[s, p]
            jacobian = self.jacobian(s, p)
            speed = 0.0
            for axis in ti.static(_AXES):
                speed = larger(finite(ti.abs(now[axis])), speed)
            self.extremes[s, p] = ti.Vector([speed, jacobian, jacobian, 0.0])


@ti.func
def columns(
    first: ti.math.vec4, second: ti.math.vec4, third: ti.math.vec4
) -> ti.math.mat3:
    """Return the matrix with these columns, of which the fourth entry is left out."""
    return ti.Matrix(
        [
            [first[0], second[0], third[0]],
            [first[1], second[1], third[1]],
            [first[2], second[2], third[2]],
        ]
    )
