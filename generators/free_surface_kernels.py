"""What the kernels of free surfaces have in common in the plane and in space.

That is the constants, rounded once, and the fields that drivers read. The kernels stand
in :mod:`.particle_stress` and :mod:`.particle_stress_3d`.
"""

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from . import backend
from .constitutive import lame, larger
from .language import f32, i32, ti, vec4
from .split import FreeSurfaceParameters, Material
from .transfer import Value, bounded, fixed_point_scale

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
        self.particles = p.particles
        self.solid = True  # whether some particles are no liquid
        self.inv_dx = float(p.grid)
        self.dx = 1.0 / p.grid
        self.dt = p.dt
        self.width = p.grid + 1  # nodes along an axis
        self.node_count = self.width**self.dimension
        self.low = p.wall
        self.high = p.grid - p.wall
        # smallest and largest coordinate of a particle
        lowest_place = self.low + _INSET  # [cells]
        highest_place = self.high - _INSET
        self.position_min = lowest_place * self.dx
        self.position_max = highest_place * self.dx
        self.speed_bound = self.dx / p.dt  # the CFL bound dx/dt [length/s]
        # of abs(v) + abs(A o), what sums have room for
        self.reach_bound = self.reach * self.speed_bound
        jacobian_bound = max(1.0, p.jacobian_max)
        self.velocity_scale = fixed_point_scale(p.particles, self.reach_bound)
        self.count_scale = fixed_point_scale(p.particles, jacobian_bound)
        self.velocity_unit = 1.0 / self.velocity_scale
        self.count_unit = 1.0 / self.count_scale
        four_dt = 4.0 * p.dt
        four_dt_per_cell = four_dt * p.grid  # 4 dt / dx
        self.stress_factor = four_dt_per_cell / p.density  # 4 dt / (rho dx)
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
        self.slopes = [vec4.field() for _ in range(self.dimension)]
        # Material, J of liquid or plastic Jp of snow (1 in other solids), and the
        # smallest and largest that this was since the start
        self.matter = vec4.field()
        # largest speed, smallest and largest J, largest abs(v) + abs(A o) since the
        # advance began
        self.extremes = vec4.field()
        # of each scenario: m / (rho dx^d), and Coulomb friction of the walls
        self.particle_volume = ti.field(f32)
        self.friction = ti.field(f32)

    def _place_fields(self) -> None:
        """Give the fields their memory, each an array of its own."""
        particle_shape = (self.scenarios, self.particles)
        node_shape = (self.scenarios, self.node_count)
        # Two more: a node counts the rows of the two nodes before it as well.
        row_count = self.node_count + 2
        row_shape = (self.scenarios, row_count)
        particle_fields = (
            self.x,
            self.particle_state,
            *self.slopes,
            *self._particle_fields(),
            self.matter,
            self.extremes,
        )
        scenario_shape = (self.scenarios,)
        scenario_fields = (self.particle_volume, self.friction)
        backend.place(
            (particle_shape, particle_fields),
            (node_shape, self._node_fields()),
            (row_shape, self._row_fields()),
            (scenario_shape, scenario_fields),
        )

    def sort_by_material(self, material: NDArray[np.int32]) -> None:
        """Note whether there are solids.

        Args:
            material: Material of each particle, shape [scenario, particle].
        """
        self.solid = bool((material != LIQUID).any())

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
    def touched_nodes(self, particles: i32) -> Value:
        """Return the first node that particles of scenario 0 touch along each axis, and
        the one behind the last.

        A node next to a wall counts its image, which no particle need touch.
        """
        first = ti.Vector([self.high] * self.dimension)
        end = ti.Vector([0] * self.dimension)
        for p in range(particles):
            x = self.x[0, p]
            for axis in ti.static(range(self.dimension)):
                coordinate = x[axis]
                base = ti.cast(coordinate * self.inv_dx - 0.5, i32)
                particle_end = base + 3
                old_first = first[axis]
                old_end = end[axis]
                first[axis] = ti.min(old_first, base)
                end[axis] = ti.max(old_end, particle_end)

        low_image = self.low - 1
        next_to_low = self.low + 1
        high_end = self.high + 2
        for axis in ti.static(range(self.dimension)):
            axis_first = first[axis]
            axis_end = end[axis]
            if axis_first <= next_to_low:
                first[axis] = low_image
            if axis_end >= self.high:
                end[axis] = high_end
        return first, end

    @ti.func
    def image(self, index: i32) -> i32:
        """Return the mirror image of a node within a cell of a wall, else -1."""
        mirrored = -1
        next_to_low = self.low + 1
        next_to_high = self.high - 1
        if index <= next_to_low:
            mirrored = 2 * self.low - index
        if index >= next_to_high:
            mirrored = 2 * self.high - index
        return mirrored

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
        density = larger(grid_density, 1.0)
        volume = 1.0 / density
        jacobian = old_jacobian + self.dt * divergence * old_jacobian

        lag = grid_jacobian - old_jacobian
        jacobian += self.parameters.jacobian_relaxation * lag

        jacobian += self.parameters.density_coupling * (volume - jacobian)
        jacobian_min = self.parameters.jacobian_min
        jacobian_max = self.parameters.jacobian_max
        return bounded(jacobian, jacobian_min, jacobian_max)

    @ti.func
    def is_outward(self, index: i32, normal: f32) -> Value:
        """Tell whether a node at a wall, or behind it, moves out of the box."""
        leaves_low = index <= self.low and normal < 0.0
        leaves_high = index >= self.high and normal > 0.0
        return leaves_low or leaves_high


@ti.func
def finite(value: f32) -> f32:
    """Return a positive value, or :data:`_HUGE` if it is not a finite number."""
    return ti.select(value < _HUGE, value, _HUGE)


@ti.func
def largest_of(a: f32, b: f32) -> f32:
    """Return the larger of two positive values.

    It is :data:`_HUGE` if either is not a number.
    """
    finite_a = finite(a)
    finite_b = finite(b)
    return larger(finite_a, finite_b)
