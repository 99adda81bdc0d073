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
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from scipy.spatial import KDTree
from score_bench import ScoreBench, straight

from lagbench.data.box import UNIT_SQUARE, Box
from lagbench.data.layout import major_of
from lagbench.data.registry import Size, load
from lagbench.data.scenario import read_scenario
from lagbench.errors import DataError
from lagbench.metrics.table import ranking_metric
from lagbench.references import (
    REFERENCES,
    Given,
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
from lagbench.references.assignment import MOST_TOGETHER, assign_particles
from lagbench.references.ballistic_analog import (
    Choice,
    bodies_touch,
    fly_then_follow,
    frames_of_flight,
    label_bodies,
)
from lagbench.references.frozen_field import decay
from lagbench.references.predictor import linear_field, with_wall_images
from lagbench.references.restarted import spread_subset
from lagbench.references.shipped import FOLDER, shipped_path
from lagbench.references.table import NAIVE
from lagbench.references.train_library import (
    Mirror,
    describe_state,
    mirrors_of,
    state_library,
)
from lagbench.scoring.score import measurable
from lagbench.scoring.skill import best_reference
from lagbench.scoring.task import SUBMISSION

Floats = NDArray[np.float64]


def given(
    split: str,
    position: Floats,
    *,
    size: str = "tiny",
    root: Path = Path(),
    **changes: Any,
) -> Given:
    """Return what a made-up scenario gives; its walls are at rest by default."""
    described = load().size(split, size)
    frame_count = described.task.input_frames + described.task.horizon
    walls = np.zeros((frame_count, 4, 2))
    walls[:, :] = changes.pop("wall", 0.0)
    x_bounds, y_bounds = described.bounds
    box_area = np.ptp(x_bounds) * np.ptp(y_bounds)
    liquid = np.zeros(position.shape[1], np.int8)
    return Given(
        size=described,
        root=root,
        position=np.asarray(position, np.float64),
        material=changes.pop("material", liquid),
        walls=walls,
        area=changes.pop("area", box_area),
        parameters=changes,
    )


def scattered(count: int, low: float, high: float, seed: int = 0) -> Floats:
    """Return points of a square, shape [point, 2]."""
    rng = np.random.default_rng(seed)
    share = rng.random((count, 2))
    return np.asarray(low + (high - low) * share)


def lattice(side: int) -> Floats:
    """Return the corners of side x side unit squares, shape [point, 2]."""
    axis = np.arange(side, dtype=float)
    columns, rows = np.meshgrid(axis, axis)
    return np.stack([columns, rows], axis=-1).reshape(-1, 2)


def predicted(name: str, scenario: Given) -> NDArray[np.float32]:
    """Return what a predictor predicts, shape [frame, particle, 2]."""
    positions = REFERENCES[name].predict(scenario)
    return np.array(list(positions))


def own_split(size: Size, *, placement: str) -> Size:
    """Return a split of a user: without generator, gravity or recorded scores."""
    parameters = dict(size.parameters)
    parameters.pop("gravity", None)
    grid_changes = {"placement": placement}
    grid = size.task.score_grid.model_copy(update=grid_changes)
    task_changes = {"score_grid": grid}
    task = size.task.model_copy(update=task_changes)
    changes = {
        "split": "own",
        "name": "full",
        "generator": "none",
        "parameters": parameters,
        "task": task,
    }
    return size.model_copy(update=changes)


SURFACE = "persistence constant-velocity ballistic climatology analog ballistic-analog"
FULL_BOX = (
    "persistence constant-velocity frozen-field analog"
    " projection projection-2x projection-3x upwind upwind-2x upwind-3x"
)
RESTARTED = "restarted restarted-two-thirds restarted-half restarted-quarter"


@pytest.mark.parametrize(
    ("split", "size", "names"),
    [
        ("cavity", "full", f"{FULL_BOX} {RESTARTED}"),
        ("fluid", "full", f"{SURFACE} {RESTARTED}"),
        ("own", "cell_centres", FULL_BOX),
        ("own", "nodes", "persistence constant-velocity analog"),
    ],
)
def test_a_size_has_the_predictors_of_its_kind_of_box(
    split: str,
    size: str,
    names: str,
) -> None:
    """A user's own split goes by its kind of box; without gravity nothing falls."""
    if split == "own":
        fluid = load().size("fluid", "mini")
        tier = own_split(fluid, placement=size)
        assert shipped(tier) is None
    else:
        tier = load().size(split, size)
    tier_names = [predictor.name for predictor in references_of(tier)]
    assert " ".join(tier_names) == names


@pytest.mark.parametrize("name", ["persistence", "constant-velocity", "ballistic"])
def test_extrapolations_stay_inside_the_walls(name: str) -> None:
    """Fast particles stop at the walls; positions are float32, one per frame."""
    start = scattered(300, 0.2, 0.8)
    frames = np.stack([start, start + 0.05])
    scenario = given("fluid", frames)
    positions = predicted(name, scenario)
    (left, right), (bottom, top) = scenario.size.bounds
    horizon = scenario.size.task.horizon
    x = positions[..., 0]
    y = positions[..., 1]
    assert positions.dtype == np.float32
    assert positions.shape == (horizon, 300, 2)
    assert x.max() <= np.float32(right)
    assert y.max() <= np.float32(top)
    least = min(left, bottom)
    assert positions.min() >= np.float32(least)


def test_ballistic_flight_is_a_parabola() -> None:
    """Frames of y = y0 + v t - g t^2 / 2 continue on the same parabola."""
    size = load().size("fluid", "tiny")
    n = size.task.input_frames
    frame_count = n + size.task.horizon
    time = np.arange(frame_count) * size.frame_interval
    fall = 0.5 * size.value("gravity") * time**2
    start = scattered(50, 0.4, 0.6)
    path = np.repeat(start[None], len(time), axis=0)
    distance = 0.1 * time
    height = 0.8 * time - fall
    path[..., 0] += distance[:, None]
    path[..., 1] += height[:, None]
    scenario = given("fluid", path[:n])
    positions = predicted("ballistic", scenario)
    assert_allclose(positions, path[n:], atol=2e-6)


def test_a_frozen_rotation_stays_a_rotation() -> None:
    """Particles of a rigid rotation keep their distance and their angle per frame."""
    centre = np.array([0.5, 0.5])
    angle = 0.05  # per frame
    cos = math.cos(angle)
    sin = math.sin(angle)
    offset = scattered(4000, -0.4, 0.4)
    rotation = np.array(
        [
            [cos, -sin],
            [sin, cos],
        ]
    )
    before = centre + offset @ rotation
    last = centre + offset
    frames = np.stack([before] * 5 + [last])
    scenario = given("cavity", frames, wall=1e-9)
    positions = predicted("frozen-field", scenario)

    is_inner = np.hypot(*offset.T) < 0.25
    first_x, first_y = offset[is_inner].T
    last_x, last_y = (positions[-1][is_inner] - centre).T
    first_radius = np.hypot(first_x, first_y)
    last_radius = np.hypot(last_x, last_y)
    assert_allclose(last_radius, first_radius, rtol=2e-3)
    first_angle = np.arctan2(first_y, first_x)
    last_angle = np.arctan2(last_y, last_x)
    expected_turn = scenario.size.task.horizon * angle
    deviation = last_angle - first_angle - expected_turn
    assert_allclose(np.cos(deviation), 1.0, atol=1e-3)


def test_decay_of_an_exponential() -> None:
    """Displacements that shrink by 0.9 a frame decay by 0.9.

    Growing ones and rest do not decay.
    """
    step = scattered(20, -0.01, 0.01)
    frame = np.arange(6)[:, None, None]
    shrinking_steps = step * 0.9**frame
    growing_steps = step * 1.1**frame
    shrinking = np.cumsum(shrinking_steps, axis=0)
    growing = np.cumsum(growing_steps, axis=0)
    at_rest = np.repeat(step[None], 6, axis=0)
    assert decay(shrinking, UNIT_SQUARE) == pytest.approx(0.9)
    assert decay(growing, UNIT_SQUARE) == 1.0
    assert decay(at_rest, UNIT_SQUARE) == 1.0


@pytest.mark.parametrize("wall_speed", [0.0, 0.02])
def test_the_mirrored_field_meets_the_wall(wall_speed: float) -> None:
    """A shear flow goes on through a wall that slides.

    A wall at rest lets a stagnation flow slide.
    """
    wall = np.zeros((4, 2))
    wall[3, 0] = wall_speed
    at_centre = np.zeros((6, 1, 2))
    scenario = given("cavity", at_centre, wall=wall)
    low, high = scenario.size.bounds[0]
    points = scattered(3000, low, high)
    depth = high - points[:, 1]
    if wall_speed:
        tangential = wall_speed + 0.3 * depth
        expected = (wall_speed, 0.0)
    else:
        tangential = np.full_like(depth, 0.01)
        expected = (0.01, 0.0)
    velocity = np.stack([tangential, 0.2 * depth], axis=1)
    images = with_wall_images(scenario, points, velocity, wall)
    field = linear_field(*images)

    x = np.linspace(0.3, 0.7, 20)
    y = np.full(20, high)
    at_wall = np.stack([x, y], axis=1)
    expected_velocity = np.tile(expected, (20, 1))
    assert_allclose(field(at_wall), expected_velocity, atol=1e-12)


def test_the_field_is_linear_and_has_no_holes() -> None:
    """A linear field is exact between the points; outside the nearest point answers."""
    points = scattered(200, 0.0, 1.0)
    gradient = np.array(
        [
            [0.1, -0.3],
            [0.2, 0.05],
        ]
    )
    field = linear_field(points, points @ gradient)
    inside = scattered(50, 0.3, 0.7, seed=1)
    expected = inside @ gradient
    assert_allclose(field(inside), expected, atol=1e-12)
    outside = np.array([[5.0, 5.0]])
    difference = points - outside
    square_distance = np.sum(difference**2, axis=1)
    nearest = points[np.argmin(square_distance)]
    nearest_velocity = field(outside)[0]
    assert_allclose(nearest_velocity, nearest @ gradient)


def opened(
    root: Path,
    size: Size,
    scenario: int,
) -> tuple[Given, NDArray[np.float32]]:
    """Return what a scenario of a generated data set gives, and its future."""
    n = size.task.input_frames
    frame_count = n + size.task.horizon
    with read_scenario(size.path(root, scenario)) as file:
        future = file.read("position", slice(n, frame_count))
        return given_in(file, size, root), future


def open_first(root: Path, size: Size, subset: str) -> Given:
    """Return what the first scenario of a subset gives."""
    number = size.subsets[subset][0]
    scenario, _ = opened(root, size, number)
    return scenario


def test_a_scenario_of_train_is_its_own_analog(bench: ScoreBench) -> None:
    """Its motion carries the particles where they go."""
    number = bench.size.subsets["train"][1]
    scenario, future = opened(bench.root, bench.size, number)
    analog, mirror = find_analog(scenario)
    assert analog == number
    assert mirror.axes == ()
    positions = predicted("analog", scenario)
    assert_allclose(positions, future, atol=1e-5)


def test_a_start_is_as_near_wherever_in_the_box_it_is(bench: ScoreBench) -> None:
    """Moved together two clouds stay as far apart.

    On the mean over directions 0.1 along x has half its square, and the cloud half of
    its variances' sum.
    """
    scenario = open_first(bench.root, bench.size, "test")
    start = describe_start(scenario)

    def move(x: float, y: float) -> InitialCloud:
        shift = np.array([x, y]) @ DIRECTIONS[2]
        clouds = {}
        for material, cloud in start.clouds.items():
            clouds[material] = cloud + shift
        return replace(start, clouds=clouds)

    near = distance(start, move(0.1, 0.0))
    first = move(0.3, -0.2)
    second = move(0.4, -0.2)
    elsewhere = distance(first, second)
    assert elsewhere == pytest.approx(near)
    variance = scenario.last.var(axis=0)
    deviation = np.sqrt(variance.sum())
    expected = 0.1 / deviation
    assert near == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize(
    ("count", "together"),
    [
        (4400, MOST_TOGETHER),
        (1400, 640),
    ],
)
def test_many_particles_of_three_dimensions_find_themselves(
    count: int, together: int
) -> None:
    """Clouds beyond what is assigned together are halved alike: a cloud in another
    order is found again, also through the ends of a periodic box.
    """
    rng = np.random.default_rng(0)
    points = rng.random((count, 3))
    order = rng.permutation(len(points))
    liquid = np.zeros(len(points), np.int8)
    bounds = [(0.0, 1.0)] * 3
    box = Box.from_bounds(bounds, [True, False, True])
    partner = assign_particles(
        points, points[order], liquid, liquid, box, most_together=together
    )
    partners = points[order][partner]
    np.testing.assert_array_equal(partners, points)


def test_a_permuted_cloud_is_assigned_particle_by_particle() -> None:
    """Each material is assigned on its own."""
    points = scattered(120, 0.0, 1.0)
    material = np.repeat([0, 2], 60)
    rng = np.random.default_rng(1)
    order = rng.permutation(120)
    moved = points[order] + 1e-6
    moved_material = material[order]
    partner = assign_particles(points, moved, material, moved_material)
    np.testing.assert_array_equal(order[partner], np.arange(120))


def test_unequal_clouds_are_assigned_evenly() -> None:
    """Fewer particles are taken more than once; of more some are left out."""
    points = scattered(90, 0.0, 1.0)
    liquid = np.zeros(90, np.int64)
    few_points = points[:30]
    few_liquid = liquid[:30]
    fewer = assign_particles(points, few_points, liquid, few_liquid)
    uses = np.bincount(fewer, minlength=30)
    assert uses.tolist() == [3] * 30
    more = assign_particles(few_points, points, few_liquid, liquid)
    distinct = set(more.tolist())
    assert len(distinct) == 30


def test_the_subset_that_carries_mass_is_spread_evenly() -> None:
    """A quarter of a jittered lattice has four in 4 x 4 spacings.

    Their number per cell deviates less than that of a random choice, which is 2.
    """
    noise = scattered(48 * 48, -0.5, 0.5)
    points = (lattice(48) + 0.5 + 0.2 * noise) / 48
    material = (points[:, 0] > 0.5).astype(np.int8)
    chosen = spread_subset(points, material, 576)
    distinct = set(chosen.tolist())
    assert len(distinct) == 576
    assert np.count_nonzero(material[chosen]) == 288
    column, row = (points[chosen] * 12).astype(int).T
    cell = column * 12 + row
    counts = np.bincount(cell, minlength=144)
    assert counts.min() >= 1
    assert counts.std() < 1.4
    again = spread_subset(points, material, 576)
    np.testing.assert_array_equal(chosen, again)


def test_the_subset_is_spread_evenly_in_three_dimensions() -> None:
    """An eighth of a jittered lattice has eight in 4 x 4 x 4 spacings.

    Their number per cell deviates less than that of a random choice, which is 2.6.
    """
    rng = np.random.default_rng(3)
    axes = [np.arange(16)] * 3
    coordinates = np.meshgrid(*axes, indexing="ij")
    corners = np.stack(coordinates, axis=-1).reshape(-1, 3)
    jitter = rng.uniform(-0.1, 0.1, corners.shape)
    points = (corners + 0.5 + jitter) / 16
    material = np.zeros(len(points), np.int8)
    chosen = spread_subset(points, material, 512)
    distinct = set(chosen.tolist())
    assert len(distinct) == 512
    x, y, z = (points[chosen] * 4).astype(int).T
    cell = (x * 4 + y) * 4 + z
    counts = np.bincount(cell, minlength=64)
    assert counts.min() >= 3
    assert counts.std() < 2.0


def test_an_analog_needs_all_of_train(
    bench: ScoreBench, copied: Callable[[], Path]
) -> None:
    """Without a scenario of train the other references are measured.

    A prediction by an analog is refused; scoring works.
    """
    root = copied()
    assert "analog" in measurable(bench.size, root)
    train = bench.size.folder(root) / "train"
    first_file = min(train.glob("*.nc"))
    first_file.unlink()
    expected = ("persistence", "constant-velocity", "frozen-field")
    assert measurable(bench.size, root) == expected

    shutil.rmtree(train)
    scenario = open_first(root, bench.size, "test")
    with pytest.raises(DataError):
        predicted("analog", scenario)
    predictions = bench.submit(root / "predictions.nc", straight)
    damaged = replace(bench, root=root)
    card = damaged.evaluate(predictions)
    assert tuple(card.scores) == (SUBMISSION, *expected)
    assert card.skill is not None


@pytest.mark.parametrize(
    "path",
    sorted(FOLDER.glob("*.json")),
    ids=lambda path: path.stem,
)
def test_shipped_scores_belong_to_the_registry(path: Path) -> None:
    """Hash, references, scenarios and ranking metric are those of the file's size."""
    content = json.loads(path.read_text())
    size = load().size(content["split"], content["size"])
    size = size.scored_on(content.get("subset", "test"))
    assert path == shipped_path(size)
    assert path.stat().st_size < 500_000
    major = major_of(content["dataset_version"])
    if major != size.major:
        pytest.skip("measured on another version of the data")

    references = shipped(size)
    names = {predictor.name for predictor in references_of(size)}
    assert references.keys() <= names
    ranking = ranking_metric(size)
    naive_scores = {}
    for name, reference in references.items():
        score = reference.scores[ranking]
        scored_scenarios = sorted(size.scored_scenarios)
        assert score.scenarios == tuple(scored_scenarios)
        assert score.mean > 0.0
        assert reference.correlation.shape == score.values.shape
        if name in NAIVE:
            naive_scores[name] = score
    assert best_reference(naive_scores) is not None


@pytest.mark.parametrize(
    "axes",
    [
        (),
        (0,),
        (1,),
        (0, 1),
    ],
)
def test_a_mirror_image_of_a_mirror_image_is_the_scenario(
    axes: tuple[int, ...],
) -> None:
    """A wall's upward motion is that of the wall across in the image along x."""
    bounds = load().size("cavity", "mini").bounds
    box = Box.from_bounds(bounds)
    mirror = Mirror(box, axes)
    points = scattered(30, 0.1, 0.9)
    image = mirror.positions(points)
    assert box.contains(image).all()
    assert_allclose(mirror.positions(image), points, atol=1e-15)

    rng = np.random.default_rng(1)
    walls = rng.normal(size=(5, 4, 2))
    wall_image = mirror.walls(walls)
    np.testing.assert_array_equal(mirror.walls(wall_image), walls)
    if 0 in axes:
        right_speed = np.abs(wall_image[:, 1])
        left_speed = np.abs(walls[:, 0])
        np.testing.assert_array_equal(right_speed, left_speed)


def test_the_mirror_image_of_a_scenario_of_train_is_found_and_predicted(
    bench: ScoreBench,
) -> None:
    """Both axes of a full box may be reversed: the answer is the mirrored future."""
    number = bench.size.subsets["train"][0]
    scenario, future = opened(bench.root, bench.size, number)
    mirror = Mirror(scenario.box, (0,))
    position = mirror.positions(scenario.position)
    walls = mirror.walls(scenario.walls)
    image = replace(scenario, position=position, walls=walls)
    analog, reversal = find_analog(image)
    assert analog == number
    assert reversal.axes == (0,)
    expected = mirror.positions(future)
    positions = predicted("analog", image)
    assert_allclose(positions, expected, atol=1e-5)


def test_two_bodies_touch_when_they_are_a_radius_apart() -> None:
    left = scattered(60, 0.0, 0.1)
    shift = np.array([0.3, 0.0])
    right = scattered(60, 0.0, 0.1, seed=1) + shift
    position = np.concatenate([left, right])
    body = label_bodies(position, 0.05)
    first_label = body[0]
    assert np.all(body[:60] == first_label)
    assert np.all(body[60:] == 1 - first_label)
    assert not bodies_touch(position, body, 0.05)
    position[60:, 0] -= 0.2
    assert bodies_touch(position, body, 0.05)


def test_a_flight_ends_when_a_tenth_of_the_particles_lie_on_the_floor() -> None:
    """A block that falls from 0.2 above the floor needs sqrt(2 h / g) for it."""
    size = load().size("fluid", "mini")
    _, (floor, _) = size.bounds
    corner = np.array([0.4, floor + 0.2])
    block = corner + scattered(400, 0.0, 0.1)
    frames = np.stack([block, block])
    scenario = given("fluid", frames, size="mini")
    fallen = 0.2 + 0.1 * 0.1  # a tenth of the block lies below a tenth of its height
    square_duration = 2.0 * fallen / size.value("gravity")
    duration = math.sqrt(square_duration)
    expected = duration / size.frame_interval
    difference = frames_of_flight(scenario) - expected
    assert abs(difference) < 2.0


@pytest.fixture(scope="module")
def splash(tiny_split: Callable[..., object], home: Path) -> tuple[Path, Size]:
    """Return the root of a generated splash and its size."""
    tiny_split("fluid")
    return home / "tiny-fluid", load().size("fluid", "tiny")


def test_a_state_of_train_is_nearest_to_itself(splash: tuple[Path, Size]) -> None:
    """Its mirror image too."""
    root, size = splash
    number = size.subsets["train"][0]
    frame = 9
    with read_scenario(size.path(root, number)) as file:
        material = file.read("material")
        frames = file.read("position", slice(frame - 1, frame + 1))
    before, now = frames.astype(np.float64)
    materials = np.unique(material).tolist()
    library = state_library(size, root, materials)
    assert library is not None
    for image, mirror in enumerate(mirrors_of(size)):
        position = mirror.positions(now)
        velocity = mirror.velocities(now - before)
        feature = describe_state(position, velocity, material)
        (state,) = library.nearest(feature, count=1)
        assert library.scenarios[state] == number
        assert library.mirrors[state] == image
        assert library.frames[state] == frame


def test_after_contact_the_particles_follow_their_analogs(
    splash: tuple[Path, Size],
) -> None:
    """A body that starts on the floor, as no scenario does, follows train at once."""
    root, size = splash
    scenario = open_first(root, size, "train")
    _, (floor, _) = size.bounds
    depth = scenario.last[:, 1].min() - floor
    # so deep that more than a tenth of the particles touch at once
    shift = np.array([0.0, depth + 0.05])
    on_floor = scenario.position - shift
    on_floor[..., 1] = on_floor[..., 1].clip(min=floor)
    resting = replace(scenario, position=on_floor)
    assert frames_of_flight(resting) == 0
    materials = np.unique(scenario.material)
    library = state_library(size, root, materials.tolist())
    choice = Choice(lag=0, analogs=2)
    prediction = fly_then_follow(resting, choice, library=library)
    positions = list(prediction)
    assert len(positions) == size.task.horizon
    assert scenario.box.contains(np.stack(positions)).all()
    first_step = positions[0] - resting.last
    assert np.abs(first_step).max() < 0.05
    prediction = fly_then_follow(resting, choice, library=None)
    without_train = list(prediction)
    difference = positions[-1] - without_train[-1]
    assert np.abs(difference).max() > 0.01


def test_climatology_is_made_of_the_clouds_of_train(splash: tuple[Path, Size]) -> None:
    """Each position is that of a particle of train at that frame, or mirrored."""
    root, size = splash
    scenario = open_first(root, size, "test")
    positions = predicted("climatology", scenario)
    frame = size.task.input_frames + 3
    clouds = []
    for number in size.subsets["train"]:
        with read_scenario(size.path(root, number)) as file:
            cloud = file.read("position", frame).astype(np.float64)
        for mirror in mirrors_of(size):
            clouds.append(mirror.positions(cloud))
    tree = KDTree(np.concatenate(clouds))
    nearest, _ = tree.query(positions[3])
    assert nearest.max() < 1e-6
