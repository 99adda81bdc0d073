"""Constant velocity: ``x(n-1+k) = x(n-1) + k (x(n-1) - x(n-2))``, no farther than the walls."""

from __future__ import annotations

from .floor import Floor, Given, Prediction


def predict(given: Given) -> Prediction:
    """Yield positions on straight lines."""
    for k, _ in enumerate(given.predicted_frames, start=1):
        yield given.inside(given.last + k * given.step).astype("float32")


FLOOR = Floor(
    name="constant-velocity",
    title="Constant velocity",
    definition="Every particle keeps its last given velocity and stops at the walls.",
    applies=lambda _: True,
    predict=predict,
)
