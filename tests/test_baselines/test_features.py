"""Features, noise and symmetries of graph networks against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from simple_models import RADIUS, batch, info, jittered, swirl
from torch.testing import assert_close

from lagbench.baselines.augmentation import (
    Symmetry,
    add_walk_noise,
    draw_mirror_matrices,
    mirror_batch,
)
from lagbench.baselines.graph import (
    NodeFeatures,
    Standardisation,
    edge_features,
    radius_graph,
    wall_distance,
)
from lagbench.data.box import UNIT_SQUARE
from lagbench.tensors import TensorBox

BOUNDS = info().bounds
UNIT_BOX = TensorBox(UNIT_SQUARE)


def generator(seed: int = 0) -> torch.Generator:
    """Return a seeded source of randomness."""
    source = torch.Generator()
    return source.manual_seed(seed)


def node_features(**options: bool) -> NodeFeatures:
    """Return the features of the test's box, the scales without noise."""
    statistics = info().statistics
    torch.manual_seed(0)
    velocity = Standardisation(
        statistics["velocity_mean"],
        statistics["velocity_std"],
    )
    acceleration = Standardisation(
        statistics["acceleration_mean"],
        statistics["acceleration_std"],
    )
    return NodeFeatures(BOUNDS, velocity, acceleration, RADIUS, **options)


def test_noise_widens_the_deviation_of_the_data() -> None:
    """Data of deviation 3 and 0 with noise of deviation 4 have deviation 5 and 4."""
    scale = Standardisation((1.0, 2.0), (3.0, 0.0), noise=4.0)
    value = torch.tensor(
        [
            [6.0, 6.0],
            [-4.0, 2.0],
        ]
    )
    expected = torch.tensor(
        [
            [1.0, 1.0],
            [-1.0, 0.0],
        ]
    )
    assert torch.equal(scale(value), expected)
    assert torch.equal(scale.inverse(expected), value)


def test_walls_are_seen_within_the_radius_only() -> None:
    """In the box [1/16, 15/16] with radius 1/16: left, right, bottom, top by hand."""
    position = torch.tensor(
        [
            [0.5, 0.5],
            [0.09375, 0.875],
            [0.0, 0.921875],
        ]
    )
    expected = torch.tensor(
        [
            [1.0, 1.0, 1.0, 1.0],
            # (0.09375 - 0.0625) / 0.0625; the top is one radius away
            [0.5, 1.0, 1.0, 1.0],
            # one radius outside; (0.9375 - 0.921875) / 0.0625
            [-1.0, 1.0, 1.0, 0.25],
        ]
    )
    distance = wall_distance(position, BOUNDS, RADIUS)
    assert torch.equal(distance, expected)


def test_edges_show_what_a_loop_over_pairs_shows() -> None:
    """Displacement and distance over the radius equal a double loop in float64."""
    position = jittered(3)
    points = torch.from_numpy(position)
    edges = radius_graph(points, RADIUS)
    features = edge_features(points, edges, RADIUS, UNIT_BOX).numpy()

    expected = []
    for sender, receiver in edges.T.tolist():
        difference = position[sender] - position[receiver]
        x, y = difference / RADIUS
        expected.append((x, y, np.hypot(x, y)))
    assert len(expected) > 500
    np.testing.assert_allclose(features, expected, atol=1e-14)
    assert features[:, 2].max() <= 1.0


def test_two_particles_in_one_place_have_no_gradient_of_distance() -> None:
    """Their distance is 0, and so is its gradient."""
    position = torch.tensor(
        [
            [0.5, 0.5],
            [0.5, 0.5],
            [0.5, 0.53125],
        ],
        requires_grad=True,
    )
    senders = [0, 2]
    receivers = [1, 1]
    edges = torch.tensor([senders, receivers])
    features = edge_features(position, edges, RADIUS, UNIT_BOX)
    distance = features[:, 2]
    assert distance.tolist() == [0.0, 0.5]
    distance.sum().backward()
    # d distance / d y of the third is 1 / radius, of the second its opposite.
    expected = torch.tensor(
        [
            [0.0, 0.0],
            [0.0, -16.0],
            [0.0, 16.0],
        ]
    )
    assert position.grad is not None
    assert torch.equal(position.grad, expected)


def test_a_particle_shows_thirty_numbers() -> None:
    """The last velocity and its four changes, four walls and an embedding.

    Velocities and changes are given in deviations.
    """
    features = node_features()
    # The deviations are (0.004, 0.003) and (0.0002, 0.0001): changes of 1, 2, 3 and 4
    # deviations end at 0.002 and 0.001.
    changes = torch.tensor([0.0, 1.0, 3.0, 6.0, 10.0])
    deviation = torch.tensor([0.0002, 0.0001])
    velocity = changes[None, :, None] * deviation
    position = torch.tensor([[0.5, 0.5]])
    material = torch.tensor([2])
    numbers = features(position, velocity, material)

    assert features.count == 30
    assert numbers.shape == (1, 30)
    expected = torch.tensor(
        [
            [0.5, 1 / 3],
            [1.0, 1.0],
            [2.0, 2.0],
            [3.0, 3.0],
            [4.0, 4.0],
        ]
    )
    motion = numbers[0, :10]
    walls = numbers[0, 10:14]
    embedding = features.embedding.weight[2]
    assert_close(motion, expected.flatten())
    assert walls.tolist() == [1.0] * 4
    assert torch.equal(numbers[0, 14:], embedding)


def test_moving_walls_are_felt_near_them() -> None:
    """A wall's velocity counts in full at the wall, by half half-way, 0 beyond.

    It is given in deviations.
    """
    features = node_features(moving_walls=True)
    assert features.count == 38
    position = torch.tensor(
        [
            [0.5, 0.9375],
            [0.5, 0.90625],
            [0.5, 0.8],
        ]
    )
    wall_velocity = torch.zeros(3, 4, 2)
    top_velocity = torch.tensor([0.008, 0.003])
    wall_velocity[:, 3] = top_velocity
    at_rest = torch.zeros(3, 5, 2)
    material = torch.zeros(3, dtype=torch.int64)

    numbers = features(position, at_rest, material, wall_velocity)
    walls = numbers[:, 30:].reshape(3, 4, 2)
    expected = torch.tensor(
        [
            [2.0, 1.0],
            [1.0, 0.5],
            [0.0, 0.0],
        ]
    )
    assert_close(walls[:, 3], expected)
    assert not walls[:, :3].any()

    without_walls = features(position, at_rest, material)
    assert not without_walls[:, 30:].any()


def test_noise_has_the_stated_deviation_at_the_last_velocity() -> None:
    """Velocity noise is a walk: covariance of steps j and k is std^2 min(j, k) / 5.

    Components, and neighbours in the row, are uncorrelated.
    """
    at_rest = torch.zeros(40_000, 6, 2)
    walks = add_walk_noise(at_rest, 6, 0.3, generator())
    assert not walks[:, 0].any()
    velocity = walks.diff(dim=1)
    draw_count = velocity[:, 0].numel()
    products = torch.einsum("pjc,pkc->jk", velocity, velocity)
    covariance = products / draw_count
    step = torch.arange(1.0, 6.0)
    earlier_step = torch.minimum(step[:, None], step)
    expected = 0.09 * earlier_step / 5.0
    # The error of a variance from n draws is sqrt(2 / n) of it. With 80,000 draws it
    # is 0.5 %; five of those are allowed.
    assert_close(covariance, expected, rtol=0.0, atol=0.025 * 0.09)
    last = velocity[:, -1]
    assert abs(float(last.std()) - 0.3) < 0.003

    x, y = (last / 0.3).T
    component_correlation = float((x * y).mean())
    assert abs(component_correlation) < 5 / np.sqrt(len(x))
    neighbours = x[1:] * x[:-1]
    neighbour_correlation = float(neighbours.mean())
    assert abs(neighbour_correlation) < 5 / np.sqrt(len(neighbours))


def test_the_target_makes_up_for_the_noise() -> None:
    """The next velocity is the true one.

    The acceleration is the true one less the noise of the velocity.
    """
    window = batch(swirl(0, 8))
    truth = window.position.double()
    disturbed = add_walk_noise(truth, 6, 1e-3, generator(1))
    noise = disturbed - truth
    last_noise = noise[:, 5].abs()
    assert float(last_noise.mean()) > 1e-4

    velocity = disturbed.diff(dim=1)
    true_velocity = truth.diff(dim=1)
    velocity_noise = noise.diff(dim=1)
    next_velocity = velocity[:, 5:]
    true_next_velocity = true_velocity[:, 5:]
    assert_close(next_velocity, true_next_velocity, atol=1e-15, rtol=0)
    acceleration = velocity.diff(dim=1)[:, 4]
    true_acceleration = true_velocity.diff(dim=1)[:, 4]
    expected = true_acceleration - velocity_noise[:, 4]
    assert_close(acceleration, expected, atol=1e-15, rtol=0)


@pytest.mark.parametrize(
    ("symmetry", "image_count"),
    [
        ("none", 1),
        ("mirror", 2),
        ("square", 8),
    ],
)
def test_every_image_is_drawn_evenly(symmetry: str, image_count: int) -> None:
    """Each mirror image comes up equally often, within five deviations."""
    kind = Symmetry(symmetry)
    matrices = draw_mirror_matrices(kind, 8000, generator())
    flat = matrices.reshape(-1, 4)
    images, counts = flat.unique(dim=0, return_counts=True)
    row_sums = images.abs().sum(dim=1)
    assert len(images) == image_count
    assert row_sums.tolist() == [2.0] * image_count
    assert [1.0, 0.0, 0.0, 1.0] in images.tolist()
    expected = 8000 / image_count
    deviation = abs(counts - expected)
    assert deviation.max() <= 5 * np.sqrt(expected)
    if symmetry == "mirror":
        assert (images[:, 3] == 1.0).all()  # gravity stays down


def test_walls_move_with_the_particles_on_them() -> None:
    """In every image a particle that rides on a wall still rides on its wall."""
    middle = np.array(
        [
            [0.0625, 0.5],
            [0.9375, 0.5],
            [0.5, 0.0625],
            [0.5, 0.9375],
        ]
    )
    standing = np.stack([middle, middle])
    at_rest = batch(standing, walls=True)
    wall_velocity = at_rest.wall_velocity[0, 0].numpy()
    moving = np.stack([middle, middle + wall_velocity])
    riders = batch(moving, walls=True)
    middle_of_walls = torch.from_numpy(middle).float()

    wall_orders = set()
    matrices = draw_mirror_matrices(Symmetry.SQUARE, 200, generator())
    for matrix in matrices.unique(dim=0):
        image = mirror_batch(riders, matrix[None], BOUNDS)
        first = image.position[:, 0]
        velocity = image.position[:, 1] - first
        to_walls = first[:, None] - middle_of_walls
        distance = to_walls.norm(dim=2)
        wall = distance.argmin(dim=1)
        own_wall_velocity = image.wall_velocity[0, 0][wall]
        assert_close(own_wall_velocity, velocity, atol=1e-6, rtol=0)
        wall_orders.add(tuple(wall.tolist()))
    assert len(wall_orders) == 8
