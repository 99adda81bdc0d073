"""Labels of dots in a chart: beside their dot, where they cover nothing.

A label that finds no room is left out; its dot still says its name to the pointer, the
keyboard and screen readers. Lengths are in pixels from the top left of the plot, and
the width of a text is estimated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

DOT_REACH = 7.0  # half the side of the square that a dot takes
ASCENT = 11.0
DESCENT = 3.0
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


@dataclass(frozen=True)
class Label:
    """A text at a place, on its base line."""

    text: str
    x: float
    y: float
    left_share: float  # share of the text that lies left of x: 0, 0.5 or 1

    @property
    def box(self) -> LabelBox:
        """The rectangle that the text takes."""
        width = 0.0
        for letter in self.text:
            if letter.isupper():
                width += CAPITAL_WIDTH
            else:
                width += LETTER_WIDTH
        left = self.x - width * self.left_share
        return LabelBox(left, self.y - ASCENT, left + width, self.y + DESCENT)


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
        is_within = (
            box.left >= plot.left
            and box.right <= plot.right
            and box.top >= plot.top
            and box.bottom <= plot.bottom
        )
        if is_within and not any(box.overlaps(other) for other in occupied):
            return label
    return None
