"""Error of the enstrophy: a metric of one's own."""

import numpy as np

from lagbench.metrics import Direction, FramePair, Metric, enough_nodes


def enstrophy_error(pair: FramePair) -> float:
    """Return ``|Z_pred - Z_true|`` with ``Z = mean(omega^2) / 2`` over the counted
    nodes.
    """
    z_pred, z_true = (
        np.mean(w**2) / 2 for w in (pair.predicted_vorticity, pair.true_vorticity)
    )
    return abs(z_pred - z_true)


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
