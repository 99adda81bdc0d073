"""Judge positions as trajectories, whatever file or program they come from.

A reader can hand over positions in which rows change their order, frames are missing or
particles are padding, and no program complains: training and scores are just wrong. So
the motion itself is looked at.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from lagbench.errors import DataError

from .box import AXES, Box, unit_box

Floats = NDArray[np.float64]

MOST_SAMPLES = 500
"""Particles whose motion is looked at."""

NEIGHBOURS = 9
"""Nearest particles, itself included, whose median motion is the surroundings'."""

MOST_STRANGE = 0.2
"""Share of particles that may look like another one in the next frame.

Splashes of which every eighth frame is given reach 0.13, rows in another order 0.28 to
1.
"""

NEARER = 0.2
"""Distance to the old place of another particle over the own step, at most, where a row
is another particle.
"""

SPIKE = 3.0
"""Motion into one frame over that before and after it which no flow has."""

GAP = 1.6
"""The same for motion in one direction: it doubles where a frame is missing."""

FAR = 20.0
"""Extent of a frame, or distance of a particle from the middle, over the usual one."""

FEWEST_TOGETHER = 3
"""Particles at exactly one place that are padding, or parked."""

COARSE = 20.0
USELESS = 2.0
"""Motion in a frame over the resolution of the numbers, at least: else a note, or none
is accepted.
"""

SAME = 1e-7
ALIKE = 1e-5
"""Difference of the moments of two frames that hold the same particles, and of two that
may, in other digits [extent].
"""

STEADY = 0.1
"""Difference of two steps, over their size, in steady motion."""

MOST_COPIES = 8
"""Frames of other trajectories that are compared with one."""

LATE = 0.4
"""Error of a prediction against the frame before over that against its own frame."""

FILL = 1e30
"""Larger numbers stand for missing ones, as netCDF's 9.97e36."""


@dataclass(frozen=True, kw_only=True)
class Judgement:
    """What the positions of one trajectory say."""

    name: str  # file and number of the trajectory, for messages
    low: Floats  # lowest position [length], [axis]
    high: Floats  # highest position [length], [axis]
    moments: Floats  # mean, covariance and skewness of the positions, [frame, moment]
    # what no shift, turn, mirror or scale changes, of positions and steps, [frame, one]
    shapes: Floats
    notes: list[str] = field(default_factory=list)

    @property
    def extent(self) -> float:
        """Longest side of the box that all positions fill [length]."""
        return float((self.high - self.low).max())


def judge_trajectory(
    name: str,
    frames: Iterable[tuple[NDArray[np.floating], NDArray[np.floating] | None]],
    *,
    box: Box | None = None,
    frame_interval: float = 1.0,
    is_wall: NDArray[np.bool_] | None = None,
) -> Judgement:
    """Refuse frames that are no trajectory of the same particles.

    Args:
        name: file and number of the trajectory.
        frames: positions [length] and velocities [length/s] or None, [particle, axis].
        box: where it repeats itself; walls all around when None.
        frame_interval: time between two frames [s].
        is_wall: particles that stand still, whose motion is not judged; none when None.

    Raises:
        DataError: a position is missing, particles are padding or blown up, rows change
            their order, frames are missing or there twice, periods are not those of
            the jumps, or velocities contradict the motion.
    """
    moments = []
    shapes = []
    sides = []
    extents = []
    before = None
    fixed = np.zeros(0, bool) if is_wall is None else is_wall
    walls: Floats = np.zeros((0, 0))
    for number, (raw_position, velocity) in enumerate(frames):
        position = raw_position.astype(np.float64)
        where = f"{name}, frame {number}"
        _refuse_missing(position, where)
        _refuse_together(raw_position, where)
        if box is None:
            box = unit_box(position.shape[1])
        if number == 0:
            _refuse_lone_particle(position, where)
            if is_wall is None:
                fixed = np.zeros(len(position), bool)
            motion = _Motion(name, np.flatnonzero(~fixed))
            walls = position[fixed]
        sides.append((position.min(axis=0), position.max(axis=0)))
        _refuse_moving_walls(position, walls, fixed, where)
        position = position[~fixed]
        velocity = None if velocity is None else velocity[~fixed]
        extents.append(np.ptp(position, axis=0).max())
        moments.append(_moments(position))
        step = 0.0 * position if before is None else box.displacement(before, position)
        shapes.append(_shape(position, step))
        before = position
        motion.add(position, velocity, box)
    low, high = np.array(sides).transpose(1, 0, 2)
    _refuse_blow_up(name, np.array(extents))
    motion.refuse_reordered_rows()
    pace_notes = motion.judge_pace()
    motion.refuse_jumps(box or unit_box(2))
    motion.refuse_velocities(frame_interval)
    notes = [
        *pace_notes,
        *motion.describe_resolution(raw_position[~fixed]),
        *motion.describe_rest(),
        *motion.describe_unmoved(position),
    ]
    return Judgement(
        name=name,
        low=low.min(axis=0),
        high=high.max(axis=0),
        moments=np.array(moments),
        shapes=np.array(shapes),
        notes=notes,
    )


def _refuse_missing(position: Floats, where: str) -> None:
    is_missing = ~(np.abs(position) < FILL).all(axis=1)
    if not is_missing.any():
        return
    first = int(np.argmax(is_missing))
    raise DataError(
        f"{where}: particle {first} has no position ({position[first].tolist()}), as "
        f"{np.count_nonzero(is_missing)} of {len(position)}; leave out particles that "
        "are not there in all frames, or end the trajectory before this frame"
    )


def _refuse_together(position: NDArray[np.floating], where: str) -> None:
    """Refuse three or more particles at one place."""
    order = np.argsort(position[:, 0], kind="stable")
    column = position[order, 0]
    is_equal = column[1:] == column[:-1]
    candidates = np.zeros(len(position), bool)
    candidates[order[1:][is_equal]] = True
    candidates[order[:-1][is_equal]] = True
    if np.count_nonzero(candidates) < FEWEST_TOGETHER:
        return
    places, counts = np.unique(position[candidates], axis=0, return_counts=True)
    most = int(np.argmax(counts))
    if counts[most] < FEWEST_TOGETHER:
        return
    first = int(np.argmax((position == places[most]).all(axis=1)))
    raise DataError(
        f"{where}: {counts[most]} of {len(position)} particles lie at one place, "
        f"{places[most].tolist()}, as particle {first}: padding, or particles that "
        "have left; leave these particles out, or end the trajectory before this frame"
    )


def _refuse_lone_particle(position: Floats, where: str) -> None:
    """Refuse a particle far away from all others, as a fill value puts it."""
    middle = np.median(position, axis=0)
    distance = np.linalg.norm(position - middle, axis=1)
    usual = float(np.quantile(distance, 0.95))
    farthest = int(np.argmax(distance))
    if len(position) < 20 or distance[farthest] <= FAR * usual or usual == 0.0:
        return
    raise DataError(
        f"{where}: particle {farthest} lies at {position[farthest].tolist()}, "
        f"{distance[farthest] / usual:.3g} times as far out as 95 % of the particles; "
        "leave it out: it is a fill value, or was parked there"
    )


def _refuse_moving_walls(
    position: Floats, walls: Floats, is_wall: NDArray[np.bool_], where: str
) -> None:
    has_moved = (position[is_wall] != walls).any(axis=1)
    if has_moved.any():
        raise DataError(
            f"{where}: particle {np.flatnonzero(is_wall)[np.argmax(has_moved)]} moves, "
            f"as {np.count_nonzero(has_moved)} of {len(walls)} particles of the kind "
            "wall; walls of particles stand still: leave these out (--kinds "
            "KIND=drop), or give them another kind"
        )


def _refuse_blow_up(name: str, extents: Floats) -> None:
    usual = float(np.quantile(extents, 0.25))
    is_far = extents > FAR * usual
    if usual == 0.0 or not is_far.any():
        return
    numbers = np.flatnonzero(is_far)
    first = int(numbers[0])
    raise DataError(
        f"{name}, frames {first} to {numbers[-1]}: particles spread over "
        f"{extents.max():.3g}, in other frames over {usual:.3g}: the simulation blew "
        f"up; end the trajectory before frame {first}"
    )


def _moments(position: Floats) -> Floats:
    """Return mean, covariance and skewness of positions, whatever their order."""
    mean = position.mean(axis=0)
    offset = position - mean
    covariance = offset.T @ offset / len(offset)
    upper = np.triu_indices(len(mean))
    return np.concatenate([mean, covariance[upper], (offset**3).mean(axis=0)])


def _shape(position: Floats, step: Floats) -> Floats:
    """Return what stays as it is when all is moved, turned, mirrored or scaled."""
    offset = position - position.mean(axis=0)
    distance = np.linalg.norm(offset, axis=1)
    size = math.sqrt(float(np.mean(distance**2))) or 1.0
    powers = [float(np.mean((distance / size) ** power)) for power in (1, 3, 4)]
    length = np.linalg.norm(step, axis=1) / size
    turn = float(np.mean(np.sum(offset * step, axis=1))) / size**2
    return np.array([*powers, length.mean(), np.sqrt(np.mean(length**2)), turn])


class _Motion:
    """The steps of some particles of a trajectory, and the jumps of all."""

    def __init__(self, name: str, numbers: NDArray[np.intp]) -> None:
        self.name = name
        self.numbers = numbers  # of the particles in the file
        self.samples = np.zeros(0, int)  # numbers of the particles
        self.before: Floats = np.zeros(0)  # positions in the frame before
        self.is_unmoved: NDArray[np.bool_] = np.zeros(0, bool)
        self.step_before: Floats | None = None
        self.steps: list[Floats] = []  # [frame] of [sample, axis]
        self.gaps: list[Floats] = []  # ways to the nearest neighbour, of [sample]
        self.others: list[Floats] = []  # ways to the nearest old place, of [sample]
        self.strayed: list[Floats] = []  # steps beside those of neighbours, of [sample]
        self.row_bends: list[float] = []  # median change of the way from row to row
        self.adjacent: list[float] = []  # share whose nearest neighbour is the next row
        self.velocities: list[Floats] = []
        # by axis: frame and signed step of particles that cross half the extent
        self.jumps: dict[int, list[tuple[int, Floats]]] = {}
        # by axis: true period less the stated one, by each crossing [length]
        self.period_errors: dict[int, list[float]] = {}
        self.low: Floats = np.zeros(0)
        self.high: Floats = np.zeros(0)

    def add(
        self,
        position: Floats,
        velocity: NDArray[np.floating] | None,
        box: Box,
    ) -> None:
        """Look at the next frame."""
        count = len(position)
        if not len(self.samples):
            chosen = np.linspace(0, count - 1, min(count, MOST_SAMPLES))
            self.samples = np.unique(chosen.astype(int))
            self.low = position.min(axis=0)
            self.high = position.max(axis=0)
            self.before = position
            self.is_unmoved = np.ones(count, bool)
            if velocity is not None:
                self.velocities.append(velocity[self.samples].astype(np.float64))
            return
        step = box.displacement(self.before, position)
        if count > 1:
            self._compare_with_neighbours(position, step, box)
        self.steps.append(step[self.samples])
        self.is_unmoved &= (position == self.before).all(axis=1)
        bend = np.diff(position, n=2, axis=0)
        self.row_bends.append(float(np.median(np.linalg.norm(bend, axis=1))))
        if velocity is not None:
            self.velocities.append(velocity[self.samples].astype(np.float64))
        self.low = np.minimum(self.low, position.min(axis=0))
        self.high = np.maximum(self.high, position.max(axis=0))
        self._find_jumps(step, position - self.before, box)
        self.before = position
        self.step_before = step

    def _compare_with_neighbours(
        self, position: Floats, step: Floats, box: Box
    ) -> None:
        points = box.tree_points(self.before)
        count = min(NEIGHBOURS, len(points))
        tree = box.tree(self.before)
        distances, rows = map(np.asarray, tree.query(points[self.samples], k=count))
        old_places = tree.query(box.tree_points(position[self.samples]))
        self.others.append(np.asarray(old_places[0]))
        own_step = step[self.samples]
        surroundings = np.median(step[rows[:, 1:]], axis=1)
        self.gaps.append(distances[:, 1])
        self.strayed.append(np.linalg.norm(own_step - surroundings, axis=1))
        is_next = (np.abs(rows - self.samples[:, None]) == 1)[:, 1:3].any(axis=1)
        self.adjacent.append(float(is_next.mean()))

    def _find_jumps(self, step: Floats, raw_step: Floats, box: Box) -> None:
        """Note the steps that a boundary may explain."""
        frame = len(self.steps)
        extent = self.high - self.low
        for axis in range(step.shape[1]):
            column = step[:, axis]
            is_jump = np.abs(column) > 0.5 * extent[axis]
            is_calm = np.median(np.abs(column)) < 0.1 * extent[axis]
            if is_calm and np.count_nonzero(is_jump) >= FEWEST_TOGETHER:
                # without the motion that the others have, too
                jump = (raw_step[:, axis] - np.median(column))[is_jump]
                self.jumps.setdefault(axis, []).append((frame, jump))
            if not box.periodic[axis] or self.step_before is None:
                continue
            raw = raw_step[:, axis]
            has_crossed = np.abs(raw) > 0.5 * box.lengths[axis]
            change = (column - self.step_before[:, axis])[has_crossed]
            errors = (np.sign(raw[has_crossed]) * change).tolist()
            self.period_errors.setdefault(axis, []).extend(errors)

    def refuse_reordered_rows(self) -> None:
        """Refuse particles that are another one in the next frame.

        A row is another particle where its step is longer than the way to its nearest
        neighbour was, neither the steps before and after nor those of its neighbours
        are like it, and the place of another particle in the frame before is far
        nearer.
        """
        if not self.gaps:
            return
        steps = np.array(self.steps)
        gaps = np.array(self.gaps)
        lengths = np.linalg.norm(steps, axis=2)
        change = np.linalg.norm(np.diff(steps, axis=0), axis=2)
        least_change = np.full(lengths.shape, np.inf)
        least_change[1:] = change
        least_change[:-1] = np.minimum(least_change[:-1], change)
        deviation = np.minimum(least_change, np.array(self.strayed))
        own_way = np.minimum(lengths, deviation)
        is_strange = (own_way > gaps) & (np.array(self.others) < NEARER * own_way)
        share = is_strange.mean(axis=1)
        frame = int(np.argmax(share > MOST_STRANGE))
        if share[frame] > MOST_STRANGE:
            sample = int(np.argmax(is_strange[frame]))
            particle = self.numbers[self.samples[sample]]
            raise DataError(
                f"{self.name}, frame {frame + 1}: {share[frame]:.0%} of the particles "
                "move farther than the way to their nearest neighbour, as particle "
                f"{particle} ({lengths[frame, sample]:.3g}, neighbour at "
                f"{gaps[frame, sample]:.3g}): rows change their order from frame to "
                "frame, or the axes have another order; order rows by particle "
                "(an array id does it), or state --axes"
            )
        ratio = np.median(lengths / np.maximum(gaps, 1e-300), axis=1)
        # a motion is smoother from frame to frame than from particle to particle
        is_rough = (
            np.median(change) > np.median(self.row_bends) if len(change) else True
        )
        if np.median(ratio) > 2.0 and np.median(self.adjacent) > 0.8 and is_rough:
            raise DataError(
                f"{self.name}: particles move {np.median(ratio):.3g} times as far in a "
                "frame as to their nearest neighbour, which is the next row: frames "
                "and particles are exchanged; state the order of the axes, as in "
                "--axes particle,frame,space, or mend the file"
            )

    def judge_pace(self) -> list[str]:
        """Refuse frames that are missing, there twice, or out of order.

        Where a steady motion goes on in another pace, which walls may do to a very
        viscous fluid, there is a note.
        """
        notes = []
        last = len(self.steps) - 1
        for number in range(last + 1):
            is_inside = 0 < number < last
            fault = self._find_fault_between(number) if is_inside else None
            change = self._find_change_of_pace(number)
            if fault is None and change is None:
                continue
            sizes = [f"{_rms(step):.3g}" for step in self.steps]
            text = (
                f"{self.name}, frame {number + 1}: particles move {sizes[number]}, "
                f"and {', '.join(sizes[max(0, number - 2) : number]) or 'nothing'} "
                "in frames before and "
                f"{', '.join(sizes[number + 1 : number + 3]) or 'nothing'} after: "
                f"{fault or change}"
            )
            if fault is None and is_inside:
                notes.append(f"{text}?")
                continue
            raise DataError(
                f"{text}; give all frames once, at even times, or end the trajectory "
                "before this frame"
            )
        return notes

    def _find_fault_between(self, number: int) -> str | None:
        """Return what is wrong with a step beside those before and after."""
        before, step, after = self.steps[number - 1 : number + 2]
        mean = 0.5 * (before + after)
        size = _rms(step)
        usual = max(_rms(before), _rms(after))
        if size > SPIKE * usual > 0.0:
            return "frames are missing or out of order, or rows change their order"
        if usual == 0.0 or _rms(after - before) >= 0.5 * _rms(mean):
            return None
        ratio = float(np.sum(step * mean) / np.sum(mean * mean))
        if ratio > GAP:
            return "frames are missing before it"
        if size == 0.0:
            return "the frame is there twice"
        return "frames are out of order" if ratio < 0.0 else None

    def _find_change_of_pace(self, number: int) -> str | None:
        """Return what is wrong where a steady motion has another pace from here on.

        The same is said of the first step, beside the two after it.
        """
        steady = self.steps[1:3] if number == 0 else self.steps[number - 2 : number]
        following = self.steps[number : number + 2]
        if len(steady) < 2 or (number and not _is_steady(following)):
            return None
        usual = steady[-1]
        if not _is_steady(steady) or not usual.any():
            return None
        step = self.steps[number]
        if _rms(step) > SPIKE * _rms(usual):
            return "frames are missing or out of order"
        ratio = float(np.sum(step * usual) / np.sum(usual * usual))
        if _rms(step - ratio * usual) > STEADY * _rms(step):
            return None
        if ratio == 0.0:
            return "the frame is there twice" if number == 0 else None
        if ratio > GAP:
            return "frames are missing before it, or times are uneven"
        return "times are uneven" if number and 0.0 < ratio * GAP < 1.0 else None

    def refuse_jumps(self, box: Box) -> None:
        """Refuse jumps across the box that no stated period explains."""
        for axis, candidates in self.jumps.items():
            least = 0.5 * (self.high - self.low)[axis]
            jumps = []
            for frame, steps in candidates:
                is_long = np.abs(steps) > least
                if np.count_nonzero(is_long) >= FEWEST_TOGETHER:
                    jumps.append((frame, steps[is_long]))
            if not jumps:
                continue
            lengths = np.abs(np.concatenate([steps for _, steps in jumps]))
            frame, first = jumps[0]
            mean = float(lengths.mean())
            where = f"{self.name}, frame {frame}: {len(first)} particles jump along "
            where += f"{AXES[axis]} by {np.abs(first).max():.3g} and the others hardly "
            where += "move"
            if lengths.std() < 0.1 * mean:
                raise DataError(
                    f"{where}: if the box repeats itself there, state --periodic "
                    f"{AXES[axis]} and --bounds whose ends are the period apart, about "
                    f"{mean:.3g}"
                )
            raise DataError(
                f"{where}, each by another length: rows change their order, or "
                "particles leave and enter elsewhere (inflow and outflow); order rows "
                "by particle, or end the trajectory where particles leave"
            )
        spacing = float(np.median(self.gaps)) if self.gaps else 0.0
        for axis, errors in self.period_errors.items():
            if len(errors) < 5:
                continue
            error = float(np.median(errors))
            spread = float(np.median(np.abs(np.array(errors) - error)))
            if abs(error) > max(0.25 * spacing, 3.0 * spread):
                period = box.lengths[axis]
                raise DataError(
                    f"{self.name}: particles jump by about {period + error:.5g} along "
                    f"{AXES[axis]}, and the stated period is {period:.5g}; state "
                    "--bounds whose ends are the true period apart"
                )

    def refuse_velocities(self, frame_interval: float) -> None:
        """Refuse velocities of another size, direction or frame than the motion.

        A particle turns between two frames, so the limits are wide.
        """
        if not self.velocities:
            return
        velocity = np.array(self.velocities)[1:]
        motion = np.array(self.steps) / frame_interval
        if len(motion) > 4:
            middle = velocity[1:-2]
            # of the motion from one frame before to one after, by half frames
            centres = [
                motion[:-3] + motion[1:-2],
                2.0 * motion[1:-2],
                motion[1:-2] + motion[2:-1],
                2.0 * motion[2:-1],
                motion[2:-1] + motion[3:],
            ]
            errors = [_rms(middle - 0.5 * centre) for centre in centres]
            best = int(np.argmin(errors))
            if best in (0, 4) and errors[best] < LATE * min(errors[1:4]):
                raise DataError(
                    f"{self.name}: velocities are those one frame "
                    f"{'after' if best else 'before'}; mend them, or leave velocities "
                    "out: they are then differences of positions"
                )
        speed = _rms(velocity)
        size = _rms(motion)
        if size == 0.0 and speed == 0.0:
            return
        ratio = speed / size if size else math.inf
        cosine = 0.0
        if speed * size > 0.0:
            products = np.sum(velocity * motion, axis=2)
            cosine = float(products.mean()) / (speed * size)
        if 0.25 <= ratio <= 4.0 and cosine >= 0.25:
            return
        raise DataError(
            f"{self.name}: velocities are {ratio:.3g} times as large as the motion of "
            f"the particles, with a cosine of {cosine:.2g}; mend their unit or the "
            "frame interval, or leave velocities out: they are then differences of "
            "positions"
        )

    def describe_resolution(self, position: NDArray[np.floating]) -> list[str]:
        """Return a note on numbers too coarse for the motion; refuse useless ones."""
        largest = max(map(_rms, self.steps), default=0.0)
        quantum = _resolution(position[self.samples])
        if largest == 0.0 or largest >= COARSE * quantum:
            return []
        text = (
            f"{self.name}: positions are multiples of {quantum:.2g}, and particles "
            f"move {largest:.2g} in a frame at most"
        )
        if largest < USELESS * quantum:
            raise DataError(
                f"{text}: their motion is noise; write more digits, or fewer frames"
            )
        error = 0.41 * quantum / largest  # of a difference of two rounded numbers
        return [f"{text}: velocities are wrong by {error:.0%}; write more digits"]

    def describe_unmoved(self, last: Floats) -> list[str]:
        """Return a note on some particles that stay at one place while others move.

        Args:
            last: positions in the last frame [length], [particle, axis].
        """
        unmoved = np.flatnonzero(self.is_unmoved)
        if not len(unmoved) or self.is_unmoved.all():
            return []
        place = np.round(last[unmoved[0]], 6).tolist()
        particle = self.numbers[unmoved[0]]
        return [
            f"{self.name}: {len(unmoved)} of {len(last)} particles never move, as "
            f"particle {particle} at {place}: leave them out if they are padding; give "
            "them the kind wall if they are one"
        ]

    def describe_rest(self) -> list[str]:
        """Return a note on frames at the end in which nothing moves."""
        resting_count = 0
        for step in reversed(self.steps):
            if step.any():
                break
            resting_count += 1
        if resting_count == len(self.steps):
            return [f"{self.name}: no particle moves from one frame to the next"]
        if resting_count < 2:
            return []
        return [f"{self.name}: the last {resting_count} frames equal the one before"]


def _is_steady(steps: Sequence[Floats]) -> bool:
    """Return whether steps are the same, one or more."""
    return _rms(steps[-1] - steps[0]) <= STEADY * _rms(steps[0])


def _rms(vectors: Floats) -> float:
    """Return the root mean square length of vectors, [..., axis]."""
    return math.sqrt(float(np.mean(np.sum(vectors**2, axis=-1))))


def _resolution(values: NDArray[np.floating]) -> float:
    """Return the least difference that numbers of this type and rounding can have."""
    largest = np.abs(values).max()
    quantum = float(np.spacing(largest))
    for kind in (np.float32, np.float16):
        with np.errstate(over="ignore"):
            narrow = values.astype(kind)
        if (narrow == values).all():
            quantum = max(quantum, float(np.spacing(np.abs(narrow).max())))
    for digits in range(1, 8):
        error = np.abs(np.round(values.astype(np.float64), digits) - values)
        if (error <= max(quantum, 1e-3 * 10.0**-digits)).all():
            return max(quantum, 10.0**-digits)
    return quantum


def find_shared_frames(
    judgements_of: Mapping[str, Sequence[Judgement]],
) -> list[str]:
    """Refuse a trajectory, or half of one, that two subsets share; note what may be.

    Two frames are the same if the moments of their positions are, in whatever order
    their particles stand. Frames in which nothing moved since the one before do not
    count. Notes tell of a few shared frames, of frames that are the same in other
    digits, moved, turned, mirrored or scaled, and of a trajectory that goes on where
    another one ends.

    Args:
        judgements_of: the trajectories of each subset.

    Raises:
        DataError: a model would be tested on what it was trained on.
    """
    judgements: list[Judgement] = []
    subsets: list[str] = []
    for subset, members in judgements_of.items():
        judgements += members
        subsets += [subset] * len(members)
    # that of the smallest: others may be in another unit
    extent = min(judgement.extent for judgement in judgements) or 1.0
    frames = [_scaled_moments(judgement, extent) for judgement in judgements]
    moving = []
    shapes = []
    for judgement, moments in zip(judgements, frames, strict=True):
        has_moved = np.ones(len(moments), bool)
        has_moved[1:] = (moments[1:] != moments[:-1]).any(axis=1)
        moving.append(moments[has_moved])
        shapes.append(judgement.shapes[has_moved])

    same = _count_shared(moving, subsets, SAME)
    alike = _count_shared(moving, subsets, ALIKE)
    similar = _count_shared(shapes, subsets, ALIKE)
    following = _find_continued(frames, subsets)
    notes = []
    for pair in sorted({*alike, *similar, *following}):
        one, other = [judgements[number] for number in pair]
        first, second = [f"{judgements[n].name} ({subsets[n]})" for n in pair]
        shortest = min(len(one.moments), len(other.moments))
        count = same.get(pair, 0)
        text = f"{first} and {second} share {max(count, alike.get(pair, 0))} frames"
        if count >= 0.5 * shortest:
            raise DataError(
                f"{text} of {shortest}: a model would be tested on what it was trained "
                "on; give each run, and all pieces of a run, to one subset"
            )
        if alike.get(pair, 0) > 1:
            notes.append(f"{text}, at least nearly: are they one run?")
        elif similar.get(pair, 0) >= 0.5 * shortest:
            notes.append(
                f"{similar[pair]} frames of {first} are those of {second}, moved, "
                "turned, mirrored or scaled: are they one run?"
            )
        elif pair in following:
            notes.append(
                f"one of {first} and {second} goes on where the other ends: are they "
                "one run?"
            )
    return notes


def _scaled_moments(judgement: Judgement, extent: float) -> Floats:
    """Return the moments over the extent, [frame, moment]."""
    dimension = len(judgement.low)
    powers = np.full(judgement.moments.shape[1], 2.0)
    powers[:dimension] = 1.0
    powers[-dimension:] = 3.0
    return np.asarray(judgement.moments / extent**powers)


def _count_shared(
    frames_of: Sequence[Floats], subsets: Sequence[str], tolerance: float
) -> dict[tuple[int, int], int]:
    """Return how many frames of a trajectory are in one of an earlier subset.

    Keys are the numbers of the earlier trajectory and of the other.
    """
    from scipy.spatial import cKDTree

    shared: dict[tuple[int, int], int] = {}
    for subset in dict.fromkeys(subsets):
        start = subsets.index(subset)
        if start == 0:
            continue
        earlier = np.concatenate(frames_of[:start])
        owners = np.repeat(np.arange(start), list(map(len, frames_of[:start])))
        tree = cKDTree(earlier)
        nearest = np.arange(1, min(MOST_COPIES, len(earlier)) + 1)
        for number in range(start, start + subsets.count(subset)):
            found = tree.query(frames_of[number], k=nearest, p=np.inf)
            distances, rows = map(np.asarray, found)
            for near, row in zip(distances, rows, strict=True):
                for owner in set(owners[row[near < tolerance]].tolist()):
                    shared[owner, number] = shared.get((owner, number), 0) + 1
    return shared


def _find_continued(
    frames_of: Sequence[Floats], subsets: Sequence[str]
) -> set[tuple[int, int]]:
    """Return pairs of trajectories, of two subsets, of which one continues the other.

    Its first frame is where the last two frames of the other lead.
    """
    starts = np.array([frames[0] for frames in frames_of])
    last_steps = np.array([frames[-1] - frames[-2] for frames in frames_of])
    ends = np.array([frames[-1] for frames in frames_of]) + last_steps
    sizes = np.abs(last_steps).max(axis=1)
    pairs = set()
    for number, end in enumerate(ends):
        distance = np.abs(starts - end).max(axis=1)
        for other in np.flatnonzero(distance < STEADY * sizes[number]).tolist():
            if subsets[other] != subsets[number]:
                pairs.add((min(number, other), max(number, other)))
    return pairs


def find_shift(predicted: Floats, truth: Floats, box: Box) -> int:
    """Return by how many frames a prediction is late (-2, -1) or early (1, 2), else 0.

    It is shifted if it fits other true frames far better than its own.

    Args:
        predicted: positions of the first predicted frames [length], [frame, particle,
            axis].
        truth: true positions of the same frames, and of as many frames before as after
            them.
        box: the box of the particles.
    """
    count = len(predicted)
    margin = (len(truth) - count) // 2
    errors = []
    for start in range(2 * margin + 1):
        errors.append(_rms(box.displacement(truth[start : start + count], predicted)))
    best = int(np.argmin(errors))
    return best - margin if errors[best] < LATE * errors[margin] else 0
