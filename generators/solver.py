"""What a solver offers, on which device it runs, and how to build one.

Importing this module does not import Taichi; :func:`build` does.
"""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, cast

import numpy as np
from numpy.typing import NDArray

from .full_box_parameters import FullBoxParameters
from .split import (
    Device,
    FreeSurfaceParameters,
    InitialState,
    SolverParameters,
)

Singles = NDArray[np.float32]


@dataclass(frozen=True, kw_only=True)
class Health:
    """What one scenario went through during the last advance.

    Before the first one these are the extremes of the loaded state.
    """

    finite: bool  # whether every position, velocity and J is a finite number
    # largest absolute velocity component of any particle or node at any substep
    # [length/s]
    max_speed: float
    jacobian_min: float  # smallest J of any particle at any substep [1]
    jacobian_max: float  # largest J of any particle at any substep [1]


class Solver(Protocol):
    """Advances a batch of scenarios that share their parameters."""

    @property
    def parameters(self) -> SolverParameters:
        """Constants that the scenarios share."""

    names: Sequence[str]  # of each scenario, for messages

    def load(self, states: Sequence[InitialState]) -> None:
        """Start one scenario per state; as many states as the solver has scenarios."""

    def advance(self, substeps: int) -> None:
        """Advance every scenario.

        One that leaves the bounds within which the solver is valid is a
        WorkFailedError, which names its index, the range of substeps (for a single one
        its number, from 1), the broken bounds and the values.
        """

    def position(self) -> Singles:
        """Particle positions [length], shape [scenario, particle, axis]."""

    def velocity(self) -> Singles:
        """Particle velocities v_p [length/s], shape [scenario, particle, axis]."""

    def displace(self, offset: Singles) -> None:
        """Add an offset to the positions [length], shape [scenario, particle, axis];
        kept in the box.
        """

    def health(self) -> list[Health]:
        """Return what each scenario went through during the last advance.

        Before the first one these are the extremes of the loaded state.
        """


IMPLEMENTATIONS: dict[type, tuple[str, str]] = {
    FreeSurfaceParameters: (".free_surface", "FreeSurface"),
    FullBoxParameters: (".full_box", "FullBox"),
}
"""Module and class of the solver of each type of constants."""


def build(
    parameters: SolverParameters,
    *,
    device: Device = Device.CPU,
    scenarios: int = 1,
    threads: int | None = None,
) -> Solver:
    """Compile the solver that belongs to the parameters.

    Args:
        parameters: constants; their type chooses the formulation.
        device: where the substeps run.
        scenarios: how many advance together; one on ``Device.CPU``.
        threads: those of ``Device.PARALLEL``; all that the process may use when None.

    Raises:
        UsageError: a device or count that cannot be.
    """
    module_name, class_name = IMPLEMENTATIONS[type(parameters)]
    package = __name__.rpartition(".")[0]
    module = importlib.import_module(module_name, package)
    solver_class = getattr(module, class_name)
    solver = solver_class(
        parameters, device=device, scenarios=scenarios, threads=threads
    )
    return cast("Solver", solver)
