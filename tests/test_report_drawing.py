"""Charts, pictures and streamlines of the report against answers known without them;
colours for all eyes.
"""

from __future__ import annotations

import io
import itertools
import math
import re
from importlib.resources import files

import numpy as np
import pytest
from html_check import read_html
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from PIL import Image

from lagbench.figures.canvas import MATERIAL_COLOURS
from lagbench.figures.chart import Bar, Plot, bar_chart, linear, logarithmic, spanning
from lagbench.figures.html import interval, text
from lagbench.figures.report.curves import shares_of
from lagbench.figures.report.flow import streamlines
from lagbench.figures.report.maps import LEVELS, SIDE, diverging, paint, sequential


def pixels(png: bytes) -> np.ndarray:
    """Return a PNG as red, green, blue, opacity, read by Pillow."""
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGBA"))


def test_missing_values_leave_gaps() -> None:
    """A NaN ends a line and a band; the next value starts another; a bar without a
    value is left out.
    """
    plot = Plot(linear(0, 4), linear(0, 4), x_label="x", y_label="y")
    low = [0, 0, math.nan, 1, 1]
    high = [1, 1, 2, 2, 2]
    plot.band([0, 1, 2, 3, 4], low, high, "s1")
    plot.line([0, 1, 2, 3, 4], low, "s2")
    plot.steps([0, 1, 2, 3], [1, math.nan, 2], "s3")
    reading = read_html(plot.svg("a", "b"))
    assert not reading.faults
    assert len(reading.of_class("band")) == 2
    for kind in ("s2", "s3"):
        assert len(re.findall("M", reading.of_class(kind)[0].attributes["d"])) == 2
    bars = [
        Bar(
            label="half",
            value=0.5,
            written="0.5",
            dots=(0.25, math.nan),
            kind="s0",
            bold=True,
        ),
        Bar(label="whole", value=1.0, written="1.0", dots=(), kind="s0"),
        Bar(label="none", value=math.nan, written="–", dots=(), kind="s1"),
    ]
    reading = read_html(bar_chart(bars, linear(0, 1), "share", "title", "words"))
    assert not reading.faults
    half, whole = (float(box.attributes["width"]) for box in reading.of_class("bar"))
    assert half == pytest.approx(whole / 2)
    assert "none  –" in reading.elements[0].text


def test_logarithmic_axis_is_even_in_decades() -> None:
    """Each decade takes the same room; zero and negatives have no place."""
    axis = logarithmic(2e-4, 0.03)
    assert (axis.low, axis.high) == pytest.approx((1e-4, 0.1))
    np.testing.assert_allclose(
        axis.share([1e-4, 1e-3, 1e-2, 1e-1]), [0, 1 / 3, 2 / 3, 1], atol=1e-12
    )
    assert np.isnan(axis.share([0.0, -1.0, math.nan])).all()
    assert [tick.label for tick in axis.ticks] == ["10⁻⁴", "10⁻³", "10⁻²", "10⁻¹"]


@pytest.mark.parametrize(
    ("high", "labels", "factor"),
    [
        (10, ["0", "2", "4", "6", "8", "10"], ""),
        (0.9, ["0", "0.2", "0.4", "0.6", "0.8", "1.0"], ""),
        (2.2e6, ["0", "0.5", "1.0", "1.5", "2.0", "2.5"], "×10⁶"),
    ],
)
def test_ticks_are_round(high: float, labels: list[str], factor: str) -> None:
    """Steps are 1, 2, 2.5 or 5 times a power of ten; small and large numbers share a
    factor.
    """
    axis = linear(0, high)
    assert ([tick.label for tick in axis.ticks], axis.factor) == (labels, factor)


@given(
    st.floats(-1e12, 1e12, allow_subnormal=False),
    st.floats(1e-12, 1e12),
    st.integers(2, 8),
)
def test_axes_hold_their_range(low: float, width: float, count: int) -> None:
    """A loose axis covers its range, and its labels times its factor are its ticks."""
    high = low + width
    if not high - low > 1e-9 * max(abs(low), abs(high)):
        return
    axis = linear(low, high, count=count)
    slack = 1e-6 * (axis.high - axis.low)
    assert axis.low <= low + slack
    assert axis.high >= high - slack
    assert 2 <= len(axis.ticks) <= count + 2
    for tick in axis.ticks:
        said = float(tick.label.replace("−", "-")) * 10.0**axis.exponent
        assert said == pytest.approx(tick.value, abs=2 * slack, rel=1e-6)


def test_axes_of_errors() -> None:
    """Wide ranges are logarithmic, narrow or signed ones linear from 0; NaN gives an
    axis too.
    """
    wide, narrow, signed = map(
        spanning, ([np.geomspace(1e-4, 1.0, 20)], [[0.5, 1.0]], [[-1.0, 1e-6, 1.0]])
    )
    assert [axis.log for axis in (wide, narrow, signed)] == [True, False, False]
    assert narrow.low == 0.0
    for empty in ([], [[math.nan]], [[0.0]], [[math.inf, 1e301]]):
        axis = spanning(empty)
        assert axis.high > axis.low


def test_numbers_are_short() -> None:
    """Three digits, powers of ten where zeros would stand, dashes where nothing is."""
    told = {
        0.5: "0.500",
        123.456: "123",
        1.2e-4: "1.20×10⁻⁴",
        1e9: "1.00×10⁹",
        -3.0: "−3",
        0.0: "0",
    }
    told |= {0.99999: "1.00", math.inf: "∞", -math.inf: "−∞"}
    assert {value: text(value) for value in told} == told
    assert (text(math.nan), interval((math.nan, 1.0))) == ("–", "")


@given(st.floats(-1e300, 1e300, allow_subnormal=False))
def test_numbers_are_right(value: float) -> None:
    """What is written reads back to three digits."""
    written = text(value).replace("−", "-")
    mantissa, _, power = written.partition("×10")
    exponent = power.translate(str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")) or "0"
    assert float(f"{mantissa}e{exponent}") == pytest.approx(
        value, rel=5.1e-3, abs=1e-300
    )


def test_pictures() -> None:
    """Blue below 0, vermilion above, clear at 0, grey where nothing is; x goes right, y
    up.

    Of magnitudes the opacity grows with the value up to the limit.
    """
    field = np.array([[-1.0, 0.0], [0.5, np.nan]])  # [x, y]
    shown = pixels(diverging(field, 1.0))
    assert shown.shape == (2, 2, 4)
    assert shown[0, 0, 3] == 0
    assert shown[0, 1].tolist() == [128, 128, 128, 34]
    # x = 0, y = 0: lower left
    assert shown[1].tolist() == [
        [0x00, 0x72, 0xB2, 255],
        [0xD5, 0x5E, 0x00, round(255 * 0.5)],
    ]
    assert pixels(diverging(np.full((1, 1), np.inf), 1.0))[0, 0].tolist() == [
        0xD5,
        0x5E,
        0x00,
        255,
    ]
    shown = pixels(sequential(np.linspace(0.0, 2.0, LEVELS + 1)[:, None], 1.0))[
        0, :, 3
    ].astype(int)
    assert shown[0] == 0
    assert (np.diff(shown) >= 0).all()
    assert shown[LEVELS // 2 :].tolist() == [255] * (LEVELS // 2 + 1)


def test_painted_particles() -> None:
    """A particle is a disc of its material's colour at its place; those outside are not
    drawn.
    """
    position = np.array([[0.25, 0.75], [0.75, 0.25], [1.5, 0.5]])
    shown = pixels(paint(position, np.array([0, 3, 1]), ((0.0, 1.0), (0.0, 1.0)), 0.1))
    assert shown.shape == (SIDE, SIDE, 4)
    places = [SIDE // 4, 3 * SIDE // 4]
    assert shown[places, places].tolist() == [
        [0x00, 0x72, 0xB2, 255],
        [0xE6, 0x9F, 0x00, 255],
    ]
    full = math.pi * (0.5 * 1.3 * 0.1 * SIDE) ** 2
    assert shown[..., 3].sum() / 255 == pytest.approx(2 * full, rel=0.03)


def test_streamlines_of_a_rotation_are_circles_and_end_where_nothing_counts() -> None:
    """Along each line the distance from the middle stays; together they reach most of
    the box.

    A uniform flow stops at nodes that do not count; a flow at rest has none.
    """
    x, y = np.mgrid[-16.0:17.0, -16.0:17.0]
    lines = streamlines(np.stack([-y, x], axis=-1), np.ones((33, 33), bool))
    assert len(lines) > 5
    for line in lines:
        x = line.x - 16.0
        y = line.y - 16.0
        radius = np.hypot(x, y)
        assert np.ptp(radius) < 0.05 * max(radius.mean(), 1.0)
        np.testing.assert_allclose(line.speed, radius, rtol=1e-6)
        turning = x[:-1] * np.diff(y) - y[:-1] * np.diff(x)
        assert (turning > 0).all()  # with the flow, not against it
    velocity = np.broadcast_to([1.0, 0.0], (20, 20, 2))
    counted = np.broadcast_to(np.arange(20)[:, None] < 10, (20, 20))
    lines = streamlines(velocity, counted)
    assert lines
    assert max(line.x.max() for line in lines) < 9.0
    assert all(np.ptp(line.y) < 1e-12 for line in lines)
    assert streamlines(0.0 * velocity, counted) == []


def test_histogram_shares() -> None:
    """Inside the truth's range the shares are NumPy's; what lies beyond is in the end
    bins.
    """
    rng = np.random.Generator(np.random.PCG64(3))
    truth = rng.random(500)
    guess = 3.0 * rng.random(500) - 1.0
    edges, shares = shares_of(guess, truth)
    assert (edges[0], edges[-1], shares.sum()) == (
        truth.min(),
        truth.max(),
        pytest.approx(100.0),
    )
    expected = 100.0 * np.histogram(guess, edges)[0] / 500
    np.testing.assert_allclose(shares[1:-1], expected[1:-1])
    assert (shares[[0, -1]] > expected[[0, -1]]).all()
    assert shares_of(np.array([]), np.array([]))[1].sum() == 0.0


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

CVD = {
    name: np.array(rows.split(), np.float64).reshape(3, 3)
    for name, rows in CVD_ROWS.items()
}
"""What a deficiency makes of a linear colour."""

SHEET = files("lagbench.figures.report").joinpath("style.css").read_text("utf-8")


def linear_rgb(digits: str) -> Colour:
    """Return a colour of six hexadecimal digits in linear RGB."""
    srgb = np.frombuffer(bytes.fromhex(digits), np.uint8) / 255.0
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def scheme(dark: bool) -> dict[str, Colour]:
    """Return the colours of the light or the dark scheme in linear RGB, by name."""
    light, after = SHEET.split("@media (prefers-color-scheme:dark)")
    text = after.split("}}")[0] if dark else light
    found = {}
    for name, value in re.findall(r"--([a-z0-9]+):#([0-9a-f]{3,6})[;}]", text + "}"):
        found[name] = linear_rgb(
            value if len(value) == 6 else "".join(2 * digit for digit in value)
        )
    return found


def contrast(one: Colour, two: Colour) -> float:
    """Return the contrast ratio of WCAG 2, of relative luminances."""
    low, high = sorted(
        float(colour @ [0.2126, 0.7152, 0.0722]) for colour in (one, two)
    )
    return (high + 0.05) / (low + 0.05)


def lab(colour: Colour) -> Colour:
    """Return CIE L*a*b* under D65."""
    to_xyz = np.array(
        [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
    )
    f = np.cbrt(np.maximum(to_xyz @ np.clip(colour, 0, 1) / [0.9505, 1.0, 1.089], 1e-4))
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


@pytest.mark.parametrize("dark", [False, True])
def test_text_can_be_read_and_speeds_are_ordered(dark: bool) -> None:
    """Text has the contrast of WCAG AA (4.5), lines and arrows that of graphics or
    nearly so.

    The faster an arrow, the farther it is from the background.
    """
    colours = scheme(dark)
    ratios = [contrast(colours[f"q{k}"], colours["paper"]) for k in range(6)]
    assert ratios[0] > 1.3
    assert ratios == sorted(ratios)
    for back in ("paper", "card"):
        for name in ("ink", "soft", "muted", "accent", "good", "warn", "bad"):
            assert contrast(colours[name], colours[back]) >= 4.5, name
        for number in range(6):
            assert contrast(colours[f"c{number}"], colours[back]) >= 2.6, number


@pytest.mark.parametrize("dark", [False, True])
@pytest.mark.parametrize("deficiency", CVD)
def test_series_stay_apart(dark: bool, deficiency: str) -> None:
    """Any two series differ by 10 in L*a*b* for colour-blind readers (2 is just
    noticeable).
    """
    colours = scheme(dark)
    seen = [lab(CVD[deficiency] @ colours[f"c{k}"]) for k in range(6)]
    for (i, one), (k, two) in itertools.combinations(enumerate(seen), 2):
        assert np.linalg.norm(one - two) >= 10.0, (i, k)


@pytest.mark.parametrize("vision", CVD)
def test_materials_stay_apart(vision: str) -> None:
    """For colour-blind readers any two materials differ by 0.2 of the RGB cube's side
    at least.
    """
    seen = [
        np.clip(CVD[vision] @ linear_rgb(c.removeprefix("#")), 0.0, 1.0)
        for c in MATERIAL_COLOURS
    ]
    back = [
        np.where(c <= 0.0031308, 12.92 * c, 1.055 * c ** (1 / 2.4) - 0.055)
        for c in seen
    ]
    assert (
        min(np.linalg.norm(one - two) for one, two in itertools.combinations(back, 2))
        > 0.2
    )
