"""Frozen field: the velocity of the last given frame carries the particles ever on.

With u the field of that frame, known at the middle of each particle's last step,

    x(f+1) = x(f) + a^k u(x(f) + a^k u(x(f)) / 2),    k = f - n + 2 with n given frames,

a midpoint step. a is 1 where walls, a force or a stream drive the flow; elsewhere ``ln
a`` is the slope of a line through the logarithms of the RMS speed of the given frames,
at most 0. What is nearly steady needs no model: this predictor shows it.
"""

from __future__ import annotations

import numpy as np

from lagbench.data.box import Box

from .predictor import (
    Floats,
    Given,
    Kind,
    Prediction,
    ReferencePredictor,
    velocity_field,
    with_wall_images,
)


def decay(position: Floats, box: Box) -> float:
    """Return the factor on the speed from frame to frame, fitted to given frames [1].

    Args:
        position: the given frames [length], shape [frame, particle, axis].
        box: box that holds the particles.
    """
    before = position[:-1]
    after = position[1:]
    steps = box.displacement(before, after)
    mean_square = np.mean(steps**2, axis=(1, 2))
    speed = np.sqrt(mean_square)  # of each step
    count = len(speed)
    if count < 2 or not speed.all():
        return 1.0
    slope, _ = np.polyfit(np.arange(count), np.log(speed), 1)
    factor = float(np.exp(slope))
    return min(1.0, factor)


def predict(given: Given) -> Prediction:
    """Yield positions that the last given field carries."""
    wall = given.walls[given.size.task.input_frames - 1]
    field = velocity_field(*with_wall_images(given, given.middle, given.step, wall))
    factor = 1.0
    has_stream = given.obstacle is not None
    if given.driven or given.body_force is not None or has_stream:
        rate = 1.0
    else:
        rate = decay(given.position, given.box)
    now = given.last
    for _ in given.predicted_frames:
        factor *= rate
        half = given.inside(now + factor * field(now) / 2.0)
        now = given.inside(now + factor * field(half))
        yield now.astype("float32")


PREDICTOR = ReferencePredictor(
    name="frozen-field",
    title="Frozen field",
    kind=Kind.NAIVE,
    definition="The velocity field of the last given frame carries the particles; in a"
    " box that nothing drives it decays as the given frames do.",
    applies=lambda size: size.is_full_box,
    predict=predict,
)
