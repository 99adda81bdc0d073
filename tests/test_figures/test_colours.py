"""Colours of pages and pictures: readable, ordered, and apart for all eyes."""

from __future__ import annotations

import itertools
from collections.abc import Mapping

import numpy as np
import pytest
from numpy.typing import NDArray

from lagbench.figures.colours import (
    DARK,
    LIGHT,
    MATERIAL_COLOURS,
    PRINT,
    format_schemes,
)

Colour = NDArray[np.float64]

SCHEMES = {"light": LIGHT, "dark": DARK}

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

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
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


def luminance(colour: str) -> float:
    """Return the relative luminance of a colour."""
    return float(linear_rgb(colour) @ LUMINANCE)


def contrast(first: str, second: str) -> float:
    """Return the contrast ratio of WCAG 2, of relative luminances."""
    luminances = (luminance(first), luminance(second))
    brighter = max(luminances) + 0.05
    darker = min(luminances) + 0.05
    return brighter / darker


def lab(colour: Colour) -> Colour:
    """Return CIE L*a*b* under D65 of a colour in linear RGB."""
    xyz = TO_XYZ @ np.clip(colour, 0, 1) / D65
    x, y, z = np.cbrt(np.maximum(xyz, 1e-4))
    lightness = 116 * y - 16
    return np.array([lightness, 500 * (x - y), 200 * (y - z)])


def test_all_schemes_name_the_same_colours() -> None:
    """A variable that is missing in one scheme would show the colour of another."""
    assert set(LIGHT) == set(DARK)
    assert set(LIGHT) == set(PRINT)
    rules = format_schemes()
    for colours in (LIGHT, DARK, PRINT):
        for name, colour in colours.items():
            assert f"--{name}:{colour}" in rules


@pytest.mark.parametrize("scheme", SCHEMES)
def test_text_can_be_read_and_speeds_are_ordered(scheme: str) -> None:
    """Text has the contrast of WCAG AA (4.5), lines nearly that of graphics.

    The faster an arrow, the farther it is from the background.
    """
    colours = SCHEMES[scheme]
    ratios = []
    for number in range(6):
        ratio = contrast(colours[f"q{number}"], colours["paper"])
        ratios.append(ratio)
    assert ratios[0] > 1.3
    assert ratios == sorted(ratios)
    for background in ("paper", "card"):
        for name in ("ink", "soft", "muted", "accent", "good", "warn", "bad"):
            ratio = contrast(colours[name], colours[background])
            assert ratio >= 4.5, name
        for number in range(6):
            ratio = contrast(colours[f"c{number}"], colours[background])
            assert ratio >= 2.6, number


def as_seen(colours: Mapping[str, str], deficiency: str) -> list[Colour]:
    """Return the six colours of series for colour-blind readers, in L*a*b*."""
    seen = []
    for number in range(6):
        colour = linear_rgb(colours[f"c{number}"])
        seen.append(lab(CVD[deficiency] @ colour))
    return seen


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("deficiency", CVD)
def test_series_stay_apart(scheme: str, deficiency: str) -> None:
    """Any two series differ by 10 in L*a*b* for colour-blind readers.

    2 is just noticeable.
    """
    seen = as_seen(SCHEMES[scheme], deficiency)
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
