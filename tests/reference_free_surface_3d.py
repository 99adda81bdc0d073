"""The free-surface solver in three dimensions in plain NumPy float32, written from the
equations.

Independent of Taichi and of ``generators/``: it reads only parameters and initial
states. Every operation rounds to float32 in the order in which the equation is written;
sums over particles are 64-bit integers. Slow and plain.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from reference_arithmetic import (
    HALF,
    ONE,
    TWO,
    WEIGHT_SCALE,
    ZERO,
    Float,
    Floats,
    Mask,
    Materials,
    Sums,
    fixed,
    hardening,
    mirror_counts,
    stay_inside,
    velocity_scale,
    volume_ratio,
)

from lagbench.generators.split import FreeSurfaceParameters, InitialState

Nodes = tuple[NDArray[np.integer], ...]
Place = tuple[int, int, int]

NEWTON_STEPS = 6
SWEEPS = 4
PLANES = ((0, 1), (0, 2), (1, 2))
FOUR = Float(4)
EIGHT = Float(8)
EPSILON = Float(1e-6)
LEAST_STRETCH = Float(0.1)


def identities(count: int) -> Floats:
    """Return unit matrices, shape [particle, 3, 3]."""
    identity = np.eye(3, dtype=Float)
    return np.tile(identity, (count, 1, 1))


def scaled(factor: Floats, matrices: Floats) -> Floats:
    """Return matrices times a number for each particle."""
    return factor[:, None, None] * matrices


def outer(a: Floats, b: Floats, index: int) -> Floats:
    """Return the products of a column of a and a row of b."""
    column = a[:, :, index]
    row = b[:, index, :]
    return column[:, :, None] * row[:, None, :]


def times(a: Floats, b: Floats) -> Floats:
    """Return the products of matrices, shape [particle, 3, 3], summed from the left."""
    first = outer(a, b, 0)
    second = outer(a, b, 1)
    third = outer(a, b, 2)
    return (first + second) + third


def transposed(a: Floats) -> Floats:
    """Return the transposed matrices."""
    return a.transpose(0, 2, 1)


def determinant(f: Floats) -> Floats:
    """Return det F, expanded along the first row."""
    first_row, second_row, third_row = f.transpose(1, 2, 0)
    a, b, c = first_row
    d, e, g = second_row
    h, i, j = third_row
    without_a = e * j - g * i
    without_b = d * j - g * h
    without_c = d * i - e * h
    total = a * without_a - b * without_b
    return np.asarray(total + c * without_c)


def left_stretch(b: Floats, jacobian: Floats) -> Floats:
    """V of F = V R from B = V^2 and J: the trace by Newton, then Cayley-Hamilton."""
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = b.transpose(1, 2, 0)
    square = (xx + yy) + zz
    in_xy = xx * yy - xy * xy
    in_yz = yy * zz - yz * yz
    in_xz = xx * zz - xz * xz
    minors = (in_xy + in_yz) + in_xz
    total = np.sqrt(Float(3) * square)
    for _ in range(NEWTON_STEPS):
        gap = total * total - square
        value = gap * gap - EIGHT * jacobian * total
        value = value - FOUR * minors
        slope = FOUR * total * gap - EIGHT * jacobian
        total = total - value / np.maximum(slope, EPSILON)
    pairs = HALF * (total * total - square)
    divisor = pairs * total - jacobian
    inverse = ONE / np.maximum(divisor, EPSILON)
    v = scaled(pairs + square, b) - times(b, b)
    for axis in range(3):
        v[:, axis, axis] += total * jacobian
    return scaled(inverse, v)


def principal_axes(b: Floats) -> tuple[Floats, Floats]:
    """Eigenvalues and eigenvectors (columns) of symmetric matrices: Jacobi's method."""
    a = b.copy()
    axes = identities(len(b))
    for _ in range(SWEEPS):
        for p, q in PLANES:
            turn_plane(a, axes, p, q)
    return np.diagonal(a, axis1=1, axis2=2), axes


def turn_plane(a: Floats, axes: Floats, p: int, q: int) -> None:
    """Turn two axes so that the matrices' entry between them is 0."""
    r = 3 - p - q
    entry = a[:, p, q].copy()
    double = TWO * entry
    difference = a[:, q, q] - a[:, p, p]
    root = np.sqrt(difference * difference + double * double)
    signed_root = np.where(difference < 0, -root, root)
    divisor = difference + signed_root
    is_diagonal = divisor == 0
    safe_divisor = np.where(is_diagonal, ONE, divisor)
    tangent = np.where(is_diagonal, ZERO, double / safe_divisor)
    cosine = ONE / np.sqrt(tangent * tangent + ONE)
    sine = tangent * cosine

    a[:, p, p] -= tangent * entry
    a[:, q, q] += tangent * entry
    a[:, p, q] = 0
    a[:, q, p] = 0
    old_p = a[:, r, p].copy()
    old_q = a[:, r, q].copy()
    new_p = cosine * old_p - sine * old_q
    new_q = sine * old_p + cosine * old_q
    a[:, r, p] = new_p
    a[:, p, r] = new_p
    a[:, r, q] = new_q
    a[:, q, r] = new_q

    column_p = axes[:, :, p].copy()
    column_q = axes[:, :, q].copy()
    c = cosine[:, None]
    s = sine[:, None]
    axes[:, :, p] = c * column_p - s * column_q
    axes[:, :, q] = s * column_p + c * column_q


@dataclass
class Stencil:
    """Where a particle touches the grid.

    These are the lowest node, the offset from the middle node [cells], shape [particle,
    3], and the weights, shape [place, particle, axis].
    """

    base: NDArray[np.int32]
    offset: Floats
    weights: Floats

    @classmethod
    def at(cls, position: Floats, grid: int) -> Stencil:
        """Quadratic B-spline around positions of shape [particle, 3]."""
        place = position * Float(grid)
        base = (place - HALF).astype(np.int32)
        distance = place - base.astype(Float)
        outside = Float(1.5) - distance
        middle = distance - ONE
        inside = distance - HALF
        low = HALF * (outside * outside)
        mid = Float(0.75) - middle * middle
        high = HALF * (inside * inside)
        weights = np.stack([low, mid, high])
        return cls(base, middle, weights)

    def nodes(self) -> Iterator[tuple[Place, Nodes, Floats]]:
        """Yield the place in the stencil, the nodes and the weights of all 27."""
        for i, j, k in np.ndindex(3, 3, 3):
            place = (i, j, k)
            along_x = self.weights[i][:, 0]
            along_y = self.weights[j][:, 1]
            along_z = self.weights[k][:, 2]
            node = self.base + np.array(place, np.int32)
            yield place, tuple(node.T), along_x * along_y * along_z


class FreeSurfaceReference3D:
    """One scenario of the free-surface solver in a cube."""

    def __init__(
        self,
        parameters: FreeSurfaceParameters,
        state: InitialState,
    ) -> None:
        """Start from a state; constants are computed in float64, then rounded once."""
        p = parameters
        self.p = parameters
        count = len(state.position)
        self.position = state.position.astype(Float)  # [length], shape [particle, 3]
        self.velocity = state.velocity.astype(Float)  # [length/s]
        self.affine = state.affine.astype(Float)  # C [1/s], shape [particle, 3, 3]
        self.deformation = identities(count)  # F [1]
        self.ratio = np.ones(count, Float)  # J of liquid, Jp of snow, 1 elsewhere [1]
        self.materials = Materials.of(p, state.material)
        self.friction = Float(state.friction)
        share = state.area / count * p.grid**3
        self.node_share = Float(share)
        self.velocity_scale = velocity_scale(p, count, 128)

    def advance(self, substeps: int) -> None:
        """Run substeps."""
        for _ in range(substeps):
            stencil = Stencil.at(self.position, self.p.grid)
            sums = self.to_grid(stencil)
            nodes = self.grid_update(sums)
            self.to_particles(stencil, *nodes)

    def stress(self) -> Floats:
        """Kirchhoff stress, shape [particle, 3, 3]."""
        p = self.p
        materials = self.materials
        stiff = hardening(p, self.ratio)
        factor = np.where(materials.snow, stiff, ONE)
        mu = materials.mu * factor
        la = materials.la * factor
        f = self.deformation
        b = times(f, transposed(f))
        jacobian = determinant(f)
        strain = b - left_stretch(b, jacobian)
        elastic = scaled(TWO * mu, strain)
        volumetric = la * (jacobian - ONE) * jacobian
        pressure = Float(p.liquid_modulus) * (self.ratio - ONE)
        isotropic = np.zeros_like(elastic)
        for axis in range(3):
            elastic[:, axis, axis] += volumetric
            isotropic[:, axis, axis] = pressure
        is_liquid = materials.liquid[:, None, None]
        elastic = np.where(is_liquid, isotropic, elastic)
        shear = self.affine + transposed(self.affine)
        return scaled(materials.viscosity, shear) + elastic

    def to_grid(self, stencil: Stencil) -> Sums:
        """Sum weighted velocity (x, y, z), weighted J and weights at the nodes.

        The shape is [5, node, node, node]. All particles of a scenario weigh the same,
        so that their mass cancels.
        """
        p = self.p
        nodes = p.grid + 1
        sums = np.zeros((5, nodes, nodes, nodes), np.int64)
        dx = Float(1 / p.grid)
        impulse = Float(4 * p.dt * p.grid / p.density)
        slope = dx * self.affine - impulse * self.stress()
        centre = self.velocity
        for axis in range(3):
            offset = stencil.offset[:, axis, None]
            centre = centre - offset * slope[:, :, axis]
        ratio = np.where(self.materials.liquid, self.ratio, ONE)
        for place, node, weight in stencil.nodes():
            value = centre
            for axis in range(3):
                value = value + Float(place[axis] - 1) * slope[:, :, axis]
            for axis in range(3):
                rounded = fixed(weight * value[:, axis], self.velocity_scale)
                np.add.at(sums[axis], node, rounded)
            np.add.at(sums[3], node, fixed(weight * ratio, WEIGHT_SCALE))
            np.add.at(sums[4], node, fixed(weight, WEIGHT_SCALE))
        return sums

    def grid_update(self, sums: Sums) -> tuple[Floats, Floats, Floats]:
        """Return nodal velocity, density and J after gravity and walls."""
        p = self.p
        low = p.wall
        high = p.grid - p.wall
        filled = sums[4] > 0
        unit = Float(WEIGHT_SCALE)
        weight = sums[4].astype(Float) / unit
        count = np.where(filled, weight, ONE)
        velocity = sums[:3].astype(Float) / Float(self.velocity_scale)
        velocity = velocity / count
        velocity[1] -= Float(p.gravity * p.dt)
        velocity = np.where(filled, velocity, ZERO)
        jacobian = sums[3].astype(Float) / unit / count
        jacobian = np.where(filled, jacobian, ONE)

        index = np.arange(p.grid + 1)
        mirrored = sums[4].copy()
        for axis in range(3):
            shape = [1, 1, 1]
            shape[axis] = -1
            below = (index <= low).reshape(shape)
            above = (index >= high).reshape(shape)
            self.wall_contact(velocity, axis, below, above)
            along = np.moveaxis(mirrored, axis, 0)
            mirror_counts(along, low, high)
        density = mirrored.astype(Float) / unit * self.node_share
        density = np.where(filled, density, ZERO)
        return velocity, density, jacobian

    def wall_contact(
        self,
        velocity: Floats,
        axis: int,
        below: Mask,
        above: Mask,
    ) -> None:
        """Remove the outward normal velocity; friction brakes the tangential one."""
        normal = velocity[axis].copy()
        hits_low = below & (normal < 0)
        hits_high = above & (normal > 0)
        hits = hits_low | hits_high
        first = velocity[(axis + 1) % 3]
        second = velocity[(axis + 2) % 3]
        sliding = np.sqrt(first * first + second * second)
        safe_sliding = np.maximum(sliding, Float(1e-9))
        loss = self.friction * np.abs(normal) / safe_sliding
        braked = np.maximum(ZERO, ONE - loss)
        kept = np.where(hits, braked, ONE)
        first *= kept
        second *= kept
        velocity[axis] = np.where(hits, ZERO, normal)

    def to_particles(
        self,
        stencil: Stencil,
        velocity: Floats,
        density: Floats,
        jacobian: Floats,
    ) -> None:
        """Gather velocity, gradient, density and J; move; update the constitutive
        state.
        """
        p = self.p
        gathered = np.zeros_like(self.velocity)
        slope = np.zeros_like(self.affine)
        r = np.zeros_like(self.ratio)
        smooth = np.zeros_like(self.ratio)
        for place, node, weight in stencil.nodes():
            nodal_velocity = velocity[(slice(None), *node)].T
            part = weight[:, None] * nodal_velocity
            gathered = gathered + part
            for axis in range(3):
                distance = Float(place[axis] - 1) - stencil.offset[:, axis]
                slope[:, :, axis] += distance[:, None] * part
            r = r + weight * density[node]
            smooth = smooth + weight * jacobian[node]
        self.affine = Float(4 * p.grid) * slope
        self.velocity = gathered
        step = Float(p.dt) * self.velocity
        self.position = stay_inside(p, self.position + step)
        old = self.ratio
        xx, yy, zz = self.affine.diagonal(axis1=1, axis2=2).T
        j = volume_ratio(
            p,
            old,
            divergence=(xx + yy) + zz,
            smooth=smooth,
            density=r,
        )
        self.ratio = np.where(self.materials.liquid, j, old)
        self.deform()

    def deform(self) -> None:
        """F <- (I + dt C) F for solids; snow then yields."""
        p = self.p
        rise = Float(p.dt) * times(self.affine, self.deformation)
        trial = self.deformation + rise
        square = times(trial, transposed(trial))
        squares, axes = principal_axes(square)
        stretches = np.sqrt(np.maximum(squares, ZERO))
        stretches = np.maximum(stretches, LEAST_STRETCH)
        low = Float(1 - p.snow_compression)
        high = Float(1 + p.snow_stretch)
        clamped = np.clip(stretches, low, high)
        shrink = clamped / stretches
        shrunk_axes = axes * shrink[:, None, :]
        yielded = times(shrunk_axes, transposed(axes))
        elastic = times(yielded, trial)
        x, y, z = (stretches / clamped).T
        least = Float(p.snow_jp_min)
        most = Float(p.snow_jp_max)
        plastic = np.clip(self.ratio * (x * y * z), least, most)
        self.ratio = np.where(self.materials.snow, plastic, self.ratio)
        is_snow = self.materials.snow[:, None, None]
        is_liquid = self.materials.liquid[:, None, None]
        deformed = np.where(is_snow, elastic, trial)
        self.deformation = np.where(is_liquid, self.deformation, deformed)
