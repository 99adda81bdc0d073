"""Linear least squares by the Gram matrix, refined once: small memory, nearly full accuracy.

For regressors X [row, regressor] and responses Y [row, response], with G = X'X + r I

    B = G^-1 X'Y,   then   B <- B + G^-1 X'(Y - X B),

the corrected semi-normal equations (Bjorck, Linear Algebra Appl. 88/89 (1987) 31): the residual is formed
from X itself, so the loss of digits in squaring X is undone while cond(X)^2 is below 1e16. Rows
pass through in blocks; four square matrices are all that is held. With fewer rows than regressors the
solution of least norm comes from the Gram matrix of the rows, B = X' (X X')^-1 Y.

Leading principal directions of many long rows, by randomised subspace iteration.

Halko, Martinsson, Tropp, SIAM Review 53 (2011) 217: a random subspace somewhat larger than
wanted is multiplied by X'X a few times, then rotated so that X'X is diagonal in it (Rayleigh and
Ritz). Rows pass through in blocks; nothing as large as X'X is formed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, blas, cho_factor, cho_solve
from scipy.sparse.linalg import LinearOperator, eigsh

from lagbench.errors import WorkFailedError

__all__ = [
    "Blocks",
    "LeastSquares",
    "solve",
    "principal_directions",
]


Matrix = NDArray[np.float64]

TOLERANCE = 1e-3
"""Relative accuracy of the condition number's two eigenvalues."""


class Blocks(Protocol):
    """Rows of regressors and responses, block by block; may be read more than once."""

    rows: int

    def __iter__(self) -> Iterator[tuple[Matrix, Matrix]]:
        """Yield regressors [row, regressor] and responses [row, response], C-ordered."""
        ...


@dataclass(frozen=True, kw_only=True)
class LeastSquares:
    """The solution and how well it is determined."""

    coefficients: Matrix  # B, shape [regressor, response]
    condition: float  # largest over smallest singular value of X; a lower bound where 'floor' > 0
    # added to the Gram matrix since it was singular to rounding, as a share of its largest
    # eigenvalue; 0 if it was not
    floor: float
    rows: int  # rows that went in


@dataclass(frozen=True)
class _Factor:
    """Cholesky factor of a Gram matrix, upper triangle."""

    upper: Matrix
    condition: float
    floor: float

    def divide(self, right: Matrix) -> Matrix:
        """Return G^-1 times a matrix, in its place when it is Fortran-ordered."""
        solved: Matrix = cho_solve((self.upper, False), right, overwrite_b=True, check_finite=False)
        return solved


def solve(blocks: Blocks) -> LeastSquares:
    """Return the least-squares solution of X B = Y, that of least norm if there are many."""
    shape = next(((x.shape[1], y.shape[1]) for x, y in blocks), None)
    if shape is None:
        raise WorkFailedError("nothing to fit", expected="scenarios longer than the lags", got="no rows")
    return _tall(blocks, shape) if blocks.rows >= shape[0] else _wide(blocks)


def _tall(blocks: Blocks, shape: tuple[int, int]) -> LeastSquares:
    """Solve with the Gram matrix of the regressors, by blocks of rows."""
    factor = _factor(lambda: _gram((x for x, _ in blocks), shape[0]))
    solution = factor.divide(_products(blocks, shape))
    solution += factor.divide(_products(((x, _residual(x, y, solution)) for x, y in blocks), shape))
    return LeastSquares(
        coefficients=solution, condition=factor.condition, floor=factor.floor, rows=blocks.rows
    )


def _wide(blocks: Blocks) -> LeastSquares:
    """Solve with the Gram matrix of the rows, which all fit."""
    x, y = (np.concatenate(parts) for parts in zip(*blocks, strict=True))
    factor = _factor(lambda: _gram([np.ascontiguousarray(x.T)], len(x)))
    dual = factor.divide(np.asfortranarray(y))
    dual += factor.divide(np.asfortranarray(y - x @ (x.T @ dual)))
    return LeastSquares(
        coefficients=x.T @ dual, condition=factor.condition, floor=factor.floor, rows=blocks.rows
    )


def _gram(blocks: Iterable[Matrix], size: int) -> Matrix:
    """Return the upper triangle of X'X from blocks of rows."""
    total: Matrix = np.zeros((size, size), order="F")
    for x in blocks:
        total = blas.dsyrk(1.0, x.T, beta=1.0, c=total, overwrite_c=True)
    return total


def _products(blocks: Iterable[tuple[Matrix, Matrix]], shape: tuple[int, int]) -> Matrix:
    """Return X'Y from blocks of rows, Fortran-ordered."""
    total: Matrix = np.zeros(shape, order="F")
    for x, y in blocks:
        total = blas.dgemm(1.0, x.T, y.T, trans_b=True, beta=1.0, c=total, overwrite_c=True)
    return total


def _residual(x: Matrix, y: Matrix, solution: Matrix) -> Matrix:
    """Return Y - X B of one block, C-ordered."""
    transposed: Matrix = blas.dgemm(-1.0, solution, x.T, trans_a=True, beta=1.0, c=y.T)
    return transposed.T


def _factor(gram: Callable[[], Matrix]) -> _Factor:
    """Return the Cholesky factor, of the matrix with a floor under it if it is singular to rounding."""
    matrix = gram()
    size = len(matrix)
    if not np.isfinite(matrix.diagonal()).all():
        raise WorkFailedError("values are not finite", where="rows to fit")
    largest = _largest_eigenvalue(lambda v: blas.dsymv(1.0, matrix, v), size)
    for floor in (0.0, size * np.finfo(np.float64).eps):
        if floor:
            matrix = gram()  # the first attempt has overwritten it
            matrix[np.diag_indices(size)] += floor * largest
        try:
            upper, _ = cho_factor(matrix, overwrite_a=True, check_finite=False)
        except LinAlgError:
            continue
        return _Factor(upper, _condition(largest, upper), floor)
    raise WorkFailedError("the Gram matrix has no Cholesky factor", where="rows to fit")


def _condition(largest: float, upper: Matrix) -> float:
    """Return the condition number of X from the largest eigenvalue and the factor of X'X."""
    inverse = _largest_eigenvalue(lambda v: cho_solve((upper, False), v, check_finite=False), len(upper))
    return float(np.sqrt(largest * inverse))


def _largest_eigenvalue(product: Callable[[Matrix], Matrix], size: int) -> float:
    """Return the largest eigenvalue of a symmetric matrix given by its product with a vector."""
    if size < 3:
        return float(np.linalg.eigvalsh(np.column_stack([product(e) for e in np.eye(size)]))[-1])
    operator = LinearOperator((size, size), matvec=product, dtype=np.float64)
    start = np.random.default_rng(0).normal(size=size)
    return float(eigsh(operator, 1, which="LA", tol=TOLERANCE, v0=start, return_eigenvectors=False)[0])


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
