"""One substep of MLS-MPM with a free surface in three dimensions.

The equations are those of :mod:`.particle_stress`, in a cube; the relative density is
r_i = n_i m / (rho dx^3). The stresses of solids stand in :mod:`.constitutive_3d`. Where
a wall is rough, Coulomb friction brakes both tangential components alike. The second
axis points up.

Only ``+ - * /``, ``sqrt`` and comparisons are used, and sums are integers
(:mod:`.transfer`): no order of particles or threads changes a bit.

Source: Hu et al. 2018; Jiang et al. 2015 (APIC).
"""

import itertools
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import backend
from .constitutive import liquid_stress
from .constitutive_3d import (
    corotated_stress,
    determinant,
    follow_flow,
    plastic_return,
    rows_of,
)
from .free_surface_kernels import LIQUID, SNOW, FreeSurfaceKernels
from .language import f32, i32, i64, mat3, ti, vec3, vec4
from .transfer import (
    Nothing,
    Template,
    Value,
    add_shifted,
    from_fixed,
    node_number,
    row_count,
    spline_weights,
    stepped,
)

_AXES = (0, 1, 2)
_ENTRIES = tuple(range(6))  # of a symmetric matrix, in Voigt's order

# nodes of a stencil along one axis
_NODES = (0, 1, 2)
# rows of a stencil along the third axis, by their nodes along the other two
_ROWS = tuple(itertools.product(_NODES, repeat=2))
# row and column of each entry of a matrix
_PLACES = tuple(itertools.product(_AXES, repeat=2))
# a node and its seven mirror images, by what is mirrored along each axis
_SIDES = tuple(itertools.product((0, 1), repeat=3))
# numbers of a node whose slopes G2P computes: v and Jbar
_SLOPED = (0, 1, 2, 3)

# The serial driver computes solids in blocks of this many particles, one in each lane
# of a vector register. LLVM makes vector instructions only if a loop reads its lanes
# from memory and writes them to memory. Therefore each quantity of the solids, such as
# an entry of F, has a list with one place for each solid. One loop copies to a list
# what other phases computed, a second one computes block by block, and a third one
# copies the results back. F stays in its lists during an advance.
_LANES = 8
_LANE_NUMBERS = tuple(range(_LANES))


@ti.data_oriented
class ParticleStress3D(FreeSurfaceKernels):
    """Fields of a batch of scenarios and the kernels that advance them.

    ``particle_state`` is v, and J of a liquid or 1. ``slopes`` are derivatives of v and
    Jbar. Nodes hold v, Jbar, r and three zeros: G2P reads all of them from one address.
    """

    dimension = 3
    reach = 128.0  # twice that of the plane
    at_rest = (0.0, 0.0, 0.0, 1.0)
    lanes = 8

    def _particle_fields(self) -> tuple[ti.Field, ...]:
        # the three weights along each axis; the fourth entry is 0
        self.weights = self._columns()
        # offset from the middle node of the stencil [cells]; the fourth entry has the
        # bits of the number of the lowest node
        self.stencil_place = vec4.field()
        # slopes of v and Jbar of the nodes at the particle: along x, then along y
        self.grid_slopes = ti.Vector.field(8, f32)
        # Kirchhoff stress of a solid without damping [mass/(length s^2)]: entries xx,
        # yy and zz; entries yz, xz and xy; the fourth entries are 0
        self.elastic_diagonal = vec4.field()
        self.elastic_off_diagonal = vec4.field()
        return (
            *self.weights,
            self.stencil_place,
            self.grid_slopes,
            self.elastic_diagonal,
            self.elastic_off_diagonal,
        )

    def _place_fields(self) -> None:
        """Give the fields their memory, each an array of its own."""
        super()._place_fields()
        # n of each row of three nodes along the third axis, at its last node. Two more:
        # a node counts the rows of the two nodes before it as well.
        self.row_sums = ti.Vector.field(4, i64)
        row_shape = (self.scenarios, self.node_count + 2)
        # the solids of scenario 0, snow first
        self.solids = ti.field(i32)
        # at the place of a solid in this list: entries of F [1] and of C [1/s], Lame's
        # constants mu and lambda [mass/(length s^2)], entries of the Kirchhoff stress
        # without damping [mass/(length s^2)], the factor on Jp [1], and det F [1]
        self.listed_gradient = [_number_fields(3) for _ in _AXES]
        self.listed_slopes = [_number_fields(3) for _ in _AXES]
        self.listed_moduli = _number_fields(2)
        self.listed_stress = _number_fields(6)
        self.listed_growth = ti.field(f32)
        self.listed_jacobian = ti.field(f32)
        list_length = _LANES * math.ceil(self.particles / _LANES)
        listed = (
            self.solids,
            *itertools.chain(*self.listed_gradient, *self.listed_slopes),
            *self.listed_moduli,
            *self.listed_stress,
            self.listed_growth,
            self.listed_jacobian,
        )
        backend.place((row_shape, (self.row_sums,)), ((list_length,), listed))

    def sort_by_material(self, material: NDArray[np.int32]) -> None:
        """Note whether there are solids, and list those of scenario 0.

        Args:
            material: Material of each particle, shape [scenario, particle].
        """
        super().sort_by_material(material)
        is_snow = material[0] == SNOW
        snow = np.flatnonzero(is_snow)
        other_solids = np.flatnonzero((material[0] != LIQUID) & ~is_snow)
        solids = np.concatenate([snow, other_solids])
        self.snow_count = len(snow)
        self.solid_count = len(solids)
        # the list has room for all particles
        numbers = np.zeros(self.solids.shape, np.int32)
        numbers[: self.solid_count] = solids
        self.solids.from_numpy(numbers)

    # The phases: each function is one phase at one particle or node.

    @ti.func
    def at(self, i: i32, j: i32, k: i32) -> i32:
        """Return the number of a node."""
        return (i * self.width + j) * self.width + k

    @ti.func
    def clear(self, s: i32, n: i32) -> None:
        """Set the sums of a node to zero, before P2G adds to them."""
        self.sums[s, n] = ti.Vector.zero(i64, 4)

    @ti.func
    def clear_row(self, s: i32, n: i32) -> None:
        """Set the sums of a row of three nodes to zero; ``n`` is the last of them."""
        self.row_sums[s, n] = ti.Vector.zero(i64, 4)

    @ti.func
    def locate(self, s: i32, p: i32) -> None:
        """Store the stencil of a particle for P2G and G2P: its nodes and weights."""
        x = self.x[s, p]
        number = 0
        offset = vec3(0.0)
        for axis in ti.static(_AXES):
            scaled = x[axis] * self.inv_dx
            lowest = ti.cast(scaled - 0.5, i32)
            f = scaled - ti.cast(lowest, f32)
            low, mid, high = spline_weights(f)
            self.weights[axis][s, p] = vec4(low, mid, high, 0.0)
            offset[axis] = f - 1.0
            number = number * self.width + lowest
        self.stencil_place[s, p] = vec4(offset, ti.bit_cast(number, f32))

    @ti.func
    def row_start(self, lowest: i32, i: Template, j: Template) -> i32:
        """Return the number of the first node of a row of a particle's stencil."""
        return lowest + (i * self.width + j) * self.width

    @ti.func
    def velocity_gradient(self, s: i32, p: i32) -> mat3:
        """Return C of a particle."""
        return self.matrix(self.slopes, s, p)

    @ti.func
    def deformation(self, s: i32, p: i32) -> mat3:
        """Return F of a particle."""
        return self.matrix(self.deformation_columns, s, p)

    @ti.func
    def matrix(self, columns: Template, s: i32, p: i32) -> mat3:
        """Return the matrix with a particle's columns, without fourth entries."""
        x = columns[0][s, p]
        y = columns[1][s, p]
        z = columns[2][s, p]
        return mat3([x.x, y.x, z.x], [x.y, y.y, z.y], [x.z, y.z, z.z])

    @ti.func
    def determinant(self, s: i32, p: i32) -> f32:
        """Return det F of a particle."""
        return determinant(rows_of(self.deformation(s, p)))

    @ti.func
    def divergence(self, s: i32, p: i32) -> f32:
        """Separate the slopes along x from those along y, and return tr C."""
        slopes_xy = self.grid_slopes[s, p]
        slope_x = slopes_xy[:4]
        slope_y = slopes_xy[4:]
        slope_z = self.slopes[2][s, p]
        self.slopes[0][s, p] = slope_x
        self.slopes[1][s, p] = slope_y
        return slope_x[0] + slope_y[1] + slope_z[2]

    @ti.func
    def store_elastic_stress(self, s: i32, p: i32, stress: Template) -> None:
        """Store the Kirchhoff stress of a solid without damping."""
        xx, yy, zz, yz, xz, xy = stress
        self.elastic_diagonal[s, p] = vec4(xx, yy, zz, 0.0)
        self.elastic_off_diagonal[s, p] = vec4(yz, xz, xy, 0.0)

    @ti.func
    def compute_elastic_stress(self, s: i32, p: i32) -> None:
        """Compute the Kirchhoff stress of a solid without damping."""
        mu, la = self.moduli(s, p)
        stress = corotated_stress(rows_of(self.deformation(s, p)), mu, la)
        self.store_elastic_stress(s, p, stress)

    @ti.func
    def copy_moduli_to_list(self, number: i32) -> None:
        """Copy Lame's constants of a solid to its place in the list of solids."""
        moduli = self.moduli(0, self.solids[number])
        for entry in ti.static(range(2)):
            self.listed_moduli[entry][number] = moduli[entry]

    @ti.func
    def compute_listed_stress(self, block: i32) -> None:
        """Compute the Kirchhoff stress of a block of solids without damping."""
        mu = load_lanes(self.listed_moduli[0], block)
        la = load_lanes(self.listed_moduli[1], block)
        rows = load_rows(self.listed_gradient, block)
        stress = corotated_stress(rows, mu, la)
        for entry in ti.static(_ENTRIES):
            store_lanes(self.listed_stress[entry], block, stress[entry])

    @ti.func
    def copy_stress_from_list(self, number: i32) -> None:
        """Copy the stress of a solid from the list of solids to the particle."""
        stress = [field[number] for field in ti.static(self.listed_stress)]
        self.store_elastic_stress(0, self.solids[number], stress)

    @ti.func
    def stress(self, s: i32, p: i32, solid: Template) -> None:
        """Compute A of a particle, and a bound of the speeds that it gives to nodes."""
        spread_jacobian = self.particle_state[s, p][3]
        modulus = self.parameters.liquid_modulus
        c = self.velocity_gradient(s, p)
        viscosity = self.viscosity(s, p, solid)
        diagonal = vec4(liquid_stress(spread_jacobian, modulus))
        off_diagonal = vec4(0.0)  # entries yz, xz and xy
        if ti.static(solid):
            # Selections instead of branches: LLVM makes vector instructions.
            is_liquid = self.matter[s, p][0] == LIQUID
            elastic_diagonal = self.elastic_diagonal[s, p]
            elastic_off_diagonal = self.elastic_off_diagonal[s, p]
            diagonal = ti.select(is_liquid, diagonal, elastic_diagonal)
            off_diagonal = ti.select(is_liquid, off_diagonal, elastic_off_diagonal)

        # A node lies within 1.5 cells of the particle along each axis. This bounds the
        # speed that A adds at the node, along each axis.
        affine_speed = vec3(0.0)
        for column in ti.static(_AXES):
            a = vec4(0.0)
            for row in ti.static(_AXES):
                tau = viscosity * (c[row, column] + c[column, row])
                if ti.static(row == column):
                    tau = tau + diagonal[row]
                elif ti.static(solid):
                    tau = tau + off_diagonal[3 - row - column]
                a[row] = self.dx * c[row, column] - self.stress_factor * tau
            affine_speed = affine_speed + 1.5 * ti.abs(a.xyz)
            self.momentum_slopes[column][s, p] = self.velocity_scale * a
        self.keep_node_speed(s, p, affine_speed)

    @ti.func
    def p2g(self, s: i32, p: i32) -> None:
        """Add n v, n J and n of a particle to the nodes of its stencil.

        What a node gets is linear in its place. So it is computed at the middle node,
        and then stepped to the neighbours, dx away.
        """
        place = self.stencil_place[s, p]
        lowest = node_number(place[3], self.node_count)
        step_x = self.momentum_slopes[0][s, p]
        step_y = self.momentum_slopes[1][s, p]
        step_z = self.momentum_slopes[2][s, p]
        scale = vec4(
            self.velocity_scale,
            self.velocity_scale,
            self.velocity_scale,
            self.count_scale,
        )
        at_middle = scale * self.particle_state[s, p] - place.x * step_x
        at_middle = at_middle - place.y * step_y - place.z * step_z

        weight_x = self.weights[0][s, p]
        weight_y = self.weights[1][s, p]
        weight_z = self.weights[2][s, p]
        for i, j in ti.static(_ROWS):
            weights = weight_x[i] * weight_y[j] * weight_z
            at_row = stepped(stepped(at_middle, step_x, i - 1), step_y, j - 1)
            start = self.row_start(lowest, i, j)
            for k in ti.static(_NODES):
                share = weights[k] * stepped(at_row, step_z, k - 1)
                add_shifted(self.sums, s, start + k, share, self.atomic)
            # The fourth weight is 0, so that the fourth sum counts shifts.
            counts = self.count_scale * weights
            add_shifted(self.row_sums, s, start + 2, counts, self.atomic)

    @ti.func
    def update(
        self, s: i32, i: i32, j: i32, k: i32, particle_volume: f32, friction: f32
    ) -> None:
        """Compute v, Jbar and r of a node from its sums, with gravity and walls.

        A node without particles is at rest.
        """
        node = self.at(i, j, k)
        velocity = vec3(0.0)
        jacobian = 1.0
        density = 0.0
        weight_sum, shifts = row_count(self.row_sums, s, node)
        if weight_sum > 0:
            count = from_fixed(weight_sum, self.count_unit)
            total = self.sums[s, node] - shifts
            jacobian = from_fixed(total[3], self.count_unit) / count
            velocity = from_fixed(total, self.velocity_unit).xyz / count
            velocity[1] -= self.gravity_gain
            velocity = self.contact(i, 0, velocity, friction)
            velocity = self.contact(j, 1, velocity, friction)
            velocity = self.contact(k, 2, velocity, friction)
            mirrored_sum = self.mirrored_count(s, i, j, k)
            density = from_fixed(mirrored_sum, self.count_unit) * particle_volume
        state = ti.Vector.zero(f32, 8)
        for axis in ti.static(_AXES):
            state[axis] = velocity[axis]
        state[3] = jacobian
        state[4] = density
        self.node_state[s, node] = state

    @ti.func
    def mirrored_count(self, s: i32, i: i32, j: i32, k: i32) -> i64:
        """Return n of a node plus n of its mirror images.

        Particles lie on one side of a wall only: without its images a node on a wall
        would count half a cell, and a node in a corner an eighth.
        """
        places_i = [i, self.image(i)]
        places_j = [j, self.image(j)]
        places_k = [k, self.image(k)]
        count = i64(0)
        for a, b, c in ti.static(_SIDES):
            if places_i[a] >= 0 and places_j[b] >= 0 and places_k[c] >= 0:
                node = self.at(places_i[a], places_j[b], places_k[c])
                weight_sum, _ = row_count(self.row_sums, s, node)
                count += weight_sum
        return count

    @ti.func
    def g2p(self, s: i32, p: i32) -> None:
        """Interpolate v, Jbar and r of the nodes at a particle, and the slopes of v.

        A vector register takes eight numbers. So all numbers of a node are one vector,
        and the slopes along x and along y are one. :meth:`divergence` separates them.
        """
        place = self.stencil_place[s, p]
        lowest = node_number(place[3], self.node_count)
        weight_x = self.weights[0][s, p]
        weight_y = self.weights[1][s, p]
        weight_z = self.weights[2][s, p]
        state = ti.Vector.zero(f32, 8)
        # first moments of v and Jbar about the particle [cells]: x, then y
        moments_xy = ti.Vector.zero(f32, 8)
        moments_z = vec4(0.0)
        for i, j in ti.static(_ROWS):
            across = weight_x[i] * weight_y[j]
            start = self.row_start(lowest, i, j)
            distance_x = i - 1.0 - place.x
            distance_y = j - 1.0 - place.y
            for k in ti.static(_NODES):
                share = across * weight_z[k] * self.node_state[s, start + k]
                state += share
                for entry in ti.static(_SLOPED):
                    moments_xy[entry] += distance_x * share[entry]
                for entry in ti.static(_SLOPED):
                    moments_xy[4 + entry] += distance_y * share[entry]
                moments_z += (k - 1.0 - place.z) * share[:4]
        slope_factor = 4.0 * self.inv_dx
        slope_z = slope_factor * moments_z
        self.grid_slopes[s, p] = slope_factor * moments_xy
        self.slopes[2][s, p] = slope_z
        self.grid_state[s, p] = state

    @ti.func
    def deform(self, s: i32, p: i32) -> None:
        """Update F of a solid with the velocity gradient, and Jp of snow.

        (I + dt C) F is the trial gradient. That of snow returns to its yield limits,
        and the change of volume that it loses goes into Jp.
        """
        kind = self.matter[s, p][0]
        if kind != LIQUID:
            old_rows = rows_of(self.deformation(s, p))
            gradient = rows_of(self.velocity_gradient(s, p))
            rows = follow_flow(old_rows, gradient, self.dt)
            self.store_deformation(s, p, rows)
            if kind == SNOW:
                elastic, growth = plastic_return(rows, self.yield_low, self.yield_high)
                self.store_deformation(s, p, elastic)
                self.store_ratio(s, p, self.grown_plastic_ratio(s, p, growth))
            self.keep_jacobian(s, p, self.determinant(s, p))

    @ti.func
    def compute_listed_deformation(self, block: i32) -> None:
        """Update F of a block of solids with the velocity gradient."""
        old_rows = load_rows(self.listed_gradient, block)
        gradient = load_rows(self.listed_slopes, block)
        rows = follow_flow(old_rows, gradient, self.dt)
        store_rows(self.listed_gradient, block, rows)

    @ti.func
    def compute_listed_plasticity(self, block: i32, snow_count: i32) -> None:
        """Compute the elastic F and the growth of Jp of a block of snow particles.

        The last block may have other solids behind the snow. Their F stays as it is.
        """
        trial = load_rows(self.listed_gradient, block)
        rows, growth = plastic_return(trial, self.yield_low, self.yield_high)
        snow_lanes = snow_count - block * _LANES
        for lane in ti.static(_LANE_NUMBERS):
            is_snow = lane < snow_lanes
            for row, column in ti.static(_PLACES):
                elastic = rows[row][column][lane]
                old = trial[row][column][lane]
                rows[row][column][lane] = ti.select(is_snow, elastic, old)
        store_rows(self.listed_gradient, block, rows)
        store_lanes(self.listed_growth, block, growth)

    @ti.func
    def copy_growth_from_list(self, number: i32) -> None:
        """Update Jp of a snow particle from its place in the list of solids."""
        p = self.solids[number]
        ratio = self.grown_plastic_ratio(0, p, self.listed_growth[number])
        self.store_ratio(0, p, ratio)

    @ti.func
    def compute_listed_jacobian(self, block: i32) -> None:
        """Compute det F of a block of solids."""
        rows = load_rows(self.listed_gradient, block)
        store_lanes(self.listed_jacobian, block, determinant(rows))

    @ti.func
    def store_deformation(self, s: i32, p: i32, rows: Template) -> None:
        """Store F of a particle, column by column."""
        for axis in ti.static(_AXES):
            column = vec4(rows[0][axis], rows[1][axis], rows[2][axis], 0.0)
            self.deformation_columns[axis][s, p] = column

    @ti.func
    def copy_to_list(self, fields: Template, columns: Template, number: i32) -> None:
        """Copy a matrix of a solid to its place in the list of solids."""
        matrix = self.matrix(columns, 0, self.solids[number])
        for row, column in ti.static(_PLACES):
            fields[row][column][number] = matrix[row, column]

    @ti.func
    def copy_gradient_from_list(self, number: i32) -> None:
        """Copy F of a solid from its place in the list of solids to the particle."""
        p = self.solids[number]
        for axis in ti.static(_AXES):
            x = self.listed_gradient[0][axis][number]
            y = self.listed_gradient[1][axis][number]
            z = self.listed_gradient[2][axis][number]
            self.deformation_columns[axis][0, p] = vec4(x, y, z, 0.0)

    # The drivers run the same phases in the same order.

    def run_serially(self, substeps: int) -> None:
        """Advance scenario 0 by many substeps in one thread, on the nodes that
        particles touch.

        The lists have F of the solids during the substeps, and the particles have it
        before and after.
        """
        self._serial_substeps(
            substeps,
            self.particles,
            self.solid_count,
            self.snow_count,
            self.solid,
        )

    def run_in_parallel(self) -> None:
        """Advance every scenario by one substep: one launch per phase."""
        self._parallel_substep(self.particles, self.node_count, self.width, self.solid)

    @ti.kernel
    def _serial_substeps(
        self,
        substeps: i32,
        particles: i32,
        solid_count: i32,
        snow_count: i32,
        solid: Template,
    ) -> Nothing:
        if ti.static(solid):
            ti.loop_config(serialize=True)
            for number in range(solid_count):
                self.copy_to_list(
                    self.listed_gradient, self.deformation_columns, number
                )
                self.copy_moduli_to_list(number)
        ti.loop_config(serialize=True)
        for _ in range(substeps):
            solid_blocks = block_count(solid_count)
            snow_blocks = block_count(snow_count)
            particle_volume = self.particle_volume[0]
            friction = self.friction[0]
            first, end = self.touched_nodes(particles)
            for i in range(first[0], end[0]):
                for j in range(first[1], end[1]):
                    for k in range(first[2], end[2]):
                        self.clear(0, self.at(i, j, k))
                    # A row has the number of its last node. So the numbers of rows with
                    # a touched node are larger by at most two.
                    for k in range(first[2], end[2] + 2):
                        self.clear_row(0, self.at(i, j, k))
            for p in range(particles):
                self.locate(0, p)
            if ti.static(solid):
                # Jp changes the moduli of snow only.
                for number in range(snow_count):
                    self.copy_moduli_to_list(number)
                for block in range(solid_blocks):
                    self.compute_listed_stress(block)
                for number in range(solid_count):
                    self.copy_stress_from_list(number)
            for p in range(particles):
                self.stress(0, p, solid)
            for p in range(particles):
                self.p2g(0, p)
            for i in range(first[0], end[0]):
                for j in range(first[1], end[1]):
                    for k in range(first[2], end[2]):
                        self.update(0, i, j, k, particle_volume, friction)
            for p in range(particles):
                self.g2p(0, p)
            for p in range(particles):
                self.flow(0, p, solid)
            if ti.static(solid):
                for number in range(solid_count):
                    self.copy_to_list(self.listed_slopes, self.slopes, number)
                for block in range(solid_blocks):
                    self.compute_listed_deformation(block)
                for block in range(snow_blocks):
                    self.compute_listed_plasticity(block, snow_count)
                for number in range(snow_count):
                    self.copy_growth_from_list(number)
                for block in range(solid_blocks):
                    self.compute_listed_jacobian(block)
                for number in range(solid_count):
                    self.keep_jacobian(
                        0, self.solids[number], self.listed_jacobian[number]
                    )
        if ti.static(solid):
            ti.loop_config(serialize=True)
            for number in range(solid_count):
                self.copy_gradient_from_list(number)

    @ti.kernel
    def _parallel_substep(
        self, particles: i32, nodes: i32, width: i32, solid: Template
    ) -> Nothing:
        threads = ti.static(self.threads)
        scenarios = ti.static(self.scenarios)
        ti.loop_config(parallelize=threads)
        for s, n in ti.ndrange(scenarios, nodes):
            self.clear(s, n)
            self.clear_row(s, n)
        ti.loop_config(parallelize=threads)
        for s, p in ti.ndrange(scenarios, particles):
            self.locate(s, p)
            if ti.static(solid):
                self.compute_elastic_stress(s, p)
            self.stress(s, p, solid)
            self.p2g(s, p)
        ti.loop_config(parallelize=threads)
        for s, i, j, k in ti.ndrange(scenarios, width, width, width):
            particle_volume = self.particle_volume[s]
            friction = self.friction[s]
            self.update(s, i, j, k, particle_volume, friction)
        ti.loop_config(parallelize=threads)
        for s, p in ti.ndrange(scenarios, particles):
            self.g2p(s, p)
            self.flow(s, p, solid)
            if ti.static(solid):
                self.deform(s, p)


@ti.func
def load_lanes(field: Template, block: i32) -> Value:
    """Read the numbers of a block of particles as one vector."""
    first = block * _LANES
    return ti.Vector([field[first + lane] for lane in ti.static(_LANE_NUMBERS)])


@ti.func
def load_rows(fields: Template, block: i32) -> Value:
    """Read the matrices of a block of particles as a list of rows."""
    return [load_row(row, block) for row in ti.static(fields)]


@ti.func
def load_row(fields: Template, block: i32) -> Value:
    """Read a row of the matrices of a block of particles."""
    return [load_lanes(field, block) for field in ti.static(fields)]


@ti.func
def store_rows(fields: Template, block: i32, rows: Value) -> None:
    """Write the matrices of a block of particles."""
    for row, column in ti.static(_PLACES):
        store_lanes(fields[row][column], block, rows[row][column])


@ti.func
def store_lanes(field: Template, block: i32, values: Value) -> None:
    """Write a vector to the numbers of a block of particles."""
    for lane in ti.static(_LANE_NUMBERS):
        field[block * _LANES + lane] = values[lane]


@ti.func
def block_count(count: i32) -> i32:
    """Return how many blocks hold the particles of a list; the last may have gaps."""
    return (count + (_LANES - 1)) // _LANES


def _number_fields(count: int) -> list[Any]:
    """Return some fields of numbers."""
    return [ti.field(f32) for _ in range(count)]
