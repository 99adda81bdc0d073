"""Read the rows of a leaderboard from entries, score files and records.

Every number is formed anew; the scores in the YAML files are not used, and
``lagbench leaderboard check`` compares them.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lagbench.data.registry import Registry, Size, load
from lagbench.errors import ChecksFailedError, DataError, UsageError
from lagbench.metrics.aggregate import Score
from lagbench.metrics.significance import mean_loss, rank_ranges, standings
from lagbench.metrics.table import ranking_metric
from lagbench.references.predictor import Kind
from lagbench.references.shipped import ReferenceScores, shipped, solver_seconds
from lagbench.references.table import REFERENCES
from lagbench.scoring.front import (
    NoSpeedup,
    breakeven,
    compute_speedup,
    seconds_where_measured,
)
from lagbench.scoring.score_file import read_statistics
from lagbench.scoring.skill import compute_skill
from lagbench.submission.truth import frames_to_predict

from .entry import Entry, Status, data_set_of, is_current, read_entry
from .folder import Folder
from .gates import EARLY_ERROR, gates_failed_by, read_failed_gates, with_early_gate
from .ranking import combine
from .rows import TRIAL, Board, Curve, Row, Tab, Value
from .shift import SUBSET, ShiftScores, read_shift, scores_of_seeds, shift_of
from .verified import MeasuredCost, Verification, read_verified, verification_of

CURVE_FRAMES = 40
"""Most frames of a curve."""


def list_data_sets(folder: Folder, registry: Registry) -> list[tuple[str, str]]:
    """Return the (split, size) that a board shows.

    They have entries; or the package has scores of their reference predictors, and the
    board has entries of that size.
    """
    with_entries = folder.data_sets()
    sizes = {size for _, size in with_entries} - {TRIAL}
    shown = list(with_entries)
    for split, description in registry.splits.items():
        for size in description.sizes:
            is_new = size in sizes and (split, size) not in shown
            if is_new and shipped(registry.size(split, size)):
                shown.append((split, size))
    return shown


def collect(
    board: str | Path,
    *,
    only: Collection[tuple[str, str]] | None = None,
    registry: Registry | None = None,
    metrics: Collection[str] | None = None,
) -> Board:
    """Return the content of a leaderboard's folder.

    Entries of other versions of the data are left out. Data sets without entries have
    their reference predictors, at the sizes of which the board has any entry.

    Args:
        board: the leaderboard's folder.
        only: (split, size) to read; all of them when None.
        registry: where splits are described; ours when None.
        metrics: metrics to form beside the ranking one; all of them when None.

    Raises:
        UsageError: no leaderboard.
        UnreadableFileError: an entry or a score file cannot be read.
        ChecksFailedError: an entry does not fit the schema or its place.
        DataError: an entry is of a split that is not known.
    """
    folder = Folder(board)
    folder.require()
    known = registry or load()
    entries: dict[tuple[str, str], list[Entry]] = {}
    for path in folder.entries():
        data_set = (path.parts[1], path.parts[2])
        if only is not None and data_set not in only:
            continue
        entry = read_entry(folder.path / path)
        if entry.yaml_path != path:
            raise ChecksFailedError(f"{path}: the entry belongs to {entry.yaml_path}")
        entries.setdefault(data_set, []).append(entry)
    for data_set in entries:
        try:
            known.size(*data_set)
        except UsageError as error:
            raise DataError(f"{folder.path}: {error}") from error

    records = BoardRecords(
        folder=folder,
        verified=read_verified(folder),
        failed_gates=read_failed_gates(folder),
        shift=read_shift(folder),
        metrics=metrics,
    )
    shown = list_data_sets(folder, known)
    tabs = []
    for split, description in known.splits.items():
        for name in description.sizes:
            size = known.size(split, name)
            active = []
            for entry in entries.get((split, name), ()):
                if entry.status is Status.ACTIVE and is_current(entry.dataset, size):
                    active.append(entry)
            is_wanted = only is None or (split, name) in only
            if active or (is_wanted and (split, name) in shown):
                tabs.append(_make_tab(records, size, description.title, active))
    return Board(tabs=tuple(tabs))


@dataclass(frozen=True, kw_only=True)
class BoardRecords:
    """What a board holds beside its entries, and which metrics are needed."""

    folder: Folder
    verified: Mapping[str, Verification]
    failed_gates: Mapping[str, tuple[str, ...]]
    shift: Mapping[str, ShiftScores]
    metrics: Collection[str] | None


def _make_tab(
    records: BoardRecords, size: Size, title: str, entries: Sequence[Entry]
) -> Tab:
    scenarios = tuple(sorted(size.subsets["test"]))
    ranking = ranking_metric(size)
    references = _read_references(records.folder, size)
    scores = {}
    for reference in references:
        if ranking in reference.scores:
            scores[reference.name] = reference.scores[ranking]
    naive = _naive_among(scores)
    on_shift = {}
    if SUBSET in size.subsets:
        for name, reference in (shipped(size.scored_on(SUBSET)) or {}).items():
            if name in REFERENCES and ranking in reference.scores:
                on_shift[name] = reference.scores[ranking]

    verifications = {}
    for entry in entries:
        verifications[entry.method] = verification_of(entry, records.verified)
    costs = FrameCosts.of(
        size, [one for one in verifications.values() if one is not None]
    )

    rows = []
    for entry in entries:
        row = _read_row(
            records,
            entry,
            size,
            verified=verifications[entry.method],
            costs=costs,
            naive=naive,
            on_shift=on_shift,
        )
        rows.append(row)
    for reference in references:
        if ranking in reference.scores:
            row = _reference_row(
                records,
                reference,
                ranking,
                costs=costs,
                naive=naive,
                on_shift=on_shift,
            )
            rows.append(row)

    rows = with_early_gate(rows, records.failed_gates)
    rows.sort(key=lambda row: (mean_loss(row.seeds), row.id))
    tab = Tab(
        size=size,
        title=title,
        ranking=ranking,
        scenarios=scenarios,
        rows=tuple(rows),
        solver_seconds=costs.solver,
    )
    return replace(tab, rows=_rank(_with_speedups(tab), tab.truth_error))


@dataclass(frozen=True, kw_only=True)
class FrameCosts:
    """Times of a frame on one machine: those of one run, or the shipped ones."""

    run: MeasuredCost | None  # the run with the most entries
    solver: float | None  # of the solver that made the data [s]
    shipped_solver: float | None  # where the references were timed [s]

    @classmethod
    def of(cls, size: Size, verifications: Sequence[Verification]) -> FrameCosts:
        """Return the times of a data set from the records of its entries."""
        runs: list[list[MeasuredCost]] = []
        for verification in verifications:
            cost = verification.cost
            if cost is None or cost.solver is None:
                continue
            for run in runs:
                if cost.is_of_same_run(run[0]):
                    run.append(cost)
                    break
            else:
                runs.append([cost])
        shipped_solver = solver_seconds(size)
        if not runs:
            return cls(run=None, solver=shipped_solver, shipped_solver=shipped_solver)
        largest = max(runs, key=len)[0]
        return cls(run=largest, solver=largest.solver, shipped_solver=shipped_solver)

    def of_entry(self, entry: Entry, verified: Verification | None) -> float | None:
        """Return the time of a frame of an entry [s]."""
        seconds = solver = None
        if verified is not None and verified.cost is not None:
            if self.run is not None and verified.cost.is_of_same_run(self.run):
                return verified.cost.seconds_per_frame
            seconds = verified.cost.seconds_per_frame
            solver = verified.cost.solver
        elif entry.cost is not None:
            seconds = entry.cost.seconds_per_frame
            solver = entry.cost.solver_seconds_per_frame
        return seconds_where_measured(
            seconds_per_frame=seconds,
            solver_seconds=solver,
            solver_seconds_here=self.solver,
        )

    def of_reference(self, reference: ReferenceScores) -> float | None:
        """Return the time of a frame of a reference predictor [s]."""
        if self.run is not None:
            seconds = {**self.run.classical, **self.run.naive}.get(reference.name)
            if seconds is not None:
                return seconds
        if math.isnan(reference.seconds_per_frame):
            return None
        if self.run is None:
            return reference.seconds_per_frame
        return seconds_where_measured(
            seconds_per_frame=reference.seconds_per_frame,
            solver_seconds=self.shipped_solver,
            solver_seconds_here=self.solver,
        )


def _read_row(
    records: BoardRecords,
    entry: Entry,
    size: Size,
    *,
    verified: Verification | None,
    costs: FrameCosts,
    naive: Mapping[str, Score],
    on_shift: Mapping[str, Score],
) -> Row:
    """Return the row of an entry, without what follows from the other rows."""
    ranking = ranking_metric(size)
    names = None
    if records.metrics is not None:
        names = {*records.metrics, ranking, EARLY_ERROR}
    stored = []
    for path in entry.score_paths:
        stored.append(read_statistics(records.folder.path / path, size))
    combined = combine([scores.tallies for scores in stored], names)
    if ranking not in combined:
        raise ChecksFailedError(f"{entry.yaml_path}: its score files lack {ranking}")
    metrics = {}
    for name, one in combined.items():
        low, high = one.interval
        metrics[name] = Value(mean=one.score.mean, std=one.std, low=low, high=high)
    seeds = [_without_frames(seed) for seed in combined[ranking].seeds]

    shift_score = shift_skill = None
    shift_scores = shift_of(entry, size, records.shift)
    if shift_scores is not None:
        seeds_on_shift = scores_of_seeds(shift_scores)
        shift_score = mean_loss(seeds_on_shift)
        shift_skill = _skill(seeds_on_shift, _naive_among(on_shift))
    return Row(
        id=entry.method,
        name=entry.name,
        kind=entry.kind,
        entry=entry,
        verified=verified,
        metrics=metrics,
        seeds=seeds,
        curve=_make_curve(combined[ranking].score),
        seconds=costs.of_entry(entry, verified),
        skill=_skill(seeds, naive),
        shift_score=shift_score,
        shift_skill=shift_skill,
        failed_gates=gates_failed_by(entry, records.failed_gates),
    )


def _reference_row(
    records: BoardRecords,
    reference: ReferenceScores,
    ranking: str,
    *,
    costs: FrameCosts,
    naive: Mapping[str, Score],
    on_shift: Mapping[str, Score],
) -> Row:
    """Return the row of a reference predictor."""
    metrics = {}
    for name, score in reference.scores.items():
        if records.metrics is None or name in records.metrics or name == ranking:
            low, high = score.interval
            metrics[name] = Value(mean=score.mean, low=low, high=high)
    seeds = [_without_frames(reference.scores[ranking])]
    shift_score = shift_skill = None
    if reference.name in on_shift:
        seed_on_shift = on_shift[reference.name]
        shift_score = seed_on_shift.mean
        shift_skill = _skill([seed_on_shift], _naive_among(on_shift))
    return Row(
        id=reference.name,
        name=reference.name,
        kind=REFERENCES[reference.name].kind,
        entry=None,
        verified=None,
        metrics=metrics,
        seeds=seeds,
        curve=_make_curve(reference.scores[ranking]),
        seconds=costs.of_reference(reference),
        skill=_skill(seeds, naive),
        shift_score=shift_score,
        shift_skill=shift_skill,
    )


def _naive_among(scores: Mapping[str, Score]) -> dict[str, Score]:
    """Return the scores of the naive baselines."""
    naive = {}
    for name, score in scores.items():
        if REFERENCES[name].kind is Kind.NAIVE:
            naive[name] = score
    return naive


def _without_frames(score: Score) -> Score:
    """Return a score without its values per frame, which take most of the memory."""
    return replace(score, per_frame=np.empty((len(score.values), 0)))


def _skill(seeds: Sequence[Score], naive: Mapping[str, Score]) -> Value | None:
    skill = compute_skill(seeds, naive)
    if skill is None:
        return None
    low, high = skill.interval
    return Value(mean=skill.value, std=skill.std, low=low, high=high)


def _make_curve(score: Score) -> Curve | None:
    """Return the mean of a metric over scenarios per frame; frames without are out."""
    if not score.metric.per_frame or not score.frames:
        return None
    with warnings.catch_warnings():
        # a frame where nothing is defined is NaN
        warnings.simplefilter("ignore", RuntimeWarning)
        values = np.nanmean(score.per_frame, axis=0)
    measured = np.flatnonzero(np.isfinite(values))
    if not len(measured):
        return None
    spread = np.linspace(0, len(measured) - 1, min(len(measured), CURVE_FRAMES))
    chosen = measured[np.rint(spread).astype(int)]
    frames = tuple(score.frames[i] for i in chosen.tolist())
    return Curve(frames=frames, mean=values[chosen])


def _with_speedups(tab: Tab) -> list[Row]:
    """Return the rows of a tab with speedup and break-even of the models."""
    size = tab.size
    front_rows = tab.front_rows
    rows = []
    for row, front in zip(tab.rows, front_rows, strict=True):
        if row.entry is None:
            rows.append(row)
            continue
        speedup = compute_speedup(front, front_rows)
        if isinstance(speedup, NoSpeedup):
            rows.append(replace(row, why_no_speedup=speedup))
            continue
        after = None
        hours = _hours(row.entry, size, tab.solver_seconds)
        if hours is not None and row.seconds is not None and row.kind.has_network:
            after = breakeven(
                speedup,
                seconds_per_frame=row.seconds,
                frames=len(frames_to_predict(size)),
                hours=hours,
            )
        rows.append(replace(row, speedup=speedup, breakeven=after))
    return rows


def _hours(entry: Entry, size: Size, solver: float | None) -> float | None:
    """Return the processor time to generate train and to train once [h].

    None where one of them is not known.
    """
    budget = entry.budget
    if budget is None or budget.cpu_hours is None or solver is None:
        return None
    frames = size.frames
    if not isinstance(frames, int):
        frames = max(frames)
    generation = solver * frames * len(size.subsets.get("train", ())) / 3600.0
    return generation + budget.cpu_hours + (budget.gpu_hours or 0.0)


def _rank(rows: Sequence[Row], truth_error: float | None) -> tuple[Row, ...]:
    """Return the rows with the ranks of the entries.

    A rank is one more than the number of entries that are better by more than the truth
    error.
    """
    entries = [row for row in rows if row.entry is not None]
    places = standings({row.id: row.seeds for row in entries})
    losses = {}
    for row in entries:
        losses[row.id] = [np.stack([seed.values for seed in row.seeds])]
    ranges = rank_ranges(losses)
    margin = truth_error or 0.0
    ranked = []
    for row in rows:
        if row.entry is None:
            ranked.append(row)
            continue
        loss = mean_loss(row.seeds)
        better = 0
        for other in entries:
            better += other is not row and mean_loss(other.seeds) < loss - margin
        place = places[row.id]
        ranked.append(
            replace(
                row,
                rank=1 + better,
                rank_range=ranges.get(row.id),
                tied=place.tied and not math.isnan(place.p),
            )
        )
    return tuple(ranked)


def _read_references(folder: Folder, size: Size) -> tuple[ReferenceScores, ...]:
    """Return the reference predictors of a split and size.

    The package ships their scores on our splits. On other splits the scorer measures
    them beside a submission, and ``submit`` keeps them in the folder. Scores on another
    data set are left out, and so are scores of a predictor that is no longer there.
    """
    shipped_scores = shipped(size)
    if shipped_scores:
        known_references = []
        for reference in shipped_scores.values():
            if reference.name in REFERENCES:
                known_references.append(reference)
        return tuple(known_references)

    references = []
    for path in folder.reference_files(size.split, size.name):
        file = folder.path / path
        stored = read_statistics(file)
        is_known = path.stem in REFERENCES
        if not is_known or not is_current(data_set_of(stored.identity), size):
            continue
        read_statistics(file, size)  # refuses scores that do not fit the task
        combined = combine([stored.tallies])
        scores = {}
        for name, combined_score in combined.items():
            scores[name] = combined_score.score
        references.append(
            ReferenceScores(
                name=path.stem,
                scores=scores,
                seconds_per_frame=math.nan,
                correlation=np.empty(0),
            )
        )
    return tuple(references)
