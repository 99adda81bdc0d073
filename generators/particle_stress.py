"""One substep of MLS-MPM with a free surface: liquid, jelly, snow and rope.

For particles of equal mass m, positions x_p, grid spacing dx, weights w_ip and
o = (x_i - x_p) / dx:

1. P2G:  n_i = sum w,   (n v)_i = sum w (v_p + A_p o),   (n J)_i = sum w J_p,
   with A = dx C - (4 dt / (rho dx)) tau, and J = 1 in solids.
2. Grid: v_i = (n v)_i / n_i + dt g; the walls take the outward normal velocity and, by
   Coulomb friction, at most ``friction`` times as much tangential velocity. Jbar = (n
   J)/n. Relative density r_i = n_i m / (rho dx^2), where n_i counts mirror images at
   the walls.
3. G2P:  v_p = sum w v_i,   C_p = (4/dx) sum w v_i o^T,
   x_p <- x_p + dt v_p, kept in the box.
   Liquid: J <- J (1 + dt tr C) + kappa (Jbar - J), then
   J <- J + theta (1/max(r, 1) - J), within [J_min, J_max].
   Solids: F <- (I + dt C) F; snow then yields.

The mass of a particle cancels everywhere but in r, so nodes count particles. Sums are
integers (:mod:`.transfer`): no order of particles or threads changes a bit. The
stresses stand in :mod:`.constitutive`.

Source: Hu et al. 2018; Jiang et al. 2015 (APIC). The tie of J to the density is ours:
without it a settled liquid loses a fifth of its depth.
"""

import taichi as ti

from .constitutive import (
    corotated_stress,
    hardening,
    larger,
    liquid_stress,
    plastic_return,
    viscous_stress,
)
from .free_surface_kernels import LIQUID, ROPE, SNOW, FreeSurfaceKernels, largest_of
from .transfer import (
    Nothing,
    Template,
    Value,
    accumulate,
    base_node,
    bounded,
    from_fixed,
    stencil,
    stepped,
)


@ti.data_oriented
class ParticleStress(FreeSurfaceKernels):
    """Fields of a batch of scenarios and the kernels that advance them."""

    dimension = 2
    reach = 64.0  # a violent impact reaches 2
    at_rest = (0.0, 0.0, 1.0, 1.0)

    def _declare_fields(self) -> None:
        """Name the fields; they have no memory yet.

        P2G spreads v_x, v_y, 1, and J of liquid or 1. Slopes are those of v_x, v_y, r
        and Jbar.
        """
        super()._declare_fields()
        self.slope_x, self.slope_y = self.slopes
        # deformation gradients of the solids [1]
        self.f = ti.Matrix.field(2, 2, ti.f32)
        self.rows = [ti.Vector.field(4, ti.f32) for _ in range(3)]  # of the stencil
        # first column of A, scaled, and two zeros
        self.a_x = ti.Vector.field(4, ti.f32)
        self.a_y = ti.Vector.field(4, ti.f32)  # second column
        self.here = ti.Vector.field(4, ti.f32)  # v_x, v_y, r, Jbar at the particle
        self.sums = ti.Vector.field(4, ti.i64)  # n v_x, n v_y, n, n J
        self.node = ti.Vector.field(4, ti.f32)  # v_x, v_y, r, Jbar

    def _particle_fields(self) -> tuple[ti.Field, ...]:
        return self.f, *self.rows, self.a_x, self.a_y, self.here

    def _node_fields(self) -> tuple[ti.Field, ...]:
        return self.sums, self.node

    # The phases: each function is one phase at one particle or node.

    @ti.func
    def stress(
        self, s: ti.i32, p: ti.i32, c: ti.math.mat2, solid: Template
    ) -> ti.math.mat2:
        """Return the Kirchhoff stress tau of a particle."""
        kind = self.matter[s, p][0]
        ratio = self.matter[s, p][1]
        pull = liquid_stress(ratio, self.parameters.liquid_modulus)
        tau = ti.Matrix([[pull, 0.0], [0.0, pull]])
        viscosity = self.liquid_viscosity
        if ti.static(solid):
            mu = self.jelly[0]
            la = self.jelly[1]
            damping = self.solid_viscosity
            if kind == ROPE:
                mu = self.rope[0]
                la = self.rope[1]
            if kind == SNOW:
                factor = hardening(
                    ratio,
                    self.parameters.snow_hardening,
                    self.parameters.snow_hardening_min,
                    self.parameters.snow_hardening_max,
                )
                mu = self.snow[0] * factor
                la = self.snow[1] * factor
                damping = 0.0
            elastic = corotated_stress(self.f[s, p], mu, la)
            tau = ti.select(kind == LIQUID, tau, elastic)
            viscosity = ti.select(kind == LIQUID, viscosity, damping)
        return tau + viscous_stress(c, viscosity)

    @ti.func
    def gradient(self, s: ti.i32, p: ti.i32) -> ti.math.mat2:
        """Return C of a particle."""
        slope_x = self.slope_x[s, p]
        slope_y = self.slope_y[s, p]
        return ti.Matrix([[slope_x[0], slope_y[0]], [slope_x[1], slope_y[1]]])

    @ti.func
    def prepare(self, s: ti.i32, p: ti.i32, solid: Template) -> None:
        """Compute the stencil of a particle, and the slope A of what it carries."""
        first, second, third = stencil(self.x[s, p], self.inv_dx, self.width)
        self.rows[0][s, p] = first
        self.rows[1][s, p] = second
        self.rows[2][s, p] = third
        c = self.gradient(s, p)
        tau = self.stress(s, p, c, solid)
        a = self.dx * c - self.impulse * tau

        v = self.carried[s, p]
        seen = self.extremes[s, p]
        slope_x = ti.abs(a[0, 0]) + ti.abs(a[0, 1])
        slope_y = ti.abs(a[1, 0]) + ti.abs(a[1, 1])
        reach_x = ti.abs(v[0]) + 1.5 * slope_x
        reach_y = ti.abs(v[1]) + 1.5 * slope_y
        reach = larger(largest_of(reach_x, reach_y), seen[3])
        self.extremes[s, p] = ti.Vector([seen[0], seen[1], seen[2], reach])
        scaled = self.velocity_scale * a
        self.a_x[s, p] = ti.Vector([scaled[0, 0], scaled[1, 0], 0.0, 0.0])
        self.a_y[s, p] = ti.Vector([scaled[0, 1], scaled[1, 1], 0.0, 0.0])

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
        a_x = self.a_x[s, p]
        a_y = self.a_y[s, p]
        middle = scale * self.carried[s, p] - offset[0] * a_x - offset[1] * a_y
        for i, j in ti.static(ti.ndrange(3, 3)):
            column = stepped(middle, a_x, i - 1)
            value = stepped(column, a_y, j - 1)
            node = ti.Vector([s, base + i * self.width + j])
            weight = self.rows[i][s, p][j]
            accumulate(self.sums, node, weight * value, self.atomic)

    @ti.func
    def at(self, i: ti.i32, j: ti.i32) -> ti.i32:
        """Return the index of a node."""
        return i * self.width + j

    @ti.func
    def clear(self, s: ti.i32, i: ti.i32, j: ti.i32) -> None:
        """Set the sums of a node of scenario s to zero, before P2G adds to them."""
        self.sums[s, self.at(i, j)] = ti.Vector.zero(ti.i64, 4)

    @ti.func
    def update(
        self, s: ti.i32, i: ti.i32, j: ti.i32, fill: ti.f32, friction: ti.f32
    ) -> None:
        """Divide by n, add gravity, meet the walls; an empty node is at rest."""
        total = self.sums[s, self.at(i, j)]
        u = 0.0
        v = 0.0
        jacobian = 1.0
        if total[2] > 0:
            n = from_fixed(total[2], self.count_unit)
            u = from_fixed(total[0], self.velocity_unit) / n
            v = from_fixed(total[1], self.velocity_unit) / n - self.fall
            jacobian = from_fixed(total[3], self.count_unit) / n
            u, v = self.contact(i, u, v, friction)
            v, u = self.contact(j, v, u, friction)
        count = self.mirrored_count(s, i, j)
        density = from_fixed(count, self.count_unit) * fill
        self.node[s, self.at(i, j)] = ti.Vector([u, v, density, jacobian])

    @ti.func
    def contact(
        self, index: ti.i32, normal: ti.f32, tangential: ti.f32, friction: ti.f32
    ) -> Value:
        """Return the normal and tangential velocity behind the contact with a wall.

        ``index`` counts nodes along the normal of the two walls across an axis.
        """
        new_normal = normal
        new_tangential = tangential
        if self.is_outward(index, normal):
            loss = friction * ti.abs(normal) / larger(ti.abs(tangential), 1e-9)
            new_normal = 0.0
            new_tangential = tangential * larger(1.0 - loss, 0.0)
        return new_normal, new_tangential

    @ti.func
    def mirrored_count(self, s: ti.i32, i: ti.i32, j: ti.i32) -> ti.i64:
        """Return n of a node with its mirror images.

        Without them a wall node would hold half a cell and a corner a quarter.
        """
        count = self.sums[s, self.at(i, j)][2]
        image_i = self.image(i)
        image_j = self.image(j)
        if image_i >= 0:
            count += self.sums[s, self.at(image_i, j)][2]
        if image_j >= 0:
            count += self.sums[s, self.at(i, image_j)][2]
            if image_i >= 0:
                count += self.sums[s, self.at(image_i, image_j)][2]
        return count

    @ti.func
    def g2p(self, s: ti.i32, p: ti.i32) -> None:
        """Gather (v, r, Jbar) and their slopes."""
        base, offset = base_node(self.rows, s, p, self.node_count)
        here = ti.Vector.zero(ti.f32, 4)
        slope_x = here
        slope_y = here
        for i, j in ti.static(ti.ndrange(3, 3)):
            part = self.rows[i][s, p][j] * self.node[s, base + i * self.width + j]
            here += part
            slope_x += ((i - 1.0) - offset[0]) * part
            slope_y += ((j - 1.0) - offset[1]) * part
        self.slope_x[s, p] = (4.0 * self.inv_dx) * slope_x
        self.slope_y[s, p] = (4.0 * self.inv_dx) * slope_y
        self.here[s, p] = here

    @ti.func
    def flow(self, s: ti.i32, p: ti.i32, solid: Template) -> None:
        """Move a particle; update J of a liquid or F of a solid."""
        here = self.here[s, p]
        kind = self.matter[s, p][0]
        old = self.matter[s, p][1]
        lowest = self.matter[s, p][2]
        highest = self.matter[s, p][3]
        position = ti.Vector([self.x[s, p][0], self.x[s, p][1]])
        velocity = ti.Vector([here[0], here[1]])
        x = bounded(position + self.dt * velocity, self.least, self.most)
        self.x[s, p] = ti.Vector([x[0], x[1], 0.0, 0.0])
        c = self.gradient(s, p)
        j = old + self.dt * (c[0, 0] + c[1, 1]) * old
        j += self.parameters.jacobian_relaxation * (here[3] - old)
        j += self.parameters.density_coupling * (1.0 / larger(here[2], 1.0) - j)
        j = bounded(j, self.parameters.jacobian_min, self.parameters.jacobian_max)
        ratio = j
        jacobian = j
        spread = j
        if ti.static(solid):
            resting = self.f[s, p]
            f = resting + self.dt * (c @ resting)
            yielded, growth = plastic_return(f, self.yield_low, self.yield_high)
            jp_min = self.parameters.snow_jp_min
            jp_max = self.parameters.snow_jp_max
            jp = bounded(old * growth, jp_min, jp_max)
            # Chosen, not branched upon: else no vectors.
            deformed = ti.select(kind == SNOW, yielded, f)
            f = ti.select(kind == LIQUID, resting, deformed)
            self.f[s, p] = f
            plastic = ti.select(kind == SNOW, jp, old)
            ratio = ti.select(kind == LIQUID, j, plastic)
            determinant = f[0, 0] * f[1, 1] - f[0, 1] * f[1, 0]
            jacobian = ti.select(kind == LIQUID, j, determinant)
            spread = ti.select(kind == LIQUID, j, 1.0)
        lowest = -larger(-ratio, -lowest)
        highest = larger(ratio, highest)
        self.matter[s, p] = ti.Vector([kind, ratio, lowest, highest])
        self.carried[s, p] = ti.Vector([here[0], here[1], 1.0, spread])
        seen = self.extremes[s, p]
        speed = largest_of(ti.abs(here[0]), ti.abs(here[1]))
        least = -larger(-jacobian, -seen[1])
        most = larger(jacobian, seen[2])
        self.extremes[s, p] = ti.Vector([larger(speed, seen[0]), least, most, seen[3]])

    # The drivers: the same phases in the same order.

    def run_serially(self, substeps: int) -> None:
        """Advance scenario 0 by many substeps in one thread, on the nodes that
        particles touch.
        """
        self._serial_substeps(substeps, self.solid)

    def run_in_parallel(self) -> None:
        """Advance every scenario by one substep: one launch per phase."""
        self._parallel_substep(self.solid)

    @ti.kernel
    def _serial_substeps(self, substeps: ti.i32, solid: Template) -> Nothing:
        ti.loop_config(serialize=True)
        for _ in range(substeps):
            # Read first, so that the address of the fields stays out of the loops: else
            # no vectors.
            fill = self.fill[0]
            friction = self.friction[0]
            first, last = self.touched_nodes(self.parameters.particles)
            for i in range(first[0], last[0]):
                for j in range(first[1], last[1]):
                    self.clear(0, i, j)
            for p in range(self.parameters.particles):
                self.prepare(0, p, solid)
            for p in range(self.parameters.particles):
                self.p2g(0, p)
            for i in range(first[0], last[0]):
                for j in range(first[1], last[1]):
                    self.update(0, i, j, fill, friction)
            for p in range(self.parameters.particles):
                self.g2p(0, p)
            for p in range(self.parameters.particles):
                self.flow(0, p, solid)

    @ti.kernel
    def _parallel_substep(self, solid: Template) -> Nothing:
        nodes = ti.static((self.low - 1, self.high + 2))
        ti.loop_config(parallelize=self.threads)
        for s, i, j in ti.ndrange(self.scenarios, nodes, nodes):
            self.clear(s, i, j)
        ti.loop_config(parallelize=self.threads)
        for s, p in ti.ndrange(self.scenarios, self.parameters.particles):
            self.prepare(s, p, solid)
            self.p2g(s, p)
        ti.loop_config(parallelize=self.threads)
        for s, i, j in ti.ndrange(self.scenarios, nodes, nodes):
            self.update(s, i, j, self.fill[s], self.friction[s])
        ti.loop_config(parallelize=self.threads)
        for s, p in ti.ndrange(self.scenarios, self.parameters.particles):
            self.g2p(s, p)
            self.flow(s, p, solid)

    @ti.kernel
    def restart_extremes(self) -> Nothing:
        """Start an advance: the extremes are those of the present state."""
        ti.loop_config(serialize=ti.static(not self.atomic))
        for s, p in ti.ndrange(self.scenarios, self.parameters.particles):
            v = self.carried[s, p]
            f = self.f[s, p]
            jacobian = f[0, 0] * f[1, 1] - f[0, 1] * f[1, 0]
            if self.matter[s, p][0] == LIQUID:
                jacobian = v[3]
            speed = largest_of(ti.abs(v[0]), ti.abs(v[1]))
            self.extremes[s, p] = ti.Vector([speed, jacobian, jacobian, 0.0])
