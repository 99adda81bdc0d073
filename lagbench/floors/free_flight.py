"""Free flight: ``x(n-1+k) = x(n-1) + k u + g k (k + 1) / 2``, stopped by the walls.

u is the last given displacement, g the displacement that gravity adds from frame to frame,
``-gravity * frame_interval^2``. Exact until a body meets a wall or another body.
"""

from __future__ import annotations

import numpy as np

from lagbench.data.registry import Size

from .floor import Floor, Given, Prediction, fills_box


def predict(given: Given) -> Prediction:
    """Yield positions on parabolas."""
    g = np.array([0.0, -float(given.size.value("gravity"))]) * given.size.frame_interval**2
    for k, _ in enumerate(given.predicted_frames, start=1):
        yield given.inside(given.last + k * given.step + g * (k * (k + 1) / 2)).astype("float32")


def _applies(size: Size) -> bool:
    return not fills_box(size) and "gravity" in size.parameters


FLOOR = Floor(
    name="free-flight",
    title="Free flight",
    definition="Every particle falls freely from its last given velocity and stops at the walls.",
    applies=_applies,
    predict=predict,
)
