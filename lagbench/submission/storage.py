"""How ``position`` may be stored, so that any block of it is read in bounded memory and time."""

from __future__ import annotations

import math

from .anatomy import Array
from .findings import Findings

__all__ = ["MAX_CACHE", "MAX_CHUNKS", "cache_of", "check_storage"]

MAX_CACHE = 1 << 27
"""Most memory for chunks that must stay unpacked while frames are read in order [bytes]."""

MAX_CHUNKS = 200_000
"""Most chunks of a file; each costs some microseconds to find."""

ITEM = 4
"""Length of a float32 [bytes]."""

_WRITE = "write it with lagbench.submission.write, or with chunks (1, 1, particle, space)"


def cache_of(array: Array) -> tuple[int, int]:
    """Return the bytes and the number of chunks to keep while frames are read in order.

    A chunk is unpacked once if all chunks that a frame touches stay until the frames, and for
    chunks over several scenarios the scenarios, that share them are through.
    """
    if array.chunks is None or array.shape is None:
        return 0, 1
    counts = [-(-n // c) for n, c in zip(array.shape, array.chunks, strict=True)]
    rows = counts[1:2] if array.chunks[0] > 1 else []
    kept = max(1, math.prod([*rows, *counts[2:]]))
    return kept * ITEM * math.prod(array.chunks), kept


def check_storage(array: Array, out: Findings) -> bool:
    """Report storage that reaches outside the file, needs plug-ins, or is a trap."""
    where = f"variable {array.name!r}"
    problems = [*_outside(array), *_chunking(array)]
    for what, expected, got in problems:
        out.error("format", what, where=where, expected=expected, got=got, fix=_WRITE)
    return not problems


def _outside(array: Array) -> list[tuple[str, str, str]]:
    if array.shape is None:
        plain = "compact, contiguous or chunked storage in this file"
        what = (
            "the values lie in other files"
            if "file" in array.layout or array.layout == "virtual"
            else ("there are no values")
        )
        return [(what, plain, array.layout)]
    if array.foreign_filters:
        got = ", ".join(array.foreign_filters)
        return [("a filter is needed that not every reader has", "zlib, shuffle, checksum or none", got)]
    return []


def _chunking(array: Array) -> list[tuple[str, str, str]]:
    if array.chunks is None or array.shape is None or len(array.shape) != len(array.chunks):
        return []
    if array.chunk_count > MAX_CHUNKS:
        return [("too many chunks", f"at most {MAX_CHUNKS}", f"{array.chunk_count} of shape {array.chunks}")]
    whole = ITEM * math.prod(array.chunks)
    if array.largest_chunk > 2 * whole + 1024:
        # zlib unpacks as much as the stream says: a thousand times its length at worst.
        got = f"{array.largest_chunk} bytes"
        return [("a chunk is longer packed than unpacked", f"about {whole} bytes at most", got)]
    size = cache_of(array)[0]
    if size > MAX_CACHE:
        got = f"chunks {array.chunks}: {size} bytes"
        return [("frames cannot be read without unpacking much more", f"at most {MAX_CACHE} bytes", got)]
    return []
