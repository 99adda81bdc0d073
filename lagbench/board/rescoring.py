"""Rescoring: score predictions of entries again, and compare with the leaderboard.

Scoring again is the proof of a score. Predictions that were submitted have equal
statistics; predictions that the same model made anew have the same score within the
tolerance of a reproduction.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from lagbench.errors import ChecksFailedError, UnreadableFileError, UsageError
from lagbench.metrics.aggregate import LONG_BITS, LONG_ROLLOUT, Tally
from lagbench.metrics.table import METRICS, STATISTICS
from lagbench.scoring.card import ScoreCard
from lagbench.scoring.package_metrics import FAILED_METRIC
from lagbench.scoring.scenario import FILM_RANGE, LAST_STEP, SUBMISSION
from lagbench.scoring.score_file_checks import ScoreFile, read_score_file
from lagbench.scoring.score_file_writer import write_statistics
from lagbench.submission.format import Header
from lagbench.submission.issues import ValidationIssue

from .entry import RELATIVE_TOLERANCE, Entry, EntryFlag, Prediction, ScoredFile
from .folder import Folder
from .issues import REFERENCES_ANEW, make_issue
from .ranking import scored_file
from .scores_compared import compare

# step of packed film positions [length]
FILM_STEP = (FILM_RANGE[1] - FILM_RANGE[0]) / LAST_STEP

# Pictures may differ by the steps in which they are packed, and by rounding.
PICTURE_STEPS = 1.01
PICTURE_TOLERANCE = 1e-5  # relative

MOST_NAMES = 5  # names of statistics that an issue lists


@dataclass(frozen=True)
class Confirmation:
    """Predictions that, scored again, gave the scores of an entry."""

    predictions: Path
    entry: Path  # relative to the leaderboard's folder
    score_file: Path  # likewise
    # greatest relative difference of any statistic; of predictions made anew, of the
    # ranking metric
    difference: float
    is_anew: bool = False  # whether the positions are not those that were submitted


@dataclass(frozen=True)
class EntryFile:
    """One of the predictions of an entry, with its score file."""

    entry: Entry
    prediction: Prediction
    score_path: Path
    scored_file: ScoredFile


@dataclass(frozen=True, kw_only=True)
class Rescoring:
    """Scores predictions of entries again."""

    folder: Folder
    entries: Sequence[Entry]
    readable_score_files: Collection[Path]  # of entries and reference predictors
    score: Callable[..., ScoreCard]  # of predictions and extras that measure more
    confirmations: list[Confirmation] = field(default_factory=list)

    def rescore(self, path: str | Path) -> Iterator[ValidationIssue]:
        """Yield where predictions differ from the leaderboard, or their faults."""
        try:
            # the scorer alone opens them, after its checks in a child process
            card = self.score(path)
        except (UnreadableFileError, ChecksFailedError) as error:
            yield make_issue(
                "rescored",
                path,
                f"{error.what}: {error.got}",
                expected="valid predictions",
                fix="lagbench validate says what is wrong",
            )
            return

        yield from self._compare_references(card)
        files = self._files_with(card.predictions_sha256)
        if not files:
            yield from self._compare_anew(Path(path), card)
        for file in files:
            # the checks of score files report files that cannot be read
            if file.score_path in self.readable_score_files:
                yield from self._compare(Path(path), card, file)

    def _files_with(self, predictions_sha256: str) -> list[EntryFile]:
        files = []
        for entry in self.entries:
            parts = zip(
                entry.predictions, entry.score_paths, entry.score.files, strict=True
            )
            for prediction, score_path, file in parts:
                if file.predictions_sha256 == predictions_sha256:
                    files.append(EntryFile(entry, prediction, score_path, file))
        return files

    def _compare_anew(self, path: Path, card: ScoreCard) -> Iterator[ValidationIssue]:
        """Compare predictions made anew by the method and seed of an entry.

        Positions differ in the last digits from processor to processor, so the ranking
        metric is compared within the tolerance of a reproduction.
        """
        files = self._files_of_method(card.header)
        if not files:
            yield make_issue(
                "rescored",
                path,
                card.predictions_sha256,
                expected="an entry with these predictions, or of this method and seed",
            )
        issues = []
        agrees_with_one = False
        for file in files:
            if file.score_path not in self.readable_score_files:
                continue
            stored = read_score_file(self.folder.path / file.score_path).scores
            try:
                reproduction = compare(
                    file.entry.score.ranking_metric,
                    stored.tallies,
                    card.tallies[SUBMISSION],
                    seed=file.prediction.seed,
                    model=card.predictions_sha256,
                    of=len(stored.tallies),
                )
            except ChecksFailedError as error:
                issue = make_issue(
                    "rescored",
                    path,
                    f"{error.what}: {error.got}",
                    expected=f"a value of {error.where} in {file.score_path} too",
                )
                issues.append(issue)
                continue
            if reproduction.agrees:
                agrees_with_one = True
                confirmation = Confirmation(
                    path,
                    file.entry.yaml_path,
                    file.score_path,
                    reproduction.difference,
                    is_anew=True,
                )
                self.confirmations.append(confirmation)
                continue
            issue = make_issue(
                "rescored",
                path,
                f"{reproduction.metric} {reproduction.reproduced}",
                expected=f"{reproduction.submitted} of {file.score_path}, within "
                f"{reproduction.tolerance:.1%}",
            )
            issues.append(issue)
        # an entry and its successor may have the same name
        if not agrees_with_one:
            yield from issues

    def _files_of_method(self, header: Header) -> list[EntryFile]:
        """Return the files of entries that have the method and seed of a header."""
        files = []
        for entry in self.entries:
            is_same_data = (entry.split, entry.size, entry.dataset.sha256) == (
                header.split,
                header.size,
                header.dataset_sha256,
            )
            if not is_same_data or header.method not in (entry.method, entry.name):
                continue
            parts = zip(
                entry.predictions, entry.score_paths, entry.score.files, strict=True
            )
            for prediction, score_path, file in parts:
                if (prediction.seed or 0) == (header.seed or 0):
                    files.append(EntryFile(entry, prediction, score_path, file))
        return files

    def _compare_references(self, card: ScoreCard) -> Iterator[ValidationIssue]:
        header = card.header
        for path in self.folder.reference_files(header.split, header.size):
            if path.stem not in card.tallies or path.stem == SUBMISSION:
                continue
            # the checks of the folder report files that cannot be read
            if path not in self.readable_score_files:
                continue
            stored = read_score_file(self.folder.path / path).scores
            if stored.identity["dataset_sha256"] != header.dataset_sha256:
                continue
            differing, _ = compare_tallies(card.tallies[path.stem], stored.tallies)
            if differing:
                got = _format_names(differing)
                yield make_issue("rescored", path, got, fix=REFERENCES_ANEW)

    def _compare(
        self, path: Path, card: ScoreCard, file: EntryFile
    ) -> Iterator[ValidationIssue]:
        """Yield where a score card differs from an entry and its score file."""
        stored = read_score_file(self.folder.path / file.score_path)
        extras = _extras_of(stored)
        if extras:
            try:
                card = self.score(path, extras=extras)
            except UsageError as error:
                yield make_issue(
                    "rescored",
                    path,
                    f"{error.what}, which measures some of them",
                    expected=f"the statistics of {file.score_path}",
                )
                return
        with tempfile.TemporaryDirectory() as scratch:
            new_path = Path(scratch) / "scores.nc"
            write_statistics(card, new_path)
            new_file = scored_file(card, new_path)
            new_stored = read_score_file(new_path)

        differing, difference = compare_tallies(
            new_stored.scores.tallies, stored.scores.tallies
        )
        differing += _compare_pictures(new_stored, stored)
        if differing:
            yield make_issue(
                "rescored",
                path,
                _format_names(differing),
                expected=f"what {file.score_path} holds",
            )

        issues = list(_compare_annotations(path, card, new_file, file))
        yield from issues
        if not differing and not issues:
            self.confirmations.append(
                Confirmation(path, file.entry.yaml_path, file.score_path, difference)
            )


def _extras_of(stored: ScoreFile) -> list[str]:
    """Return the optional packages that measured statistics of a score file."""
    first_tally = next(iter(stored.scores.tallies.values()))
    extras = set()
    for name in first_tally.names:
        if name in METRICS and METRICS[name].extra is not None:
            extras.add(str(METRICS[name].extra))
    return sorted(extras)


def _compare_pictures(first: ScoreFile, second: ScoreFile) -> list[str]:
    """Return the pictures that differ by more than their packing."""
    vorticity_step = max(first.precision, second.precision)
    differing = []
    if not _is_close(
        first.preview.vorticity, second.preview.vorticity, step=vorticity_step
    ):
        differing.append("vorticity pictures")
    if not _is_close(first.preview.film, second.preview.film, step=FILM_STEP):
        differing.append("film pictures")
    if not _is_same_obstacle(first.preview.obstacle, second.preview.obstacle):
        differing.append("the obstacle of the film")
    return differing


def _is_same_obstacle(first: ArrayLike | None, second: ArrayLike | None) -> bool:
    """Say whether both films show one obstacle; older score files state none."""
    if first is None or second is None:
        return True
    return np.array_equal(np.asarray(first), np.asarray(second))


def _is_close(first: ArrayLike, second: ArrayLike, *, step: float) -> bool:
    a = np.asarray(first, np.float64)
    b = np.asarray(second, np.float64)
    if a.shape != b.shape:
        return False
    return np.allclose(
        a, b, rtol=PICTURE_TOLERANCE, atol=PICTURE_STEPS * step, equal_nan=True
    )


def _compare_annotations(
    path: Path, card: ScoreCard, new_file: ScoredFile, file: EntryFile
) -> Iterator[ValidationIssue]:
    """Yield where flags, warnings, diverged scenarios or the budget differ.

    Older entries may have a warning of a package's metric. It is not compared.
    """
    old_file = file.scored_file
    old_warnings = _flag_names(old_file.warnings)
    compared_warnings = [name for name in old_warnings if name != FAILED_METRIC]
    pairs: dict[str, tuple[object, object]] = {
        "flags": (_flag_names(new_file.flags), _flag_names(old_file.flags)),
        "warnings": (_flag_names(new_file.warnings), compared_warnings),
        "diverged_at": (
            dict(sorted(new_file.diverged_at.items())),
            dict(sorted(old_file.diverged_at.items())),
        ),
        "budget": (card.header.budget, file.prediction.budget),
    }
    for name, (new_value, old_value) in pairs.items():
        if new_value != old_value:
            yield make_issue(
                "rescored",
                path,
                f"{name} {new_value}",
                expected=f"{name} {old_value}",
            )


def _flag_names(flags: Sequence[EntryFlag]) -> list[str]:
    return sorted(flag.name for flag in flags)


def compare_tallies(
    first: Mapping[int, Tally], second: Mapping[int, Tally]
) -> tuple[list[str], float]:
    """Compare the statistics of two sets of scenarios.

    Statistics of packages that one side lacks are on no board, and not compared.

    Returns:
        Names of the statistics that differ, and the greatest relative difference of the
        others.
    """
    if _frames_of(first) != _frames_of(second):
        return ["scenarios or frames"], np.inf

    first_tally = next(iter(first.values()))
    second_tally = next(iter(second.values()))
    tolerance = RELATIVE_TOLERANCE
    if len(second_tally.frames) > LONG_ROLLOUT:
        # the last bits may have pushed a value over to the next step of its rounding
        tolerance = 2.0 ** (1 - LONG_BITS)

    differing = []
    greatest = 0.0
    names = {*first_tally.names, *second_tally.names}
    for name in sorted(names.intersection(STATISTICS)):
        difference = 0.0
        for scenario, tally in first.items():
            scenario_difference = relative_difference(tally, second[scenario], name)
            difference = max(difference, scenario_difference)
        if difference > tolerance:
            differing.append(name)
        else:
            greatest = max(greatest, difference)
    return differing, greatest


def _frames_of(tallies: Mapping[int, Tally]) -> dict[int, tuple[int, ...]]:
    frames = {}
    for scenario, tally in tallies.items():
        frames[scenario] = tuple(tally.frames)
    return frames


def relative_difference(first: Tally, second: Tally, name: str) -> float:
    """Return the greatest relative difference of a statistic in a scenario.

    Infinite where one side lacks it or has gaps at other frames.
    """
    if name not in first.names or name not in second.names:
        return np.inf
    a = first.series(name)
    b = second.series(name)
    has_same_frames = np.array_equal(first.measured(name), second.measured(name))
    if not has_same_frames or not np.array_equal(np.isnan(a), np.isnan(b)):
        return np.inf

    # score files hold single precision
    a = a.astype(np.float32).astype(np.float64)
    b = b.astype(np.float32).astype(np.float64)
    is_unequal = a != b
    unequal_a = a[is_unequal]
    unequal_b = b[is_unequal]
    distance = np.abs(unequal_a - unequal_b)
    scale = np.maximum(np.abs(unequal_a), np.abs(unequal_b))
    relative = distance / scale
    return float(np.nanmax(relative, initial=0.0))


def _format_names(names: Sequence[str]) -> str:
    text = f"other {', '.join(names[:MOST_NAMES])}"
    if len(names) > MOST_NAMES:
        return f"{text} and {len(names) - MOST_NAMES} more"
    return text
