"""The checks of a leaderboard's folder that need no data set and no git."""

from __future__ import annotations

import math
import stat
from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import dataclass, field
from pathlib import Path

from lagbench.data.checksums import file_sha256
from lagbench.data.hdf5 import SIGNATURE
from lagbench.data.layout import major_of
from lagbench.data.registry import Registry, Size
from lagbench.errors import (
    LagbenchError,
    UnreadableFileError,
    UsageError,
    format_count,
)
from lagbench.metrics.aggregate import Score
from lagbench.references.table import REFERENCES
from lagbench.scoring.score_file import SubmissionStatistics
from lagbench.scoring.score_file_checks import (
    MAX_SCORE_BYTES,
    ScoreFile,
    read_score_file,
)
from lagbench.submission.issues import ValidationIssue
from lagbench.submission.task_checks import VERSION

from .entry import (
    RELATIVE_TOLERANCE,
    Entry,
    EntryBudget,
    Prediction,
    Status,
    Summary,
    Verification,
)
from .entry_checks import check_diverged, check_training
from .entry_file import ENTRY_FIX, examine, load_plain
from .fields import latest_date
from .folder import GATES, VERIFIED, Folder, Place, entry_path
from .gates import read_failed_gates
from .identity import confusable_key, find_impossible_values, fingerprint_of
from .issues import issue_from_error, make_issue
from .ranking import combine, dataset_of, summarise
from .selection import is_current
from .shift import check_shift
from .verified import read_verified, verification_of
from .verified_checks import check_line
from .weights import check_weights

SHOWN_DIGITS = 16  # digits of a hash in an issue


@dataclass(frozen=True)
class ScoredEntry:
    """An entry with one of its score files."""

    entry: Entry
    score_path: Path


@dataclass(kw_only=True)
class FolderChecks:
    """Checks files one by one, then what they are to each other."""

    folder: Folder
    registry: Registry
    unreadable: Mapping[Path, str]  # files that a child process cannot read, and why
    issues: list[ValidationIssue] = field(default_factory=list)
    entries: list[Entry] = field(default_factory=list)  # entries that fit the schema
    # score files of entries and reference predictors
    readable_score_files: set[Path] = field(default_factory=set)
    # lines of verified.yaml that hold, of active entries
    verifications: list[Verification] = field(default_factory=list)
    # entries by content hash and by fingerprint of their predictions
    _scored: dict[str, list[ScoredEntry]] = field(default_factory=dict)
    # ranking metric by scenario, by score file; of entries whose files are sound
    _ranking_values: dict[Path, dict[int, float]] = field(default_factory=dict)

    def run(self) -> None:
        """Make all checks."""
        for path in self.folder.entries():
            self._guard(path, self._check_entry)
        for path in self.folder.reference_files():
            self._guard(path, self._check_reference)
        self._check_misplaced_files()
        # what belongs to an entry that cannot be read is not reported too
        readable_places = {entry.place for entry in self.entries}
        unreadable_places = self.folder.claimed_places() - readable_places
        self.issues += check_weights(
            self.folder,
            self.entries,
            unreadable_places=unreadable_places,
        )
        self._check_successors()
        self._check_duplicates()
        self._check_names()
        self._check_stray_score_files(unreadable_places)
        self._check_verified(unreadable_places)
        self._check_gates()
        self.issues += check_shift(
            self.folder,
            self.entries,
            self.registry,
            unreadable_places=unreadable_places,
        )

    def _add(
        self,
        check: str,
        where: object,
        got: object,
        *,
        what: str | None = None,
        expected: object = None,
        fix: str | None = None,
    ) -> None:
        self.issues.append(
            make_issue(check, where, got, what=what, expected=expected, fix=fix)
        )

    def _guard(self, path: Path, check: Callable[[Path], None]) -> None:
        """Check one file; an error that nobody thought of must not hide other
        issues.
        """
        try:
            check(path)
        except Exception as error:
            message = ascii(str(error)[:200])[1:-1]
            self._add("readable", path, f"{type(error).__name__}: {message}")

    def _check_entry(self, path: Path) -> None:
        """Check the YAML file of an entry and its score files."""
        try:
            content = load_plain(self.folder.path / path, fix=ENTRY_FIX)
            entry, schema_issues = examine(Entry, content)
        except UnreadableFileError as error:
            self.issues.append(issue_from_error("readable", error, path))
            return
        for issue in schema_issues:
            where = f"{path}, {issue.where}"
            self._add("schema", where, issue.got, what=issue.what, fix=issue.fix)
        if entry is None:
            return
        try:
            size = self.registry.size(entry.split, entry.size)
        except UsageError as error:
            self._add("split", path, f"{entry.split} {entry.size}", fix=error.fix)
            return

        self.entries.append(entry)
        if entry.yaml_path != path:
            self._add("place", path, path, expected=entry.yaml_path)
        self._check_version(path, entry, size)
        latest = latest_date()
        if entry.date > latest:
            self._add("date", path, entry.date, expected=f"at most {latest}")
        self._check_predictions(path, entry)
        self.issues += check_training(entry)
        self._check_budget(path, entry)
        self._check_scores(path, entry, size)

    def _check_version(self, path: Path, entry: Entry, size: Size) -> None:
        dataset = entry.dataset
        if entry.status is not Status.ACTIVE or is_current(dataset, size):
            return
        recorded = "no recorded hash"
        if size.measured:
            recorded = size.measured.dataset_sha256[:SHOWN_DIGITS]
        self._add(
            "version",
            path,
            f"version {dataset.version}, {dataset.sha256[:SHOWN_DIGITS]}",
            expected=f"version {size.version}, {recorded}",
        )

    def _check_predictions(self, path: Path, entry: Entry) -> None:
        """Check the predictions that lie in the folder."""
        for number, prediction in enumerate(entry.predictions):
            if prediction.path is None:
                continue
            length = self._describe_length(Path(prediction.path))
            if length == prediction.bytes:
                continue
            expected = f"{prediction.path}, a file of {prediction.bytes} bytes"
            if prediction.bytes is None:
                expected = f"{prediction.path}, and its length in bytes"
            self._add(
                "predictions",
                f"{path}, predictions.{number}",
                length,
                expected=expected,
            )

    def _describe_length(self, path: Path) -> str | int:
        """Return the length of a file in the folder [bytes], or why it has none."""
        if self.folder.link_in(path) is not None:
            return "a symbolic link"
        try:
            status = (self.folder.path / path).lstat()
        except OSError:
            return "no such file"
        if not stat.S_ISREG(status.st_mode):
            return "something that is no regular file"
        try:
            with (self.folder.path / path).open("rb") as stream:
                signature = stream.read(len(SIGNATURE))
        except OSError:
            return "a file that cannot be read"
        if signature != SIGNATURE:
            return "something that is no netCDF file"
        return status.st_size

    def _check_budget(self, path: Path, entry: Entry) -> None:
        budgets = [prediction.budget for prediction in entry.predictions]
        mean_budget = EntryBudget.mean_over_seeds(entry.size, budgets)
        if mean_budget is not None:
            if entry.budget != mean_budget:
                where = f"{path}, budget"
                self._add("budget", where, entry.budget, expected=mean_budget)
        elif entry.budget is not None and entry.budget.track is not None:
            self._add("budget", f"{path}, budget.track", entry.budget.track)

    def _check_scores(self, path: Path, entry: Entry, size: Size) -> None:
        """Check the score files of an entry, and its score block against them."""
        task = None
        if is_current(entry.dataset, size):
            task = size
        sound_scores = []
        files = zip(
            entry.score_paths, entry.score.files, entry.predictions, strict=True
        )
        for score_path, file, prediction in files:
            stored = self._read_score_file(score_path, file.sha256, task)
            if stored is None:
                continue
            self._check_identity(score_path, stored.scores, entry, prediction)
            self.issues += check_diverged(
                file, stored.scores, f"{path}, score.files, diverged_at"
            )
            impossible_values = list(find_impossible_values(stored))
            if impossible_values:
                got = impossible_values[0]
                if len(impossible_values) > 1:
                    got += f" and {len(impossible_values) - 1} more"
                self._add("values", score_path, got)
            else:
                sound_scores.append(stored.scores)
            for identity in (prediction.sha256, fingerprint_of(stored.scores.tallies)):
                scored_entry = ScoredEntry(entry, score_path)
                self._scored.setdefault(identity, []).append(scored_entry)

        if entry.score.dataset_sha256 != entry.dataset.sha256:
            self._add(
                "score",
                f"{path}, score",
                entry.score.dataset_sha256,
                expected=entry.dataset.sha256,
            )
        if len(sound_scores) == len(entry.predictions):
            self._check_score_block(path, entry, sound_scores)

    def _read_score_file(
        self, path: Path, sha256: str, task: Size | None
    ) -> ScoreFile | None:
        """Return a score file; None, and an issue, where it cannot be one."""
        file = self.folder.path / path
        if not file.is_file() or self.folder.link_in(path) is not None:
            self._add("missing", path, "no such file")
            return None
        length = file.stat().st_size
        if length > MAX_SCORE_BYTES:
            self._add("oversize", path, f"{length} bytes")
            return None
        found_sha256 = file_sha256(file)
        if found_sha256 != sha256:
            self._add(
                "score_file",
                path,
                f"SHA-256 {found_sha256[:SHOWN_DIGITS]}, not {sha256[:SHOWN_DIGITS]} "
                "as the entry says",
            )
            return None
        if file in self.unreadable:
            self._add("score_file", path, self.unreadable[file])
            return None
        try:
            stored = read_score_file(file, task)
        except UnreadableFileError as error:
            self._add("score_file", path, f"{error.what}: {error.got}")
            return None
        self.readable_score_files.add(path)
        return stored

    def _check_identity(
        self,
        path: Path,
        scores: SubmissionStatistics,
        entry: Entry,
        prediction: Prediction,
    ) -> None:
        """Check that a score file belongs to the entry's data set and predictions.

        Seeds that came later may have a newer minor version of the same data.
        """
        expected = {
            "split": entry.split,
            "size": entry.size,
            "dataset_sha256": entry.dataset.sha256,
            "predictions_sha256": prediction.sha256,
        }
        identity = {
            **scores.identity,
            "predictions_sha256": scores.predictions_sha256,
        }
        for name, value in expected.items():
            if identity[name] != value:
                got = ascii(identity[name])[:80]
                self._add("score_file", path, f"{name} {got}, not {value!a}")

        version = identity["dataset_version"]
        major = major_of(entry.dataset.version)
        if VERSION.fullmatch(version) is None or major_of(version) != major:
            got = ascii(version)[:80]
            self._add("score_file", path, f"dataset_version {got}, not {major}.x.y")

    def _check_score_block(
        self, path: Path, entry: Entry, scores: Sequence[SubmissionStatistics]
    ) -> None:
        """Compare the score block with the scores that the score files give."""
        # only seeds of the same scenarios and frames have a mean
        first_extent = _extent_of(scores[0])
        has_same_extent = True
        for score_path, stored in zip(entry.score_paths, scores, strict=True):
            if _extent_of(stored) != first_extent:
                has_same_extent = False
                self._add(
                    "score_file",
                    score_path,
                    "other scenarios, frames or ranking metric than the first seed has",
                )
        if not has_same_extent:
            return

        where = f"{path}, score"
        ranking = scores[0].ranking
        if entry.score.ranking_metric != ranking:
            self._add(
                "score",
                where,
                entry.score.ranking_metric,
                expected=f"ranking_metric {ranking}",
            )
        combined = combine([stored.tallies for stored in scores])
        if ranking in combined:
            self._keep_ranking_values(entry, combined[ranking].seeds)
        formed = summarise(combined)
        stated = entry.score.metrics
        differing = []
        for name in {**formed, **stated}:
            if not _is_same_summary(formed.get(name), stated.get(name)):
                differing.append(name)
        if differing:
            name = differing[0]
            got = _format_summary(stated.get(name))
            if len(differing) > 1:
                others = format_count(len(differing) - 1, "other metric")
                got += f"; and {others}"
            expected = f"{name}: {_format_summary(formed.get(name))}"
            self._add("score", where, got, expected=expected)

    def _keep_ranking_values(self, entry: Entry, seeds: Sequence[Score]) -> None:
        """Keep the ranking metric of each seed, for the lines of verified.yaml."""
        for score_path, score in zip(entry.score_paths, seeds, strict=True):
            values = zip(score.scenarios, score.values.tolist(), strict=True)
            self._ranking_values[score_path] = dict(values)

    def _check_reference(self, path: Path) -> None:
        """Check the scores of a reference predictor."""
        file = self.folder.path / path
        try:
            size = self.registry.size(*path.parts[1:3])
            if path.stem not in REFERENCES or file in self.unreadable:
                got = self.unreadable.get(file, "an unknown name")
                self._add("reference", path, got, expected=", ".join(REFERENCES))
                return
            identity = read_score_file(file, size).scores.identity
            self.readable_score_files.add(path)
        except LagbenchError as error:
            self.issues.append(issue_from_error("reference", error, path))
            return
        if not is_current(dataset_of(identity), size):
            self._add(
                "reference",
                path,
                identity["dataset_sha256"],
                what="scores on another data set",
            )

    def _check_misplaced_files(self) -> None:
        """Report links, irregular files, and files that no rule and no entry names."""
        named_paths = []
        for entry in self.entries:
            for prediction in entry.predictions:
                if prediction.path is not None:
                    named_paths.append(Path(prediction.path))
        for path, reason in self.folder.find_misplaced(named_paths):
            self._add("folder", ascii(path.as_posix())[1:-1], reason)

    def _check_successors(self) -> None:
        """Check that successors are there, and that no line of them is a circle."""
        successor_of: dict[Place, Place] = {}
        for entry in self.entries:
            if entry.superseded_by is not None:
                successor_of[entry.place] = (
                    entry.split,
                    entry.size,
                    entry.superseded_by,
                )
        for place, successor in successor_of.items():
            line = [successor]
            while line[-1] in successor_of and successor_of[line[-1]] not in line:
                line.append(successor_of[line[-1]])
            if not (self.folder.path / entry_path(successor)).is_file():
                got = f"{successor[2]}, which is not there"
                self._add("lifecycle", entry_path(place), got)
            elif place in line:
                got = " -> ".join(method for _, _, method in line)
                self._add("lifecycle", entry_path(place), got)

    def _check_duplicates(self) -> None:
        """Check that the same predictions stand under one name and seed only."""
        reported = set()
        for scored_entries in self._scored.values():
            paths: list[Path] = []
            for scored in scored_entries:
                is_active = scored.entry.status is Status.ACTIVE
                if is_active and scored.score_path not in paths:
                    paths.append(scored.score_path)
            first_paths: dict[tuple[str, ...], Path] = {}  # by data set
            for path in paths:
                # the parts of a path are scores, split, size and file
                first_path = first_paths.setdefault(path.parts[1:3], path)
                if path != first_path and path not in reported:
                    reported.add(path)
                    self._add("duplicate", path, f"those of {first_path}")

    def _check_names(self) -> None:
        """Check that no two names of active entries look alike."""
        reference_keys = {}
        for name in REFERENCES:
            reference_keys[confusable_key(name)] = name
        entries_by_key: dict[tuple[str, str, str], Entry] = {}
        for entry in self.entries:
            if entry.status is not Status.ACTIVE:
                continue
            key = confusable_key(entry.name)
            if key in reference_keys:
                owner = f"that of the reference predictor {reference_keys[key]}"
                self._add("name", entry.yaml_path, owner)
                continue
            first = entries_by_key.setdefault((entry.split, entry.size, key), entry)
            if first is not entry:
                owner = f"that of {first.method}, {first.name!a}"
                self._add("name", entry.yaml_path, owner)

    def _check_stray_score_files(self, unreadable_places: Set[Place]) -> None:
        """Check that every score file has an entry."""
        named_paths: set[Path] = set()
        for entry in self.entries:
            named_paths.update(entry.score_paths)
        for path in self.folder.score_files():
            method = path.stem.partition("_")[0]
            place = (path.parts[1], path.parts[2], method)
            if path not in named_paths and place not in unreadable_places:
                self._add("stray", path, "none")

    def _check_verified(self, unreadable_places: Set[Place]) -> None:
        """Check that every line of verified.yaml has an entry with its scores."""
        try:
            verified = read_verified(self.folder)
        except LagbenchError as error:
            self.issues.append(issue_from_error("verified", error, VERIFIED))
            return
        names = {entry_path(place).as_posix() for place in unreadable_places}
        for entry in self.entries:
            line = verification_of(entry, verified)
            if line is not None:
                names.add(entry.yaml_path.as_posix())
                if entry.status is Status.ACTIVE:
                    self.verifications.append(line)
                size = self.registry.size(entry.split, entry.size)
                self.issues += check_line(
                    line,
                    entry,
                    size,
                    ranking_values=self._ranking_values,
                )
        for name in sorted(verified.keys() - names):
            self._add("verified", VERIFIED, ascii(name)[:120])

    def _check_gates(self) -> None:
        """Check that gates.json can be read, if there is one."""
        try:
            read_failed_gates(self.folder)
        except LagbenchError as error:
            self.issues.append(issue_from_error("gates", error, GATES))


def _extent_of(scores: SubmissionStatistics) -> tuple[list[int], tuple[int, ...], str]:
    """Return scenarios, frames and ranking metric."""
    first_tally = next(iter(scores.tallies.values()))
    return sorted(scores.tallies), first_tally.frames, scores.ranking


def _is_same_summary(first: Summary | None, second: Summary | None) -> bool:
    """Tell whether two summaries of a metric agree; False where one is missing."""
    if first is None or second is None:
        return False
    for (_, a), (_, b) in zip(first, second, strict=True):
        if a is None or b is None:
            if a is not b:
                return False
        elif not math.isclose(a, b, rel_tol=RELATIVE_TOLERANCE, abs_tol=1e-300):
            return False
    return True


def _format_summary(summary: Summary | None) -> str:
    if summary is None:
        return "no such metric"
    return ", ".join(f"{key} {value}" for key, value in summary)
