"""Try naive predictors that are none of ours, on fluid and multimaterial mini.

    python benchmarks/naive_attempts.py --root FOLDER [--split fluid] [--attempt NAME]
        [-o attempts.json]

Can anybody find a naive predictor that is much better than ``ballistic-analog``? Each
attempt below sees train only. Its parameters are those with the least mean distance of
clouds when each scenario of train is predicted from the other ones; there every fourth
particle counts. Then test is scored once, with ``cloud_distance`` of the package. The
script prints one row per attempt: the distance on train, the score on test, and the
ratio to ``ballistic-analog`` as shipped.

Predictions are formed at the frames that are measured only, so an attempt takes
seconds a scenario. ``-o`` keeps finished attempts, and a repeated run goes on.
"""

from __future__ import annotations

import argparse
import functools
import itertools
import json
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lagbench.atomic import write_atomically
from lagbench.board.reproduce import score_positions
from lagbench.data.local import resolve_root
from lagbench.data.registry import Size, load
from lagbench.data.scenario import read_scenario
from lagbench.figures.tables import markdown
from lagbench.metrics.aggregate import score
from lagbench.metrics.table import METRICS
from lagbench.metrics.transport import sliced_wasserstein2
from lagbench.references.assignment import assign_particles
from lagbench.references.ballistic_analog import frames_of_flight
from lagbench.references.extrapolation import ballistic_positions
from lagbench.references.predictor import Floats, Given, given_in
from lagbench.references.shipped import shipped
from lagbench.references.train_library import (
    FEATURE_DIRECTIONS,
    FEATURE_LEVELS,
    Mirror,
    long_enough,
    mirrors_of,
    read_train_scenario,
)
from lagbench.scoring.task import load_scored_task

METRIC = "cloud_distance"
BASELINE = "ballistic-analog"  # the best naive predictor of both, to be beaten
SPLITS = ("fluid", "multimaterial")
STRIDE = 4  # frames between the states that are compared
LAST_STATE = 2 / 3  # share of a scenario's frames within which a state may lie
THINNING = 4  # every so many particles count when parameters are chosen
MEASURED_EVERY = 10  # frames between those at which the metric is measured
CHOSEN_EVERY = 30  # the same when parameters are chosen

Choice = Mapping[str, float]
Clouds = dict[int, Floats]  # positions by frame [length], each [particle, axis]


@dataclass(frozen=True)
class State:
    """A state of train: a frame of a scenario under a mirror image."""

    scenario: int
    mirror: int
    frame: int


@dataclass(frozen=True, eq=False)
class States:
    """States of train and how they look."""

    states: tuple[State, ...]
    features: Floats  # shape [state, feature]


@dataclass(frozen=True, kw_only=True, eq=False)
class Case:
    """A scenario to predict, and what may be looked at."""

    given: Given
    frames: tuple[int, ...]  # absolute frames to predict, ascending
    without: int | None  # scenario of train that may not be looked at
    thinning: int  # every so many particles are predicted

    @property
    def material(self) -> NDArray[np.int8]:
        """Materials of the predicted particles, shape [particle]."""
        return self.given.material[:: self.thinning]

    @functools.cached_property
    def flight(self) -> int:
        """Frames until a body touches something."""
        return frames_of_flight(self.given)

    def steps(self, frame: int) -> int:
        """Return how many frames after the last given one a frame is."""
        return frame - self.given.size.task.input_frames + 1

    def flown(self, steps: int) -> tuple[Floats, Floats]:
        """Return positions and velocities after free flight, thinned."""
        given = self.given
        position = ballistic_positions(given, steps) if steps else given.last
        before = given.position[-2]
        if steps == 1:
            before = given.last
        elif steps > 1:
            before = ballistic_positions(given, steps - 1)
        velocity = given.box.displacement(before, position)
        return position[:: self.thinning], velocity[:: self.thinning]


@dataclass(frozen=True, kw_only=True)
class Attempt:
    """A naive predictor with the parameters that it may have."""

    name: str
    what: str
    predict: Callable[[Case, Choice], Clouds]
    choices: tuple[Choice, ...]


def grid(**values: Sequence[float]) -> tuple[Choice, ...]:
    """Return all combinations of some values."""
    choices = []
    for combination in itertools.product(*values.values()):
        choices.append(dict(zip(values, combination, strict=True)))
    return tuple(choices)


# --- looking things up in train


def quantiles(values: Floats) -> Floats:
    """Return the quantiles of a cloud along eight directions, one row."""
    along = FEATURE_DIRECTIONS[values.shape[1]]
    levels = np.quantile(values @ along, FEATURE_LEVELS, axis=0)
    return np.asarray(levels.ravel() / math.sqrt(levels.size))


def describe(
    position: Floats,
    velocity: Floats,
    material: NDArray[np.int8],
    kinds: Sequence[int],
    velocity_weight: float,
) -> Floats:
    """Return how the clouds of some materials look, one row of numbers."""
    parts = []
    for kind in kinds:
        members = material == kind
        share = math.sqrt(float(np.mean(members)))
        parts.append(share * quantiles(position[members]))
        parts.append(share * velocity_weight * quantiles(velocity[members]))
    return np.concatenate(parts)


class Library:
    """States of train of one data set, by the materials that they are compared in."""

    def __init__(self, size: Size, root: Path) -> None:
        self.size = size
        self.root = root
        self.mirrors: tuple[Mirror, ...] = mirrors_of(size)
        self._states: dict[tuple[object, ...], States | None] = {}

    def motion(self, state: State) -> tuple[Floats, NDArray[np.int8]]:
        """Return the mirrored positions of a scenario [length], and its materials."""
        return self._image(state.scenario, state.mirror)

    @functools.lru_cache(maxsize=64)  # noqa: B019 - one library lives as long as the run
    def _image(self, scenario: int, mirror: int) -> tuple[Floats, NDArray[np.int8]]:
        train = read_train_scenario(self.size.path(self.root, scenario))
        image = self.mirrors[mirror].positions(train.position)
        return image, train.material

    def states(
        self, kinds: tuple[int, ...], velocity_weight: float, *, is_exact: bool
    ) -> States | None:
        """Return the states of scenarios that have some materials; None without any.

        Args:
            kinds: materials that are compared.
            velocity_weight: frames over which velocities count as positions do.
            is_exact: whether the scenarios may have no other material.
        """
        key = (kinds, velocity_weight, is_exact)
        if key not in self._states:
            self._states[key] = self._build(kinds, velocity_weight, is_exact=is_exact)
        return self._states[key]

    def _build(
        self, kinds: tuple[int, ...], velocity_weight: float, *, is_exact: bool
    ) -> States | None:
        states = []
        features = []
        for scenario in long_enough(self.size):
            for mirror in range(len(self.mirrors)):
                image, material = self._image(scenario, mirror)
                present = tuple(np.unique(material).tolist())
                if is_exact and present != kinds:
                    continue
                if not set(kinds) <= set(present):
                    continue
                for frame in range(1, int(LAST_STATE * len(image)), STRIDE):
                    position = image[frame]
                    velocity = self.size.box.displacement(image[frame - 1], position)
                    states.append(State(scenario, mirror, frame))
                    features.append(
                        describe(position, velocity, material, kinds, velocity_weight)
                    )
        if not states:
            return None
        return States(tuple(states), np.array(features))


def nearest(
    states: States, feature: Floats, *, count: int, without: int | None
) -> tuple[list[State], list[float]]:
    """Return the nearest states of different mirrored scenarios, and distances."""
    distance = np.sqrt(np.sum((states.features - feature) ** 2, axis=1))
    chosen: list[State] = []
    distances = []
    seen = set()
    for number in np.argsort(distance, kind="stable").tolist():
        state = states.states[number]
        image = (state.scenario, state.mirror)
        if state.scenario == without or image in seen:
            continue
        seen.add(image)
        chosen.append(state)
        distances.append(float(distance[number]))
        if len(chosen) == count:
            break
    return chosen, distances


# --- predictors


class Predictors:
    """The attempts on one data set."""

    def __init__(self, library: Library) -> None:
        self.library = library

    def _kinds(self, case: Case) -> tuple[int, ...]:
        return tuple(np.unique(case.given.material).tolist())

    def _compare(
        self, case: Case, steps: int, choice: Choice, kinds: tuple[int, ...]
    ) -> tuple[list[State], list[float]]:
        """Return the analogs of the state after some frames of flight."""
        weight = float(choice.get("velocity_weight", 20.0))
        position, velocity = case.flown(steps)
        is_exact = kinds == self._kinds(case)
        states = self.library.states(kinds, weight, is_exact=is_exact)
        if states is None:
            return [], []
        feature = describe(position, velocity, case.material, kinds, weight)
        return nearest(
            states, feature, count=int(choice["analogs"]), without=case.without
        )

    def _paths(
        self, case: Case, state: State, position: Floats, members: NDArray[np.intp]
    ) -> Callable[[int], Floats]:
        """Return the way of the members' partners: frames on to [member, axis]."""
        image, material = self.library.motion(state)
        partner = assign_particles(
            position[members],
            image[state.frame],
            case.material[members],
            material,
            case.given.box,
        )
        offset = position[members] - image[state.frame, partner]

        def at(frames_on: int, fading: float = 0.95) -> Floats:
            frame = min(state.frame + frames_on, len(image) - 1)
            return np.asarray(image[frame, partner] + offset * fading**frames_on)

        return at

    def _after_flight(
        self,
        case: Case,
        flown: int,
        follow: Callable[[int], Floats],
    ) -> Clouds:
        """Return free flight, then what a function of the frames since then gives."""
        clouds = {}
        for frame in case.frames:
            steps = case.steps(frame)
            if steps <= flown:
                clouds[frame] = case.flown(steps)[0]
            else:
                clouds[frame] = case.given.box.inside(follow(steps - flown))
        return clouds

    def _flown(self, case: Case, choice: Choice) -> int:
        horizon = len(case.given.predicted_frames)
        return min(horizon, case.flight + int(choice.get("lag", 0)))

    def shared(self, case: Case, choice: Choice) -> Clouds:
        """Our own: the particles share the nearest states."""
        flown = self._flown(case, choice)
        position, _ = case.flown(flown)
        states, _ = self._compare(case, flown, choice, self._kinds(case))
        followers = []
        for number, state in enumerate(states):
            members = np.arange(number, len(position), len(states))
            followers.append((members, self._paths(case, state, position, members)))
        fading = float(choice.get("fading", 0.95))

        def follow(frames_on: int) -> Floats:
            cloud = position.copy()
            for members, path in followers:
                cloud[members] = path(frames_on, fading)
            return cloud

        if not followers:
            return self._after_flight(case, len(case.given.predicted_frames), follow)
        return self._after_flight(case, flown, follow)

    def weighted(self, case: Case, choice: Choice) -> Clouds:
        """Nearer states get more particles: shares fall with the distance."""
        flown = self._flown(case, choice)
        position, _ = case.flown(flown)
        states, distances = self._compare(case, flown, choice, self._kinds(case))
        if not states:
            return self._fly(case)
        weights = _weights(distances, float(choice["sharpness"]))
        edges = np.cumsum(weights)
        # low discrepancy: every stretch of particles has the same shares
        place = np.mod(np.arange(len(position)) * 0.6180339887498949, 1.0)
        owner = np.minimum(np.searchsorted(edges, place), len(states) - 1)
        followers = []
        for number, state in enumerate(states):
            members = np.flatnonzero(owner == number)
            if members.size:
                followers.append((members, self._paths(case, state, position, members)))

        def follow(frames_on: int) -> Floats:
            cloud = position.copy()
            for members, path in followers:
                cloud[members] = path(frames_on)
            return cloud

        return self._after_flight(case, flown, follow)

    def barycentre(self, case: Case, choice: Choice) -> Clouds:
        """The mean cloud of the nearest states: matched anew at every frame, then
        averaged with weights that fall with the distance.
        """
        flown = self._flown(case, choice)
        position, _ = case.flown(flown)
        states, distances = self._compare(case, flown, choice, self._kinds(case))
        if not states:
            return self._fly(case)
        weights = _weights(distances, float(choice["sharpness"]))
        everybody = np.arange(len(position))
        paths = [self._paths(case, state, position, everybody) for state in states]
        material = case.material

        def follow(frames_on: int) -> Floats:
            first = paths[0](frames_on)
            total = weights[0] * first
            for weight, path in zip(weights[1:], paths[1:], strict=True):
                other = path(frames_on)
                total = total + weight * _matched(first, other, material)
            return np.asarray(total)

        return self._after_flight(case, flown, follow)

    def per_material(self, case: Case, choice: Choice) -> Clouds:
        """Every material has analogs of its own, with any company."""
        flown = self._flown(case, choice)
        position, _ = case.flown(flown)
        followers = []
        for kind in self._kinds(case):
            ours = np.flatnonzero(case.material == kind)
            states, _ = self._compare(case, flown, choice, (kind,))
            for number, state in enumerate(states):
                members = ours[number :: len(states)]
                followers.append((members, self._paths(case, state, position, members)))
        if not followers:
            return self._fly(case)

        def follow(frames_on: int) -> Floats:
            cloud = position.copy()
            for members, path in followers:
                cloud[members] = path(frames_on)
            return cloud

        return self._after_flight(case, flown, follow)

    def windows(self, case: Case, choice: Choice) -> Clouds:
        """Analogs are sought anew after every window, from the predicted state."""
        flown = self._flown(case, choice)
        weight = 20.0
        kinds = self._kinds(case)
        states = self.library.states(kinds, weight, is_exact=True)
        if states is None:
            return self._fly(case)
        window = int(choice["window"])
        position, velocity = case.flown(flown)
        everybody = np.arange(len(position))
        start = flown
        path: Callable[[int], Floats] | None = None
        clouds = {}
        for frame in case.frames:
            steps = case.steps(frame)
            if steps <= flown:
                clouds[frame] = case.flown(steps)[0]
                continue
            while path is None or steps - start > window:
                if path is not None:
                    position = path(window)
                    velocity = position - path(window - 1)
                    start += window
                feature = describe(position, velocity, case.material, kinds, weight)
                (state, *_), _ = nearest(states, feature, count=1, without=case.without)
                path = self._paths(case, state, position, everybody)
            clouds[frame] = case.given.box.inside(path(steps - start))
        return clouds

    def from_the_start(self, case: Case, choice: Choice) -> Clouds:
        """A mixture of whole scenarios that start alike: climatology by neighbours."""
        kinds = self._kinds(case)
        weight = float(choice["velocity_weight"])
        states = self.library.states(kinds, weight, is_exact=True)
        if states is None:
            return self._fly(case)
        first_frames = [
            number for number, state in enumerate(states.states) if state.frame == 1
        ]
        starts = States(
            tuple(states.states[number] for number in first_frames),
            states.features[first_frames],
        )
        position, velocity = case.flown(0)
        feature = describe(position, velocity, case.material, kinds, weight)
        chosen, _ = nearest(
            starts, feature, count=int(choice["analogs"]), without=case.without
        )
        followers = []
        for number, state in enumerate(chosen):
            members = np.arange(number, len(position), len(chosen))
            followers.append((members, self._paths(case, state, position, members)))

        def follow(frames_on: int) -> Floats:
            cloud = position.copy()
            for members, path in followers:
                cloud[members] = path(frames_on)
            return cloud

        return self._after_flight(case, 0, follow)

    def damped(self, case: Case, choice: Choice) -> Clouds:
        """Free flight with bounces: walls return a share of the speed, and friction
        takes a share per frame.
        """
        given = case.given
        low = given.box.lower_walls
        high = given.box.upper_walls
        position, velocity = case.flown(0)
        position = position.copy()
        velocity = velocity + 0.5 * given.fall
        clouds = {}
        wanted = set(case.frames)
        for steps, frame in enumerate(given.predicted_frames, start=1):
            velocity = (velocity + given.fall * (steps > 1)) * (
                1.0 - float(choice["friction"]) * (steps > case.flight)
            )
            position = position + velocity
            for axis in range(position.shape[1]):
                below = position[:, axis] < low[axis]
                above = position[:, axis] > high[axis]
                velocity[below | above, axis] *= -float(choice["bounce"])
            position = np.clip(position, low, high)
            if frame in wanted:
                clouds[frame] = position.copy()
        return clouds

    def to_the_pool(self, case: Case, choice: Choice) -> Clouds:
        """Our own prediction, drawn towards a flat pool on the floor."""
        clouds = self.shared(case, choice)
        pool = _pool(case)
        for frame in case.frames:
            since = max(0, case.steps(frame) - case.flight)
            share = float(choice["most"]) * -math.expm1(-since / float(choice["time"]))
            cloud = clouds[frame]
            target = _matched(cloud, pool, case.material)
            clouds[frame] = (1.0 - share) * cloud + share * target
        return clouds

    def with_climatology(self, case: Case, choice: Choice) -> Clouds:
        """Our own prediction, drawn towards the mean cloud of train at that frame."""
        clouds = self.shared(case, choice)
        images = []
        for scenario in long_enough(case.given.size):
            if scenario == case.without:
                continue
            for mirror in range(len(self.library.mirrors)):
                images.append(State(scenario, mirror, 0))
        count = len(case.material)
        for frame in case.frames:
            climate = np.empty((count, case.given.box.dimension))
            for kind in self._kinds(case):
                ours = np.flatnonzero(case.material == kind)
                pools = []
                for state in images:
                    image, material = self.library.motion(state)
                    if (material == kind).any():
                        pools.append(image[frame][material == kind])
                pool = np.concatenate(pools)
                climate[ours] = pool[np.arange(len(ours)) * len(pool) // len(ours)]
            since = max(0, case.steps(frame) - case.flight)
            share = float(choice["most"]) * -math.expm1(-since / float(choice["time"]))
            cloud = clouds[frame]
            target = _matched(cloud, climate, case.material)
            clouds[frame] = (1.0 - share) * cloud + share * target
        return clouds

    def _fly(self, case: Case) -> Clouds:
        return {frame: case.flown(case.steps(frame))[0] for frame in case.frames}


def _weights(distances: Sequence[float], sharpness: float) -> Floats:
    """Return weights that fall with the distance over the least one, sum 1."""
    relative = np.array(distances) / max(distances[0], 1e-12)
    weights = relative**-sharpness
    return np.asarray(weights / weights.sum())


def _matched(here: Floats, there: Floats, material: NDArray[np.int8]) -> Floats:
    """Return the other cloud in the order in which it lies nearest to this one."""
    return np.asarray(there[assign_particles(here, there, material, material)])


def _pool(case: Case) -> Floats:
    """Return particles spread evenly over a flat pool that has the given area."""
    box = case.given.box
    low = box.lower_walls
    high = box.upper_walls
    width = high[0] - low[0]
    height = case.given.area / width
    count = len(case.material)
    columns = max(1, round(math.sqrt(count * width / height)))
    number = np.arange(count)
    rows = math.ceil(count / columns)
    x = low[0] + width * (number % columns + 0.5) / columns
    y = low[1] + height * (number // columns + 0.5) / rows
    return np.stack([x, y], axis=1)


def attempts_on(library: Library) -> tuple[Attempt, ...]:
    """Return the attempts on a data set; the first is our own, as a check."""
    own = Predictors(library)
    return (
        Attempt(
            name="shipped",
            what="ballistic-analog as shipped, every fourth state",
            predict=own.shared,
            choices=grid(lag=(0, 5, 10, 15), analogs=(1, 2, 4)),
        ),
        Attempt(
            name="offset",
            what="the same; the offset from the partner fades at other rates",
            predict=own.shared,
            choices=grid(lag=(0, 10), analogs=(1, 2), fading=(0.8, 0.9, 0.98, 1.0)),
        ),
        Attempt(
            name="velocities",
            what="the same; velocities count less or more when states are compared",
            predict=own.shared,
            choices=grid(
                lag=(0, 10), analogs=(1, 2), velocity_weight=(0.0, 5.0, 10.0, 40.0)
            ),
        ),
        Attempt(
            name="weighted",
            what="mixture of k analogs; nearer ones get more particles",
            predict=own.weighted,
            choices=grid(lag=(0, 10), analogs=(2, 4, 8), sharpness=(1.0, 3.0)),
        ),
        Attempt(
            name="barycentre",
            what="Wasserstein mean of k analogs, matched anew at every frame",
            predict=own.barycentre,
            choices=grid(lag=(0, 10), analogs=(2, 3, 5), sharpness=(0.0, 2.0)),
        ),
        Attempt(
            name="per-material",
            what="every material has analogs of its own, with any company",
            predict=own.per_material,
            choices=grid(lag=(0, 5, 10, 15), analogs=(1, 2, 4)),
        ),
        Attempt(
            name="windows",
            what="one analog per window of time, sought anew from the prediction",
            predict=own.windows,
            choices=grid(lag=(0, 10), window=(20, 40, 80)),
        ),
        Attempt(
            name="from-the-start",
            what="mixture of the k scenarios that start most alike",
            predict=own.from_the_start,
            choices=grid(analogs=(1, 2, 4, 8), velocity_weight=(0.0, 20.0, 60.0)),
        ),
        Attempt(
            name="damped",
            what="free flight with bounces and friction",
            predict=own.damped,
            choices=grid(bounce=(0.0, 0.3, 0.6), friction=(0.0, 0.02, 0.1)),
        ),
        Attempt(
            name="pool",
            what="ballistic-analog, drawn towards a flat pool",
            predict=own.to_the_pool,
            choices=grid(
                lag=(0, 10), analogs=(2,), most=(0.2, 0.5), time=(50.0, 200.0)
            ),
        ),
        Attempt(
            name="with-climatology",
            what="ballistic-analog, drawn towards the mean cloud of train",
            predict=own.with_climatology,
            choices=grid(
                lag=(0, 10), analogs=(2,), most=(0.2, 0.5), time=(50.0, 200.0)
            ),
        ),
    )


# --- choosing and scoring


def active_frames(path: Path) -> int | None:
    """Return the predicted frames until a scenario rests; None where it says none."""
    with read_scenario(path) as file:
        stated = file.header.parameters.get("active_frames")
    return None if stated is None else int(str(stated))


def measured_frames(size: Size, every: int, active: int | None) -> tuple[int, ...]:
    """Return the absolute frames at which clouds are compared."""
    first = size.task.input_frames
    last = size.task.horizon if active is None else min(active, size.task.horizon)
    frames = range(first + MEASURED_EVERY - 1, first + last, every)
    return tuple(frames) or (first + last - 1,)


def cases_of_train(size: Size, root: Path) -> dict[int, Case]:
    """Return the scenarios of train, each to be predicted from the other ones."""
    cases = {}
    for scenario in long_enough(size):
        path = size.path(root, scenario)
        with read_scenario(path) as file:
            given = given_in(file, size, root)
        cases[scenario] = Case(
            given=given,
            frames=measured_frames(size, CHOSEN_EVERY, active_frames(path)),
            without=scenario,
            thinning=THINNING,
        )
    return cases


def error_on_train(
    cases: Mapping[int, Case], library: Library, attempt: Attempt, choice: Choice
) -> float:
    """Return the mean distance of clouds when scenarios of train predict each other."""
    errors = []
    for scenario, case in cases.items():
        clouds = attempt.predict(case, choice)
        truth, _ = library.motion(State(scenario, 0, 0))
        for_frames = []
        for frame in case.frames:
            true_cloud = truth[frame][::THINNING]
            error = 0.0
            for kind in np.unique(case.material):
                members = case.material == kind
                distance = sliced_wasserstein2(
                    clouds[frame][members], true_cloud[members]
                )
                error += float(np.mean(members)) * distance
            for_frames.append(error)
        errors.append(float(np.mean(for_frames)))
    return float(np.mean(errors))


def score_on_test(size: Size, root: Path, attempt: Attempt, choice: Choice) -> float:
    """Return the ranking metric on test."""
    task = load_scored_task(size, root, is_hashed=True)
    frames = measured_frames(size, MEASURED_EVERY, None)
    tallies = {}
    for scenario in task.scenarios:
        with task.opened(scenario) as truth:
            given = given_in(truth.file, size, root)
        case = Case(given=given, frames=frames, without=None, thinning=1)
        clouds = attempt.predict(case, choice)
        horizon = range(
            size.task.input_frames, size.task.input_frames + size.task.horizon
        )
        position = np.empty((len(horizon), *given.last.shape), np.float32)
        for row, frame in enumerate(horizon):
            # the metric is not measured at the frames between
            later = [one for one in frames if one >= frame] or [frames[-1]]
            position[row] = given.box.inside(clouds[later[0]])
        tallies[scenario] = score_positions(task, scenario, position, METRIC)
    result = score(METRICS[METRIC], tallies)
    if result is None:
        raise ValueError(f"{size.split}: no value of {METRIC}")
    return result.mean


def baseline_score(size: Size) -> float:
    """Return the shipped score on test of the predictor that is to be beaten."""
    references = shipped(size)
    if references is None:
        raise ValueError(f"{size.split} {size.name}: nothing was shipped")
    return references[BASELINE].scores[METRIC].mean


def run(
    size: Size,
    root: Path,
    attempt: Attempt,
    *,
    cases: Mapping[int, Case],
    library: Library,
) -> dict[str, object]:
    """Return the chosen parameters of an attempt and its errors."""
    errors = {}
    for number, choice in enumerate(attempt.choices):
        errors[number] = error_on_train(cases, library, attempt, choice)
    number = min(errors, key=lambda number: errors[number])
    choice = attempt.choices[number]
    return {
        "what": attempt.what,
        "chosen": dict(choice),
        "choices": len(attempt.choices),
        "train": errors[number],
        "test": score_on_test(size, root, attempt, choice),
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the attempts that are not kept yet, and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--root", type=Path)
    parser.add_argument("--split", choices=SPLITS, action="append")
    parser.add_argument("--attempt", action="append", help="only these; all by default")
    parser.add_argument("--output", "-o", type=Path, help="keeps finished attempts")
    options = parser.parse_args(arguments)
    root = resolve_root(options.root)
    kept: dict[str, dict[str, dict[str, object]]] = {}
    if options.output and options.output.is_file():
        kept = json.loads(options.output.read_text())

    rows = []
    for split in options.split or SPLITS:
        size = load().size(split, "mini")
        library = Library(size, root)
        cases = cases_of_train(size, root)
        baseline = baseline_score(size)
        results = kept.setdefault(split, {})
        for attempt in attempts_on(library):
            if options.attempt and attempt.name not in options.attempt:
                continue
            if attempt.name not in results:
                results[attempt.name] = run(
                    size, root, attempt, cases=cases, library=library
                )
                sys.stderr.write(f"{split} {attempt.name}: {results[attempt.name]}\n")
                if options.output:
                    data = json.dumps(kept, indent=1).encode()
                    write_atomically(options.output, data, option="--output")
            rows.append(_row(split, attempt.name, results[attempt.name], baseline))
    heads = ("data set", "attempt", "what", "chosen on train", "train", "test", "ratio")
    sys.stdout.write(f"{markdown(heads, rows)}\n")
    return 0


def _row(
    split: str, attempt: str, result: Mapping[str, object], baseline: float
) -> tuple[str, ...]:
    chosen = result["chosen"]
    words = []
    if isinstance(chosen, dict):
        for key, value in chosen.items():
            words.append(f"{key} {value:g}")
    test = float(str(result["test"]))
    return (
        f"{split} mini",
        attempt,
        str(result["what"]),
        ", ".join(words),
        f"{float(str(result['train'])):.4f}",
        f"{test:.4f}",
        f"{test / baseline:.2f}",
    )


if __name__ == "__main__":
    raise SystemExit(main())
