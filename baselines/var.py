"""Vector autoregression of whole frames (thesis section 4.8.3), in small memory.

Least squares by the Gram matrix, refined once, are nearly of full accuracy. For
regressors X [row, regressor] and responses Y [row, response], with G = X'X + r I

    B = G^-1 X'Y,   then   B <- B + G^-1 X'(Y - X B),

the corrected semi-normal equations (Bjorck, Linear Algebra Appl. 88/89 (1987) 31): the
residual is formed from X itself, so the loss of digits in squaring X is undone while
cond(X)^2 is below 1e16. Rows are read in blocks; memory holds four square matrices.
With fewer rows than regressors the solution of least norm comes from the Gram matrix of
the rows, B = X' (X X')^-1 Y.

Leading principal directions of many long rows come from randomised subspace iteration
(Halko, Martinsson, Tropp, SIAM Review 53 (2011) 217): a random subspace with some
directions to spare is multiplied by X'X a few times, then rotated so that X'X is
diagonal in it (Rayleigh and Ritz). Rows are read in blocks; nothing as large as X'X is
formed.
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
from .baseline import DatasetInfo
from .frame_model import FrameModel, FrameWindow

BLOCK = 1024  # rows in memory at a time, at most
EPSILON = 1e-12  # least ridge: directions without any variance stay as they are

Matrix = NDArray[np.float64]
Sequences = Sequence[NDArray[np.float32]]


class LaggedRows:
    """Regressors ``(1, z(f-1), ..., z(f-p))`` and responses ``z(f)``, p the lags.

    The rows are those of several sequences of states, shape [frame, feature]. No row
    reaches from one sequence into the next.
    """

    def __init__(self, sequences: Sequences, *, lags: int) -> None:
        self.sequences = [states for states in sequences if len(states) > lags]
        self.lags = lags
        self.rows = sum(len(states) - lags for states in self.sequences)

    def __iter__(self) -> Iterator[tuple[Matrix, Matrix]]:
        """Yield regressors and responses, at most :data:`BLOCK` rows at a time."""
        for states in self.sequences:
            for first in range(self.lags, len(states), BLOCK):
                last = min(first + BLOCK, len(states))
                responses = states[first:last].astype(np.float64)
                yield self._regressors(states, first, last), responses

    def _regressors(self, states: NDArray[np.float32], first: int, last: int) -> Matrix:
        """Return the regressors of frames first to last, shape [row, regressor]."""
        features = states.shape[1]
        regressors = np.ones((last - first, 1 + self.lags * features))
        for lag in range(1, self.lags + 1):
            column = 1 + (lag - 1) * features
            lagged = states[first - lag : last - lag]
            regressors[:, column : column + features] = lagged
        return regressors


class Fitted(FrameModel):
    """Base of models that are fitted in closed form instead of trained step by step.

    Class attributes:
        closed_form: True; training calls :meth:`fit` once and takes no gradient step.
    """

    closed_form: ClassVar[bool] = True

    @abstractmethod
    def fit(self, scenarios: Iterable[NDArray[np.float32]]) -> Mapping[str, float]:
        """Set the coefficients from positions; return numbers to log.

        Each scenario has shape [frame, particle, 2].
        """

    def states(self, position: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return standardised states [1], shape [frame - 1, feature].

        The first frame is left out: it has no velocity of its own.
        """
        exact_position = torch.from_numpy(position).to(torch.float64)
        state = self.frame_state.standardise(exact_position)
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

    def __init__(self, options: Options, info: DatasetInfo) -> None:
        super().__init__(options, info)
        shape = (1 + options.lags * self.features, self.features)
        self.register_buffer("coefficients", torch.zeros(shape, dtype=torch.float64))

    @property
    def inputs(self) -> int:
        """One frame per lag."""
        return self.options.lags

    def fit(self, scenarios: Iterable[NDArray[np.float32]]) -> Mapping[str, float]:
        """Fit the coefficients.

        Return condition number, floor and rows of :class:`LeastSquares`.
        """
        sequences = [self.states(position) for position in scenarios]
        solution = solve(LaggedRows(sequences, lags=self.options.lags))
        self.coefficients = torch.from_numpy(solution.coefficients)
        return {
            "condition": solution.condition,
            "floor": solution.floor,
            "rows": solution.rows,
        }

    def next_state(self, window: FrameWindow) -> Tensor:
        """Return the next standardised state [1], shape [window, particle, 4]."""
        latest_first = window.state.flip(1)
        intercept = self.coefficients[0]
        predicted = intercept + latest_first.flatten(1) @ self.coefficients[1:]
        return predicted.view(latest_first.shape[0], *latest_first.shape[2:])


class StableVAR(Fitted):
    """``z(f) = z(f-1) + b + A' V' (z(f-1) - m)``: persistence, truncation and ridge.

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

    def __init__(self, options: Options, info: DatasetInfo) -> None:
        super().__init__(options, info)
        rank = min(options.rank, self.features)
        self.register_buffer("mean", torch.zeros(self.features))
        self.register_buffer("drift", torch.zeros(self.features))
        self.register_buffer("directions", torch.zeros(self.features, rank))
        self.register_buffer("response", torch.zeros(rank, self.features))

    def fit(self, scenarios: Iterable[NDArray[np.float32]]) -> Mapping[str, float]:
        """Fit mean, drift, directions and response.

        Return the share of variance in the directions, and the rows.
        """
        sequences = [self.states(position) for position in scenarios]
        rows = LaggedRows(sequences, lags=1)
        if not rows.rows:
            raise WorkFailedError(
                "nothing to fit", expected="scenarios of 3 frames or more", got="none"
            )
        mean, drift, variance = self._moments(rows)
        rank = self.directions.shape[1]
        directions, eigenvalues = principal_directions(
            partial(_centred_states, rows, mean), self.features, rank=rank
        )

        response = np.zeros((rank, self.features))  # A
        for x, y in rows:
            state = x[:, 1:]
            change = y - state - drift
            response += ((state - mean) @ directions).T @ change
        ridge = max(self.options.ridge, EPSILON) * rows.rows
        response /= (eigenvalues + ridge)[:, None]

        self.mean.copy_(torch.from_numpy(mean))
        self.drift.copy_(torch.from_numpy(drift))
        self.directions.copy_(torch.from_numpy(directions))
        self.response.copy_(torch.from_numpy(response))
        return {"variance": float(eigenvalues.sum() / variance), "rows": rows.rows}

    def _moments(self, rows: LaggedRows) -> tuple[Matrix, Matrix, float]:
        """Return mean state, mean change, and the summed variance of all rows."""
        mean = np.zeros(self.features)
        drift = np.zeros(self.features)
        square_sum = 0.0
        for x, y in rows:
            state = x[:, 1:]
            mean += state.sum(0) / rows.rows
            drift += (y - state).sum(0) / rows.rows
            square_sum += float(np.square(state).sum())
        variance = square_sum - rows.rows * float(mean @ mean)
        return mean, drift, variance

    def next_state(self, window: FrameWindow) -> Tensor:
        """Return the next standardised state [1], shape [window, particle, 4]."""
        state = window.state[:, -1]
        deviation = state.flatten(1) - self.mean
        change = self.drift + deviation @ self.directions @ self.response
        return state + change.view(state.shape)


def _centred_states(rows: LaggedRows, mean: Matrix) -> Iterator[Matrix]:
    """Yield the states of the regressors less the mean, in blocks of rows."""
    for x, _ in rows:
        yield x[:, 1:] - mean


TOLERANCE = 1e-3  # relative accuracy of the condition number's two eigenvalues


@dataclass(frozen=True, kw_only=True)
class LeastSquares:
    """The least-squares solution, and the condition of the problem."""

    coefficients: Matrix  # B, shape [regressor, response]
    # largest over smallest singular value of X; a lower bound where 'floor' > 0
    condition: float
    # added to the diagonal of a Gram matrix that is singular to rounding, as a share of
    # its largest eigenvalue; else 0
    floor: float
    rows: int  # rows that went in


def solve(blocks: LaggedRows) -> LeastSquares:
    """Return the least-squares solution of X B = Y; of many, that of least norm.

    Raises:
        WorkFailedError: there are no rows, or values are not finite.
    """
    first_block = next(iter(blocks), None)
    if first_block is None:
        raise WorkFailedError(
            "nothing to fit", expected="scenarios longer than the lags", got="no rows"
        )
    x, y = first_block
    if blocks.rows >= x.shape[1]:
        return _solve_overdetermined(blocks, (x.shape[1], y.shape[1]))
    return _solve_underdetermined(blocks)


def _solve_overdetermined(blocks: LaggedRows, shape: tuple[int, int]) -> LeastSquares:
    """Solve by the Gram matrix of the regressors, from blocks of rows."""

    def gram() -> Matrix:
        return _gram((x for x, _ in blocks), shape[0])

    divide, condition, floor = _factor(gram)
    solution = divide(_products(blocks, shape))

    def residuals() -> Iterator[tuple[Matrix, Matrix]]:
        for x, y in blocks:
            transposed = blas.dgemm(-1.0, solution, x.T, trans_a=True, beta=1.0, c=y.T)
            yield x, transposed.T

    solution += divide(_products(residuals(), shape))
    return LeastSquares(
        coefficients=solution, condition=condition, floor=floor, rows=blocks.rows
    )


def _solve_underdetermined(blocks: LaggedRows) -> LeastSquares:
    """Solve by the Gram matrix of the rows, which are few enough for memory."""
    x_blocks, y_blocks = zip(*blocks, strict=True)
    x = np.concatenate(x_blocks)
    y = np.concatenate(y_blocks)

    def gram() -> Matrix:
        return _gram([np.ascontiguousarray(x.T)], len(x))

    divide, condition, floor = _factor(gram)
    dual = divide(np.asfortranarray(y))
    dual += divide(np.asfortranarray(y - x @ (x.T @ dual)))
    return LeastSquares(
        coefficients=x.T @ dual, condition=condition, floor=floor, rows=blocks.rows
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
    """Return a function that multiplies by G^-1, the condition number and the floor.

    It divides by Cholesky's factor of G, in place where a matrix is Fortran-ordered.
    Where G is singular to rounding, the floor is added to its diagonal.
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
        divide: Callable[..., Matrix] = partial(
            cho_solve, (upper, False), check_finite=False
        )
        condition = float(np.sqrt(largest * _largest_eigenvalue(divide, size)))
        return partial(divide, overwrite_b=True), condition, floor
    raise WorkFailedError("the Gram matrix has no Cholesky factor", where="rows to fit")


def _largest_eigenvalue(product: Callable[[Matrix], Matrix], size: int) -> float:
    """Return the largest eigenvalue of a symmetric matrix.

    ``product`` returns the product of the matrix with a vector.
    """
    if size < 3:
        columns = [product(unit_vector) for unit_vector in np.eye(size)]
        return float(np.linalg.eigvalsh(np.column_stack(columns))[-1])
    operator = LinearOperator((size, size), matvec=product, dtype=np.float64)
    start = np.random.default_rng(0).normal(size=size)
    eigenvalues = eigsh(
        operator, 1, which="LA", tol=TOLERANCE, v0=start, return_eigenvectors=False
    )
    return float(eigenvalues[0])


# directions to spare, without which the last directions would not converge
OVERSAMPLING = 20
# multiplications by X'X; ratios of neighbouring eigenvalues count to twice this power
ITERATIONS = 8


def principal_directions(
    blocks: Callable[[], Iterable[Matrix]], features: int, *, rank: int
) -> tuple[Matrix, Matrix]:
    """Return orthonormal directions of largest X'X, and their eigenvalues.

    The directions have shape [feature, rank], the largest first.

    Args:
        blocks: function that returns the rows of X in blocks, centred; it is called
            nine times.
        features: features of a row.
        rank: number of directions.
    """
    width = min(features, rank + OVERSAMPLING)
    basis = np.random.default_rng(0).normal(size=(features, width))
    for _ in range(ITERATIONS):
        product = _multiply_by_square(blocks(), basis)
        basis, _ = np.linalg.qr(product)

    small = basis.T @ _multiply_by_square(blocks(), basis)
    eigenvalues, rotation = np.linalg.eigh((small + small.T) / 2)
    largest_first = rotation[:, ::-1][:, :rank]
    return basis @ largest_first, eigenvalues[::-1][:rank].clip(0.0)


def _multiply_by_square(blocks: Iterable[Matrix], basis: Matrix) -> Matrix:
    """Return X'X times a basis."""
    total = np.zeros_like(basis)
    for x in blocks:
        total = total + x.T @ (x @ basis)
    return total
