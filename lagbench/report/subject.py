"""What a report is about: the entries, the task, and the frames that its pictures show."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lagbench.errors import UsageError
from lagbench.exam import Exam, load_exam
from lagbench.layout import resolve_root
from lagbench.locating import rooted
from lagbench.method_names import told_apart
from lagbench.metrics import Metric, Score
from lagbench.registry import Registry
from lagbench.score_card import ScoreCard
from lagbench.sitting import SUBMISSION

__all__ = ["COLOURS", "Entry", "Row", "Subject", "kind_of", "subject_of"]

COLOURS = 6
"""Series that differ in colour; further ones are dashed."""

THESIS_FRAMES = {"cavity": 54, "curl-noise": 40}
"""Frame at which the thesis compares models: 54, and 35 after the last of 6 given frames."""

OTHER_FRAME = 60

TIMES = 6
"""Columns of the pictures over time."""

SAME = ("split", "size", "dataset_version", "dataset_sha256")


@dataclass(frozen=True, kw_only=True, eq=False)
class Entry:
    """One submission of the report.

    Attributes:
        number: its place in the order in which the files were given, from 0.
        name: its method, told apart from others of that name.
        card: what the scorer says of it.
        predictions: its file.
    """

    number: int
    name: str
    card: ScoreCard
    predictions: Path

    @property
    def kind(self) -> str:
        """Classes of its marks."""
        return kind_of(self.number)


@dataclass(frozen=True, kw_only=True, eq=False)
class Row:
    """What stands beside each other in tables and charts: an entry or a floor.

    Attributes:
        name: its name.
        kind: classes of its marks.
        scores: its scores by metric.
        entry: the entry, None for a floor.
    """

    name: str
    kind: str
    scores: Mapping[str, Score]
    entry: Entry | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Subject:
    """Everything that the figures are drawn from.

    Attributes:
        exam: the test subset.
        title: title of the split.
        entries: the submissions in the order in which they were given.
    """

    exam: Exam
    title: str
    entries: tuple[Entry, ...]

    @cached_property
    def rows(self) -> tuple[Row, ...]:
        """Entries, then the floors."""
        entries = [Row(name=e.name, kind=e.kind, scores=e.card.submission, entry=e) for e in self.entries]
        first = self.entries[0].card.scores
        floors = [name for name in first if name != SUBMISSION]
        return (
            *entries,
            *(Row(name=name, kind=f"floor{i}", scores=first[name]) for i, name in enumerate(floors)),
        )

    @property
    def ranking(self) -> Metric:
        """The metric that ranks."""
        card = self.entries[0].card
        return card.submission[card.ranking].metric

    @property
    def leader(self) -> Row:
        """The row with the least loss in the ranking metric, the first of equals."""
        return self._least(self.rows)

    @property
    def best_entry(self) -> Row:
        """The same among the entries, floors aside."""
        return self._least([row for row in self.rows if row.entry is not None])

    def _least(self, rows: Sequence[Row]) -> Row:
        metric = self.ranking
        losses = [metric.loss(row.scores[metric.name].mean) for row in rows]
        return rows[int(np.argmin(np.nan_to_num(losses, nan=np.inf)))]

    @property
    def full_box(self) -> bool:
        """Whether the material fills the box: no surface, one material."""
        return self.ranking.name == "vorticity_rmse"

    @property
    def scenarios(self) -> tuple[int, ...]:
        """Ids of the test scenarios, ascending."""
        return self.exam.scenarios

    @property
    def frames(self) -> NDArray[np.int64]:
        """Absolute numbers of the predicted frames, shape [frame]."""
        return np.array(self.exam.setting.predicted_frames)

    @property
    def key_frame(self) -> int:
        """The frame of interest nearest to the one at which the thesis compares."""
        wanted = THESIS_FRAMES.get(self.exam.size.split, OTHER_FRAME)
        return min(self.frames_of_interest, key=lambda frame: (abs(frame - wanted), frame))

    @property
    def frames_of_interest(self) -> tuple[int, ...]:
        """Frames of interest, the last predicted one if there are none."""
        predicted = self.exam.setting.predicted_frames
        known = sorted(set(self.exam.setting.frames_of_interest).intersection(predicted))
        return tuple(known) or (predicted[-1],)

    @property
    def histogram_frames(self) -> tuple[int, ...]:
        """Frames of the distributions over time: those of interest but the key frame, or evenly spaced."""
        others = [frame for frame in self.frames_of_interest if frame != self.key_frame]
        return tuple(others[:TIMES]) if len(others) >= TIMES else self.times

    @property
    def times(self) -> tuple[int, ...]:
        """Frames of the pictures over time, the first and the last predicted one among them."""
        predicted = self.exam.setting.predicted_frames
        if len(self.frames_of_interest) >= TIMES:
            chosen = _spaced(self.frames_of_interest, TIMES - 1)
        else:
            chosen = _spaced(tuple(predicted), TIMES)
        return tuple(sorted({*chosen, predicted[-1]}))


def kind_of(number: int) -> str:
    """Return the classes of a series: six colours, then the same ones dashed."""
    return f"s{number % COLOURS}" + (f" d{min(number // COLOURS, 3)}" if number >= COLOURS else "")


def _spaced(numbers: Sequence[int], count: int) -> Iterator[int]:
    """Yield evenly spaced members, first and last included."""
    if len(numbers) <= count:
        yield from numbers
        return
    for i in range(count):
        yield numbers[round(i * (len(numbers) - 1) / (count - 1))]


def subject_of(
    cards: Sequence[ScoreCard],
    predictions: Sequence[Path],
    *,
    root: str | Path | None = None,
    registry: Registry | None = None,
) -> Subject:
    """Return the subject of a report.

    Args:
        cards: score cards.
        predictions: their files, in the same order.
        root: folder of all data sets.
        registry: where splits are described; ours when None.

    Raises:
        UsageError: nothing to report, or cards of different splits, sizes or data sets.
        DataError: the test subset is missing or damaged.
    """
    if not cards or len(cards) != len(predictions):
        raise UsageError(
            "a report needs score cards and their predictions",
            expected="one file per score card, at least one",
            got=f"{len(cards)} cards, {len(predictions)} files",
        )
    for card, path in zip(cards, predictions, strict=True):
        _check_same(cards[0], card, path)
    folder, header = resolve_root(root), cards[0].header
    described = rooted(folder, registry)
    exam = load_exam(described.size(header.split, header.size), folder)
    names = told_apart([card.header.method for card in cards], taken=cards[0].scores)
    entries = [
        Entry(number=i, name=name, card=card, predictions=Path(path))
        for i, (name, card, path) in enumerate(zip(names, cards, predictions, strict=True))
    ]
    return Subject(exam=exam, title=described.split(header.split).title, entries=tuple(entries))


def _check_same(first: ScoreCard, card: ScoreCard, path: Path) -> None:
    for name in SAME:
        expected, got = getattr(first.header, name), getattr(card.header, name)
        if expected != got:
            raise UsageError(
                f"one report, two values of {name}",
                where=str(path),
                expected=expected,
                got=got,
                fix="report submissions to one data set together, others on their own",
            )
