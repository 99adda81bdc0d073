"""Persistence: ``x(n-1+k) = x(n-1)``, the last of n given frames, repeated."""

from __future__ import annotations

from .floor import Floor, Given, Prediction


def predict(given: Given) -> Prediction:
    """Yield the last given positions."""
    last = given.last.astype("float32")
    return (last for _ in given.predicted_frames)


FLOOR = Floor(
    name="persistence",
    title="Persistence",
    definition="The last given frame, repeated.",
    applies=lambda _: True,
    predict=predict,
)
