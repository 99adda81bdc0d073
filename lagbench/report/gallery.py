"""The frames that pictures show, read from truth and predictions a few at a time."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from lagbench.exam import OpenScenario
from lagbench.metrics import FramePair, Scenario, Snapshot
from lagbench.submission import Predictions, open_predictions

from .subject import Subject

__all__ = ["Gallery", "Moment", "Walls", "open_gallery"]

WALLS = ("left", "right", "bottom", "top")
_ALONG = ((0.0, 1.0), (0.0, 1.0), (1.0, 0.0), (1.0, 0.0))


@dataclass(frozen=True)
class Walls:
    """Which walls of a scenario move, and its Reynolds number.

    Attributes:
        moving: names of the walls that slide.
        reynolds: Reynolds number, None where there is none.
        mark: what sets the scenario apart, as in "falling circle"; empty where nothing does.
    """

    moving: tuple[str, ...]
    reynolds: float | None
    mark: str

    @property
    def classes(self) -> str:
        """Classes of a panel whose walls move."""
        return " ".join(f"{wall}-moves" for wall in self.moving)


@dataclass(frozen=True, kw_only=True, eq=False)
class Moment:
    """One frame of one scenario: the truth and every entry's prediction.

    Attributes:
        scenario: id of the scenario.
        frame: absolute frame number.
        pairs: truth and prediction of each entry, in their order.
    """

    scenario: int
    frame: int
    pairs: tuple[FramePair, ...]

    @property
    def truth(self) -> Snapshot:
        """The true particles."""
        return self.pairs[0].truth

    @property
    def setting_of(self) -> Scenario:
        """What holds in all frames of the scenario."""
        return self.pairs[0].scenario

    @cached_property
    def true_vorticity(self) -> NDArray[np.float64]:
        """Vorticity of the truth, NaN where it is not compared [1/frame], shape [x node, y node]."""
        return self.truth.fields.vorticity


@dataclass(frozen=True, eq=False)
class Gallery:
    """All frames that the pictures of a report show.

    Attributes:
        moments: moments by scenario id and frame.
        walls: walls by scenario id.
    """

    moments: Mapping[tuple[int, int], Moment]
    walls: Mapping[int, Walls]

    def at(self, scenario: int, frames: Collection[int]) -> list[Moment]:
        """Return the moments of a scenario at some frames."""
        return [self.moments[scenario, frame] for frame in frames]


def open_gallery(subject: Subject) -> Gallery:
    """Read the frames that the pictures of a report show.

    Raises:
        DataError: the truth is damaged.
        UnreadableFileError: predictions are.
    """
    moments: dict[tuple[int, int], Moment] = {}
    walls: dict[int, Walls] = {}
    with ExitStack() as stack:
        files = [stack.enter_context(open_predictions(entry.predictions)) for entry in subject.entries]
        for scenario in subject.scenarios:
            with subject.exam.opened(scenario) as truth:
                walls[scenario] = _walls(truth)
                for moment in _moments(truth, files, scenario, _frames(subject, scenario)):
                    moments[scenario, moment.frame] = moment
    return Gallery(moments, walls)


def _frames(subject: Subject, scenario: int) -> list[int]:
    """Return the frames of a scenario that are shown: all in the first, and of free surfaces."""
    if scenario != subject.scenarios[0] and subject.full_box:
        return [subject.key_frame]
    return sorted({subject.key_frame, *subject.times, *subject.histogram_frames})


def _moments(
    truth: OpenScenario, files: list[Predictions], number: int, frames: list[int]
) -> Iterator[Moment]:
    scenario = truth.scenario
    for frame in frames:
        position = truth.file.read("position", slice(frame - 1, frame + 1))
        true = scenario.snapshot(position[1], position[0])
        pairs = [FramePair(scenario, frame, true, _predicted(f, scenario, number, frame)) for f in files]
        yield Moment(scenario=number, frame=frame, pairs=tuple(pairs))


def _predicted(file: Predictions, scenario: Scenario, number: int, frame: int) -> Snapshot:
    if frame == scenario.setting.input_frames:
        return scenario.snapshot(file.frames(number, frame, 1)[0], scenario.given[-1])
    before, now = file.frames(number, frame - 1, 2)
    return scenario.snapshot(now, before)


def _walls(truth: OpenScenario) -> Walls:
    file = truth.file
    speed = np.zeros((4, 2))
    if "wall_velocity" in file.variables:
        speed = np.asarray(file.read("wall_velocity", 0), np.float64) * _ALONG
    parameters = file.header.parameters
    reynolds = parameters.get("reynolds_number")
    marks = [str(parameters[name]) for name in ("family", "pair") if name in parameters]
    if "frequency" in parameters:
        marks.append(f"frequency {parameters['frequency']}")
    return Walls(
        moving=tuple(wall for wall, v in zip(WALLS, speed, strict=True) if v.any()),
        reynolds=float(reynolds) if isinstance(reynolds, (int, float)) else None,
        mark=", ".join(marks),
    )
