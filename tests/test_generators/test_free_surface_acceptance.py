"""Acceptance of the free-surface solver on scenarios of the registry and set pieces.

Sloshing is chaotic, so the bounds are statistical; every family and pair runs at least
twice, in three turns.
"""

from __future__ import annotations

import dataclasses
from itertools import pairwise
from typing import cast

import numpy as np
import pytest
from free_surface_scenarios import Part, scenario, start
from numpy.typing import NDArray
from scenario_draws import state_of
from scipy.spatial import cKDTree
from turns import of_this_turn

from lagbench.data import registry
from lagbench.generators.constants import solver_constants
from lagbench.generators.free_surface import courant
from lagbench.generators.shapes import Disc, Rectangle
from lagbench.generators.split import FreeSurfaceParameters, InitialState, Material
from validation import dam_break

Array = NDArray[np.float64]

SETTLING = [
    ("fluid", 4),
    ("fluid", 5),
    ("fluid", 6),
    ("fluid", 7),
    ("multimaterial", 53),
]
"""They run on until the liquid is at rest."""


def constants(split: str, size: str) -> FreeSurfaceParameters:
    """Return the solver's constants at a size of the registry."""
    described = registry.load().size(split, size)
    return cast("FreeSurfaceParameters", solver_constants(described))


FULL = dataclasses.replace(
    constants("multimaterial", "full"),
    particles=1250,
    wall=3,
)
"""The materials of the data in set pieces of their own."""

FULL_SIZE = registry.load().size("multimaterial", "full")
FRAME = FULL_SIZE.substeps_per_frame


def spacing(state: InitialState) -> float:
    """Mean distance of particles, the square root of the area of one."""
    particle_area = state.area / len(state.position)
    return float(np.sqrt(particle_area))


def relative_density(
    position: Array,
    area: float,
    p: FreeSurfaceParameters,
) -> Array:
    """Density over rest density at the particles, from B-splines mirrored at the walls,
    in float64.
    """
    scaled = position * p.grid
    base = np.floor(scaled - 0.5).astype(int)
    f = scaled - base
    low = 0.5 * (1.5 - f) ** 2
    middle = 0.75 - (f - 1.0) ** 2
    high = 0.5 * (f - 0.5) ** 2
    weight = (low, middle, high)
    stencil = []
    for i, j in np.ndindex(3, 3):
        column = base[:, 0] + i
        row = base[:, 1] + j
        node_weight = weight[i][:, 0] * weight[j][:, 1]
        stencil.append(((column, row), node_weight))

    node_count = p.grid + 1
    count = np.zeros((node_count, node_count))
    for node, w in stencil:
        np.add.at(count, node, w)
    low_wall = p.wall
    high_wall = p.grid - p.wall
    walls = [(low_wall, 1), (high_wall, -1)]
    for n in (count, count.T):
        for wall, inwards in walls:
            inner = wall + inwards
            outer = wall - inwards
            n[wall] *= 2.0
            n[inner] += n[outer]
            n[outer] = n[inner]

    gathered = np.zeros(len(position))
    for node, w in stencil:
        gathered += w * count[node]
    particle_area = area / p.particles
    return gathered * particle_area * p.grid**2


@pytest.mark.parametrize("size", ["full", "mini", "tiny"])
def test_sound_stays_within_a_cell(size: str) -> None:
    """The acoustic Courant number of every material of a split is at most 0.8 at every
    size.
    """
    liquid = courant(constants("fluid", size))
    materials = courant(constants("multimaterial", size))
    assert liquid[Material.LIQUID] <= 0.8
    assert max(materials.values()) <= 0.8


@pytest.mark.slow
@pytest.mark.parametrize(
    ("split", "scenario_id"),
    of_this_turn(SETTLING, turns=3),
)
def test_settled_liquid(split: str, scenario_id: int) -> None:
    """The energy falls up to 2 % of what was dissipated, no particle leaves the box;
    after 1500 frames: rest density, even depth, hydrostatic pressure.

    Density and pressure count below the surface by two cells; the profile is judged in
    bins of depth, in units of the pressure on the floor.
    """
    p = constants(split, "full")
    state = state_of(split, "full", scenario_id)
    solver = start(p, [state])
    energies = []
    for _ in range(150):
        energies.append(solver.energy().total[0])
        solver.advance(10 * registry.load().size(split, "full").substeps_per_frame)
    total = np.array(energies)
    largest_rise = np.max(total - np.minimum.accumulate(total))
    assert largest_rise <= 0.02 * (total[0] - total.min())
    position = solver.position()[0].astype(np.float64)
    assert position.min() >= p.wall / p.grid
    assert position.max() <= 1.0 - p.wall / p.grid

    cell = 1.0 / p.grid
    low = p.wall * cell
    columns = 16
    width = 1.0 - 2.0 * low
    x, y = position.T
    share = (x - low) / width
    column = np.clip(share * columns, 0, columns - 1)
    column = column.astype(int)
    heights = []
    for c in range(columns):
        column_heights = y[column == c]
        heights.append(np.quantile(column_heights, 0.98))
    top = np.array(heights) - low
    mean_depth = state.area / width
    np.testing.assert_allclose(top, mean_depth, rtol=0.25)

    below = low + top[column] - y
    density = relative_density(position, state.area, p)
    deep_density = density[below > 2.0 * cell]
    assert abs(deep_density.mean() - 1.0) <= 0.02
    assert deep_density.std() <= 0.05

    pressure = p.liquid_modulus * (1.0 - solver.volume_ratio()[0])
    weight = p.density * p.gravity  # per area and depth
    mean_top = top.mean()
    floor_pressure = weight * mean_top
    depths = np.linspace(2.0 * cell, mean_top, 6)
    for least_depth, most_depth in pairwise(depths):
        here = (below >= least_depth) & (below < most_depth)
        hydrostatic = weight * below[here].mean()
        excess = pressure[here].mean() - hydrostatic
        assert abs(excess) <= 0.1 * floor_pressure


@pytest.mark.slow
@pytest.mark.parametrize(
    "shape",
    [
        Rectangle(0.22, 0.22),
        Disc(0.125),
    ],
)
@pytest.mark.parametrize("seed", [1, 2])
def test_snow_compacts_and_breaks(shape: Rectangle | Disc, seed: int) -> None:
    """Dropped by 0.45, 25 to 85 % of the snow is compacted and neighbours are torn
    apart.
    """
    height = 3 / 64 + 0.45 + shape.reach[1]
    snow = Part(Material.SNOW, shape, (0.5, height))
    state = scenario(FULL, snow, seed=seed, friction=0.3)
    solver = start(FULL, [state])
    solver.advance(150 * FRAME)
    is_compacted = solver.volume_ratio()[0] < 1.0
    assert 0.25 <= is_compacted.mean() <= 0.85

    reach = 1.5 * spacing(state)
    tree = cKDTree(state.position)
    pairs = tree.query_pairs(reach, output_type="ndarray")
    first, second = pairs.T
    x = solver.position()[0].astype(np.float64)
    difference = x[first] - x[second]
    distance = np.linalg.norm(difference, axis=1)
    torn = distance > 3.0 * spacing(state)
    assert torn.mean() >= 0.05


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_jelly_rebounds_and_keeps_its_shape(seed: int) -> None:
    """Dropped by 0.45, a ball rises to 0.6-0.9 of that and is round again at frame
    600.
    """
    radius = 0.126
    drop = 0.45
    floor = 3 / 64
    centre = (0.5, floor + drop + radius)
    ball = Part(Material.JELLY, Disc(radius), centre)
    state = scenario(FULL, ball, seed=seed)
    solver = start(FULL, [state])
    heights = []
    for _ in range(120):
        y = solver.position()[0, :, 1]
        heights.append(float(y.mean()))
        solver.advance(FRAME)
    lowest = int(np.argmin(heights[:60]))
    rest = heights[0] - drop
    rebound = max(heights[lowest:]) - rest
    assert 0.6 <= rebound / drop <= 0.9
    solver.advance(480 * FRAME)
    # root mean square distance after the best rigid motion (Kabsch)
    before = state.position
    after = solver.position()[0].astype(np.float64)
    a = before - before.mean(axis=0)
    b = after - after.mean(axis=0)
    u, _, vt = np.linalg.svd(a.T @ b)
    handedness = np.sign(np.linalg.det(u @ vt))
    signs = np.diag([1.0, handedness])
    rotation = u @ signs @ vt
    deviation = a @ rotation - b
    square = np.sum(deviation**2, axis=1)
    error = np.sqrt(square.mean())
    assert error <= 0.03 * radius


@pytest.mark.slow
@pytest.mark.parametrize(
    ("material", "young"),
    [
        (Material.ROPE, 150.0),
        (Material.JELLY, 90.0),
    ],
)
def test_bar_rings_at_its_frequency(material: Material, young: float) -> None:
    """A free bar swings lengthwise at sqrt(E / (rho (1 - nu^2))) / 2L to 2 %."""
    length = 0.6
    weightless = dataclasses.replace(FULL, particles=900, gravity=0.0)
    shape = Rectangle(length, 0.05)
    bar = Part(material, shape, (0.5, 0.5))
    state = scenario(weightless, bar)
    left_end = 0.5 - 0.5 * length
    distance = state.position[:, 0] - left_end
    along = distance / length
    mode = np.cos(np.pi * along)
    state.velocity[:, 0] = 0.05 * mode
    solver = start(weightless, [state])
    amplitude = []
    for _ in range(1200):
        solver.advance(5)
        velocity = solver.velocity()[0, :, 0]
        mean = np.mean(velocity * mode)
        amplitude.append(float(mean))
    a = np.array(amplitude)
    is_change = np.diff(np.sign(a)) != 0
    before = np.flatnonzero(is_change)
    after = before + 1
    # where the line between the two amplitudes is 0
    share = a[before] / (a[before] - a[after])
    crossing = (before + share) * 5 * weightless.dt
    half_periods = len(crossing) - 1
    duration = crossing[-1] - crossing[0]
    frequency = 0.5 * half_periods / duration
    sound = np.sqrt(young / (1.0 - 0.3**2))
    expected = sound / (2.0 * length)
    assert frequency == pytest.approx(expected, rel=0.02)


@pytest.mark.slow
def test_dam_break_follows_the_experiment() -> None:
    """The front of a breaking column is within 10 % of Martin and Moyce (1952), and it
    never recedes.
    """
    result = dam_break.run("full")
    assert result.deviation <= 0.10
    advance = np.diff(result.front)
    assert (advance > 0.0).all()
