"""Climatology: where matter is at this frame in train, whatever the start.

Each particle follows, from the first predicted frame on, one particle of its material
in one scenario of train or its mirror image, drawn with a fixed seed. Where train has
none of its material, it rests. The cloud at a
frame is then a sample of all clouds of train at that frame. The scenarios take turns,
so that each has its share.
"""

from __future__ import annotations

import numpy as np

from .predictor import Given, Kind, Prediction, ReferencePredictor, falls
from .train_library import (
    Mirror,
    long_enough,
    mirrors_of,
    read_train_scenario,
)

SEED = 0
"""Seed of the drawn particles."""


def predict(given: Given) -> Prediction:
    """Yield a sample of the clouds of train."""
    size = given.size
    horizon = len(given.predicted_frames)
    first = given.predicted_frames[0]
    rng = np.random.Generator(np.random.PCG64(SEED))
    draws = rng.random(len(given.last))
    position = np.repeat(given.last[None], horizon, axis=0)
    frames = np.arange(first, first + horizon)
    scenarios = long_enough(size)
    for kind in np.unique(given.material):
        sources = _images_with(given, int(kind), scenarios)
        members = np.flatnonzero(given.material == kind)
        for number, (scenario, mirror) in enumerate(sources):
            path = size.path(given.root, scenario)
            motion = read_train_scenario(path)
            followers = members[number :: len(sources)]
            pool = np.flatnonzero(motion.material == kind)
            place = draws[followers] * len(pool)
            partner = pool[place.astype(np.intp)]
            all_paths = motion.positions_at(frames)
            position[:, followers] = mirror.positions(all_paths[:, partner])
    yield from position.astype("float32")


def _images_with(
    given: Given, kind: int, scenarios: tuple[int, ...]
) -> list[tuple[int, Mirror]]:
    """Return the scenarios that have a material, under each mirror image."""
    images = []
    for scenario in scenarios:
        motion = read_train_scenario(given.size.path(given.root, scenario))
        if (motion.material == kind).any():
            images += [(scenario, mirror) for mirror in mirrors_of(given.size)]
    return images


PREDICTOR = ReferencePredictor(
    name="climatology",
    title="Climatology",
    kind=Kind.NAIVE,
    definition="Particles of the same material drawn from all scenarios of train and"
    " their mirror images, at the same frame.",
    applies=falls,
    predict=predict,
    reads_train=True,
)
