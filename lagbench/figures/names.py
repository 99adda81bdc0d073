"""Names of dots in a chart: where they cover nothing, in a crowd with a line to the
dot.

Places are in pixels from the top left of the plot. How wide a name is drawn is
estimated.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from .html import Markup, path_data, tag

Point = tuple[float, float]
"""Across and down [pixel]."""

Box = tuple[float, float, float, float]
"""Left, top, right and bottom [pixel]."""

Place = tuple[float, float, float]
"""Where a name stands: across, down, and the share of it that lies left of there."""

DOT = 7
"""Half the side of what a dot takes [pixel]."""

BESIDE: Sequence[Place] = (
    *((9, 4, 0.0), (-9, 4, 1.0), (4, -9, 0.0), (4, 17, 0.0)),
    *((-4, -9, 1.0), (-4, 17, 1.0), (0, -9, 0.5), (0, 17, 0.5)),
)
"""Places that touch a dot, from its middle."""

FARTHER: Sequence[Place] = tuple(
    (right, down, end)
    for reach in range(24, 144, 14)
    for down in (-reach, reach)
    for right in (0, 14, -14, 28, -28, 56, -56, 84, -84)
    for end in (0.0, 1.0, 0.5)
)
"""Places of names that have a line to their dot."""

CROSSING = 20.0
"""A line may be so much longer if it crosses one dot less [pixel]."""

_ANCHORS = {0.0: "name", 0.5: "name middle", 1.0: "name end"}


class Names:
    """What is written in a plot of some size, and where there is room for more."""

    def __init__(self, across: float, down: float) -> None:
        self._size = (across, down)
        self._taken: list[Box] = []
        self._leads: list[Markup] = []

    def take(self, name: str, place: Place) -> None:
        """Note what is written there anyway."""
        self._taken.append(_box(name, place))

    def keep_off(self, one: Point, other: Point) -> None:
        """Keep names off a line."""
        self._taken += _along(one, other)

    def beside(
        self, names: Sequence[str], places: Sequence[Point]
    ) -> tuple[list[Markup], list[Markup]]:
        """Return the names of dots, empty where there is no room, and lines to those
        that stand aside.

        First come first, but of those that do not touch their dot the longest.
        """
        self._leads = []
        dots = [(x - DOT, y - DOT, x + DOT, y + DOT) for x, y in places]
        found: dict[int, Markup] = {}
        order = list(range(len(names)))
        for choose in (self._touching, self._led):
            for number in order:
                others = dots[:number] + dots[number + 1 :]
                if (place := choose(names[number], places[number], others)) is not None:
                    self._taken.append(_box(names[number], place))
                    found[number] = written(
                        names[number], place[0], place[1], _ANCHORS[place[2]]
                    )
            # Of those without a place the longest are the hardest to find one for.
            order = sorted(
                (n for n in order if n not in found),
                key=lambda number: -len(names[number]),
            )
        return [
            found.get(number, Markup("")) for number in range(len(names))
        ], self._leads

    def _touching(self, name: str, dot: Point, others: Sequence[Box]) -> Place | None:
        """Return the first free place that touches a dot."""
        return next(self._free(name, dot, others, BESIDE), None)

    def _led(self, name: str, dot: Point, others: Sequence[Box]) -> Place | None:
        """Return a place with a line to the dot, which is drawn: a short one that
        crosses few other dots.
        """
        best = None
        least = math.inf
        for place in self._free(name, dot, others, FARTHER):
            box = _box(name, place)
            near = min(max(dot[0], box[0] + 4), box[2] - 4)
            end = (near, box[1] - 1 if box[1] > dot[1] else box[3] + 1)
            length = math.dist(dot, end)
            if length >= least:
                continue
            points = _along(dot, end)
            # near the dots of a crowd their lines are as close
            lead = points[len(points) // 3 :]
            if any(_meet(point, one) for point in lead for one in self._taken):
                continue
            length += CROSSING * sum(
                any(_meet(point, one) for point in lead) for one in others
            )
            if length < least:
                best = (place, end, lead)
                least = length
        if best is None:
            return None
        place, end, lead = best
        self._taken += lead
        self._leads.append(tag("path", d=path_data([dot, end]), class_="mark"))
        return place

    def _free(
        self, name: str, dot: Point, others: Sequence[Box], tries: Sequence[Place]
    ) -> Iterator[Place]:
        """Yield places of a name, tried from the middle of its dot, where it covers
        nothing.
        """
        across, down = self._size
        for right, below, end in tries:
            place = (dot[0] + right, dot[1] + below, end)
            box = _box(name, place)
            inside = box[0] >= 0 and box[2] <= across and box[1] >= 0 and box[3] <= down
            if inside and not any(_meet(box, one) for one in (*others, *self._taken)):
                yield place


def written(text: str, x: float, y: float, kind: str) -> Markup:
    """Return a text at a place, on its base line."""
    return tag("text", text, x=f"{x:.1f}", y=f"{y:.1f}", class_=kind)


def _box(name: str, place: Place) -> Box:
    width = sum(9.0 if letter.isupper() else 6.4 for letter in name)
    left = place[0] - width * place[2]
    return left, place[1] - 11, left + width, place[1] + 3


def _along(one: Point, other: Point) -> list[Box]:
    """Return points of a line, as small boxes."""
    across = other[0] - one[0]
    down = other[1] - one[1]
    steps = max(2, round(math.hypot(across, down) / 4))
    points = [
        (one[0] + k / steps * across, one[1] + k / steps * down)
        for k in range(steps + 1)
    ]
    return [(x - 1, y - 1, x + 1, y + 1) for x, y in points]


def _meet(one: Box, other: Box) -> bool:
    return (
        one[0] < other[2]
        and one[2] > other[0]
        and one[1] < other[3]
        and one[3] > other[1]
    )
