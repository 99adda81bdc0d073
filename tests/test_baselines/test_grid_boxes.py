"""Grids and NeuralMPM in three dimensions and in boxes with periodic axes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from simple_models import info, rolled
from torch import Tensor, nn
from torch.testing import assert_close

from lagbench.baselines.augmentation import (
    shift_batch,
)
from lagbench.baselines.neuralmpm import NeuralMPM
from lagbench.baselines.particle_grid import ParticleGrid
from lagbench.data.box import Box
from lagbench.data.grid import Grid, transfer
from lagbench.tensors import Batch, TensorBox

Positions = NDArray[np.float64]

UNIT = (0.0, 1.0)
LOW = (0.0, 0.75)
WIDE = (0.25, 1.25)
THIN = (0.0, 0.45)
BOXES = {
    "square": Box.from_bounds([UNIT, UNIT], [True, True]),
    "channel": Box.from_bounds([UNIT, LOW], [True, False]),
    "oblong": Box.from_bounds([WIDE, THIN], [True, True]),
    "room": Box.from_bounds([UNIT, UNIT, UNIT]),
    "cube": Box.from_bounds([UNIT, UNIT, UNIT], [True, True, True]),
    "duct": Box.from_bounds([UNIT, LOW, UNIT], [True, False, True]),
}

SMALL: dict[str, object] = {
    "cells": 8,
    "width": 4,
    "velocities": 2,
    "bundle": 2,
    "calls": 2,
    "noise_std": 0.0,
}
STATISTICS = {
    "position_mean": 0.5,
    "position_std": 0.3,
    "velocity_mean": 0.0,
    "velocity_std": 0.004,
    "acceleration_mean": 0.0,
    "acceleration_std": 0.0002,
}
"""Alike along all axes."""


def make_grid(name: str, cells: int = 8) -> ParticleGrid:
    """Return a grid of one of the boxes."""
    box = BOXES[name]
    return ParticleGrid(
        box.bounds,
        cells,
        multiple=4,
        periodic=box.periodic,
    )


def draw_places(
    name: str,
    count: int,
    seed: int = 0,
) -> Positions:
    """Return random points in one of the boxes, shape [particle, axis]."""
    box = BOXES[name]
    rng = np.random.default_rng(seed)
    shape = (count, box.dimension)
    return rng.uniform(box.low, box.high, shape)


def draw_tensor(name: str, count: int) -> Tensor:
    """Return random points in one of the boxes in single precision."""
    places = draw_places(name, count)
    return torch.from_numpy(places).float()


def one_layer(count: int) -> Tensor:
    """Return the layer of particles that are all in the first."""
    return torch.zeros(count, dtype=torch.int64)


def greatest(values: Tensor) -> float:
    """Return the greatest absolute value."""
    return float(values.abs().max())


def surrogate(
    name: str,
    *,
    awake: float = 0.0,
    **options: Any,
) -> Any:
    """Return a small model; `awake` is the deviation of its last layer's weights."""
    box = BOXES[name]
    axes = [axis for axis in range(box.dimension) if box.periodic[axis]]
    statistics = {}
    for kind, value in STATISTICS.items():
        statistics[kind] = (value,) * box.dimension
    dataset = info(
        bounds=box.bounds,
        periodic=tuple("xyz"[axis] for axis in axes),
        statistics=statistics,
    )
    torch.manual_seed(0)
    model = NeuralMPM.build(SMALL | options, dataset)
    if awake:
        for parameter in model.network.end.parameters():
            nn.init.normal_(parameter, std=awake)
    return model


def window_of(
    frames: Positions,
    walls: Tensor | None = None,
) -> Batch:
    """Return one window from positions of shape [frame, particle, axis]."""
    particles = frames.shape[1]
    position = frames.swapaxes(0, 1).astype(np.float32)
    return Batch(
        position=torch.from_numpy(position),
        sample=one_layer(particles),
        material=one_layer(particles),
        wall_velocity=walls,
        scenario=one_layer(1),
        frame=one_layer(1),
    )


def drift(
    name: str,
    frames: int,
    velocity: Sequence[float],
) -> Positions:
    """Return a cloud that fills the box and moves as one through its seams."""
    box = BOXES[name]
    time = np.arange(frames)[:, None, None]
    displacement = time * np.array(velocity)
    places = draw_places(name, 300)
    return box.wrap(places + displacement)


@pytest.mark.parametrize("cells", [7, 8])
@pytest.mark.parametrize("name", BOXES)
def test_constant_fields_stay_constant(name: str, cells: int) -> None:
    """Both ways: a constant at the nodes, and particles that fill the box evenly."""
    box = BOXES[name]
    grid = make_grid(name, cells)
    for count in grid.shape:
        assert count % 4 == 0
    place = draw_tensor(name, 200)
    stencil = grid.stencil(place, one_layer(200))
    ones = torch.ones(1, 1, *grid.shape)
    gathered = grid.gather(stencil, ones)
    assert_close(gathered, torch.ones(200, 1))

    # Two particles a cell along each axis: B-splines sum to a constant over them.
    axes = []
    widths = grid.cell.tolist()
    for axis, width in zip(grid.axes, widths, strict=True):
        offsets = torch.tensor([-0.25, 0.25]) * width
        places = axis[:, None] + offsets
        axes.append(places.flatten())
    lattice = torch.cartesian_prod(*axes)
    is_inside = box.contains(lattice.numpy(), tolerance=1e-6)
    lattice = lattice[torch.from_numpy(is_inside)]
    count = len(lattice)
    evenly = grid.stencil(lattice, one_layer(count))
    mass = torch.ones(count, 1)
    density = grid.spread(evenly, mass, 1)[0, 0]
    reach = 1.501 * grid.spacing
    for number, places in enumerate(grid.axes):
        if not box.periodic[number]:  # beside walls there is less
            is_above = places > box.low[number] + reach
            is_below = places < box.high[number] - reach
            is_inner = is_above & is_below
            inner = torch.nonzero(is_inner)[:, 0]
            density = density.index_select(number, inner)
    assert density.numel()
    expected = torch.full_like(density, 2.0**box.dimension)
    assert_close(density, expected)


@pytest.mark.parametrize("name", ["square", "cube"])
def test_spread_is_the_scorers_transfer(name: str) -> None:
    box = BOXES[name]
    grid = make_grid(name)
    place = draw_places(name, 400)
    rng = np.random.default_rng(1)
    velocity = rng.normal(size=place.shape)
    position = torch.from_numpy(place).float()
    stencil = grid.stencil(position, one_layer(400))
    value = torch.from_numpy(velocity).float()
    sums = grid.spread(stencil, value, 1)[0]
    expected = transfer(place, velocity, Grid(8, box=box))
    momentum = np.moveaxis(expected.momentum, -1, 0)
    np.testing.assert_allclose(sums.numpy(), momentum, atol=1e-5)


@pytest.mark.parametrize("name", ["square", "cube", "duct"])
def test_gather_is_the_adjoint_of_spread(name: str) -> None:
    """<spread(v), g> = <v, gather(g)>, and so for gradients to positions."""
    grid = make_grid(name)
    generator = torch.Generator().manual_seed(0)
    place = torch.from_numpy(draw_places(name, 100))
    place.requires_grad_()
    layer = torch.arange(100) % 2
    value = torch.randn(100, 3, generator=generator)
    field = torch.randn(2, 3, *grid.shape, generator=generator)
    value = value.double()
    field = field.double()
    gradients = []
    products = []
    for direction in ("spread", "gather"):
        stencil = grid.stencil(place, layer)
        if direction == "spread":
            sums = grid.spread(stencil, value, 2)
            product = torch.sum(sums * field)
        else:
            gathered = grid.gather(stencil, field)
            product = torch.sum(value * gathered)
        products.append(float(product.detach()))
        gradients += torch.autograd.grad(product, place)
    of_spread, of_gather = products
    assert of_spread == pytest.approx(of_gather, rel=1e-9)
    assert_close(*gradients)


@pytest.mark.parametrize(
    "name",
    [
        "square",
        "oblong",
        "cube",
        "channel",
    ],
)
def test_a_shift_along_periodic_axes_shifts_the_prediction(name: str) -> None:
    """By a node of the U-Net's coarsest level, with any weights."""
    box = BOXES[name]
    model = surrogate(name, awake=0.1, context=2, smoothing=0.3)
    velocity = (0.03, -0.01, 0.02)[: box.dimension]
    frames = drift(name, 3, velocity)
    four_nodes = 4 * model.grid.cell.numpy()
    shift = np.where(box.periodic, four_nodes, 0.0)
    shifted_frames = box.wrap(frames + shift)
    path = rolled(model, window_of(frames), 4)
    shifted = rolled(model, window_of(shifted_frames), 4)
    expected = path + torch.from_numpy(shift).float()
    difference = model.box.displacement(expected, shifted)
    assert greatest(difference) < 1e-5
    # Weights that do nothing would pass as well.
    unmoved_model = surrogate(name, smoothing=0.3)
    still = rolled(unmoved_model, window_of(frames), 4)
    effect = model.box.displacement(still, path)
    assert greatest(effect) > 1e-4


@pytest.mark.parametrize("name", ["square", "cube"])
def test_a_flow_through_the_periodic_ends_continues(name: str) -> None:
    """A uniform flow through it costs nothing, and goes on for ever."""
    dimension = BOXES[name].dimension
    velocity = (0.03, -0.02, 0.01)[:dimension]
    frames = drift(name, 12, velocity)
    model = surrogate(name, pushforward=1, recovery=4)
    predicted_count = model.options.bundle * model.options.calls
    count = model.history + predicted_count
    terms = model(window_of(frames[:count]))
    loss = terms["velocity"].detach()
    assert float(loss) < 1e-4

    path = rolled(model, window_of(frames[:3]), 9)
    future = frames[3:].swapaxes(0, 1)
    truth = torch.from_numpy(future).float()
    error = model.box.displacement(truth, path)
    assert greatest(error) < 1e-5
    assert float(path.min()) >= 0.0
    assert float(path.max()) < 1.0


def test_windows_are_shifted_along_periodic_axes_only() -> None:
    """Each by its own way, all frames alike, the first one of the scenario too."""
    name = "channel"
    box = TensorBox(BOXES[name])
    frames = drift(name, 3, (0.03, 0.0))
    one = window_of(frames)
    first_frame = one.position[:, 0]
    both = replace(
        one,
        position=one.position.repeat(2, 1, 1),
        sample=torch.arange(2).repeat_interleave(300),
        scenario=one_layer(2),
        origin=first_frame.repeat(2, 1),
    )
    generator = torch.Generator().manual_seed(0)
    moved = shift_batch(both, box, generator)
    way = box.displacement(both.position, moved.position)
    assert moved.origin is not None
    assert_close(moved.origin, moved.position[:, 0])
    across = way[..., 1]
    assert greatest(across) == 0.0
    first = way[:300, :, 0]
    second = way[300:, :, 0]
    for ways in (first, second):
        shift = ways[:1, :1].expand_as(ways)
        assert_close(ways, shift, rtol=0, atol=1e-6)
    difference = first[0, 0] - second[0, 0]
    assert abs(float(difference)) > 1e-3
