"""The ranking metric between two runs of a scenario, neither of which is a file."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lagbench.data import MATERIALS
from lagbench.data.registry import Size
from lagbench.metrics.aggregate import aggregate, tally
from lagbench.metrics.frame import FramePair, Scenario, TaskConfig, snapshots
from lagbench.metrics.table import METRICS, ranking_metric

Array = NDArray[np.floating]


def error_between(
    size: Size,
    prediction: Array,
    truth: Array,
    *,
    given: Array,
    previous: Array | None = None,
    material: NDArray[np.int8],
    area: float,
) -> float:
    """Return the ranking metric of the task, as the scorer measures it.

    Args:
        size: the split and size.
        prediction: positions in the predicted frames [length], shape [frame, particle,
            axis].
        truth: the same of the run that counts as true.
        given: the given frames of that run, shape [frame, particle, axis].
        previous: positions of the prediction in the last given frame, where they are
            not those of the truth [length], shape [particle, axis].
        material: index into MATERIALS, shape [particle].
        area: area or volume that the particles cover [length^d].
    """
    task = size.task
    present = np.unique(material).tolist()
    config = TaskConfig(
        grid=size.field_grid,
        input_frames=task.input_frames,
        horizon=len(truth),
        frames_of_interest=task.frames_of_interest,
        attribute_std=(1.0,) * (2 * size.dimension),  # no ranking metric reads it
        radius=task.radius,
        materials=tuple(MATERIALS[value] for value in present),
    )
    scenario = Scenario(
        config=config,
        input_positions=given,
        material=material,
        particle_mass=float(size.value("density")) * area / len(material),
        area=area,
    )
    metric = METRICS[ranking_metric(size)]
    statistics = [METRICS[name] for name in metric.of] or [metric]
    frames = config.predicted_frames
    rows = zip(
        frames,
        snapshots(scenario, truth),
        snapshots(scenario, prediction, previous=previous),
        strict=True,
    )
    pairs = (FramePair(scenario, *row) for row in rows)
    tallies = {0: tally(pairs, statistics, frames)}
    scores = aggregate([*statistics, metric], tallies)
    return float(scores[metric.name].mean)
