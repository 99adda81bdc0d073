"""Two bodies of different materials collide and fall in a cube.

Pairs, the attractor and the shares of the particles are those of :mod:`.multimaterial`:
pairs by id % 6 are liquid-snow, rope-snow, rope-liquid, snow-snow, rope-jelly ball and
liquid-liquid. The bodies are solids: a rope is a round rod, jelly is a ball, anything
else is a block or a ball.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from .constants import draw_between
from .draws import RandomSource, draw_direction
from .multimaterial import BodyShapes, draw_bodies, solver_parameters
from .shapes import Ball, Block, Rod, Shape
from .split import (
    InitialState,
)

if TYPE_CHECKING:
    from lagbench.data.registry import Size

__all__ = ["initial_state", "solver_parameters"]


def _draw_rod(rng: RandomSource, size: Size, length: float) -> Shape:
    radius = size.value("rope_radius")
    axis = draw_direction(rng, 3)
    return Rod(length, radius, axis)


def _draw_block(rng: RandomSource, size: Size, volume: float) -> Shape:
    along_x = draw_between(rng, size, "aspect")
    along_z = draw_between(rng, size, "aspect")
    aspects = (along_x, along_z)
    return Block.of_volume(volume, aspects)


SOLIDS = BodyShapes(
    measure="volume", rope=_draw_rod, ball=Ball.of_volume, block=_draw_block
)
"""Shapes of the bodies in space."""


def initial_state(size: Size, scenario: int, rng: RandomSource) -> InitialState:
    """Draw the bodies, their places and their velocities."""
    return draw_bodies(size, scenario, rng, SOLIDS)
