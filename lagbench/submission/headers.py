"""What the headers of a predictions.nc say; no value of an array is read."""

from __future__ import annotations

import math
from dataclasses import dataclass

import h5py
import numpy as np

from lagbench.data.hdf5 import find_storage_issue, read_attribute, read_dimensions

MAX_ATTRIBUTE = 1 << 16
"""Longest attribute that is used [characters]."""


class UnusableAttribute:
    """An attribute that exists, and is no single text or number."""


def read_single_value(owner: h5py.HLObject, name: str) -> object:
    """Return an attribute that is one number or one text; None where it is missing."""
    value = read_attribute(owner, name)
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, int | float):
        return value
    if isinstance(value, str) and len(value) <= MAX_ATTRIBUTE:
        return value
    return UnusableAttribute()


@dataclass(frozen=True, kw_only=True)
class ArrayInfo:
    """A data set as its header describes it."""

    shape: tuple[int, ...] | None  # None for what must not be read
    dims: tuple[str, ...]  # an empty name where a dimension has none
    kind: str  # its type, such as "float32", without the byte order
    chunks: tuple[int, ...] | None
    chunk_bytes: int  # length of an unpacked chunk [bytes]; 0 where it is not chunked
    issue: str | None  # why it must not be read


def describe_array(dataset: h5py.Dataset) -> ArrayInfo:
    """Return what the header of a data set says."""
    issue = find_storage_issue(dataset)
    if issue is None and not dataset.shape:
        issue = "there is one value, or none"
    chunks = dataset.chunks
    return ArrayInfo(
        shape=None if issue else dataset.shape,
        dims=() if issue else read_dimensions(dataset),
        kind=dataset.dtype.name,
        chunks=chunks,
        chunk_bytes=dataset.dtype.itemsize * math.prod(chunks) if chunks else 0,
        issue=issue,
    )


def estimate_chunk_cache(array: ArrayInfo) -> tuple[int, int]:
    """Return the bytes and the number of chunks to keep while frames are read in order.

    With this cache no chunk is unpacked twice. Axes are [scenario, frame, particle,
    space]: the chunks of one frame stay, and if a chunk holds several scenarios, the
    chunks of all their frames.

    Returns:
        Bytes and number of chunks; 0 and 1 for an array without chunks.
    """
    if array.chunks is None or array.shape is None:
        return 0, 1
    counts = []
    for length, chunk_length in zip(array.shape, array.chunks, strict=True):
        counts.append(-(-length // chunk_length))  # rounded up
    cached_chunks = math.prod(counts[2:])
    if array.chunks[0] > 1:
        cached_chunks *= counts[1]
    cached_chunks = max(1, cached_chunks)
    return cached_chunks * array.chunk_bytes, cached_chunks
