"""Distances between distributions of vorticity.

Per node (Eqs. 5.23-5.25) the magnitudes are read as a distribution over the box: where the
rotation is. The histogram form and Wasserstein-1 compare how much rotation there is,
wherever it stands: a mirrored flow is perfect there.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from .frame import Floats, FramePair
from .metric import Direction, Metric, enough_nodes

__all__ = ["BINS", "EPSILON", "METRICS", "PSEUDO_COUNT", "histograms", "kl", "normalised", "wasserstein1"]

EPSILON = 1e-10
"""Added to every magnitude, so that no node has probability 0 [1/frame]."""

BINS = 64
"""Bins of the histograms, equal in width over the truth's range."""

PSEUDO_COUNT = 0.5
"""Added to every bin of both histograms, so that an empty bin costs little."""


def normalised(values: Floats) -> Floats:
    """Return ``(|v| + eps) / sum(|v| + eps)`` (Eq. 5.24), shape [node]."""
    magnitude = np.abs(values) + EPSILON
    return magnitude / np.sum(magnitude)


def kl(p: Floats, q: Floats) -> float:
    """Return ``sum(P ln(P / Q))`` [nat] (Eqs. 5.23, 5.25); 0 where P and Q agree.

    Not symmetric: Q small where P is not costs most. Clipped at 0, below which only
    rounding leads.
    """
    return max(0.0, float(np.sum(p * np.log(p / q))))


def histograms(truth: Floats, prediction: Floats) -> tuple[Floats, Floats] | None:
    """Return the two distributions over 64 bins of the truth's range, None if that is empty.

    The first and last bin are open: what the truth never reaches counts there, so that the
    divergence saturates on wild predictions; :func:`wasserstein1` does not.
    """
    low, high = np.min(truth), np.max(truth)
    edges = np.linspace(low, high, BINS + 1)[1:-1]
    if not (edges[0] > low and edges[-1] < high):
        return None

    def shares(values: Floats) -> Floats:
        count = np.bincount(np.searchsorted(edges, values, side="right"), minlength=BINS)
        return np.asarray((count + PSEUDO_COUNT) / (len(values) + BINS * PSEUDO_COUNT), np.float64)

    return shares(truth), shares(prediction)


def wasserstein1(x: Floats, y: Floats) -> float:
    """Return ``W1 = mean(|x_(i) - y_(i)|)`` over order statistics, for samples of one size.

    Equal to ``scipy.stats.wasserstein_distance``; monotone where a divergence saturates.
    """
    return float(np.mean(np.abs(np.sort(x) - np.sort(y))))


def _histogram_kl(truth: Floats, prediction: Floats) -> float:
    shares = histograms(truth, prediction)
    return math.nan if shares is None else kl(*shares)


def vorticity_kl(pair: FramePair) -> float:
    """Return the divergence of predicted from true magnitudes per node [nat].

    The thesis's models range from 0.128 to 0.391 at frame 54 of the cavity (Table 5.5).
    """
    return kl(normalised(pair.true_vorticity), normalised(pair.predicted_vorticity))


def vorticity_kl_hist(pair: FramePair) -> float:
    """Return the divergence of the histograms of omega [nat]."""
    return _histogram_kl(pair.true_vorticity, pair.predicted_vorticity)


def vorticity_kl_hist_abs(pair: FramePair) -> float:
    """Return the divergence of the histograms of the magnitude of omega [nat]."""
    return _histogram_kl(np.abs(pair.true_vorticity), np.abs(pair.predicted_vorticity))


def vorticity_w1(pair: FramePair) -> float:
    """Return the Wasserstein-1 distance between the values of omega [1/frame]."""
    return wasserstein1(pair.true_vorticity, pair.predicted_vorticity)


def _metrics() -> Iterator[Metric]:
    for statistic, unit, source, summary in (
        (vorticity_kl, "nat", "Eqs. 5.23-5.25", "divergence of vorticity magnitudes per node"),
        (vorticity_kl_hist, "nat", "Fig. 5.12", "divergence of vorticity histograms, 64 bins"),
        (
            vorticity_kl_hist_abs,
            "nat",
            "Fig. 5.12",
            "the same of vorticity magnitudes",
        ),
        (vorticity_w1, "1/frame", "design section 8", "Wasserstein-1 distance of vorticity values"),
    ):
        yield Metric(
            name=statistic.__name__,
            family="distributions",
            unit=unit,
            direction=Direction.LOWER,
            perfect=0.0,
            source=source,
            summary=summary,
            statistic=statistic,
            defined=enough_nodes,
        )


METRICS = tuple(_metrics())
"""Metrics of this family."""
