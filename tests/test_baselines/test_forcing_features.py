"""What particles see of the force and of an obstacle, against closed forms."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from simple_models import RADIUS, batch, info, network, rolled, swirl
from torch import Tensor
from torch.testing import assert_close

from lagbench.baselines.baseline import Batch, DatasetInfo
from lagbench.baselines.forcing import (
    force_at,
    obstacle_features,
    skip_frames,
)
from lagbench.data.box import Box
from lagbench.tensors import TensorBox

UNIT = (0.0, 1.0)
BOXES = {
    "walls": Box.from_bounds([UNIT, UNIT]),
    "channel": Box.from_bounds([UNIT, UNIT], [True, False]),
    "periodic": Box.from_bounds([UNIT, UNIT], [True, True]),
    "cube": Box.from_bounds([UNIT, UNIT, UNIT]),
    "periodic cube": Box.from_bounds([UNIT, UNIT, UNIT], [True, True, True]),
}


def info_of_box(box: Box) -> DatasetInfo:
    """Return the figures of a box, with the statistics of two axes for all."""
    statistics = {}
    for name, values in info().statistics.items():
        statistics[name] = (*values, *values)[: box.dimension]
    axes = [name for name, repeats in zip("xyz", box.periodic, strict=False) if repeats]
    return info(bounds=box.bounds, periodic=tuple(axes), statistics=statistics)


@pytest.mark.parametrize(
    ("frames", "count", "expected"),
    [
        (4, 1, [1, 2, 3]),
        (4, 3, [3]),
        (4, 9, [3]),
        (1, 1, [0]),
    ],
)
def test_the_last_known_forcing_stays(
    frames: int, count: int, expected: list[int]
) -> None:
    """Frames beyond the known ones have it."""
    forcing = torch.arange(frames).reshape(1, frames, 1)
    later = skip_frames(forcing, count)
    assert later.flatten().tolist() == expected


def parabola(height: NDArray[np.float64], force: float, viscosity: float) -> Any:
    """Return the steady speed of reverse Poiseuille flow in a period of length 1.

    It is f y (H - y) / (2 nu) in the lower half, H = 1/2, and its opposite in the upper
    (Backer et al. 2005).
    """
    half = 0.5
    place = np.mod(height, 1.0)
    above = np.where(place < half, place, place - half)
    sign = np.where(place < half, 1.0, -1.0)
    return sign * force * above * (half - above) / (2.0 * viscosity)


@pytest.mark.parametrize("name", ["periodic", "periodic cube"])
def test_the_force_is_what_the_parabola_needs(name: str) -> None:
    """In steady flow it is -nu u'', constant in each half of the box, wherever in the
    period a particle is counted.
    """
    force = 0.03
    viscosity = 1e-3
    height = np.array([0.01, 0.2, 0.49, 0.51, 0.75, 0.99, -0.25, 1.25, 1.75])
    step = 1e-3
    after = parabola(height + step, force, viscosity)
    before = parabola(height - step, force, viscosity)
    curvature = (after - 2.0 * parabola(height, force, viscosity) + before) / step**2
    needed = -viscosity * curvature
    assert np.unique(needed.round(6)).tolist() == [-force, force]

    box = BOXES[name]
    position = torch.full((len(height), box.dimension), 0.3)
    position[:, 1] = torch.from_numpy(height)
    sample = torch.tensor([0] * 4 + [1] * 5)
    layers = torch.zeros(2, 2, box.dimension)
    layers[:, 0, 0] = force
    layers[:, 1, 0] = -force
    acting = force_at(position, sample, layers, TensorBox(box))
    expected = torch.zeros_like(acting)
    expected[:, 0] = torch.from_numpy(needed)
    assert_close(acting, expected, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("name", BOXES)
def test_the_surface_of_a_circle_or_ball_is_seen_within_the_reach(name: str) -> None:
    """Particles stand on rays from the centre: their distance to the surface is the
    length of the ray less the radius, the normal is the ray. Half of the rays leave the
    box; along periodic axes they enter at the other end.
    """
    box = BOXES[name]
    reach = 0.1
    radius = 0.05
    centre = torch.full((box.dimension,), 0.5)
    centre[0] = 0.95  # near an end of x
    rng = np.random.default_rng(0)
    ray = rng.normal(size=(60, box.dimension))
    ray /= np.linalg.norm(ray, axis=1)[:, None]
    gap = rng.uniform(-0.04, 0.16, 60)  # from inside to beyond the reach
    normal = torch.from_numpy(ray).float()
    distance = torch.from_numpy(gap).float()[:, None]
    position = TensorBox(box).wrap(centre + (radius + distance) * normal)
    one = torch.cat([centre, torch.tensor([radius])])
    features = obstacle_features(position, one.expand(60, -1), reach, TensorBox(box))

    relative = (distance / reach).clamp(max=1.0)
    nearness = (1.0 - relative).clamp(max=1.0)
    expected = torch.cat([relative, nearness * normal], dim=1)
    assert_close(features, expected, rtol=0.0, atol=1e-5)
    is_beyond = gap > reach
    assert is_beyond.any()
    assert (features[is_beyond, 0] == 1.0).all()
    assert (features[is_beyond, 1:] == 0.0).all()


def test_the_centre_of_an_obstacle_has_no_direction_and_no_gradient() -> None:
    position = torch.tensor([[0.5, 0.5]], requires_grad=True)
    circle = torch.tensor([[0.5, 0.5, 0.1]])
    features = obstacle_features(position, circle, 0.2, TensorBox(BOXES["walls"]))
    assert features.tolist() == [[-0.5, 0.0, 0.0]]
    features[:, 0].sum().backward()
    assert position.grad is not None
    assert position.grad.tolist() == [[0.0, 0.0]]


def swirl_in(box: Box, frames: int = 7) -> NDArray[np.float64]:
    """Return particles that turn about the middle of a box, at one height in space."""
    plane = swirl(0, frames)
    if box.dimension == 2:
        return plane
    height = np.full((*plane.shape[:2], 1), 0.5)
    return np.concatenate([plane, height], axis=2)


def forced_batch(box: Box) -> Batch:
    """Return two windows with a force of their own in each frame, and an obstacle."""
    path = swirl_in(box)
    plain = batch(path, path[::-1].copy())
    axes = box.dimension
    generator = torch.Generator().manual_seed(7)
    force = 1e-3 * torch.rand((2, 9, 2, axes), generator=generator)
    obstacle = torch.full((2, axes + 1), 0.4)
    obstacle[1, 0] = 0.6
    obstacle[:, -1] = 0.1
    return replace(plain, body_force=force, obstacle=obstacle)


def seeing(box: Box, **options: object) -> Any:
    """Return an awake graph network of one layer in a box."""
    figures = info_of_box(box)
    changes = {
        "bounds": figures.bounds,
        "periodic": figures.periodic,
        "statistics": figures.statistics,
    }
    return network(awake=True, layers=1, changes=changes, **options)


def node_inputs(model: Any, given: Batch, frames: int) -> list[Tensor]:
    """Return what the network is given of the nodes in each step of a rollout."""
    seen: list[Tensor] = []
    hook = model.network.node_encoder.register_forward_pre_hook(
        lambda _, values: seen.append(values[0])
    )
    rolled(model, given, frames)
    hook.remove()
    return seen


@pytest.mark.parametrize("name", BOXES)
def test_nodes_see_force_and_obstacle_after_all_else(name: str) -> None:
    """The force of the next frame, in deviations of accelerations that the weights
    state; the other features are to the bit those of a network that sees neither.
    """
    box = BOXES[name]
    axes = box.dimension
    window = forced_batch(box)
    given = window.part(slice(6))
    model = seeing(box, body_force=True, obstacle=True)
    assert model.forcing_seen == {"body_force", "obstacle"}
    blind = seeing(box)
    assert blind.forcing_seen == frozenset()
    (blind_node,) = node_inputs(blind, given, 1)
    nodes = node_inputs(model, given, 4)
    plain = blind_node.shape[1]
    assert nodes[0].shape[1] == plain + axes + axes + 1
    with torch.random.fork_rng():
        torch.manual_seed(0)
        embedding = blind.features.embedding.weight.clone()
        model.features.embedding.weight.data.copy_(embedding)
    (node, *_) = node_inputs(model, given, 1)
    assert torch.equal(node[:, :plain], blind_node)

    deviations = np.array(model.info.statistics["acceleration_std"])
    unit = float(np.sqrt(np.mean(deviations**2)))
    scale = model.info.frame_interval**2 / unit
    path = rolled(model, given, 3)
    places = [given.position[:, -1], *path.unbind(1)]
    assert window.body_force is not None
    assert window.obstacle is not None
    box_of_tensors = TensorBox(box)
    for step, (features, position) in enumerate(zip(nodes, places, strict=True)):
        frame = min(6 + step, 8)  # the last known one stays
        force = window.body_force[:, frame]
        acting = force_at(position, window.sample, force, box_of_tensors)
        force_seen = features[:, plain : plain + axes]
        assert_close(force_seen, scale * acting, rtol=1e-5, atol=1e-7)
        own = window.obstacle[window.sample]
        reach = 3.0 * RADIUS
        surface = obstacle_features(position, own, reach, box_of_tensors)
        assert_close(features[:, plain + axes :], surface, rtol=0.0, atol=1e-6)
