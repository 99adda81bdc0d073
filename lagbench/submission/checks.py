"""Check the predicted positions: finite, frozen, inside the box, without jumps."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from lagbench.data.box import AXES, Box
from lagbench.data.checksums import round_digits
from lagbench.data.registry import Size
from lagbench.errors import format_count

from .issues import IssueCollector
from .predictions import Predictions
from .start import JUMP, StartFrames, largest_true_displacement
from .truth import Truth, squared_lengths

MAX_DISTANCE = 10.0
"""Farthest outside the walls that a position may be [length]; the box has length 1."""

MAX_PERIODS = 1.0
"""Farthest outside the box along a periodic axis without a warning [period]."""

FILL = np.float32(9.969209968386869e36)
"""What netCDF puts where a float32 was never written."""

Block = NDArray[np.float32]
"""Consecutive frames of positions [length], shape [frame, particle, space]."""


@dataclass
class ScenarioScan:
    """What one pass over a scenario's predictions saw."""

    scenario: int
    value_count: int = 0
    bad_values: int = 0  # values that are not finite, or were never written
    unwritten_values: int = 0  # those of them that were never written
    # frame, particle and component
    first_bad: tuple[int, int, int] | None = None
    position_count: int = 0
    outside_box: int = 0  # positions more than a solver cell outside the box
    outside_grid: int = 0  # positions outside the unit box
    farthest: float = 0.0  # largest distance outside the box along an axis [length]
    first_outside: tuple[int, int] | None = None  # frame and particle
    # frame and particle of the first position beyond MAX_DISTANCE
    first_lost: tuple[int, int] | None = None
    most_periods: float = 0.0  # largest distance outside along a periodic axis [period]
    # frame, particle and axis of that distance
    most_periods_at: tuple[int, int, int] | None = None
    # frame and particle of the largest jump
    jump_at: tuple[int, int] | None = None
    last_moving_frame: int = 0  # frame that is repeated from there to the end
    _first_frame: tuple[int, Block] | None = field(default=None, repr=False)
    _last_frame: Block | None = field(default=None, repr=False)
    _jump_square: float = field(default=0.0, repr=False)

    @property
    def jump(self) -> float:
        """Largest distance of a particle between consecutive frames [length]."""
        return math.sqrt(self._jump_square)

    def add(self, first: int, block: Block, size: Size) -> None:
        """Take in consecutive frames, the first of which has the number ``first``."""
        block = self._mask_bad_values(first, block)
        box = size.box
        self._add_places(first, block, box=box, cell=1.0 / size.grid)
        if box.is_periodic:
            self._add_periods(first, block, box)
        if self._last_frame is None:
            self._first_frame = (first, block[:1].copy())
            self.last_moving_frame = first
            self._add_steps(first + 1, block, box)
        else:
            frames = np.concatenate([self._last_frame, block])
            self._add_steps(first, frames, box)
        self._last_frame = block[-1:].copy()

    def add_given_frame(self, position: NDArray[np.floating], box: Box) -> None:
        """Take in the step from the last given frame to the first predicted one."""
        if self._first_frame is None:
            return
        first, predicted = self._first_frame
        self._add_jumps(first, np.concatenate([position[None], predicted]), box)

    def _mask_bad_values(self, first: int, block: Block) -> Block:
        """Return the block with NaN where values are not finite or never written."""
        self.value_count += block.size
        # One pass over sound values; a comparison with NaN is false.
        is_sound = block.min(initial=0.0) > -np.inf and block.max(initial=0.0) < FILL
        if is_sound:
            return block
        is_unwritten = block == FILL
        is_bad = ~np.isfinite(block) | is_unwritten
        if not is_bad.any():
            return block
        if self.first_bad is None:
            frame, particle, axis = first_index(is_bad)
            self.first_bad = (first + frame, particle, axis)
        self.bad_values += int(np.count_nonzero(is_bad))
        self.unwritten_values += int(np.count_nonzero(is_unwritten))
        return np.where(is_bad, np.float32(np.nan), block)

    def _add_places(self, first: int, block: Block, *, box: Box, cell: float) -> None:
        self.position_count += block[..., 0].size
        if is_inside(block, box, slack=cell):
            return  # nearly always, and 20 times as fast

        # distance outside the box along an axis, shape [frame, particle]
        below = box.lower_walls - block
        above = block - box.upper_walls
        beyond = np.fmax(below, above).max(axis=-1)
        is_outside = beyond > cell
        if not is_outside.any():
            return
        if self.first_outside is None:
            frame, particle = first_index(is_outside)
            self.first_outside = (first + frame, particle)
        self.outside_box += int(np.count_nonzero(is_outside))
        self.farthest = max(self.farthest, float(beyond[is_outside].max()))
        places = box.wrap(block)
        is_axis_outside = (places < 0) | (places > 1)
        is_outside_grid = is_axis_outside.any(axis=-1)
        self.outside_grid += int(np.count_nonzero(is_outside_grid))
        if self.first_lost is None and self.farthest > MAX_DISTANCE:
            frame, particle = first_index(beyond > MAX_DISTANCE)
            self.first_lost = (first + frame, particle)

    def _add_periods(self, first: int, block: Block, box: Box) -> None:
        """Take in how many periods outside of the box the positions lie."""
        outside = np.fmax(box.low - block, block - box.high) / box.lengths
        periods = np.where(box.periodic, outside, 0.0)
        periods = np.nan_to_num(periods, copy=False)
        farthest = float(periods.max(initial=0.0))
        if farthest > self.most_periods:
            frame, particle, axis = first_index(periods == farthest)
            self.most_periods = farthest
            self.most_periods_at = (first + frame, particle, axis)

    def _add_steps(self, first: int, frames: Block, box: Box) -> None:
        """Take in steps; the first of them leads to the frame ``first``."""
        has_moved = (frames[1:] != frames[:-1]).any(axis=(1, 2))
        moved_steps = np.flatnonzero(has_moved)
        if moved_steps.size:
            self.last_moving_frame = first + int(moved_steps[-1])
        self._add_jumps(first, frames, box)

    def _add_jumps(self, first: int, frames: NDArray[np.floating], box: Box) -> None:
        """Take in steps; the first of them leads to the frame ``first``."""
        before = frames[0].astype(np.float64)
        # A frame fits the cache of a processor, a block does not.
        for step, frame in enumerate(frames[1:]):
            after = frame.astype(np.float64)
            squares = squared_lengths(box.displacement(before, after))
            before = after
            if np.isnan(squares.max()):
                squares = np.nan_to_num(squares)
            largest = float(squares.max())
            if largest > self._jump_square:
                self._jump_square = largest
                self.jump_at = (first + step, int(squares.argmax()))


def first_index(mask: NDArray[np.bool_]) -> tuple[int, ...]:
    """Return the index of the first true value."""
    return tuple(int(places[0]) for places in np.nonzero(mask))


def is_inside(block: Block, box: Box, *, slack: float) -> bool:
    """Return whether no position lies more than a slack [length] beyond a wall.

    NaN is not inside.
    """
    walls = zip(box.lower_walls, box.upper_walls, strict=True)
    for axis, (lowest, highest) in enumerate(walls):
        values = block[..., axis]
        beyond_low = lowest - values.min()
        beyond_high = values.max() - highest
        if not (beyond_low <= slack and beyond_high <= slack):
            return False
    return True


def scan_positions(
    predictions: Predictions, size: Size
) -> tuple[list[ScenarioScan], str | None]:
    """Read all predictions of known scenarios once, in blocks, by ascending id.

    Returns what was seen, and the content hash where all scenarios are known.
    """
    stored_scenarios = set(predictions.header.scenarios)
    known_scenarios = sorted(stored_scenarios.intersection(size.scored_scenarios))
    scans = []
    hasher = predictions.start_hash()
    for scenario in known_scenarios:
        scan = ScenarioScan(scenario)
        for first, block in predictions.blocks(scenario):
            hasher.update("position", predictions.pad(block))
            scan.add(first, block, size)
        scans.append(scan)

    if known_scenarios != sorted(predictions.header.scenarios):
        return scans, None
    return scans, hasher.hexdigest()


def check_finite(scans: list[ScenarioScan], issues: IssueCollector) -> None:
    """Report values that are NaN, infinite or were never written."""
    issues.complete("finite")
    bad_scans = []
    for scan in scans:
        if scan.first_bad is not None:
            bad_scans.append(scan)
    if not bad_scans:
        return
    bad_values = sum(scan.bad_values for scan in bad_scans)
    unwritten_values = sum(scan.unwritten_values for scan in bad_scans)
    value_count = sum(scan.value_count for scan in scans)
    frame, particle, axis = bad_scans[0].first_bad or (0, 0, 0)

    what = "values are not finite"
    fix = (
        "freeze a diverging rollout at its last finite frame and name it in diverged_at"
    )
    if unwritten_values == bad_values:
        what = "values were never written"
        fix = "write every frame of every scenario"
    scenarios = format_count(len(bad_scans), "scenario")
    got = f"{bad_values} of {value_count} values in {scenarios}"
    if unwritten_values:
        got += f", {unwritten_values} of them netCDF's fill value"
    issues.error(
        "finite",
        what,
        where=f"first in scenario {bad_scans[0].scenario}, frame {frame}, "
        f"particle {particle}, {AXES[axis]}",
        expected="finite positions everywhere",
        got=got,
        fix=fix,
    )


def check_frozen(
    predictions: Predictions, scans: list[ScenarioScan], issues: IssueCollector
) -> None:
    """Report rollouts that move after the frame from which they should be frozen."""
    for scan in scans:
        frozen_from = predictions.header.diverged_at.get(scan.scenario)
        if frozen_from is None or scan.last_moving_frame <= frozen_from:
            continue
        moving = scan.last_moving_frame
        issues.error(
            "diverged_at",
            "the rollout moves after it was frozen",
            where=f"scenario {scan.scenario}, frame {moving}",
            expected=f"the positions of frame {frozen_from} from there on, as "
            f"'diverged_at' says",
            got=f"another position in frame {moving} than in the one before",
            fix="freeze a diverging rollout at its last finite frame, or leave "
            "'diverged_at' out",
        )


def check_domain(scans: list[ScenarioScan], size: Size, issues: IssueCollector) -> None:
    """Flag positions outside the box; refuse those beyond ten boxes."""
    issues.complete("in_domain")
    _check_periods(scans, issues)
    outside_scans = []
    for scan in scans:
        if scan.first_outside is not None:
            outside_scans.append(scan)
    if not outside_scans:
        return
    farthest = max(scan.farthest for scan in outside_scans)
    for scan in outside_scans:
        if scan.first_lost is None:
            continue
        frame, particle = scan.first_lost
        issues.error(
            "in_domain",
            "positions lie far beyond the box: one of them would ruin every mean",
            where=f"first in scenario {scan.scenario}, frame {frame}, particle "
            f"{particle}",
            expected=f"at most {MAX_DISTANCE:g} lengths of the unit box outside "
            f"the walls",
            got=f"up to {farthest:.3g} outside",
            fix="give positions in lengths of the unit box, as the given frames have "
            "them; if the rollout diverges, freeze it before that and name the frame "
            "in diverged_at",
        )
        return

    position_count = sum(scan.position_count for scan in scans)
    share = sum(scan.outside_box for scan in outside_scans) / max(1, position_count)
    outside_grid = sum(scan.outside_grid for scan in outside_scans)
    frame, particle = outside_scans[0].first_outside or (0, 0)
    issues.warning(
        "in_domain",
        f"{share:.2%} of the positions lie outside the box",
        where=f"first in scenario {outside_scans[0].scenario}, frame {frame}, "
        f"particle {particle}",
        expected=f"{format_walls(size.box)}, up to a solver cell beyond",
        got=f"up to {farthest:.3g} outside; {outside_grid} positions are outside the "
        f"unit box and carry no grid weight",
        fix="positions are in lengths of the unit box, the walls' places are the "
        "split's bounds",
    )


def _check_periods(scans: list[ScenarioScan], issues: IssueCollector) -> None:
    """Flag positions that lie periods away from the box along a periodic axis."""
    farthest = max(scans, key=lambda scan: scan.most_periods, default=None)
    if farthest is None or farthest.most_periods_at is None:
        return
    if farthest.most_periods <= MAX_PERIODS:
        return
    frame, particle, axis = farthest.most_periods_at
    issues.warning(
        "in_domain",
        "positions lie periods away from the box",
        where=f"scenario {farthest.scenario}, frame {frame}, particle {particle}, "
        f"{AXES[axis]}",
        expected=f"at most {MAX_PERIODS:g} period outside of the box",
        got=f"{farthest.most_periods:.3g} periods outside",
        fix="wrap positions into the box; where the model moves particles that far, "
        "leave it: their images in the box are scored, with fewer digits the farther "
        "away they are",
    )


def check_jumps(
    scans: list[ScenarioScan],
    starts: Mapping[int, StartFrames],
    *,
    truth: Truth,
    issues: IssueCollector,
) -> None:
    """Flag particles that jump much farther in a frame than any true particle."""
    for scan in scans:
        start = starts[scan.scenario]
        scan.add_given_frame(start.last_given, start.box)
        limit = JUMP * largest_true_displacement(
            start, truth=truth, scenario=scan.scenario, enough=scan.jump / JUMP
        )
        if scan.jump_at is None or scan.jump <= limit:
            continue
        frame, particle = scan.jump_at
        issues.warning(
            "max_displacement",
            "a particle jumps",
            where=f"scenario {scan.scenario}, from frame {frame - 1} to {frame}, "
            f"particle {particle}",
            expected=f"at most {limit:.3g}, {JUMP:g} times the truth's largest "
            f"displacement in a frame",
            got=f"{scan.jump:.3g}",
            fix="check the rollout for instability, and that particles keep "
            "their order",
        )
    issues.complete("max_displacement")


def format_walls(box: Box) -> str:
    """Return the walls of a box for a message.

    >>> format_walls(Box.from_bounds([(0, 1), (0, 2)], periodic=[True, False]))
    'y in (0.0, 2.0)'
    """
    parts = []
    for axis, is_periodic in enumerate(box.periodic):
        if not is_periodic:
            parts.append(f"{AXES[axis]} in {box.bounds[axis]}")
    return ", ".join(parts)


def outside_share(opened: Predictions, size: Size) -> float:
    """Return the share of positions more than a solver cell outside the box."""
    lowest = size.box.lower_walls - 1.0 / size.grid
    highest = size.box.upper_walls + 1.0 / size.grid
    outside_count = 0
    position_count = 0
    for scenario in opened.header.scenarios:
        for _, block in opened.blocks(scenario):
            is_outside = ((block < lowest) | (block > highest)).any(axis=-1)
            outside_count += int(is_outside.sum())
            position_count += is_outside.size
    return round_digits(outside_count / max(1, position_count), 4)
