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
from typing import Any

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

from .entry import Entry, is_current, read_entry
from .folder import Folder
from .gates import EARLY_ERROR, gates_failed_by, read_failed_gates, with_early_gate
from .ranking import CombinedScore, combine, combine_seeds
from .records import record_of
from .rows import TRIAL, Board, Curve, Row, Tab, Value
from .shift import SHIFT_SCORES, SUBSET, ShiftScores, scores_of_seeds, shift_of
from .verified import VERIFICATIONS, MeasuredCost, Verification

CURVE_FRAMES = 40
"""Most frames of a curve."""


def list_data_sets(folder: Folder, registry: Registry) -> list[tuple[str, str]]:
    """Return the (split, size) that a board shows.

    They have entries; or the package has scores of their reference predictors, and the
    board has entries of that size.
    """
    shown = list(folder.data_sets())
    sizes = {size for _, size in shown} - {TRIAL}
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
        verified=VERIFICATIONS.read(folder),
        failed_gates=read_failed_gates(folder),
        shift=SHIFT_SCORES.read(folder),
        metrics=metrics,
    )
    shown = list_data_sets(folder, known)
    tabs = []
    for split, description in known.splits.items():
        for name in description.sizes:
            size = known.size(split, name)
            active = []
            for entry in entries.get((split, name), ()):
                if is_current(entry.dataset, size):
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
    ranking = ranking_metric(size)
    references = []
    for reference in (shipped(size) or {}).values():
        if reference.name in REFERENCES and ranking in reference.scores:
            references.append(reference)
    on_shift = {}
    if SUBSET in size.subsets:
        for name, reference in (shipped(size.scored_on(SUBSET)) or {}).items():
            if name in REFERENCES and ranking in reference.scores:
                on_shift[name] = reference.scores[ranking]
    naive = _naive_among({one.name: one.scores[ranking] for one in references})
    naive_on_shift = _naive_among(on_shift)
    verifications = {
        entry.method: record_of(entry, records.verified) for entry in entries
    }
    costs = FrameCosts.of(size, [one for one in verifications.values() if one])

    def make_row(
        combined: Mapping[str, CombinedScore],
        shift_seeds: Sequence[Score],
        **keys: Any,  # noqa: ANN401 - the other fields of a row
    ) -> Row:
        """Return a row, without what follows from the other rows."""
        metrics = {}
        for name, one in combined.items():
            low, high = one.interval
            metrics[name] = Value(mean=one.score.mean, std=one.std, low=low, high=high)
        seeds = []
        for seed in combined[ranking].seeds:
            # values per frame take most of the memory
            seeds.append(replace(seed, per_frame=np.empty((len(seed.values), 0))))
        return Row(
            metrics=metrics,
            seeds=seeds,
            curve=_make_curve(combined[ranking].score),
            skill=_skill(seeds, naive),
            shift_skill=_skill(shift_seeds, naive_on_shift) if shift_seeds else None,
            **keys,
        )

    rows = []
    for entry in entries:
        names = None
        if records.metrics is not None:
            names = {*records.metrics, ranking, EARLY_ERROR}
        tallies = []
        for path in entry.score_paths:
            tallies.append(read_statistics(records.folder.path / path, size).tallies)
        combined = combine(tallies, names)
        if ranking not in combined:
            raise ChecksFailedError(
                f"{entry.yaml_path}: its score files lack {ranking}"
            )
        shift = shift_of(entry, size, records.shift)
        verified = verifications[entry.method]
        rows.append(
            make_row(
                combined,
                scores_of_seeds(shift) if shift is not None else (),
                id=entry.method,
                name=entry.name,
                kind=entry.kind,
                entry=entry,
                verified=verified,
                seconds=costs.of_entry(entry, verified),
                failed_gates=gates_failed_by(entry, records.failed_gates),
            )
        )
    for reference in references:
        combined = {}
        for name, one in reference.scores.items():
            if records.metrics is None or name in {*records.metrics, ranking}:
                combined[name] = combine_seeds([one])
        rows.append(
            make_row(
                combined,
                [on_shift[reference.name]] if reference.name in on_shift else (),
                id=reference.name,
                name=reference.name,
                kind=REFERENCES[reference.name].kind,
                entry=None,
                verified=None,
                seconds=costs.of_reference(reference),
            )
        )

    rows = with_early_gate(rows, records.failed_gates)
    rows.sort(key=lambda row: (mean_loss(row.seeds), row.id))
    tab = Tab(
        size=size,
        title=title,
        ranking=ranking,
        scenarios=tuple(sorted(size.subsets["test"])),
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


def _naive_among(scores: Mapping[str, Score]) -> dict[str, Score]:
    return {
        name: one for name, one in scores.items() if REFERENCES[name].kind is Kind.NAIVE
    }


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
    frames = size.frames if isinstance(size.frames, int) else max(size.frames)
    train = len(size.subsets.get("train", ()))
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
        budget = row.entry.budget
        if (
            row.kind.has_network
            and row.seconds is not None
            and tab.solver_seconds is not None
            and budget is not None
            and budget.cpu_hours is not None
        ):
            # of the data for it, and of its training
            generation = tab.solver_seconds * frames * train / 3600.0
            hours = generation + budget.cpu_hours + (budget.gpu_hours or 0.0)
            after = breakeven(
                speedup,
                seconds_per_frame=row.seconds,
                frames=len(frames_to_predict(size)),
                hours=hours,
            )
        rows.append(replace(row, speedup=speedup, breakeven=after))
    return rows


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
