"""Submissions: predictions.nc, its writer, its reader, and the checks that it must
pass.

>>> from lagbench import submission
>>> submission.DIMS
('scenario', 'frame', 'particle', 'space')

``write`` makes a file from arrays, ``template`` one to fill, ``validate`` says what is
wrong with one, ``open_predictions`` reads one in bounded memory. docs/predictions.md
has the format.
"""

from __future__ import annotations

from .findings import CHECKS, Finding, Severity, ValidationResult
from .format import DIMS, FORMAT, Header
from .predictions import Predictions, open_predictions
from .validation import validate
from .writer import PredictionsWriter, TemplateResult, template, write

__all__ = [
    "CHECKS",
    "DIMS",
    "FORMAT",
    "Finding",
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
