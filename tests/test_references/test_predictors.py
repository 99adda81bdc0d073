"""Reference predictors against closed forms, copies and the solver itself."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from box_scenarios import compiled
from numpy.typing import NDArray
from scipy.spatial import KDTree
from score_bench import ScoreBench, straight

from lagbench.data.box import UNIT_SQUARE, Box
from lagbench.data.layout import major_of
from lagbench.data.registry import Size, load
from lagbench.data.scenario import read_scenario
from lagbench.errors import DataError
from lagbench.generators.constants import solver_constants
from lagbench.generators.split import InitialState
from lagbench.metrics.table import ranking_metric
from lagbench.references import (
    REFERENCES,
    Given,
    coarse_solver,
    given_in,
    references_of,
    shipped,
)
from lagbench.references.analog import (
    DIRECTIONS,
    InitialCloud,
    describe_start,
    distance,
    find_analog,
)
from lagbench.references.assignment import assign_particles
from lagbench.references.ballistic_analog import (
    Choice,
    bodies_touch,
    choose,
    cloud_error,
    frames_of_flight,
    label_bodies,
    predict_positions,
)
from lagbench.references.coarse_solver import coarser, predict_with, spread_subset
from lagbench.references.frozen_field import decay
from lagbench.references.predictor import linear_field, with_wall_images
from lagbench.references.shipped import FOLDER, shipped_path
from lagbench.references.table import NAIVE
from lagbench.references.train_library import (
    Mirror,
    describe_state,
    mirrors_of,
    state_library,
)
from lagbench.scoring.card import SUBMISSION
from lagbench.scoring.references import measurable
from lagbench.scoring.skill import best_reference

Floats = NDArray[np.float64]


def given(
    split: str,
    position: Floats,
    *,
    size: str = "tiny",
    root: Path = Path(),
    **changes: Any,
) -> Given:
    """Return what a made-up scenario gives; its walls are at rest unless told
    otherwise.
    """
    tier = load().size(split, size)
    frames = tier.task.input_frames + tier.task.horizon
    walls = np.zeros((frames, 4, 2))
    walls[:, :] = changes.pop("wall", 0.0)
    (left, right), (bottom, top) = tier.bounds
    return Given(
        size=tier,
        root=root,
        position=np.asarray(position, np.float64),
        material=changes.pop("material", np.zeros(position.shape[1], np.int8)),
        walls=walls,
        area=changes.pop("area", (right - left) * (top - bottom)),
        parameters=changes,
    )


def scattered(count: int, low: float, high: float, seed: int = 0) -> Floats:
    """Return points of a square, shape [point, 2]."""
    return np.asarray(
        low + (high - low) * np.random.default_rng(seed).random((count, 2))
    )


def predicted(name: str, scenario: Given) -> NDArray[np.float32]:
    """Return what a predictor predicts, shape [frame, particle, 2]."""
    return np.array(list(REFERENCES[name].predict(scenario)))


def own(size: Size, *, placement: str) -> Size:
    """Return a split of a user's own: without generator, gravity or recorded scores."""
    parameters = {
        name: value for name, value in size.parameters.items() if name != "gravity"
    }
    grid = size.task.score_grid.model_copy(update={"placement": placement})
    task = size.task.model_copy(update={"score_grid": grid})
    told = {
        "split": "own",
        "name": "full",
        "generator": "none",
        "parameters": parameters,
        "task": task,
    }
    return size.model_copy(update=told)


SURFACE = "persistence constant-velocity ballistic climatology analog ballistic-analog"
FULL_BOX = (
    "persistence constant-velocity frozen-field analog"
    " projection projection-2x projection-3x"
)


@pytest.mark.parametrize(
    ("split", "size", "names"),
    [
        ("cavity", "full", FULL_BOX),
        ("cavity", "mini", FULL_BOX),
        ("curl-noise", "full", FULL_BOX),
        ("fluid", "full", f"{SURFACE} coarse-solver coarse-solver-4x"),
        ("fluid", "mini", f"{SURFACE} coarse-solver"),
        ("multimaterial", "full", f"{SURFACE} coarse-solver"),
        ("multimaterial", "mini", SURFACE),
        ("fluid", "tiny", SURFACE),
        ("own", "cell_centres", FULL_BOX),
        ("own", "nodes", "persistence constant-velocity analog"),
    ],
)
def test_a_size_has_the_predictors_of_its_kind_of_box(
    split: str, size: str, names: str
) -> None:
    """A user's own split goes by its kind of box; without gravity nothing falls."""
    if split == "own":
        tier = own(load().size("fluid", "mini"), placement=size)
        assert shipped(tier) is None
    else:
        tier = load().size(split, size)
    assert " ".join(predictor.name for predictor in references_of(tier)) == names
    for times in (2, 4):
        coarse = coarser(tier, times)
        assert coarse is None or coarse.grid * times == tier.grid


def test_every_predictor_says_what_it_is() -> None:
    for name, predictor in REFERENCES.items():
        assert predictor.name == name
        assert predictor.title
        assert predictor.definition.endswith(".")
    solvers = {name for name in REFERENCES if "projection" in name or "solver" in name}
    assert frozenset(REFERENCES) - NAIVE == solvers


def test_extrapolations_stay_inside_the_walls() -> None:
    """Fast particles stop at the walls; positions are float32, one frame per frame of
    the horizon.
    """
    start = scattered(300, 0.2, 0.8)
    fast = np.stack([start, start + 0.05])
    for name in ("persistence", "constant-velocity", "ballistic"):
        found = predicted(name, scenario := given("fluid", fast))
        (left, right), (bottom, top) = scenario.size.bounds
        assert found.dtype == np.float32
        assert found.shape == (scenario.size.task.horizon, 300, 2)
        assert found[..., 0].max() <= np.float32(right)
        assert found[..., 1].max() <= np.float32(top)
        assert found.min() >= np.float32(min(left, bottom))


def test_ballistic_flight_is_a_parabola() -> None:
    """Frames of y = y0 + v t - g t^2 / 2 continue on the same parabola."""
    size = load().size("fluid", "tiny")
    time = np.arange(size.task.input_frames + size.task.horizon) * size.frame_interval
    start = scattered(50, 0.4, 0.6)
    path = np.repeat(start[None], len(time), axis=0)
    path[..., 0] += 0.1 * time[:, None]
    path[..., 1] += (0.8 * time - 0.5 * size.value("gravity") * time**2)[:, None]
    n = size.task.input_frames
    found = predicted("ballistic", given("fluid", path[:n]))
    np.testing.assert_allclose(found, path[n:], atol=2e-6)


def test_a_frozen_rotation_stays_a_rotation() -> None:
    """Particles of a rigid rotation by 0.05 a frame keep their distance and turn by
    0.05 a frame.
    """
    centre = np.array([0.5, 0.5])
    angle = 0.05
    offset = scattered(4000, -0.4, 0.4)
    cos = math.cos(angle)
    sin = math.sin(angle)
    before = centre + offset @ np.array([[cos, -sin], [sin, cos]])
    scenario = given("cavity", np.stack([*([before] * 5), centre + offset]), wall=1e-9)
    found = predicted("frozen-field", scenario)
    inner = np.hypot(*offset.T) < 0.25
    now = found[-1][inner] - centre
    steps = scenario.size.task.horizon
    np.testing.assert_allclose(np.hypot(*now.T), np.hypot(*offset[inner].T), rtol=2e-3)
    gone = np.arctan2(now[:, 1], now[:, 0]) - np.arctan2(
        offset[inner, 1], offset[inner, 0]
    )
    np.testing.assert_allclose(np.cos(gone - steps * angle), 1.0, atol=1e-3)


def test_decay_of_an_exponential() -> None:
    """Displacements that shrink by 0.9 a frame decay by 0.9; growing ones and rest do
    not decay.
    """
    step = scattered(20, -0.01, 0.01)
    shrinking = np.cumsum([step * 0.9**k for k in range(6)], axis=0)
    assert decay(shrinking, UNIT_SQUARE) == pytest.approx(0.9)
    growing = np.cumsum([step * 1.1**k for k in range(6)], axis=0)
    assert decay(growing, UNIT_SQUARE) == 1.0
    assert decay(np.repeat(step[None], 6, axis=0), UNIT_SQUARE) == 1.0


@pytest.mark.parametrize("speed", [0.0, 0.02])
def test_the_mirrored_field_meets_the_wall(speed: float) -> None:
    """A shear flow goes on through a wall that slides at 0.02; one at rest lets a
    stagnation flow slide.
    """
    wall = np.zeros((4, 2))
    wall[3, 0] = speed
    scenario = given("cavity", np.zeros((6, 1, 2)), wall=wall)
    low, high = scenario.size.bounds[0]
    points = scattered(3000, low, high)
    depth = high - points[:, 1]
    tangential = speed + 0.3 * depth if speed else np.full_like(depth, 0.01)
    field = linear_field(
        *with_wall_images(
            scenario, points, np.stack([tangential, 0.2 * depth], axis=1), wall
        )
    )
    at_wall = np.stack([np.linspace(0.3, 0.7, 20), np.full(20, high)], axis=1)
    np.testing.assert_allclose(
        field(at_wall), np.tile((speed or 0.01, 0.0), (20, 1)), atol=1e-12
    )


def test_the_field_is_linear_and_has_no_holes() -> None:
    """A linear field is met exactly between the points; far outside, the nearest point
    answers.
    """
    points = scattered(200, 0.0, 1.0)
    gradient = np.array([[0.1, -0.3], [0.2, 0.05]])
    field = linear_field(points, points @ gradient)
    inside = scattered(50, 0.3, 0.7, seed=1)
    np.testing.assert_allclose(field(inside), inside @ gradient, atol=1e-12)
    beyond = np.array([[5.0, 5.0]])
    corner = points[np.argmin(np.sum((points - beyond) ** 2, axis=1))]
    np.testing.assert_allclose(field(beyond)[0], corner @ gradient)


@pytest.fixture(autouse=True)
def compile_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the coarse solver take the solver that is there."""
    coarse_solver._solver.cache_clear()
    monkeypatch.setattr("lagbench.generators.solver.build", compiled)


def opened(root: Path, size: Size, scenario: int) -> tuple[Given, NDArray[np.float32]]:
    """Return what a scenario of a generated data set gives, and its future."""
    n = size.task.input_frames
    with read_scenario(size.path(root, scenario)) as file:
        future = file.read("position", slice(n, n + size.task.horizon))
        return given_in(file, size, root), future


def test_analogs_of_a_copy_and_of_another(bench: ScoreBench) -> None:
    """A full box that stands in train is its own analog, and its motion carries it
    where it goes.

    A test scenario gets another one's motion: particles start where they are and stay
    in the box.
    """
    number = bench.size.subsets["train"][1]
    scenario, future = opened(bench.root, bench.size, number)
    analog, mirror = find_analog(scenario)
    assert analog == number
    assert mirror.axes == ()
    np.testing.assert_allclose(predicted("analog", scenario), future, atol=1e-5)
    scenario, future = opened(bench.root, bench.size, bench.size.subsets["test"][0])
    assert find_analog(scenario)[0] in bench.size.subsets["train"]
    found = predicted("analog", scenario)
    assert found.shape == future.shape
    assert np.abs(found[0] - scenario.last).max() < 0.1


def test_a_start_is_as_near_wherever_in_the_box_it_is(bench: ScoreBench) -> None:
    """Moved together two clouds stay as far apart; 0.1 over the deviation along a
    direction.
    """
    scenario, _ = opened(bench.root, bench.size, bench.size.subsets["test"][0])
    start = describe_start(scenario)

    def moved(by: Floats) -> InitialCloud:
        return replace(
            start,
            clouds={kind: c + by @ DIRECTIONS for kind, c in start.clouds.items()},
        )

    near = distance(start, moved(np.array([0.1, 0.0])))
    assert distance(
        moved(np.array([0.3, -0.2])), moved(np.array([0.4, -0.2]))
    ) == pytest.approx(near)
    # on the mean over directions 0.1 along x has half its square, and the cloud half of
    # its variances' sum
    assert near == pytest.approx(
        0.1 / np.sqrt(scenario.last.var(axis=0).sum()), rel=0.01
    )


def test_assignment_goes_by_material() -> None:
    """A permuted, slightly moved cloud is matched particle by particle, each material
    on its own.

    Fewer particles are taken more than once, more are left out; a lacking material
    takes any.
    """
    points = scattered(120, 0.0, 1.0)
    rng = np.random.default_rng(1)
    material = np.repeat([0, 2], 60)
    order = rng.permutation(120)
    partner = assign_particles(points, points[order] + 1e-6, material, material[order])
    np.testing.assert_array_equal(order[partner], np.arange(120))
    points = scattered(90, 0.0, 1.0)
    zeros = np.zeros(90, np.int64)
    fewer = assign_particles(points, points[:30], zeros, zeros[:30])
    assert np.bincount(fewer, minlength=30).tolist() == [3] * 30
    more = assign_particles(points[:30], points, zeros[:30], zeros)
    assert len(set(more.tolist())) == 30
    assert set(
        assign_particles(points[:9], points[:9], zeros[:9] + 3, zeros[:9]).tolist()
    ) == set(range(9))


def test_the_subset_that_carries_mass_is_spread_evenly() -> None:
    """A quarter of a jittered lattice has four in 4 x 4 spacings, far more evenly than
    by chance.
    """
    side = np.stack(np.meshgrid(np.arange(48), np.arange(48)), axis=-1).reshape(-1, 2)
    points = (side + 0.5 + 0.2 * scattered(48 * 48, -0.5, 0.5)) / 48
    material = (points[:, 0] > 0.5).astype(np.int8)
    chosen = spread_subset(points, material, 576)
    assert len(set(chosen.tolist())) == 576
    assert np.count_nonzero(material[chosen]) == 288
    cell = (points[chosen] * 12).astype(int)
    counts = np.bincount(cell[:, 0] * 12 + cell[:, 1], minlength=144)
    assert counts.min() >= 1
    assert counts.std() < 1.4  # a random choice: 2
    np.testing.assert_array_equal(chosen, spread_subset(points, material, 576))


def test_the_coarse_solver_at_full_resolution_is_the_solver() -> None:
    """With the grid, time step and particles of its own size it moves them as the
    solver does.
    """
    size = load().size("fluid", "tiny")
    n = size.task.input_frames
    count = size.particles
    block = (
        np.stack(np.meshgrid(np.arange(16), np.arange(16)), axis=-1).reshape(-1, 2) / 80
        + 0.4
    )
    speed = np.tile([0.5, 0.2], (count, 1))
    path = np.stack([block - speed * size.frame_interval * k for k in range(n)[::-1]])
    scenario = given("fluid", path, area=0.04)
    found = list(predict_with(scenario, size))
    fall = np.array([0.0, -0.5 * size.value("gravity") * size.frame_interval])
    solver = compiled(solver_constants(size))
    velocity = (path[-1] - path[-2]) / size.frame_interval + fall
    rest = {
        "affine": np.zeros((count, 2, 2)),
        "material": np.zeros(count, np.int8),
        "area": 0.04,
    }
    solver.load([InitialState(position=path[-1], velocity=velocity, **rest)])
    for frame in found:
        solver.advance(size.substeps_per_frame)
        np.testing.assert_array_equal(frame, solver.position()[0])


def test_the_coarse_solver_is_driven_by_the_walls_of_each_frame() -> None:
    """A solver that is told each frame's walls before it moves there goes the same way,
    to the bit.
    """
    size = load().size("cavity", "tiny")
    n = size.task.input_frames
    frames = size.task.input_frames + size.task.horizon
    (left, right), (bottom, top) = size.bounds
    unit = (
        np.stack(np.meshgrid(np.arange(18), np.arange(18)), axis=-1).reshape(-1, 2)
        + 0.5
    ) / 18
    place = np.array([left, bottom]) + unit * np.array([right - left, top - bottom])
    walls = np.zeros((frames, 4, 2))
    walls[:, 3, 0] = (
        0.2 * np.random.default_rng(0).normal(size=frames) * size.frame_interval
    )
    scenario = given(
        "cavity", np.stack([place] * n), area=(right - left) * (top - bottom)
    )
    scenario = replace(scenario, walls=walls, parameters={"viscosity": 1e-3})
    found = list(predict_with(scenario, size))
    solver = compiled(replace(solver_constants(size), particles=len(place)))
    still = {
        "affine": np.zeros((len(place), 2, 2)),
        "material": scenario.material,
        "area": scenario.area,
    }
    still |= {
        "velocity": np.zeros_like(place),
        "wall_velocity": np.zeros((4, 2)),
        "viscosity": 1e-3,
    }
    solver.load([InitialState(position=place, **still)])
    for frame, speed in zip(found, walls[n:] / size.frame_interval, strict=True):
        solver.move_walls(speed[None].astype(np.float32))
        solver.advance(size.substeps_per_frame)
        np.testing.assert_array_equal(frame, solver.position()[0])


def test_the_coarse_solver_moves_all_particles() -> None:
    """A falling block on the coarser grid falls as a whole: bodies in flight keep their
    parabola.
    """
    size = load().size("fluid", "mini")
    coarse = coarser(size, 2)
    assert coarse is not None
    side = np.stack(np.meshgrid(np.arange(25), np.arange(25)), axis=-1).reshape(-1, 2)
    block = side / 120 + np.array([0.4, 0.6])
    scenario = given(
        "fluid", np.stack([block, block]), size="mini", area=(25 / 120) ** 2
    )
    frames = predict_with(scenario, coarse)
    for k, frame in zip(range(1, 11), frames, strict=False):
        fallen = 0.5 * size.value("gravity") * size.frame_interval**2 * k * (k + 1)
        np.testing.assert_allclose(
            np.mean(block - frame, axis=0), [0.0, fallen], atol=1e-3
        )
        assert frame.shape == block.shape


def test_an_analog_needs_all_of_train(
    bench: ScoreBench, copied: Callable[[], Path]
) -> None:
    """One scenario of train that is missing: the other floors are measured, and scoring
    works.

    Who asks for an analog all the same is told.
    """
    root = copied()
    assert "analog" in measurable(bench.size, root)
    train = root / bench.size.split / bench.size.name / f"v{bench.size.major}" / "train"
    next(iter(sorted(train.glob("*.nc")))).unlink()
    expected = ("persistence", "constant-velocity", "frozen-field")
    assert measurable(bench.size, root) == expected
    shutil.rmtree(train)
    with pytest.raises(DataError):
        predicted("analog", opened(root, bench.size, bench.size.subsets["test"][0])[0])
    alone = replace(bench, root=root)
    card = alone.evaluate(bench.submit(root / "predictions.nc", straight))
    assert tuple(card.scores) == (SUBMISSION, *expected)
    assert card.skill is not None


@pytest.mark.parametrize(
    "path", sorted(FOLDER.glob("*.json")), ids=lambda path: path.stem
)
def test_shipped_scores_belong_to_the_registry(path: Path) -> None:
    """Hash, floors, scenarios and ranking metric are those of the size that the file
    names.
    """
    said = json.loads(path.read_text())
    size = load().size(said["split"], said["size"])
    assert path == shipped_path(size)
    assert path.stat().st_size < 200_000
    if major_of(said["dataset_version"]) != size.major:
        pytest.skip("measured on another version of the data")
    scenario = shipped(size)
    assert list(scenario) == [floor.name for floor in references_of(size)]
    ranking = ranking_metric(size)
    for floor in scenario.values():
        score = floor.scores[ranking]
        assert score.scenarios == tuple(sorted(size.subsets["test"]))
        assert score.mean > 0.0
        assert floor.correlation.shape == score.values.shape
    assert (
        best_reference(
            {
                name: scenario[name].scores[ranking]
                for name in NAIVE.intersection(scenario)
            }
        )
        is not None
    )


@pytest.mark.parametrize("axes", [(), (0,), (1,), (0, 1)])
def test_a_mirror_image_of_a_mirror_image_is_the_scenario(
    axes: tuple[int, ...],
) -> None:
    box = Box.from_bounds(load().size("cavity", "mini").bounds)
    mirror = Mirror(box, axes)
    points = scattered(30, 0.1, 0.9)
    walls = np.random.default_rng(1).normal(size=(5, 4, 2))
    image = mirror.positions(points)
    assert box.contains(image).all()
    np.testing.assert_allclose(mirror.positions(image), points, atol=1e-15)
    np.testing.assert_array_equal(mirror.walls(mirror.walls(walls)), walls)
    if 0 in axes:
        # what moved up beside the left wall moves up beside the right one
        np.testing.assert_array_equal(
            np.abs(mirror.walls(walls)[:, 1]), np.abs(walls[:, 0])
        )


def test_the_mirror_image_of_a_scenario_of_train_is_found_and_predicted(
    bench: ScoreBench,
) -> None:
    """Both axes of a full box may be reversed: the answer is the mirrored future."""
    number = bench.size.subsets["train"][0]
    scenario, future = opened(bench.root, bench.size, number)
    mirror = Mirror(scenario.box, (0,))
    image = replace(
        scenario,
        position=mirror.positions(scenario.position),
        walls=mirror.walls(scenario.walls),
    )
    analog, reversal = find_analog(image)
    assert analog == number
    assert reversal.axes == (0,)
    np.testing.assert_allclose(
        predicted("analog", image), mirror.positions(future), atol=1e-5
    )


def test_two_bodies_touch_when_they_are_a_radius_apart() -> None:
    left = scattered(60, 0.0, 0.1)
    right = scattered(60, 0.0, 0.1, seed=1) + np.array([0.3, 0.0])
    position = np.concatenate([left, right])
    body = label_bodies(position, 0.05)
    assert set(body[:60].tolist()) == {body[0]}
    assert set(body[60:].tolist()) == {1 - body[0]}
    assert not bodies_touch(position, body, 0.05)
    position[60:, 0] -= 0.2
    assert bodies_touch(position, body, 0.05)


def test_a_flight_ends_when_a_tenth_of_the_particles_lie_on_the_floor() -> None:
    """A block that falls from 0.2 above the floor needs sqrt(2 h / g) for it."""
    size = load().size("fluid", "mini")
    block = scattered(400, 0.0, 0.1) + np.array([0.4, size.bounds[1][0] + 0.2])
    scenario = given("fluid", np.stack([block, block]), size="mini")
    fallen = 0.2 + 0.1 * 0.1  # a tenth of the block lies below a tenth of its height
    expected = math.sqrt(2.0 * fallen / size.value("gravity")) / size.frame_interval
    assert abs(frames_of_flight(scenario) - expected) < 2.0


@pytest.fixture(scope="module")
def splash(tiny_split: Callable[..., object], home: Path) -> tuple[Path, Size]:
    """Return the root of a generated splash and its size."""
    tiny_split("fluid")
    return home / "tiny-fluid", load().size("fluid", "tiny")


def test_a_state_of_train_is_nearest_to_itself(splash: tuple[Path, Size]) -> None:
    """Its mirror image too; without itself another scenario is nearest."""
    root, size = splash
    number, other = size.subsets["train"][:2]
    frame = 9
    with read_scenario(size.path(root, number)) as file:
        material = file.read("material")
        now = file.read("position", frame).astype(np.float64)
        before = file.read("position", frame - 1).astype(np.float64)
    library = state_library(size, root, np.unique(material).tolist())
    assert library is not None
    for image, mirror in enumerate(mirrors_of(size)):
        velocity = mirror.velocities(now - before)
        feature = describe_state(mirror.positions(now), velocity, material)
        (state,) = library.nearest(feature, count=1)
        assert library.scenarios[state] == number
        assert library.mirrors[state] == image
        assert library.frames[state] == frame
        (state,) = library.nearest(feature, count=1, without=number)
        assert library.scenarios[state] == other


def test_after_contact_the_particles_follow_their_analogs(
    splash: tuple[Path, Size],
) -> None:
    """A body that starts on the floor, as no scenario does, follows train at once."""
    root, size = splash
    scenario, _ = opened(root, size, size.subsets["train"][0])
    depth = scenario.last[:, 1].min() - size.bounds[1][0]
    on_floor = scenario.position - np.array([0.0, depth])
    # so deep that more than a tenth of the particles touch at once
    on_floor[..., 1] = np.maximum(on_floor[..., 1] - 0.05, size.bounds[1][0])
    resting = replace(scenario, position=on_floor)
    assert frames_of_flight(resting) == 0
    library = state_library(size, root, np.unique(scenario.material).tolist())
    choice = Choice(lag=0, analogs=2)
    positions = list(predict_positions(resting, choice, library=library))
    assert len(positions) == size.task.horizon
    assert scenario.box.contains(np.stack(positions)).all()
    step = np.abs(positions[0] - resting.last).max()
    assert step < 0.05
    without_train = list(predict_positions(resting, choice, library=None))
    assert np.abs(positions[-1] - without_train[-1]).max() > 0.01


def test_what_predicts_train_best_is_chosen(splash: tuple[Path, Size]) -> None:
    root, size = splash
    best = choose(size, root)
    scenarios = {n: opened(root, size, n)[0] for n in size.subsets["train"]}

    def mean_error(choice: Choice) -> float:
        return float(
            np.mean([cloud_error(given, choice, n) for n, given in scenarios.items()])
        )

    least = mean_error(best)
    for choice in (Choice(lag=0, analogs=1), Choice(lag=10, analogs=2)):
        assert least <= mean_error(choice)


def test_climatology_is_made_of_the_clouds_of_train(splash: tuple[Path, Size]) -> None:
    """Each position is that of a particle of train at that frame, or mirrored."""
    root, size = splash
    scenario, _ = opened(root, size, size.subsets["test"][0])
    positions = predicted("climatology", scenario)
    frame = size.task.input_frames + 3
    clouds = []
    for number in size.subsets["train"]:
        with read_scenario(size.path(root, number)) as file:
            cloud = np.asarray(file.read("position", frame), np.float64)
        for mirror in mirrors_of(size):
            clouds.append(mirror.positions(cloud))
    nearest, _ = KDTree(np.concatenate(clouds)).query(positions[3])
    assert nearest.max() < 1e-6
