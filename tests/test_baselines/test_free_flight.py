"""Bodies in free flight against known places, the parabola, and the solver's data."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest
import torch
from scipy.sparse.csgraph import connected_components
from simple_models import info
from torch import Tensor

from lagbench.baselines.free_flight import FALL_UNIT, FreeFlight, find_bodies
from lagbench.baselines.rollout import scenario_batch, scenario_paths
from lagbench.data.box import Box
from lagbench.data.registry import load as load_registry
from lagbench.make.generate import GenerationResult
from lagbench.tensors import TensorBox

REACH = 0.1


def body_numbers(
    position: Sequence[Sequence[float]],
    *,
    velocity: Sequence[Sequence[float]] | None = None,
    sample: Sequence[int] | None = None,
    periodic: Sequence[bool] | None = None,
) -> tuple[list[int], list[bool]]:
    """Return the bodies of particles in a unit box, and which of these fly."""
    x = torch.tensor(position)
    v = torch.zeros_like(x)
    if velocity is not None:
        v = torch.tensor(velocity)
    window = torch.zeros(len(x), dtype=torch.int64)
    if sample is not None:
        window = torch.tensor(sample)
    box = Box.from_bounds([(0.0, 1.0)] * x.shape[1], periodic)
    body, flies = find_bodies(x, v, window, reach=REACH, box=TensorBox(box))
    return body.tolist(), flies.tolist()


def test_walls_reach_half_as_far() -> None:
    """They stop a whole body that has one particle near them."""
    near = [[0.04, 0.5], [0.12, 0.5]]
    far = [[0.5, 0.06], [0.58, 0.06]]
    body, flies = body_numbers([*near, *far])
    assert body == [0, 0, 1, 1]
    assert flies == [False, True]


def test_bodies_that_meet_within_the_frame_are_one() -> None:
    """Where particles are after a frame counts too, for walls as well."""
    pair = [[0.3, 0.5], [0.6, 0.5]]
    towards = [[0.25, 0.0], [0.0, 0.0]]
    assert body_numbers(pair)[0] == [0, 1]
    assert body_numbers(pair, velocity=towards)[0] == [0, 0]
    _, flies = body_numbers([[0.5, 0.3]], velocity=[[0.0, -0.5]])
    assert flies == [False]


@pytest.mark.parametrize("dimension", [2, 3])
def test_periodic_ends_link_and_are_no_walls(dimension: int) -> None:
    """The shortest way across an end counts."""
    middle = [0.5] * (dimension - 1)
    ends = [[0.02, *middle], [0.97, *middle]]
    periodic = [True] + [False] * (dimension - 1)
    assert body_numbers(ends, periodic=periodic) == ([0, 0], [True])
    assert body_numbers(ends) == ([0, 1], [False, False])


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("is_periodic", [False, True])
@pytest.mark.parametrize("reach", [0.02, 0.05, 0.1])
def test_bodies_are_the_components_of_all_pairs(
    dimension: int, is_periodic: bool, reach: float
) -> None:
    """SciPy's distances of all pairs say so: in two blobs, and in a spray of drops."""
    rng = np.random.default_rng(4)
    blobs = [rng.uniform(low, low + 0.2, (150, dimension)) for low in (0.25, 0.5)]
    spray = rng.uniform(0.0, 1.0, (60, dimension))
    position = np.concatenate([*blobs, spray])
    velocity = rng.normal(0.0, 0.01, position.shape)
    box = Box.from_bounds([(0.0, 1.0)] * dimension, [is_periodic] * dimension)

    next_position = position + velocity
    if is_periodic:
        next_position %= 1.0
    else:
        next_position = next_position.clip(0.0, 1.0)
    is_linked = np.zeros((len(position), len(position)), np.bool_)
    for each in (position, next_position):
        difference = each[:, None] - each
        if is_periodic:
            difference -= np.round(difference)
        distance = np.linalg.norm(difference, axis=2)
        is_linked |= distance <= reach
    count, label = connected_components(is_linked)

    bodies = find_bodies(
        torch.from_numpy(position),
        torch.from_numpy(velocity),
        torch.zeros(len(position), dtype=torch.int64),
        reach=reach,
        box=TensorBox(box),
    )
    assert len(bodies.flies) == count
    assert bodies.body.tolist() == label.tolist()


def free_flight(gravity: Tensor, *, dimension: int = 2) -> FreeFlight:
    """Return the correction with a given gravity, in a unit box."""
    figures = info(bounds=((0.0, 1.0),) * dimension)
    part = FreeFlight(figures, reach=REACH, unit=0.5)
    with torch.no_grad():
        part.fall.copy_(gravity / (FALL_UNIT * 0.5))
    return part


@pytest.mark.parametrize("dimension", [2, 3])
def test_means_of_flying_bodies_are_gravity(dimension: int) -> None:
    """Differences inside a body stay; a body at a wall keeps all of its own."""
    rng = np.random.default_rng(1)
    offsets = rng.uniform(-0.02, 0.02, (3, 5, dimension))
    centres = np.full((3, 1, dimension), 0.5)
    centres[:, 0, 0] = (0.03, 0.4, 0.8)  # the first one touches the left wall
    position = torch.tensor((centres + offsets).reshape(-1, dimension)).float()
    position = position.clamp(min=0.0)
    acceleration = torch.tensor(rng.normal(size=(15, dimension))).float()
    gravity = torch.zeros(dimension)
    gravity[1] = -0.7
    part = free_flight(gravity, dimension=dimension)

    sample = torch.zeros(15, dtype=torch.int64)
    rest = torch.zeros_like(position)
    corrected = part(acceleration, position, rest, sample).detach()

    assert torch.equal(corrected[:5], acceleration[:5])
    for start in (5, 10):
        body = slice(start, start + 5)
        mean = corrected[body].mean(dim=0)
        torch.testing.assert_close(mean, gravity)
        inside = corrected[body] - mean
        expected = acceleration[body] - acceleration[body].mean(dim=0)
        torch.testing.assert_close(inside, expected)


@pytest.mark.slow
@pytest.mark.parametrize("split", ["fluid", "multimaterial"])
def test_bodies_of_the_data_fall_as_the_law_says(
    split: str, tiny_split: Callable[..., GenerationResult]
) -> None:
    """Bodies out of reach of the solver's grid have the mean acceleration g."""
    root = tiny_split(split).root
    size = load_registry().size(split, "tiny")
    solver_cell = 1.0 / float(size.parameters["grid"].value)
    gravity = float(size.parameters["gravity"].value) * size.frame_interval**2
    box = TensorBox(Box.from_bounds(size.bounds))

    errors = []
    for path in scenario_paths(split, subset="train", size="tiny", root=root).values():
        position = scenario_batch(path).position
        sample = torch.zeros(len(position), dtype=torch.int64)
        for frame in range(1, position.shape[1] - 1, 2):
            before, now, after = position[:, frame - 1 : frame + 2].double().unbind(1)
            body, flies = find_bodies(
                now, now - before, sample, reach=4.0 * solver_cell, box=box
            )
            acceleration = after - 2.0 * now + before
            for number in flies.nonzero().flatten():
                mean = acceleration[body == number].mean(dim=0)
                error = mean + torch.tensor([0.0, gravity])
                errors.append(float(error.abs().max()) / gravity)
    assert len(errors) >= 10
    assert max(errors) < 0.01  # of g
