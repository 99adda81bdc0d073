"""Charts as SVG: axes with few quiet lines, and marks coloured by the style sheet.

Classes of marks: ``s0`` to ``s5`` are series, ``d1`` to ``d3`` dashes, ``truth`` is the
truth, ``floor0`` and so on are reference predictors. Each chart has a title and a
description for readers who do not see it.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .html import Markup, clipped, format_multiples, join, path_data, tag
from .labels import (
    ANCHORS,
    LINE_HEIGHT,
    Label,
    LabelBox,
    place_joined_labels,
    place_labels,
    wrap_name,
)
from .numbers import format_power

Floats = NDArray[np.float64]
Point = tuple[float, float]

WIDE = 60.0
"""From this ratio of greatest to least value an axis of errors is logarithmic."""

DEEPEST = 1e-6
"""A logarithmic axis reaches no lower than this share of its top."""

HUGE = 1e300  # values beyond are no numbers of a chart
TINY = 1e-300  # magnitudes below it stand at 0
ROUNDING = 1e-12  # values that differ by less than this share differ by rounding
MOST_LABELS = 8  # of a logarithmic axis; of more ticks the powers of ten stay
PLAIN_POWERS = range(-3, 4)  # powers of ten that are written out
ROUND_FACTORS = (1.0, 2.0, 2.5, 5.0, 10.0)


@dataclass(frozen=True)
class Tick:
    """A mark of an axis."""

    value: float  # where it stands
    label: str  # its text


@dataclass(frozen=True)
class AxisScale:
    """Where values stand along one axis."""

    low: float  # value at its start
    high: float  # value at its end
    log: bool  # whether it is logarithmic
    exponent: int  # the labels are in units of this power of ten
    ticks: tuple[Tick, ...]  # its marks

    def share(self, values: ArrayLike) -> Floats:
        """Return where values lie between low (0) and high (1).

        NaN stands for values that have no place.
        """
        x = np.asarray(values, np.float64)
        if not self.log:
            return (x - self.low) / (self.high - self.low)
        is_positive = x > 0.0
        logs = np.log10(np.where(is_positive, x, 1.0))
        low = math.log10(self.low)
        high = math.log10(self.high)
        share = (logs - low) / (high - low)
        return np.where(is_positive, share, np.nan)

    @property
    def factor(self) -> str:
        """The factor of all labels, empty for 1."""
        if self.exponent:
            return f"×{format_power(self.exponent)}"
        return ""


def linear(
    low: float, high: float, *, count: int = 5, tight: bool = False
) -> AxisScale:
    """Return a linear axis that covers a range with about so many steps.

    A tight axis ends at the range, others at the next ticks. If low and high differ
    only by rounding, the range is widened to the greater magnitude of the two.
    """
    greatest = max(abs(low), abs(high))
    if not high - low > ROUNDING * greatest:
        width = greatest or 1.0
        high = low + 0.5 * width
        low = low - 0.5 * width
    step = _round_up((high - low) / count)
    first = math.floor(low / step + 1e-9)
    last = math.ceil(high / step - 1e-9)
    values = [k * step for k in range(first, last + 1)]
    if tight:
        slack = 1e-9 * step
        values = [v for v in values if low - slack <= v <= high + slack]
    else:
        low = values[0]
        high = values[-1]

    order = math.floor(math.log10(max(abs(low), abs(high))))
    exponent = 0
    if order < -2 or order > 4:
        exponent = order
    unit = 10.0**exponent
    multiples = [value / unit for value in values]
    labels = format_multiples(multiples, step / unit)
    ticks = tuple(map(Tick, values, labels))
    return AxisScale(low, high, False, exponent, ticks)


def _round_up(rough: float) -> float:
    """Return the next number that is 1, 2, 2.5 or 5 times a power of ten."""
    unit = 10.0 ** math.floor(math.log10(rough))
    least = rough * (1 - 1e-9)
    round_numbers = [factor * unit for factor in ROUND_FACTORS]
    return min(number for number in round_numbers if number >= least)


def logarithmic(low: float, high: float) -> AxisScale:
    """Return a logarithmic axis over whole decades.

    A single decade has ticks between, many decades skip some.
    """
    first = math.floor(math.log10(low) + 1e-9)
    last = math.ceil(math.log10(high) - 1e-9)
    last = max(last, first + 1)
    decades = last - first
    every = 1 + decades // 7
    low = 10.0**first
    high = 10.0**last
    ticks = []
    for exponent in range(first, last + 1, every):
        ticks.append(Tick(10.0**exponent, format_power(exponent)))
    if decades == 1:
        for factor in (2, 5):
            label = f"{factor}×{format_power(first)}"
            ticks.append(Tick(factor * low, label))
    return AxisScale(low, high, True, 0, tuple(ticks))


def close_logarithmic(low: float, high: float) -> AxisScale:
    """Return a logarithmic axis that ends at the next 1, 2 or 5 times a power of ten.

    Where there are many ticks, only the powers of ten are labelled.
    """
    first_decade = math.floor(math.log10(low)) - 1
    last_decade = math.ceil(math.log10(high)) + 1
    marks = []
    for exponent in range(first_decade, last_decade):
        for factor in (1, 2, 5):
            marks.append((factor * 10.0**exponent, factor, exponent))
    start = max(value for value, _, _ in marks if value <= 0.8 * low)
    end = min(value for value, _, _ in marks if value >= 1.25 * high)
    marks = [mark for mark in marks if start <= mark[0] <= end]

    ticks = []
    for value, factor, exponent in marks:
        if factor != 1 and len(marks) > MOST_LABELS:
            continue
        if exponent in PLAIN_POWERS:
            label = f"{value:g}"
        elif factor == 1:
            label = format_power(exponent)
        else:
            label = f"{factor}×{format_power(exponent)}"
        ticks.append(Tick(value, label))
    return AxisScale(start, end, True, 0, tuple(ticks))


def spanning(
    series: Sequence[ArrayLike], *, zero: bool = True, log: bool | None = None
) -> AxisScale:
    """Return an axis for series of values; values that are not finite are left out.

    Args:
        series: values, of any shape.
        zero: whether a linear axis holds 0.
        log: whether the axis is logarithmic; None decides by the range of the values.
    """
    parts = [np.asarray(values, np.float64).ravel() for values in series]
    values = np.concatenate([*parts, np.zeros(0)])
    values = values[np.abs(values) < HUGE]  # NaN is not less
    values = np.where(np.abs(values) < TINY, 0.0, values)
    if not values.size:
        return linear(0.0, 1.0)
    low = float(values.min())
    high = float(values.max())
    positive = values[:0]
    if high > 0.0:
        positive = values[values > DEEPEST * high]

    has_logs = positive.size > 0
    if log is None:
        log = False
        if has_logs and low >= 0.0:
            log = float(np.percentile(positive, 5)) * WIDE < high
    if log and has_logs:
        return logarithmic(float(positive.min()), high)
    if zero:
        low = min(low, 0.0)
        high = max(high, 0.0)
    return linear(low, high)


# lengths of a chart [pixel]
WIDTH = 460
HEIGHT = 270
LEFT = 44
RIGHT = 10
TOP = 30
BOTTOM = 40
MARGIN = 3  # marks may reach so far over the rim of the plot
DOT_RADIUS = 5
REACH_RADIUS = 14  # of the disc around a dot that the pointer meets
LINE_REACH = 2.0  # from the middle of a line to labels
LABEL_ROOM = 26  # letters of a dot's label
JOINED_LABEL_ROOM = 40  # of a label in two lines
KEY_COLUMNS = 2
KEY_GAP = 8  # above the key
KEY_ROW = 17  # height of a row of the key
KEY_MARK = 22  # width of a mark of the key
TICK_LETTER = 6.0  # width of a letter of a tick

FAR = 3.0
"""Marks are cut off at so many heights or widths of the plot."""


@dataclass(frozen=True, kw_only=True)
class Spot:
    """A dot that has a name, and that the keyboard reaches."""

    x: float
    y: float
    name: str  # drawn beside it where there is room
    description: str  # the dot in words, for readers who do not see it
    kind: str  # classes of the mark
    href: str | None = None  # where it leads


@dataclass(frozen=True)
class KeyItem:
    """A mark of the chart, and what it stands for."""

    kind: str  # classes of the mark; the first is "dot" or "line"
    name: str


def key_height(items: Sequence[KeyItem]) -> int:
    """Return the height of a key below a chart [pixel]."""
    if not items:
        return 0
    rows = math.ceil(len(items) / KEY_COLUMNS)
    return KEY_GAP + KEY_ROW * rows


class Plot:
    """One chart, built mark by mark.

    Args:
        x: scale of the horizontal axis.
        y: scale of the vertical axis.
        x_label: name of the horizontal axis.
        y_label: name of the vertical axis.
        height: height of the chart without its key [pixel].
        key: marks that are explained below the chart, row by row.
    """

    def __init__(
        self,
        x: AxisScale,
        y: AxisScale,
        *,
        x_label: str,
        y_label: str,
        height: int = HEIGHT,
        key: Sequence[KeyItem] = (),
    ) -> None:
        self._x = x
        self._y = y
        self._x_label = x_label
        self._y_label = y_label
        self._height = height
        self._plot_width = WIDTH - LEFT - RIGHT
        self._plot_height = height - TOP - BOTTOM
        self._marks: list[Markup] = []
        self._key = tuple(key)
        self._notes: list[LabelBox] = []  # text that labels of dots must not cover
        self._is_interactive = False

    def line(
        self,
        x: ArrayLike,
        y: ArrayLike,
        kind: str,
        title: str = "",
        *,
        is_free: bool = False,
    ) -> None:
        """Draw a line through points; NaN leaves a gap.

        Labels of dots do not cover a free line.
        """
        points = self._points(x, y)
        self._add_path(path_data(points), f"line {kind}", title)
        if is_free:
            self._notes += _boxes_along(points)

    def band(self, x: ArrayLike, low: ArrayLike, high: ArrayLike, kind: str) -> None:
        """Fill between two lines where both are numbers."""
        above = self._points(x, high)
        below = self._points(x, low)
        is_finite = np.isfinite(np.array([above, below])).all(axis=(0, 2))
        for run in _runs(is_finite):
            outline = above[run] + below[run][::-1]
            self._add_path(path_data(outline) + "Z", f"band {kind}")

    def steps(
        self, edges: ArrayLike, heights: ArrayLike, kind: str, title: str = ""
    ) -> None:
        """Draw the outline of a histogram; there is one edge more than heights."""
        x = np.repeat(np.asarray(edges, np.float64), 2)[1:-1]
        y = np.repeat(np.asarray(heights, np.float64), 2)
        self.line(x, y, f"steps {kind}", title)

    def dots(self, x: ArrayLike, y: ArrayLike, kind: str) -> None:
        """Draw a cloud of points."""
        data = _dot_data(self._points(x, y))
        self._add_path(data, f"dots {kind}")

    def level(self, value: float, label: str) -> None:
        """Draw a horizontal line with a label at its right end."""
        row = float(self._rows(value))
        right = self._plot_width
        line = _draw_line((0, row), (right, row), "level")
        note = draw_text(label, right, row - 5, "note end")
        self._marks += [line, note]

    def upright(self, value: float, label: str) -> None:
        """Draw a vertical line with a label at its top."""
        column = float(self._columns(value))
        bottom = self._plot_height
        line = _draw_line((column, 0), (column, bottom), "level")
        self._marks.append(line)
        is_right = column > self._plot_width / 2
        if is_right:
            note = Label(label, column - 5, 11, 1.0)
        else:
            note = Label(label, column + 5, 11, 0.0)
        self._marks.append(_draw_label(note, "note"))
        self._notes.append(note.box)

    def spots(self, spots: Sequence[Spot], *, joined: bool = False) -> None:
        """Draw dots that the keyboard reaches, with labels where there is room.

        Spots that come first have the choice. If labels are joined, a line leads from a
        dot to a label that does not stand beside it.
        """
        self._is_interactive = True
        x = [spot.x for spot in spots]
        y = [spot.y for spot in spots]
        points = self._points(x, y)
        if joined:
            place = place_joined_labels
            names = [wrap_name(clipped(spot.name, JOINED_LABEL_ROOM)) for spot in spots]
        else:
            place = place_labels
            names = [clipped(spot.name, LABEL_ROOM) for spot in spots]
        labels = place(
            names,
            points,
            plot=LabelBox(0, 0, self._plot_width, self._plot_height),
            taken=self._notes,
        )
        for spot, point, label in zip(spots, points, labels, strict=True):
            self._marks.append(_draw_spot(spot, point, label))

    def svg(self, title: str, description: str) -> Markup:
        """Return the chart."""
        shift = f"translate({MARGIN} {MARGIN})"
        area = tag(
            "svg",
            tag("g", *self._marks, transform=shift),
            x=LEFT - MARGIN,
            y=TOP - MARGIN,
            width=self._plot_width + 2 * MARGIN,
            height=self._plot_height + 2 * MARGIN,
        )
        role = "img"
        if self._is_interactive:
            role = "group"
        parts = [
            *self._draw_y_axis(),
            *self._draw_x_axis(),
            *self._draw_axis_labels(),
            area,
            *self._draw_key(),
        ]
        height = self._height + key_height(self._key)
        return _wrap_svg(height, title, description, parts, role=role)

    def _add_path(self, data: str, kind: str, title: str = "") -> None:
        children = []
        if title:
            children.append(tag("title", title))
        self._marks.append(tag("path", *children, d=data, class_=kind))

    def _points(self, x: ArrayLike, y: ArrayLike) -> list[Point]:
        """Return the places of values, across and down [pixel]."""
        columns = self._columns(x).tolist()
        rows = self._rows(y).tolist()
        return list(zip(columns, rows, strict=True))

    def _columns(self, x: ArrayLike) -> Floats:
        return np.clip(self._x.share(x), -FAR, FAR) * self._plot_width

    def _rows(self, y: ArrayLike) -> Floats:
        return (1.0 - np.clip(self._y.share(y), -FAR, FAR)) * self._plot_height

    def _draw_y_axis(self) -> list[Markup]:
        """Return a line across the plot for each tick, with its label."""
        right = WIDTH - RIGHT
        label_right = LEFT - 7
        drawn = []
        for tick in self._y.ticks:
            row = TOP + float(self._rows(tick.value))
            line = _draw_line((LEFT, row), (right, row), "grid")
            label = draw_text(tick.label, label_right, row + 4, "tick end")
            drawn += [line, label]
        return drawn

    def _draw_x_axis(self) -> list[Markup]:
        """Return the axis with a mark for each tick, with its label."""
        right = WIDTH - RIGHT
        bottom = TOP + self._plot_height
        mark_bottom = bottom + 4
        base_line = bottom + 17
        drawn = []
        for tick in self._x.ticks:
            column = LEFT + float(self._columns(tick.value))
            mark = _draw_line((column, bottom), (column, mark_bottom), "mark")
            # a label at the end of the axis stays inside the chart
            half_width = TICK_LETTER * len(tick.label) / 2
            middle = min(column, WIDTH - half_width)
            label = draw_text(tick.label, middle, base_line, "tick middle")
            drawn += [mark, label]
        axis = _draw_line((LEFT, bottom), (right, bottom), "axis")
        drawn.append(axis)
        return drawn

    def _draw_axis_labels(self) -> list[Markup]:
        x_label = _with_factor(self._x_label, self._x)
        y_label = _with_factor(self._y_label, self._y)
        right = WIDTH - RIGHT
        below = self._height - 5
        return [
            draw_text(x_label, right, below, "label end"),
            draw_text(y_label, 2, 14, "label"),
        ]

    def _draw_key(self) -> list[Markup]:
        """Return the marks below the chart with their names, row by row."""
        column_width = WIDTH / KEY_COLUMNS
        drawn = []
        for number, item in enumerate(self._key):
            row, column = divmod(number, KEY_COLUMNS)
            left = 2 + column * column_width
            base_line = self._height + KEY_GAP + row * KEY_ROW + 10
            middle = base_line - 4
            if item.kind.startswith("dot"):
                place = {"cx": f"{left + KEY_MARK / 2:.1f}", "cy": f"{middle:.1f}"}
                circle = tag("circle", **place, r=DOT_RADIUS)
                mark = tag("g", circle, class_=item.kind)
            else:
                mark = _draw_line((left, middle), (left + KEY_MARK, middle), item.kind)
            name = draw_text(item.name, left + KEY_MARK + 5, base_line, "note")
            drawn += [mark, name]
        return drawn


def _draw_spot(spot: Spot, point: Point, label: Label | None) -> Markup:
    """Return a dot with its label; the element takes the keyboard's focus.

    Its title is what screen readers say.
    """
    x, y = point
    place = {"cx": f"{x:.1f}", "cy": f"{y:.1f}"}
    parts = [
        tag("title", spot.description),
        tag("circle", **place, r=REACH_RADIUS, class_="reach"),
        tag("circle", **place, r=DOT_RADIUS),
    ]
    if label is not None:
        if label.line_end is not None:
            parts.insert(1, _draw_line(point, label.line_end, "mark"))
        parts.append(_draw_label(label, "name"))
    kind = f"dot {spot.kind}".strip()
    if spot.href is None:
        element = "g"
        attributes: dict[str, object] = {"tabindex": 0, "role": "img"}
    else:
        element = "a"
        attributes = {"href": spot.href}
    return tag(element, *parts, class_=kind, **attributes)


# lengths of a chart of bars [pixel]
ROW_HEIGHT = 40
BAR_HEIGHT = 11
BARS_LEFT = 8
BARS_RIGHT = 14


@dataclass(frozen=True, kw_only=True)
class Bar:
    """One bar of a chart."""

    label: str  # what it stands for
    value: float  # its length; NaN leaves it out
    value_text: str  # the value as text
    dots: Sequence[float]  # values of the scenarios, drawn on the bar
    kind: str  # classes of the mark
    bold: bool = False  # whether it is the best


def bar_chart(
    bars: Sequence[Bar], scale: AxisScale, *, label: str, title: str, description: str
) -> Markup:
    """Return horizontal bars with their names above them."""
    bottom = ROW_HEIGHT * len(bars) + 6
    drawn: list[Markup] = []
    for tick in scale.ticks:
        column = _bar_column(scale, tick.value)
        line = _draw_line((column, 4), (column, bottom), "grid")
        tick_label = draw_text(tick.label, column, bottom + 16, "tick middle")
        drawn += [line, tick_label]

    start = float(BARS_LEFT)
    if not scale.log:
        start = _bar_column(scale, 0.0)
    for number, bar in enumerate(bars):
        top = number * ROW_HEIGHT + 19
        drawn.append(_draw_bar_name(bar, top))
        if np.isfinite(bar.value):
            end = _bar_column(scale, bar.value)
            drawn.append(_draw_bar(bar, start, end, top=top))
        middle = top + BAR_HEIGHT / 2
        points = []
        for dot in bar.dots:
            if np.isfinite(dot):
                points.append((_bar_column(scale, dot), middle))
        if points:
            drawn.append(tag("path", d=_dot_data(points), class_="dots on"))

    axis = _draw_line((start, 4), (start, bottom), "axis")
    right = WIDTH - BARS_RIGHT
    axis_label = _with_factor(label, scale)
    drawn.append(axis)
    drawn.append(draw_text(axis_label, right, bottom + 34, "label end"))
    return _wrap_svg(bottom + 40, title, description, drawn, role="img")


def _bar_column(scale: AxisScale, value: float) -> float:
    """Return where a value stands along the bars [pixel]."""
    across = WIDTH - BARS_LEFT - BARS_RIGHT
    share = float(np.nan_to_num(scale.share(value), nan=0.0))
    return BARS_LEFT + across * min(max(share, 0.0), 1.0)


def _draw_bar(bar: Bar, start: float, end: float, *, top: float) -> Markup:
    width = max(abs(end - start), 1.0)
    return tag(
        "rect",
        x=f"{min(start, end):.1f}",
        y=top,
        width=f"{width:.1f}",
        height=BAR_HEIGHT,
        class_=f"bar {bar.kind}",
    )


def _draw_bar_name(bar: Bar, top: float) -> Markup:
    kind = None
    if bar.bold:
        kind = "strong"
    name = tag("tspan", clipped(bar.label), class_=kind)
    value = tag("tspan", f"  {bar.value_text}", class_="value")
    return tag("text", name, value, x=14, y=top - 5, class_="name")


def draw_text(text: str, x: float, y: float, kind: str) -> Markup:
    """Return a text at a place, on its base line."""
    return tag("text", text, x=f"{x:.1f}", y=f"{y:.1f}", class_=kind)


def _draw_label(label: Label, kind: str) -> Markup:
    classes = f"{kind} {ANCHORS[label.left_share]}".strip()
    lines = []
    for number, line in enumerate(label.text.split("\n")):
        base_line = label.y + number * LINE_HEIGHT
        lines.append(draw_text(line, label.x, base_line, classes))
    return join(lines)


def _draw_line(start: Point, end: Point, kind: str) -> Markup:
    return tag("path", d=path_data([start, end]), class_=kind)


def _boxes_along(points: Sequence[Point]) -> list[LabelBox]:
    """Return small squares side by side along a line through points."""
    boxes = []
    half = LINE_REACH
    for (x, y), (next_x, next_y) in itertools.pairwise(points):
        length = math.hypot(next_x - x, next_y - y)
        if not math.isfinite(length):
            continue
        count = max(math.ceil(length / (2 * half)), 1)
        for number in range(count + 1):
            share = number / count
            column = x + share * (next_x - x)
            row = y + share * (next_y - y)
            boxes.append(LabelBox(column - half, row - half, column + half, row + half))
    return boxes


def _dot_data(points: Iterable[Point]) -> str:
    """Return path data of single points; a line with round ends makes dots of them."""
    return "".join(path_data([point]) for point in points)


def _wrap_svg(
    height: int, title: str, description: str, parts: Sequence[object], *, role: str
) -> Markup:
    return tag(
        "svg",
        tag("title", title),
        tag("desc", description),
        *parts,
        viewBox=f"0 0 {WIDTH} {height}",
        class_="chart",
        role=role,
        aria_label=title,
    )


def _with_factor(label: str, scale: AxisScale) -> Markup:
    if not scale.factor:
        return join([label])
    return join([label, tag("tspan", f"  {scale.factor}", class_="factor")])


def _runs(is_kept: NDArray[np.bool_]) -> list[slice]:
    """Return the stretches of True.

    >>> _runs(np.array([True, True, False, True]))
    [slice(0, 2, None), slice(3, 4, None)]
    """
    padded = np.concatenate([[False], is_kept, [False]])
    changes = np.flatnonzero(np.diff(padded.astype(np.int8)))
    starts = changes[0::2].tolist()
    stops = changes[1::2].tolist()
    return list(map(slice, starts, stops))
