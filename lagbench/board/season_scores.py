"""The file of a season's scores: seasons/<name>/scores.yaml, read and checked."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from lagbench.data.checksums import round_digits
from lagbench.errors import ChecksFailedError
from lagbench.metrics.aggregate import Score
from lagbench.scoring.boards import board_option

from .entry import Entry, Strict
from .entry_file import examine, format_issues, load_plain
from .fields import Hash, Name, RankingValue, Seed
from .folder import SEASON_SCORES, Folder
from .scores_compared import DIGITS
from .season import (
    FrozenEntry,
    FrozenModel,
    Recorded,
    Season,
    SeasonDataSet,
    season_path,
)

MOST_SCORE_BYTES = 4_000_000
"""Longest file of scores [bytes]; a model takes up to 5,000."""

Values = Annotated[dict[int, RankingValue], Field(max_length=1000)]


class ModelScores(Strict):
    """The ranking metric of one model by scenario, on blind and on public ones."""

    method: Name
    seed: Seed | None = None
    seeds: Annotated[int, Field(ge=1)] = Field(description="seeds of the entry")
    model: Hash
    public: Values
    blind: Values


class DataSetScores(Strict):
    """The blind scenarios of a data set and what was scored on them."""

    split: Name
    size: Name
    draw_seed: Hash
    scenarios: Annotated[dict[int, Hash], Field(max_length=1000)] = Field(
        description="content hash of each blind scenario"
    )
    # ranking metric of the naive predictor
    public_reference: Values
    blind_reference: Values
    models: Annotated[tuple[ModelScores, ...], Field(max_length=10_000, strict=False)]


class SeasonScores(Strict):
    """The whole file seasons/<name>/scores.yaml."""

    format: Literal[1] = 1
    season: Name
    data_sets: Annotated[tuple[DataSetScores, ...], Field(max_length=100, strict=False)]

    @property
    def recorded(self) -> Recorded:
        """Content hashes of the blind scenarios, by split and size."""
        hashes = {}
        for data_set in self.data_sets:
            hashes[data_set.split, data_set.size] = data_set.scenarios
        return hashes


def read_scores(folder: Folder, season: Season) -> SeasonScores | None:
    """Return the scores of a season on the board; None where it was not run yet.

    Raises:
        UnreadableFileError: the file cannot be read.
        ChecksFailedError: it does not fit, or belongs to other seeds or models.
    """
    path = season_path(season.season, SEASON_SCORES)
    file = folder.path / path
    if folder.link_in(path) is not None or not file.is_file():
        return None
    fix = (
        "restore it, or remove it and run: lagbench season run "
        f"{season.season}{board_option(folder.path)}"
    )
    content = load_plain(file, longest=MOST_SCORE_BYTES, fix=fix)
    scores, issues = examine(SeasonScores, content)
    if scores is None:
        raise ChecksFailedError(
            "the scores of a season do not fit",
            where=str(file),
            expected="the layout of scores.yaml",
            got=format_issues(issues),
            fix=fix,
        )
    problem = _find_mismatch(season, scores)
    if problem is not None:
        raise ChecksFailedError(
            "the scores of a season are not those of its frozen models",
            where=str(file),
            expected=str(season_path(season.season)),
            got=problem,
            fix=fix,
        )
    return scores


def _find_mismatch(season: Season, scores: SeasonScores) -> str | None:
    """Return what of the scores does not belong to the season, None where all does."""
    if scores.season != season.season or len(scores.data_sets) != len(season.data_sets):
        return "another season, or other data sets"
    for frozen, scored in zip(season.data_sets, scores.data_sets, strict=True):
        place = f"{frozen.split} {frozen.size}"
        if (scored.split, scored.size) != (frozen.split, frozen.size):
            return f"{scored.split} {scored.size} instead of {place}"
        if scored.draw_seed != frozen.draw_seed:
            return f"{place}: another seed"
        ids = list(frozen.ids)
        if list(scored.scenarios) != ids or list(scored.blind_reference) != ids:
            return f"{place}: other blind scenarios"
        expected = []
        for entry, model in frozen_models(frozen):
            expected.append((entry.method, model.seed, model.sha256, entry.scenarios))
        found = []
        for one in scored.models:
            count = len(one.blind)
            if list(one.blind) != ids[:count]:
                return f"{place}, {one.method}: other blind scenarios"
            found.append((one.method, one.seed, one.model, count))
        if found != expected:
            return f"{place}: other models"
    return None


def values_of(scores: Score) -> dict[int, float]:
    """Return the value of a metric in each scenario that has one, nine digits."""
    values = {}
    for scenario, value in zip(scores.scenarios, scores.values.tolist(), strict=True):
        if np.isfinite(value):
            values[scenario] = round_digits(value, DIGITS)
    return values


def find_prediction(entry: Entry, model: FrozenModel) -> int | None:
    """Return the number of the prediction that a frozen model made, None without it.

    None also where the entry predicts with other options by now.
    """
    for index, prediction in enumerate(entry.predictions):
        if model.is_of(entry, prediction):
            return index
    return None


def frozen_models(
    data_set: SeasonDataSet,
) -> Iterable[tuple[FrozenEntry, FrozenModel]]:
    """Yield the models of a data set, each with its entry."""
    for entry in data_set.entries:
        for model in entry.models:
            yield entry, model
