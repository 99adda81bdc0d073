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
from .constitutive import hardening, larger, liquid_stress
from .constitutive_3d import (
    corotated_stress,
    determinant,
    follow_flow,
    plastic_return,
    rows_of,
)
from .free_surface_kernels import LIQUID, ROPE, SNOW, FreeSurfaceKernels, finite
from .language import f32, i32, i64, mat3, ti, vec3, vec4
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
    """Fields of a batch of scenarios and the kernels that advance them."""

    dimension = 3
    reach = 128.0  # twice that of the plane
    at_rest = (0.0, 0.0, 0.0, 1.0)

    def _declare_fields(self) -> None:
        """Name the fields; they have no memory yet.

        ``particle_state`` is v, and J of a liquid or 1. ``slopes`` are derivatives of v
        and Jbar.
        """
        super()._declare_fields()
        self.slope_x, self.slope_y, self.slope_z = self.slopes
        # by how much the number of a node grows along each axis
        width = self.width
        layer = width**2
        self.stride = (layer, width, 1)
        # of each particle: columns of the deformation gradient of a solid [1]; the
        # fourth entry of a column is 0
        self.deformation_columns = _vector_fields()
        # columns of A times velocity_scale; the fourth entry is 0
        self.momentum_slopes = _vector_fields()
        slope_x, slope_y, slope_z = self.momentum_slopes
        self.momentum_slope_x = slope_x
        self.momentum_slope_y = slope_y
        self.momentum_slope_z = slope_z
        # the three weights along each axis; the fourth entry is 0
        self.weights = _vector_fields()
        self.weight_x, self.weight_y, self.weight_z = self.weights
        # offset from the middle node of the stencil [cells]; the fourth entry has the
        # bits of the number of the lowest node
        self.stencil_place = vec4.field()
        # v, Jbar and r of the nodes, at the particle, and three zeros
        self.grid_state = _wide_field()
        # slopes of v and Jbar of the nodes at the particle: along x, then along y
        self.grid_slopes = _wide_field()
        # Kirchhoff stress of a solid without damping [mass/(length s^2)]: entries xx,
        # yy and zz; entries yz, xz and xy; the fourth entries are 0
        self.elastic_diagonal = vec4.field()
        self.elastic_off_diagonal = vec4.field()

        # the solids of scenario 0, snow first
        self.solids = ti.field(i32)
        # at the place of a solid in this list: entries of F [1] and of C [1/s], Lame's
        # constants mu and lambda [mass/(length s^2)], entries of the Kirchhoff stress
        # without damping [mass/(length s^2)], the factor on Jp [1], and det F [1]
        self.listed_gradient = _matrix_fields()
        self.listed_slopes = _matrix_fields()
        self.listed_mu = ti.field(f32)
        self.listed_la = ti.field(f32)
        self.listed_stress = _number_fields(6)
        self.listed_growth = ti.field(f32)
        self.listed_jacobian = ti.field(f32)

        # of each node: n v and n J
        self.sums = _sum_field()
        # n of each row of three nodes along the third axis, at its last node
        self.row_sums = _sum_field()
        # v, Jbar, r and three zeros: G2P reads all of them from one address
        self.node_state = _wide_field()

    def _particle_fields(self) -> tuple[ti.Field, ...]:
        return (
            *self.deformation_columns,
            *self.momentum_slopes,
            *self.weights,
            self.stencil_place,
            self.grid_state,
            self.grid_slopes,
            self.elastic_diagonal,
            self.elastic_off_diagonal,
        )

    def _node_fields(self) -> tuple[ti.Field, ...]:
        return self.sums, self.node_state

    def _row_fields(self) -> tuple[ti.Field, ...]:
        return (self.row_sums,)

    def _place_fields(self) -> None:
        """Give the fields their memory, each an array of its own."""
        super()._place_fields()
        list_length = _LANES * math.ceil(self.particles / _LANES)
        list_shape = (list_length,)
        listed = (
            self.solids,
            *self.listed_gradient[0],
            *self.listed_gradient[1],
            *self.listed_gradient[2],
            *self.listed_slopes[0],
            *self.listed_slopes[1],
            *self.listed_slopes[2],
            self.listed_mu,
            self.listed_la,
            *self.listed_stress,
            self.listed_growth,
            self.listed_jacobian,
        )
        backend.place((list_shape, listed))

    def sort_by_material(self, material: NDArray[np.int32]) -> None:
        """Note whether there are solids, and list those of scenario 0.

        Args:
            material: Material of each particle, shape [scenario, particle].
        """
        super().sort_by_material(material)
        first_material = material[0]
        is_snow = first_material == SNOW
        snow = np.flatnonzero(is_snow)
        other_solids = np.flatnonzero((first_material != LIQUID) & ~is_snow)
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
        width = self.width
        return (i * width + j) * width + k

    @ti.func
    def clear(self, s: i32, n: i32) -> None:
        """Set the sums of a node to zero, before P2G adds to them."""
        zero = ti.Vector.zero(i64, 4)
        self.sums[s, n] = zero

    @ti.func
    def clear_row(self, s: i32, n: i32) -> None:
        """Set the sums of a row of three nodes to zero; ``n`` is the last of them."""
        zero = ti.Vector.zero(i64, 4)
        self.row_sums[s, n] = zero

    @ti.func
    def locate(self, s: i32, p: i32) -> None:
        """Store the stencil of a particle for P2G and G2P: its nodes and weights."""
        x = self.x[s, p]
        number = 0
        offset = vec3(0.0)
        for axis in ti.static(_AXES):
            coordinate = x[axis]
            scaled = coordinate * self.inv_dx
            lowest = ti.cast(scaled - 0.5, i32)
            f = scaled - ti.cast(lowest, f32)
            low, mid, high = spline_weights(f)
            weights = vec4(low, mid, high, 0.0)
            self.weights[axis][s, p] = weights
            offset[axis] = f - 1.0
            stride = self.stride[axis]
            number += lowest * stride
        number_bits = ti.bit_cast(number, f32)
        place = vec4(offset, number_bits)
        self.stencil_place[s, p] = place

    @ti.func
    def row_start(self, lowest: i32, i: Template, j: Template) -> i32:
        """Return the number of the first node of a row of a particle's stencil."""
        width = self.width
        return lowest + (i * width + j) * width

    @ti.func
    def velocity_gradient(self, s: i32, p: i32) -> mat3:
        """Return C of a particle."""
        slope_x = self.slope_x[s, p]
        slope_y = self.slope_y[s, p]
        slope_z = self.slope_z[s, p]
        return columns(slope_x, slope_y, slope_z)

    @ti.func
    def deformation(self, s: i32, p: i32) -> mat3:
        """Return F of a particle."""
        first = self.deformation_columns[0][s, p]
        second = self.deformation_columns[1][s, p]
        third = self.deformation_columns[2][s, p]
        return columns(first, second, third)

    @ti.func
    def moduli(self, s: i32, p: i32) -> Value:
        """Return Lame's constants mu and lambda of a solid [mass/(length s^2)]."""
        matter = self.matter[s, p]
        kind = matter[0]
        ratio = matter[1]
        mu, la = self.jelly
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
        return mu, la

    @ti.func
    def store_elastic_stress(self, s: i32, p: i32, stress: Template) -> None:
        """Store the Kirchhoff stress of a solid without damping."""
        xx, yy, zz, yz, xz, xy = stress
        diagonal = vec4(xx, yy, zz, 0.0)
        off_diagonal = vec4(yz, xz, xy, 0.0)
        self.elastic_diagonal[s, p] = diagonal
        self.elastic_off_diagonal[s, p] = off_diagonal

    @ti.func
    def compute_elastic_stress(self, s: i32, p: i32) -> None:
        """Compute the Kirchhoff stress of a solid without damping."""
        mu, la = self.moduli(s, p)
        f = self.deformation(s, p)
        rows = rows_of(f)
        stress = corotated_stress(rows, mu, la)
        self.store_elastic_stress(s, p, stress)

    @ti.func
    def copy_gradient_to_list(self, number: i32) -> None:
        """Copy F of a solid to its place in the list of solids."""
        p = self.solids[number]
        f = self.deformation(0, p)
        store_matrix(self.listed_gradient, number, f)

    @ti.func
    def copy_gradient_from_list(self, number: i32) -> None:
        """Copy F of a solid from its place in the list of solids to the particle."""
        p = self.solids[number]
        x_row, y_row, z_row = ti.static(self.listed_gradient)
        for axis in ti.static(_AXES):
            x = x_row[axis][number]
            y = y_row[axis][number]
            z = z_row[axis][number]
            column = vec4(x, y, z, 0.0)
            self.deformation_columns[axis][0, p] = column

    @ti.func
    def copy_slopes_to_list(self, number: i32) -> None:
        """Copy C of a solid to its place in the list of solids."""
        p = self.solids[number]
        c = self.velocity_gradient(0, p)
        store_matrix(self.listed_slopes, number, c)

    @ti.func
    def copy_moduli_to_list(self, number: i32) -> None:
        """Copy Lame's constants of a solid to its place in the list of solids."""
        p = self.solids[number]
        mu, la = self.moduli(0, p)
        self.listed_mu[number] = mu
        self.listed_la[number] = la

    @ti.func
    def compute_listed_stress(self, block: i32) -> None:
        """Compute the Kirchhoff stress of a block of solids without damping."""
        mu = load_lanes(self.listed_mu, block)
        la = load_lanes(self.listed_la, block)
        rows = load_rows(self.listed_gradient, block)
        stress = corotated_stress(rows, mu, la)
        for entry in ti.static(_ENTRIES):
            values = stress[entry]
            store_lanes(self.listed_stress[entry], block, values)

    @ti.func
    def copy_stress_from_list(self, number: i32) -> None:
        """Copy the stress of a solid from the list of solids to the particle."""
        stress = [
            self.listed_stress[0][number],
            self.listed_stress[1][number],
            self.listed_stress[2][number],
            self.listed_stress[3][number],
            self.listed_stress[4][number],
            self.listed_stress[5][number],
        ]
        p = self.solids[number]
        self.store_elastic_stress(0, p, stress)

    @ti.func
    def viscosity(self, s: i32, p: i32) -> f32:
        """Return the dynamic viscosity of a liquid, or the damping of a solid."""
        matter = self.matter[s, p]
        kind = matter[0]
        damping = ti.select(kind == SNOW, 0.0, self.solid_viscosity)
        return ti.select(kind == LIQUID, self.liquid_viscosity, damping)

    @ti.func
    def stress(self, s: i32, p: i32, solid: Template) -> None:
        """Compute A of a particle, and a bound of the speeds that it gives to nodes."""
        particle_state = self.particle_state[s, p]
        spread_jacobian = particle_state[3]
        modulus = self.parameters.liquid_modulus
        isotropic_stress = liquid_stress(spread_jacobian, modulus)
        c = self.velocity_gradient(s, p)
        viscosity = self.liquid_viscosity
        diagonal = vec4(isotropic_stress)
        off_diagonal = vec4(0.0)  # entries yz, xz and xy
        if ti.static(solid):
            viscosity = self.viscosity(s, p)
            # Selections instead of branches: LLVM makes vector instructions.
            matter = self.matter[s, p]
            kind = matter[0]
            is_liquid = kind == LIQUID
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
                slope = c[row, column]
                mirrored_slope = c[column, row]
                tau = viscosity * (slope + mirrored_slope)
                if ti.static(row == column):
                    normal_stress = diagonal[row]
                    tau = tau + normal_stress
                elif ti.static(solid):
                    shear_stress = off_diagonal[3 - row - column]
                    tau = tau + shear_stress
                a[row] = self.dx * slope - self.stress_factor * tau
            affine_speed = affine_speed + 1.5 * ti.abs(a.xyz)
            self.momentum_slopes[column][s, p] = self.velocity_scale * a
        self.keep_node_speed(s, p, affine_speed)

    @ti.func
    def keep_node_speed(self, s: i32, p: i32, affine_speed: vec3) -> None:
        """Keep the largest speed that a particle gives to a node in this advance."""
        particle_state = self.particle_state[s, p]
        velocity = particle_state.xyz
        node_speed = ti.abs(velocity) + affine_speed
        extremes = self.extremes[s, p]
        largest = extremes[3]
        for axis in ti.static(_AXES):
            axis_speed = node_speed[axis]
            component = finite(axis_speed)
            largest = larger(component, largest)
        extremes[3] = largest
        self.extremes[s, p] = extremes

    @ti.func
    def p2g(self, s: i32, p: i32) -> None:
        """Add n v, n J and n of a particle to the nodes of its stencil.

        What a node gets is linear in its place. So it is computed at the middle node,
        and then stepped to the neighbours, dx away.
        """
        place = self.stencil_place[s, p]
        number_bits = place[3]
        lowest = node_number(number_bits, self.node_count)
        step_x = self.momentum_slope_x[s, p]
        step_y = self.momentum_slope_y[s, p]
        step_z = self.momentum_slope_z[s, p]
        scale = vec4(
            self.velocity_scale,
            self.velocity_scale,
            self.velocity_scale,
            self.count_scale,
        )
        particle_state = self.particle_state[s, p]
        at_middle = scale * particle_state - place.x * step_x
        at_middle = at_middle - place.y * step_y
        at_middle = at_middle - place.z * step_z

        weight_x = self.weight_x[s, p]
        weight_y = self.weight_y[s, p]
        weight_z = self.weight_z[s, p]
        for i, j in ti.static(_ROWS):
            weight_i = weight_x[i]
            weight_j = weight_y[j]
            weights = weight_i * weight_j * weight_z
            at_column = stepped(at_middle, step_x, i - 1)
            at_row = stepped(at_column, step_y, j - 1)
            start = self.row_start(lowest, i, j)
            for k in ti.static(_NODES):
                node = start + k
                weight = weights[k]
                at_node = stepped(at_row, step_z, k - 1)
                share = weight * at_node
                add_shifted(self.sums, s, node, share, self.atomic)
            # The fourth weight is 0, so that the fourth sum counts shifts.
            last = start + 2
            counts = self.count_scale * weights
            add_shifted(self.row_sums, s, last, counts, self.atomic)

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
            shifted_total = self.sums[s, node]
            total = shifted_total - shifts
            jacobian_total = total[3]
            momentum = from_fixed(total, self.velocity_unit)
            jacobian_sum = from_fixed(jacobian_total, self.count_unit)
            jacobian = jacobian_sum / count
            velocity = momentum.xyz / count
            weightless_speed = velocity.y
            velocity.y = weightless_speed - self.gravity_gain
            velocity = self.contact(i, 0, velocity, friction)
            velocity = self.contact(j, 1, velocity, friction)
            velocity = self.contact(k, 2, velocity, friction)
            mirrored_sum = self.mirrored_count(s, i, j, k)
            mirrored_count = from_fixed(mirrored_sum, self.count_unit)
            density = mirrored_count * particle_volume
        state = ti.Vector.zero(f32, 8)
        for axis in ti.static(_AXES):
            component = velocity[axis]
            state[axis] = component
        state[3] = jacobian
        state[4] = density
        self.node_state[s, node] = state

    @ti.func
    def contact(
        self, index: i32, axis: Template, velocity: vec3, friction: f32
    ) -> vec3:
        """Return the velocity of a node after contact with one of two opposite walls.

        Args:
            index: place of the node along the normal of the walls.
            axis: that of the normal.
            velocity: that of the node.
            friction: Coulomb's coefficient of the walls.
        """
        first_axis = ti.static((axis + 1) % 3)
        second_axis = ti.static((axis + 2) % 3)
        normal = velocity[axis]
        first = velocity[first_axis]
        second = velocity[second_axis]
        new_velocity = velocity
        if self.is_outward(index, normal):
            impact_speed = ti.abs(normal)
            sliding_speed = ti.sqrt(first * first + second * second)
            divisor = larger(sliding_speed, 1e-9)
            loss = friction * impact_speed / divisor
            kept = larger(1.0 - loss, 0.0)
            new_first = first * kept
            new_second = second * kept
            new_velocity[axis] = 0.0
            new_velocity[first_axis] = new_first
            new_velocity[second_axis] = new_second
        return new_velocity

    @ti.func
    def mirrored_count(self, s: i32, i: i32, j: i32, k: i32) -> i64:
        """Return n of a node plus n of its mirror images.

        Particles lie on one side of a wall only: without its images a node on a wall
        would count half a cell, and a node in a corner an eighth.
        """
        image_i = self.image(i)
        image_j = self.image(j)
        image_k = self.image(k)
        places_i = [i, image_i]
        places_j = [j, image_j]
        places_k = [k, image_k]
        count = i64(0)
        for a, b, c in ti.static(_SIDES):
            place_i = places_i[a]
            place_j = places_j[b]
            place_k = places_k[c]
            if place_i >= 0 and place_j >= 0 and place_k >= 0:
                node = self.at(place_i, place_j, place_k)
                weight_sum, _ = row_count(self.row_sums, s, node)
                count += weight_sum
        return count

    @ti.func
    def g2p(self, s: i32, p: i32) -> None:
        """Interpolate v, Jbar and r of the nodes at a particle, and the slopes of v.

        A vector register takes eight numbers. So all numbers of a node are one vector,
        and the slopes along x and along y are one. :meth:`flow` separates them.
        """
        place = self.stencil_place[s, p]
        number_bits = place[3]
        lowest = node_number(number_bits, self.node_count)
        weight_x = self.weight_x[s, p]
        weight_y = self.weight_y[s, p]
        weight_z = self.weight_z[s, p]
        state = ti.Vector.zero(f32, 8)
        # first moments of v and Jbar about the particle [cells]: x, then y
        moments_xy = ti.Vector.zero(f32, 8)
        moments_z = vec4(0.0)
        for i, j in ti.static(_ROWS):
            weight_i = weight_x[i]
            weight_j = weight_y[j]
            across = weight_i * weight_j
            start = self.row_start(lowest, i, j)
            distance_x = i - 1.0 - place.x
            distance_y = j - 1.0 - place.y
            for k in ti.static(_NODES):
                weight_k = weight_z[k]
                weight = across * weight_k
                node = start + k
                node_state = self.node_state[s, node]
                share = weight * node_state
                distance_z = k - 1.0 - place.z
                state += share
                for entry in ti.static(_SLOPED):
                    component = share[entry]
                    moment = distance_x * component
                    moments_xy[entry] += moment
                for entry in ti.static(_SLOPED):
                    component = share[entry]
                    moment = distance_y * component
                    moments_xy[4 + entry] += moment
                sloped_share = share[:4]
                moments_z += distance_z * sloped_share
        slope_factor = 4.0 * self.inv_dx
        slope_z = slope_factor * moments_z
        self.grid_slopes[s, p] = slope_factor * moments_xy
        self.slope_z[s, p] = slope_z
        self.grid_state[s, p] = state

    @ti.func
    def flow(self, s: i32, p: i32, solid: Template) -> None:
        """Move a particle with the grid's velocity, and update J of a liquid."""
        grid_state = self.grid_state[s, p]
        u = grid_state[0]
        v = grid_state[1]
        w = grid_state[2]
        velocity = vec3(u, v, w)
        grid_jacobian = grid_state[3]
        grid_density = grid_state[4]
        old_position = self.x[s, p]
        old_x = old_position.xyz
        x = old_x + self.dt * velocity
        low = self.position_min
        high = self.position_max
        x = bounded(x, low, high)
        position = vec4(x, 0.0)
        self.x[s, p] = position

        matter = self.matter[s, p]
        kind = matter[0]
        old_ratio = matter[1]
        slopes_xy = self.grid_slopes[s, p]
        slope_x = slopes_xy[:4]
        slope_y = slopes_xy[4:]
        slope_z = self.slope_z[s, p]
        self.slope_x[s, p] = slope_x
        self.slope_y[s, p] = slope_y
        strain_rate_x = slope_x[0]
        strain_rate_y = slope_y[1]
        strain_rate_z = slope_z[2]
        divergence = strain_rate_x + strain_rate_y + strain_rate_z
        jacobian = self.liquid_jacobian(
            old_ratio, divergence, grid_jacobian, grid_density
        )
        is_liquid = kind == LIQUID
        ratio = jacobian
        spread_jacobian = jacobian
        if ti.static(solid):
            ratio = ti.select(is_liquid, jacobian, old_ratio)
            spread_jacobian = ti.select(is_liquid, jacobian, 1.0)
        particle_state = vec4(velocity, spread_jacobian)
        self.particle_state[s, p] = particle_state
        self.store_ratio(s, p, ratio)

        extremes = self.extremes[s, p]
        speed = largest_component(velocity)
        old_speed = extremes[0]
        extremes[0] = larger(speed, old_speed)
        self.extremes[s, p] = extremes
        kept_jacobian = jacobian
        if ti.static(solid):
            # det F of a solid is computed later. Until then the old minimum stands for
            # it, which changes neither extreme.
            old_min = extremes[1]
            kept_jacobian = ti.select(is_liquid, jacobian, old_min)
        self.keep_jacobian(s, p, kept_jacobian)

    @ti.func
    def store_ratio(self, s: i32, p: i32, ratio: f32) -> None:
        """Store J of a liquid or Jp of snow, and its extremes since the start."""
        matter = self.matter[s, p]
        old_min = matter[2]
        old_max = matter[3]
        new_min = ti.select(ratio < old_min, ratio, old_min)
        new_max = larger(ratio, old_max)
        matter[1] = ratio
        matter[2] = new_min
        matter[3] = new_max
        self.matter[s, p] = matter

    @ti.func
    def jacobian(self, s: i32, p: i32) -> f32:
        """Return J of a liquid or det F of a solid."""
        matter = self.matter[s, p]
        kind = matter[0]
        ratio = matter[1]
        f = self.deformation(s, p)
        rows = rows_of(f)
        solid_jacobian = determinant(rows)
        return ti.select(kind == LIQUID, ratio, solid_jacobian)

    @ti.func
    def keep_jacobian(self, s: i32, p: i32, jacobian: f32) -> None:
        """Keep the smallest and largest J or det F of a particle in this advance."""
        extremes = self.extremes[s, p]
        old_min = extremes[1]
        old_max = extremes[2]
        new_min = ti.select(jacobian < old_min, jacobian, old_min)
        new_max = larger(jacobian, old_max)
        extremes[1] = new_min
        extremes[2] = new_max
        self.extremes[s, p] = extremes

    @ti.func
    def deform(self, s: i32, p: i32) -> None:
        """Update F of a solid with the velocity gradient, and Jp of snow.

        (I + dt C) F is the trial gradient. That of snow returns to its yield limits,
        and the change of volume that it loses goes into Jp.
        """
        matter = self.matter[s, p]
        kind = matter[0]
        if kind != LIQUID:
            f = self.deformation(s, p)
            c = self.velocity_gradient(s, p)
            old_rows = rows_of(f)
            gradient = rows_of(c)
            rows = follow_flow(old_rows, gradient, self.dt)
            self.store_deformation(s, p, rows)
            if kind == SNOW:
                low = self.yield_low
                high = self.yield_high
                elastic_rows, growth = plastic_return(rows, low, high)
                self.store_deformation(s, p, elastic_rows)
                self.update_plastic_ratio(s, p, growth)
            jacobian = self.jacobian(s, p)
            self.keep_jacobian(s, p, jacobian)

    @ti.func
    def update_plastic_ratio(self, s: i32, p: i32, growth: f32) -> None:
        """Multiply Jp of a snow particle by a factor, within its limits."""
        jp_min = self.parameters.snow_jp_min
        jp_max = self.parameters.snow_jp_max
        matter = self.matter[s, p]
        old_jp = matter[1]
        grown_jp = old_jp * growth
        jp = bounded(grown_jp, jp_min, jp_max)
        self.store_ratio(s, p, jp)

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
        low = self.yield_low
        high = self.yield_high
        trial = load_rows(self.listed_gradient, block)
        rows, growth = plastic_return(trial, low, high)
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
        growth = self.listed_growth[number]
        self.update_plastic_ratio(0, p, growth)

    @ti.func
    def compute_listed_jacobian(self, block: i32) -> None:
        """Compute det F of a block of solids."""
        rows = load_rows(self.listed_gradient, block)
        jacobian = determinant(rows)
        store_lanes(self.listed_jacobian, block, jacobian)

    @ti.func
    def copy_jacobian_from_list(self, number: i32) -> None:
        """Keep the extremes of det F of a solid, from its place in the list."""
        p = self.solids[number]
        jacobian = self.listed_jacobian[number]
        self.keep_jacobian(0, p, jacobian)

    @ti.func
    def store_deformation(self, s: i32, p: i32, rows: Template) -> None:
        """Store F of a particle, column by column."""
        x_row, y_row, z_row = rows
        for axis in ti.static(_AXES):
            x = x_row[axis]
            y = y_row[axis]
            z = z_row[axis]
            column = vec4(x, y, z, 0.0)
            self.deformation_columns[axis][s, p] = column

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
                self.copy_gradient_to_list(number)
                self.copy_moduli_to_list(number)
        ti.loop_config(serialize=True)
        for _ in range(substeps):
            solid_blocks = block_count(solid_count)
            snow_blocks = block_count(snow_count)
            particle_volume = self.particle_volume[0]
            friction = self.friction[0]
            first, end = self.touched_nodes(particles)
            first_i, first_j, first_k = first
            end_i, end_j, end_k = end
            # A row has the number of its last node. So the numbers of rows with a
            # touched node are larger by at most two.
            row_end_k = end_k + 2
            for i in range(first_i, end_i):
                for j in range(first_j, end_j):
                    for k in range(first_k, end_k):
                        node = self.at(i, j, k)
                        self.clear(0, node)
                    for k in range(first_k, row_end_k):
                        node = self.at(i, j, k)
                        self.clear_row(0, node)
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
            for i in range(first_i, end_i):
                for j in range(first_j, end_j):
                    for k in range(first_k, end_k):
                        self.update(0, i, j, k, particle_volume, friction)
            for p in range(particles):
                self.g2p(0, p)
            for p in range(particles):
                self.flow(0, p, solid)
            if ti.static(solid):
                for number in range(solid_count):
                    self.copy_slopes_to_list(number)
                for block in range(solid_blocks):
                    self.compute_listed_deformation(block)
                for block in range(snow_blocks):
                    self.compute_listed_plasticity(block, snow_count)
                for number in range(snow_count):
                    self.copy_growth_from_list(number)
                for block in range(solid_blocks):
                    self.compute_listed_jacobian(block)
                for number in range(solid_count):
                    self.copy_jacobian_from_list(number)
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

    def restart_extremes(self) -> None:
        """Start an advance: the extremes are those of the present state."""
        self._restart_extremes(self.particles)

    @ti.kernel
    def _restart_extremes(self, particles: i32) -> Nothing:
        is_serial = ti.static(not self.atomic)
        scenarios = ti.static(self.scenarios)
        ti.loop_config(serialize=is_serial)
        for s, p in ti.ndrange(scenarios, particles):
            particle_state = self.particle_state[s, p]
            velocity = particle_state.xyz
            jacobian = self.jacobian(s, p)
            speed = largest_component(velocity)
            extremes = vec4(speed, jacobian, jacobian, 0.0)
            self.extremes[s, p] = extremes


@ti.func
def load_lanes(field: Template, block: i32) -> Value:
    """Read the numbers of a block of particles as one vector."""
    first = block * _LANES
    values = ti.Vector.zero(f32, _LANES)
    for lane in ti.static(_LANE_NUMBERS):
        value = field[first + lane]
        values[lane] = value
    return values


@ti.func
def load_rows(fields: Template, block: i32) -> Value:
    """Read the matrices of a block of particles as a list of rows."""
    x_row = load_row(fields[0], block)
    y_row = load_row(fields[1], block)
    z_row = load_row(fields[2], block)
    return [x_row, y_row, z_row]


@ti.func
def load_row(fields: Template, block: i32) -> Value:
    """Read a row of the matrices of a block of particles."""
    x = load_lanes(fields[0], block)
    y = load_lanes(fields[1], block)
    z = load_lanes(fields[2], block)
    return [x, y, z]


@ti.func
def store_matrix(fields: Template, number: i32, matrix: mat3) -> None:
    """Write the matrix of one particle to its place in a list."""
    for row, column in ti.static(_PLACES):
        entry = matrix[row, column]
        fields[row][column][number] = entry


@ti.func
def store_rows(fields: Template, block: i32, rows: Value) -> None:
    """Write the matrices of a block of particles."""
    for row, column in ti.static(_PLACES):
        field = ti.static(fields[row][column])
        values = rows[row][column]
        store_lanes(field, block, values)


@ti.func
def store_lanes(field: Template, block: i32, values: Value) -> None:
    """Write a vector to the numbers of a block of particles."""
    first = block * _LANES
    for lane in ti.static(_LANE_NUMBERS):
        number = first + lane
        value = values[lane]
        field[number] = value


@ti.func
def block_count(count: i32) -> i32:
    """Return how many blocks hold the particles of a list; the last may have gaps."""
    return (count + (_LANES - 1)) // _LANES


@ti.func
def largest_component(velocity: vec3) -> f32:
    """Return the largest absolute component, huge where one is not a number."""
    speed = ti.abs(velocity)
    largest = 0.0
    for axis in ti.static(_AXES):
        axis_speed = speed[axis]
        component = finite(axis_speed)
        largest = larger(component, largest)
    return largest


@ti.func
def columns(first: vec4, second: vec4, third: vec4) -> mat3:
    """Return the matrix with these columns, without their fourth entries."""
    x_row = [first.x, second.x, third.x]
    y_row = [first.y, second.y, third.y]
    z_row = [first.z, second.z, third.z]
    return mat3(x_row, y_row, z_row)


def _vector_fields() -> list[Any]:
    """Return a field of vectors of four for each axis."""
    return [vec4.field() for _ in _AXES]


def _number_fields(count: int) -> list[Any]:
    """Return some fields of numbers."""
    return [ti.field(f32) for _ in range(count)]


def _matrix_fields() -> list[list[Any]]:
    """Return the rows of a matrix of fields of numbers."""
    return [_number_fields(3) for _ in _AXES]


def _wide_field() -> Any:  # noqa: ANN401 (Taichi is untyped)
    """Return a field of vectors of eight."""
    return ti.Vector.field(8, f32)


def _sum_field() -> Any:  # noqa: ANN401 (Taichi is untyped)
    """Return a field of fixed-point sums of vectors of four."""
    return ti.Vector.field(4, i64)
