"""A column of liquid that collapses: a split of one's own."""

from pathlib import Path

import numpy as np

from lagbench.data.registry import Size
from lagbench.generators.constants import constants, free_surface_walls
from lagbench.generators.draws import RandomSource, uniform
from lagbench.generators.shapes import Rectangle, body_at, sample_points
from lagbench.generators.split import FreeSurfaceParameters, InitialState

REGISTRY = Path(__file__).with_name("dam_break.yaml")


def solver_parameters(size: Size) -> FreeSurfaceParameters:
    """Return the constants that the registry names."""
    return constants(FreeSurfaceParameters, size)


def initial_state(size: Size, scenario: int, rng: RandomSource) -> InitialState:
    """Draw the column's width and height; only ``rng.random`` may be used."""
    low, _ = free_surface_walls(size)
    width = uniform(rng, 0.2, 0.4)
    height = uniform(rng, 0.4, 0.7)
    column = body_at(
        Rectangle(width, height), low + 0.01 + width / 2, low + 0.01 + height / 2
    )
    return InitialState(
        position=sample_points(rng, column, size.particles),
        velocity=np.zeros((size.particles, 2)),
        affine=np.zeros((size.particles, 2, 2)),
        material=np.zeros(size.particles, np.int8),
        area=width * height,
        parameters={"width": width, "height": height},
    )
