"""Two predictions that cost nothing, which every submission stands beside.

With n given frames 0..n-1 and k = 1, 2, ... the number of the predicted frame::

    persistence         x(n-1+k) = x(n-1)
    constant velocity   x(n-1+k) = x(n-1) + k (x(n-1) - x(n-2))

Positions are rounded to float32 as those of a predictions.nc. Nothing keeps the second in
the box: particles that leave it carry no weight on the grid.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from lagbench.metrics import Scenario, Snapshot, snapshots

__all__ = [
    "CONSTANT_VELOCITY",
    "FLOORS",
    "PERSISTENCE",
    "constant_velocity",
    "persistence",
]


PERSISTENCE = "persistence"
CONSTANT_VELOCITY = "constant-velocity"


def persistence(scenario: Scenario) -> Iterator[Snapshot]:
    """Yield the last given state, at rest, for every predicted frame.

    It is one object throughout, so that its grid fields are formed once.
    """
    last = scenario.snapshot(scenario.given[-1], scenario.given[-1])
    return (last for _ in scenario.setting.predicted_frames)


def constant_velocity(scenario: Scenario) -> Iterator[Snapshot]:
    """Yield the snapshots of particles that keep their last given velocity."""
    return snapshots(scenario, _straight_on(scenario))


def _straight_on(scenario: Scenario) -> Iterator[NDArray[np.float32]]:
    last = np.asarray(scenario.given[-1], np.float64)
    step = last - scenario.given[-2]
    for number in range(1, scenario.setting.horizon + 1):
        yield (last + number * step).astype(np.float32)


FLOORS: Mapping[str, Callable[[Scenario], Iterator[Snapshot]]] = MappingProxyType(
    {PERSISTENCE: persistence, CONSTANT_VELOCITY: constant_velocity}
)
"""The floors by name, in the order in which they are shown."""
