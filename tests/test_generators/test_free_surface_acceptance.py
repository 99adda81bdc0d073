"""Acceptance of the free-surface solver on scenarios of the registry and set pieces.

Sloshing is chaotic, so the bounds are statistical; every family and pair runs at least
twice, in three commits.
"""

from __future__ import annotations

import dataclasses
import functools
from dataclasses import dataclass
from itertools import pairwise
from typing import cast

import numpy as np
import pytest
from free_surface_scenarios import Part, scenario, start
from numpy.typing import NDArray
from scenario_draws import of_this_turn, state_of
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import minimum_spanning_tree
from scipy.spatial import Delaunay, cKDTree

from lagbench.data import registry
from lagbench.generators.constants import solver_constants
from lagbench.generators.free_surface import courant
from lagbench.generators.shapes import Disc, Rectangle
from lagbench.generators.split import FreeSurfaceParameters, InitialState, Material
from validation import dam_break

Array = NDArray[np.float64]

LIQUID_IDS = (0, 4, 1, 5, 2, 6, 3, 7)
PAIR_IDS = (48, 54, 49, 55, 50, 56, 51, 57, 52, 58, 53, 59)
# Equals stand side by side: families repeat with the id by 4, pairs by 6, and a commit
# takes every third.
EVERY = [("fluid", i) for i in LIQUID_IDS] + [("multimaterial", i) for i in PAIR_IDS]
SETTLING = [("fluid", i) for i in (4, 5, 6, 7)] + [("multimaterial", 53)]
SMALL = [("fluid", size, i) for size in ("mini", "tiny") for i in range(4)]
SMALL += [("multimaterial", size, i) for size in ("mini", "tiny") for i in range(6)]


@dataclass(frozen=True)
class History:
    """What a run of a registered scenario left behind; energies are one number per 4
    frames.
    """

    parameters: FreeSurfaceParameters
    state: InitialState
    kinetic: Array
    total: Array
    fastest: float
    position: Array
    ratio: Array
    largest_gap: float
    mach: float  # exceeded by one particle and frame in a thousand
    liquid_jacobian: float  # J above which 99.9 % of liquid particles and frames are
    lowest: Array  # smallest J of liquid or Jp of snow at any substep, of each particle


def constants(split: str, size: str) -> FreeSurfaceParameters:
    """Return the solver's constants at a size of the registry."""
    return cast(
        "FreeSurfaceParameters", solver_constants(registry.load().size(split, size))
    )


FULL = dataclasses.replace(constants("multimaterial", "full"), particles=1250, wall=3)
"""The materials of the data in set pieces of their own."""

FRAME = registry.load().size("multimaterial", "full").substeps_per_frame


def wave_speeds(p: FreeSurfaceParameters) -> Array:
    """Speed of sound by the number of the material: sqrt(M / rho), with the P-wave
    modulus M = E (1 - nu) / ((1 + nu) (1 - 2 nu)) of a solid.
    """
    solids = (
        (p.jelly_modulus, p.jelly_poisson),
        (p.snow_modulus, p.snow_poisson),
        (p.rope_modulus, p.rope_poisson),
    )
    moduli = [p.liquid_modulus]
    for young, nu in solids:
        moduli.append(young * (1.0 - nu) / ((1.0 + nu) * (1.0 - 2.0 * nu)))
    return np.sqrt(np.array(moduli) / p.density)


def spacing(state: InitialState) -> float:
    """Mean distance of particles, the square root of the area of one."""
    return float(np.sqrt(state.area / len(state.position)))


@functools.cache
def history(split: str, size: str, scenario_id: int, frames: int) -> History:
    """Run a scenario of the registry once for all tests."""
    solver_parameters = constants(split, size)
    state = state_of(split, size, scenario_id)
    solver = start(solver_parameters, [state])
    substeps = registry.load().size(split, size).substeps_per_frame
    kinetic = []
    total = []
    fastest = 0.0
    gap = 0.0
    sound = wave_speeds(solver_parameters)[state.material]
    is_liquid = state.material == Material.LIQUID
    mach = []
    jacobian = []
    energy = solver.energy()
    for _ in range(frames // 4):
        kinetic.append(energy.kinetic[0])
        total.append(energy.total[0])
        solver.advance(4 * substeps)
        (health,) = solver.health()
        assert health.finite
        fastest = max(fastest, health.max_speed)
        mach.append(np.linalg.norm(solver.velocity()[0], axis=1) / sound)
        jacobian.append(solver.volume_ratio()[0, is_liquid])
        rope = solver.position()[0, state.material == Material.ROPE].astype(np.float64)
        if len(rope) and len(kinetic) % 15 == 0:
            gap = max(gap, longest_edge(rope))
        energy = solver.energy()
    return History(
        parameters=solver_parameters,
        state=state,
        kinetic=np.array([*kinetic, energy.kinetic[0]]),
        total=np.array([*total, energy.total[0]]),
        fastest=fastest,
        position=solver.position()[0].astype(np.float64),
        ratio=solver.volume_ratio()[0].astype(np.float64),
        largest_gap=gap,
        mach=float(np.quantile(mach, 0.999)),
        liquid_jacobian=float(np.quantile(jacobian, 0.001)) if is_liquid.any() else 1.0,
        lowest=solver.volume_ratio_extremes()[0][0].astype(np.float64),
    )


def longest_edge(position: Array) -> float:
    """Return the largest gap that holds a body together: the longest edge of its
    spanning tree.
    """
    triangles = Delaunay(position).simplices
    sides = [triangles[:, pair] for pair in ([0, 1], [1, 2], [0, 2])]
    first, second = np.concatenate(sides).T
    length = np.linalg.norm(position[first] - position[second], axis=1)
    graph = coo_matrix((length, (first, second)), shape=(len(position), len(position)))
    return float(minimum_spanning_tree(graph.tocsr()).data.max())


def relative_density(position: Array, area: float, p: FreeSurfaceParameters) -> Array:
    """Density over rest density at the particles, from B-splines mirrored at the walls,
    in float64.
    """
    scaled = position * p.grid
    base = np.floor(scaled - 0.5).astype(int)
    f = scaled - base
    weight = (0.5 * (1.5 - f) ** 2, 0.75 - (f - 1.0) ** 2, 0.5 * (f - 0.5) ** 2)
    count = np.zeros((p.grid + 1, p.grid + 1))
    stencil = [
        (i, j, weight[i][:, 0] * weight[j][:, 1]) for i in range(3) for j in range(3)
    ]
    for i, j, w in stencil:
        np.add.at(count, (base[:, 0] + i, base[:, 1] + j), w)
    for n in (count, count.T):
        for wall, inside, outside in ((p.wall, 1, -1), (p.grid - p.wall, -1, 1)):
            n[wall] *= 2.0
            n[wall + inside] += n[wall + outside]
            n[wall + outside] = n[wall + inside]
    gathered = np.sum(
        [w * count[base[:, 0] + i, base[:, 1] + j] for i, j, w in stencil], axis=0
    )
    return np.asarray(gathered * area / p.particles * p.grid**2)


@pytest.mark.parametrize("size", ["full", "mini", "tiny"])
def test_sound_stays_within_a_cell(size: str) -> None:
    """The acoustic Courant number of every material of a split is at most 0.8 at every
    size.
    """
    assert courant(constants("fluid", size))[Material.LIQUID] <= 0.8
    assert max(courant(constants("multimaterial", size)).values()) <= 0.8


def assert_sound(run: History) -> None:
    """Positions lie between the walls, nobody crosses a cell in a substep, energy
    falls.

    Energy never rises above its running minimum by 2 % of what was dissipated.
    """
    low = run.parameters.wall / run.parameters.grid
    assert run.position.min() >= low
    assert run.position.max() <= 1.0 - low
    assert run.fastest * run.parameters.dt * run.parameters.grid <= 0.8
    rise = (run.total - np.minimum.accumulate(run.total)).max()
    assert rise <= 0.02 * (run.total[0] - run.total.min())


@pytest.mark.slow
@pytest.mark.parametrize(("split", "scenario_id"), of_this_turn(EVERY, turns=3))
def test_scenarios_are_sound(split: str, scenario_id: int) -> None:
    """A scenario keeps box, CFL bound and falling energy, its motion dies out, its rope
    stays in one piece.

    Every particle of a rope has a neighbour within 2 spacings, and no gap grows by
    half. The first points themselves hang together by gaps of 2.0 to 2.4 spacings, the
    rows of the R2 lattice, so the gap of the spanning tree is compared with its own
    start.
    """
    run = history(split, "full", scenario_id, 600)
    assert_sound(run)
    assert run.mach <= 0.3
    assert run.liquid_jacobian >= 0.9
    p = run.parameters
    material = run.state.material
    assert (run.lowest[material == Material.LIQUID] > p.jacobian_min).all()
    # neither Jp nor the hardening exp(xi (1 - Jp)) meets its numerical bound
    least_plastic = max(
        p.snow_jp_min, 1.0 - np.log(p.snow_hardening_max) / p.snow_hardening
    )
    assert (run.lowest[material == Material.SNOW] > least_plastic).all()
    assert run.kinetic[-1] <= 0.03 * run.kinetic.max()
    rope = run.state.material == Material.ROPE
    if rope.any():
        position = run.position[rope]
        distance, _ = cKDTree(position).query(position, k=2)
        neighbour = np.asarray(distance)[:, 1]
        assert neighbour.max() <= 2.0 * spacing(run.state)
        assert run.largest_gap <= 1.5 * longest_edge(run.state.position[rope])


@pytest.mark.slow
@pytest.mark.parametrize(("split", "scenario_id"), of_this_turn(SETTLING, turns=3))
def test_settled_liquid(split: str, scenario_id: int) -> None:
    """After 1500 frames: rest density, even depth, hydrostatic pressure.

    Density and pressure count below the surface by two cells; the profile is judged in
    bins of depth, in units of the pressure on the floor.
    """
    run = history(split, "full", scenario_id, 1500)
    p = run.parameters
    cell = 1.0 / run.parameters.grid
    low = p.wall * cell
    columns = 16
    width = 1.0 - 2.0 * low
    x, y = run.position.T
    share = (x - low) / width
    column = np.clip(share * columns, 0, columns - 1).astype(int)
    heights = [np.quantile(y[column == c], 0.98) for c in range(columns)]
    top = np.array(heights) - low
    np.testing.assert_allclose(top, run.state.area / width, rtol=0.25)
    below = low + top[column] - y
    deep = below > 2.0 * cell
    density = relative_density(run.position, run.state.area, p)[deep]
    assert abs(density.mean() - 1.0) <= 0.02
    assert density.std() <= 0.05
    pressure = p.liquid_modulus * (1.0 - run.ratio)
    floor = p.density * p.gravity * top.mean()
    for start_of_bin, end in pairwise(np.linspace(2.0 * cell, top.mean(), 6)):
        here = (below >= start_of_bin) & (below < end)
        excess = pressure[here].mean() - p.density * p.gravity * below[here].mean()
        assert abs(excess) <= 0.1 * floor


@pytest.mark.slow
@pytest.mark.parametrize("shape", [Rectangle(0.22, 0.22), Disc(0.125)])
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
    first, second = tree.query_pairs(reach, output_type="ndarray").T
    x = solver.position()[0].astype(np.float64)
    distance = np.linalg.norm(x[first] - x[second], axis=1)
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
    ball = Part(Material.JELLY, Disc(radius), (0.5, 3 / 64 + drop + radius))
    state = scenario(FULL, ball, seed=seed)
    solver = start(FULL, [state])
    heights = []
    for _ in range(120):
        heights.append(float(solver.position()[0, :, 1].mean()))
        solver.advance(FRAME)
    lowest = int(np.argmin(heights[:60]))
    rest = heights[0] - drop
    assert 0.6 <= (max(heights[lowest:]) - rest) / drop <= 0.9
    solver.advance(480 * FRAME)
    # root mean square distance after the best rigid motion (Kabsch)
    after = solver.position()[0].astype(np.float64)
    a = state.position - state.position.mean(axis=0)
    b = after - after.mean(axis=0)
    u, _, vt = np.linalg.svd(a.T @ b)
    turn = u @ np.diag([1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    square = ((a @ turn - b) ** 2).sum(axis=1)
    assert np.sqrt(square.mean()) <= 0.03 * radius


@pytest.mark.slow
@pytest.mark.parametrize(
    ("material", "young"), [(Material.ROPE, 150.0), (Material.JELLY, 90.0)]
)
def test_bar_rings_at_its_frequency(material: Material, young: float) -> None:
    """A free bar swings lengthwise at sqrt(E / (rho (1 - nu^2))) / 2L to 2 %."""
    length = 0.6
    weightless = dataclasses.replace(FULL, particles=900, gravity=0.0)
    state = scenario(weightless, Part(material, Rectangle(length, 0.05), (0.5, 0.5)))
    mode = np.cos(np.pi * (state.position[:, 0] - 0.5 + 0.5 * length) / length)
    state.velocity[:, 0] = 0.05 * mode
    solver = start(weightless, [state])
    amplitude = []
    for _ in range(1200):
        solver.advance(5)
        amplitude.append(float((solver.velocity()[0, :, 0] * mode).mean()))
    a = np.array(amplitude)
    before = np.flatnonzero(np.diff(np.sign(a)))
    crossing = (before + a[before] / (a[before] - a[before + 1])) * 5 * weightless.dt
    frequency = 0.5 * (len(crossing) - 1) / (crossing[-1] - crossing[0])
    expected = np.sqrt(young / (1.0 - 0.3**2)) / (2.0 * length)
    assert frequency == pytest.approx(expected, rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("split", "size", "scenario_id"), of_this_turn(SMALL, turns=3, shift=1)
)
def test_small_sizes_are_sound(split: str, size: str, scenario_id: int) -> None:
    """With the constants of ``full``, mini and tiny keep box, CFL bound and falling
    energy.
    """
    assert_sound(history(split, size, scenario_id, 300))


@pytest.mark.slow
def test_dam_break_follows_the_experiment() -> None:
    """The front of a breaking column is within 10 % of Martin and Moyce (1952), and it
    never recedes.
    """
    result = dam_break.run("full")
    assert result.deviation <= 0.10
    assert (np.diff(result.front) > 0.0).all()
