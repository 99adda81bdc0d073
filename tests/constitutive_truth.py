"""Truth for the constitutive models in two and three dimensions: SciPy's decompositions
and finite differences.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import polar

from lagbench.generators.constitutive import lame

Single = NDArray[np.float32]
Double = NDArray[np.float64]

MU, LAMBDA = lame(30.0, 0.3)
LOW = 1.0 - 2.5e-2
"""Least stretch of snow that does not yield."""

HIGH = 1.0 + 4.5e-3
"""Greatest stretch of snow that does not yield."""


def draw_near_identity(
    rng: np.random.Generator, count: int, dimension: int, spread: float
) -> Double:
    """Draw matrices near the identity, shape [count, dimension, dimension]."""
    share = rng.random((count, dimension, dimension))
    deviation = 2.0 * share - 1.0
    return np.eye(dimension) + spread * deviation


def corotated_energy(f: Double) -> float:
    """Fixed corotated energy mu |F - R|^2 + lambda/2 (J - 1)^2, R from SciPy."""
    rotation, _ = polar(f)
    difference = f - rotation
    shear = (difference**2).sum()
    bulk = (np.linalg.det(f) - 1.0) ** 2
    return float(MU * shear + 0.5 * LAMBDA * bulk)


def corotated_stress(f: Double) -> Double:
    """(d psi / dF) F^T of a gradient, psi differentiated by central differences."""
    step = 1e-6
    gradient = np.empty_like(f)
    for entry in np.ndindex(f.shape):
        shift = np.zeros_like(f)
        shift[entry] = step
        rise = corotated_energy(f + shift) - corotated_energy(f - shift)
        gradient[entry] = rise / (2.0 * step)
    return gradient @ f.T


def clamped_stretches(f: Single) -> tuple[Double, Double]:
    """U clamp(Sigma) V^T of gradients by NumPy's SVD, and the volume that is left."""
    u, sigma, vt = np.linalg.svd(f.astype(np.float64))
    clamped = np.clip(sigma, LOW, HIGH)
    elastic = u @ (clamped[:, :, None] * vt)
    ratio = sigma.prod(1) / clamped.prod(1)
    return elastic, ratio
