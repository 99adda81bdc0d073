"""Floors: predictions that cost no learning, and their scores on our data sets.

Rows of every table, report and board, none of which is ranked. :data:`FLOORS` names
them, :func:`floors_of` says which of them a split and size has, ``Floor.counts`` which
may be the best one, :func:`shipped` what they score there.
"""

from __future__ import annotations

from .floor import Floor, Given, given_in
from .shipped import FloorScores, shipped, solver_seconds
from .table import FLOORS, floors_of

__all__ = [
    "FLOORS",
    "Floor",
    "FloorScores",
    "Given",
    "floors_of",
    "given_in",
    "shipped",
    "solver_seconds",
]
