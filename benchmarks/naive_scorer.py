"""A plain scorer of five metrics, as one would write it after the thesis: SciPy griddata, cubic.

It reads whole arrays and interpolates the velocities of truth and prediction to the 40x40
grid, frame by frame; five metrics against our sixty.
"""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import griddata
from scipy.stats import entropy, pearsonr

__all__ = ["naive_scores"]

Floats = NDArray[np.float64]

CELLS = 40


def naive_scores(truth: Path, predictions: Path, row: int, first: int, frames: int) -> dict[str, float]:
    """Return five metrics of one scenario, means over frames.

    Args:
        truth: scenario file.
        predictions: predictions.nc.
        row: row of the scenario in it.
        first: absolute number of the first predicted frame.
        frames: frames to score.
    """
    with h5py.File(truth) as file:
        true = np.asarray(file["position"][first - 1 : first + frames], np.float64)
    with h5py.File(predictions) as file:
        guess = np.asarray(file["position"][row, :frames], np.float64)
    guess = np.concatenate([true[:1], guess])
    found = [_frame(true[f - 1], true[f], guess[f - 1], guess[f]) for f in range(1, frames + 1)]
    return {name: float(np.mean([one[name] for one in found])) for name in found[0]}


def _frame(true_before: Floats, true: Floats, guess_before: Floats, guess: Floats) -> dict[str, float]:
    t, p = _vorticity(true, true - true_before), _vorticity(guess, guess - guess_before)
    known = np.isfinite(t) & np.isfinite(p)
    t, p = t[known], p[known]
    return {
        "position_mse": float(np.mean((guess - true) ** 2)),
        "vorticity_mse": float(np.mean((p - t) ** 2)),
        "vorticity_mae": float(np.mean(np.abs(p - t))),
        "vorticity_pearson": float(pearsonr(t, p).statistic),
        "vorticity_kl": float(entropy(np.abs(t) + 1e-10, np.abs(p) + 1e-10)),
    }


def _vorticity(x: Floats, u: Floats) -> Floats:
    axis = (np.arange(CELLS) + 0.5) / CELLS
    nodes = tuple(np.meshgrid(axis, axis, indexing="ij"))
    field = griddata(x, u, nodes, method="cubic")
    return np.gradient(field[..., 1], 1 / CELLS, axis=0) - np.gradient(field[..., 0], 1 / CELLS, axis=1)
