"""Arrays that were meant otherwise: axes transposed, velocities of another frame, axis
or unit.

Each mistake is undone and compared. A trajectory is refused only where another reading
explains it far better than the one taken: what is noisy, at rest or random is nobody's
mistake.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagbench.errors import DataError
from lagbench.submission.start import Mistake

# neighbours along an axis looked at together: two second differences, a step and its
# neighbours
STRETCH = 4
# stretches of frames and of particles that are looked at, evenly spaced over each axis
STRETCHES = 64, 200
# change of a step, as a share of the step, from which on frames do not resolve the
# motion
ROUGH = 0.5
# the same for what jumps: random places have 1.7, what turns by a radian per frame 0.96
JUMPS = 1.0
SMOOTHER = 0.25  # share of the jumps that the other axis may have to be the smooth one
ROUNDED = 1e-6  # share of a variance that rounding may leave
# share of the velocities' variance that motion must leave, or another reading take away
EXPLAINED = 0.5
# from which on velocities have another unit than the motion; our coarsest data have 1.3
FACTOR = 1.5
# share of the misfit that a shift by a frame must leave: a solver may lag by a tenth
SHIFTED = 0.4
FEWEST = 8  # steps below which chance may look like anything

# of shape [stretch of frames, frame, stretch of particles, particle, 2]
Block = NDArray[np.float64]


def misplaced_axes(shape: tuple[int, ...]) -> Mistake | None:
    """Return what is wrong with a shape whose components do not come last; None where
    they do.
    """
    if len(shape) != 3 or shape[2] in (2, 3) or 2 not in shape[:2]:
        return None  # with three components it is data in space
    found, place = (
        ("(frames, 2, particles)", 1)
        if shape[1] == 2
        else ("(2, frames, particles)", 0)
    )
    return Mistake(_axes(found), f"np.moveaxis(array, {place}, 2)")


def _axes(found: str) -> str:
    return f"axes: {found} where (frames, particles, 2) was expected"


def check_meaning(name: str, position: Any, velocity: Any, interval: float) -> None:  # noqa: ANN401 (arrays, also netCDF's)
    """Refuse positions [length] and velocities [length/s] that another reading explains
    far better.
    """
    if position.shape[0] < STRETCH:
        return
    found: list[Mistake] = []
    with np.errstate(
        all="ignore"
    ):  # what is not finite is no mistake of meaning, and found elsewhere
        moved = _block(position)
        if _is_transposed(moved):
            found = [Mistake(_axes("(particles, frames, 2)"), "array.swapaxes(0, 1)")]
        elif velocity is not None:
            found = list(_of_velocities(moved, _block(velocity), interval))
    if found:
        raise DataError(
            "; ".join(mistake.what for mistake in found),
            where=name,
            expected="position[f, p] and velocity[f, p] of particle p in frame f, x "
            "first, per second",
            fix="; ".join(mistake.fix for mistake in found)
            + "; or, if the data are right, --as-is",
        )


def _block(array: Any) -> Block:  # noqa: ANN401
    """Return evenly spaced stretches of an array, of which a frame at a time is in
    memory.
    """
    places = []  # indices of shape [stretch, neighbour] along each axis
    for count, most in zip(array.shape[:2], STRETCHES, strict=True):
        length = min(STRETCH, count)
        first = np.unique(np.linspace(0, count - length, most).astype(int))
        places.append(first[:, None] + np.arange(length))
    frames, particles = places
    rows = [
        np.asarray(array[int(frame)], np.float64)[particles] for frame in frames.flat
    ]
    return np.stack(rows).reshape(*frames.shape, *particles.shape, 2)


def _is_transposed(moved: Block) -> bool:
    """Tell whether positions jump from row to row, as particles do, but not from column
    to column.
    """
    if moved.shape[3] < STRETCH:
        return False
    (step, change), (other_step, other_change) = (
        (_length(np.diff(moved, axis=axis)), _length(np.diff(moved, n=2, axis=axis)))
        for axis in (1, 3)
    )
    jumps = change >= JUMPS * step > 0.0
    # Jitter about a smooth row of particles at rest jumps from row to row, and as much
    # along the row.
    return bool(
        jumps
        and other_change * step <= SMOOTHER * change * other_step
        and other_change <= SMOOTHER * change
    )


def _of_velocities(moved: Block, velocity: Block, interval: float) -> Iterator[Mistake]:
    """Yield the mistakes in velocities, each after the ones before are undone."""
    steps = np.diff(moved, axis=1)
    step = steps[:, 1]
    if step[..., 0].size < FEWEST:
        return
    (left, _), (swapped, _) = (
        _multiple(step, velocity),
        _multiple(step, velocity[..., ::-1]),
    )
    if left > ROUNDED and swapped <= EXPLAINED * left:
        yield Mistake("x and y of the velocity are swapped", "velocity[..., ::-1]")
        velocity = velocity[..., ::-1]
    if _length(np.diff(steps, axis=1)) > ROUGH * _length(step):
        return
    left, rate = _multiple(step, velocity)
    factor = rate * interval
    if left <= EXPLAINED and not 1.0 / FACTOR <= factor <= FACTOR:
        per_frame = abs(factor / interval - 1.0) <= 0.1
        if factor < 0.0:
            yield Mistake("velocities point backwards", "-velocity")
            return
        if per_frame:
            yield Mistake(
                "velocities are per frame, not per second",
                "divide them by the frame interval",
            )
        else:
            what = (
                f"velocities are {factor:.3g} times what the positions move per second"
            )
            yield Mistake(
                what, f"divide them by it, or --frame-interval {interval / factor:.3g}"
            )
        if per_frame:
            interval = 1.0
        else:
            interval = interval / factor
    velocity = velocity * interval  # [length/frame]

    def apart(*readings: Block) -> float:
        return min(_length(step - reading) for reading in readings)

    # A velocity may be that of its moment, or the difference to the frame before or
    # after.
    own = min(apart(*_own(velocity)), _length(step))
    before, start, end, after = (velocity[:, frame] for frame in range(STRETCH))
    late = apart(after, (after + end) / 2.0)
    early = apart(before, (before + start) / 2.0)
    if own > 0.0 and min(late, early) <= SHIFTED * own:
        if late <= early:
            yield Mistake(
                "velocities are one frame late", "velocity[1:] belongs to position[:-1]"
            )
        else:
            yield Mistake(
                "velocities are one frame early",
                "velocity[:-1] belongs to position[1:]",
            )


def _own(velocity: Block) -> tuple[Block, Block, Block]:
    """Return what may be the mean over a step: the velocity before it, after it, or of
    both moments.
    """
    return velocity[:, 1], velocity[:, 2], (velocity[:, 1] + velocity[:, 2]) / 2.0


def _multiple(step: Block, velocity: Block) -> tuple[float, float]:
    """Return which share of the velocities' variance no multiple of the steps explains,
    and the multiple.
    """
    found = []
    for mean in _own(velocity):
        squares = np.sum(step * step)
        both = np.sum(step * mean)
        share = 1.0 - both**2 / (squares * np.sum(mean * mean))
        found.append(
            (float(share), float(both / squares)) if np.isfinite(share) else (1.0, 0.0)
        )
    return min(found)


def _length(vectors: Block) -> float:
    """Return the mean length of vectors: less than their mean square it heeds the few
    that collide.
    """
    return float(np.hypot(vectors[..., 0], vectors[..., 1]).mean())
