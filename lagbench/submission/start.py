"""How predictions begin: mistakes that the first frames give away, and jumps that are
none.

A bad model is scored, whatever it predicts; a file is refused only where a mistake is
recognised. Each mistake is undone and compared: displacements added up, values scaled
back, axes swapped back, the scenario looked for among the others, the particle among
its neighbours.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .findings import Findings
from .predictions import Predictions
from .truth import Truth, squared_steps

JUMP = 10.0
"""A step is suspect beyond this many of the truth's largest per-frame displacement."""

NEARER = 0.25
"""A mistake is recognised where undoing it brings the prediction this many times
nearer.
"""

SAMPLE = 200
"""Particles whose neighbours are looked for, evenly spaced over the ids."""

FEWEST = 40
"""Particles astray from which on another order is looked for: chance does not put half
of them on others.
"""

ON = 0.2
"""A prediction lies on a true particle within this many spacings; at random 13 % do at
the most.
"""

EXACTLY = 0.02
"""Within this many spacings no shift of a lattice ends by chance."""

Positions = NDArray[np.float64]


@dataclass(frozen=True)
class Start:
    """The frames around the first predicted one [length], each of shape [particle,
    space].
    """

    given: Positions  # the last given frame
    true: Positions  # the truth of the first predicted frame
    first: Positions  # the first predicted frame
    second: Positions  # the second predicted frame; the first again where there is none
    horizon: int = 0  # frames to predict
    # the truth of the second predicted frame, where there is one
    later: Positions | None = None

    @cached_property
    def true_step(self) -> float:
        """Largest distance that a particle of the truth moves between these frames
        [length].
        """
        frames = [
            frame for frame in (self.given, self.true, self.later) if frame is not None
        ]
        return float(np.sqrt(np.max(squared_steps(np.stack(frames)))))

    def largest_step(self, truth: Truth, scenario: int, *, enough: float) -> float:
        """Return the largest such distance in the scenario, or one that is enough in
        these frames.
        """
        if self.true_step >= enough:
            return self.true_step
        return truth.largest_displacement(scenario, enough=enough)


class Mistake(NamedTuple):
    """What was mistaken, and how to mend it."""

    what: str
    fix: str
    everywhere: bool = True  # whether a file that has it has it in most scenarios


def read_starts(predictions: Predictions, truth: Truth) -> dict[int, Start]:
    """Return how each known scenario begins, by ascending id."""
    known = sorted(set(predictions.header.scenarios) & set(truth.size.subsets["test"]))
    starts = {}
    frames = predictions.header.frames
    for scenario in known:
        predicted = predictions.frames(scenario, frames[0], min(2, len(frames))).astype(
            np.float64
        )
        given, true, *later = truth.around_start(scenario).astype(np.float64)
        second = next(iter(later), None)
        starts[scenario] = Start(
            given, true, predicted[0], predicted[-1], len(frames), second
        )
    return starts


def check_start(
    starts: Mapping[int, Start], first: int, truth: Truth, out: Findings
) -> None:
    """Refuse mistakes that are recognised, and flag predictions that do not follow what
    was given.

    ``first`` is the number of the first predicted frame.
    """
    mistakes = {
        i: mistake(
            start, truth.size.bounds, {j: s for j, s in starts.items() if j != i}
        )
        for i, start in starts.items()
    }
    counts = Counter(found for found in mistakes.values() if found is not None)
    for scenario, start in starts.items():
        found = mistakes[scenario]
        # A bad model may look so in one scenario by chance; what writes a file makes
        # the mistake in all.
        if found is None or (found.everywhere and 2 * counts[found] < len(starts)):
            with np.errstate(all="ignore"):
                distance = _rms(start.first - start.given)
            limit = JUMP * start.largest_step(truth, scenario, enough=distance / JUMP)
            if np.isfinite(distance) and distance > limit:
                out.warning(
                    "discontinuous_start",
                    "the first predicted frame is far from the last given one",
                    where=f"scenario {scenario}, frame {first}",
                    expected=f"root mean square distance at most {limit:.3g},"
                    f" {JUMP:g} times the truth's largest displacement in a frame",
                    got=f"{distance:.3g}",
                    fix="predict what follows the last given frame, particle by "
                    "particle; "
                    "where the model itself jumps, leave it: it is scored, and "
                    "flagged on the board",
                )
            continue
        out.error(
            "start",
            found.what,
            where=f"scenario {scenario}, frame {first}",
            expected="positions that follow the last given frame, particle by particle",
            got=f"root mean square distance to it "
            f"{_rms(start.first - start.given):.3g}",
            fix=found.fix,
        )
    told = {
        scenario: by
        for scenario, start in starts.items()
        if (by := shift(start)) is not None
    }
    for by, what, fix in (
        (
            -1,
            "the last given frame",
            "leave the last given frame out: predictions begin one frame later",
        ),
        (
            1,
            "the second frame of the truth",
            "predictions begin one frame earlier, after the last given one",
        ),
    ):
        wrong = [scenario for scenario, shifted in told.items() if shifted == by]
        if wrong:
            report = out.error if len(wrong) == len(told) else out.warning
            report(
                "start",
                "the frames seem to be shifted by one",
                where=f"scenario {wrong[0]}, frame {first}",
                expected="the frame after the last given one first",
                got=f"{what}, in {len(wrong)} of {len(told)} scenarios whose "
                f"truth moves",
                fix=fix,
            )
    out.made("start", "discontinuous_start")


def shift(start: Start) -> int | None:
    """Return by how many frames the prediction begins too late; None where the truth
    stands still.

    -1: the first predicted frame is the last given one and the second moves on. A
    prediction that then stays there, as persistence does, is a bad one and no mistake.
    1: the first predicted frame is the second one of the truth and the next step is as
    long as the truth's; a model that is twice too fast takes a second long step. 0:
    neither.
    """
    moved = _rms(start.true - start.given)
    if moved < 1e-6:
        return None
    if _rms(start.first - start.given) <= 0.1 * moved:
        return -int(_rms(start.second - start.first) >= 0.5 * moved)
    if start.later is None or _rms(start.first - start.later) > 0.1 * moved:
        return 0
    skips = _rms(start.first - start.later) <= NEARER * _rms(start.first - start.true)
    return int(skips and 0.5 * moved <= _rms(start.second - start.first) <= 1.5 * moved)


def mistake(
    start: Start, bounds: Sequence[tuple[float, float]], others: Mapping[int, Start]
) -> Mistake | None:
    """Return the mistake that was made; None where none is recognised.

    ``others`` are the starts of the other scenarios, by id.
    """
    first = start.first
    given = start.given
    low, high = np.array(bounds, np.float64).T
    apart = _rms(first - given)
    if not np.isfinite(apart) or np.array_equal(first, given):
        return None
    outside = ((first < low) | (first > high)).any(axis=-1).mean() >= 0.5
    if outside and _rms(first) <= min(NEARER * apart, JUMP * _rms(start.true - given)):
        return Mistake(
            "these seem to be displacements",
            "add them up, from the last given frame on",
        )
    if outside and _is_scaled(first, given):
        return Mistake(
            "the positions seem to be standardised", "undo that before writing"
        )
    if _rms(first[:, ::-1] - given) <= NEARER * apart:
        return Mistake(
            "x and y seem to be swapped", "store x first: positions[..., ::-1]"
        )
    if _is_reshaped(start):
        what = "frames and particles seem to be mixed up"
        return Mistake(
            what, "transpose an array [particle, frame, space], do not reshape it"
        )
    for i, other in others.items():
        if _rms(first - other.given) <= min(
            NEARER * apart, 2 * _rms(other.true - other.given)
        ):
            what = f"this seems to be the prediction of scenario {i}"
            fix = "store each under its own id"
            return Mistake(what, fix, everywhere=False)
    if _is_permuted(start):
        what = "the particles seem to stand in another order"
        fix = "keep the order of the given frames"
        return Mistake(what, fix, everywhere=False)
    return None


def _is_scaled(first: Positions, given: Positions) -> bool:
    """Tell whether positions are the given ones in other units, per component, and
    wider.
    """
    spread = first.std(axis=0), given.std(axis=0)
    if min(map(np.min, spread)) == 0.0:
        return False
    scaled = (
        (first - first.mean(axis=0)) / spread[0],
        (given - given.mean(axis=0)) / spread[1],
    )
    alike = (scaled[0] * scaled[1]).mean(axis=0)  # correlation
    return bool((alike >= 0.9).all() and (spread[0] >= 1.5 * spread[1]).all())


def _is_reshaped(start: Start) -> bool:
    """Tell whether an array [particle, frame, space] was read as [frame, particle,
    space].

    The rows of the first frame are then the frames of one particle after the other.
    """
    if not 0 < 3 * start.horizon <= len(start.first):
        return False
    rows = start.first[:: start.horizon]
    apart = _rms(rows - start.given[:: start.horizon])
    return _rms(rows - start.given[: len(rows)]) <= NEARER * apart


def _is_permuted(start: Start) -> bool:
    """Tell whether most particles that lie on neither of their own places lie on those
    of others.

    Clouds that fill a box agree whatever a model does, so it is not their shape that
    tells a permutation, of all particles or of some, but that predictions lie *on* true
    or given particles, though not on their own, next to which they did not move there.
    """
    count = len(start.given)
    if count < 8:
        return False
    sample = _spaced(np.arange(count))
    apart = float(np.median(_nearest(start.given[sample], start.given, skip=sample)[1]))
    move = start.first - start.given
    own = np.hypot(*move.T) <= ON * apart
    own |= np.hypot(*(start.first - start.true).T) <= ON * apart
    astray = np.flatnonzero(~own)
    if len(astray) < min(FEWEST, count / 2):
        return False
    sample = _spaced(astray)
    beside, _ = _nearest(start.given[sample], start.given, skip=sample)
    # Neighbours that move alike, as a lattice that shifts by its spacing, are no
    # permutation.
    torn = np.hypot(*(move[sample] - move[beside]).T) > apart
    for cloud in (start.given, start.true):
        found, distance = _nearest(start.first[sample], cloud)
        other = ((distance <= ON * apart) & torn) | (distance <= EXACTLY * apart)
        # A cloud that shrank to one point may lie on a particle too, but on one only.
        if len(np.unique(found[other])) >= 0.5 * (
            count if count < 2 * FEWEST else len(sample)
        ):
            return True
    return False


def _spaced(ids: NDArray[np.int_]) -> NDArray[np.int_]:
    """Return at most :data:`SAMPLE` of the ids, evenly spaced."""
    chosen: NDArray[np.int_] = ids[
        np.unique(np.linspace(0, len(ids) - 1, min(SAMPLE, len(ids))).astype(int))
    ]
    return chosen


def _nearest(
    points: Positions, cloud: Positions, skip: NDArray[np.int_] | None = None
) -> tuple[NDArray[np.int_], Positions]:
    """Return for every point the nearest particle of a cloud but ``skip``, and its
    distance.
    """
    found = np.empty(len(points), np.int_)
    distance = np.empty(len(points))
    # a sum over two neighbours in memory takes ten times as long
    columns = np.ascontiguousarray(cloud.T)
    apart = np.empty_like(columns)
    for row, point in enumerate(points):
        np.subtract(columns, point[:, None], out=apart)
        np.square(apart, out=apart)
        squares = np.add(apart[0], apart[1], out=apart[0])
        if skip is not None:
            squares[skip[row]] = np.inf
        found[row] = np.argmin(squares)
        distance[row] = np.sqrt(squares[found[row]])
    return found, distance


def _rms(distances: Positions) -> float:
    """Return the root mean square length of vectors [length]."""
    return float(np.sqrt(np.einsum("ij,ij->", distances, distances) / len(distances)))
