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
from taichi import f32, i32, i64
from taichi.math import mat2, vec2, vec4

from .constitutive import (
    corotated_stress,
    determinant,
    hardening,
    larger,
    liquid_stress,
    plastic_return,
    smaller,
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
    masked,
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
        # of each particle: the deformation gradient of a solid [1]
        self.deformation = mat2.field()
        # rows of its stencil
        self.weight_rows = [vec4.field() for _ in range(3)]
        # first column of A, scaled, and two zeros
        self.momentum_slope_x = vec4.field()
        # second column
        self.momentum_slope_y = vec4.field()
        # v_x, v_y, r and Jbar of the nodes, at the particle
        self.grid_state = vec4.field()

        # of each node: n v_x, n v_y, n, n J
        self.sums = ti.Vector.field(4, i64)
        self.node_state = vec4.field()  # v_x, v_y, r, Jbar

    def _particle_fields(self) -> tuple[ti.Field, ...]:
        return (
            self.deformation,
            *self.weight_rows,
            self.momentum_slope_x,
            self.momentum_slope_y,
            self.grid_state,
        )

    def _node_fields(self) -> tuple[ti.Field, ...]:
        return self.sums, self.node_state

    # The phases: each function is one phase at one particle or node.

    @ti.func
    def stress(self, s: i32, p: i32, c: mat2, solid: Template) -> mat2:
        """Return the Kirchhoff stress tau of a particle."""
        kind = self.matter[s, p][0]
        ratio = self.matter[s, p][1]
        modulus = self.parameters.liquid_modulus
        isotropic = liquid_stress(ratio, modulus)
        tau = mat2([isotropic, 0.0], [0.0, isotropic])
        viscosity = self.liquid_viscosity
        if ti.static(solid):
            mu, la = self.jelly
            damping = self.solid_viscosity
            if kind == ROPE:
                mu, la = self.rope
            if kind == SNOW:
                factor = hardening(
                    ratio,
                    self.parameters.snow_hardening,
                    self.parameters.snow_hardening_min,
                    self.parameters.snow_hardening_max,
                )
                snow_mu, snow_la = self.snow
                mu = snow_mu * factor
                la = snow_la * factor
                damping = 0.0
            f = self.deformation[s, p]
            elastic = corotated_stress(f, mu, la)
            is_liquid = kind == LIQUID
            tau = ti.select(is_liquid, tau, elastic)
            viscosity = ti.select(is_liquid, viscosity, damping)
        return tau + viscous_stress(c, viscosity)

    @ti.func
    def velocity_gradient(self, s: i32, p: i32) -> mat2:
        """Return C of a particle."""
        slope_x = self.slope_x[s, p]
        slope_y = self.slope_y[s, p]
        gradient_of_u = vec2(slope_x.x, slope_y.x)
        gradient_of_v = vec2(slope_x.y, slope_y.y)
        return mat2(gradient_of_u, gradient_of_v)

    @ti.func
    def prepare(self, s: i32, p: i32, solid: Template) -> None:
        """Compute the stencil of a particle, and the slope A of what it carries."""
        self.locate(s, p)
        c = self.velocity_gradient(s, p)
        tau = self.stress(s, p, c, solid)
        a = self.dx * c - self.stress_factor * tau
        self.keep_reach(s, p, a)
        scaled = self.velocity_scale * a
        first_column = scaled[:, 0]
        second_column = scaled[:, 1]
        self.momentum_slope_x[s, p] = vec4(first_column, 0.0, 0.0)
        self.momentum_slope_y[s, p] = vec4(second_column, 0.0, 0.0)

    @ti.func
    def locate(self, s: i32, p: i32) -> None:
        """Keep for P2G and G2P which nodes a particle touches, and the weights."""
        x = self.x[s, p]
        first, second, third = stencil(x, self.inv_dx, self.width)
        self.weight_rows[0][s, p] = first
        self.weight_rows[1][s, p] = second
        self.weight_rows[2][s, p] = third

    @ti.func
    def keep_reach(self, s: i32, p: i32, a: mat2) -> None:
        """Keep the largest abs(v) + abs(A o) of a particle in this advance."""
        # A node lies within 1.5 cells per axis.
        velocity = self.particle_state[s, p].xy
        speed = ti.abs(velocity)
        slope = ti.abs(a)
        slope_of_x = slope[0, 0] + slope[0, 1]
        slope_of_y = slope[1, 0] + slope[1, 1]
        reach_x = speed.x + 1.5 * slope_of_x
        reach_y = speed.y + 1.5 * slope_of_y
        reach = largest_of(reach_x, reach_y)
        extremes = self.extremes[s, p]
        extremes[3] = larger(reach, extremes[3])
        self.extremes[s, p] = extremes

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
        step_x = self.momentum_slope_x[s, p]
        step_y = self.momentum_slope_y[s, p]
        at_middle = scale * self.particle_state[s, p]
        at_middle = at_middle - offset.x * step_x
        at_middle = at_middle - offset.y * step_y
        for i, j in ti.static(ti.ndrange(3, 3)):
            at_column = stepped(at_middle, step_x, i - 1)
            at_node = stepped(at_column, step_y, j - 1)
            node = base + i * self.width + j
            weight = self.weight_rows[i][s, p][j]
            share = weight * at_node
            accumulate(self.sums, s, node, share, self.atomic)

    @ti.func
    def at(self, i: i32, j: i32) -> i32:
        """Return the number of a node."""
        return i * self.width + j

    @ti.func
    def clear(self, s: i32, i: i32, j: i32) -> None:
        """Set the sums of a node of scenario s to zero, before P2G adds to them."""
        node = self.at(i, j)
        zero = ti.Vector.zero(i64, 4)
        self.sums[s, node] = zero

    @ti.func
    def update(
        self, s: i32, i: i32, j: i32, particle_volume: f32, friction: f32
    ) -> None:
        """Divide by n, add gravity, meet the walls; an empty node is at rest."""
        node = self.at(i, j)
        total = self.sums[s, node]
        u = 0.0
        v = 0.0
        jacobian = 1.0
        count_sum = total[2]
        if count_sum > 0:
            momentum = from_fixed(total.xy, self.velocity_unit)
            count = from_fixed(count_sum, self.count_unit)
            jacobian_sum = from_fixed(total[3], self.count_unit)
            u = momentum.x / count
            v = momentum.y / count - self.gravity_gain
            jacobian = jacobian_sum / count
            u, v = self.contact(i, u, v, friction)
            v, u = self.contact(j, v, u, friction)
        mirrored_sum = self.mirrored_count(s, i, j)
        mirrored_count = from_fixed(mirrored_sum, self.count_unit)
        density = mirrored_count * particle_volume
        self.node_state[s, node] = vec4(u, v, density, jacobian)

    @ti.func
    def contact(self, index: i32, normal: f32, tangential: f32, friction: f32) -> Value:
        """Return the normal and tangential velocity behind the contact with a wall.

        ``index`` counts nodes along the normal of the two walls across an axis.
        """
        new_normal = normal
        new_tangential = tangential
        if self.is_outward(index, normal):
            impact_speed = ti.abs(normal)
            sliding_speed = ti.abs(tangential)
            divisor = larger(sliding_speed, 1e-9)
            loss = friction * impact_speed / divisor
            kept = larger(1.0 - loss, 0.0)
            new_normal = 0.0
            new_tangential = tangential * kept
        return new_normal, new_tangential

    @ti.func
    def count_at(self, s: i32, i: i32, j: i32) -> i64:
        """Return n of a node, without its mirror images."""
        node = self.at(i, j)
        return self.sums[s, node][2]

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
        """Gather (v, r, Jbar) and their slopes."""
        lowest, offset = base_node(self.weight_rows, s, p)
        base = masked(lowest, self.node_count)
        state = vec4(0.0)
        slope_x = vec4(0.0)
        slope_y = vec4(0.0)
        for i, j in ti.static(ti.ndrange(3, 3)):
            node = base + i * self.width + j
            weight = self.weight_rows[i][s, p][j]
            node_state = self.node_state[s, node]
            share = weight * node_state
            distance_x = (i - 1.0) - offset.x
            distance_y = (j - 1.0) - offset.y
            state += share
            slope_x += distance_x * share
            slope_y += distance_y * share
        slope_factor = 4.0 * self.inv_dx
        self.slope_x[s, p] = slope_factor * slope_x
        self.slope_y[s, p] = slope_factor * slope_y
        self.grid_state[s, p] = state

    @ti.func
    def flow(self, s: i32, p: i32, solid: Template) -> None:
        """Move a particle; update J of a liquid or F of a solid."""
        grid_state = self.grid_state[s, p]
        grid_density = grid_state[2]
        grid_jacobian = grid_state[3]
        velocity = grid_state.xy
        old_x = self.x[s, p].xy
        x = old_x + self.dt * velocity
        x = bounded(x, self.position_min, self.position_max)
        self.x[s, p] = vec4(x, 0.0, 0.0)

        matter = self.matter[s, p]
        kind = matter[0]
        old_ratio = matter[1]
        c = self.velocity_gradient(s, p)
        divergence = c[0, 0] + c[1, 1]
        j = self.liquid_jacobian(old_ratio, divergence, grid_jacobian, grid_density)
        ratio = j
        jacobian = j
        spread_jacobian = j
        if ti.static(solid):
            # Chosen, not branched upon: else no vectors.
            is_snow = kind == SNOW
            is_liquid = kind == LIQUID
            old_f = self.deformation[s, p]
            rate = c @ old_f
            trial = old_f + self.dt * rate
            yielded, growth = plastic_return(trial, self.yield_low, self.yield_high)
            solid_f = ti.select(is_snow, yielded, trial)
            f = ti.select(is_liquid, old_f, solid_f)
            self.deformation[s, p] = f

            jp_min = self.parameters.snow_jp_min
            jp_max = self.parameters.snow_jp_max
            jp = bounded(old_ratio * growth, jp_min, jp_max)
            solid_ratio = ti.select(is_snow, jp, old_ratio)
            ratio = ti.select(is_liquid, j, solid_ratio)
            jacobian = ti.select(is_liquid, j, determinant(f))
            spread_jacobian = ti.select(is_liquid, j, 1.0)
        self.particle_state[s, p] = vec4(velocity, 1.0, spread_jacobian)

        old_min = matter[2]
        old_max = matter[3]
        ratio_min = smaller(ratio, old_min)
        ratio_max = larger(ratio, old_max)
        self.matter[s, p] = vec4(kind, ratio, ratio_min, ratio_max)
        speed = ti.abs(velocity)
        self.keep_extremes(s, p, speed, jacobian)

    @ti.func
    def keep_extremes(self, s: i32, p: i32, speed: vec2, jacobian: f32) -> None:
        """Keep the largest speed and the extremes of J in this advance."""
        extremes = self.extremes[s, p]
        fastest = largest_of(speed.x, speed.y)
        extremes[0] = larger(fastest, extremes[0])
        extremes[1] = smaller(jacobian, extremes[1])
        extremes[2] = larger(jacobian, extremes[2])
        self.extremes[s, p] = extremes

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
        ti.loop_config(serialize=True)
        for _ in range(substeps):
            # Read here: an address of a field inside the loops would keep them from
            # being vectorised.
            particle_volume = self.particle_volume[0]
            friction = self.friction[0]
            first, end = self.touched_nodes(self.particles)
            for i in range(first[0], end[0]):
                for j in range(first[1], end[1]):
                    self.clear(0, i, j)
            for p in range(self.particles):
                self.prepare(0, p, solid)
            for p in range(self.particles):
                self.p2g(0, p)
            for i in range(first[0], end[0]):
                for j in range(first[1], end[1]):
                    self.update(0, i, j, particle_volume, friction)
            for p in range(self.particles):
                self.g2p(0, p)
            for p in range(self.particles):
                self.flow(0, p, solid)

    @ti.kernel
    def _parallel_substep(self, solid: Template) -> Nothing:
        # with the nodes behind the walls
        first_node = ti.static(self.low - 1)
        end_node = ti.static(self.high + 2)
        nodes = ti.static((first_node, end_node))
        ti.loop_config(parallelize=self.threads)
        for s, i, j in ti.ndrange(self.scenarios, nodes, nodes):
            self.clear(s, i, j)
        ti.loop_config(parallelize=self.threads)
        for s, p in ti.ndrange(self.scenarios, self.particles):
            self.prepare(s, p, solid)
            self.p2g(s, p)
        ti.loop_config(parallelize=self.threads)
        for s, i, j in ti.ndrange(self.scenarios, nodes, nodes):
            particle_volume = self.particle_volume[s]
            friction = self.friction[s]
            self.update(s, i, j, particle_volume, friction)
        ti.loop_config(parallelize=self.threads)
        for s, p in ti.ndrange(self.scenarios, self.particles):
            self.g2p(s, p)
            self.flow(s, p, solid)

    @ti.kernel
    def restart_extremes(self) -> Nothing:
        """Start an advance: the extremes are those of the present state.

        They are the speed, the least J and the largest J of a particle. Its reach, the
        fourth one, is 0 until it moves.
        """
        ti.loop_config(serialize=ti.static(not self.atomic))
        for s, p in ti.ndrange(self.scenarios, self.particles):
            state = self.particle_state[s, p]
            f = self.deformation[s, p]
            jacobian = determinant(f)
            if self.matter[s, p][0] == LIQUID:
                jacobian = state[3]
            speed = ti.abs(state.xy)
            speed_max = largest_of(speed.x, speed.y)
            self.extremes[s, p] = vec4(speed_max, jacobian, jacobian, 0.0)
