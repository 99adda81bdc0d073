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
from .frame_model import FrameModel, FrameWindow, require_particles

BLOCK = 1024  # rows in memory at a time, at most
EPSILON = 1e-12  # least ridge: directions without any variance stay as they are

Matrix = NDArray[np.float64]
Frames = NDArray[np.float32]
"""Positions or states, one row for each frame."""

Rows = tuple[Matrix, Matrix]
"""Regressors X and responses Y of the same rows."""


class LaggedRows:
    """Regressors ``(1, z(f-1), ..., z(f-p))`` and responses ``z(f)``, p the lags.

    The rows are those of several sequences of states, shape [frame, feature]. No row
    reaches from one sequence into the next.
    """

    def __init__(self, sequences: Sequence[Frames], *, lags: int) -> None:
        self.sequences = []
        self.lags = lags
        self.rows = 0
        for states in sequences:
            row_count = len(states) - lags
            if row_count > 0:
                self.sequences.append(states)
                self.rows += row_count

    def __iter__(self) -> Iterator[Rows]:
        """Yield regressors and responses, at most :data:`BLOCK` rows at a time."""
        for states in self.sequences:
            frame_count = len(states)
            for first in range(self.lags, frame_count, BLOCK):
                last = min(first + BLOCK, frame_count)
                regressors = self._regressors(states, first, last)
                responses = states[first:last].astype(np.float64)
                yield regressors, responses

    def _regressors(self, states: Frames, first: int, last: int) -> Matrix:
        """Return the regressors of frames first to last, shape [row, regressor]."""
        row_count = last - first
        features = states.shape[1]
        regressor_count = 1 + self.lags * features
        regressors = np.ones((row_count, regressor_count))
        column = 1  # column 0 is that of the intercept
        for lag in range(1, self.lags + 1):
            next_column = column + features
            lagged = states[first - lag : last - lag]
            regressors[:, column:next_column] = lagged
            column = next_column
        return regressors


class Fitted(FrameModel):
    """Base of models that are fitted in closed form instead of trained step by step.

    Class attributes:
        closed_form: True; training calls :meth:`fit` once and takes no gradient step.
    """

    closed_form: ClassVar[bool] = True

    @abstractmethod
    def fit(self, scenarios: Iterable[Frames]) -> Mapping[str, float]:
        """Set the coefficients from positions; return numbers to log.

        Each scenario has shape [frame, particle, 2].
        """

    def states(self, position: Frames) -> Frames:
        """Return standardised states [1], shape [frame - 1, feature].

        The first frame is left out: it has no velocity of its own.
        """
        particles = position.shape[1]
        require_particles([particles], self.info.particles)
        stored_position = torch.from_numpy(position)
        exact_position = stored_position.to(torch.float64)
        state = self.frame_state.standardise(exact_position)
        rows = state[1:].flatten(1)
        single_precision_rows = rows.to(torch.float32)
        return single_precision_rows.numpy()


class VAROptions(baseline.Options):
    """Options of the VAR."""

    lags: PositiveInt = 1  # order p


class VAR(Fitted):
    """``z(f) = c + A_1 z(f-1) + ... + A_p z(f-p)``, by ordinary least squares.

    The coefficients are those of statsmodels' ``VAR(states).fit(p)``, laid out as its
    ``params`` are: row 0 is the intercept, then the features of lag 1, lag 2, ...
    Several scenarios are stacked without rows across their ends. With thousands of
    features its forecasts diverge, since nothing holds the eigenvalues of A within the
    unit circle.
    """

    method = "var"

    Options = VAROptions

    precision = torch.float64
    options: VAROptions
    coefficients: Tensor

    def __init__(self, options: VAROptions, info: DatasetInfo) -> None:
        super().__init__(options, info)
        regressor_count = 1 + options.lags * self.features
        shape = (regressor_count, self.features)
        coefficients = torch.zeros(shape, dtype=torch.float64)
        self.register_buffer("coefficients", coefficients)

    @property
    def inputs(self) -> int:
        """One frame per lag."""
        return self.options.lags

    def fit(self, scenarios: Iterable[Frames]) -> Mapping[str, float]:
        """Fit the coefficients.

        Return condition number, floor and rows of :class:`LeastSquares`.
        """
        sequences = [self.states(position) for position in scenarios]
        rows = LaggedRows(sequences, lags=self.options.lags)
        solution = solve(rows)
        self.coefficients = torch.from_numpy(solution.coefficients)
        return {
            "condition": solution.condition,
            "floor": solution.floor,
            "rows": solution.rows,
        }

    def next_state(self, window: FrameWindow) -> Tensor:
        """Return the next standardised state [1], shape [window, particle, 4]."""
        latest_first = window.state.flip(1)
        lagged_states = latest_first.flatten(1)
        intercept = self.coefficients[0]
        lag_coefficients = self.coefficients[1:]
        predicted = intercept + lagged_states @ lag_coefficients
        windows, _, *state_shape = latest_first.shape
        return predicted.view(windows, *state_shape)


class StableVAROptions(baseline.Options):
    """Options of the stable VAR."""

    in_training = frozenset({"ridge"})

    # principal directions kept; all there are if they are fewer
    rank: PositiveInt = 200
    # added to the variance of each direction [standardised^2]
    ridge: float = Field(default=0.1, ge=0, allow_inf_nan=False)


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

    Options = StableVAROptions

    precision = torch.float32
    options: StableVAROptions
    mean: Tensor
    drift: Tensor
    directions: Tensor
    response: Tensor

    def __init__(self, options: StableVAROptions, info: DatasetInfo) -> None:
        super().__init__(options, info)
        features = self.features
        rank = min(options.rank, features)
        self.register_buffer("mean", torch.zeros(features))
        self.register_buffer("drift", torch.zeros(features))
        self.register_buffer("directions", torch.zeros(features, rank))
        self.register_buffer("response", torch.zeros(rank, features))

    def fit(self, scenarios: Iterable[Frames]) -> Mapping[str, float]:
        """Fit mean, drift, directions and response.

        Return the share of variance in the directions, and the rows.

        Raises:
            WorkFailedError: there are no rows, or positions are not finite.
        """
        sequences = [self.states(position) for position in scenarios]
        for states in sequences:
            _require_finite(states)
        rows = LaggedRows(sequences, lags=1)
        if not rows.rows:
            raise WorkFailedError(
                "nothing to fit; take longer scenarios for train",
                where="scenarios of train",
            )
        mean, drift, variance = self._moments(rows)
        rank = self.directions.shape[1]
        centred_states = partial(_centred_states, rows, mean)
        directions, eigenvalues = principal_directions(
            centred_states, self.features, rank=rank
        )

        response = np.zeros((rank, self.features))  # A
        for regressors, next_state in rows:
            state = regressors[:, 1:]
            change = next_state - state - drift
            component = (state - mean) @ directions
            response += component.T @ change
        ridge = max(self.options.ridge, EPSILON)
        divisor = eigenvalues + ridge * rows.rows
        response /= divisor[:, None]

        self.mean.copy_(torch.from_numpy(mean))
        self.drift.copy_(torch.from_numpy(drift))
        self.directions.copy_(torch.from_numpy(directions))
        self.response.copy_(torch.from_numpy(response))
        variance_share = float(eigenvalues.sum() / variance)
        return {"variance": variance_share, "rows": rows.rows}

    def _moments(self, rows: LaggedRows) -> tuple[Matrix, Matrix, float]:
        """Return mean state, mean change, and the summed variance of all rows."""
        mean = np.zeros(self.features)
        drift = np.zeros(self.features)
        square_sum = 0.0
        for regressors, next_state in rows:
            state = regressors[:, 1:]
            change = next_state - state
            mean += state.sum(0) / rows.rows
            drift += change.sum(0) / rows.rows
            squares = np.square(state)
            square_sum += float(squares.sum())
        squared_mean = float(mean @ mean)
        variance = square_sum - rows.rows * squared_mean
        return mean, drift, variance

    def next_state(self, window: FrameWindow) -> Tensor:
        """Return the next standardised state [1], shape [window, particle, 4]."""
        state = window.state[:, -1]
        deviation = state.flatten(1) - self.mean
        component = deviation @ self.directions
        change = self.drift + component @ self.response
        return state + change.view(state.shape)


def _centred_states(rows: LaggedRows, mean: Matrix) -> Iterator[Matrix]:
    """Yield the states of the regressors less the mean, in blocks of rows."""
    for regressors, _ in rows:
        state = regressors[:, 1:]
        yield state - mean


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
    """Return the least-squares solution of X B = Y.

    With fewer rows than regressors there are many solutions. This is the one of least
    norm.

    Raises:
        WorkFailedError: there are no rows, or values are not finite.
    """
    first_block = next(iter(blocks), None)
    if first_block is None:
        raise WorkFailedError(
            "nothing to fit; take longer scenarios for train, or fewer lags",
            where="scenarios of train",
        )
    x, y = first_block
    regressor_count = x.shape[1]
    response_count = y.shape[1]
    if blocks.rows < regressor_count:
        solution = _solve_underdetermined(blocks)
    else:
        shape = (regressor_count, response_count)
        solution = _solve_overdetermined(blocks, shape)
    # responses that are not finite make coefficients that are not
    _require_finite(solution.coefficients)
    return solution


def _require_finite(values: Matrix | Frames) -> None:
    """Refuse sums or solutions of rows with values that are not finite."""
    if np.isfinite(values).all():
        return
    raise WorkFailedError(
        "values are not finite; check the data: lagbench verify",
        where="rows to fit",
    )


def _solve_overdetermined(blocks: LaggedRows, shape: tuple[int, int]) -> LeastSquares:
    """Solve by the Gram matrix of the regressors, from blocks of rows."""
    regressor_count = shape[0]

    def gram() -> Matrix:
        return _gram(_regressors_of(blocks), regressor_count)

    divide, condition, floor = _factor(gram)
    products = _products(blocks, shape)
    solution = divide(products)

    # The residuals Y - X B of the first solution refine it once.
    residuals = _residuals(blocks, solution)
    residual_products = _products(residuals, shape)
    solution += divide(residual_products)
    return LeastSquares(
        coefficients=solution,
        condition=condition,
        floor=floor,
        rows=blocks.rows,
    )


def _regressors_of(blocks: LaggedRows) -> Iterator[Matrix]:
    """Yield the regressors X alone, in blocks of rows."""
    for x, _ in blocks:
        yield x


def _residuals(blocks: LaggedRows, solution: Matrix) -> Iterator[Rows]:
    """Yield X and Y - X B, in blocks of rows."""
    for x, y in blocks:
        # (Y - X B)' = -B' X' + Y'
        transposed = blas.dgemm(
            -1.0,
            solution,
            x.T,
            trans_a=True,
            beta=1.0,
            c=y.T,
        )
        yield x, transposed.T


def _solve_underdetermined(blocks: LaggedRows) -> LeastSquares:
    """Solve by the Gram matrix of the rows, which are few enough for memory."""
    x_blocks = []
    y_blocks = []
    for x_block, y_block in blocks:
        x_blocks.append(x_block)
        y_blocks.append(y_block)
    x = np.concatenate(x_blocks)
    y = np.concatenate(y_blocks)
    _require_finite(y)  # NumPy would warn of infinite ones

    def gram() -> Matrix:
        transposed = np.ascontiguousarray(x.T)
        return _gram([transposed], len(x))

    divide, condition, floor = _factor(gram)
    dual = divide(np.asfortranarray(y))
    # The residuals of the first solution refine it once.
    fitted = x @ (x.T @ dual)
    residual = np.asfortranarray(y - fitted)
    dual += divide(residual)
    coefficients = x.T @ dual
    return LeastSquares(
        coefficients=coefficients,
        condition=condition,
        floor=floor,
        rows=blocks.rows,
    )


def _gram(blocks: Iterable[Matrix], size: int) -> Matrix:
    """Return the upper triangle of X'X from blocks of rows."""
    total: Matrix = np.zeros((size, size), order="F")
    for x in blocks:
        total = blas.dsyrk(1.0, x.T, beta=1.0, c=total, overwrite_c=True)
    return total


def _products(blocks: Iterable[Rows], shape: tuple[int, int]) -> Matrix:
    """Return X'Y from blocks of rows, Fortran-ordered."""
    total: Matrix = np.zeros(shape, order="F")
    for x, y in blocks:
        total = blas.dgemm(
            1.0,
            x.T,
            y.T,
            trans_b=True,
            beta=1.0,
            c=total,
            overwrite_c=True,
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
    _require_finite(matrix.diagonal())
    multiply = partial(blas.dsymv, 1.0, matrix)
    largest = _largest_eigenvalue(multiply, size)

    rounding_floor = size * np.finfo(np.float64).eps
    for floor in (0.0, rounding_floor):
        if floor:
            matrix = gram()  # the first attempt has overwritten it
            matrix[np.diag_indices(size)] += floor * largest
        try:
            upper, _ = cho_factor(matrix, overwrite_a=True, check_finite=False)
        except LinAlgError:
            continue
        factor = (upper, False)
        divide: Callable[..., Matrix] = partial(cho_solve, factor, check_finite=False)
        largest_inverse = _largest_eigenvalue(divide, size)
        condition = float(np.sqrt(largest * largest_inverse))
        divide_in_place = partial(divide, overwrite_b=True)
        return divide_in_place, condition, floor
    raise WorkFailedError(
        "the Gram matrix has no Cholesky factor: a singular matrix; take more or "
        "longer scenarios for train",
        where="rows to fit",
    )


def _largest_eigenvalue(product: Callable[[Matrix], Matrix], size: int) -> float:
    """Return the largest eigenvalue of a symmetric matrix.

    ``product`` returns the product of the matrix with a vector.
    """
    if size < 3:
        columns = [product(unit_vector) for unit_vector in np.eye(size)]
        matrix = np.column_stack(columns)
        ascending = np.linalg.eigvalsh(matrix)
        return float(ascending[-1])
    operator = LinearOperator((size, size), matvec=product, dtype=np.float64)
    rng = np.random.default_rng(0)
    start = rng.normal(size=size)
    eigenvalues = eigsh(
        operator,
        1,
        which="LA",
        tol=TOLERANCE,
        v0=start,
        return_eigenvectors=False,
    )
    return float(eigenvalues[0])


# directions to spare, without which the last directions would not converge
OVERSAMPLING = 20
# multiplications by X'X; ratios of neighbouring eigenvalues count to twice this power
ITERATIONS = 8


def principal_directions(
    blocks: Callable[[], Iterable[Matrix]],
    features: int,
    *,
    rank: int,
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
    rng = np.random.default_rng(0)
    basis = rng.normal(size=(features, width))
    for _ in range(ITERATIONS):
        product = _multiply_by_square(blocks(), basis)
        basis, _ = np.linalg.qr(product)

    # Rayleigh and Ritz: X'X in the basis, shape [width, width], made diagonal.
    product = _multiply_by_square(blocks(), basis)
    projected = basis.T @ product
    symmetric = (projected + projected.T) / 2
    ascending, rotation = np.linalg.eigh(symmetric)
    descending = ascending[::-1]
    eigenvalues = descending[:rank].clip(0.0)
    largest_first = rotation[:, ::-1]
    directions = basis @ largest_first[:, :rank]
    return directions, eigenvalues


def _multiply_by_square(blocks: Iterable[Matrix], basis: Matrix) -> Matrix:
    """Return X'X times a basis."""
    total = np.zeros_like(basis)
    for x in blocks:
        component = x @ basis
        total = total + x.T @ component
    return total
