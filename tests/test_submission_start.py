"""How predictions begin: mistakes are named, bad models are scored, on the tiny data of all four splits."""

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
from lagbench.submission.start import Start, mistake
from lagbench.submission.truth import Truth

Floats = NDArray[np.floating]
Predict = Callable[["World", int], Floats]


@dataclass(frozen=True)
class World:
    """The test subset of a tiny data set in memory."""

    size: Size
    root: Path
    positions: Mapping[int, Floats]  # every frame, shape [frame, particle, 2]
    material: Mapping[int, NDArray[np.int8]]

    @property
    def given(self) -> int:
        """Given frames."""
        return self.size.task.input_frames

    def truth(self, scenario: int, *, late: int = 0) -> Floats:
        """The frames to predict, or those some frames later."""
        first = self.given + late
        return self.positions[scenario][first : first + self.size.task.horizon]

    def last(self, scenario: int) -> Floats:
        """The last given frame."""
        return self.positions[scenario][self.given - 1]

    def validate(self, path: Path, predict: Predict) -> ValidationResult:
        """Write predictions and validate them."""
        with PredictionsWriter(path, split=self.size.split, size="tiny", method="m", root=self.root) as out:
            for scenario in self.positions:
                out.add(scenario, predict(self, scenario))
        return validate(path, root=self.root, isolated=False)


@pytest.fixture(scope="module", params=["cavity", "curl-noise", "fluid", "multimaterial"])
def world(request: pytest.FixtureRequest, tiny_split: Callable[..., GenerationResult]) -> World:
    """The test subset of each split."""
    root = tiny_split(request.param).root
    size = load().size(request.param, "tiny")
    positions, material = {}, {}
    for scenario in sorted(size.subsets["test"]):
        with read_scenario(Truth(size, root).path(scenario)) as file:
            positions[scenario], material[scenario] = file.read("position"), file.read("material")
    return World(size, root, positions, material)


def rng(scenario: int) -> np.random.Generator:
    """Random numbers of a scenario."""
    return np.random.Generator(np.random.PCG64(scenario))


def permuted(world: World, scenario: int) -> Floats:
    """The truth with particles in another order, all frames alike."""
    return world.truth(scenario)[:, rng(scenario).permutation(world.size.particles)]


def permuted_within(world: World, scenario: int) -> Floats:
    """The truth with the particles of each material in another order."""
    order = np.arange(world.size.particles)
    for kind in np.unique(world.material[scenario]):
        held = np.flatnonzero(world.material[scenario] == kind)
        order[held] = rng(scenario).permutation(held)
    return world.truth(scenario)[:, order]


def rolled(world: World, scenario: int) -> Floats:
    """The truth with every particle under the next one's number."""
    return np.roll(world.truth(scenario), 1, axis=1)


def permuted_and_wrong(world: World, scenario: int) -> Floats:
    """Particles in another order, predicted to stand still."""
    order = rng(scenario).permutation(world.size.particles)
    return np.broadcast_to(world.last(scenario)[order], world.truth(scenario).shape)


def partly_permuted(world: World, scenario: int) -> Floats:
    """The truth with a third of the particles in another order."""
    order = np.arange(world.size.particles)
    some = rng(scenario).choice(order, len(order) // 3, replace=False)
    order[np.sort(some)] = some
    return world.truth(scenario)[:, order]


def swapped(world: World, scenario: int) -> Floats:
    """The truth with y first."""
    return world.truth(scenario)[..., ::-1]


def early(world: World, scenario: int) -> Floats:
    """The last given frame first, then the truth."""
    return world.truth(scenario, late=-1)


def late(world: World, scenario: int) -> Floats:
    """The truth without its first frame; the last one is repeated."""
    held = world.truth(scenario)
    return np.concatenate([held[1:], held[-1:]])


def steps(world: World, scenario: int) -> Floats:
    """Displacements from frame to frame."""
    return np.diff(world.positions[scenario][world.given - 1 :][: world.size.task.horizon + 1], axis=0)


def displacements(world: World, scenario: int) -> Floats:
    """Displacements from the last given frame."""
    return world.truth(scenario) - world.last(scenario)


def standardised(world: World, scenario: int) -> Floats:
    """The truth less its mean over its standard deviation."""
    held = world.truth(scenario)
    return (held - held.mean((0, 1))) / held.std((0, 1))


def another_scenario(world: World, scenario: int) -> Floats:
    """The truth of the next scenario."""
    ids = list(world.positions)
    return world.truth(ids[(ids.index(scenario) + 1) % len(ids)])


@pytest.mark.parametrize(
    ("predict", "word"),
    [
        (permuted, "order"),
        (permuted_within, "order"),
        (partly_permuted, "order"),
        (rolled, "order"),
        (permuted_and_wrong, "order"),
        (swapped, "swapped"),
        (early, "shifted"),
        (late, "shifted"),
        (steps, "displacements"),
        (displacements, "displacements"),
        (standardised, "standardised"),
        (another_scenario, "scenario"),
    ],
)
def test_a_mistake_is_named(world: World, tmp_path: Path, predict: Predict, word: str) -> None:
    """The check ``start`` refuses it, by its own name."""
    result = world.validate(tmp_path / "p.nc", predict)
    assert {finding.check for finding in result.errors} == {"start"}
    assert all(word in finding.what for finding in result.errors)
    assert result.exit_code == 1


def mean_of_scenarios(world: World, scenario: int) -> Floats:
    """The mean over scenarios by particle and frame."""
    return np.mean([world.truth(i) for i in world.positions], axis=0)


def noisy(deviation: float) -> Predict:
    """The truth with noise on every position [length]."""

    def predict(world: World, scenario: int) -> Floats:
        held = world.truth(scenario)
        return held + deviation * rng(scenario).normal(size=held.shape)

    return predict


def linear_map(world: World, scenario: int) -> Floats:
    """A model that turns and shrinks the cloud, with some noise: what a network trained too little does."""
    held = world.truth(scenario) @ np.array([[0.9, 0.1], [-0.1, 0.8]]) + 0.05
    return held + 0.03 * rng(scenario).normal(size=held.shape)


def too_fast(world: World, scenario: int) -> Floats:
    """Every particle twice as far from the last given frame as it should be."""
    return 2 * world.truth(scenario) - world.last(scenario)


def partly_lost(world: World, scenario: int) -> Floats:
    """A third of the particles anywhere within a twentieth of the box."""
    held = world.truth(scenario).copy()
    some = rng(scenario).random(held.shape[1]) < 1 / 3
    held[:, some] += rng(scenario).uniform(-0.05, 0.05, held[:, some].shape)
    return held


def shifted_cloud(world: World, scenario: int) -> Floats:
    """All particles a tenth of the box to the right."""
    return world.truth(scenario) + np.array([0.1, 0.0])


def anywhere(world: World, scenario: int) -> Floats:
    """Uniform in the unit box."""
    return rng(scenario).random(world.truth(scenario).shape)


def one_point(world: World, scenario: int) -> Floats:
    """All particles in the middle."""
    return np.full(world.truth(scenario).shape, 0.5)


@pytest.mark.parametrize(
    "predict",
    [
        *(mean_of_scenarios, noisy(0.01), noisy(0.1), noisy(0.5), linear_map, too_fast, partly_lost),
        *(shifted_cloud, anywhere, one_point),
    ],
)
def test_a_bad_model_is_scored(world: World, tmp_path: Path, predict: Predict) -> None:
    """Nothing rejects it; a jump at the start, where there is one, is a warning with its size."""
    result = world.validate(tmp_path / "p.nc", predict)
    assert result.valid
    flagged = [f for f in result.warnings if f.check == "discontinuous_start"]
    scenarios = {int(f.where.split()[1].rstrip(",")) for f in flagged}
    for scenario in world.positions:
        jump = predict(world, scenario)[0].astype("f4") - world.last(scenario)
        moved = np.diff(world.positions[scenario][: world.given + world.size.task.horizon], axis=0)
        limit = 10 * np.sqrt((moved.astype("f8") ** 2).sum(-1).max())
        assert (np.sqrt((jump**2).sum(-1).mean()) > limit) == (scenario in scenarios)


def test_persistence_and_truth_are_no_mistakes(world: World, tmp_path: Path) -> None:
    """What stands still from the start is a floor; the truth passes all checks."""
    made = template(world.size.split, "tiny", output=tmp_path / "t.nc", root=world.root)
    assert not validate(made.path, root=world.root, isolated=False).findings
    assert not world.validate(tmp_path / "p.nc", lambda held, i: held.truth(i)).findings


def test_one_early_scenario_is_a_warning(world: World, tmp_path: Path) -> None:
    """Frames shifted by one in a single scenario may be a model that starts late."""
    first = min(world.positions)

    def predict(held: World, scenario: int) -> Floats:
        return early(held, scenario) if scenario == first else held.truth(scenario)

    result = world.validate(tmp_path / "p.nc", predict)
    assert result.valid
    assert [finding.check for finding in result.warnings] == ["start"]


def test_frames_and_particles_mixed_up_are_named() -> None:
    """An array [particle, frame, space] that was reshaped instead of transposed; turned round it is none."""
    rng = np.random.default_rng(4)
    given = rng.random((60, 2))
    path = given[:, None] + 0.002 * np.cumsum(rng.standard_normal((60, 10, 2)), axis=1)
    wrong, right = path.reshape(10, 60, 2), path.transpose(1, 0, 2)
    bounds = ((0.0, 1.0), (0.0, 1.0))
    found = mistake(Start(given, right[0], wrong[0], wrong[1], 10), bounds, {})
    assert found is not None
    assert "mixed up" in found.what
    assert mistake(Start(given, right[0], right[0], right[1], 10), bounds, {}) is None
