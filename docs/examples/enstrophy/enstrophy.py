"""Error of the enstrophy: an example of your own metric."""

import numpy as np
from numpy.typing import NDArray

from lagbench.metrics import Direction, FramePair, Metric, enough_nodes


def mean_enstrophy(vorticity: NDArray[np.float64]) -> float:
    """Return ``Z = mean(omega^2) / 2`` over the counted nodes [1/frame^2]."""
    return float(np.mean(vorticity**2) / 2)


def enstrophy_error(pair: FramePair) -> float:
    """Return ``|Z_pred - Z_true|`` of one frame [1/frame^2]."""
    predicted = mean_enstrophy(pair.predicted_vorticity)
    true = mean_enstrophy(pair.true_vorticity)
    return abs(predicted - true)


METRICS = Metric(
    name="enstrophy_error",
    family="vorticity",
    unit="1/frame^2",
    direction=Direction.LOWER,
    perfect=0.0,
    source="Batchelor 1967",
    summary="error of the mean enstrophy",
    statistic=enstrophy_error,
    defined=enough_nodes,
)
