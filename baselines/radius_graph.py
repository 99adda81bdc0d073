"""Neighbour search: every pair of particles within a radius, exactly, on CPU and GPU.

A pair is connected where, in float64 of the positions as they are stored,

    (x_i - x_j)^2 + (y_i - y_j)^2 <= radius^2.

Particles are sorted by square cells a little wider than the radius. In the order (column, row)
the cells above a particle's own, and the three beside it in the next column, are two runs of
consecutive particles; their distances are all that has to be computed. NumPy does this on the
CPU, torch elsewhere; both compute the inequality with the same roundings and agree to the last edge.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lagbench.errors import UsageError

__all__ = ["radius_graph"]

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

MARGIN = 1e-6
"""Cells are wider than the radius by this share, more than rounding can move a particle."""

FAR = 1 << 20
"""Cells that are told apart on either side of the origin; what lies beyond shares the last."""


@torch.no_grad()
def radius_graph(
    position: Tensor, radius: float, sample: Tensor | None = None, *, self_edges: bool = False
) -> Tensor:
    """Connect all pairs of particles within a radius, without a cap on neighbours.

    Args:
        position: particle positions [length], shape [particle, 2].
        radius: largest distance of a pair [length], itself included.
        sample: window of each particle, ascending, int64, shape [particle]; particles of
            different windows are never connected. One window by default.
        self_edges: whether a particle is connected to itself too.

    Returns:
        ``edge_index``, int64, shape [2, edge]: senders and receivers, both directions of every
        pair, sorted by receiver, then sender. Particles whose position is no finite number have
        no edges.

    Raises:
        UsageError: a shape does not fit, `sample` descends, or the radius is no positive number.
    """
    _check(position, radius, sample)
    if position.device.type == "cpu":
        return _graph_numpy(position, radius, sample, self_edges)
    return _graph_torch(position, radius, sample, self_edges)


def _check(position: Tensor, radius: float, sample: Tensor | None) -> None:
    if position.ndim != 2 or position.shape[1] != 2:
        raise UsageError(
            "positions have the wrong shape",
            where="radius_graph",
            expected="[particle, 2]",
            got=tuple(position.shape),
        )
    if not (math.isfinite(radius) and radius > 0.0):
        raise UsageError(
            "the radius is no length", where="radius_graph", expected="a positive number", got=radius
        )
    if sample is None:
        return
    if sample.shape != position.shape[:1] or bool((sample[1:] < sample[:-1]).any()):
        raise UsageError(
            "windows do not fit the particles",
            where="radius_graph, sample",
            expected=f"{len(position)} ascending numbers",
            got=f"shape {tuple(sample.shape)}",
        )


def _graph_numpy(position: Tensor, radius: float, sample: Tensor | None, self_edges: bool) -> Tensor:
    """Search on the CPU."""
    x = position.detach().double().numpy()
    finite = np.isfinite(x).all(axis=1)
    kept = np.flatnonzero(finite)
    window = np.zeros(len(x), np.int64) if sample is None else sample.numpy()
    key, stride = _cells_numpy(x[kept], window[kept], radius)
    order = np.argsort(key, kind="stable")
    i, j = _pairs_numpy(x[kept[order]], key[order], stride, radius)
    particle = kept[order]
    i, j = particle[i], particle[j]
    edges = [(i << 32) | j, (j << 32) | i]
    if self_edges:
        edges.append((kept << 32) | kept)
    sorted_edges = np.concatenate(edges)
    sorted_edges.sort()
    return torch.from_numpy(np.stack([sorted_edges & 0xFFFFFFFF, sorted_edges >> 32]))


def _cells_numpy(x: Floats, window: Ints, radius: float) -> tuple[Ints, int]:
    """Return each particle's cell number, ascending along y, and the step to the next column."""
    if not len(x):
        return np.zeros(0, np.int64), 0
    cell = np.floor(x * (1.0 / (radius * (1.0 + MARGIN)))).clip(-FAR, FAR).astype(np.int64)
    cell -= cell.min(axis=0)
    columns, rows = cell.max(axis=0)
    # An empty row after each column and an empty column after each window keep them apart.
    stride = int(rows) + 2
    return (window * (columns + 2) + cell[:, 0]) * stride + cell[:, 1], stride


def _pairs_numpy(x: Floats, key: Ints, stride: int, radius: float) -> tuple[Ints, Ints]:
    """Return the pairs among particles sorted by cell, each once."""
    own = np.arange(len(x))
    above = np.searchsorted(key, key + 2)
    beside = np.searchsorted(key, key + (stride - 1))
    past = np.searchsorted(key, key + (stride + 2))
    start = np.concatenate([own + 1, beside])
    count = np.concatenate([above - (own + 1), past - beside])
    i = np.repeat(np.concatenate([own, own]), count)
    j = np.arange(len(i)) + np.repeat(start - (np.cumsum(count) - count), count)
    x_0, x_1 = x.T.copy()
    dx, dy = x_0[i] - x_0[j], x_1[i] - x_1[j]
    near = np.flatnonzero(dx * dx + dy * dy <= radius * radius)
    return i[near], j[near]


def _graph_torch(position: Tensor, radius: float, sample: Tensor | None, self_edges: bool) -> Tensor:
    """Search with torch operations alone, on any device."""
    x = position.detach().double()
    kept = x.isfinite().all(dim=1).nonzero().squeeze(1)
    window = x.new_zeros(len(x), dtype=torch.int64) if sample is None else sample
    key, stride = _cells_torch(x[kept], window[kept], radius)
    key, order = key.sort()
    particle = kept[order]
    i, j = _pairs_torch(x[particle], key, stride, radius)
    i, j = particle[i], particle[j]
    edges = [(i << 32) | j, (j << 32) | i]
    if self_edges:
        edges.append((kept << 32) | kept)
    sorted_edges = torch.cat(edges).sort().values
    return torch.stack([sorted_edges & 0xFFFFFFFF, sorted_edges >> 32])


def _cells_torch(x: Tensor, window: Tensor, radius: float) -> tuple[Tensor, Tensor | int]:
    """Return what :func:`_cells_numpy` returns; the step stays on the device."""
    if not len(x):
        return window, 0
    cell = (x * (1.0 / (radius * (1.0 + MARGIN)))).floor().clamp(-FAR, FAR).long()
    cell = cell - cell.amin(dim=0)
    columns, rows = cell.amax(dim=0)
    stride = rows + 2
    return (window * (columns + 2) + cell[:, 0]) * stride + cell[:, 1], stride


def _pairs_torch(x: Tensor, key: Tensor, stride: Tensor | int, radius: float) -> tuple[Tensor, Tensor]:
    """Return what :func:`_pairs_numpy` returns."""
    own = torch.arange(len(x), device=x.device)
    above = torch.searchsorted(key, key + 2)
    beside = torch.searchsorted(key, key + (stride - 1))
    past = torch.searchsorted(key, key + (stride + 2))
    start = torch.cat([own + 1, beside])
    count = torch.cat([above - (own + 1), past - beside])
    run = torch.repeat_interleave(count)
    i = torch.cat([own, own])[run]
    j = torch.arange(len(run), device=x.device) + (start - (count.cumsum(0) - count))[run]
    x_0, x_1 = x.T.contiguous()
    dx, dy = x_0[i] - x_0[j], x_1[i] - x_1[j]
    near = (dx * dx + dy * dy <= radius * radius).nonzero().squeeze(1)
    return i[near], j[near]
