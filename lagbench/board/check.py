"""Check a leaderboard's folder: ``lagbench leaderboard check``, for every pull request.

All issues are reported together; one bad file hides nothing of the others. Whoever
makes every hash and number anew is found by scoring the predictions again or running
the model, and by nothing else: verified.yaml names the entries for which that was done.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lagbench.data.checksums import file_sha256
from lagbench.data.registry import Registry, Size, load
from lagbench.errors import LagbenchError
from lagbench.metrics.aggregate import LONG_BITS, LONG_ROLLOUT, Tally
from lagbench.metrics.table import STATISTICS
from lagbench.references.table import REFERENCES
from lagbench.scoring.score import score
from lagbench.scoring.score_file import (
    read_statistics,
    write_statistics,
)
from lagbench.work.run import Progress

from .entry import (
    RELATIVE_TOLERANCE,
    Entry,
    find_model,
    is_current,
    read_entry,
)
from .folder import SCORES, WEIGHTS, Folder
from .gates import read_failed_gates
from .ranking import combine, summarise
from .shift import SHIFT_SCORES
from .verified import VERIFICATIONS, Level, Verification, record

MOST_WEIGHTS = 40_000_000
"""All weights of a leaderboard together [bytes]: git keeps every version for good."""


@dataclass(frozen=True, kw_only=True)
class Confirmation:
    """Predictions that, scored again, gave the scores of an entry."""

    predictions: Path
    entry: str  # path of the entry in the leaderboard's folder
    score_file: str
    difference: float  # greatest relative difference of any statistic


@dataclass(frozen=True, kw_only=True)
class CheckResult:
    """The result of all checks of a leaderboard's folder."""

    folder: Path
    entries: int  # entries that were checked
    findings: tuple[str, ...]  # what is wrong, a line each
    confirmed: tuple[Confirmation, ...] = ()
    recorded: tuple[str, ...] = ()  # entries that were added to verified.yaml

    @property
    def exit_code(self) -> int:
        """0 where nothing is wrong, else 1."""
        return 1 if self.findings else 0


def check_board(
    board: str | Path,
    *,
    registry: Registry | None = None,
    predictions: Sequence[str | Path] = (),
    recording: bool = False,
    root: str | Path | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> CheckResult:
    """Check entries, score files and weights of a leaderboard's folder.

    Args:
        board: the leaderboard's folder.
        registry: where splits are described; ours when None.
        predictions: files of predictions of entries, which are scored again.
        recording: whether to note confirmed entries in verified.yaml.
        root: folder of all data sets; else LAGBENCH_ROOT, else the user data folder.
        progress: called as the work advances.

    Raises:
        UsageError: no leaderboard.
    """
    folder = Folder(board)
    folder.require()
    known = registry or load()
    issues = [
        f"{path}: not part of a leaderboard; remove it" for path in folder.misplaced()
    ]
    entries: dict[str, Entry] = {}
    for path in folder.entries():
        try:
            entry = read_entry(folder.path / path)
            size = known.size(entry.split, entry.size)
        except LagbenchError as error:
            issues.append(str(error))
            continue
        entries[path.as_posix()] = entry
        issues += check_entry(folder, path, entry, size)
    # what no entry names, and weights beyond the size of all
    named: set[Path] = set()
    for entry in entries.values():
        named |= {*entry.score_paths, *entry.weight_paths}
    weight_files = folder.files(WEIGHTS)
    if len(entries) == len(folder.entries()):
        for path in (*folder.files(SCORES), *weight_files):
            if path not in named:
                issues.append(f"{path}: no entry names it; remove it")
    total = sum((folder.path / path).stat().st_size for path in weight_files)
    if total > MOST_WEIGHTS:
        issues.append(
            f"the weights have {total} bytes, at most {MOST_WEIGHTS} in all; name "
            "larger ones by `weights: https://...` in the entry"
        )
    issues += VERIFICATIONS.find_stale(folder, entries)
    issues += SHIFT_SCORES.find_stale(folder, entries)
    try:
        read_failed_gates(folder)
    except LagbenchError as error:
        issues.append(str(error))

    confirmed = []
    for path in map(Path, predictions):
        card = score(
            path,
            root=root,
            packages=False,
            registry=registry,
            progress=progress,
            write=False,
        )
        found = None
        for name, entry in entries.items():
            for file, score_path in zip(
                entry.score.files, entry.score_paths, strict=True
            ):
                if file.predictions_sha256 == card.predictions_sha256:
                    found = (name, score_path)
        if found is None:
            issues.append(f"{path}: no entry has these predictions")
            continue
        name, score_path = found
        stored = read_statistics(folder.path / score_path)
        with tempfile.TemporaryDirectory() as scratch:
            new_path = Path(scratch) / "scores.nc"
            write_statistics(card, new_path)
            scored = read_statistics(new_path)
        differing, difference = compare_tallies(scored.tallies, stored.tallies)
        if differing:
            issues.append(
                f"{path}: scored again, {', '.join(differing[:5])} are not those of "
                f"{score_path}"
            )
            continue
        confirmed.append(
            Confirmation(
                predictions=path,
                entry=name,
                score_file=score_path.as_posix(),
                difference=difference,
            )
        )

    def scored_again(line: Verification) -> Verification:
        if line.level is not Level.AS_SUBMITTED:
            return line
        return line.model_copy(update={"level": Level.SCORED_AGAIN})

    recorded = []
    if recording and not issues:
        files = {one.score_file for one in confirmed}
        for name, entry in entries.items():
            if files.issuperset(path.as_posix() for path in entry.score_paths):
                record(folder, entry, scored_again)
                recorded.append(name)
    return CheckResult(
        folder=folder.path,
        entries=len(folder.entries()),
        findings=tuple(issues),
        confirmed=tuple(confirmed),
        recorded=tuple(recorded),
    )


def check_entry(folder: Folder, path: Path, entry: Entry, size: Size) -> Iterator[str]:
    """Yield what is wrong with an entry, its score files and its weights."""
    if entry.yaml_path != path:
        yield f"{path}: the entry belongs to {entry.yaml_path}; move it there"
        return
    current = is_current(entry.dataset, size)
    if not current:
        yield (
            f"{path}: the data set has version {size.version}, the entry is of "
            f"{entry.dataset.version}; predict again, or remove the entry"
        )
    if entry.name in REFERENCES:
        yield f"{path}: {entry.name} is the name of a reference predictor"
    for prediction in entry.predictions:
        provenance = prediction.provenance
        if provenance is not None and {"test", "shift"} & set(provenance.subsets):
            yield f"{path}: the model was trained on scored scenarios"
        if prediction.weights is not None:
            try:
                find_model(folder, prediction.weights)
            except LagbenchError as error:
                yield str(error)

    stored = []
    for score_path, file, prediction in zip(
        entry.score_paths, entry.score.files, entry.predictions, strict=True
    ):
        whole_path = folder.path / score_path
        if not whole_path.is_file() or file_sha256(whole_path) != file.sha256:
            yield (
                f"{score_path}: not the score file that {path} names, or missing; "
                "restore it, or submit again"
            )
            continue
        try:
            scores = read_statistics(whole_path, size if current else None)
        except LagbenchError as error:
            yield str(error)
            continue
        expected = {
            "split": entry.split,
            "size": entry.size,
            "dataset_sha256": entry.dataset.sha256,
            "predictions_sha256": prediction.sha256,
        }
        found = {**scores.identity, "predictions_sha256": scores.predictions_sha256}
        for name, value in expected.items():
            if found[name] != value:
                yield f"{score_path}: {name} {ascii(found[name])[:80]}, not {value}"
        stored.append(scores)
    if len(stored) < len(entry.predictions):
        return

    first = stored[0]
    if any(one.tallies.keys() != first.tallies.keys() for one in stored):
        yield f"{path}: the score files of its seeds have other scenarios"
        return
    if entry.score.ranking_metric != first.ranking:
        yield f"{path}: ranking_metric is not {first.ranking}"
    formed = summarise(combine([scores.tallies for scores in stored]))
    for name, summary in formed.items():
        stated = entry.score.metrics.get(name)
        is_same = stated is not None
        for (_, a), (_, b) in zip(summary, stated or summary, strict=True):
            if a is None or b is None:
                is_same &= a is b
            else:
                is_same &= math.isclose(
                    a, b, rel_tol=RELATIVE_TOLERANCE, abs_tol=1e-300
                )
        if not is_same:
            yield f"{path}, score: {name} is not that of the score files; submit again"
            return


def compare_tallies(
    first: Mapping[int, Tally], second: Mapping[int, Tally]
) -> tuple[list[str], float]:
    """Compare the statistics of two sets of scenarios.

    Statistics of packages that one side lacks are on no board, and not compared.

    Returns:
        Names of the statistics that differ, and the greatest relative difference of the
        others.
    """
    if {i: tuple(tally.frames) for i, tally in first.items()} != {
        i: tuple(tally.frames) for i, tally in second.items()
    }:
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
            distance = relative_distance(tally, second[scenario], name)
            difference = max(difference, distance)
        if difference > tolerance:
            differing.append(name)
        else:
            greatest = max(greatest, difference)
    return differing, greatest


def relative_distance(first: Tally, second: Tally, name: str) -> float:
    """Return the greatest relative difference of a statistic in a scenario.

    Infinite where one side lacks it or has gaps at other frames.
    """
    if name not in first.names or name not in second.names:
        return np.inf
    a = first.series(name).astype(np.float32).astype(np.float64)
    b = second.series(name).astype(np.float32).astype(np.float64)
    has_same_frames = np.array_equal(first.measured(name), second.measured(name))
    if not has_same_frames or not np.array_equal(np.isnan(a), np.isnan(b)):
        return np.inf
    is_unequal = a != b
    scale = np.maximum(np.abs(a[is_unequal]), np.abs(b[is_unequal]))
    relative = np.abs(a[is_unequal] - b[is_unequal]) / scale
    return float(np.nanmax(relative, initial=0.0))
