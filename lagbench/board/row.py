"""One row of the board and its detail, from an entry and the score files of its seeds."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from lagbench.data.registry import Size
from lagbench.metrics import mean

from .entry import Entry, FlagEntry
from .model import Cost, Detail, Prediction, RaisedFlag, Row, Value
from .pictures import PREDICTION, curve, pictures, residuals
from .seeds import Combined
from .standing import Standing
from .stored import Stored

__all__ = ["CURVES", "Ingredients", "make_row"]

CURVES = (
    *("vorticity_rmse", "attribute_mse", "position_rmse", "vorticity_pearson", "energy_ratio"),
    *("density_rmse", "divergence_rms"),
)
"""Metrics that details have curves of."""

ENERGY = "energy_predicted"


@dataclass(frozen=True, kw_only=True, eq=False)
class Ingredients:
    """What a row is made of."""

    entry: Entry  # the YAML file
    current: bool  # whether its data set is that of today
    stored: Sequence[Stored]  # score file of each seed
    scores: Mapping[str, Combined]  # scores by metric, all seeds together


def make_row(held: Ingredients, standing: Standing | None, size: Size) -> Row:
    """Return a row."""
    entry, files = held.entry, held.entry.score.files
    return Row(
        id=entry.method,
        name=entry.name,
        authors=entry.authors,
        affiliation=entry.affiliation,
        licence=entry.licence,
        code=entry.code,
        paper=entry.paper,
        date=entry.date.isoformat(),
        floor=entry.floor,
        status=str(entry.status),
        superseded_by=entry.superseded_by,
        reason=entry.reason,
        current=held.current,
        dataset_version=entry.dataset.version,
        rank=standing.rank if standing else None,
        shared=standing.shared if standing else False,
        p=standing.p if standing else math.nan,
        seeds=len(entry.predictions),
        parameters=entry.parameters,
        cost=_cost(entry),
        flags=_raised([flag for file in files for flag in file.flags]),
        warnings=_raised([warning for file in files for warning in file.warnings]),
        diverged=sum(len(file.diverged_at) for file in files),
        values={name: _value(found, size) for name, found in held.scores.items()},
        detail=_detail(held),
    )


def _cost(entry: Entry) -> Cost | None:
    given = entry.cost
    if given is None:
        return None
    solver = given.solver_seconds_per_frame
    return Cost(
        seconds_per_frame=given.seconds_per_frame,
        device=given.device,
        solver_seconds_per_frame=solver,
        speed_up=None if solver is None else solver / given.seconds_per_frame,
    )


def _raised(found: Sequence[FlagEntry]) -> tuple[RaisedFlag, ...]:
    """Return flags by name, each once, with the reasons that any seed gave."""
    reasons: dict[str, dict[str, None]] = {}
    for flag in found:
        reasons.setdefault(flag.name, {}).update(dict.fromkeys(flag.reasons))
    return tuple(RaisedFlag(name=name, reasons=tuple(held)) for name, held in reasons.items())


def _value(found: Combined, size: Size) -> Value:
    score = found.score
    low, high = score.interval
    frames = {*size.task.frames_of_interest, score.frames[-1]}.intersection(score.frames)
    return Value(
        mean=score.mean,
        std=found.std,
        low=low,
        high=high,
        per_scenario=tuple(score.values.tolist()),
        at={frame: mean(score.at(frame)) for frame in sorted(frames)} if score.metric.per_frame else {},
        undefined=sum(score.undefined),
    )


def _detail(held: Ingredients) -> Detail:
    entry, preview = held.entry, held.stored[0].preview
    return Detail(
        curves={name: curve(held.scores[name].score) for name in CURVES if name in held.scores},
        energy=curve(held.scores[ENERGY].score),
        pictures=pictures(preview, PREDICTION),
        residuals=residuals(preview),
        command=entry.command,
        training=entry.training,
        hardware=entry.hardware,
        notes=entry.notes,
        predictions=_predictions(held),
        scored_by=entry.score.scored_by,
        lagbench_version=entry.score.lagbench,
    )


def _predictions(held: Ingredients) -> tuple[Prediction, ...]:
    entry = held.entry
    means = held.scores[held.stored[0].scores.ranking].means
    return tuple(
        Prediction(
            seed=made.seed,
            sha256=made.sha256,
            url=made.url,
            path=made.path,
            size=made.bytes,
            score_file=path.as_posix(),
            mean=value,
        )
        for made, path, value in zip(entry.predictions, entry.score_paths, means, strict=True)
    )
