"""Limits of the parameters, subsets and frames of a size.

The limits are checked when a datasets.yaml is loaded, for every split alike. The limits
of a solver's constants stand in ``lagbench.generators.constants``. Every refusal is a
``ValueError`` whose message names key, expected, got and, for names, the nearest known
one.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from lagbench.errors import suggest_name

from .field_errors import describe_value

Value = int | float | bool | str

SUBSETS = ("train", "valid", "test", "extra", "shift")
"""Subsets that a size may have; ``shift`` lies outside train on purpose."""

SCORED_SUBSETS = ("test", "shift")
"""Subsets that predictions may be of, and that are scored."""


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
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            return False
        # also an integer may be larger than any float; no comparison holds for NaN
        if not abs(value) <= sys.float_info.max:
            return False
        if self.whole and not isinstance(value, int):
            return False
        if value < self.low or value > self.high:
            return False
        is_on_open_low = self.open_low and value == self.low
        is_on_open_high = self.open_high and value == self.high
        return not is_on_open_low and not is_on_open_high

    def __str__(self) -> str:
        """Return the limit in words.

        >>> print(Limit(low=1, high=4096, whole=True))
        an integer, >= 1 and <= 4096
        """
        bounds = []
        if self.low > -math.inf:
            sign = ">" if self.open_low else ">="
            bounds.append(f"{sign} {self.low:.10g}")
        if self.high < math.inf:
            sign = "<" if self.open_high else "<="
            bounds.append(f"{sign} {self.high:.10g}")
        kind = "an integer" if self.whole else "a finite number"
        if bounds:
            return f"{kind}, {' and '.join(bounds)}"
        return kind


NEEDED = {
    "particles": Limit(low=1, high=10_000_000, whole=True),
    "grid": Limit(low=4, high=4096, whole=True),
    "substeps_per_frame": Limit(low=1, high=1_000_000, whole=True),
    "frame_rate": Limit(low=0, high=1e9, open_low=True),
    "density": Limit(low=0, open_low=True),
}
"""Parameters of every split: reading, estimating and writing need them."""

STATED_NUMBERS = {
    "gravity": Limit(),
    "liquid_viscosity": Limit(low=0),
}
"""Parameters that readers take for numbers, where a split has them."""

FRAMES = Limit(low=1, high=1_000_000, whole=True)
"""Frames of one scenario."""


def check_parameters(
    size: str, values: Mapping[str, Value], declared: Mapping[str, Value | None]
) -> None:
    """Refuse unknown, missing and impossible parameters of a size.

    Args:
        size: name of the size.
        values: values that the size gives.
        declared: default value of each parameter of the split; None without one.

    Raises:
        ValueError: a parameter is unknown, missing or outside its limit, or the split
            does not declare one that every split needs.
    """
    for name in values:
        if name not in declared:
            hint = suggest_name(name, declared)
            raise ValueError(f"size {size}: undeclared parameter {name!r}: {hint}")
    missing = []
    for name, default in declared.items():
        if default is None and name not in values:
            missing.append(name)
    if missing:
        raise ValueError(f"size {size}: no value for {', '.join(missing)}")
    for name in NEEDED:
        if name not in declared:
            hint = suggest_name(name, declared)
            raise ValueError(
                f"parameters: no {name!r}, which every split needs; {hint}"
            )

    known_limits = NEEDED | STATED_NUMBERS
    for name, default in declared.items():
        key = f"parameters.{name}.value"
        if name in values:
            key = f"sizes.{size}.parameters.{name}"
        value = values.get(name, default)
        limit = known_limits.get(name, Limit())
        # A split may have texts and switches of its own.
        is_own_choice = isinstance(value, bool | str) and name not in known_limits
        if not is_own_choice and not limit.holds(value):
            raise ValueError(f"{key}: expected {limit}; got {describe_value(value)}")


def check_subsets(
    size: str, subsets: Mapping[str, Sequence[int]], *, needed: Sequence[str]
) -> None:
    """Refuse unknown and missing subsets, and ids that stand in two of them.

    Args:
        size: name of the size.
        subsets: scenario ids of each subset.
        needed: names of the subsets that every size has.

    Raises:
        ValueError: a subset is unknown or missing, or an id stands in two of them.
    """
    unknown = set(subsets) - set(SUBSETS)
    if unknown:
        name = min(unknown)
        hint = suggest_name(name, SUBSETS)
        raise ValueError(f"size {size}: no subset {name!r}: {hint}")
    for name in needed:
        if name not in subsets:
            raise ValueError(f"size {size}: no subset {name!r}, which every size needs")
    ids = _all_ids(subsets)
    if len(ids) != len(set(ids)):
        raise ValueError(f"size {size}: a scenario stands in two subsets")


def check_frames(
    size: str,
    frames: int | Mapping[int, Sequence[int]],
    subsets: Mapping[str, Sequence[int]],
    *,
    task_frames: int,
) -> None:
    """Refuse impossible frame counts, and test scenarios shorter than their task.

    Args:
        size: name of the size.
        frames: frames of every scenario, or the ids of scenarios by frame count.
        subsets: scenario ids of each subset.
        task_frames: frames that the task needs of a test scenario.

    Raises:
        ValueError: a count is impossible, or a scenario has none or several.
    """
    key = f"sizes.{size}.frames"
    ids = _all_ids(subsets)
    if isinstance(frames, int):
        frame_counts = [(scenario, frames) for scenario in ids]
    else:
        frame_counts = []
        for count, group in frames.items():
            frame_counts += [(scenario, count) for scenario in group]
        frame_counts.sort()
        if [scenario for scenario, _ in frame_counts] != ids:
            raise ValueError(f"size {size}: frames must name every scenario once")
    for scenario, count in frame_counts:
        if not FRAMES.holds(count):
            raise ValueError(f"{key}: expected {FRAMES}; got {describe_value(count)}")
        for subset in SCORED_SUBSETS:
            if scenario in subsets.get(subset, ()) and count < task_frames:
                least = f"at least input_frames + horizon = {task_frames}"
                raise ValueError(
                    f"{key}: expected {least} for {subset} scenario {scenario}; "
                    f"got {count}"
                )


def check_particle_counts(
    size: str,
    counts: Mapping[int, Sequence[int]],
    subsets: Mapping[str, Sequence[int]],
    particles: Value | None,
) -> None:
    """Refuse impossible numbers of particles, and a table that is no partition of ids.

    Args:
        size: name of the size.
        counts: ids of the scenarios that have each number of particles, by number.
        subsets: scenario ids of each subset.
        particles: the parameter of that name, which is the largest of the numbers.

    Raises:
        ValueError: a number is impossible, a scenario is unknown, missing or there
            twice, or the largest number is not the parameter ``particles``.
    """
    if not counts:
        return
    key = f"sizes.{size}.particle_counts"
    ids: list[int] = []
    for count, scenarios in counts.items():
        if not NEEDED["particles"].holds(count):
            raise ValueError(f"{key}: expected {NEEDED['particles']}; got {count!r}")
        ids += scenarios
    if sorted(ids) != _all_ids(subsets):
        raise ValueError(f"{key}: must name every scenario once")
    if max(counts) != particles:
        raise ValueError(
            f"{key}: expected the parameter particles, {particles!r}, as the largest; "
            f"got {max(counts)}"
        )


def _all_ids(subsets: Mapping[str, Sequence[int]]) -> list[int]:
    """Return the ids of all subsets, ascending."""
    ids: list[int] = []
    for subset in subsets.values():
        ids += subset
    return sorted(ids)
