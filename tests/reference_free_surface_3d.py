"""The free-surface solver in three dimensions in plain NumPy float32, written from the
equations.

Independent of Taichi and of ``generators/``: it reads only parameters and initial
states. Every operation rounds to float32 in the order in which the equation is written;
sums over particles are 64-bit integers. Slow and plain.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from reference_free_surface import WEIGHT_SCALE, exp, fixed, lame

from lagbench.generators.split import FreeSurfaceParameters, InitialState, Material

Float = np.float32
Floats = NDArray[np.float32]
Nodes = tuple[NDArray[np.integer], ...]

NEWTON_STEPS = 6
SWEEPS = 4
EPSILON = Float(1e-6)
LEAST_STRETCH = Float(0.1)


def times(a: Floats, b: Floats) -> Floats:
    """Return the products of matrices, shape [particle, 3, 3], summed from the left."""
    first = a[:, :, 0, None] * b[:, None, 0, :]
    second = a[:, :, 1, None] * b[:, None, 1, :]
    third = a[:, :, 2, None] * b[:, None, 2, :]
    return np.asarray((first + second) + third)


def transposed(a: Floats) -> Floats:
    """Return the transposed matrices."""
    return a.transpose(0, 2, 1)


def determinant(f: Floats) -> Floats:
    """Return det F, expanded along the first row."""
    (a, b, c), (d, e, g), (h, i, j) = f.transpose(1, 2, 0)
    return np.asarray((a * (e * j - g * i) - b * (d * j - g * h)) + c * (d * i - e * h))


def left_stretch(b: Floats, jacobian: Floats) -> Floats:
    """V of F = V R from B = V^2 and J: the trace by Newton, then Cayley-Hamilton."""
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = b.transpose(1, 2, 0)
    square = (xx + yy) + zz
    minors = ((xx * yy - xy * xy) + (yy * zz - yz * yz)) + (xx * zz - xz * xz)
    total = np.sqrt(Float(3) * square)
    for _ in range(NEWTON_STEPS):
        gap = total * total - square
        value = (gap * gap - Float(8) * jacobian * total) - Float(4) * minors
        slope = Float(4) * total * gap - Float(8) * jacobian
        total = total - value / np.maximum(slope, EPSILON)
    pairs = Float(0.5) * (total * total - square)
    inverse = Float(1) / np.maximum(pairs * total - jacobian, EPSILON)
    v = (pairs + square)[:, None, None] * b - times(b, b)
    for axis in range(3):
        v[:, axis, axis] += total * jacobian
    return np.asarray(inverse[:, None, None] * v)


def principal_axes(b: Floats) -> tuple[Floats, Floats]:
    """Eigenvalues and eigenvectors (columns) of symmetric matrices: Jacobi's method."""
    a = b.copy()
    axes = np.tile(np.eye(3, dtype=Float), (len(b), 1, 1))
    for _, (p, q) in product(range(SWEEPS), ((0, 1), (0, 2), (1, 2))):
        r = 3 - p - q
        entry = a[:, p, q].copy()
        double = Float(2) * entry
        difference = a[:, q, q] - a[:, p, p]
        root = np.sqrt(difference * difference + double * double)
        divisor = difference + np.where(difference < 0, -root, root)
        diagonal = divisor == 0
        tangent = np.where(
            diagonal, Float(0), double / np.where(diagonal, Float(1), divisor)
        )
        cosine = Float(1) / np.sqrt(tangent * tangent + Float(1))
        sine = tangent * cosine
        a[:, p, p] -= tangent * entry
        a[:, q, q] += tangent * entry
        a[:, p, q] = a[:, q, p] = 0
        old_p = a[:, r, p].copy()
        old_q = a[:, r, q].copy()
        a[:, r, p] = a[:, p, r] = cosine * old_p - sine * old_q
        a[:, r, q] = a[:, q, r] = sine * old_p + cosine * old_q
        column_p = axes[:, :, p].copy()
        column_q = axes[:, :, q].copy()
        c = cosine[:, None]
        s = sine[:, None]
        axes[:, :, p] = c * column_p - s * column_q
        axes[:, :, q] = s * column_p + c * column_q
    return np.diagonal(a, axis1=1, axis2=2), axes


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
        scaled = position * Float(grid)
        base = (scaled - Float(0.5)).astype(np.int32)
        distance = scaled - base.astype(Float)
        outer = Float(1.5) - distance
        middle = distance - Float(1)
        inner = distance - Float(0.5)
        low = Float(0.5) * (outer * outer)
        mid = Float(0.75) - middle * middle
        high = Float(0.5) * (inner * inner)
        return cls(base, middle, np.stack([low, mid, high]))

    def nodes(self) -> Iterator[tuple[tuple[int, int, int], Nodes, Floats]]:
        """Yield the place in the stencil, the nodes and the weights of all 27."""
        for i, j, k in np.ndindex(3, 3, 3):
            share = self.weights[i][:, 0] * self.weights[j][:, 1]
            node = tuple((self.base + np.array([i, j, k], np.int32)).T)
            yield (i, j, k), node, share * self.weights[k][:, 2]


class FreeSurfaceReference3D:
    """One scenario of the free-surface solver in a cube."""

    def __init__(self, parameters: FreeSurfaceParameters, state: InitialState) -> None:
        """Start from a state; constants are computed in float64, then rounded once."""
        p = parameters
        self.p = parameters
        count = len(state.position)
        self.position = state.position.astype(Float)  # [length], shape [particle, 3]
        self.velocity = state.velocity.astype(Float)  # [length/s]
        self.affine = state.affine.astype(Float)  # C [1/s], shape [particle, 3, 3]
        self.deformation = np.tile(np.eye(3, dtype=Float), (count, 1, 1))  # F [1]
        self.ratio = np.ones(count, Float)  # J of liquid, Jp of snow, 1 elsewhere [1]
        self.liquid = state.material == Material.LIQUID
        self.snow = state.material == Material.SNOW
        moduli = {
            Material.LIQUID: (0.0, 0.0),
            Material.JELLY: lame(p.jelly_modulus, p.jelly_poisson),
            Material.SNOW: lame(p.snow_modulus, p.snow_poisson),
            Material.ROPE: lame(p.rope_modulus, p.rope_poisson),
        }
        constants = [moduli[Material(m)] for m in state.material]
        self.mu, self.la = np.array(constants, Float).T
        damping = np.where(self.snow, 0.0, p.elastic_damping)
        kinematic = np.where(self.liquid, p.liquid_viscosity, damping)
        self.viscosity = (p.density * kinematic).astype(Float)
        self.friction = Float(state.friction)
        self.node_share = Float(state.area / count * p.grid**3)
        # Velocities up to 128 cells per substep, in 62 bits less those of the particle
        # count.
        bits = min(50, 62 - (count - 1).bit_length())
        speed_bits = int(np.ceil(np.log2(128 / (p.grid * p.dt))))
        self.velocity_scale = 2.0 ** (bits - speed_bits)

    def advance(self, substeps: int) -> None:
        """Run substeps."""
        for _ in range(substeps):
            stencil = Stencil.at(self.position, self.p.grid)
            self.to_particles(stencil, *self.grid_update(self.to_grid(stencil)))

    def stress(self) -> Floats:
        """Kirchhoff stress, shape [particle, 3, 3]."""
        p = self.p
        exponent = Float(p.snow_hardening) * (Float(1) - self.ratio)
        exponent = np.clip(exponent, Float(-4), Float(4))
        softest = Float(p.snow_hardening_min)
        hardest = Float(p.snow_hardening_max)
        stiff = np.clip(exp(exponent), softest, hardest)
        factor = np.where(self.snow, stiff, Float(1))
        mu = self.mu * factor
        la = self.la * factor
        b = times(self.deformation, transposed(self.deformation))
        jacobian = determinant(self.deformation)
        elastic = (Float(2) * mu)[:, None, None] * (b - left_stretch(b, jacobian))
        volumetric = la * (jacobian - Float(1)) * jacobian
        pressure = Float(p.liquid_modulus) * (self.ratio - Float(1))
        for axis in range(3):
            elastic[:, axis, axis] += volumetric
        for row, column in np.ndindex(3, 3):
            isotropic = pressure if row == column else Float(0)
            elastic[:, row, column] = np.where(
                self.liquid, isotropic, elastic[:, row, column]
            )
        shear = self.affine + transposed(self.affine)
        return np.asarray(self.viscosity[:, None, None] * shear + elastic)

    def to_grid(self, stencil: Stencil) -> NDArray[np.int64]:
        """Sum weighted velocity (x, y, z), weighted J and weights at the nodes.

        The shape is [5, node, node, node]. All particles of a scenario weigh the same,
        so that their mass cancels.
        """
        nodes = self.p.grid + 1
        sums = np.zeros((5, nodes, nodes, nodes), np.int64)
        impulse = Float(4 * self.p.dt * self.p.grid / self.p.density)
        slope = Float(1 / self.p.grid) * self.affine - impulse * self.stress()
        a, b, c = (slope[:, :, axis] for axis in range(3))
        x, y, z = (stencil.offset[:, axis, None] for axis in range(3))
        centre = ((self.velocity - x * a) - y * b) - z * c
        spread = np.where(self.liquid, self.ratio, Float(1))
        for (i, j, k), node, weight in stencil.nodes():
            value = centre + Float(i - 1) * a
            value = value + Float(j - 1) * b
            value = value + Float(k - 1) * c
            for axis in range(3):
                rounded = fixed(weight * value[:, axis], self.velocity_scale)
                np.add.at(sums[axis], node, rounded)
            np.add.at(sums[3], node, fixed(weight * spread, WEIGHT_SCALE))
            np.add.at(sums[4], node, fixed(weight, WEIGHT_SCALE))
        return sums

    def grid_update(self, sums: NDArray[np.int64]) -> tuple[Floats, Floats, Floats]:
        """Return nodal velocity, density and J after gravity and walls."""
        p = self.p
        low = p.wall
        high = p.grid - p.wall
        filled = sums[4] > 0
        count = np.where(filled, sums[4].astype(Float) / Float(WEIGHT_SCALE), Float(1))
        velocity = sums[:3].astype(Float) / Float(self.velocity_scale) / count
        velocity[1] -= Float(p.gravity * p.dt)
        velocity = np.where(filled, velocity, Float(0))
        jacobian = sums[3].astype(Float) / Float(WEIGHT_SCALE) / count
        index = np.arange(p.grid + 1)
        for axis in range(3):
            shape = [1, 1, 1]
            shape[axis] = -1
            below = (index <= low).reshape(shape)
            above = (index >= high).reshape(shape)
            self.wall_contact(velocity, axis, below, above)
        mirrored = sums[4].copy()
        for axis in range(3):
            along = np.moveaxis(mirrored, axis, 0)
            for wall, inside, outside in (
                (low, low + 1, low - 1),
                (high, high - 1, high + 1),
            ):
                along[wall] *= 2
                along[inside] += along[outside]
                along[outside] = along[inside]
        density = mirrored.astype(Float) / Float(WEIGHT_SCALE) * self.node_share
        density = np.where(filled, density, Float(0))
        return velocity, density, np.where(filled, jacobian, Float(1))

    def wall_contact(
        self,
        velocity: Floats,
        axis: int,
        below: NDArray[np.bool_],
        above: NDArray[np.bool_],
    ) -> None:
        """Remove the outward normal velocity; friction brakes the tangential one."""
        normal = velocity[axis].copy()
        hits = (below & (normal < 0)) | (above & (normal > 0))
        first = velocity[(axis + 1) % 3]
        second = velocity[(axis + 2) % 3]
        sliding = np.sqrt(first * first + second * second)
        loss = self.friction * np.abs(normal) / np.maximum(sliding, Float(1e-9))
        kept = np.where(hits, np.maximum(Float(0), Float(1) - loss), Float(1))
        first *= kept
        second *= kept
        velocity[axis] = np.where(hits, Float(0), normal)

    def to_particles(
        self, stencil: Stencil, velocity: Floats, density: Floats, jacobian: Floats
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
            part = weight[:, None] * velocity[(slice(None), *node)].T
            gathered = gathered + part
            for axis in range(3):
                distance = Float(place[axis] - 1) - stencil.offset[:, axis]
                slope[:, :, axis] += distance[:, None] * part
            r = r + weight * density[node]
            smooth = smooth + weight * jacobian[node]
        self.affine = Float(4 * p.grid) * slope
        self.velocity = gathered
        low = Float((p.wall + 1e-3) * (1 / p.grid))
        high = Float((p.grid - p.wall - 1e-3) * (1 / p.grid))
        moved = self.position + Float(p.dt) * self.velocity
        self.position = np.clip(moved, low, high)
        old = self.ratio
        c = self.affine
        divergence = (c[:, 0, 0] + c[:, 1, 1]) + c[:, 2, 2]
        j = old + Float(p.dt) * divergence * old
        j = j + Float(p.jacobian_relaxation) * (smooth - old)
        j = j + Float(p.density_coupling) * (Float(1) / np.maximum(r, Float(1)) - j)
        j = np.clip(j, Float(p.jacobian_min), Float(p.jacobian_max))
        self.ratio = np.where(self.liquid, j, old)
        self.deform()

    def deform(self) -> None:
        """F <- (I + dt C) F for solids; snow then yields."""
        p = self.p
        rise = Float(p.dt) * times(self.affine, self.deformation)
        trial = self.deformation + rise
        squares, axes = principal_axes(times(trial, transposed(trial)))
        stretches = np.sqrt(np.maximum(squares, Float(0)))
        stretches = np.maximum(stretches, LEAST_STRETCH)
        low = Float(1 - p.snow_compression)
        high = Float(1 + p.snow_stretch)
        clamped = np.clip(stretches, low, high)
        scaled = axes * (clamped / stretches)[:, None, :]
        elastic = times(times(scaled, transposed(axes)), trial)
        x, y, z = (stretches / clamped).T
        plastic = np.clip(
            self.ratio * (x * y * z), Float(p.snow_jp_min), Float(p.snow_jp_max)
        )
        self.ratio = np.where(self.snow, plastic, self.ratio)
        is_snow = self.snow[:, None, None]
        is_liquid = self.liquid[:, None, None]
        deformed = np.where(is_snow, elastic, trial)
        self.deformation = np.where(is_liquid, self.deformation, deformed)
