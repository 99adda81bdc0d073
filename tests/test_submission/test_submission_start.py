"""How predictions begin: permuted truth is refused, bad models are scored.

The tests run on tiny data of a full box and of a free surface.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from lagbench.data.registry import Size, load
from lagbench.data.scenario import read_scenario
from lagbench.make.generate import GenerationResult
from lagbench.submission import PredictionsWriter, ValidationResult, template, validate
from lagbench.submission.truth import Truth

Floats = NDArray[np.floating]
Predict = Callable[["World", int], Floats]


@dataclass(frozen=True)
class World:
    """The test subset of a tiny data set in memory."""

    size: Size
    root: Path
    positions: Mapping[int, Floats]  # every frame, shape [frame, particle, 2]

    @property
    def input_frames(self) -> int:
        """Number of given frames."""
        return self.size.task.input_frames

    @property
    def horizon(self) -> int:
        """Number of predicted frames."""
        return self.size.task.horizon

    def truth(self, scenario: int) -> Floats:
        """The frames to predict."""
        first = self.input_frames
        return self.positions[scenario][first : first + self.horizon]

    def last(self, scenario: int) -> Floats:
        """The last given frame."""
        position = self.positions[scenario]
        return position[self.input_frames - 1]

    def validate(self, path: Path, predict: Predict) -> ValidationResult:
        """Write predictions and validate them."""
        writer = PredictionsWriter(
            path,
            split=self.size.split,
            size="tiny",
            method="m",
            root=self.root,
        )
        with writer:
            for scenario in self.positions:
                prediction = predict(self, scenario)
                writer.add(scenario, prediction)
        return validate(path, root=self.root)


SPLITS = ["curl-noise", "fluid"]


@pytest.fixture(scope="module", params=SPLITS)
def world(
    request: pytest.FixtureRequest, tiny_split: Callable[..., GenerationResult]
) -> World:
    """The test subset of each split."""
    root = tiny_split(request.param).root
    size = load().size(request.param, "tiny")
    truth = Truth(size, root)
    positions = {}
    for scenario in sorted(size.subsets["test"]):
        with read_scenario(truth.path(scenario)) as file:
            positions[scenario] = file.read("position")
    return World(size, root, positions)


def rng(scenario: int) -> np.random.Generator:
    """Random numbers of a scenario."""
    return np.random.Generator(np.random.PCG64(scenario))


# --- refused ----------------------------------------------------------------------


def permuted(world: World, scenario: int) -> Floats:
    """The truth, all particles in another order."""
    order = rng(scenario).permutation(world.size.particles)
    truth = world.truth(scenario)
    return truth[:, order]


def two_particles_exchanged(world: World, scenario: int) -> Floats:
    """The truth, but for the first two particles."""
    order = np.arange(world.size.particles)
    order[:2] = [1, 0]
    truth = world.truth(scenario)
    return truth[:, order]


def permuted_and_at_rest(world: World, scenario: int) -> Floats:
    """The last given frame in another order of the particles, repeated."""
    order = rng(scenario).permutation(world.size.particles)
    shape = world.truth(scenario).shape
    at_rest = world.last(scenario)[order]
    return np.broadcast_to(at_rest, shape)


@pytest.mark.parametrize(
    "predict",
    [
        permuted,
        two_particles_exchanged,
        permuted_and_at_rest,
    ],
)
def test_permuted_truth_is_refused(
    world: World, tmp_path: Path, predict: Predict
) -> None:
    """The check ``start`` rejects every scenario; nothing else does."""
    result = world.validate(tmp_path / "p.nc", predict)
    checks = [issue.check for issue in result.errors]
    assert checks == ["start"] * len(world.positions)
    assert result.exit_code == 1


# --- scored, however bad ----------------------------------------------------------


def noise(world: World, scenario: int) -> Floats:
    """Normal numbers for every position."""
    shape = world.truth(scenario).shape
    return rng(scenario).normal(size=shape)


def noisy(amplitude: float) -> Predict:
    """The truth with noise of an amplitude [length]."""

    def predict(world: World, scenario: int) -> Floats:
        truth = world.truth(scenario)
        return truth + amplitude * noise(world, scenario)

    return predict


def one_frame_late(world: World, scenario: int) -> Floats:
    """The truth without its first frame; the last one is repeated."""
    truth = world.truth(scenario)
    return np.concatenate([truth[1:], truth[-1:]])


def displacements(world: World, scenario: int) -> Floats:
    """Steps instead of positions."""
    last = world.last(scenario)
    frames = np.concatenate([last[None], world.truth(scenario)])
    return np.diff(frames, axis=0)


def another_scenario(world: World, scenario: int) -> Floats:
    """The truth of the next scenario."""
    scenarios = list(world.positions)
    following = (scenarios.index(scenario) + 1) % len(scenarios)
    return world.truth(scenarios[following])


@pytest.mark.parametrize(
    "predict",
    [
        noisy(0.5),
        one_frame_late,
        displacements,
        another_scenario,
    ],
)
def test_a_bad_model_is_scored_and_its_jump_flagged(
    world: World, tmp_path: Path, predict: Predict
) -> None:
    """Nothing rejects it; a jump at the start is a warning."""
    result = world.validate(tmp_path / "p.nc", predict)
    assert result.valid
    flagged = set()
    for issue in result.warnings:
        if issue.check == "discontinuous_start":
            _, number, *_ = issue.where.split()
            flagged.add(int(number.rstrip(",")))
    given_and_predicted = world.input_frames + world.horizon
    for scenario, position in world.positions.items():
        first = predict(world, scenario)[0].astype("f4")
        jump = root_mean_square(first - world.last(scenario))
        frames = position[:given_and_predicted]
        steps = np.diff(frames, axis=0).astype("f8")
        square_lengths = np.sum(steps**2, axis=-1)
        limit = 10 * np.sqrt(square_lengths.max())
        assert (scenario in flagged) == (jump > limit)


def root_mean_square(vectors: Floats) -> float:
    """Root mean square length of vectors."""
    square_lengths = np.sum(vectors**2, axis=-1)
    return float(np.sqrt(square_lengths.mean()))


def test_persistence_and_the_truth_pass_all_checks(
    world: World, tmp_path: Path
) -> None:
    """What stands still from the start is a naive baseline, and no mistake."""
    result = template(
        world.size.split,
        "tiny",
        output=tmp_path / "t.nc",
        root=world.root,
    )
    persistence = validate(result.path, root=world.root)
    assert not persistence.findings
    truth = world.validate(tmp_path / "p.nc", World.truth)
    assert not truth.findings
