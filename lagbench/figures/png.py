"""PNG files of indexed colours with opacity, written without an imaging library."""

from __future__ import annotations

import struct
import zlib

import numpy as np
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]

SIGNATURE = b"\x89PNG\r\n\x1a\n"
INDEXED = 3  # colour type of the header


def encode_indexed_png(index: Bytes, palette: Bytes) -> bytes:
    """Return a PNG file that shows an entry of the palette in each pixel.

    Args:
        index: entry of each pixel, shape [row, column], first row at the top.
        palette: red, green, blue and opacity of each entry, shape [entry, 4].
    """
    height, width = index.shape
    header = struct.pack(">IIBBBBB", width, height, 8, INDEXED, 0, 0, 0)
    # every row begins with the number of its filter: none
    filters = np.zeros((height, 1), np.uint8)
    rows = np.concatenate([filters, index], axis=1)
    colours = palette[:, :3]
    opacities = palette[:, 3]
    chunks = [
        SIGNATURE,
        _encode_chunk(b"IHDR", header),
        _encode_chunk(b"PLTE", colours.tobytes()),
        _encode_chunk(b"tRNS", opacities.tobytes()),
        _encode_chunk(b"IDAT", zlib.compress(rows.tobytes(), 9)),
        _encode_chunk(b"IEND", b""),
    ]
    return b"".join(chunks)


def _encode_chunk(name: bytes, data: bytes) -> bytes:
    length = struct.pack(">I", len(data))
    checksum = struct.pack(">I", zlib.crc32(name + data))
    return length + name + data + checksum
