"""What the kernels of free surfaces have in common in the plane and in space.

That is the constants, rounded once, and the fields that drivers read. The kernels stand
in :mod:`.particle_stress` and :mod:`.particle_stress_3d`.
"""

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from . import backend
from .constitutive import hardening, lame, larger
from .language import f32, i32, i64, ti, vec4
from .split import FreeSurfaceParameters, Material
from .transfer import Nothing, Template, Value, bounded, fixed_point_scale

LIQUID = int(Material.LIQUID)
SNOW = int(Material.SNOW)
ROPE = int(Material.ROPE)

_INSET = 1e-3  # distance that particles keep from a wall [cells]
_HUGE = 3e38  # stands for what is not a number where extremes are kept


class FreeSurfaceKernels:
    """Constants and fields of a batch of scenarios in the plane or in space."""

    dimension: ClassVar[int]  # number of axes
    # bound of abs(v_p + A o) over dx/dt, the largest speed [1]
    reach: ClassVar[float]
    # what a particle at rest spreads, shape [4]: J, or 1 in solids, last
    at_rest: ClassVar[tuple[float, float, float, float]]
    lanes: ClassVar[int]  # numbers of a node

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
        self.particles = p.particles
        self.solid = True  # whether some particles are no liquid
        self.inv_dx = float(p.grid)
        self.dx = 1.0 / p.grid
        self.dt = p.dt
        self.width = p.grid + 1  # nodes along an axis
        self.node_count = self.width**self.dimension
        self.axes = tuple(range(self.dimension))
        self.low = p.wall
        self.high = p.grid - p.wall
        # smallest and largest coordinate of a particle
        self.position_min = (self.low + _INSET) * self.dx
        self.position_max = (self.high - _INSET) * self.dx
        self.speed_bound = self.dx / p.dt  # the CFL bound dx/dt [length/s]
        # of abs(v) + abs(A o), what sums have room for
        self.reach_bound = self.reach * self.speed_bound
        jacobian_bound = max(1.0, p.jacobian_max)
        self.velocity_scale = fixed_point_scale(p.particles, self.reach_bound)
        self.count_scale = fixed_point_scale(p.particles, jacobian_bound)
        self.velocity_unit = 1.0 / self.velocity_scale
        self.count_unit = 1.0 / self.count_scale
        self.stress_factor = 4.0 * p.dt * p.grid / p.density  # 4 dt / (rho dx)
        self.gravity_gain = p.gravity * p.dt  # dt g
        self.liquid_viscosity = p.density * p.liquid_viscosity
        self.solid_viscosity = p.density * p.elastic_damping
        self.jelly = lame(p.jelly_modulus, p.jelly_poisson)
        self.rope = lame(p.rope_modulus, p.rope_poisson)
        self.snow = lame(p.snow_modulus, p.snow_poisson)
        self.yield_low = 1.0 - p.snow_compression
        self.yield_high = 1.0 + p.snow_stretch
        self._declare_fields()
        self._place_fields()

    def _declare_fields(self) -> None:
        """Name the fields; they have no memory yet."""
        # of each particle: its position [length], filled up with zeros
        self.x = vec4.field()
        # what P2G spreads, v_p first
        self.particle_state = vec4.field()
        # derivative along each axis of what nodes hold, v first, at the particle:
        # columns of C
        self.slopes = self._columns()
        # columns of the deformation gradient of a solid [1], filled up with zeros
        self.deformation_columns = self._columns()
        # columns of A times velocity_scale, filled up with zeros
        self.momentum_slopes = self._columns()
        # what nodes hold, at the particle
        self.grid_state = ti.Vector.field(self.lanes, f32)
        # Material, J of liquid or plastic Jp of snow (1 in other solids), and the
        # smallest and largest that this was since the start
        self.matter = vec4.field()
        # largest speed, smallest and largest J, largest abs(v) + abs(A o) since the
        # advance began
        self.extremes = vec4.field()
        # of each node: fixed-point sums, and v, Jbar, r
        self.sums = ti.Vector.field(4, i64)
        self.node_state = ti.Vector.field(self.lanes, f32)
        # of each scenario: m / (rho dx^d), and Coulomb friction of the walls
        self.particle_volume = ti.field(f32)
        self.friction = ti.field(f32)

    def _columns(self) -> list[ti.Field]:
        """Return a field of vectors of four for each axis."""
        return [vec4.field() for _ in self.axes]

    def _place_fields(self) -> None:
        """Give the fields their memory, each an array of its own."""
        particle_fields = (
            self.x,
            self.particle_state,
            *self.slopes,
            *self.deformation_columns,
            *self.momentum_slopes,
            self.grid_state,
            *self._particle_fields(),
            self.matter,
            self.extremes,
        )
        backend.place(
            ((self.scenarios, self.particles), particle_fields),
            ((self.scenarios, self.node_count), (self.sums, self.node_state)),
            ((self.scenarios,), (self.particle_volume, self.friction)),
        )

    def sort_by_material(self, material: NDArray[np.int32]) -> None:
        """Note whether there are solids.

        Args:
            material: Material of each particle, shape [scenario, particle].
        """
        self.solid = bool((material != LIQUID).any())

    def _particle_fields(self) -> tuple[ti.Field, ...]:
        """Return the fields of particles that this dimension adds."""
        raise NotImplementedError

    def run_serially(self, substeps: int) -> None:
        """Advance scenario 0 by many substeps in one thread, on the nodes that
        particles touch.
        """
        raise NotImplementedError

    def run_in_parallel(self) -> None:
        """Advance every scenario by one substep: one launch per phase."""
        raise NotImplementedError

    def determinant(self, s: i32, p: i32) -> f32:
        """Return det F of a particle."""
        raise NotImplementedError

    def divergence(self, s: i32, p: i32) -> f32:
        """Return tr C of a particle."""
        raise NotImplementedError

    @ti.kernel
    def restart_extremes(self) -> Nothing:
        """Start an advance: the extremes are those of the present state.

        The largest abs(v) + abs(A o) is 0 until a particle moves.
        """
        particles = ti.static(self.particles)
        scenarios = ti.static(self.scenarios)
        is_serial = ti.static(not self.atomic)
        ti.loop_config(serialize=is_serial)
        for s, p in ti.ndrange(scenarios, particles):
            jacobian = self.matter[s, p][1]
            if self.matter[s, p][0] != LIQUID:
                jacobian = self.determinant(s, p)
            self.extremes[s, p] = vec4(0.0, jacobian, jacobian, 0.0)
            self.keep_speed(s, p)

    @ti.func
    def touched_nodes(self, particles: i32) -> Value:
        """Return the first node that particles of scenario 0 touch along each axis, and
        the one behind the last.

        A node next to a wall counts its image, which no particle need touch.
        """
        first = ti.Vector([self.high] * self.dimension)
        end = ti.Vector([0] * self.dimension)
        for p in range(particles):
            x = self.x[0, p]
            for axis in ti.static(self.axes):
                base = ti.cast(x[axis] * self.inv_dx - 0.5, i32)
                first[axis] = ti.min(first[axis], base)
                end[axis] = ti.max(end[axis], base + 3)

        for axis in ti.static(self.axes):
            if first[axis] <= self.low + 1:
                first[axis] = self.low - 1
            if end[axis] >= self.high:
                end[axis] = self.high + 2
        return first, end

    @ti.func
    def image(self, index: i32) -> i32:
        """Return the mirror image of a node within a cell of a wall, else -1."""
        mirrored = -1
        if index <= self.low + 1:
            mirrored = 2 * self.low - index
        if index >= self.high - 1:
            mirrored = 2 * self.high - index
        return mirrored

    @ti.func
    def moduli(self, s: i32, p: i32) -> Value:
        """Return Lame's constants mu and lambda of a solid."""
        matter = self.matter[s, p]
        mu, la = self.jelly
        if matter[0] == ROPE:
            mu, la = self.rope
        if matter[0] == SNOW:
            factor = hardening(
                matter[1],
                self.parameters.snow_hardening,
                self.parameters.snow_hardening_min,
                self.parameters.snow_hardening_max,
            )
            snow_mu, snow_la = self.snow
            mu = snow_mu * factor
            la = snow_la * factor
        return mu, la

    @ti.func
    def viscosity(self, s: i32, p: i32, solid: Template) -> f32:
        """Return the dynamic viscosity of a liquid, or the damping of a solid."""
        viscosity = self.liquid_viscosity
        if ti.static(solid):
            kind = self.matter[s, p][0]
            damping = ti.select(kind == SNOW, 0.0, self.solid_viscosity)
            viscosity = ti.select(kind == LIQUID, self.liquid_viscosity, damping)
        return viscosity

    @ti.func
    def keep_node_speed(self, s: i32, p: i32, affine_speed: Value) -> None:
        """Keep the largest speed that a particle gives to a node in this advance.

        Args:
            s: scenario.
            p: particle.
            affine_speed: bound of the speed that A adds along each axis [length/s].
        """
        speed = ti.abs(self.particle_state[s, p])
        extremes = self.extremes[s, p]
        largest = extremes[3]
        for axis in ti.static(self.axes):
            largest = larger(finite(speed[axis] + affine_speed[axis]), largest)
        extremes[3] = largest
        self.extremes[s, p] = extremes

    @ti.func
    def contact(
        self, index: i32, axis: Template, velocity: Value, friction: f32
    ) -> Value:
        """Return the velocity of a node after contact with one of two opposite walls.

        Args:
            index: place of the node along the normal of the walls.
            axis: that of the normal.
            velocity: that of the node.
            friction: Coulomb's coefficient of the walls.
        """
        normal = velocity[axis]
        new_velocity = velocity
        leaves_low = index <= self.low and normal < 0.0
        leaves_high = index >= self.high and normal > 0.0
        if leaves_low or leaves_high:
            square = 0.0  # of the sliding speed
            for other in ti.static(self.axes):
                if ti.static(other != axis):
                    square += velocity[other] * velocity[other]
            loss = friction * ti.abs(normal) / larger(ti.sqrt(square), 1e-9)
            new_velocity = larger(1.0 - loss, 0.0) * velocity
            new_velocity[axis] = 0.0
        return new_velocity

    @ti.func
    def flow(self, s: i32, p: i32, solid: Template) -> None:
        """Move a particle with the grid's velocity, and update J of a liquid."""
        grid_state = self.grid_state[s, p]
        position = self.x[s, p]
        particle_state = self.particle_state[s, p]
        for axis in ti.static(self.axes):
            velocity = grid_state[axis]
            moved = position[axis] + self.dt * velocity
            position[axis] = bounded(moved, self.position_min, self.position_max)
            particle_state[axis] = velocity
        self.x[s, p] = position

        matter = self.matter[s, p]
        jacobian = self.liquid_jacobian(
            matter[1],
            self.divergence(s, p),
            grid_state[self.dimension],
            grid_state[self.dimension + 1],
        )
        ratio = jacobian
        particle_state[3] = jacobian
        if ti.static(solid):
            is_liquid = matter[0] == LIQUID
            ratio = ti.select(is_liquid, jacobian, matter[1])
            particle_state[3] = ti.select(is_liquid, jacobian, 1.0)
            # det F of a solid is computed later. Until then the old minimum stands for
            # it, which changes neither extreme.
            jacobian = ti.select(is_liquid, jacobian, self.extremes[s, p][1])
        self.particle_state[s, p] = particle_state
        self.store_ratio(s, p, ratio)
        self.keep_speed(s, p)
        self.keep_jacobian(s, p, jacobian)

    @ti.func
    def store_ratio(self, s: i32, p: i32, ratio: f32) -> None:
        """Store J of a liquid or Jp of snow, and its extremes since the start."""
        matter = self.matter[s, p]
        matter[1] = ratio
        matter[2] = ti.select(ratio < matter[2], ratio, matter[2])
        matter[3] = larger(ratio, matter[3])
        self.matter[s, p] = matter

    @ti.func
    def grown_plastic_ratio(self, s: i32, p: i32, growth: f32) -> f32:
        """Return Jp of a snow particle times a factor, within its limits."""
        jp_min = self.parameters.snow_jp_min
        jp_max = self.parameters.snow_jp_max
        return bounded(self.matter[s, p][1] * growth, jp_min, jp_max)

    @ti.func
    def keep_speed(self, s: i32, p: i32) -> None:
        """Keep the largest speed along an axis of a particle in this advance."""
        speed = ti.abs(self.particle_state[s, p])
        extremes = self.extremes[s, p]
        largest = extremes[0]
        for axis in ti.static(self.axes):
            largest = larger(finite(speed[axis]), largest)
        extremes[0] = largest
        self.extremes[s, p] = extremes

    @ti.func
    def keep_jacobian(self, s: i32, p: i32, jacobian: f32) -> None:
        """Keep the smallest and largest J or det F of a particle in this advance."""
        extremes = self.extremes[s, p]
        extremes[1] = ti.select(jacobian < extremes[1], jacobian, extremes[1])
        extremes[2] = larger(jacobian, extremes[2])
        self.extremes[s, p] = extremes

    @ti.func
    def liquid_jacobian(
        self,
        old_jacobian: f32,
        divergence: f32,
        grid_jacobian: f32,
        grid_density: f32,
    ) -> f32:
        """Return J of a liquid after a substep.

        It follows the flow, and is drawn towards J and the density of the grid.
        """
        volume = 1.0 / larger(grid_density, 1.0)
        jacobian = old_jacobian + self.dt * divergence * old_jacobian
        lag = grid_jacobian - old_jacobian
        jacobian += self.parameters.jacobian_relaxation * lag
        jacobian += self.parameters.density_coupling * (volume - jacobian)
        return bounded(
            jacobian, self.parameters.jacobian_min, self.parameters.jacobian_max
        )


@ti.func
def finite(value: f32) -> f32:
    """Return a positive value, or :data:`_HUGE` if it is not a finite number."""
    return ti.select(value < _HUGE, value, _HUGE)
