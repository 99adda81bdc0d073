"""Score a predictions.nc: validate, measure, aggregate, put beside the floors, flag,
write.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from lagbench.atomic import atomic_path, check_writable
from lagbench.data.local import load_rooted_registry, resolve_root
from lagbench.data.registry import Registry
from lagbench.errors import UnreadableFileError, UsageError, suggest_name
from lagbench.metrics.aggregate import Score, Tally, aggregate
from lagbench.metrics.metric import Metric
from lagbench.metrics.table import available, ranking_metric, select
from lagbench.references import extrapolation
from lagbench.references.shipped import shipped
from lagbench.references.table import COUNTING
from lagbench.submission.findings import Finding, ValidationResult
from lagbench.submission.format import Anatomy, Header
from lagbench.submission.predictions import open_predictions
from lagbench.submission.validation import validate
from lagbench.work.machine import available_cores
from lagbench.work.progress import Meter, Progress
from lagbench.work.run import run_all

from .card import JSON_NAME, SUBMISSION, ScoreCard, read_scores, skill, spell
from .flags import Flag, below_twin_floor, copy_suspect, physics
from .references import measurable
from .scenario import ScenarioJob, ScenarioScores, score_scenario
from .score_file import NETCDF_NAME, write_statistics
from .task import ScoredTask, load_scored_task
from .usable import OF_NODES, few_nodes

PREDICTIONS = "predictions.nc"
"""The usual name of a submission; its scores lie beside it."""

WORTH_WORKERS = 1_000_000
"""Particles times predicted frames below which starting worker processes costs more
than it gains.
"""


def score(
    predictions: str | Path,
    *,
    root: str | Path | None = None,
    output_dir: str | Path | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    extras: Collection[str] = (),
    progress: Callable[[Progress], None] | None = None,
    examined: Callable[[ValidationResult], None] | None = None,
    registry: Registry | None = None,
    write: bool = True,
    validated: ValidationResult | None = None,
) -> ScoreCard:
    """Score a submission and write scores.json and scores.nc.

    Args:
        predictions: a predictions.nc.
        root: folder of all data sets; else LAGBENCH_ROOT, else the user data folder.
        output_dir: folder for the two files; by default that of a predictions.nc, and
            beside a file of another name the folder of that name.
        workers: worker processes; by default one per core where the work is worth it.
        scheduler: address of a Dask scheduler that takes the scenarios instead.
        extras: extras whose metrics are wanted too, as in ("transport",).
        progress: told how far the work is.
        examined: told what the validation found, before anything is raised for it.
        registry: where splits are described; ours when None.
        write: whether to write the two files.
        validated: what :func:`lagbench.validate` with ``require_truth`` said of this
            very file and root, if it was asked before; the file is not validated again.

    Returns:
        The score card; ``files`` names what was written.

    Raises:
        UsageError: an extra that brings no metrics, or that is not installed; scores of
            another method lie where these would go.
        UnreadableFileError: the predictions cannot be read.
        ChecksFailedError: they are not valid.
        DataError: they were made from another data set, or the test subset is missing
            or damaged.
        WorkFailedError: a worker or the cluster was lost, the disk is full, or the
            folder cannot be written to, which is seen before the work.
    """
    metrics = _chosen(extras)
    path = Path(predictions).absolute()
    holder = resolve_root(root)
    described = load_rooted_registry(holder, registry)
    if output_dir is None:
        folder = scores_folder(Path(predictions))
    else:
        folder = Path(output_dir)
    result = validated or validate(
        path, root=holder, require_truth=True, registry=described
    )
    if result.path != path:
        raise UsageError(
            "the validation is of another file", where=str(path), got=result.path
        )
    if examined is not None:
        examined(result)
    result.check()
    if write:
        check_writable(folder, option="--output")
    with open_predictions(path) as opened:
        header = opened.header
        anatomy = opened.anatomy
        content = result.sha256 or opened.content_sha256()
    if write:
        _check_own(folder / JSON_NAME, header)
    task = load_scored_task(described.size(header.split, header.size), holder)
    known = shipped(task.size) or {}
    floors = () if known else measurable(task.size, holder)
    outcomes = _outcomes(
        task,
        path,
        anatomy,
        tuple(m.name for m in metrics),
        floors,
        workers,
        scheduler,
        Meter(progress),
    )
    tallies = {
        row: {outcome.scenario: outcome.tallies[row] for outcome in outcomes}
        for row in outcomes[0].tallies
    }
    scores: dict[str, Mapping[str, Score]] = {
        row: aggregate(metrics, held) for row, held in tallies.items()
    }
    scores |= {name: floor.scores for name, floor in known.items()}
    ranking = ranking_metric(task.size)
    floored = {
        row: held[ranking]
        for row, held in scores.items()
        if row in COUNTING and ranking in held
    }
    preview = next(
        outcome.preview for outcome in outcomes if outcome.preview is not None
    )
    card = ScoreCard(
        header=header,
        predictions_sha256=content,
        setting=task.setting,
        ranking=ranking,
        tallies=tallies,
        scores=scores,
        skill=skill([scores[SUBMISSION][ranking]], floored),
        flags=_flags(task, outcomes, scores),
        warnings=(*result.warnings, *_undefined(task, tallies[SUBMISSION])),
        preview=preview,
    )
    if write:
        return _written(card, folder)
    return card


def scores_folder(predictions: Path) -> Path:
    """Return where the scores of a file go by default.

    >>> scores_folder(Path("runs/predictions.nc")).as_posix(), scores_folder(Path("runs/gns.nc")).as_posix()
    ('runs', 'runs/gns')
    """
    usual = predictions.name == PREDICTIONS
    if usual:
        return predictions.parent
    return predictions.parent / predictions.stem


def _check_own(path: Path, header: Header) -> None:
    """Refuse to write over scores of another method or data set."""
    if not path.exists():
        return
    try:
        held = read_scores(path).identity
        found = " ".join(held[name] for name in ("method", "split", "size"))
    except UnreadableFileError:
        found = "something else"
    own = f"{header.method} {header.split} {header.size}"
    if found != own:
        raise UsageError(
            "the scores of another submission lie there",
            where=str(path),
            expected=f"no such file, or the scores of {own}",
            got=found,
            fix="keep them: --output FOLDER; or remove them first",
        )


def _undefined(task: ScoredTask, held: Mapping[int, Tally]) -> Iterator[Finding]:
    """Warn where the vorticity of all scenarios, or of any where it ranks, has too few
    nodes throughout.
    """
    lost = [i for i, tally in held.items() if not _has_nodes(tally)]
    if lost and (ranking_metric(task.size) == OF_NODES or len(lost) == len(held)):
        yield few_nodes(task, lost)


def _has_nodes(tally: Tally) -> bool:
    """Tell whether the vorticity was compared in any frame, if it was measured."""
    if "vorticity_mse" not in tally.names:
        return True
    return bool(tally.weight[tally.names.index("vorticity_mse")].any())


def _written(card: ScoreCard, folder: Path) -> ScoreCard:
    json_path = folder / JSON_NAME
    netcdf_path = folder / NETCDF_NAME
    with atomic_path(
        json_path, option="--output"
    ) as temporary:  # both, or neither where the disk is full
        temporary.write_bytes(spell(card))
        write_statistics(card, netcdf_path)
    return card.at(json_path, netcdf_path)


def _chosen(extras: Collection[str]) -> tuple[Metric, ...]:
    """Return the metrics to measure; refuse an extra that brings none."""
    known = {metric.extra for metric in available().values() if metric.extra}
    if isinstance(extras, str):
        extras = (extras,)
    else:
        extras = extras
    for extra in extras:
        if extra not in known:
            raise UsageError(
                f"no extra {extra!r} with metrics",
                where="--extras",
                fix=suggest_name(extra, known),
            )
    return select(extras=extras)


def _outcomes(
    task: ScoredTask,
    path: Path,
    anatomy: Anatomy,
    metrics: tuple[str, ...],
    floors: tuple[str, ...],
    workers: int | None,
    scheduler: str | None,
    meter: Meter,
) -> list[ScenarioScores]:
    """Return what was measured of every scenario, by ascending id."""
    ids = task.scenarios
    horizon = task.setting.horizon
    jobs = {
        f"scenario {i}": ScenarioJob(
            task=task,
            scenario=i,
            predictions=path,
            anatomy=anatomy,
            metrics=metrics,
            floors=floors,
            pictured=i == ids[0],
        )
        for i in ids
    }
    if workers is None:
        worth = len(ids) * horizon * task.size.particles >= WORTH_WORKERS
        if worth:
            workers = available_cores()
        else:
            workers = 1
    meter.begin("scoring", total=len(ids) * horizon, scenarios=len(ids))
    return run_all(
        score_scenario, jobs, workers=workers, scheduler=scheduler, report=meter.count
    )


def _flags(
    task: ScoredTask,
    outcomes: Sequence[ScenarioScores],
    scores: Mapping[str, Mapping[str, Score]],
) -> tuple[Flag, ...]:
    traces = [outcome.trace for outcome in outcomes]
    error, still = (
        np.asarray(np.mean(scores[row]["position_rmse"].per_frame, axis=0))
        for row in (SUBMISSION, extrapolation.PERSISTENCE.name)
    )
    return (
        copy_suspect(traces),
        below_twin_floor(error, still, task.twin_floor),
        physics(traces),
    )
