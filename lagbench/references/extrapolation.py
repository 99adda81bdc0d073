"""Extrapolations: every particle goes on by itself and stops at the walls.

With n given frames, u = x(n-1) - x(n-2) and g = -gravity * frame_interval^2, k frames
on:

    persistence        x(n-1)
    constant velocity  x(n-1) + k u
    ballistic          x(n-1) + k u + g k (k + 1) / 2

Ballistic flight is exact until a body meets a wall or another body.
"""

from __future__ import annotations

from .predictor import Floats, Given, Kind, Prediction, ReferencePredictor, falls


def predict_rest(given: Given) -> Prediction:
    """Yield the last given positions."""
    last = given.last.astype("float32")
    return (last for _ in given.predicted_frames)


def predict_lines(given: Given) -> Prediction:
    """Yield positions on straight lines."""
    for k, _ in enumerate(given.predicted_frames, start=1):
        yield given.inside(given.last + k * given.step).astype("float32")


def ballistic_positions(given: Given, frames_on: int) -> Floats:
    """Return where free particles are so many frames after the last given one.

    The unit is length, the shape [particle, axis].
    """
    fallen = given.fall * (frames_on * (frames_on + 1) / 2)
    return given.inside(given.last + frames_on * given.step + fallen)


def predict_parabolas(given: Given) -> Prediction:
    """Yield positions on parabolas."""
    for k, _ in enumerate(given.predicted_frames, start=1):
        yield ballistic_positions(given, k).astype("float32")


PERSISTENCE = ReferencePredictor(
    name="persistence",
    title="Persistence",
    kind=Kind.NAIVE,
    definition="The last given frame, repeated.",
    predict=predict_rest,
)

CONSTANT_VELOCITY = ReferencePredictor(
    name="constant-velocity",
    title="Constant velocity",
    kind=Kind.NAIVE,
    definition="Every particle keeps its last given velocity and stops at the walls.",
    predict=predict_lines,
)

BALLISTIC = ReferencePredictor(
    name="ballistic",
    title="Ballistic",
    kind=Kind.NAIVE,
    definition="Every particle falls freely from its last given velocity and stops at"
    " the walls.",
    applies=falls,
    predict=predict_parabolas,
)
