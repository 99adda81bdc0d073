"""Fewer frames, particles and nodes, as much as a page needs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def spaced(length: int, count: int) -> list[int]:
    """Return at most so many evenly spaced indices, first and last included.

    >>> spaced(10, 4), spaced(3, 5), spaced(7, 1)
    ([0, 3, 6, 9], [0, 1, 2], [6])
    """
    if length <= count:
        return list(range(length))
    if count == 1:
        return [length - 1]
    return [i * (length - 1) // (count - 1) for i in range(count)]


def coarsen(field: NDArray[np.floating], nodes: int) -> NDArray[np.float64]:
    """Return a field with at most so many nodes a side: means of blocks.

    Args:
        field: values at nodes, NaN where there is none, shape [..., x node, y node].
        nodes: most nodes a side.
    """
    side = field.shape[-1]
    block = -(-side // nodes)  # nodes of a block a side, rounded up
    if block == 1:
        return field.astype(np.float64)

    count = -(-side // block)
    margin = (0, count * block - side)
    padding = [(0, 0)] * (field.ndim - 2) + [margin, margin]
    padded = np.pad(field.astype(np.float64), padding, constant_values=np.nan)

    # shape [..., x block, x node, y block, y node]
    blocks = padded.reshape(*field.shape[:-2], count, block, count, block)
    is_known = np.isfinite(blocks)
    known_count = is_known.sum(axis=(-3, -1))
    total = np.where(is_known, blocks, 0.0).sum(axis=(-3, -1))
    return np.where(known_count > 0, total / np.maximum(known_count, 1), np.nan)
