"""Small PNG pictures: indexed colours with opacity, so that they suit light and dark pages.

Nothing is drawn where the page is to shine through; the same pixels give the same bytes.
"""

from __future__ import annotations

import base64
import struct
import zlib

import numpy as np
from numpy.typing import NDArray

from lagbench.draw.style import rgb

__all__ = [
    "CLOCKWISE",
    "COUNTER",
    "FAST",
    "data_uri",
    "diverging",
    "encode",
    "sequential",
]


Bytes = NDArray[np.uint8]

CLOCKWISE, COUNTER, FAST = "#0072b2", "#d55e00", "#009e73"
"""Colours of negative and positive values and of great magnitudes (Okabe & Ito 2008)."""

LEVELS = 100
"""Steps of opacity on either side of 0."""

NOTHING = 2 * LEVELS + 1
"""Entry of the palette for nodes without a value."""

VOID = (128, 128, 128, 34)
"""Their red, green, blue and opacity."""


def encode(index: Bytes, palette: Bytes) -> bytes:
    """Return an indexed PNG.

    Args:
        index: entry of the palette per pixel, first row at the top, shape [row, column].
        palette: red, green, blue, opacity, shape [entry, 4].
    """
    height, width = index.shape
    rows = np.concatenate([np.zeros((height, 1), np.uint8), index], axis=1)
    parts = [
        (b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 3, 0, 0, 0)),
        (b"PLTE", palette[:, :3].tobytes()),
        (b"tRNS", palette[:, 3].tobytes()),
        (b"IDAT", zlib.compress(rows.tobytes(), 9)),
        (b"IEND", b""),
    ]
    return b"\x89PNG\r\n\x1a\n" + b"".join(_part(name, data) for name, data in parts)


def _part(name: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))


def data_uri(png: bytes) -> str:
    """Return a PNG as an address that holds it."""
    return "data:image/png;base64," + base64.b64encode(png).decode("ascii")


def diverging(field: NDArray[np.floating], limit: float) -> bytes:
    """Return a picture of signed values: blue below 0, vermilion above, clear at 0.

    Args:
        field: values at nodes, NaN where there is none, shape [x node, y node].
        limit: magnitude of full colour.
    """
    share = np.clip(np.nan_to_num(field / limit, nan=0.0, posinf=1.0, neginf=-1.0), -1.0, 1.0)
    index = np.where(np.isnan(field), NOTHING, np.round(LEVELS + LEVELS * share))
    return encode(_upright(index), _DIVERGING)


def sequential(field: NDArray[np.floating], limit: float) -> bytes:
    """Return a picture of magnitudes: clear at 0, green at the limit; see :func:`diverging`."""
    share = np.clip(np.nan_to_num(field / limit, nan=0.0, posinf=1.0), 0.0, 1.0)
    index = np.where(np.isnan(field), NOTHING, np.round(LEVELS + LEVELS * share))
    return encode(_upright(index), _SEQUENTIAL)


def _upright(index: NDArray[np.floating]) -> Bytes:
    """Return [x node, y node] as rows from the top."""
    return np.ascontiguousarray(index.T[::-1]).astype(np.uint8)


def _ramp(below: str, above: str) -> Bytes:
    side = np.arange(-LEVELS, LEVELS + 1)
    table = np.empty((NOTHING + 1, 4), np.uint8)
    table[:-1, :3] = np.where(side[:, None] < 0, rgb(below), rgb(above))
    table[:-1, 3] = np.round(255.0 * np.abs(side) / LEVELS)
    table[NOTHING] = VOID
    return table


_DIVERGING, _SEQUENTIAL = _ramp(CLOCKWISE, COUNTER), _ramp(FAST, FAST)
