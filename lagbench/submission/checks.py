"""Checks on the predicted positions: finite, frozen, where they lie, how far they
jump.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from lagbench.data.checksums import round_digits
from lagbench.data.registry import Size

from .findings import Findings
from .predictions import Predictions
from .start import JUMP, Start
from .truth import Truth, squared_lengths

MAX_DISTANCE = 10.0
"""Farthest outside the walls that a position may be [length]; the box has length 1."""

FILL = np.float32(9.969209968386869e36)
"""What netCDF puts where a float32 was never written."""


@dataclass
class Survey:
    """What one pass over a scenario's predictions saw."""

    scenario: int
    values: int = 0
    bad: int = 0  # values that are not finite, or were never written
    unwritten: int = 0  # those of them that were never written
    first_bad: tuple[int, int, int] | None = None  # frame, particle and component
    positions: int = 0
    outside: int = 0  # positions more than a solver cell outside the box
    off_grid: int = 0  # positions outside the unit box
    farthest: float = 0.0  # largest distance outside the box along an axis [length]
    first_outside: tuple[int, int] | None = None  # frame and particle
    # frame and particle of the first beyond MAX_DISTANCE
    lost: tuple[int, int] | None = None
    jump_at: tuple[int, int] | None = None  # frame and particle of the largest jump
    settled: int = 0  # frame that is repeated from there to the end
    _first: tuple[int, NDArray[np.float32]] | None = field(default=None, repr=False)
    _last: NDArray[np.float32] | None = field(default=None, repr=False)
    _jump_square: float = field(default=0.0, repr=False)

    @property
    def jump(self) -> float:
        """Largest distance of a particle between consecutive frames [length]."""
        return math.sqrt(self._jump_square)

    def add(self, first: int, block: NDArray[np.float32], size: Size) -> None:
        """Take in consecutive frames [length], shape [frame, particle, space], the
        first one by number.
        """
        if not (
            block.min(initial=0.0) > -np.inf and block.max(initial=0.0) < FILL
        ):  # NaN too
            wrong = ~np.isfinite(block) | (block == FILL)
            if wrong.any():
                if self.first_bad is None:
                    frame, particle, axis = (int(i[0]) for i in np.nonzero(wrong))
                    self.first_bad = (first + frame, particle, axis)
                self.bad += int(np.count_nonzero(wrong))
                self.unwritten += int(np.count_nonzero(block == FILL))
                block = np.where(wrong, np.float32(np.nan), block)
        self.values += block.size
        self._add_places(first, block, size)
        if self._last is None:
            self._first = (first, block[:1].copy())
            self.settled = first
            self._add_steps(first + 1, block)
        else:
            self._add_steps(first, np.concatenate([self._last, block]))
        self._last = block[-1:].copy()

    def follow(self, given: NDArray[np.floating]) -> None:
        """Take in the step from the last given frame to the first predicted one."""
        if self._first:
            frame, first = self._first
            self._add_jumps(frame, np.concatenate([given[None], first]))

    def _add_places(self, first: int, block: NDArray[np.float32], size: Size) -> None:
        slack = 1.0 / size.grid
        low, high = np.array(size.bounds, np.float64).T
        self.positions += block[..., 0].size
        sides = zip(np.moveaxis(block, -1, 0), low, high, strict=True)
        if all(
            left - x.min() <= slack and x.max() - right <= slack
            for x, left, right in sides
        ):
            return  # nearly always, and 20 times as fast; NaN goes on
        beyond = np.fmax(low - block, block - high).max(axis=-1)
        far = beyond > slack
        if far.any():
            if self.first_outside is None:
                frame, particle = (int(i[0]) for i in np.nonzero(far))
                self.first_outside = (first + frame, particle)
            self.outside += int(np.count_nonzero(far))
            self.farthest = max(self.farthest, float(beyond[far].max()))
            self.off_grid += int(
                np.count_nonzero(((block < 0) | (block > 1)).any(axis=-1))
            )
            if self.lost is None and self.farthest > MAX_DISTANCE:
                frame, particle = (int(i[0]) for i in np.nonzero(beyond > MAX_DISTANCE))
                self.lost = (first + frame, particle)

    def _add_steps(self, first: int, joined: NDArray[np.float32]) -> None:
        moved = np.flatnonzero((joined[1:] != joined[:-1]).any(axis=(1, 2)))
        if moved.size:
            self.settled = first + int(moved[-1])
        self._add_jumps(first, joined)

    def _add_jumps(self, first: int, joined: NDArray[np.floating]) -> None:
        """Take in the steps between consecutive frames, of which the first leads to
        ``first``.
        """
        before = joined[0].astype(np.float64)
        for frame, there in enumerate(
            joined[1:]
        ):  # a frame fits the cache, a block does not
            after = there.astype(np.float64)
            squares = squared_lengths(after - before)
            before = after
            if np.isnan(squares.max()):
                squares = np.nan_to_num(squares)
            if squares.max() > self._jump_square:
                self._jump_square = float(squares.max())
                self.jump_at = (first + frame, int(squares.argmax()))


def survey(predictions: Predictions, size: Size) -> tuple[list[Survey], str | None]:
    """Read all predictions of known scenarios once, in blocks, by ascending id.

    Returns what was seen, and the content hash where all scenarios are known.
    """
    known = sorted(set(predictions.header.scenarios) & set(size.subsets["test"]))
    surveys = [Survey(scenario) for scenario in known]
    hasher = predictions.hasher()
    for one in surveys:
        for first, block in predictions.blocks(one.scenario):
            hasher.update("position", block)
            one.add(first, block, size)
    whole = known == sorted(predictions.header.scenarios)
    return surveys, hasher.hexdigest() if whole else None


def check_finite(surveys: list[Survey], out: Findings) -> None:
    """Report values that are NaN, infinite or were never written."""
    out.made("finite")
    bad = [one for one in surveys if one.first_bad]
    if not bad:
        return
    frame, particle, axis = bad[0].first_bad or (0, 0, 0)
    count = sum(one.bad for one in bad)
    unwritten = sum(one.unwritten for one in bad)
    fix = (
        "freeze a diverging rollout at its last finite frame and name it in diverged_at"
    )
    out.error(
        "finite",
        f"{count} values are no numbers"
        if unwritten < count
        else f"{count} values were never written",
        where=f"first in scenario {bad[0].scenario}, frame {frame}, particle "
        f"{particle}, {'xy'[axis]}",
        expected="finite positions everywhere",
        got=f"{count} of {sum(one.values for one in surveys)} values in {len(bad)} "
        f"scenarios"
        + (f", {unwritten} of them netCDF's fill value" if unwritten else ""),
        fix="write every frame of every scenario" if unwritten == count else fix,
    )


def check_frozen(
    predictions: Predictions, surveys: list[Survey], out: Findings
) -> None:
    """Report rollouts that go on moving after the frame at which they are said to be
    frozen.
    """
    for one in surveys:
        mark = predictions.header.diverged_at.get(one.scenario)
        if mark is not None and one.settled > mark:
            out.error(
                "diverged_at",
                "the rollout moves after it was frozen",
                where=f"scenario {one.scenario}, frame {one.settled}",
                expected=f"the positions of frame {mark} from there on, as "
                f"'diverged_at' says",
                got=f"another position in frame {one.settled} than in the one before",
                fix="freeze a diverging rollout at its last finite frame, or leave "
                "'diverged_at' out",
            )


def check_domain(surveys: list[Survey], size: Size, out: Findings) -> None:
    """Flag positions more than a solver cell outside the box; refuse those beyond ten
    boxes.
    """
    out.made("in_domain")
    bad = [one for one in surveys if one.first_outside]
    if not bad:
        return
    lost = next((one for one in bad if one.lost), None)
    if lost is not None:
        frame, particle = lost.lost or (0, 0)
        out.error(
            "in_domain",
            "positions lie far beyond the box: one of them would ruin every mean",
            where=f"first in scenario {lost.scenario}, frame {frame}, particle "
            f"{particle}",
            expected=f"at most {MAX_DISTANCE:g} lengths of the unit box outside "
            f"the walls",
            got=f"up to {max(one.farthest for one in bad):.3g} outside",
            fix="freeze a diverging rollout before that and name the frame in "
            "diverged_at",
        )
        return
    frame, particle = bad[0].first_outside or (0, 0)
    share = sum(one.outside for one in bad) / max(
        1, sum(one.positions for one in surveys)
    )
    out.warning(
        "in_domain",
        f"{share:.2%} of the positions lie outside the box",
        where=f"first in scenario {bad[0].scenario}, frame {frame}, particle "
        f"{particle}",
        expected=f"x in {size.bounds[0]}, y in {size.bounds[1]}, up to a solver "
        f"cell beyond",
        got=f"up to {max(one.farthest for one in bad):.3g} outside;"
        f" {sum(one.off_grid for one in bad)} positions are outside the unit box and "
        f"carry no grid weight",
        fix="positions are in lengths of the unit box, the walls' places are the "
        "split's bounds",
    )


def check_jumps(
    surveys: list[Survey], starts: Mapping[int, Start], truth: Truth, out: Findings
) -> None:
    """Flag particles that jump much farther in a frame than any particle of the
    truth.
    """
    for one in surveys:
        start = starts[one.scenario]
        one.follow(start.given)
        limit = JUMP * start.largest_step(truth, one.scenario, enough=one.jump / JUMP)
        if one.jump_at and one.jump > limit:
            frame, particle = one.jump_at
            out.warning(
                "max_displacement",
                "a particle jumps",
                where=f"scenario {one.scenario}, from frame {frame - 1} to {frame}, "
                f"particle {particle}",
                expected=f"at most {limit:.3g}, {JUMP:g} times the truth's largest "
                f"displacement in a frame",
                got=f"{one.jump:.3g}",
                fix="check the rollout for instability, and that particles keep "
                "their order",
            )
    out.made("max_displacement")


def outside_share(opened: Predictions, size: Size) -> float:
    """Return the share of positions that lie more than a solver cell outside the
    box.
    """
    low, high = np.array(size.bounds).T + np.array([[-1.0], [1.0]]) / size.grid
    found = 0
    count = 0
    for scenario in opened.header.scenarios:
        for _, block in opened.blocks(scenario):
            beyond = ((block < low) | (block > high)).any(axis=-1)
            found = found + int(beyond.sum())
            count = count + beyond.size
    return round_digits(found / max(1, count), 4)
