"""From the preview of a score file to what a detail draws: maps, histograms, film, curves."""

from __future__ import annotations

import warnings

import numpy as np
from numpy.typing import NDArray

from lagbench.metrics import Score
from lagbench.scoring.scenario import Preview

from .model import Curve, Histogram, Pictures

__all__ = ["CURVE_FRAMES", "PREDICTION", "RESIDUAL_BINS", "TRUTH", "curve", "pictures", "residuals"]

TRUTH, PREDICTION = 0, 1
"""Sides of a preview."""

CURVE_FRAMES = 120
"""Most frames of a curve."""

RESIDUAL_BINS = 41
"""Bins of the histogram of residuals; odd, so that one holds 0."""


def pictures(preview: Preview, side: int) -> Pictures:
    """Return the pictures of the truth or of the prediction."""
    ranges = preview.histogram_range.astype(np.float64).tolist()
    shares = preview.histogram[side].astype(np.float64)
    return Pictures(
        scenario=preview.scenario,
        map_frames=preview.map_frames,
        vorticity=preview.vorticity[side],
        histograms=tuple(
            Histogram(low=a, high=b, shares=s) for (a, b), s in zip(ranges, shares, strict=True)
        ),
        film_frames=preview.film_frames,
        material=preview.material,
        film=preview.film[side],
    )


def residuals(preview: Preview) -> tuple[Histogram, ...]:
    """Return the histogram of predicted minus true vorticity at each map frame."""
    truth, prediction = preview.vorticity.astype(np.float64)
    return tuple(_histogram((p - t)[~np.isnan(p - t)]) for t, p in zip(truth, prediction, strict=True))


def _histogram(values: NDArray[np.float64]) -> Histogram:
    """Return shares over +-max abs value; NaN without values."""
    if not values.size:
        return Histogram(low=0.0, high=0.0, shares=np.full(RESIDUAL_BINS, np.nan))
    end = float(np.max(np.abs(values)))
    # a field without any error is one bin, not a division by 0
    bins = np.rint((values / end if end else values) * (RESIDUAL_BINS // 2)).astype(int) + RESIDUAL_BINS // 2
    counts = np.bincount(bins, minlength=RESIDUAL_BINS)
    return Histogram(low=-end, high=end, shares=counts / values.size)


def curve(score: Score) -> Curve:
    """Return the mean of a metric over scenarios per frame, and the lowest and highest of them."""
    chosen = _spaced(len(score.frames), CURVE_FRAMES)
    values = score.per_frame[:, chosen]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a frame where nothing is defined is NaN
        mean, low, high = np.nanmean(values, axis=0), np.nanmin(values, axis=0), np.nanmax(values, axis=0)
    return Curve(frames=tuple(score.frames[i] for i in chosen), mean=mean, low=low, high=high)


def _spaced(count: int, most: int) -> list[int]:
    """Return evenly spaced numbers below a count, first and last included; all if there are few.

    >>> _spaced(10, 4)
    [0, 3, 6, 9]
    """
    if count <= most:
        return list(range(count))
    return [i * (count - 1) // (most - 1) for i in range(most)]
