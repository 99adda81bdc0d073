"""Ballistic flight until contact, then analogs of which the nearer ones lead more.

As :mod:`.ballistic_analog`, with another division of the particles: the share of an
analog at distance d from the state is ``d^-s / sum d^-s``. With s = 0 all lead as many
particles, with large s the nearest leads all.

Frames after contact, analogs and s are chosen on train, each scenario predicted from
the others (``python benchmarks/naive_attempts.py --attempt weighted``). The predictor
applies where that was done: :data:`CHOSEN`.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lagbench.data.registry import Size

from .ballistic_analog import Choice, predict_positions
from .predictor import Floats, Given, Kind, Prediction, ReferencePredictor
from .train_library import state_library

GOLDEN = 0.6180339887498949
"""Step between the places of particles: every stretch of them has the same shares."""

LEAST_DISTANCE = 1e-12
"""Least distance of an analog [length]: a state of train is its own analog."""


@dataclass(frozen=True)
class WeightedChoice:
    """What is chosen on train."""

    flight: Choice  # frames after contact, and analogs
    sharpness: float  # power s of the distance


CHOSEN: Mapping[str, WeightedChoice] = {
    "fluid-mini-v3": WeightedChoice(Choice(lag=0, analogs=4), sharpness=3.0),
}
"""Choices by split, size and MAJOR version."""


def key_of(size: Size) -> str:
    """Return the key of a data set in :data:`CHOSEN`."""
    return f"{size.split}-{size.name}-v{size.major}"


def applies(size: Size) -> bool:
    """Tell whether something was chosen for a data set."""
    return key_of(size) in CHOSEN


def divide_by_nearness(
    distances: Floats, particle_count: int, *, sharpness: float
) -> list[NDArray[np.intp]]:
    """Return the followers of each analog, the nearer ones having more.

    Args:
        distances: of the analogs, shape [analog].
        particle_count: number of particles.
        sharpness: power s of the distance.

    Returns:
        Numbers of particles by analog; together they are all particles once.
    """
    weights = np.maximum(distances, LEAST_DISTANCE) / max(
        float(distances.min()), LEAST_DISTANCE
    )
    weights = weights**-sharpness
    edges = np.cumsum(weights / weights.sum())
    places = np.mod(np.arange(particle_count) * GOLDEN, 1.0)
    owners = np.minimum(np.searchsorted(edges, places), len(distances) - 1)
    followers = []
    for number in range(len(distances)):
        followers.append(np.flatnonzero(owners == number))
    return followers


def predict(given: Given) -> Prediction:
    """Yield positions on parabolas, and after contact those of the analogs."""
    choice = CHOSEN[key_of(given.size)]
    library = state_library(given.size, given.root, np.unique(given.material).tolist())
    divide = functools.partial(divide_by_nearness, sharpness=choice.sharpness)
    for position in predict_positions(
        given, choice.flight, library=library, divide=divide
    ):
        yield position.astype("float32")


PREDICTOR = ReferencePredictor(
    name="weighted-analogs",
    title="Ballistic, then weighted analogs",
    kind=Kind.NAIVE,
    definition="Every particle falls freely until a tenth of them touch a wall or two"
    " bodies meet; then it follows its partner in one of the states of train, or their"
    " mirror images, that are most like that; the nearer a state, the more particles"
    " follow it.",
    applies=applies,
    predict=predict,
    reads_train=True,
)
