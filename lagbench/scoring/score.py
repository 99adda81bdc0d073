"""Score a predictions.nc: validate, measure, aggregate, compare, flag, write."""

from __future__ import annotations

import itertools
import json
import time
from collections.abc import Callable, Collection, Generator, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lagbench.atomic import atomic_path, check_writable
from lagbench.data.layout import expand_home
from lagbench.data.local import (
    DESCRIPTION,
    check_contents,
    load_rooted_registry,
    locate_split,
    resolve_root,
)
from lagbench.data.registry import Registry, Size
from lagbench.errors import LagbenchError, UsageError, check_installed, suggest_name
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
from lagbench.references.extrapolation import PERSISTENCE
from lagbench.references.predictor import given_in
from lagbench.references.shipped import ReferenceScores, shipped, solver_seconds
from lagbench.references.table import NAIVE, REFERENCES, references_of
from lagbench.store.copy import update_working_copy
from lagbench.submission.format import Header
from lagbench.submission.issues import ValidationIssue, ValidationResult
from lagbench.submission.predictions import open_predictions
from lagbench.submission.validation import require_split, validate
from lagbench.work.executor import Report
from lagbench.work.machine import available_cores, worker_count
from lagbench.work.run import Meter, Progress, run_all

from .card import JSON_NAME, ScoreCard, format_scores
from .flags import Trace, judge_copying, judge_physics, judge_predictability
from .front import (
    NoSpeedup,
    Speedup,
    compute_speedup,
    front_row,
    seconds_where_measured,
)
from .scorability import OF_NODES, few_nodes_warning
from .score_file import NETCDF_NAME, write_statistics
from .skill import compute_skill
from .task import (
    SUBMISSION,
    ScoredTask,
    load_scored_task,
    measure_rows,
    predict_reference,
)

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
    if own and (scheduler is not None or (workers or 1) > 1):
        raise UsageError(
            "metrics of your own are measured in this process; leave workers and "
            "scheduler out, or install the metrics as a package: docs/extending.md",
            where="metrics",
        )
    if own:
        workers = 1
    if isinstance(extras, str):
        extras = (extras,)
    check_extras(extras)
    table = available() if packages else METRICS
    measured_metrics = select((*select(extras=extras, known=table), *own), known=table)
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

    result = validated or validate(
        path, root=data_root, require_truth=True, registry=rooted_registry
    )
    if result.path != path:
        raise UsageError("the validation is of another file; leave validated out")
    require_split(result, expected_split)
    if examined is not None:
        examined(result)
    result.check()
    with open_predictions(path) as opened:
        header = opened.header
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
        metrics=measured_metrics,
        predictions=path,
        references=references,
        workers=workers,
        scheduler=scheduler,
        meter=Meter(progress),
    )
    tallies: dict[str, dict[int, Tally]] = {}
    scores: dict[str, Mapping[str, Score]] = {}
    for row in outcomes[0].tallies:
        tallies[row] = {one.scenario: one.tallies[row] for one in outcomes}
        scores[row] = aggregate(measured_metrics, tallies[row])
    for name, reference in shipped_references.items():
        scores[name] = reference.scores

    ranking = ranking_metric(size)
    submission = scores[SUBMISSION][ranking]
    naive = {}
    for row, row_scores in scores.items():
        if row in NAIVE and ranking in row_scores:
            naive[row] = row_scores[ranking]
    # position RMSE, mean over scenarios [length], shape [frame]
    error, persistence_error = (
        np.asarray(np.mean(scores[row]["position_rmse"].per_frame, axis=0))
        for row in (SUBMISSION, PERSISTENCE.name)
    )
    traces = [outcome.trace for outcome in outcomes]
    card = ScoreCard(
        header=header,
        predictions_sha256=str(result.sha256),
        config=task.config,
        ranking=ranking,
        tallies=tallies,
        scores=scores,
        skill=compute_skill([submission], naive),
        speedup=speedup_beside(header, size, submission, shipped_references),
        flags=(
            judge_copying(traces),
            judge_predictability(error, persistence_error, task.predictability_limit),
            judge_physics(traces, dimension=size.dimension),
        ),
        warnings=(*result.warnings, *_warn_of_few_nodes(task, tallies[SUBMISSION])),
    )
    if not write:
        return card
    json_path = folder / JSON_NAME
    # both files, or neither where the disk is full
    with atomic_path(json_path, option="--output") as temporary:
        temporary.write_bytes(format_scores(card))
        write_statistics(card, folder / NETCDF_NAME)
    return replace(card, files=(json_path, folder / NETCDF_NAME))


def measurable(size: Size, root: Path) -> tuple[str, ...]:
    """Return the names of the references that scoring measures where none are shipped.

    These are the ones that count.
    """
    train = size.subsets.get("train", ())
    has_train = bool(train) and all(size.path(root, i).is_file() for i in train)
    names = []
    for reference in references_of(size):
        if reference.counts and (has_train or not reference.reads_train):
            names.append(reference.name)
    return tuple(names)


def check_train(size: Size, root: Path, references: Collection[str]) -> None:
    """Fetch and hash train where a reference looks things up there.

    Raises:
        DataError: a scenario of train is not the recorded one.
    """
    if any(REFERENCES[name].reads_train for name in references):
        scenarios = size.subsets["train"]
        update_working_copy(size, root, scenarios)
        check_contents(size, root, scenarios)


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


def _check_overwriting(path: Path, header: Header) -> None:
    """Refuse to write over scores of another method, data set or subset.

    A minor version leaves the data as they are, so the hash decides.
    """
    if not path.exists():
        return
    try:
        content = json.loads(path.read_bytes())
    except (OSError, ValueError):
        content = {}
    present = {"subset": "test", **content} if isinstance(content, dict) else {}
    for name in ("method", "split", "size", "subset", "dataset_sha256"):
        if present.get(name) != getattr(header, name):
            raise UsageError(
                f"the folder holds the scores of another {name}; write these to "
                "another folder: --output FOLDER",
                where=str(path),
            )


def _warn_of_few_nodes(
    task: ScoredTask, tallies: Mapping[int, Tally]
) -> Iterator[ValidationIssue]:
    """Warn of scenarios whose vorticity has too few nodes in every frame.

    Where it ranks, of any such scenario; else only if all scenarios are such.
    """
    without = []
    for i, tally in tallies.items():
        is_compared = "vorticity_mse" not in tally.names or np.any(
            tally.weight[tally.names.index("vorticity_mse")]
        )
        if not is_compared:
            without.append(i)
    ranks = ranking_metric(task.size) == OF_NODES
    if without and (ranks or len(without) == len(tallies)):
        yield few_nodes_warning(task, without)


def check_extras(extras: Collection[str]) -> None:
    """Refuse an extra that brings no metrics, or whose package is missing.

    Raises:
        UsageError: there is no such extra, or it is not installed.
    """
    modules: dict[str, set[str]] = {}
    for metric in available().values():
        if metric.extra is not None:
            modules.setdefault(metric.extra, set()).add(metric.module or "lagbench")
    for extra in extras:
        if extra not in modules:
            raise UsageError(
                f"no extra {extra!r} with metrics; {suggest_name(extra, modules)}",
                where="--extras",
            )
        for module in sorted(modules[extra]):
            check_installed(module, extra=extra)


def time_frames(
    frames: Iterator[NDArray[np.float32]], seconds: list[float]
) -> Iterator[NDArray[np.float32]]:
    """Yield frames; append the CPU time of each to ``seconds`` [s]."""
    while True:
        start = time.process_time()
        frame = next(frames, None)
        if frame is None:
            return
        seconds.append(time.process_time() - start)
        yield frame


@dataclass(frozen=True, kw_only=True)
class ScenarioJob:
    """Input of a worker that scores one scenario."""

    task: ScoredTask
    scenario: int  # id of the scenario
    metrics: tuple[Metric, ...]
    predictions: Path | None  # a predictions.nc that has been validated
    references: tuple[str, ...]  # names of the references to measure


@dataclass(frozen=True, eq=False)
class ScenarioScores:
    """Result of a worker that scores one scenario."""

    scenario: int  # id of the scenario
    tallies: Mapping[str, Tally]  # statistics by row
    trace: Trace  # of the first row's error
    # processor time of the prediction of each frame by name of the reference [s]
    seconds: Mapping[str, list[float]]


def score_scenario(job: ScenarioJob, report: Report) -> ScenarioScores:
    """Score one scenario of a submission, if any, and of references."""
    number = job.scenario
    seconds: dict[str, list[float]] = {}
    rows = {}
    try:
        # where a metric fails, the traceback would keep files and predictions open
        with job.task.opened(number) as truth, ExitStack() as stack:
            if job.predictions is not None:
                opened = stack.enter_context(open_predictions(job.predictions))
                blocks = (block for _, block in opened.blocks(number))
                frames = itertools.chain.from_iterable(blocks)
                rows[SUBMISSION] = snapshots(truth.scenario, frames)
            for name in job.references:
                given = given_in(truth.file, job.task.size, job.task.truth.root)
                prediction = predict_reference(REFERENCES[name], given)
                if isinstance(prediction, Generator):
                    stack.callback(prediction.close)
                seconds[name] = []
                timed = time_frames(prediction, seconds[name])
                rows[name] = snapshots(truth.scenario, timed)
            tallies, trace = measure_rows(
                truth.scenario,
                truth.snapshots(),
                rows,
                metrics=job.metrics,
                report=report,
            )
    except LagbenchError as error:
        error.add_note(f"scenario {number}")
        raise
    return ScenarioScores(number, tallies, trace, seconds)


def score_scenarios(
    task: ScoredTask,
    *,
    metrics: tuple[Metric, ...],
    predictions: Path | None = None,
    references: tuple[str, ...] = (),
    workers: int | None,
    scheduler: str | None = None,
    meter: Meter,
) -> list[ScenarioScores]:
    """Return the statistics of every scenario, by ascending id.

    Args:
        task: the test subset.
        metrics: the metrics to measure.
        predictions: a predictions.nc that has been validated.
        references: names of the references to measure.
        workers: worker processes; None: one per core where the work is worth it.
        scheduler: address of a Dask scheduler that takes the scenarios instead.
        meter: counts the frames.
    """
    jobs = {}
    for scenario in task.scenarios:
        jobs[f"scenario {scenario}"] = ScenarioJob(
            task=task,
            scenario=scenario,
            metrics=metrics,
            predictions=predictions,
            references=references,
        )

    frame_count = len(jobs) * task.config.horizon
    default = 1
    if frame_count * task.size.particles >= WORTH_WORKERS:
        default = available_cores()
    meter.begin("scoring", total=frame_count, scenarios=len(jobs))
    return run_all(
        score_scenario,
        jobs,
        workers=worker_count(workers, default=default),
        scheduler=scheduler,
        report=meter.count,
    )
