"""The table of reference predictors: every list, row and name comes from it."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from lagbench.data.registry import Size

from . import (
    analog,
    analog_barycentre,
    ballistic_analog,
    calibrated,
    climatology,
    extrapolation,
    frozen_field,
    projection,
    restarted,
)
from .predictor import Kind, ReferencePredictor

_PREDICTORS = (
    extrapolation.PERSISTENCE,
    extrapolation.CONSTANT_VELOCITY,
    frozen_field.PREDICTOR,
    extrapolation.BALLISTIC,
    climatology.PREDICTOR,
    analog.PREDICTOR,
    ballistic_analog.PREDICTOR,
    *projection.PREDICTORS,
    *restarted.PREDICTORS,
    *calibrated.PREDICTORS,
    analog_barycentre.PREDICTOR,
)

REFERENCES: Mapping[str, ReferencePredictor] = MappingProxyType(
    {predictor.name: predictor for predictor in _PREDICTORS}
)
"""All reference predictors by name, in the order in which they are shown."""

NAIVE = frozenset(
    name for name, predictor in REFERENCES.items() if predictor.kind is Kind.NAIVE
)
"""Names of the naive predictors: skill is measured against the best of them."""

CLASSICAL = frozenset(REFERENCES) - NAIVE
"""Names of the classical and calibrated solvers, against which models are measured."""


def references_of(size: Size) -> tuple[ReferencePredictor, ...]:
    """Return the reference predictors of a split and size.

    A split of the user's own has those of its kind of box.
    """
    predictors = []
    for predictor in REFERENCES.values():
        if predictor.applies(size):
            predictors.append(predictor)
    return tuple(predictors)
