"""The hybrid on free surfaces: unchanged it is the coarse solver, changed a fit."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from lagbench.baselines import hybrid_coarse
from lagbench.baselines.baseline import DatasetInfo
from lagbench.baselines.dataset_info import read_dataset_info
from lagbench.baselines.hybrid_coarse import (
    COEFFICIENTS,
    HybridCoarse,
    change_constants,
    fastest_sound,
    minimum_of_surface,
    spread_points,
)
from lagbench.baselines.rollout import roll_out, scenario_batch, scenario_paths
from lagbench.data.registry import Size, load
from lagbench.data.scenario import read_scenario
from lagbench.errors import DataError, UsageError
from lagbench.generators.constants import solver_constants
from lagbench.generators.soundness import sound_speeds
from lagbench.generators.split import Material
from lagbench.make.generate import GenerationResult
from lagbench.metrics.frame import sliced_wasserstein2
from lagbench.references import coarse_solver
from lagbench.references.predictor import given_in

SPLIT = "multimaterial"
SIZE = "tiny"
TIMES = 2


@pytest.fixture
def root(tiny_split: Callable[..., GenerationResult]) -> Path:
    """Folder of the tiny data of several materials."""
    return tiny_split(SPLIT).root


@pytest.fixture
def figures(root: Path) -> DatasetInfo:
    """Public figures of these data."""
    return read_dataset_info(SPLIT, SIZE, root=root)


def described() -> Size:
    """Return the description of the data."""
    return load().size(SPLIT, SIZE)


def coarse_size() -> Size:
    """Return the size of the classical coarse solver."""
    coarse = coarse_solver.coarser(described(), TIMES)
    assert coarse is not None
    return coarse


@pytest.mark.slow
def test_without_changes_it_is_the_coarse_solver(
    root: Path, figures: DatasetInfo
) -> None:
    """Positions are equal to the bit, in two scenarios side by side too."""
    size = described()
    paths = list(scenario_paths(SPLIT, subset="test", size=SIZE, root=root).values())
    expected = []
    for path in paths[:2]:
        with read_scenario(path) as file:
            scenario = given_in(file, size, root)
        positions = coarse_solver.predict(scenario, TIMES)
        expected.append(np.array(list(positions)))

    model = HybridCoarse.build({}, figures)
    given = scenario_batch(paths[:2], slice(size.task.input_frames))
    rollouts = roll_out(model, given, size.task.horizon)
    for rollout, positions in zip(rollouts, expected, strict=True):
        np.testing.assert_array_equal(rollout.position.numpy(), positions)


@pytest.mark.slow
def test_rollouts_side_by_side_take_their_solvers_again(
    root: Path, figures: DatasetInfo
) -> None:
    """Each has a solver of its own; the next rollouts compile none."""
    paths = list(scenario_paths(SPLIT, subset="test", size=SIZE, root=root).values())
    given = scenario_batch(paths[:2], slice(2))
    model = HybridCoarse.build({}, figures)
    state = model.start(given)
    solvers = [rollout.solver for rollout in state.rollouts]
    assert solvers[0] is not solvers[1]
    del state
    again = model.start(given)
    for rollout in again.rollouts:
        assert any(rollout.solver is solver for solver in solvers)
    assert again.rollouts[0].solver is not again.rollouts[1].solver


def with_coefficient(name: str, value: float) -> Size:
    """Return the coarse size with one coefficient that is not 0."""
    coefficients = np.zeros(len(COEFFICIENTS))
    coefficients[COEFFICIENTS.index(name)] = value
    return change_constants(coarse_size(), coefficients)


def changes(size: Size) -> dict[str, float]:
    """Return constants over those of the coarse solver, where they differ."""
    ratios = {}
    for name, parameter in coarse_size().parameters.items():
        before = parameter.value
        after = size.parameters[name].value
        if before != after:
            ratios[name] = float(after) / float(before)
    return ratios


def test_each_coefficient_changes_its_constants() -> None:
    """Damping by a share, the others by a factor; shares stay at most 1."""
    damped = changes(with_coefficient("viscosity", -0.25))
    assert damped == pytest.approx({"liquid_viscosity": 0.75, "elastic_damping": 0.75})
    undamped = with_coefficient("viscosity", -2.0)
    assert undamped.value("liquid_viscosity") == 0.0
    softer = changes(with_coefficient("moduli", np.log(0.5)))
    solids = {f"{name}_modulus": 0.5 for name in ("jelly", "snow", "rope")}
    assert {name: softer[name] for name in solids} == pytest.approx(solids)
    relaxed = with_coefficient("relaxation", 3.0)
    assert relaxed.value("jacobian_relaxation") == 1.0
    coupled = changes(with_coefficient("coupling", np.log(2.0)))
    assert coupled == pytest.approx({"density_coupling": 2.0})


def test_sound_is_that_of_the_solver() -> None:
    """The generator's own speeds, of snow at its hardest."""
    size = described()
    parameters = solver_constants(size)
    speeds = dict(sound_speeds(parameters))
    speeds[Material.SNOW] *= np.sqrt(parameters.snow_hardening_max)
    assert fastest_sound(size) == pytest.approx(max(speeds.values()))


def test_slower_sound_takes_longer_time_steps() -> None:
    """A quarter of all moduli halves the sound, and with it the number of steps."""
    coarse = coarse_size()
    coefficients = np.zeros(len(COEFFICIENTS))
    coefficients[COEFFICIENTS.index("modulus")] = np.log(0.25)
    coefficients[COEFFICIENTS.index("moduli")] = np.log(0.25)
    changed = change_constants(coarse, coefficients)
    assert fastest_sound(changed) == pytest.approx(0.5 * fastest_sound(coarse))
    half = -(-coarse.substeps_per_frame // 2)
    assert changed.substeps_per_frame == half


def test_points_of_the_fit_fill_the_ranges() -> None:
    """Each half of each coefficient has as many, and none is a corner."""
    ranges = np.array([(-1.0, 0.0), (0.0, 3.0)])
    points = spread_points(ranges, 36)
    assert points.shape == (36, 2)
    assert (points > ranges[:, 0]).all()
    assert (points < ranges[:, 1]).all()
    is_low = points < ranges.mean(axis=1)
    np.testing.assert_allclose(is_low.mean(axis=0), 0.5, atol=0.06)


def test_the_surface_finds_the_bottom_of_a_bowl() -> None:
    """Also under noise, and at the edge where the bottom lies outside."""
    rng = np.random.default_rng(0)
    ranges = np.array([(-1.0, 1.0)] * 3)
    points = spread_points(ranges, 60)
    bottom = np.array([0.3, -0.5, 0.1])
    bowl = ((points - bottom) ** 2).sum(axis=1)
    exact = minimum_of_surface(points, bowl, ranges)
    np.testing.assert_allclose(exact, bottom, atol=1e-5)
    noise = rng.normal(0.0, 0.05, len(points))
    noisy = minimum_of_surface(points, bowl + noise, ranges)
    np.testing.assert_allclose(noisy, bottom, atol=0.1)
    outside = ((points - [2.0, 0.0, 0.0]) ** 2).sum(axis=1)
    edge = minimum_of_surface(points, outside, ranges)
    np.testing.assert_allclose(edge, [1.0, 0.0, 0.0], atol=1e-5)


@pytest.mark.slow
def test_the_fit_finds_a_flow_of_other_constants(
    root: Path, figures: DatasetInfo
) -> None:
    """From positions that a softer coarse solver made it comes close to that one.

    Of the points that it tries, all softer too, it keeps the best: rollouts have the
    error of that one.
    """
    size = described()
    (path, *_) = scenario_paths(SPLIT, subset="train", size=SIZE, root=root).values()
    scenario = scenario_batch(path)
    teacher = HybridCoarse.build({}, figures)
    teacher.coefficients[COEFFICIENTS.index("moduli")] = -1.0
    given_frames = size.task.input_frames
    given = scenario.part(slice(given_frames))
    (rollout,) = roll_out(teacher, given, size.task.horizon)
    future = rollout.position.transpose(0, 1)
    whole = torch.cat([given.position, future], dim=1)
    made = replace(scenario, position=whole)

    frame_step = 5
    model = HybridCoarse.build({"evaluations": 2, "frame_step": frame_step}, figures)
    numbers = model.fit([made])
    assert numbers["error_without"] > 1e-4
    assert numbers["error"] < 0.5 * numbers["error_without"]
    (fitted,) = roll_out(model, given, size.task.horizon)
    compared = slice(frame_step - 1, None, frame_step)
    error = mean_distance(
        fitted.position.numpy()[compared],
        rollout.position.numpy()[compared],
        scenario.material.numpy(),
    )
    assert error == pytest.approx(numbers["error"], rel=1e-3)


@pytest.mark.slow
def test_coefficients_that_do_not_help_stay_0(root: Path, figures: DatasetInfo) -> None:
    """The error that the fit returns is that of the weights it leaves."""
    size = described()
    (path, *_) = scenario_paths(SPLIT, subset="train", size=SIZE, root=root).values()
    scenario = scenario_batch(path)
    model = HybridCoarse.build({"evaluations": 1, "frame_step": 5}, figures)
    given = scenario.part(slice(size.task.input_frames))
    (rollout,) = roll_out(model, given, size.task.horizon)
    future = rollout.position.transpose(0, 1)
    made = replace(scenario, position=torch.cat([given.position, future], dim=1))
    numbers = model.fit([made])
    assert torch.equal(model.coefficients, torch.zeros(len(COEFFICIENTS)))
    assert numbers["error"] == numbers["error_without"] < 1e-6


def test_the_fit_keeps_only_the_frames_that_it_compares(
    root: Path, figures: DatasetInfo
) -> None:
    """Whole scenarios in float64 would take gigabytes at full."""
    (path, *_) = scenario_paths(SPLIT, subset="train", size=SIZE, root=root).values()
    model = HybridCoarse.build({"frame_step": 5}, figures)
    true_rollout = model.prepare_truth(scenario_batch(path))
    assert true_rollout.true_frames
    for position in true_rollout.true_frames.values():
        assert position.base is None


def test_a_fit_without_frames_to_compare_names_the_first(
    root: Path, figures: DatasetInfo
) -> None:
    """A large step between frames is as good a reason as a short scenario."""
    (path, *_) = scenario_paths(SPLIT, subset="train", size=SIZE, root=root).values()
    model = HybridCoarse.build({"frame_step": 500}, figures)
    with pytest.raises(UsageError) as caught:
        model.fit([scenario_batch(path)])
    first = figures.input_frames + 499
    assert str(first) in caught.value.expected
    assert "frame_step" in caught.value.fix


def mean_distance(
    first: NDArray[np.float32],
    second: NDArray[np.float32],
    material: NDArray[np.integer],
) -> float:
    """Return the mean distance of the clouds of each material in all frames [length].

    A material counts by its share of the particles.
    """
    distances = []
    for kind in np.unique(material):
        members = material == kind
        share = float(members.mean())
        for x, y in zip(first[:, members], second[:, members], strict=True):
            distances.append(share * sliced_wasserstein2(x, y))
    return float(np.sum(distances)) / len(first)


@pytest.mark.slow
def test_a_solver_that_breaks_down_ends_the_rollout(
    root: Path, figures: DatasetInfo, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its frames are no numbers, and the fit counts it as the worst."""
    monkeypatch.setattr(hybrid_coarse, "MOST_SUBSTEPS", 1)
    size = described()
    path = scenario_paths(SPLIT, subset="train", size=SIZE, root=root)
    first = next(iter(path.values()))
    model = HybridCoarse.build({"evaluations": 1}, figures)
    whole = scenario_batch(first)
    counts: list[int] = []
    numbers = model.fit([whole], count=counts.append)
    assert numbers["error_without"] == hybrid_coarse.WORST_ERROR
    assert 2 <= sum(counts) <= model.evaluations
    given = whole.part(slice(size.task.input_frames))
    (rollout,) = roll_out(model, given, size.task.horizon)
    assert rollout.diverged_at is not None


def test_coefficients_out_of_range_are_refused(
    root: Path, figures: DatasetInfo
) -> None:
    """They may come from a stranger's file."""
    path = next(
        iter(scenario_paths(SPLIT, subset="train", size=SIZE, root=root).values())
    )
    given = scenario_batch(path, slice(2))
    model = HybridCoarse.build({}, figures)
    for value in (1e3, float("nan")):
        model.coefficients[0] = value
        with pytest.raises(DataError, match="out of range"):
            model.start(given)


def test_data_without_a_mass_are_refused(root: Path, figures: DatasetInfo) -> None:
    """The solver needs the area that a particle stands for."""
    path = next(
        iter(scenario_paths(SPLIT, subset="train", size=SIZE, root=root).values())
    )
    given = replace(scenario_batch(path, slice(2)), particle_mass=None)
    with pytest.raises(DataError, match="mass"):
        HybridCoarse.build({}, figures).start(given)


@pytest.mark.parametrize(
    "changes", [{"split": "cavity", "size": "mini"}, {"split": "fluid", "size": "tiny"}]
)
def test_data_without_a_coarser_grid_are_refused(
    figures: DatasetInfo, changes: dict[str, str]
) -> None:
    """Full boxes are the projection solver's; small grids have too few cells."""
    other = replace(figures, **changes)
    with pytest.raises(UsageError):
        HybridCoarse.build({}, other)


def info_of(figures: DatasetInfo, split: str, size: str) -> DatasetInfo:
    """Return public figures with the names and the box of another data set."""
    described = load().size(split, size)
    return replace(figures, split=split, size=size, bounds=described.bounds)


def test_two_thirds_of_the_cells_are_those_of_the_classical_solver(
    figures: DatasetInfo,
) -> None:
    """Without changes the constants are those of coarse-solver-two-thirds."""
    info = info_of(figures, "multimaterial-3d", "full")
    model = HybridCoarse.build({"times": 1.5}, info)
    size = load().size("multimaterial-3d", "full")
    assert model.coarse == coarse_solver.coarser(size, Fraction(3, 2))
    assert model.coarse.grid == 32
    assert change_constants(model.coarse, model.checked_coefficients()) == model.coarse


def test_a_refused_factor_names_one_that_works(figures: DatasetInfo) -> None:
    info = info_of(figures, "multimaterial-3d", "full")
    with pytest.raises(UsageError) as caught:
        HybridCoarse.build({}, info)
    (proposal, *_) = re.findall(r"model\.times=([0-9.]+)", str(caught.value.fix))
    HybridCoarse.build({"times": float(proposal)}, info)
    with pytest.raises(UsageError) as caught:
        HybridCoarse.build({}, info_of(figures, "fluid", "tiny"))
    assert "model.times" not in str(caught.value.fix)
