"""Charts as SVG: axes with few quiet lines, marks whose colours the page's style sheet
knows.

Classes of marks: ``s0`` .. ``s5`` series, ``d1`` .. ``d3`` dashes, ``truth``,
``floor0`` .. for the floors. Each chart has a title and a description for those who do
not see it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .html import Markup, clipped, decimals, join, path_data, power, tag
from .names import Names, written

Floats = NDArray[np.float64]

WIDE = 60.0
"""From this ratio of greatest to least value an axis of errors is logarithmic."""

DEEPEST = 1e-6
"""A logarithmic axis reaches no lower than this share of its top."""


@dataclass(frozen=True)
class Tick:
    """A mark of an axis."""

    value: float  # where it stands
    label: str  # its text


@dataclass(frozen=True)
class Scale:
    """One axis."""

    low: float  # value at its start
    high: float  # value at its end
    log: bool  # whether it is logarithmic
    exponent: int  # the labels are in units of this power of ten
    ticks: tuple[Tick, ...]  # its marks

    def share(self, values: ArrayLike) -> Floats:
        """Return where values lie between low (0) and high (1); NaN where they have no
        place.
        """
        x = np.asarray(values, np.float64)
        if not self.log:
            return (x - self.low) / (self.high - self.low)
        logs = np.where(x > 0.0, np.log10(np.where(x > 0.0, x, 1.0)), np.nan)
        low = math.log10(self.low)
        high = math.log10(self.high)
        return np.asarray((logs - low) / (high - low), np.float64)

    @property
    def factor(self) -> str:
        """What the labels are to be multiplied by, empty for 1."""
        if self.exponent:
            return f"×{power(self.exponent)}"
        return ""


def linear(low: float, high: float, *, count: int = 5, tight: bool = False) -> Scale:
    """Return a linear axis that covers a range."""
    if not high > low:
        middle = abs(low) or 1.0
        high = low + 0.5 * middle
        low = low - 0.5 * middle
    rough = (high - low) / count
    unit = 10.0 ** math.floor(math.log10(rough))
    # the round number next above
    step = next(
        k * unit for k in (1.0, 2.0, 2.5, 5.0, 10.0) if k * unit >= rough * (1 - 1e-9)
    )
    first = math.floor(low / step + 1e-9)
    last = math.ceil(high / step - 1e-9)
    numbers = [k * step for k in range(first, last + 1)]
    if tight:
        numbers = [
            value
            for value in numbers
            if low - 1e-9 * step <= value <= high + 1e-9 * step
        ]
    else:
        low = numbers[0]
        high = numbers[-1]
    largest = max(abs(low), abs(high))
    order = math.floor(math.log10(largest))
    if order < -2 or order > 4:
        exponent = order
    else:
        exponent = 0
    unit = 10.0**exponent
    labels = decimals([value / unit for value in numbers], step / unit)
    return Scale(low, high, False, exponent, tuple(map(Tick, numbers, labels)))


def logarithmic(low: float, high: float) -> Scale:
    """Return a logarithmic axis over whole decades; few decades have ticks between,
    many skip some.
    """
    first = math.floor(math.log10(low) + 1e-9)
    last = math.ceil(math.log10(high) - 1e-9)
    last = max(last, first + 1)
    every = 1 + (last - first) // 7
    ticks = [Tick(10.0**k, power(k)) for k in range(first, last + 1, every)]
    if last - first == 1:
        ticks += [
            Tick(factor * 10.0**first, f"{factor}×{power(first)}") for factor in (2, 5)
        ]
    return Scale(10.0**first, 10.0**last, True, 0, tuple(ticks))


def close_logarithmic(low: float, high: float) -> Scale:
    """Return a logarithmic axis that ends at the next 1, 2 or 5; of many ticks the
    powers of ten are kept.
    """
    decades = range(math.floor(math.log10(low)) - 1, math.ceil(math.log10(high)) + 1)
    marks = [(factor * 10.0**k, factor, k) for k in decades for factor in (1, 2, 5)]
    first = max(i for i, (value, *_) in enumerate(marks) if value <= 0.8 * low)
    last = min(i for i, (value, *_) in enumerate(marks) if value >= 1.25 * high)
    kept = marks[first : last + 1]
    if len(kept) > 8:
        shown = [mark for mark in kept if mark[1] == 1]
    else:
        shown = kept
    ticks = []
    for value, factor, k in shown:
        if factor == 1:
            long = power(k)
        else:
            long = f"{factor}×{power(k)}"
        ticks.append(Tick(value, f"{value:g}" if -3 <= k <= 3 else long))
    return Scale(kept[0][0], kept[-1][0], True, 0, tuple(ticks))


def spanning(
    series: Sequence[ArrayLike], *, zero: bool = True, log: bool | None = None
) -> Scale:
    """Return an axis for series of values; what is not finite is left out."""
    values = np.concatenate(
        [np.asarray(s, np.float64).ravel() for s in series] or [np.zeros(0)]
    )
    values = values[np.isfinite(values) & (np.abs(values) < 1e300)]
    if not values.size:
        return linear(0.0, 1.0)
    low = float(values.min())
    high = float(values.max())
    if high > 0.0:
        positive = values[values > DEEPEST * high]
    else:
        positive = values[:0]
    if log is None:
        log = (
            low >= 0.0
            and positive.size > 0
            and float(np.percentile(positive, 5)) * WIDE < high
        )
    if log and positive.size and high > 1e-300:
        return logarithmic(float(positive.min()), high)
    return linear(min(low, 0.0) if zero else low, max(high, 0.0) if zero else high)


WIDTH = 460
HEIGHT = 270
LEFT = 44
RIGHT = 10
TOP = 30
BOTTOM = 40
MARGIN = 3
"""Marks may reach so far over the rim of the plot [pixel]."""

FAR = 3.0
"""Marks are cut off at so many heights or widths of the plot."""

ROW = 40
BAR = 11
"""Height of a bar's row, and of the bar [pixel]."""


@dataclass(frozen=True, kw_only=True)
class Spot:
    """A dot that has a name, and that the keyboard reaches."""

    x: float
    y: float
    name: str  # drawn beside it where there is room
    said: str  # what it is in words, for those who do not see it
    kind: str  # classes of the mark
    href: str | None = None  # where it leads


class Plot:
    """One chart, built mark by mark."""

    def __init__(
        self, x: Scale, y: Scale, *, x_label: str, y_label: str, height: int = HEIGHT
    ) -> None:
        self._x = x
        self._y = y
        self._labels = (x_label, y_label)
        self._height = height  # height [pixel]; the width is 460
        self._across = WIDTH - LEFT - RIGHT
        self._up = height - TOP - BOTTOM
        self._marks: list[Markup] = []
        self._names = Names(self._across, self._up)
        self._linked = False  # whether the keyboard reaches marks

    def line(self, x: ArrayLike, y: ArrayLike, kind: str, title: str = "") -> None:
        """Draw a line through points; NaN leaves a gap."""
        data = path_data(zip(self._columns(x), self._rows(y), strict=True))
        self._path(data, f"line {kind}", title)

    def front(self, x: ArrayLike, y: ArrayLike) -> None:
        """Draw a line through dots, which their names keep off."""
        self.line(x, y, "front")
        places = list(
            zip(self._columns(x).tolist(), self._rows(y).tolist(), strict=True)
        )
        for pair in pairwise(places):
            self._names.keep_off(*pair)

    def band(self, x: ArrayLike, low: ArrayLike, high: ArrayLike, kind: str) -> None:
        """Fill between two lines where both are numbers."""
        columns = self._columns(x)
        below = self._rows(low)
        above = self._rows(high)
        known = np.isfinite(below) & np.isfinite(above)
        for run in _runs(known):
            there = zip(columns[run], above[run], strict=True)
            back = zip(columns[run][::-1], below[run][::-1], strict=True)
            self._path(path_data([*there, *back]) + "Z", f"band {kind}")

    def steps(
        self, edges: ArrayLike, heights: ArrayLike, kind: str, title: str = ""
    ) -> None:
        """Draw a histogram's outline; there is one edge more than heights."""
        x = np.repeat(np.asarray(edges, np.float64), 2)[1:-1]
        self.line(
            x, np.repeat(np.asarray(heights, np.float64), 2), f"steps {kind}", title
        )

    def dots(self, x: ArrayLike, y: ArrayLike, kind: str) -> None:
        """Draw a cloud of points."""
        points = zip(self._columns(x), self._rows(y), strict=True)
        self._path("".join(path_data([point]) for point in points), f"dots {kind}")

    def level(self, value: float, label: str, *, above: bool = True) -> None:
        """Draw a horizontal line with a name at its right end."""
        row = float(self._rows(np.array([value]))[0])
        self._path(path_data([(0, row), (self._across, row)]), "level")
        if above:
            place = row - 5
        else:
            place = row + 13
        self._marks.append(
            tag("text", label, x=self._across, y=f"{place:.1f}", class_="note end")
        )

    def upright(self, value: float, label: str) -> None:
        """Draw a vertical line with a name at its top."""
        column = float(self._columns(np.array([value]))[0])
        self._path(path_data([(column, 0), (column, self._up)]), "level")
        left = column > self._across / 2
        x, kind = (column - 5, "note end") if left else (column + 5, "note")
        self._marks.append(written(label, x, 11, kind))
        self._names.take(label, (x, 11, float(left)))

    def spots(self, spots: Sequence[Spot]) -> None:
        """Draw dots that the keyboard reaches, and their names where they touch
        nothing; first come first.
        """
        self._linked = True
        columns = self._columns([s.x for s in spots])
        rows = self._rows([s.y for s in spots])
        places = list(zip(columns.tolist(), rows.tolist(), strict=True))
        names, leads = self._names.beside(
            [clipped(spot.name, 22) for spot in spots], places
        )
        for spot, (x, y), name in zip(spots, places, names, strict=True):
            drawn = [
                tag("title", spot.said),
                tag("circle", cx=f"{x:.1f}", cy=f"{y:.1f}", r=14, class_="reach"),
                tag("circle", cx=f"{x:.1f}", cy=f"{y:.1f}", r=5),
                name,
            ]
            kind = f"dot {spot.kind}".strip()
            if spot.href is None:
                reached = {"tabindex": 0, "role": "img"}
            else:
                reached = {"href": spot.href}
            if spot.href is None:
                element = "g"
            else:
                element = "a"
            self._marks.append(
                tag(element, *drawn, class_=kind, **reached, aria_label=spot.said)
            )
        self._marks += leads  # above the dots

    def svg(self, title: str, description: str) -> Markup:
        """Return the chart."""
        area = tag(
            "svg",
            tag("g", *self._marks, transform=f"translate({MARGIN} {MARGIN})"),
            x=LEFT - MARGIN,
            y=TOP - MARGIN,
            width=self._across + 2 * MARGIN,
            height=self._up + 2 * MARGIN,
        )
        return _canvas(
            self._height, title, description, *self._axes(), area, linked=self._linked
        )

    def _path(self, data: str, kind: str, title: str = "") -> None:
        self._marks.append(
            tag("path", *([tag("title", title)] if title else []), d=data, class_=kind)
        )

    def _columns(self, x: ArrayLike) -> NDArray[np.float64]:
        return np.clip(self._x.share(x), -FAR, FAR) * self._across

    def _rows(self, y: ArrayLike) -> NDArray[np.float64]:
        return (1.0 - np.clip(self._y.share(y), -FAR, FAR)) * self._up

    def _axes(self) -> list[Markup]:
        bottom = TOP + self._up
        right = WIDTH - RIGHT
        drawn = []
        for tick in self._y.ticks:
            row = TOP + float(self._rows(tick.value))
            drawn.append(
                tag("path", d=path_data([(LEFT, row), (right, row)]), class_="grid")
            )
            drawn.append(written(tick.label, LEFT - 7, row + 4, "tick end"))
        for tick in self._x.ticks:
            column = LEFT + float(self._columns(tick.value))
            drawn.append(
                tag(
                    "path",
                    d=path_data([(column, bottom), (column, bottom + 4)]),
                    class_="mark",
                )
            )
            drawn.append(written(tick.label, column, bottom + 17, "tick middle"))
        x_label, y_label = self._labels
        return [
            *drawn,
            tag("path", d=path_data([(LEFT, bottom), (right, bottom)]), class_="axis"),
            written(
                _with_factor(x_label, self._x), right, self._height - 5, "label end"
            ),
            written(_with_factor(y_label, self._y), 2, 14, "label"),
        ]


@dataclass(frozen=True, kw_only=True)
class Bar:
    """One bar of a chart."""

    label: str  # what it stands for
    value: float  # its length; NaN leaves it out
    written: str  # the value as text
    dots: Sequence[float]  # values of the scenarios, drawn on the bar
    kind: str  # classes of the mark
    bold: bool = False  # whether it is the best


def bar_chart(
    bars: Sequence[Bar], scale: Scale, label: str, title: str, description: str
) -> Markup:
    """Return horizontal bars with their names above them."""
    left = 8
    right = 14
    across = WIDTH - left - right
    bottom = ROW * len(bars) + 6

    def place(value: float) -> float:
        return left + across * float(
            np.clip(np.nan_to_num(scale.share(value), nan=0.0), 0.0, 1.0)
        )

    drawn: list[Markup] = []
    for tick in scale.ticks:
        column = place(tick.value)
        drawn.append(
            tag("path", d=path_data([(column, 4), (column, bottom)]), class_="grid")
        )
        drawn.append(written(tick.label, column, bottom + 16, "tick middle"))
    if not scale.log:
        zero = place(0.0)
    else:
        zero = left
    for number, bar in enumerate(bars):
        top = number * ROW + 19
        name = tag("tspan", bar.label, class_="strong" if bar.bold else None)
        value = tag("tspan", f"  {bar.written}", class_="value")
        drawn.append(tag("text", name, value, x=14, y=top - 5, class_="name"))
        if np.isfinite(bar.value):
            low, high = sorted((zero, place(bar.value)))
            box = {
                "x": f"{low:.1f}",
                "y": top,
                "width": f"{max(high - low, 1.0):.1f}",
                "height": BAR,
            }
            drawn.append(tag("rect", **box, class_=f"bar {bar.kind}"))
        points = [
            (place(value), top + BAR / 2) for value in bar.dots if np.isfinite(value)
        ]
        if points:
            drawn.append(
                tag("path", d="".join(path_data([p]) for p in points), class_="dots on")
            )
    drawn.append(tag("path", d=path_data([(zero, 4), (zero, bottom)]), class_="axis"))
    drawn.append(
        written(_with_factor(label, scale), WIDTH - right, bottom + 34, "label end")
    )
    return _canvas(bottom + 40, title, description, *drawn)


def _canvas(
    height: int, title: str, description: str, *drawn: object, linked: bool = False
) -> Markup:
    return tag(
        "svg",
        tag("title", title),
        tag("desc", description),
        *drawn,
        viewBox=f"0 0 {WIDTH} {height}",
        class_="chart",
        role="group" if linked else "img",
        aria_label=title,
    )


def _with_factor(label: str, scale: Scale) -> Markup:
    factor = tag("tspan", f"  {scale.factor}", class_="factor") if scale.factor else ""
    return join([label, factor])


def _runs(known: NDArray[np.bool_]) -> list[slice]:
    """Return the stretches of True.

    >>> _runs(np.array([True, True, False, True]))
    [slice(0, 2, None), slice(3, 4, None)]
    """
    change = np.flatnonzero(
        np.diff(np.concatenate([[False], known, [False]]).astype(np.int8))
    )
    return [slice(int(a), int(b)) for a, b in change.reshape(-1, 2)]
