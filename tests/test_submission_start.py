"""How predictions begin: mistakes are named, bad models are scored, on the tiny data of
all four splits.
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
        with PredictionsWriter(
            path, split=self.size.split, size="tiny", method="m", root=self.root
        ) as out:
            for scenario in self.positions:
                out.add(scenario, predict(self, scenario))
        return validate(path, root=self.root, isolated=False)


@pytest.fixture(
    scope="module", params=["cavity", "curl-noise", "fluid", "multimaterial"]
)
def world(
    request: pytest.FixtureRequest, tiny_split: Callable[..., GenerationResult]
) -> World:
    """The test subset of each split."""
    root = tiny_split(request.param).root
    size = load().size(request.param, "tiny")
    positions = {}
    material = {}
    for scenario in sorted(size.subsets["test"]):
        with read_scenario(Truth(size, root).path(scenario)) as file:
            positions[scenario] = file.read("position")
            material[scenario] = file.read("material")
    return World(size, root, positions, material)


def rng(scenario: int) -> np.random.Generator:
    """Random numbers of a scenario."""
    return np.random.Generator(np.random.PCG64(scenario))


def order(world: World, scenario: int) -> NDArray[np.intp]:
    """Another order of the particles."""
    return rng(scenario).permutation(world.size.particles)


def within(world: World, scenario: int) -> NDArray[np.intp]:
    """Another order of the particles of each material."""
    order = np.arange(world.size.particles)
    for kind in np.unique(world.material[scenario]):
        held = np.flatnonzero(world.material[scenario] == kind)
        order[held] = rng(scenario).permutation(held)
    return order


def a_third(world: World, scenario: int) -> NDArray[np.intp]:
    """Another order of a third of the particles."""
    order = np.arange(world.size.particles)
    some = rng(scenario).choice(order, len(order) // 3, replace=False)
    order[np.sort(some)] = some
    return order


def following(world: World, scenario: int) -> int:
    """The next scenario."""
    ids = list(world.positions)
    return ids[(ids.index(scenario) + 1) % len(ids)]


MISTAKES: dict[str, tuple[Predict, str]] = {
    "permuted": (lambda w, i: w.truth(i)[:, order(w, i)], "order"),
    "permuted within materials": (lambda w, i: w.truth(i)[:, within(w, i)], "order"),
    "a third permuted": (lambda w, i: w.truth(i)[:, a_third(w, i)], "order"),
    "under the next number": (lambda w, i: np.roll(w.truth(i), 1, axis=1), "order"),
    # permuted, and predicted to stand still
    "permuted and wrong": (
        lambda w, i: np.broadcast_to(w.last(i)[order(w, i)], w.truth(i).shape),
        "order",
    ),
    "y first": (lambda w, i: w.truth(i)[..., ::-1], "swapped"),
    # the last given frame first, then the truth
    "early": (lambda w, i: w.truth(i, late=-1), "shifted"),
    # without its first frame; the last one is repeated
    "late": (lambda w, i: np.concatenate([w.truth(i)[1:], w.truth(i)[-1:]]), "shifted"),
    "steps": (
        lambda w, i: np.diff(np.concatenate([w.last(i)[None], w.truth(i)]), axis=0),
        "displacements",
    ),
    "from the last given frame": (lambda w, i: w.truth(i) - w.last(i), "displacements"),
    "standardised": (
        lambda w, i: (w.truth(i) - w.truth(i).mean((0, 1))) / w.truth(i).std((0, 1)),
        "standardised",
    ),
    "another scenario": (lambda w, i: w.truth(following(w, i)), "scenario"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_named(world: World, tmp_path: Path, name: str) -> None:
    """The check ``start`` refuses it, by its own name."""
    predict, word = MISTAKES[name]
    result = world.validate(tmp_path / "p.nc", predict)
    assert {(finding.check, word in finding.what) for finding in result.errors} == {
        ("start", True)
    }
    assert result.exit_code == 1


def partly_lost(world: World, scenario: int) -> Floats:
    """A third of the particles anywhere within a twentieth of the box."""
    held = world.truth(scenario).copy()
    some = rng(scenario).random(held.shape[1]) < 1 / 3
    held[:, some] += rng(scenario).uniform(-0.05, 0.05, held[:, some].shape)
    return held


def noise(world: World, scenario: int) -> Floats:
    """Normal numbers for every position."""
    return rng(scenario).normal(size=world.truth(scenario).shape)


BAD: dict[str, Predict] = {
    "the mean over scenarios": lambda w, i: np.mean(
        [w.truth(j) for j in w.positions], axis=0
    ),
    "noise of 0.01": lambda w, i: w.truth(i) + 0.01 * noise(w, i),
    "noise of 0.1": lambda w, i: w.truth(i) + 0.1 * noise(w, i),
    "noise of 0.5": lambda w, i: w.truth(i) + 0.5 * noise(w, i),
    # turned and shrunk, with some noise: what a network trained too little does
    "turned": lambda w, i: (
        w.truth(i) @ np.array([[0.9, 0.1], [-0.1, 0.8]]) + 0.05 + 0.03 * noise(w, i)
    ),
    "twice as far": lambda w, i: 2 * w.truth(i) - w.last(i),
    "partly lost": partly_lost,
    "all a tenth to the right": lambda w, i: w.truth(i) + np.array([0.1, 0.0]),
    "anywhere": lambda w, i: rng(i).random(w.truth(i).shape),
    "in one point": lambda w, i: np.full(w.truth(i).shape, 0.5),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_model_is_scored(world: World, tmp_path: Path, name: str) -> None:
    """Nothing rejects it; a jump at the start, where there is one, is a warning with
    its size.
    """
    predict = BAD[name]
    result = world.validate(tmp_path / "p.nc", predict)
    assert result.valid
    flagged = [f for f in result.warnings if f.check == "discontinuous_start"]
    scenarios = {int(f.where.split()[1].rstrip(",")) for f in flagged}
    for scenario in world.positions:
        jump = predict(world, scenario)[0].astype("f4") - world.last(scenario)
        moved = np.diff(
            world.positions[scenario][: world.given + world.size.task.horizon], axis=0
        )
        limit = 10 * np.sqrt((moved.astype("f8") ** 2).sum(-1).max())
        assert (np.sqrt((jump**2).sum(-1).mean()) > limit) == (scenario in scenarios)


def test_what_is_no_mistake(world: World, tmp_path: Path) -> None:
    """What stands still from the start is a floor; the truth passes all checks.

    Frames shifted by one in a single scenario may be a model that starts late.
    """
    made = template(world.size.split, "tiny", output=tmp_path / "t.nc", root=world.root)
    assert not validate(made.path, root=world.root, isolated=False).findings
    assert not world.validate(tmp_path / "p.nc", lambda held, i: held.truth(i)).findings
    first = min(world.positions)
    result = world.validate(
        tmp_path / "p.nc", lambda w, i: w.truth(i, late=-1 if i == first else 0)
    )
    assert result.valid
    assert [finding.check for finding in result.warnings] == ["start"]


def test_frames_and_particles_mixed_up_are_named() -> None:
    """An array [particle, frame, space] that was reshaped instead of transposed; turned
    round it is none.
    """
    rng = np.random.default_rng(4)
    given = rng.random((60, 2))
    path = given[:, None] + 0.002 * np.cumsum(rng.standard_normal((60, 10, 2)), axis=1)
    wrong = path.reshape(10, 60, 2)
    right = path.transpose(1, 0, 2)
    bounds = ((0.0, 1.0), (0.0, 1.0))
    assert (
        "mixed up"
        in mistake(Start(given, right[0], wrong[0], wrong[1], 10), bounds, {}).what
    )
    assert mistake(Start(given, right[0], right[0], right[1], 10), bounds, {}) is None
