"""Strain since the first frame: affine motion has the strain of its matrix, images have
images of it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from simple_models import batch, info, jittered
from torch import Tensor

from lagbench.baselines.augmentation import mirror_batch
from lagbench.baselines.particle_grid import ParticleGrid
from lagbench.baselines.strain import UNIT, RestShape, first_frame
from lagbench.errors import UsageError

BOUNDS = info().bounds


def rest(position: Tensor, *, bodies: int = 1) -> RestShape:
    """Return the first frame of bodies whose particles take turns."""
    layer = torch.arange(len(position)) % bodies
    return RestShape.build(
        ParticleGrid(BOUNDS, 12, multiple=4), position, layer, bodies
    )


def cloud(seed: int, low: float = 0.3, high: float = 0.7) -> Tensor:
    """Return a square body."""
    return torch.from_numpy(jittered(seed, low=low, high=high)).float()


@pytest.mark.parametrize(
    "gradient",  # the second a rotation: no strain
    [
        (1.0, 0.0, 0.0, 1.0),
        (0.6, -0.8, 0.8, 0.6),
        (0.9, 0.0, 0.0, 0.9),
        (1.1, 0.05, -0.02, 0.92),
        (1, 0.3, 0, 1),
    ],
)
def test_affine_motion_has_the_strain_of_its_matrix(
    gradient: tuple[float, ...],
) -> None:
    """(F F^T - 1) / 2, at the edges of the body too, wherever it went."""
    f = np.reshape(gradient, (2, 2))
    e = 0.5 * (f @ f.T - np.eye(2))
    first = cloud(0)
    moved = first @ torch.from_numpy(f).float().T + 0.05
    found = rest(first).strain(moved)
    expected = np.tanh(np.array([e[0, 0], e[0, 1], e[1, 1]]) / UNIT)
    np.testing.assert_allclose(
        found.numpy(), np.tile(expected, (len(first), 1)), rtol=0, atol=0.05
    )
    np.testing.assert_allclose(found.mean(dim=0).numpy(), expected, rtol=0, atol=0.02)
    with torch.autocast("cpu", torch.bfloat16):  # has the bits that it has in a rollout
        assert torch.equal(rest(first).strain(moved), found)


def test_bodies_in_layers_of_their_own_fly_apart_unstrained() -> None:
    """Two that lie in each other at first and part: neither is strained."""
    first = cloud(0)
    apart = (
        first + torch.tensor([[-0.1, 0.0], [0.1, 0.05]])[torch.arange(len(first)) % 2]
    )
    assert float(rest(first, bodies=2).strain(apart).abs().max()) < 1e-4
    assert float(rest(first).strain(apart).abs().max()) > 0.1


def test_an_image_is_strained_as_an_image() -> None:
    """A mirror image in x has the same xx and yy, and the opposite xy."""
    frames = torch.stack([cloud(0), cloud(0) @ torch.tensor([[1.05, 0.1], [0.0, 0.9]])])
    given = replace(batch(frames.numpy()), origin=frames[0])
    mirrored = mirror_batch(given, torch.tensor([[[-1.0, 0.0], [0.0, 1.0]]]), BOUNDS)
    here, there = (
        rest(first_frame(one)).strain(one.position[:, 1]) for one in (given, mirrored)
    )
    torch.testing.assert_close(
        there, here * torch.tensor([1.0, -1.0, 1.0]), rtol=0, atol=1e-3
    )


def test_the_first_frame_is_known_or_asked_for() -> None:
    """Windows from the first frame hold it, others must bring it."""
    given = batch(jittered(0)[None].repeat(3, axis=0))
    assert torch.equal(first_frame(given), given.position[:, 0])
    later = replace(given, frame=given.frame + 4)
    with pytest.raises(UsageError) as caught:
        first_frame(later)
    assert caught.value.where == "batch.origin"
    assert torch.equal(first_frame(replace(later, origin=cloud(1))), cloud(1))
