"""Which parameters a size needs, and which values its numbers may have.

Checked when a datasets.yaml is loaded, for every split alike; what the constants of a
solver may be is told where it gets them (``lagbench.generators.constants``). Every
mistake is a ``ValueError`` whose message names key, expected, got and, for names, the
nearest known one.

Scenario ids as text: ``0,3-5`` means 0, 3, 4 and 5.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from lagbench.errors import UsageError, nearest

Value = int | float | bool | str

SUBSETS = ("train", "valid", "test", "extra")


@dataclass(frozen=True, kw_only=True)
class Limit:
    """The numbers that a parameter may be."""

    low: float = -math.inf  # least value
    high: float = math.inf  # greatest value
    whole: bool = False  # whether it must be an integer
    open_low: bool = False  # whether 'low' itself is too small
    open_high: bool = False  # whether 'high' itself is too large

    def holds(self, value: object) -> bool:
        """Tell whether a value is a finite number within the limit."""
        kinds = int if self.whole else (int, float)
        if (
            isinstance(value, bool)
            or not isinstance(value, kinds)
            or not math.isfinite(value)
        ):
            return False
        if self.open_low:
            above = self.low < value
        else:
            above = self.low <= value
        if self.open_high:
            below = value < self.high
        else:
            below = value <= self.high
        return above and below

    def __str__(self) -> str:
        """Return the limit in words.

        >>> print(Limit(low=1, high=4096, whole=True))
        an integer, >= 1 and <= 4096
        """
        if self.low > -math.inf:
            low = f"{'>' if self.open_low else '>='} {self.low:.10g}"
        else:
            low = ""
        if self.high < math.inf:
            high = f"{'<' if self.open_high else '<='} {self.high:.10g}"
        else:
            high = ""
        sides = " and ".join(side for side in (low, high) if side)
        if self.whole:
            kind = "an integer"
        else:
            kind = "a finite number"
        if sides:
            return f"{kind}, {sides}"
        return kind


NEEDED = {
    "particles": Limit(low=1, high=10_000_000, whole=True),
    "grid": Limit(low=4, high=4096, whole=True),
    "substeps_per_frame": Limit(low=1, high=1_000_000, whole=True),
    "frame_rate": Limit(low=0, high=1e9, open_low=True),
    "density": Limit(low=0, open_low=True),
}
"""What every split must give: reading, estimating and writing rest on it."""

FRAMES = Limit(low=1, high=1_000_000, whole=True)
"""Frames of one scenario."""


def check_parameters(
    size: str, given: Mapping[str, Value], declared: Mapping[str, Value | None]
) -> None:
    """Refuse unknown, missing and impossible parameters of a size."""
    for name in given:
        if name not in declared:
            raise ValueError(
                f"size {size}: undeclared parameter {name!r}: {nearest(name, declared)}"
            )
    missing = [n for n, value in declared.items() if value is None and n not in given]
    if missing:
        raise ValueError(f"size {size}: no value for {', '.join(missing)}")
    for name in NEEDED:
        if name not in declared:
            raise ValueError(
                f"parameters: no {name!r}, which every split needs; "
                f"{nearest(name, declared)}"
            )
    for name, default in declared.items():
        if name in given:
            key = f"sizes.{size}.parameters.{name}"
        else:
            key = f"parameters.{name}.value"
        value = given.get(name, default)
        limit = NEEDED.get(name, Limit())
        # Texts and switches are a split's own affair, unless the name is one that every
        # split needs.
        if not limit.holds(value) and (
            name in NEEDED or not isinstance(value, bool | str)
        ):
            raise ValueError(f"{key}: expected {limit}; got {value!r}")


def check_subsets(size: str, subsets: Mapping[str, Sequence[int]]) -> None:
    """Refuse unknown subsets and ids that stand in two of them."""
    unknown = set(subsets) - set(SUBSETS)
    if unknown:
        raise ValueError(
            f"size {size}: no subset {min(unknown)!r}: {nearest(min(unknown), SUBSETS)}"
        )
    ids = [i for subset in subsets.values() for i in subset]
    if len(ids) != len(set(ids)):
        raise ValueError(f"size {size}: a scenario stands in two subsets")


def check_frames(
    size: str,
    frames: int | Mapping[int, Sequence[int]],
    subsets: Mapping[str, Sequence[int]],
    *,
    task_frames: int,
) -> None:
    """Refuse impossible frame counts, and test scenarios shorter than their task."""
    key = f"sizes.{size}.frames"
    ids = sorted(i for subset in subsets.values() for i in subset)
    if isinstance(frames, int):
        pairs = [(i, frames) for i in ids]
    else:
        pairs = sorted((i, count) for count, group in frames.items() for i in group)
        if [i for i, _ in pairs] != ids:
            raise ValueError(f"size {size}: frames must name every scenario once")
    for scenario, count in pairs:
        if not FRAMES.holds(count):
            raise ValueError(f"{key}: expected {FRAMES}; got {count!r}")
        if scenario in subsets.get("test", ()) and count < task_frames:
            least = f"at least input_frames + horizon = {task_frames} for test scenario {scenario}"
            raise ValueError(f"{key}: expected {least}; got {count}")


MAX_ID = 9999
"""Largest scenario id: file names have four digits."""


def parse_ids(
    text: str | int, *, where: str = "--scenarios", noun: str = "id"
) -> tuple[int, ...]:
    """Return the scenario ids that a text names, in its order.

    Args:
        text: comma-separated ids and inclusive ranges; an int stands for itself.
        where: option that gave the text, for messages.
        noun: what the numbers are, for messages.

    Raises:
        UsageError: the text is no list of ids, a range runs backwards, or an id stands
            twice.

    >>> parse_ids("0,3-5")
    (0, 3, 4, 5)
    """

    def bad(got: str) -> UsageError:
        expected = f"{noun}s and ranges from 0 to {MAX_ID}, as in 0,3-5"
        return UsageError(
            f"bad list of {noun}s {text!r}", where=where, expected=expected, got=got
        )

    ids: list[int] = []
    for part in str(text).replace(" ", "").split(","):
        match = re.fullmatch(r"(\d{1,4})(?:-(\d{1,4}))?", part)
        if match is None:
            raise bad(f"{part!r} is no {noun} and no range")
        first = int(match[1])
        last = int(match[2] or match[1])
        if last < first:
            raise bad(f"{part!r} runs backwards")
        ids.extend(range(first, last + 1))
    if len(set(ids)) != len(ids):
        raise bad("a number stands twice")
    return tuple(ids)


def spell_ids(ids: Iterable[int]) -> str:
    """Return the shortest text that :func:`parse_ids` reads as these ids.

    >>> spell_ids([0, 3, 4, 5])
    '0,3-5'
    """
    runs: list[list[int]] = []
    for i in ids:
        if runs and i == runs[-1][-1] + 1:
            runs[-1].append(i)
        else:
            runs.append([i])
    return ",".join(
        f"{run[0]}-{run[-1]}" if len(run) > 1 else f"{run[0]}" for run in runs
    )
