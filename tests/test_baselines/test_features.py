"""Features, noise and symmetries of graph networks against closed forms and brute
force.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from simple_models import RADIUS, batch, info, jittered, swirl

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
from lagbench.errors import UsageError

BOUNDS = info().bounds


def generator(seed: int = 0) -> torch.Generator:
    """Return a seeded source of randomness."""
    return torch.Generator().manual_seed(seed)


def node_features(**options: bool) -> NodeFeatures:
    """Return the features of the test's box, the scales without noise."""
    statistics = info().statistics
    torch.manual_seed(0)
    kinds = ("velocity", "acceleration")
    scales = (
        Standardisation(statistics[f"{kind}_mean"], statistics[f"{kind}_std"])
        for kind in kinds
    )
    return NodeFeatures(BOUNDS, *scales, RADIUS, **options)


def test_noise_widens_the_deviation_of_the_data() -> None:
    """Data of deviation 3 and 0 with noise of deviation 4 have deviation 5 and 4."""
    scale = Standardisation((1.0, 2.0), (3.0, 0.0), noise=4.0)
    value = torch.tensor([[6.0, 6.0], [-4.0, 2.0]])
    assert torch.equal(scale(value), torch.tensor([[1.0, 1.0], [-1.0, 0.0]]))
    assert torch.equal(scale.inverse(scale(value)), value)


def test_walls_are_seen_within_the_radius_only() -> None:
    """In the box [1/16, 15/16] with radius 1/16: left, right, bottom, top by hand."""
    position = torch.tensor([[0.5, 0.5], [0.09375, 0.875], [0.0, 0.921875]])
    expected = [
        [1.0, 1.0, 1.0, 1.0],
        [0.5, 1.0, 1.0, 1.0],  # (0.09375 - 0.0625) / 0.0625; the top is one radius away
        [-1.0, 1.0, 1.0, 0.25],  # one radius outside; (0.9375 - 0.921875) / 0.0625
    ]
    assert torch.equal(wall_distance(position, BOUNDS, RADIUS), torch.tensor(expected))


def test_edges_show_what_a_loop_over_pairs_shows() -> None:
    """Displacement and distance over the radius equal a double loop in float64."""
    position = jittered(3)
    points = torch.from_numpy(position)
    edges = radius_graph(points, RADIUS)
    shown = edge_features(points, edges, RADIUS).numpy()
    expected = [
        (
            *(position[s] - position[r]) / RADIUS,
            np.hypot(*(position[s] - position[r])) / RADIUS,
        )
        for s, r in edges.T.tolist()
    ]
    assert len(expected) > 500
    np.testing.assert_allclose(shown, expected, atol=1e-14)
    assert shown[:, 2].max() <= 1.0
    # the distance of two particles in one place is 0, and so is its gradient
    position = torch.tensor(
        [[0.5, 0.5], [0.5, 0.5], [0.5, 0.53125]], requires_grad=True
    )
    edges = torch.tensor([[0, 2], [1, 1]])
    distance = edge_features(position, edges, RADIUS)[:, 2]
    assert distance.tolist() == [0.0, 0.5]
    distance.sum().backward()
    # d distance / d y of the third is 1 / radius, of the second its opposite.
    assert position.grad.tolist() == [[0.0, 0.0], [0.0, -16.0], [0.0, 16.0]]


def test_a_particle_shows_thirty_numbers() -> None:
    """The last of five velocities and their changes, over deviations, four walls, an
    embedding.
    """
    features = node_features()
    # deviations (0.004, 0.003) and (0.0002, 0.0001): changes of 1, 2, 3, 4 deviations
    # end at 0.002 and 0.001
    velocity = torch.tensor([0.0, 1.0, 3.0, 6.0, 10.0])[None, :, None] * torch.tensor(
        [0.0002, 0.0001]
    )
    shown = features(torch.tensor([[0.5, 0.5]]), velocity, torch.tensor([2]))
    assert shown.shape == (1, features.count) == (1, 30)
    expected = torch.tensor([0.5, 1 / 3, 1.0, 1.0, 2.0, 2.0, 3.0, 3.0, 4.0, 4.0])
    torch.testing.assert_close(shown[0, :10], expected)
    assert shown[0, 10:14].tolist() == [1.0] * 4
    assert torch.equal(shown[0, 14:], features.embedding.weight[2])


def test_moving_walls_are_felt_near_them() -> None:
    """A wall's velocity over the deviation counts in full at the wall, by half
    half-way, 0 beyond.
    """
    features = node_features(moving_walls=True)
    assert features.count == 38
    position = torch.tensor([[0.5, 0.9375], [0.5, 0.90625], [0.5, 0.8]])
    walls = torch.zeros(3, 4, 2)
    walls[:, 3] = torch.tensor([0.008, 0.003])
    still = torch.zeros(3, 5, 2)
    shown = features(position, still, torch.zeros(3, dtype=torch.int64), walls)[
        :, 30:
    ].reshape(3, 4, 2)
    torch.testing.assert_close(
        shown[:, 3], torch.tensor([[2.0, 1.0], [1.0, 0.5], [0.0, 0.0]])
    )
    assert not shown[:, :3].any()
    assert not features(position, still, torch.zeros(3, dtype=torch.int64))[
        :, 30:
    ].any()


def test_features_do_not_see_where_particles_are() -> None:
    """Away from walls a common shift changes no bit of any feature."""
    features = node_features(moving_walls=True)
    position = torch.from_numpy(
        np.round(jittered(1, 8, 0.3, 0.6) * 1024) / 1024
    ).float()
    velocity = torch.randn(len(position), 5, 2, generator=generator()) * 0.01
    material = torch.arange(len(position)) % 4
    walls = torch.randn(len(position), 4, 2, generator=generator())
    shifted = position + torch.tensor([0.125, -0.0625])
    edges = radius_graph(position, RADIUS)
    assert torch.equal(radius_graph(shifted, RADIUS), edges)
    here, there = (features(x, velocity, material, walls) for x in (position, shifted))
    assert torch.equal(here, there)
    assert torch.equal(
        edge_features(position, edges, RADIUS), edge_features(shifted, edges, RADIUS)
    )


def test_noise_has_the_stated_deviation_at_the_last_velocity() -> None:
    """Velocity noise is a walk: covariance of steps j and k is std^2 min(j, k) / 5
    (80,000 draws).

    That of x and y, and of neighbours in the row, is uncorrelated.
    """
    walks = add_walk_noise(torch.zeros(40_000, 6, 2), 6, 0.3, generator())
    velocity = walks.diff(dim=1)
    covariance = (
        torch.einsum("pjc,pkc->jk", velocity, velocity) / velocity[:, 0].numel()
    )
    step = torch.arange(1.0, 6.0)
    expected = 0.09 * torch.minimum(step[:, None], step) / 5.0
    # The error of a variance from n draws is sqrt(2 / n) of it: 0.5 %; five of those.
    torch.testing.assert_close(covariance, expected, rtol=0.0, atol=0.025 * 0.09)
    assert abs(float(velocity[:, -1].std()) - 0.3) < 0.003
    assert not walks[:, 0].any()
    last = velocity[:, -1] / 0.3
    for one, other in ((last[:, 0], last[:, 1]), (last[1:, 0], last[:-1, 0])):
        assert abs(float((one * other).mean())) < 5 / np.sqrt(len(one))


def test_the_target_makes_up_for_the_noise() -> None:
    """The next velocity is the true one; the acceleration is the true one less the
    velocity noise.
    """
    truth = batch(swirl(0, 8)).position.double()
    disturbed = add_walk_noise(truth, 6, 1e-3, generator(1))
    noise = disturbed - truth
    assert float(noise[:, 5].abs().mean()) > 1e-4
    torch.testing.assert_close(
        disturbed.diff(dim=1)[:, 5:], truth.diff(dim=1)[:, 5:], atol=1e-15, rtol=0
    )
    acceleration = truth.diff(dim=1).diff(dim=1)[:, 4] - noise.diff(dim=1)[:, 4]
    torch.testing.assert_close(
        disturbed.diff(dim=1).diff(dim=1)[:, 4], acceleration, atol=1e-15, rtol=0
    )


@pytest.mark.parametrize(
    ("symmetry", "images"), [("none", 1), ("mirror", 2), ("square", 8)]
)
def test_every_image_is_drawn_evenly(symmetry: str, images: int) -> None:
    """8000 draws hold each image of the group 8000 / images times, within five
    deviations.
    """
    drawn = draw_mirror_matrices(Symmetry(symmetry), 8000, generator()).reshape(-1, 4)
    different, counts = drawn.unique(dim=0, return_counts=True)
    assert len(different) == images
    assert different.abs().sum(dim=1).tolist() == [2.0] * images
    assert [1.0, 0.0, 0.0, 1.0] in different.tolist()
    assert abs(counts - 8000 / images).max() <= 5 * np.sqrt(8000 / images)
    if symmetry == "mirror":
        assert (different[:, 3] == 1.0).all()  # gravity stays down


def test_walls_move_with_the_particles_on_them() -> None:
    """In every image a particle that rides on a wall still rides on the wall that it is
    at.
    """
    middle = np.array([[0.0625, 0.5], [0.9375, 0.5], [0.5, 0.0625], [0.5, 0.9375]])
    rider = batch(np.stack([middle, middle]), walls=True)
    rider = batch(
        np.stack([middle, middle + rider.wall_velocity[0, 0].numpy()]), walls=True
    )
    seen = set()
    for matrix in draw_mirror_matrices(Symmetry.SQUARE, 200, generator()).unique(dim=0):
        turned = mirror_batch(rider, matrix[None], BOUNDS)
        place = (
            (turned.position[:, None, 0] - torch.from_numpy(middle).float())
            .norm(dim=2)
            .argmin(dim=1)
        )
        velocity = turned.position[:, 1] - turned.position[:, 0]
        torch.testing.assert_close(
            turned.wall_velocity[0, 0][place], velocity, atol=1e-6, rtol=0
        )
        seen.add(tuple(place.tolist()))
    assert len(seen) == 8


def test_images_are_per_window_and_leave_the_data_alone() -> None:
    """The first window stays, the second is mirrored in x: x becomes 1 - x in this box.

    Mixed precision does not round positions or wall velocities to bfloat16.
    """
    windows = batch(swirl(0, 3), swirl(1, 3), walls=True)
    kept = windows.position.clone()
    matrix = torch.stack([torch.eye(2), torch.diag(torch.tensor([-1.0, 1.0]))])
    turned = mirror_batch(windows, matrix, BOUNDS)
    assert torch.equal(windows.position, kept)
    torch.testing.assert_close(turned.position[:256], kept[:256])
    torch.testing.assert_close(turned.position[256:, :, 0], 1.0 - kept[256:, :, 0])
    torch.testing.assert_close(turned.position[256:, :, 1], kept[256:, :, 1])
    matrix = draw_mirror_matrices(Symmetry.SQUARE, 2, generator(3))
    plain = mirror_batch(windows, matrix, BOUNDS)
    with torch.autocast("cpu", torch.bfloat16):
        mixed = mirror_batch(windows, matrix, BOUNDS)
    assert torch.equal(mixed.position, plain.position)
    assert torch.equal(mixed.wall_velocity, plain.wall_velocity)


def test_axes_change_places_only_in_a_square() -> None:
    """In an oblong box a quarter turn is refused, with the option that works."""
    with pytest.raises(UsageError) as caught:
        mirror_batch(
            batch(swirl(0, 3)), torch.eye(2).flip(0)[None], ((0.0, 1.0), (0.0, 0.5))
        )
    assert caught.value.where == "symmetry"
