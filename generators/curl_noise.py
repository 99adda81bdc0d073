"""Decaying curl noise: a fluid stirred once, in a free-slip box (thesis §5.9).

The initial velocity is the rotated gradient of one stream function,

    u = dpsi/dy,  v = -dpsi/dx,  psi = s L Perlin(F X, F Y) w(X) w(1 - X) w(Y) w(1 - Y),

with X, Y in [0, 1] across the box of width L, lattice frequency F = id % count + least
(Eq. 5.55), and Bridson's ramp w over the first half cell from a wall. The scale is s =
s0 (F0 / F)^k: with k = 0 a higher frequency has more energy (full), with k = 2 all have
one vorticity (mini, whose slow flows would be frozen ones). psi is 0 on the walls,
hence no flow crosses them; u_x + v_y = 0 holds to the bit. The viscosity at mini is
about what the transfers of a run without refinement add to the equations; full and tiny
state none, and have that of their transfers alone. Larger vortices live longer: about
three quarters of the energy is left after 600 frames at frequency 4 of full, a few per
cent at 13.

The subset ``shift`` of mini and full lies outside train on purpose: its scenarios
alternate between a frequency below all of train and one above.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lagbench.errors import UsageError

from .constants import constants, shift_number
from .draws import RandomSource, fill_grid, quantise
from .full_box_parameters import FullBoxParameters
from .noise import Jet, coordinates, gradients, noise, ramp
from .split import InitialState, liquid

if TYPE_CHECKING:
    from lagbench.data.registry import Size

Array = NDArray[np.float64]


def solver_parameters(size: Size) -> FullBoxParameters:
    """Return the solver's constants at this size; walls let the fluid slide."""
    return constants(FullBoxParameters, size, box=size.box, no_slip=False)


def stream_function(
    position: Array,
    lattice: Array,
    *,
    low: float,
    high: float,
    scale: float,
) -> Jet:
    """Return psi [length^2/s] and its derivatives at points between the walls.

    Args:
        position: points [length], shape [point, 2].
        lattice: Perlin gradients, shape [F + 1, F + 1, 2].
        low: coordinate of the left and bottom walls [length].
        high: coordinate of the right and top walls [length].
        scale: s [length/s].

    The velocity is u = psi.y and v = -psi.x.
    """
    width = high - low
    per_length = float(len(lattice) - 1) / width
    x, y = coordinates(position)
    minus_x = x.scale(-1.0)
    minus_y = y.scale(-1.0)
    # distances from the walls, in cells of the lattice at last; measured from its own
    # wall, the ramp is exactly 0 there
    left_distance = x.shift(-low)
    bottom_distance = y.shift(-low)
    right_distance = minus_x.shift(high)
    top_distance = minus_y.shift(high)
    from_left = left_distance.scale(per_length)
    from_bottom = bottom_distance.scale(per_length)
    from_right = right_distance.scale(per_length)
    from_top = top_distance.scale(per_length)

    psi = noise(from_left, from_bottom, lattice)
    for distance in (from_left, from_bottom, from_right, from_top):
        half_cells = distance.scale(2.0)
        window = ramp(half_cells)
        psi = psi * window
    amplitude = scale * width
    return psi.scale(amplitude)


def _pairs(x: Array, y: Array) -> Array:
    """Return vectors from their components, shape [point, 2]."""
    return np.stack([x, y], axis=-1)


def flow(psi: Jet) -> tuple[Array, Array]:
    """Return velocity [point, 2] and its gradient C [point, 2, 2], multiples of
    2^-20.
    """
    u = psi.y
    v = -psi.x
    u_x = psi.xy
    u_y = psi.yy
    v_x = -psi.xx
    v_y = -psi.xy
    velocity = _pairs(u, v)
    gradient_of_u = _pairs(u_x, u_y)
    gradient_of_v = _pairs(v_x, v_y)
    affine = np.stack([gradient_of_u, gradient_of_v], axis=1)
    return quantise(velocity), quantise(affine)


def _root_mean_square(values: Array) -> float:
    square_sum = _sum_of_squares(values)
    return math.sqrt(square_sum / values.size)


def _sum_of_squares(values: Array) -> float:
    """Return the sum of squares, rounded once."""
    flat = values.ravel()
    squares = [value * value for value in flat.tolist()]
    return math.fsum(squares)


def _grid_rates(lattice: Array, size: Size, scale: float) -> tuple[float, float]:
    """Return RMS divergence (Eq. 5.54) and vorticity [1/s] as the solver's grid sees
    them.

    Central differences between nodes inside the walls: what is not zero of the
    divergence is the grid's share, not the field's.
    """
    low, high = size.bounds[0]
    parameters = solver_parameters(size)
    node = (parameters.origin[0] + 1.0 + np.arange(parameters.cells[0])) / size.grid
    node_count = len(node)
    grid_x, grid_y = np.meshgrid(node, node, indexing="ij")
    x = grid_x.ravel()
    y = grid_y.ravel()
    points = _pairs(x, y)

    psi = stream_function(points, lattice, low=low, high=high, scale=scale)
    grid_shape = (node_count, node_count)
    u = psi.y.reshape(grid_shape)
    v = -psi.x.reshape(grid_shape)

    # neighbours of the inner nodes
    inner = slice(1, -1)
    after = slice(2, None)
    before = slice(None, -2)
    east = (after, inner)
    west = (before, inner)
    north = (inner, after)
    south = (inner, before)
    per_difference = 0.5 * size.grid  # slope for a difference over two cells
    divergence = (u[east] - u[west] + v[north] - v[south]) * per_difference
    vorticity = (v[east] - v[west] - u[north] + u[south]) * per_difference
    divergence_rms = _root_mean_square(divergence)
    vorticity_rms = _root_mean_square(vorticity)
    return divergence_rms, vorticity_rms


def _scale_of(size: Size, frequency: int) -> float:
    """Return s0 (F0 / F)^k [length/s]; no power: its bits differ between machines."""
    scale = float(size.value("velocity_scale"))
    least_frequency = size.value("frequency_min")
    for _ in range(size.value("scale_falloff")):
        scale = scale * least_frequency / frequency
    return scale


def _frequency(size: Size, scenario: int) -> int:
    """Return the lattice frequency of a scenario."""
    number = shift_number(size, scenario)
    if number is None:
        frequency_count = int(size.value("frequency_count"))
        least_frequency = int(size.value("frequency_min"))
        return least_frequency + scenario % frequency_count
    if number % 2 == 0:
        return int(size.value("frequency_shift_low"))
    return int(size.value("frequency_shift_high"))


def _viscosity(size: Size) -> float:
    """Return nu [length^2/s]; 0 where the size states none."""
    if "viscosity" not in size.parameters:
        return 0.0
    return float(size.value("viscosity"))


def initial_state(size: Size, scenario: int, rng: RandomSource) -> InitialState:
    """Draw a jittered grid of particles and a random stream function that moves them.

    The stream function is Perlin noise times ``scale``, between the walls.
    """
    low, high = size.bounds[0]
    columns = size.value("lattice_x")
    rows = size.value("lattice_y")
    place_count = columns * rows
    if place_count != size.particles:
        raise UsageError(
            f"the lattice does not hold the particles: got {columns} * {rows} = "
            f"{place_count}, expected lattice_x * lattice_y = particles = "
            f"{size.particles}; correct the number of particles in the file of the "
            "split",
            where=f"datasets.yaml, {size.split} {size.name}",
        )
    position = fill_grid(
        rng,
        columns,
        rows,
        low=low,
        high=high,
        jitter=size.value("jitter"),
        subdivision=size.subdivision,
    )
    frequency = _frequency(size, scenario)
    lattice = gradients(rng, frequency)
    scale = _scale_of(size, frequency)

    psi = stream_function(position, lattice, low=low, high=high, scale=scale)
    velocity, affine = flow(psi)
    divergence, vorticity = _grid_rates(lattice, size, scale)
    square_sum = _sum_of_squares(velocity)
    energy = 0.5 * square_sum / size.particles
    width = high - low
    return InitialState(
        position=position,
        velocity=velocity,
        affine=affine,
        material=liquid(size.particles),
        area=width * width,
        viscosity=_viscosity(size),
        parameters={
            "frequency": frequency,
            "scale": scale,
            "initial_kinetic_energy": energy,
            "initial_divergence_rms": divergence,
            "initial_vorticity_rms": vorticity,
        },
    )
