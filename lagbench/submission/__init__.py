"""Submissions: predictions.nc, its writer, its reader and its checks.

>>> from lagbench import submission
>>> submission.DIMS
('scenario', 'frame', 'particle', 'space')

``write`` makes a file from arrays; ``template`` makes one to fill. ``validate`` says
what is wrong with a file. ``open_predictions`` reads one in bounded memory.
docs/predictions.md has the format.
"""

from __future__ import annotations

from .format import DIMS, FORMAT, Header
from .issues import CHECKS, Severity, ValidationIssue, ValidationResult
from .predictions import Predictions, open_predictions
from .validation import validate
from .writer import PredictionsWriter, TemplateResult, template, write

__all__ = [
    "CHECKS",
    "DIMS",
    "FORMAT",
    "ValidationIssue",
    "Header",
    "Predictions",
    "PredictionsWriter",
    "Severity",
    "TemplateResult",
    "ValidationResult",
    "open_predictions",
    "template",
    "validate",
    "write",
]
