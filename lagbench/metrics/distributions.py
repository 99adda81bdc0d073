"""Distances between distributions of vorticity, and of energy over scales.

Per node (Eqs. 5.23-5.25) the absolute values are read as a distribution over the box:
the place of the rotation. In three dimensions each component of each node is a value of
its own, here and in all other measures of the vorticity. The histogram form and
Wasserstein-1 compare the amount of rotation, wherever it is: a mirrored flow is perfect
there. A divergence is undefined where the true vorticity is nothing but rounding;
Wasserstein-1, an error in 1/frame, is not.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
"""Added to every absolute value, so that no node has probability 0 [1/frame]."""

BINS = 64
"""Bins of the histograms, equal in width over the truth's range."""

DECADES = 6.0
"""Greatest error of the energy of a shell [decades]."""

PSEUDO_COUNT = 0.5
"""Added to every bin of both histograms, so that an empty bin costs little."""


def normalise(values: Floats) -> Floats:
    """Return ``(|v| + eps) / sum(|v| + eps)`` (Eq. 5.24), shape of ``v``."""
    magnitude = np.abs(values) + EPSILON
    return magnitude / float(magnitude.sum())


def kl(p: Floats, q: Floats) -> float:
    """Return ``sum(P ln(P / Q))`` [nat] (Eqs. 5.23, 5.25); 0 where P and Q agree.

    Not symmetric: Q small where P is not costs most. Clipped at 0, below which only
    rounding leads. NaN where a share is NaN.
    """
    divergence = float((p * np.log(p / q)).sum())
    return max(divergence, 0.0)  # in this order NaN stays NaN


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
    number = (place * BINS).astype(np.intp)
    number = np.minimum(number, BINS - 1)
    count = np.bincount(number, minlength=BINS)
    total = len(values) + BINS * PSEUDO_COUNT
    shares = (count + PSEUDO_COUNT) / total
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
    """Kullback-Leibler divergence of the absolute vorticity, in 3-D of its components,
    over the nodes.

    The thesis's models range from 0.128 to 0.391 at frame 54 of the cavity (Table 5.5).
    """
    return kl(normalise(pair.true_vorticity), normalise(pair.predicted_vorticity))


@_distance(source="Fig. 5.12")
def vorticity_kl_hist(pair: FramePair) -> float:
    """Kullback-Leibler divergence of vorticity histograms, 64 bins."""
    return _histogram_kl(pair.true_vorticity, pair.predicted_vorticity)


@_distance(source="Fig. 5.12")
def vorticity_kl_hist_abs(pair: FramePair) -> float:
    """Kullback-Leibler divergence of histograms of the absolute vorticity, in 3-D of
    its components.
    """
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
    phase = np.pi * k * (n + 0.5) / nodes
    cosines = np.sqrt(2.0 / nodes) * np.cos(phase)
    cosines[0] = math.sqrt(1.0 / nodes)
    return np.asarray(cosines, np.float64)


def energy_spectrum(velocity: Floats, periodic: Sequence[bool] | None = None) -> Floats:
    """Return the kinetic energy of node velocities in shells of wave numbers, [shell].

    Modes of all components are summed over ``round(|k|) = 1, 2, ...``. Along an axis
    with walls k counts half waves of cosines: a box with walls has no period, and
    cosines, unlike a Fourier series, put no jump at them (Denis, Cote and Laprise,
    Monthly Weather Review 2002). Along a periodic axis the modes are those of the
    discrete Fourier transform. Where all axes are periodic k counts whole waves on the
    longest of them, else half waves. Shell 0, the mean flow, is left out, as are the
    corners of the wave-number space beyond what the axes with the fewest modes resolve.

    All transforms are unitary: the shells of a field with all its modes sum to
    ``sum |u|^2`` over the nodes less that of the mean.

    Args:
        velocity: node velocity, shape [*node, axis].
        periodic: whether each axis repeats itself, shape [axis]; none by default.
    """
    dimension = velocity.shape[-1]
    if periodic is None:
        periodic = [False] * dimension
    node_counts = velocity.shape[:-1]
    half_waves = 2  # of a whole wave
    if all(periodic):
        half_waves = 1
    longest = max(node_counts)

    modes: NDArray[Any] = velocity
    wave_numbers = []  # of each axis, shape [mode]
    limits = []  # the first wave number that an axis does not resolve
    for axis, count in enumerate(node_counts):
        if periodic[axis]:
            modes = np.fft.fft(modes, axis=axis, norm="ortho")
            frequencies = np.fft.fftfreq(count, 1.0 / count)
            waves = np.abs(frequencies)
            scale = half_waves * longest / count
            greatest = (count // 2) * scale
            wave_numbers.append(waves * scale)
            limits.append(int(greatest) + 1)
        else:
            modes = _transform_by_cosines(modes, axis)
            waves = np.arange(count, dtype=np.float64)
            wave_numbers.append(waves)
            limits.append(count)
    magnitude = np.abs(modes)
    power = np.sum(magnitude**2, axis=-1)  # shape [*mode]

    squares = [numbers**2 for numbers in np.ix_(*wave_numbers)]
    shell = np.rint(np.sqrt(sum(squares))).astype(np.intp)
    sums = np.bincount(shell.ravel(), weights=power.ravel())
    energy = np.asarray(sums, np.float64)
    return energy[1 : min(limits)]


def _transform_by_cosines(field: NDArray[Any], axis: int) -> NDArray[Any]:
    """Return the modes of a field along an axis of nodes, of the field's shape."""
    cosines = _cosines(field.shape[axis])
    nodes = "xyz"[: field.ndim - 1]
    modes = nodes.replace(nodes[axis], "k")
    # einsum, not BLAS: the bits must not depend on the number of threads
    subscripts = f"k{nodes[axis]},{nodes}c->{modes}c"
    modes_of_field: NDArray[Any] = np.einsum(subscripts, cosines, field)
    return modes_of_field


def _at_slow_frames_of_full_box(pair: FramePair) -> bool:
    return pair.scenario.config.is_full_box and at_slow_frames(pair)


@_distance(
    unit="1",
    source="Denis, Cote and Laprise 2002, Mon. Weather Rev. 130",
    applies=_at_slow_frames_of_full_box,
    defined=enough_nodes,
)
def spectrum_error(pair: FramePair) -> float:
    """RMS of log10(predicted / true kinetic energy) over shells of wave numbers.

    Decades: 0.3 is a factor of two in every shell. Blind to where the eddies are; sees
    smoothing and noise at once. A ratio counts at most :data:`DECADES`, a prediction at
    rest exactly that. NaN where the truth rests.
    """
    # the cuboid that holds the counted nodes, all nodes along periodic axes
    counted = pair.truth.fields.counted
    periodic = pair.scenario.config.box.periodic
    ranges = []
    for axis, is_periodic in enumerate(periodic):
        across = tuple(other for other in range(counted.ndim) if other != axis)
        has_counted = counted.any(axis=across)
        places = np.flatnonzero(has_counted)
        if is_periodic:
            ranges.append(slice(None))
        else:
            end = places[-1] + 1
            ranges.append(slice(places[0], end))
    cuboid = tuple(ranges)

    true_velocity = pair.truth.fields.velocity[cuboid]
    predicted_velocity = pair.prediction.fields.velocity[cuboid]
    true = energy_spectrum(true_velocity, periodic)
    predicted = energy_spectrum(predicted_velocity, periodic)
    has_energy = true > 0.0
    if not has_energy.any():
        return math.nan

    ratio = predicted[has_energy] / true[has_energy]
    clipped = np.clip(ratio, 10.0**-DECADES, 10.0**DECADES)
    decades = np.log10(clipped)
    mean_square = float(np.mean(decades**2))
    return math.sqrt(mean_square)


METRICS = metrics_of(globals())
"""Metrics of this family, in the order of their definition."""
