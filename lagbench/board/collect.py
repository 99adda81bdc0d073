"""Read entries and score files, and form the board: every number from score files anew.

What the YAML files say of scores is not used; ``lagbench leaderboard check`` compares it.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lagbench.data.registry import Registry, Size, load
from lagbench.errors import ChecksFailedError, UnreadableFileError
from lagbench.floors.shipped import FloorScores, solver_seconds
from lagbench.floors.table import FLOORS
from lagbench.metrics.aggregate import Score
from lagbench.metrics.metric import mean
from lagbench.metrics.significance import FEWEST_SCENARIOS, Standing, mean_loss, standings
from lagbench.metrics.table import METRICS
from lagbench.scoring.scenario import Preview
from lagbench.scoring.skill import skill
from lagbench.submission.task_checks import frames_to_predict

from .entry import Cost, Entry, Status
from .entry_file import read_entry
from .floors import read_floors
from .folder import Folder
from .model import Board, Curve, Floor, Histogram, Pictures, Row, Tab, Value
from .payload import spaced
from .ranking import Combined, combine, is_current
from .score_file import Stored, read_stored, reported_frames
from .verified import Verification, read_verified, verification_of

__all__ = ["COLUMNS", "CURVES", "CURVE_FRAMES", "RESIDUAL_BINS", "collect", "curve", "residuals"]

COLUMNS = (
    *("vorticity_nrmse", "cloud_distance", "vorticity_rmse", "mse_avg", "vorticity_pearson"),
    *("stable_frames", "position_rmse_20", "position_rmse", "spectrum_error", "velocity_rmse"),
    *("density_rmse", "momentum_error", "shape_error", "connectivity", "sliced_w2"),
)
"""Metrics to show at first where a data set has them, the ranking one aside."""

CURVES = (
    *("vorticity_rmse", "attribute_mse", "position_rmse", "vorticity_pearson", "energy_ratio"),
    *("density_rmse", "divergence_rms"),
)
"""Metrics that details have curves of, beside the ranking one."""

TRIAL = "tiny"
"""The size for trying out: nobody is asked to submit to it."""

ENERGIES = ("energy_true", "energy_predicted")

TRUTH, PREDICTION = 0, 1
"""Sides of a preview."""

CURVE_FRAMES = 120
"""Most frames of a curve."""

RESIDUAL_BINS = 41
"""Bins of the histogram of residuals; odd, so that one holds 0."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Held:
    """What a row is made of."""

    entry: Entry
    current: bool
    stored: Sequence[Stored]  # score file of each seed
    scores: Mapping[str, Combined]  # by metric, all seeds together


def collect(
    folder: str | Path,
    *,
    registry: Registry | None = None,
    report: Callable[[int], None] = lambda _: None,
) -> Board:
    """Return the board of a leaderboard's folder.

    Args:
        folder: the leaderboard's folder.
        registry: where splits are described; ours when None.
        report: told the entries done.

    Raises:
        UsageError: no leaderboard there.
        UnreadableFileError: an entry or a score file cannot be read.
        ChecksFailedError: an entry does not fit the schema or lies in another place.
    """
    place, described = Folder(folder), registry or load()
    place.require()
    found: dict[tuple[str, str], list[_Held]] = {}
    for path in place.entries():
        entry = read_entry(place.path / path)
        if entry.yaml_path != path:
            raise ChecksFailedError(
                "an entry lies in another place than it says",
                where=str(path),
                expected=str(entry.yaml_path),
                fix="let split, size and method be those of the path",
            )
        held = _held(place, entry, described.size(entry.split, entry.size))
        if held is not None:
            found.setdefault((entry.split, entry.size), []).append(held)
        report(1)
    verified, tabs, empty = read_verified(place), [], []
    for split, about in described.splits.items():
        for name in about.sizes:
            size = described.size(split, name)
            if (split, name) in found:
                floors = read_floors(place, size)
                tabs.append(_tab(size, about.title, found[split, name], floors, verified))
            elif name != TRIAL and len(size.subsets["test"]) >= FEWEST_SCENARIOS:
                empty.append((split, name))
    seen = {name for tab in tabs for row in tab.lines for name in row.values}
    metrics = {name: metric for name, metric in METRICS.items() if name in seen}
    return Board(tabs=tuple(tabs), empty=tuple(empty), metrics=metrics)


def _held(place: Folder, entry: Entry, size: Size) -> _Held | None:
    """Return what a row is made of; None for old scores that do not fit the task of today."""
    current = is_current(entry.dataset, size)
    try:
        stored = [read_stored(place.path / path, size) for path in entry.score_paths]
    except UnreadableFileError:
        if current:
            raise
        return None
    scores = combine([held.scores for held in stored])
    lacking = [name for name in (stored[0].scores.ranking, *ENERGIES) if name not in scores]
    if lacking:
        raise UnreadableFileError(
            "a score file lacks metrics that every one has",
            where=str(place.path / entry.score_paths[0]),
            expected=", ".join(lacking),
            fix="score the predictions again: lagbench submit",
        )
    return _Held(entry=entry, current=current, stored=stored, scores=scores)


def _tab(
    size: Size,
    title: str,
    found: Sequence[_Held],
    floors: Sequence[FloorScores],
    verified: Mapping[str, Verification],
) -> Tab:
    # maps of truth and prediction share one packing: an explosion leaves nothing of the truth
    witness = min(found, key=lambda held: (held.stored[0].precision, held.entry.method))
    ranking = witness.stored[0].scores.ranking
    ranked = {
        held.entry.method: held.scores[ranking].seeds
        for held in found
        if held.current and held.entry.status is Status.ACTIVE and ranking in held.scores
    }
    places = standings(ranked)

    def order(held: _Held) -> tuple[bool, float, str]:
        loss = mean_loss(held.scores[ranking].seeds) if ranking in held.scores else math.inf
        return held.entry.method not in ranked, loss, held.entry.method

    rows = [
        _row(held, size, places.get(held.entry.method), verification_of(held.entry, verified), floors)
        for held in sorted(found, key=order)
    ]
    shown = {name for row in rows for name in row.values}
    standing_for = (ranking, *METRICS[ranking].of, *CURVES)
    frames, scenarios = tuple(frames_to_predict(size)), tuple(sorted(size.subsets["test"]))
    return Tab(
        size=size,
        title=title,
        scenarios=scenarios,
        frames=frames,
        marked=reported_frames(size),
        ranking=ranking,
        decided=len(scenarios) >= FEWEST_SCENARIOS,
        columns=_known((ranking, *COLUMNS), shown),
        curves=_known(standing_for, {name for row in rows for name in row.curves}),
        energy=curve(witness.scores[ENERGIES[0]].score),
        truth=_pictures(witness.stored[0].preview, TRUTH),
        rows=tuple(rows),
        floors=tuple(_floor(held, size, ranking) for held in floors),
        solver_seconds=solver_seconds(size),
    )


def _known(names: Iterable[str], known: set[str]) -> tuple[str, ...]:
    return tuple(name for name in dict.fromkeys(names) if name in known)


def _row(
    held: _Held,
    size: Size,
    standing: Standing | None,
    verified: Verification | None,
    floors: Sequence[FloorScores],
) -> Row:
    preview, ranking = held.stored[0].preview, held.stored[0].scores.ranking
    scores = {name: found.score for name, found in held.scores.items()}
    return Row(
        entry=held.entry,
        current=held.current,
        rank=standing.rank if standing else None,
        tied=standing is not None and standing.tied and not math.isnan(standing.p),
        p=standing.p if standing else math.nan,
        verified=verified,
        skill=_skill(held.scores[ranking], floors) if held.current else None,
        values={
            name: _value(found.score, found.interval, found.std, size) for name, found in held.scores.items()
        },
        seed_means=held.scores[ranking].means,
        curves=_curves(scores, ranking),
        energy=curve(scores[ENERGIES[1]]),
        pictures=_pictures(preview, PREDICTION),
        residuals=residuals(preview),
    )


def _skill(scores: Combined, floors: Sequence[FloorScores]) -> Value | None:
    """Return how much better a row is than the best floor, over its seeds."""
    name = scores.score.metric.name
    known = {floor.name: floor.scores[name] for floor in floors if name in floor.scores}
    found = skill(scores.seeds, known)
    if found is None:
        return None
    low, high = found.interval
    return Value(mean=found.value, std=found.std, low=low, high=high, per_scenario=(), at={}, undefined=0)


def _floor(held: FloorScores, size: Size, ranking: str) -> Floor:
    energy, about = held.scores.get(ENERGIES[1]), FLOORS[held.name]
    return Floor(
        name=held.name,
        definition=about.definition,
        values={name: _value(score, score.interval, math.nan, size) for name, score in held.scores.items()},
        curves=_curves(held.scores, ranking),
        energy=curve(energy) if energy is not None and np.isfinite(energy.per_frame).mean() > 0.5 else None,
        counts=about.counts,
        cost=None if math.isnan(held.seconds_per_frame) else _cost(held.seconds_per_frame, size),
    )


def _cost(seconds: float, size: Size) -> Cost:
    return Cost.model_construct(
        seconds_per_frame=seconds,
        device="one core, where the floors were measured",
        solver_seconds_per_frame=solver_seconds(size),
    )


def _value(score: Score, interval: tuple[float, float], std: float, size: Size) -> Value:
    low, high = interval
    frames = [frame for frame in reported_frames(size) if frame in score.frames]
    return Value(
        mean=score.mean,
        std=std,
        low=low,
        high=high,
        per_scenario=tuple(score.values.tolist()),
        at={frame: mean(score.at(frame)) for frame in frames} if score.metric.per_frame else {},
        undefined=sum(score.undefined),
    )


def _curves(scores: Mapping[str, Score], ranking: str) -> dict[str, Curve]:
    names = dict.fromkeys((ranking, *METRICS[ranking].of, *CURVES))
    known = {name: scores[name] for name in names if name in scores}
    return {name: curve(score) for name, score in known.items() if score.metric.per_frame and score.frames}


def curve(score: Score) -> Curve:
    """Return the mean of a metric over scenarios per frame, and the lowest and highest of them."""
    chosen = spaced(len(score.frames), CURVE_FRAMES)
    values = score.per_frame[:, chosen]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a frame where nothing is defined is NaN
        middle, low, high = np.nanmean(values, axis=0), np.nanmin(values, axis=0), np.nanmax(values, axis=0)
    return Curve(frames=tuple(score.frames[i] for i in chosen), mean=middle, low=low, high=high)


def _pictures(preview: Preview, side: int) -> Pictures:
    ranges = preview.histogram_range.astype(np.float64).tolist()
    shares = preview.histogram[side].astype(np.float64)
    return Pictures(
        scenario=preview.scenario,
        map_frames=preview.map_frames,
        vorticity=preview.vorticity[side],
        histograms=tuple(
            Histogram(low=a, high=b, shares=s) for (a, b), s in zip(ranges, shares, strict=True)
        ),
        film_frames=preview.film_frames,
        material=preview.material,
        film=preview.film[side],
    )


def residuals(preview: Preview) -> tuple[Histogram, ...]:
    """Return the histogram of predicted minus true vorticity at each map frame."""
    truth, prediction = preview.vorticity.astype(np.float64)
    return tuple(_histogram((p - t)[~np.isnan(p - t)]) for t, p in zip(truth, prediction, strict=True))


def _histogram(values: NDArray[np.float64]) -> Histogram:
    """Return shares over +-max abs value; NaN without values."""
    if not values.size:
        return Histogram(low=0.0, high=0.0, shares=np.full(RESIDUAL_BINS, np.nan))
    end = float(np.max(np.abs(values)))
    # a field without any error is one bin, not a division by 0
    bins = np.rint((values / end if end else values) * (RESIDUAL_BINS // 2)).astype(int) + RESIDUAL_BINS // 2
    counts = np.bincount(bins, minlength=RESIDUAL_BINS)
    return Histogram(low=-end, high=end, shares=counts / values.size)
