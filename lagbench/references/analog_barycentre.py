"""Ballistic flight until contact, then the mean cloud of the most similar states.

As :mod:`.ballistic_analog`, but every particle follows a partner in each of the states
of train that are most like ours. Their clouds x_k are matched to that of the nearest
one, anew in every tenth frame, and averaged:

    x_i = sum_k w_k x_k,m_k(i),     w_k = d_k^-s / sum d^-s,

with d_k the distance of analog k from the state, and m_k the matching with the least
sum of squared distances within each material. The mean is taken along the shortest ways
from the nearest cloud to the others, so a cloud may lie across the ends of a periodic
box. This is one step towards the Wasserstein-2 barycentre of the
clouds (Agueh and Carlier 2011), whose mean squared distance from them is least.

Frames after contact, analogs and s are chosen on train, each scenario predicted from
the others (``benchmarks/naive_attempts.py`` of commit 5c959f01, which matches
the clouds in every compared frame). The predictor applies where that was done:
:data:`CHOSEN`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lagbench.data.registry import Size

from .assignment import assign_particles
from .ballistic_analog import Choice, FollowedAnalog, fly_then_follow
from .predictor import Floats, Given, Kind, Prediction, ReferencePredictor
from .train_library import state_library

MATCHED_EVERY = 10
"""Frames from one matching of the clouds to the next: it takes most of the time."""

MATCHED_TOGETHER = 640
"""Particles of a material that are matched together, at most.

All of them in a scenario of two dimensions at size mini. In three dimensions there are
ten times as many, and the time of a matching grows with the cube.
"""

LEAST_DISTANCE = 1e-12
"""Least distance of an analog, in units of features.

A state of train is at distance 0 of itself.
"""


@dataclass(frozen=True)
class BarycentreChoice:
    """What is chosen on train."""

    after_contact: Choice  # frames after contact, and analogs
    sharpness: float  # power s of the distance


CHOSEN: Mapping[str, BarycentreChoice] = {
    "fluid-3d-mini-v1": BarycentreChoice(Choice(lag=0, analogs=2), sharpness=2.0),
    "fluid-mini-v3": BarycentreChoice(Choice(lag=0, analogs=5), sharpness=2.0),
    "multimaterial-3d-mini-v1": BarycentreChoice(
        Choice(lag=10, analogs=3), sharpness=2.0
    ),
    "multimaterial-mini-v3": BarycentreChoice(Choice(lag=10, analogs=5), sharpness=2.0),
}
"""Choices by split, size and MAJOR version."""


def key_of(size: Size) -> str:
    """Return the key of a data set in :data:`CHOSEN`."""
    return f"{size.split}-{size.name}-v{size.major}"


def applies(size: Size) -> bool:
    """Tell whether something was chosen for a data set."""
    return key_of(size) in CHOSEN


def follow_all(distances: Floats, particle_count: int) -> list[NDArray[np.intp]]:
    """Return the followers of each analog: all particles follow each one."""
    everybody = np.arange(particle_count)
    return [everybody for _ in distances]


def weights_of(distances: Floats, sharpness: float) -> Floats:
    """Return the weights ``d^-s / sum d^-s`` of the analogs [1]."""
    nearest = max(float(distances.min()), LEAST_DISTANCE)
    relative = np.maximum(distances, LEAST_DISTANCE) / nearest
    weights = relative**-sharpness
    return np.asarray(weights / weights.sum())


class MeanCloud:
    """The weighted mean of the analogs' clouds, frame after frame.

    Args:
        sharpness: power s of the distance.
    """

    def __init__(self, sharpness: float) -> None:
        self._sharpness = sharpness
        # particles of each further analog in the order of the nearest one
        self._partners: list[NDArray[np.intp]] = []

    def __call__(
        self, given: Given, analogs: Sequence[FollowedAnalog], frames_on: int
    ) -> Floats:
        """Return the mean cloud [length], shape [particle, axis].

        Args:
            given: what is given of the scenario.
            analogs: analogs that all particles follow, nearest first.
            frames_on: frames since the comparison, ascending from call to call.
        """
        distances = np.array([analog.distance for analog in analogs])
        weights = weights_of(distances, self._sharpness)
        clouds = [analog.positions(frames_on) for analog in analogs]
        if not self._partners or frames_on % MATCHED_EVERY == 0:
            self._match(given, clouds)

        nearest_cloud = clouds[0]
        mean = nearest_cloud.copy()
        for weight, cloud, partner in zip(
            weights[1:], clouds[1:], self._partners, strict=True
        ):
            mean += weight * given.box.displacement(nearest_cloud, cloud[partner])
        return mean

    def _match(self, given: Given, clouds: Sequence[Floats]) -> None:
        """Match the clouds to the first one."""
        self._partners = []
        for cloud in clouds[1:]:
            partner = assign_particles(
                clouds[0],
                cloud,
                given.material,
                given.material,
                given.box,
                most_together=MATCHED_TOGETHER,
            )
            self._partners.append(partner)


def predict(given: Given) -> Prediction:
    """Yield positions on parabolas, and after contact the mean of the analogs."""
    choice = CHOSEN[key_of(given.size)]
    library = state_library(given.size, given.root, np.unique(given.material).tolist())
    for position in fly_then_follow(
        given,
        choice.after_contact,
        library=library,
        divide=follow_all,
        combine=MeanCloud(choice.sharpness),
        most_together=MATCHED_TOGETHER,
    ):
        yield position.astype("float32")


PREDICTOR = ReferencePredictor(
    name="analog-barycentre",
    title="Ballistic, then mean cloud of analogs",
    kind=Kind.NAIVE,
    definition="Every particle falls freely until a tenth of them touch a wall or two"
    " bodies meet. Then the two to five states of train, or their mirror images, that"
    " are most like that are matched, and their clouds are averaged; nearer states"
    " count more.",
    applies=applies,
    predict=predict,
    reads_train=True,
)
