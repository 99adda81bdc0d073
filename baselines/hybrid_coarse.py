"""Hybrid: the solver on a coarser grid, with constants that are learned.

On a grid with fewer cells the material-point solver damps the flow more: each
transfer between particles and nodes averages over a larger cell. Softer matter carries
sound more slowly. It allows longer time steps, so there are fewer transfers, and each
frame loses less. The hybrid changes the constants of the solver accordingly:

    viscosity     max(0, 1 + a) nu          (liquid; elastic damping of solids likewise)
    modulus       exp(b) K                  (liquid)
    relaxation    min(1, exp(c) kappa)      (share of the grid's J in a time step)
    coupling      min(1, exp(d) theta)      (pull of J towards the density of the grid)
    moduli        exp(e) E                  (all solids)

The time steps of a frame follow from the fastest sound. With all five 0 the model is
the coarse solver (:mod:`lagbench.references.coarse_solver`) to the bit.
"""

from __future__ import annotations

import math
from fractions import Fraction
from pathlib import Path

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from lagbench.data.registry import Size
from lagbench.data.registry import load as load_registry
from lagbench.errors import DataError, UsageError, WorkFailedError
from lagbench.references import calibrated
from lagbench.references.coarse_solver import CoarseRollout, coarser
from lagbench.references.predictor import Given

from .baseline import Batch, DatasetInfo
from .hybrid import Hybrid, HybridOptions

COEFFICIENTS = ("viscosity", "modulus", "relaxation", "coupling", "moduli")
"""Names of the coefficients a to e, in their order."""


class HybridCoarseOptions(HybridOptions):
    """Options of the hybrid."""

    of_weights = frozenset({"times"})

    # cells of the data's grid over its own, along each axis; 1.5 keeps two of three
    times: int | float = Field(default=2, ge=1.5, le=4, allow_inf_nan=False)


class HybridCoarse(Hybrid):
    """The coarse solver with learned constants."""

    method = "hybrid coarse solver"
    largest = 3.0  # a modulus changes by a factor of 20 at most

    Options = HybridCoarseOptions
    options: HybridCoarseOptions

    def __init__(self, options: HybridCoarseOptions, info: DatasetInfo) -> None:
        super().__init__(options, info)
        self.size = load_registry().size(info.split, info.size)
        coarse = coarser(self.size, Fraction(options.times))
        if coarse is None:
            raise UsageError(
                f"{self.method} has no such grid for {info.split} {info.size}",
                where="model.times",
            )
        self.coarse = coarse
        self.register_buffer("coefficients", torch.zeros(len(COEFFICIENTS)))

    def start(self, given: Batch) -> list[CoarseRollout]:
        """Return the rollouts from the last two given frames.

        Raises:
            DataError: the mass is not known, or a coefficient is out of range.
        """
        coefficients = self.checked_coefficients().tolist()
        changed = change_constants(
            self.coarse, dict(zip(COEFFICIENTS, coefficients, strict=True))
        )
        if given.particle_mass is None:
            raise DataError(
                "the mass of the particles is not known: the files state none",
                where=f"{self.info.split} {self.info.size}",
            )
        rollouts = []
        for window in range(given.windows):
            is_inside = given.sample == window
            frames = given.position[is_inside].double().numpy()
            particle_count, _, dimension = frames.shape
            mass = float(given.particle_mass[window]) * particle_count
            parameters: dict[str, object] = {}
            if given.friction is not None:
                parameters["friction"] = float(given.friction[window])
            scenario = Given(
                size=self.size,
                root=Path(),
                position=frames.swapaxes(0, 1),
                material=given.material[is_inside].numpy().astype(np.int8),
                walls=np.zeros((given.frames + 1, 2 * dimension, dimension)),
                area=mass / float(self.size.value("density")),
                parameters=parameters,
            )
            rollouts.append(CoarseRollout(scenario, changed))
        return rollouts

    def advance(self, state: list[CoarseRollout]) -> tuple[list[CoarseRollout], Tensor]:
        """Return the next state and positions [length], shape [particle, axis].

        The solver keeps its state itself, so a state can be advanced once only.
        """
        positions = []
        for rollout in state:
            try:
                positions.append(rollout.advance())
            except WorkFailedError:  # the solver breaks down
                positions.append(np.full_like(rollout.position, np.nan))
        return state, torch.from_numpy(np.concatenate(positions)).float()


def change_constants(coarse: Size, constants: calibrated.Constants) -> Size:
    """Return a size with the constants that the coefficients stand for.

    Args:
        coarse: the size of the classical coarse solver.
        constants: a to e, by the names in :data:`COEFFICIENTS`.
    """
    changed = calibrated.change_constants(coarse, constants)
    parameters = dict(changed.parameters)
    factors = {
        "jacobian_relaxation": math.exp(constants["relaxation"]),
        "density_coupling": math.exp(constants["coupling"]),
    }
    for name, factor in factors.items():
        value = min(1.0, float(coarse.value(name)) * factor)
        parameters[name] = parameters[name].model_copy(update={"value": value})
    return changed.model_copy(update={"parameters": parameters})
