"""What hybrids share: a solver with coefficients that an earlier version fitted.

Calibrated rows (:mod:`lagbench.references.calibrated`) have taken their place: nothing
fits hybrids any more, but the committed weights predict as before.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict
from torch import Tensor

from lagbench.errors import DataError, UsageError

from .baseline import Baseline, Batch, Options


class HybridOptions(Options):
    """Base of the options; weights state those of their fit too."""

    model_config = ConfigDict(extra="ignore")


class Hybrid(Baseline):
    """A solver with fitted coefficients; they are all that its weights hold.

    Class attributes:
        largest: greatest magnitude of a coefficient that a file may state.
    """

    closed_form: ClassVar[bool] = True
    any_box: ClassVar[bool] = True
    computes_on_cpu: ClassVar[bool] = True
    largest: ClassVar[float]

    coefficients: Tensor

    @property
    def history(self) -> int:
        """Given frames that the solver reads: the last two."""
        return 2

    def forward(self, batch: Batch, generator: object = None) -> dict[str, Tensor]:
        """Return no loss: nothing is trained."""
        del batch, generator
        return {}

    def fit(self, scenarios: object) -> Mapping[str, float]:
        """Refuse a training.

        Raises:
            UsageError: always.
        """
        del scenarios
        raise UsageError(
            f"{self.method} is fitted no more; calibrated rows take its place: "
            "python -m lagbench.scoring.calibrate"
        )

    def checked_coefficients(self) -> NDArray[np.float64]:
        """Return the coefficients [1], shape [coefficient].

        Raises:
            DataError: one is out of range: a file could ask for endless time steps.
        """
        values = self.coefficients.double().cpu().numpy()
        if not np.abs(values).max() <= self.largest:
            raise DataError(
                f"coefficients of {self.method} out of range: {values.tolist()}, "
                f"expected are -{self.largest:g} to {self.largest:g}",
                where="weights",
            )
        return np.asarray(values)
