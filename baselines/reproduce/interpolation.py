"""Vorticity as the thesis forms it: SciPy's cubic interpolation to 40 x 40 nodes, then differences.

    u_ij = griddata(x_p, u_p, x_ij, method="cubic"),   omega = dv/dx - du/dy  (second order)

over nodes that span the box from wall to wall (Fig. 5.20). Unlike the scorer's transfer it does not
average over particles: it follows every particle's velocity, so that noise between neighbours shows.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from lagbench.metrics.distributions import kl, normalised

__all__ = ["CELLS", "cubic_vorticity", "errors"]

Floats = NDArray[np.float64]

CELLS = 40
"""Nodes along a side, at every size."""


def cubic_vorticity(
    position: Floats,
    velocity: Floats,
    bounds: tuple[tuple[float, float], tuple[float, float]],
    *,
    cells: int = CELLS,
) -> Floats:
    """Return the vorticity at the nodes, NaN outside the particles' hull [1/frame], shape [x, y].

    Args:
        position: particles [length], shape [particle, 2].
        velocity: their velocities [length/frame], shape [particle, 2].
        bounds: box, (low, high) along x and y [length].
        cells: nodes along a side.
    """
    from scipy.interpolate import griddata

    x, y = (np.linspace(low, high, cells) for low, high in bounds)
    nodes = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
    held: Floats = griddata(position, velocity, nodes, method="cubic")
    slope = np.gradient(held[..., 1], x, axis=0) - np.gradient(held[..., 0], y, axis=1)
    return np.asarray(slope, np.float64)


def errors(truth: Floats, prediction: Floats) -> Mapping[str, float]:
    """Return MAE, MSE, RMSE, KL (Eq. 5.23) and Pearson (Eq. 5.21) over nodes that both have."""
    both = np.isfinite(truth) & np.isfinite(prediction)
    true, predicted = truth[both], prediction[both]
    residual = predicted - true
    mse = float(np.mean(residual**2))
    still = not (np.ptp(true) and np.ptp(predicted))
    return {
        "mae": float(np.mean(np.abs(residual))),
        "mse": mse,
        "rmse": mse**0.5,
        "kl": kl(normalised(true), normalised(predicted)),
        "pearson": float("nan") if still else float(np.corrcoef(true, predicted)[0, 1]),
    }
