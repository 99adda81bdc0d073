"""Density and divergence on the grid: does the prediction stay an incompressible body?"""

from __future__ import annotations

import math

import numpy as np

from .frame import Floats, FramePair
from .metric import Direction, Metric, enough_nodes
from .reductions import root_mean_square as over_frames_rms

__all__ = ["METRICS", "root_mean_square"]


def root_mean_square(values: Floats) -> float:
    """Return ``sqrt(mean(v^2))`` over nodes."""
    return math.sqrt(float(np.mean(values**2)))


def density_rmse(pair: FramePair) -> float:
    """Return the RMS over all nodes of the error of relative density [1].

    All nodes of the grid, so that material in the wrong place shows both where it is missing
    and where it should not be. 0 is perfect; values of a box that is filled in part are small.
    """
    return root_mean_square(pair.prediction.fields.density - pair.truth.fields.density)


def divergence_rms(pair: FramePair) -> float:
    """Return the RMS of ``du/dx + dv/dy`` of the prediction over the compared nodes [1/frame]."""
    return root_mean_square(pair.predicted_fields.divergence[pair.nodes])


def divergence_rms_true(pair: FramePair) -> float:
    """Return the RMS of the truth's divergence over the compared nodes [1/frame]."""
    return root_mean_square(pair.truth.fields.divergence[pair.nodes])


METRICS = (
    Metric(
        name="density_rmse",
        family="continuity",
        unit="1",
        direction=Direction.LOWER,
        perfect=0.0,
        source="design section 8",
        summary="root mean squared error of density relative to rest, over all nodes",
        statistic=density_rmse,
        over_frames=over_frames_rms,
    ),
    Metric(
        name="divergence_rms",
        family="continuity",
        unit="1/frame",
        direction=Direction.NONE,
        source="section 5.9.1",
        summary="root mean squared divergence of the prediction",
        statistic=divergence_rms,
        defined=enough_nodes,
    ),
    Metric(
        name="divergence_rms_true",
        family="continuity",
        unit="1/frame",
        direction=Direction.NONE,
        source="section 5.9.1",
        summary="root mean squared divergence of the truth",
        statistic=divergence_rms_true,
        defined=enough_nodes,
    ),
)
"""Metrics of this family."""
