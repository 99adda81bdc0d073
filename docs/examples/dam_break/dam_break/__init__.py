"""A column of liquid that collapses: an example of your own split."""

from pathlib import Path

import numpy as np

from lagbench.data.registry import Size
from lagbench.generators.constants import constants, free_surface_walls
from lagbench.generators.draws import RandomSource, uniform
from lagbench.generators.shapes import Rectangle, body_at, sample_points
from lagbench.generators.split import FreeSurfaceParameters, InitialState

REGISTRY = Path(__file__).with_name("dam_break.yaml")

GAP = 0.01
"""Distance of the column from the left wall and from the floor [length]."""


def solver_parameters(size: Size) -> FreeSurfaceParameters:
    """Return the solver's constants, as the registry states them."""
    return constants(FreeSurfaceParameters, size)


def initial_state(size: Size, scenario: int, rng: RandomSource) -> InitialState:
    """Draw the width and height of the column; use ``rng.random`` only."""
    width = uniform(rng, 0.2, 0.4)
    height = uniform(rng, 0.4, 0.7)

    wall, _ = free_surface_walls(size)
    centre_x = wall + GAP + width / 2
    centre_y = wall + GAP + height / 2
    column = body_at(Rectangle(width, height), centre_x, centre_y)

    return InitialState(
        position=sample_points(rng, column, size.particles),
        velocity=np.zeros((size.particles, 2)),
        affine=np.zeros((size.particles, 2, 2)),
        material=np.zeros(size.particles, np.int8),  # 0: liquid
        area=width * height,
        parameters={"width": width, "height": height},
    )
