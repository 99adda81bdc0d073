"""Shape matching and density projection against SciPy's rotations and lattices."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from simple_models import info, jittered
from torch import Tensor
from torch.testing import assert_close

from lagbench.baselines.particle_grid import ParticleGrid
from lagbench.baselines.projection import (
    LEARNING_SCALE,
    DensityProjection,
    Projection,
    ShapeMatching,
)

BOUNDS = info().bounds
FULL_STEP = torch.tensor(1.0)
"""The share of a correction that is applied: all of it."""


def body(
    seed: int,
    low: float = 0.3,
    high: float = 0.7,
) -> Tensor:
    """Return a square body in double precision."""
    position = jittered(seed, low=low, high=high)
    return torch.from_numpy(position).double()


def two_bodies() -> Tensor:
    """Return two bodies of 256 particles in one place in single precision."""
    both = torch.cat([body(0), body(1)])
    return both.float()


def one_window(position: Tensor) -> Tensor:
    """Return the sample numbers of particles of one window."""
    count = len(position)
    return torch.zeros(count, dtype=torch.int64)


def random_displacement(
    rng: np.random.Generator,
    deviation: float,
    count: int,
) -> Tensor:
    """Return normal displacements in double precision, shape [particle, 2]."""
    displacement = rng.normal(0.0, deviation, (count, 2))
    return torch.from_numpy(displacement)


def match_shape(position: Tensor, cells: int = 8) -> ShapeMatching:
    """Return the clusters of one body in double precision."""
    grid = ParticleGrid(BOUNDS, cells).double()
    sample = one_window(position)
    return ShapeMatching.build(grid, position, sample, 1)


def project_density(position: Tensor) -> DensityProjection:
    """Return the densities of one window in double precision."""
    grid = ParticleGrid(BOUNDS, 8).double()
    sample = one_window(position)
    return DensityProjection.build(grid, position, sample, 1)


def rotate(position: Tensor, angle: float) -> Tensor:
    """Return positions turned about the middle of the box."""
    cosine = np.cos(angle)
    sine = np.sin(angle)
    rotation = torch.tensor(
        [
            [cosine, sine],
            [-sine, cosine],
        ]
    )
    return (position - 0.5) @ rotation + 0.5


def add_noise(position: Tensor, scale: float) -> Tensor:
    """Return single precision positions with normal noise."""
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(position.shape, generator=generator)
    return position + scale * noise


def squeeze(position: Tensor, factor: float) -> Tensor:
    """Return positions nearer to the middle of the box."""
    return factor * (position - 0.5) + 0.5


@pytest.mark.parametrize("angle", [0.0, 0.4, 2.0, -3.1])
def test_rigid_motion_is_left_as_it_is(angle: float) -> None:
    """However far a body turns and flies, it has its shape."""
    first = body(0)
    flight = torch.tensor([0.1, -0.2])
    moved = rotate(first, angle) + flight
    matched = match_shape(first).match(moved)
    assert_close(matched, moved, rtol=0, atol=1e-9)


def in_space(position: Tensor) -> NDArray[np.float64]:
    """Return positions with z = 0."""
    one_more_column = ((0, 0), (0, 1))
    return np.pad(position.numpy(), one_more_column)


def test_clusters_turn_as_scipy_says() -> None:
    """Each cluster's rotation is the best weighted one; SciPy finds it per node."""
    rng = np.random.default_rng(0)
    first = body(0, low=0.4, high=0.6)[:40]
    noise = random_displacement(rng, 0.01, 40)
    position = rotate(first, 0.7) + noise
    matching = match_shape(first, cells=6)

    # The weight of each particle in each node's cluster, shape [node, particle].
    weight = np.zeros((matching.node_count, 40))
    nodes_of_particles = matching.stencil.node.view(-1, 9)
    shares_of_particles = matching.stencil.weight.numpy()
    for particle in range(40):
        nodes = nodes_of_particles[particle].numpy()
        weight[nodes, particle] = shares_of_particles[particle]
    occupied = weight.sum(axis=1) > 0.0

    expected = np.zeros((40, 2))
    x = in_space(first)
    y = in_space(position)
    for cluster_weight in weight[occupied]:
        x_centre = np.average(x, axis=0, weights=cluster_weight)
        y_centre = np.average(y, axis=0, weights=cluster_weight)
        best, _ = Rotation.align_vectors(
            y - y_centre,
            x - x_centre,
            weights=cluster_weight,
        )
        angle = best.as_rotvec()[2]  # in the plane: no other axis
        in_plane = Rotation.from_rotvec([0.0, 0.0, angle])
        goal = y_centre + in_plane.apply(x - x_centre)
        share = cluster_weight[:, None]
        expected += share * goal[:, :2]

    matched = matching.match(position).numpy()
    difference = np.abs(matched - expected)
    assert difference.max() < 1e-9


def test_shape_matching_keeps_both_momenta_and_restores_the_shape() -> None:
    """The centre and the spin of a body stay; each step is nearer to its shape."""
    rng = np.random.default_rng(1)
    first = body(0)
    noise = random_displacement(rng, 0.02, len(first))
    position = rotate(first, 0.3) + noise
    matched = match_shape(body(0)).match(position)
    correction = matched - position

    no_momentum = torch.zeros(2).double()
    total = correction.sum(dim=0)
    assert_close(total, no_momentum, rtol=0, atol=1e-9)
    x, y = position.T
    x_correction, y_correction = correction.T
    spin = x * y_correction - y * x_correction
    assert abs(float(spin.sum())) < 1e-9
    total_way = correction.abs().sum()
    assert float(total_way) > 1e-9

    def shape_error(position: Tensor) -> float:
        difference = torch.pdist(position) - torch.pdist(first)
        return float(difference.square().mean())

    assert shape_error(matched) < 0.1 * shape_error(position)


@pytest.mark.parametrize(
    "sides",
    [
        (0.875, 0.875),
        (0.875, 0.31),
    ],
)
@pytest.mark.parametrize("cells", [6, 7])
def test_a_full_box_is_evenly_dense(
    cells: int,
    sides: tuple[float, float],
) -> None:
    """That includes the walls, where splines lie partly outside.

    In some of the cases the cells do not fill the box.
    """
    number = torch.arange(150).double()
    unit_axis = (number + 0.5) / 150
    width, height = sides
    x_axis = 0.0625 + width * unit_axis
    y_axis = 0.0625 + height * unit_axis
    lattice = torch.cartesian_prod(x_axis, y_axis)
    sample = one_window(lattice)
    bounds = (
        (0.0625, 0.0625 + width),
        (0.0625, 0.0625 + height),
    )
    grid = ParticleGrid(bounds, cells).double()

    projection = DensityProjection.build(grid, lattice, sample, 1)
    stencil = grid.stencil(lattice, sample)
    density, mass = projection.relative_density(stencil)
    evenly = torch.ones_like(density)
    assert_close(density, evenly, rtol=4e-3, atol=0)
    assert float(mass.sum()) == pytest.approx(150**2)
    cell_area = grid.spacing**2
    particles_per_cell = 150**2 * cell_area / (width * height)
    greatest = float(projection.greatest)
    assert greatest == pytest.approx(particles_per_cell, rel=4e-3)


@pytest.mark.parametrize(
    "shift",
    [
        (-0.22, -0.22),
        (-0.22, 0.0),
        (0.0, -0.22),
    ],
)
def test_the_density_projection_parts_bodies_in_one_place(
    shift: tuple[float, float],
) -> None:
    """Their centre stays; at rest nothing moves, by a bit."""
    offset = torch.tensor(shift)
    first_body = body(0, 0.3, 0.45)
    second_body = body(1, 0.3, 0.45)
    apart = torch.cat([first_body, second_body - offset])
    projection = project_density(apart)
    limit = torch.ones(len(apart)).double()
    at_rest = projection.correct(apart, FULL_STEP, limit)
    assert torch.equal(at_rest, apart)

    in_one_place = apart.clone()
    in_one_place[256:] += offset
    position = in_one_place
    greatest_density = []
    for _ in range(12):
        stencil = projection.grid.stencil(position, projection.sample)
        density, _ = projection.relative_density(stencil)
        greatest_density.append(float(density.max()))
        position = projection.correct(position, FULL_STEP, limit)

    centre = in_one_place.mean(dim=0)
    new_centre = position.mean(dim=0)
    assert_close(new_centre, centre, rtol=0, atol=1e-9)
    assert greatest_density[0] > 1.6
    assert greatest_density[-1] < 1.15


def test_a_heap_is_not_thrown_apart() -> None:
    """A body in a twenty-fifth of its place moves by a cell or two, however dense."""
    projection = project_density(body(0))
    heap = squeeze(body(1), 0.2)
    limit = torch.ones(256).double()
    corrected = projection.correct(heap, FULL_STEP, limit)
    distance = (corrected - heap).norm(dim=1)
    greatest = float(distance.max())
    assert 1.0 < greatest / projection.grid.spacing < 2.5


def test_each_material_goes_its_share_of_the_way_to_its_shape() -> None:
    """Jelly (1) goes a quarter of the way, rope (3) three quarters."""
    first = two_bodies()
    position = add_noise(first, 0.02)
    material = torch.tensor([1, 3]).repeat(256)
    sample = one_window(first)
    model = Projection(BOUNDS, shape=(8,), density=())
    share_by_material = {1: 0.25, 3: 0.75}
    shares = torch.tensor(list(share_by_material.values()))
    with torch.no_grad():
        model.held.copy_(shares.logit() / LEARNING_SCALE)

    start = model.start(first, material, sample, 1)
    projected = model(start, position)
    for kind, share in share_by_material.items():
        members = material == kind
        grid = ParticleGrid(BOUNDS, 8)
        own_first = first[members]
        own_sample = sample[members]
        matching = ShapeMatching.build(grid, own_first, own_sample, 1)
        now = position[members]
        whole_way = matching.match(now) - now
        expected = now + share * whole_way
        own_projected = projected[members]
        assert_close(own_projected, expected, rtol=0, atol=1e-6)


def two_windows() -> tuple[Tensor, Tensor]:
    """Return two bodies of 256 particles, and their sample numbers."""
    first_body = body(0)
    second_body = body(1, 0.4, 0.6)
    both = torch.cat([first_body, second_body])
    sample = torch.arange(2).repeat_interleave(256)
    return both.float(), sample


def test_windows_side_by_side_do_not_see_each_other() -> None:
    first, sample = two_windows()
    position = add_noise(squeeze(first, 0.9), 0.01)
    material = torch.arange(4).repeat(128)
    model = Projection(BOUNDS, shape=(4, 8), density=(8,))

    start = model.start(first, material, sample, 2)
    together = model(start, position)
    for window in range(2):
        members = sample == window
        own_first = first[members]
        own_material = material[members]
        own_sample = one_window(own_first)
        start = model.start(own_first, own_material, own_sample, 1)
        alone = model(start, position[members])
        own_together = together[members]
        assert_close(own_together, alone, rtol=0, atol=1e-6)


def test_only_jelly_and_rope_come_back_to_their_shape() -> None:
    first, sample = two_windows()
    position = add_noise(squeeze(first, 0.9), 0.01)
    material = torch.arange(4).repeat(128)
    model = Projection(BOUNDS, shape=(4, 8), density=())

    start = model.start(first, material, sample, 2)
    correction = model(start, position) - position
    displacement = correction.abs().amax(dim=1)
    is_elastic = (material == 1) | (material == 3)
    assert torch.equal(displacement > 0.0, is_elastic)


@pytest.mark.parametrize("material", [0, 1])
def test_every_weight_has_a_gradient(material: int) -> None:
    """Training on several devices needs it, also where nothing is elastic or dense."""
    first = body(0).float()
    materials = torch.full((256,), material)
    model = Projection(BOUNDS, shape=(4, 8), density=(8,))
    sample = one_window(first)
    start = model.start(first, materials, sample, 1)
    projected = model(start, first + 0.3)
    projected.sum().backward()
    for parameter in model.parameters():
        assert parameter.grad is not None
