"""Reference predictors, which learn nothing, and their scores on our data sets.

Rows of every table, report and board, none of which is ranked. :data:`REFERENCES` names
them, :func:`references_of` says which of them a split and size has,
``ReferencePredictor.counts`` which may be the best one, :func:`shipped` what they score
there.
"""

from __future__ import annotations

from .predictor import Given, ReferencePredictor, given_in
from .shipped import ReferenceScores, shipped, solver_seconds
from .table import REFERENCES, references_of

__all__ = [
    "REFERENCES",
    "ReferencePredictor",
    "ReferenceScores",
    "Given",
    "references_of",
    "given_in",
    "shipped",
    "solver_seconds",
]
