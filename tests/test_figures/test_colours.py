"""Colours of pages and pictures: readable, ordered, and apart for all eyes."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from numpy.typing import NDArray

from lagbench.figures.colours import MATERIAL_COLOURS, SERIES

Colour = NDArray[np.float64]

CVD_ROWS = {
    "protanopia": "0.152286 1.052583 -0.204868 0.114503 0.786281 0.099216 -0.003882 "
    "-0.048116 1.051998",
    "deuteranopia": "0.367322 0.860646 -0.227968 0.280085 0.672501 0.047413 -0.011820 "
    "0.042940 0.968881",
    "tritanopia": "1.255528 -0.076749 -0.178779 -0.078411 0.930809 0.147602 0.004733 "
    "0.691367 0.303900",
}
"""Machado, Oliveira & Fernandes (2009), Table 1, full severity, on linear RGB, row by
row.
"""

CVD = {}
"""The matrix of a colour vision deficiency on linear RGB."""
for deficiency_name, row_text in CVD_ROWS.items():
    numbers = np.array(row_text.split(), np.float64)
    CVD[deficiency_name] = numbers.reshape(3, 3)

TO_XYZ = np.array(
    [
        [0.4124, 0.3576, 0.1805],
        [0.2126, 0.7152, 0.0722],
        [0.0193, 0.1192, 0.9505],
    ]
)
D65 = np.array([0.9505, 1.0, 1.089])


def linear_rgb(colour: str) -> Colour:
    """Return a colour of three or six hexadecimal digits in linear RGB."""
    digits = colour.removeprefix("#")
    if len(digits) == 3:
        digits = "".join(2 * digit for digit in digits)
    content = np.frombuffer(bytes.fromhex(digits), np.uint8)
    srgb = content / 255.0
    bright = ((srgb + 0.055) / 1.055) ** 2.4
    return np.where(srgb <= 0.04045, srgb / 12.92, bright)


def lab(colour: Colour) -> Colour:
    """Return CIE L*a*b* under D65 of a colour in linear RGB."""
    xyz = TO_XYZ @ np.clip(colour, 0, 1) / D65
    x, y, z = np.cbrt(np.maximum(xyz, 1e-4))
    lightness = 116 * y - 16
    return np.array([lightness, 500 * (x - y), 200 * (y - z)])


@pytest.mark.parametrize("deficiency", CVD)
def test_series_stay_apart(deficiency: str) -> None:
    """Any two series differ by 10 in L*a*b* for colour-blind readers.

    2 is just noticeable.
    """
    seen = [lab(CVD[deficiency] @ linear_rgb(colour)) for colour in SERIES]
    for first, second in itertools.combinations(seen, 2):
        assert np.linalg.norm(first - second) >= 10.0


@pytest.mark.parametrize("deficiency", CVD)
def test_materials_stay_apart(deficiency: str) -> None:
    """For colour-blind readers materials differ by 0.2 of the side of the RGB cube."""
    seen = []
    for colour in MATERIAL_COLOURS:
        linear = np.clip(CVD[deficiency] @ linear_rgb(colour), 0.0, 1.0)
        dark = 12.92 * linear
        bright = 1.055 * linear ** (1 / 2.4) - 0.055
        seen.append(np.where(linear <= 0.0031308, dark, bright))
    for first, second in itertools.combinations(seen, 2):
        assert np.linalg.norm(first - second) > 0.2
