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
    hardening,
    larger,
    liquid_stress,
    plastic_return,
    smaller,
    viscous_stress,
)
from .free_surface_kernels import LIQUID, ROPE, SNOW, FreeSurfaceKernels, largest_of
from .language import f32, i32, i64, mat2, ti, vec2, vec4
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
        self.first_row = vec4.field()
        self.second_row = vec4.field()
        self.third_row = vec4.field()
        self.weight_rows = [self.first_row, self.second_row, self.third_row]
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
        matter = self.matter[s, p]
        kind = matter[0]
        ratio = matter[1]

        # as if it were liquid
        modulus = self.parameters.liquid_modulus
        isotropic = liquid_stress(ratio, modulus)
        first_row = vec2(isotropic, 0.0)
        second_row = vec2(0.0, isotropic)
        tau = mat2(first_row, second_row)
        viscosity = self.liquid_viscosity
        if ti.static(solid):
            mu, la = self.jelly
            damping = self.solid_viscosity
            if kind == ROPE:
                mu, la = self.rope
            if kind == SNOW:
                exponent = self.parameters.snow_hardening
                least_factor = self.parameters.snow_hardening_min
                greatest_factor = self.parameters.snow_hardening_max
                factor = hardening(ratio, exponent, least_factor, greatest_factor)
                snow_mu, snow_la = self.snow
                mu = snow_mu * factor
                la = snow_la * factor
                damping = 0.0
            f = self.deformation[s, p]
            elastic = corotated_stress(f, mu, la)
            is_liquid = kind == LIQUID
            tau = ti.select(is_liquid, tau, elastic)
            viscosity = ti.select(is_liquid, viscosity, damping)
        viscous = viscous_stress(c, viscosity)
        return tau + viscous

    @ti.func
    def velocity_gradient(self, s: i32, p: i32) -> mat2:
        """Return C of a particle."""
        slope_x = self.slope_x[s, p]
        slope_y = self.slope_y[s, p]
        u_x = slope_x.x
        u_y = slope_y.x
        v_x = slope_x.y
        v_y = slope_y.y
        gradient_of_u = vec2(u_x, u_y)
        gradient_of_v = vec2(v_x, v_y)
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
        slope_x = vec4(first_column, 0.0, 0.0)
        slope_y = vec4(second_column, 0.0, 0.0)
        self.momentum_slope_x[s, p] = slope_x
        self.momentum_slope_y[s, p] = slope_y

    @ti.func
    def locate(self, s: i32, p: i32) -> None:
        """Keep for P2G and G2P which nodes a particle touches, and the weights."""
        position = self.x[s, p]
        first, second, third = stencil(position, self.inv_dx, self.width)
        self.first_row[s, p] = first
        self.second_row[s, p] = second
        self.third_row[s, p] = third

    @ti.func
    def keep_reach(self, s: i32, p: i32, a: mat2) -> None:
        """Keep the largest abs(v) + abs(A o) of a particle in this advance."""
        # A node lies within 1.5 cells per axis.
        state = self.particle_state[s, p]
        velocity = state.xy
        speed = ti.abs(velocity)
        slope = ti.abs(a)
        xx = slope[0, 0]
        xy = slope[0, 1]
        yx = slope[1, 0]
        yy = slope[1, 1]
        reach_x = speed.x + 1.5 * (xx + xy)
        reach_y = speed.y + 1.5 * (yx + yy)
        reach = largest_of(reach_x, reach_y)

        extremes = self.extremes[s, p]
        old_reach = extremes[3]
        extremes[3] = larger(reach, old_reach)
        self.extremes[s, p] = extremes

    @ti.func
    def p2g(self, s: i32, p: i32) -> None:
        """Spread n v, n and n J, from the middle node to its neighbours, dx away."""
        scale = vec4(
            self.velocity_scale,
            self.velocity_scale,
            self.count_scale,
            self.count_scale,
        )
        state = self.particle_state[s, p]
        at_particle = scale * state
        # what is added from one node to the next, along x and along y
        step_x = self.momentum_slope_x[s, p]
        step_y = self.momentum_slope_y[s, p]

        base, offset = base_node(self.weight_rows, s, p)
        at_middle = at_particle - offset.x * step_x
        at_middle = at_middle - offset.y * step_y

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
        momentum_sum = total.xy
        count_sum = total[2]
        jacobian_sum = total[3]
        if count_sum > 0:
            momentum = from_fixed(momentum_sum, self.velocity_unit)
            count = from_fixed(count_sum, self.count_unit)
            count_times_jacobian = from_fixed(jacobian_sum, self.count_unit)
            jacobian = count_times_jacobian / count
            u = momentum.x / count
            v = momentum.y / count
            v = v - self.gravity_gain
            u, v = self.contact(i, u, v, friction)
            v, u = self.contact(j, v, u, friction)

        mirrored_sum = self.mirrored_count(s, i, j)
        mirrored_count = from_fixed(mirrored_sum, self.count_unit)
        density = mirrored_count * particle_volume
        state = vec4(u, v, density, jacobian)
        self.node_state[s, node] = state

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
            kept = 1.0 - friction * impact_speed / divisor
            kept = larger(kept, 0.0)
            new_normal = 0.0
            new_tangential = tangential * kept
        return new_normal, new_tangential

    @ti.func
    def count_at(self, s: i32, i: i32, j: i32) -> i64:
        """Return n of a node, without its mirror images."""
        node = self.at(i, j)
        total = self.sums[s, node]
        return total[2]

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
        state = vec4(0.0)
        # sums of w q o, along x and along y
        moment_x = vec4(0.0)
        moment_y = vec4(0.0)

        lowest, offset = base_node(self.weight_rows, s, p)
        base = masked(lowest, self.node_count)
        for i in ti.static(range(3)):
            weights = self.weight_rows[i][s, p]
            column = base + i * self.width
            distance_x = (i - 1.0) - offset.x
            for j in ti.static(range(3)):
                node = column + j
                weight = weights[j]
                node_state = self.node_state[s, node]
                share = weight * node_state
                share_x = distance_x * share
                share_y = (j - 1.0 - offset.y) * share
                state += share
                moment_x += share_x
                moment_y += share_y

        slope_factor = 4.0 * self.inv_dx
        slope_y = slope_factor * moment_y
        self.slope_x[s, p] = slope_factor * moment_x
        self.slope_y[s, p] = slope_y
        self.grid_state[s, p] = state

    @ti.func
    def flow(self, s: i32, p: i32, solid: Template) -> None:
        """Move a particle; update J of a liquid or F of a solid."""
        grid_state = self.grid_state[s, p]
        grid_density = grid_state[2]
        grid_jacobian = grid_state[3]
        velocity = grid_state.xy
        old_x = self.x[s, p]
        old_position = old_x.xy
        moved = old_position + self.dt * velocity
        inside = bounded(moved, self.position_min, self.position_max)
        x = vec4(inside, 0.0, 0.0)
        self.x[s, p] = x

        matter = self.matter[s, p]
        kind = matter[0]
        old_ratio = matter[1]
        c = self.velocity_gradient(s, p)
        stretch_rate_x = c[0, 0]
        stretch_rate_y = c[1, 1]
        divergence = stretch_rate_x + stretch_rate_y
        j = self.liquid_jacobian(old_ratio, divergence, grid_jacobian, grid_density)
        ratio = j
        jacobian = j
        spread_jacobian = j
        if ti.static(solid):
            # Chosen, not branched upon: else no vectors.
            is_snow = kind == SNOW
            is_liquid = kind == LIQUID
            old_f = self.deformation[s, p]
            trial = old_f + self.dt * (c @ old_f)
            least_stretch = self.yield_low
            greatest_stretch = self.yield_high
            yielded, growth = plastic_return(trial, least_stretch, greatest_stretch)
            f = ti.select(is_liquid, old_f, ti.select(is_snow, yielded, trial))
            self.deformation[s, p] = f

            jp_min = self.parameters.snow_jp_min
            jp_max = self.parameters.snow_jp_max
            jp = old_ratio * growth
            jp = bounded(jp, jp_min, jp_max)
            ratio = ti.select(is_liquid, j, ti.select(is_snow, jp, old_ratio))
            solid_jacobian = determinant(f)
            jacobian = ti.select(is_liquid, j, solid_jacobian)
            spread_jacobian = ti.select(is_liquid, j, 1.0)
        state = vec4(velocity, 1.0, spread_jacobian)
        self.particle_state[s, p] = state

        old_min = matter[2]
        old_max = matter[3]
        ratio_min = smaller(ratio, old_min)
        ratio_max = larger(ratio, old_max)
        new_matter = vec4(kind, ratio, ratio_min, ratio_max)
        self.matter[s, p] = new_matter
        speed = ti.abs(velocity)
        self.keep_extremes(s, p, speed, jacobian)

    @ti.func
    def keep_extremes(self, s: i32, p: i32, speed: vec2, jacobian: f32) -> None:
        """Keep the largest speed and the extremes of J in this advance."""
        extremes = self.extremes[s, p]
        old_speed = extremes[0]
        old_least = extremes[1]
        old_greatest = extremes[2]
        fastest = largest_of(speed.x, speed.y)
        extremes[0] = larger(fastest, old_speed)
        extremes[1] = smaller(jacobian, old_least)
        extremes[2] = larger(jacobian, old_greatest)
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
        particles = ti.static(self.particles)
        ti.loop_config(serialize=True)
        for _ in range(substeps):
            # Read here: an address of a field inside the loops would keep them from
            # being vectorised.
            particle_volume = self.particle_volume[0]
            friction = self.friction[0]
            first, end = self.touched_nodes(particles)
            first_i = first[0]
            first_j = first[1]
            end_i = end[0]
            end_j = end[1]
            for i in range(first_i, end_i):
                for j in range(first_j, end_j):
                    self.clear(0, i, j)
            for p in range(particles):
                self.prepare(0, p, solid)
            for p in range(particles):
                self.p2g(0, p)
            for i in range(first_i, end_i):
                for j in range(first_j, end_j):
                    self.update(0, i, j, particle_volume, friction)
            for p in range(particles):
                self.g2p(0, p)
            for p in range(particles):
                self.flow(0, p, solid)

    @ti.kernel
    def _parallel_substep(self, solid: Template) -> Nothing:
        threads = ti.static(self.threads)
        scenarios = ti.static(self.scenarios)
        particles = ti.static(self.particles)
        # with the nodes behind the walls
        first_node = ti.static(self.low - 1)
        end_node = ti.static(self.high + 2)
        nodes = ti.static((first_node, end_node))
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

    @ti.kernel
    def restart_extremes(self) -> Nothing:
        """Start an advance: the extremes are those of the present state.

        They are the speed, the least J and the largest J of a particle. Its reach, the
        fourth one, is 0 until it moves.
        """
        scenarios = ti.static(self.scenarios)
        particles = ti.static(self.particles)
        is_serial = ti.static(not self.atomic)
        ti.loop_config(serialize=is_serial)
        for s, p in ti.ndrange(scenarios, particles):
            state = self.particle_state[s, p]
            matter = self.matter[s, p]
            kind = matter[0]
            f = self.deformation[s, p]
            jacobian = determinant(f)
            if kind == LIQUID:
                jacobian = state[3]

            velocity = state.xy
            speed = ti.abs(velocity)
            fastest = largest_of(speed.x, speed.y)
            extremes = vec4(fastest, jacobian, jacobian, 0.0)
            self.extremes[s, p] = extremes
