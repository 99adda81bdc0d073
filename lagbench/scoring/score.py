"""Score a predictions.nc: validate, measure, aggregate, compare, flag, write."""

from __future__ import annotations

import functools
from collections.abc import Callable, Collection, Generator, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lagbench.atomic import atomic_path, check_writable
from lagbench.data.layout import expand_home
from lagbench.data.local import (
    DESCRIPTION,
    load_rooted_registry,
    locate_split,
    resolve_root,
)
from lagbench.data.registry import Registry, Size
from lagbench.errors import (
    LagbenchError,
    UnreadableFileError,
    UsageError,
    check_installed,
    suggest_name,
)
from lagbench.metrics.aggregate import Score, Tally, aggregate
from lagbench.metrics.frame import snapshots
from lagbench.metrics.metric import Metric
from lagbench.metrics.table import (
    METRICS,
    OwnMetrics,
    available,
    own_metrics,
    ranking_metric,
    select,
)
from lagbench.references import extrapolation
from lagbench.references.predictor import given_in
from lagbench.references.shipped import ReferenceScores, shipped, solver_seconds
from lagbench.references.table import NAIVE, REFERENCES
from lagbench.submission.format import FileInfo, Header
from lagbench.submission.issues import ValidationIssue, ValidationResult
from lagbench.submission.predictions import Predictions, open_predictions
from lagbench.submission.validation import require_split, validate
from lagbench.work.executor import Report
from lagbench.work.machine import available_cores, worker_count
from lagbench.work.run import Meter, Progress, run_all

from .card import JSON_NAME, ScoreCard, format_scores
from .flags import Flag, Trace, judge_copying, judge_physics, judge_predictability
from .front import (
    NoSpeedup,
    Speedup,
    compute_speedup,
    front_row,
    seconds_where_measured,
)
from .published_scores import IDENTITY, read_scores
from .references import check_train, measurable
from .scenario import (
    SUBMISSION,
    Preview,
    PreviewRecorder,
    measure_rows,
    predict_reference,
)
from .scorability import OF_NODES, few_nodes_warning
from .score_file import NETCDF_NAME
from .score_file_writer import write_statistics
from .skill import compute_skill
from .task import ScoredTask, load_scored_task

WORTH_WORKERS = 1_000_000
"""Least particles times predicted frames for which worker processes are worth it."""


def score(
    predictions: str | Path,
    *,
    split: str | Path | None = None,
    root: str | Path | None = None,
    output_dir: str | Path | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    extras: str | Collection[str] = (),
    metrics: OwnMetrics = (),
    packages: bool = True,
    progress: Callable[[Progress], None] | None = None,
    examined: Callable[[ValidationResult], None] | None = None,
    registry: Registry | None = None,
    write: bool = True,
    validated: ValidationResult | None = None,
) -> ScoreCard:
    """Score a submission and write scores.json and scores.nc.

    Args:
        predictions: a predictions.nc.
        split: the split to which they must belong, or the path of a local split's
            folder; the one that they name when None.
        root: folder of all data sets; else LAGBENCH_ROOT, else the user data folder.
        output_dir: folder for the two files; by default the folder of the predictions'
            name beside them, see :func:`scores_folder`.
        workers: worker processes; by default one per core where the work is worth it.
        scheduler: address of a Dask scheduler that takes the scenarios instead.
        extras: extras whose metrics are measured too, as in ("transport",); or one.
        metrics: metrics of your own that are measured too: functions of a
            :class:`~lagbench.metrics.FramePair`, or a
            :class:`~lagbench.metrics.Metric` where a direction and a unit are to be
            stated; one of them, or a list. They are measured in this process.
        packages: whether to measure the metrics of installed packages too.
        progress: called with the state of the work.
        examined: called with the result of the validation, before anything is raised
            for it.
        registry: where splits are described; ours when None.
        write: whether to write the two files.
        validated: the result of :func:`lagbench.validate` with ``require_truth`` for
            this very file and root; the file is then not validated again.

    Returns:
        The score card; ``files`` names the written files.

    Raises:
        UsageError: predictions for another split; an extra that brings no metrics, or
            that is not installed; what is no metric, or workers for one of your own;
            scores of another method lie where these would go.
        UnreadableFileError: the predictions cannot be read.
        ChecksFailedError: they are not valid.
        DataError: they were made from another data set, or the test subset is missing
            or damaged.
        WorkFailedError: a worker or the cluster was lost, the disk is full, or the
            folder cannot be written to, which is seen before the work; or a metric
            failed.
    """
    own = own_metrics(metrics)
    if own:
        workers = _one_worker(workers, scheduler)
    table = METRICS
    if packages:
        table = available()
    measured_metrics = select((*_select_metrics(extras, table), *own), known=table)
    given_path = expand_home(predictions, "predictions")
    path = given_path.absolute()
    expected_split = None
    if split is not None:
        expected_split, root, _ = locate_split(split, root=root, registry=registry)
    data_root = resolve_root(root)
    rooted_registry = load_rooted_registry(data_root, registry)
    folder = scores_folder(given_path)
    if output_dir is not None:
        folder = expand_home(output_dir, "--output")

    result = validated
    if result is None:
        result = validate(
            path, root=data_root, require_truth=True, registry=rooted_registry
        )
    _require_validation_of(path, result)
    require_split(result, expected_split)
    if examined is not None:
        examined(result)
    result.check()

    with open_predictions(path) as opened:
        header = opened.header
        info = opened.info
        sha256 = result.sha256 or opened.content_sha256()
    if write:
        check_writable(folder, option="--output")
        _check_overwriting(folder / JSON_NAME, header)

    size = rooted_registry.size(header.split, header.size).scored_on(header.subset)
    # a validation that compares with the truth has hashed it
    is_hashed = validated is None and "discontinuous_start" not in result.skipped
    task = load_scored_task(size, data_root, is_hashed=is_hashed)
    shipped_references = shipped(size) or {}
    references: tuple[str, ...] = ()
    if not shipped_references:
        references = measurable(size, data_root)
        check_train(size, data_root, references)
    outcomes = score_scenarios(
        task,
        path,
        info,
        metrics=_names_or_metrics(measured_metrics, {metric.name for metric in own}),
        references=references,
        workers=workers,
        scheduler=scheduler,
        meter=Meter(progress),
    )
    tallies: dict[str, dict[int, Tally]] = {}
    for row in outcomes[0].tallies:
        tallies[row] = {}
        for outcome in outcomes:
            tallies[row][outcome.scenario] = outcome.tallies[row]
    scores: dict[str, Mapping[str, Score]] = {}
    for row, row_tallies in tallies.items():
        scores[row] = aggregate(measured_metrics, row_tallies)
    measurement = Measurement(outcomes=outcomes, tallies=tallies, scores=scores)
    card = _make_card(
        measurement,
        task=task,
        header=header,
        sha256=sha256,
        shipped_references=shipped_references,
        warnings=result.warnings,
    )
    if write:
        return _write(card, folder)
    return card


@dataclass(frozen=True, kw_only=True, eq=False)
class Measurement:
    """What was measured of a submission and of the references beside it."""

    outcomes: Sequence[ScenarioScores]  # by ascending id of the scenario
    tallies: Mapping[str, Mapping[int, Tally]]  # statistics by row and scenario
    scores: Mapping[str, Mapping[str, Score]]  # by row and metric


def _one_worker(workers: int | None, scheduler: str | None) -> int:
    """Return the number of workers for functions that no other process can import.

    Raises:
        UsageError: more of them are asked for.
    """
    if scheduler is not None or (workers or 1) > 1:
        got = f"workers={workers}"
        if scheduler is not None:
            got = f"scheduler={scheduler!r}"
        raise UsageError(
            "metrics of your own are measured in this process",
            where="metrics",
            expected="one worker and no scheduler",
            got=got,
            fix="leave it out, or install the metrics as a package: see "
            "docs/extending.md",
        )
    return 1


def _names_or_metrics(
    metrics: Sequence[Metric], own_names: Collection[str]
) -> tuple[str | Metric, ...]:
    """Return the names of installed metrics, and the others themselves."""
    listed: list[str | Metric] = []
    for metric in metrics:
        listed.append(metric if metric.name in own_names else metric.name)
    return tuple(listed)


def _make_card(
    measurement: Measurement,
    *,
    task: ScoredTask,
    header: Header,
    sha256: str,
    shipped_references: Mapping[str, ReferenceScores],
    warnings: Sequence[ValidationIssue],
) -> ScoreCard:
    """Return the score card: measured scores beside those of the references.

    Args:
        measurement: what was measured.
        task: the test subset.
        header: what the predictions say about themselves.
        sha256: content hash of the predicted positions.
        shipped_references: scores of the references that were not measured.
        warnings: of the validation.
    """
    scores = dict(measurement.scores)
    for name, reference in shipped_references.items():
        scores[name] = reference.scores
    ranking = ranking_metric(task.size)
    submission = scores[SUBMISSION][ranking]
    counting = {}
    for row, row_scores in scores.items():
        if row in NAIVE and ranking in row_scores:
            counting[row] = row_scores[ranking]

    speedup = speedup_beside(header, task.size, submission, shipped_references)
    few_nodes = _warn_of_few_nodes(task, measurement.tallies[SUBMISSION])
    return ScoreCard(
        header=header,
        predictions_sha256=sha256,
        config=task.config,
        ranking=ranking,
        tallies=measurement.tallies,
        scores=scores,
        skill=compute_skill([submission], counting),
        speedup=speedup,
        flags=_judge(task, measurement.outcomes, scores),
        warnings=(*warnings, *few_nodes),
        preview=next(
            outcome.preview
            for outcome in measurement.outcomes
            if outcome.preview is not None
        ),
    )


def speedup_beside(
    header: Header,
    size: Size,
    submission: Score,
    references: Mapping[str, ReferenceScores],
) -> Speedup | NoSpeedup:
    """Return the speedup of predictions over the classical side, or why they have none.

    Args:
        header: what the predictions say about themselves, its costs among it.
        size: the data set.
        submission: score of the submission in the ranking metric.
        references: shipped scores and costs of the reference predictors.
    """
    metric = submission.metric.name
    scenarios = submission.scenarios
    rows = []
    for name, reference in references.items():
        if name in REFERENCES and metric in reference.scores:
            row = front_row(
                name=name,
                kind=REFERENCES[name].kind,
                seconds=reference.seconds_per_frame,
                seeds=[reference.scores[metric]],
                scenarios=scenarios,
            )
            rows.append(row)
    seconds = seconds_where_measured(
        seconds_per_frame=header.seconds_per_frame,
        solver_seconds=header.solver_seconds_per_frame,
        solver_seconds_here=solver_seconds(size),
    )
    model = front_row(
        name=header.method,
        kind="learned",
        seconds=seconds,
        seeds=[submission],
        scenarios=scenarios,
    )
    return compute_speedup(model, rows)


def scores_folder(predictions: Path) -> Path:
    """Return the default folder of the scores of a file: beside it, with its name.

    The folder of a local split is none: predictions may have the name of their split.

    >>> scores_folder(Path("runs/gns.nc")).as_posix()
    'runs/gns'
    >>> scores_folder(Path("runs/gns")).as_posix()
    'runs/gns-scores'
    """
    folder = predictions.parent / predictions.stem
    if predictions.suffix and not (folder / DESCRIPTION).exists():
        return folder
    return predictions.parent / f"{predictions.stem}-scores"


def _require_validation_of(path: Path, result: ValidationResult) -> None:
    """Refuse the result of a validation of another file."""
    if result.path != path:
        raise UsageError(
            "the validation is of another file",
            where=str(path),
            expected="the result of validate for this file",
            got=result.path,
            fix="leave validated out: score validates by itself",
        )


def _check_overwriting(path: Path, header: Header) -> None:
    """Refuse to write over scores of another method, data set or subset."""
    if not path.exists():
        return
    identity = {}
    for name in IDENTITY:
        identity[name] = getattr(header, name)
    expected = _describe_scored(identity, header.subset)
    try:
        scores = read_scores(path)
        present = _describe_scored(scores.identity, scores.subset)
    except UnreadableFileError:
        present = "something else"
    if present != expected:
        raise UsageError(
            "the folder holds the scores of another submission",
            where=str(path),
            expected=f"no such file, or the scores of {expected}",
            got=present,
            fix="name another folder for the new scores: --output FOLDER, in Python "
            "output_dir=; or remove the old ones",
        )


def _describe_scored(identity: Mapping[str, str], subset: str) -> str:
    """Return method, data set and subset of scores in words.

    A minor version leaves the data as they are, so the hash decides.
    """
    split = identity["split"]
    size = identity["size"]
    sha256 = identity["dataset_sha256"]
    return f"{identity['method']} {split} {size} {subset}, data {sha256}"


def _warn_of_few_nodes(
    task: ScoredTask, tallies: Mapping[int, Tally]
) -> Iterator[ValidationIssue]:
    """Warn of scenarios whose vorticity has too few nodes in every frame.

    Where it ranks, of any such scenario; else only if all scenarios are such.
    """
    without = []
    for i, tally in tallies.items():
        if not _has_nodes(tally):
            without.append(i)
    if not without:
        return
    if ranking_metric(task.size) == OF_NODES or len(without) == len(tallies):
        yield few_nodes_warning(task, without)


def _has_nodes(tally: Tally) -> bool:
    """Return whether the vorticity was compared in any frame, if it was measured."""
    if "vorticity_mse" not in tally.names:
        return True
    row = tally.names.index("vorticity_mse")
    return bool(tally.weight[row].any())


def _write(card: ScoreCard, folder: Path) -> ScoreCard:
    """Write both files and return the card with their paths."""
    json_path = folder / JSON_NAME
    netcdf_path = folder / NETCDF_NAME
    # both, or neither where the disk is full
    with atomic_path(json_path, option="--output") as temporary:
        temporary.write_bytes(format_scores(card))
        write_statistics(card, netcdf_path)
    return card.at(json_path, netcdf_path)


def _select_metrics(
    extras: str | Collection[str], table: Mapping[str, Metric]
) -> tuple[Metric, ...]:
    """Return the metrics of a table to measure.

    Extras are refused as by `check_extras`.
    """
    if isinstance(extras, str):
        extras = (extras,)
    check_extras(extras)
    return select(extras=extras, known=table)


def check_extras(extras: Collection[str]) -> None:
    """Refuse an extra that brings no metrics, or whose package is missing.

    Raises:
        UsageError: there is no such extra, or it is not installed.
    """
    modules: dict[str, set[str]] = {}
    for metric in available().values():
        if metric.extra is None:
            continue
        modules_of_extra = modules.setdefault(metric.extra, set())
        if metric.module is not None:
            modules_of_extra.add(metric.module)
    for extra in extras:
        if extra not in modules:
            raise UsageError(
                f"no extra {extra!r} with metrics",
                where="--extras",
                expected="an extra that brings metrics",
                got=ascii(extra),
                fix=suggest_name(extra, modules),
            )
        for module in sorted(modules[extra]):
            check_installed(module, extra=extra)


# --- one scenario, the unit of parallel work ------------------------------------------


@dataclass(frozen=True, kw_only=True)
class ScenarioJob:
    """Input of a worker that scores one scenario."""

    task: ScoredTask  # the test subset
    scenario: int  # id of the scenario
    predictions: Path  # a predictions.nc that has been validated
    info: FileInfo  # content of its headers
    # names of the metrics, and metrics of the user that are not installed
    metrics: tuple[str | Metric, ...]
    references: tuple[str, ...] = ()  # names of the references to measure beside it
    has_preview: bool = False  # whether to take the preview


@dataclass(frozen=True, eq=False)
class ScenarioScores:
    """Result of a worker that scores one scenario."""

    scenario: int  # id of the scenario
    tallies: Mapping[str, Tally]  # statistics by row
    trace: Trace  # of the submission's error
    preview: Preview | None  # pictures, if they were asked for


# the search through installed packages takes as long as some frames
_select = functools.cache(select)


def score_scenario(job: ScenarioJob, report: Report) -> ScenarioScores:
    """Score one scenario of a submission and of the references beside it."""
    number = job.scenario
    metrics = _select(job.metrics)
    recorder = None
    try:
        with (
            job.task.opened(number) as truth,
            open_predictions(job.predictions, info=job.info) as predictions,
            ExitStack() as open_rows,
        ):
            scenario = truth.scenario
            frames = _predicted_frames(predictions, number)
            rows = {SUBMISSION: snapshots(scenario, frames)}
            for name in job.references:
                given = given_in(truth.file, job.task.size, job.task.truth.root)
                prediction = predict_reference(REFERENCES[name], given)
                # where a metric fails, the traceback would keep the files open
                if isinstance(prediction, Generator):
                    open_rows.callback(prediction.close)
                rows[name] = snapshots(scenario, prediction)

            if job.has_preview:
                obstacle = truth.obstacle
                recorder = PreviewRecorder(number, scenario, obstacle=obstacle)
            tallies, trace = measure_rows(
                scenario,
                truth.snapshots(),
                rows,
                metrics=metrics,
                recorder=recorder,
                report=report,
            )
    except LagbenchError as error:
        error.add_note(f"scenario {number}")
        raise

    preview = None
    if recorder is not None:
        preview = recorder.preview
    return ScenarioScores(number, tallies, trace, preview)


def _predicted_frames(
    predictions: Predictions, scenario: int
) -> Iterator[NDArray[np.floating]]:
    """Yield the predicted positions of one frame after the other."""
    for _, block in predictions.blocks(scenario):
        yield from block


# --- all scenarios --------------------------------------------------------------------


def score_scenarios(
    task: ScoredTask,
    path: Path,
    info: FileInfo,
    *,
    metrics: tuple[str | Metric, ...],
    references: tuple[str, ...],
    workers: int | None,
    scheduler: str | None,
    meter: Meter,
) -> list[ScenarioScores]:
    """Return the statistics of every scenario, by ascending id.

    Args:
        task: the test subset.
        path: a predictions.nc that has been validated.
        info: content of its headers.
        metrics: names of the metrics, and metrics that are not installed.
        references: names of the references to measure beside it.
        workers: worker processes; None: one per core where the work is worth it.
        scheduler: address of a Dask scheduler that takes the scenarios instead.
        meter: counts the frames.
    """
    scenarios = task.scenarios
    jobs = {}
    for scenario in scenarios:
        jobs[f"scenario {scenario}"] = ScenarioJob(
            task=task,
            scenario=scenario,
            predictions=path,
            info=info,
            metrics=metrics,
            references=references,
            has_preview=scenario == scenarios[0],
        )

    frame_count = len(scenarios) * task.config.horizon
    default = 1
    if frame_count * task.size.particles >= WORTH_WORKERS:
        default = available_cores()
    meter.begin("scoring", total=frame_count, scenarios=len(scenarios))
    return run_all(
        score_scenario,
        jobs,
        workers=worker_count(workers, default=default),
        scheduler=scheduler,
        report=meter.count,
    )


def _judge(
    task: ScoredTask,
    outcomes: Sequence[ScenarioScores],
    scores: Mapping[str, Mapping[str, Score]],
) -> tuple[Flag, ...]:
    """Return the flags of a submission."""
    traces = [outcome.trace for outcome in outcomes]
    # position RMSE, mean over scenarios [length], shape [frame]
    submission = scores[SUBMISSION]["position_rmse"]
    persistence = scores[extrapolation.PERSISTENCE.name]["position_rmse"]
    error = np.asarray(np.mean(submission.per_frame, axis=0))
    persistence_error = np.asarray(np.mean(persistence.per_frame, axis=0))
    return (
        judge_copying(traces),
        judge_predictability(error, persistence_error, task.predictability_limit),
        judge_physics(traces, dimension=task.size.dimension),
    )
