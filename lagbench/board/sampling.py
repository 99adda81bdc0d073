"""Fewer nodes, as many as a page needs."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray


def coarsen(field: NDArray[np.floating], nodes: int) -> NDArray[np.float64]:
    """Return a field with at most so many nodes a side: means of blocks.

    Args:
        field: values at nodes, NaN where there is none, shape [..., x node, y node].
        nodes: most nodes a side.
    """
    values = field.astype(np.float64)
    side = field.shape[-1]
    block = math.ceil(side / nodes)  # nodes of a block a side
    if block == 1:
        return values

    count = math.ceil(side / block)  # blocks a side
    missing = count * block - side
    padding = [(0, 0)] * (field.ndim - 2)
    padding += [(0, missing), (0, missing)]
    padded = np.pad(values, padding, constant_values=np.nan)

    leading = field.shape[:-2]
    # shape [..., x block, x node, y block, y node]
    blocks = padded.reshape(*leading, count, block, count, block)
    is_known = np.isfinite(blocks)
    known_values = np.where(is_known, blocks, 0.0)
    known_count = is_known.sum(axis=(-3, -1))
    total = known_values.sum(axis=(-3, -1))
    mean = total / np.maximum(known_count, 1)
    return np.where(known_count > 0, mean, np.nan)
