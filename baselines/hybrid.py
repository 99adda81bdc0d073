"""What hybrids share: a solver whose coefficients are fitted as a whole, on train."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lagbench.errors import DataError, UsageError

from .baseline import Baseline, Batch


class Hybrid(Baseline):
    """A solver with fitted coefficients; they are all that its weights hold.

    Class attributes:
        largest: greatest magnitude of a coefficient that a file may state.
    """

    closed_form: ClassVar[bool] = True
    fits_batches: ClassVar[bool] = True
    any_box: ClassVar[bool] = True
    computes_on_cpu: ClassVar[bool] = True
    largest: ClassVar[float]

    coefficients: Tensor

    @property
    def history(self) -> int:
        """Given frames that the solver reads: the last two."""
        return 2

    def forward(
        self, batch: Batch, generator: torch.Generator | None = None
    ) -> dict[str, Tensor]:
        """Refuse: the coefficients are fitted as a whole, without steps.

        Raises:
            UsageError: always.
        """
        raise UsageError(
            f"{self.method} takes no training steps",
            where=f"{type(self).__name__}.forward",
            fix="train it with `lagbench train`",
        )

    def checked_coefficients(self) -> NDArray[np.float64]:
        """Return the coefficients [1], shape [coefficient].

        Raises:
            DataError: one is out of range: a file could ask for endless time steps.
        """
        values = self.coefficients.double().cpu().numpy()
        if not np.abs(values).max() <= self.largest:
            raise DataError(
                f"the coefficients of the {self.method} are out of range",
                where="coefficients of the weights",
                expected=f"numbers from -{self.largest:g} to {self.largest:g}",
                got=values.tolist(),
                fix="train the model with `lagbench train`",
            )
        return np.asarray(values)
