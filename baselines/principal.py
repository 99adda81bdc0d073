"""Leading principal directions of many long rows, by randomised subspace iteration.

Halko, Martinsson, Tropp, SIAM Review 53 (2011) 217: a random subspace somewhat larger than
wanted is multiplied by X'X a few times, then rotated so that X'X is diagonal in it (Rayleigh and
Ritz). Rows pass through in blocks; nothing as large as X'X is formed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import NDArray

__all__ = ["principal_directions"]

Matrix = NDArray[np.float64]

OVERSAMPLING = 20
"""Directions beyond those wanted, which the last wanted ones need to converge."""

ITERATIONS = 8
"""Multiplications by X'X; ratios of neighbouring eigenvalues count to twice this power."""


def principal_directions(
    blocks: Callable[[], Iterable[Matrix]], features: int, *, rank: int
) -> tuple[Matrix, Matrix]:
    """Return orthonormal directions of largest X'X and their eigenvalues, the largest first.

    Args:
        blocks: returns the rows of X in blocks of shape [row, feature], centred; called ten times.
        features: columns of X.
        rank: directions wanted, at most `features`.

    Returns:
        Directions, shape [feature, rank], and eigenvalues, shape [rank].
    """
    width = min(features, rank + OVERSAMPLING)
    basis = np.random.default_rng(0).normal(size=(features, width))
    for _ in range(ITERATIONS):
        basis = np.linalg.qr(_squared(blocks(), basis))[0]
    small = basis.T @ _squared(blocks(), basis)
    values, rotation = np.linalg.eigh((small + small.T) / 2)
    return basis @ rotation[:, ::-1][:, :rank], values[::-1][:rank].clip(0.0)


def _squared(blocks: Iterable[Matrix], basis: Matrix) -> Matrix:
    """Return X'X times a basis."""
    total = np.zeros_like(basis)
    for x in blocks:
        total += x.T @ (x @ basis)
    return total
