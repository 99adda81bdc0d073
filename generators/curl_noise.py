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
from .draws import RandomSource, quantise, square_sum
from .full_box_parameters import FullBoxParameters
from .noise import gradients, noise, ramp
from .periodic_noise import Smooth, coordinate, fill_box, rotated_gradient
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
) -> Smooth:
    """Return psi [length^2/s] and its derivatives at points between the walls.

    Args:
        position: points [length], shape [point, 2].
        lattice: Perlin gradients, shape [F + 1, F + 1, 2].
        low: coordinate of the left and bottom walls [length].
        high: coordinate of the right and top walls [length].
        scale: s [length/s].
    """
    width = high - low
    per_length = float(len(lattice) - 1) / width
    # distances from the walls, in cells of the lattice; measured from its own wall, the
    # ramp is exactly 0 there
    from_low = []
    from_high = []
    for axis in range(2):
        along = coordinate(position[:, axis], axis, 2)
        from_low.append(along.shift(-low).scale(per_length))
        from_high.append(along.scale(-1.0).shift(high).scale(per_length))

    x, y = from_low
    psi = noise(x, y, lattice)
    for distance in (*from_low, *from_high):
        psi = psi * ramp(distance.scale(2.0))
    return psi.scale(scale * width)


def _root_mean_square(values: Array) -> float:
    return math.sqrt(square_sum(values) / values.size)


def _grid_rates(lattice: Array, size: Size, scale: float) -> tuple[float, float]:
    """Return RMS divergence (Eq. 5.54) and vorticity [1/s] as the solver's grid sees
    them.

    Central differences between nodes inside the walls: what is not zero of the
    divergence is the grid's share, not the field's.
    """
    low, high = size.bounds[0]
    parameters = solver_parameters(size)
    node = (parameters.origin[0] + 1.0 + np.arange(parameters.cells[0])) / size.grid
    points = np.stack(np.meshgrid(node, node, indexing="ij"), axis=-1).reshape(-1, 2)
    psi = stream_function(points, lattice, low=low, high=high, scale=scale)
    u, v = rotated_gradient(psi).velocity.T.reshape(2, len(node), len(node))

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
    return _root_mean_square(divergence), _root_mean_square(vorticity)


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
    position = fill_box(
        rng,
        (columns, rows),
        low=(low, low),
        high=(high, high),
        jitter=size.value("jitter"),
        subdivision=size.subdivision,
    )
    frequency = _frequency(size, scenario)
    lattice = gradients(rng, frequency)
    scale = _scale_of(size, frequency)

    psi = stream_function(position, lattice, low=low, high=high, scale=scale)
    flow = rotated_gradient(psi)
    velocity = quantise(flow.velocity)
    divergence, vorticity = _grid_rates(lattice, size, scale)
    width = high - low
    viscosity = 0.0
    if "viscosity" in size.parameters:
        viscosity = float(size.value("viscosity"))
    return InitialState(
        position=position,
        velocity=velocity,
        affine=quantise(flow.affine),
        material=liquid(size.particles),
        area=width * width,
        viscosity=viscosity,
        parameters={
            "frequency": frequency,
            "scale": scale,
            "initial_kinetic_energy": 0.5 * square_sum(velocity) / size.particles,
            "initial_divergence_rms": divergence,
            "initial_vorticity_rms": vorticity,
        },
    )
