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

from .constitutive import (
    corotated_stress,
    determinant,
    liquid_stress,
    plastic_return,
    viscous_stress,
)
from .free_surface_kernels import LIQUID, SNOW, FreeSurfaceKernels
from .language import f32, i32, i64, mat2, ti, vec2, vec4
from .transfer import (
    Nothing,
    Template,
    accumulate,
    base_node,
    from_fixed,
    masked,
    stencil,
    stepped,
)


@ti.data_oriented
class ParticleStress(FreeSurfaceKernels):
    """Fields of a batch of scenarios and the kernels that advance them.

    P2G spreads v_x, v_y, 1, and J of liquid or 1. Nodes hold v_x, v_y, Jbar and r.
    """

    dimension = 2
    reach = 64.0  # a violent impact reaches 2
    at_rest = (0.0, 0.0, 1.0, 1.0)
    lanes = 4

    def _particle_fields(self) -> tuple[ti.Field, ...]:
        # the rows of the stencil
        self.weight_rows = [vec4.field() for _ in range(3)]
        return tuple(self.weight_rows)

    # The phases: each function is one phase at one particle or node.

    @ti.func
    def stress(self, s: i32, p: i32, c: mat2, solid: Template) -> mat2:
        """Return the Kirchhoff stress tau of a particle."""
        matter = self.matter[s, p]
        # as if it were liquid
        isotropic = liquid_stress(matter[1], self.parameters.liquid_modulus)
        tau = mat2([isotropic, 0.0], [0.0, isotropic])
        if ti.static(solid):
            mu, la = self.moduli(s, p)
            elastic = corotated_stress(self.deformation(s, p), mu, la)
            tau = ti.select(matter[0] == LIQUID, tau, elastic)
        return tau + viscous_stress(c, self.viscosity(s, p, solid))

    @ti.func
    def velocity_gradient(self, s: i32, p: i32) -> mat2:
        """Return C of a particle."""
        slope_x = self.slopes[0][s, p]
        slope_y = self.slopes[1][s, p]
        return mat2([slope_x.x, slope_y.x], [slope_x.y, slope_y.y])

    @ti.func
    def deformation(self, s: i32, p: i32) -> mat2:
        """Return F of a particle."""
        first = self.deformation_columns[0][s, p]
        second = self.deformation_columns[1][s, p]
        return mat2([first.x, second.x], [first.y, second.y])

    @ti.func
    def determinant(self, s: i32, p: i32) -> f32:
        """Return det F of a particle."""
        return determinant(self.deformation(s, p))

    @ti.func
    def divergence(self, s: i32, p: i32) -> f32:
        """Return tr C of a particle."""
        return self.slopes[0][s, p].x + self.slopes[1][s, p].y

    @ti.func
    def prepare(self, s: i32, p: i32, solid: Template) -> None:
        """Compute the stencil of a particle, and the slope A of what it carries."""
        rows = stencil(self.x[s, p], self.inv_dx, self.width)
        for i in ti.static(range(3)):
            self.weight_rows[i][s, p] = rows[i]
        c = self.velocity_gradient(s, p)
        a = self.dx * c - self.stress_factor * self.stress(s, p, c, solid)
        # A node lies within 1.5 cells per axis.
        affine_speed = 1.5 * (ti.abs(a[:, 0]) + ti.abs(a[:, 1]))
        self.keep_node_speed(s, p, affine_speed)
        for axis in ti.static(self.axes):
            column = self.velocity_scale * a[:, axis]
            self.momentum_slopes[axis][s, p] = vec4(column, 0.0, 0.0)

    @ti.func
    def p2g(self, s: i32, p: i32) -> None:
        """Spread n v, n and n J, from the middle node to its neighbours, dx away."""
        scale = vec4(
            self.velocity_scale,
            self.velocity_scale,
            self.count_scale,
            self.count_scale,
        )
        at_particle = scale * self.particle_state[s, p]
        # what is added from one node to the next, along x and along y
        step_x = self.momentum_slopes[0][s, p]
        step_y = self.momentum_slopes[1][s, p]
        base, offset = base_node(self.weight_rows, s, p)
        at_middle = at_particle - offset.x * step_x - offset.y * step_y

        for i in ti.static(range(3)):
            column = base + i * self.width
            at_column = stepped(at_middle, step_x, i - 1)
            for j in ti.static(range(3)):
                at_node = stepped(at_column, step_y, j - 1)
                # A weight at a time: a name for the row makes this loop slower.
                share = self.weight_rows[i][s, p][j] * at_node
                accumulate(self.sums, s, column + j, share, self.atomic)

    @ti.func
    def at(self, i: i32, j: i32) -> i32:
        """Return the number of a node."""
        return i * self.width + j

    @ti.func
    def clear(self, s: i32, i: i32, j: i32) -> None:
        """Set the sums of a node of scenario s to zero, before P2G adds to them."""
        self.sums[s, self.at(i, j)] = ti.Vector.zero(i64, 4)

    @ti.func
    def update(
        self, s: i32, i: i32, j: i32, particle_volume: f32, friction: f32
    ) -> None:
        """Divide by n, add gravity, meet the walls; an empty node is at rest."""
        node = self.at(i, j)
        total = self.sums[s, node]
        velocity = vec2(0.0)
        jacobian = 1.0
        if total[2] > 0:
            count = from_fixed(total[2], self.count_unit)
            jacobian = from_fixed(total[3], self.count_unit) / count
            velocity = from_fixed(total.xy, self.velocity_unit) / count
            velocity[1] -= self.gravity_gain
            velocity = self.contact(i, 0, velocity, friction)
            velocity = self.contact(j, 1, velocity, friction)
        mirrored_count = from_fixed(self.mirrored_count(s, i, j), self.count_unit)
        density = mirrored_count * particle_volume
        self.node_state[s, node] = vec4(velocity, jacobian, density)

    @ti.func
    def count_at(self, s: i32, i: i32, j: i32) -> i64:
        """Return n of a node, without its mirror images."""
        return self.sums[s, self.at(i, j)][2]

    @ti.func
    def mirrored_count(self, s: i32, i: i32, j: i32) -> i64:
        """Return the fixed-point sum n of a node and of its mirror images.

        A node within a cell of a wall has an image. A node on the wall is its own image
        and counts twice, in a corner four times. Otherwise it would seem to hold half a
        cell, or in a corner a quarter.
        """
        image_i = self.image(i)
        image_j = self.image(j)
        count = self.count_at(s, i, j)
        if image_i >= 0:
            count += self.count_at(s, image_i, j)
        if image_j >= 0:
            count += self.count_at(s, i, image_j)
            if image_i >= 0:
                count += self.count_at(s, image_i, image_j)
        return count

    @ti.func
    def g2p(self, s: i32, p: i32) -> None:
        """Gather (v, Jbar, r) and their slopes."""
        state = vec4(0.0)
        # sums of w q o, along x and along y
        moment_x = vec4(0.0)
        moment_y = vec4(0.0)
        lowest, offset = base_node(self.weight_rows, s, p)
        base = masked(lowest, self.node_count)
        for i in ti.static(range(3)):
            weights = self.weight_rows[i][s, p]
            column = base + i * self.width
            for j in ti.static(range(3)):
                share = weights[j] * self.node_state[s, column + j]
                state += share
                moment_x += (i - 1.0 - offset.x) * share
                moment_y += (j - 1.0 - offset.y) * share
        slope_factor = 4.0 * self.inv_dx
        slope_y = slope_factor * moment_y
        self.slopes[0][s, p] = slope_factor * moment_x
        self.slopes[1][s, p] = slope_y
        self.grid_state[s, p] = state

    @ti.func
    def deform(self, s: i32, p: i32) -> None:
        """Update F of a solid with the velocity gradient, and Jp of snow.

        Chosen, not branched upon: else LLVM makes no vector instructions.
        """
        matter = self.matter[s, p]
        is_snow = matter[0] == SNOW
        is_liquid = matter[0] == LIQUID
        old_f = self.deformation(s, p)
        trial = old_f + self.dt * (self.velocity_gradient(s, p) @ old_f)
        yielded, growth = plastic_return(trial, self.yield_low, self.yield_high)
        f = ti.select(is_liquid, old_f, ti.select(is_snow, yielded, trial))
        for axis in ti.static(self.axes):
            self.deformation_columns[axis][s, p] = vec4(f[:, axis], 0.0, 0.0)
        jp = self.grown_plastic_ratio(s, p, growth)
        self.store_ratio(s, p, ti.select(is_snow, jp, matter[1]))
        self.keep_jacobian(s, p, ti.select(is_liquid, matter[1], determinant(f)))

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
    def _serial_substeps(self, substeps: i32, solid: Template) -> Nothing:
        particles = ti.static(self.particles)
        ti.loop_config(serialize=True)
        for _ in range(substeps):
            # Read here: an address of a field inside the loops would keep them from
            # being vectorised.
            particle_volume = self.particle_volume[0]
            friction = self.friction[0]
            first, end = self.touched_nodes(particles)
            for i in range(first[0], end[0]):
                for j in range(first[1], end[1]):
                    self.clear(0, i, j)
            for p in range(particles):
                self.prepare(0, p, solid)
            for p in range(particles):
                self.p2g(0, p)
            for i in range(first[0], end[0]):
                for j in range(first[1], end[1]):
                    self.update(0, i, j, particle_volume, friction)
            for p in range(particles):
                self.g2p(0, p)
            for p in range(particles):
                self.flow(0, p, solid)
                if ti.static(solid):
                    self.deform(0, p)

    @ti.kernel
    def _parallel_substep(self, solid: Template) -> Nothing:
        threads = ti.static(self.threads)
        scenarios = ti.static(self.scenarios)
        particles = ti.static(self.particles)
        # with the nodes behind the walls
        nodes = ti.static((self.low - 1, self.high + 2))
        ti.loop_config(parallelize=threads)
        for s, i, j in ti.ndrange(scenarios, nodes, nodes):
            self.clear(s, i, j)
        ti.loop_config(parallelize=threads)
        for s, p in ti.ndrange(scenarios, particles):
            self.prepare(s, p, solid)
            self.p2g(s, p)
        ti.loop_config(parallelize=threads)
        for s, i, j in ti.ndrange(scenarios, nodes, nodes):
            particle_volume = self.particle_volume[s]
            friction = self.friction[s]
            self.update(s, i, j, particle_volume, friction)
        ti.loop_config(parallelize=threads)
        for s, p in ti.ndrange(scenarios, particles):
            self.g2p(s, p)
            self.flow(s, p, solid)
            if ti.static(solid):
                self.deform(s, p)
