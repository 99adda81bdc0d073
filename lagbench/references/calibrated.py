"""Calibrated rows: classical solvers with a few constants that are fitted on train.

In full boxes the projection solver with upwind advection: how much of the upwind part
it takes, and a factor on the viscosity that it is told; in a channel also a factor on
the radius within which the body stops the fluid. On free surfaces the restarted
simulator at half the resolution. Each transfer between its particles and nodes averages
over a larger cell, which damps the flow; softer matter allows longer time steps, so
there are fewer transfers. Its constants change by

    viscosity     max(0, 1 + a) nu          (liquid; elastic damping of solids likewise)
    modulus       exp(b) K                  (liquid)
    moduli        exp(c) E                  (all solids)

and the time steps of a frame follow from the fastest sound.

The fits stand in ``calibrated.json``; ``python -m lagbench.scoring.calibrate`` makes
them. A data set without a fit has no calibrated rows.
"""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from lagbench.data.registry import Size

from .predictor import Given, Kind, Prediction, ReferencePredictor
from .projection import Scheme
from .projection import predict as predict_projection
from .restarted import follow, resolve, runs_at, start

CALIBRATED_PATH = Path(__file__).parent / "calibrated.json"

Constants = Mapping[str, float]

SOLIDS = ("jelly", "snow", "rope")
"""Materials with a modulus of their own."""

MOST_SUBSTEPS = 2000
"""Time steps of a frame, at most."""


@dataclass(frozen=True, kw_only=True)
class CalibratedRow:
    """A solver with constants to fit."""

    name: str
    title: str
    fits: Callable[[Size], bool]  # whether the solver knows a split and size
    # ends of each constant in a fit, by name
    ranges: Callable[[Size], Mapping[str, tuple[float, float]]]
    predict: Callable[[Given, Constants], Prediction]
    # whether its error has no jumps, so that a second fit around the first is worth it
    is_smooth: bool


def _upwind_ranges(size: Size) -> Mapping[str, tuple[float, float]]:
    ranges = {"upwinding": (0.0, 2.0), "viscosity_factor": (0.6, 1.4)}
    if size.has_fringe:
        ranges["radius_factor"] = (0.85, 1.15)
    return ranges


def _upwind(name: str, resolution: float) -> CalibratedRow:
    def predict(given: Given, constants: Constants) -> Prediction:
        return predict_projection(given, Scheme(resolution=resolution, **constants))

    return CalibratedRow(
        name=name,
        title=f"Projection solver, calibrated, {resolution:g} x the score grid",
        fits=lambda size: size.is_full_box,
        ranges=_upwind_ranges,
        predict=predict,
        is_smooth=True,
    )


def _softer_ranges(size: Size) -> Mapping[str, tuple[float, float]]:
    ranges = {
        "viscosity": (-1.0, 0.0),
        "modulus": (-1.6, 0.2),
    }
    if any(f"{solid}_modulus" in size.parameters for solid in SOLIDS):
        ranges["moduli"] = (-1.2, 0.2)
    return ranges


def _predict_softer(given: Given, constants: Constants) -> Prediction:
    resolution = resolve(change_constants(given.size, constants), 0.5)
    return follow(start(given, resolution))


ROWS = (
    _upwind("upwind-calibrated", 1),
    _upwind("upwind-2x-calibrated", 2),
    CalibratedRow(
        name="restarted-half-calibrated",
        title="Restarted simulator, calibrated, half of the recorded resolution",
        fits=lambda size: not size.is_full_box and runs_at(size, 0.5),
        ranges=_softer_ranges,
        predict=_predict_softer,
        is_smooth=False,
    ),
)
"""All calibrated rows, the cheapest of a kind first."""


def change_constants(size: Size, constants: Constants) -> Size:
    """Return a free surface with the changed constants of its solver.

    Args:
        size: the split and size.
        constants: a to c, by the names that the module states; 0 where one is missing.
    """
    damping = max(0.0, 1.0 + constants.get("viscosity", 0.0))
    factors = {
        "liquid_viscosity": damping,
        "elastic_damping": damping,
        "liquid_modulus": math.exp(constants.get("modulus", 0.0)),
    }
    for solid in SOLIDS:
        factors[f"{solid}_modulus"] = math.exp(constants.get("moduli", 0.0))

    parameters = dict(size.parameters)
    for name, factor in factors.items():
        if name not in parameters:
            continue
        value = float(size.value(name)) * factor
        parameters[name] = parameters[name].model_copy(update={"value": value})
    changed = size.model_copy(update={"parameters": parameters})

    speed_ratio = fastest_sound(changed) / fastest_sound(size)
    substeps = math.ceil(size.substeps_per_frame * speed_ratio)
    substeps = min(max(substeps, 1), MOST_SUBSTEPS)
    parameters["substeps_per_frame"] = parameters["substeps_per_frame"].model_copy(
        update={"value": substeps}
    )
    return size.model_copy(update={"parameters": parameters})


def fastest_sound(size: Size) -> float:
    """Return the largest speed of sound over all materials [length/s].

    Its square is K / rho in liquid. In solids it is (1 - p) / ((1 + p)(1 - 2 p)) E /
    rho with Poisson's ratio p; in snow times its greatest hardening.
    """
    density = float(size.value("density"))
    squares = [float(size.value("liquid_modulus")) / density]
    for solid in SOLIDS:
        if f"{solid}_modulus" not in size.parameters:
            continue
        modulus = float(size.value(f"{solid}_modulus"))
        poisson = float(size.value(f"{solid}_poisson"))
        factor = (1.0 - poisson) / ((1.0 + poisson) * (1.0 - 2.0 * poisson))
        square = modulus * factor / density
        if solid == "snow":
            square *= float(size.value("snow_hardening_max"))
        squares.append(square)
    return math.sqrt(max(squares))


@functools.cache
def _read_fits(path: Path) -> Mapping[str, Mapping[str, Constants]]:
    fits: Mapping[str, Mapping[str, Constants]] = json.loads(path.read_text("utf-8"))
    return fits


def fit_key(size: Size) -> str:
    """Return the key of a data set in the file of fits."""
    return f"{size.split}-{size.name}-v{size.major}"


def fitted_constants(size: Size, name: str) -> Constants | None:
    """Return the fitted constants of a row; None where it was not fitted."""
    fits = _read_fits(CALIBRATED_PATH).get(fit_key(size), {})
    return fits.get(name)


def _describe(row: CalibratedRow) -> ReferencePredictor:
    def predict(given: Given) -> Prediction:
        constants = fitted_constants(given.size, row.name)
        if constants is None:
            raise ValueError(f"{row.name} was not fitted on {fit_key(given.size)}")
        return row.predict(given, constants)

    return ReferencePredictor(
        name=row.name,
        title=row.title,
        kind=Kind.CALIBRATED,
        definition=f"{row.title}: a few constants of the solver are fitted on train.",
        applies=lambda size: fitted_constants(size, row.name) is not None,
        predict=predict,
    )


PREDICTORS = tuple(_describe(row) for row in ROWS)
