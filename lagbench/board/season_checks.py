"""The checks of the files of blind seasons."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from lagbench.data.registry import Registry
from lagbench.errors import LagbenchError
from lagbench.metrics.aggregate import score
from lagbench.metrics.table import METRICS
from lagbench.references.shipped import shipped
from lagbench.scoring.boards import board_option
from lagbench.scoring.score_file_checks import read_score_file
from lagbench.submission.issues import ValidationIssue

from .entry import RELATIVE_TOLERANCE, Entry
from .folder import SEASON_SCORES, SEASONS, Folder, Place
from .issues import issue_from_error, make_issue
from .season import Season, SeasonDataSet, read_season, season_path
from .season_scores import (
    DataSetScores,
    SeasonScores,
    find_prediction,
    frozen_models,
    read_scores,
    values_of,
)


@dataclass(frozen=True, kw_only=True)
class PublicValues:
    """The ranking metric on test by scenario: as a season states it, and as it is."""

    name: str  # whose values they are, for messages
    stated: Mapping[int, float]
    measured: Mapping[int, float]
    source: Path  # the file with the measured values

    def find_difference(self) -> tuple[str, str] | None:
        """Return the first value that differs, as stated and as measured.

        Both texts name the scenario. None where all values agree.
        """
        for scenario in sorted({*self.stated, *self.measured}):
            stated = self.stated.get(scenario)
            measured = self.measured.get(scenario)
            if not _agree(stated, measured):
                return _describe(scenario, stated), _describe(scenario, measured)
        return None


def check_seasons(
    folder: Folder,
    entries: Sequence[Entry],
    *,
    readable_score_files: Collection[Path],
    registry: Registry,
) -> list[ValidationIssue]:
    """Check that seeds and scores of seasons follow from their frozen models.

    Args:
        folder: the leaderboard's folder.
        entries: entries that fit the schema.
        readable_score_files: score files that no other check has refused.
        registry: where splits are described.
    """
    entry_at = {entry.place: entry for entry in entries}
    issues = []
    names = {path.parts[1] for path in folder.season_files()}
    for name in sorted(names):
        try:
            season = read_season(folder, name)
            scores = read_scores(folder, season)
            if scores is None:
                continue
            for values in _read_public_values(
                folder, season, scores, entry_at, readable_score_files, registry
            ):
                difference = values.find_difference()
                if difference is not None:
                    issue = _issue_of_difference(folder, name, values, *difference)
                    issues.append(issue)
        except LagbenchError as error:
            issues.append(issue_from_error("season", error, error.where or SEASONS))
    return issues


def _read_public_values(
    folder: Folder,
    season: Season,
    scores: SeasonScores,
    entry_at: Mapping[Place, Entry],
    readable_score_files: Collection[Path],
    registry: Registry,
) -> Iterator[PublicValues]:
    """Yield the public values of a season that can be compared with score files.

    An entry may be removed or get another model after a season. Then nothing is left
    to compare its values with.
    """
    for data_set, scored in zip(season.data_sets, scores.data_sets, strict=True):
        reference = _read_reference(data_set, scored, registry)
        if reference is not None:
            yield reference

        models = zip(frozen_models(data_set), scored.models, strict=True)
        for (frozen, model), stated in models:
            place = (data_set.split, data_set.size, frozen.method)
            entry = entry_at.get(place)
            if entry is None or entry.dataset.sha256 != data_set.dataset_sha256:
                continue
            index = find_prediction(entry, model)
            if index is None:
                continue
            path = entry.score_paths[index]
            if path not in readable_score_files:
                continue
            tallies = read_score_file(folder.path / path).scores.tallies
            public = score(METRICS[data_set.metric], tallies)
            measured = {}
            if public is not None:
                measured = values_of(public)
            name = "/".join(place)
            if model.seed is not None:
                name += f", seed {model.seed}"
            yield PublicValues(
                name=name, stated=stated.public, measured=measured, source=path
            )


def _read_reference(
    data_set: SeasonDataSet, scored: DataSetScores, registry: Registry
) -> PublicValues | None:
    """Return the public values of the naive predictor; None on data of another day."""
    size = registry.size(data_set.split, data_set.size)
    if size.measured is None:
        return None
    if size.measured.dataset_sha256 != data_set.dataset_sha256:
        return None
    reference = (shipped(size) or {}).get(data_set.reference)
    if reference is None:
        return None
    return PublicValues(
        name=f"{data_set.split}/{data_set.size}, {data_set.reference}",
        stated=scored.public_reference,
        measured=values_of(reference.scores[data_set.metric]),
        source=Path("lagbench/references/measured"),
    )


def _issue_of_difference(
    folder: Folder, season: str, values: PublicValues, stated: str, measured: str
) -> ValidationIssue:
    path = season_path(season, SEASON_SCORES)
    return make_issue(
        "season",
        f"{path}, public values of {values.name}",
        stated,
        what="the public scores of a season are not those of the score files",
        expected=f"{measured}, as in {values.source}",
        fix=f"lagbench season run {season}{board_option(folder.path)}",
    )


def _agree(stated: float | None, measured: float | None) -> bool:
    if stated is None or measured is None:
        return False
    return math.isclose(stated, measured, rel_tol=RELATIVE_TOLERANCE, abs_tol=1e-300)


def _describe(scenario: int, value: float | None) -> str:
    if value is None:
        return f"scenario {scenario}: no value"
    return f"scenario {scenario}: {value}"
