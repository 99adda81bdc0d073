"""Check how predictions begin: with the given particles, in their order, close by.

A bad model is scored, whatever it predicts. A file is refused only where its first
frame holds exactly the true positions, or the last given ones, in another order of the
particles: no model predicts that, so it can only be a mistake of the file.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from lagbench.data.box import Box
from lagbench.data.judgement import find_shift

from .issues import IssueCollector
from .predictions import Predictions
from .truth import Truth, squared_steps

JUMP = 10.0
"""A step is suspect beyond this many of the truth's largest per-frame displacement."""

SHIFT_FRAMES = 5
"""First predicted frames that are compared with the true ones before and after."""

Positions = NDArray[np.float32]


@dataclass(frozen=True)
class StartFrames:
    """The frames around the first predicted one [length]."""

    # the last given frame and the true ones after it, [2 or 3, particle, space]
    truth: Positions
    predicted: Positions  # the first predicted frame, [particle, space]
    box: Box  # that holds the particles

    @property
    def last_given(self) -> Positions:
        """The last given frame [length], shape [particle, space]."""
        position: Positions = self.truth[0]
        return position

    @property
    def first_true(self) -> Positions:
        """The truth of the first predicted frame [length], shape [particle, space]."""
        position: Positions = self.truth[1]
        return position

    @cached_property
    def true_displacement(self) -> float:
        """Largest distance that a particle of the truth moves in a frame [length]."""
        return float(np.sqrt(np.max(squared_steps(self.truth, self.box))))

    @cached_property
    def jump(self) -> float:
        """Distance from the last given to the first predicted frame [length].

        The root mean square over particles; NaN where a position is no number.
        """
        with np.errstate(all="ignore"):
            predicted = self.predicted.astype(np.float64)
            step = self.box.displacement(self.last_given, predicted)
            mean_square = np.einsum("ij,ij->", step, step) / len(step)
            return float(np.sqrt(mean_square))


def read_starts(predictions: Predictions, truth: Truth) -> dict[int, StartFrames]:
    """Return how each known scenario begins, by ascending id."""
    first_frame = predictions.header.frames[0]
    test_scenarios = set(truth.size.scored_scenarios)
    scenarios = sorted(test_scenarios.intersection(predictions.header.scenarios))
    starts = {}
    for scenario in scenarios:
        predicted = predictions.frames(scenario, first_frame, 1)[0]
        true_frames = truth.frames_around_start(scenario)
        starts[scenario] = StartFrames(true_frames, predicted, truth.size.box)
    return starts


def check_start(
    starts: Mapping[int, StartFrames],
    *,
    first_frame: int,
    truth: Truth,
    issues: IssueCollector,
) -> None:
    """Refuse permuted particles, and flag a jump from the last given frame."""
    for scenario, start in starts.items():
        where = f"scenario {scenario}, frame {first_frame}"
        if is_start_permuted(start):
            issues.error(
                "start",
                "the particles stand in another order",
                where=where,
                expected="particles in the order of the given frames",
                got="the same positions in another order",
                fix="keep the order of the given frames",
            )
            continue
        limit = JUMP * largest_true_displacement(
            start, truth=truth, scenario=scenario, enough=start.jump / JUMP
        )
        if np.isfinite(start.jump) and start.jump > limit:
            issues.warning(
                "discontinuous_start",
                "the first predicted frame is far from the last given one",
                where=where,
                expected=f"root mean square distance at most {limit:.3g},"
                f" {JUMP:g} times the truth's largest displacement in a frame",
                got=f"{start.jump:.3g}",
                fix="store positions, x first, in lengths of the unit box, of every "
                "scenario under its own id; where the model itself jumps, leave it: "
                "it is scored, and flagged on the board",
            )
    issues.complete("start", "discontinuous_start")


def check_shift(predictions: Predictions, truth: Truth, issues: IssueCollector) -> None:
    """Flag predictions that are a frame or two late, or early, in every scenario."""
    first = predictions.header.frames[0]
    margin = 2
    count = min(SHIFT_FRAMES, truth.size.task.horizon - margin)
    scored = set(truth.size.scored_scenarios).intersection(predictions.header.scenarios)
    shifts = set()
    for scenario in sorted(scored) if count > 1 else ():
        predicted = predictions.frames(scenario, first, count).astype(np.float64)
        recorded = truth.frames(scenario, first - margin, first + count + margin)
        true_frames = recorded.astype(np.float64)
        shift = 0
        if np.isfinite(predicted).all():
            shift = find_shift(predicted, true_frames, truth.size.box)
        shifts.add(shift)
        if shifts != {shift} or shift == 0:
            shifts = {0}
            break
    if shifts and shifts != {0}:
        shift = shifts.pop()
        frames = "one frame" if abs(shift) == 1 else f"{abs(shift)} frames"
        issues.warning(
            "shifted",
            f"predictions are {frames} {'late' if shift < 0 else 'early'}: in every "
            f"scenario they fit the true frames {'before' if shift < 0 else 'after'} "
            "far better than their own",
            where=f"frames {first} to {first + count - 1}",
            expected="the frame after the last given one first",
            got="a rollout that begins with another one",
            fix="begin with the frame after the last given one",
        )
    issues.complete("shifted")


def is_start_permuted(start: StartFrames) -> bool:
    """Return whether the prediction begins with true or given positions, permuted."""
    return any(
        is_permutation(start.predicted, reference)
        for reference in (start.first_true, start.last_given)
    )


def is_permutation(predicted: Positions, reference: Positions) -> bool:
    """Return whether two frames hold the same positions in another particle order.

    >>> square = np.array([[0, 0], [0, 1], [1, 0], [1, 1]], np.float32)
    >>> is_permutation(square[::-1], square), is_permutation(square, square)
    (True, False)
    """
    if np.array_equal(predicted, reference):
        return False
    return np.array_equal(sort_particles(predicted), sort_particles(reference))


def sort_particles(position: Positions) -> Positions:
    """Return positions ordered by x, then y, then z, shape [particle, space]."""
    order = np.lexsort(position.T[::-1])
    return position[order]


def largest_true_displacement(
    start: StartFrames, *, truth: Truth, scenario: int, enough: float
) -> float:
    """Return the largest distance that a true particle moves in a frame [length].

    More of the truth is read only where the first frames show less than ``enough``
    [length].
    """
    if start.true_displacement >= enough:
        return start.true_displacement
    return truth.largest_displacement(scenario, enough=enough)
