"""The table of a season: public skill, blind skill and their gap, model by model.

Both skills are measured over the same naive predictor, and with the same models. The
public scenarios are those of test; public and blind ones are independent draws.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from lagbench.data.checksums import round_digits
from lagbench.figures.tables import markdown
from lagbench.metrics.aggregate import Score
from lagbench.metrics.table import METRICS
from lagbench.scoring.skill import skill_gap

from .entry import BlindScore, Entry, Level, Verification
from .entry_file import read_entry_if_valid
from .folder import Folder, entry_path
from .season import Season, SeasonDataSet
from .season_scores import (
    DataSetScores,
    ModelScores,
    SeasonScores,
    find_prediction,
    frozen_models,
)
from .verified import record

DIGITS = 6


@dataclass(frozen=True, kw_only=True)
class SeasonRow:
    """An entry of a season: its skill in public and on blind scenarios."""

    split: str
    size: str
    method: str
    models: tuple[str, ...]  # SHA-256 of the models that were run
    seeds: int  # seeds of the entry
    reference: str  # the naive predictor that both skills are measured over
    public: float
    public_scenarios: int
    blind: float
    blind_scenarios: int
    gap: float  # public minus blind
    # 95 % interval of the gap, over scenarios; NaN of few
    low: float
    high: float

    @property
    def name(self) -> str:
        """Split, size and method."""
        return f"{self.split}/{self.size}/{self.method}"


def season_rows(season: Season, scores: SeasonScores) -> tuple[SeasonRow, ...]:
    """Return the rows of a season's table, by data set, best in public first."""
    rows = []
    for frozen, scored in zip(season.data_sets, scores.data_sets, strict=True):
        group = []
        for entry in frozen.entries:
            models = [one for one in scored.models if one.method == entry.method]
            group.append(_make_row(frozen, scored, models))
        rows += sorted(group, key=lambda row: (-row.public, row.method))
    return tuple(rows)


def _make_row(
    data_set: SeasonDataSet, scored: DataSetScores, models: Sequence[ModelScores]
) -> SeasonRow:
    metric = data_set.metric
    public = [score_of_values(metric, model.public) for model in models]
    blind = [score_of_values(metric, model.blind) for model in models]
    gap = skill_gap(
        public,
        score_of_values(metric, scored.public_reference),
        blind,
        score_of_values(metric, scored.blind_reference),
    )
    return SeasonRow(
        split=data_set.split,
        size=data_set.size,
        method=models[0].method,
        models=tuple(model.model for model in models),
        seeds=models[0].seeds,
        reference=data_set.reference,
        public=gap.first,
        public_scenarios=len(public[0].scenarios),
        blind=gap.second,
        blind_scenarios=len(blind[0].scenarios),
        gap=gap.value,
        low=gap.interval[0],
        high=gap.interval[1],
    )


def score_of_values(name: str, values: Mapping[int, float]) -> Score:
    """Return the score of a metric from its value in each scenario."""
    numbers = np.array(list(values.values()))
    return Score(
        metric=METRICS[name],
        scenarios=tuple(values),
        frames=(),
        per_frame=np.empty((len(numbers), 0)),
        values=numbers,
        undefined=(0,) * len(numbers),
    )


def record_blind(
    board: str | Path, season: Season, rows: Sequence[SeasonRow]
) -> tuple[str, ...]:
    """Write the blind skills to verified.yaml; return the entries at the level blind.

    That level needs all seeds of a reproduced entry. Of other entries the line holds
    the skills only. A gap without an interval is not recorded, nor is that of an entry
    that has other models by now.
    """
    folder = Folder(board)
    blind_entries = []
    for row in rows:
        if math.isnan(row.low):
            continue
        place = (row.split, row.size, row.method)
        entry = read_entry_if_valid(folder.path / entry_path(place))
        if entry is None or not _has_frozen_models(entry, season):
            continue
        line = record(folder, entry, partial(_with_blind, season=season, row=row))
        if line.level is Level.BLIND:
            blind_entries.append(row.name)
    return tuple(blind_entries)


def _has_frozen_models(entry: Entry, season: Season) -> bool:
    """Tell whether an entry still has the models that were frozen, and the options."""
    for data_set in season.data_sets:
        if (data_set.split, data_set.size) != (entry.split, entry.size):
            continue
        for frozen, model in frozen_models(data_set):
            if frozen.method == entry.method and find_prediction(entry, model) is None:
                return False
    return True


def _with_blind(line: Verification, *, season: Season, row: SeasonRow) -> Verification:
    blind = BlindScore(
        season=season.season,
        public=round_digits(row.public, DIGITS),
        blind=round_digits(row.blind, DIGITS),
        low=round_digits(row.low, DIGITS),
        high=round_digits(row.high, DIGITS),
    )
    level = line.level
    if level is Level.REPRODUCED and len(row.models) == row.seeds:
        level = Level.BLIND
    return line.model_copy(update={"blind": blind, "level": level})


def markdown_table(rows: Sequence[SeasonRow]) -> str:
    """Return the table of a season in Markdown, as docs/seasons.md shows it."""
    head = (
        "data set",
        "entry",
        "seeds",
        "public skill",
        "blind skill",
        "gap [95 %]",
        "blind scenarios",
    )
    lines = []
    for row in rows:
        lines.append(
            (
                f"{row.split} {row.size}",
                row.method,
                f"{len(row.models)} of {row.seeds}",
                f"{row.public:z.3f}",
                f"{row.blind:z.3f}",
                describe_gap(row),
                str(row.blind_scenarios),
            )
        )
    return markdown(head, lines)


def describe_gap(row: SeasonRow) -> str:
    """Return the gap and its interval in figures."""
    if math.isnan(row.low):
        return f"{row.gap:+z.3f}"
    return f"{row.gap:+z.3f} [{row.low:+z.3f}, {row.high:+z.3f}]"
