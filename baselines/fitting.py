"""Models that are fitted in closed form, through the same door as those that are trained."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from .baseline import Baseline
from .checkpoint import load_weights, rounded_weights, save
from .job import Job
from .ledger import Ledger
from .validation import validate, validation_windows
from .windows import scenario_batch

__all__ = ["ClosedForm", "fit"]

STEPS = 1
"""A closed form counts as one step."""


class ClosedForm(Protocol):
    """What a baseline with ``closed_form = True`` has beside the contract."""

    def fit(self, scenarios: Iterator[NDArray[np.float32]]) -> Mapping[str, float]:
        """Set the coefficients from positions, shape [frame, particle, 2]; return figures to log."""
        ...


def fit(job: Job, model: Baseline) -> tuple[Ledger, int]:
    """Fit a model to every scenario, validate and store it; return the ledger and its one step."""
    ledger = job.ledger()
    if job.earlier is not None:
        load_weights(model, job.earlier.weights, where=str(job.folder.checkpoint))
        ledger.state = "finished"
        return ledger, STEPS
    figures = model.fit(_scenarios(job))  # type: ignore[operator]
    ledger.step, ledger.loss = STEPS, {name: float(value) for name, value in figures.items()}
    truth = validation_windows(job)
    if truth is not None:
        ledger.validated(validate(model, truth))
    ledger.state = "finished"
    ledger.read_clocks()
    state = {name: value.detach() for name, value in model.state_dict().items()}
    save(job.folder.weights, job.checkpoint(weights=rounded_weights(model), training=ledger.as_json()))
    save(job.folder.checkpoint, job.checkpoint(weights=state, training=ledger.as_json()))
    job.folder.write_record({**job.record(model, steps=STEPS), **ledger.as_json()})
    return ledger, STEPS


def _scenarios(job: Job) -> Iterator[NDArray[np.float32]]:
    """Yield the positions of every scenario to fit, shape [frame, particle, 2]."""
    paths = [path for subset in job.recipe.training.windows for path in job.files(subset).values()]
    job.meter.begin("fitting", total=len(paths) + 1, scenarios=len(paths))
    for path in paths:
        yield scenario_batch(path).position.transpose(0, 1).numpy()
        job.meter.count(1, scenarios=1)
