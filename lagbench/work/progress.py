"""Progress of a piece of work: a meter counts it and tells a listener."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace


def watched() -> bool:
    """Tell whether a person can watch stderr; where it is closed, Python has none."""
    return sys.stderr is not None and sys.stderr.isatty()


@dataclass(frozen=True, kw_only=True)
class Progress:
    """Progress of a piece of work; training counts its steps as scenarios."""

    stage: str  # the present stage, in a word or two
    done: int  # units of work done: substeps, summed over scenarios, or files
    total: int  # units to do; 0 where nobody knows
    scenarios_done: int  # scenarios that are finished
    scenarios: int  # scenarios to finish; 0 where nobody knows
    seconds: float  # time since the start [s]
    # scenarios that were finished when the stage began; they took none of that time
    before: int = 0
    # what is counted as scenarios, in the plural; empty for the command's own word
    unit: str = ""

    @property
    def rate(self) -> float:
        """Scenarios finished per second since the start [1/s]."""
        if self.seconds > 0.0:
            return (self.scenarios_done - self.before) / self.seconds
        return 0.0


class Meter:
    """Counts work and tells a listener, where there is one, at every count."""

    def __init__(self, listener: Callable[[Progress], None] | None = None) -> None:
        self._listener = listener
        self.stage = ""  # the present stage
        self._progress = Progress(
            stage="", done=0, total=0, scenarios_done=0, scenarios=0, seconds=0.0
        )
        self._started = time.monotonic()

    def begin(
        self, stage: str, *, total: int, scenarios: int, done: int = 0, unit: str = ""
    ) -> None:
        """Start a stage with counts at zero, or where an earlier run stopped.

        Args:
            stage: the stage, in a word or two.
            total: units of work to do.
            scenarios: scenarios to finish.
            done: units that are done, and scenarios likewise: it suits stages of one
                unit each.
            unit: what is counted as scenarios, in the plural.
        """
        self.stage = stage
        self._progress = Progress(
            stage=stage,
            done=done,
            total=total,
            scenarios_done=done,
            scenarios=scenarios,
            seconds=0.0,
            before=done,
            unit=unit,
        )
        self._started = time.monotonic()
        self.count()

    def count(self, units: int = 0, *, scenarios: int = 0) -> None:
        """Add units of work (negative where work was lost) and finished scenarios."""
        old = self._progress
        self._progress = replace(
            old,
            stage=self.stage,
            done=old.done + units,
            scenarios_done=old.scenarios_done + scenarios,
            seconds=time.monotonic() - self._started,
        )
        if self._listener is not None:
            self._listener(self._progress)
