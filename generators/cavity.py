"""Lid-driven cavity: a full box, one wall or two opposite ones slide (thesis §5.8).

Expected behaviour: a vortex fills the box from the moving wall inwards; two opposite walls
make one vortex (directions opposed) or two (alike). Which walls move goes by id, so that every
subset of ``full`` holds all six choices; direction, speed, Reynolds number and start are drawn.
Recording starts anywhere between rest and the nearly steady flow. The Reynolds number is
U L / nu with the box's width L.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .constants import closed_box_walls, constants
from .draws import RandomSource, choice, log_uniform, quantise, uniform
from .lattice import fill
from .split import WALLS, ClosedBoxParameters, InitialState, Material

if TYPE_CHECKING:
    from lagbench.data.registry import Size

__all__ = ["DRIVEN", "initial_state", "solver_parameters"]

DRIVEN = (("top",), ("bottom",), ("left",), ("right",), ("left", "right"), ("bottom", "top"))
"""The sets of walls that move, by id % 6: six consecutive scenarios hold each once."""

_TANGENT = {"left": 1, "right": 1, "bottom": 0, "top": 0}
_DIRECTION = {(0, 1): "right", (0, -1): "left", (1, 1): "up", (1, -1): "down"}


def solver_parameters(size: Size) -> ClosedBoxParameters:
    """Return the constants of Table 5.2 and design 4.3 at this size; walls hold the fluid."""
    return constants(ClosedBoxParameters, size, no_slip=True)


def _wall_motion(
    rng: RandomSource, walls: tuple[str, ...], speed: float
) -> tuple[NDArray[np.float64], str, str]:
    """Draw which way the walls move."""
    signs = [2 * choice(rng, 2) - 1 for _ in walls]
    velocity = np.zeros((len(WALLS), 2))
    for wall, sign in zip(walls, signs, strict=True):
        velocity[WALLS.index(wall), _TANGENT[wall]] = sign * speed
    directions = [_DIRECTION[_TANGENT[w], s] for w, s in zip(walls, signs, strict=True)]
    return velocity, "+".join(walls), "+".join(directions)


def _start_substep(rng: RandomSource, size: Size) -> int:
    """Draw the substep at which recording starts, end points included."""
    last = round(float(size.value("start_time_max")) / size.dt)
    return choice(rng, last + 1)


def initial_state(size: Size, scenario: int, rng: RandomSource) -> InitialState:
    """Draw a fluid at rest and the wall motion that drives it through all frames."""
    low, high = closed_box_walls(size)
    factor = size.value("speed_factor")
    speed = float(quantise(uniform(rng, factor * size.value("speed_min"), factor * size.value("speed_max"))))
    reynolds = log_uniform(rng, size.value("reynolds_min"), size.value("reynolds_max"))
    wall_velocity, wall, direction = _wall_motion(rng, DRIVEN[scenario % len(DRIVEN)], speed)
    start = _start_substep(rng, size)
    viscosity = speed * (high - low) / reynolds
    return InitialState(
        position=fill(rng, size.particles, low=low, high=high, jitter=size.value("jitter")),
        velocity=np.zeros((size.particles, 2)),
        affine=np.zeros((size.particles, 2, 2)),
        material=np.full(size.particles, Material.LIQUID, dtype=np.int8),
        area=(high - low) * (high - low),
        viscosity=viscosity,
        wall_velocity=wall_velocity,
        start_substep=start,
        parameters={
            "wall": wall,
            "direction": direction,
            "speed": speed,
            "reynolds": reynolds,
            "viscosity": viscosity,
            "dynamic_viscosity": size.value("density") * viscosity,
            "start_substep": start,
        },
    )
