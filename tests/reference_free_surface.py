"""The free-surface solver of the plane in plain NumPy float32, from the equations.

Independent of Taichi and of ``generators/``: it reads only parameters and initial
states. Every operation rounds to float32 in the order in which the equation is written;
sums over particles are 64-bit integers. Slow (two to three microseconds per particle
and substep) and plain.
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

Nodes = NDArray[np.int32]
Components = tuple[Floats, Floats, Floats, Floats]


@dataclass
class PolarParts:
    """F = q R + [[h, k], [k, -h]], with the rotation R = [[cos, -sin], [sin, cos]]."""

    q: Floats
    cos: Floats
    sin: Floats
    h: Floats
    k: Floats

    @classmethod
    def of(cls, f: Components) -> PolarParts:
        """Divide gradients into a scaled rotation and a scaled reflection."""
        a, b, c, d = f
        e = HALF * (a + d)
        g = HALF * (c - b)
        q = np.sqrt(e * e + g * g)
        turns = q > Float(1e-6)
        inverse = ONE / np.where(turns, q, ONE)
        cos = np.where(turns, e * inverse, ONE)
        sin = np.where(turns, g * inverse, ZERO)
        h = HALF * (a - d)
        k = HALF * (c + b)
        return cls(q, cos, sin, h, k)


@dataclass
class Stencil:
    """Where a particle touches the grid.

    These are the lowest node, the distance to it [cells] and the weights per axis.
    """

    base: NDArray[np.int32]
    distance: Floats
    weights: tuple[Floats, Floats, Floats]

    @classmethod
    def at(cls, position: Floats, grid: int) -> Stencil:
        """Quadratic B-spline around positions of shape [particle, 2]."""
        scaled = position * Float(grid)
        base = (scaled - HALF).astype(np.int32)
        d = scaled - base.astype(Float)
        outer = Float(1.5) - d
        middle = d - ONE
        inner = d - HALF
        low = HALF * (outer * outer)
        mid = Float(0.75) - middle * middle
        high = HALF * (inner * inner)
        weights = (low, mid, high)
        return cls(base, d, weights)

    def nodes(self) -> Iterator[tuple[Nodes, Nodes, Floats, Floats, Floats]]:
        """Yield node i, node k, weight and offsets x, y [cells] of the nine nodes."""
        for i, k in np.ndindex(3, 3):
            along_x = self.weights[i][:, 0]
            along_y = self.weights[k][:, 1]
            weight = along_x * along_y
            offset_x = Float(i) - self.distance[:, 0]
            offset_y = Float(k) - self.distance[:, 1]
            node_i = self.base[:, 0] + i
            node_k = self.base[:, 1] + k
            yield node_i, node_k, weight, offset_x, offset_y


class FreeSurfaceReference:
    """One scenario of the free-surface solver."""

    def __init__(
        self,
        parameters: FreeSurfaceParameters,
        state: InitialState,
    ) -> None:
        """Start from a state; constants are computed in float64, then rounded once."""
        p = parameters
        self.p = parameters
        count = len(state.position)
        self.position = state.position.astype(Float)  # [length], shape [particle, 2]
        self.velocity = state.velocity.astype(Float)  # [length/s], shape [particle, 2]
        # C [1/s] and F [1], components (xx, xy, yx, yy) of shape [particle]
        components = state.affine.reshape(count, 4).T
        self.affine: Components = tuple(components.astype(Float))
        ones = np.ones(count, Float)
        zeros = np.zeros(count, Float)
        self.deformation: Components = (ones, zeros, zeros, ones)
        self.ratio = ones  # J of liquid, Jp of snow, 1 elsewhere [1], shape [particle]
        self.materials = Materials.of(p, state.material)
        self.friction = Float(state.friction)
        share = state.area / count * p.grid**2
        self.node_share = Float(share)
        self.velocity_scale = velocity_scale(p, count, 64)

    def advance(self, substeps: int) -> None:
        """Run substeps."""
        for _ in range(substeps):
            stencil = Stencil.at(self.position, self.p.grid)
            sums = self.to_grid(stencil)
            nodes = self.grid_update(sums)
            self.to_particles(stencil, *nodes)

    def stress(self) -> tuple[Floats, Floats, Floats]:
        """Kirchhoff stress (xx, xy, yy)."""
        p = self.p
        f = PolarParts.of(self.deformation)
        materials = self.materials
        stiff = hardening(p, self.ratio)
        factor = np.where(materials.snow, stiff, ONE)
        mu = materials.mu * factor
        la = materials.la * factor
        square = f.h * f.h + f.k * f.k
        jacobian = f.q * f.q - square
        volumetric = la * (jacobian - ONE) * jacobian
        isotropic = f.q * (f.q - ONE) + square
        mean = TWO * mu * isotropic + volumetric
        stretch = TWO * mu * (TWO * f.q - ONE)
        along = f.cos * f.h - f.sin * f.k
        across = f.cos * f.k + f.sin * f.h
        normal = stretch * along
        xy = stretch * across
        xx = mean + normal
        yy = mean - normal
        pressure = Float(p.liquid_modulus) * (self.ratio - ONE)
        cxx, cxy, cyx, cyy = self.affine
        viscosity = materials.viscosity
        elastic_xx = np.where(materials.liquid, pressure, xx)
        elastic_xy = np.where(materials.liquid, ZERO, xy)
        elastic_yy = np.where(materials.liquid, pressure, yy)
        return (
            elastic_xx + TWO * viscosity * cxx,
            elastic_xy + viscosity * (cxy + cyx),
            elastic_yy + TWO * viscosity * cyy,
        )

    def to_grid(self, stencil: Stencil) -> Sums:
        """Sum weighted velocity (x, y), weights and weighted J at the nodes.

        The shape is [4, node, node]. All particles of a scenario weigh the same, so
        that their mass cancels.
        """
        nodes = self.p.grid + 1
        dx = Float(1 / self.p.grid)
        sums = np.zeros((4, nodes, nodes), dtype=np.int64)
        xx, xy, yy = self.stress()
        cxx, cxy, cyx, cyy = self.affine
        s = Float(4 * self.p.dt * self.p.grid / self.p.density)
        slopes_x = (cxx * dx - s * xx, cyx * dx - s * xy)
        slopes_y = (cxy * dx - s * xy, cyy * dx - s * yy)
        x, y = (stencil.distance - ONE).T
        jacobian = np.where(self.materials.liquid, self.ratio, ONE)
        for component in range(2):
            a = slopes_x[component]
            b = slopes_y[component]
            centre = self.velocity[:, component] - x * a
            centre = centre - y * b
            steps = np.ndindex(3, 3)
            for (i, k), node in zip(steps, stencil.nodes(), strict=True):
                node_i, node_k, w, _, _ = node
                velocity = centre + Float(i - 1) * a
                velocity = velocity + Float(k - 1) * b
                rounded = fixed(w * velocity, self.velocity_scale)
                np.add.at(sums[component], (node_i, node_k), rounded)
        for node_i, node_k, w, _, _ in stencil.nodes():
            node = (node_i, node_k)
            weight = fixed(w, WEIGHT_SCALE)
            weighted_jacobian = fixed(w * jacobian, WEIGHT_SCALE)
            np.add.at(sums[2], node, weight)
            np.add.at(sums[3], node, weighted_jacobian)
        return sums

    def grid_update(self, sums: Sums) -> Components:
        """Return nodal velocity (x, y), density and J after gravity and walls."""
        low = self.p.wall
        high = self.p.grid - self.p.wall
        filled = sums[2] > 0
        px, py, n, mj = sums.astype(Float)
        px = px / Float(self.velocity_scale)
        py = py / Float(self.velocity_scale)
        n = n / Float(WEIGHT_SCALE)
        mj = mj / Float(WEIGHT_SCALE)
        n = np.where(filled, n, ONE)
        fall = Float(self.p.gravity * self.p.dt)
        u = np.where(filled, px / n, ZERO)
        v = np.where(filled, py / n - fall, ZERO)
        index = np.arange(self.p.grid + 1)
        below = index <= low
        above = index >= high
        left = below[:, None]
        right = above[:, None]
        bottom = below[None, :]
        top = above[None, :]
        u, v = self.wall_contact(u, v, left, right)
        v, u = self.wall_contact(v, u, bottom, top)
        mirrored = sums[2].copy()
        for count in (mirrored, mirrored.T):
            mirror_counts(count, low, high)
        counts = mirrored.astype(Float) / Float(WEIGHT_SCALE)
        density = counts * self.node_share
        jacobian = np.where(filled, mj / n, ONE)
        return u, v, density, jacobian

    def wall_contact(
        self,
        normal: Floats,
        tangential: Floats,
        below: Mask,
        above: Mask,
    ) -> tuple[Floats, Floats]:
        """Remove the outward normal velocity; friction brakes the tangential one."""
        hits_low = below & (normal < 0)
        hits_high = above & (normal > 0)
        hits = hits_low | hits_high
        speed = np.abs(tangential)
        sliding = np.maximum(speed, Float(1e-9))
        loss = self.friction * np.abs(normal) / sliding
        braked = tangential * np.maximum(ZERO, ONE - loss)
        new_normal = np.where(hits, ZERO, normal)
        new_tangential = np.where(hits, braked, tangential)
        return new_normal, new_tangential

    def to_particles(
        self,
        stencil: Stencil,
        u: Floats,
        v: Floats,
        density: Floats,
        jacobian: Floats,
    ) -> None:
        """Gather velocity, gradient, density and J; move; update the constitutive
        state.
        """
        zeros = np.zeros(len(self.position), Float)
        vx = vy = cxx = cxy = cyx = cyy = r = smooth = zeros
        for i, k, w, ox, oy in stencil.nodes():
            x = w * u[i, k]
            y = w * v[i, k]
            vx = vx + x
            vy = vy + y
            cxx = cxx + x * ox
            cxy = cxy + x * oy
            cyx = cyx + y * ox
            cyy = cyy + y * oy
            r = r + w * density[i, k]
            smooth = smooth + w * jacobian[i, k]
        scale = Float(4 * self.p.grid)
        self.affine = (
            scale * cxx,
            scale * cxy,
            scale * cyx,
            scale * cyy,
        )
        self.velocity = np.stack([vx, vy], 1)
        step = Float(self.p.dt) * self.velocity
        self.position = stay_inside(self.p, self.position + step)
        old = self.ratio
        j = volume_ratio(
            self.p,
            old,
            divergence=self.affine[0] + self.affine[3],
            smooth=smooth,
            density=r,
        )
        self.ratio = np.where(self.materials.liquid, j, old)
        self.deform()

    def deform(self) -> None:
        """F <- (I + dt C) F for solids; snow then yields."""
        a, b, c, d = self.deformation
        cxx, cxy, cyx, cyy = self.affine
        dt = Float(self.p.dt)
        trial = (
            a + dt * (cxx * a + cxy * c),
            b + dt * (cxx * b + cxy * d),
            c + dt * (cyx * a + cyy * c),
            d + dt * (cyx * b + cyy * d),
        )
        # Snow: the principal stretches are clamped; Jp takes the rest.
        low = Float(1 - self.p.snow_compression)
        high = Float(1 + self.p.snow_stretch)
        f = PolarParts.of(trial)  # type: ignore[arg-type]
        r = np.sqrt(f.h * f.h + f.k * f.k)
        first = np.clip(f.q + r, low, high)
        second = np.clip(f.q - r, low, high)
        sheared = r > Float(1e-12)
        divisor = np.where(sheared, r, ONE)
        half_shear = HALF * (first - second)
        shrink = np.where(sheared, half_shear / divisor, ZERO)
        mean = HALF * (first + second)
        e = mean * f.cos
        g = mean * f.sin
        h = shrink * f.h
        k = shrink * f.k
        least_stretch = Float(0.1)
        trial_first = np.maximum(f.q + r, least_stretch)
        trial_second = np.maximum(f.q - r, least_stretch)
        trial_product = trial_first * trial_second
        factor = trial_product / (first * second)
        plastic_min = Float(self.p.snow_jp_min)
        plastic_max = Float(self.p.snow_jp_max)
        plastic = np.clip(self.ratio * factor, plastic_min, plastic_max)
        self.ratio = np.where(self.materials.snow, plastic, self.ratio)
        elastic = (
            e + h,
            k - g,
            k + g,
            e - h,
        )
        components = []
        for number, old in enumerate(self.deformation):
            solid = np.where(self.materials.snow, elastic[number], trial[number])
            component = np.where(self.materials.liquid, old, solid)
            components.append(component)
        self.deformation = tuple(components)  # type: ignore[assignment]
