"""Try naive predictors that are none of ours, on free surfaces.

    python benchmarks/naive_attempts.py --root FOLDER [--split fluid] [--size full]
        [--attempt NAME] [--train-only] [-o attempts.json]

Can anybody find a naive predictor that is much better than ``ballistic-analog``? Each
attempt below sees train only. Its parameters are those with the least mean distance of
clouds when each scenario of train is predicted from the other ones; there every fourth
particle counts, in three dimensions every sixteenth. Then test is scored once, with
``cloud_distance`` of the package. The script prints one row per attempt: the distance
on train, the score on test, and the ratio to ``ballistic-analog`` as shipped.

In three dimensions only ``ballistic-analog`` and ``barycentre`` are tried. With
``--train-only`` the parameters are chosen, and test is neither scored nor needed.

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
from lagbench.errors import LagbenchError, UsageError, suggest_name
from lagbench.figures.tables import markdown
from lagbench.metrics.aggregate import score
from lagbench.metrics.frame import sliced_wasserstein2
from lagbench.metrics.table import METRICS
from lagbench.references.analog_barycentre import MATCHED_TOGETHER
from lagbench.references.assignment import MOST_TOGETHER, assign_particles
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
SPLITS = ("fluid", "multimaterial", "fluid-3d", "multimaterial-3d")
SIZES = ("mini", "full")
STRIDE = 4  # frames between the states that are compared
STATE_SHARE = 2 / 3  # share of a scenario's frames within which a state may lie
# Every so many particles count when parameters are chosen, by dimension.
THINNING = {2: 4, 3: 16}
MEASURED_EVERY = 10  # frames between those at which the metric is measured
CHOSEN_EVERY = 30  # the same when parameters are chosen
GOLDEN_RATIO = 0.6180339887498949  # the smaller one; its multiples spread evenly

Choice = Mapping[str, float]
Clouds = dict[int, Floats]  # positions by frame [length], each [particle, axis]
Kinds = tuple[int, ...]  # numbers of materials
Materials = NDArray[np.int8]  # material of each particle, shape [particle]
PartnerPath = Callable[..., Floats]  # from frames on to positions [member, axis]


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
class AnalogCase:
    """A scenario to predict, and what may be looked at."""

    given: Given
    frames: tuple[int, ...]  # absolute frames to predict, ascending
    without: int | None  # scenario of train that may not be looked at
    thinning: int  # every so many particles are predicted

    @property
    def material(self) -> Materials:
        """Materials of the predicted particles, shape [particle]."""
        return self.given.material[:: self.thinning]

    @functools.cached_property
    def flight(self) -> int:
        """Frames until a body touches something."""
        return frames_of_flight(self.given)

    def steps(self, frame: int) -> int:
        """Return how many frames after the last given one a frame is."""
        return frame - self.given.size.task.input_frames + 1

    def fly(self, steps: int) -> tuple[Floats, Floats]:
        """Return positions [length] and velocities [length/frame] in free flight.

        They are those of every ``thinning``-th particle, so many frames after the last
        given one.
        """
        given = self.given
        position = given.last
        before = given.position[-2]
        if steps >= 1:
            position = ballistic_positions(given, steps)
            before = given.last
        if steps > 1:
            before = ballistic_positions(given, steps - 1)
        velocity = given.box.displacement(before, position)
        counted = slice(None, None, self.thinning)
        return position[counted], velocity[counted]


@dataclass(frozen=True, kw_only=True)
class Attempt:
    """A naive predictor with the parameters that it may have."""

    name: str
    what: str
    predict: Callable[[AnalogCase, Choice], Clouds]
    choices: tuple[Choice, ...]


def grid(**values: Sequence[float]) -> tuple[Choice, ...]:
    """Return all combinations of some values."""
    names = tuple(values)
    choices = []
    for combination in itertools.product(*values.values()):
        pairs = zip(names, combination, strict=True)
        choice = dict(pairs)
        choices.append(choice)
    return tuple(choices)


# --- looking things up in train


def quantiles(values: Floats) -> Floats:
    """Return the quantiles of a cloud along eight directions, one row."""
    dimension = values.shape[1]
    directions = FEATURE_DIRECTIONS[dimension]
    projections = values @ directions
    levels = np.quantile(projections, FEATURE_LEVELS, axis=0)
    scaled = levels.ravel() / math.sqrt(levels.size)
    return np.asarray(scaled)


def describe(
    position: Floats,
    velocity: Floats,
    material: Materials,
    kinds: Sequence[int],
    velocity_weight: float,
) -> Floats:
    """Return how the clouds of some materials look, one row of numbers."""
    parts = []
    for kind in kinds:
        members = material == kind
        share = float(np.mean(members))
        weight = math.sqrt(share)
        position_levels = quantiles(position[members])
        velocity_levels = quantiles(velocity[members])
        weight_of_velocity = weight * velocity_weight
        parts.append(weight * position_levels)
        parts.append(weight_of_velocity * velocity_levels)
    return np.concatenate(parts)


class Library:
    """States of train of one data set, by the materials that they are compared in."""

    def __init__(self, size: Size, root: Path) -> None:
        self.size = size
        self.root = root
        self.mirrors: tuple[Mirror, ...] = mirrors_of(size)
        self._states: dict[tuple[object, ...], States | None] = {}

    def motion(self, state: State) -> tuple[Floats, Materials]:
        """Return the mirrored positions of a scenario [length], and its materials."""
        return self._image(state.scenario, state.mirror)

    @functools.lru_cache(maxsize=128)  # noqa: B019 - one library lives as long as the run
    def _image(self, scenario: int, mirror: int) -> tuple[Floats, Materials]:
        path = self.size.path(self.root, scenario)
        train = read_train_scenario(path)
        reflection = self.mirrors[mirror]
        image = reflection.positions(train.position.astype(np.float64))
        return image, train.material

    def states(
        self,
        kinds: Kinds,
        velocity_weight: float,
        *,
        is_exact: bool,
    ) -> States | None:
        """Return the states of scenarios that have some materials; None without any.

        Args:
            kinds: materials that are compared.
            velocity_weight: frames over which velocities count as positions do.
            is_exact: whether the scenarios may have no other material.
        """
        key = (kinds, velocity_weight, is_exact)
        if key not in self._states:
            states = self._build(kinds, velocity_weight, is_exact=is_exact)
            self._states[key] = states
        return self._states[key]

    def _build(
        self,
        kinds: Kinds,
        velocity_weight: float,
        *,
        is_exact: bool,
    ) -> States | None:
        box = self.size.box
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

                end = int(STATE_SHARE * len(image))
                for frame in range(1, end, STRIDE):
                    before = image[frame - 1]
                    position = image[frame]
                    velocity = box.displacement(before, position)
                    feature = describe(
                        position,
                        velocity,
                        material,
                        kinds,
                        velocity_weight,
                    )
                    features.append(feature)
                    state = State(scenario, mirror, frame)
                    states.append(state)
        if not states:
            return None
        return States(tuple(states), np.array(features))


def find_nearest_states(
    states: States,
    feature: Floats,
    *,
    count: int,
    without: int | None,
) -> tuple[list[State], list[float]]:
    """Return the nearest states and their distances.

    Of each scenario and mirror image only the nearest state counts.
    """
    difference = states.features - feature
    square = np.sum(difference**2, axis=1)
    distance = np.sqrt(square)
    nearest_first = np.argsort(distance, kind="stable")

    chosen: list[State] = []
    distances = []
    chosen_images = set()
    for number in nearest_first.tolist():
        state = states.states[number]
        if state.scenario == without:
            continue
        image = (state.scenario, state.mirror)
        if image in chosen_images:
            continue
        chosen_images.add(image)
        chosen.append(state)
        distances.append(float(distance[number]))
        if len(chosen) == count:
            break
    return chosen, distances


# --- predictors


class Predictors:
    """The attempts on one data set.

    ``most_together`` particles of a material are matched to partners together, at most.
    """

    def __init__(self, library: Library, *, most_together: int = MOST_TOGETHER) -> None:
        self.library = library
        self.most_together = most_together

    def _kinds(self, case: AnalogCase) -> Kinds:
        kinds = np.unique(case.given.material)
        return tuple(kinds.tolist())

    def _compare(
        self,
        case: AnalogCase,
        steps: int,
        choice: Choice,
        kinds: Kinds,
    ) -> tuple[list[State], list[float]]:
        """Return the analogs of the state after some frames of flight."""
        weight = float(choice.get("velocity_weight", 20.0))
        position, velocity = case.fly(steps)
        is_exact = kinds == self._kinds(case)
        states = self.library.states(kinds, weight, is_exact=is_exact)
        if states is None:
            return [], []
        feature = describe(position, velocity, case.material, kinds, weight)
        count = int(choice["analogs"])
        return find_nearest_states(states, feature, count=count, without=case.without)

    def _paths(
        self,
        case: AnalogCase,
        state: State,
        position: Floats,
        members: NDArray[np.intp],
    ) -> PartnerPath:
        """Return the way of the members' partners."""
        image, material = self.library.motion(state)
        own_position = position[members]
        own_material = case.material[members]
        image_position = image[state.frame]
        partner = assign_particles(
            own_position,
            image_position,
            own_material,
            material,
            case.given.box,
            most_together=self.most_together,
        )
        offset = own_position - image_position[partner]
        last_frame = len(image) - 1

        def at(frames_on: int, fading: float = 0.95) -> Floats:
            frame = min(state.frame + frames_on, last_frame)
            partner_position = image[frame, partner]
            share = fading**frames_on
            return np.asarray(partner_position + offset * share)

        return at

    def _after_flight(
        self,
        case: AnalogCase,
        flight_steps: int,
        follow: PartnerPath,
    ) -> Clouds:
        """Return free flight, then what a function of the frames since then gives."""
        box = case.given.box
        clouds = {}
        for frame in case.frames:
            steps = case.steps(frame)
            if steps <= flight_steps:
                position, _ = case.fly(steps)
                clouds[frame] = position
                continue
            position = follow(steps - flight_steps)
            clouds[frame] = box.inside(position)
        return clouds

    def _flight_steps(self, case: AnalogCase, choice: Choice) -> int:
        """Return the frames of free flight: until the first contact, and ``lag`` more.

        Analogs take over then.
        """
        horizon = len(case.given.predicted_frames)
        lag = int(choice.get("lag", 0))
        return min(horizon, case.flight + lag)

    def shared(self, case: AnalogCase, choice: Choice) -> Clouds:
        """Our own: the particles share the nearest states."""
        flight_steps = self._flight_steps(case, choice)
        position, _ = case.fly(flight_steps)
        kinds = self._kinds(case)
        states, _ = self._compare(case, flight_steps, choice, kinds)
        followers = []
        everybody = np.arange(len(position))
        for number, state in enumerate(states):
            members = everybody[number :: len(states)]
            path = self._paths(case, state, position, members)
            followers.append((members, path))
        fading = float(choice.get("fading", 0.95))

        def follow(frames_on: int) -> Floats:
            cloud = position.copy()
            for members, path in followers:
                cloud[members] = path(frames_on, fading)
            return cloud

        if not followers:
            return self._fly(case)
        return self._after_flight(case, flight_steps, follow)

    def weighted(self, case: AnalogCase, choice: Choice) -> Clouds:
        """Nearer states get more particles: shares fall with the distance."""
        flight_steps = self._flight_steps(case, choice)
        position, _ = case.fly(flight_steps)
        kinds = self._kinds(case)
        states, distances = self._compare(case, flight_steps, choice, kinds)
        if not states:
            return self._fly(case)
        sharpness = float(choice["sharpness"])
        weights = _weights(distances, sharpness)
        upper_ends = np.cumsum(weights)
        # low discrepancy: every stretch of particles has the same shares
        numbers = np.arange(len(position))
        multiples = numbers * GOLDEN_RATIO
        place = np.mod(multiples, 1.0)
        owner = np.searchsorted(upper_ends, place)
        owner = np.minimum(owner, len(states) - 1)
        followers = []
        for number, state in enumerate(states):
            members = np.flatnonzero(owner == number)
            if members.size:
                path = self._paths(case, state, position, members)
                followers.append((members, path))

        def follow(frames_on: int) -> Floats:
            cloud = position.copy()
            for members, path in followers:
                cloud[members] = path(frames_on)
            return cloud

        return self._after_flight(case, flight_steps, follow)

    def barycentre(self, case: AnalogCase, choice: Choice) -> Clouds:
        """The mean cloud of the nearest states: matched anew at every frame, then
        averaged with weights that fall with the distance.
        """
        flight_steps = self._flight_steps(case, choice)
        position, _ = case.fly(flight_steps)
        kinds = self._kinds(case)
        states, distances = self._compare(case, flight_steps, choice, kinds)
        if not states:
            return self._fly(case)
        sharpness = float(choice["sharpness"])
        weights = _weights(distances, sharpness)
        everybody = np.arange(len(position))
        paths = []
        for state in states:
            path = self._paths(case, state, position, everybody)
            paths.append(path)
        first_path, *other_paths = paths
        first_weight, *other_weights = weights

        def follow(frames_on: int) -> Floats:
            first = first_path(frames_on)
            total = first_weight * first
            for weight, path in zip(other_weights, other_paths, strict=True):
                other = path(frames_on)
                matched = _matched(first, other, case)
                total = total + weight * matched
            return np.asarray(total)

        return self._after_flight(case, flight_steps, follow)

    def per_material(self, case: AnalogCase, choice: Choice) -> Clouds:
        """Every material has analogs of its own.

        They may have other materials too, unless the case has one material only.
        """
        flight_steps = self._flight_steps(case, choice)
        position, _ = case.fly(flight_steps)
        followers = []
        for kind in self._kinds(case):
            kinds = (kind,)
            of_kind = np.flatnonzero(case.material == kind)
            states, _ = self._compare(case, flight_steps, choice, kinds)
            for number, state in enumerate(states):
                members = of_kind[number :: len(states)]
                path = self._paths(case, state, position, members)
                followers.append((members, path))
        if not followers:
            return self._fly(case)

        def follow(frames_on: int) -> Floats:
            cloud = position.copy()
            for members, path in followers:
                cloud[members] = path(frames_on)
            return cloud

        return self._after_flight(case, flight_steps, follow)

    def windows(self, case: AnalogCase, choice: Choice) -> Clouds:
        """Analogs are sought anew after every window, from the predicted state."""
        flight_steps = self._flight_steps(case, choice)
        weight = 20.0
        kinds = self._kinds(case)
        states = self.library.states(kinds, weight, is_exact=True)
        if states is None:
            return self._fly(case)
        window = int(choice["window"])
        position, velocity = case.fly(flight_steps)
        everybody = np.arange(len(position))
        start = flight_steps
        path: PartnerPath | None = None
        box = case.given.box
        clouds = {}
        for frame in case.frames:
            steps = case.steps(frame)
            if steps <= flight_steps:
                clouds[frame], _ = case.fly(steps)
                continue
            while path is None or steps - start > window:
                if path is not None:
                    before = path(window - 1)
                    position = path(window)
                    velocity = position - before
                    start += window
                feature = describe(position, velocity, case.material, kinds, weight)
                analogs, _ = find_nearest_states(
                    states,
                    feature,
                    count=1,
                    without=case.without,
                )
                if not analogs:
                    return self._fly(case)
                path = self._paths(case, analogs[0], position, everybody)
            cloud = path(steps - start)
            clouds[frame] = box.inside(cloud)
        return clouds

    def from_the_start(self, case: AnalogCase, choice: Choice) -> Clouds:
        """A mixture of whole scenarios that start alike: climatology by neighbours."""
        kinds = self._kinds(case)
        weight = float(choice["velocity_weight"])
        states = self.library.states(kinds, weight, is_exact=True)
        if states is None:
            return self._fly(case)
        first_states = []
        rows = []
        for row, state in enumerate(states.states):
            if state.frame == 1:  # frame 0 has no velocity yet
                first_states.append(state)
                rows.append(row)
        starts = States(tuple(first_states), states.features[rows])

        position, velocity = case.fly(0)
        feature = describe(position, velocity, case.material, kinds, weight)
        count = int(choice["analogs"])
        chosen, _ = find_nearest_states(
            starts, feature, count=count, without=case.without
        )
        if not chosen:
            return self._fly(case)
        followers = []
        everybody = np.arange(len(position))
        for number, state in enumerate(chosen):
            members = everybody[number :: len(chosen)]
            path = self._paths(case, state, position, members)
            followers.append((members, path))

        def follow(frames_on: int) -> Floats:
            cloud = position.copy()
            for members, path in followers:
                cloud[members] = path(frames_on)
            return cloud

        return self._after_flight(case, 0, follow)

    def damped(self, case: AnalogCase, choice: Choice) -> Clouds:
        """Free flight with bounces: walls return a share of the speed.

        After the first contact friction takes a share of the speed in each frame.
        """
        given = case.given
        low = given.box.lower_walls
        high = given.box.upper_walls
        friction = float(choice["friction"])
        bounce = float(choice["bounce"])
        position, velocity = case.fly(0)
        position = position.copy()
        clouds = {}
        wanted = set(case.frames)
        for steps, frame in enumerate(given.predicted_frames, start=1):
            has_touched = steps > case.flight
            velocity = velocity + given.fall
            velocity = velocity * (1.0 - friction * has_touched)
            position = position + velocity
            is_beyond = (position < low) | (position > high)
            velocity[is_beyond] *= -bounce
            position = np.clip(position, low, high)
            if frame in wanted:
                clouds[frame] = position.copy()
        return clouds

    def to_the_pool(self, case: AnalogCase, choice: Choice) -> Clouds:
        """Our own prediction, drawn towards a flat pool on the floor."""
        clouds = self.shared(case, choice)
        pool = _pool(case)
        for frame in case.frames:
            share = _share_since_flight(case, frame, choice)
            cloud = clouds[frame]
            target = _matched(cloud, pool, case)
            clouds[frame] = (1.0 - share) * cloud + share * target
        return clouds

    def with_climatology(self, case: AnalogCase, choice: Choice) -> Clouds:
        """Our own prediction, drawn towards the clouds of train at that frame."""
        clouds = self.shared(case, choice)
        images = []
        for scenario in long_enough(case.given.size):
            if scenario == case.without:
                continue
            for mirror in range(len(self.library.mirrors)):
                image = State(scenario, mirror, 0)
                images.append(image)
        if not images:
            return clouds
        for frame in case.frames:
            climate = self._pooled_cloud(case, frame, images)
            share = _share_since_flight(case, frame, choice)
            cloud = clouds[frame]
            target = _matched(cloud, climate, case)
            clouds[frame] = (1.0 - share) * cloud + share * target
        return clouds

    def _pooled_cloud(
        self, case: AnalogCase, frame: int, images: Sequence[State]
    ) -> Floats:
        """Return particles spread over the clouds of train at a frame.

        The shape is [particle, axis]; materials are those of the case.
        """
        particles = len(case.material)
        dimension = case.given.box.dimension
        climate = np.empty((particles, dimension))
        for kind in self._kinds(case):
            clouds = []
            for state in images:
                image, material = self.library.motion(state)
                is_kind = material == kind
                if is_kind.any():
                    position = image[frame]
                    clouds.append(position[is_kind])
            train_particles = np.concatenate(clouds)

            members = np.flatnonzero(case.material == kind)
            count = len(members)
            numbers = np.arange(count)
            drawn = numbers * len(train_particles) // count
            climate[members] = train_particles[drawn]
        return climate

    def _fly(self, case: AnalogCase) -> Clouds:
        """Return free flight in every frame."""
        clouds = {}
        for frame in case.frames:
            steps = case.steps(frame)
            clouds[frame], _ = case.fly(steps)
        return clouds


def _share_since_flight(case: AnalogCase, frame: int, choice: Choice) -> float:
    """Return how far a prediction is drawn to a target: more with time since flight."""
    most = float(choice["most"])
    time_scale = float(choice["time"])  # [frame]
    steps = case.steps(frame)
    frames_since = max(0, steps - case.flight)
    share = -math.expm1(-frames_since / time_scale)
    return most * share


def _weights(distances: Sequence[float], sharpness: float) -> Floats:
    """Return weights that fall with the distance over the least one, sum 1."""
    least = max(distances[0], 1e-12)
    relative = np.array(distances) / least
    weights = relative**-sharpness
    total = weights.sum()
    return np.asarray(weights / total)


def _matched(here: Floats, there: Floats, case: AnalogCase) -> Floats:
    """Return the other cloud in the order in which it lies nearest to this one."""
    partner = assign_particles(
        here,
        there,
        case.material,
        case.material,
        case.given.box,
        most_together=MATCHED_TOGETHER,
    )
    return np.asarray(there[partner])


def _pool(case: AnalogCase) -> Floats:
    """Return particles spread evenly over a flat pool that has the given area."""
    box = case.given.box
    low = box.lower_walls
    high = box.upper_walls
    width = high[0] - low[0]
    height = case.given.area / width
    count = len(case.material)
    even_columns = math.sqrt(count * width / height)
    columns = max(1, round(even_columns))
    rows = math.ceil(count / columns)

    number = np.arange(count)
    column = number % columns
    row = number // columns
    from_left = width * (column + 0.5) / columns
    from_floor = height * (row + 0.5) / rows
    x = low[0] + from_left
    y = low[1] + from_floor
    return np.stack([x, y], axis=1)


def attempts_on(library: Library) -> tuple[Attempt, ...]:
    """Return the attempts on a data set; the first is our own, as a check.

    In three dimensions there are two of them: the others did not help in the plane.
    """
    predictors = Predictors(library)
    barycentre = _barycentre(library)
    if library.size.box.dimension == 3:
        return (_shipped_predictor(predictors), barycentre)
    return (
        *_variants_of_ballistic_analog(predictors),
        *_attempts_with_other_analogs(predictors),
        barycentre,
        *_attempts_that_come_to_rest(predictors),
    )


def _shipped_predictor(predictors: Predictors) -> Attempt:
    return Attempt(
        name="shipped",
        what="the method `ballistic-analog`, with every fourth state",
        predict=predictors.shared,
        choices=grid(lag=(0, 5, 10, 15), analogs=(1, 2, 4)),
    )


def _barycentre(library: Library) -> Attempt:
    """Return the attempt that matches clouds anew at each measured frame.

    That takes long, so fewer particles are matched together than in other attempts.
    """
    predictors = Predictors(library, most_together=MATCHED_TOGETHER)
    return Attempt(
        name="barycentre",
        what="Wasserstein mean of k analogs, matched again at each measured frame",
        predict=predictors.barycentre,
        choices=grid(
            lag=(0, 10),
            analogs=(2, 3, 5),
            sharpness=(0.0, 2.0),
        ),
    )


def _variants_of_ballistic_analog(predictors: Predictors) -> tuple[Attempt, ...]:
    """Return ballistic-analog as it is shipped, and with other settings."""
    return (
        _shipped_predictor(predictors),
        Attempt(
            name="offset",
            what="the same, with other factors for the offset from the partner",
            predict=predictors.shared,
            choices=grid(
                lag=(0, 10),
                analogs=(1, 2),
                fading=(0.8, 0.9, 0.98, 1.0),
            ),
        ),
        Attempt(
            name="velocities",
            what="the same, with other weights of the velocities in the comparison",
            predict=predictors.shared,
            choices=grid(
                lag=(0, 10),
                analogs=(1, 2),
                velocity_weight=(0.0, 5.0, 10.0, 40.0),
            ),
        ),
    )


def _attempts_with_other_analogs(predictors: Predictors) -> tuple[Attempt, ...]:
    """Return attempts that choose or mix analogs in another way."""
    return (
        Attempt(
            name="weighted",
            what="mixture of k analogs; a nearer analog gets more particles",
            predict=predictors.weighted,
            choices=grid(
                lag=(0, 10),
                analogs=(2, 4, 8),
                sharpness=(1.0, 3.0),
            ),
        ),
        Attempt(
            name="per-material",
            what="separate analogs for each material",
            predict=predictors.per_material,
            choices=grid(lag=(0, 5, 10, 15), analogs=(1, 2, 4)),
        ),
        Attempt(
            name="windows",
            what="a new analog for each window of frames, found from the prediction",
            predict=predictors.windows,
            choices=grid(lag=(0, 10), window=(20, 40, 80)),
        ),
        Attempt(
            name="from-the-start",
            what="mixture of the k scenarios or mirror images with the most similar "
            "start",
            predict=predictors.from_the_start,
            choices=grid(
                analogs=(1, 2, 4, 8),
                velocity_weight=(0.0, 20.0, 60.0),
            ),
        ),
    )


def _attempts_that_come_to_rest(predictors: Predictors) -> tuple[Attempt, ...]:
    """Return attempts with friction, or drawn towards a cloud at rest."""
    return (
        Attempt(
            name="damped",
            what="free flight with bounces and friction",
            predict=predictors.damped,
            choices=grid(bounce=(0.0, 0.3, 0.6), friction=(0.0, 0.02, 0.1)),
        ),
        Attempt(
            name="pool",
            what="ballistic-analog, drawn towards a flat pool on the floor",
            predict=predictors.to_the_pool,
            choices=grid(
                lag=(0, 10),
                analogs=(2,),
                most=(0.2, 0.5),
                time=(50.0, 200.0),
            ),
        ),
        Attempt(
            name="with-climatology",
            what="ballistic-analog, drawn towards particles of all clouds of train",
            predict=predictors.with_climatology,
            choices=grid(
                lag=(0, 10),
                analogs=(2,),
                most=(0.2, 0.5),
                time=(50.0, 200.0),
            ),
        ),
    )


# --- choosing and scoring


def active_frames(path: Path) -> int | None:
    """Return the predicted frames until a scenario rests; None where it says none."""
    with read_scenario(path) as file:
        stated = file.header.parameters.get("active_frames")
    if stated is None:
        return None
    return int(str(stated))


def measured_frames(size: Size, every: int, active: int | None) -> tuple[int, ...]:
    """Return the absolute frames at which clouds are compared, one at least."""
    first = size.task.input_frames
    count = size.task.horizon
    if active is not None:
        # Where nothing moves any more the first predicted frame counts.
        count = min(max(1, active), count)
    end = first + count
    first_measured = first + MEASURED_EVERY - 1
    frames = range(first_measured, end, every)
    return tuple(frames) or (end - 1,)


def cases_of_train(size: Size, root: Path) -> dict[int, AnalogCase]:
    """Return the scenarios of train, each to be predicted from the other ones."""
    cases = {}
    for scenario in long_enough(size):
        path = size.path(root, scenario)
        with read_scenario(path) as file:
            given = given_in(file, size, root)
        active = active_frames(path)
        cases[scenario] = AnalogCase(
            given=given,
            frames=measured_frames(size, CHOSEN_EVERY, active),
            without=scenario,
            thinning=THINNING[size.box.dimension],
        )
    return cases


def error_on_train(
    cases: Mapping[int, AnalogCase],
    library: Library,
    attempt: Attempt,
    choice: Choice,
) -> float:
    """Return the mean distance of clouds when scenarios of train predict each other."""
    errors = []
    for scenario, case in cases.items():
        clouds = attempt.predict(case, choice)
        unmirrored = State(scenario, 0, 0)
        truth, _ = library.motion(unmirrored)
        frame_errors = []
        for frame in case.frames:
            error = cloud_distance_by_material(
                clouds[frame],
                truth[frame, :: case.thinning],
                case.material,
            )
            frame_errors.append(error)
        errors.append(float(np.mean(frame_errors)))
    return float(np.mean(errors))


def cloud_distance_by_material(
    cloud: Floats,
    true_cloud: Floats,
    material: Materials,
) -> float:
    """Return the distance of two clouds, material by material [length].

    The sliced Wasserstein-2 distances of the materials are averaged, weighted by the
    shares of particles.
    """
    error = 0.0
    for kind in np.unique(material):
        members = material == kind
        share = float(np.mean(members))
        distance = sliced_wasserstein2(cloud[members], true_cloud[members])
        error += share * distance
    return error


def score_on_test(
    size: Size,
    root: Path,
    attempt: Attempt,
    choice: Choice,
) -> float:
    """Return the ranking metric on test."""
    task = load_scored_task(size, root, is_hashed=True)
    frames = measured_frames(size, MEASURED_EVERY, None)
    first = size.task.input_frames
    end = first + size.task.horizon
    horizon = range(first, end)
    tallies = {}
    for scenario in task.scenarios:
        with task.opened(scenario) as truth:
            given = given_in(truth.file, size, root)
        case = AnalogCase(
            given=given,
            frames=frames,
            without=None,
            thinning=1,
        )
        clouds = attempt.predict(case, choice)
        shape = (len(horizon), *given.last.shape)
        position = np.empty(shape, np.float32)
        for row, frame in enumerate(horizon):
            # The metric is not measured at the frames between.
            measured = next_measured(frames, frame)
            position[row] = given.box.inside(clouds[measured])
        tallies[scenario] = score_positions(task, scenario, position, METRIC)
    result = score(METRICS[METRIC], tallies)
    if result is None:
        raise ValueError(f"{size.split}: no value of {METRIC}")
    return result.mean


def next_measured(frames: Sequence[int], frame: int) -> int:
    """Return the first measured frame that is no earlier, or the last one."""
    for measured in frames:
        if measured >= frame:
            return measured
    return frames[-1]


def baseline_score(size: Size) -> float:
    """Return the shipped score on test of the predictor that is to be beaten."""
    references = shipped(size)
    if references is None:
        raise ValueError(f"{size.split} {size.name}: nothing was shipped")
    scores = references[BASELINE].scores
    return scores[METRIC].mean


def run(
    size: Size,
    root: Path,
    attempt: Attempt,
    *,
    cases: Mapping[int, AnalogCase],
    library: Library,
    is_scored: bool,
) -> dict[str, object]:
    """Return the chosen parameters of an attempt and its errors.

    Without ``is_scored`` there is no error on test.
    """
    errors = []
    for choice in attempt.choices:
        error = error_on_train(cases, library, attempt, choice)
        errors.append(error)
    least_error = min(errors)
    best = errors.index(least_error)
    best_choice = attempt.choices[best]
    result: dict[str, object] = {
        "what": attempt.what,
        "chosen": dict(best_choice),
        "choices": len(attempt.choices),
        "train": least_error,
    }
    if is_scored:
        result["test"] = score_on_test(size, root, attempt, best_choice)
    return result


def check_attempts(names: Sequence[str], sizes: Sequence[Size], root: Path) -> None:
    """Refuse names of attempts that no data set has.

    Raises:
        UsageError: there is no such attempt.
    """
    known: dict[str, None] = {}  # a set that keeps its order
    for size in sizes:
        for attempt in attempts_on(Library(size, root)):
            known[attempt.name] = None
    for name in names:
        if name not in known:
            raise UsageError(
                "no such attempt on these data sets",
                where="--attempt",
                expected="the name of an attempt",
                got=repr(name),
                fix=suggest_name(name, list(known)),
            )


def needs_run(result: Mapping[str, object] | None, *, is_scored: bool) -> bool:
    """Return whether an attempt is to be run: it is not kept, or not yet scored."""
    if result is None:
        return True
    return is_scored and "test" not in result


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the attempts that are not kept yet, and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--root", type=Path)
    parser.add_argument("--split", choices=SPLITS, action="append")
    parser.add_argument("--size", choices=SIZES, default="mini")
    parser.add_argument("--attempt", action="append", help="only these; all by default")
    parser.add_argument("--train-only", action="store_true", help="do not score test")
    parser.add_argument("--output", "-o", type=Path, help="keeps finished attempts")
    options = parser.parse_args(arguments)
    root = resolve_root(options.root)
    is_scored = not options.train_only
    kept: dict[str, dict[str, dict[str, object]]] = {}
    if options.output and options.output.is_file():
        kept = json.loads(options.output.read_text())

    sizes = []
    for split in options.split or SPLITS:
        sizes.append(load().size(split, options.size))
    check_attempts(options.attempt or (), sizes, root)
    rows = []
    for size in sizes:
        library = Library(size, root)
        cases = cases_of_train(size, root)
        baseline = baseline_score(size)
        data_set = f"{size.split} {size.name}"
        results = kept.setdefault(data_set, {})
        for attempt in attempts_on(library):
            if options.attempt and attempt.name not in options.attempt:
                continue
            if needs_run(results.get(attempt.name), is_scored=is_scored):
                result = run(
                    size,
                    root,
                    attempt,
                    cases=cases,
                    library=library,
                    is_scored=is_scored,
                )
                results[attempt.name] = result
                sys.stderr.write(f"{data_set} {attempt.name}: {result}\n")
                if options.output:
                    text = json.dumps(kept, indent=1)
                    write_atomically(options.output, text.encode(), option="--output")
            row = _row(data_set, attempt.name, results[attempt.name], baseline)
            rows.append(row)
    heads = ("data set", "attempt", "what", "chosen on train", "train", "test", "ratio")
    table = markdown(heads, rows)
    sys.stdout.write(f"{table}\n")
    return 0


def _row(
    data_set: str, attempt: str, result: Mapping[str, object], baseline: float
) -> tuple[str, ...]:
    """Return the row of an attempt; a dash stands for test where it is not scored."""
    chosen = result["chosen"]
    parameters = []
    if isinstance(chosen, dict):
        for key, value in chosen.items():
            parameters.append(f"{key} {value:g}")
    train_error = float(str(result["train"]))
    test_text = "-"
    ratio_text = "-"
    if "test" in result:
        test_score = float(str(result["test"]))
        ratio = test_score / baseline
        test_text = f"{test_score:.4f}"
        ratio_text = f"{ratio:.2f}"
    return (
        data_set,
        attempt,
        str(result["what"]),
        ", ".join(parameters),
        f"{train_error:.4f}",
        test_text,
        ratio_text,
    )


if __name__ == "__main__":
    try:
        raise SystemExit(main())
    except LagbenchError as error:
        print(f"naive_attempts: {error}", file=sys.stderr)
        raise SystemExit(error.exit_code) from error
