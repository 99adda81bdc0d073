"""Ballistic flight until contact, then what came of the states of train most like it.

Free bodies fall on parabolas until one touches a wall or another body. Some frames
later the state of the flight is compared with states of train: every second frame of
every scenario and of its mirror image (see :mod:`.train_library`). The particles share
the nearest few among them: each particle follows its partner in one of these analogs.
How far a particle was from its partner is kept at first and fades away.

How many frames after contact, and how many analogs, was chosen on train: each scenario
was predicted from the others, and the choice with the least mean distance of clouds was
taken (``choose`` of this module at commit d1b9abca). It stands in ``chosen.json``.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lagbench.data.box import UNIT_SQUARE, Box
from lagbench.data.registry import Size

from .assignment import MOST_TOGETHER, assign_particles
from .extrapolation import ballistic_positions
from .predictor import (
    Floats,
    Given,
    Kind,
    Prediction,
    ReferencePredictor,
    falls,
)
from .train_library import (
    StateLibrary,
    describe_state,
    mirrors_of,
    read_train_scenario,
    state_library,
)

CONTACT_SHARE = 0.1
"""Share of the particles that must lie on a wall for the flight to be over."""

OFFSET_FADING = 0.95
"""Factor per frame on the distance of a particle from its partner."""

CHOSEN_PATH = Path(__file__).parent / "chosen.json"


@dataclass(frozen=True)
class Choice:
    """What is chosen on train."""

    lag: int = 5  # frames from contact to the comparison
    analogs: int = 4  # analogs that the particles share


@functools.cache
def _chosen() -> Mapping[str, Mapping[str, int]]:
    choices: dict[str, dict[str, int]] = json.loads(CHOSEN_PATH.read_text("utf-8"))
    return choices


def choice_for(size: Size) -> Choice:
    """Return what was chosen for a data set, or for size mini of its split.

    Data sets of a user have the default.
    """
    for name in (size.name, "mini"):
        chosen = _chosen().get(f"{size.split}-{name}-v{size.major}")
        if chosen is not None:
            return Choice(**chosen)
    return Choice()


def label_bodies(
    position: Floats, radius: float, box: Box = UNIT_SQUARE
) -> NDArray[np.intp]:
    """Return the number of the body of each particle.

    A body is all that hangs together by steps of at most the radius. Bodies are
    numbered from 0.

    Args:
        position: positions [length], shape [particle, axis].
        radius: longest distance of neighbours [length].
        box: box that holds the particles.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    pairs = box.tree(position).query_pairs(radius, output_type="ndarray")
    count = len(position)
    links = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(count, count))
    return np.asarray(connected_components(links, directed=False)[1], np.intp)


def bodies_touch(
    position: Floats, body: NDArray[np.intp], radius: float, box: Box = UNIT_SQUARE
) -> bool:
    """Tell whether particles of two bodies lie within the radius of each other."""
    for number in range(1, int(body.max()) + 1):
        tree = box.tree(position[body == number])
        others = box.tree_points(position[body < number])
        nearest, _ = tree.query(others, distance_upper_bound=radius)
        if np.isfinite(nearest).any():
            return True
    return False


def frames_of_flight(given: Given) -> int:
    """Return how many frames on the bodies still fly freely, at most the horizon."""
    radius = given.size.task.radius
    body = label_bodies(given.last, radius, given.box)
    low = given.box.lower_walls + 1e-9
    high = given.box.upper_walls - 1e-9
    horizon = len(given.predicted_frames)
    for frames_on in range(1, horizon + 1):
        position = ballistic_positions(given, frames_on)
        on_wall = ((position <= low) | (position >= high)).any(axis=1)
        if on_wall.mean() > CONTACT_SHARE or bodies_touch(
            position, body, radius, given.box
        ):
            return frames_on - 1
    return horizon


Division = Callable[[Floats, int], list[NDArray[np.intp]]]
"""From the distances of the analogs and the number of particles to the particles that
follow each analog.
"""


def divide_evenly(distances: Floats, particle_count: int) -> list[NDArray[np.intp]]:
    """Return the particles that follow each analog, one array per analog.

    Particle i follows the analog of number i modulo the number of analogs. With fewer
    particles than analogs the last analogs have no followers.
    """
    analog_count = len(distances)
    followers = []
    for number in range(analog_count):
        followers.append(np.arange(number, particle_count, analog_count))
    return followers


@dataclass(frozen=True, eq=False)
class FollowedAnalog:
    """An analog and the particles that follow it."""

    distance: float  # of its state from ours, in units of features
    members: NDArray[np.intp]  # our particles, shape [member]
    paths: (
        Floats  # of their partners, from the compared frame on, [frame, member, axis]
    )
    offset: Floats  # from partner to particle at that frame [length], [member, axis]

    def positions(self, frames_on: int) -> Floats:
        """Return the members' positions so many frames on [length], [member, axis]."""
        path = self.paths[min(frames_on, len(self.paths) - 1)]
        return np.asarray(path + self.offset * OFFSET_FADING**frames_on)


Combination = Callable[[Given, Sequence[FollowedAnalog], int], Floats]
"""From the analogs and the frames since the comparison to the positions of all
particles [length], shape [particle, axis].
"""


def follow_own_analog(
    given: Given, analogs: Sequence[FollowedAnalog], frames_on: int
) -> Floats:
    """Return positions of which each is that in the particle's own analog."""
    position = np.empty_like(given.last)
    for analog in analogs:
        position[analog.members] = analog.positions(frames_on)
    return position


def fly_then_follow(
    given: Given,
    choice: Choice,
    *,
    library: StateLibrary | None,
    divide: Division = divide_evenly,
    combine: Combination = follow_own_analog,
    most_together: int = MOST_TOGETHER,
) -> Iterator[Floats]:
    """Yield positions of the predicted frames [length], each [particle, axis].

    Args:
        given: what is given of the scenario.
        choice: how long after contact, and how many analogs.
        library: states of train; without any the flight goes on.
        divide: which particles follow which analog.
        combine: what the analogs say together.
        most_together: particles of a material that are assigned together, at most.
    """
    horizon = len(given.predicted_frames)
    flown = horizon
    if library is not None:
        flown = min(horizon, frames_of_flight(given) + choice.lag)
    for frames_on in range(1, flown + 1):
        yield ballistic_positions(given, frames_on)
    if library is None or flown == horizon:
        return

    position = given.last
    previous = given.position[-2]
    if flown == 1:
        previous = given.last
    elif flown > 1:
        previous = ballistic_positions(given, flown - 1)
    if flown > 0:
        position = ballistic_positions(given, flown)
    velocity = given.box.displacement(previous, position)  # [length/frame]
    feature = describe_state(position, velocity, given.material)
    states = library.nearest(feature, count=choice.analogs)
    distances = np.linalg.norm(library.features[states] - feature, axis=1)
    followers = divide(distances, len(position))
    analogs = []
    for state, distance, members in zip(states, distances, followers, strict=True):
        scenario = int(library.scenarios[state])
        frame = int(library.frames[state])
        motion = read_train_scenario(given.size.path(given.root, scenario))
        mirror = mirrors_of(given.size)[library.mirrors[state]]
        partner = assign_particles(
            position[members],
            mirror.positions(motion.position[frame]),
            given.material[members],
            motion.material,
            given.box,
            most_together=most_together,
        )
        stop = frame + 1 + horizon
        paths = mirror.positions(motion.position[frame:stop, partner])
        offset = given.box.displacement(paths[0], position[members])
        analogs.append(FollowedAnalog(float(distance), members, paths, offset))
    for frames_on in range(1, horizon - flown + 1):
        yield given.inside(combine(given, analogs, frames_on))


def predict(given: Given) -> Prediction:
    """Yield positions on parabolas, and after contact those of the analogs."""
    library = state_library(given.size, given.root, np.unique(given.material).tolist())
    for position in fly_then_follow(given, choice_for(given.size), library=library):
        yield position.astype("float32")


PREDICTOR = ReferencePredictor(
    name="ballistic-analog",
    title="Ballistic, then analog",
    kind=Kind.NAIVE,
    definition="Every particle falls freely until a tenth of them touch a wall or two"
    " bodies meet; then it follows its partner in the states of train, or their mirror"
    " images, that are most like that.",
    applies=falls,
    predict=predict,
    reads_train=True,
)
