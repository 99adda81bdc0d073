"""Extrapolations: every particle goes on by itself, and stops at the walls.

With n given frames, u = x(n-1) - x(n-2) and g = -gravity * frame_interval^2, k frames
on:

    persistence        x(n-1)
    constant velocity  x(n-1) + k u
    free flight        x(n-1) + k u + g k (k + 1) / 2

Free flight is exact until a body meets a wall or another body.
"""

from __future__ import annotations

import numpy as np

from .predictor import Given, Prediction, ReferencePredictor, fills_box


def at_rest(given: Given) -> Prediction:
    """Yield the last given positions."""
    last = given.last.astype("float32")
    return (last for _ in given.predicted_frames)


def on_lines(given: Given) -> Prediction:
    """Yield positions on straight lines."""
    for k, _ in enumerate(given.predicted_frames, start=1):
        yield given.inside(given.last + k * given.step).astype("float32")


def on_parabolas(given: Given) -> Prediction:
    """Yield positions on parabolas."""
    g = (
        np.array([0.0, -float(given.size.value("gravity"))])
        * given.size.frame_interval**2
    )
    for k, _ in enumerate(given.predicted_frames, start=1):
        yield given.inside(given.last + k * given.step + g * (k * (k + 1) / 2)).astype(
            "float32"
        )


PERSISTENCE = ReferencePredictor(
    name="persistence",
    title="Persistence",
    definition="The last given frame, repeated.",
    predict=at_rest,
)

CONSTANT_VELOCITY = ReferencePredictor(
    name="constant-velocity",
    title="Constant velocity",
    definition="Every particle keeps its last given velocity and stops at the walls.",
    predict=on_lines,
)

FREE_FLIGHT = ReferencePredictor(
    name="free-flight",
    title="Free flight",
    definition="Every particle falls freely from its last given velocity and stops at "
    "the walls.",
    applies=lambda size: not fills_box(size) and "gravity" in size.parameters,
    predict=on_parabolas,
)
