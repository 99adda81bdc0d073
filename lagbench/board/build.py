"""Build the leaderboard: read entries and score files, form every number anew, write
the page.

What the YAML files say of scores is not used; ``lagbench leaderboard check`` compares
it.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lagbench.atomic import write_atomically
from lagbench.data.registry import Registry, Size, load
from lagbench.errors import (
    ChecksFailedError,
    DataError,
    UnreadableFileError,
    UsageError,
)
from lagbench.figures.html import tag
from lagbench.metrics.aggregate import Score
from lagbench.metrics.metric import mean
from lagbench.metrics.significance import (
    FEWEST_SCENARIOS,
    Standing,
    mean_loss,
    standings,
)
from lagbench.metrics.table import METRICS
from lagbench.references.shipped import ReferenceScores, solver_seconds
from lagbench.references.table import COUNTING, REFERENCES
from lagbench.scoring.card import Preview, skill
from lagbench.scoring.stored import Stored, read_stored, reported_frames
from lagbench.submission.task_checks import frames_to_predict

from .entry import Cost, Entry, Status, Verification
from .entry_file import read_entry, read_verified, schema_bytes, verification_of
from .findings import CHECKS
from .folder import PAGE, SCHEMA, Folder
from .model import Board, Curve, Histogram, Pictures, ReferenceRow, Row, Tab, Value
from .page import LINKS, render
from .payload import spaced
from .ranking import Combined, combine, is_current, read_references

COLUMNS = (
    *(
        "vorticity_nrmse",
        "cloud_distance",
        "vorticity_rmse",
        "mse_avg",
        "vorticity_pearson",
    ),
    *(
        "stable_frames",
        "position_rmse_20",
        "position_rmse",
        "spectrum_error",
        "velocity_rmse",
    ),
    *("density_rmse", "momentum_error", "shape_error", "connectivity", "sliced_w2"),
)
"""Metrics to show at first where a data set has them, the ranking one aside."""

CURVES = (
    *(
        "vorticity_rmse",
        "attribute_mse",
        "position_rmse",
        "vorticity_pearson",
        "energy_ratio",
    ),
    *("density_rmse", "divergence_rms"),
)
"""Metrics that details have curves of, beside the ranking one."""

TRIAL = "tiny"  # the size for trying out: nobody is asked to submit to it

ENERGIES = ("energy_true", "energy_predicted")

TRUTH = 0
PREDICTION = 1  # sides of a preview
CURVE_FRAMES = 120  # most frames of a curve
RESIDUAL_BINS = 41  # bins of the histogram of residuals; odd, so that one holds 0


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
    only: Collection[tuple[str, str]] | None = None,
    registry: Registry | None = None,
) -> Board:
    """Return the board of a leaderboard's folder; of some (split, size) ``only``, or of
    all.
    """
    place = Folder(folder)
    described = registry or load()
    place.require()
    found: dict[tuple[str, str], list[_Held]] = {}
    for path in place.entries():
        if only is not None and path.parts[1:3] not in only:
            continue
        entry = read_entry(place.path / path)
        if entry.yaml_path != path:
            what = "an entry lies in another place than it says"
            expected = str(entry.yaml_path)
            raise ChecksFailedError(
                what, where=str(path), expected=expected, fix=CHECKS["place"].fix
            )
        try:
            size = described.size(entry.split, entry.size)
        except UsageError as error:
            missing = "install the package that adds the split; lagbench list names those that are known"
            if entry.split in described.splits:
                fix = error.fix
            else:
                fix = missing
            where = str(place.path / path)
            raise DataError(
                error.what, where=where, expected=error.expected, fix=fix
            ) from error
        current = is_current(entry.dataset, size)
        try:
            stored = [
                read_stored(place.path / path, size) for path in entry.score_paths
            ]
        except UnreadableFileError:
            if current:
                raise
            continue  # old scores that do not fit the task of today
        scores = combine([held.scores for held in stored])
        if lacking := [
            name for name in (stored[0].scores.ranking, *ENERGIES) if name not in scores
        ]:
            what = "a score file lacks metrics that every one has"
            file = place.path / entry.score_paths[0]
            fix = "score the predictions again: lagbench submit"
            raise UnreadableFileError(
                what, where=str(file), expected=", ".join(lacking), fix=fix
            )
        held = _Held(entry=entry, current=current, stored=stored, scores=scores)
        found.setdefault((entry.split, entry.size), []).append(held)
    verified = read_verified(place)
    tabs = []
    empty = []
    for split, about in described.splits.items():
        for name in about.sizes:
            if only is not None and (split, name) not in only:
                continue
            size = described.size(split, name)
            if (split, name) in found:
                floors = read_references(place, size)
                tabs.append(
                    _tab(size, about.title, found[split, name], floors, verified)
                )
            elif name != TRIAL and len(size.subsets["test"]) >= FEWEST_SCENARIOS:
                empty.append((split, name))
    seen = {name for tab in tabs for row in tab.lines for name in row.values}
    metrics = {name: metric for name, metric in METRICS.items() if name in seen}
    return Board(tabs=tuple(tabs), empty=tuple(empty), metrics=metrics)


def _tab(
    size: Size,
    title: str,
    found: Sequence[_Held],
    floors: Sequence[ReferenceScores],
    verified: Mapping[str, Verification],
) -> Tab:
    # maps of truth and prediction share one packing: an explosion leaves nothing of the
    # truth
    witness = min(found, key=lambda held: (held.stored[0].precision, held.entry.method))
    ranking = witness.stored[0].scores.ranking
    ranked = {
        held.entry.method: held.scores[ranking].seeds
        for held in found
        if held.current
        and held.entry.status is Status.ACTIVE
        and ranking in held.scores
    }
    places = standings(ranked)

    def order(held: _Held) -> tuple[bool, float, str]:
        if ranking in held.scores:
            loss = mean_loss(held.scores[ranking].seeds)
        else:
            loss = math.inf
        return held.entry.method not in ranked, loss, held.entry.method

    rows = [
        _row(
            held,
            size,
            places.get(held.entry.method),
            verification_of(held.entry, verified),
            floors,
        )
        for held in sorted(found, key=order)
    ]
    shown = {name for row in rows for name in row.values}
    curved = {name for row in rows for name in row.curves}
    scenarios = tuple(sorted(size.subsets["test"]))
    return Tab(
        size=size,
        title=title,
        scenarios=scenarios,
        frames=tuple(frames_to_predict(size)),
        marked=reported_frames(size),
        ranking=ranking,
        decided=len(scenarios) >= FEWEST_SCENARIOS,
        columns=tuple(
            name for name in dict.fromkeys((ranking, *COLUMNS)) if name in shown
        ),
        curves=tuple(name for name in _with_curves(ranking) if name in curved),
        energy=curve(witness.scores[ENERGIES[0]].score),
        truth=_pictures(witness.stored[0].preview, TRUTH),
        rows=tuple(rows),
        floors=tuple(_floor(held, size, ranking) for held in floors),
        solver_seconds=solver_seconds(size),
    )


def _row(
    held: _Held,
    size: Size,
    standing: Standing | None,
    verified: Verification | None,
    floors: Sequence[ReferenceScores],
) -> Row:
    preview = held.stored[0].preview
    ranking = held.stored[0].scores.ranking
    scores = {name: found.score for name, found in held.scores.items()}
    known = {
        f.name: f.scores[ranking]
        for f in floors
        if f.name in COUNTING and ranking in f.scores
    }
    better = None
    if held.current and (found := skill(held.scores[ranking].seeds, known)) is not None:
        low, high = found.interval
        better = Value(
            mean=found.value,
            std=found.std,
            low=low,
            high=high,
            per_scenario=(),
            at={},
            undefined=0,
        )
    return Row(
        entry=held.entry,
        current=held.current,
        rank=standing.rank if standing else None,
        tied=standing is not None and standing.tied and not math.isnan(standing.p),
        p=standing.p if standing else math.nan,
        verified=verified,
        skill=better,
        values={
            name: _value(one.score, one.interval, one.std, size)
            for name, one in held.scores.items()
        },
        seed_means=held.scores[ranking].means,
        curves=_curves(scores, ranking),
        energy=curve(scores[ENERGIES[1]]),
        pictures=_pictures(preview, PREDICTION),
        residuals=residuals(preview),
    )


def _floor(held: ReferenceScores, size: Size, ranking: str) -> ReferenceRow:
    energy = held.scores.get(ENERGIES[1])
    about = REFERENCES[held.name]
    cost = Cost.model_construct(
        seconds_per_frame=held.seconds_per_frame,
        device="one core, where the floors were measured",
        solver_seconds_per_frame=solver_seconds(size),
    )
    return ReferenceRow(
        name=held.name,
        definition=about.definition,
        values={
            name: _value(score, score.interval, math.nan, size)
            for name, score in held.scores.items()
        },
        curves=_curves(held.scores, ranking),
        energy=curve(energy)
        if energy is not None and np.isfinite(energy.per_frame).mean() > 0.5
        else None,
        counts=about.counts,
        cost=None if math.isnan(held.seconds_per_frame) else cost,
    )


def _value(
    score: Score, interval: tuple[float, float], std: float, size: Size
) -> Value:
    low, high = interval
    frames = [frame for frame in reported_frames(size) if frame in score.frames]
    return Value(
        mean=score.mean,
        std=std,
        low=low,
        high=high,
        per_scenario=tuple(score.values.tolist()),
        at={frame: mean(score.at(frame)) for frame in frames}
        if score.metric.per_frame
        else {},
        undefined=sum(score.undefined),
    )


def _with_curves(ranking: str) -> dict[str, None]:
    """Return the metrics to draw over frames, the ranking one or what stands for it
    first.
    """
    return dict.fromkeys((ranking, *METRICS[ranking].of, *CURVES))


def _curves(scores: Mapping[str, Score], ranking: str) -> dict[str, Curve]:
    known = {name: scores[name] for name in _with_curves(ranking) if name in scores}
    return {
        name: curve(score)
        for name, score in known.items()
        if score.metric.per_frame and score.frames
    }


def curve(score: Score) -> Curve:
    """Return the mean of a metric over scenarios per frame, and the lowest and highest
    of them.

    Some metrics have a value at every tenth frame: the others are left out, they are no
    gaps.
    """
    measured = np.flatnonzero(np.isfinite(score.per_frame).any(axis=0))
    step = int(np.diff(measured).min(initial=len(score.frames)))
    sampled = range(
        int(measured[0]) % step if len(measured) else 0, len(score.frames), step
    )
    chosen = [sampled[i] for i in spaced(len(sampled), CURVE_FRAMES)]
    values = score.per_frame[:, chosen]
    with warnings.catch_warnings():
        # a frame where nothing is defined is NaN
        warnings.simplefilter("ignore", RuntimeWarning)
        middle = np.nanmean(values, axis=0)
        low = np.nanmin(values, axis=0)
        high = np.nanmax(values, axis=0)
    return Curve(
        frames=tuple(score.frames[i] for i in chosen), mean=middle, low=low, high=high
    )


def _pictures(preview: Preview, side: int) -> Pictures:
    ranges = preview.histogram_range.astype(np.float64).tolist()
    shares = preview.histogram[side].astype(np.float64)
    return Pictures(
        scenario=preview.scenario,
        map_frames=preview.map_frames,
        vorticity=preview.vorticity[side],
        histograms=tuple(
            Histogram(low=a, high=b, shares=s)
            for (a, b), s in zip(ranges, shares, strict=True)
        ),
        film_frames=preview.film_frames,
        material=preview.material,
        film=preview.film[side],
    )


def residuals(preview: Preview) -> tuple[Histogram, ...]:
    """Return shares of predicted minus true vorticity at each map frame, over +- its
    greatest.
    """
    truth, prediction = preview.vorticity.astype(np.float64)
    found = []
    for difference in prediction - truth:
        values = difference[~np.isnan(difference)]
        end = float(np.max(np.abs(values), initial=0.0))
        half = RESIDUAL_BINS // 2
        # a field without any error is one bin, not a division by 0
        bins = np.rint((values / end if end else values) * half).astype(int) + half
        counts = np.bincount(bins, minlength=RESIDUAL_BINS)
        if values.size:
            shares = counts / values.size
        else:
            shares = np.full(RESIDUAL_BINS, np.nan)
        found.append(
            Histogram(low=-end if values.size else 0.0, high=end, shares=shares)
        )
    return tuple(found)


@dataclass(frozen=True, kw_only=True)
class BuildResult:
    """A page that was drawn."""

    page: Path
    bytes: int
    tabs: int  # splits and sizes on it
    rows: int  # entries on it
    written: tuple[Path, ...]  # files that were missing or had other bytes


def build(
    board: str | Path, *, check: bool = False, registry: Registry | None = None
) -> BuildResult:
    """Write page and schema.json where they are stale; with ``check`` nothing: what is
    stale is an error.
    """
    folder = Folder(board)
    held = collect(board, registry=registry)
    links = {
        label: path for label, path in LINKS.items() if (folder.path / path).exists()
    }
    page = folder.path / PAGE
    if (
        check and page.is_file()
    ):  # a copy of the folder elsewhere still has the links of where it was drawn
        said = page.read_bytes()
        links = {
            n: path
            for n, path in LINKS.items()
            if str(tag("a", n, href=path)).encode() in said
        }
    wanted = {page: render(held, links).encode(), folder.path / SCHEMA: schema_bytes()}
    stale = [
        path
        for path, data in wanted.items()
        if path.is_symlink() or not path.is_file() or path.read_bytes() != data
    ]
    if stale and check:
        raise ChecksFailedError(
            "the page is not what the submissions give",
            where=", ".join(str(path) for path in stale),
            expected=", ".join(
                f"{path.name} of {len(wanted[path])} bytes" for path in stale
            ),
            got="another content, or no file",
            fix=f"lagbench leaderboard build --board {board}",
        )
    for path in stale:
        write_atomically(path, wanted[path], option="--board")
    return BuildResult(
        page=page,
        bytes=len(wanted[page]),
        tabs=len(held.tabs),
        rows=sum(len(tab.rows) for tab in held.tabs),
        written=tuple(stale),
    )
