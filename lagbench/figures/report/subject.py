"""The subject of a report: entries, task, and the frames that its pictures show."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lagbench.data.layout import major_of
from lagbench.data.local import load_rooted_registry, resolve_root
from lagbench.data.registry import Registry
from lagbench.errors import UsageError
from lagbench.figures.recording import describe_parameters
from lagbench.figures.solid import SLICE
from lagbench.metrics.aggregate import Score
from lagbench.metrics.frame import FramePair, Snapshot
from lagbench.metrics.metric import Metric
from lagbench.scoring.card import ScoreCard, number_methods
from lagbench.scoring.task import SUBMISSION, OpenScenario, ScoredTask, load_scored_task
from lagbench.submission.predictions import Predictions, open_predictions

Floats = NDArray[np.float64]

THESIS_FRAMES = {"cavity": 54, "curl-noise": 40}
"""Frame at which the thesis compares models: 54, and 35 after the last of 6 given
frames.
"""

OTHER_FRAME = 60  # the same of splits that are not in the thesis

TIMES = 6  # columns of the pictures over time

TOP_PERCENTILE = 99.5  # full colour is this percentile of the truth's magnitudes

SAME_FIELDS = ("split", "size", "subset", "dataset_sha256")
"""Fields of the header that all entries of a report share.

Versions may differ in MINOR and PATCH, which change no data.
"""


@dataclass(frozen=True, kw_only=True, eq=False)
class ReportEntry:
    """One submission of the report."""

    number: int  # its place in the order in which the files were given, from 0
    name: str  # its method, distinct from the names of other entries
    card: ScoreCard  # its scores
    predictions: Path  # its file


@dataclass(frozen=True, kw_only=True, eq=False)
class ReportRow:
    """One line of tables and charts: an entry or a reference predictor."""

    name: str
    scores: Mapping[str, Score]  # its scores by metric
    entry: ReportEntry | None = None  # None for a reference predictor


@dataclass(frozen=True, kw_only=True, eq=False)
class Subject:
    """All that the figures are drawn from."""

    task: ScoredTask  # the predicted subset
    title: str  # title of the split
    entries: tuple[ReportEntry, ...]  # in the order in which the files were given

    @cached_property
    def rows(self) -> tuple[ReportRow, ...]:
        """The reference predictors, then the entries."""
        rows = []
        for name, scores in self.entries[0].card.scores.items():
            if name != SUBMISSION:
                rows.append(ReportRow(name=name, scores=scores))
        for entry in self.entries:
            scores = entry.card.submission
            rows.append(ReportRow(name=entry.name, scores=scores, entry=entry))
        return tuple(rows)

    @property
    def names(self) -> list[str]:
        """Names of the entries."""
        return [entry.name for entry in self.entries]

    def rows_with(self, metric: str) -> list[ReportRow]:
        """Return the rows that have a score of a metric."""
        rows = []
        for row in self.rows:
            if metric in row.scores:
                rows.append(row)
        return rows

    @property
    def ranking(self) -> Metric:
        """The metric that ranks."""
        card = self.entries[0].card
        return card.submission[card.ranking].metric

    @property
    def data_name(self) -> str:
        """Split and size, and the subset if it is not test."""
        return self.entries[0].card.data_name

    @property
    def is_full_box(self) -> bool:
        """Whether one fluid fills the box; else the material has a free surface."""
        return self.task.config.is_full_box

    @property
    def scenarios(self) -> tuple[int, ...]:
        """Ids of the scenarios, ascending."""
        return self.task.scenarios

    @property
    def frames(self) -> NDArray[np.int64]:
        """Absolute numbers of the predicted frames, shape [frame]."""
        return np.array(self.task.config.predicted_frames)

    @property
    def key_frame(self) -> int:
        """The frame of interest nearest to the one at which the thesis compares."""
        target = THESIS_FRAMES.get(self.task.size.split, OTHER_FRAME)

        def distance(frame: int) -> int:
            return abs(frame - target)

        # the earlier of two that are as near
        return min(self.frames_of_interest, key=distance)

    @property
    def frames_of_interest(self) -> tuple[int, ...]:
        """Frames of interest, the last predicted one if there are none."""
        predicted = self.task.config.predicted_frames
        frames = set(self.task.config.frames_of_interest).intersection(predicted)
        return tuple(sorted(frames)) or (predicted[-1],)

    @property
    def times(self) -> tuple[int, ...]:
        """Frames of the pictures over time, with the first and last predicted one."""
        predicted = self.task.config.predicted_frames
        if len(self.frames_of_interest) >= TIMES:
            frames = _choose_evenly(self.frames_of_interest, TIMES - 1)
        else:
            frames = _choose_evenly(predicted, TIMES)
        return tuple(sorted({*frames, predicted[-1]}))


def _choose_evenly(numbers: Sequence[int], count: int) -> Sequence[int]:
    if len(numbers) <= count:
        return numbers
    step = (len(numbers) - 1) / (count - 1)
    return [numbers[round(i * step)] for i in range(count)]


def load_subject(
    cards: Sequence[ScoreCard],
    predictions: Sequence[Path],
    *,
    root: str | Path | None = None,
    registry: Registry | None = None,
) -> Subject:
    """Return the subject of a report.

    Raises:
        UsageError: there is no entry, or entries do not belong together.
        DataError: the predicted subset is missing or damaged.
    """
    if not cards or len(cards) != len(predictions):
        raise UsageError(
            "a report needs score cards and their predictions; give as many of both"
        )
    expected_fields: dict[str, object] = {}
    for card, path in zip(cards, predictions, strict=True):
        fields = {name: getattr(card.header, name) for name in SAME_FIELDS}
        # The hash of a data set does not cover the subset shift.
        fields["MAJOR version of the data"] = major_of(card.header.dataset_version)
        for name, value in fields.items():
            if value != expected_fields.setdefault(name, value):
                raise UsageError(
                    f"{path} has another {name} than the files before it; report "
                    "submissions to one data set together"
                )
    header = cards[0].header
    folder = resolve_root(root)
    splits = load_rooted_registry(folder, registry)
    size = splits.size(header.split, header.size).scored_on(header.subset)
    task = load_scored_task(size, folder)

    methods = [card.header.method for card in cards]
    names = number_methods(methods, taken=cards[0].scores)
    entries = []
    for number, name in enumerate(names):
        entry = ReportEntry(
            number=number,
            name=name,
            card=cards[number],
            predictions=Path(predictions[number]),
        )
        entries.append(entry)
    title = splits.split(header.split).title
    return Subject(task=task, title=title, entries=tuple(entries))


@dataclass(frozen=True, kw_only=True, eq=False)
class Moment:
    """One frame of one scenario: the truth and every entry's prediction."""

    scenario: int  # id of the scenario
    frame: int  # absolute frame number
    pairs: tuple[FramePair, ...]  # truth and prediction of each entry, in their order

    @property
    def title(self) -> str:
        """The frame as a heading."""
        return f"frame {self.frame}"

    @property
    def truth(self) -> Snapshot:
        """The true particles."""
        return self.pairs[0].truth

    @cached_property
    def true_vorticity(self) -> Floats:
        """Vorticity of the truth [1/frame], shape [x node, y node].

        NaN stands where it is not compared. In three dimensions it is the component
        across the middle plane, in that plane.
        """
        return self.truth.fields.section.vorticity

    def predicted_vorticity(self, number: int) -> Floats:
        """Return the vorticity of an entry where it is compared, NaN elsewhere."""
        pair = self.pairs[number]
        is_compared = self.truth.fields.section.differentiable
        vorticity = pair.predicted_fields.section.vorticity
        return np.where(is_compared, vorticity, np.nan)


@dataclass(frozen=True, eq=False)
class Gallery:
    """All frames that the pictures of a report show."""

    moments: Mapping[tuple[int, int], Moment]  # by scenario id and frame
    labels: Mapping[int, str]  # what sets a scenario apart, by its id

    def at(self, scenario: int, frames: Collection[int]) -> list[Moment]:
        """Return the moments of a scenario at some frames."""
        return [self.moments[scenario, frame] for frame in frames]

    def describe(self, scenario: int) -> str:
        """Return a sentence that names a scenario and what sets it apart."""
        label = self.labels[scenario]
        if not label:
            return f"Scenario {scenario}."
        return f"Scenario {scenario}: {label}."


def read_gallery(subject: Subject) -> Gallery:
    """Read the frames that the pictures of a report show.

    Raises:
        DataError: the test subset is missing or damaged.
        UnreadableFileError: predictions are.
    """
    moments: dict[tuple[int, int], Moment] = {}
    labels: dict[int, str] = {}
    all_frames = {subject.key_frame, *subject.times}
    with ExitStack() as stack:
        files = []
        for entry in subject.entries:
            files.append(stack.enter_context(open_predictions(entry.predictions)))
        for number in subject.scenarios:
            # in full boxes only the first scenario is shown over time
            if subject.is_full_box and number != subject.scenarios[0]:
                frames = [subject.key_frame]
            else:
                frames = sorted(all_frames)
            with subject.task.opened(number) as truth:
                details = describe_parameters(truth.file.header.parameters)
                if truth.scenario.config.box.dimension == 3:
                    details.append(f"fields are a slice {SLICE}")
                labels[number] = ", ".join(details)
                for frame in frames:
                    pairs = _read_pairs(truth, files, number, frame)
                    moment = Moment(scenario=number, frame=frame, pairs=pairs)
                    moments[number, frame] = moment
    return Gallery(moments, labels)


def _read_pairs(
    truth: OpenScenario, files: Sequence[Predictions], number: int, frame: int
) -> tuple[FramePair, ...]:
    """Return truth and prediction of each entry at a frame."""
    scenario = truth.scenario
    before, now = truth.file.read("position", slice(frame - 1, frame + 1))
    true_snapshot = scenario.snapshot(scenario.select(now), scenario.select(before))
    pairs = []
    for file in files:
        is_first_predicted = frame == scenario.config.input_frames
        if is_first_predicted:
            before = scenario.input_positions[-1]
            now = file.frames(number, frame, 1)[0]
        else:
            before, now = file.frames(number, frame - 1, 2)
        predicted_snapshot = scenario.snapshot(
            scenario.select(now), scenario.select(before)
        )
        pairs.append(FramePair(scenario, frame, true_snapshot, predicted_snapshot))
    return tuple(pairs)


def limit_of(fields: Sequence[Floats]) -> float:
    """Return the magnitude of full colour: almost all nodes stay below it."""
    values = np.concatenate([field.ravel() for field in fields])
    values = np.abs(values[np.isfinite(values)])
    if values.size == 0:
        return 1.0
    top = float(np.percentile(values, TOP_PERCENTILE))
    if np.isfinite(top) and top > 0.0:
        return top
    return 1.0
