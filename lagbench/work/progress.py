"""How far a piece of work is: counted by a meter, told to whoever asked."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field


def watched() -> bool:
    """Tell whether a person can watch stderr; where it is closed, Python has none."""
    return sys.stderr is not None and sys.stderr.isatty()


@dataclass(frozen=True, kw_only=True)
class Progress:
    """How far a generation or verification is."""

    stage: str  # what happens now, in a word or two
    done: int  # units of work done: substeps, summed over scenarios, or files
    total: int  # units to do; 0 where nobody knows
    scenarios_done: int  # scenarios that are finished
    scenarios: int  # scenarios to finish; 0 where nobody knows
    seconds: float  # time since the start [s]
    before: int = 0  # scenarios that an earlier run had finished; they took none of that time

    @property
    def rate(self) -> float:
        """Scenarios finished per second since the start [1/s]."""
        return (self.scenarios_done - self.before) / self.seconds if self.seconds > 0.0 else 0.0


@dataclass
class Meter:
    """Counts work and tells a listener at every count."""

    # called with the state after every count; nobody when None
    listener: Callable[[Progress], None] | None = None
    stage: str = ""  # what happens now
    total: int = 0  # units to do
    scenarios: int = 0  # scenarios to finish
    done: int = 0  # units done
    finished: int = 0  # scenarios finished
    _before: int = field(default=0, init=False)
    _started: float = field(default_factory=time.monotonic, init=False)

    def begin(self, stage: str, *, total: int, scenarios: int, done: int = 0) -> None:
        """Start a stage with counts at zero, or at what an earlier run had done."""
        self.stage, self.total, self.scenarios = stage, total, scenarios
        self.done = self.finished = self._before = done
        self._started = time.monotonic()
        self.count()

    def count(self, units: int = 0, *, scenarios: int = 0) -> None:
        """Add units of work (negative where work was lost) and finished scenarios."""
        self.done += units
        self.finished += scenarios
        if self.listener is not None:
            self.listener(
                Progress(
                    stage=self.stage,
                    done=self.done,
                    total=self.total,
                    scenarios_done=self.finished,
                    scenarios=self.scenarios,
                    seconds=time.monotonic() - self._started,
                    before=self._before,
                )
            )
