"""One substep of MLS-MPM with a free surface: liquid, jelly, snow and rope (design 4.4).

For particles of equal mass m, positions x_p, grid spacing dx, weights w_ip and
o = (x_i - x_p) / dx:

1. P2G:  n_i = sum w,   (n v)_i = sum w (v_p + A_p o),   (n J)_i = sum w J_p,
   with A = dx C - (4 dt / (rho dx)) tau, and J = 1 in solids.
2. Grid: v_i = (n v)_i / n_i + dt g; the walls take the outward normal velocity and, by Coulomb
   friction, at most ``friction`` times as much tangential velocity. Jbar = (n J)/n. Relative
   density r_i = n_i m / (rho dx^2), where n_i counts mirror images at the walls.
3. G2P:  v_p = sum w v_i,   C_p = (4/dx) sum w v_i o^T,   x_p <- x_p + dt v_p, kept in the box.
   Liquid: J <- J (1 + dt tr C) + kappa (Jbar - J), then J <- J + theta (1/max(r, 1) - J),
   within [J_min, J_max]. Solids: F <- (I + dt C) F; snow then yields.

The mass of a particle cancels everywhere but in r, so nodes count particles. Sums are integers
(:mod:`.transfer`): no order of particles or threads changes a bit. The stresses stand in
:mod:`.constitutive`.

Source: Hu et al. 2018; Jiang et al. 2015 (APIC). The tie of J to the density is ours: without
it a settled liquid loses a fifth of its depth.
"""

import taichi as ti

from . import backend
from .constitutive import (
    corotated_stress,
    hardening,
    lame,
    larger,
    liquid_stress,
    plastic_return,
    viscous_stress,
)
from .split import FreeSurfaceParameters, Material
from .transfer import Nothing, Value, accumulate, bounded, fixed_point_scale, from_fixed, stencil

__all__ = ["ParticleStress"]

_INSET = 1e-3
"""Distance that particles keep from a wall [cells]."""

_REACH = 64.0
"""Bound of abs(v_p + A o) over dx/dt, the largest speed [1]; a violent impact reaches 2."""

_HUGE = 3e38
"""Stands for what is not a number where extremes are kept."""

_LIQUID, _SNOW, _ROPE = int(Material.LIQUID), int(Material.SNOW), int(Material.ROPE)


@ti.data_oriented
class ParticleStress:
    """Fields of a batch of scenarios and the kernels that advance them.

    Attributes:
        x: particle positions [length].
        v: particle velocities [length/s].
        c: APIC matrices C [1/s].
        f: deformation gradients of the solids [1].
        ratio: J of liquid, plastic Jp of snow, 1 in other solids [1].
        material: :class:`.Material` of each particle.
        extremes: largest speed, smallest and largest J, and largest abs(v) + abs(A o) of each
            particle since the advance began.
        fill: m / (rho dx^2), shape [scenario].
        friction: Coulomb friction of the walls, shape [scenario].
        least: smallest coordinate of a particle.
        most: largest coordinate of a particle.
        speed_bound: the CFL bound dx/dt [length/s].
        reach_bound: largest abs(v) + abs(A o) that the sums have room for [length/s].
    """

    def __init__(
        self, parameters: FreeSurfaceParameters, *, scenarios: int, atomic: bool, threads: int
    ) -> None:
        """Round the constants and take the memory."""
        self.parameters = parameters  # constants that the scenarios share
        self.scenarios = scenarios  # scenarios advanced together
        self.atomic = atomic  # whether several threads run the phases
        self.threads = threads  # threads of the parallel loops on a CPU
        self._set_constants()
        self._make_fields()

    def _set_constants(self) -> None:
        p = self.parameters
        dx = 1.0 / p.grid
        self.inv_dx, self.dx, self.dt = float(p.grid), dx, p.dt
        self.low, self.high = p.wall, p.grid - p.wall
        self.least, self.most = (self.low + _INSET) * dx, (self.high - _INSET) * dx
        self.speed_bound = dx / p.dt
        self.reach_bound = _REACH * self.speed_bound
        self.velocity_scale = fixed_point_scale(p.particles, self.reach_bound)
        self.count_scale = fixed_point_scale(p.particles, max(1.0, p.jacobian_max))
        self.velocity_unit, self.count_unit = 1.0 / self.velocity_scale, 1.0 / self.count_scale
        self.impulse = 4.0 * p.dt * p.grid / p.density
        self.fall = p.gravity * p.dt
        self.liquid_viscosity = p.density * p.liquid_viscosity
        self.solid_viscosity = p.density * p.elastic_damping
        self.jelly = lame(p.jelly_modulus, p.jelly_poisson)
        self.rope = lame(p.rope_modulus, p.rope_poisson)
        self.snow = lame(p.snow_modulus, p.snow_poisson)
        self.yield_low, self.yield_high = 1.0 - p.snow_compression, 1.0 + p.snow_stretch

    def _make_fields(self) -> None:
        self.x = ti.Vector.field(2, ti.f32)
        self.v = ti.Vector.field(2, ti.f32)
        self.c = ti.Matrix.field(2, 2, ti.f32)
        self.f = ti.Matrix.field(2, 2, ti.f32)
        self.ratio = ti.field(ti.f32)
        self.material = ti.field(ti.i32)
        self.extremes = ti.Vector.field(4, ti.f32)
        self.slope = ti.Matrix.field(2, 2, ti.f32)  # A, scaled
        self.around = ti.Vector.field(2, ti.f32)  # r and Jbar at the particle
        self.sums = ti.Vector.field(4, ti.i64)  # n v_x, n v_y, n, n J
        self.node = ti.Vector.field(4, ti.f32)  # v_x, v_y, r, Jbar
        self.fill = ti.field(ti.f32)
        self.friction = ti.field(ti.f32)
        particles = (self.scenarios, self.parameters.particles)
        nodes = (self.scenarios, self.parameters.grid + 1, self.parameters.grid + 1)
        carried = (self.x, self.v, self.c, self.f, self.ratio, self.material)
        derived = (self.extremes, self.slope, self.around)
        self._tree = backend.place(
            *((particles, [field]) for field in carried + derived),
            *((nodes, [field]) for field in (self.sums, self.node)),
            ((self.scenarios,), [self.fill, self.friction]),
        )

    # --- one substep: each function is one phase at one particle or node ---------------------

    @ti.func
    def stress(self, s: ti.i32, p: ti.i32) -> ti.math.mat2:
        """Return the Kirchhoff stress tau of a particle."""
        tau = ti.Matrix.zero(ti.f32, 2, 2)
        viscosity = self.solid_viscosity
        if self.material[s, p] == _LIQUID:
            pull = liquid_stress(self.ratio[s, p], self.parameters.liquid_modulus)
            tau = ti.Matrix([[pull, 0.0], [0.0, pull]])
            viscosity = self.liquid_viscosity
        else:
            mu, la = self.jelly[0], self.jelly[1]
            if self.material[s, p] == _ROPE:
                mu, la = self.rope[0], self.rope[1]
            if self.material[s, p] == _SNOW:
                factor = hardening(
                    self.ratio[s, p],
                    self.parameters.snow_hardening,
                    self.parameters.snow_hardening_min,
                    self.parameters.snow_hardening_max,
                )
                mu, la = self.snow[0] * factor, self.snow[1] * factor
                viscosity = 0.0
            tau = corotated_stress(self.f[s, p], mu, la)
        return tau + viscous_stress(self.c[s, p], viscosity)

    @ti.func
    def prepare(self, s: ti.i32, p: ti.i32) -> None:
        """Compute the slope A of what a particle carries; a loop of its own is faster."""
        a = self.dx * self.c[s, p] - self.impulse * self.stress(s, p)
        v = self.v[s, p]
        reach_x = ti.abs(v[0]) + 1.5 * (ti.abs(a[0, 0]) + ti.abs(a[0, 1]))
        reach_y = ti.abs(v[1]) + 1.5 * (ti.abs(a[1, 0]) + ti.abs(a[1, 1]))
        self.extremes[s, p][3] = larger(largest_of(reach_x, reach_y), self.extremes[s, p][3])
        self.slope[s, p] = self.velocity_scale * a

    @ti.func
    def p2g(self, s: ti.i32, p: ti.i32) -> None:
        """Spread n v, n and n J; centred on the middle node, whose neighbours lie dx away."""
        base, f, weight = stencil(self.x[s, p], self.inv_dx)
        jacobian = 1.0
        if self.material[s, p] == _LIQUID:
            jacobian = self.ratio[s, p]
        a, v = self.slope[s, p], self.velocity_scale * self.v[s, p]
        a_x = ti.Vector([a[0, 0], a[1, 0], 0.0, 0.0])
        a_y = ti.Vector([a[0, 1], a[1, 1], 0.0, 0.0])
        carried = ti.Vector([v[0], v[1], self.count_scale, self.count_scale * jacobian])
        centre = carried - (f[0] - 1.0) * a_x - (f[1] - 1.0) * a_y
        for i in ti.static(range(3)):
            column = centre + (i - 1) * a_x
            for j in ti.static(range(3)):
                value = (weight[i, 0] * weight[j, 1]) * (column + (j - 1) * a_y)
                accumulate(self.sums, ti.Vector([s, base[0] + i, base[1] + j]), value, self.atomic)

    @ti.func
    def clear(self, s: ti.i32, i: ti.i32, j: ti.i32) -> None:
        """Empty the sums of a node."""
        self.sums[s, i, j] = ti.Vector.zero(ti.i64, 4)

    @ti.func
    def update(self, s: ti.i32, i: ti.i32, j: ti.i32) -> None:
        """Divide by n, add gravity, meet the walls; an empty node is at rest."""
        total = self.sums[s, i, j]
        u, v, jacobian = 0.0, 0.0, 1.0
        if total[2] > 0:
            n = from_fixed(total[2], self.count_unit)
            u = from_fixed(total[0], self.velocity_unit) / n
            v = from_fixed(total[1], self.velocity_unit) / n - self.fall
            jacobian = from_fixed(total[3], self.count_unit) / n
            u, v = self.contact(i, u, v, self.friction[s])
            v, u = self.contact(j, v, u, self.friction[s])
        density = from_fixed(self.mirrored_count(s, i, j), self.count_unit) * self.fill[s]
        self.node[s, i, j] = ti.Vector([u, v, density, jacobian])

    @ti.func
    def contact(self, index: ti.i32, normal: ti.f32, tangential: ti.f32, friction: ti.f32) -> Value:
        """Return the (normal, tangential) velocity that the two walls across an axis leave."""
        kept, braked = normal, tangential
        if (index <= self.low and normal < 0.0) or (index >= self.high and normal > 0.0):
            loss = friction * ti.abs(normal) / larger(ti.abs(tangential), 1e-9)
            kept, braked = 0.0, tangential * larger(1.0 - loss, 0.0)
        return kept, braked

    @ti.func
    def image(self, index: ti.i32) -> ti.i32:
        """Return the mirror image of a node within a cell of a wall, else -1."""
        found = -1
        if index <= self.low + 1:
            found = 2 * self.low - index
        if index >= self.high - 1:
            found = 2 * self.high - index
        return found

    @ti.func
    def mirrored_count(self, s: ti.i32, i: ti.i32, j: ti.i32) -> ti.i64:
        """Return n of a node with its images: a wall node holds half a cell, a corner a quarter."""
        count = self.sums[s, i, j][2]
        image_i, image_j = self.image(i), self.image(j)
        if image_i >= 0:
            count += self.sums[s, image_i, j][2]
        if image_j >= 0:
            count += self.sums[s, i, image_j][2]
            if image_i >= 0:
                count += self.sums[s, image_i, image_j][2]
        return count

    @ti.func
    def g2p(self, s: ti.i32, p: ti.i32) -> None:
        """Gather velocity, its gradient, r and Jbar; move the particle."""
        base, f, weight = stencil(self.x[s, p], self.inv_dx)
        mean = ti.Vector.zero(ti.f32, 4)
        b = ti.Vector.zero(ti.f32, 4)
        for i, j in ti.static(ti.ndrange(3, 3)):
            part = (weight[i, 0] * weight[j, 1]) * self.node[s, base[0] + i, base[1] + j]
            offset = ti.Vector([i - f[0], i - f[0], j - f[1], j - f[1]])
            mean += part
            b += offset * ti.Vector([part[0], part[1], part[0], part[1]])
        v = ti.Vector([mean[0], mean[1]])
        self.c[s, p] = (4.0 * self.inv_dx) * ti.Matrix([[b[0], b[2]], [b[1], b[3]]])
        self.v[s, p] = v
        self.x[s, p] = bounded(self.x[s, p] + self.dt * v, self.least, self.most)
        self.around[s, p] = ti.Vector([mean[2], mean[3]])
        self.extremes[s, p][0] = larger(largest_of(ti.abs(v[0]), ti.abs(v[1])), self.extremes[s, p][0])

    @ti.func
    def flow(self, s: ti.i32, p: ti.i32) -> None:
        """Update J of a liquid or F of a solid."""
        c = self.c[s, p]
        if self.material[s, p] == _LIQUID:
            old, r, mean = self.ratio[s, p], self.around[s, p][0], self.around[s, p][1]
            j = old + self.dt * (c[0, 0] + c[1, 1]) * old
            j += self.parameters.jacobian_relaxation * (mean - old)
            j += self.parameters.density_coupling * (1.0 / larger(r, 1.0) - j)
            self.ratio[s, p] = bounded(j, self.parameters.jacobian_min, self.parameters.jacobian_max)
        else:
            f = self.f[s, p] + self.dt * (c @ self.f[s, p])
            if self.material[s, p] == _SNOW:
                f, growth = plastic_return(f, self.yield_low, self.yield_high)
                self.ratio[s, p] = bounded(
                    self.ratio[s, p] * growth, self.parameters.snow_jp_min, self.parameters.snow_jp_max
                )
            self.f[s, p] = f
        jacobian = self.volume(s, p)
        self.extremes[s, p][1] = -larger(-jacobian, -self.extremes[s, p][1])
        self.extremes[s, p][2] = larger(jacobian, self.extremes[s, p][2])

    @ti.func
    def volume(self, s: ti.i32, p: ti.i32) -> ti.f32:
        """Return J of a liquid, det F of a solid (its elastic part in snow)."""
        jacobian = self.ratio[s, p]
        if self.material[s, p] != _LIQUID:
            f = self.f[s, p]
            jacobian = f[0, 0] * f[1, 1] - f[0, 1] * f[1, 0]
        return jacobian

    # --- the drivers: the same phases in the same order --------------------------------------

    @ti.kernel
    def run_serially(self, substeps: ti.i32) -> Nothing:
        """Advance scenario 0 by many substeps in one thread, on the nodes that particles touch."""
        ti.loop_config(serialize=True)
        for _ in range(substeps):
            first, last = ti.Vector([self.high, self.high]), ti.Vector([0, 0])
            for p in range(self.parameters.particles):
                base = ti.cast(self.x[0, p] * self.inv_dx - 0.5, ti.i32)
                first, last = ti.min(first, base), ti.max(last, base + 3)
            # A node next to a wall counts its image, which no particle need touch.
            for a in ti.static(range(2)):
                if first[a] <= self.low + 1:
                    first[a] = self.low - 1
                if last[a] >= self.high:
                    last[a] = self.high + 2
            for i in range(first[0], last[0]):
                for j in range(first[1], last[1]):
                    self.clear(0, i, j)
            for p in range(self.parameters.particles):
                self.prepare(0, p)
            for p in range(self.parameters.particles):
                self.p2g(0, p)
            for i in range(first[0], last[0]):
                for j in range(first[1], last[1]):
                    self.update(0, i, j)
            for p in range(self.parameters.particles):
                self.g2p(0, p)
            for p in range(self.parameters.particles):
                self.flow(0, p)

    @ti.kernel
    def run_in_parallel(self) -> Nothing:
        """Advance every scenario by one substep: one launch per phase."""
        nodes = ti.static((self.low - 1, self.high + 2))
        ti.loop_config(parallelize=self.threads)
        for s, i, j in ti.ndrange(self.scenarios, nodes, nodes):
            self.clear(s, i, j)
        ti.loop_config(parallelize=self.threads)
        for s, p in ti.ndrange(self.scenarios, self.parameters.particles):
            self.prepare(s, p)
            self.p2g(s, p)
        ti.loop_config(parallelize=self.threads)
        for s, i, j in ti.ndrange(self.scenarios, nodes, nodes):
            self.update(s, i, j)
        ti.loop_config(parallelize=self.threads)
        for s, p in ti.ndrange(self.scenarios, self.parameters.particles):
            self.g2p(s, p)
            self.flow(s, p)

    @ti.kernel
    def restart_extremes(self) -> Nothing:
        """Start an advance: the extremes are those of the present state."""
        for s, p in self.extremes:
            v, jacobian = self.v[s, p], self.volume(s, p)
            speed = largest_of(ti.abs(v[0]), ti.abs(v[1]))
            self.extremes[s, p] = ti.Vector([speed, jacobian, jacobian, 0.0])


@ti.func
def largest_of(a: ti.f32, b: ti.f32) -> ti.f32:
    """Return the larger of two positive values, :data:`_HUGE` if either is not a number."""
    return larger(ti.select(a < _HUGE, a, _HUGE), ti.select(b < _HUGE, b, _HUGE))
