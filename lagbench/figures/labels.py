"""Labels of dots in a chart: beside their dot, where they cover nothing.

A label may stand farther away, where a line joins it with its dot. A label that finds
no room is left out; its dot still says its name to the pointer, the keyboard and screen
readers. Lengths are in pixels from the top left of the plot, and
the width of a text is estimated.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

Point = tuple[float, float]

DOT_REACH = 7.0  # half the side of the square that a dot takes
ASCENT = 11.0
DESCENT = 3.0
LINE_HEIGHT = 14.0
LONGEST_LINE = 14  # letters of a name that stays in one line
# of the largest size in which a style sheet writes labels
CAPITAL_WIDTH = 10.0
LETTER_WIDTH = 7.2

# Shift of a label from the middle of its dot, and the share of it that lies to the
# left. Labels above and below clear the dots that stand in one row with theirs, those
# farther away the dots that stand a little higher or lower.
ABOVE = -11.0
BELOW = 19.0
FAR_ABOVE = -20.0
FAR_BELOW = 28.0
SHIFTS = (
    (9.0, 4.0, 0.0),
    (-9.0, 4.0, 1.0),
    (0.0, ABOVE, 0.5),
    (0.0, BELOW, 0.5),
    (-6.0, ABOVE, 0.0),
    (-6.0, BELOW, 0.0),
    (6.0, ABOVE, 1.0),
    (6.0, BELOW, 1.0),
    (0.0, FAR_ABOVE, 0.5),
    (0.0, FAR_BELOW, 0.5),
    (-6.0, FAR_ABOVE, 0.0),
    (-6.0, FAR_BELOW, 0.0),
    (6.0, FAR_ABOVE, 1.0),
    (6.0, FAR_BELOW, 1.0),
)

NEAR_SHIFTS = SHIFTS[:8]  # of labels that a reader joins with their dot without a line

CLEARER = 3.0
"""A label without a line is nearer to its own dot than to others by so much."""

# lengths of lines from the middle of a dot to its label, and their directions
LINE_LENGTHS = (20.0, 28.0, 38.0, 50.0, 64.0, 80.0, 96.0)
DIRECTIONS = 48
STEEP = 0.7  # cosine up to which a line ends above or below its label
STEP = 2.0  # between points of a line that must be free
DOT_RADIUS = 5.0
MOST_JOINED = 25  # labels that may have a line: the search for its place takes long

ANCHORS = {0.0: "", 0.5: "middle", 1.0: "end"}
"""Class of the style sheet by the share of a text that lies left of its place."""


@dataclass(frozen=True)
class LabelBox:
    """A rectangle that something takes."""

    left: float
    top: float
    right: float
    bottom: float

    def overlaps(self, other: LabelBox) -> bool:
        """Return whether two rectangles share an area."""
        is_across = self.left < other.right and self.right > other.left
        is_down = self.top < other.bottom and self.bottom > other.top
        return is_across and is_down

    def distance(self, point: Point) -> float:
        """Return the distance of a point from the rectangle, 0 inside it."""
        x, y = point
        across = max(self.left - x, 0.0, x - self.right)
        down = max(self.top - y, 0.0, y - self.bottom)
        return math.hypot(across, down)

    def contains(self, other: LabelBox) -> bool:
        """Return whether another rectangle lies in this one."""
        is_across = self.left <= other.left and other.right <= self.right
        is_down = self.top <= other.top and other.bottom <= self.bottom
        return is_across and is_down


@dataclass(frozen=True)
class Label:
    """A text of one or more lines at a place, on the base line of its first line."""

    text: str
    x: float
    y: float
    left_share: float  # share of the text that lies left of x: 0, 0.5 or 1
    line_end: Point | None = None  # of the line from its dot, where there is one

    @property
    def box(self) -> LabelBox:
        """The rectangle that the text takes."""
        lines = self.text.split("\n")
        width = max(_estimate_width(line) for line in lines)
        left = self.x - width * self.left_share
        bottom = self.y + (len(lines) - 1) * LINE_HEIGHT + DESCENT
        return LabelBox(left, self.y - ASCENT, left + width, bottom)


def _estimate_width(line: str) -> float:
    width = 0.0
    for letter in line:
        if letter.isupper():
            width += CAPITAL_WIDTH
        else:
            width += LETTER_WIDTH
    return width


def wrap_name(name: str) -> str:
    r"""Return a long name in two lines, broken at the space nearest to its middle.

    >>> wrap_name("Hybrid projection solver")
    'Hybrid\nprojection solver'
    """
    spaces = [place for place, letter in enumerate(name) if letter == " "]
    if len(name) <= LONGEST_LINE or not spaces:
        return name
    middle = (len(name) - 1) / 2
    place = min(spaces, key=lambda space: abs(space - middle))
    return f"{name[:place]}\n{name[place + 1 :]}"


def place_labels(
    names: Sequence[str],
    dots: Sequence[tuple[float, float]],
    *,
    plot: LabelBox,
    taken: Sequence[LabelBox] = (),
) -> list[Label | None]:
    """Return the label of each dot, None where there is no room.

    Labels that come first have the choice.

    Args:
        names: text of each label.
        dots: middle of each dot, across and down.
        plot: the rectangle that labels must not leave.
        taken: rectangles that hold other text.
    """
    occupied = list(taken)
    for x, y in dots:
        box = LabelBox(x - DOT_REACH, y - DOT_REACH, x + DOT_REACH, y + DOT_REACH)
        occupied.append(box)

    labels: list[Label | None] = []
    for name, (x, y) in zip(names, dots, strict=True):
        label = _find_room(name, x, y, plot=plot, occupied=occupied)
        labels.append(label)
        if label is not None:
            occupied.append(label.box)
    return labels


def _find_room(
    name: str, x: float, y: float, *, plot: LabelBox, occupied: Sequence[LabelBox]
) -> Label | None:
    candidates = []
    for right, down, left_share in SHIFTS:
        candidates.append(Label(name, x + right, y + down, left_share))
    # a long name near the rim ends there, above or below its dot
    for down in (ABOVE, BELOW):
        at_rim = Label(name, plot.right, y + down, 1.0)
        if at_rim.box.left <= x:
            candidates.append(at_rim)
    for label in candidates:
        box = label.box
        if plot.contains(box) and not any(box.overlaps(other) for other in occupied):
            return label
    return None


def place_joined_labels(
    names: Sequence[str],
    dots: Sequence[Point],
    *,
    plot: LabelBox,
    taken: Sequence[LabelBox] = (),
) -> list[Label | None]:
    """Return the label of each dot, None where there is no room.

    A label that stands beside its dot is clearly nearer to it than to other dots. Other
    labels have a line. It crosses neither other labels nor lines of other labels nor
    other dots. Labels that come first have the choice. Only the first
    :data:`MOST_JOINED` may have a line.

    Args:
        names: text of each label.
        dots: middle of each dot, across and down.
        plot: the rectangle that labels must not leave.
        taken: rectangles that hold other text or lines.
    """
    occupied = list(taken)
    for x, y in dots:
        box = LabelBox(x - DOT_REACH, y - DOT_REACH, x + DOT_REACH, y + DOT_REACH)
        occupied.append(box)

    labels: list[Label | None] = []
    placed_boxes: list[LabelBox] = []  # of labels and of their lines
    for number, name in enumerate(names):
        dot = dots[number]
        other_dots = [other for other in dots if other != dot]
        label = None
        for candidate in _propose_labels(name, dot):
            if candidate.line_end is not None and number >= MOST_JOINED:
                break
            box = candidate.box
            if not plot.contains(box):
                continue
            if any(box.overlaps(other) for other in occupied):
                continue
            if any(box.overlaps(other) for other in placed_boxes):
                continue
            if candidate.line_end is None:
                is_clear = _is_clear(box, dot, other_dots)
            else:
                end = candidate.line_end
                is_clear = _is_free_line(dot, end, other_dots, placed_boxes)
            if is_clear:
                label = candidate
                break
        labels.append(label)
        if label is None:
            continue
        placed_boxes.append(label.box)
        if label.line_end is not None:
            for x, y in _points_of_line(dot, label.line_end):
                placed_boxes.append(LabelBox(x - 1, y - 1, x + 1, y + 1))
    return labels


def _propose_labels(name: str, dot: Point) -> Iterator[Label]:
    """Yield labels beside a dot, then labels that a line joins with it."""
    x, y = dot
    more_lines = name.count("\n") * LINE_HEIGHT
    for right, down, left_share in NEAR_SHIFTS:
        base_line = y + down - more_lines * _share_above(down)
        yield Label(name, x + right, base_line, left_share)
    for length in LINE_LENGTHS:
        for number in range(DIRECTIONS):
            angle = 2.0 * math.pi * number / DIRECTIONS
            across = math.cos(angle)
            end_x = x + length * across
            end_y = y + length * math.sin(angle)
            line_end = (end_x, end_y)
            if abs(across) > STEEP:
                left_share = 0.0 if across > 0.0 else 1.0
                away = math.copysign(3.0, across)
                base_line = end_y + 4.0 - more_lines / 2
                yield Label(name, end_x + away, base_line, left_share, line_end)
                continue
            base_line = end_y + ASCENT
            if end_y < y:
                base_line = end_y - DESCENT - more_lines
            for away, left_share in ((0.0, 0.5), (-6.0, 0.0), (6.0, 1.0)):
                yield Label(name, end_x + away, base_line, left_share, line_end)


def _share_above(down: float) -> float:
    """Return which share of the further lines of a label rises above its shift."""
    if down < 0.0:
        return 1.0
    if down < BELOW:
        return 0.5
    return 0.0


def _is_clear(box: LabelBox, dot: Point, others: Sequence[Point]) -> bool:
    """Return whether a label is clearly nearer to its dot than to all others."""
    own_distance = box.distance(dot)
    return all(box.distance(other) >= own_distance + CLEARER for other in others)


def _points_of_line(start: Point, end: Point) -> list[Point]:
    """Return points along the line from the rim of a dot to a label."""
    length = math.dist(start, end)
    first_step = math.ceil(DOT_RADIUS / STEP)
    # the last point lies on the end, also where rounding makes the line too short
    last_step = math.floor(length / STEP + 1e-6)
    points = []
    for step in range(first_step, last_step + 1):
        share = step * STEP / length
        x = start[0] + share * (end[0] - start[0])
        y = start[1] + share * (end[1] - start[1])
        points.append((x, y))
    return points


def _is_free_line(
    start: Point, end: Point, other_dots: Sequence[Point], boxes: Sequence[LabelBox]
) -> bool:
    """Return whether a line keeps clear of other dots and of the given boxes.

    It is tested from the rim of its own dot on.

    Args:
        start: the line's own dot.
        end: where it meets its label.
        other_dots: all other dots.
        boxes: labels, and lines of labels, that were placed before.
    """
    clearance = DOT_RADIUS + 1.0
    for point in _points_of_line(start, end):
        if any(math.dist(point, other) < clearance for other in other_dots):
            return False
        if any(box.distance(point) < 1.0 for box in boxes):
            return False
    return True
