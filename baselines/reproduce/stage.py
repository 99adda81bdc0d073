"""Truth and predictions of one test scenario, frame by frame, for pictures and tables at a frame."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager

import numpy as np
from numpy.typing import NDArray

from lagbench.data.scenario import ScenarioFile
from lagbench.draw.recording import Recording, Scene, open_recording
from lagbench.metrics import FramePair, Scenario, Snapshot
from lagbench.submission import Predictions, open_predictions

from .plan import Plan

__all__ = ["Stage", "staged"]

Floats = NDArray[np.float64]


class Stage:
    """One test scenario."""

    def __init__(
        self,
        scenario: Scenario,
        file: ScenarioFile,
        recording: Recording,
        predictions: Mapping[str, Predictions],
    ) -> None:
        self.id = recording.scenario  # its number
        self.scenario = scenario  # what holds in all its frames, as metrics see it
        self.recording = recording  # the same as pictures see it
        # models whose predictions are here, in the order in which they were asked for
        self.names = tuple(predictions)
        self._file = file
        self._predictions = predictions
        self._truth: dict[int, Snapshot] = {}

    @property
    def frames(self) -> range:
        """Absolute numbers of the predicted frames."""
        return self.scenario.setting.predicted_frames

    def position(self, name: str | None, frame: int) -> Floats:
        """Return positions of the truth (None) or of a prediction [length], shape [particle, 2].

        Given frames are the truth's.
        """
        if name is None or frame < self.frames[0]:
            return np.asarray(self._file.read("position", frame), np.float64)
        return np.asarray(self._predictions[name].frames(self.id, frame, 1)[0], np.float64)

    def snapshot(self, name: str | None, frame: int) -> Snapshot:
        """Return a frame as metrics see it."""
        if name is not None:
            return self.scenario.snapshot(self.position(name, frame), self.position(name, frame - 1))
        if frame not in self._truth:
            found = self.scenario.snapshot(self.position(None, frame), self.position(None, frame - 1))
            self._truth[frame] = found
        return self._truth[frame]

    def pair(self, name: str, frame: int) -> FramePair:
        """Return truth and prediction of a frame."""
        return FramePair(self.scenario, frame, self.snapshot(None, frame), self.snapshot(name, frame))

    def scene(self, name: str | None, frame: int) -> Scene:
        """Return a frame as pictures see it; velocities are differences of positions."""
        position = self.position(name, frame)
        displacement = position - self.position(name, frame - 1)
        return Scene(
            recording=self.recording,
            frame=frame,
            position=position,
            velocity=displacement / self.recording.size.frame_interval,
            displacement=displacement,
        )


@contextmanager
def staged(plan: Plan, split: str, scenario: int, names: Iterable[str]) -> Iterator[Stage]:
    """Open a test scenario with the predictions of models; those without a run are left out."""
    paths = {name: plan.predictions(split, name) for name in names}
    with ExitStack() as stack:
        opened = stack.enter_context(plan.exam(split).opened(scenario))
        recording = stack.enter_context(open_recording(opened.file.path, registry=plan.described))
        predictions = {
            name: stack.enter_context(open_predictions(path)) for name, path in paths.items() if path
        }
        yield Stage(opened.scenario, opened.file, recording, predictions)
