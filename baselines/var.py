"""Vector autoregression of whole frames (thesis section 4.8.3), by least squares in
small memory.

Least squares by the Gram matrix, refined once, are nearly of full accuracy. For
regressors X [row, regressor] and responses Y [row, response], with G = X'X + r I

    B = G^-1 X'Y,   then   B <- B + G^-1 X'(Y - X B),

the corrected semi-normal equations (Bjorck, Linear Algebra Appl. 88/89 (1987) 31): the
residual is formed from X itself, so the loss of digits in squaring X is undone while
cond(X)^2 is below 1e16. Rows pass through in blocks; four square matrices are all that
is held. With fewer rows than regressors the solution of least norm comes from the Gram
matrix of the rows, B = X' (X X')^-1 Y.

Leading principal directions of many long rows come from randomised subspace iteration
(Halko, Martinsson, Tropp, SIAM Review 53 (2011) 217): a random subspace somewhat larger
than wanted is multiplied by X'X a few times, then rotated so that X'X is diagonal in it
(Rayleigh and Ritz). Rows pass through in blocks; nothing as large as X'X is formed.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field, PositiveInt
from scipy.linalg import LinAlgError, blas, cho_factor, cho_solve
from scipy.sparse.linalg import LinearOperator, eigsh
from torch import Tensor

from lagbench.errors import WorkFailedError

from . import baseline
from .baseline import Facts
from .frame_model import FrameModel, FrameWindow

BLOCK = 1024  # most rows that are held at a time
EPSILON = 1e-12  # least ridge: directions without any variance stay as they are

Matrix = NDArray[np.float64]
Sequences = Sequence[NDArray[np.float32]]


class LaggedRows:
    """Regressors ``(1, z(f-1), ..., z(f-p))`` and responses ``z(f)`` of several
    sequences, p the lags.

    No row reaches from one sequence of states, shape [frame, feature], into the next.
    """

    def __init__(self, sequences: Sequences, *, lags: int) -> None:
        self.sequences = [states for states in sequences if len(states) > lags]
        self.lags = lags
        self.rows = sum(len(states) - lags for states in self.sequences)

    def __iter__(self) -> Iterator[tuple[Matrix, Matrix]]:
        """Yield regressors and responses, at most :data:`BLOCK` rows at a time."""
        for states in self.sequences:
            features = states.shape[1]
            for first in range(self.lags, len(states), BLOCK):
                last = min(first + BLOCK, len(states))
                regressors = np.ones((last - first, 1 + self.lags * features))
                for lag in range(1, self.lags + 1):
                    column = 1 + (lag - 1) * features
                    regressors[:, column : column + features] = states[
                        first - lag : last - lag
                    ]
                yield regressors, states[first:last].astype(np.float64)


class Fitted(FrameModel):
    """Base of models that are fitted in closed form instead of trained step by step.

    Class attributes:
        closed_form: True; training calls :meth:`fit` once and takes no gradient step.
    """

    closed_form: ClassVar[bool] = True

    @abstractmethod
    def fit(self, scenarios: Iterable[NDArray[np.float32]]) -> Mapping[str, float]:
        """Set the coefficients from positions, [frame, particle, 2] per scenario;
        return what to log.
        """

    def states(self, position: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return standardised states [1], shape [frame - 1, feature].

        The first frame is left out: it has no velocity of its own.
        """
        state = self.frame_state.of(torch.from_numpy(position).to(torch.float64))
        return state[1:].flatten(1).to(torch.float32).numpy()


class VAR(Fitted):
    """``z(f) = c + A_1 z(f-1) + ... + A_p z(f-p)``, by ordinary least squares.

    The coefficients are those of statsmodels' ``VAR(states).fit(p)``, laid out as its
    ``params`` are: row 0 is the intercept, then the features of lag 1, lag 2, ...
    Several scenarios are stacked without rows across their ends. With thousands of
    features its forecasts diverge, since nothing holds the eigenvalues of A within the
    unit circle.
    """

    method = "var"

    class Options(baseline.Options):
        """Options of the VAR."""

        lags: PositiveInt = 1  # order p

    precision = torch.float64
    options: Options
    coefficients: Tensor

    def __init__(self, options: Options, facts: Facts) -> None:
        super().__init__(options, facts)
        shape = (1 + options.lags * self.features, self.features)
        self.register_buffer("coefficients", torch.zeros(shape, dtype=torch.float64))

    @property
    def inputs(self) -> int:
        """One frame per lag."""
        return self.options.lags

    def fit(self, scenarios: Iterable[NDArray[np.float32]]) -> Mapping[str, float]:
        """Fit the coefficients; return condition number, floor and rows of
        :class:`LeastSquares`.
        """
        rows = LaggedRows(
            [self.states(position) for position in scenarios], lags=self.options.lags
        )
        found = solve(rows)
        self.coefficients = torch.from_numpy(found.coefficients)
        return {"condition": found.condition, "floor": found.floor, "rows": found.rows}

    def next_state(self, window: FrameWindow) -> Tensor:
        """Return the next standardised state [1], shape [window, particle, 4]."""
        given = window.state.flip(1)  # the latest frame first
        predicted = self.coefficients[0] + given.flatten(1) @ self.coefficients[1:]
        return predicted.view(given.shape[0], *given.shape[2:])


class StableVAR(Fitted):
    """``z(f) = z(f-1) + b + A' V' (z(f-1) - m)``: ridge and truncation around
    persistence.

    V are the leading principal directions of the states of training, m their mean, b
    the mean change. With P = V'(Z - m) of all rows, D their changes less b, and n
    rows::

        A = (P P' + ridge n I)^-1 P D'

    so that directions whose variance is below the ridge, and all outside V, stay as
    they are. What the plain VAR fits to noise in its thousands of small directions is
    what makes it diverge. Rank and ridge of a recipe are chosen by rollouts of
    ``valid``.
    """

    method = "var-stable"
    inputs = 1

    class Options(baseline.Options):
        """Options of the stable VAR."""

        in_training = frozenset({"ridge"})

        # principal directions kept; all there are if they are fewer
        rank: PositiveInt = 200
        # added to the variance of each direction [standardised^2]
        ridge: float = Field(default=0.1, ge=0, allow_inf_nan=False)

    precision = torch.float32
    options: Options
    mean: Tensor
    drift: Tensor
    directions: Tensor
    response: Tensor

    def __init__(self, options: Options, facts: Facts) -> None:
        super().__init__(options, facts)
        rank = min(options.rank, self.features)
        self.register_buffer("mean", torch.zeros(self.features))
        self.register_buffer("drift", torch.zeros(self.features))
        self.register_buffer("directions", torch.zeros(self.features, rank))
        self.register_buffer("response", torch.zeros(rank, self.features))

    def fit(self, scenarios: Iterable[NDArray[np.float32]]) -> Mapping[str, float]:
        """Fit mean, drift, directions and response; return the share of variance they
        hold.
        """
        rows = LaggedRows([self.states(position) for position in scenarios], lags=1)
        if not rows.rows:
            raise WorkFailedError(
                "nothing to fit", expected="scenarios of 3 frames or more", got="none"
            )
        mean = np.zeros(self.features)
        drift = np.zeros(self.features)
        squares = 0.0
        for x, y in rows:
            mean += x[:, 1:].sum(0) / rows.rows
            drift += (y - x[:, 1:]).sum(0) / rows.rows
            squares += float(np.square(x[:, 1:]).sum())
        spread = squares - rows.rows * float(mean @ mean)
        kept = self.directions.shape[1]
        directions, eigenvalues = principal_directions(
            lambda: (x[:, 1:] - mean for x, _ in rows), self.features, rank=kept
        )
        response = np.zeros((kept, self.features))
        for x, y in rows:
            response += ((x[:, 1:] - mean) @ directions).T @ (y - x[:, 1:] - drift)
        response /= (eigenvalues + max(self.options.ridge, EPSILON) * rows.rows)[
            :, None
        ]
        found = {
            "mean": mean,
            "drift": drift,
            "directions": directions,
            "response": response,
        }
        for name, value in found.items():
            getattr(self, name).copy_(torch.from_numpy(value))
        return {"variance": float(eigenvalues.sum() / spread), "rows": rows.rows}

    def next_state(self, window: FrameWindow) -> Tensor:
        """Return the next standardised state [1], shape [window, particle, 4]."""
        state = window.state[:, -1]
        change = (
            self.drift
            + (state.flatten(1) - self.mean) @ self.directions @ self.response
        )
        return state + change.view(state.shape)


TOLERANCE = 1e-3  # relative accuracy of the condition number's two eigenvalues


@dataclass(frozen=True, kw_only=True)
class LeastSquares:
    """The solution and how well it is determined."""

    coefficients: Matrix  # B, shape [regressor, response]
    # largest over smallest singular value of X; a lower bound where 'floor' > 0
    condition: float
    # added to the Gram matrix since it was singular to rounding, as a share of its
    # largest eigenvalue; 0 if it was not
    floor: float
    rows: int  # rows that went in


def solve(blocks: LaggedRows) -> LeastSquares:
    """Return the least-squares solution of X B = Y, that of least norm if there are
    many.
    """
    shape = next(((x.shape[1], y.shape[1]) for x, y in blocks), None)
    if shape is None:
        raise WorkFailedError(
            "nothing to fit", expected="scenarios longer than the lags", got="no rows"
        )
    if blocks.rows >= shape[0]:  # the Gram matrix of the regressors, by blocks of rows
        divided, condition, floor = _factor(
            lambda: _gram((x for x, _ in blocks), shape[0])
        )
        found = divided(_products(blocks, shape))
        # (Y - X B)' of a block
        residual = partial(blas.dgemm, -1.0, found, trans_a=True, beta=1.0)
        found += divided(
            _products(((x, residual(x.T, c=y.T).T) for x, y in blocks), shape)
        )
    else:  # the Gram matrix of the rows, which all fit
        x, y = (np.concatenate(parts) for parts in zip(*blocks, strict=True))
        divided, condition, floor = _factor(
            lambda: _gram([np.ascontiguousarray(x.T)], len(x))
        )
        dual = divided(np.asfortranarray(y))
        dual += divided(np.asfortranarray(y - x @ (x.T @ dual)))
        found = x.T @ dual
    return LeastSquares(
        coefficients=found, condition=condition, floor=floor, rows=blocks.rows
    )


def _gram(blocks: Iterable[Matrix], size: int) -> Matrix:
    """Return the upper triangle of X'X from blocks of rows."""
    total: Matrix = np.zeros((size, size), order="F")
    for x in blocks:
        total = blas.dsyrk(1.0, x.T, beta=1.0, c=total, overwrite_c=True)
    return total


def _products(
    blocks: Iterable[tuple[Matrix, Matrix]], shape: tuple[int, int]
) -> Matrix:
    """Return X'Y from blocks of rows, Fortran-ordered."""
    total: Matrix = np.zeros(shape, order="F")
    for x, y in blocks:
        total = blas.dgemm(
            1.0, x.T, y.T, trans_b=True, beta=1.0, c=total, overwrite_c=True
        )
    return total


def _factor(
    gram: Callable[[], Matrix],
) -> tuple[Callable[[Matrix], Matrix], float, float]:
    """Return G^-1 times a matrix, in its place when that is Fortran-ordered, condition
    number and floor.

    By Cholesky's factor of G, with the floor under it if it is singular to rounding.
    """
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
        divided: Callable[..., Matrix] = partial(
            cho_solve, (upper, False), check_finite=False
        )
        condition = float(np.sqrt(largest * _largest_eigenvalue(divided, size)))
        return partial(divided, overwrite_b=True), condition, floor
    raise WorkFailedError("the Gram matrix has no Cholesky factor", where="rows to fit")


def _largest_eigenvalue(product: Callable[[Matrix], Matrix], size: int) -> float:
    """Return the largest eigenvalue of a symmetric matrix given by its product with a
    vector.
    """
    if size < 3:
        return float(
            np.linalg.eigvalsh(np.column_stack([product(e) for e in np.eye(size)]))[-1]
        )
    operator = LinearOperator((size, size), matvec=product, dtype=np.float64)
    start = np.random.default_rng(0).normal(size=size)
    return float(
        eigsh(
            operator, 1, which="LA", tol=TOLERANCE, v0=start, return_eigenvectors=False
        )[0]
    )


# directions beyond those wanted, which the last wanted ones need to converge
OVERSAMPLING = 20
# multiplications by X'X; ratios of neighbouring eigenvalues count to twice this power
ITERATIONS = 8


def principal_directions(
    blocks: Callable[[], Iterable[Matrix]], features: int, *, rank: int
) -> tuple[Matrix, Matrix]:
    """Return orthonormal directions of largest X'X, shape [feature, rank], and their
    eigenvalues.

    The largest come first. ``blocks`` returns the rows of X in blocks, centred; it is
    called ten times.
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
    return sum((x.T @ (x @ basis) for x in blocks), np.zeros_like(basis))
