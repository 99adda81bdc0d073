"""Run a trained model on scenarios, one after the other, on one thread.

Predictions that are made for a file go through :mod:`lagbench.baselines.predict`. Here
the positions stay in memory, so that a few scenarios can be predicted anew.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lagbench.data.registry import Registry

from .baseline import Baseline, DatasetInfo
from .checkpoint import check_data, load
from .machine import use_threads
from .predict import restore_for_size
from .rollout import Rollout, count_predicted, roll_out, scenario_batch


class WeightsRunner:
    """A model from its weights, on the data of one split and size.

    Args:
        path: weights of a training.
        size: name of the size to predict.
        root: folder of all data sets.
        registry: where splits are described.
        settings: changes of options that have no weights.
        threads: threads on the CPU.

    Raises:
        UnreadableFileError: the file is damaged or no weights.
        DataError: the data set is not the one of the training.
        UsageError: the model is not installed, or cannot be run at that size.
    """

    def __init__(
        self,
        path: Path,
        *,
        size: str,
        root: Path,
        registry: Registry,
        settings: Sequence[str] = (),
        threads: int = 1,
    ) -> None:
        trained = load(path)
        self._threads = threads
        self._info: DatasetInfo = check_data(
            trained, root=root, registry=registry, size=size, where=str(path)
        )
        # of scenarios whose files state none [length^2/s]
        self._viscosity = registry.size(self._info.split, self._info.size).viscosity()
        self._model: Baseline = restore_for_size(
            trained, self._info, settings, registry, root=root, where=str(path)
        )

    def predict(
        self, scenario_file: Path, frames: int | None = None
    ) -> NDArray[np.float32]:
        """Return positions of the frames after the given ones [length].

        A rollout that ceases to be finite is frozen, as in a file of predictions.

        Args:
            scenario_file: file of the scenario.
            frames: frames to predict; by default those of the task.

        Returns:
            Positions, shape [frame, particle, axis].
        """
        rollout = self._roll_out(scenario_file, frames or self._info.horizon)
        return rollout.position.numpy()

    def _roll_out(self, scenario_file: Path, frames: int) -> Rollout:
        """Return the rollout of a scenario."""
        given_frames = scenario_batch(
            scenario_file,
            slice(0, self._info.input_frames),
            viscosity=self._viscosity,
        )
        with use_threads(self._threads):
            return roll_out(self._model, given_frames, frames)[0]

    def time(self, scenario_file: Path, frames: int) -> float:
        """Return the processor time of a frame, mean over the first ones [s].

        One step before the clock starts warms up. The time to read the given frames
        counts; frozen frames do not.
        """
        self._roll_out(scenario_file, 1)
        started = time.process_time()
        rollout = self._roll_out(scenario_file, frames)
        seconds = time.process_time() - started
        predicted = count_predicted(
            rollout, frames, input_frames=self._info.input_frames
        )
        return seconds / predicted

    def close(self) -> None:
        """Nothing is left open."""
