"""What the kernels of free surfaces have in common in the plane and in space.

That is the constants, rounded once, and the fields that drivers read. The kernels stand
in :mod:`.particle_stress` and :mod:`.particle_stress_3d`.
"""

from typing import ClassVar

import taichi as ti

from . import backend
from .constitutive import lame, larger
from .split import FreeSurfaceParameters, Material
from .transfer import Value, fixed_point_scale

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
    # what a particle at rest spreads, shape [4]
    at_rest: ClassVar[tuple[float, float, float, float]]

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
        self.solid = True  # whether some particles are no liquid
        self.inv_dx = float(p.grid)
        self.dx = 1.0 / p.grid
        self.dt = p.dt
        self.width = p.grid + 1  # nodes along an axis
        self.node_count = self.width**self.dimension
        self.low = p.wall
        self.high = p.grid - p.wall
        # smallest and largest coordinate of a particle
        self.least = (self.low + _INSET) * self.dx
        self.most = (self.high - _INSET) * self.dx
        self.speed_bound = self.dx / p.dt  # the CFL bound dx/dt [length/s]
        # of abs(v) + abs(A o), what sums have room for
        self.reach_bound = self.reach * self.speed_bound
        self.velocity_scale = fixed_point_scale(p.particles, self.reach_bound)
        self.count_scale = fixed_point_scale(p.particles, max(1.0, p.jacobian_max))
        self.velocity_unit = 1.0 / self.velocity_scale
        self.count_unit = 1.0 / self.count_scale
        self.impulse = 4.0 * p.dt * p.grid / p.density
        self.fall = p.gravity * p.dt
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
        # particle positions [length], filled up with zeros
        self.x = ti.Vector.field(4, ti.f32)
        self.carried = ti.Vector.field(4, ti.f32)  # what P2G spreads, v_p first
        # derivative along each axis of what nodes hold, v first, at the particles:
        # columns of C
        self.slopes = [ti.Vector.field(4, ti.f32) for _ in range(self.dimension)]
        # Material, J of liquid or plastic Jp of snow (1 in other solids), and the
        # smallest and largest that this was since the start
        self.matter = ti.Vector.field(4, ti.f32)
        # largest speed, smallest and largest J, largest abs(v) + abs(A o) since the
        # advance began
        self.extremes = ti.Vector.field(4, ti.f32)
        self.fill = ti.field(ti.f32)  # m / (rho dx^d), shape [scenario]
        # Coulomb friction of the walls, shape [scenario]
        self.friction = ti.field(ti.f32)

    def _place_fields(self) -> None:
        """Give the fields their memory, each an array of its own."""
        particle_shape = (self.scenarios, self.parameters.particles)
        node_shape = (self.scenarios, self.node_count)
        # Two more: a node counts the rows of the two nodes before it as well.
        row_shape = (self.scenarios, self.node_count + 2)
        particle_fields = (
            self.x,
            self.carried,
            *self.slopes,
            *self._particle_fields(),
            self.matter,
            self.extremes,
        )
        backend.place(
            *((particle_shape, [field]) for field in particle_fields),
            *((node_shape, [field]) for field in self._node_fields()),
            *((row_shape, [field]) for field in self._row_fields()),
            ((self.scenarios,), [self.fill, self.friction]),
        )

    def run_serially(self, substeps: int) -> None:
        """Advance scenario 0 by many substeps in one thread, on the nodes that
        particles touch.
        """
        raise NotImplementedError

    def run_in_parallel(self) -> None:
        """Advance every scenario by one substep: one launch per phase."""
        raise NotImplementedError

    def restart_extremes(self) -> None:
        """Start an advance: the extremes are those of the present state."""
        raise NotImplementedError

    def _particle_fields(self) -> tuple[ti.Field, ...]:
        """Return the fields of particles that this dimension adds."""
        raise NotImplementedError

    def _node_fields(self) -> tuple[ti.Field, ...]:
        """Return the fields of nodes."""
        raise NotImplementedError

    def _row_fields(self) -> tuple[ti.Field, ...]:
        """Return the fields of rows of three nodes."""
        return ()

    @ti.func
    def touched_nodes(self, particles: ti.i32) -> Value:
        """Return the first node that particles of scenario 0 touch along each axis, and
        the one behind the last.

        A node next to a wall counts its image, which no particle need touch.
        """
        first = ti.Vector([self.high for _ in range(self.dimension)])
        last = ti.Vector([0 for _ in range(self.dimension)])
        for p in range(particles):
            for axis in ti.static(range(self.dimension)):
                base = ti.cast(self.x[0, p][axis] * self.inv_dx - 0.5, ti.i32)
                first[axis] = ti.min(first[axis], base)
                last[axis] = ti.max(last[axis], base + 3)
        for axis in ti.static(range(self.dimension)):
            if first[axis] <= self.low + 1:
                first[axis] = self.low - 1
            if last[axis] >= self.high:
                last[axis] = self.high + 2
        return first, last

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
    def is_outward(self, index: ti.i32, normal: ti.f32) -> Value:
        """Tell whether a node at a wall, or behind it, moves out of the box."""
        return (index <= self.low and normal < 0.0) or (
            index >= self.high and normal > 0.0
        )


@ti.func
def finite(value: ti.f32) -> ti.f32:
    """Return a positive value, or :data:`_HUGE` if it is not a finite number."""
    return ti.select(value < _HUGE, value, _HUGE)


@ti.func
def largest_of(a: ti.f32, b: ti.f32) -> ti.f32:
    """Return the larger of two positive values.

    It is :data:`_HUGE` if either is not a number.
    """
    return larger(finite(a), finite(b))
