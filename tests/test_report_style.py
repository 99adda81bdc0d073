"""Colours of report and pictures: enough contrast, and apart for colour-blind readers."""

from __future__ import annotations

import itertools
import re
from importlib.resources import files

import numpy as np
import pytest
from numpy.typing import NDArray

from lagbench.draw.style import MATERIAL_COLOURS

Colour = NDArray[np.float64]

CVD = {
    "protanopia": [
        [0.152286, 1.052583, -0.204868],
        [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998],
    ],
    "deuteranopia": [
        [0.367322, 0.860646, -0.227968],
        [0.280085, 0.672501, 0.047413],
        [-0.011820, 0.042940, 0.968881],
    ],
    "tritanopia": [
        [1.255528, -0.076749, -0.178779],
        [-0.078411, 0.930809, 0.147602],
        [0.004733, 0.691367, 0.303900],
    ],
}
"""Machado, Oliveira & Fernandes (2009), Table 1, full severity, on linear RGB."""

SHEET = files("lagbench.report").joinpath("style.css").read_text("utf-8")


def linear(digits: str) -> Colour:
    """Return a colour of six hexadecimal digits in linear RGB."""
    srgb = np.frombuffer(bytes.fromhex(digits), np.uint8) / 255.0
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def scheme(dark: bool) -> dict[str, Colour]:
    """Return the colours of the light or the dark scheme in linear RGB, by name."""
    light, after = SHEET.split("@media (prefers-color-scheme:dark)")
    text = after.split("}}")[0] if dark else light
    found = {}
    for name, value in re.findall(r"--([a-z0-9]+):#([0-9a-f]{3,6})[;}]", text + "}"):
        found[name] = linear(value if len(value) == 6 else "".join(2 * digit for digit in value))
    return found


def luminance(colour: Colour) -> float:
    """Return the relative luminance of WCAG 2."""
    return float(colour @ np.array([0.2126, 0.7152, 0.0722]))


def contrast(one: Colour, two: Colour) -> float:
    """Return the contrast ratio of WCAG 2."""
    low, high = sorted((luminance(one), luminance(two)))
    return (high + 0.05) / (low + 0.05)


def lab(colour: Colour) -> Colour:
    """Return CIE L*a*b* under D65."""
    to_xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    f = np.cbrt(np.maximum(to_xyz @ np.clip(colour, 0, 1) / [0.9505, 1.0, 1.089], 1e-4))
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


@pytest.mark.parametrize("dark", [False, True])
def test_text_can_be_read(dark: bool) -> None:
    """Text has the contrast of WCAG AA (4.5), lines and arrows that of graphics or nearly so."""
    colours = scheme(dark)
    for back in ("paper", "card"):
        for name in ("ink", "soft", "muted", "accent", "good", "warn", "bad"):
            assert contrast(colours[name], colours[back]) >= 4.5, name
        for number in range(6):
            assert contrast(colours[f"c{number}"], colours[back]) >= 2.6, number


@pytest.mark.parametrize("dark", [False, True])
@pytest.mark.parametrize("deficiency", CVD)
def test_series_stay_apart(dark: bool, deficiency: str) -> None:
    """Any two series differ by 10 in L*a*b* for colour-blind readers (2 is just noticeable)."""
    colours = scheme(dark)
    seen = [lab(np.array(CVD[deficiency]) @ colours[f"c{k}"]) for k in range(6)]
    for (i, one), (k, two) in itertools.combinations(enumerate(seen), 2):
        assert np.linalg.norm(one - two) >= 10.0, (i, k)


@pytest.mark.parametrize("vision", CVD)
def test_materials_stay_apart(vision: str) -> None:
    """For colour-blind readers any two materials differ by 0.2 of the RGB cube's side at least."""
    seen = [np.clip(np.array(CVD[vision]) @ linear(c.removeprefix("#")), 0.0, 1.0) for c in MATERIAL_COLOURS]
    back = [np.where(c <= 0.0031308, 12.92 * c, 1.055 * c ** (1 / 2.4) - 0.055) for c in seen]
    assert min(np.linalg.norm(one - two) for one, two in itertools.combinations(back, 2)) > 0.2


@pytest.mark.parametrize("dark", [False, True])
def test_speeds_are_ordered(dark: bool) -> None:
    """The faster, the farther from the background."""
    colours = scheme(dark)
    ratios = [contrast(colours[f"q{k}"], colours["paper"]) for k in range(6)]
    assert ratios == sorted(ratios)
    assert ratios[0] > 1.3


def test_sheet_names_no_address() -> None:
    """The sheet fetches nothing, and its braces match."""
    assert not re.search(r"url\(|@import|@font-face|https?:", SHEET)
    assert SHEET.count("{") == SHEET.count("}")
