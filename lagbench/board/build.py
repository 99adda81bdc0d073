"""Build the leaderboard from entries and score files.

Every number is formed anew, then the page is written. The scores in the YAML files are
not used; ``lagbench leaderboard check`` compares them.
"""

from __future__ import annotations

import math
import os
import shlex
import warnings
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lagbench.addresses import DOCUMENTATION
from lagbench.atomic import write_atomically
from lagbench.data.box import Box
from lagbench.data.registry import Registry, Size, load
from lagbench.errors import (
    ChecksFailedError,
    DataError,
    UnreadableFileError,
    UsageError,
)
from lagbench.figures.solid import View
from lagbench.metrics.aggregate import Score, interval_in_range
from lagbench.metrics.metric import mean, mean_of_rows
from lagbench.metrics.significance import (
    FEWEST_SCENARIOS,
    Standing,
    mean_loss,
    rank_ranges,
    standings,
)
from lagbench.metrics.table import METRICS
from lagbench.references.shipped import ReferenceScores, shipped, solver_seconds
from lagbench.references.table import CLASSICAL, NAIVE, REFERENCES
from lagbench.scoring.boards import advise_board_check
from lagbench.scoring.front import seconds_where_measured
from lagbench.scoring.scenario import Preview, spaced
from lagbench.scoring.score_file_checks import (
    ScoreFile,
    read_score_file,
    reported_frames,
)
from lagbench.scoring.skill import (
    AgainstClassical,
    Skill,
    compute_against_classical,
    compute_skill,
)
from lagbench.submission.task_checks import frames_to_predict
from lagbench.work.machine import available_cores
from lagbench.work.pool import Report
from lagbench.work.run import run_all

from .columns import PRESETS
from .entry import Entry, EntryCost, MeasuredCost, Status, Verification
from .entry_file import read_entry, schema_bytes
from .folder import PAGE, SCHEMA, Folder
from .gates import gates_failed_by, read_failed_gates
from .identity import find_impossible_values
from .issues import CHECKS
from .model import (
    Board,
    BoardRow,
    Curve,
    Floats,
    Histogram,
    OnShift,
    Pictures,
    ReferenceRow,
    Tab,
    Value,
)
from .page import links_in, links_to, render, same_page
from .ranking import CombinedScore, combine, read_references
from .sampling import coarsen
from .selection import is_current
from .shift import (
    SUBSET,
    ShiftScores,
    read_shift,
    scores_of_seeds,
    shift_of,
)
from .variants import find_variants
from .verified import read_verified, verification_of

COLUMNS = (
    "vorticity_nrmse",
    "motion_distance",
    "cloud_distance",
    "vorticity_rmse",
    "mse_avg",
    "vorticity_pearson",
    "stable_frames",
    "position_rmse_20",
    "position_rmse",
    "spectrum_error",
    "velocity_rmse",
    "density_rmse",
    "momentum_error",
    "shape_error",
    "connectivity",
    "sliced_w2",
)
"""Metrics to show at first where a data set has them, the ranking one aside."""

CURVES = (
    "vorticity_rmse",
    "attribute_mse",
    "position_rmse",
    "vorticity_pearson",
    "energy_ratio",
    "density_rmse",
    "divergence_rms",
)
"""Metrics that details have curves of, beside the ranking one."""

AT_FRAMES = frozenset((*COLUMNS, *CURVES))
"""Metrics with values at the frames of interest."""

TRIAL = "tiny"  # the size for trying out: nobody is asked to submit to it

TRUE_ENERGY = "energy_true"
PREDICTED_ENERGY = "energy_predicted"

TRUTH = 0  # sides of a preview
PREDICTION = 1

CURVE_FRAMES = 60  # most frames of a curve
MAP_FRAMES = 4  # most frames of vorticity maps and histograms
MAP_NODES = 20  # most nodes of a map, a side
RESIDUAL_BINS = 41  # bins of the histogram of residuals; odd, so that one holds 0

FEWEST_FOR_WORKERS = 40
"""Entries from which on tabs are formed in worker processes: a worker takes a second to
start, an entry a tenth to form.
"""

MOST_WORKERS = 8
"""Most of these processes, each of which takes some 150 MB of memory."""

PICTURED_METHODS = 80
"""Most methods on all tabs together that have maps, histograms and a film: two thirds
of a page of 150 entries would be theirs.
"""


@dataclass(frozen=True, kw_only=True, eq=False)
class ScoredMethod:
    """What a row is made of: an entry, and what was formed from its score files.

    The statistics themselves are let go: those of 100 entries would take gigabytes.
    """

    entry: Entry
    is_current: bool
    ranking: str  # name of the ranking metric
    seeds: Sequence[Score]  # ranking metric of each seed, without values per frame
    values: Mapping[str, Value]
    curves: Mapping[str, Curve]
    energy: Curve  # predicted kinetic energy
    pictures: Pictures | None  # of the first seed
    residuals: tuple[Histogram, ...]

    @property
    def method(self) -> str:
        """Id of the method."""
        return self.entry.method

    @property
    def losses(self) -> Floats:
        """Ranking metric, shape [seed, scenario]."""
        return np.stack([seed.values for seed in self.seeds])

    @property
    def is_ranked(self) -> bool:
        """Whether it may take part in the ranking."""
        return self.entry.status is Status.ACTIVE and self.is_current


@dataclass(frozen=True, kw_only=True, eq=False)
class PicturedTruth:
    """The truth as a score file pictures it."""

    precision: float  # step of the packed vorticity maps [1/frame]
    method: str
    energy: Curve  # true kinetic energy
    pictures: Pictures | None

    @property
    def order(self) -> tuple[float, str]:
        """The finest packing comes first."""
        return self.precision, self.method


@dataclass(frozen=True, kw_only=True)
class Scope:
    """How much of the score files a board needs: the less, the faster it is formed."""

    metrics: Collection[str] | None = None  # beside the ranking one; None: all
    intervals: Collection[str] | None = None  # metrics with 95 % intervals; None: all
    has_pictures: bool = True  # whether curves, maps and films are needed

    def includes(self, metric: str) -> bool:
        """Tell whether a metric is needed."""
        return self.metrics is None or metric in self.metrics

    def has_interval(self, metric: str) -> bool:
        """Tell whether the interval of a metric is needed."""
        return self.intervals is None or metric in self.intervals


EVERYTHING = Scope()

PAGE_SCOPE = Scope(
    metrics=frozenset((*COLUMNS, *CURVES, *chain.from_iterable(PRESETS.values()))),
    intervals=COLUMNS,
)
"""What the page shows."""


def collect(
    folder: str | Path,
    *,
    only: Collection[tuple[str, str]] | None = None,
    registry: Registry | None = None,
    scope: Scope = EVERYTHING,
) -> Board:
    """Return the board of a leaderboard's folder.

    Args:
        folder: the leaderboard's folder.
        only: (split, size) to read; all of them when None.
        registry: where splits are described; ours when None.
        scope: how much of the score files is needed.

    Raises:
        UsageError: no leaderboard.
        UnreadableFileError: an entry or a score file cannot be read.
        ChecksFailedError: an entry does not fit the schema or its place.
        DataError: an entry is of a split that is not known.
    """
    board = Folder(folder)
    full_registry = registry or load()
    board.require()

    paths: dict[tuple[str, ...], list[Path]] = {}
    for path in board.entries():
        data_set = path.parts[1:3]
        if only is None or data_set in only:
            paths.setdefault(data_set, []).append(path)
    for data_set, paths_of_data_set in paths.items():
        _require_described(board, data_set, paths_of_data_set, full_registry)

    verified = read_verified(board)
    failed_gates = read_failed_gates(board)
    shift = read_shift(board)
    sources = {}
    for split, description in full_registry.splits.items():
        for name in description.sizes:
            data_set = (split, name)
            if only is not None and data_set not in only:
                continue
            sources[data_set] = TabSource(
                board=board,
                paths=tuple(paths.get(data_set, ())),
                size=full_registry.size(split, name),
                title=description.title,
                registry=full_registry,
                scope=scope,
                verified=verified,
                failed_gates=failed_gates,
                shift=shift,
            )
    formed = _form_tabs(sources)
    tabs = picture_first(list(formed.values()), PICTURED_METHODS)
    empty = []
    for data_set, source in sources.items():
        is_for_trial = source.size.name == TRIAL
        is_ranked = len(source.size.subsets["test"]) >= FEWEST_SCENARIOS
        if data_set not in formed and is_ranked and not is_for_trial:
            empty.append(data_set)

    shown: set[str] = set()
    for tab in tabs:
        for row in tab.lines:
            shown.update(row.values)
    metrics = {}
    for name, metric in METRICS.items():
        if name in shown:
            metrics[name] = metric
    return Board(tabs=tuple(tabs), empty=tuple(empty), metrics=metrics)


@dataclass(frozen=True, kw_only=True, eq=False)
class TabSource:
    """Where the tab of a data set comes from."""

    board: Folder
    paths: Sequence[Path]  # entries, in the leaderboard's folder
    size: Size
    title: str
    registry: Registry
    scope: Scope
    verified: Mapping[str, Verification]
    failed_gates: Mapping[str, tuple[str, ...]]
    shift: Mapping[str, ShiftScores]


def _form_tabs(
    sources: Mapping[tuple[str, str], TabSource],
) -> dict[tuple[str, str], Tab]:
    """Return the tabs of all data sets with entries of this task.

    The tabs of a large leaderboard are formed in several processes side by side.
    """
    jobs = {}
    for data_set, source in sources.items():
        if source.paths:
            jobs["/".join(data_set)] = source
    entry_count = sum(len(source.paths) for source in jobs.values())
    workers = 1
    if entry_count >= FEWEST_FOR_WORKERS:
        workers = min(available_cores(), MOST_WORKERS)
    tabs = {}
    formed = run_all(_form_tab, jobs, workers=workers)
    for source, tab in zip(jobs.values(), formed, strict=True):
        if tab is not None:
            tabs[source.size.split, source.size.name] = tab
    return tabs


def _form_tab(source: TabSource, _report: Report) -> Tab | None:
    """Return the tab of a data set; None where no entry has scores of this task."""
    methods, truth = _read_methods(
        source.board, source.paths, source.registry, source.scope
    )
    if truth is None:
        return None
    tab = _make_tab(
        source.size,
        source.title,
        methods=methods,
        truth=truth,
        scope=source.scope,
        references=read_references(source.board, source.size),
        verified=source.verified,
        failed_gates=source.failed_gates,
        shift=source.shift,
    )
    # No page shows more pictures of one tab. The pictures of all entries take more
    # memory than everything else.
    (pictured,) = picture_first([tab], PICTURED_METHODS)
    return pictured


def _require_described(
    board: Folder,
    data_set: tuple[str, ...],
    paths: Sequence[Path],
    registry: Registry,
) -> None:
    """Refuse entries in the folder of a data set that is not known."""
    split, name = data_set
    if split in registry.splits and name in registry.splits[split].sizes:
        return
    for path in paths:
        _size_of(_read_in_place(board, path), registry, where=board.path / path)


def _read_methods(
    board: Folder, paths: Sequence[Path], registry: Registry, scope: Scope
) -> tuple[list[ScoredMethod], PicturedTruth | None]:
    """Return the methods of a data set, and the truth as it is pictured best.

    The truth is None where no entry has scores of this task.
    """
    methods = []
    finest: PicturedTruth | None = None
    for path in paths:
        read = _read_method(board, path, registry, scope)
        if read is None:
            continue
        method, truth = read
        methods.append(method)
        # Maps of truth and prediction share one packing: an explosion leaves nothing
        # of the truth.
        if finest is None or truth.order < finest.order:
            finest = truth
    return methods, finest


def _read_in_place(board: Folder, path: Path) -> Entry:
    """Return an entry that lies where it says."""
    entry = read_entry(board.path / path)
    if entry.yaml_path != path:
        raise ChecksFailedError(
            "an entry lies in another place than it says",
            where=str(path),
            expected=str(entry.yaml_path),
            got=str(path),
            fix=CHECKS["place"].fix,
        )
    return entry


def _require_present(board: Folder, score_path: Path, *, entry: Path) -> None:
    """Refuse an entry whose score file is missing.

    Raises:
        UnreadableFileError: there is no such file.
    """
    file = board.path / score_path
    if os.path.lexists(file):
        return
    raise UnreadableFileError(
        "a score file of an entry is missing",
        where=str(file),
        expected=f"the file that {entry} names",
        got="no such file",
        fix="restore it, or submit the predictions again; "
        f"{advise_board_check(board.path)}",
    )


def _read_method(
    board: Folder, path: Path, registry: Registry, scope: Scope
) -> tuple[ScoredMethod, PicturedTruth] | None:
    """Return an entry with its scores, and the truth beside them.

    None for old scores of another task.
    """
    entry = _read_in_place(board, path)
    size = _size_of(entry, registry, where=board.path / path)
    current = is_current(entry.dataset, size)
    try:
        stored = []
        for score_path in entry.score_paths:
            if current:
                _require_present(board, score_path, entry=path)
            score_file = read_score_file(board.path / score_path, size)
            _require_possible(board, score_path, score_file)
            stored.append(score_file)
    except UnreadableFileError:
        if current:
            raise
        return None

    ranking = stored[0].scores.ranking
    scores = _form_scores(board, entry, stored, scope)
    values = {}
    for name, combined in scores.items():
        if scope.includes(name) or name == ranking:
            values[name] = _value_of_seeds(combined, size, scope, ranking=ranking)

    plain_scores = {name: combined.score for name, combined in scores.items()}
    preview = stored[0].preview
    curves = {}
    residuals: tuple[Histogram, ...] = ()
    true_pictures = None
    pictures = None
    if scope.has_pictures:
        curves = _make_curves(plain_scores, ranking)
        residuals = residual_histograms(preview)
        true_pictures = _make_pictures(preview, TRUTH, size.box)
        pictures = _make_pictures(preview, PREDICTION, size.box)
    seeds = []
    for seed in scores[ranking].seeds:
        seeds.append(replace(seed, per_frame=np.empty((len(seed.values), 0))))
    method = ScoredMethod(
        entry=_without_stated_metrics(entry),
        is_current=current,
        ranking=ranking,
        seeds=seeds,
        values=values,
        curves=curves,
        energy=make_curve(plain_scores[PREDICTED_ENERGY]),
        pictures=pictures,
        residuals=residuals,
    )
    truth = PicturedTruth(
        precision=stored[0].precision,
        method=entry.method,
        energy=make_curve(plain_scores[TRUE_ENERGY]),
        pictures=true_pictures,
    )
    return method, truth


def _without_stated_metrics(entry: Entry) -> Entry:
    """Return an entry without the metrics that it states.

    Rows show those that follow from its score files. The stated ones would take more
    memory than everything else of an entry without pictures.
    """
    score = entry.score.model_copy(update={"metrics": {}})
    return entry.model_copy(update={"score": score})


def _require_possible(board: Folder, path: Path, score_file: ScoreFile) -> None:
    """Refuse a score file with values that no prediction can have."""
    impossible = next(find_impossible_values(score_file), None)
    if impossible is not None:
        raise UnreadableFileError(
            "impossible scores",
            where=str(board.path / path),
            expected="scores that a prediction can have",
            got=impossible,
            fix=f"submit the predictions again; {advise_board_check(board.path)}",
        )


def _form_scores(
    board: Folder, entry: Entry, stored: Sequence[ScoreFile], scope: Scope
) -> Mapping[str, CombinedScore]:
    """Return the scores of a method by metric, all seeds together."""
    ranking = stored[0].scores.ranking
    needed = (ranking, TRUE_ENERGY, PREDICTED_ENERGY)
    names: set[str] | None = None
    if scope.metrics is not None:
        names = {*scope.metrics, *needed}
        if scope.has_pictures:
            names.update(_names_of_curves(ranking))
    scores = combine([seed.scores.tallies for seed in stored], names)
    missing = []
    for name in needed:
        if name not in scores:
            missing.append(name)
    if missing:
        raise UnreadableFileError(
            "a score file lacks metrics that every score file has",
            where=str(board.path / entry.score_paths[0]),
            expected=", ".join(missing),
            got="no values of them",
            fix="score the predictions again: lagbench submit",
        )
    return scores


def _value_of_seeds(
    combined: CombinedScore, size: Size, scope: Scope, *, ranking: str
) -> Value:
    name = combined.score.metric.name
    interval = (math.nan, math.nan)
    if scope.has_interval(name) or name == ranking:
        interval = combined.interval
    return _make_value(combined.score, interval=interval, std=combined.std, size=size)


def _size_of(entry: Entry, registry: Registry, *, where: Path) -> Size:
    try:
        return registry.size(entry.split, entry.size)
    except UsageError as error:
        fix = error.fix
        if entry.split not in registry.splits:
            fix = (
                "install the package that adds the split; lagbench list names those "
                "that are known"
            )
        raise DataError(
            error.what,
            where=str(where),
            expected=error.expected,
            got=error.got,
            fix=fix,
        ) from error


def _make_tab(
    size: Size,
    title: str,
    *,
    methods: Sequence[ScoredMethod],
    truth: PicturedTruth,
    scope: Scope,
    references: Sequence[ReferenceScores],
    verified: Mapping[str, Verification],
    failed_gates: Mapping[str, tuple[str, ...]],
    shift: Mapping[str, ShiftScores],
) -> Tab:
    ranking = methods[0].ranking
    shift_references = _references_on_shift(size, ranking)
    solver_time = solver_seconds(size)
    variants = _find_variants(methods)
    ranked = {}
    for method in methods:
        if method.is_ranked and method.method not in variants:
            ranked[method.method] = method
    places = standings({name: method.seeds for name, method in ranked.items()})
    ranges = rank_ranges({name: [method.losses] for name, method in ranked.items()})

    def order(method: ScoredMethod) -> tuple[bool, float, str]:
        return method.method not in places, mean_loss(method.seeds), method.method

    rows = []
    for method in sorted(methods, key=order):
        row = _make_row(
            method,
            size,
            standing=places.get(method.method),
            rank_range=ranges.get(method.method),
            variant_of=variants.get(method.method),
            verified=verification_of(method.entry, verified),
            references=references,
            solver_time=solver_time,
        )
        failed = gates_failed_by(method.entry, failed_gates)
        on_shift = _method_on_shift(method, size, shift, shift_references)
        rows.append(replace(row, failed_gates=failed, on_shift=on_shift))

    columns = []
    for name in dict.fromkeys((ranking, *COLUMNS)):
        if any(name in row.values for row in rows):
            columns.append(name)
    curves = []
    for name in _names_of_curves(ranking):
        if any(name in row.curves for row in rows):
            curves.append(name)
    scenarios = tuple(sorted(size.subsets["test"]))
    reference_rows = _reference_rows(
        references,
        size,
        ranking,
        scope,
        shift_references=shift_references,
        solver_time=solver_time,
    )
    run = _run_of(rows)
    if run is not None:
        reference_rows = tuple(_with_times_of(run, row) for row in reference_rows)
        solver_time = run.solver
    return Tab(
        size=size,
        title=title,
        scenarios=scenarios,
        frames=tuple(frames_to_predict(size)),
        marked=reported_frames(size),
        ranking=ranking,
        decided=len(scenarios) >= FEWEST_SCENARIOS,
        columns=tuple(columns),
        curves=tuple(curves),
        energy=truth.energy,
        truth=truth.pictures,
        rows=tuple(rows),
        references=reference_rows,
        run=run,
        solver_seconds=solver_time,
    )


def picture_first(tabs: Sequence[Tab], most: int) -> list[Tab]:
    """Return tabs with pictures of the first methods alone, where there are too many.

    Each tab keeps those of equally many methods, one at least, and those of their
    variants.

    Args:
        tabs: all tabs of a board.
        most: most methods with pictures on all tabs together.
    """
    methods_of_tabs = []
    for tab in tabs:
        methods_of_tabs.append([row.id for row in tab.rows if row.variant_of is None])
    counts = [len(methods) for methods in methods_of_tabs]
    pictured_count = max(counts, default=0)
    while pictured_count > 1 and _sum_up_to(pictured_count, counts) > most:
        pictured_count -= 1

    pictured_tabs = []
    for tab, methods in zip(tabs, methods_of_tabs, strict=True):
        if len(methods) <= pictured_count:
            pictured_tabs.append(tab)
            continue
        pictured = methods[:pictured_count]
        rows = []
        for row in tab.rows:
            if row.id in pictured or row.variant_of in pictured:
                rows.append(row)
            else:
                rows.append(replace(row, pictures=None, residuals=()))
        pictured_tabs.append(replace(tab, rows=tuple(rows), pictured=pictured_count))
    return pictured_tabs


def _sum_up_to(highest: int, counts: Sequence[int]) -> int:
    """Return the sum of some counts, those above a highest one cut down to it."""
    return sum(min(count, highest) for count in counts)


def _reference_rows(
    references: Sequence[ReferenceScores],
    size: Size,
    ranking: str,
    scope: Scope,
    *,
    shift_references: Mapping[str, Score],
    solver_time: float | None,
) -> tuple[ReferenceRow, ...]:
    """Return the rows of the reference predictors, with skill and score on shift."""
    baselines = _naive_scores(references, ranking)
    rows = []
    for reference in references:
        row = _make_reference(reference, size, ranking, scope, solver_time=solver_time)
        if ranking in reference.scores:
            skill = compute_skill([reference.scores[ranking]], baselines)
            row = replace(row, skill=_value_of_ratio(skill))
        shift_score = shift_references.get(reference.name)
        if shift_score is not None:
            row = replace(row, on_shift=_on_shift([shift_score], shift_references))
        rows.append(row)
    return tuple(rows)


def _run_of(rows: Sequence[BoardRow]) -> MeasuredCost | None:
    """Return a cost of the run in which all measured active entries were measured.

    None if no active entry was measured, if they were measured in several runs, or if
    the run has no time of the solver.
    """
    costs = []
    for row in rows:
        if row.active and row.verified is not None and row.verified.cost is not None:
            costs.append(row.verified.cost)
    if not costs or costs[0].solver is None:
        return None
    run = costs[0]
    if all(cost.is_of_same_run(run) for cost in costs):
        return run
    return None


def _with_times_of(run: MeasuredCost, row: ReferenceRow) -> ReferenceRow:
    """Return the row of a reference predictor with its time in a run.

    A run has no time of predictors that read train. Theirs are converted by the times
    of the solver.
    """
    seconds = {**run.classical, **run.naive}.get(row.name)
    if seconds is None:
        if row.cost is None or row.cost.speed_up is None or run.solver is None:
            return row
        seconds = run.solver / row.cost.speed_up
    cost = EntryCost.model_construct(
        seconds_per_frame=seconds,
        device=run.machine,
        solver_seconds_per_frame=run.solver,
    )
    return replace(row, cost=cost)


def _find_variants(methods: Sequence[ScoredMethod]) -> Mapping[str, str]:
    """Return the method that each variant belongs to, by the id of the variant."""
    entries = [method.entry for method in methods]
    ranked_entries = [method.entry for method in methods if method.is_ranked]
    return find_variants(entries, ranked_entries)


def _make_row(
    method: ScoredMethod,
    size: Size,
    *,
    standing: Standing | None,
    rank_range: tuple[int, int] | None,
    variant_of: str | None,
    verified: Verification | None,
    references: Sequence[ReferenceScores],
    solver_time: float | None,
) -> BoardRow:
    costs = _compare_costs(method, references, verified, solver_time=solver_time)
    against = None
    solver_costs_more = False
    if costs is not None:
        against = _against_classical(method, references, costs)
        solver_costs_more = costs.method < min(costs.solvers.values())
    rank = None
    is_tied = False
    p = math.nan
    if standing is not None:
        rank = standing.rank
        p = standing.p
        is_tied = standing.tied and not math.isnan(p)
    return BoardRow(
        entry=method.entry,
        current=method.is_current,
        rank=rank,
        rank_range=rank_range,
        variant_of=variant_of,
        tied=is_tied,
        p=p,
        verified=verified,
        skill=_skill_of(method, references),
        against_classical=_value_of_ratio(against),
        solver=None if against is None else against.reference,
        values=method.values,
        losses=method.losses,
        solver_costs_more=solver_costs_more,
        seed_means=tuple(seed.mean for seed in method.seeds),
        curves=method.curves,
        energy=method.energy,
        pictures=method.pictures,
        residuals=method.residuals,
    )


def _skill_of(
    method: ScoredMethod, references: Sequence[ReferenceScores]
) -> Value | None:
    """Return the skill beside the best naive baseline, where one was scored."""
    if not method.is_current:
        return None
    baselines = _naive_scores(references, method.ranking)
    return _value_of_ratio(compute_skill(method.seeds, baselines))


def _naive_scores(
    references: Sequence[ReferenceScores], ranking: str
) -> dict[str, Score]:
    """Return the scores of the naive baselines in the ranking metric, by name."""
    scores = {}
    for reference in references:
        if reference.name in NAIVE and ranking in reference.scores:
            scores[reference.name] = reference.scores[ranking]
    return scores


@dataclass(frozen=True, kw_only=True)
class ComparedCosts:
    """What a frame costs a method and the classical solvers, on one machine [s]."""

    method: float
    solvers: Mapping[str, float]  # by name; those with a score, at least one


def _compare_costs(
    method: ScoredMethod,
    references: Sequence[ReferenceScores],
    verified: Verification | None,
    *,
    solver_time: float | None,
) -> ComparedCosts | None:
    """Return the costs of a method and of the classical solvers on one machine.

    Costs that we measured in one run are compared as they are; a cost that the entry
    states is brought to the machine of the references by the time of our solver on
    both. None where neither is known.
    """
    if not method.is_current:
        return None
    solvers = _classical(references, method.ranking)
    costs = {}
    for name, reference in solvers.items():
        if not math.isnan(reference.seconds_per_frame):
            costs[name] = reference.seconds_per_frame
    seconds = None
    if verified is not None and verified.cost is not None and verified.cost.classical:
        seconds = verified.cost.seconds_per_frame
        timed = verified.cost.classical
        costs = {name: timed[name] for name in solvers if name in timed}
    elif method.entry.cost is not None:
        seconds = seconds_where_measured(
            seconds_per_frame=method.entry.cost.seconds_per_frame,
            solver_seconds=method.entry.cost.solver_seconds_per_frame,
            solver_seconds_here=solver_time,
        )
    if seconds is None or not costs:
        return None
    return ComparedCosts(method=seconds, solvers=costs)


def _classical(
    references: Sequence[ReferenceScores], ranking: str
) -> dict[str, ReferenceScores]:
    """Return the classical solvers that have a score in the ranking metric, by name."""
    solvers = {}
    for reference in references:
        if reference.name in CLASSICAL and ranking in reference.scores:
            solvers[reference.name] = reference
    return solvers


def _against_classical(
    method: ScoredMethod, references: Sequence[ReferenceScores], costs: ComparedCosts
) -> AgainstClassical | None:
    """Return the score over that of the best classical solver that costs no more, or of
    the cheapest one.
    """
    scores = {}
    for name, reference in _classical(references, method.ranking).items():
        if name in costs.solvers:
            scores[name] = reference.scores[method.ranking]
    return compute_against_classical(
        method.seeds, scores, seconds=costs.solvers, seconds_per_frame=costs.method
    )


def _references_on_shift(size: Size, ranking: str) -> Mapping[str, Score]:
    """Return the ranking metric of the references on ``shift``, where it was scored."""
    if SUBSET not in size.subsets:
        return {}
    scores = {}
    for name, reference in (shipped(size.scored_on(SUBSET)) or {}).items():
        if name in REFERENCES and ranking in reference.scores:
            scores[name] = reference.scores[ranking]
    return scores


def _method_on_shift(
    method: ScoredMethod,
    size: Size,
    shift: Mapping[str, ShiftScores],
    references: Mapping[str, Score],
) -> OnShift | None:
    """Return the seeds of a method that were scored on ``shift``; None without any."""
    scores = shift_of(method.entry, size, shift)
    if scores is None:
        return None
    return _on_shift(scores_of_seeds(scores), references)


def _on_shift(seeds: Sequence[Score], references: Mapping[str, Score]) -> OnShift:
    """Return the values of some seeds, and their skill over the naive baselines."""
    baselines = {}
    for name, reference in references.items():
        if name in NAIVE:
            baselines[name] = reference
    means = np.array([seed.mean for seed in seeds])
    std = math.nan
    if len(means) > 1:
        std = float(np.std(means, ddof=1))
    values = np.stack([seed.values for seed in seeds])  # shape [seed, scenario]
    low, high = interval_in_range(values, seeds[0].value_range)
    value = Value(
        mean=mean(means),
        std=std,
        low=low,
        high=high,
        per_scenario=tuple(np.mean(values, axis=0).tolist()),
        at={},
        undefined=0,
    )
    return OnShift(score=value, skill=_value_of_ratio(compute_skill(seeds, baselines)))


def _value_of_ratio(ratio: Skill | AgainstClassical | None) -> Value | None:
    """Return a skill, or a score over that of a solver, as a value of the board."""
    if ratio is None:
        return None
    low, high = ratio.interval
    return Value(
        mean=ratio.value,
        std=ratio.std,
        low=low,
        high=high,
        per_scenario=(),
        at={},
        undefined=0,
    )


def _make_reference(
    reference: ReferenceScores,
    size: Size,
    ranking: str,
    scope: Scope,
    *,
    solver_time: float | None,
) -> ReferenceRow:
    description = REFERENCES[reference.name]
    values = {}
    for name, score in reference.scores.items():
        if not scope.includes(name) and name != ranking:
            continue
        interval = (math.nan, math.nan)
        if scope.has_interval(name) or name == ranking:
            interval = score.interval
        values[name] = _make_value(score, interval=interval, std=math.nan, size=size)

    energy = None
    energy_score = reference.scores.get(PREDICTED_ENERGY)
    if energy_score is not None:
        defined_share = np.isfinite(energy_score.per_frame).mean()
        if defined_share > 0.5:
            energy = make_curve(energy_score)

    cost = None
    if not math.isnan(reference.seconds_per_frame):
        cost = EntryCost.model_construct(
            seconds_per_frame=reference.seconds_per_frame,
            device="one core, where the reference predictors were measured",
            solver_seconds_per_frame=solver_time,
        )
    return ReferenceRow(
        name=reference.name,
        definition=description.definition,
        values=values,
        curves=_make_curves(reference.scores, ranking) if scope.has_pictures else {},
        energy=energy,
        kind=description.kind,
        cost=cost,
    )


def _make_value(
    score: Score, *, interval: tuple[float, float], std: float, size: Size
) -> Value:
    low, high = interval
    at = {}
    if score.metric.per_frame and score.metric.name in AT_FRAMES:
        at = _means_at_frames(score, reported_frames(size))
    return Value(
        mean=score.mean,
        std=std,
        low=low,
        high=high,
        per_scenario=tuple(score.values.tolist()),
        at=at,
        undefined=sum(score.undefined),
    )


def _means_at_frames(score: Score, frames: Sequence[int]) -> dict[int, float]:
    """Return the mean over scenarios at some absolute frames, by frame.

    Frames that the score does not have are left out.
    """
    columns = {}
    for column, frame in enumerate(score.frames):
        if frame in frames:
            columns[frame] = column
    at_frames = score.per_frame[:, list(columns.values())]  # shape [scenario, frame]
    means = mean_of_rows(at_frames.T)
    return dict(zip(columns, means.tolist(), strict=True))


def _names_of_curves(ranking: str) -> tuple[str, ...]:
    """Return the metrics to draw over frames, the ranking one or its parts first."""
    return tuple(dict.fromkeys((ranking, *METRICS[ranking].of, *CURVES)))


def _make_curves(scores: Mapping[str, Score], ranking: str) -> dict[str, Curve]:
    """Return the curves over frames of an entry, by metric.

    A metric without a value per frame has no curve.
    """
    curves = {}
    for name in _names_of_curves(ranking):
        score = scores.get(name)
        if score is not None and score.metric.per_frame and score.frames:
            curves[name] = make_curve(score)
    return curves


def make_curve(score: Score) -> Curve:
    """Return mean, lowest and highest of a metric over scenarios per frame.

    Some metrics have a value at every tenth frame, and the shipped scores of reference
    predictors at some of these: the other frames are left out, they are no gaps.
    """
    is_measured = np.isfinite(score.per_frame).any(axis=0)
    measured = np.flatnonzero(is_measured).tolist()
    sampled = list(range(len(score.frames)))
    is_sparse = bool(measured) and np.diff(measured).min(initial=len(sampled)) > 1
    if is_sparse:
        sampled = measured
    chosen = []
    for i in spaced(len(sampled), CURVE_FRAMES):
        chosen.append(sampled[i])

    values = score.per_frame[:, chosen]  # shape [scenario, frame]
    with warnings.catch_warnings():
        # a frame where nothing is defined is NaN
        warnings.simplefilter("ignore", RuntimeWarning)
        middle = np.nanmean(values, axis=0)
        low = np.nanmin(values, axis=0)
        high = np.nanmax(values, axis=0)
    frames = tuple(score.frames[i] for i in chosen)
    return Curve(frames=frames, mean=middle, low=low, high=high)


def _flatten_film(film: NDArray[np.float32], box: Box) -> NDArray[np.float32]:
    """Return where particles stand in the picture, shape [film frame, particle, 2].

    Those of two dimensions stand where they are, in memory of their own: a view would
    keep the film of the other side.
    """
    if box.dimension == 2:
        return film.copy()
    return np.asarray(View(box).place(film), np.float32)


def _place_obstacle(
    obstacle: NDArray[np.float32] | None, box: Box
) -> tuple[float, float, float] | None:
    """Return x, y and radius of an obstacle in the picture; None without one."""
    if obstacle is None:
        return None
    centre = obstacle[:-1].astype(np.float64)
    radius = float(obstacle[-1])
    if box.dimension == 3:
        view = View(box)
        centre = view.place(centre)
        radius *= view.scale
    x, y = centre.tolist()
    return x, y, radius


def _make_pictures(preview: Preview, side: int, box: Box) -> Pictures:
    maps = spaced(len(preview.map_frames), MAP_FRAMES)
    histograms = []
    ranges = preview.histogram_range.astype(np.float64).tolist()
    shares = preview.histogram[side].astype(np.float64)
    for i in maps:
        low, high = ranges[i]
        frame_shares = shares[i]
        histograms.append(Histogram(low=low, high=high, shares=frame_shares))
    vorticity = coarsen(preview.vorticity[side][maps], MAP_NODES)
    return Pictures(
        scenario=preview.scenario,
        map_frames=tuple(preview.map_frames[i] for i in maps),
        vorticity=vorticity.astype(np.float32),
        histograms=tuple(histograms),
        film_frames=preview.film_frames,
        material=preview.material,
        film=_flatten_film(preview.film[side], box),
        obstacle=_place_obstacle(preview.obstacle, box),
    )


def residual_histograms(preview: Preview) -> tuple[Histogram, ...]:
    """Return shares of predicted minus true vorticity at each map frame.

    The range is symmetric, up to the greatest residual.
    """
    maps = spaced(len(preview.map_frames), MAP_FRAMES)
    truth, prediction = preview.vorticity[:, maps].astype(np.float64)
    half = RESIDUAL_BINS // 2
    histograms = []
    for difference in prediction - truth:
        values = difference[~np.isnan(difference)]
        if not values.size:
            no_shares = np.full(RESIDUAL_BINS, np.nan)
            histograms.append(Histogram(low=0.0, high=0.0, shares=no_shares))
            continue
        magnitude = np.abs(values)
        greatest = float(np.max(magnitude))
        relative = values
        if greatest:  # a field without any error is one bin, not a division by 0
            relative = values / greatest
        bins = np.rint(relative * half).astype(int) + half
        counts = np.bincount(bins, minlength=RESIDUAL_BINS)
        shares = counts / values.size
        histograms.append(Histogram(low=-greatest, high=greatest, shares=shares))
    return tuple(histograms)


@dataclass(frozen=True, kw_only=True)
class BuildResult:
    """A page that was drawn."""

    page: Path
    bytes: int
    tabs: int  # splits and sizes on it
    rows: int  # entries on it
    written: tuple[Path, ...]  # files that were missing or had another content


def build(
    board: str | Path,
    *,
    check: bool = False,
    registry: Registry | None = None,
    documentation: str = DOCUMENTATION,
) -> BuildResult:
    """Write page and schema.json where they are stale.

    Args:
        board: the leaderboard's folder.
        check: whether to write nothing; stale files are an error then.
        registry: where splits are described; ours when None.
        documentation: address of the documentation's site; empty where it has none.

    Raises:
        ChecksFailedError: with ``check``, a file is stale; else see :func:`collect`.
        UsageError, UnreadableFileError, DataError: see :func:`collect`.
    """
    folder = Folder(board)
    page = folder.path / PAGE
    schema = folder.path / SCHEMA
    content = collect(board, registry=registry, scope=PAGE_SCOPE)
    links = _links_of(folder, links_to(documentation), check=check)
    new_page = render(content, links)
    new_schema = schema_bytes()

    stale = {}
    if not _is_file(page) or not same_page(page.read_bytes(), new_page.encode()):
        stale[page] = new_page.encode()
    if not _is_file(schema) or schema.read_bytes() != new_schema:
        stale[schema] = new_schema
    if stale and check:
        descriptions = []
        for path, data in stale.items():
            descriptions.append(f"{path.name} of {len(data)} bytes")
        raise ChecksFailedError(
            "the page is out of date",
            where=", ".join(str(path) for path in stale),
            expected=", ".join(descriptions),
            got="another content, or no file",
            fix=f"lagbench leaderboard build --board {shlex.quote(str(board))}",
        )
    for path, data in stale.items():
        write_atomically(path, data, option="--board")
    return BuildResult(
        page=page,
        bytes=page.stat().st_size,
        tabs=len(content.tabs),
        rows=sum(len(tab.rows) for tab in content.tabs),
        written=tuple(stale),
    )


def _is_file(path: Path) -> bool:
    return path.is_file() and not path.is_symlink()


def _links_of(
    folder: Folder, known_links: Mapping[str, str], *, check: bool
) -> dict[str, str]:
    """Return the links of the page: to a site with an address, or to files there are.

    A copy of the folder elsewhere still has the links of where its page was drawn, so a
    page that is checked keeps its links to files.
    """
    page = folder.path / PAGE
    drawn_links = None
    if check and page.is_file():
        drawn_links = links_in(page.read_bytes(), known_links)
    links = {}
    for label, address in known_links.items():
        if "://" in address:
            is_shown = True
        elif drawn_links is not None:
            is_shown = label in drawn_links
        else:
            is_shown = (folder.path / address).exists()
        if is_shown:
            links[label] = address
    return links
