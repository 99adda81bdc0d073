"""NeuralMPM: what holds for any weights, and that it learns."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from simple_models import batch, greatest_difference, info, jittered, rolled, swirl
from torch import Tensor, nn
from torch.testing import assert_close

from lagbench.baselines.augmentation import Symmetry, mirror_batch, mirror_matrices
from lagbench.baselines.baseline import Batch
from lagbench.baselines.neuralmpm import NeuralMPM

SMALL: dict[str, object] = {
    "cells": 10,
    "width": 8,
    "velocities": 2,
    "bundle": 2,
    "calls": 2,
    "noise_std": 0.0,
    "materials": [0, 1, 2, 3],
}


def surrogate(
    *,
    awake: float = 0.0,
    changes: Mapping[str, object] | None = None,
    **options: object,
) -> Any:
    """Return a small model; `awake` is the deviation of its last layer's weights."""
    torch.manual_seed(0)
    dataset_info = info(**(changes or {}))
    model = NeuralMPM.build(SMALL | options, dataset_info)
    if awake:
        last_layer = model.network.end
        nn.init.normal_(last_layer.weight, std=awake)
    return model


def liquid(*windows: NDArray[np.float64]) -> Batch:
    """Return windows side by side, all of one material."""
    window = batch(*windows)
    window.material.zero_()
    return window


def move_straight(
    position: NDArray[np.float64],
    velocity: NDArray[np.float64],
    frames: int = 3,
) -> NDArray[np.float64]:
    """Return frames of particles at constant velocity, shape [frame, particle, 2]."""
    time = np.arange(frames)[:, None, None]
    return position + time * velocity


def drift(
    speed: tuple[float, float],
    frames: int,
    seed: int = 0,
) -> NDArray[np.float64]:
    """Return a cloud that moves as one, shape [frame, particle, 2]."""
    cloud = jittered(seed, low=0.35, high=0.65)
    velocity = np.array(speed)
    return move_straight(cloud, velocity, frames)


def random_motion(deviation: float) -> NDArray[np.float64]:
    """Return three frames of particles that move on at random velocities."""
    rng = np.random.default_rng(0)
    velocity = rng.normal(0.0, deviation, (256, 2))
    cloud = jittered(0, low=0.3, high=0.7)
    return move_straight(cloud, velocity)


def roll_out_velocities(model: Any, window: Batch, frames: int) -> Tensor:
    """Return the differences of predicted positions, shape [particle, frame, 2]."""
    path = rolled(model, window, frames)
    return path.diff(dim=1)


def change_material(window: Batch, material: Tensor) -> Batch:
    """Return a window whose particles are of other materials."""
    return replace(window, material=material)


def test_untrained_models_keep_every_velocity() -> None:
    """Without smoothing particles move on straight."""
    window = random_motion(2e-3)
    model = surrogate(smoothing=0.0)

    predicted = roll_out_velocities(model, batch(window), 20)
    last_velocity = torch.from_numpy(window[1] - window[0])
    expected = last_velocity.float()[:, None]
    assert_close(
        predicted,
        expected.expand(-1, 19, -1),
        rtol=0,
        atol=1e-6,
    )


def test_smoothing_damps_what_the_grid_does_not_see() -> None:
    """A share of the sub-grid velocity goes with every frame."""
    window = liquid(random_motion(1e-3))
    model = surrogate(smoothing=0.3)

    predicted = roll_out_velocities(model, window, 4).double()
    deviation = predicted.std(dim=0).mean(dim=1)
    ratio = deviation[1:] / deviation[:-1]
    assert float(ratio.max()) < 0.85


def test_particles_stay_inside_the_walls() -> None:
    """Velocities are the differences of the positions, also where a wall stops."""
    model = surrogate(awake=30.0)
    first_frames = swirl(0, 3)
    second_frames = swirl(1, 3)
    window = batch(first_frames, second_frames)
    path = rolled(model, window, 12)
    bounds = torch.tensor(info().bounds)
    low, high = bounds.T
    assert bool((path >= low).all())
    assert bool((path <= high).all())
    is_stopped = (path == low) | (path == high)
    assert bool(is_stopped.any())

    state = model.start(window)
    _, frames = model.call(state)
    first_position, _ = frames[0]
    second_position, second_velocity = frames[1]
    displacement = second_position - first_position
    assert_close(displacement, second_velocity, rtol=0, atol=2e-7)


def test_windows_side_by_side_do_not_see_each_other() -> None:
    """Two windows in one batch roll out as they do alone, with walls and context."""
    model = surrogate(awake=0.1, context=3, wall_velocity=True)
    first = swirl(0, 3)
    second = swirl(1, 3)

    both = batch(first, second, walls=True)
    together = rolled(model, both, 5)
    first_alone = rolled(model, batch(first, walls=True), 5)
    second_alone = rolled(model, batch(second, walls=True), 5)
    alone = torch.cat([first_alone, second_alone])
    assert_close(together, alone, rtol=0, atol=1e-6)


def test_training_unrolls_the_rollout() -> None:
    """The loss over two calls is the mean error of the rollout's velocities.

    It is measured in deviations of the acceleration. With a generator none or one call
    without gradients comes before, and the loss is that of the rollout's next frames.
    """
    window = batch(swirl(0, 9))
    model = surrogate(awake=0.1, pushforward=1)
    given = window.part(slice(3))
    predicted = rolled(model, given, 6)
    last = window.position[:, 2:3]
    path = torch.cat([last, predicted], dim=1)
    truth = window.position[:, 2:]

    acceleration_variance = (2e-4**2 + 1e-4**2) / 2
    true_velocity = truth.diff(dim=1)
    difference = path.diff(dim=1) - true_velocity
    error = difference.square() / acceleration_variance
    first_error = error[:, 0:4].mean()
    next_error = error[:, 2:6].mean()
    first_frames = float(first_error)
    next_frames = float(next_error)

    losses = set()
    with torch.no_grad():
        loss = float(model(window)["velocity"])
        for seed in range(12):
            generator = torch.Generator().manual_seed(seed)
            terms = model(window, generator)
            losses.add(float(terms["velocity"]))
    assert loss == pytest.approx(first_frames, rel=1e-3)
    expected = sorted([first_frames, next_frames])
    assert sorted(losses) == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("speed", [2.2e-3, 6e-3])
def test_recovery_asks_for_the_way_back(speed: float) -> None:
    """The loss counts how far the model is behind the truth, up to a bound.

    The untrained model goes on as before, the truth goes on at `speed` per frame.
    """
    initial_speed = 2e-3
    initial_path = initial_speed * np.arange(3.0)
    later_frames = np.arange(1.0, 5.0)
    later_path = 2 * initial_speed + speed * later_frames
    distance = np.concatenate([initial_path, later_path])
    along_x = distance[:, None, None] * np.array([1.0, 0.0])
    cloud = jittered(0, low=0.3, high=0.6)
    window = batch(cloud + along_x)
    model = surrogate(smoothing=0.0, recovery=4.0)

    lag = (speed - initial_speed) * np.arange(4.0)
    most_recovery = 3.0 * model.acceleration_std
    recovery = np.minimum(lag / 4.0, most_recovery)
    target = speed + recovery
    # Nothing moves along y, so the mean over both axes is half of that along x.
    mean_square = (target - initial_speed) ** 2 / 2
    expected = mean_square.mean() / model.acceleration_std**2
    with torch.no_grad():
        loss = float(model(window)["velocity"])
    assert loss == pytest.approx(expected, rel=1e-2)


def sheared_window() -> Batch:
    """Return a window with strain and moving walls."""
    window = batch(swirl(0, 3), walls=True)
    shear = torch.tensor([[0.9, 0.15], [0.0, 1.05]])
    first_frame = window.position[:, 0]
    origin = (first_frame - 0.5) @ shear + 0.5
    return replace(window, origin=origin)


@functools.cache
def rolled_as_given(*, average: bool) -> tuple[Any, Tensor]:
    """Return a model and its rollout, which all mirror images are compared with."""
    options = {
        "strain": True,
        "wall_velocity": True,
        "context": 3,
        "symmetry": "square",
    }
    model = surrogate(**options, awake=0.1, average=average)
    context_weight = model.context.numbers[-1].weight
    nn.init.normal_(context_weight, std=3.0)
    return model, rolled(model, sheared_window(), 4)


@pytest.mark.parametrize("number", range(8))
def test_the_mirror_average_has_the_symmetry_of_the_box(number: int) -> None:
    """The rollout of a mirror image is the mirror image of the rollout.

    That includes strain, moving walls and context.
    """
    matrix = mirror_matrices(Symmetry.SQUARE)[number]
    image = mirror_batch(sheared_window(), matrix[None], info().bounds)

    def image_error(*, average: bool) -> float:
        model, path = rolled_as_given(average=average)
        image_path = rolled(model, image, 4)
        expected = (path - 0.5) @ matrix.T + 0.5
        return greatest_difference(image_path, expected)

    assert image_error(average=True) < 2e-6
    # The weights have no symmetry; number 0 is the identity.
    has_difference = image_error(average=False) > 1e-5
    assert has_difference is (number > 0)


def test_materials_in_one_place_come_to_one_velocity() -> None:
    """A grid that two clouds share holds them together where they lie in each other."""
    rng = np.random.default_rng(0)
    is_odd = torch.arange(256) % 2
    direction = np.where(is_odd.numpy(), 1.0, -1.0)
    velocity = direction[:, None] * np.array([1e-3, 0.0])
    cloud = rng.uniform(0.3, 0.7, (256, 2))
    frames = move_straight(cloud, velocity)
    window = change_material(batch(frames), is_odd)

    def velocity_difference(**options: object) -> float:
        model = surrogate(smoothing=0.5, **options)
        predicted = roll_out_velocities(model, window, 6).double()
        mean = predicted.mean(dim=0)
        assert float(mean.abs().max()) < 2e-4
        odd_mean = predicted[1::2, -1, 0].mean()
        even_mean = predicted[::2, -1, 0].mean()
        return float(odd_mean - even_mean)

    assert velocity_difference() == pytest.approx(2e-3, rel=0.02)
    mixture_difference = velocity_difference(mixture=True)
    assert abs(mixture_difference) < 0.3 * 2e-3


@pytest.mark.parametrize(
    ("material", "is_solid"),
    [
        (0, False),
        (1, True),
    ],
)
def test_a_strained_first_frame_matters_to_solids(
    material: int, is_solid: bool
) -> None:
    """A liquid has no shape to come back to."""
    window = batch(swirl(0, 3))
    model = surrogate(awake=0.1, strain=True)
    one_material = torch.full_like(window.material, material)
    window = change_material(window, one_material)
    first_frame = window.position[:, 0]
    origin = 0.9 * (first_frame - 0.5) + 0.5
    strained = replace(window, origin=origin)
    path = rolled(model, window, 2)
    strained_path = rolled(model, strained, 2)
    is_same = torch.equal(path, strained_path)
    assert is_same is not is_solid


class Drag(nn.Module):
    """Stand for the U-Net: the acceleration is -rate times the velocity on the grid."""

    def __init__(self, rate: float, bundle: int) -> None:
        super().__init__()
        self.rate = rate
        self.bundle = bundle

    def forward(self, field: Tensor) -> Tensor:
        """Return the accelerations of one material in all frames of a bundle."""
        velocity = field[:, 1:3]
        bundle = velocity.repeat(1, self.bundle, 1, 1)
        return -self.rate * bundle


def test_a_known_network_has_a_known_rollout() -> None:
    """Drag takes a share of the velocity before a bundle in each of its frames."""
    model = surrogate(materials=[0], smoothing=0.0)
    rate = 0.1
    drag_rate = rate * model.velocity_std / model.acceleration_std
    model.network = Drag(drag_rate, 2)
    velocity = (4e-3, -2e-3)
    window = liquid(drift(velocity, 3))

    path = rolled(model, window, 4).double()
    mean_path = path.mean(dim=0)
    last = window.position[:, -1].double()
    displacement = mean_path - last.mean(dim=0)
    velocity_shares = np.array(
        [
            1 - rate,
            1 - 2 * rate,
            (1 - 2 * rate) * (1 - rate),
            (1 - 2 * rate) ** 2,
        ]
    )
    distance = velocity_shares.cumsum()[:, None]
    expected = distance * np.array(velocity)
    assert_allclose(displacement.numpy(), expected, rtol=1e-3)


def test_each_frame_is_driven_by_its_own_walls() -> None:
    """A bundle sees the walls of its two frames and none after them."""
    model = surrogate(awake=0.1, wall_velocity=True)
    whole = batch(swirl(0, 9), walls=True)

    def roll_out_with_walls_at(frame: int) -> Tensor:
        wall_velocity = torch.zeros_like(whole.wall_velocity)
        wall_velocity[:, frame] = 0.05
        window = replace(whole, wall_velocity=wall_velocity)
        given = window.part(slice(3))
        return rolled(model, given, 4)

    # Frame 2 is the last frame of the window: its walls are over.
    still = roll_out_with_walls_at(2)
    in_first_bundle = roll_out_with_walls_at(3)
    in_second_bundle = roll_out_with_walls_at(6)
    after_both = roll_out_with_walls_at(7)
    assert not torch.equal(in_first_bundle[:, 0], still[:, 0])
    assert torch.equal(in_second_bundle[:, :2], still[:, :2])
    assert not torch.equal(in_second_bundle[:, 2], still[:, 2])
    assert torch.equal(after_both, still)
