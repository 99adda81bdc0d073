"""Charts, labels and numbers against answers known without them."""

from __future__ import annotations

import math
import random
import re

import numpy as np
import pytest
from html_check import Reading, read_html
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from lagbench.figures.chart import (
    WIDTH,
    Bar,
    KeyItem,
    Plot,
    Spot,
    bar_chart,
    close_logarithmic,
    key_height,
    linear,
    logarithmic,
    spanning,
)
from lagbench.figures.html import interval
from lagbench.figures.labels import LabelBox, place_joined_labels, place_labels
from lagbench.figures.numbers import text

PLOT_BOX = LabelBox(0.0, 0.0, 400.0, 200.0)


def draw_bar(label: str, value: float, *, dots: tuple[float, ...] = ()) -> Bar:
    """Return a bar whose text is its value."""
    return Bar(
        label=label,
        value=value,
        value_text=text(value),
        dots=dots,
        kind="s0",
    )


def empty_plot() -> Plot:
    """Return a plot of 0 to 4 along both axes."""
    axis = linear(0, 4)
    return Plot(axis, axis, x_label="x", y_label="y")


def read_plot(plot: Plot) -> Reading:
    """Return the elements of a chart without faults."""
    svg = plot.svg("title", "description")
    reading = read_html(svg)
    assert not reading.faults
    return reading


def test_missing_values_leave_gaps() -> None:
    """A NaN ends a line and a band; the next value starts another."""
    plot = empty_plot()
    x = [0, 1, 2, 3, 4]
    low = [0, 0, math.nan, 1, 1]
    high = [1, 1, 2, 2, 2]
    plot.band(x, low, high, "s1")
    plot.line(x, low, "s2")
    plot.steps([0, 1, 2, 3], [1, math.nan, 2], "s3")
    reading = read_plot(plot)
    assert len(reading.of_class("band")) == 2
    for kind in ("s2", "s3"):
        (path,) = reading.of_class(kind)
        assert path.attributes["d"].count("M") == 2


def test_bars_are_as_long_as_their_values() -> None:
    """Half the value is half the length; a bar without a value is left out."""
    bars = [
        draw_bar("half", 0.5, dots=(0.25, math.nan)),
        draw_bar("whole", 1.0),
        draw_bar("none", math.nan),
    ]
    chart = bar_chart(
        bars,
        linear(0, 1),
        label="share",
        title="title",
        description="words",
    )
    reading = read_html(chart)
    assert not reading.faults
    widths = []
    for box in reading.of_class("bar"):
        widths.append(float(box.attributes["width"]))
    half, whole = widths
    assert half == pytest.approx(whole / 2)
    assert "none  –" in reading.elements[0].text


def test_logarithmic_axis_is_even_in_decades() -> None:
    """Each decade takes the same room; zero and negatives have no place."""
    axis = logarithmic(2e-4, 0.03)
    assert axis.low == pytest.approx(1e-4)
    assert axis.high == pytest.approx(0.1)
    shares = axis.share([1e-4, 1e-3, 1e-2, 1e-1])
    assert_allclose(shares, [0, 1 / 3, 2 / 3, 1], atol=1e-12)
    without_place = axis.share([0.0, -1.0, math.nan])
    assert np.isnan(without_place).all()
    labels = [tick.label for tick in axis.ticks]
    assert labels == ["10⁻⁴", "10⁻³", "10⁻²", "10⁻¹"]


@pytest.mark.parametrize(
    ("high", "labels", "factor"),
    [
        (10, ["0", "2", "4", "6", "8", "10"], ""),
        (0.9, ["0", "0.2", "0.4", "0.6", "0.8", "1.0"], ""),
        (2.2e6, ["0", "0.5", "1.0", "1.5", "2.0", "2.5"], "×10⁶"),
    ],
)
def test_ticks_are_round(high: float, labels: list[str], factor: str) -> None:
    """Steps are 1, 2, 2.5 or 5 times a power of ten; large numbers share a factor."""
    axis = linear(0, high)
    actual_labels = [tick.label for tick in axis.ticks]
    assert actual_labels == labels
    assert axis.factor == factor


@given(
    st.floats(-1e12, 1e12, allow_subnormal=False),
    st.floats(1e-12, 1e12),
    st.integers(2, 8),
)
def test_axes_hold_their_range(low: float, width: float, count: int) -> None:
    """A loose axis covers its range, and its labels times its factor are its ticks."""
    high = low + width
    magnitude = max(abs(low), abs(high))
    is_distinct = high - low > 1e-9 * magnitude
    if not is_distinct:
        return
    axis = linear(low, high, count=count)
    slack = 1e-6 * (axis.high - axis.low)
    assert axis.low <= low + slack
    assert axis.high >= high - slack
    assert 2 <= len(axis.ticks) <= count + 2
    for tick in axis.ticks:
        number = float(tick.label.replace("−", "-"))
        value = number * 10.0**axis.exponent
        assert value == pytest.approx(tick.value, abs=2 * slack, rel=1e-6)


@pytest.mark.parametrize(
    ("values", "is_logarithmic"),
    [
        (np.geomspace(1e-4, 1.0, 20), True),
        ([0.5, 1.0], False),
        ([-1.0, 1e-6, 1.0], False),
    ],
)
def test_wide_ranges_are_logarithmic(values: list[float], is_logarithmic: bool) -> None:
    """Narrow and signed ranges are linear and hold 0."""
    axis = spanning([values])
    assert axis.log == is_logarithmic
    if not is_logarithmic:
        assert axis.low <= 0.0


@pytest.mark.parametrize(
    "values",
    [
        [],
        [math.nan],
        [0.0],
        [math.inf, 1e301],
        [0.0, 5e-324],
        [-5e-324, 1e-323],
    ],
)
def test_series_without_numbers_have_an_axis(values: list[float]) -> None:
    """Values that are not finite or too large are left out; the tiniest stand at 0."""
    axis = spanning([values])
    assert axis.high > axis.low


@pytest.mark.parametrize(
    "values",
    [
        [10.0, 10.000000000000002],
        [1e5, 1e5 * (1.0 + 1e-15)],
        [-7e-50, -7.000000000000001e-50],
        [1e19, 1e19 * (1.0 + 4e-16)],
    ],
)
def test_values_that_differ_by_rounding_have_an_axis(values: list[float]) -> None:
    """It has a width, and no two ticks have the same label."""
    axis = spanning([values], zero=False, log=False)
    assert axis.high > axis.low
    shares = axis.share(values)
    assert np.all((shares >= 0.0) & (shares <= 1.0))
    labels = [tick.label for tick in axis.ticks]
    assert len(labels) >= 2
    assert len(set(labels)) == len(labels)


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (0.5, "0.500"),
        (123.456, "123"),
        (1.2e-4, "1.20×10⁻⁴"),
        (1e9, "1.00×10⁹"),
        (-3.0, "−3"),
        (0.0, "0"),
        (0.99999, "1.00"),
        (math.inf, "∞"),
        (-math.inf, "−∞"),
        (math.nan, "–"),
    ],
)
def test_numbers_are_short(value: float, expected: str) -> None:
    """Three digits, powers of ten where zeros would stand, a dash for NaN."""
    assert text(value) == expected


def test_an_interval_without_an_end_is_empty() -> None:
    """There is no interval of one scenario."""
    assert interval((math.nan, 1.0)) == ""


PLAIN_DIGITS = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")


@given(st.floats(-1e300, 1e300, allow_subnormal=False))
def test_numbers_are_right(value: float) -> None:
    """A text reads back to three digits."""
    written = text(value).replace("−", "-")
    mantissa, _, power = written.partition("×10")
    exponent = power.translate(PLAIN_DIGITS) or "0"
    number = float(f"{mantissa}e{exponent}")
    assert number == pytest.approx(value, rel=5.1e-3, abs=1e-300)


coordinates = st.tuples(st.floats(0.0, 400.0), st.floats(0.0, 200.0))


@given(st.lists(coordinates, max_size=12))
def test_labels_cover_nothing(dots: list[tuple[float, float]]) -> None:
    """Labels lie within the plot, and on no dot, note or other label."""
    note = LabelBox(0.0, 0.0, 90.0, 14.0)
    names = [f"method {number}" for number in range(len(dots))]
    placed = place_labels(names, dots, plot=PLOT_BOX, taken=[note])
    assert len(placed) == len(dots)
    boxes = [note]
    for x, y in dots:
        boxes.append(LabelBox(x - 5, y - 5, x + 5, y + 5))
    for label in placed:
        if label is not None:
            assert label.box.left >= 0.0
            assert label.box.right <= 400.0
            for box in boxes:
                assert not label.box.overlaps(box)
            boxes.append(label.box)


@pytest.mark.parametrize("seed", [48, 160, 223, 271])
def test_a_line_keeps_clear_of_labels_to_its_end(seed: int) -> None:
    """Between crowded dots; labels that come first are in the way of the others."""
    generator = random.Random(seed)
    dots = []
    for _ in range(20):
        dots.append((generator.uniform(100, 300), generator.uniform(50, 150)))
    names = ["m" * generator.randint(1, 8) for _ in dots]
    boxes: list[LabelBox] = []
    for label in place_joined_labels(names, dots, plot=PLOT_BOX):
        if label is None:
            continue
        if label.line_end is not None:
            for box in boxes:
                assert box.distance(label.line_end) > 0.999
        boxes.append(label.box)


def test_a_lonely_dot_has_its_label_to_the_right() -> None:
    """At the right rim the label stands to the left."""
    names = ["first", "second"]
    dots = [(100.0, 100.0), (395.0, 100.0)]
    first, second = place_labels(names, dots, plot=PLOT_BOX)
    assert first is not None
    assert first.box.left > 100.0
    assert second is not None
    assert second.box.right < 395.0


def test_a_label_evades_neighbours_that_stand_a_little_lower() -> None:
    """It moves away from them: the first of a group of dots has its name."""
    dots = [(200.0, 150.0), (185.0, 154.0), (215.0, 152.0), (200.0, 136.0)]
    names = ["a model with a name", "", "", ""]
    first, *_ = place_labels(names, dots, plot=PLOT_BOX)
    assert first is not None
    assert first.box.bottom <= 200.0


def test_a_long_label_near_the_rim_ends_there() -> None:
    """Where dots beside it leave no other room."""
    dots = [(290.0, 148.0), (199.0, 128.0), (192.0, 156.0), (233.0, 171.0)]
    names = ["NeuralMPM trained at m", "", "", ""]
    first, *_ = place_labels(names, dots, plot=PLOT_BOX)
    assert first is not None
    assert first.box.right == PLOT_BOX.right


@given(st.lists(coordinates, max_size=8, unique=True))
def test_joined_labels_cover_nothing_and_belong_to_one_dot(
    dots: list[tuple[float, float]],
) -> None:
    """A label without a line is nearest to its own dot. A line ends at its label."""
    note = LabelBox(0.0, 0.0, 90.0, 14.0)
    names = [f"method {number}\nof two lines" for number in range(len(dots))]
    placed = place_joined_labels(names, dots, plot=PLOT_BOX, taken=[note])
    assert len(placed) == len(dots)
    boxes = [note]
    for x, y in dots:
        boxes.append(LabelBox(x - 5, y - 5, x + 5, y + 5))
    for label, dot in zip(placed, dots, strict=True):
        if label is None:
            continue
        assert PLOT_BOX.contains(label.box)
        for box in boxes:
            assert not label.box.overlaps(box)
        boxes.append(label.box)
        if label.line_end is None:
            distances = [label.box.distance(other) for other in dots]
            assert min(distances) == label.box.distance(dot)
        else:
            assert label.box.distance(label.line_end) < 5.0


def test_a_joined_label_of_a_crowded_dot_has_a_line() -> None:
    """The row of dots leaves no room beside the middle one. Its line meets no dot."""
    dots = [(200.0, 100.0), (180.0, 100.0), (220.0, 100.0)]
    names = ["constant-velocity", "persistence", "frozen-field"]
    labels = place_joined_labels(names, dots, plot=PLOT_BOX)
    assert None not in labels
    middle = labels[0]
    assert middle is not None
    assert middle.line_end is not None
    end_x, end_y = middle.line_end
    for x, y in dots[1:]:
        for share in np.linspace(0.0, 1.0, 50):
            point_x = 200.0 + share * (end_x - 200.0)
            point_y = 100.0 + share * (end_y - 100.0)
            assert np.hypot(point_x - x, point_y - y) > 5.0


def test_joined_labels_leave_a_free_line_alone() -> None:
    """A lonely dot at the left end of a line has its label to the left."""
    axis = linear(0, 10)
    spot = Spot(x=2, y=5, name="a method", description="a method", kind="entry")
    for is_free in (False, True):
        plot = Plot(axis, axis, x_label="x", y_label="y")
        plot.line([2, 9], [5, 5], "front", is_free=is_free)
        plot.spots([spot], joined=True)
        reading = read_plot(plot)
        (name,) = reading.of_class("name")
        dot, *_ = reading.named("circle")
        is_left = float(name.attributes["x"]) < float(dot.attributes["cx"])
        assert is_left == is_free


def test_a_label_at_the_end_of_an_axis_stays_in_the_chart() -> None:
    """5×10⁴ is the last tick, at the right rim of the plot; a letter is 6 pixels."""
    x = close_logarithmic(250.0, 4e4)
    assert x.ticks[-1].value == x.high
    plot = Plot(x, linear(0, 1), x_label="x", y_label="y")
    for element in read_plot(plot).of_class("middle"):
        half_width = 6.0 * len(element.text) / 2
        assert float(element.attributes["x"]) + half_width <= WIDTH


def test_a_key_lies_below_the_chart() -> None:
    """Five marks in rows of two: every name is below the plot and in the picture."""
    names = ["first", "second", "third", "fourth", "fifth"]
    items = [KeyItem("dot naive", name) for name in names]
    axis = linear(0, 1)
    plot = Plot(axis, axis, x_label="x", y_label="y", height=200, key=items)
    reading = read_plot(plot)
    bases = []
    for element in reading.of_class("note"):
        bases.append(float(element.attributes["y"]))
    assert [element.text for element in reading.of_class("note")] == names
    assert min(bases) > 200
    assert max(bases) < 200 + key_height(items)
    assert len(set(bases)) == 3
    assert len(reading.named("circle")) == len(names)


def test_a_dot_without_room_for_a_label_says_its_name() -> None:
    """Of many dots at one place the first is labelled; the others have a title."""
    plot = empty_plot()
    spots = []
    for number in range(20):
        name = f"method number {number}"
        spot = Spot(x=2, y=2, name=name, description=name, kind="entry")
        spots.append(spot)
    plot.spots(spots)
    reading = read_plot(plot)
    labels = [element.text for element in reading.of_class("name")]
    assert labels[0] == "method number 0"
    assert len(labels) < len(spots)
    titles = {element.text for element in reading.named("title")}
    descriptions = {spot.description for spot in spots}
    assert descriptions <= titles
    for dot in reading.of_class("dot"):
        assert dot.attributes["tabindex"] == "0"
    assert not re.search("nan", plot.svg("title", "description"))
