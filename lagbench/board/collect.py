"""Read submissions and score files, and form the board: every number from score files anew.

What the YAML files say of scores is not used; ``lagbench leaderboard check`` compares it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from lagbench.data.registry import Registry, Size, load
from lagbench.errors import ChecksFailedError, UnreadableFileError
from lagbench.floors import FLOORS
from lagbench.metrics import METRICS
from lagbench.metrics.comparison import FEWEST_SCENARIOS
from lagbench.submission.task_checks import frames_to_predict

from .entry import Entry
from .entry_file import read_entry
from .folder import Folder
from .model import Board, Row, Tab
from .pictures import TRUTH, curve, pictures
from .row import CURVES, Ingredients, make_row
from .seeds import combine
from .standing import is_current, is_ranked, mean_loss, standings
from .stored import read_stored

__all__ = ["COLUMNS", "collect"]

COLUMNS = (
    *("vorticity_rmse", "mse_avg", "vorticity_pearson", "stable_frames", "position_rmse", "velocity_rmse"),
    *("energy_error", "density_rmse", "momentum_error", "shape_error", "connectivity", "sliced_w2"),
)
"""Metrics to show at first, the ranking one aside."""

ENERGIES = ("energy_true", "energy_predicted")


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
    found: dict[tuple[str, str], list[Ingredients]] = {}
    for path in place.entries():
        entry = _entry(place, path)
        size = described.size(entry.split, entry.size)
        held = _ingredients(place, entry, size)
        if held is not None:
            found.setdefault((entry.split, entry.size), []).append(held)
        report(1)
    order = [(split, size) for split, held in described.splits.items() for size in held.sizes]
    tabs = [
        _tab(described.size(*key), described.split(key[0]).title, found[key]) for key in order if key in found
    ]
    seen = {name for tab in tabs for row in tab.rows for name in row.values}
    return Board(tabs=tuple(tabs), metrics={name: metric for name, metric in METRICS.items() if name in seen})


def _entry(place: Folder, path: Path) -> Entry:
    entry = read_entry(place.path / path)
    if entry.yaml_path != path:
        raise ChecksFailedError(
            "an entry lies in another place than it says",
            where=str(path),
            expected=str(entry.yaml_path),
            fix="let split, size and method be those of the path",
        )
    return entry


def _ingredients(place: Folder, entry: Entry, size: Size) -> Ingredients | None:
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
    return Ingredients(entry=entry, current=current, stored=stored, scores=scores)


def _tab(size: Size, title: str, found: Sequence[Ingredients]) -> Tab:
    witness = min(found, key=_trust)
    ranking, scenarios = witness.stored[0].scores.ranking, tuple(sorted(size.subsets["test"]))
    ranked = {
        held.entry.method: held.scores[ranking].score
        for held in found
        if is_ranked(held.entry, size) and ranking in held.scores
    }
    places = standings(ranked)
    frames = tuple(frames_to_predict(size))
    order = sorted(found, key=lambda held: _order(held, ranking, set(ranked)))
    rows = tuple(make_row(held, places.get(held.entry.method), size) for held in order)
    return Tab(
        split=size.split,
        size=size.name,
        title=title,
        dataset_version=size.version,
        dataset_sha256=size.measured.dataset_sha256 if size.measured else witness.entry.dataset.sha256,
        particles=size.particles,
        input_frames=size.task.input_frames,
        frames=frames,
        frames_of_interest=tuple(sorted({*size.task.frames_of_interest, frames[-1]}.intersection(frames))),
        frame_interval=size.frame_interval,
        scenarios=scenarios,
        ranking=ranking,
        decided=len(scenarios) >= FEWEST_SCENARIOS,
        columns=_present(dict.fromkeys((ranking, *COLUMNS)), rows),
        curves=_present(sorted(CURVES, key=lambda name: name != _per_frame(ranking)), rows),
        energy=curve(witness.scores[ENERGIES[0]].score),
        truth=pictures(witness.stored[0].preview, TRUTH),
        rows=rows,
    )


def _trust(held: Ingredients) -> tuple[int, float, str]:
    """Order by whose picture of the truth to take: a floor's first, then the finest packed.

    Maps of truth and prediction share one packing, so that a prediction that explodes leaves
    nothing of the truth.
    """
    method = held.entry.method
    floor = list(FLOORS).index(method) if method in FLOORS else len(FLOORS)
    return floor, held.stored[0].precision, method


def _order(held: Ingredients, ranking: str, ranked: set[str]) -> tuple[int, float, str]:
    """Order rows: ranked ones by their mean, floors, then what is not ranked."""
    method = held.entry.method
    group = 0 if method in ranked else 1 if held.entry.floor else 2
    loss = mean_loss(held.scores[ranking].score) if ranking in held.scores else math.inf
    return group, loss, method


def _present(names: Sequence[str] | Mapping[str, None], rows: Sequence[Row]) -> tuple[str, ...]:
    known = {name for row in rows for name in row.values}
    return tuple(name for name in names if name in known)


def _per_frame(ranking: str) -> str:
    """Return the metric per frame that stands for the ranking one."""
    return "attribute_mse" if ranking == "mse_avg" else ranking
