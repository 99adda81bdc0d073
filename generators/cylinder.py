"""Flow past a cylinder: a channel with a fixed disc, which sheds vortices.

The channel is periodic along x and has walls along y, along which the fluid slides. In
its last part along x, the fringe, the velocity is drawn to the stream (U, 0): there the
wake dies, the stream that comes round to the disc is even, and its speed stays U. The
disc of diameter D stands off the middle of the channel by a drawn number of particle
spacings. At the start the fluid flows past it without friction, and an eddy behind the
disc disturbs it:

    v = 3.5 U' s (1 - s^2)^2 along circles, s = r / R < 1,

with drawn centre, radius R, speed U' and sense; it has no divergence. The Reynolds
number U D / nu is drawn between 80 and 200, where the flow is two-dimensional and
periodic (Williamson, Annu. Rev. Fluid Mech. 28 (1996) 477).

Expected behaviour: from about the time 25 D/U vortices of either sign are shed in turn
from both sides, with the frequency St U / D. The Strouhal number St is
about 0.16 at Re 100 and 0.2 at Re 200 in an unbounded stream (Williamson, J. Fluid
Mech. 206 (1989) 579), and larger in a channel.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lagbench.errors import UsageError

from .constants import constants, interval, start_frame
from .draws import RandomSource, choice, log_uniform, quantise, uniform
from .full_box_parameters import FullBoxParameters
from .obstacle import Obstacle, is_inside
from .periodic_noise import fill_box
from .split import InitialState, liquid

if TYPE_CHECKING:
    from lagbench.data.registry import Size

__all__ = ["initial_state", "solver_parameters", "start_frame"]

Array = NDArray[np.float64]


def solver_parameters(size: Size) -> FullBoxParameters:
    """Return the solver's constants at this size; walls let the fluid slide."""
    is_solid = is_inside(lattice_places(size), middle_of_disc(size, 0), _radius(size))
    solid_count = int(is_solid.sum())
    return constants(
        FullBoxParameters,
        size,
        box=size.box,
        no_slip=False,
        particles=is_solid.size - solid_count,
        obstacle_particles=solid_count,
    )


def lattice_counts(size: Size) -> tuple[int, int]:
    """Return the particles along each axis of the lattice that fills the channel."""
    per_length = int(size.value("lattice"))
    columns, rows = (round(per_length * side) for side in size.box.lengths.tolist())
    return columns, rows


def lattice_places(size: Size) -> Array:
    """Return the places of the lattice [length], shape [place, 2]."""
    cell = np.indices(lattice_counts(size)).reshape(2, -1).T
    return quantise(np.array(size.box.low) + (cell + 0.5) / size.value("lattice"))


def _radius(size: Size) -> float:
    """Return the radius of the disc [length]."""
    return 0.5 * float(size.value("obstacle_diameter"))


def middle_of_disc(size: Size, steps: int) -> tuple[float, float]:
    """Return the centre of a disc that is some steps off the middle [length].

    A step is a spacing of the lattice at refinement 1, so that every disc covers as
    many places of the lattice.
    """
    offset = steps * size.subdivision / size.value("lattice")
    return float(size.value("obstacle_x")), size.box.centre.tolist()[1] + offset


def _square(vectors: Array) -> Array:
    """Return the squared length of vectors in the plane, shape [vector]."""
    x, y = vectors.T
    return np.asarray(x * x + y * y)


def _pairs(x: Array, y: Array) -> Array:
    """Return vectors, or rows of matrices, from their components: axis 1."""
    return np.stack([x, y], axis=1)


def moved_out(position: Array, centre: Array, radius: float) -> Array:
    """Return positions of which those inside a disc are put on its rim [length]."""
    way = position - centre
    distance = np.sqrt(_square(way))
    stretch = np.where(distance < radius, radius / distance, 1.0)
    return quantise(centre + stretch[:, None] * way)


def potential_flow(
    position: Array,
    centre: Array,
    *,
    radius: float,
    speed: float,
) -> tuple[Array, Array]:
    """Return velocity [length/s] and gradient [1/s] of potential flow past a disc.

        u = U (1 - R^2 (x^2 - y^2) / r^4),    v = -2 U R^2 x y / r^4,

    with x, y from the centre. No fluid goes through the disc: a stream that met it at
    once would be compressed by a sound wave.

    Args:
        position: points outside the disc [length], shape [point, 2].
        centre: of the disc [length].
        radius: R of the disc [length].
        speed: U of the stream along x [length/s].
    """
    way = position - centre
    x, y = way.T
    square = _square(way)
    dipole = speed * radius * radius / (square * square)
    u = speed - dipole * (x * x - y * y)
    v = -2.0 * dipole * x * y

    # The flow is harmonic: two numbers make the gradient. They hold the real part of
    # (x + iy)^3 over x, and the imaginary part over y.
    stretch = 2.0 * dipole * x * (x * x - 3.0 * y * y) / square
    shear = 2.0 * dipole * y * (3.0 * x * x - y * y) / square
    return _pairs(u, v), _pairs(_pairs(stretch, shear), _pairs(shear, -stretch))


def eddy(
    position: Array,
    centre: Array,
    *,
    radius: float,
    speed: float,
) -> tuple[Array, Array]:
    """Return velocity [length/s] and gradient [1/s] of an eddy of finite size.

    With s = r / R the speed is 3.5 U' s (1 - s^2)^2 along circles; its largest value
    is U', nearly, at s = 1 / sqrt(5).

    Args:
        position: points [length], shape [point, 2].
        centre: of the eddy [length].
        radius: R [length].
        speed: U', positive for a turn against the clock [length/s].
    """
    way = (position - centre) / radius
    square = _square(way)
    rest = np.where(square < 1.0, 1.0 - square, 0.0)
    rate = 3.5 * speed * rest * rest
    x, y = way.T

    # derivative of the rate with respect to the square, times 2
    slope = -14.0 * speed * rest
    gradient = _pairs(
        _pairs(-slope * x * y, -slope * y * y - rate),
        _pairs(slope * x * x + rate, slope * x * y),
    )
    return _pairs(-rate * y, rate * x), gradient / radius


def initial_state(size: Size, scenario: int, rng: RandomSource) -> InitialState:
    """Draw the place of the disc, the Reynolds number, and an eddy behind the disc."""
    start = start_frame(size, scenario, rng)
    box = size.box
    diameter = float(size.value("obstacle_diameter"))
    radius = _radius(size)
    # only the y of the disc differs by scenario
    most_steps = int(size.value("offset_max"))
    x, y = middle_of_disc(size, choice(rng, 2 * most_steps + 1) - most_steps)
    centre = np.array([x, y])
    position = fill_box(
        rng,
        lattice_counts(size),
        low=box.low,
        high=box.high,
        jitter=size.value("jitter"),
        subdivision=size.subdivision,
    )
    places = lattice_places(size)
    is_solid = is_inside(places, (x, y), radius)
    _check_counts(size, int(is_solid.sum()), len(places))
    obstacle = Obstacle(centre=(x, y), radius=radius, position=places[is_solid])

    speed = float(size.value("speed"))
    # The eddy ends before the disc and the walls: they would stop it at once, and that
    # compresses the fluid.
    diameters_behind = uniform(rng, 2.0, 2.5)
    diameters_above = uniform(rng, -0.5, 0.5)
    eddy_centre = centre + diameter * np.array([diameters_behind, diameters_above])
    eddy_radius = uniform(rng, 0.75, 1.0) * diameter
    eddy_speed = uniform(rng, 0.5, 1.0) * speed
    if choice(rng, 2):
        eddy_speed = -eddy_speed

    fluid = moved_out(position[~is_solid], centre, radius)
    velocity, affine = eddy(fluid, eddy_centre, radius=eddy_radius, speed=eddy_speed)
    past, past_affine = potential_flow(fluid, centre, radius=radius, speed=speed)
    velocity += past
    affine += past_affine

    reynolds = log_uniform(rng, *interval(size, "reynolds"))
    viscosity = speed * diameter / reynolds
    return InitialState(
        position=fluid,
        velocity=quantise(velocity),
        affine=quantise(affine),
        material=liquid(len(fluid)),
        area=box.volume * len(fluid) / len(places),
        viscosity=viscosity,
        obstacle=obstacle,
        stream=np.array([speed, 0.0]),
        start_frame=start,
        parameters={
            "obstacle_y": y,
            "reynolds": reynolds,
            "viscosity": viscosity,
        },
    )


def _check_counts(size: Size, solid_count: int, lattice_count: int) -> None:
    """Refuse counts that do not follow from the lattice and the disc.

    Those of a finer lattice are nowhere stated.

    Raises:
        UsageError: datasets.yaml states other numbers of particles.
    """
    if size.subdivision > 1:
        return
    fluid_count = lattice_count - solid_count
    stated_solid_count = int(size.value("obstacle_particles"))
    expected = (fluid_count, solid_count)
    stated = (size.particles, stated_solid_count)
    if stated != expected:
        raise UsageError(
            f"the lattice does not hold the particles: got {stated}, expected "
            f"particles, obstacle_particles = {expected}; correct the number of "
            "particles in the file of the split",
            where=f"datasets.yaml, {size.split} {size.name}",
        )
