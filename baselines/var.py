"""Vector autoregression of whole frames (thesis section 4.8.3)."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field, PositiveInt
from torch import Tensor

from lagbench.errors import WorkFailedError

from . import baseline
from .facts import Facts
from .frame_model import FrameModel, FrameWindow
from .least_squares import LeastSquares, principal_directions, solve

__all__ = ["Fitted", "LaggedRows", "StableVAR", "VAR"]

BLOCK = 1024
"""Most rows that are held at a time."""

EPSILON = 1e-12
"""Least ridge: directions without any variance stay as they are."""

Matrix = NDArray[np.float64]
Sequences = Sequence[NDArray[np.float32]]


class LaggedRows:
    """Regressors ``(1, z(f-1), ..., z(f-p))`` and responses ``z(f)`` of several sequences.

    Args:
        sequences: states, shape [frame, feature]; no row reaches from one into the next.
        lags: p.
    """

    def __init__(self, sequences: Sequences, *, lags: int) -> None:
        self.sequences = [states for states in sequences if len(states) > lags]
        self.lags = lags
        self.rows = sum(len(states) - lags for states in self.sequences)

    def __iter__(self) -> Iterator[tuple[Matrix, Matrix]]:
        """Yield regressors and responses, at most :data:`BLOCK` rows at a time."""
        for states in self.sequences:
            for first in range(self.lags, len(states), BLOCK):
                yield self._block(states, first, min(first + BLOCK, len(states)))

    def _block(self, states: NDArray[np.float32], first: int, last: int) -> tuple[Matrix, Matrix]:
        features = states.shape[1]
        regressors = np.ones((last - first, 1 + self.lags * features))
        for lag in range(1, self.lags + 1):
            column = 1 + (lag - 1) * features
            regressors[:, column : column + features] = states[first - lag : last - lag]
        return regressors, states[first:last].astype(np.float64)


class Fitted(FrameModel):
    """Base of models that are fitted in closed form instead of trained step by step.

    Class attributes:
        closed_form: True; training calls :meth:`fit` once and takes no gradient step.
    """

    closed_form: ClassVar[bool] = True

    @abstractmethod
    def fit(self, scenarios: Iterable[NDArray[np.float32]]) -> Mapping[str, float]:
        """Set the coefficients and return what is worth logging.

        Args:
            scenarios: positions [length], one array of shape [frame, particle, 2] per scenario;
                iterated once.
        """

    def states(self, position: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return standardised states [1], shape [frame - 1, feature].

        The first frame is left out: it has no velocity of its own.
        """
        state = self.frame_state.of(torch.from_numpy(position).to(torch.float64))
        return state[1:].flatten(1).to(torch.float32).numpy()


class VAR(Fitted):
    """``z(f) = c + A_1 z(f-1) + ... + A_p z(f-p)``, by ordinary least squares.

    The coefficients are those of statsmodels' ``VAR(states).fit(p)``, laid out as its ``params``
    are: row 0 is the intercept, then the features of lag 1, lag 2, ... Several scenarios
    are stacked without rows across their ends. With thousands of features its forecasts diverge, since
    nothing holds the eigenvalues of A within the unit circle.
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
        """Fit the coefficients; return condition number, floor and rows of :class:`LeastSquares`."""
        rows = LaggedRows([self.states(position) for position in scenarios], lags=self.options.lags)
        return self.adopt(solve(rows))

    def adopt(self, found: LeastSquares) -> Mapping[str, float]:
        """Take over a solution."""
        self.coefficients = torch.from_numpy(found.coefficients)
        return {"condition": found.condition, "floor": found.floor, "rows": found.rows}

    def next_state(self, window: FrameWindow) -> Tensor:
        """Return the next standardised state [1], shape [window, particle, 4]."""
        given = window.state.flip(1)  # the latest frame first
        predicted = self.coefficients[0] + given.flatten(1) @ self.coefficients[1:]
        return predicted.view(given.shape[0], *given.shape[2:])


class StableVAR(Fitted):
    """``z(f) = z(f-1) + b + A' V' (z(f-1) - m)``: ridge and truncation around persistence.

    V are the leading principal directions of the states of training, m their mean, b the mean
    change. With P = V'(Z - m) of all rows, D their changes less b, and n rows::

        A = (P P' + ridge n I)^-1 P D'

    so that directions whose variance is below the ridge, and all outside V, stay as they are. What
    the plain VAR fits to noise in its thousands of small directions is what makes it diverge. Rank and ridge
    of a recipe are chosen by rollouts of ``valid``.
    """

    method = "var-stable"

    class Options(baseline.Options):
        """Options of the stable VAR."""

        rank: PositiveInt = 200  # principal directions kept; all there are if they are fewer
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
        shapes = {
            "mean": (self.features,),
            "drift": (self.features,),
            "directions": (self.features, rank),
            "response": (rank, self.features),
        }
        for name, shape in shapes.items():
            self.register_buffer(name, torch.zeros(shape))

    @property
    def inputs(self) -> int:
        """One frame."""
        return 1

    def fit(self, scenarios: Iterable[NDArray[np.float32]]) -> Mapping[str, float]:
        """Fit mean, drift, directions and response; return the share of variance they hold."""
        rows = LaggedRows([self.states(position) for position in scenarios], lags=1)
        if not rows.rows:
            raise WorkFailedError("nothing to fit", expected="scenarios of 3 frames or more", got="none")
        mean, drift, spread = self._moments(rows)

        def centred() -> Iterator[Matrix]:
            return (x[:, 1:] - mean for x, _ in rows)

        kept = self.directions.shape[1]
        directions, eigenvalues = principal_directions(centred, self.features, rank=kept)
        response = np.zeros((kept, self.features))
        for x, y in rows:
            response += ((x[:, 1:] - mean) @ directions).T @ (y - x[:, 1:] - drift)
        response /= (eigenvalues + max(self.options.ridge, EPSILON) * rows.rows)[:, None]
        found = {"mean": mean, "drift": drift, "directions": directions, "response": response}
        for name, value in found.items():
            getattr(self, name).copy_(torch.from_numpy(value))
        return {"variance": float(eigenvalues.sum() / spread), "rows": rows.rows}

    def _moments(self, rows: LaggedRows) -> tuple[Matrix, Matrix, float]:
        """Return the mean state, the mean change, and the sum of squares about the mean."""
        mean, change, squares = np.zeros(self.features), np.zeros(self.features), 0.0
        for x, y in rows:
            mean += x[:, 1:].sum(0) / rows.rows
            change += (y - x[:, 1:]).sum(0) / rows.rows
            squares += float(np.square(x[:, 1:]).sum())
        return mean, change, squares - rows.rows * float(mean @ mean)

    def next_state(self, window: FrameWindow) -> Tensor:
        """Return the next standardised state [1], shape [window, particle, 4]."""
        state = window.state[:, -1]
        change = self.drift + (state.flatten(1) - self.mean) @ self.directions @ self.response
        return state + change.view(state.shape)
