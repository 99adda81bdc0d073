"""The free-surface solver in plain NumPy float32, written from the equations.

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

from lagbench.generators.split import FreeSurfaceParameters, InitialState, Material

Float = np.float32
Floats = NDArray[np.float32]
Components = tuple[Floats, Floats, Floats, Floats]

ONE = Float(1.0)
TWO = Float(2.0)
HALF = Float(0.5)
WEIGHT_SCALE = 2.0**50


def lame(young: float, poisson: float) -> tuple[float, float]:
    """Lame's constants in float64."""
    mu = young / (2 * (1 + poisson))
    la = young * poisson / ((1 + poisson) * (1 - 2 * poisson))
    return mu, la


def fixed(value: Floats, scale: float) -> NDArray[np.int64]:
    """Round to the nearest multiple of 1/scale, ties to even, as an integer."""
    return np.rint(value.astype(np.float64) * scale).astype(np.int64)


def exp(z: Floats) -> Floats:
    """Degree-6 Taylor polynomial of z/16, squared four times."""
    t = z * Float(1 / 16)
    tt = t * t
    high = (Float(1 / 24) + t * Float(1 / 120)) + tt * Float(1 / 720)
    e = (ONE + t) + tt * ((HALF + t * Float(1 / 6)) + tt * high)
    for _ in range(4):
        e = e * e
    return e.astype(Float)


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
        sin = np.where(turns, g * inverse, Float(0))
        return cls(q, cos, sin, HALF * (a - d), HALF * (c + b))


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
        return cls(base, d, (low, mid, high))

    def nodes(
        self,
    ) -> Iterator[tuple[NDArray[np.int32], NDArray[np.int32], Floats, Floats, Floats]]:
        """Yield node i, node k, weight and offsets x, y [cells] of the nine nodes."""
        for i, k in np.ndindex(3, 3):
            weight = self.weights[i][:, 0] * self.weights[k][:, 1]
            offset_x = Float(i) - self.distance[:, 0]
            offset_y = Float(k) - self.distance[:, 1]
            node_i = self.base[:, 0] + i
            node_k = self.base[:, 1] + k
            yield node_i, node_k, weight, offset_x, offset_y


class FreeSurfaceReference:
    """One scenario of the free-surface solver."""

    def __init__(self, parameters: FreeSurfaceParameters, state: InitialState) -> None:
        """Start from a state; constants are computed in float64, then rounded once."""
        p = parameters
        self.p = parameters
        count = len(state.position)
        self.position = state.position.astype(Float)  # [length], shape [particle, 2]
        self.velocity = state.velocity.astype(Float)  # [length/s], shape [particle, 2]
        # C [1/s] and F [1], components (xx, xy, yx, yy) of shape [particle]
        self.affine: Components = tuple(state.affine.reshape(count, 4).T.astype(Float))
        ones = np.ones(count, Float)
        zeros = np.zeros(count, Float)
        self.deformation: Components = (ones, zeros, zeros, ones)
        self.ratio = ones  # J of liquid, Jp of snow, 1 elsewhere [1], shape [particle]
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
        self.node_share = Float(state.area / count * p.grid**2)
        # Velocities up to 64 cells per substep, in 62 bits less those of the particle
        # count.
        bits = min(50, 62 - (count - 1).bit_length())
        speed_bits = int(np.ceil(np.log2(64 / (p.grid * p.dt))))
        self.velocity_scale = 2.0 ** (bits - speed_bits)

    def advance(self, substeps: int) -> None:
        """Run substeps."""
        for _ in range(substeps):
            stencil = Stencil.at(self.position, self.p.grid)
            nodes = self.grid_update(self.to_grid(stencil))
            self.to_particles(stencil, *nodes)

    def stress(self) -> tuple[Floats, Floats, Floats]:
        """Kirchhoff stress (xx, xy, yy)."""
        p = self.p
        f = PolarParts.of(self.deformation)
        exponent = Float(p.snow_hardening) * (ONE - self.ratio)
        exponent = np.clip(exponent, Float(-4), Float(4))
        softest = Float(p.snow_hardening_min)
        hardest = Float(p.snow_hardening_max)
        stiff = np.clip(exp(exponent), softest, hardest)
        factor = np.where(self.snow, stiff, ONE)
        mu = self.mu * factor
        la = self.la * factor
        square = f.h * f.h + f.k * f.k
        jacobian = f.q * f.q - square
        volumetric = la * (jacobian - ONE) * jacobian
        mean = TWO * mu * (f.q * (f.q - ONE) + square) + volumetric
        stretch = TWO * mu * (TWO * f.q - ONE)
        normal = stretch * (f.cos * f.h - f.sin * f.k)
        xy = stretch * (f.cos * f.k + f.sin * f.h)
        xx = mean + normal
        yy = mean - normal
        pressure = Float(p.liquid_modulus) * (self.ratio - ONE)
        cxx, cxy, cyx, cyy = self.affine
        return (
            np.where(self.liquid, pressure, xx) + TWO * self.viscosity * cxx,
            np.where(self.liquid, Float(0), xy) + self.viscosity * (cxy + cyx),
            np.where(self.liquid, pressure, yy) + TWO * self.viscosity * cyy,
        )

    def to_grid(self, stencil: Stencil) -> NDArray[np.int64]:
        """Sum weighted velocity (x, y), weights and weighted J at the nodes.

        The shape is [4, node, node]. All particles of a scenario weigh the same, so
        that their mass cancels.
        """
        nodes = self.p.grid + 1
        dx = Float(1 / self.p.grid)
        sums = np.zeros((4, nodes, nodes), np.int64)
        xx, xy, yy = self.stress()
        cxx, cxy, cyx, cyy = self.affine
        s = Float(4 * self.p.dt * self.p.grid / self.p.density)
        slopes_x = cxx * dx - s * xx, cyx * dx - s * xy
        slopes_y = cxy * dx - s * xy, cyy * dx - s * yy
        x, y = (stencil.distance - ONE).T
        jacobian = np.where(self.liquid, self.ratio, ONE)
        for component in range(2):
            a = slopes_x[component]
            b = slopes_y[component]
            centre = self.velocity[:, component] - x * a - y * b
            pairs = zip(np.ndindex(3, 3), stencil.nodes(), strict=True)
            for (i, k), (node_i, node_k, w, _, _) in pairs:
                value = w * ((centre + Float(i - 1) * a) + Float(k - 1) * b)
                rounded = fixed(value, self.velocity_scale)
                np.add.at(sums[component], (node_i, node_k), rounded)
        for node_i, node_k, w, _, _ in stencil.nodes():
            np.add.at(sums[2], (node_i, node_k), fixed(w, WEIGHT_SCALE))
            np.add.at(sums[3], (node_i, node_k), fixed(w * jacobian, WEIGHT_SCALE))
        return sums

    def grid_update(
        self, sums: NDArray[np.int64]
    ) -> tuple[Floats, Floats, Floats, Floats]:
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
        u = np.where(filled, px / n, Float(0))
        v = np.where(filled, py / n - Float(self.p.gravity * self.p.dt), Float(0))
        index = np.arange(self.p.grid + 1)
        below = index <= low
        above = index >= high
        u, v = self.wall_contact(u, v, below[:, None], above[:, None])
        v, u = self.wall_contact(v, u, below[None, :], above[None, :])
        mirrored = sums[2].copy()
        for count in (mirrored, mirrored.T):
            for wall, inside, outside in (
                (low, low + 1, low - 1),
                (high, high - 1, high + 1),
            ):
                count[wall] *= 2
                count[inside] += count[outside]
                count[outside] = count[inside]
        density = mirrored.astype(Float) / Float(WEIGHT_SCALE) * self.node_share
        return u, v, density, np.where(filled, mj / n, ONE)

    def wall_contact(
        self,
        normal: Floats,
        tangential: Floats,
        below: NDArray[np.bool_],
        above: NDArray[np.bool_],
    ) -> tuple[Floats, Floats]:
        """Remove the outward normal velocity; friction brakes the tangential one."""
        hits = (below & (normal < 0)) | (above & (normal > 0))
        sliding = np.maximum(np.abs(tangential), Float(1e-9))
        loss = self.friction * np.abs(normal) / sliding
        braked = tangential * np.maximum(Float(0), ONE - loss)
        return np.where(hits, Float(0), normal), np.where(hits, braked, tangential)

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
        self.affine = (scale * cxx, scale * cxy, scale * cyx, scale * cyy)
        self.velocity = np.stack([vx, vy], 1)
        dx = 1 / self.p.grid
        low = Float((self.p.wall + 1e-3) * dx)
        high = Float((self.p.grid - self.p.wall - 1e-3) * dx)
        moved = self.position + Float(self.p.dt) * self.velocity
        self.position = np.clip(moved, low, high)
        # J <- J (1 + dt tr C) + kappa (Jbar - J); J <- J + theta (1 / max(r, 1) - J);
        # limits.
        p = self.p
        old = self.ratio
        j = old + Float(p.dt) * (self.affine[0] + self.affine[3]) * old
        j = j + Float(p.jacobian_relaxation) * (smooth - old)
        j = j + Float(p.density_coupling) * (ONE / np.maximum(r, ONE) - j)
        j = np.clip(j, Float(p.jacobian_min), Float(p.jacobian_max))
        self.ratio = np.where(self.liquid, j, old)
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
        shrink = np.where(sheared, HALF * (first - second) / divisor, Float(0))
        mean = HALF * (first + second)
        e = mean * f.cos
        g = mean * f.sin
        h = shrink * f.h
        k = shrink * f.k
        least_stretch = Float(0.1)
        trial_first = np.maximum(f.q + r, least_stretch)
        trial_second = np.maximum(f.q - r, least_stretch)
        factor = trial_first * trial_second / (first * second)
        plastic_min = Float(self.p.snow_jp_min)
        plastic_max = Float(self.p.snow_jp_max)
        plastic = np.clip(self.ratio * factor, plastic_min, plastic_max)
        self.ratio = np.where(self.snow, plastic, self.ratio)
        elastic = (e + h, k - g, k + g, e - h)
        components = []
        for old, yielded, new in zip(self.deformation, elastic, trial, strict=True):
            solid = np.where(self.snow, yielded, new)
            components.append(np.where(self.liquid, old, solid))
        self.deformation = tuple(components)  # type: ignore[assignment]
