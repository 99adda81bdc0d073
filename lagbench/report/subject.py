"""What a report is about: the entries, the task, and the frames that its pictures
show.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lagbench.data import WALLS
from lagbench.data.local import resolve_root, rooted
from lagbench.data.registry import Registry
from lagbench.errors import UsageError
from lagbench.metrics.aggregate import Score
from lagbench.metrics.frame import FramePair, Snapshot
from lagbench.metrics.metric import Metric
from lagbench.scoring.card import SUBMISSION, ScoreCard, number_methods
from lagbench.scoring.task import OpenScenario, ScoredTask, load_scored_task
from lagbench.submission.predictions import open_predictions

COLOURS = 6  # series that differ in colour; further ones are dashed

THESIS_FRAMES = {"cavity": 54, "curl-noise": 40}
"""Frame at which the thesis compares models: 54, and 35 after the last of 6 given
frames.
"""

OTHER_FRAME = 60

TIMES = 6  # columns of the pictures over time

TOP = 99.5  # full colour of pictures is the percentile of the truth's magnitudes

SAME = ("split", "size", "dataset_version", "dataset_sha256")


@dataclass(frozen=True, kw_only=True, eq=False)
class Entry:
    """One submission of the report."""

    number: int  # its place in the order in which the files were given, from 0
    name: str  # its method, told apart from others of that name
    card: ScoreCard  # what the scorer says of it
    predictions: Path  # its file

    @property
    def kind(self) -> str:
        """Classes of its marks."""
        return kind_of(self.number)


@dataclass(frozen=True, kw_only=True, eq=False)
class Row:
    """What stands beside each other in tables and charts: an entry or a floor."""

    name: str
    kind: str  # classes of its marks
    scores: Mapping[str, Score]  # its scores by metric
    entry: Entry | None = None  # the entry, None for a floor


@dataclass(frozen=True, kw_only=True, eq=False)
class Subject:
    """Everything that the figures are drawn from."""

    task: ScoredTask  # the test subset
    title: str  # title of the split
    entries: tuple[Entry, ...]  # the submissions in the order in which they were given

    @cached_property
    def rows(self) -> tuple[Row, ...]:
        """Entries, then the floors."""
        rows = [
            Row(name=e.name, kind=e.kind, scores=e.card.submission, entry=e)
            for e in self.entries
        ]
        first = self.entries[0].card.scores
        floors = [name for name in first if name != SUBMISSION]
        rows += [
            Row(name=name, kind=f"floor{i}", scores=first[name])
            for i, name in enumerate(floors)
        ]
        return tuple(rows)

    @property
    def ranking(self) -> Metric:
        """The metric that ranks."""
        card = self.entries[0].card
        return card.submission[card.ranking].metric

    @property
    def best_entry(self) -> Row:
        """The entry with the least loss in the ranking metric, the first of equals."""
        metric = self.ranking
        rows = self.rows[: len(self.entries)]
        losses = [metric.loss(row.scores[metric.name].mean) for row in rows]
        return rows[int(np.argmin(np.nan_to_num(losses, nan=np.inf)))]

    @property
    def full_box(self) -> bool:
        """Whether the material fills the box: no surface, one material."""
        return self.task.config.is_full_box

    @property
    def scenarios(self) -> tuple[int, ...]:
        """Ids of the test scenarios, ascending."""
        return self.task.scenarios

    @property
    def frames(self) -> NDArray[np.int64]:
        """Absolute numbers of the predicted frames, shape [frame]."""
        return np.array(self.task.config.predicted_frames)

    @property
    def key_frame(self) -> int:
        """The frame of interest nearest to the one at which the thesis compares."""
        wanted = THESIS_FRAMES.get(self.task.size.split, OTHER_FRAME)
        return min(
            self.frames_of_interest, key=lambda frame: (abs(frame - wanted), frame)
        )

    @property
    def frames_of_interest(self) -> tuple[int, ...]:
        """Frames of interest, the last predicted one if there are none."""
        predicted = self.task.config.predicted_frames
        known = sorted(
            set(self.task.config.frames_of_interest).intersection(predicted)
        )
        return tuple(known) or (predicted[-1],)

    @property
    def histogram_frames(self) -> tuple[int, ...]:
        """Frames of the distributions over time: those of interest but the key frame,
        or evenly spaced.
        """
        others = [frame for frame in self.frames_of_interest if frame != self.key_frame]
        if len(others) >= TIMES:
            return tuple(others[:TIMES])
        return self.times

    @property
    def times(self) -> tuple[int, ...]:
        """Frames of the pictures over time, the first and the last predicted one among
        them.
        """
        predicted = self.task.config.predicted_frames
        many = len(self.frames_of_interest) >= TIMES
        if many:
            chosen = _spaced(self.frames_of_interest, TIMES - 1)
        else:
            chosen = _spaced(predicted, TIMES)
        return tuple(sorted({*chosen, predicted[-1]}))


def kind_of(number: int) -> str:
    """Return the classes of a series: six colours, then the same ones dashed."""
    return f"s{number % COLOURS}" + (
        f" d{min(number // COLOURS, 3)}" if number >= COLOURS else ""
    )


def _spaced(numbers: Sequence[int], count: int) -> Sequence[int]:
    if len(numbers) <= count:
        return numbers
    return [numbers[round(i * (len(numbers) - 1) / (count - 1))] for i in range(count)]


def subject_of(
    cards: Sequence[ScoreCard],
    predictions: Sequence[Path],
    *,
    root: str | Path | None = None,
    registry: Registry | None = None,
) -> Subject:
    """Return the subject of a report."""
    if not cards or len(cards) != len(predictions):
        expected = "one file per score card, at least one"
        got = f"{len(cards)} cards, {len(predictions)} files"
        raise UsageError(
            "a report needs score cards and their predictions",
            expected=expected,
            got=got,
        )
    folder = resolve_root(root)
    header = cards[0].header
    for card, path in zip(cards, predictions, strict=True):
        for name in SAME:
            one = getattr(header, name)
            two = getattr(card.header, name)
            if one != two:
                what = f"one report, two values of {name}"
                fix = "report submissions to one data set together, others on their own"
                raise UsageError(what, where=str(path), expected=one, got=two, fix=fix)
    described = rooted(folder, registry)
    task = load_scored_task(described.size(header.split, header.size), folder)
    names = number_methods([card.header.method for card in cards], taken=cards[0].scores)
    entries = [
        Entry(number=i, name=name, card=card, predictions=Path(path))
        for i, (name, card, path) in enumerate(
            zip(names, cards, predictions, strict=True)
        )
    ]
    return Subject(
        task=task, title=described.split(header.split).title, entries=tuple(entries)
    )


_ALONG = ((0.0, 1.0), (0.0, 1.0), (1.0, 0.0), (1.0, 0.0))  # how walls slide


@dataclass(frozen=True)
class Walls:
    """Which walls of a scenario move, and its Reynolds number."""

    moving: tuple[str, ...]  # names of the walls that slide
    reynolds: float | None  # Reynolds number, None where there is none
    # what sets the scenario apart, as in "falling circle"; empty where nothing does
    mark: str

    @property
    def classes(self) -> str:
        """Classes of a panel, which tell the walls that move."""
        return " ".join(["panel", *(f"{wall}-moves" for wall in self.moving)])


@dataclass(frozen=True, kw_only=True, eq=False)
class Moment:
    """One frame of one scenario: the truth and every entry's prediction."""

    scenario: int  # id of the scenario
    frame: int  # absolute frame number
    pairs: tuple[FramePair, ...]  # truth and prediction of each entry, in their order

    @property
    def truth(self) -> Snapshot:
        """The true particles."""
        return self.pairs[0].truth

    @cached_property
    def true_vorticity(self) -> NDArray[np.float64]:
        """Vorticity of the truth, NaN where it is not compared [1/frame], shape [x
        node, y node].
        """
        return self.truth.fields.vorticity


@dataclass(frozen=True, eq=False)
class Gallery:
    """All frames that the pictures of a report show."""

    moments: Mapping[tuple[int, int], Moment]  # moments by scenario id and frame
    walls: Mapping[int, Walls]  # walls by scenario id

    def at(self, scenario: int, frames: Collection[int]) -> list[Moment]:
        """Return the moments of a scenario at some frames."""
        return [self.moments[scenario, frame] for frame in frames]


def open_gallery(subject: Subject) -> Gallery:
    """Read the frames that the pictures of a report show."""
    moments: dict[tuple[int, int], Moment] = {}
    walls: dict[int, Walls] = {}
    with ExitStack() as stack:
        files = [
            stack.enter_context(open_predictions(entry.predictions))
            for entry in subject.entries
        ]
        for number in subject.scenarios:
            # all frames in the first scenario, and of free surfaces
            frames = sorted(
                {subject.key_frame, *subject.times, *subject.histogram_frames}
            )
            if number != subject.scenarios[0] and subject.full_box:
                frames = [subject.key_frame]
            with subject.task.opened(number) as truth:
                scenario = truth.scenario
                walls[number] = _walls(truth)
                for frame in frames:
                    before, now = truth.file.read(
                        "position", slice(frame - 1, frame + 1)
                    )
                    true = scenario.snapshot(now, before)
                    pairs = []
                    for file in files:
                        if frame == scenario.config.input_frames:
                            before = scenario.input_positions[-1]
                            now = file.frames(number, frame, 1)[0]
                        else:
                            before, now = file.frames(number, frame - 1, 2)
                        pairs.append(
                            FramePair(
                                scenario, frame, true, scenario.snapshot(now, before)
                            )
                        )
                    moments[number, frame] = Moment(
                        scenario=number, frame=frame, pairs=tuple(pairs)
                    )
    return Gallery(moments, walls)


def limit_of(fields: Sequence[NDArray[np.float64]]) -> float:
    """Return the magnitude of full colour: what almost all nodes stay below."""
    values = np.concatenate([np.abs(field[np.isfinite(field)]) for field in fields])
    if values.size:
        top = float(np.percentile(values, TOP))
    else:
        top = 0.0
    if np.isfinite(top) and top > 0.0:
        return top
    return 1.0


def _walls(truth: OpenScenario) -> Walls:
    file = truth.file
    speed = np.zeros((4, 2))
    if "wall_velocity" in file.variables:
        speed = (
            np.abs(np.asarray(file.read("wall_velocity"), np.float64)).max(axis=0)
            * _ALONG
        )
    reynolds = file.header.parameters.get("reynolds_number")
    parameters = file.header.parameters
    marks = [str(parameters[name]) for name in ("family", "pair") if name in parameters]
    if "frequency" in parameters:
        marks.append(f"frequency {parameters['frequency']}")
    return Walls(
        moving=tuple(wall for wall, v in zip(WALLS, speed, strict=True) if v.any()),
        reynolds=float(reynolds) if isinstance(reynolds, (int, float)) else None,
        mark=", ".join(marks),
    )
