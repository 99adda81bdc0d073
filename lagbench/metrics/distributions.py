"""Distances between distributions of vorticity, and of energy over scales.

Per node (Eqs. 5.23-5.25) the magnitudes are read as a distribution over the box: the
place of the rotation. The histogram form and Wasserstein-1 compare the amount of
rotation, wherever it is: a mirrored flow is perfect there. A divergence is undefined
where the true vorticity is nothing but rounding; Wasserstein-1, an error in 1/frame, is
not.
"""

from __future__ import annotations

import functools
import math
from functools import partial

import numpy as np

from .frame import Floats, FramePair, average
from .metric import (
    Direction,
    at_slow_frames,
    enough_nodes,
    has_rotation,
    metric,
    metrics_of,
)

EPSILON = 1e-10
"""Added to every magnitude, so that no node has probability 0 [1/frame]."""

BINS = 64
"""Bins of the histograms, equal in width over the truth's range."""

DECADES = 6.0
"""Greatest error of the energy of a shell [decades]."""

PSEUDO_COUNT = 0.5
"""Added to every bin of both histograms, so that an empty bin costs little."""


def normalise(values: Floats) -> Floats:
    """Return ``(|v| + eps) / sum(|v| + eps)`` (Eq. 5.24), shape [node]."""
    magnitude = np.abs(values) + EPSILON
    return magnitude / float(magnitude.sum())


def kl(p: Floats, q: Floats) -> float:
    """Return ``sum(P ln(P / Q))`` [nat] (Eqs. 5.23, 5.25); 0 where P and Q agree.

    Not symmetric: Q small where P is not costs most. Clipped at 0, below which only
    rounding leads.
    """
    divergence = float((p * np.log(p / q)).sum())
    return max(0.0, divergence)


def histograms(truth: Floats, prediction: Floats) -> tuple[Floats, Floats] | None:
    """Return both distributions over 64 bins of the truth's range, None if it is empty.

    The first and last bin are open: values beyond the truth's range count there, so
    that the divergence saturates on wild predictions; :func:`wasserstein1` does not.
    """
    low = truth.min()
    high = truth.max()
    first_edge = low + (high - low) / BINS
    if not low < first_edge < high:
        return None
    return _bin_shares(truth, low, high), _bin_shares(prediction, low, high)


def _bin_shares(values: Floats, low: float, high: float) -> Floats:
    """Return the smoothed share of the values in each bin, shape [bin]."""
    clipped = np.minimum(np.maximum(values, low), high)
    place = (clipped - low) / (high - low)
    number = np.minimum((place * BINS).astype(np.intp), BINS - 1)
    count = np.bincount(number, minlength=BINS)
    shares = (count + PSEUDO_COUNT) / (len(values) + BINS * PSEUDO_COUNT)
    return np.asarray(shares, np.float64)


def wasserstein1(x: Floats, y: Floats) -> float:
    """Return ``W1 = mean(|x_(i) - y_(i)|)`` over order statistics of equal samples.

    Equal to ``scipy.stats.wasserstein_distance``; monotone where a divergence
    saturates.
    """
    return average(np.abs(np.sort(x) - np.sort(y)))


def _histogram_kl(truth: Floats, prediction: Floats) -> float:
    distributions = histograms(truth, prediction)
    if distributions is None:
        return math.nan
    return kl(*distributions)


_distance = partial(metric, unit="nat", direction=Direction.LOWER, defined=has_rotation)


@_distance(source="Eqs. 5.23-5.25")
def vorticity_kl(pair: FramePair) -> float:
    """Divergence of vorticity magnitudes per node.

    The thesis's models range from 0.128 to 0.391 at frame 54 of the cavity (Table 5.5).
    """
    return kl(normalise(pair.true_vorticity), normalise(pair.predicted_vorticity))


@_distance(source="Fig. 5.12")
def vorticity_kl_hist(pair: FramePair) -> float:
    """Divergence of vorticity histograms, 64 bins."""
    return _histogram_kl(pair.true_vorticity, pair.predicted_vorticity)


@_distance(source="Fig. 5.12")
def vorticity_kl_hist_abs(pair: FramePair) -> float:
    """Divergence of the histograms of vorticity magnitudes."""
    return _histogram_kl(np.abs(pair.true_vorticity), np.abs(pair.predicted_vorticity))


@_distance(
    unit="1/frame",
    source="Ramdas et al. 2017, Entropy 19(2)",
    defined=enough_nodes,
)
def vorticity_w1(pair: FramePair) -> float:
    """Wasserstein-1 distance of vorticity values."""
    return wasserstein1(pair.true_vorticity, pair.predicted_vorticity)


@functools.cache
def _cosines(nodes: int) -> Floats:
    """Return the orthonormal DCT-II as a matrix, shape [wave number, node]."""
    k = np.arange(nodes)[:, None]
    n = np.arange(nodes)
    cosines = np.sqrt(2.0 / nodes) * np.cos(np.pi * k * (n + 0.5) / nodes)
    cosines[0] = math.sqrt(1.0 / nodes)
    return np.asarray(cosines, np.float64)


def energy_spectrum(velocity: Floats) -> Floats:
    """Return the kinetic energy of node velocities in shells of half waves, [shell].

    Cosine modes (k, l) of both components, summed over
    ``round(sqrt(k^2 + l^2)) = 1, 2, ...``: a box with walls has no period, and cosines,
    unlike a Fourier series, put no jump at them (Denis, Cote and Laprise, Monthly
    Weather Review 2002). Shell 0, the mean flow, is left out, as are the corners of the
    wave-number plane beyond the shorter side. Velocities have the shape [x node, y
    node, 2].
    """
    rows, columns = velocity.shape[:2]

    # einsum, not BLAS: the bits must not depend on the number of threads
    x_modes = np.einsum("ki,ijc->kjc", _cosines(rows), velocity)
    modes = np.einsum("lj,kjc->klc", _cosines(columns), x_modes)
    power = np.sum(modes**2, axis=-1)  # shape [k, l]

    k, l = np.ogrid[:rows, :columns]  # noqa: E741 - wave numbers
    shell = np.rint(np.hypot(k, l)).astype(np.intp)
    sums = np.bincount(shell.ravel(), weights=power.ravel())
    energy = np.asarray(sums, np.float64)
    return energy[1 : min(rows, columns)]


def _at_slow_frames_of_full_box(pair: FramePair) -> bool:
    return pair.scenario.config.is_full_box and at_slow_frames(pair)


@_distance(
    unit="1",
    source="Denis, Cote and Laprise 2002, Mon. Weather Rev. 130",
    applies=_at_slow_frames_of_full_box,
    defined=enough_nodes,
)
def spectrum_error(pair: FramePair) -> float:
    """RMS over shells of wave numbers of log10 of predicted over true kinetic energy.

    Decades: 0.3 is a factor of two in every shell. Blind to where the eddies are; sees
    smoothing and noise at once. A ratio counts at most :data:`DECADES`, a prediction at
    rest exactly that. NaN where the truth rests.
    """
    # the rectangle that holds the counted nodes
    counted = pair.truth.fields.counted
    x = np.flatnonzero(counted.any(axis=1))
    y = np.flatnonzero(counted.any(axis=0))
    box = (slice(x[0], x[-1] + 1), slice(y[0], y[-1] + 1))

    true = energy_spectrum(pair.truth.fields.velocity[box])
    predicted = energy_spectrum(pair.prediction.fields.velocity[box])
    has_energy = true > 0.0
    if not has_energy.any():
        return math.nan

    ratio = predicted[has_energy] / true[has_energy]
    decades = np.log10(np.clip(ratio, 10.0**-DECADES, 10.0**DECADES))
    return math.sqrt(float(np.mean(decades**2)))


METRICS = metrics_of(globals())
"""Metrics of this family, in the order of their definition."""
