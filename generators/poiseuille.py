"""Reverse Poiseuille flow: a periodic square with halves that are driven apart.

The fluid below the middle, y < 1/2, is accelerated by f(t) along x, the fluid above it
by -f(t). A constant f would end in a parabola in each half, of height H = 1/2,

    u(y) = f y (H - y) / (2 nu),    0 <= y <= H,

with the speed f H^2 / (8 nu) in its middle (Backer et al., J. Chem. Phys. 122 (2005)
154503). Here f follows a smooth random program (:func:`.draw_program`), so that the
flow never settles. The eddies at the start are those of :mod:`.decaying_vortices`. The
force of all frames is given to predictors.

Expected behaviour: the parallel flow follows the force with a lag; viscosity smooths
its kinks at y = 0 and y = 1/2. It shears the eddies, and feeds them where its profile
has inflections. The force adds no momentum in all. The Reynolds number is U L / nu,
with U the drawn speed of the eddies and L = 1.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from . import decaying_vortices
from .constants import constants, interval, start_frame
from .draws import RandomSource, draw_program
from .full_box_parameters import FullBoxParameters
from .split import InitialState

if TYPE_CHECKING:
    from lagbench.data.registry import Size

__all__ = ["initial_state", "solver_parameters", "start_frame"]


def solver_parameters(size: Size) -> FullBoxParameters:
    """Return the solver's constants at this size: two layers of a body force."""
    return constants(
        FullBoxParameters, size, box=size.box, no_slip=False, force_layers=2
    )


def initial_state(size: Size, scenario: int, rng: RandomSource) -> InitialState:
    """Draw eddies, and the force that drives the halves through all frames."""
    start = start_frame(size, scenario, rng)
    frame_count = start + size.frame_count(scenario)
    program = draw_program(
        rng,
        frame_count,
        amplitude=size.value("force_max"),
        knot_gap=interval(size, "knot_gap"),
    )
    # acceleration of both layers towards each frame, shape [frame, layer, axis]
    shape = (len(program), 2, 2)
    body_force = np.zeros(shape)
    body_force[:, 0, 0] = program
    body_force[:, 1, 0] = -program

    eddies = decaying_vortices.initial_state(size, scenario, rng)
    return replace(eddies, body_force=body_force, start_frame=start)
