"""Vector autoregression of whole frames (thesis section 4.8.3), in small memory.

Least squares by the Gram matrix, refined once, are nearly of full accuracy. For
regressors X [row, regressor] and responses Y [row, response], with G = X'X,

    B = G^-1 X'Y,   then   B <- B + G^-1 X'(Y - X B),

the corrected semi-normal equations (Bjorck, Linear Algebra Appl. 88/89 (1987) 31): the
residual is formed from X itself, so the loss of digits in squaring X is undone while
cond(X)^2 is below 1e16. Rows are read in blocks. Where G is singular, as with fewer
rows than regressors, its pseudo-inverse gives the solution of least norm.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field, PositiveInt
from scipy.linalg import LinAlgError, cho_factor, cho_solve, pinvh
from torch import Tensor

from lagbench.errors import WorkFailedError

from . import baseline
from .baseline import Batch, DatasetInfo
from .frame_model import FrameModel, FrameWindow, require_particles

BLOCK = 1024  # rows in memory at a time, at most

# directions to spare, without which the last principal directions would not converge
OVERSAMPLING = 20
# multiplications by X'X; ratios of neighbouring eigenvalues count to twice this power
ITERATIONS = 8

Matrix = NDArray[np.float64]
Frames = NDArray[np.float32]
"""States, one row for each frame."""


class LaggedRows:
    """Regressors ``(1, z(f-1), ..., z(f-p))`` and responses ``z(f)``, p the lags.

    The rows are those of several sequences of states, shape [frame, feature]. No row
    reaches from one sequence into the next.
    """

    def __init__(self, sequences: Sequence[Frames], *, lags: int) -> None:
        self.sequences = [states for states in sequences if len(states) > lags]
        self.lags = lags
        self.rows = sum(len(states) - lags for states in self.sequences)

    def __iter__(self) -> Iterator[tuple[Matrix, Matrix]]:
        """Yield regressors and responses, at most :data:`BLOCK` rows at a time."""
        for states in self.sequences:
            for first in range(self.lags, len(states), BLOCK):
                last = min(first + BLOCK, len(states))
                columns: list[NDArray[Any]] = [np.ones((last - first, 1))]
                for lag in range(1, self.lags + 1):
                    columns.append(states[first - lag : last - lag])
                regressors = np.concatenate(columns, axis=1, dtype=np.float64)
                yield regressors, states[first:last].astype(np.float64)


def solve(rows: LaggedRows) -> Matrix:
    """Return the least-squares solution of X B = Y, shape [regressor, response].

    Raises:
        WorkFailedError: there are no rows, or values are not finite.
    """
    gram, products = _sum_products(rows)
    try:
        if rows.rows < len(gram):
            raise LinAlgError  # rounding might hide that there is no factor
        factor = cho_factor(gram)
        divide: Callable[[Matrix], Matrix] = partial(cho_solve, factor)
    except LinAlgError:
        divide = partial(np.matmul, pinvh(gram))
    solution = divide(products)
    _, residual_products = _sum_products(rows, solution)
    return solution + divide(residual_products)


def _sum_products(
    rows: LaggedRows, solution: Matrix | None = None
) -> tuple[Matrix, Matrix]:
    """Return X'X and X'(Y - X B), B 0 without a solution."""
    gram: Matrix | None = None
    products = np.zeros(())
    for x, y in rows:
        if solution is not None:
            y -= x @ solution
        products = products + x.T @ y
        gram = x.T @ x if gram is None else gram + x.T @ x
    if gram is None:
        raise WorkFailedError(
            "nothing to fit; take longer scenarios for train, or fewer lags",
            where="scenarios of train",
        )
    if not (np.isfinite(gram).all() and np.isfinite(products).all()):
        raise WorkFailedError(
            "values are not finite; check the data: lagbench verify",
            where="rows to fit",
        )
    return gram, products


class Fitted(FrameModel):
    """Base of models that are fitted in closed form instead of trained step by step."""

    closed_form: ClassVar[bool] = True

    @abstractmethod
    def fit(self, scenarios: Iterable[Batch]) -> Mapping[str, float]:
        """Set the coefficients from whole scenarios; return numbers to log."""

    def states(self, scenarios: Iterable[Batch]) -> list[Frames]:
        """Return the standardised states of scenarios [1], shape [frame - 1, feature].

        The first frame is left out: it has no velocity of its own.
        """
        sequences = []
        for scenario in scenarios:
            position = scenario.position.transpose(0, 1).double()
            require_particles([position.shape[1]], self.info.particles)
            state = self.frame_state.standardise(position)
            sequences.append(state[1:].flatten(1).float().numpy())
        return sequences


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

    def fit(self, scenarios: Iterable[Batch]) -> Mapping[str, float]:
        """Fit the coefficients; return the number of rows."""
        rows = LaggedRows(self.states(scenarios), lags=self.options.lags)
        self.coefficients = torch.from_numpy(solve(rows))
        return {"rows": rows.rows}

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
    ``valid``. V comes from randomised subspace iteration (Halko, Martinsson, Tropp,
    SIAM Review 53 (2011) 217).
    """

    method = "var-stable"
    inputs = 1

    Options = StableVAROptions

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

    def fit(self, scenarios: Iterable[Batch]) -> Mapping[str, float]:
        """Fit mean, drift, directions and response.

        Return the share of variance in the directions, and the rows.

        Raises:
            WorkFailedError: there are no rows, or positions are not finite.
        """
        states = []
        changes = []
        for sequence in self.states(scenarios):
            frames = torch.from_numpy(sequence)
            states.append(frames[:-1])
            changes.append(frames.diff(dim=0))
        state = torch.cat(states)
        change = torch.cat(changes)
        rows = len(state)
        if not rows or not state.isfinite().all() or not change.isfinite().all():
            raise WorkFailedError(
                "nothing to fit, or values that are not finite; check the data: "
                "lagbench verify",
                where="scenarios of train",
            )
        self.mean.copy_(state.mean(0, dtype=torch.float64))
        self.drift.copy_(change.mean(0, dtype=torch.float64))
        state -= self.mean
        change -= self.drift

        rank = min(self.directions.shape[1], rows)
        width = min(rank + OVERSAMPLING, *state.shape)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)
            _, singular, directions = torch.svd_lowrank(state, width, ITERATIONS)
        directions = directions[:, :rank]
        eigenvalues = singular[:rank].double().square()
        component = state @ directions
        # directions without any variance stay as they are
        ridge = max(self.options.ridge, 1e-12)
        divisor = eigenvalues + ridge * rows
        response = (component.T @ change) / divisor[:, None]
        self.directions[:, :rank] = directions
        self.response[:rank] = response
        variance = state.square().sum(dtype=torch.float64)
        return {"variance": float(eigenvalues.sum() / variance), "rows": rows}

    def next_state(self, window: FrameWindow) -> Tensor:
        """Return the next standardised state [1], shape [window, particle, 4]."""
        state = window.state[:, -1]
        deviation = state.flatten(1) - self.mean
        component = deviation @ self.directions
        change = self.drift + component @ self.response
        return state + change.view(state.shape)
